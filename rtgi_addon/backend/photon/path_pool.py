# SPDX-License-Identifier: GPL-3.0-or-later
"""Photon paths that live over many frames: replacing a few costs what these few cost (Larsen04 §2).

Paths have fixed rows; their hits lie together somewhere in a pool. A path that is replaced leaves its hits behind,
marked as nobody's, and gets new ones at the pool's end; once the dead are too many the pool is put in order. Hits are
always handed out in the order of paths, so nothing outside sees what happened before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lamps.emission import Int64
from ..scene import Bool, Float32, Int32
from .paths import HIT_FIELDS, PATH_FIELDS, PhotonPaths, join_paths, scaled_paths

Rows = NDArray[np.int64]

#: In ``path``: the hit belongs to no path any more.
NOBODY = -1
#: The pool is put in order when dead hits are more than this share of the living, and more than so many.
_MOST_DEAD = 0.5
_LEAST_DEAD = 1 << 12


class PathPool:
    """p paths with unit flux (``Starts.guide``), each with a factor (3,) W that makes it flux.

    89 bytes a path and 53 a hit; dead hits and free room may come to as much again.
    """

    def __init__(self) -> None:
        none = join_paths([])
        self._of_path = {name: getattr(none, name) for name in PATH_FIELDS}
        self._of_hit = {name: getattr(none, name) for name in HIT_FIELDS}
        self._path: Int32 = np.zeros(0, np.int32)  # of each hit
        self._first: Rows = np.zeros(0, np.int64)
        self._length: Rows = np.zeros(0, np.int64)
        self.factor: Float32 = np.zeros((0, 3), np.float32)
        self._used = 0
        self._alive = 0

    # --- what is there --------------------------------------------------------------------------------------------

    @property
    def path(self) -> Int32:
        """(used,) path of each hit in the pool, or NOBODY."""
        return self._path[: self._used]

    def hit(self, name: str) -> NDArray[Any]:
        """(used, ...) a column of HIT_FIELDS; unit flux. Rows of NOBODY mean nothing."""
        column: NDArray[Any] = self._of_hit[name][: self._used]
        return column

    def of_path(self, name: str) -> NDArray[Any]:
        """(p, ...) a column of PATH_FIELDS; unit flux."""
        column: NDArray[Any] = self._of_path[name]
        return column

    def hits_of(self, paths: Rows) -> Rows:
        """Hits of ``paths`` (k,), one path after the other."""
        length = self._length[paths]
        first = np.cumsum(length) - length
        return np.asarray(np.arange(int(length.sum())) + np.repeat(self._first[paths] - first, length))

    def starts(self, paths: Rows) -> tuple[Float32, Float32, Float32]:
        """Origin, direction and guide (k, 3) that ``paths`` (k,) were traced from."""
        landed = self._length[paths] > 0
        first = self._first[paths[landed]]
        out = []
        for at_end, at_hit in (("end_direction", "direction"), ("end_flux", "flux")):
            column = self._of_path[at_end].take(paths, axis=0)
            column[landed] = self._of_hit[at_hit].take(first, axis=0)
            out.append(column)
        return self._of_path["origin"].take(paths, axis=0), out[0], out[1]

    def select(self, hits: Bool | None = None) -> PhotonPaths:
        """All paths, with flux in W, and of their hits those chosen by ``hits`` (used,)."""
        chosen = self.path != NOBODY if hits is None else hits & (self.path != NOBODY)
        paths = self._unit(np.nonzero(chosen)[0])
        return scaled_paths(paths, self.factor)

    def _unit(self, rows: Rows) -> PhotonPaths:
        path = self._path[rows]
        rows = rows[np.argsort(path, kind="stable")]  # a path's hits stand in order of bounce
        first = np.concatenate([[0], np.cumsum(np.bincount(path, minlength=len(self._first)))]).astype(np.int64)
        return PhotonPaths(
            first_hit=first,
            **{name: column.copy() for name, column in self._of_path.items()},
            **{name: column.take(rows, axis=0) for name, column in self._of_hit.items()},
        )

    # --- changes --------------------------------------------------------------------------------------------------

    def resize(self, light: Int32, index: Int64, row_before: Rows) -> None:
        """New rows of ``light``, ``index`` (p,): those that had a row keep their path, others (-1) have no hits."""

        def moved(column: NDArray[Any]) -> NDArray[Any]:
            return moved_rows(column, row_before)

        kept = row_before >= 0
        row_now = np.full(len(self._first) + 1, NOBODY, np.int32)  # the last stands for NOBODY itself
        row_now[row_before[kept]] = np.nonzero(kept)[0]
        self._path[: self._used] = row_now[self.path]
        self.hit("distance")[self.path == NOBODY] = 0
        self._of_path = {name: moved(column) for name, column in self._of_path.items()}
        self._of_path["light"], self._of_path["index"] = light, index
        self._first, self._length, self.factor = moved(self._first), moved(self._length), moved(self.factor)
        self._alive = int(self._length.sum())

    def compare(self, rows: Rows, fresh: PhotonPaths, factor: Float32) -> tuple[Bool, Bool, Bool]:
        """Path i of ``fresh`` with ``factor`` (k, 3) against that of ``rows[i]``, to the last bit.

        (k,) is the path the same? And of hits_of(rows), and of the hits of ``fresh``: is the hit there in both?
        """
        length, fresh_length = self._length[rows], np.diff(fresh.first_hit)
        same: Bool = equal_bits(factor, self.factor[rows]) & equal_bits(self._of_path["origin"][rows], fresh.origin)
        common = np.where(same, np.minimum(length, fresh_length), 0)  # else no hit is the same
        for name in PATH_FIELDS:
            same &= equal_bits(self._of_path[name].take(rows, axis=0), getattr(fresh, name))
        path = np.repeat(np.arange(len(rows)), common)
        bounce = np.arange(len(path)) - np.repeat(np.cumsum(common) - common, common)
        mine, its = self._first[rows][path] + bounce, fresh.first_hit[path] + bounce
        equal = np.ones(len(path), np.bool_)
        for name in HIT_FIELDS:
            equal &= equal_bits(self._of_hit[name].take(mine, axis=0), getattr(fresh, name).take(its, axis=0))
        same &= length == fresh_length
        same[path[~equal]] = False
        stays, fresh_stays = np.zeros(int(length.sum()), np.bool_), np.zeros(len(fresh.triangle), np.bool_)
        stays[(np.cumsum(length) - length)[path[equal]] + bounce[equal]] = True
        fresh_stays[its[equal]] = True
        return same, stays, fresh_stays

    def replace(self, rows: Rows, fresh: PhotonPaths) -> None:
        """Path i of ``fresh`` in the place of ``rows[i]``, which ascend. Removing is constant time a hit."""
        gone = self.hits_of(rows)
        self._path[gone] = NOBODY
        # Nothing of any length: the swept test passes it over.
        self._of_hit["distance"][gone] = 0
        for name in PATH_FIELDS:
            self._of_path[name][rows] = getattr(fresh, name)
        length = np.diff(fresh.first_hit)
        count = len(fresh.triangle)
        self._reserve(count)
        new = slice(self._used, self._used + count)
        self._path[new] = np.repeat(rows, length)
        for name, column in self._of_hit.items():
            column[new] = getattr(fresh, name)
        self._first[rows] = self._used + fresh.first_hit[:-1]
        self._length[rows] = length
        self._used += count
        self._alive += count - len(gone)
        if self._used - self._alive > max(_MOST_DEAD * self._alive, _LEAST_DEAD):
            self._put_in_order()

    def _reserve(self, count: int) -> None:
        room = len(self._path)
        if self._used + count <= room:
            return
        size = max(self._used + count, room + room // 2) if self._used else count
        self._of_hit = {name: _longer(column, size) for name, column in self._of_hit.items()}
        self._path = _longer(self._path, size)

    def _put_in_order(self) -> None:
        paths = self._unit(np.nonzero(self.path != NOBODY)[0])
        self._of_hit = {name: getattr(paths, name) for name in HIT_FIELDS}
        self._path, self._first = paths.path_of_hit, paths.first_hit[:-1].copy()
        self._used = len(self._path)


def moved_rows(column: NDArray[Any], row_before: Rows) -> NDArray[Any]:
    """``column[row_before]``; zero where ``row_before`` (p,) is negative."""
    out = np.zeros((len(row_before), *column.shape[1:]), column.dtype)
    kept = row_before >= 0
    out[kept] = column[row_before[kept]]
    return out


def _longer(column: NDArray[Any], size: int) -> NDArray[Any]:
    out = np.zeros((size, *column.shape[1:]), column.dtype)
    out[: len(column)] = column
    return out


def equal_bits(a: NDArray[Any], b: NDArray[Any]) -> Bool:
    """(k,) rows of (k,) or (k, 3) arrays that are the same to the last bit."""
    if a.dtype == np.float32:
        a, b = np.ascontiguousarray(a).view(np.int32), np.ascontiguousarray(b).view(np.int32)
    if a.ndim == 1:
        return np.asarray(a == b)
    # Column by column: NumPy is slow to reduce an axis of three.
    return np.asarray((a[:, 0] == b[:, 0]) & (a[:, 1] == b[:, 1]) & (a[:, 2] == b[:, 2]))
