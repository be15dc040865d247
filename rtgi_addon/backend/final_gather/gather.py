# SPDX-License-Identifier: GPL-3.0-or-later
"""The rays of a final gather: where each ends, and how much what is there counts.

Each texel sends ``cosine`` rays that follow the cosine and ``bright`` ones aimed at bright targets. A target is a
texel or a patch of sky. A ray's weight is the balance heuristic's (Veach and Guibas 1995): with p_c = cosθ/π and
p_b the density of the aimed samples at the same direction, every sample weighs p_c / (n_c p_c + n_b p_b), whichever
way it was made; so weights are bounded by 1/n_c and the irradiance is the plain sum of weight times radiosity.
Behind a mirror, glass or a see-through surface only cosine rays go on; what they find weighs throughput / n_c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..lamps.sky import Sky
from ..photon.scatter import ABSORBED, Surfaces, scatter
from ..sampling import frames, hash_keys, unit_float32
from ..scene import Bool, Float32, Float64, Int32
from ..settings import SampleCounts
from ..surface.geometry import Geometry
from ..surface.rasterise import POINTS
from ..surface.texels import BACK, TexelFrame, Texels
from ..surface.tracing import Hits, Tracer
from .bright import BrightTargets
from .patterns import bright_patterns, cosine_patterns, pattern_of_texels

NO_TARGET = -1


@dataclass(frozen=True)
class TracedLinks:
    """Links of m texels, K rays each, cosine rays first; and of their rays' ways on behind mirrors."""

    first: int  # number of the first texel
    target: Int32  # (m, K)
    weight: Float32  # (m, K)
    usable: Bool  # (m, K) False: the ray starts inside geometry, or leaves below the surface
    free: Float32  # (m,) share of the cosine rays from the texel's open part that do not end on a dark side
    beyond_row: Int32  # (b,) texel
    beyond_target: Int32  # (b,)
    beyond_weight: Float32  # (b, 3)
    rays: int


@dataclass(frozen=True)
class _Fan:
    """The cosine rays of m texels, c each."""

    start: Int32  # (m, c) which of the texel's points
    directions: Float32  # (m, c, 3)
    target: Int32  # (m, c)
    weight: Float32  # (m, c)
    dark: Bool  # (m, c) ended on a side without a map
    below: Bool  # (m, c) leaves below the texel's own triangle


class GatherRays:
    """Traces links of any range of texels; holds what all ranges share."""

    def __init__(
        self, texels: Texels, frame: TexelFrame, geometry: Geometry, surfaces: Surfaces, tracer: Tracer,
        sky: Sky | None, bright: BrightTargets, samples: SampleCounts, *, max_specular: int, seed: int,
    ) -> None:  # fmt: skip
        self._texels, self._frame, self._geometry, self._tracer = texels, frame, geometry, tracer
        self._surfaces, self._max_specular = surfaces, max_specular
        self._sky, self._samples, self._seed = sky, samples, seed
        self._see_through = bool(surfaces.passes.any())
        self._n_bright = samples.bright if bright.any else 0
        self._bright = bright
        # Density of aimed samples per solid angle: probability / area · distance² / cosine at the target.
        count = texels.count
        area = np.maximum(frame.area, np.finfo(np.float32).tiny)
        self._density = np.concatenate(
            [bright.probability[:count] / area, bright.probability[count:] / (sky.solid_angle if sky else 1)]
        ).astype(np.float32)
        self._tangents = frames(frame.normal)
        self._aim_points, self._aim_normals, self._aim_targets = self._aims()

    def trace(self, first: int, stop: int) -> TracedLinks:
        """The links of texels first..stop-1."""
        rows = slice(first, stop)
        t = self._texels
        pattern = pattern_of_texels(t.page[rows], t.row[rows], t.col[rows], self._seed)
        fan, hits = self._cosine(rows, pattern)
        opened, tested = self._open_points(rows, fan)
        from_open = np.take_along_axis(opened, fan.start, axis=1)
        usable = ~(fan.dark | fan.below) & from_open
        free = (from_open & ~fan.dark).sum(axis=1) / np.maximum(from_open.sum(axis=1), 1)
        target, weight, rays = fan.target, fan.weight, fan.target.size + tested
        if self._n_bright:
            start, aim, aimed, cast = self._aimed(rows, pattern)
            target, weight = np.concatenate([target, aim], axis=1), np.concatenate([weight, aimed], axis=1)
            usable = np.concatenate([usable, np.take_along_axis(opened, start, axis=1)], axis=1)
            rays += cast
        row, beyond, throughput, cast = self._beyond(first, hits, fan.target.reshape(-1), fan.directions.reshape(-1, 3))
        return TracedLinks(
            first, target, weight, usable, free.astype(np.float32), row, beyond, throughput, rays + cast
        )  # fmt: skip

    def _open_points(self, rows: slice, fan: _Fan) -> tuple[Bool, int]:
        """((m, POINTS) which points belong to the texel's open part, rays cast).

        A texel that another surface cuts through has points on both its sides; those behind it see the void or dark
        sides. Points that cannot see each other along the surface lie on different sides; the side whose rays end on
        dark sides least is the open one.
        """
        opened = np.ones((len(fan.dark), POINTS), np.bool_)
        cut = np.nonzero(fan.dark.any(axis=1))[0]
        if not len(cut):
            return opened, 0
        of_point = fan.start[cut][:, :, None] == np.arange(POINTS)  # (k, c, POINTS)
        dark = (of_point & fan.dark[cut][:, :, None]).sum(axis=1)
        cast = np.maximum(of_point.sum(axis=1), 1)
        anchor = np.argmin(dark / cast, axis=1)
        points = self._frame.points[rows][cut]
        origins = np.repeat(points[np.arange(len(cut)), anchor], POINTS, axis=0)
        ways = points.reshape(-1, 3) - origins
        hidden = self._tracer.occluded(origins, ways, np.ones(len(ways), np.float32)).reshape(-1, POINTS)

        def darkness(chosen: Bool) -> Float64:
            return np.asarray((dark * chosen).sum(axis=1) / np.maximum((cast * chosen).sum(axis=1), 1))

        other_side = (darkness(hidden) < darkness(~hidden)) & hidden.any(axis=1)
        opened[cut] = np.where(other_side[:, None], hidden, ~hidden)
        return opened, len(ways)

    def _starts(self, rows: slice, start: Int32) -> Float32:
        """(m, c, 3) ray origins: the points ``start`` (m, c) of each texel."""
        number = start + (np.arange(rows.start, rows.stop, dtype=np.int32) * np.int32(POINTS))[:, None]
        return self._frame.points.reshape(-1, 3).take(number, axis=0)

    def _cosine(self, rows: slice, pattern: Int32) -> tuple[_Fan, Hits]:
        table = cosine_patterns(self._samples.cosine, self._seed)
        local = table.directions[pattern]  # (m, c, 3)
        axes = np.stack([self._tangents[0][rows], self._tangents[1][rows], self._frame.normal[rows]], axis=1)
        directions = np.matmul(local, axes)  # (m, c, 3)
        origins = self._starts(rows, table.start[pattern])
        shape = local.shape[:2]
        flat_directions = directions.reshape(-1, 3)
        hits = self._tracer.intersect(origins.reshape(-1, 3), flat_directions)
        escaped = hits.triangle < 0
        target = self._targets(hits, flat_directions)
        dark_side = (target < 0) & ~escaped
        if self._see_through:
            dark_side &= ~self._goes_on(hits.triangle)
        per_area = hits.distance * hits.distance / np.maximum(np.abs(hits.cosine), np.float32(1e-6))
        density = self._density.take(target, mode="clip") * np.where(escaped, np.float32(1), per_area)
        density[target < 0] = 0
        cosine = np.maximum(local[:, :, 2], np.float32(1e-6))
        n_c, n_b = np.float32(self._samples.cosine), np.float32(self._n_bright)
        weight = 1 / (n_c + n_b * np.float32(np.pi) * density.reshape(shape) / cosine)
        below = np.einsum("mcj,mj->mc", directions, self._frame.geometric_normal[rows]) <= 0
        fan = _Fan(
            table.start[pattern], directions, target.reshape(shape), weight, dark_side.reshape(shape), np.asarray(below)
        )
        return fan, hits

    def _aimed(self, rows: slice, pattern: Int32) -> tuple[Int32, Int32, Float32, int]:
        """((m, b) start point, (m, b) target, (m, b) weight, rays cast) of the aimed samples."""
        table = bright_patterns(self._samples.bright, self._seed)
        target = self._aim_targets[pattern]  # (m, b)
        is_sky = target >= self._texels.count
        origins = self._starts(rows, table.start[pattern])
        ways = self._aim_points[pattern] - np.where(is_sky[:, :, None], np.float32(0), origins)
        distance2 = np.einsum("mbj,mbj->mb", ways, ways)
        distance = np.sqrt(np.maximum(distance2, np.finfo(np.float32).tiny))
        cos_here = np.einsum("mbj,mj->mb", ways, self._frame.normal[rows]) / distance
        above = np.einsum("mbj,mj->mb", ways, self._frame.geometric_normal[rows]) > 0
        cos_there = -np.einsum("mbj,mbj->mb", ways, self._aim_normals[pattern]) / distance
        seen = (cos_here > 0) & above & (is_sky | (cos_there > 1e-6))
        density = self._density[target] * np.where(is_sky, np.float32(1), distance2 / np.maximum(cos_there, 1e-6))
        n_c, n_b = np.float32(self._samples.cosine), np.float32(self._samples.bright)
        p_c = cos_here * np.float32(1 / np.pi)
        weight = np.where(seen, p_c / np.maximum(n_c * p_c + n_b * density, np.finfo(np.float32).tiny), 0)
        at = np.nonzero(seen.reshape(-1))[0]
        ends = np.where(is_sky, np.float32(np.inf), np.float32(1)).reshape(-1)[at]
        hidden = self._tracer.occluded(origins.reshape(-1, 3)[at], ways.reshape(-1, 3)[at], ends)
        weight.reshape(-1)[at[hidden]] = 0
        return table.start[pattern], target, weight.astype(np.float32), len(at)

    def _beyond(self, first: int, hits: Hits, target: Int32, directions: Float32) -> tuple[Int32, Int32, Float32, int]:
        """((b,) texel, (b,) target, (b, 3) weight, rays): where rays go on from surfaces that pass them."""
        none = np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32), 0
        if not self._see_through or self._max_specular == 0:
            return none
        ray = np.nonzero(self._goes_on(hits.triangle))[0]
        hits, target, directions = hits.take(ray), target[ray], directions[ray]
        throughput = np.full((len(ray), 3), 1 / self._samples.cosine, np.float32)
        found, cast = [], 0
        for depth in range(self._max_specular):
            if not len(ray):
                break
            keys = [hash_keys(ray + first * self._samples.cosine, depth, k, self._seed) for k in range(3)]
            position = self._geometry.points(hits.triangle, hits.u, hits.v)
            numbers = [unit_float32(k) for k in keys]
            after = scatter(self._surfaces, hits, target, position, directions, throughput, numbers, diffuse=False)
            on = np.nonzero(after.kind != ABSORBED)[0]
            ray, throughput, directions = ray[on], after.flux[on], after.direction[on]
            hits = self._tracer.intersect(np.ascontiguousarray(after.origin[on]), np.ascontiguousarray(directions))
            cast += len(ray)
            target = self._targets(hits, directions)
            row = (ray // self._samples.cosine + first).astype(np.int32)
            ends = target != NO_TARGET
            found.append((row[ends], target[ends], throughput[ends]))
            goes_on = np.nonzero(self._goes_on(hits.triangle))[0]
            ray, throughput, directions = ray[goes_on], throughput[goes_on], directions[goes_on]
            target, hits = target[goes_on], hits.take(goes_on)
        if not found:
            return none
        row, ended, weight = (np.concatenate(column) for column in zip(*found, strict=True))
        return row, ended, weight, cast

    def _goes_on(self, triangle: Int32) -> Bool:
        material = self._surfaces.material_of_triangle.take(triangle, mode="clip")
        return np.asarray(self._surfaces.passes.take(material) & (triangle >= 0))

    def _targets(self, hits: Hits, directions: Float32) -> Int32:
        """(r,) the target each ray ended on, texel or sky patch, or NO_TARGET."""
        target = self._texels.of_hits(hits.triangle, hits.u, hits.v, hits.back)
        if self._sky is not None:
            escaped = hits.triangle < 0
            target[escaped] = self._texels.count + self._sky.of_directions(directions[escaped])
        return target

    def _aims(self) -> tuple[Float32, Float32, Int32]:
        """Per pattern: (P, b, 3) point on the target, lifted (or direction to the sky), (P, b, 3) its normal,
        (P, b) the target."""
        table = bright_patterns(self._samples.bright, self._seed)
        shape = table.choice.shape
        target = np.searchsorted(self._bright.cdf, table.choice.reshape(-1), side="right") - 1
        target = np.clip(target, 0, max(len(self._bright.probability) - 1, 0)).astype(np.int32)
        points, normals = np.zeros((len(target), 3), np.float32), np.zeros((len(target), 3), np.float32)
        solid = (target < self._texels.count) & self._bright.any
        t, on = target[solid], (table.target.reshape(-1, 2)[solid, 0] * POINTS).astype(np.int64)
        points[solid] = self._frame.points[t, on]
        facing = np.where(self._texels.side[t] == BACK, np.float32(-1), np.float32(1))
        normals[solid] = self._geometry.normals[self._texels.point_triangle[t, on]] * facing[:, None]
        if self._sky is not None and self._bright.any:
            on_sky = table.target.reshape(-1, 2)[~solid]
            patch = target[~solid] - self._texels.count
            points[~solid] = self._sky.directions(patch, on_sky[:, 0], on_sky[:, 1])
        return points.reshape(*shape, 3), normals.reshape(*shape, 3), target.reshape(shape)
