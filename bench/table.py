# SPDX-License-Identifier: GPL-3.0-or-later
"""What the bench runs: scenes and methods. To add one, add a row."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from rtgi_addon.backend.settings import SAMPLES_OF_QUALITY, Quality, SampleCounts

ROOT = Path(__file__).parents[1]
#: Errors at which times are compared.
TARGETS = (0.04, 0.03, 0.02)
#: RTGI is to reach the first of them so much sooner than Cycles + OIDN.
HELD_TO = 25.0

#: Texels that are surface by less are not compared: Cycles bakes the one point in the middle of a pixel, which at half
#: lies on the very border, often black, and below half comes from its neighbours.
LEAST_WHOLE = 0.75


@dataclass(frozen=True)
class BenchScene:
    """A scene with a stored reference. All its materials must be uniform: the Cycles bake joins its meshes."""

    name: str
    title: str

    @property
    def blend(self) -> Path:
        return ROOT / "demo_blend" / f"{self.name}.blend"

    @property
    def reference(self) -> Path:
        return ROOT / "tests" / "reference" / f"{self.name}.npz"


class Curve(StrEnum):
    """Methods that differ in sample count alone; one line of the plot."""

    OURS = "RTGI"
    OURS_DENOISED = "RTGI + OIDN"
    CYCLES = "Cycles"
    CYCLES_DENOISED = "Cycles + OIDN"


@dataclass(frozen=True)
class Method:
    """One point of a curve; ``samples`` of RTGI, or Cycles' per texel."""

    samples: SampleCounts | int
    seeds: int
    name: str = ""

    @property
    def label(self) -> str:
        return self.name or f"{self.samples} spp"


SCENES = (
    BenchScene("cornell", "Cornell box"),
    BenchScene("larsen_box", "Box with a bumpy floor (Larsen04, Figure 1)"),
    BenchScene("two_rooms", "Two rooms, the wall between them closed (Larsen04, Figure 5)"),
)
OURS = tuple(
    Method(counts, 5, name)
    for counts, name in (
        (SAMPLES_OF_QUALITY[Quality.DRAFT], "draft"),
        (SampleCounts(16, 16), "16 + 16 rays"),
        (SAMPLES_OF_QUALITY[Quality.PREVIEW], "preview"),
        (SAMPLES_OF_QUALITY[Quality.FINAL], "final"),
    )
)
CYCLES = (Method(16, 5), Method(64, 5), Method(256, 5), Method(1024, 3))
#: With --full, so that Cycles' curves reach the lower errors.
CYCLES_FULL = (*CYCLES, Method(4096, 2))
