# SPDX-License-Identifier: GPL-3.0-or-later
"""Strands: one colour channel of one group of rows; what solvers sum over, each by itself.

Rows are laid out by channel and group, every group in whole blocks of its own with zeros at the end. A strand's sum is
the float64 sum of its blocks' float32 sums: its bits hang on that strand's numbers and their order, not on the other
groups, their labels or whether they are there at all. No BLAS.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene import Bool, Float32, Float64, Int32

#: Short, so that groups of few rows fill little with zeros; a float32 sum of this many is good to about 1e-7.
BLOCK = 64

Intp = NDArray[np.intp]


class Strands:
    """Layout of n rows in g groups: columns (c, blocks, BLOCK) of float32, scalars (c, g) of float64."""

    def __init__(self, group: Int32 | None, count: int) -> None:
        """group (n,): any number of each row's group; rows with -1 are left out. None: all rows are one group."""
        self.count = count
        inside = np.arange(count) if group is None else np.flatnonzero(group >= 0)
        if group is None or (len(inside) == count and (group == group[:1]).all()):
            self.labels = np.zeros(1, np.int32) if group is None else group[:1].astype(np.int32)
            sizes = np.full(len(self.labels), count, np.intp)
        else:
            known, sizes = np.unique(group[inside], return_counts=True)
            self.labels = known.astype(np.int32)
            inside = inside[np.argsort(_narrow(group[inside]), kind="stable")]
        self._blocks = np.maximum(1, -(-sizes // BLOCK))  # of each group
        self._first = (np.cumsum(self._blocks) - self._blocks).astype(np.intp)
        self._total = int(self._blocks.sum())
        self._inside: Intp | None = None  # rows in order of their slots; None: every row, in its own order
        if not np.array_equal(inside, np.arange(count)) or len(self.labels) > 1:
            before = np.cumsum(sizes) - sizes
            slot = np.arange(len(inside)) + np.repeat(self._first * BLOCK - before, sizes)
            self._inside = inside.astype(np.intp)
            # Row of each slot, the row past the last for padding; slot of each row, 0 for those left out.
            self._row = np.full(self._total * BLOCK, count, np.intp)
            self._row[slot] = inside
            self._slot = np.zeros(count, np.intp)
            self._slot[inside] = slot
            self._outside = np.flatnonzero(np.bincount(inside, minlength=count) == 0)

    def to_columns(self, rows: Float32) -> Float32:
        """(n, c) as (c, blocks, BLOCK)."""
        columns = np.zeros((rows.shape[1], self._total * BLOCK), np.float32)
        if self._inside is None:
            columns[:, : self.count] = rows.T
        else:
            padded = np.zeros(self.count + 1, np.float32)
            for column, values in zip(columns, rows.T, strict=True):
                padded[: self.count] = values
                np.take(padded, self._row, out=column, mode="clip")
        return columns.reshape(len(columns), self._total, BLOCK)

    def to_rows(self, columns: Float32) -> Float32:
        """(n, c) as a view of columns (c, n); zero in rows that are left out."""
        flat = columns.reshape(len(columns), -1)
        if self._inside is None:
            return flat[:, : self.count].T
        if not flat.shape[1]:
            return np.zeros((self.count, len(flat)), np.float32)
        rows = flat.take(self._slot, axis=1, mode="clip")
        rows[:, self._outside] = 0
        return rows.T

    def keep(self, solved: Float32, b: Float32) -> Float32:
        """(n, c) C order: ``solved`` columns in rows that belong to a group, b in the others."""
        out = np.array(self.to_rows(solved), np.float32, order="C")
        if self._inside is not None:
            out[self._outside] = b[self._outside]
        return out

    def dots(self, a: Float32, b: Float32) -> Float64:
        """(c, g) inner products."""
        return self._sums(np.einsum("cbk,cbk->cb", a, b))

    def projections(self, basis: Float32, vector: Float32) -> Float64:
        """(j, c, g) inner products of ``vector`` with each of the basis (j, c, blocks, BLOCK)."""
        return self._sums(np.einsum("jcbk,cbk->jcb", basis, vector))

    def combination(self, basis: Float32, weights: Float64) -> Float32:
        """The sum over j, in that order, of weights (j, c, g) · basis (j, c, blocks, BLOCK)."""
        return np.asarray(np.einsum("jcb,jcbk->cbk", self._by_block(weights), basis))

    def norms(self, a: Float32) -> Float64:
        length: Float64 = np.sqrt(self.dots(a, a))
        return length

    def largest(self, a: Float32) -> Float64:
        """(c, g) the largest magnitude."""
        magnitude = np.abs(a).reshape(len(a), -1)
        if not magnitude.shape[1]:
            return np.zeros((len(a), 0))
        return np.maximum.reduceat(magnitude, self._first * BLOCK, axis=1).astype(np.float64)

    def scaled(self, vector: Float32, factor: Float64) -> Float32:
        """factor (c, g) · vector."""
        return np.asarray(np.einsum("cb,cbk->cbk", self._by_block(factor), vector))

    def chosen(self, where: Bool, a: Float32, b: Float32) -> Float32:
        """a in the strands ``where`` (c, g), b in the others."""
        if not where.any():
            return b
        return np.where(np.repeat(where, self._blocks, axis=1)[:, :, None], a, b)

    def clear(self, vector: Float32, where: Bool) -> None:
        """Zero in the strands ``where`` (c, g)."""
        if where.any():
            vector[np.repeat(where, self._blocks, axis=1)] = 0

    def _sums(self, by_block: Float32) -> Float64:
        """(..., blocks) summed by group."""
        if not len(self._first):
            return np.zeros((*by_block.shape[:-1], 0))
        return np.asarray(np.add.reduceat(by_block.astype(np.float64), self._first, axis=-1))

    def _by_block(self, by_group: Float64) -> Float32:
        """(..., g) for each block."""
        return np.repeat(by_group.astype(np.float32), self._blocks, axis=-1)


def _narrow(labels: Int32) -> NDArray[np.int16] | Int32:
    """The same numbers in 16 bits where they fit: NumPy sorts those in linear time."""
    if len(labels) and labels.max() < 1 << 15:
        return labels.astype(np.int16)
    return labels
