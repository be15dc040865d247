# SPDX-License-Identifier: GPL-3.0-or-later
"""Links: a gather's rays kept as a sparse matrix from the radiosity of all targets to the irradiance of all texels.

Lit anew, the same rays cost one product. Since ∫ cosθ/π = 1 the weights of a texel's rays, escaped ones included,
must sum to one; each row is divided by its sum (a ratio estimator: exact for a uniform field, and free of the noise
in the sum).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..parallel import CHUNK_RAYS, Workers
from ..scene import Bool, Float32, Int32
from ..settings import SampleCounts
from .gather import NO_TARGET, GatherRays, TracedLinks

#: A texel of whose rays fewer than this share see lit sides is inside or under other geometry: not valid, filled from
#: its neighbours. A side without a map is one that no light reaches; a surface that light reaches does not see it.
LEAST_FREE_SHARE = 0.9


@dataclass(frozen=True)
class Links:
    """n texels' links to m targets (texels first, then sky patches)."""

    matrix: sparse.csr_matrix  # (n, m) float32, rows sum to the share of rays that ended on a target
    halves: tuple[sparse.csr_matrix, sparse.csr_matrix]  # the matrix from either half of the rays alone
    beyond: tuple[sparse.csr_matrix, ...]  # three (n, m), one a channel: by mirror and glass; () where there are none
    valid: Bool  # (n,) False: the texel lies under other geometry
    rays: int

    def irradiance(self, radiosity: Float32, *, half: int | None = None) -> Float32:
        """(n, 3) W/m² from the radiosity (m, 3) of all targets; ``half`` 0 or 1: estimated from that half's rays."""
        matrix = self.matrix if half is None else self.halves[half]
        direct = np.asarray(matrix @ radiosity, np.float32)
        if self.beyond:
            # Both halves share these rays; their noise is not in the difference of the halves.
            direct += np.stack([m @ radiosity[:, k] for k, m in enumerate(self.beyond)], axis=1)
        return direct


def trace_links(
    tracer: GatherRays, texel_count: int, target_count: int, samples: SampleCounts, workers: Workers
) -> Links:
    """Links of all texels."""
    chunk = max(1, CHUNK_RAYS // samples.total)
    parts = workers.map_slices(lambda s: tracer.trace(s.start, s.stop), texel_count, chunk)
    if not parts:
        empty = sparse.csr_matrix((0, target_count), dtype=np.float32)
        return Links(empty, (empty, empty), (), np.zeros(0, np.bool_), 0)
    traced = TracedLinks.join(parts)
    weight = traced.weight * traced.usable
    first = _first_half(weight.shape[1], samples)
    matrices = [_matrix(traced.target, weight, columns, target_count) for columns in (slice(None), first, ~first)]
    beyond = _beyond_matrices(traced, weight, target_count) if len(traced.beyond_row) else ()
    return Links(matrices[0], (matrices[1], matrices[2]), beyond, traced.free >= LEAST_FREE_SHARE, traced.rays)


def _beyond_matrices(traced: TracedLinks, weight: Float32, target_count: int) -> tuple[sparse.csr_matrix, ...]:
    """One matrix a channel, its rows scaled as the plain links' are."""
    scale = _row_scale(weight)
    place = (traced.beyond_row, traced.beyond_target)
    shape = (len(weight), target_count)
    return tuple(
        sparse.coo_matrix((traced.beyond_weight[:, k] * scale[traced.beyond_row], place), shape=shape).tocsr()
        for k in range(3)
    )


def _row_scale(weight: Float32) -> Float32:
    """(n,) what makes each row of ``weight`` (n, K) sum to one; 0 for a row of zeros."""
    total = weight.sum(axis=1, dtype=np.float64)
    return np.asarray(np.divide(1.0, total, out=np.zeros_like(total), where=total > 0), np.float32)


def _first_half(columns: int, samples: SampleCounts) -> Bool:
    """(columns,) the first half of the cosine rays and of the aimed ones; each half is well spread by itself."""
    number = np.arange(columns)
    return np.where(
        number < samples.cosine, number < samples.cosine // 2, number - samples.cosine < samples.bright // 2
    )


def _matrix(target: Int32, weight: Float32, columns: slice | Bool, target_count: int) -> sparse.csr_matrix:
    """Rows scaled to sum to one over all rays, the ones that ended nowhere included."""
    target, weight = target[:, columns], weight[:, columns]
    scale = _row_scale(weight)
    kept = (weight > 0) & (target != NO_TARGET)
    start = np.concatenate([[0], np.cumsum(kept.sum(axis=1))]).astype(np.int32)
    data = (weight * scale[:, None])[kept]
    return sparse.csr_matrix((data, target[kept], start), shape=(len(target), target_count))
