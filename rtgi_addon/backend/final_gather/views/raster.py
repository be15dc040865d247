# SPDX-License-Identifier: GPL-3.0-or-later
"""Views by drawing: the scene as it is seen from thousands of texels, each in a tile of one target (Larsen04 §4).

One draw shows one face of many texels' views, an instance a texel. Drawn is what may lie before them: clusters of
triangles behind all of them are left out, and large meshes are drawn as their stand-ins, but not before their own
texels, which lie on the mesh itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...gpu.context import Gpu
from ...gpu.pace import Pace
from ...gpu.programs import draw_program, set_uniforms
from ...gpu.triangles import CORNER_FORMAT, Corners, SceneTriangles, corners_of_scene, farthest
from ...scene import Bool, Float32, FrameState, Int32
from ...surface.geometry import Geometry
from ...surface.texels import Texels
from .clusters import Clusters, cluster_spheres, in_front, make_clusters
from .coarse import CoarseMesh
from .entries import Entries
from .target import Eyes, Target, nearest_texture, padded
from .view import View

#: Depths are logarithms of the distance over this share of the largest: 24 bits tell a millionth of any distance apart.
NEAR_SHARE = 1e-7
#: Views of one draw: few enough that what lies behind all of them is left out, many enough to keep a GPU busy.
LEAST_VIEWS, FIRST_VIEWS, MOST_VIEWS = 16, 256, 4096
#: Ranges of triangles that are drawn apart; nearer ones are drawn with what lies between them.
MOST_RANGES = 32
GL_CLIP_DISTANCE0 = 0x3000
#: Points that a parted view is taken from: one in each 2 × 2 of its pixels.
PARTS = 4
#: An instance of a draw: eye, tangent, normal, tile.
EYE = np.dtype([("eye", "f4", 3), ("tangent", "f4", 3), ("normal", "f4", 3), ("tile", "f4", 2)])


@dataclass(frozen=True)
class _Level:
    """The triangles of one level of detail; cluster by cluster they are drawn."""

    place: Int32  # (c, 3) where each corner is found in the geometry's corners
    clusters: Clusters
    offset: int  # of the first in the buffer of all


@dataclass(frozen=True)
class _Scenery:
    """All clusters of all levels in one frame."""

    centre: Float32  # (k, 3) of their spheres, local
    radius: Float32  # (k,) m
    instance: Int32  # (k,)
    coarse: Bool  # (k,) of a stand-in
    shown: Bool  # (k,)
    depth: tuple[float, float]  # see view.glsl
    begin: Int32  # (k,) first triangle in the buffer of all
    end: Int32  # (k,)


class ViewRaster:
    """Draws views of one scene as it stands in the frame last given to :meth:`follow`."""

    def __init__(
        self, gpu: Gpu, view: View, geometry: Geometry, texels: Texels, state: FrameState, entries: Entries,
        coarse: dict[int, CoarseMesh],
    ) -> None:  # fmt: skip
        """``coarse``: stand-ins by mesh. Raises GpuFailed where the scene does not fit the device."""
        self._gpu, self._view, self._geometry, self._entries = gpu, view, geometry, entries
        self._has_coarse = np.array([i.mesh in coarse for i in geometry.scene.instances], np.bool_)
        full, small = corners_of_scene(geometry), _coarse_corners(geometry, coarse)
        self._triangles = SceneTriangles(gpu, geometry, texels, state, _joined(full, small))
        self._levels = _levels(geometry, full, small)
        self._pace = Pace(LEAST_VIEWS, MOST_VIEWS, FIRST_VIEWS)
        self._depths: dict[tuple[int, int], Any] = {}
        self._resolution = texels.index.shape[1]
        self._open()
        self._mirrored = geometry.mirrored.copy()
        self._write_indices()
        self._scenery = self._look(state)

    def follow(self, moved: NDArray[np.int64], state: FrameState) -> None:
        """Bring the instances ``moved`` to where ``geometry`` has them, and show what ``state`` does."""
        self._triangles.follow(moved, state)
        if not np.array_equal(self._mirrored, self._geometry.mirrored):
            self._mirrored = self._geometry.mirrored.copy()
            self._write_indices()
        self._scenery = self._look(state)

    def draw(self, target: Target, tile: Int32, eyes: Eyes) -> None:
        """Draw the views of ``eyes`` (k,) into the tiles (k,) of ``target``; all its others stay as they are."""
        cleared = len(tile) == target.tiles and self._entries.plain_sky
        if cleared:
            with self._gpu.current() as ctx:
                self._aim(ctx, target)
                self._eyes.write(bytes(EYE.itemsize))  # one tile: all of the target
                self._erase(ctx, target, 1, target.size)
        for rows in _alike(self._has_coarse, eyes.instance):
            whole, parted = rows[~eyes.parted[rows]], rows[eyes.parted[rows]]
            self._draw_paced(target, tile[whole], eyes.take(whole), None, erase=not cleared)
            for part in range(PARTS):
                of_part = eyes.take(parted).from_point(part)
                self._draw_paced(target, tile[parted], of_part, part, erase=not cleared and part == 0)

    def release(self) -> None:
        """Give memory back."""
        self._triangles.release()
        vertex_arrays = (*self._drawings, self._clearing)
        self._gpu.release(*vertex_arrays, self._order, self._eyes, self._directions, *self._depths.values())

    def _open(self) -> None:
        """Programs and buffers."""
        two_sided = self._triangles.two_sided
        self._programs = [draw_program(self._gpu, "view", TWO_SIDED=two_sided, PARTED=parted) for parted in (0, 1)]
        self._clear = draw_program(self._gpu, "background")
        with self._gpu.current() as ctx:
            self._order = ctx.buffer(reserve=12 * max(self._triangles.count, 1))
            self._eyes = ctx.buffer(reserve=MOST_VIEWS * EYE.itemsize)
            read = [
                (self._triangles.placed, "3f", "in_position"),
                (self._triangles.corner_rows, *CORNER_FORMAT[two_sided]),
                (self._eyes, "3f 3f 3f 2f/i", "in_eye", "in_tangent", "in_normal", "in_tile"),
            ]
            self._drawings = [ctx.vertex_array(program, read, index_buffer=self._order) for program in self._programs]
            away = [(self._eyes, "12x 3f 3f 2f/i", "in_tangent", "in_normal", "in_tile")]
            self._clearing = ctx.vertex_array(self._clear, away)
            self._directions = nearest_texture(ctx, padded(self._view.directions))

    def _write_indices(self) -> None:
        with self._gpu.current():
            for level in self._levels:
                if level.clusters.count:
                    indices = self._triangles.indices(level.clusters.order + np.int32(level.offset))
                    self._order.write(indices.tobytes(), offset=12 * level.offset)

    def _look(self, state: FrameState) -> _Scenery:
        """What is there to draw, and where."""
        octaves = float(np.log2(1 / NEAR_SHARE))
        near = max(farthest(self._geometry) * NEAR_SHARE, float(np.finfo(np.float32).tiny))
        shown = state.visible & np.array([i.blocks_light for i in self._geometry.scene.instances], np.bool_)
        known = self._geometry.corners.reshape(-1, 3)
        spheres = [cluster_spheres(known[level.place], level.clusters) for level in self._levels]
        instance = np.concatenate([level.clusters.instance for level in self._levels])
        return _Scenery(
            centre=np.concatenate([centre for centre, _ in spheres]),
            radius=np.concatenate([radius for _, radius in spheres]),
            instance=instance,
            coarse=np.concatenate([np.full(level.clusters.count, level.offset > 0) for level in self._levels]),
            shown=shown[instance],
            depth=(-float(np.log2(near)) / octaves, 1 / octaves),
            begin=np.concatenate([level.clusters.first[:-1] + level.offset for level in self._levels]),
            end=np.concatenate([level.clusters.first[1:] + level.offset for level in self._levels]),
        )

    def _ranges(self, eyes: Eyes) -> list[tuple[int, int]]:
        """(first triangle, their number) in the buffer of all that may lie before ``eyes``, which are of one instance
        where that has a stand-in."""
        scenery = self._scenery
        as_is = (scenery.instance == eyes.instance[0]) | ~self._has_coarse[scenery.instance]
        drawn = scenery.shown & (as_is != scenery.coarse)
        rows = np.flatnonzero(drawn)
        rows = rows[in_front(scenery.centre[rows], scenery.radius[rows], eyes.eye, eyes.normal)]
        return merged(scenery.begin[rows], scenery.end[rows], np.cumsum(~drawn)[rows])

    def _draw_paced(self, target: Target, tile: Int32, eyes: Eyes, part: int | None, *, erase: bool) -> None:
        """In pieces short enough for a driver's watchdog. ``part``: of parted views, whose pixels alone are drawn."""
        done = 0
        while done < len(tile):
            rows = np.arange(done, min(done + self._pace.items, len(tile)))
            with self._pace.timed(len(rows)), self._gpu.current() as ctx:
                self._draw(ctx, target, target.corners(tile[rows]), eyes.take(rows), part, erase=erase)
                ctx.finish()
            done += len(rows)

    def _draw(self, ctx: Any, target: Target, corner: Float32, eyes: Eyes, part: int | None, *, erase: bool) -> None:
        rows = np.zeros(len(corner), EYE)
        rows["eye"], rows["tangent"], rows["normal"], rows["tile"] = eyes.eye, eyes.tangent, eyes.normal, corner
        self._eyes.orphan()
        self._eyes.write(rows.tobytes())
        self._aim(ctx, target)
        ctx.enable(ctx.DEPTH_TEST)
        if erase:
            self._erase(ctx, target, len(rows), (self._view.width, self._view.height))
        ctx.depth_func = "<"
        ctx.front_face = "cw"  # the picture looks along the normal with the tangent to the right: a mirror image
        ranges = self._ranges(eyes)
        program, drawing = self._programs[part is not None], self._drawings[part is not None]
        # Programs are shared by all views of the context: what one sets does not stay.
        set_uniforms(
            program, resolution=self._resolution, none=self._entries.none, target=target.size,
            depth=self._scenery.depth, part=0 if part is None else part,
        )  # fmt: skip
        with _clipped(ctx):
            for face in self._view.faces:
                axes = tuple(face.axes.T.reshape(-1))
                set_uniforms(program, axes=axes, low=face.low, rectangle=face.rectangle)
                for first, count in ranges:
                    drawing.render(ctx.TRIANGLES, vertices=3 * count, first=3 * first, instances=len(rows))
        ctx.disable(ctx.DEPTH_TEST)

    def _erase(self, ctx: Any, target: Target, tiles: int, size: tuple[int, int]) -> None:
        """Put the sky, infinitely far, into the first ``tiles`` of the eyes' tiles, each of ``size`` pixels."""
        ctx.enable(ctx.DEPTH_TEST)
        ctx.depth_func = "1"  # always: it takes the place of what was there
        self._directions.use(0)
        entries = self._entries
        set_uniforms(
            self._clear, size=size, target=target.size, directions=0, sky_size=entries.sky_size,
            sky_first=entries.sky_first, escaped=entries.escaped,
        )  # fmt: skip
        self._clearing.render(ctx.TRIANGLE_STRIP, vertices=4, instances=tiles)

    def _aim(self, ctx: Any, target: Target) -> None:
        """Draw to ``target`` from now on; targets of one size share their depths."""
        if target.framebuffer is None:
            if target.size not in self._depths:
                self._depths[target.size] = ctx.depth_renderbuffer(target.size)
            target.framebuffer = ctx.framebuffer([target.texture], self._depths[target.size])
        target.framebuffer.use()


def merged(begin: Int32, end: Int32, part: NDArray[np.int64]) -> list[tuple[int, int]]:
    """(first, count) of ranges that hold [begin, end) (k,), rising: what touches is joined, and then what lies nearest,
    with what is between, until there are MOST_RANGES.

    part (k,), rising: between ranges of different parts lies what must not be drawn; these are never joined.
    """
    if not len(begin):
        return []
    gap, barred = begin[1:] - end[:-1], part[1:] != part[:-1]
    apart = barred | (gap > 0)
    if np.count_nonzero(apart) >= MOST_RANGES:
        by_width = np.argsort(np.where(barred, -np.inf, -gap), kind="stable")
        apart = barred.copy()
        apart[by_width[: MOST_RANGES - 1]] = True
    first, last = begin[np.append(True, apart)], end[np.append(apart, True)]
    return [(int(a), int(b - a)) for a, b in zip(first, last, strict=True)]


def _alike(has_coarse: Bool, instance: Int32) -> Iterator[NDArray[np.int64]]:
    """Rows of eyes before which the same levels of detail are drawn."""
    key = np.where(has_coarse[instance], instance, np.int32(-1))
    for own in np.unique(key):
        yield np.flatnonzero(key == own)


def _levels(geometry: Geometry, full: Corners, small: Corners) -> list[_Level]:
    """Everything as it is, and the stand-ins after it."""
    size = geometry.triangle_count
    levels = []
    for corners, place, offset in (
        (full, np.arange(3 * size, dtype=np.int32).reshape(size, 3), 0),
        (small, _places(geometry, small), size),
    ):
        clusters = make_clusters(geometry.corners.reshape(-1, 3)[place], corners.instance)
        levels.append(_Level(place, clusters, offset))
    return levels


def _places(geometry: Geometry, corners: Corners) -> Int32:
    """(c, 3) a corner of the geometry that lies at each corner's vertex."""
    out = np.zeros(corners.vertex.shape, np.int32)
    for instance in np.unique(corners.instance):
        mesh = geometry.scene.meshes[geometry.scene.instances[instance].mesh]
        any_corner = np.zeros(len(mesh.vertices), np.int32)
        any_corner[mesh.triangles.reshape(-1)] = np.arange(mesh.triangles.size)
        rows = corners.instance == instance
        out[rows] = any_corner[corners.vertex[rows]] + 3 * geometry.first_triangle[instance]
    return out


def _coarse_corners(geometry: Geometry, coarse: dict[int, CoarseMesh]) -> Corners:
    """The triangles of all instances' stand-ins."""
    parts = [
        Corners(
            np.full(len(small.source), number, np.int32),
            small.source + geometry.first_triangle[number],
            small.triangles,
        )
        for number, instance in enumerate(geometry.scene.instances)
        if (small := coarse.get(instance.mesh)) is not None
    ]
    return _joined(*parts)


def _joined(*parts: Corners) -> Corners:
    return Corners(
        np.concatenate([np.zeros(0, np.int32), *(p.instance for p in parts)]),
        np.concatenate([np.zeros(0, np.int32), *(p.source for p in parts)]),
        np.concatenate([np.zeros((0, 3), np.int32), *(p.vertex for p in parts)]),
    )


@contextmanager
def _clipped(ctx: Any) -> Iterator[None]:
    """With the four clip distances that keep triangles within their tiles."""
    planes = [GL_CLIP_DISTANCE0 + k for k in range(4)]
    for plane in planes:
        ctx.enable_direct(plane)
    try:
        yield
    finally:
        for plane in planes:
            ctx.disable_direct(plane)
