# SPDX-License-Identifier: GPL-3.0-or-later
"""Denoising of light maps: OIDN over sheets of islands, without light passing between surfaces.

Each surface is divided by its own mean before the filter and multiplied after it, so a bright surface beside a dark
one on its sheet looks like its equal and nothing bleeds; the mean of each surface is kept. Pixels around an island
mirror it. In a box of islands of 16 x 16 texels with 37 % noise that leaves 9 % error; black pixels around them left
13 %, and repeated border texels 30 %, since the filter takes such streaks for structure.
Sheets whose texels are as they were in the last call keep their result.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..scene import Bool, Float32, Float64, Int32
from .oidn import Denoiser, ImageFilter, require_finite
from .sheets import ALIGN_PX, Sheet, make_sheet, sheet_of_surfaces

#: Surfaces have mean 1 when they are filtered; a fixed scale keeps one surface's change from touching the others.
INPUT_SCALE = 0.3
#: The filter may lose light (fireflies that it takes out whole); giving back more than this would only invent.
MOST_GAIN = 2.0
#: W/m² that count as none: what lies below cannot be brought to mean 1 in float32.
DARK = 1e-30
#: What the filter makes of grey is read off an image of this size: by a few per mille less or more than grey near the
#: image's border, by 4 % in its corners (small network: 20 %), and that is taken back.
FLAT_PX = 64


@dataclass
class _Kept:
    """A sheet and what the last calls made of it, by the key of the call."""

    sheet: Sheet
    inverse_flat: Float32  # (m, 3) takes back what the filter makes of grey there
    stand_in: Int32 | None = None  # (m,) that ``sources`` are for
    sources: Int32 | None = None  # (h * w,) see Sheet.sources
    results: dict[str, tuple[Float32, Int32, Float32]] = field(default_factory=dict)  # values, stand-ins, result


class MapDenoiser:
    """Denoises values on the n texels of one atlas; built once for it. The ``denoiser`` is the caller's to close.

    ``filtered``: texels that the last call had to filter.
    """

    def __init__(self, denoiser: Denoiser, index: Int32, surface: Int32, cluster: Int32 | None = None) -> None:
        """``index`` (pages, H, W): texel of each pixel, -1 where there is none; ``surface`` (n,) of each texel.

        Islands of one ``cluster`` (n,) may be moved together; without it each goes by itself.
        """
        self.filtered = 0
        self._denoiser = denoiser
        self._surface = surface
        self._counts = np.bincount(surface)
        at = np.flatnonzero(index >= 0)
        at = at[np.argsort(index.ravel()[at])]  # of each texel
        page, self._row, self._col = (x.astype(np.int32) for x in np.unravel_index(at, index.shape))
        self._cluster = (surface if cluster is None else cluster).astype(np.int64) * len(index) + page
        self._component: Int32 | None = None  # that the sheets are for
        self._kept: dict[bytes, _Kept] = {}  # by the surfaces on the sheet
        self._local = np.zeros(len(surface), np.int32)  # number of each texel on its sheet
        self._filters: dict[tuple[int, ...], ImageFilter] = {}  # by image size
        self._flat = denoiser.denoise(np.ones((FLAT_PX, FLAT_PX, 3), np.float32), input_scale=INPUT_SCALE)

    def denoise(
        self, values: Float32, *, stand_in: Int32 | None = None, component: Int32 | None = None, key: str = ""
    ) -> Float32:
        """``values`` (n, 3) >= 0 without their noise; each surface keeps its mean (within ``MOST_GAIN``).

        Texels that are not their own ``stand_in`` (n,) (see ``texels.stand_ins``) are not looked at; they get what
        the filter makes of their surroundings on the surface, black where it has no stand-in. Surfaces of different
        ``component`` (surfaces,) share no sheet, but for small ones. Calls with one ``key`` share a memory; the
        result does not depend on it. Raises ValueError where a value is not finite or is negative.
        """
        if values.shape != (len(self._surface), 3):
            raise ValueError(f"values of shape {values.shape}: must be ({len(self._surface)}, 3)")
        own = np.arange(len(values), dtype=np.int32)
        stand_in = own if stand_in is None else stand_in
        known = _known(values, stand_in == own)
        self._lay_out(component)
        self.filtered = 0
        result = np.zeros_like(known)
        for kept in self._kept.values():
            texels = kept.sheet.texels
            nearest = stand_in.take(texels)
            nearest = np.where(nearest < 0, np.int32(-1), self._local.take(nearest, mode="clip"))
            result[texels] = self._on_sheet(kept, known.take(texels, axis=0), nearest, key)
        return result

    def _lay_out(self, component: Int32 | None) -> None:
        """Sheets for these components, with what is known of those that stay."""
        if component is None:
            component = np.zeros(len(self._counts), np.int32)
        component = component[: len(self._counts)]  # surfaces after the last texel's have none
        if self._component is not None and np.array_equal(component, self._component):
            return
        self._component = component.copy()
        before, self._kept = self._kept, {}
        sheet = sheet_of_surfaces(self._counts, component)[self._surface]
        order = np.argsort(sheet, kind="stable").astype(np.int32)
        for texels in np.split(order, np.flatnonzero(np.diff(sheet[order])) + 1) if len(order) else []:
            surface = self._surface[texels]
            name = np.unique(surface).tobytes()
            self._kept[name] = before.get(name) or self._started(
                make_sheet(texels, surface, self._cluster[texels], self._row[texels], self._col[texels])
            )
            self._local[texels] = np.arange(len(texels), dtype=np.int32)
        shapes = {kept.sheet.index.shape for kept in self._kept.values()}
        for shape in [shape for shape in self._filters if shape not in shapes]:
            self._filters.pop(shape).close()

    def _started(self, sheet: Sheet) -> _Kept:
        height, width = sheet.index.shape
        return _Kept(sheet, 1 / self._flat[_flat_place(sheet.row, height), _flat_place(sheet.col, width)])

    def _on_sheet(self, kept: _Kept, values: Float32, stand_in: Int32, key: str) -> Float32:
        """(m, 3) of one sheet; ``values`` (m, 3), zero where not valid; ``stand_in`` (m,) on the sheet."""
        if key in kept.results:
            old_values, old_stand_in, old_result = kept.results[key]
            if np.array_equal(stand_in, old_stand_in) and _same_bits(values, old_values):
                return old_result
        if kept.sources is None or kept.stand_in is None or not np.array_equal(stand_in, kept.stand_in):
            kept.stand_in, kept.sources = stand_in, kept.sheet.sources(stand_in)
        result = self._filtered(kept, values, kept.sources, stand_in == np.arange(len(stand_in)))
        self.filtered += len(values)
        kept.results[key] = values, stand_in, result
        return result

    def _filtered(self, kept: _Kept, values: Float32, sources: Int32, seen: Bool) -> Float32:
        sheet = kept.sheet
        count = np.maximum(sheet.sums @ seen, 1)[:, None]
        mean = (sheet.sums @ values) / count
        relative = _relative_to(mean, values, sheet.surface)
        shown = np.concatenate([relative, np.ones((1, 3), np.float32)])
        opened = self._filter_of(sheet.index.shape)
        shown.take(sources, axis=0, out=opened.color.reshape(-1, 3), mode="clip")
        opened.run()
        filtered = opened.output.reshape(-1, 3).take(sheet.pixel, axis=0) * kept.inverse_flat
        # The mean of ``relative`` is 1.
        after = sheet.sums @ (filtered if seen.all() else filtered * seen[:, None]) / count
        gain = 1 / np.maximum(after, 1 / MOST_GAIN)
        return np.asarray(filtered * (gain * mean).astype(np.float32).take(sheet.surface, axis=0), np.float32)

    def _filter_of(self, shape: tuple[int, ...]) -> ImageFilter:
        if shape not in self._filters:
            self._filters[shape] = self._denoiser.filter_of(*shape, input_scale=INPUT_SCALE)
        return self._filters[shape]


def _flat_place(at: Int32, side: int) -> Int32:
    """Where in FLAT_PX a pixel at ``at`` of ``side`` lies: as far from the nearer end, and at the same place of the
    filter's grid of ALIGN_PX.
    """
    half = FLAT_PX // 2
    inside = np.where(at < half, at, half + at % ALIGN_PX)
    return np.where((side - at <= half) & (2 * at >= side), FLAT_PX - side + at, inside)


def _known(values: Float32, seen: Bool) -> Float32:
    """``values`` (n, 3) where they are ``seen`` (n,), else zero; raises ValueError where those cannot be light."""
    known = values.copy()
    known[~seen] = 0
    if len(known) and not (known.min() >= 0 and known.max() < np.inf):
        require_finite(values[seen])
        raise ValueError(f"{np.count_nonzero((known < 0).any(axis=1))} texels are negative")
    return known


def _same_bits(a: Float32, b: Float32) -> bool:
    return np.array_equal(a.view(np.uint32), b.view(np.uint32))


def _relative_to(mean: Float64, values: Float32, surface: Int32) -> Float32:
    """``values`` over their surface's ``mean`` (k, 3). A channel without light shows the others' average, or 1: a
    colour at the edge of what there is would get a tint from the filter.
    """
    lit = mean > DARK
    inverse = np.divide(1, mean, out=np.zeros_like(mean), where=lit).astype(np.float32)
    relative: Float32 = values * inverse.take(surface, axis=0)
    if not lit.all():
        rows = np.flatnonzero(~lit.all(axis=1)[surface])
        part, shown = relative[rows], lit[surface[rows]]
        channels = shown.sum(axis=1)
        grey = np.where(channels > 0, part.sum(axis=1) / np.maximum(channels, 1), 1).astype(np.float32)
        relative[rows] = np.where(shown, part, grey[:, None])
    return relative
