# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's materials as backend materials and, where they vary over a mesh, as albedo and emission maps.

All materials are evaluated together on a palette of one quad each; only meshes with a material that varies are baked
over their own light-map layout. Rough reflection counts as diffuse, so that its energy is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ..backend.errors import BakeError
from ..backend.progress import Report
from ..backend.scene import Float32, Material
from ..source import Layout, SourceScene
from . import nodes
from .as_rendered import read_as_rendered
from .lobes import OUTPUT, Lobes, read_lobes
from .material_maps import bake_mesh, carried_of, tell_instances, with_means
from .palette import evaluate_constants


@dataclass(frozen=True)
class Appearance:
    """Follows SourceScene.material_names and .meshes."""

    materials: tuple[Material, ...]
    albedo_maps: list[Float32 | None]  # (h, w, 3) over the mesh's layout
    emission_maps: list[Float32 | None]  # (h, w, 3) radiance, W/(m² sr)
    warnings: tuple[str, ...] = ()


def evaluate_materials(
    source: SourceScene, layouts: Sequence[Layout], resolution_px: Sequence[tuple[int, int]], report: Report
) -> Appearance:
    """``resolution_px`` (width, height) of each mesh's maps. The scene must be at the first frame of the bake."""
    warnings: dict[str, None] = {}  # keeps order
    materials = [_find(name) for name in source.material_names]
    _require_images(materials)
    lobes = read_as_rendered(
        bpy.context.scene, bpy.context.view_layer, lambda depsgraph: _lobes_of(materials, depsgraph)
    )
    for material, lobe in zip(materials, lobes, strict=True):
        warnings.update({f"material {material.name}: {note}": None for note in lobe.notes if material is not None})
    varies = np.array([m is not None and _varies(m) for m in materials], np.bool_)
    textured = [i for i, m in enumerate(source.meshes) if varies[np.unique(m.material_of_triangle)].any()]
    report("materials", 0, 1 + len(textured))
    constants = evaluate_constants(source.material_names, materials, lobes, varies, warnings)
    albedo: list[Float32 | None] = [None] * len(source.meshes)
    emission: list[Float32 | None] = [None] * len(source.meshes)
    carried = carried_of(source, textured) if textured else {}
    for done, index in enumerate(textured):
        report("materials", 1 + done, 1 + len(textured))
        albedo[index], emission[index] = bake_mesh(
            source, index, layouts[index], resolution_px[index], carried[index], materials, lobes, warnings
        )
        tell_instances(source, index, materials, varies, warnings)
    constants = with_means(constants, source, layouts, varies, albedo, emission)
    _require_light(source, constants, emission)
    report("materials", 1 + len(textured), 1 + len(textured))
    return Appearance(constants, albedo, emission, tuple(warnings))


def animated_lobes(source: SourceScene, depsgraph: bpy.types.Depsgraph) -> dict[int, Lobes]:
    """Of the materials that :func:`animated_constants` evaluates, by their number; animation is ``depsgraph``'s."""
    materials = [_find(name) for name in source.material_names]
    moving = [i for i, m in enumerate(materials) if nodes.is_time_dependent(m) and not _varies(m)]
    return dict(zip(moving, _lobes_of([materials[i] for i in moving], depsgraph), strict=True))


def animated_constants(
    source: SourceScene, constants: Sequence[Material], lobes: dict[int, Lobes]
) -> tuple[Material, ...] | None:
    """``constants`` with the animated ones, those of ``lobes``, evaluated at the current frame; None where none is."""
    if not lobes:
        return None
    names = [source.material_names[i] for i in lobes]
    some = [_find(name) for name in names]
    new = evaluate_constants(names, some, list(lobes.values()), np.zeros(len(some), np.bool_), {})
    out = list(constants)
    for index, material in zip(lobes, new, strict=True):
        out[index] = material
    return tuple(out)


def _lobes_of(materials: Sequence[bpy.types.Material | None], depsgraph: bpy.types.Depsgraph) -> list[Lobes]:
    """Read from evaluated node trees: of what only renders show, the file's own keep the values of another frame."""
    return [Lobes() if m is None else read_lobes(m.evaluated_get(depsgraph)) for m in materials]


def _find(name: str | None) -> bpy.types.Material | None:
    if name is None:
        return None
    for material in bpy.data.materials:
        if material.name_full == name:
            return material
    raise BakeError(f"material {name}: no longer in the file; start the bake again")


def _varies(material: bpy.types.Material) -> bool:
    """Does it differ from point to point, as far as its nodes can tell?"""
    if not nodes.uses_nodes(material):
        return False
    return any(n.bl_idname not in nodes.PLAIN_NODES for n in nodes.reachable(material.node_tree, OUTPUT))


def _require_images(materials: Sequence[bpy.types.Material | None]) -> None:
    problems = [
        f"material {material.name}: image file {path} is missing; restore or relink it, or remove the node"
        for material in materials
        if material is not None and nodes.uses_nodes(material)
        for path in nodes.missing_images(material.node_tree, OUTPUT)
    ]
    if problems:
        raise BakeError(*problems)


def _require_light(source: SourceScene, constants: Sequence[Material], emission: Sequence[Float32 | None]) -> None:
    shines = any(glow is not None for glow in emission) or any(max(m.emission) > 0 for m in constants)
    animated = any(nodes.is_time_dependent(_find(name)) for name in source.material_names if name is not None)
    if not (source.lit or shines or animated):
        raise BakeError(
            "the scene has no light: every lamp is off, the world is black and no material emits; "
            "add a lamp, give the world a colour, or give a material some emission"
        )
