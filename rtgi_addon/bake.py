# SPDX-License-Identifier: GPL-3.0-or-later
"""A bake from .blend to folder, stage by stage, on one page: :func:`bake`.

The Blender side of the pipeline: it opens, extracts, lays out and writes, and hands arrays to the session, which
computes the light. Used by the command line and from Python alike.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import bpy

from .backend.errors import BakeError
from .backend.layout.packing import pack
from .backend.layout.sides import lit_sides
from .backend.stats import FrameStats
from .extract import evaluate_materials, extract_source
from .extract.source_scene import frame_kept
from .frames import FrameStates, bake_frames, failing, guide_of, open_folder, telling_states
from .job import BakeJob, Plan
from .layouts import assemble, expected_densities, lay_out, map_sizes
from .lit_copy import save_lit_copy, take_off
from .output import folder_problems, map_bytes
from .scene_file import default_folder, default_frames, open_blend, scene_problems, scene_warnings
from .terminal import Listener


@dataclass(frozen=True)
class BakeSummary:
    """How a bake went, when all its frames are on disk."""

    out: Path
    frames: int
    kept: int  # of them, from an earlier run
    seconds: float
    estimated_error: float | None  # the largest over frames
    warnings: tuple[str, ...]

    def in_words(self) -> list[str]:
        kept = f", {self.kept} of them kept" if self.kept else ""
        error = "" if self.estimated_error is None else f", estimated error {self.estimated_error:.1%}"
        return [f"{self.frames} frame{'s' * (self.frames != 1)} in {self.seconds:.1f} s{kept}{error}: {self.out}"]


def bake(job: BakeJob, listener: Listener | None = None) -> BakeSummary:
    """Bake ``job``: all stages in order.

    Raises BakeError before anything is written, FrameFailed or Cancelled later; finished frames are kept then.
    The scene's current frame is restored.
    """
    listener = Listener() if listener is None else listener
    report, setup, start = listener.report, FrameStats(), time.perf_counter()
    with setup.stage("open"):
        open_blend(job.scene)
        take_off(job.scene)
        frames, out = _checked(job)
        report("open", 1, 1)
    with frame_kept(bpy.context.scene):
        with setup.stage("extract"):
            source = extract_source(frames, report)
            bpy.context.scene.frame_set(frames[0])
        with setup.stage("unwrap"):
            densities = expected_densities(source, job.settings)
            layouts, warnings = lay_out(source, densities, report)
        with setup.stage("materials"):
            sizes = map_sizes(layouts, densities, job.settings.resolution)
            appearance = evaluate_materials(source, layouts, sizes, report)
            scene = assemble(source, layouts, appearance)
            states = FrameStates(source, frames, scene.materials)
        with setup.stage("sides"):
            telling = telling_states(states, report)
            front, back = lit_sides(scene, telling)
        with setup.stage("pack"):
            wanted = {"front": front, "back": back}
            packing = pack(scene, resolution=job.settings.resolution, density=job.settings.density, **wanted)
        said = (*scene_warnings(), *source.warnings, *warnings, *appearance.warnings, *packing.warnings)
        for text in said:
            listener.warn(text)
        plan = Plan(job, frames, out, scene, packing.atlas, states, guide_of(telling), setup.seconds, said)
        folder = open_folder(plan)
        with failing(folder):
            records = bake_frames(plan, folder, listener)
    with failing(folder):  # a copy opens at the frame where its author was
        if job.save_blend is not None:
            report("save", 0, 1)
            for text in save_lit_copy(job.save_blend, source, layouts, plan):
                listener.warn(text)
            report("save", 1, 1)
        folder.close("done")
    return _summary(plan, records, time.perf_counter() - start)


def _checked(job: BakeJob) -> tuple[Sequence[int], Path]:
    """Frames and folder, once all that can be known before computing is known to be right."""
    problems, out = scene_problems(), job.out
    frames = default_frames(bpy.context.scene) if job.frames is None else job.frames
    try:
        out = default_folder("rtgi") if out is None else out
    except BakeError as fault:
        problems += fault.problems
    if job.save_blend is not None and len({b - a for a, b in pairwise(frames)}) > 1:
        problems.append(f"{job.save_blend}: image sequences need evenly spaced frames; choose such, or do not save it")
    # A resumed bake may have most of its maps already.
    needed = 0 if job.resume else map_bytes(frames=len(frames), resolution=job.settings.resolution, pages=1, kinds=2)
    problems += [] if out is None else folder_problems(out, needed)
    if job.save_blend is not None:
        problems += folder_problems(job.save_blend.parent)
    if problems or out is None:
        raise BakeError(*problems)
    return frames, out


def _summary(plan: Plan, records: list[dict[str, Any]], seconds: float) -> BakeSummary:
    errors = [record["estimated_error"] for record in records if record["estimated_error"] is not None]
    return BakeSummary(
        out=plan.out,
        frames=len(records),
        kept=sum(record["kept"] for record in records),
        seconds=seconds,
        estimated_error=max(errors, default=None),
        warnings=tuple(dict.fromkeys((*plan.warnings, *(text for r in records for text in r["warnings"])))),
    )
