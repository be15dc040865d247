# SPDX-License-Identifier: GPL-3.0-or-later
"""Simplified stand-ins of large meshes, for a gather that draws the scene from every texel.

Far fewer rays leave a texel than a large mesh has triangles, so that its coarsest version serves a gather as well as
any (Larsen04 §9). Vertices are clustered on a uniform grid (Rossignac and Borrel 1993, "Multi-resolution 3D
approximations for rendering complex scenes"). Each corner of a triangle moves to the one vertex that stands for its
cluster and keeps its own light-map UV. All corners at one place move together, so what was closed stays closed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ...scene import Bool, Float32, Float64, Int32, Mesh
from ...surface.geometry import triangle_normals, unit

Int64 = NDArray[np.int64]

#: A stand-in never has more triangles, whatever is asked for: three cluster numbers then fit into one 63-bit key.
MOST_TRIANGLES = 2**21 // 3 - 1
#: Grids tried. The count goes about with the resolution's square, so most meshes need one to four.
TRIES = 12
#: A grid that leaves this share of the triangles allowed is near enough.
NEAR = 0.97
#: Share by which two grids' resolutions differ at least.
STEP = 0.005
#: Vertices of one cell stay apart when the cosine of their normals is less. Between 1/3, of a thin box's two corners
#: across its thickness, and 1/√3, of a box's corner and its face, which belong together.
ALIKE = 0.45
#: Opposite triangles at one place leave this share of their area as its normal by rounding: it has none.
NO_NORMAL = 1e-4
#: Weight of a vertex's distance from its cluster's mean beside its distance from the cluster's planes: decides where
#: a surface is flat, and leaves edges and corners alone elsewhere.
MEAN_WEIGHT = 1e-3
#: A stand-in with less of the mesh's area lets light through that the mesh does not: better none.
LEAST_AREA = 0.5


@dataclass(frozen=True)
class CoarseMesh:
    """A mesh in fewer triangles, by numbers of its own vertices and triangles: it follows wherever those go."""

    representative: Int32  # (k,) vertices of the mesh that are left, ascending
    triangles: Int32  # (s, 3) vertices of the mesh, all of them representatives; wound as their source
    source: Int32  # (s,) triangle of the mesh each was, ascending: its corner UVs, island and material hold
    deviation_rms: float  # m, object: root mean square distance that the places of the mesh's vertices moved
    deviation_max: float  # m, object: the largest; none of the corners moved farther


@dataclass(frozen=True)
class _Surface:
    """The finite part of a mesh: p places (vertices at one position are one), f triangles."""

    vertex: Int64  # (p,) first vertex of the mesh at the place; the heaviest place comes first
    position: Float64  # (p, 3) in [0, 1] from the lowest corner, over the longest side of the bounding box
    normal: Float64  # (p, 4) unit mean normal and 0; places without one have (0, 0, 0, 1)
    part: Int64  # (p,) connected part, 0..part_count-1
    part_count: int
    triangles: Int64  # (f, 3) places
    source: Int64  # (f,) triangle of the mesh
    crosses: Float64  # (f, 3) normal times twice the area


@dataclass(frozen=True)
class _Clusters:
    """One clustering of the p places into c clusters."""

    resolution: float  # cells along the extent
    of_place: Int64  # (p,) 0..count-1
    count: int
    triangle_count: int  # that would be left, some of them perhaps degenerate


def coarse_mesh(mesh: Mesh, most: int) -> CoarseMesh | None:
    """A stand-in of at most ``most`` triangles; None where the mesh has no more, or where no grid gives a good one.

    Triangles with a non-finite corner are left out. Places of different connected parts and of surfaces that face
    different ways keep apart, so a thin wall keeps both sides (Low and Tan 1997, "Model simplification using
    vertex-clustering"); only where no grid is good so, as for leaves, cells alone decide.
    """
    if most < 1:
        raise ValueError(f"a stand-in needs at least one triangle, not {most}")
    surface = _surface(mesh) if mesh.triangle_count > most else None
    if surface is None:
        return None
    for apart in (True, False):
        clusters = _search(surface, min(most, MOST_TRIANGLES), apart=apart)
        coarse = None if clusters is None else _coarse(mesh, surface, clusters)
        if coarse is not None:
            return coarse
    return None


def _surface(mesh: Mesh) -> _Surface | None:
    """The finite part of ``mesh``; None where it has no extent."""
    finite = np.isfinite(mesh.vertices).all(axis=1)
    source = np.flatnonzero(finite[mesh.triangles].all(axis=1))
    used = np.flatnonzero(np.bincount(mesh.triangles[source].reshape(-1), minlength=len(finite)))
    if not len(used):
        return None
    first, place_of_used = _weld(mesh.vertices[used])
    place_of_vertex = np.zeros(len(finite), np.int64)
    place_of_vertex[used] = place_of_used
    triangles = place_of_vertex[mesh.triangles[source]]
    position = mesh.vertices[used[first]].astype(np.float64)
    position -= position.min(axis=0)
    extent = float(position.max())
    if extent == 0.0:
        return None
    position /= extent
    crosses = _crosses(position[triangles])
    areas = np.sqrt((crosses * crosses).sum(axis=1))
    normal, weight = _place_normals(triangles, crosses, areas, len(first))
    order = np.argsort(-weight, kind="stable")
    rank = np.zeros_like(order)
    rank[order] = np.arange(len(order))
    triangles = rank[triangles]
    part_count, part = _parts(triangles, len(first))
    return _Surface(used[first[order]], position[order], normal[order], part, part_count, triangles, source, crosses)


def _weld(positions: Float32) -> tuple[Int64, Int64]:
    """((p,) the first row at each of the p distinct ``positions`` (n, 3), (n,) which of them each row has)."""
    order = np.lexsort(positions.T)
    ordered = positions[order]
    new = np.ones(len(order), np.bool_)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    place = np.zeros(len(order), np.int64)
    place[order] = np.cumsum(new) - 1
    return order[new], place


def _place_normals(triangles: Int64, crosses: Float64, areas: Float64, count: int) -> tuple[Float64, Float64]:
    """((p, 4) as ``_Surface.normal``, (p,) area of the triangles around each place)."""
    sums = _spread(crosses.T, triangles, count).T
    weight = _spread(areas[None], triangles, count)[0]
    lost = (sums * sums).sum(axis=1) <= (NO_NORMAL * weight) ** 2
    sums[lost] = 0.0
    return np.concatenate([unit(sums), lost[:, None].astype(np.float64)], axis=1), weight


def _parts(triangles: Int64, count: int) -> tuple[int, Int64]:
    """(number of connected parts, (p,) part of each place)."""
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(ends), np.bool_), (ends[:, 0], ends[:, 1])), shape=(count, count))
    parts, part = connected_components(graph, directed=False)
    return int(parts), part.astype(np.int64)


def _search(surface: _Surface, most: int, *, apart: bool) -> _Clusters | None:
    """The clustering that leaves the most triangles up to ``most``, of TRIES grids; None where all leave none."""
    finest = (2.0**62 / surface.part_count) ** (1 / 3)  # else a cell's key overflows
    area = np.sqrt((surface.crosses**2).sum(axis=1)).sum() / 2
    # A grid's cells meet a surface of area A in about 3 A / 2 places, two triangles for each.
    resolution = float(np.clip(np.sqrt(most / (3 * area + 1e-30)), 1.0, finest))
    low, high = 0.0, finest
    best = None
    for attempt in range(TRIES):
        clusters = _clusters(surface, resolution, most, apart=apart)
        left = clusters.triangle_count
        if left > most:
            high = resolution
        else:
            low = resolution
            best = clusters if left > (best.triangle_count if best else 0) else best
        # Below one cell nothing changes any more; between two grids so alike the count jumps.
        if NEAR * most <= left <= most or low == finest or high < 1 or high < low * (1 + STEP):
            break
        guess = resolution * np.sqrt((1 + NEAR) / 2 * most / max(left, 1))
        if not low < guess < high or attempt % 3 == 2:
            guess = np.sqrt(max(low, high / 64) * high)
        resolution = float(guess)
    return best


def _clusters(surface: _Surface, resolution: float, most: int, *, apart: bool) -> _Clusters:
    """Places by part, cell and facing; or by cell alone where not ``apart``."""
    cell = (surface.position * resolution).astype(np.int64)
    side = int(resolution) + 1
    key = (cell[:, 0] * side + cell[:, 1]) * side + cell[:, 2]
    if apart:
        key += surface.part * side**3
    rest = np.argsort(key, kind="stable")
    of_place = np.zeros(len(key), np.int64)
    count = 0
    # At most some twelve rounds: no more directions fit on a sphere so far apart.
    while len(rest):
        begins = np.ones(len(rest), np.bool_)
        begins[1:] = key[rest[1:]] != key[rest[:-1]]
        group = np.cumsum(begins) - 1
        heaviest = rest[begins]
        taken = np.ones(len(rest), np.bool_)
        if apart:
            normals = surface.normal[rest]
            cosine = np.einsum("ij,ij->i", normals, surface.normal[heaviest][group])
            taken = (cosine > ALIKE) | begins
        of_place[rest[taken]] = count + group[taken]
        count += len(heaviest)
        rest = rest[~taken]
    return _Clusters(resolution, of_place, count, _count(of_place[surface.triangles], count, most))


def _count(triples: Int64, cluster_count: int, most: int) -> int:
    """How many of ``triples`` (f, 3) of clusters differ and are no lines; some number above ``most`` where more."""
    live = triples[_is_triangle(triples)]
    used = np.bincount(live.reshape(-1), minlength=cluster_count) > 0
    number = np.cumsum(used) - 1
    if not len(live) or number[-1] >= 3 * most:
        return 3 * most if len(live) else 0
    keys = np.sort(_keys(number[live]))
    return 1 + int((keys[1:] != keys[:-1]).sum())


def _is_triangle(triples: Int64) -> Bool:
    a, b, c = triples.T
    return np.asarray((a != b) & (b != c) & (c != a))


def _keys(triples: Int64) -> Int64:
    """(f,) equal where two ``triples`` (f, 3) hold the same numbers, below 2^21, in the same turn."""
    first = triples.argmin(axis=1)
    rows = np.arange(len(triples))
    a, b, c = (triples[rows, (first + k) % 3] for k in range(3))
    return np.asarray((a << 42) | (b << 21) | c)


def _coarse(mesh: Mesh, surface: _Surface, clusters: _Clusters) -> CoarseMesh | None:
    """The stand-in by ``clusters``; None where too little of the surface is left."""
    chosen = _representatives(surface, clusters)
    place = chosen[clusters.of_place]
    corners = place[surface.triangles]
    rows = _kept(surface, corners)
    moved = surface.position[corners[rows]]
    before, after = (np.sqrt((c * c).sum(axis=1)).sum() for c in (surface.crosses, _crosses(moved)))
    if not len(rows) or after < LEAST_AREA * before:
        return None
    # Not by position, which rounds to the extent.
    away = mesh.vertices[surface.vertex].astype(np.float64) - mesh.vertices[surface.vertex[place]]
    square = (away * away).sum(axis=1)
    triangles = surface.vertex[corners[rows]].astype(np.int32)
    return CoarseMesh(
        representative=np.unique(triangles),
        triangles=triangles,
        source=surface.source[rows].astype(np.int32),
        deviation_rms=float(np.sqrt(square.mean())),
        deviation_max=float(np.sqrt(square.max())),
    )


def _representatives(surface: _Surface, clusters: _Clusters) -> Int64:
    """(c,) the place of each cluster that lies nearest to the planes of all its triangles and of its open borders.

    The mean squared distance is a quadric (Lindstrom 2000, "Out-of-core simplification of large polygonal models"). A
    box keeps its edges and corners and an open sheet its border, where places nearest to the mean would draw
    both in by half a cell, and open gaps to what they touch.
    """
    columns = _plane_quadrics(surface) + _border_quadrics(surface) / clusters.resolution
    sums = [np.bincount(clusters.of_place, column, clusters.count)[clusters.of_place] for column in columns]
    xx, yy, zz, xy, yz, zx, bx, by, bz = sums
    x, y, z = surface.position.T
    error = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + yz * y * z + zx * z * x)
    error += 2 * (bx * x + by * y + bz * z)
    order = np.lexsort((error, clusters.of_place))
    begins = np.searchsorted(clusters.of_place[order], np.arange(clusters.count))
    return np.asarray(order[begins])


def _plane_quadrics(surface: _Surface) -> Float64:
    """(9, p) summed over the triangles of each place, by their area; see ``_quadrics``."""
    normals = unit(surface.crosses)
    areas = (normals * surface.crosses).sum(axis=1)
    count = len(surface.position)
    sums = _spread(_quadrics(normals, surface.position[surface.triangles[:, 0]], areas), surface.triangles, count)
    weight = MEAN_WEIGHT * np.bincount(surface.triangles.reshape(-1), np.repeat(areas, 3), count)
    sums[:3] += weight
    sums[6:] -= weight * surface.position.T
    return sums


def _border_quadrics(surface: _Surface) -> Float64:
    """(9, p) of the planes that stand on edges of a single triangle, by the edges' length."""
    count = len(surface.position)
    start = surface.triangles.reshape(-1)
    end = np.roll(surface.triangles, -1, axis=1).reshape(-1)
    edge = np.minimum(start, end) * count + np.maximum(start, end)
    order = np.argsort(edge)
    ordered = edge[order]
    same = ordered[1:] == ordered[:-1]
    single = order[~np.concatenate([[False], same]) & ~np.concatenate([same, [False]])]
    single = single[start[single] != end[single]]
    along = surface.position[end[single]] - surface.position[start[single]]
    across = unit(np.cross(along, surface.crosses[single // 3]))
    length = np.sqrt((along * along).sum(axis=1))
    quadrics = _quadrics(across, surface.position[start[single]], length)
    return _spread(quadrics, np.stack([start[single], end[single]], axis=1), count)


def _quadrics(normals: Float64, points: Float64, weights: Float64) -> Float64:
    """(9, k) of planes by ``normals`` and ``points`` (k, 3): A as xx yy zz xy yz zx, then b of xᵀAx + 2bᵀx + c."""
    x, y, z = normals.T
    shift = -(normals * points).sum(axis=1)
    return np.asarray(np.stack([x * x, y * y, z * z, x * y, y * z, z * x, shift * x, shift * y, shift * z]) * weights)


def _spread(columns: Float64, places: Int64, count: int) -> Float64:
    """(n, count) ``columns`` (n, k) added up at each of their ``places`` (k, j)."""
    at = places.T.reshape(-1)
    sums = [np.bincount(at, np.tile(column, places.shape[1]), count) for column in columns]
    return np.stack(sums).astype(np.float64)


def _kept(surface: _Surface, corners: Int64) -> Int64:
    """(s,) rows of the triangles that stay when their corners move to the places ``corners`` (f, 3).

    Of those at the same three places and wound alike the largest stays that still faces as it did; a
    triangle turned over goes where one that is not covers the same places.
    """
    rows = np.flatnonzero(_is_triangle(corners))
    rows = rows[(triangle_normals(surface.position[corners[rows]]) != 0).any(axis=1)]
    used, dense = np.unique(corners[rows], return_inverse=True)
    dense = dense.reshape(-1, 3)
    crosses = surface.crosses[rows]
    turned = (crosses * _crosses(surface.position[corners[rows]])).sum(axis=1) < 0
    key = _keys(dense)
    order = np.lexsort((-(crosses * crosses).sum(axis=1), turned, key))
    begins = np.ones(len(order), np.bool_)
    begins[1:] = key[order[1:]] != key[order[:-1]]
    best = order[begins]
    other = _keys(dense[best][:, ::-1])
    at = np.minimum(np.searchsorted(key[best], other), max(len(best) - 1, 0))
    covered = (key[best][at] == other) & ~turned[best][at]
    return np.sort(rows[best[~(turned[best] & covered)]])


def _crosses(corners: Float64) -> Float64:
    """(f, 3) normals of ``corners`` (f, 3, 3) times twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
