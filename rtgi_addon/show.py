# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of a baked scene, stage by stage: :func:`show`. Opens, takes the bake up again, applies its maps, draws.

The counterpart of ``bake`` for ``rtgi render``. The scene has no light maps afterwards, as before.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy

from .backend.errors import BakeError
from .lightmaps import apply_lightmaps, remove_lightmaps
from .lit_copy import take_off
from .output import FrameFailed, folder_problems
from .preview import render_preview
from .reopen import Baked, reopen
from .scene_file import open_blend, scene_problems
from .terminal import Listener


@dataclass(frozen=True)
class ShowJob:
    """What to draw. None of scene: the open one; of frames: those baked; of out: preview/ in the folder of the maps."""

    maps: Path
    scene: Path | None = None
    frames: Sequence[int] | None = None
    out: Path | None = None
    size: tuple[int, int] | None = None  # (width, height) in pixels; None: the scene's own
    samples: int | None = None  # Eevee's; None: the scene's own


@dataclass(frozen=True)
class ShowSummary:
    """What was drawn."""

    out: Path
    pictures: tuple[Path, ...]
    video: Path | None
    seconds: float
    warnings: tuple[str, ...]

    def in_words(self) -> list[str]:
        video = "" if self.video is None else f" and {self.video.name}"
        count = len(self.pictures)
        return [f"{count} picture{'s' * (count != 1)}{video} in {self.seconds:.1f} s: {self.out}"]


def show(job: ShowJob, listener: Listener | None = None) -> ShowSummary:
    """Draw ``job``. Raises BakeError before anything is written, FrameFailed or Cancelled later."""
    listener = Listener() if listener is None else listener
    start = time.perf_counter()
    open_blend(job.scene)
    take_off(job.scene)
    out = job.maps / "preview" if job.out is None else job.out
    _require(job, out)
    listener.report("open", 1, 1)
    baked = reopen(job.maps, listener.report)
    frames = baked.maps.frames if job.frames is None else job.frames
    applied = apply_lightmaps(baked.source, baked.layouts, baked.atlas, baked.maps, baked.states)
    try:
        warnings = [*applied.warnings, *_held(baked, frames)]
        for text in warnings:
            listener.warn(text)
        out.mkdir(parents=True, exist_ok=True)
        drawn = render_preview(out, frames, size=job.size, samples=job.samples, report=listener.report)
    except (BakeError, OSError) as fault:
        raise FrameFailed(*(fault.problems if isinstance(fault, BakeError) else (str(fault),))) from fault
    finally:
        remove_lightmaps()
    for text in drawn.warnings:
        listener.warn(text)
    return ShowSummary(out, drawn.pictures, drawn.video, time.perf_counter() - start, (*warnings, *drawn.warnings))


def _require(job: ShowJob, out: Path) -> None:
    """All that can be known to be wrong before anything is drawn."""
    scene = bpy.context.scene
    problems = [*scene_problems(), *folder_problems(out)]
    if scene.camera is None:
        problems.append(f"scene {scene.name}: has no camera to draw from; add one and make it active")
    if job.samples is not None and job.samples < 1:
        problems.append(f"--samples {job.samples}: out of range; give 1 or more")
    if problems:
        raise BakeError(*problems)


def _held(baked: Baked, frames: Sequence[int]) -> list[str]:
    first, last = baked.maps.frames[0], baked.maps.frames[-1]
    if first <= min(frames) and max(frames) <= last:
        return []
    return [f"--frames: the bake holds {first} to {last}; before and after, light stays as in the nearest of them"]
