# SPDX-License-Identifier: GPL-3.0-or-later
"""Padding of light-map pages: pixels beside an island take its nearest texel, so that bilinear lookups at its border
see the island alone. Which pixel takes which texel follows from the atlas; a frame is one gather.
"""

from __future__ import annotations

import numpy as np
import scipy.ndimage

from ..scene import Bool, Float32, Int32

#: Bilinear lookups reach one pixel diagonally; mipmaps and block compression look further.
PADDING_PX = 4.0


class DilationMap:
    """Where each pixel of the pages gets its value. Built once for an atlas.

    texel (pages, H, W) int32: the texel shown, -1 where the pixel stays black · filled (pages, H, W) bool: the pixel
    shows another pixel's texel.
    """

    def __init__(self, index: Int32, padding_px: float = PADDING_PX) -> None:
        """``index`` (pages, H, W): texel of each pixel, -1 where there is none. A pixel within ``padding_px`` of a
        texel takes the nearest one; between two islands the border lies midway, so neither reaches into the other.
        """
        self.texel: Int32 = np.array([nearest_texel(page, padding_px) for page in index], np.int32).reshape(index.shape)
        self.filled: Bool = (self.texel >= 0) & (index < 0)
        self._shown = np.flatnonzero(self.texel >= 0)
        self._texel_of_shown = self.texel.ravel()[self._shown]

    def apply(self, values: Float32) -> Float32:
        """(pages, H, W, c) pages of per-texel ``values`` (n, c); black beyond the padding."""
        pages = np.zeros((self.texel.size, values.shape[1]), values.dtype)
        pages[self._shown] = values.take(self._texel_of_shown, axis=0)
        return pages.reshape(*self.texel.shape, values.shape[1])


def nearest_texel(index: Int32, reach_px: float) -> Int32:
    """(h, w) the texel of each pixel, else the nearest one within ``reach_px`` pixels, else -1; ``index`` (h, w)."""
    if not (index >= 0).any():
        return index.copy()
    rows, cols, distance = nearest_pixel(index)
    return np.where(distance <= reach_px, index[rows, cols], np.int32(-1))


def nearest_pixel(index: Int32) -> tuple[Int32, Int32, Float32]:
    """(h, w) row, column and distance in pixels of the texel nearest to each pixel; ``index`` (h, w) has some."""
    distance, (rows, cols) = scipy.ndimage.distance_transform_edt(index < 0, return_indices=True)
    return rows, cols, distance.astype(np.float32)
