# SPDX-License-Identifier: GPL-3.0-or-later
"""Sheets: the images in which islands of the atlas are filtered together, packed tighter than the pages.

Surfaces that exchange no light never meet in one sheet (but for lumps of small components), so that a change in one
room leaves what the filter made of the other. The layout follows from atlas and components alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..layout.skyline import orders, place
from ..scene import Bool, Int32
from .dilate import nearest_pixel

#: Width of the mirrored border. Wider ones meet their neighbours' and make patterns of their own.
MIRROR_PX = 2
#: Free pixels between two islands, shared by their mirrored borders. With 2 the error of large islands is a tenth
#: higher; the image's own border needs none, the filter knows images that end.
GAP_PX = 3
#: OIDN pads to multiples of this with zeros, which would darken the last rows.
ALIGN_PX = 16
#: Images of 16 pixels are all border.
LEAST_PX = 32
#: Components of fewer texels share sheets of about LUMP_TEXELS: hundreds of tiny ones are not hundreds of calls.
SMALL_TEXELS = 1024
LUMP_TEXELS = 4096
#: Components of more texels are cut into sheets of about so many.
SHEET_TEXELS = 32768
#: A layout tries widths and sequences until it has placed so many rectangles, 10 µs each. Widths are within a factor
#: of MOST_STRETCH of a square's: long strips are all border.
MOST_PLACED = 4000
MOST_STRETCH = 1.5


@dataclass(frozen=True)
class Sheet:
    """m texels of k surfaces on an image of (h, w) pixels, p of which show something.

    Texels and surfaces are numbered from 0 within the sheet; ``texels`` and ``surfaces`` say which they are.
    """

    surfaces: Int32  # (k,) ascending
    texels: Int32  # (m,) ascending
    surface: Int32  # (m,) of each texel
    row: Int32  # (m,)
    col: Int32  # (m,)
    index: Int32  # (h, w) texel of each pixel, -1 where there is none
    shown: Int32  # (p,) flat pixel: those of texels, then their mirrored borders
    centre: Int32  # (p,) texel that the pixel lies on, or is mirrored around

    def sources(self, stand_in: Int32) -> Int32:
        """(p,) texel to show at each of the pixels; -1 for none. ``stand_in`` (m,), see ``texels.stand_ins``.

        Pixels of texels that are not valid, and of borders, show the texel as far on the other side of the nearest
        valid one, or that one itself where the island ends before.
        """
        height, width = self.index.shape
        nearest = stand_in[self.centre]
        row = np.clip(2 * self.row[nearest] - self.shown // width, 0, height - 1)
        col = np.clip(2 * self.col[nearest] - self.shown % width, 0, width - 1)
        beyond = self.index[row, col]
        same = (beyond >= 0) & (self.surface[beyond] == self.surface[nearest])
        same &= stand_in[beyond] == beyond
        return np.where(nearest < 0, np.int32(-1), np.where(same, beyond, nearest)).astype(np.int32)


def sheet_of_surfaces(counts: Int32, component: Int32) -> Int32:
    """(surfaces,) number of the sheet of each, by the texels that they and their component (surfaces,) have.

    How components are numbered does not matter; they are taken in the order of their first surfaces.
    """
    _, first, label = np.unique(component, return_index=True, return_inverse=True)
    label = np.argsort(np.argsort(first))[label]
    size = np.bincount(label, weights=counts).astype(np.int64)
    lumped = np.where(size < SMALL_TEXELS, size, 0)
    lump = np.where(lumped > 0, (np.cumsum(lumped) - lumped) // LUMP_TEXELS, len(size) + np.arange(len(size)))
    _, group = np.unique(lump[label], return_inverse=True)
    order = np.argsort(group, kind="stable")
    total = np.bincount(group, weights=counts).astype(np.int64)
    before = np.cumsum(counts[order]) - counts[order] - np.repeat(np.cumsum(total) - total, np.bincount(group))
    parts = np.maximum(np.round(total / SHEET_TEXELS), 1).astype(np.int64)[group[order]]
    part = before * parts // np.maximum(total[group[order]], 1)
    sheet = np.zeros(len(group), np.int64)
    sheet[order] = group[order] * (int(part.max(initial=0)) + 1) + part
    return np.asarray(np.unique(sheet, return_inverse=True)[1], np.int32)


def make_sheet(texels: Int32, surface: Int32, cluster: Int32, row: Int32, col: Int32) -> Sheet:
    """The sheet of ``texels`` (m,) of given surfaces, at page pixels ``row`` and ``col``; all (m,).

    Islands of one ``cluster`` (m,) lie on one page; they keep their places to each other where that is tighter.
    """
    surfaces, local = np.unique(surface, return_inverse=True)
    block = _blocks(local, np.unique(cluster, return_inverse=True)[1], row, col)
    low, size = _boxes(block, row, col)
    corner, width, height = _packed(size + GAP_PX)
    row = (row + (corner[:, 1] - low[:, 0])[block]).astype(np.int32)
    col = (col + (corner[:, 0] - low[:, 1])[block]).astype(np.int32)
    index = np.full((height, width), -1, np.int32)
    index[row, col] = np.arange(len(texels), dtype=np.int32)
    near_row, near_col, distance = nearest_pixel(index)
    border = np.flatnonzero((index < 0) & (distance <= MIRROR_PX))
    own = row * np.int32(width) + col
    return Sheet(
        surfaces=surfaces.astype(np.int32),
        texels=texels,
        surface=local.astype(np.int32),
        row=row,
        col=col,
        index=index,
        shown=np.concatenate([own, border]).astype(np.int32),
        centre=np.concatenate([index[row, col], index[near_row, near_col].ravel()[border]]),
    )


def _blocks(surface: Int32, cluster: Int32, row: Int32, col: Int32) -> Int32:
    """(m,) number of the rectangle that each texel is packed with: its surface, or its whole cluster."""
    of_surface = np.zeros(int(surface.max()) + 1, np.int64)
    of_surface[surface] = cluster
    apart = np.bincount(of_surface, weights=(_boxes(surface, row, col)[1] + GAP_PX).prod(axis=1))
    whole: Bool = (_boxes(cluster, row, col)[1] + GAP_PX).prod(axis=1) < apart
    key = np.where(whole[cluster], cluster, len(whole) + surface)
    return np.asarray(np.unique(key, return_inverse=True)[1], np.int32)


def _boxes(number: Int32, row: Int32, col: Int32) -> tuple[Int32, Int32]:
    """(b, 2) lowest (row, col) and (b, 2) size (width, height) of the pixels of each number 0..b-1; none is empty."""
    order = np.argsort(number, kind="stable")
    start = np.flatnonzero(np.diff(number[order], prepend=-1))
    at = np.stack([row, col], axis=1)[order]
    low: Int32 = np.minimum.reduceat(at, start)
    high: Int32 = np.maximum.reduceat(at, start)
    return low, (high - low + 1)[:, ::-1]


def _packed(sizes: Int32) -> tuple[Int32, int, int]:
    """(b, 2) corners (x, y) of rectangles (b, 2) in the smallest image found, and its width and height.

    The rectangles' last GAP_PX may hang over.
    """
    square = float(sizes.prod(axis=1).sum()) ** 0.5
    least = max(_aligned(int(sizes[:, 0].max())), _aligned(round(square / MOST_STRETCH)))
    widths = range(least, max(least, _aligned(round(square * MOST_STRETCH))) + 1, ALIGN_PX)
    tries = [(width, order) for width in sorted(widths, key=lambda w: abs(w - square)) for order in range(4)]
    sequences = orders(sizes, several=True)
    best: tuple[int, Int32, int, int] | None = None
    for width, order in tries[: max(1, MOST_PLACED // len(sizes))]:
        corner, reached = place(sizes, sequences[order], width=width + GAP_PX, height=int(sizes[:, 1].sum()))
        height = _aligned(reached)
        if best is None or width * height < best[0]:
            best = width * height, corner, width, height
    assert best is not None
    return best[1:]


def _aligned(side: int) -> int:
    """Pixels for rectangles that reach to ``side``, of which the last GAP_PX may hang over."""
    return max(LEAST_PX, -(-(side - GAP_PX) // ALIGN_PX) * ALIGN_PX)
