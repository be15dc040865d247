# SPDX-License-Identifier: GPL-3.0-or-later
"""What gather rays find behind mirrors and glass, kept from frame to frame with the segments of their ways.

Sorted by ray, so that what is kept does not hang on the order in which rays were traced. 20 bytes an end, 36 a segment.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..scene import Bool, Int32
from ..selection.sweep import Sweep
from .gather import Beyond

Int64 = NDArray[np.int64]


class BeyondStore:
    """The :class:`Beyond` of all texels' rays."""

    def __init__(self, n_cosine: int) -> None:
        self._cosine = n_cosine
        self.all = _empty()

    def touched(self, sweep: Sweep) -> tuple[Int64, Int64]:
        """((r,), (r,)) texel and number of the rays whose way behind a mirror meets a place of the ``sweep``."""
        kept = self.all
        rows = sweep.touches(kept.origin, kept.direction, kept.distance)
        ray = np.unique(kept.segment_ray[rows])
        return ray // self._cosine, ray % self._cosine

    def replace_rays(self, texel: Int32, number: Int32, parts: Sequence[Beyond]) -> None:
        """``parts`` are all that the rays ``number`` (r,) of ``texel`` (r,) find now."""
        ray = texel.astype(np.int64) * self._cosine + number
        if self.all.rays or any(p.rays for p in parts):
            self._replace(np.isin(self.all.ray, ray), np.isin(self.all.segment_ray, ray), parts)

    def replace_texels(self, texel: Int32, parts: Sequence[Beyond]) -> None:
        """``parts`` are all that the rays of ``texel`` (m,) find now."""
        if self.all.rays or any(p.rays for p in parts):
            kept = self.all
            of_end, of_segment = kept.ray // self._cosine, kept.segment_ray // self._cosine
            self._replace(np.isin(of_end, texel), np.isin(of_segment, texel), parts)

    def matrices(self, texels: int, targets: int) -> tuple[sparse.csr_matrix, ...]:
        """Three (texels, targets), one a channel; none where no ray found anything."""
        return beyond_matrices(self.all, self._cosine, 0, texels, targets)

    def _replace(self, old_end: Bool, old_segment: Bool, parts: Sequence[Beyond]) -> None:
        kept = self.all
        columns = {}
        for names, keep, key in (
            (("ray", "target", "weight"), ~old_end, "ray"),
            (("segment_ray", "origin", "direction", "distance"), ~old_segment, "segment_ray"),
        ):
            ray = np.concatenate([getattr(kept, key)[keep], *(getattr(p, key) for p in parts)])
            order = np.argsort(ray, kind="stable")
            for name in names:
                joined = np.concatenate([getattr(kept, name)[keep], *(getattr(p, name) for p in parts)])
                columns[name] = joined[order]
        self.all = Beyond(**columns)


def beyond_matrices(
    beyond: Beyond, n_cosine: int, first: int, stop: int, targets: int
) -> tuple[sparse.csr_matrix, ...]:
    """Three (stop - first, targets) of ``beyond``, whose rays are of those texels; none where it is empty."""
    if not len(beyond.ray):
        return ()
    count = np.bincount(beyond.ray // n_cosine - first, minlength=stop - first)
    starts = np.concatenate([[0], np.cumsum(count)])
    shape = (stop - first, targets)
    return tuple(
        sparse.csr_matrix((weight, beyond.target, starts), shape=shape)
        for weight in np.ascontiguousarray(beyond.weight.T)
    )


def _empty() -> Beyond:
    vectors, numbers = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
    return Beyond(numbers, np.zeros(0, np.int32), vectors, numbers, vectors, vectors, np.zeros(0, np.float32))
