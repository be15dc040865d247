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
from ..surface.texels import Texels, stand_ins
from .gather import NO_TARGET, GatherRays, TracedLinks

#: A texel of whose rays fewer than this share see lit sides is inside or under other geometry: not valid, filled from
#: its neighbours. A side without a map is one that no light reaches; a surface that light reaches does not see it.
LEAST_FREE_SHARE = 0.9
#: A half's rows are scaled up from the whole's by this at most; 2 is expected.
MOST_HALF_SCALE = 4.0


@dataclass(frozen=True)
class Links:
    """n texels' links to m targets (texels first, then sky patches). 12 bytes a link."""

    matrix: sparse.csr_matrix  # (n, m) float32, rows sum to the share of rays that ended on a target
    half: sparse.csr_matrix  # the same from half of the rays alone
    beyond: tuple[sparse.csr_matrix, ...]  # three (n, m), one a channel: by mirror and glass; () where there are none
    stand_in: Int32  # (n,) texel whose light stands for each; itself unless it lies under other geometry; -1: none
    rays: int

    @property
    def valid(self) -> Bool:
        """(n,) False: the texel lies under other geometry."""
        return np.asarray(self.stand_in == np.arange(len(self.stand_in)))

    def irradiance(self, radiosity: Float32, *, from_half: bool = False) -> Float32:
        """(n, 3) W/m² from the radiosity (m, 3) of all targets; ``from_half``: as half of the rays estimate it."""
        direct = np.asarray((self.half if from_half else self.matrix) @ radiosity, np.float32)
        if self.beyond:
            # The half shares these rays: their noise is not in its difference from the whole.
            direct += np.stack([m @ radiosity[:, k] for k, m in enumerate(self.beyond)], axis=1)
        return direct


def trace_links(
    tracer: GatherRays, texels: Texels, target_count: int, samples: SampleCounts, workers: Workers
) -> Links:
    """Links of all texels."""
    chunk = max(1, CHUNK_RAYS // samples.total)
    parts = workers.map_slices(lambda s: _packed(tracer.trace(s.start, s.stop), samples), texels.count, chunk)
    shape = (texels.count, target_count)
    stand_in = stand_ins(texels, np.concatenate([np.zeros(0, np.bool_), *(p.valid for p in parts)]))
    seen_as = np.concatenate([stand_in, np.arange(texels.count, target_count, dtype=np.int32)])
    return Links(
        matrix=_redirected(_joined([p.whole for p in parts], shape), seen_as),
        half=_redirected(_joined([p.half for p in parts], shape), seen_as),
        beyond=tuple(_redirected(m, seen_as) for m in _beyond_matrices([p.beyond for p in parts], shape)),
        stand_in=stand_in,
        rays=sum(p.rays for p in parts),
    )


def _redirected(matrix: sparse.csr_matrix, seen_as: Int32) -> sparse.csr_matrix:
    """``matrix`` (n, m) with each target replaced by ``seen_as`` (m,).

    A target that is not valid has no light of its own, though a sliver of it may be in sight. Where nothing stands for
    it (-1) the link is dropped and the rest of its row made up for it.
    """
    if np.array_equal(seen_as, np.arange(len(seen_as))):
        return matrix
    target = seen_as[matrix.indices]
    kept = np.where(target >= 0, matrix.data, np.float32(0))
    if (target < 0).any():
        before = np.asarray(matrix.sum(axis=1), np.float64).ravel()
        row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        after = np.bincount(row, kept, minlength=matrix.shape[0])
        kept = kept * np.divide(before, after, out=np.zeros_like(before), where=after > 0).astype(np.float32)[row]
    return sparse.csr_matrix((kept, np.maximum(target, 0), matrix.indptr), shape=matrix.shape)


@dataclass(frozen=True)
class _Rows:
    """Some rows of a sparse matrix, packed."""

    weight: Float32  # (k,)
    target: Int32  # (k,)
    count: Int32  # (m,) entries of each row


@dataclass(frozen=True)
class _Packed:
    """The links of m texels without the rays that ended nowhere."""

    whole: _Rows
    half: _Rows
    beyond: tuple[Int32, Int32, Float32]  # (b,) texel, (b,) target, (b, 3) weight
    valid: Bool  # (m,)
    rays: int


def _packed(traced: TracedLinks, samples: SampleCounts) -> _Packed:
    """Rows scaled to sum to one over all rays, the ones that ended nowhere included."""
    weight = traced.weight * traced.usable
    scale = _row_scale(weight)
    first = _first_half(weight.shape[1], samples)
    # Half of few rays may have hardly any weight; its own scale would then give nearly all to one bright target.
    half_scale = np.minimum(_row_scale(weight[:, first]), scale * np.float32(MOST_HALF_SCALE))
    beyond_scale = scale[traced.beyond_row - traced.first][:, None]
    return _Packed(
        whole=_rows(traced.target, weight, scale),
        half=_rows(traced.target[:, first], weight[:, first], half_scale),
        beyond=(traced.beyond_row, traced.beyond_target, traced.beyond_weight * beyond_scale),
        valid=traced.free >= LEAST_FREE_SHARE,
        rays=traced.rays,
    )


def _rows(target: Int32, weight: Float32, scale: Float32) -> _Rows:
    kept = (weight > 0) & (target != NO_TARGET)
    return _Rows((weight * scale[:, None])[kept], target[kept], kept.sum(axis=1, dtype=np.int32))


def _joined(parts: list[_Rows], shape: tuple[int, int]) -> sparse.csr_matrix:
    """All rows as one matrix."""
    counts = np.concatenate([np.zeros(1, np.int64), *(p.count for p in parts)])
    weight = np.concatenate([np.zeros(0, np.float32), *(p.weight for p in parts)])
    target = np.concatenate([np.zeros(0, np.int32), *(p.target for p in parts)])
    return sparse.csr_matrix((weight, target, np.cumsum(counts)), shape=shape)


def _beyond_matrices(
    parts: list[tuple[Int32, Int32, Float32]], shape: tuple[int, int]
) -> tuple[sparse.csr_matrix, ...]:
    """One matrix a channel, or none where no ray went on."""
    if not any(len(row) for row, _, _ in parts):
        return ()
    row, target, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    return tuple(sparse.coo_matrix((weight[:, k], (row, target)), shape=shape).tocsr() for k in range(3))


def _row_scale(weight: Float32) -> Float32:
    """(m,) what makes each row of ``weight`` (m, K) sum to one; 0 for a row of zeros."""
    total = weight.sum(axis=1, dtype=np.float64)
    return np.asarray(np.divide(1.0, total, out=np.zeros_like(total), where=total > 0), np.float32)


def _first_half(columns: int, samples: SampleCounts) -> Bool:
    """(columns,) the first half of the cosine rays and of the aimed ones, well spread by itself."""
    number = np.arange(columns)
    return np.where(
        number < samples.cosine, number < samples.cosine // 2, number - samples.cosine < samples.bright // 2
    )
