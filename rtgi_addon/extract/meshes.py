# SPDX-License-Identifier: GPL-3.0-or-later
"""One evaluated mesh to arrays, by Blender's fast paths (attributes rather than per-element properties).

Broken input is mended here and told: triangles at non-finite vertices are dropped, a bad RTGI layer is ignored.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.scene import Bool, Float32, Int32

UV_LAYER = "RTGI"
#: A light-map UV triangle smaller than this share of the unit square has no texels even on an 8k page.
MIN_UV_AREA = 1e-10


@dataclass(frozen=True)
class MeshArrays:
    """A SourceMesh before materials have scene-wide numbers; t triangles, v vertices."""

    vertices: Float32  # (v, 3) object
    triangles: Int32  # (t, 3)
    corner_normals: Float32  # (t, 3, 3)
    loop_of_corner: Int32  # (t, 3)
    polygon_of_triangle: Int32  # (t,)
    slot_of_triangle: Int32  # (t,) material slot
    rtgi_uv: Float32 | None  # (t, 3, 2)


@dataclass(frozen=True)
class Faces:
    """What tells the faces of two meshes apart."""

    digest: bytes
    slots: tuple[int, ...]  # material slots that faces are in, rising


def positions(mesh: bpy.types.Mesh) -> Float32:
    """(v, 3) object."""
    flat = np.zeros(len(mesh.vertices) * 3, np.float32)
    if len(flat):
        mesh.attributes["position"].data.foreach_get("vector", flat)
    return flat.reshape(-1, 3)


def loop_normals(mesh: bpy.types.Mesh) -> Float32:
    """(loops, 3) object, as Blender shades: smooth, sharp or custom."""
    flat = np.zeros(len(mesh.loops) * 3, np.float32)
    mesh.corner_normals.foreach_get("vector", flat)
    return flat.reshape(-1, 3)


def topology_digest(mesh: bpy.types.Mesh) -> bytes:
    """The same for the same faces over the same vertices."""
    corners = np.zeros(len(mesh.loops), np.int32)
    mesh.attributes[".corner_vert"].data.foreach_get("value", corners)
    starts = np.zeros(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", starts)
    return digest_of(np.array([len(mesh.vertices)]), corners, starts)


def faces_of(mesh: bpy.types.Mesh) -> Faces:
    """The same for the same faces over the same vertices in the same material slots."""
    slots = _polygon_slots(mesh)
    digest = digest_of(np.frombuffer(topology_digest(mesh), np.uint8), slots)
    return Faces(digest, tuple(np.unique(slots).tolist()))


def shape_digest(mesh: bpy.types.Mesh) -> bytes:
    """The same for the same places of all vertices and, given the same faces, the same shading normals.

    Without custom normals these follow from what is sharp, which is many times less to read.
    """
    arrays: list[NDArray[np.generic]] = [positions(mesh)]
    for name in ("sharp_face", "sharp_edge"):
        attribute = mesh.attributes.get(name)
        values = np.zeros(0 if attribute is None else len(attribute.data), np.bool_)
        if len(values) and attribute.data_type == "BOOLEAN":
            attribute.data.foreach_get("value", values)
        arrays.append(values if values.any() else values[:0])  # absent is all smooth
    if mesh.has_custom_normals or "custom_normal" in mesh.attributes:
        arrays.append(loop_normals(mesh))
    return digest_of(np.array([len(array) for array in arrays]), *arrays)


def digest_of(*arrays: NDArray[np.generic]) -> bytes:
    """16 bytes that differ where the contiguous ``arrays`` do."""
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(array)
    return digest.digest()


def read_mesh(mesh: bpy.types.Mesh, name: str, *, warn: Callable[[str], None]) -> MeshArrays:
    """All of ``mesh``; ``name`` is for the warnings."""
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    triangles, loops = np.zeros(count * 3, np.int32), np.zeros(count * 3, np.int32)
    polygons = np.zeros(count, np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles)
    mesh.loop_triangles.foreach_get("loops", loops)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    loops = loops.reshape(-1, 3)
    vertices = positions(mesh)
    return MeshArrays(
        vertices=vertices,
        triangles=triangles.reshape(-1, 3),
        corner_normals=loop_normals(mesh)[loops],
        loop_of_corner=loops,
        polygon_of_triangle=polygons,
        slot_of_triangle=_polygon_slots(mesh)[polygons],
        rtgi_uv=_light_map_uv(mesh, vertices, triangles.reshape(-1, 3), loops, name, warn),
    )


def without_vertices(arrays: MeshArrays, bad: Bool) -> MeshArrays:
    """``arrays`` less the triangles at the ``bad`` (v,) vertices, which move to the origin."""
    keep = ~bad[arrays.triangles].any(axis=1)
    return MeshArrays(
        vertices=np.where(bad[:, None], np.float32(0), arrays.vertices),
        triangles=arrays.triangles[keep],
        corner_normals=np.nan_to_num(arrays.corner_normals[keep]),
        loop_of_corner=arrays.loop_of_corner[keep],
        polygon_of_triangle=arrays.polygon_of_triangle[keep],
        slot_of_triangle=arrays.slot_of_triangle[keep],
        rtgi_uv=None if arrays.rtgi_uv is None else arrays.rtgi_uv[keep],
    )


def _polygon_slots(mesh: bpy.types.Mesh) -> Int32:
    slots = np.zeros(len(mesh.polygons), np.int32)
    attribute = mesh.attributes.get("material_index")  # absent: all zero
    if attribute is not None and attribute.domain == "FACE":
        attribute.data.foreach_get("value", slots)
    # Blender draws a slot past the last one with the last one.
    return np.clip(slots, 0, max(len(mesh.materials) - 1, 0))


def _light_map_uv(
    mesh: bpy.types.Mesh, vertices: Float32, triangles: Int32, loops: Int32, name: str, warn: Callable[[str], None]
) -> Float32 | None:
    """(t, 3, 2) the mesh's own light-map layer, where every real triangle can be baked over it."""
    layer = mesh.uv_layers.get(UV_LAYER)
    if layer is None:
        return None
    flat = np.zeros(len(mesh.loops) * 2, np.float32)
    layer.uv.foreach_get("vector", flat)
    uv = flat.reshape(-1, 2)[loops]
    fault = _uv_fault(uv, vertices[triangles])
    if fault:
        warn(f"{name}: its UV map {UV_LAYER} {fault}; it is unwrapped anew for the bake, mend or delete that map")
        return None
    return np.clip(uv, 0, 1)


def _uv_fault(uv: Float32, corners: Float32) -> str:
    if not np.isfinite(uv).all():
        return "has values that are not finite"
    if uv.min(initial=0.0) < -1e-6 or uv.max(initial=1.0) > 1 + 1e-6:
        return "reaches outside of the unit square"
    a, b = (uv[:, i].astype(np.float64) - uv[:, 0] for i in (1, 2))
    flat = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2 < MIN_UV_AREA
    with np.errstate(invalid="ignore", over="ignore"):
        edges = corners[:, 1:].astype(np.float64) - corners[:, :1]
        cross = np.cross(edges[:, 0], edges[:, 1])
        square = np.einsum("ij,ij->i", cross, cross)
        longest = np.einsum("tij,tij->ti", edges, edges).max(axis=1, initial=0.0)
        real = square > (longest * 1e-6) ** 2
    bad = int(np.count_nonzero(flat & real))
    return f"gives {bad} of {len(uv)} triangles no area" if bad else ""
