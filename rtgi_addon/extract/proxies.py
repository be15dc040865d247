# SPDX-License-Identifier: GPL-3.0-or-later
"""Stand-ins for the user's meshes that Cycles can bake over a light-map layout.

A proxy has the same triangles and carries every attribute that a shader may read, so node trees see what they see on
the original; it is a triangle soup of corners, since a layout may cut through the polygons of the original.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.errors import BakeError
from ..backend.scene import Float32, Float64
from ..source import Layout, SourceMesh
from .meshes import UV_LAYER

#: How Blender stores an attribute: property to read, values per element, number type.
STORAGE: dict[str, tuple[str, int, type]] = {
    "FLOAT": ("value", 1, np.float32),
    "INT": ("value", 1, np.int32),
    "INT8": ("value", 1, np.int32),
    "BOOLEAN": ("value", 1, np.bool_),
    "FLOAT2": ("vector", 2, np.float32),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT_COLOR": ("color", 4, np.float32),
    "BYTE_COLOR": ("color", 4, np.float32),
}
OWN_ATTRIBUTES = {"position", "material_index", "custom_normal"}


@dataclass(frozen=True)
class Attribute:
    """Values per element of ``domain``: (elements, width)."""

    name: str
    kind: str
    domain: str
    values: NDArray[np.generic]


@dataclass(frozen=True)
class Carried:
    """What shaders may read of one evaluated mesh and the object it is on."""

    attributes: tuple[Attribute, ...]
    render_uv: str
    render_color: str
    matrix: Float64  # (4, 4) of the first instance
    color: tuple[float, ...]  # the object's
    pass_index: int


def read_carried(obj: bpy.types.Object, mesh: bpy.types.Mesh, matrix: Float64) -> Carried:
    """Copies of everything; no reference to evaluated data stays."""
    attributes = []
    for attribute in mesh.attributes:
        usable = attribute.data_type in STORAGE and attribute.domain in {"POINT", "CORNER", "FACE"}
        if usable and not attribute.name.startswith(".") and attribute.name not in OWN_ATTRIBUTES:
            prop, width, dtype = STORAGE[attribute.data_type]
            values = np.zeros(len(attribute.data) * width, dtype)
            attribute.data.foreach_get(prop, values)
            attributes.append(
                Attribute(attribute.name, attribute.data_type, attribute.domain, values.reshape(-1, width))
            )
    render_uv = next((layer.name for layer in mesh.uv_layers if layer.active_render), "")
    render_color = mesh.attributes.default_color_name or ""
    return Carried(tuple(attributes), render_uv, render_color, matrix, tuple(obj.color), obj.pass_index)


def build_proxy(source: SourceMesh, layout: Layout, carried: Carried) -> bpy.types.Mesh:
    """A mesh with the UV layer RTGI holding ``layout``; material slots are empty, numbers are the source's."""
    mesh = bpy.data.meshes.new("rtgi_proxy")
    count = len(source.triangles)
    mesh.vertices.add(len(source.vertices))
    mesh.loops.add(3 * count)
    mesh.polygons.add(count)
    mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(source.vertices).ravel())
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(source.triangles).ravel())
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    for attribute in carried.attributes:
        if not (attribute.domain == "CORNER" and attribute.name == UV_LAYER):
            _carry(mesh, attribute, source)
    _add_layout(mesh, layout, source.name)
    if carried.render_uv in mesh.uv_layers:
        mesh.uv_layers[carried.render_uv].active_render = True
    if carried.render_color:
        mesh.attributes.default_color_name = carried.render_color
    mesh.normals_split_custom_set(source.corner_normals.reshape(-1, 3))
    return mesh


def _carry(mesh: bpy.types.Mesh, attribute: Attribute, source: SourceMesh) -> None:
    rows = {
        "POINT": slice(None),
        "CORNER": source.loop_of_corner.ravel(),
        "FACE": source.polygon_of_triangle,
    }[attribute.domain]
    new = mesh.attributes.get(attribute.name) or mesh.attributes.new(attribute.name, attribute.kind, attribute.domain)
    if new is None or new.domain != attribute.domain or new.data_type != attribute.kind:
        return  # one of Blender's own names with a meaning of its own: nothing a shader reads
    values = np.ascontiguousarray(attribute.values[rows]).ravel()
    new.data.foreach_set(STORAGE[attribute.kind][0], values)


def _add_layout(mesh: bpy.types.Mesh, layout: Layout, name: str) -> None:
    layer = mesh.uv_layers.new(name=UV_LAYER, do_init=False)
    if layer is None:
        raise BakeError(f"{name}: has as many UV maps as Blender allows; remove one to make room for {UV_LAYER}")
    uv: Float32 = np.ascontiguousarray(layout.corner_uv, np.float32)
    layer.uv.foreach_set("vector", uv.ravel())
