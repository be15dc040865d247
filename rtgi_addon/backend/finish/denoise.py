# SPDX-License-Identifier: GPL-3.0-or-later
"""Denoising of light maps: OIDN over the atlas pages, without light passing between surfaces.

Each surface is divided by its own mean before the filter and multiplied after it, so a bright surface beside a dark
one on the page looks like its equal and nothing bleeds; the mean of each surface is kept. Pixels around an island
mirror it. In a box of islands of 16 x 16 texels with 37 % noise that leaves 9 % error; black pixels around them left
13 %, and repeated border texels 30 %, since the filter takes such streaks for structure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene import Bool, Float32, Float64, Int32
from .dilate import nearest_pixel
from .oidn import Denoiser, require_finite

#: Width of the mirrored border. Wider ones meet their neighbours' and make patterns of their own.
MIRROR_PX = 2
#: Neutral frame around what is filtered: OIDN's error on a grey constant is below 0.4 % this far from the image's edge.
FRAME_PX = 8
#: OIDN pads to multiples of this with zeros, which would darken the last rows.
ALIGN_PX = 16
#: Surfaces have mean 1 when they are filtered; a fixed scale keeps one surface's change from touching the others.
INPUT_SCALE = 0.3
#: The filter may lose light (fireflies that it takes out whole); giving back more than this would only invent.
MOST_GAIN = 2.0


@dataclass(frozen=True)
class _Crop:
    """The filtered part of one page; n texels in all, n stands for a neutral pixel."""

    source: Int32  # (h, w) texel shown by each pixel
    texels: Int32  # (m,) those whose own pixel is here
    pixels: Int32  # (m,) flat pixel of each


class MapDenoiser:
    """Denoises values on the texels of one atlas; built once for it. The ``denoiser`` is the caller's to close."""

    def __init__(self, denoiser: Denoiser, index: Int32, surface: Int32) -> None:
        """``index`` (pages, H, W): texel of each pixel, -1 where there is none; ``surface`` (n,) of each texel."""
        self._denoiser = denoiser
        self._index = index
        self._surface = surface
        self._seen: Bool | None = None  # the valid texels that the pages are laid out for

    def denoise(self, values: Float32, *, valid: Bool | None = None) -> Float32:
        """``values`` (n, 3) >= 0 without their noise; each surface keeps its mean (within ``MOST_GAIN``).

        Texels that are not ``valid`` (n,) are not looked at; they get what the filter makes of their surroundings on
        the surface, black where none of it is valid. Raises ValueError where a value is not finite or is negative.
        """
        if values.shape != (len(self._surface), 3):
            raise ValueError(f"values of shape {values.shape}: must be ({len(self._surface)}, 3)")
        seen = np.ones(len(values), np.bool_) if valid is None else valid
        if self._seen is None or not np.array_equal(seen, self._seen):
            self._see(seen)
        require_finite(values[seen])
        if (values[seen] < 0).any():
            raise ValueError(f"{np.count_nonzero((values[seen] < 0).any(axis=1))} texels are negative")
        known = np.where(seen[:, None], values, np.float32(0))
        mean = self._means(known, seen)
        relative = self._relative_to(mean, known)
        shown = np.concatenate([relative, np.ones((1, 3), np.float32)])
        filtered = np.zeros_like(relative)
        for crop in self._crops:
            image = self._denoiser.denoise(shown[crop.source], input_scale=INPUT_SCALE)
            filtered[crop.texels] = image.reshape(-1, 3)[crop.pixels]
        # The mean of ``relative`` is 1.
        gain = 1 / np.maximum(self._means(filtered, seen), 1 / MOST_GAIN)
        return filtered * (gain * mean).astype(np.float32)[self._surface]

    def _see(self, seen: Bool) -> None:
        """Lay out the pages for these valid texels (n,); they change only where something moves."""
        self._seen = seen.copy()
        self._count = np.maximum(np.bincount(self._surface, weights=seen), 1)
        self._crops = [_make_crop(page, self._surface, seen) for page in self._index if (page >= 0).any()]

    def _means(self, values: Float32, seen: Bool) -> Float64:
        """(surfaces, 3) mean over the valid texels of each surface."""
        sums = [np.bincount(self._surface, weights=np.where(seen, channel, 0)) for channel in values.T]
        return np.asarray(np.stack(sums, axis=1) / self._count[:, None], np.float64)

    def _relative_to(self, mean: Float64, values: Float32) -> Float32:
        """``values`` over their surface's mean. A channel without light shows the others' average, or 1: a colour
        at the edge of what there is would get a tint from the filter.
        """
        lit = mean > 0
        inverse = np.divide(1, mean, out=np.zeros_like(mean), where=lit)
        relative: Float32 = (values * inverse[self._surface]).astype(np.float32)
        dark = ~lit[self._surface]
        if dark.any():
            channels = 3 - dark.sum(axis=1)
            grey = np.where(channels > 0, relative.sum(axis=1) / np.maximum(channels, 1), 1).astype(np.float32)
            relative = np.where(dark, grey[:, None], relative)
        return relative


def _make_crop(page: Int32, surface: Int32, seen: Bool) -> _Crop:
    rows, cols = np.flatnonzero((page >= 0).any(axis=1)), np.flatnonzero((page >= 0).any(axis=0))
    used = page[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    size = [-(-(side + 2 * FRAME_PX) // ALIGN_PX) * ALIGN_PX for side in used.shape]
    index = np.full(size, -1, np.int32)
    index[FRAME_PX : FRAME_PX + used.shape[0], FRAME_PX : FRAME_PX + used.shape[1]] = used
    source = _mirrored(index, np.where((index >= 0) & seen[index], index, np.int32(-1)), surface)
    pixels = np.flatnonzero(index >= 0)
    return _Crop(np.where(source >= 0, source, np.int32(len(surface))), index.ravel()[pixels], pixels.astype(np.int32))


def _mirrored(index: Int32, known: Int32, surface: Int32) -> Int32:
    """(h, w) texel to show at each pixel, -1 for none. ``known``: ``index`` without the texels that are not valid.

    Pixels of an island that are not known, and pixels within MIRROR_PX of one, show the texel as far on the other
    side of the nearest known one, or that one itself where the island ends before.
    """
    if not (known >= 0).any():
        return known
    rows, cols, distance = nearest_pixel(known)
    height, width = index.shape
    beyond_row = np.clip(2 * rows - np.arange(height)[:, None], 0, height - 1)
    beyond_col = np.clip(2 * cols - np.arange(width)[None, :], 0, width - 1)
    nearest, beyond = known[rows, cols], known[beyond_row, beyond_col]
    same = (beyond >= 0) & (surface[beyond] == surface[nearest])
    shown = np.where(index >= 0, surface[index] == surface[nearest], distance <= MIRROR_PX)
    return np.where(shown, np.where(same, beyond, nearest), np.int32(-1))
