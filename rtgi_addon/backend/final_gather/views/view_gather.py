# SPDX-License-Identifier: GPL-3.0-or-later
"""The gather by views: what each texel sees is drawn once, kept on the GPU, and summed for whatever light there is.

Drawn again is what a moved object may be seen in: views of texels before which it was or is. With still geometry and
moving lamps nothing is drawn. What does not fit the memory allowed is drawn anew for every product.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...gpu.compute_tracer import ComputeTracer
from ...gpu.context import Gpu, GpuFailed
from ...parallel import Workers
from ...placed import PlacedScene
from ...sampling import dot, frames, hash_keys, unit_float32
from ...scene import Bool, Float32, FrameState, Int32
from ...selection.changes import Change
from ...settings import Gather, SampleCounts
from ...surface.texels import stand_ins
from ..bright import BrightTargets
from ..gather import GatherRays
from ..kept_gather import GatherWork
from ..link_store import LinkStore
from ..links import MOST_HALF_SCALE
from ..openness import open_texels
from ..patterns import TILE, pattern_of_texels
from .coarse import CoarseMesh
from .entries import NOTHING, make_entries
from .raster import ViewRaster
from .rays import ViewRays
from .sums import ViewSums
from .target import Eyes, Target
from .view import LEAST_SIZE, MOST_SIZE, View

#: Rays of a texel that tell which of its points lie in the open.
PROBES = SampleCounts(32, 0)
#: Sides of a target, pixels: software draws fastest into what stays in a core's cache.
SOFTWARE_SIDE, HARDWARE_SIDE = 1024, 4096
#: Targets given back where memory ran out: for one to draw anew into, its depths, and sums.
SPARED_TARGETS = 3
#: Normals of a flat texel's points, and of a texel and its triangle, differ by less.
FLAT = np.float32(1e-4)
#: Cosine below which two normals of a texel's points are of different sides of an edge: 26°.
ALIKE = np.float32(0.9)


def view_size(samples: SampleCounts) -> int:
    """Pixels along a view that stand for ``samples`` rays: 16, 32, 64 for draft, preview, final."""
    size = 1 << int(np.ceil(np.log2(4 * np.sqrt(samples.total)) - 1e-9))
    return min(max(size, LEAST_SIZE), MOST_SIZE)


class ViewSource(Protocol):
    """What fills the tiles of targets."""

    def follow(self, moved: NDArray[np.int64], state: FrameState) -> None:
        """Bring the instances ``moved`` to where they are now, and show what ``state`` does."""
        ...

    def draw(self, target: Target, tile: Int32, eyes: Eyes) -> None:
        """Fill the tiles (k,) of ``target`` with the views of ``eyes`` (k,)."""
        ...

    def release(self) -> None:
        """Give memory back."""
        ...


class ViewGather:
    """The :class:`~..kept_gather.KeptGather` by views. All calls from one thread."""

    def __init__(
        self, placed: PlacedScene, gpu: Gpu, view: View, workers: Workers,
        *, memory: int, coarse: dict[int, CoarseMesh], seed: int,
    ) -> None:  # fmt: skip
        """Nothing is drawn yet. ``memory``: bytes that views may take · ``coarse``: stand-ins by mesh.

        Raises GpuFailed where the scene does not fit the device, here and in every call.
        """
        self._placed, self._gpu, self._view = placed, gpu, view
        texels = placed.texels
        self._probe = GatherRays(
            texels, placed.frame, placed.geometry, placed.surfaces, placed.tracer, placed.sky, nothing_bright(placed),
            PROBES, max_specular=0, seed=seed,
        )  # fmt: skip
        self._shift = _shifts(pattern_of_texels(texels.page, texels.row, texels.col, seed), seed)
        self._entries = make_entries(texels, placed.sky)
        self._source: ViewSource
        if view.kind is Gather.RAYS:
            if not isinstance(placed.tracer, ComputeTracer):
                raise GpuFailed("gather rays: the scene is not traced by the GPU")
            self._source = ViewRays(gpu, view, placed.geometry, texels, placed.tracer, self._entries)
        else:
            self._source = ViewRaster(gpu, view, placed.geometry, texels, placed.state, self._entries, coarse)
        # A device that has compute shaders sums faster by them; software does not.
        by_groups = gpu.info.computes and not gpu.info.software
        self._sums = ViewSums(gpu, view, self._entries.count, by_groups=by_groups)
        # Which part of a texel is open hangs on what its probes meet; they are kept and followed as links are.
        self._opening = LinkStore(self._probe, workers, memory=1 << 62)
        self._pending = np.ones(texels.count, np.bool_)
        self._targets = self._make_targets(memory)
        self._spare: _ViewTarget | None = None

    @property
    def count(self) -> int:
        return len(self._pending)

    @property
    def kept(self) -> int:
        return min(self.count, sum(t.target.tiles for t in self._targets))

    @property
    def samples_kept(self) -> int:
        """None that are counted: see ``FrameStats.views_drawn``."""
        return 0

    @property
    def bytes(self) -> int:
        return sum(t.target.bytes for t in self._targets)

    @property
    def pending(self) -> Bool:
        return np.asarray(self._pending | self._opening.pending)

    def follow(self, placed: PlacedScene, change: Change) -> int:
        self._probe.follow(change.texels, placed.surfaces)
        if not change.sweep.any:
            return 0
        self._opening.disturb(self._probe, change.sweep, placed.frame.reach)
        self._source.follow(np.flatnonzero(change.sweep.moved), placed.state)
        self._pending |= change.texels
        frame = placed.frame
        for place in change.sweep.places:
            away = place.centre.astype(np.float32) - frame.position
            self._pending |= dot(away, frame.normal) + np.float32(place.radius) + frame.reach > 0
        return 0

    def renew(self, texel: Int32) -> GatherWork:
        texel = texel[self.pending[texel]]
        work = GatherWork(np.zeros(self.count, np.bool_), drawn=len(texel))
        work.traced = self._opening.renew(self._probe, texel).traced
        work.changed[texel] = True
        first = 0
        for kept in self._targets:
            mine = texel[(texel >= first) & (texel < first + kept.target.tiles)]
            eyes = self._eyes(mine)
            kept.draw(self._source, mine - first, eyes, self._tilt(eyes))
            first += kept.target.tiles
        self._pending[texel] = False
        return work

    def at_stake(self, brightness: Float32, texel: Int32) -> Float32:
        sent = np.broadcast_to(brightness[:, None], (len(brightness), 3)).astype(np.float32)
        return np.ascontiguousarray(self.irradiance().irradiance(sent)[texel, 0])

    def components(self) -> tuple[Int32, Bool]:
        """One: which surfaces a view shows is known to the GPU alone."""
        count = self._placed.texels.surface_count
        return np.zeros(count, np.int32), np.ones(count, np.bool_)

    def irradiance(self) -> ViewIrradiance:
        texels = self._placed.texels
        stand_in = stand_ins(texels, open_texels(texels, self._opening.free))
        patches = np.arange(self._probe.target_count - self.count, dtype=np.int32) + np.int32(self.count)
        themselves = np.arange(self.count, dtype=np.int32)
        shown = None
        if not np.array_equal(stand_in, themselves):
            shown = np.concatenate([np.where(stand_in < 0, np.int32(NOTHING), stand_in), patches])
        return ViewIrradiance(stand_in, self, shown, themselves)

    def release(self) -> None:
        for kept in (*self._targets, self._spare):
            if kept is not None:
                kept.release()
        self._source.release()
        self._sums.release()

    def products(self, radiosity: Float32, seen_as: Int32 | None, texels: NDArray[np.int64]) -> tuple[Float32, Float32]:
        """((r, 4), (r, 4)) what each half of the pixels brings to ``texels`` (r,), rising, and its weight."""
        self._sums.send(self._entries.sent(radiosity, seen_as))
        halves = np.zeros((2, len(texels), 4), np.float32)
        first = 0
        for kept in self._targets:
            rows = slice(*np.searchsorted(texels, [first, first + kept.target.tiles]))
            if rows.start < rows.stop:
                for half, sums in zip(halves, self._sums.sums(kept.target, kept.triangle), strict=True):
                    half[rows] = sums[texels[rows] - first]
            first += kept.target.tiles
        for at in range(int(np.searchsorted(texels, first)), len(texels), max(1, self._spare_tiles())):
            rows = slice(at, min(at + self._spare_tiles(), len(texels)))
            for half, sums in zip(halves, self._drawn_again(texels[rows].astype(np.int32)), strict=True):
                half[rows] = sums
        return halves[0], halves[1]

    def lit_once(self, texel: Int32, radiosity: Float32, products: int) -> tuple[Float32, float]:
        """((k, 3) irradiance of ``texel`` (k,), rising, seconds for drawing their views and so many products). Nothing
        of it is kept. Once before, unmeasured, so that no shader is compiled meanwhile."""
        self._opening.renew(self._probe, texel)
        self._sums.send(self._entries.sent(radiosity, None))
        parts = [texel[at : at + self._spare_tiles()] for at in range(0, len(texel), self._spare_tiles())]
        halves = np.concatenate([sum(self._drawn_again(part)) for part in parts])
        seconds = 0.0
        for part in parts:
            start = time.perf_counter()
            self._drawn_again(part)
            drawn = time.perf_counter()
            assert self._spare is not None
            self._sums.sums(self._spare.target, self._spare.triangle)
            summed = time.perf_counter() - drawn
            # A sum takes a target's time whether all of its tiles hold anything or not.
            share = len(part) / self._spare.target.tiles
            seconds += drawn - start - summed + products * summed * share
        return halves[:, :3] * _inverse(halves[:, 3:]), seconds

    def _spare_tiles(self) -> int:
        return self._targets[0].target.tiles if self._targets else self._fitting(self.count).tiles

    def _drawn_again(self, texel: Int32) -> list[Float32]:
        """Of views that are not kept: drawn for this product alone."""
        if self._spare is None:
            self._spare = _ViewTarget(self._gpu, self._fitting(self.count), self._tilted)
        tile = np.arange(len(texel), dtype=np.int32)
        eyes = self._eyes(texel)
        self._spare.draw(self._source, tile, eyes, self._tilt(eyes))
        return [sums[: len(texel)] for sums in self._sums.sums(self._spare.target, self._spare.triangle)]

    def _make_targets(self, memory: int) -> list[_ViewTarget]:
        """As many as the texels need and ``memory`` holds."""
        # Rays below a texel's own triangle are left out as they are traced.
        self._tilted = self._view.kind is not Gather.RAYS and bool(
            np.any(np.abs(self._placed.frame.normal - self._placed.frame.geometric_normal) > FLAT)
        )
        shape = self._fitting(self.count)
        each = 4 * shape.tiles * self._view.width * self._view.height
        number = min(-(-self.count // shape.tiles), memory // each)
        targets: list[_ViewTarget] = []
        try:
            while len(targets) < number:
                targets.append(_ViewTarget(self._gpu, shape, self._tilted))
        except GpuFailed:  # the device has less: room is left for what draws the others, product by product
            for target in targets[-SPARED_TARGETS:]:
                target.release()
            del targets[-SPARED_TARGETS:]
        return targets

    def _fitting(self, count: int) -> _Shape:
        """Tiles across and down a target; no larger than ``count`` texels need."""
        side = min(SOFTWARE_SIDE if self._gpu.info.software else HARDWARE_SIDE, self._gpu.info.max_texture)
        across = max(1, min(side // self._view.width, count))
        return _Shape(self._view, across, max(1, min(side // self._view.height, -(-count // across))))

    def _eyes(self, texel: Int32) -> Eyes:
        """Where the views of ``texel`` (m,) are taken from: its middle, where it is flat and wholly in the open, else
        the point in the open nearest to the middle of those."""
        frame, texels = self._placed.frame, self._placed.texels
        points, opened = frame.points[texel], self._opening.opened[texel]
        share = opened / np.maximum(opened.sum(axis=1, keepdims=True), 1)
        middle = np.asarray((points * share[:, :, None]).sum(axis=1), np.float32)
        away = ((points - middle[:, None]) ** 2).sum(axis=2)
        nearest = np.argmin(np.where(opened, away, np.float32(np.inf)), axis=1)
        normals = self._placed.geometry.normals[texels.point_triangle[texel]]
        flat = (np.abs(normals - normals[:, :1]) <= FLAT).all(axis=(1, 2)) & opened.all(axis=1)
        eye = np.where(flat[:, None], middle, points[np.arange(len(texel)), nearest])
        normal = frame.normal[texel]
        tangent, bitangent = frames(normal)
        # A quarter turn brings a view's pixels back to where they were.
        turn = self._shift[texel, :1] * np.float32(np.pi / 2)
        cosine, sine = np.cos(turn), np.sin(turn)
        return Eyes(
            eye, tangent * cosine + bitangent * sine, normal, frame.geometric_normal[texel], texels.instance[texel],
            points, opened, self._shift[texel], self._parted(texel, normals, opened),
        )  # fmt: skip

    def _parted(self, texel: Int32, normals: Float32, opened: Bool) -> Bool:
        """(m,) does light change too much over ``texel`` for one point to stand for it: about an edge, partly under
        other geometry, or beside such? normals (m, POINTS, 3) and opened (m, POINTS) of its points."""
        about_edge = ((normals * normals[:, :1]).sum(axis=2) < ALIKE).any(axis=1)
        near = self._opening.near(texel, 2 * self._placed.frame.reach[texel])
        return np.asarray(about_edge | ~opened.all(axis=1) | near)

    def _tilt(self, eyes: Eyes) -> Float32 | None:
        """(m, 4) normals of the own triangles of ``eyes`` (m,), tangent space; None where no texel's is tilted."""
        if not self._tilted:
            return None
        across = np.cross(eyes.normal, eyes.tangent).astype(np.float32)
        parts = [dot(eyes.own, axis) for axis in (eyes.tangent, across, eyes.normal)]
        return np.asarray(np.stack([*parts, np.zeros(len(across), np.float32)], axis=1), np.float32)


@dataclass(frozen=True)
class ViewIrradiance:
    """The :class:`~..kept_gather.Irradiance` by views, of r texels."""

    stand_in: Int32
    _gather: ViewGather
    _seen_as: Int32 | None  # (m,) what each target is seen as, NOTHING: it does not count; None: as itself
    _texels: NDArray[Any]  # (r,) rising

    def irradiance(self, radiosity: Float32) -> Float32:
        return self.with_half(radiosity)[0]

    def with_half(self, radiosity: Float32) -> tuple[Float32, Float32]:
        first, second = self._gather.products(radiosity, self._seen_as, self._texels)
        whole = first + second
        scale = _inverse(whole[:, 3:])
        half_scale = np.minimum(_inverse(first[:, 3:]), scale * np.float32(MOST_HALF_SCALE))
        return whole[:, :3] * scale, first[:, :3] * half_scale

    def only(self, texels: NDArray[np.int64]) -> ViewIrradiance:
        return replace(self, _texels=texels)


@dataclass(frozen=True)
class _Shape:
    view: View
    across: int
    down: int

    @property
    def tiles(self) -> int:
        return self.across * self.down


class _ViewTarget:
    """A target, and the triangles' normals of the texels in its tiles where they matter."""

    def __init__(self, gpu: Gpu, shape: _Shape, tilted: bool) -> None:
        self._gpu = gpu
        self.target = Target(gpu, shape.view, shape.across, shape.down)
        self.triangle: Any = None
        self._up = np.zeros((shape.tiles, 4), np.float32)
        if tilted:
            with gpu.current() as ctx:
                self.triangle = ctx.texture((shape.across, shape.down), 4, dtype="f4")
                self.triangle.filter = (ctx.NEAREST, ctx.NEAREST)

    def draw(self, source: ViewSource, tile: Int32, eyes: Eyes, tilt: Float32 | None) -> None:
        if not len(tile):
            return
        source.draw(self.target, tile, eyes)
        if tilt is not None:
            self._up[tile] = tilt
            with self._gpu.current():
                self.triangle.write(self._up.tobytes())

    def release(self) -> None:
        self.target.release()
        self._gpu.release(self.triangle)


def nothing_bright(placed: PlacedScene) -> BrightTargets:
    """Nothing to aim at."""
    count = placed.texels.count + (placed.sky.count if placed.sky else 0)
    none = np.zeros((1, count))
    return BrightTargets(np.zeros(placed.texels.count, np.int32), none.astype(np.float32), np.zeros((1, count + 1)))


def _shifts(pattern: Int32, seed: int) -> Float32:
    """(n, 2) in [0, 1), evenly spread over the texels of a tile, so that what the denoiser averages cancels."""
    sets, within = np.divmod(pattern, TILE * TILE)
    bits = np.array([int(f"{k:04b}"[::-1], 2) for k in range(TILE * TILE)])
    share = np.stack([bits[within], within], axis=1) / (TILE * TILE)
    turned = np.stack([unit_float32(hash_keys(sets, k, seed)) for k in (5, 6)], axis=1)
    return np.asarray((share + turned) % 1.0, np.float32)


def _inverse(weight: Float32) -> Float32:
    return np.divide(np.float32(1), weight, out=np.zeros_like(weight), where=weight > 0)
