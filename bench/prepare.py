# SPDX-License-Identifier: GPL-3.0-or-later
"""A .blend made ready to bake, outside of ``rtgi bake``: the same stages up to the atlas, without folder and frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from rtgi_addon.backend.layout.packing import pack
from rtgi_addon.backend.layout.sides import lit_sides
from rtgi_addon.backend.progress import silent
from rtgi_addon.backend.scene import Atlas, FrameState, Scene
from rtgi_addon.backend.settings import BakeSettings
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.texels import Texels, make_texels, place_texels
from rtgi_addon.extract import evaluate_materials, extract_source
from rtgi_addon.frames import FrameStates
from rtgi_addon.layouts import assemble, expected_densities, lay_out, map_sizes
from rtgi_addon.scene_file import open_blend

from .reference import TexelTable


@dataclass(frozen=True)
class Prepared:
    """A scene at its first frame, and its atlas."""

    scene: Scene
    atlas: Atlas
    first: FrameState


def prepare(blend: Path, resolution: int, frame: int = 1) -> Prepared:
    """Open ``blend`` and lay out its light maps on pages of ``resolution`` pixels."""
    open_blend(blend.absolute())
    settings = BakeSettings(resolution=resolution)
    source = extract_source([frame], silent)
    bpy.context.scene.frame_set(frame)
    densities = expected_densities(source, settings)
    layouts, _ = lay_out(source, densities, silent)
    appearance = evaluate_materials(source, layouts, map_sizes(layouts, densities, resolution), silent)
    scene = assemble(source, layouts, appearance)
    states = FrameStates(source, [frame], scene.materials)
    front, back = lit_sides(scene, states)
    atlas = pack(scene, resolution=resolution, density=None, front=front, back=back).atlas
    return Prepared(scene, atlas, states[0])


def texel_table(prepared: Prepared) -> tuple[Texels, TexelTable]:
    """All texels of the atlas, and where they are in the world."""
    geometry = Geometry(prepared.scene, prepared.first)
    texels = make_texels(prepared.scene, prepared.atlas, geometry)
    frame = place_texels(texels, geometry)
    names = tuple(instance.name for instance in prepared.scene.instances)
    position = geometry.origin + frame.position.astype(np.float64)
    return texels, TexelTable(position, frame.normal, frame.area, texels.instance, names)
