# SPDX-License-Identifier: GPL-3.0-or-later
"""Texels: the atlas pixels that are surface, where they lie in the world, and which one a ray hit belongs to.

``Texels`` is fixed for a bake (it follows from meshes and atlas); ``TexelFrame`` is their place in one frame.
Larsen04's maps are per hand-made surface; here a surface is one UV island of one side of one instance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..scene import Atlas, Bool, Float32, Float64, Int32, Material, Mesh, Placement, Scene
from .geometry import Geometry, unit
from .rasterise import POINTS, RasterTexels, rasterise

Rows = NDArray[np.integer[Any]]

FRONT, BACK = 0, 1
#: The lookup image is widened by this many pixels, so that a hit on an island's border, moved over it by rounding,
#: still finds the island's own texel.
LOOKUP_BORDER_PX = 1
#: Of several texels equally near, the tree would return one that depends on all its texels; so far off a pixel's
#: middle none are equally near, and none that was further comes first.
TIE_BREAK_PX = (1e-5, 6.180339887e-6, 0.0)


@dataclass(frozen=True)
class Texels:
    """n texels in order of instance, side, row, col."""

    page: Int32  # (n,)
    row: Int32  # (n,) 0 is the bottom row
    col: Int32  # (n,)
    instance: Int32  # (n,)
    side: Int32  # (n,) FRONT or BACK
    surface: Int32  # (n,) 0..surface_count-1
    surface_count: int
    triangle: Int32  # (n,) scene-wide
    barycentric: Float32  # (n, 2) weights of the triangle's second and third corner
    point_triangle: Int32  # (n, POINTS) points spread over the texel's surface, see ``rasterise``: scene-wide triangle
    point_barycentric: Float32  # (n, POINTS, 2)
    coverage: Float32  # (n,) share of the pixel that is surface
    share: sparse.csr_matrix  # (n, triangles) part of each triangle's area that is the texel's
    index: Int32  # (pages, H, W) texel of each pixel, -1 where there is none
    lookup: Int32  # (pages * H * W,) `index` widened by LOOKUP_BORDER_PX within each island
    hit_affine: Float32  # (2 * triangles, 3, 2) page pixel of corner 0 and its change along u and v; NaN without map
    hit_page: Int32  # (2 * triangles,) first pixel of the page; rows of the back side follow all front ones

    @property
    def count(self) -> int:
        return len(self.row)

    @property
    def valid(self) -> Bool:
        """(pages, H, W) is the pixel a texel?"""
        return self.index >= 0

    def of_hits(self, triangle: Int32, u: Float32, v: Float32, back: Bool) -> Int32:
        """(m,) texel that a hit lies in; -1 where ``triangle`` is -1 or that side has no map."""
        height, width = self.index.shape[1:]
        row_of_side = triangle + back * np.int32(len(self.hit_page) // 2)
        affine = self.hit_affine.take(row_of_side, axis=0, mode="clip")  # (m, 3, 2)
        at = affine[:, 0] + affine[:, 1] * u[:, None] + affine[:, 2] * v[:, None]
        has_map = np.isfinite(at[:, 0]) & (triangle >= 0)
        cell = np.where(has_map[:, None], at, np.float32(0)).astype(np.int32)
        np.clip(cell[:, 0], 0, width - 1, out=cell[:, 0])
        np.clip(cell[:, 1], 0, height - 1, out=cell[:, 1])
        pixel = self.hit_page.take(row_of_side, mode="clip") + cell[:, 1] * width + cell[:, 0]
        return np.where(has_map, self.lookup.take(pixel), np.int32(-1))

    def to_pages(self, values: Float32) -> Float32:
        """(pages, H, W, c) image of per-texel ``values`` (n, c); zero elsewhere."""
        image = np.zeros((*self.index.shape, values.shape[1]), np.float32)
        image[self.page, self.row, self.col] = values
        return image


@dataclass(frozen=True)
class TexelFrame:
    """Where the texels are in one frame; local space (see ``geometry``)."""

    position: Float32  # (n, 3)
    normal: Float32  # (n, 3) unit shading normal, out of the texel's own side
    geometric_normal: Float32  # (n, 3) unit, out of the texel's own side
    points: Float32  # (n, POINTS, 3) spread over the texel's surface, lifted off it: where rays start and end
    area: Float32  # (n,) m²
    reach: Float32  # (n,) m: of the farthest of the points from the position


def make_texels(scene: Scene, atlas: Atlas, geometry: Geometry) -> Texels:
    """All texels of ``atlas``. Raises ValueError when a placement leaves its page."""
    rasters: dict[tuple[object, ...], RasterTexels] = {}
    parts: list[_Side] = []
    affine = np.full((2 * geometry.triangle_count, 3, 2), np.nan, np.float32)
    page_start = np.zeros(2 * geometry.triangle_count, np.int32)
    surface_count = 0
    for number, instance in enumerate(scene.instances):
        mesh = scene.meshes[instance.mesh]
        for side, placement in ((FRONT, atlas.front[number]), (BACK, atlas.back[number])):
            if placement is None or not mesh.triangle_count or not instance.receives_light:
                continue
            corner_px = _corner_px(mesh, placement, atlas.resolution)
            if corner_px.min() < -1e-3 or corner_px.max() > atlas.resolution + 1e-3:
                raise ValueError(f"{instance.name}: its atlas rectangle leaves page {placement.page}")
            whole = np.floor(corner_px.min(axis=(0, 1)) + 1e-3)
            start = corner_px - whole
            key = (instance.mesh, *placement.scale, *np.round(start[0, 0], 3))
            if key not in rasters:
                rasters[key] = rasterise(start, mesh.island_of_triangle)
            triangles = geometry.triangles_of(number)
            rows = slice(
                side * geometry.triangle_count + triangles.start, side * geometry.triangle_count + triangles.stop
            )
            affine[rows] = _affine(corner_px)
            page_start[rows] = placement.page * atlas.resolution**2
            raster = rasters[key]
            parts.append(_Side(number, side, placement.page, whole, triangles.start, surface_count, raster))
            surface_count += mesh.island_count
    columns, share = _columns(scene, parts, geometry.triangle_count)
    return _on_pages(columns, share, atlas, surface_count, affine, page_start)


@dataclass(frozen=True)
class _Side:
    """One mapped side of one instance."""

    instance: int
    side: int
    page: int
    whole: Float64  # (2,) page pixel (col, row) of the raster's first
    first_triangle: int
    first_surface: int
    raster: RasterTexels


def _corner_px(mesh: Mesh, placement: Placement, resolution: int) -> Float64:
    uv = mesh.corner_uv.astype(np.float64) * placement.scale + placement.offset
    return np.asarray(uv * resolution, np.float64)


def _affine(corner_px: Float64) -> Float64:
    origin = corner_px[:, 0]
    return np.stack([origin, corner_px[:, 1] - origin, corner_px[:, 2] - origin], axis=1)


def _columns(
    scene: Scene, parts: list[_Side], triangle_count: int
) -> tuple[dict[str, NDArray[Any]], sparse.csr_matrix]:
    """The texels of all sides one after the other, as columns of :class:`Texels`; and their shares of triangles."""
    counts = np.array([len(p.raster.row) for p in parts], np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)])

    def joined(make: Callable[[_Side], Any], shape: tuple[int, ...], kind: type) -> NDArray[Any]:
        return np.concatenate([np.zeros((0, *shape), kind), *(np.asarray(make(p), kind) for p in parts)])

    def same(make: Callable[[_Side], int]) -> Int32:
        return np.repeat(np.array([make(p) for p in parts], np.int32), counts)

    islands = [scene.meshes[scene.instances[p.instance].mesh].island_of_triangle for p in parts]
    columns = {
        "page": same(lambda p: p.page),
        "row": joined(lambda p: p.raster.row + int(p.whole[1]), (), np.int32),
        "col": joined(lambda p: p.raster.col + int(p.whole[0]), (), np.int32),
        "instance": same(lambda p: p.instance),
        "side": same(lambda p: p.side),
        "surface": np.concatenate(
            [
                np.zeros(0, np.int32),
                *(i[p.raster.triangle] + p.first_surface for p, i in zip(parts, islands, strict=True)),
            ]
        ).astype(np.int32),
        "triangle": joined(lambda p: p.raster.triangle + p.first_triangle, (), np.int32),
        "barycentric": joined(lambda p: p.raster.barycentric, (2,), np.float32),
        "point_triangle": joined(lambda p: p.raster.point_triangle + p.first_triangle, (POINTS,), np.int32),
        "point_barycentric": joined(lambda p: p.raster.point_barycentric, (POINTS, 2), np.float32),
        "coverage": joined(lambda p: p.raster.coverage, (), np.float32),
    }
    texel = [p.raster.pair_texel + int(start) for p, start in zip(parts, starts, strict=False)]
    pairs = (
        joined(lambda p: p.raster.pair_share, (), np.float32),
        (
            np.concatenate([np.zeros(0, np.int64), *texel]),
            joined(lambda p: p.raster.pair_triangle + p.first_triangle, (), np.int32),
        ),
    )
    return columns, sparse.coo_matrix(pairs, shape=(int(starts[-1]), triangle_count)).tocsr()


def _on_pages(
    columns: dict[str, NDArray[Any]], share: sparse.csr_matrix, atlas: Atlas, surface_count: int,
    affine: Float32, page_start: Int32,
) -> Texels:  # fmt: skip
    """Texels with their index images. Where rectangles overlap (a user's own layer may), the first keeps the pixel."""
    size = atlas.resolution
    inside = (columns["row"] >= 0) & (columns["row"] < size) & (columns["col"] >= 0) & (columns["col"] < size)
    pixel = (columns["page"].astype(np.int64) * size + columns["row"]) * size + columns["col"]
    _, first = np.unique(np.where(inside, pixel, -1), return_index=True)
    keep = np.zeros(len(pixel), np.bool_)
    keep[first] = True
    keep &= inside
    if not keep.all():
        columns, share = {name: column[keep] for name, column in columns.items()}, share[keep]
    index = np.full((atlas.page_count, size, size), -1, np.int32)
    index[columns["page"], columns["row"], columns["col"]] = np.arange(len(columns["row"]), dtype=np.int32)
    return Texels(
        **columns,
        share=share,
        surface_count=surface_count,
        index=index,
        lookup=_widened(index).reshape(-1),
        hit_affine=affine,
        hit_page=page_start,
    )


def _widened(index: Int32) -> Int32:
    """``index`` with each free pixel taking a direct neighbour's texel, LOOKUP_BORDER_PX times."""
    wide = index.copy()
    for _ in range(LOOKUP_BORDER_PX):
        before = np.pad(wide, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
        for dy, dx in ((1, 0), (1, 2), (0, 1), (2, 1), (0, 0), (0, 2), (2, 0), (2, 2)):
            neighbour = before[:, dy : dy + index.shape[1], dx : dx + index.shape[2]]
            np.copyto(wide, neighbour, where=wide < 0)
    return wide


def stand_ins(texels: Texels, valid: Bool) -> Int32:
    """(n,) the texel whose light stands for each: itself where ``valid``, else the nearest valid one of its surface on
    the page; -1 where its surface has none. Each surface by itself: what is hidden elsewhere does not matter."""
    source = np.arange(texels.count, dtype=np.int32)
    lost = np.flatnonzero(~valid)
    source[lost] = -1
    hidden = np.zeros(texels.surface_count, np.bool_)
    hidden[texels.surface[lost]] = True
    good = np.flatnonzero(valid & hidden[texels.surface])
    if not len(lost) or not len(good):
        return source
    # Surfaces lie so far apart along the third axis that the nearest texel is one's own surface's if it has any.
    apart = 4.0 * max(texels.index.shape[1:])
    place = np.stack([texels.row, texels.col, texels.surface * apart], axis=1).astype(np.float64)
    _, nearest = cKDTree(place[good]).query(place[lost] + TIE_BREAK_PX)
    own = texels.surface[good[nearest]] == texels.surface[lost]
    source[lost[own]] = good[nearest[own]]
    return source


def place_texels(texels: Texels, geometry: Geometry) -> TexelFrame:
    """The texels' place in the frame that ``geometry`` stands in."""
    return _placed(texels, geometry, np.arange(texels.count))


def follow_texels(frame: TexelFrame, texels: Texels, geometry: Geometry, rows: Rows) -> None:
    """Bring the texels ``rows`` (k,) of ``frame`` to where ``geometry`` stands; the same bits as all placed anew."""
    if len(rows):
        moved = _placed(texels, geometry, rows)
        for f in fields(TexelFrame):
            getattr(frame, f.name)[rows] = getattr(moved, f.name)


def _placed(texels: Texels, geometry: Geometry, rows: Rows) -> TexelFrame:
    """The texels ``rows`` (k,)."""
    triangle, barycentric = texels.triangle[rows], texels.barycentric[rows]
    corners = geometry.corners.take(triangle, axis=0)  # (k, 3, 3)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    u, v = barycentric[:, :1], barycentric[:, 1:]
    facing = np.where(texels.side[rows] == BACK, np.float32(-1), np.float32(1))[:, None]
    shading = geometry.corner_normals.take(triangle, axis=0)
    normal = unit((shading[:, 0] * (1 - u - v) + shading[:, 1] * u + shading[:, 2] * v).astype(np.float64))
    geometric = geometry.normals.take(triangle, axis=0)
    # No shading normal (it vanished between opposite corners, or the mesh has none): the triangle's own.
    lost = (normal * normal).sum(axis=1) < 0.5
    normal[lost] = geometric[lost]
    position = np.asarray(corners[:, 0] + e1 * u + e2 * v, np.float32)
    points = _lifted_points(texels, geometry, rows)
    away = points - position[:, None]
    share = texels.share if len(rows) == texels.count else texels.share[rows]
    return TexelFrame(
        position=position,
        normal=(normal * facing).astype(np.float32),
        geometric_normal=geometric * facing,
        points=points,
        area=np.asarray(share @ geometry.areas, np.float32),
        reach=np.sqrt((away * away).sum(axis=2).max(axis=1, initial=0)),
    )


def _lifted_points(texels: Texels, geometry: Geometry, rows: Rows) -> Float32:
    """(k, POINTS, 3) each point lifted off its own triangle, to the texel's side."""
    triangle = texels.point_triangle[rows].reshape(-1)
    u, v = texels.point_barycentric[rows].reshape(-1, 2).T
    points = geometry.points(triangle, u, v)
    facing = np.where(texels.side[rows] == BACK, np.float32(-1), np.float32(1)).repeat(POINTS)
    lift = (geometry.offset_length(points) * facing)[:, None]
    return np.asarray(points + geometry.normals.take(triangle, axis=0) * lift, np.float32).reshape(-1, POINTS, 3)


def surface_areas(texels: Texels, frame: TexelFrame) -> Float32:
    """(surface_count,) m²"""
    return np.asarray(np.bincount(texels.surface, frame.area, minlength=texels.surface_count), np.float32)


def texel_colours(
    texels: Texels, scene: Scene, geometry: Geometry, materials: tuple[Material, ...]
) -> tuple[Float32, Float32]:
    """((n, 3), (n, 3)): albedo and emitted radiance W/(m² sr) of each texel, from maps where a mesh has them."""
    material = geometry.material_of_triangle[texels.triangle]
    albedo = np.array([m.albedo for m in materials], np.float32).reshape(-1, 3)[material]
    emission = np.array([m.emission for m in materials], np.float32).reshape(-1, 3)[material]
    mesh_of_instance = np.array([i.mesh for i in scene.instances], np.int64)
    mesh_of_texel = mesh_of_instance[texels.instance] if texels.count else np.zeros(0, np.int64)
    for number, mesh in enumerate(scene.meshes):
        if mesh.albedo_map is None and mesh.emission_map is None:
            continue
        rows = np.nonzero(mesh_of_texel == number)[0]
        instance_start = geometry.first_triangle[texels.instance[rows]]
        uv = mesh.corner_uv[texels.triangle[rows] - instance_start]  # (m, 3, 2)
        u, v = texels.barycentric[rows, :1], texels.barycentric[rows, 1:]
        at = uv[:, 0] * (1 - u - v) + uv[:, 1] * u + uv[:, 2] * v
        if mesh.albedo_map is not None:
            albedo[rows] = sample_map(mesh.albedo_map, at)
        if mesh.emission_map is not None:
            emission[rows] = sample_map(mesh.emission_map, at)
    return albedo, emission


def sample_map(image: Float32, uv: Float32) -> Float32:
    """(m, 3) the pixels of ``image`` (h, w, 3) at ``uv`` (m, 2); nearest, since neighbours may be other islands."""
    height, width = image.shape[:2]
    col = np.clip((uv[:, 0] * width).astype(np.int64), 0, width - 1)
    row = np.clip((uv[:, 1] * height).astype(np.int64), 0, height - 1)
    return image[row, col]
