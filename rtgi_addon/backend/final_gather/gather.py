# SPDX-License-Identifier: GPL-3.0-or-later
"""The rays of a final gather: where each ends, and how much what is there counts.

Each texel sends ``cosine`` rays that follow the cosine and ``bright`` ones aimed at bright targets. A target is a
texel or a patch of sky. A ray's weight is the balance heuristic's (Veach and Guibas 1995): with p_c = cosθ/π and
p_b the density of the aimed samples at the same direction, every sample weighs p_c / (n_c p_c + n_b p_b), whichever
way it was made; so weights are bounded by 1/n_c and the irradiance is the plain sum of weight times radiosity.
Behind a mirror, glass or a see-through surface only cosine rays go on; what they find weighs throughput / n_c.

A ray hangs on (texel, number) and the frame's geometry alone, and every formula is written out element by element: any
of them traced by itself gives the same bits as all together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lamps.sky import Sky
from ..sampling import dot, frames, hash_keys, unit_float32
from ..scene import Bool, Float32, Float64, Int32
from ..settings import SampleCounts
from ..surface.geometry import Geometry
from ..surface.rasterise import POINTS
from ..surface.scatter import ABSORBED, Surfaces, scatter
from ..surface.texels import TexelFrame, Texels
from ..surface.tracing import FREE, WALL, Hits, Tracer
from .aims import Aims, density_on_texels, follow_aims, place_aims, target_density
from .bright import BrightTargets
from .patterns import PATTERNS, bright_patterns, cosine_patterns, pattern_of_texels

NO_TARGET = -1


@dataclass(frozen=True)
class CosineRays:
    """r rays that follow the cosine. Directions are unit, distances m."""

    start: Int32  # (r,) which of the texel's points
    origin: Float32  # (r, 3)
    direction: Float32  # (r, 3)
    hits: Hits
    target: Int32  # (r,)
    weight: Float32  # (r,)
    dark: Bool  # (r,) ended on a side without a map
    below: Bool  # (r,) leaves below the texel's own triangle


@dataclass(frozen=True)
class AimedRays:
    """r samples aimed at bright targets. A direction's length is the distance; the sky's are unit."""

    start: Int32  # (r,)
    target: Int32  # (r,) NO_TARGET where it faces away, or where a wall hides it that no moving object can lift
    weight: Float32  # (r,) zero there, and where what moves hides it
    cast: int  # rays traced


@dataclass(frozen=True)
class Beyond:
    """Where b rays' ways end behind mirrors and glass, and the s segments of those ways; ray = texel * cosine + number.

    Sorted by ray, then along its way.
    """

    ray: NDArray[np.int64]  # (b,)
    target: Int32  # (b,)
    weight: Float32  # (b, 3)
    segment_ray: NDArray[np.int64]  # (s,)
    origin: Float32  # (s, 3)
    direction: Float32  # (s, 3) unit
    distance: Float32  # (s,) m, inf where it escaped

    @property
    def rays(self) -> int:
        """Rays traced."""
        return len(self.segment_ray)


@dataclass(frozen=True)
class TracedTexels:
    """All rays of m texels, K each, cosine rays first."""

    target: Int32  # (m, K)
    weight: Float32  # (m, K)
    usable: Bool  # (m, K) False: the ray starts inside geometry, or leaves below the surface
    opened: Bool  # (m, POINTS) False: the point lies inside geometry
    distance: Float32  # (m, cosine) inf where a ray escaped
    cut: Bool  # (m,) some ray ended on a dark side: another surface may cut through the texel
    free: Float32  # (m,) share of the cosine rays from the texel's open part that do not end on a dark side
    beyond: Beyond
    rays: int


class GatherRays:
    """Traces gather rays of any texels, or any rays of them, in one frame; holds what all share."""

    def __init__(
        self, texels: Texels, frame: TexelFrame, geometry: Geometry, surfaces: Surfaces, tracer: Tracer,
        sky: Sky | None, bright: BrightTargets, samples: SampleCounts, *, max_specular: int, seed: int,
    ) -> None:  # fmt: skip
        self.texels, self.frame, self.geometry = texels, frame, geometry
        self.target_count = texels.count + (sky.count if sky else 0)
        self.n_cosine, self.n_bright = samples.cosine, samples.bright if bright.any else 0
        self._tracer, self._surfaces, self._sky = tracer, surfaces, sky
        self._max_specular, self._seed = max_specular, seed
        self.see_through = bool(surfaces.passes.any())
        self._bright, self._density = bright, target_density(bright, frame.area, sky)
        self._first_density = bright.room * np.int32(self.target_count)  # (n,) of each texel's room
        tangent, bitangent = frames(frame.normal)
        self.axes = [np.ascontiguousarray(a.T) for a in (tangent, bitangent, frame.normal)]  # (3, n) each
        self.pattern = pattern_of_texels(texels.page, texels.row, texels.col, seed)
        self.aim_pattern = bright.room * np.int32(PATTERNS) + self.pattern
        self.cosine_table = cosine_patterns(samples.cosine, seed)
        self.bright_table = bright_patterns(samples.bright, seed) if self.n_bright else None
        self.aims: Aims | None = None
        if self.bright_table is not None:
            self.aims = place_aims(self.bright_table, bright, texels, frame, geometry, sky)

    def follow(self, moved: Bool, surfaces: Surfaces) -> None:
        """Bring all to the frame that the scene stands in now; only the texels ``moved`` (n,) are not where they were.

        The same bits as a new one would have. The sky must have the patches it had.
        """
        self._surfaces, self.see_through = surfaces, bool(surfaces.passes.any())
        rows = np.nonzero(moved)[0]
        if not len(rows):
            return
        normal = self.frame.normal[rows]
        for mine, now in zip(self.axes, (*frames(normal), normal), strict=True):
            mine[:, rows] = now.T
        self._density[:, rows] = density_on_texels(self._bright.probability[:, rows], self.frame.area[rows])
        if self.aims is not None:
            at_moved = np.nonzero(~self.aims.is_sky & np.append(moved, False).take(self.aims.target, mode="clip"))[0]
            follow_aims(self.aims, at_moved, self._bright, self.texels, self.frame, self.geometry)

    def trace(self, texel: Int32) -> TracedTexels:
        """All rays of the texels (m,)."""
        count = len(texel)
        fan = self.cosine(*_all_rays(texel, self.n_cosine))
        start = fan.start.reshape(count, -1)
        dark, below = fan.dark.reshape(count, -1), fan.below.reshape(count, -1)
        opened, tested = self._open_points(texel, start, dark)
        from_open = np.take_along_axis(opened, start, axis=1)
        usable = ~(dark | below) & from_open
        free = (from_open & ~dark).sum(axis=1) / np.maximum(from_open.sum(axis=1), 1)
        target, weight = fan.target.reshape(count, -1), fan.weight.reshape(count, -1)
        rays = fan.target.size + tested
        if self.n_bright:
            aimed = self.aimed(*_all_rays(texel, self.n_bright))
            target = np.concatenate([target, aimed.target.reshape(count, -1)], axis=1)
            weight = np.concatenate([weight, aimed.weight.reshape(count, -1)], axis=1)
            reached = np.take_along_axis(opened, aimed.start.reshape(count, -1), axis=1)
            usable = np.concatenate([usable, reached], axis=1)
            rays += aimed.cast
        beyond = self.beyond(*_all_rays(texel, self.n_cosine), fan)
        distance = fan.hits.distance.reshape(count, -1)
        return TracedTexels(
            target,
            weight,
            usable,
            opened,
            distance,
            dark.any(axis=1),
            free.astype(np.float32),
            beyond,
            rays + beyond.rays,
        )

    def cosine_segments(self, texel: Int32, number: Int32) -> tuple[Int32, Float32, Float32]:
        """((r,), (r, 3), (r, 3)) start point, origin and unit direction of cosine rays ``number`` (r,) of ``texel``."""
        at = self.pattern.take(texel) * np.int32(self.n_cosine) + number
        start = self.cosine_table.start.reshape(-1).take(at)
        x, y, z = (table.reshape(-1).take(at) for table in self.cosine_table.directions)
        directions = np.empty((len(at), 3), np.float32)
        for k, (t, b, n) in enumerate(zip(*self.axes, strict=True)):
            directions[:, k] = x * t.take(texel) + y * b.take(texel) + z * n.take(texel)
        return start, self._starts(texel, start), directions

    def cosine(self, texel: Int32, number: Int32) -> CosineRays:
        """Cosine rays ``number`` (r,) of ``texel`` (r,), traced."""
        start, origins, directions = self.cosine_segments(texel, number)
        hits = self._tracer.intersect(origins, directions)
        escaped = hits.triangle < 0
        target = self._targets(hits, directions)
        dark = (target < 0) & ~escaped
        if self.see_through:
            dark &= ~self._goes_on(hits.triangle)
        weight = np.full(len(texel), 1 / np.float32(self.n_cosine), np.float32)
        if self.n_bright:
            per_area = hits.distance * hits.distance / np.maximum(np.abs(hits.cosine), np.float32(1e-6))
            density = self._density.reshape(-1).take(self._first_density.take(texel) + target, mode="clip")
            with np.errstate(over="ignore"):  # on a texel of next to no area
                density *= np.where(escaped, np.float32(1), per_area)
            density[target < 0] = 0
            at = self.pattern.take(texel) * np.int32(self.n_cosine) + number
            cosine = np.maximum(self.cosine_table.directions[2].reshape(-1).take(at), np.float32(1e-6))
            n_c, n_b = np.float32(self.n_cosine), np.float32(self.n_bright)
            with np.errstate(over="ignore"):  # of a target so far away that a ray that finds it weighs nothing
                weight = np.asarray(1 / (n_c + n_b * np.float32(np.pi) * density / cosine), np.float32)
        below = dot(directions, self.frame.geometric_normal.take(texel, axis=0)) <= 0
        return CosineRays(start, origins, directions, hits, target, weight, dark, np.asarray(below))

    def aimed_segments(self, texel: Int32, number: Int32) -> tuple[NDArray[np.int64], Int32, Float32, Float32]:
        """((r,) row of the aims, (r,) start point, (r, 3) origin, (r, 3) way to the aim) of aimed samples."""
        assert self.bright_table is not None and self.aims is not None
        at = self.aim_pattern.take(texel).astype(np.int64) * self.n_bright + number
        start = self.bright_table.start.reshape(-1).take(self.pattern.take(texel) * np.int32(self.n_bright) + number)
        origins = self._starts(texel, start)
        ways = self.aims.point.take(at, axis=0)
        if self._sky is None:
            ways -= origins
        else:
            ways -= np.where(self.aims.is_sky.take(at)[:, None], np.float32(0), origins)
        return at, start, origins, ways

    def aimed(self, texel: Int32, number: Int32) -> AimedRays:
        """Aimed samples ``number`` (r,) of ``texel`` (r,), traced."""
        assert self.aims is not None
        at, start, origins, ways = self.aimed_segments(texel, number)
        is_sky = self.aims.is_sky.take(at)
        distance2 = dot(ways, ways)
        distance = np.sqrt(np.maximum(distance2, np.finfo(np.float32).tiny))
        cos_here = dot(ways, self.frame.normal.take(texel, axis=0)) / distance
        above = dot(ways, self.frame.geometric_normal.take(texel, axis=0)) > 0
        cos_there = -dot(ways, self.aims.normal.take(at, axis=0)) / distance
        seen = (cos_here > 0) & above & (is_sky | (cos_there > 1e-6))
        per_area = np.where(is_sky, np.float32(1), distance2 / np.maximum(cos_there, np.float32(1e-6)))
        n_c, n_b = np.float32(self.n_cosine), np.float32(self.n_bright)
        p_c = cos_here * np.float32(1 / np.pi)
        with np.errstate(over="ignore"):  # on a texel of next to no area, whose samples then weigh nothing
            density = self.aims.density.take(at) * per_area
            weight = np.where(seen, p_c / np.maximum(n_c * p_c + n_b * density, np.finfo(np.float32).tiny), 0)
        rows = np.nonzero(seen)[0]
        ends = np.where(is_sky, np.float32(np.inf), np.float32(1))[rows]
        blocked = self._tracer.blocked(origins[rows], ways[rows], ends)
        weight[rows[blocked != FREE]] = 0
        target = self.aims.target.take(at)
        lost = ~seen
        lost[rows[blocked == WALL]] = True
        target[lost] = NO_TARGET
        return AimedRays(start, target, weight.astype(np.float32), len(rows))

    def beyond(self, texel: Int32, number: Int32, fan: CosineRays) -> Beyond:
        """Where those of the ``fan``'s rays go on that met surfaces which pass them."""
        kept: list[tuple[NDArray[Any], ...]] = []
        segments: list[tuple[NDArray[Any], ...]] = []
        on = np.zeros(0, np.int64)
        if self.see_through and self._max_specular > 0:
            on = np.nonzero(self._goes_on(fan.hits.triangle))[0]
        ray = texel[on].astype(np.int64) * self.n_cosine + number[on]
        hits, target, directions = fan.hits.take(on), fan.target[on], fan.direction[on]
        throughput = np.full((len(ray), 3), 1 / self.n_cosine, np.float32)
        for depth in range(self._max_specular):
            if not len(ray):
                break
            numbers = [unit_float32(hash_keys(ray, depth, k, self._seed)) for k in range(3)]
            position = self.geometry.points(hits.triangle, hits.u, hits.v)
            after = scatter(self._surfaces, hits, target, position, directions, throughput, numbers, diffuse=False)
            on = np.nonzero(after.kind != ABSORBED)[0]
            ray, throughput, directions = ray[on], after.flux[on], np.ascontiguousarray(after.direction[on])
            origins = np.ascontiguousarray(after.origin[on])
            hits = self._tracer.intersect(origins, directions)
            segments.append((ray, origins, directions, hits.distance))
            target = self._targets(hits, directions)
            ends = target != NO_TARGET
            kept.append((ray[ends], target[ends], throughput[ends]))
            on = np.nonzero(self._goes_on(hits.triangle))[0]
            ray, throughput, directions = ray[on], throughput[on], directions[on]
            target, hits = target[on], hits.take(on)
        return _sorted_beyond(kept, segments)

    def _open_points(self, texel: Int32, start: Int32, dark: Bool) -> tuple[Bool, int]:
        """((m, POINTS) which points belong to the texel's open part, rays cast); start, dark (m, cosine).

        A texel that another surface cuts through has points on both its sides; those behind it see the void or dark
        sides. Points that cannot see each other along the surface lie on different sides; the side whose rays end on
        dark sides least is the open one.
        """
        opened = np.ones((len(dark), POINTS), np.bool_)
        cut = np.nonzero(dark.any(axis=1))[0]
        if not len(cut):
            return opened, 0
        of_point = start[cut][:, :, None] == np.arange(POINTS)  # (k, c, POINTS)
        lost = (of_point & dark[cut][:, :, None]).sum(axis=1)
        cast = np.maximum(of_point.sum(axis=1), 1)
        anchor = np.argmin(lost / cast, axis=1)
        points = self.frame.points[texel[cut]]
        origins = np.repeat(points[np.arange(len(cut)), anchor], POINTS, axis=0)
        ways = points.reshape(-1, 3) - origins
        hidden = self._tracer.occluded(origins, ways, np.ones(len(ways), np.float32)).reshape(-1, POINTS)

        def darkness(chosen: Bool) -> Float64:
            return np.asarray((lost * chosen).sum(axis=1) / np.maximum((cast * chosen).sum(axis=1), 1))

        other_side = (darkness(hidden) < darkness(~hidden)) & hidden.any(axis=1)
        opened[cut] = np.where(other_side[:, None], hidden, ~hidden)
        return opened, len(ways)

    def _starts(self, texel: Int32, start: Int32) -> Float32:
        """(r, 3) ray origins: the points ``start`` (r,) of ``texel`` (r,)."""
        return self.frame.points.reshape(-1, 3).take(texel.astype(np.int64) * POINTS + start, axis=0)

    def _goes_on(self, triangle: Int32) -> Bool:
        material = self._surfaces.material_of_triangle.take(triangle, mode="clip")
        return np.asarray(self._surfaces.passes.take(material) & (triangle >= 0))

    def _targets(self, hits: Hits, directions: Float32) -> Int32:
        """(r,) the target each ray ended on, texel or sky patch, or NO_TARGET."""
        target = self.texels.of_hits(hits.triangle, hits.u, hits.v, hits.back)
        if self._sky is not None:
            escaped = hits.triangle < 0
            target[escaped] = self.texels.count + self._sky.of_directions(directions[escaped])
        return target


def _all_rays(texel: Int32, count: int) -> tuple[Int32, Int32]:
    """((m count,), (m count,)) texel and number of all rays of ``texel`` (m,)."""
    return np.repeat(texel, count), np.tile(np.arange(count, dtype=np.int32), len(texel))


def _sorted_beyond(kept: list[tuple[NDArray[Any], ...]], segments: list[tuple[NDArray[Any], ...]]) -> Beyond:
    none = np.zeros(0, np.int64), np.zeros((0, 3), np.float32)
    ray, target, weight = _joined(kept, (none[0], np.zeros(0, np.int32), none[1]))
    segment_ray, origin, direction, distance = _joined(segments, (none[0], none[1], none[1], np.zeros(0, np.float32)))
    ends, ways = np.argsort(ray, kind="stable"), np.argsort(segment_ray, kind="stable")
    return Beyond(
        ray[ends], target[ends], weight[ends], segment_ray[ways], origin[ways], direction[ways], distance[ways]
    )


def _joined(parts: list[tuple[NDArray[Any], ...]], empty: tuple[NDArray[Any], ...]) -> list[NDArray[Any]]:
    return [np.concatenate([column, *(p[k] for p in parts)]) for k, column in enumerate(empty)]
