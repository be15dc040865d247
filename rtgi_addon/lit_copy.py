# SPDX-License-Identifier: GPL-3.0-or-later
"""A copy of the open scene that shows its light maps, saved as a .blend; the open scene stays as it is.

After the frames of a bake, for artists who go on working with the lit scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy

from .job import Plan
from .lightmap_nodes import MARK
from .lightmaps import apply_lightmaps, map_files, remove_lightmaps
from .output import whole_file
from .source import Layout, SourceScene


def is_lit() -> bool:
    """Does the open scene show light maps already? They would be baked as if its surfaces shone."""
    return any(group.get(MARK) for group in bpy.data.node_groups)


def save_lit_copy(path: Path, source: SourceScene, layouts: Sequence[Layout], plan: Plan) -> tuple[str, ...]:
    """Save the copy at ``path``; warnings of what it does not show. Paths in it are relative to it."""
    maps = map_files(plan.out, page_count=plan.atlas.page_count, frames=plan.frames)
    applied = apply_lightmaps(source, layouts, plan.atlas, maps, plan.states)
    try:
        with whole_file(path) as part:
            bpy.ops.wm.save_as_mainfile(filepath=str(part), copy=True, check_existing=False)
    finally:
        remove_lightmaps()
    return applied.warnings
