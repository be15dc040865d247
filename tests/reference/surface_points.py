# SPDX-License-Identifier: GPL-3.0-or-later
"""Points spread over the covered part of each texel, found by a plain point-in-triangle test of its own.

What a texel should hold is the mean irradiance over the surface in its pixel. The points here say where that is,
independently of the bake's rasteriser, footprints and sample patterns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgi_addon.backend.scene import Float64, FrameState, Int32, Scene
from rtgi_addon.backend.surface.texels import BACK, Texels

#: Points per texel side.
GRID = 4
#: (triangle, point) pairs tested at a time, to bound memory.
CHUNK_PAIRS = 1 << 21


@dataclass(frozen=True)
class SurfacePoints:
    """p points in the world, grouped by texel. A sliver may miss all points of the grid."""

    texel: Int32  # (p,) position in the list of texels asked for, ascending
    position: Float64  # (p, 3) m
    geometric_normal: Float64  # (p, 3) unit, out of the texel's own side
    normal: Float64  # (p, 3) unit shading normal, out of the texel's own side
    spacing: Float64  # (p,) m: least distance to the next point of the grid


def surface_points(scene: Scene, state: FrameState, texels: Texels, chosen: Int32) -> SurfacePoints:
    """Points of the texels ``chosen`` (n,)."""
    first_triangle = np.cumsum([0, *(scene.meshes[i.mesh].triangle_count for i in scene.instances)])
    parts = []
    for number in np.unique(texels.instance[chosen]).tolist():
        for side in np.unique(texels.side[chosen][texels.instance[chosen] == number]).tolist():
            rows = np.nonzero((texels.instance[chosen] == number) & (texels.side[chosen] == side))[0]
            parts.append(_points_of(scene, state, texels, chosen[rows], rows, number, side, first_triangle[number]))
    columns = [np.concatenate(c) for c in zip(*parts, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    texel, position, geometric, normal, spacing = (c[order] for c in columns)
    return SurfacePoints(texel.astype(np.int32), position, geometric, normal, spacing)


def _points_of(
    scene: Scene, state: FrameState, texels: Texels, chosen: Int32, rows: Int32, number: int, side: int, first: int
) -> tuple[np.ndarray, ...]:
    """(texel row, position, geometric normal, normal, spacing) of one side of one instance."""
    mesh = scene.meshes[scene.instances[number].mesh]
    # The page pixel of each corner follows from the texels' own affine map of the page (corner, and its change).
    affine = texels.hit_affine.reshape(2, -1, 3, 2)[side][first : first + mesh.triangle_count].astype(np.float64)
    corner_px = np.stack([affine[:, 0], affine[:, 0] + affine[:, 1], affine[:, 0] + affine[:, 2]], axis=1)
    wanted_island = mesh.island_of_triangle[texels.triangle[chosen] - first]
    hit_row, triangle, u, v = _grid_hits(
        corner_px, mesh.island_of_triangle, texels.row[chosen], texels.col[chosen], wanted_island
    )
    u, v = u[:, None], v[:, None]
    matrix = np.asarray(state.matrix_world[number], np.float64)
    vertices = state.vertices.get(scene.instances[number].mesh, mesh.vertices).astype(np.float64)
    corners = (vertices @ matrix[:3, :3].T + matrix[:3, 3])[mesh.triangles[triangle]]  # (p, 3, 3) world
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # Blender's rule: a mirrored object keeps its front.
    turned = -1.0 if np.linalg.det(matrix[:3, :3]) < 0 else 1.0
    sign = turned * (-1.0 if side == BACK else 1.0)
    cross = np.cross(e1, e2)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    geometric = sign * cross / np.maximum(length, 1e-300)
    shading = state.corner_normals.get(scene.instances[number].mesh, mesh.corner_normals)[triangle].astype(np.float64)
    mixed = shading[:, 0] * (1 - u - v) + shading[:, 1] * u + shading[:, 2] * v
    carried = mixed @ np.linalg.inv(matrix[:3, :3]) * (-1.0 if side == BACK else 1.0)
    normal = carried / np.maximum(np.linalg.norm(carried, axis=1, keepdims=True), 1e-300)
    normal = np.where((normal * normal).sum(axis=1, keepdims=True) < 0.5, geometric, normal)
    spacing = _spacing(corner_px[triangle], e1, e2) / GRID
    return rows[hit_row], corners[:, 0] + e1 * u + e2 * v, geometric, normal, spacing


def _grid_hits(
    corner_px: Float64, island: Int32, row: Int32, col: Int32, wanted_island: Int32
) -> tuple[Int32, Int32, Float64, Float64]:
    """Grid points of the pixels (row, col) (n,) that lie in a triangle of the pixel's island: (k,) pixel's number,
    triangle and barycentric weights u, v; each point once."""
    low = np.array([col.min(), row.min()])
    width, height = int(col.max() - low[0] + 1), int(row.max() - low[1] + 1)
    pixel = np.full((height, width), -1, np.int64)
    pixel[row - low[1], col - low[0]] = np.arange(len(row))
    at = (corner_px - low) * GRID - 0.5  # grid points have whole coordinates
    first = np.maximum(np.ceil(at.min(axis=1) - 1e-6), 0).astype(np.int64)
    last = np.minimum(np.floor(at.max(axis=1) + 1e-6), [width * GRID - 1, height * GRID - 1]).astype(np.int64)
    size = np.maximum(last - first + 1, 0)
    count = size[:, 0] * size[:, 1]
    ends = np.cumsum(count)
    found, start = [], 0
    while start < len(at):
        stop = max(start + 1, int(np.searchsorted(ends, ends[start] - count[start] + CHUNK_PAIRS, side="right")))
        triangle = np.repeat(np.arange(start, stop), count[start:stop])
        within = np.arange(len(triangle)) - np.repeat(
            np.cumsum(count[start:stop]) - count[start:stop], count[start:stop]
        )
        x, y = first[triangle, 0] + within % size[triangle, 0], first[triangle, 1] + within // size[triangle, 0]
        number = pixel[y // GRID, x // GRID]
        ours = (number >= 0) & (island[triangle] == wanted_island[number])
        triangle, x, y, number = triangle[ours], x[ours], y[ours], number[ours]
        u, v = _weights(at[triangle], np.stack([x, y], axis=1))
        inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
        key = y[inside] * (width * GRID) + x[inside]
        found.append((key, number[inside], triangle[inside], u[inside], v[inside]))
        start = stop
    key, number, triangle, u, v = (np.concatenate(c) for c in zip(*found, strict=True))
    once = np.unique(key, return_index=True)[1]
    return number[once], triangle[once], u[once], v[once]


def _weights(corners: Float64, point: Float64) -> tuple[Float64, Float64]:
    e1, e2, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], point - corners[:, 0]
    det = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    safe = np.where(np.abs(det) > 1e-12, det, np.nan)
    return (d[:, 0] * e2[:, 1] - d[:, 1] * e2[:, 0]) / safe, (e1[:, 0] * d[:, 1] - e1[:, 1] * d[:, 0]) / safe


def _spacing(corner_px: Float64, e1: Float64, e2: Float64) -> Float64:
    """(p,) least world length of a pixel step in any direction: the smaller singular value of pixel to world."""
    p1, p2 = corner_px[:, 1] - corner_px[:, 0], corner_px[:, 2] - corner_px[:, 0]
    det = p1[:, 0] * p2[:, 1] - p1[:, 1] * p2[:, 0]
    safe = np.where(np.abs(det) > 1e-12, det, np.inf)[:, None]
    along_x = (e1 * p2[:, 1:] - e2 * p1[:, 1:]) / safe
    along_y = (e2 * p1[:, :1] - e1 * p2[:, :1]) / safe
    a, b = (along_x**2).sum(axis=1), (along_y**2).sum(axis=1)
    c = (along_x * along_y).sum(axis=1)
    return np.sqrt(np.maximum((a + b) / 2 - np.sqrt(((a - b) / 2) ** 2 + c**2), 0))
