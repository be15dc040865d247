# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of the bench that need no .blend: animations, scaling, Larsen04's tables. Each in a process of its own.

Blender is only asked where it keeps Open Image Denoise.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from rtgi_addon.backend.settings import BakeSettings, Quality

from . import flicker, frames, larsen_tables, scaling
from .results import Machine
from .sequences import SEQUENCES

log = logging.getLogger("bench")
Result = TypeVar("Result")

#: How sequences are played, by name: what a bake's default is, few rays, and those without an error estimate, which
#: costs a second denoise and which nobody reads while a scene moves before his eyes.
KINDS: dict[str, dict[str, Any]] = {
    "preview": {"quality": Quality.PREVIEW},
    "draft": {"quality": Quality.DRAFT},
    "live": {"quality": Quality.DRAFT, "estimate": False},
}
#: Kinds whose maps are alike flicker alike.
FLICKERING = ("preview", "draft")
#: Maps are compared with converged ones at these frames; at none where another sequence says as much.
COMPARED = {"slow": (), "still": frames.COMPARED[:1]}


@dataclass(frozen=True)
class FramesResult:
    machine: Machine
    played: list[frames.Played]
    flickers: list[flicker.Flicker]


@dataclass(frozen=True)
class ScalingResult:
    machine: Machine
    sweeps: list[scaling.Sweep]


@dataclass(frozen=True)
class LarsenResult:
    machine: Machine
    look_ups: list[larsen_tables.LookUp]
    gathers: list[larsen_tables.FinalGather]


def in_process(work: Callable[[], Result]) -> Result:
    """``work()`` in a fresh process: the parent must not load bpy, or processes that it starts cannot."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_with_log, work).result()


def _with_log(work: Callable[[], Result]) -> Result:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    return work()


def bench_frames() -> FramesResult:
    """All sequences with all qualities, beside converged maps; and the slow mover's flicker."""
    machine, oidn = _surroundings()
    played, flickers = [], []
    for name, make in SEQUENCES.items():
        sequence = make()
        compared = COMPARED.get(name, frames.COMPARED)
        converged = frames.converge(sequence, compared) if compared else None
        for label, kind in KINDS.items():
            settings = BakeSettings(**kind, **sequence.options)
            played.append(frames.play(sequence, settings, oidn, label=label, converged=converged))
            _log(played[-1])
    sequence = SEQUENCES["slow"]()
    truth = flicker.true_changes(sequence)
    for label in FLICKERING:
        flickers.append(flicker.flicker(sequence, BakeSettings(**KINDS[label]), oidn, truth, label=label))
    return FramesResult(machine, played, flickers)


def bench_scaling() -> ScalingResult:
    machine, oidn = _surroundings()
    sweeps = []
    for sweep in scaling.sweeps(oidn):
        log.info("scaling with %s: slopes %.2f selected, %.2f from scratch", sweep.name, *sweep.slopes())
        sweeps.append(sweep)
    return ScalingResult(machine, sweeps)


def bench_larsen() -> LarsenResult:
    machine, _ = _surroundings()
    return LarsenResult(machine, larsen_tables.look_ups(), larsen_tables.final_gathers())


def _surroundings() -> tuple[Machine, list[Path]]:
    """The machine, and where Open Image Denoise may lie. Only called in a process of its own: it loads bpy."""
    from rtgi_addon.environment import device, library_folders, versions

    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    processor = device(0)
    return Machine(str(processor["name"]), int(processor["threads"]), versions(), load), library_folders()


def _log(played: frames.Played) -> None:
    log.info(
        "%s, %s: %.1f ms a frame selected, %.1f from scratch, %.1f times",
        played.title, played.label, 1000 * played.selected.seconds, 1000 * played.scratch.seconds, played.ratio,
    )  # fmt: skip
