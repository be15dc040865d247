# SPDX-License-Identifier: GPL-3.0-or-later
"""Products of links kept as (n, K) arrays with what their targets send: 1.1 ms a core for 768,000 links.

SciPy's compressed rows with K entries each are these very arrays, so nothing is copied. Channels go one by one, which
is faster than three at once: a column of all targets stays in a core's cache. SciPy holds no lock meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from ..parallel import Workers
from ..scene import Float32, Int32

#: Links worked on at a time by one thread: read three times, they should come from its cache.
PART_LINKS = 1 << 19
#: Fewer are multiplied sooner by one thread than two threads are set to work.
LEAST_LINKS = 1 << 18


def row_products(target: Int32, weight: Float32, target_count: int, workers: Workers) -> Callable[[Float32], Float32]:
    """x (m, c) to (n, c): the sum over k of weight[i, k] · x[target[i, k]], taken in order of k.

    target, weight (n, K), C order, 0 <= target < m = ``target_count``; both are kept, not copied. Every row's sum is
    its own: the same bits in any set of rows and with any number of threads. The product is a view of (c, n) columns;
    an x of that layout (``columns.T``) is used as it lies.
    """
    if target.shape != weight.shape or target.ndim != 2:
        raise ValueError(f"target {target.shape} and weight {weight.shape} must be the same (n, K)")
    if target.dtype != np.int32 or weight.dtype != np.float32:
        raise ValueError(f"target {target.dtype} must be int32, weight {weight.dtype} float32")
    # SciPy does not look: a number outside would read foreign memory. Negative ones are large without a sign.
    if target.size and target.view(np.uint32).max() >= target_count:
        raise ValueError(f"targets {target.min()} .. {target.max()} are not all within 0 .. {target_count - 1}")
    count, width = target.shape
    per_thread = -(-count // workers.count)
    rows = max(1, min(max(per_thread, LEAST_LINKS // max(width, 1)), PART_LINKS // max(width, 1)))
    parts = [_matrix(target[a : a + rows], weight[a : a + rows], target_count) for a in range(0, count, rows)]

    def product(x: Float32) -> Float32:
        if len(x) != target_count:
            raise ValueError(f"x has {len(x)} rows, not one for each of {target_count} targets")
        columns = np.ascontiguousarray(x.T, np.float32)
        out = np.zeros((len(columns), count), np.float32)

        def work(number: slice) -> None:
            part = parts[number.start]
            first = number.start * rows
            for column, sums in zip(columns, out[:, first : first + rows], strict=True):
                sums[:] = part @ column

        workers.map_slices(work, len(parts), 1)
        return out.T

    return product


def _matrix(target: Int32, weight: Float32, target_count: int) -> sparse.csr_matrix:
    """The rows as a sparse matrix on the same memory; SciPy's constructor would copy views of large arrays."""
    count, width = target.shape
    matrix = sparse.csr_matrix((count, target_count), dtype=np.float32)
    matrix.data, matrix.indices = weight.reshape(-1), target.reshape(-1)
    matrix.indptr = np.arange(count + 1, dtype=np.int32) * np.int32(width)
    return matrix
