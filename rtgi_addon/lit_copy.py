# SPDX-License-Identifier: GPL-3.0-or-later
"""A copy of the open scene that shows its light maps, saved as a .blend; and what to do when such a copy is baked.

Saved after the frames of a bake, for artists who go on working with the lit scene. The open scene stays unlit.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy

from .backend.errors import BakeError
from .eevee_light import direct_light_only, kept
from .job import Plan
from .lightmap_nodes import MARK
from .lightmaps import apply_lightmaps, map_files, remove_lightmaps
from .output import whole_file
from .preview import eevee_engine
from .source import Layout, SourceScene


def take_off(named: Path | None) -> None:
    """Take light maps of an earlier bake off the open scene: they would be baked as if its surfaces shone.

    Only off a file that was ``named`` to be opened. A scene that merely is open stays as it is, so that is refused.
    """
    if not any(group.get(MARK) for group in bpy.data.node_groups):
        return
    if named is None:
        raise BakeError("the open scene shows light maps; take them off with remove_lightmaps() first")
    remove_lightmaps()


def save_lit_copy(path: Path, source: SourceScene, layouts: Sequence[Layout], plan: Plan) -> tuple[str, ...]:
    """Save the copy at ``path``; warnings of what it does not show. Paths in it are relative to it.

    It opens in Eevee, the engine that the maps are made for, without the light that they hold.
    """
    scene = bpy.context.scene
    maps = map_files(plan.out, page_count=plan.atlas.page_count, frames=plan.frames)
    applied = apply_lightmaps(source, layouts, plan.atlas, maps, plan.states)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with direct_light_only(scene), kept(scene.render, engine=eevee_engine()), whole_file(path) as part:
            bpy.ops.wm.save_as_mainfile(filepath=str(part), copy=True, check_existing=False)
    except RuntimeError as fault:
        reason = str(fault).strip().splitlines()[0].removeprefix("Error: ")
        raise BakeError(f"{path}: cannot be written ({reason}); check free space and permissions") from fault
    finally:
        remove_lightmaps()
    return applied.warnings
