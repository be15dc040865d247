# SPDX-License-Identifier: GPL-3.0-or-later
"""Sheets: the images in which islands of the atlas are filtered together, packed tighter than the pages.

Surfaces that exchange no light never meet in one sheet (but for lumps of small components), so that a change in one
room leaves what the filter made of the other. The layout follows from atlas and components alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

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
    """m texels of k surfaces on an image of (h, w) pixels, b of which are mirrored borders.

    Texels and surfaces are numbered from 0 within the sheet; ``texels`` says which they are.
    """

    texels: Int32  # (m,) ascending
    surface: Int32  # (m,) of each texel
    sums: sparse.csr_matrix  # (k, m) float64, adds up the texels of each surface
    row: Int32  # (m,)
    col: Int32  # (m,)
    index: Int32  # (h, w) texel of each pixel, -1 where there is none
    border: Int32  # (b,) flat pixel
    centre: Int32  # (b,) texel that the border is mirrored around

    @property
    def pixel(self) -> Int32:
        """(m,) flat pixel of each texel."""
        return self.row * np.int32(self.index.shape[1]) + self.col

    def sources(self, stand_in: Int32) -> Int32:
        """(h * w,) texel to show at each pixel; m for none. ``stand_in`` (m,), see ``texels.stand_ins``.

        Pixels of texels that are not valid, and of borders, show the texel as far on the other side of the nearest
        valid one (within the image), or that one itself where the island ends before.
        """
        own = np.arange(len(stand_in), dtype=np.int32)
        lost = np.flatnonzero(stand_in != own)
        pixel = np.concatenate([self.pixel[lost], self.border])
        nearest = stand_in[np.concatenate([lost, self.centre])]
        height, width = self.index.shape
        row = np.clip(2 * self.row[nearest] - pixel // width, 0, height - 1)
        col = np.clip(2 * self.col[nearest] - pixel % width, 0, width - 1)
        beyond = self.index[row, col]
        same = (beyond >= 0) & (self.surface[beyond] == self.surface[nearest]) & (stand_in[beyond] == beyond)
        none = np.int32(len(stand_in))
        shown = np.where(self.index >= 0, self.index, none).ravel()
        shown[pixel] = np.where(nearest < 0, none, np.where(same, beyond, nearest))
        return shown


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
    part = np.minimum(before * parts // np.maximum(total[group[order]], 1), parts - 1)
    sheet = np.zeros(len(group), np.int64)
    sheet[order] = group[order] * (int(part.max(initial=0)) + 1) + part
    return np.asarray(np.unique(sheet, return_inverse=True)[1], np.int32)


def make_sheet(texels: Int32, surface: Int32, cluster: Int32, row: Int32, col: Int32) -> Sheet:
    """The sheet of ``texels`` (m,) of given surfaces, at page pixels ``row`` and ``col``; all (m,).

    Islands of one ``cluster`` (m,) lie on one page; they keep their places to each other where that is tighter.
    """
    local = np.unique(surface, return_inverse=True)[1]
    block = _blocks(local, np.unique(cluster, return_inverse=True)[1], row, col)
    low, size = _boxes(block, row, col)
    corner, width, height = _packed(size + GAP_PX)
    row = (row + (corner[:, 1] - low[:, 0])[block]).astype(np.int32)
    col = (col + (corner[:, 0] - low[:, 1])[block]).astype(np.int32)
    index = np.full((height, width), -1, np.int32)
    index[row, col] = np.arange(len(texels), dtype=np.int32)
    near_row, near_col, distance = nearest_pixel(index)
    border = np.flatnonzero((index < 0) & (distance <= MIRROR_PX)).astype(np.int32)
    ones = np.ones(len(texels)), (local, np.arange(len(texels)))
    return Sheet(
        texels=texels,
        surface=local.astype(np.int32),
        sums=sparse.csr_matrix(ones),
        row=row,
        col=col,
        index=index,
        border=border,
        centre=index[near_row, near_col].ravel()[border],
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
    area, (widest, tallest) = int(sizes.prod(axis=1).sum()), sizes.max(axis=0).tolist()
    square = area**0.5
    least = _aligned(max(widest, min(round(square / MOST_STRETCH), area // tallest)))
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
