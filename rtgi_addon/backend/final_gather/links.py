# SPDX-License-Identifier: GPL-3.0-or-later
"""Links as a linear map: from the radiosity of all targets to the irradiance of all texels.

Lit anew, the same rays cost one product. Since ∫ cosθ/π = 1 the weights of a texel's rays, escaped ones included,
must sum to one; each row is divided by its sum (a ratio estimator: exact for a uniform field, and free of the noise
in the sum).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..parallel import Workers
from ..scene import Float32, Float64, Int32
from ..surface.texels import stand_ins
from .beyond_store import beyond_matrices
from .gather import GatherRays
from .link_store import LinkStore

#: A half's rows are scaled up from the whole's by this at most; 2 is expected.
MOST_HALF_SCALE = 4.0
#: Texels of one sparse product: so that threads share them and what they read stays in a core's cache.
BLOCK_TEXELS = 2048


@dataclass(frozen=True)
class _Gathered:
    """What m texels get: before rows are scaled."""

    halves: Float32  # (m, 2, 3) by each half of the rays
    beyond: Float32  # (m, 3) by way of mirrors and glass


class Links:
    """n texels' links to m targets (texels first, then sky patches) in one frame.

    ``stand_in`` (n,): the texel whose light stands for each; itself unless it lies under other geometry; -1: none.
    A target that is not valid has no light of its own, though a sliver of it may be in sight: it is seen as what stands
    for it. Where nothing does, the link counts for nothing and the rest of its row makes up for it.
    """

    def __init__(self, store: LinkStore, rays: GatherRays, workers: Workers) -> None:
        self._store, self._rays, self._workers = store, rays, workers
        self.stand_in = stand_ins(rays.texels, store.valid)
        self._blocks = [
            _as_matrix(store.weight[a : a + BLOCK_TEXELS], store.target[a : a + BLOCK_TEXELS], store.nothing + 1)
            for a in range(0, store.kept, BLOCK_TEXELS)
        ]
        self._beyond = store.beyond.matrices(store.kept, store.nothing + 1)
        nothing = np.int32(store.nothing)
        others = np.arange(store.count, store.nothing + 1, dtype=np.int32)
        self._seen_as = np.concatenate([np.where(self.stand_in < 0, nothing, self.stand_in), others])
        whole, half = self._weights()
        self._scale = _inverse(whole)
        # Half of few rays may have hardly any weight; its own scale would then give nearly all to one bright target.
        self._half_scale = np.minimum(_inverse(half), self._scale * np.float32(MOST_HALF_SCALE))

    def irradiance(self, radiosity: Float32) -> Float32:
        """(n, 3) W/m² from the radiosity (m, 3) of all targets."""
        got = self._gather(self._seen(radiosity))
        return np.asarray((got.halves[:, 0] + got.halves[:, 1] + got.beyond) * self._scale[:, None])

    def with_half(self, radiosity: Float32) -> tuple[Float32, Float32]:
        """:meth:`irradiance`, and the same as half of the rays estimate it."""
        got = self._gather(self._seen(radiosity))
        whole = (got.halves[:, 0] + got.halves[:, 1] + got.beyond) * self._scale[:, None]
        # The half shares the rays beyond: their noise is not in its difference from the whole.
        return whole, got.halves[:, 0] * self._half_scale[:, None] + got.beyond * self._scale[:, None]

    def _seen(self, radiosity: Float32) -> Float32:
        """(m + 1, 3) what each column shows: nothing is black."""
        dark = np.zeros((1, radiosity.shape[1]), np.float32)
        return np.asarray(np.concatenate([radiosity, dark]).take(self._seen_as, axis=0))

    def _weights(self) -> tuple[Float64, Float64]:
        """((n,), (n,)) weight of each row's links, and of the half's, without those to what nothing stands for."""
        total = self._store.total
        lost = np.zeros((self._store.nothing + 1, 1), np.float32)
        lost[: self._store.count, 0] = self.stand_in < 0
        if lost.any():
            total = np.maximum(total - self._gather(lost).halves[:, :, 0], 0)
            # What rounding leaves of a row that saw nothing else is not a weight.
            total[total < 1e-6 * self._store.total] = 0
        return total[:, 0] + total[:, 1], total[:, 0]

    def _gather(self, seen: Float32) -> _Gathered:
        """Of all texels; ``seen`` (m + 1, c)."""
        parts = self._workers.map_slices(lambda s: _product(self._blocks[s.start], seen), len(self._blocks), 1)
        kept, width = self._store.kept, seen.shape[1]
        halves = np.concatenate([np.zeros((0, 2, width), np.float32), *parts])
        beyond = np.zeros((kept, width), np.float32)
        for channel, matrix in enumerate(self._beyond if width == 3 else ()):
            beyond[:, channel] = matrix @ seen[:, channel]
        if kept == self._store.count:
            return _Gathered(halves, beyond)
        others = self._workers.map_slices(
            lambda s: self._traced(kept + s.start, kept + s.stop, seen), self._store.count - kept, self._store.chunk
        )
        return _Gathered(
            np.concatenate([halves, *(o.halves for o in others)]), np.concatenate([beyond, *(o.beyond for o in others)])
        )

    def _traced(self, first: int, stop: int, seen: Float32) -> _Gathered:
        """Of texels whose links are not kept: traced for this product alone."""
        count, width = stop - first, seen.shape[1]
        traced = self._rays.trace(np.arange(first, stop, dtype=np.int32))
        target, weight = self._store.rows(traced)
        beyond = np.zeros((count, width), np.float32)
        found = beyond_matrices(traced.beyond, self._rays.n_cosine, first, stop, len(seen))
        for channel, matrix in enumerate(found if width == 3 else ()):
            beyond[:, channel] = matrix @ seen[:, channel]
        return _Gathered(_product(_as_matrix(weight, target, len(seen)), seen), beyond)


def _as_matrix(weight: Float32, target: Int32, columns: int) -> sparse.csr_matrix:
    """(2 m, columns) of weight, target (m, K): two rows a texel, its halves. Nothing is copied."""
    count, slots = weight.shape
    starts = np.arange(0, weight.size + 1, slots // 2, dtype=np.int32)
    return sparse.csr_matrix((weight.reshape(-1), target.reshape(-1), starts), shape=(2 * count, columns))


def _product(matrix: sparse.csr_matrix, seen: Float32) -> Float32:
    """(m, 2, c)"""
    return np.asarray(matrix @ seen, np.float32).reshape(-1, 2, seen.shape[1])


def _inverse(weight: Float64) -> Float32:
    """(n,) what makes each row sum to one; 0 for a row of zeros."""
    return np.asarray(np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0), np.float32)
