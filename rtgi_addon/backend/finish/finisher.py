# SPDX-License-Identifier: GPL-3.0-or-later
"""From gathered texels to light-map pages: texels under geometry filled, noise filtered, seams closed, borders padded.

The last stages of a frame; what they need of the atlas is made once per session.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..scene import Atlas, Bool, Float32, Int32, Scene
from ..settings import BakeSettings
from ..surface.texels import Texels
from .denoise import MapDenoiser
from .dilate import DilationMap
from .oidn import Denoiser, OidnError, find_oidn
from .seams import SeamMatcher


class Finisher:
    """The last stages of one atlas. Holds the denoiser, which :meth:`close` gives back."""

    def __init__(
        self, scene: Scene, atlas: Atlas, texels: Texels, settings: BakeSettings, oidn_paths: Sequence[Path]
    ) -> None:
        self._texels = texels
        self._dilation = DilationMap(texels.index)
        self._seams = SeamMatcher(scene, atlas, self._dilation, texels.surface) if settings.seams else None
        self.warnings: list[str] = []
        self._oidn = self._open_oidn(settings, oidn_paths)
        self._denoiser = MapDenoiser(self._oidn, texels.index, texels.surface) if self._oidn else None

    def close(self) -> None:
        """Give the denoiser's threads back."""
        if self._oidn is not None:
            self._oidn.close()
            self._oidn = None
            self._denoiser = None

    def _open_oidn(self, settings: BakeSettings, paths: Sequence[Path]) -> Denoiser | None:
        if not settings.denoise or not self._texels.count:
            return None
        library = find_oidn(paths)
        if library is None:
            self.warnings.append("Open Image Denoise was not found: maps are not denoised; use --quality final")
            return None
        try:
            return Denoiser(library, threads=settings.threads)
        except OidnError as fault:
            self.warnings.append(f"{fault}: maps are not denoised; use --quality final")
            return None

    def fill(self, values: Float32, valid: Bool) -> Float32:
        """``values`` (n, 3) with each texel that is not ``valid`` taking the nearest valid one of its surface; zero
        where a surface has none."""
        if valid.all():
            return values
        source = nearest_valid(self._texels, valid)
        return np.where((source >= 0)[:, None], values[source], np.float32(0))

    def denoise(self, values: Float32, valid: Bool) -> Float32:
        """``values`` (n, 3) filtered; texels that are not ``valid`` get what the filter makes of their surroundings.

        Where there is no denoiser they are only filled.
        """
        if self._denoiser is None:
            return self.fill(values, valid)
        return self._denoiser.denoise(np.maximum(values, 0), valid=valid)

    def close_seams(self, values: Float32) -> Float32:
        """``values`` (n, 3) matched along the cuts through smooth surfaces, or as they are when not asked for."""
        return values if self._seams is None else self._seams.match(values)

    def to_pages(self, values: Float32) -> Float32:
        """(pages, H, W, 3) pages of ``values`` (n, 3), with padding."""
        return self._dilation.apply(values)

    def valid_pages(self, valid: Bool) -> Bool:
        """(pages, H, W) pixels that are valid texels."""
        pages = np.zeros(self._texels.index.shape, np.bool_)
        t = self._texels
        pages[t.page, t.row, t.col] = valid
        return pages


def nearest_valid(texels: Texels, valid: Bool) -> Int32:
    """(n,) for each texel the nearest valid one of its surface on the page, itself where valid, -1 where none is."""
    source = np.arange(texels.count, dtype=np.int32)
    lost, good = np.nonzero(~valid)[0], np.nonzero(valid)[0]
    if not len(good):
        return np.full(texels.count, -1, np.int32)
    # Surfaces lie so far apart along the third axis that the nearest texel is one's own surface's if it has any.
    apart = 4.0 * max(texels.index.shape[1:])
    place = np.stack([texels.row, texels.col, texels.surface * apart], axis=1).astype(np.float64)
    _, nearest = cKDTree(place[good]).query(place[lost])
    found = good[nearest]
    source[lost] = np.where(texels.surface[found] == texels.surface[lost], found, -1)
    return source
