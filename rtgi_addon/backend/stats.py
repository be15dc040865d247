# SPDX-License-Identifier: GPL-3.0-or-later
"""What a frame cost and how good it is: the numbers of ``bake.json``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class FrameStats:
    """Counts of one frame; filled stage by stage."""

    seconds: dict[str, float] = field(default_factory=dict)  # by stage
    rays: int = 0
    photons_probed: int = 0
    photons_invalidated: int = 0
    photons_traced: int = 0
    photons_kept: int = 0
    links_tested: int = 0  # kept links that an object moved near to, looked at ray by ray
    links_traced: int = 0
    links_kept: int = 0
    views_drawn: int = 0  # texels whose view was drawn, or traced as a whole, on the GPU
    texels_updated: int = 0
    texels_kept: int = 0
    texels_pending: int = 0  # of live frames: still with links of an earlier one
    surfaces_updated: int = 0
    surfaces_kept: int = 0
    gather: str = "links"
    gather_reason: str = ""  # why this one
    device: str = "cpu"  # what traced and gathered: cpu, or the GPU's name
    view_pixels: int = 0  # along a side of a view, of gathers that draw
    cosine_rays: int = 0  # per texel
    bright_rays: int = 0  # per texel
    estimated_error: float | None = None  # relative RMS error of the IIM; None where the IIM is black
    stand_ins: dict[str, dict[str, float]] = field(default_factory=dict)  # by object, see Gathers.stand_ins
    warnings: list[str] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside to ``seconds[name]``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
