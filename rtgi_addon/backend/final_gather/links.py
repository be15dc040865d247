# SPDX-License-Identifier: GPL-3.0-or-later
"""Links as a linear map: from the radiosity of all targets to the irradiance of all texels.

Lit anew, the same rays cost one product. Since ∫ cosθ/π = 1 the weights of a texel's rays, escaped ones included,
must sum to one; each row is divided by its sum (a ratio estimator: exact for a uniform field, and free of the noise
in the sum).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..parallel import Workers
from ..scene import Float32, Float64, Int32
from ..surface.texels import stand_ins
from .beyond_store import beyond_matrices
from .gather import GatherRays
from .link_store import LinkStore
from .openness import open_texels
from .products import row_products

#: A half's rows are scaled up from the whole's by this at most; 2 is expected.
MOST_HALF_SCALE = 4.0


@dataclass(frozen=True)
class _Gathered:
    """What r texels get, before rows are scaled; by channel, since columns lie better in a core's cache."""

    first: Float32  # (c, r) by the first half of the rays
    second: Float32  # (c, r)
    beyond: Float32 | None  # (c, r) by way of mirrors and glass; None: there are none


@dataclass(frozen=True)
class Links:
    """Links of r texels to m targets (texels first, then sky patches) in one frame.

    A target that is not valid has no light of its own, though a sliver of it may be in sight: it is seen as what stands
    for it. Where nothing does, the link counts for nothing and the rest of its row makes up for it.
    """

    stand_in: Int32  # (n,) of all texels: whose light stands for each; itself unless under other geometry; -1: none
    _store: LinkStore
    _rays: GatherRays
    _workers: Workers
    _seen_as: Int32 | None  # (m + 1,) what each target, and nothing, is seen as; None: as itself
    _product: Callable[[Float32], Float32]  # (m + 1, c) to (2 r, c), halves of the kept texels
    _beyond: tuple[sparse.csr_matrix, ...]  # three (r, m + 1), one a channel; () where there are none
    _all: bool  # r = n
    _scale: Float32  # (r,)
    _half_scale: Float32  # (r,)

    def irradiance(self, radiosity: Float32) -> Float32:
        """(r, 3) W/m² from the radiosity (m, 3) of all targets; a view of columns."""
        got = self._gather(self._seen(radiosity))
        return self._whole(got).T

    def with_half(self, radiosity: Float32) -> tuple[Float32, Float32]:
        """:meth:`irradiance`, and the same as half of the rays estimate it."""
        got = self._gather(self._seen(radiosity))
        half = got.first * self._half_scale
        if got.beyond is not None:
            # The half shares the rays beyond: their noise is not in its difference from the whole.
            half += got.beyond * self._scale
        return self._whole(got).T, half.T

    def _whole(self, got: _Gathered) -> Float32:
        """(c, r)"""
        whole = got.first + got.second
        if got.beyond is not None:
            whole += got.beyond
        whole *= self._scale
        return whole

    def only(self, texels: NDArray[np.int64]) -> Links:
        """The links of ``texels`` (r,), of the links of all."""
        if self._store.kept < self._store.count:
            raise ValueError("links that are not kept cannot be taken apart")
        return replace(
            self,
            _product=_halves(self._store, texels, self._workers),
            _beyond=tuple(matrix[texels] for matrix in self._beyond),
            _scale=self._scale[texels],
            _half_scale=self._half_scale[texels],
            _all=False,
        )

    def _seen(self, radiosity: Float32) -> Float32:
        """(c, m + 1) what each column shows: nothing is black."""
        columns = np.zeros((radiosity.shape[1], len(radiosity) + 1), np.float32)
        columns[:, :-1] = radiosity.T
        return columns if self._seen_as is None else columns.take(self._seen_as, axis=1)

    def _gather(self, seen: Float32) -> _Gathered:
        store = self._store
        kept = _gathered(self._product(seen.T), self._beyond, seen)
        if not self._all or store.kept == store.count:
            return kept
        others = self._workers.map_slices(
            lambda s: self._traced(store.kept + s.start, store.kept + s.stop, seen),
            store.count - store.kept,
            store.chunk,
        )
        return _joined([kept, *others])

    def _traced(self, first: int, stop: int, seen: Float32) -> _Gathered:
        """Of texels whose links are not kept: traced for this product alone."""
        traced = self._rays.trace(np.arange(first, stop, dtype=np.int32))
        target, weight = self._store.rows(traced)
        one = Workers(1)  # this is one of many threads already
        product = row_products(*_as_halves(target, weight), seen.shape[1], one)(seen.T)
        found = beyond_matrices(traced.beyond, self._rays.n_cosine, first, stop, seen.shape[1])
        return _gathered(product, found, seen)


def make_links(store: LinkStore, rays: GatherRays, workers: Workers) -> Links:
    """The links of all texels as they stand in the frame of ``rays``."""
    stand_in = stand_ins(rays.texels, open_texels(rays.texels, store.free))
    themselves = np.arange(store.nothing + 1, dtype=np.int32)
    seen_as = themselves.copy()
    seen_as[: store.count] = np.where(stand_in < 0, np.int32(store.nothing), stand_in)
    links = Links(
        stand_in=stand_in,
        _store=store,
        _rays=rays,
        _workers=workers,
        _seen_as=None if np.array_equal(seen_as, themselves) else seen_as,
        _product=_halves(store, None, workers),
        _beyond=store.beyond.matrices(store.kept, store.nothing + 1),
        _all=True,
        _scale=np.zeros(0, np.float32),
        _half_scale=np.zeros(0, np.float32),
    )
    total = store.total
    lost = np.zeros((1, store.nothing + 1), np.float32)
    lost[0, : store.count] = stand_in < 0
    if lost.any():
        got = links._gather(lost)
        total = np.maximum(total - np.stack([got.first[0], got.second[0]], axis=1), 0)
        # What rounding leaves of a row that saw nothing else is not a weight.
        total[total < 1e-6 * store.total] = 0
    scale = _inverse(total[:, 0] + total[:, 1])
    # Half of few rays may have hardly any weight; its own scale would then give nearly all to one bright target.
    half_scale = np.minimum(_inverse(total[:, 0]), scale * np.float32(MOST_HALF_SCALE))
    return replace(links, _scale=scale, _half_scale=half_scale)


def _halves(store: LinkStore, texels: NDArray[np.int64] | None, workers: Workers) -> Callable[[Float32], Float32]:
    """Products of the kept links of ``texels`` (default: all), two rows a texel."""
    chosen = slice(None) if texels is None else texels
    return row_products(*_as_halves(store.target[chosen], store.weight[chosen]), store.nothing + 1, workers)


def _as_halves(target: Int32, weight: Float32) -> tuple[Int32, Float32]:
    half = target.shape[1] // 2
    return target.reshape(-1, half), weight.reshape(-1, half)


def _gathered(product: Float32, beyond: tuple[sparse.csr_matrix, ...], seen: Float32) -> _Gathered:
    """From the products (2 r, c) of halves and the matrices beyond, one for each of three channels."""
    halves = product.T  # (c, 2 r)
    through = None
    if beyond and len(seen) == 3:
        through = np.stack([matrix @ channel for matrix, channel in zip(beyond, seen, strict=True)])
    return _Gathered(halves[:, 0::2], halves[:, 1::2], through)


def _joined(parts: list[_Gathered]) -> _Gathered:
    """One after the other."""
    first, second = (np.concatenate([getattr(p, name) for p in parts], axis=1) for name in ("first", "second"))
    if all(p.beyond is None for p in parts):
        return _Gathered(first, second, None)
    beyond = [np.zeros_like(p.first) if p.beyond is None else p.beyond for p in parts]
    return _Gathered(first, second, np.concatenate(beyond, axis=1))


def _inverse(weight: Float64) -> Float32:
    """(n,) what makes each row sum to one; 0 for a row of zeros."""
    return np.asarray(np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0), np.float32)
