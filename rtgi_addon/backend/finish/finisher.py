# SPDX-License-Identifier: GPL-3.0-or-later
"""From gathered texels to light-map pages: texels under geometry filled, noise filtered, seams closed, borders padded.

The last stages of a frame; what they need of the atlas is made once per session.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ..scene import Atlas, Bool, Float32, Int32, Scene
from ..settings import BakeSettings, Quality
from ..surface.texels import Texels
from .denoise import MapDenoiser
from .dilate import PADDING_PX, DilationMap
from .oidn import Denoiser, OidnError, find_oidn
from .seams import SeamMatcher


class OidnOpening:
    """Open Image Denoise being opened beside other work: loading it takes as long as rasterising a small atlas."""

    def __init__(self, settings: BakeSettings, paths: Sequence[Path]) -> None:
        self._thread = ThreadPoolExecutor(1)
        self._opened = self._thread.submit(_open_oidn, settings, paths)

    def result(self) -> tuple[Denoiser | None, str | None]:
        """The denoiser, or why there is none where one was asked for."""
        opened = self._opened.result()
        self._thread.shutdown()
        return opened


def _open_oidn(settings: BakeSettings, paths: Sequence[Path]) -> tuple[Denoiser | None, str | None]:
    if not settings.denoise:
        return None, None
    library = find_oidn(paths)
    if library is None:
        return None, "Open Image Denoise was not found: maps are not denoised; use --quality final"
    try:
        # With a draft's few rays the small network's error does not show.
        fast = settings.quality is Quality.DRAFT and settings.target_error is None
        return Denoiser(library, threads=settings.threads, fast=fast), None
    except OidnError as fault:
        return None, f"{fault}: maps are not denoised; use --quality final"


class Finisher:
    """The last stages of one atlas. Holds the denoiser, which :meth:`close` gives back."""

    def __init__(self, scene: Scene, atlas: Atlas, texels: Texels, settings: BakeSettings, oidn: OidnOpening) -> None:
        self._texels = texels
        self._dilation = DilationMap(texels.index)
        self._seams = SeamMatcher(scene, atlas, self._dilation, texels.surface) if settings.seams else None
        self._oidn, warning = oidn.result()
        self.warnings = [] if warning is None else [warning]
        cluster = 2 * texels.instance + texels.side
        self._denoiser = MapDenoiser(self._oidn, texels.index, texels.surface, cluster) if self._oidn else None

    def close(self) -> None:
        """Give the denoiser's threads back."""
        if self._oidn is not None:
            self._oidn.close()
            self._oidn = None
            self._denoiser = None

    @property
    def filtered(self) -> int:
        """Texels that the last :meth:`denoise` had to filter; the others' result was kept."""
        return self._denoiser.filtered if self._denoiser else 0

    def denoise(
        self, values: Float32, stand_in: Int32, *, component: Int32 | None = None, half: bool = False
    ) -> Float32:
        """``values`` (n, 3) filtered; texels that are not valid get what the filter makes of their surroundings.

        ``component`` (surfaces,): surfaces of different ones exchange no light, and what changes in one leaves the
        others' bits; None: all are one. Light of ``half`` the rays has a memory of its own.
        Where there is no denoiser values are only filled.
        """
        if self._denoiser is None or not len(values):
            return fill(values, stand_in)
        return self._denoiser.denoise(
            np.maximum(values, 0), stand_in=stand_in, component=component, key="half" if half else "full"
        )

    def close_seams(self, values: Float32) -> Float32:
        """``values`` (n, 3) matched along the cuts through smooth surfaces, or as they are when not asked for."""
        return values if self._seams is None else self._seams.match(values)

    def to_pages(self, values: Float32, stand_in: Int32) -> Float32:
        """(pages, H, W, 3) pages of ``values`` (n, 3), with padding; black where the ``stand_in`` (n,) is far away.

        Light is carried under other geometry as far as lookups beside it reach, like padding. What lies deeper, or on
        the far side of a wall that the surface goes through, is as dark as its rays find it.
        """
        away = np.maximum(*(np.abs(at.take(stand_in, mode="clip") - at) for at in (self._texels.row, self._texels.col)))
        deep = (stand_in < 0) | (away > PADDING_PX)
        return self._dilation.apply(np.where(deep[:, None], np.float32(0), values) if deep.any() else values)

    def valid_pages(self, valid: Bool) -> Bool:
        """(pages, H, W) pixels that are valid texels."""
        pages = np.zeros(self._texels.index.shape, np.bool_)
        t = self._texels
        pages[t.page, t.row, t.col] = valid
        return pages


def fill(values: Float32, stand_in: Int32) -> Float32:
    """``values`` (n, 3) of each texel's stand-in (see ``texels.stand_ins``); zero where it has none."""
    return np.where((stand_in >= 0)[:, None], values[stand_in], np.float32(0))
