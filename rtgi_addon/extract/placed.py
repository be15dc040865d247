# SPDX-License-Identifier: GPL-3.0-or-later
"""What stands in the scene in one frame: every mesh-like object and instance that a render would show, and every lamp.

Reads the depsgraph; knows objects by names and numbers that mean the same in every frame, never by reference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from ..backend.scene import Float64

#: Name of the instancer (or ""), of the object, and the numbers Blender gives an instance within its instancer.
Key = tuple[str | int, ...]

#: Objects that draw something, but nothing that a light map can cover.
NOT_MESH_LIKE = {"CURVES", "POINTCLOUD", "VOLUME", "GPENCIL", "GREASEPENCIL"}
LIGHT_RAYS = ("visible_diffuse", "visible_shadow")


@dataclass(frozen=True)
class Placed:
    """One object or instance in one frame. ``object`` and ``data`` are evaluated: good inside the reading only."""

    key: Key
    name: str  # as the user knows it; instances by the same instancer may share it
    matrix: Float64  # (4, 4) object to world
    object: bpy.types.Object
    data: bpy.types.Mesh
    materials: tuple[str | None, ...]  # by slot, full names
    blocks_light: bool
    receives_light: bool


def placed_meshes(depsgraph: bpy.types.Depsgraph, warn: Callable[[str], None]) -> Iterator[Placed]:
    """In the depsgraph's order, which is the same for the same scene."""
    seen: dict[Key, int] = {}
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self:
            continue
        if obj.type in NOT_MESH_LIKE and not isinstance(obj.data, bpy.types.Mesh):
            warn(f"{obj.name}: {obj.type.lower()} objects are not baked; convert it to a mesh to light it")
            continue
        if not isinstance(obj.data, bpy.types.Mesh) or not len(obj.data.polygons):
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        name, key = identify(instance)
        if not np.isfinite(matrix).all():
            warn(f"{name}: its transform is not finite; it is left out")
            continue
        # One object may give several meshes, a curve with geometry nodes for one.
        part = seen[key] = seen.get(key, -1) + 1
        blocks, receives = light_flags(instance, name, depsgraph.view_layer_eval, warn)
        yield Placed((*key, part), name, matrix, obj, obj.data, slot_materials(obj), blocks, receives)


def placed_lights(depsgraph: bpy.types.Depsgraph) -> Iterator[tuple[Key, str, bpy.types.Object, Float64]]:
    """(key, name, evaluated object, matrix) of each lamp that a render would use; instances may share a name."""
    for instance in depsgraph.object_instances:
        if instance.object.type == "LIGHT" and instance.show_self:
            name, key = identify(instance)
            yield key, name, instance.object, np.array(instance.matrix_world, np.float64)


def identify(instance: bpy.types.DepsgraphObjectInstance) -> tuple[str, Key]:
    """The name a user would give it, and what tells it from others over all frames."""
    obj = instance.object.original
    if not instance.is_instance:
        return obj.name_full, ("", obj.name_full)
    parent = instance.parent.original
    # The mesh of a curve, and plain geometry instanced by nodes, come as instances of the object by itself.
    name = obj.name_full if obj == parent else f"{parent.name_full}/{obj.name_full}"
    return name, (parent.name_full, obj.name_full, *instance.persistent_id)


def light_flags(
    instance: bpy.types.DepsgraphObjectInstance, name: str, layer: bpy.types.ViewLayer, warn: Callable[[str], None]
) -> tuple[bool, bool]:
    """(blocks light, receives light). As in Cycles, a ray sees an instance if it sees it and its instancer."""
    carriers = [instance.object] + ([instance.parent] if instance.is_instance else [])
    diffuse, shadow = (all(getattr(c, flag) for c in carriers) for flag in LIGHT_RAYS)
    if diffuse != shadow:
        off, on = ("shadow", "diffuse") if diffuse else ("diffuse", "shadow")
        warn(
            f"{name}: hidden from {off} rays but not from {on} rays; it blocks light here, hide both to let light pass"
        )
    holdout = any(c.is_holdout or c.holdout_get(view_layer=layer) for c in carriers)
    return diffuse or shadow, not holdout


def slot_materials(obj: bpy.types.Object) -> tuple[str | None, ...]:
    """Full names by slot: the object's own where a slot says so, else the mesh's (geometry nodes may have set them)."""
    names = [m.name_full if m is not None else None for m in obj.data.materials]
    for index, slot in enumerate(obj.material_slots[: len(names)]):
        if slot.link == "OBJECT":
            names[index] = slot.material.name_full if slot.material is not None else None
    return tuple(names)
