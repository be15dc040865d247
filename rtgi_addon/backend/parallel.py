# SPDX-License-Identifier: GPL-3.0-or-later
"""Threads over chunks of arrays. Chunk borders never depend on the thread count, so results do not either."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

R = TypeVar("R")

#: Rays worked on at a time: fewer leave threads waiting for one another between NumPy calls, more leave a core's cache
#: (measured: 128k beat 64k and 256k by a twentieth).
CHUNK_RAYS = 1 << 17


def thread_count(threads: int) -> int:
    """``threads``, or the number of cores this process may use when it is 0."""
    if threads > 0:
        return threads
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else (os.cpu_count() or 1)


class Workers:
    """A pool of threads for work that releases the GIL (Embree, NumPy, SciPy)."""

    def __init__(self, threads: int = 0) -> None:
        self.count = thread_count(threads)
        self._pool = ThreadPoolExecutor(self.count) if self.count > 1 else None

    def map_slices(self, work: Callable[[slice], R], total: int, chunk: int = CHUNK_RAYS) -> list[R]:
        """``[work(slice) ...]`` over ``range(total)`` cut every ``chunk``, results in order."""
        if chunk < 1:
            raise ValueError(f"chunk = {chunk}: must be at least 1")
        slices = [slice(a, min(a + chunk, total)) for a in range(0, total, chunk)]
        if self._pool is None or len(slices) < 2:
            return [work(s) for s in slices]
        return list(self._pool.map(work, slices))

    def close(self) -> None:
        """Give the threads back."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
