# SPDX-License-Identifier: GPL-3.0-or-later
"""Which surfaces exchange light: links counted by pairs of surfaces, and the components they connect.

A component's light is solved apart (``solvers``), so what changes in one closed room is no work in another. Counts
change by what a frame changed; the components are a function of the pairs alone, not of how they came about.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ..scene import Bool, Int32

#: Up to this many surfaces every pair has a count, 2 MB of them; with more only pairs that have occurred.
DENSE_SURFACES = 512
#: Pairs worked on at a time, so that scenes of 50 million links need no array of all their pairs.
CHUNK_PAIRS = 1 << 21

Int64 = NDArray[np.int64]


class SurfaceGraph:
    """How many links lead from each surface to each surface; s surfaces."""

    def __init__(self, surface_count: int) -> None:
        self.surface_count = surface_count
        self._stride = surface_count + 1  # a pair's key is row * stride + target + 1; multiples of it: no target
        dense = surface_count <= DENSE_SURFACES
        self._keys: Int64 | None = None if dense else np.zeros(0, np.int64)  # rising; None: all that there can be
        self._links = np.zeros(surface_count * self._stride if dense else 0, np.int64)  # of each key
        self._flips: list[Int64] = []  # keys that got their first or lost their last link since labels were found
        self._labels: Int32 | None = None
        self._coupled = np.zeros(0, np.bool_)

    def add(self, row_surface: Int32, target_surface: Int32) -> None:
        """Links from ``row_surface`` to ``target_surface``, arrays that broadcast against each other, such as (n, 1)
        and (n, K). Target -1: the link ends on no surface, and is not counted."""
        self._change(row_surface, target_surface, 1)

    def remove(self, row_surface: Int32, target_surface: Int32) -> None:
        """The reverse of ``add``. Raises ValueError where more links would go than came; nothing is changed then."""
        self._change(row_surface, target_surface, -1)

    def count(self, row_surface: int, target_surface: int) -> int:
        """Links from one surface to another."""
        key = np.array([row_surface * self._stride + target_surface + 1])
        if self._keys is None:
            return int(self._links[key[0]])
        at = int(np.searchsorted(self._keys, key[0]))
        return int(self._links[at]) if at < len(self._keys) and self._keys[at] == key[0] else 0

    def labels(self) -> Int32:
        """(s,) each surface's component, numbered in the order of their lowest surfaces."""
        self._update()
        assert self._labels is not None
        return self._labels

    def coupled(self) -> Bool:
        """(s,) False: no link at all in the surface's component, not even from the surface to itself."""
        self._update()
        return self._coupled

    def _change(self, row_surface: Int32, target_surface: Int32, sign: int) -> None:
        row, target = np.broadcast_arrays(row_surface, target_surface)
        if not row.size:
            return
        if row.ndim < 2:
            row, target = row.reshape(-1, 1), target.reshape(-1, 1)
        _require_range(row_surface, 0, self.surface_count)
        _require_range(target_surface, -1, self.surface_count)
        step = max(1, CHUNK_PAIRS // row.shape[1])
        parts = [self._counted(row[a : a + step], target[a : a + step]) for a in range(0, len(row), step)]
        if len(parts) > 1:
            parts = [_merged(parts)]
        self._apply(*parts[0], sign)

    def _counted(self, row: Int32, target: Int32) -> tuple[Int64, Int64]:
        """(keys, rising; links of each, > 0) of some pairs."""
        most = self.surface_count * self._stride
        dtype = np.int32 if most < 1 << 31 else np.int64
        key = np.multiply(row, self._stride, dtype=dtype)
        key += target
        key += 1
        if self._keys is None and 4 * key.size > most:
            links = np.bincount(key.reshape(-1), minlength=most)
            found = np.flatnonzero(links)
            links = links[found]
        else:
            found, links = np.unique(key, return_counts=True)
        meant = found % self._stride != 0
        return found[meant].astype(np.int64), links[meant].astype(np.int64)

    def _apply(self, keys: Int64, links: Int64, sign: int) -> None:
        at = self._positions(keys, sign > 0)
        before = self._links[at]
        after = before + sign * links
        if (after < 0).any():
            row, target = divmod(int(keys[np.flatnonzero(after < 0)[0]]), self._stride)
            raise ValueError(f"more links from surface {row} to {target - 1} removed than added")
        self._links[at] = after
        flipped = keys[(before > 0) != (after > 0)]
        if len(flipped):
            self._flips.append(flipped)

    def _positions(self, keys: Int64, insert: bool) -> Int64:
        """(k,) where each key's count is; new keys get one where ``insert``."""
        if self._keys is None:
            return keys
        at = np.searchsorted(self._keys, keys)
        known = self._keys.take(at, mode="clip") == keys if len(self._keys) else np.zeros(len(keys), np.bool_)
        if known.all():
            return at
        if not insert:
            row, target = divmod(int(keys[np.flatnonzero(~known)[0]]), self._stride)
            raise ValueError(f"more links from surface {row} to {target - 1} removed than added")
        self._keys = np.insert(self._keys, at[~known], keys[~known])
        self._links = np.insert(self._links, at[~known], 0)
        return np.searchsorted(self._keys, keys)

    def _update(self) -> None:
        """Find the components, unless every pair that appeared or vanished did so an even number of times."""
        if self._labels is not None:
            if not self._flips:
                return
            _, times = np.unique(np.concatenate(self._flips), return_counts=True)
            if not (times % 2).any():
                self._flips = []
                return
        self._flips = []
        linked = np.flatnonzero(self._links)
        if self._keys is not None and 2 * len(linked) < len(self._keys):
            self._keys, self._links = self._keys[linked], self._links[linked]
            linked = np.arange(len(linked))
        keys = linked if self._keys is None else self._keys[linked]
        row = keys // self._stride
        target = keys - row * self._stride - 1
        shape = (self.surface_count, self.surface_count)
        graph = sparse.coo_matrix((np.ones(len(row), np.int8), (row, target)), shape=shape)
        count, label = connected_components(graph, directed=False)
        first = np.full(count, self.surface_count)
        np.minimum.at(first, label, np.arange(self.surface_count))
        rank = np.argsort(np.argsort(first))
        self._labels = rank[label].astype(np.int32)
        self._coupled = (np.bincount(self._labels[row], minlength=count) > 0)[self._labels]


def _merged(parts: list[tuple[Int64, Int64]]) -> tuple[Int64, Int64]:
    """One list of keys, rising, and their links."""
    keys, links = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(keys, kind="stable")
    keys, links = keys[order], links[order]
    first = np.flatnonzero(np.concatenate([np.ones(min(len(keys), 1), np.bool_), keys[1:] != keys[:-1]]))
    return keys[first], np.add.reduceat(links, first) if len(first) else links


def _require_range(surface: Int32, lowest: int, end: int) -> None:
    if surface.size and not (surface.min() >= lowest and surface.max() < end):
        raise ValueError(f"surfaces {surface.min()} .. {surface.max()} are not all within {lowest} .. {end - 1}")
