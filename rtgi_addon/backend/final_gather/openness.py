# SPDX-License-Identifier: GPL-3.0-or-later
"""Which texels are open to the light, from the share of their rays that end on no dark side.

A share of few rays is noisy. Where it passes the threshold slowly, along a wall that reaches out of a lit room, texels
decided each by itself are salt and pepper; so neighbours on the surface that are about alike decide together.
"""

from __future__ import annotations

import numpy as np

from ..scene import Bool, Float32, Int32
from ..surface.texels import Rows, Texels

#: A texel of whose rays fewer than this share see lit sides is inside or under other geometry: not valid, filled from
#: its neighbours. A side without a map is one that no light reaches; a surface that light reaches does not see it.
LEAST_FREE_SHARE = 0.9
#: Texels up to so many pixels away, of shares that differ by no more than ALIKE, decide together. The border of what
#: an object covers is sharper than that, and stays as it is.
WINDOW_PX = 3
ALIKE = 0.25


def open_texels(texels: Texels, free: Float32) -> Bool:
    """(n,) is the texel valid? ``free`` (n,): share of its rays that end on no dark side. Each surface by itself."""
    is_open = free >= LEAST_FREE_SHARE
    doubtful = np.flatnonzero((free > LEAST_FREE_SHARE - ALIKE) & (free < 1))
    if not len(doubtful):
        return np.asarray(is_open)
    near = np.unique(np.concatenate([_beside(texels, doubtful, *step) for step in _steps()]))
    near = near[near >= 0]
    total, count = np.zeros(len(near)), np.zeros(len(near))
    for step in _steps():
        other = _beside(texels, near, *step)
        share = free.take(other, mode="clip")
        alike = (other >= 0) & (np.abs(share - free[near]) <= ALIKE)
        total += np.where(alike, share, 0)
        count += alike
    is_open[near] = total >= LEAST_FREE_SHARE * count
    return np.asarray(is_open)


def _steps() -> list[tuple[int, int]]:
    reach = range(-WINDOW_PX, WINDOW_PX + 1)
    return [(down, right) for down in reach for right in reach]


def _beside(texels: Texels, rows: Rows, down: int, right: int) -> Int32:
    """(k,) the texel that lies so many pixels from each of ``rows`` (k,) on its surface; -1 where there is none."""
    height, width = texels.index.shape[1:]
    row, col = texels.row[rows] + down, texels.col[rows] + right
    inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
    other = texels.index[texels.page[rows], np.where(inside, row, 0), np.where(inside, col, 0)]
    same = inside & (other >= 0) & (texels.surface.take(other, mode="clip") == texels.surface[rows])
    return np.where(same, other, np.int32(-1))
