# SPDX-License-Identifier: GPL-3.0-or-later
"""Stand-ins: mesh objects that show light maps for what has no place of its own for UVs and properties.

The rule: an object keeps itself if it is a local mesh object whose modifiers leave its faces alone, which instances
nothing and has room for the layer. All else (instances, generated geometry, curves, text, objects of a library, objects
whose faces or materials change) is hidden and shown by stand-ins: its evaluated mesh with all attributes, one object
for each instance and each of its variants.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from .backend.scene import Float32, Int32
from .extract.meshes import loop_normals, positions, topology_digest
from .extract.placed import identify, placed_meshes
from .extract.variants import Finder
from .lightmap_nodes import animation_curves
from .lightmap_sampling import MARK, UV_LAYER
from .motion import Motion
from .source import SourceScene

COLLECTION = "RTGI stand-ins"
#: What hides an object, in renders and in the viewport, and where a hidden original remembers how that was.
_HIDDEN = {"hide_render": "rtgi_hidden", "hide_viewport": "rtgi_hidden_viewport"}
_MUTED = "rtgi_muted"

#: How ``foreach_get`` reads an attribute of a type: property, components, dtype.
_VALUES = {
    "FLOAT": ("value", 1, np.float32),
    "INT": ("value", 1, np.int32),
    "INT8": ("value", 1, np.int32),
    "BOOLEAN": ("value", 1, np.bool_),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT2": ("vector", 2, np.float32),
    "FLOAT_COLOR": ("color", 4, np.float32),
    "BYTE_COLOR": ("color_srgb", 4, np.float32),  # as stored, no rounding
    "QUATERNION": ("value", 4, np.float32),
}


@dataclass(frozen=True)
class Attribute:
    name: str
    domain: str
    data_type: str
    values: NDArray[np.generic]  # flat


@dataclass(frozen=True)
class MeshCopy:
    """An evaluated mesh with all that shading can ask for."""

    positions: Float32  # (v, 3) object
    vertex_of_loop: Int32  # (loops,)
    loop_start: Int32  # (faces,)
    normals: Float32  # (loops, 3)
    attributes: tuple[Attribute, ...]
    rendered_uv: str | None
    rendered_color: str | None
    texture_space: tuple[tuple[float, ...], tuple[float, ...]]  # location, size
    materials: tuple[str | None, ...]  # full names by slot


@dataclass
class Survey:
    """Who keeps himself and who is stood in for; indices follow ``source.instances``."""

    own: dict[int, str] = field(default_factory=dict)  # instance -> full name of the object
    copies: dict[int, MeshCopy] = field(default_factory=dict)  # mesh -> copy, for meshes of stand-ins
    hidden: dict[str, None] = field(default_factory=dict)  # full names of the objects that are stood in for
    lamps: dict[str, str] = field(default_factory=dict)  # lamp of a hidden instancer -> full name of its data
    lost: dict[str, None] = field(default_factory=dict)  # warnings: what else hidden instancers show
    known: set[int] = field(default_factory=set)  # instances decided on
    mesh_of_data: dict[str, int] = field(default_factory=dict)  # whose layout a mesh of the file takes


def survey(depsgraph: bpy.types.Depsgraph, source: SourceScene, found: Survey) -> Survey:
    """Decide for each instance of ``source`` that this frame shows and ``found`` does not know; adds to ``found``."""
    finder = Finder(source)
    instancers = {key[0] for key in source.keys if key[0]}
    objects = {obj.name_full: obj for obj in bpy.data.objects}
    for placed in placed_meshes(depsgraph, lambda line: None):
        index = finder.index_or_none(placed)
        if index is None or index in found.known:
            continue
        found.known.add(index)
        mesh, obj = source.instances[index].mesh, objects.get(str(placed.key[1]))
        alone = source.looks[index] is None and not placed.key[0] and not finder.knows((*placed.key[:-1], 1))
        alone = alone and placed.key[1] not in instancers
        has_layout = source.meshes[mesh].rtgi_uv is not None
        if alone and obj is not None and _keeps_itself(obj, placed.data, has_layout=has_layout):
            # Two objects may share a mesh and differ by their modifiers, and so in their layouts.
            if found.mesh_of_data.setdefault(obj.data.name, mesh) == mesh:
                found.own[index] = obj.name_full
                continue
        found.hidden[str(placed.key[0] or placed.key[1])] = None
        if mesh not in found.copies:
            found.copies[mesh] = copy_mesh(placed.data, placed.materials)
    _survey_others(depsgraph, source, found)
    return found


def _keeps_itself(obj: bpy.types.Object, evaluated: bpy.types.Mesh, *, has_layout: bool) -> bool:
    if obj.type != "MESH" or obj.library is not None or obj.data.library is not None:
        return False
    has_room = has_layout or (UV_LAYER not in obj.data.attributes and len(obj.data.uv_layers) < 8)
    return has_room and topology_digest(obj.data) == topology_digest(evaluated)


def _survey_others(depsgraph: bpy.types.Depsgraph, source: SourceScene, found: Survey) -> None:
    """Lamps and the rest that hiding the instancers would take away."""
    lamps = {key: light.name for key, light in zip(source.lamp_keys, source.lights, strict=True)}
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self or isinstance(obj.data, bpy.types.Mesh) or obj.type == "EMPTY":
            continue
        name, key = identify(instance)
        if key[0] not in found.hidden:
            continue
        if key in lamps:
            found.lamps[lamps[key]] = obj.data.original.name_full
        elif obj.type != "LIGHT":  # a portal shows nothing
            found.lost[f"{name}: {obj.type.lower()} objects in instances are not shown in the preview"] = None


def copy_mesh(mesh: bpy.types.Mesh, materials: tuple[str | None, ...]) -> MeshCopy:
    """Everything of an evaluated mesh that its stand-in needs."""
    vertex_of_loop = np.zeros(len(mesh.loops), np.int32)
    mesh.attributes[".corner_vert"].data.foreach_get("value", vertex_of_loop)
    loop_start = np.zeros(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", loop_start)
    attributes = []
    for attribute in mesh.attributes:
        if attribute.data_type in _VALUES and attribute.domain in ("POINT", "CORNER", "FACE"):
            if not attribute.name.startswith(".") and attribute.name not in ("position", "sharp_face", UV_LAYER):
                prop, width, dtype = _VALUES[attribute.data_type]
                values = np.zeros(len(attribute.data) * width, dtype)
                attribute.data.foreach_get(prop, values)
                attributes.append(Attribute(attribute.name, attribute.domain, attribute.data_type, values))
    colors = mesh.color_attributes
    color_index = colors.render_color_index
    return MeshCopy(
        positions=positions(mesh),
        vertex_of_loop=vertex_of_loop,
        loop_start=loop_start,
        normals=loop_normals(mesh),
        attributes=tuple(attributes),
        rendered_uv=next((layer.name for layer in mesh.uv_layers if layer.active_render), None),
        rendered_color=colors[color_index].name if 0 <= color_index < len(colors) else None,
        texture_space=(tuple(mesh.texspace_location), tuple(mesh.texspace_size)),
        materials=materials,
    )


def make_mesh(copy: MeshCopy, name: str, loop_uv: Float32) -> bpy.types.Mesh:
    """A mesh like ``copy`` with the light-map layer ``loop_uv`` (loops, 2)."""
    mesh = bpy.data.meshes.new(f"RTGI {name}")
    mesh[MARK] = True
    mesh.vertices.add(len(copy.positions))
    mesh.vertices.foreach_set("co", copy.positions.ravel())
    mesh.loops.add(len(copy.vertex_of_loop))
    mesh.loops.foreach_set("vertex_index", copy.vertex_of_loop)
    mesh.polygons.add(len(copy.loop_start))
    mesh.polygons.foreach_set("loop_start", copy.loop_start)
    mesh.update(calc_edges=True)
    materials = {material.name_full: material for material in bpy.data.materials}
    for material in copy.materials:
        mesh.materials.append(None if material is None else materials[material])
    uv = Attribute(UV_LAYER, "CORNER", "FLOAT2", np.ascontiguousarray(loop_uv, np.float32).ravel())
    for source in (*copy.attributes, uv):
        attribute = mesh.attributes.get(source.name) or mesh.attributes.new(
            source.name, source.data_type, source.domain
        )
        attribute.data.foreach_set(_VALUES[source.data_type][0], source.values)
    if copy.rendered_uv is not None and copy.rendered_uv in mesh.uv_layers:
        mesh.uv_layers[copy.rendered_uv].active_render = True
    if copy.rendered_color is not None:
        mesh.color_attributes.render_color_index = mesh.color_attributes.find(copy.rendered_color)
    mesh.use_auto_texspace = False
    mesh.texspace_location, mesh.texspace_size = copy.texture_space
    mesh.normals_split_custom_set(copy.normals.astype(np.float64).tolist())
    return mesh


def standin_collection() -> bpy.types.Collection:
    """The collection of stand-ins, made if need be."""
    collection = next((c for c in bpy.data.collections if c.get(MARK)), None)
    if collection is None:
        collection = bpy.data.collections.new(COLLECTION)
        collection[MARK] = True
        bpy.context.scene.collection.children.link(collection)
    return collection


def add_object(name: str, data: bpy.types.ID, motion: Motion, frames: Sequence[int]) -> bpy.types.Object:
    """An object of ours that moves and shows itself as ``motion`` says."""
    obj = bpy.data.objects.new(f"RTGI {name}", data)
    obj[MARK] = True
    standin_collection().objects.link(obj)
    obj.rotation_mode = "QUATERNION"
    moves = bool((motion.matrix != motion.matrix[0]).any())
    blinks = bool((motion.shown != motion.shown[0]).any())
    before = None
    for matrix, shown, frame in zip(motion.matrix, motion.shown, frames, strict=True):
        if before is None or moves:
            _set_matrix(obj, Matrix(matrix.tolist()))
        for path in ("location", "rotation_quaternion", "scale") if moves else ():
            obj.keyframe_insert(path, frame=frame)
        if shown != before:
            _show(obj, shown=bool(shown), frame=frame if blinks else None)
        before = shown
    if obj.animation_data is not None:
        obj.animation_data.action[MARK] = True
        for curve in animation_curves(obj.animation_data):
            for key in curve.keyframe_points:
                key.interpolation = "CONSTANT" if curve.data_path in _HIDDEN else "LINEAR"
    return obj


def _set_matrix(obj: bpy.types.Object, matrix: Matrix) -> None:
    """Without a turn by the long way round since the matrix before."""
    before = obj.rotation_quaternion.copy()
    obj.matrix_basis = matrix
    rotation = obj.rotation_quaternion.copy()
    rotation.make_compatible(before)
    obj.rotation_quaternion = rotation


def _show(obj: bpy.types.Object, *, shown: bool, frame: int | None) -> None:
    """From ``frame`` on, if given."""
    for path in _HIDDEN:
        setattr(obj, path, not shown)
        if frame is not None:
            obj.keyframe_insert(path, frame=frame)


def hide_originals(names: Iterable[str]) -> None:
    """Take the objects of these full names out of renders and viewports, remembering how they were."""
    objects = {obj.name_full: obj for obj in bpy.data.objects}
    for obj in (objects[name] for name in names if name in objects):
        animation = obj.animation_data
        for curve in [] if animation is None else [*animation_curves(animation), *animation.drivers]:
            if curve.data_path in _HIDDEN and not curve.mute:
                curve.mute = True
                obj[_MUTED] = True
        for path, kept in _HIDDEN.items():
            obj[kept] = getattr(obj, path)
            setattr(obj, path, True)


def remove_standins() -> None:
    """Remove all stand-ins and show the originals again."""
    for obj in [o for o in bpy.data.objects if _HIDDEN["hide_render"] in o]:
        for path, kept in _HIDDEN.items():
            if kept in obj:
                setattr(obj, path, bool(obj[kept]))
                del obj[kept]
        if obj.get(_MUTED):
            del obj[_MUTED]
            for curve in [*animation_curves(obj.animation_data), *obj.animation_data.drivers]:
                if curve.data_path in _HIDDEN:
                    curve.mute = False
    for kind in ("objects", "collections", "meshes", "actions"):
        blocks = getattr(bpy.data, kind)
        for block in [b for b in blocks if b.get(MARK)]:
            blocks.remove(block)
