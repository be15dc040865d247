# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be said of a light-map layout from its arrays alone: islands, scale in metres, overlaps.

Used when a mesh is unwrapped and when its instances are packed. A layout is a (t, 3, 2) array of corner UVs over
the triangles of a :class:`~rtgi_addon.backend.scene.Mesh`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..scene import Bool, Float32, Float64, Int32

#: Triangles may reach this far into one another, as a share of the layout's side: rounding, far below a texel.
OVERLAP_TOLERANCE = 1e-5
#: Scan lines of the overlap test: enough for a few per triangle of an even mesh, within these bounds.
SCAN_LINES = (256, 2048)


def unique_corners(triangles: Int32, corner_uv: Float32) -> Int32:
    """(t, 3) numbers from 0: two corners have the same one if and only if vertex and UV are the same."""
    # Adding zero turns -0.0, another bit pattern, into 0.0.
    bits = (np.ascontiguousarray(corner_uv, np.float32) + np.float32(0)).view(np.uint32).astype(np.uint64)
    uv, uv_number = np.unique((bits[..., 0] << np.uint64(32)) | bits[..., 1], return_inverse=True)
    key = triangles.astype(np.int64).ravel() * len(uv) + uv_number.ravel()
    numbers: Int32 = np.unique(key, return_inverse=True)[1].reshape(-1, 3).astype(np.int32)
    return numbers


def connected_triangles(corner_numbers: Int32) -> Int32:
    """(t,) the component of each triangle, where triangles with a common corner number (t, 3) belong together.

    Components are numbered in the order of their first triangles.
    """
    count = len(corner_numbers)
    if count == 0:
        return np.zeros(0, np.int32)
    rows = np.repeat(np.arange(count), 3)
    nodes = count + int(corner_numbers.max()) + 1
    graph = coo_array((np.ones(3 * count, np.int8), (rows, count + corner_numbers.ravel())), shape=(nodes, nodes))
    labels = connected_components(graph, directed=False)[1][:count]
    first, inverse = np.unique(labels, return_index=True, return_inverse=True)[1:]
    rank = np.zeros(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    numbered: Int32 = rank[inverse]
    return numbered


def uv_islands(triangles: Int32, corner_uv: Float32) -> Int32:
    """(t,) UV island of each triangle: the connected components over shared UV corners."""
    return connected_triangles(unique_corners(triangles, corner_uv))


@dataclass(frozen=True)
class Stretch:
    """How a layout, or g groups of its triangles, maps UV units to metres under any linear map of the mesh.

    ``along_u``, ``along_v`` (g, 3, 3): sums of twice the UV area times the outer product of dP/du (dP/dv) with itself,
    over its length; ``uv_area`` (g,): sums of twice the UV area. Products of area and derivative stay
    bounded for triangles that are slivers in UV, where the derivative alone does not.
    """

    along_u: Float64
    along_v: Float64
    uv_area: Float64

    def size(self, linear: Float64 | None = None) -> Float64:
        """(g, 2) metres that the unit of u and of v spans, the mean over UV area; 0 without UV area.

        ``linear`` (3, 3) is the mesh's transform to the space wanted, the identity if not given.
        """
        matrix = np.eye(3) if linear is None else linear
        gram = matrix.T @ matrix
        sizes = np.zeros((len(self.uv_area), 2))
        for axis, tensor in enumerate((self.along_u, self.along_v)):
            weight = np.einsum("gii->g", tensor)
            stretched = np.maximum(np.einsum("gij,ij->g", tensor, gram), 0.0)
            np.divide(np.sqrt(weight * stretched), self.uv_area, out=sizes[:, axis], where=self.uv_area > 0)
        return sizes


def stretch(corners: Float32, corner_uv: Float32, group: Int32 | None = None) -> Stretch:
    """Of the triangles with ``corners`` (t, 3, 3) laid out at ``corner_uv`` (t, 3, 2), by ``group`` (t,) from 0."""
    groups = np.zeros(len(corners), np.int64) if group is None else group.astype(np.int64)
    count = int(groups.max(initial=0)) + 1
    points, uv = corners.astype(np.float64), corner_uv.astype(np.float64)
    p1, p2 = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    along_u = p1 * d2[:, 1:] - p2 * d1[:, 1:]  # (t, 3) dP/du times twice the signed UV area
    along_v = p2 * d1[:, :1] - p1 * d2[:, :1]
    area = np.bincount(groups, np.abs(d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]), minlength=count)
    return Stretch(_tensor(along_u, groups, count), _tensor(along_v, groups, count), area.astype(np.float64))


def _tensor(vectors: Float64, groups: NDArray[np.int64], count: int) -> Float64:
    """(g, 3, 3) sums of v vᵀ / |v| by group."""
    length = np.sqrt(np.einsum("ti,ti->t", vectors, vectors))
    direction = np.divide(vectors, length[:, None], out=np.zeros_like(vectors), where=length[:, None] > 0)
    result = np.zeros((count, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            result[:, i, j] = np.bincount(groups, vectors[:, i] * direction[:, j], minlength=count)
            result[:, j, i] = result[:, i, j]
    return result


def overlapping_triangles(corner_uv: Float32) -> Bool:
    """(t,) True for triangles that lie in UV over part of another one which is not marked itself.

    ``corner_uv`` lies within [0, 1]. Dense scan lines along u and along v are cut with all triangles; intervals of one
    line must not overlap by more than :data:`OVERLAP_TOLERANCE`. What lies between all lines is not seen.
    """
    lines = int(np.clip(4 * np.sqrt(len(corner_uv)), *SCAN_LINES))
    marked: Bool = _marked_by_scan(corner_uv.astype(np.float64), lines)
    marked |= _marked_by_scan(corner_uv[..., ::-1].astype(np.float64), lines)
    return marked


def _marked_by_scan(uv: Float64, lines: int) -> Bool:
    triangle, line, low, high = _scan_intervals(uv, lines)
    order = np.lexsort((triangle, low, line))
    triangle, line, low, high = triangle[order], line[order], low[order], high[order]
    # Lines lie 2 apart on one axis, so that one running maximum serves all of them.
    reach = np.maximum.accumulate(high + 2.0 * line)
    overlap = np.minimum(reach[:-1] - 2.0 * line[1:], high[1:]) - low[1:]
    marked = np.zeros(len(uv), np.bool_)
    marked[triangle[1:][overlap > OVERLAP_TOLERANCE]] = True
    return marked


def _scan_intervals(uv: Float64, lines: int) -> tuple[Int32, Int32, Float64, Float64]:
    """(k,) triangle, line, lowest and highest u of each cut of a triangle with a line of constant v."""
    # Not a half: vertices of regular layouts would fall on the lines.
    y = uv[..., 1] * lines - 0.4871
    first = np.ceil(y.min(axis=1)).astype(np.int64)
    count = np.maximum(np.floor(y.max(axis=1)).astype(np.int64) - first + 1, 0)
    triangle = np.repeat(np.arange(len(uv), dtype=np.int32), count)
    start = np.repeat(np.cumsum(count) - count, count)
    line = np.repeat(first, count) + np.arange(len(triangle)) - start
    low, high = np.full(len(triangle), np.inf), np.full(len(triangle), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        ya, yb = y[triangle, a], y[triangle, b]
        cut = (np.minimum(ya, yb) <= line) & (line <= np.maximum(ya, yb)) & (ya != yb)
        share = np.divide(line - ya, yb - ya, out=np.zeros_like(ya), where=cut)
        x = uv[triangle, a, 0] * (1 - share) + uv[triangle, b, 0] * share
        low = np.where(cut, np.minimum(low, x), low)
        high = np.where(cut, np.maximum(high, x), high)
    return triangle, line.astype(np.int32), low, high
