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

from .dilate import nearest_pixel
from .oidn import Denoiser, require_finite
from .scene import Float32, Float64, Int32

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
        self._surface = surface
        self._texels_of_surface = np.maximum(np.bincount(surface), 1)
        self._crops = [_make_crop(page, surface) for page in index if (page >= 0).any()]

    def denoise(self, values: Float32) -> Float32:
        """``values`` (n, 3) >= 0 without their noise; each surface keeps its mean (within ``MOST_GAIN``).

        Raises ValueError where a value is not finite or is negative.
        """
        if values.shape != (len(self._surface), 3):
            raise ValueError(f"values of shape {values.shape}: must be ({len(self._surface)}, 3)")
        require_finite(values)
        if values.size and values.min() < 0:
            raise ValueError(f"{np.count_nonzero((values < 0).any(axis=1))} texels are negative")
        mean = self._means(values)
        relative = self._relative_to(mean, values)
        shown = np.concatenate([relative, np.ones((1, 3), np.float32)])
        filtered = np.zeros_like(relative)
        for crop in self._crops:
            image = self._denoiser.denoise(shown[crop.source], input_scale=INPUT_SCALE)
            filtered[crop.texels] = image.reshape(-1, 3)[crop.pixels]
        # The mean of ``relative`` is 1.
        gain = 1 / np.maximum(self._means(filtered), 1 / MOST_GAIN)
        return filtered * (gain * mean).astype(np.float32)[self._surface]

    def _means(self, values: Float32) -> Float64:
        """(surfaces, 3) mean of each surface."""
        sums = [np.bincount(self._surface, weights=channel) for channel in values.T]
        return np.asarray(np.stack(sums, axis=1) / self._texels_of_surface[:, None], np.float64)

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


def _make_crop(page: Int32, surface: Int32) -> _Crop:
    rows, cols = np.flatnonzero((page >= 0).any(axis=1)), np.flatnonzero((page >= 0).any(axis=0))
    used = page[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    size = [-(-(side + 2 * FRAME_PX) // ALIGN_PX) * ALIGN_PX for side in used.shape]
    index = np.full(size, -1, np.int32)
    index[FRAME_PX : FRAME_PX + used.shape[0], FRAME_PX : FRAME_PX + used.shape[1]] = used
    source = np.where(index >= 0, index, _mirrored(index, surface))
    pixels = np.flatnonzero(index >= 0)
    return _Crop(np.where(source >= 0, source, np.int32(len(surface))), index.ravel()[pixels], pixels.astype(np.int32))


def _mirrored(index: Int32, surface: Int32) -> Int32:
    """(h, w) for pixels within MIRROR_PX of an island: the texel as far inside it, else its nearest; -1 beyond."""
    rows, cols, distance = nearest_pixel(index)
    height, width = index.shape
    inside_row = np.clip(2 * rows - np.arange(height)[:, None], 0, height - 1)
    inside_col = np.clip(2 * cols - np.arange(width)[None, :], 0, width - 1)
    nearest, inside = index[rows, cols], index[inside_row, inside_col]
    same = (inside >= 0) & (surface[inside] == surface[nearest])
    return np.where(distance <= MIRROR_PX, np.where(same, inside, nearest), np.int32(-1))
