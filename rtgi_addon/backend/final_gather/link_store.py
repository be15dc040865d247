# SPDX-License-Identifier: GPL-3.0-or-later
"""Gather rays kept from frame to frame: K a texel in fixed arrays, which are at once the rows of a sparse matrix.

A link is a ray's target and weight; its length is kept to test it against what moves. Objects that move disturb the
links they touch, and only those are traced again (DESIGN §5). What does not fit the memory allowed is traced anew
whenever its light is asked for.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..parallel import CHUNK_RAYS, Workers
from ..scene import Bool, Float32, Float64, Int32
from ..selection.sweep import Sweep
from ..surface.rasterise import POINTS
from .beyond_store import BeyondStore
from .components import SurfaceGraph
from .gather import NO_TARGET, Beyond, GatherRays, TracedTexels
from .kept_gather import GatherWork
from .touched import Kept, touched_rays

#: Target, weight and pending mark of a link; a cosine ray's length besides.
BYTES_PER_LINK, BYTES_PER_LENGTH = 9, 4
#: Pieces that work is cut into, at the least. More and smaller ones would keep more threads busy, but NumPy's threads
#: stand in one another's way below some ten thousand numbers at a time.
PARTS = 2
#: More moved objects than this cost as much to test for as all rays cost to trace (hall of 64 blocks: at 12).
MOST_PLACES = 12
#: Fewer rays than this are not worth a second thread.
LEAST_RAYS = 1 << 13


class LinkStore:
    """The links of n texels to m targets and to nothing (number m), K each; those of the first ``kept`` texels stay.

    A texel's slots are in two halves, each a good set of rays by itself: half of the cosine rays, half of the aimed
    ones, then the others. target, weight (kept, K): weight 0 where a ray is not usable · distance (kept, cosine).
    """

    def __init__(self, rays: GatherRays, workers: Workers, *, memory: int) -> None:
        """Nothing is traced yet. ``memory``: bytes that links may take."""
        count, slots = rays.texels.count, rays.n_cosine + rays.n_bright
        per_texel = slots * BYTES_PER_LINK + rays.n_cosine * BYTES_PER_LENGTH
        self.count, self.kept, self.nothing = count, min(count, memory // per_texel), rays.target_count
        self._workers, self._cosine, self._bright = workers, rays.n_cosine, rays.n_bright
        self.target = np.zeros((self.kept, slots), np.int32)
        self.weight = np.zeros((self.kept, slots), np.float32)
        self._distance = np.zeros((self.kept, rays.n_cosine), np.float32)
        self.total: Float64 = np.zeros((count, 2))  # weight of each half
        self.free: Float32 = np.ones(count, np.float32)  # share of a texel's rays that end on no dark side
        self._cut: Bool = np.zeros(count, np.bool_)
        self._opened: Bool = np.ones((count, POINTS), np.bool_)
        self._pending = np.ones((self.kept, slots), np.bool_)
        self._pending_texel = np.ones(count, np.bool_)
        self._filled = False  # is anything traced yet?
        self.beyond = BeyondStore(rays.n_cosine)
        self.graph = SurfaceGraph(rays.texels.surface_count)
        self._known_pairs: dict[str, tuple[Int32, Int32]] = {}  # of links that the graph has no counts of
        self._surface = rays.texels.surface
        self._surface_of_column = np.full(self.nothing + 1, -1, np.int32)
        self._surface_of_column[:count] = rays.texels.surface
        self._cosine_slots, self._aimed_slots = _slots(rays.n_cosine, rays.n_bright)

    @property
    def opened(self) -> Bool:
        """(n, POINTS) which points of each texel lie in its open part; not to be written to."""
        return self._opened

    def near(self, texel: Int32, distance: Float32) -> Bool:
        """(k,) does any cosine ray of ``texel`` (k,), all of them kept, end within ``distance`` (k,) m?"""
        return np.asarray(self._distance[texel].min(axis=1, initial=np.inf) < distance)

    @property
    def bytes(self) -> int:
        """Memory that the kept links take."""
        return self.target.nbytes + self.weight.nbytes + self._distance.nbytes + self._pending.nbytes

    def components(self) -> tuple[Int32, Bool]:
        """((s,) which surfaces exchange light, numbered; (s,) whether they exchange any)."""
        return self.graph.labels(), self.graph.coupled()

    @property
    def pending(self) -> Bool:
        """(n,) texels with links that an object touched and that were not traced since."""
        return self._pending_texel.copy()

    def disturb(self, rays: GatherRays, sweep: Sweep, reach: Float32) -> int:
        """Mark the links that the ``sweep`` touches as pending; how many were looked at one by one.

        ``rays`` of the new frame; reach (n,) m: of each texel's points from its middle.
        """
        if not sweep.any:
            return 0
        self._pending_texel[self.kept :] = True
        moved = sweep.moved[rays.texels.instance]
        whole = moved | self._cut_near(rays, sweep, reach)
        whole |= len(sweep.taken) > MOST_PLACES
        skipped = whole[: self.kept] | self._pending.all(axis=1)
        moved_column = np.append(moved, np.zeros(self.nothing + 1 - self.count, np.bool_))

        def part(rows: slice) -> int:
            texel = np.arange(rows.start, rows.stop, dtype=np.int32)
            found = touched_rays(rays, sweep, texel, self._known(rows, ~skipped[rows], moved_column), reach)
            mark = np.empty((len(texel), self.target.shape[1]), np.bool_)
            mark[:, self._cosine_slots], mark[:, self._aimed_slots] = found.cosine, found.aimed
            self._pending[rows] |= mark
            self._pending_texel[rows] |= mark.any(axis=1)
            return found.tested

        tested = sum(self._workers.map_slices(part, self.kept, _even(self.kept, 4 * self.chunk, self._least)))
        of, number = self.beyond.touched(sweep)
        self._pending[of, self._cosine_slots[number]] = True
        self._pending_texel[of] = True
        self._pending[whole[: self.kept]] = True
        self._pending_texel |= whole
        return tested

    def at_stake(self, brightness: Float32, texel: Int32) -> Float32:
        """(k,) W/m² that the pending links of ``texel`` (k,), all of them kept, bring where each target sends
        ``brightness`` (m,) W/m²: about what their irradiance may change by."""
        seen = np.append(brightness, np.float32(0)).astype(np.float32)
        total = np.maximum(self.total[texel].sum(axis=1), 1e-30)
        out = np.zeros(len(texel), np.float32)

        def part(rows: slice) -> None:
            of = texel[rows]
            brought = self.weight[of] * seen.take(self.target[of]) * self._pending[of]
            out[rows] = brought.sum(axis=1) / total[rows]

        self._workers.map_slices(part, len(texel), self.chunk)
        return out

    def renew(self, rays: GatherRays, texel: Int32) -> GatherWork:
        """Trace the pending links of ``texel`` (m,)."""
        work = GatherWork(np.zeros(self.count, np.bool_))
        texel = texel[self._pending_texel[texel]]
        inside = texel[texel < self.kept]
        some = ~self._pending[inside].all(axis=1)
        grown = self._renew_rays(rays, inside[some], work)
        self._renew_texels(rays, np.concatenate([inside[~some], grown]), work)
        self._renew_texels(rays, texel[texel >= self.kept], work)
        work.changed[texel] = True
        self._pending[inside] = False
        self._pending_texel[texel] = False
        beyond = self.beyond.all
        self._set_pairs("beyond", self._surface[beyond.ray // self._cosine], self._surface_of_column[beyond.target])
        return work

    def _known(self, rows: slice, asked: Bool, moved_column: Bool) -> Kept:
        """What is stored of the rays of some texels; ``moved_column`` (m + 1,): targets that moved."""
        target, distance = self.target[rows], self._distance[rows]
        hit, aim = target.take(self._cosine_slots, axis=1), target.take(self._aimed_slots, axis=1)
        seen = self.weight[rows].take(self._aimed_slots, axis=1) > 0
        return Kept(
            asked=asked,
            hits_moved=moved_column.take(hit),
            hits_unknown=(hit == self.nothing) & np.isfinite(distance),
            distance=distance,
            seen=seen,
            hidden=(aim != self.nothing) & ~seen,
        )

    def _cut_near(self, rays: GatherRays, sweep: Sweep, reach: Float32) -> Bool:
        """(n,) texels that are cut through and that a place comes near to."""
        near = np.zeros(self.count, np.bool_)
        cut = np.nonzero(self._cut)[0]
        for place in sweep.places:
            away = rays.frame.position[cut] - place.centre.astype(np.float32)
            far = np.float32(place.radius) + 2 * reach[cut]
            near[cut[(away * away).sum(axis=1) <= far * far]] = True
        return near

    def _renew_rays(self, rays: GatherRays, texel: Int32, work: GatherWork) -> Int32:
        """Trace the pending links of ``texel``, whose others stay; texels of which another part may be open now."""
        if not len(texel):
            return texel
        pending = self._pending[texel]
        row, slot = np.divmod(np.flatnonzero(pending), pending.shape[1])
        links = texel[row], slot
        self.graph.remove(*self._pairs(*links))
        row, number = np.divmod(np.flatnonzero(pending[:, self._cosine_slots]), self._cosine)
        of, number = texel[row], number.astype(np.int32)
        beyond = []

        def cosine(rows: slice) -> tuple[int, Int32]:
            t, k = of[rows], number[rows]
            fan = rays.cosine(t, k)
            slot = self._cosine_slots[k]
            before = (self.target[t, slot] == self.nothing) & np.isfinite(self._distance[t, k])
            unknown = (fan.target == NO_TARGET) & np.isfinite(fan.hits.distance)
            self.target[t, slot] = self._column(fan.target)
            usable = self._opened[t, fan.start] & ~(fan.dark | fan.below)
            self.weight[t, slot] = np.where(usable, fan.weight, np.float32(0))
            self._distance[t, k] = fan.hits.distance
            found = rays.beyond(t, k, fan)
            beyond.append((rows.start, found))
            # Which part of a texel is open hangs on which rays end on dark sides.
            other = (before | unknown) if rays.see_through else before != unknown
            return len(t) + found.rays, t[other]

        done = self._workers.map_slices(cosine, len(of), _even(len(of), CHUNK_RAYS, LEAST_RAYS))
        work.traced += sum(d[0] for d in done)
        work.renewed += int(np.count_nonzero(pending))
        self.beyond.replace_rays(of, number, [b for _, b in sorted(beyond, key=lambda pair: pair[0])])
        if self._bright:
            work.traced += self._renew_aimed(rays, texel, pending)
        self.graph.add(*self._pairs(*links))
        self.total[texel] = _totals(self.weight[texel])
        return np.asarray(np.unique(np.concatenate([np.zeros(0, np.int32), *(d[1] for d in done)])))

    def _renew_aimed(self, rays: GatherRays, texel: Int32, pending: Bool) -> int:
        row, number = np.divmod(np.flatnonzero(pending[:, self._aimed_slots]), self._bright)
        of, number = texel[row], number.astype(np.int32)

        def aimed(rows: slice) -> int:
            t, k = of[rows], number[rows]
            found = rays.aimed(t, k)
            slot = self._aimed_slots[k]
            self.target[t, slot] = self._column(found.target)
            self.weight[t, slot] = np.where(self._opened[t, found.start], found.weight, np.float32(0))
            return found.cast

        return sum(self._workers.map_slices(aimed, len(of), _even(len(of), CHUNK_RAYS, LEAST_RAYS)))

    def _renew_texels(self, rays: GatherRays, texel: Int32, work: GatherWork) -> None:
        """Trace all links of ``texel``."""
        if not len(texel):
            return
        beyond, loose = [], []
        kept = texel[texel < self.kept]
        if self._filled:
            self.graph.remove(*self._pairs(kept))

        def part(rows: slice) -> int:
            of = texel[rows]
            traced = rays.trace(of)
            target, weight = self.rows(traced)
            self.free[of], self._cut[of], self._opened[of] = traced.free, traced.cut, traced.opened
            self.total[of] = _totals(weight)
            inside = of < self.kept
            at = of[inside]
            self.target[at], self.weight[at], self._distance[at] = (
                target[inside],
                weight[inside],
                traced.distance[inside],
            )
            if inside.all():
                beyond.append((rows.start, traced.beyond))
            else:
                loose.append(self._pairs_of_rows(of, target, weight, traced.beyond))
            return traced.rays

        work.traced += sum(self._workers.map_slices(part, len(texel), self.chunk_of(len(texel))))
        work.renewed += len(kept) * self.target.shape[1]
        self.graph.add(*self._pairs(kept))
        self._filled = True
        self.beyond.replace_texels(texel, [b for _, b in sorted(beyond, key=lambda pair: pair[0])])
        if loose:
            self._set_pairs("loose", *(np.concatenate(column) for column in zip(*loose, strict=True)))

    def _pairs_of_rows(self, texel: Int32, target: Int32, weight: Float32, beyond: Beyond) -> tuple[Int32, Int32]:
        """Each pair of surfaces once that links of ``texel`` (m,), which are not kept, lead from and to."""
        row = np.broadcast_to(self._surface[texel][:, None], target.shape)
        there = np.where(weight > 0, self._surface_of_column.take(target), np.int32(-1))
        row = np.concatenate([row.reshape(-1), self._surface[beyond.ray // self._cosine]])
        there = np.concatenate([there.reshape(-1), self._surface_of_column[beyond.target]])
        return _each_once(row, there, self.graph.surface_count)

    def _set_pairs(self, name: str, row: Int32, target: Int32) -> None:
        """Of links that are not counted in the graph, let it know which pairs of surfaces there are."""
        before = self._known_pairs.get(name)
        if before is None and not len(row):
            return
        if before is not None:
            self.graph.remove(*before)
        self._known_pairs[name] = _each_once(row, target, self.graph.surface_count)
        self.graph.add(*self._known_pairs[name])

    def rows(self, traced: TracedTexels) -> tuple[Int32, Float32]:
        """((m, K), (m, K)) target and weight of traced texels, as kept."""
        order = np.argsort(np.concatenate([self._cosine_slots, self._aimed_slots]))
        target = self._column(traced.target[:, order])
        return target, np.where(traced.usable, traced.weight, np.float32(0))[:, order]

    @property
    def chunk(self) -> int:
        """Texels worked on at a time."""
        return max(1, CHUNK_RAYS // self.target.shape[1])

    @property
    def _least(self) -> int:
        return max(1, LEAST_RAYS // self.target.shape[1])

    def chunk_of(self, texels: int) -> int:
        """:attr:`chunk`, or less where that would leave threads without work."""
        return _even(texels, self.chunk, self._least)

    def _column(self, target: Int32) -> Int32:
        return np.where(target == NO_TARGET, np.int32(self.nothing), target)

    def _pairs(self, texel: Int32, slot: NDArray[np.int64] | None = None) -> tuple[Int32, Int32]:
        """Surfaces that links lead from and to, for the graph; all links of ``texel`` (m,), or each one's ``slot``."""
        row = self._surface[texel] if slot is not None else self._surface[texel][:, None]
        at = texel if slot is None else (texel, slot)
        target = self._surface_of_column.take(self.target[at])
        return row, np.where(self.weight[at] > 0, target, np.int32(-1))


def _each_once(row: Int32, target: Int32, count: int) -> tuple[Int32, Int32]:
    """Every pair with a target (not -1) once."""
    key = np.unique(row[target >= 0].astype(np.int64) * count + target[target >= 0])
    return (key // count).astype(np.int32), (key % count).astype(np.int32)


def _even(total: int, most: int, least: int) -> int:
    """Items worked on at a time, so that PARTS threads have as much to do, but ``least`` at least and ``most`` at most.

    No result hangs on it.
    """
    parts = -(-total // (most * PARTS)) * PARTS
    return max(1, -(-total // max(1, min(parts, total // least))))


def _totals(weight: Float32) -> Float64:
    """(m, 2) sums of both halves of each row (m, K); in rows of their own, so that they do not hang on each other."""
    halves = weight.reshape(len(weight), 2, -1).astype(np.float64)
    return np.asarray(np.add.reduce(halves, axis=2))


def _slots(cosine: int, bright: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """((cosine,), (bright,)) slot of each ray: the first half of both kinds, then the second."""
    c, b = np.arange(cosine), np.arange(bright)
    return np.where(c < cosine // 2, c, c + bright // 2), np.where(b < bright // 2, b + cosine // 2, b + cosine)
