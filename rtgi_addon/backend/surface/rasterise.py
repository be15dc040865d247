# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pixels of the atlas a mesh's light-map triangles cover, and how much of each.

One mesh at one size in pixels is rasterised once, however many instances show it. Every pixel that a triangle
touches becomes a texel, so a ray that hits the triangle always finds one; a partly covered pixel says how
much of it is surface and where the middle of that part lies.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..scene import Bool, Float32, Float64, Int32

#: Sub-samples per pixel side for coverage: 1/16 of a pixel's area is the smallest share told apart.
SUBSAMPLES = 4
#: Points of the surface kept for each texel: where its rays start and what aimed samples aim at.
POINTS = 8
#: All sub-samples of a pixel in the order in which POINTS are picked: any first few are spread over the pixel.
_SPREAD = np.array([0, 10, 7, 13, 2, 8, 5, 15, 11, 1, 12, 6, 9, 3, 14, 4])
#: Candidate (triangle, pixel) pairs worked on at a time, to bound memory.
CHUNK_PAIRS = 1 << 20
#: A pixel that a triangle enters by less than this is not touched: rectangle borders meet the pixel grid by rounding.
TOUCH_PX = 2e-3
#: Texels without a covered sub-sample take their point this far from the triangle's edge, towards its middle.
INSET_PX = 0.25
#: From this area in pixels on, counted sub-samples give a triangle's area well enough.
LARGE_PX = 4.0
#: A triangle whose pixel-space area is below this has no direction in the map.
FLAT_AREA_PX = 1e-9


@dataclass(frozen=True)
class RasterTexels:
    """Covered pixels of one mesh, n of them, row-major order. Pixel coordinates count from the rectangle's corner."""

    row: Int32  # (n,)
    col: Int32  # (n,)
    triangle: Int32  # (n,) of the mesh: the one that stands for the pixel
    barycentric: Float32  # (n, 2) weights of its second and third corner at the texel's sample point
    coverage: Float32  # (n,) share of the pixel that is this island's surface, 0..1, never 0
    point_triangle: Int32  # (n, POINTS) points spread over the covered part: triangle of the mesh
    point_barycentric: Float32  # (n, POINTS, 2) and weights of its second and third corner
    pair_texel: Int32  # (m,) texel and triangle of each overlap,
    pair_triangle: Int32  # (m,)
    pair_share: Float32  # (m,) and how much of the triangle's area lies there; sums to about one over a triangle


def rasterise(corner_px: Float64, island_of_triangle: Int32) -> RasterTexels:
    """Rasterise triangles ``corner_px`` (t, 3, 2), (col, row) in pixels, of islands (t,).

    A pixel that two islands touch goes to the one covering more of it. Triangles without area in the map get the
    pixel they fall on.
    """
    pairs = _covered_pairs(corner_px)
    if not len(pairs.triangle):
        none, nothing, no_pair = np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros((0, 2), np.float32)
        no_points = np.zeros((0, POINTS), np.int32), np.zeros((0, POINTS, 2), np.float32)
        return RasterTexels(none, none, none, no_pair, nothing, *no_points, none, none, nothing)
    return _texels_of_pairs(pairs, corner_px, island_of_triangle)


@dataclass(frozen=True)
class _Pairs:
    """(triangle, pixel) pairs that touch, with sums over the covered sub-samples."""

    triangle: Int32
    col: Int32
    row: Int32
    inside: Bool  # (m, 16) which sub-samples are covered
    nearest: Float64  # (m, 2) point of the triangle nearest to the pixel's centre


def _covered_pairs(corner_px: Float64) -> _Pairs:
    low = np.floor(corner_px.min(axis=1)).astype(np.int64)  # (t, 2)
    high = np.floor(corner_px.max(axis=1)).astype(np.int64)
    # A maximum that lies exactly on a pixel border belongs to the pixel before it.
    on_border = (corner_px.max(axis=1) == high) & (high > low)
    size = np.where(on_border, high - low, high - low + 1)
    count = size[:, 0] * size[:, 1]
    ends = np.cumsum(count)
    parts, start = [], 0
    while start < len(corner_px):
        base = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, base + CHUNK_PAIRS, side="right")))
        parts.append(_pairs_of(np.arange(start, stop), corner_px, low, size))
        start = stop
    if not parts:
        parts = [_pairs_of(np.zeros(0, np.int64), corner_px, low, size)]
    return _Pairs(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(_Pairs)))


def _pairs_of(triangles: Int32, corner_px: Float64, low: Int32, size: Int32) -> _Pairs:
    count = (size[triangles, 0] * size[triangles, 1]).astype(np.int64)
    triangle = np.repeat(triangles, count)
    within = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    col = low[triangle, 0] + within % size[triangle, 0]
    row = low[triangle, 1] + within // size[triangle, 0]
    a, b, c = (corner_px[triangle, k] for k in range(3))
    pixel = np.stack([col, row], axis=1).astype(np.float64)
    edges = _edge_functions(a, b, c)
    inside_all = np.ones(len(triangle), np.bool_)
    outside = np.zeros(len(triangle), np.bool_)
    for nx, ny, offset in edges:
        at = nx * pixel[:, 0] + ny * pixel[:, 1] + offset
        inside_all &= at + np.minimum(nx, 0) + np.minimum(ny, 0) >= 0  # the pixel's least corner
        outside |= at + np.maximum(nx, 0) + np.maximum(ny, 0) < 0
    keep = ~outside
    triangle, pixel, inside_all = triangle[keep], pixel[keep], inside_all[keep]
    edges = [(nx[keep], ny[keep], offset[keep]) for nx, ny, offset in edges]
    inside = np.ones((len(triangle), SUBSAMPLES * SUBSAMPLES), np.bool_)
    nearest = pixel + 0.5
    part = np.nonzero(~inside_all)[0]
    if len(part):
        partial = [(nx[part], ny[part], offset[part]) for nx, ny, offset in edges]
        inside[part] = _subsample(pixel[part], partial)
        tri = triangle[part]
        nearest[part] = _nearest_points(pixel[part] + 0.5, corner_px[tri, 0], corner_px[tri, 1], corner_px[tri, 2])
    touches = inside.any(axis=1) | (np.abs(nearest - pixel - 0.5).max(axis=1) <= 0.5 - TOUCH_PX)
    # A triangle that lies on a pixel border still needs a texel.
    first = triangles[0] if len(triangles) else 0
    lost = np.bincount(triangle[touches] - first, minlength=len(triangles)) == 0
    touches |= lost[triangle - first] & (np.diff(triangle, prepend=-1) != 0)
    col32, row32 = pixel[touches, 0].astype(np.int32), pixel[touches, 1].astype(np.int32)
    return _Pairs(triangle[touches].astype(np.int32), col32, row32, inside[touches], nearest[touches])


def _edge_functions(a: Float64, b: Float64, c: Float64) -> list[tuple[Float64, Float64, Float64]]:
    """Three (nx, ny, offset) per triangle: non-negative inside, whatever the winding."""
    area: Float64 = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    sign = np.where(area < 0, -1.0, 1.0)
    edges = []
    for p, q in ((a, b), (b, c), (c, a)):
        nx, ny = -(q[:, 1] - p[:, 1]) * sign, (q[:, 0] - p[:, 0]) * sign
        edges.append((nx, ny, -(nx * p[:, 0] + ny * p[:, 1])))
    return edges


def _subsample_offsets() -> Float64:
    """(16, 2) sub-samples within a pixel, (col, row).

    Slightly off the grid, differently in col and row: no sample lies on the edges that artists draw (45°, parallel to
    an axis), where both neighbours would claim it.
    """
    steps = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES
    col, row = np.meshgrid(steps + 1.1e-3, steps - 0.7e-3)
    return np.stack([col.ravel(), row.ravel()], axis=1)


def _subsample(pixel: Float64, edges: list[tuple[Float64, Float64, Float64]]) -> Bool:
    """(m, 16) which sub-samples of each pixel lie inside all edges."""
    dx, dy = _subsample_offsets().T
    inside = np.ones((len(pixel), len(dx)), np.bool_)
    for nx, ny, offset in edges:
        at = (nx * pixel[:, 0] + ny * pixel[:, 1] + offset)[:, None]
        inside &= at + nx[:, None] * dx + ny[:, None] * dy >= 0
    return inside


def _nearest_points(p: Float64, a: Float64, b: Float64, c: Float64) -> Float64:
    """(m, 2) the point of each triangle nearest to ``p``; p itself where it lies inside."""
    best, best_d2 = a.copy(), np.full(len(p), np.inf)
    for q, r in ((a, b), (b, c), (c, a)):
        edge = r - q
        length2 = np.einsum("ij,ij->i", edge, edge)
        s = np.divide(np.einsum("ij,ij->i", p - q, edge), length2, out=np.zeros_like(length2), where=length2 > 0)
        point = q + edge * np.clip(s, 0, 1)[:, None]
        d2 = np.einsum("ij,ij->i", point - p, point - p)
        nearer = d2 < best_d2
        best[nearer], best_d2[nearer] = point[nearer], d2[nearer]
    inside = np.ones(len(p), np.bool_)
    for nx, ny, offset in _edge_functions(a, b, c):
        inside &= nx * p[:, 0] + ny * p[:, 1] + offset >= 0
    area: Float64 = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    inside &= np.abs(area) > FLAT_AREA_PX
    best[inside] = p[inside]
    return best


def _texels_of_pairs(pairs: _Pairs, corner_px: Float64, island_of_triangle: Int32) -> RasterTexels:
    """One texel a pixel: its island by coverage, its triangle by nearness to the centre."""
    island = island_of_triangle[pairs.triangle]
    width = int(pairs.col.max()) + 1
    pixel = pairs.row.astype(np.int64) * width + pairs.col
    by_island = np.lexsort((island, pixel))
    key_change = np.diff(pixel[by_island], prepend=-1) != 0
    island_change = key_change | (np.diff(island[by_island], prepend=-1) != 0)
    group = np.cumsum(island_change) - 1  # (m,) one a (pixel, island)
    samples_of_pair = pairs.inside.sum(axis=1)
    covered = np.bincount(group, weights=samples_of_pair[by_island])
    first = np.nonzero(island_change)[0]
    # Of a pixel's islands the one covering more wins; lexsort is stable, so ties go to the lower island.
    order = np.lexsort((np.arange(len(first)), -covered, pixel[by_island][first]))
    winner = order[np.diff(pixel[by_island][first][order], prepend=-1) != 0]
    texel_of_group = np.full(len(first), -1, np.int64)
    texel_of_group[winner] = np.arange(len(winner))
    texel = texel_of_group[group]
    member = by_island[texel >= 0]
    texel = texel[texel >= 0]
    n = len(winner)

    samples = np.bincount(texel, weights=samples_of_pair[member], minlength=n)
    offset = pairs.nearest[member] - np.stack([pairs.col[member], pairs.row[member]], axis=1) - 0.5
    distance = np.einsum("ij,ij->i", offset, offset)
    nearest_first = np.lexsort((pairs.triangle[member], distance, texel))
    chosen = member[nearest_first[np.diff(texel[nearest_first], prepend=-1) != 0]]
    pixels = np.stack([pairs.col[chosen], pairs.row[chosen]], axis=1).astype(np.float64)

    owner = np.full((n, SUBSAMPLES * SUBSAMPLES), -1, np.int32)  # triangle under each sub-sample
    pair, at = np.nonzero(pairs.inside[member])
    owner[texel[pair], at] = pairs.triangle[member][pair]
    point = _middles(pixels, owner, pairs.nearest[chosen])
    corners = corner_px[pairs.triangle[chosen]]
    # The middle of the covered part may lie on a neighbour; the nearest point of the chosen triangle stands for it.
    point = _nearest_points(point, corners[:, 0], corners[:, 1], corners[:, 2])
    barycentric = _barycentric(point, corners)
    # On the very edge of the object a point would touch whatever it stands on: slivers' points are drawn inwards.
    inward = np.where(samples > 0, 0.0, np.minimum(INSET_PX / np.maximum(_widths(corners), FLAT_AREA_PX), 1.0))[:, None]
    barycentric = (barycentric * (1 - inward) + inward / 3).astype(np.float32)
    point_triangle, point_barycentric = _points(pixels, owner, corner_px, pairs.triangle[chosen], barycentric)
    smallest = 1.0 / (SUBSAMPLES * SUBSAMPLES)
    # A triangle between the sub-samples still has its area: it counts as a sliver of one. Small triangles' shares are
    # made to sum to one; large ones are left as counted, so that both sides of a shared edge fit together.
    part = np.maximum(samples_of_pair[member] * smallest, smallest * smallest)
    counted = np.bincount(pairs.triangle[member], weights=part, minlength=len(corner_px))
    exact = _pixel_areas(corner_px)
    of_triangle = np.where(exact >= LARGE_PX, exact, counted)
    return RasterTexels(
        row=pairs.row[chosen],
        col=pairs.col[chosen],
        triangle=pairs.triangle[chosen],
        barycentric=barycentric,
        coverage=np.clip(samples * smallest, smallest, 1.0).astype(np.float32),
        point_triangle=point_triangle,
        point_barycentric=point_barycentric,
        pair_texel=texel.astype(np.int32),
        pair_triangle=pairs.triangle[member],
        pair_share=(part / of_triangle[pairs.triangle[member]]).astype(np.float32),
    )


def _middles(pixels: Float64, owner: Int32, nearest: Float64) -> Float64:
    """(n, 2) middle of the covered sub-samples; the pixel's centre where all are, ``nearest`` where none is."""
    covered = owner >= 0
    count = covered.sum(axis=1)
    middle = pixels + (covered @ _subsample_offsets()) / np.maximum(count, 1)[:, None]
    whole = count == owner.shape[1]
    middle[whole] = pixels[whole] + 0.5
    return np.where((count > 0)[:, None], middle, nearest)


def _points(
    pixels: Float64, owner: Int32, corner_px: Float64, triangle: Int32, barycentric: Float32
) -> tuple[Int32, Float32]:
    """((n, POINTS), (n, POINTS, 2)) triangle and weights of points over the covered sub-samples, repeated where there
    are fewer; the texel's own ``triangle``, ``barycentric`` where there are none."""
    sub = np.broadcast_to(_SPREAD[:POINTS], (len(owner), POINTS)).copy()
    part = np.nonzero((owner < 0).any(axis=1))[0]
    if len(part):
        spread = owner[part][:, _SPREAD]
        covered_first = np.argsort(spread < 0, axis=1, kind="stable")
        count = (spread >= 0).sum(axis=1)
        turn = np.arange(POINTS)[None, :] % np.maximum(count, 1)[:, None]
        sub[part] = _SPREAD[np.take_along_axis(covered_first, turn, axis=1)]
    found = np.take_along_axis(owner, sub, axis=1)
    some = found >= 0
    found = np.where(some, found, triangle[:, None])
    place = pixels[:, None] + _subsample_offsets()[sub]
    weights = _barycentric(place.reshape(-1, 2), corner_px[found.reshape(-1)]).reshape(*found.shape, 2)
    return found.astype(np.int32), np.where(some[:, :, None], weights, barycentric[:, None]).astype(np.float32)


def _widths(corners: Float64) -> Float64:
    """(m,) longest side of (m, 3, 2) triangles."""
    sides = np.roll(corners, -1, axis=1) - corners
    return np.asarray(np.sqrt(np.einsum("mcx,mcx->mc", sides, sides)).max(axis=1))


def _pixel_areas(corner_px: Float64) -> Float64:
    e1, e2 = corner_px[:, 1] - corner_px[:, 0], corner_px[:, 2] - corner_px[:, 0]
    return np.asarray(np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2)


def _barycentric(point: Float64, corners: Float64) -> Float64:
    """(m, 2) weights of the second and third corner; flat triangles give the nearest along their longest edge."""
    e1, e2, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], point - corners[:, 0]
    det = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    good = np.abs(det) > FLAT_AREA_PX
    safe = np.where(good, det, 1.0)
    u = np.where(good, (d[:, 0] * e2[:, 1] - d[:, 1] * e2[:, 0]) / safe, 1 / 3)
    v = np.where(good, (e1[:, 0] * d[:, 1] - e1[:, 1] * d[:, 0]) / safe, 1 / 3)
    u, v = np.clip(u, 0, 1), np.clip(v, 0, 1)
    over = np.maximum(u + v, 1.0)
    return np.stack([u / over, v / over], axis=1)
