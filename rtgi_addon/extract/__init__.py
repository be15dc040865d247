# SPDX-License-Identifier: GPL-3.0-or-later
"""From Blender to arrays: the scene as a render would see it, for each frame, and its materials.

extract_source -> (unwrap elsewhere) -> evaluate_materials -> frame_state per frame.
as_rendered gives the depsgraph; placed, meshes, lights and world read it; lobes and texture_bake do for materials.
"""

from __future__ import annotations

from .frames import frame_state
from .materials import Appearance, evaluate_materials
from .source_scene import extract_source

__all__ = ["Appearance", "evaluate_materials", "extract_source", "frame_state"]
