# SPDX-License-Identifier: GPL-3.0-or-later
"""Ways to flatten triangles into islands, and to lay islands side by side: xatlas, and plain projection.

Charts come out in metres, each at its own place and all of them overlapping; :func:`pack_islands` then lays them out.
Everything here is a function of its arguments to the bit (xatlas draws its numbers from a fixed seed).
"""

from __future__ import annotations

import numpy as np
import xatlas
from scipy.spatial import ConvexHull, QhullError

from ..scene import Bool, Float32, Float64, Int32
from .islands import connected_triangles, stretch, unique_corners

#: Faces may lean this far (cosine) from the direction they are projected along; smart_project's default is 66°, too.
PROJECTION_COSINE = 0.4067
#: Side of xatlas' own layout in texels while it only makes charts; islands are packed again afterwards.
CHARTING_TEXELS = 256
#: Side of the layout that is packed, in texels, for few and for many islands: xatlas' time grows with its square.
PACKING_TEXELS = (256, 1024)
#: xatlas stretches charts to whole texels, so that a metre takes somewhat more texels than asked for.
STRETCH_RESERVE = 1.15
#: A layout so large has this many texels per island's side, at least.
ISLAND_TEXELS = 24


def projectable_triangles(vertices: Float32, triangles: Int32) -> tuple[Bool, Float32]:
    """Planes and height fields: which triangles (t,) lie in them, and (t, 3, 2) their projection, metres.

    One is a connected part of the mesh (over shared vertices) whose faces all look along its mean normal within
    :data:`PROJECTION_COSINE`. It is flattened along that normal, in one piece.
    """
    component = connected_triangles(triangles)
    corners = vertices[triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mean = np.stack([np.bincount(component, normals[:, i]) for i in range(3)], axis=1).astype(np.float64)
    length = np.sqrt(np.einsum("ci,ci->c", mean, mean))
    mean = np.divide(mean, length[:, None], out=np.zeros_like(mean), where=length[:, None] > 0)
    area = np.sqrt(np.einsum("ti,ti->t", normals, normals))
    leaning = np.einsum("ti,ti->t", normals, mean[component]) < PROJECTION_COSINE * area
    flat: Bool = np.bincount(component, leaning)[component] == 0
    tangent, bitangent = _axes(mean)
    u = np.einsum("tci,ti->tc", corners, tangent[component])
    v = np.einsum("tci,ti->tc", corners, bitangent[component])
    return flat, np.stack([u, v], axis=-1).astype(np.float32)


def _axes(normals: Float64) -> tuple[Float64, Float64]:
    """Two unit vectors (n, 3) each, right-handed with ``normals``; along the world's axes for planes that are."""
    least = np.argmin(np.abs(normals), axis=1)
    bitangent = np.cross(normals, np.eye(3)[least])
    bitangent /= np.maximum(np.sqrt(np.einsum("ni,ni->n", bitangent, bitangent)), 1e-30)[:, None]
    return np.cross(bitangent, normals), bitangent


def xatlas_charts(vertices: Float32, triangles: Int32) -> Float32:
    """(t, 3, 2) UVs of xatlas' charts, up to each chart's place and scale. Triangles must have an area."""
    used, local = np.unique(triangles, return_inverse=True)
    points = vertices[used].astype(np.float64)
    points = (points - points.mean(axis=0)) / max(float(np.ptp(points, axis=0).max()), 1e-30)
    corners = points[local.reshape(-1, 3)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt(np.einsum("ti,ti->t", cross, cross)).sum() / 2
    atlas = xatlas.Atlas()
    atlas.add_mesh(points.astype(np.float32), local.reshape(-1, 3).astype(np.uint32))
    uv: Float32 = _generate(atlas, texels_per_unit=CHARTING_TEXELS / max(area, 1e-12) ** 0.5, padding=0)
    return uv


def in_metres(corners: Float32, corner_uv: Float32, island: Int32) -> Float32:
    """``corner_uv`` with u and v of each island scaled to the metres they span on ``corners`` (t, 3, 3)."""
    size = stretch(corners, corner_uv, island).size()
    low = _island_low(corner_uv, island)
    metres: Float32 = ((corner_uv - low[island][:, None]) * size[island][:, None]).astype(np.float32)
    return metres


def _island_low(corner_uv: Float32, island: Int32) -> Float64:
    low = np.full((int(island.max(initial=-1)) + 1, 2), np.inf)
    for corner in range(3):
        np.minimum.at(low, island, corner_uv[:, corner])
    return low


def pack_islands(
    triangles: Int32, metres_uv: Float32, island: Int32, *, texels_per_metre: float, margin_px: float
) -> Float32:
    """(t, 3, 2) ``metres_uv`` laid out in [0, 1]² without overlap, islands at least ``margin_px`` apart.

    The margin holds when the layout is shown at ``texels_per_metre``. Island borders of small layouts then lie on
    texel borders.
    """
    count = int(island.max(initial=-1)) + 1
    if count == 1:
        return _fill_unit_square(_upright(metres_uv))
    # The same (vertex, UV) may occur in two islands that are to be kept apart.
    corner = unique_corners(triangles + (island * (int(triangles.max()) + 1)).astype(np.int64)[:, None], metres_uv)
    first = np.unique(corner, return_index=True)[1]
    density, padding = _packing_scale(metres_uv, count, texels_per_metre, margin_px)
    # xatlas works at densities of its own order of magnitude, whatever the mesh's unit.
    points = (metres_uv.reshape(-1, 2)[first] * np.float64(density)).astype(np.float32)
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(points, corner.astype(np.uint32), island.astype(np.uint32)[:, None])
    return _fill_unit_square(_generate(atlas, texels_per_unit=1.0, padding=padding))


def _packing_scale(metres_uv: Float32, islands: int, texels_per_metre: float, margin_px: float) -> tuple[float, int]:
    """Texels per metre and xatlas' padding that keep ``margin_px``, coarser where full resolution would be dear."""
    d1, d2 = metres_uv[:, 1] - metres_uv[:, 0], metres_uv[:, 2] - metres_uv[:, 0]
    area = np.abs(d1[:, 0].astype(np.float64) * d2[:, 1] - d1[:, 1] * d2[:, 0]).sum() / 2
    side = max(area**0.5, float(np.ptp(metres_uv.reshape(-1, 2), axis=0).max()) / 16, 1e-30) * texels_per_metre
    limit = float(np.clip(ISLAND_TEXELS * islands**0.5, *PACKING_TEXELS))
    wanted_px = margin_px * STRETCH_RESERVE
    if side <= limit:
        # xatlas keeps 2 padding + 1 texels between charts.
        return texels_per_metre, max(0, int(np.ceil((wanted_px - 1) / 2)))
    # One coarse texel is margin enough.
    return texels_per_metre / max(wanted_px, side / limit), 0


def _generate(atlas: xatlas.Atlas, *, texels_per_unit: float, padding: int) -> Float32:
    """(t, 3, 2) texel coordinates of the atlas' one mesh, triangles in the order they were given."""
    options = xatlas.PackOptions()
    options.texels_per_unit = texels_per_unit
    options.padding = padding
    options.bilinear = True  # else slanted borders may touch where padding is 0
    options.create_image = False
    atlas.generate(xatlas.ChartOptions(), options)
    _, indices, uv = atlas.get_mesh(0)
    placed: Float32 = (uv[indices].astype(np.float64) * (atlas.width, atlas.height)).astype(np.float32)
    return placed


def _upright(uv: Float32) -> Float32:
    """``uv`` (t, 3, 2) turned so that its bounding box is smallest (one side of it lies along a side of the hull)."""
    points = uv.reshape(-1, 2).astype(np.float64)
    try:
        hull = points[ConvexHull(points).vertices]  # (h, 2)
    except QhullError:  # all points on one line
        return uv
    edges = np.roll(hull, -1, axis=0) - hull
    length = np.hypot(edges[:, 0], edges[:, 1])
    edges = edges[length > 1e-6 * length.max()]
    angle = np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2)
    angles = np.concatenate([[0.0], np.sort(angle)])
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    boxes = np.ptp(cos * hull[:, 0] + sin * hull[:, 1], axis=1) * np.ptp(cos * hull[:, 1] - sin * hull[:, 0], axis=1)
    # The first angle within rounding of the best: no turn at all where none helps.
    best = angles[np.argmax(boxes <= boxes.min() * (1 + 1e-6))]
    turn = np.array([[np.cos(best), -np.sin(best)], [np.sin(best), np.cos(best)]])
    turned: Float32 = np.einsum("tci,ij->tcj", uv.astype(np.float64), turn).astype(np.float32)
    return turned


def _fill_unit_square(uv: Float32) -> Float32:
    """``uv`` moved and scaled by axis to span [0, 1]; an axis without extent stays at 1/2."""
    points = uv.astype(np.float64)
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    span = high - low
    filled = np.divide(points - low, span, out=np.full_like(points, 0.5), where=span > 0)
    result: Float32 = np.clip(filled, 0.0, 1.0).astype(np.float32)
    return result
