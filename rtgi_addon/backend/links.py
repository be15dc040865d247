# SPDX-License-Identifier: GPL-3.0-or-later
"""Links: the rays of a final gather, kept as a sparse matrix from the radiosity of targets to irradiance.

Each texel sends ``cosine`` rays that follow the cosine and ``bright`` ones aimed at bright targets. A target is a
texel or a patch of sky. A link's weight is the balance heuristic's (Veach and Guibas 1995): with p_c = cosθ/π and
p_b the density of the aimed samples at the same direction, every sample weighs p_c / (n_c p_c + n_b p_b), whichever
way it was made; so weights are bounded by 1/n_c and the irradiance is the plain sum of weight times radiosity.

Since ∫ p_c = 1 the weights of a texel's rays, escaped ones included, must sum to one; each row is divided by its sum
(a ratio estimator: exact for a uniform field, and free of the noise in the sum).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from .geometry import Geometry
from .parallel import CHUNK_RAYS, Workers
from .patterns import bright_patterns, cosine_patterns, pattern_of_texels
from .sampling import frames
from .scene import Bool, Float32, Float64, Int32
from .settings import SampleCounts
from .sky import Sky
from .texels import TexelFrame, Texels
from .tracing import Tracer

NO_TARGET = -1
#: A texel most of whose rays start inside other geometry is under it: not valid, filled from its neighbours.
LEAST_FREE_SHARE = 0.25


@dataclass(frozen=True)
class BrightTargets:
    """What aimed samples choose from: the probability of each of the m targets."""

    probability: Float32  # (m,) sums to one
    cdf: Float64  # (m + 1,)

    @property
    def any(self) -> bool:
        return bool(self.cdf[-1] > 0)


@dataclass(frozen=True)
class Links:
    """n texels' links to m targets (texels first, then sky patches)."""

    matrix: sparse.csr_matrix  # (n, m) float32, rows sum to the share of rays that ended on a target
    halves: tuple[sparse.csr_matrix, sparse.csr_matrix]  # the matrix from either half of the rays alone
    valid: Bool  # (n,) False: the texel lies under other geometry
    rays: int

    def irradiance(self, radiosity: Float32) -> Float32:
        """(n, 3) W/m² from the radiosity (m, 3) of all targets."""
        return np.asarray(self.matrix @ radiosity, np.float32)


def bright_targets(radiosity: Float32, area: Float32, sky: Sky | None, extent: float) -> BrightTargets:
    """Odds by expected share of a receiver's irradiance: B A for texels, π L Ω (D/4)² for sky.

    radiosity (n + sky.count, 3) W/m² · area (n,) m² · extent: the scene's diagonal D; its quarter stands for the
    distance of a typical target.
    """
    luminance = radiosity.astype(np.float64).sum(axis=1)
    weight = np.zeros(len(radiosity))
    count = len(area)
    weight[:count] = luminance[:count] * area
    if sky is not None and sky.count > 1:
        # A sky of one colour is best sampled by the cosine rays alone.
        weight[count:] = luminance[count:] * sky.solid_angle * (extent / 4) ** 2
    total = weight.sum()
    if not total > 0:
        return BrightTargets(np.zeros(len(weight), np.float32), np.zeros(len(weight) + 1))
    cdf = np.concatenate([[0.0], np.cumsum(weight) / total])
    cdf[1:][cdf[1:] == cdf[-1]] = 1.0
    return BrightTargets((weight / total).astype(np.float32), cdf)


class LinkTracer:
    """Traces links of any range of texels; holds what all ranges share."""

    def __init__(
        self, texels: Texels, frame: TexelFrame, geometry: Geometry, tracer: Tracer, sky: Sky | None,
        bright: BrightTargets, samples: SampleCounts, *, seed: int,
    ) -> None:  # fmt: skip
        self._texels, self._frame, self._geometry, self._tracer = texels, frame, geometry, tracer
        self._sky, self._samples, self._seed = sky, samples, seed
        self._n_bright = samples.bright if bright.any else 0
        self._bright = bright
        # Density of aimed samples per solid angle: probability / area · distance² / cosine at the target.
        count = texels.count
        area = np.maximum(frame.area, np.finfo(np.float32).tiny)
        self._density = np.concatenate(
            [bright.probability[:count] / area, bright.probability[count:] / (sky.solid_angle if sky else 1)]
        ).astype(np.float32)
        self._tangents = frames(frame.normal)
        self._lift = geometry.offset_length(frame.position)

    def trace(self, first: int, stop: int) -> tuple[Int32, Float32, Bool]:
        """((m, K) target, (m, K) weight, (m, K) usable) of texels first..stop-1; cosine rays come first."""
        rows = slice(first, stop)
        pattern = pattern_of_texels(first, stop, self._seed)
        parts = [self._cosine(rows, pattern)]
        if self._n_bright:
            parts.append(self._aimed(rows, pattern))
        target, weight, usable = (np.concatenate(column, axis=1) for column in zip(*parts, strict=True))
        return target, weight, usable

    def _starts(self, rows: slice, footprint: Float32) -> Float32:
        """(m, c, 3) ray origins spread over each texel's footprint."""
        f = self._frame
        lifted = f.position[rows] + f.geometric_normal[rows] * self._lift[rows, None]
        spread = footprint[:, :, :1] * f.tangent_u[rows, None] + footprint[:, :, 1:] * f.tangent_v[rows, None]
        return np.asarray(spread + lifted[:, None], np.float32)

    def _cosine(self, rows: slice, pattern: Int32) -> tuple[Int32, Float32, Bool]:
        table = cosine_patterns(self._samples.cosine, self._seed)
        local = table.directions[pattern]  # (m, c, 3)
        axes = np.stack([self._tangents[0][rows], self._tangents[1][rows], self._frame.normal[rows]], axis=1)
        directions = np.matmul(local, axes)  # (m, c, 3)
        origins = self._starts(rows, table.footprint[pattern])
        shape = local.shape[:2]
        flat_directions = directions.reshape(-1, 3)
        hits = self._tracer.intersect(origins.reshape(-1, 3), flat_directions)
        escaped = hits.triangle < 0
        target = self._texels.of_hits(hits.triangle, hits.u, hits.v, hits.back)
        dark_side = (target < 0) & ~escaped
        density = self._density.take(target, mode="clip")
        distance2 = hits.distance * hits.distance
        density = density * distance2 / np.maximum(np.abs(hits.cosine), np.float32(1e-6))
        if self._sky is not None and escaped.any():
            patch = self._sky.of_directions(flat_directions[escaped])
            target[escaped] = self._texels.count + patch
            density[escaped] = self._density[self._texels.count + patch]
        density[target < 0] = 0
        cosine = np.maximum(local[:, :, 2], np.float32(1e-6))
        n_c, n_b = np.float32(self._samples.cosine), np.float32(self._n_bright)
        weight = 1 / (n_c + n_b * np.float32(np.pi) * density.reshape(shape) / cosine)
        below = np.einsum("mcj,mj->mc", directions, self._frame.geometric_normal[rows]) <= 0
        return target.reshape(shape), weight, ~(dark_side.reshape(shape) | below)

    def _aimed(self, rows: slice, pattern: Int32) -> tuple[Int32, Float32, Bool]:
        table = bright_patterns(self._samples.bright, self._seed)
        points, normals, target_table = self._aims()
        target = target_table[pattern]  # (m, b)
        is_sky = target >= self._texels.count
        origins = self._starts(rows, table.footprint[pattern])
        ways = points[pattern] - np.where(is_sky[:, :, None], np.float32(0), origins)
        distance2 = np.einsum("mbj,mbj->mb", ways, ways)
        distance = np.sqrt(np.maximum(distance2, np.finfo(np.float32).tiny))
        cos_here = np.einsum("mbj,mj->mb", ways, self._frame.normal[rows]) / distance
        above = np.einsum("mbj,mj->mb", ways, self._frame.geometric_normal[rows]) > 0
        cos_there = -np.einsum("mbj,mbj->mb", ways, normals[pattern]) / distance
        seen = (cos_here > 0) & above & (is_sky | (cos_there > 1e-6))
        density = self._density[target] * np.where(is_sky, np.float32(1), distance2 / np.maximum(cos_there, 1e-6))
        n_c, n_b = np.float32(self._samples.cosine), np.float32(self._samples.bright)
        p_c = cos_here * np.float32(1 / np.pi)
        weight = np.where(seen, p_c / np.maximum(n_c * p_c + n_b * density, np.finfo(np.float32).tiny), 0)
        at = np.nonzero(seen.reshape(-1))[0]
        ends = np.where(is_sky, np.float32(np.inf), np.float32(1)).reshape(-1)[at]
        hidden = self._tracer.occluded(origins.reshape(-1, 3)[at], ways.reshape(-1, 3)[at], ends)
        weight.reshape(-1)[at[hidden]] = 0
        return target, weight.astype(np.float32), np.ones(weight.shape, np.bool_)

    def _aims(self) -> tuple[Float32, Float32, Int32]:
        """Per pattern: (P, b, 3) point on the target, lifted (or direction to the sky), (P, b, 3) its normal,
        (P, b) the target."""
        if not hasattr(self, "_aim_table"):
            table = bright_patterns(self._samples.bright, self._seed)
            shape = table.choice.shape
            target = np.searchsorted(self._bright.cdf, table.choice.reshape(-1), side="right") - 1
            target = np.minimum(target, len(self._bright.probability) - 1).astype(np.int32)
            points, normals = np.zeros((len(target), 3), np.float32), np.zeros((len(target), 3), np.float32)
            solid = target < self._texels.count
            t, on = target[solid], table.target.reshape(-1, 2)[solid] - np.float32(0.5)
            f = self._frame
            points[solid] = f.position[t] + f.tangent_u[t] * on[:, :1] + f.tangent_v[t] * on[:, 1:]
            points[solid] += f.geometric_normal[t] * self._lift[t, None]
            normals[solid] = f.geometric_normal[t]
            if self._sky is not None:
                on = table.target.reshape(-1, 2)[~solid]
                points[~solid] = self._sky.directions(target[~solid] - self._texels.count, on[:, 0], on[:, 1])
            self._aim_table = points.reshape(*shape, 3), normals.reshape(*shape, 3), target.reshape(shape)
        return self._aim_table


def trace_links(tracer: LinkTracer, texel_count: int, target_count: int, samples: SampleCounts, workers: Workers) -> Links:
    """Links of all texels."""
    chunk = max(1, CHUNK_RAYS // samples.total)
    parts = workers.map_slices(lambda s: tracer.trace(s.start, s.stop), texel_count, chunk)
    if not parts:
        empty = sparse.csr_matrix((0, target_count), dtype=np.float32)
        return Links(empty, (empty, empty), np.zeros(0, np.bool_), 0)
    target, weight, usable = (np.concatenate(column) for column in zip(*parts, strict=True))
    free = usable[:, : samples.cosine].mean(axis=1)
    weight *= usable
    rays = target.size
    first = _first_half(target.shape[1], samples)
    matrices = [_matrix(target, weight, columns, target_count) for columns in (slice(None), first, ~first)]
    return Links(matrices[0], (matrices[1], matrices[2]), free >= LEAST_FREE_SHARE, rays)


def _first_half(columns: int, samples: SampleCounts) -> Bool:
    """(columns,) the first half of the cosine rays and of the aimed ones; each half is well spread by itself."""
    number = np.arange(columns)
    return np.where(number < samples.cosine, number < samples.cosine // 2, number - samples.cosine < samples.bright // 2)


def _matrix(target: Int32, weight: Float32, columns: slice | Bool, target_count: int) -> sparse.csr_matrix:
    """Rows scaled to sum to one over all rays, the ones that ended nowhere included."""
    target, weight = target[:, columns], weight[:, columns]
    total = weight.sum(axis=1, dtype=np.float64)
    scale = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0).astype(np.float32)
    kept = (weight > 0) & (target != NO_TARGET)
    start = np.concatenate([[0], np.cumsum(kept.sum(axis=1))]).astype(np.int32)
    data = (weight * scale[:, None])[kept]
    return sparse.csr_matrix((data, target[kept], start), shape=(len(target), target_count))
