# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake is asked for, and what it has prepared when frames begin. Plain data, no bpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from .backend.scene import Atlas, FrameState, Scene
from .backend.settings import BakeSettings


@dataclass(frozen=True)
class BakeJob:
    """What to bake. None of scene: the open one; of frames: the scene's own; of out: a folder beside the .blend."""

    scene: Path | None = None
    frames: Sequence[int] | None = None
    out: Path | None = None
    settings: BakeSettings = field(default_factory=BakeSettings)
    resume: bool = False
    texels: bool = False  # write texels.npz
    save_blend: Path | None = None  # save a copy of the scene that shows the maps


@dataclass(frozen=True)
class Plan:
    """A bake ready for its frames."""

    job: BakeJob
    frames: Sequence[int]
    out: Path
    scene: Scene
    atlas: Atlas
    states: Sequence[FrameState]  # of the frames, read from Blender when asked for
    guide: Sequence[FrameState]  # spread over them; their light tells where gather rays are aimed in all
    setup_seconds: dict[str, float]  # by stage
    warnings: tuple[str, ...]
