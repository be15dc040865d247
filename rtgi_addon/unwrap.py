# SPDX-License-Identifier: GPL-3.0-or-later
"""Light-map UVs: gives each mesh a :class:`~.source.Layout`, and writes it to the mesh's own layer named RTGI.

Planes and height fields are projected in one piece. Of the rest, small meshes go to xatlas (no overlap, few
charts, dear) and large ones to Blender's smart_project (thirty times as fast); xatlas lays the islands out.
Layouts are checked for overlaps. The user's UV layers are neither read nor written.
"""

from __future__ import annotations

import bpy
import numpy as np

from .backend.layout.charts import in_metres, pack_islands, projectable_triangles, xatlas_charts
from .backend.layout.islands import connected_triangles, overlapping_triangles, stretch, uv_islands
from .backend.scene import Bool, Float32, Int32
from .backend.surface.geometry import triangle_normals
from .smart_project import Faces, smart_project, whole_faces
from .source import Layout, SourceMesh

UV_LAYER = "RTGI"
#: Seconds that xatlas takes for the charts of t triangles are about this times t to the power 1.5 (measured on one
#: core from 10³ to 6·10⁴). Its choice follows from counts, never from a clock, so that a mesh keeps its layout.
XATLAS_SECONDS = 1e-6
#: What xatlas may be expected to take, in seconds, for charts in place of overlapping ones.
REPAIR_SECONDS = 0.3


def unwrap(
    mesh: SourceMesh, margin_px: float = 2.0, texels_per_metre: float = 100.0, time_limit: float = 0.02
) -> tuple[Layout, list[str]]:
    """A layout without overlaps for ``mesh``, and warnings for the user.

    Islands are at least ``margin_px`` texels apart at ``texels_per_metre`` (object space). xatlas makes the charts
    where it is expected to take no more than ``time_limit`` seconds. An own layer that is valid is kept.
    """
    warnings: list[str] = []
    if mesh.rtgi_uv is not None:
        fault = layer_fault(mesh, mesh.rtgi_uv)
        if fault is None:
            return _layout(mesh, mesh.rtgi_uv), warnings
        warnings.append(f"{mesh.name}: its UV layer {UV_LAYER} {fault}; unwrapped anew")
    solid = solid_triangles(mesh)
    corner_uv = np.full((len(mesh.triangles), 3, 2), 0.5, np.float32)
    if solid.any():
        triangles = mesh.triangles[solid]
        faces = whole_faces(mesh, solid)
        placed, overlaps = _unwrap_solid(mesh.vertices, triangles, faces, margin_px, texels_per_metre, time_limit)
        if overlaps:
            warnings.append(f"{mesh.name}: {overlaps} faces overlap in the light map; give it a UV layer {UV_LAYER}")
        corner_uv[solid] = placed
        corner_uv[~solid] = placed[0, 0]  # no area, so any place of the map will do
    return _layout(mesh, corner_uv), warnings


def solid_triangles(mesh: SourceMesh) -> Bool:
    """(t,) triangles with finite corners and an area."""
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    finite = np.isfinite(corners).all(axis=(1, 2))
    solid: Bool = np.zeros(len(corners), np.bool_)
    solid[finite] = triangle_normals(corners[finite]).any(axis=1)
    return solid


def layer_fault(mesh: SourceMesh, corner_uv: Float32) -> str | None:
    """Why (t, 3, 2) ``corner_uv`` cannot serve as the light-map layout of ``mesh``; None if it can."""
    if corner_uv.shape != (len(mesh.triangles), 3, 2):
        return "does not fit the mesh"
    if not np.isfinite(corner_uv).all():
        return "holds values that are not finite"
    if corner_uv.size and (corner_uv.min() < -1e-5 or corner_uv.max() > 1 + 1e-5):
        return "leaves the unit square"
    d1, d2 = corner_uv[:, 1] - corner_uv[:, 0], corner_uv[:, 2] - corner_uv[:, 0]
    flat = np.abs(d1[:, 0].astype(np.float64) * d2[:, 1] - d1[:, 1].astype(np.float64) * d2[:, 0]) < 1e-14
    if (flat & solid_triangles(mesh)).any():
        return "gives faces no area"
    if overlapping_triangles(np.clip(corner_uv, 0.0, 1.0)).any():
        return "has overlapping faces"
    return None


def write_uv_layer(mesh: bpy.types.Mesh, loop_uv: Float32) -> None:
    """Write (loops, 2) ``loop_uv`` to the layer RTGI of ``mesh``, made if need be; other layers stay as they are.

    Which layers are active and rendered stays, too. A mesh with eight layers already raises ValueError.
    """
    active, rendered = mesh.uv_layers.active_index, [layer.name for layer in mesh.uv_layers if layer.active_render]
    layer = mesh.uv_layers.get(UV_LAYER)
    had_layers = len(mesh.uv_layers) > 0
    if layer is None:
        layer = mesh.uv_layers.new(name=UV_LAYER, do_init=False)
        if layer is None or layer.name != UV_LAYER:
            raise ValueError(f"{mesh.name}: no room for a UV layer named {UV_LAYER}")
    layer.uv.foreach_set("vector", np.ascontiguousarray(loop_uv, np.float32).ravel())
    if had_layers:
        mesh.uv_layers.active_index = active
        for name in rendered:
            mesh.uv_layers[name].active_render = True


def loop_uv(mesh: SourceMesh, corner_uv: Float32, loop_count: int) -> Float32:
    """(loop_count, 2) UV by mesh loop (face corner); loops of no triangle get 0."""
    uv = np.zeros((loop_count, 2), np.float32)
    uv[mesh.loop_of_corner.ravel()] = corner_uv.reshape(-1, 2)
    return uv


def _layout(mesh: SourceMesh, corner_uv: Float32) -> Layout:
    uv = np.clip(corner_uv, 0.0, 1.0).astype(np.float32)
    solid = solid_triangles(mesh)
    size = stretch(mesh.vertices[mesh.triangles[solid]], uv[solid]).size()[0]
    return Layout(uv, uv_islands(mesh.triangles, uv), (float(size[0]), float(size[1])))


def _unwrap_solid(
    vertices: Float32,
    triangles: Int32,
    faces: Faces,
    margin_px: float,
    texels_per_metre: float,
    time_limit: float,
) -> tuple[Float32, int]:
    """(t, 3, 2) in [0, 1]; the number of triangles that still overlap others, which only rounding can cause."""
    corners = vertices[triangles]
    uv, island = _charts(vertices, triangles, faces, time_limit)
    for repair in (*REPAIRS, None):
        metres = in_metres(corners, uv, island)
        placed = pack_islands(triangles, metres, island, texels_per_metre=texels_per_metre, margin_px=margin_px)
        marked = overlapping_triangles(placed)
        if repair is None or not marked.any():
            return placed, int(marked.sum())
        uv, island = repair(vertices, triangles, metres, island, marked)
    raise AssertionError("the last round returns")


def _charts(vertices: Float32, triangles: Int32, faces: Faces, time_limit: float) -> tuple[Float32, Int32]:
    """UVs of islands up to place and scale, and the island of each triangle."""
    flat, uv = projectable_triangles(vertices, triangles)
    island = connected_triangles(triangles)
    rest = np.nonzero(~flat)[0]
    if len(rest):
        if expected_xatlas_seconds(len(rest)) <= time_limit:
            uv[rest] = xatlas_charts(vertices, triangles[rest])
        else:
            # Polygons lie in one component, so they are here as a whole.
            uv[rest] = smart_project(vertices, triangles[rest], Faces(faces.polygon[rest], faces.loop[rest]))
        island[rest] = uv_islands(triangles[rest], uv[rest]) + len(triangles)
    return uv, _renumbered(island)


def expected_xatlas_seconds(triangles: int) -> float:
    return float(XATLAS_SECONDS * triangles**1.5)


def _rechart(vertices: Float32, triangles: Int32, uv: Float32, island: Int32, marked: Bool) -> tuple[Float32, Int32]:
    """Charts by xatlas for the islands at fault, or for the ``marked`` triangles alone where that would take long."""
    fault = np.isin(island, np.unique(island[marked]))
    if expected_xatlas_seconds(int(fault.sum())) > REPAIR_SECONDS:
        fault = marked
    if expected_xatlas_seconds(int(fault.sum())) > REPAIR_SECONDS:
        return _separate(vertices, triangles, uv, island, marked)
    charts = xatlas_charts(vertices, triangles[fault])
    return _replaced(uv, island, fault, charts, uv_islands(triangles[fault], charts))


def _separate(vertices: Float32, triangles: Int32, uv: Float32, island: Int32, marked: Bool) -> tuple[Float32, Int32]:
    """Each of the ``marked`` triangles an island."""
    return _replaced(uv, island, marked, flat_triangles(vertices[triangles[marked]]), np.arange(int(marked.sum())))


def _separate_all(
    vertices: Float32, triangles: Int32, uv: Float32, island: Int32, marked: Bool
) -> tuple[Float32, Int32]:
    """Each triangle of an island with ``marked`` ones an island."""
    return _separate(vertices, triangles, uv, island, np.isin(island, np.unique(island[marked])))


#: What is done about overlaps, one after another until there are none.
REPAIRS = (_rechart, _separate, _separate_all)


def _replaced(uv: Float32, island: Int32, rows: Bool, new_uv: Float32, new_island: Int32) -> tuple[Float32, Int32]:
    uv, island = uv.copy(), island.copy()
    uv[rows] = new_uv
    island[rows] = new_island + island.max() + 1
    return uv, _renumbered(island)


def flat_triangles(corners: Float32) -> Float32:
    """(t, 3, 2) each of the triangles (t, 3, 3) laid flat by itself, first edge along u."""
    p = corners.astype(np.float64)
    a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    length = np.sqrt(np.einsum("ti,ti->t", a, a))
    cross = np.cross(a, b)
    uv = np.zeros((len(p), 3, 2))
    uv[:, 1, 0] = length
    uv[:, 2, 0] = np.einsum("ti,ti->t", a, b) / np.maximum(length, 1e-300)
    uv[:, 2, 1] = np.sqrt(np.einsum("ti,ti->t", cross, cross)) / np.maximum(length, 1e-300)
    return uv.astype(np.float32)


def _renumbered(island: Int32) -> Int32:
    numbers: Int32 = np.unique(island, return_inverse=True)[1].astype(np.int32).reshape(-1)
    return numbers
