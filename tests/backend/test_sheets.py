# SPDX-License-Identifier: GPL-3.0-or-later
"""Sheets: which surfaces share one, how tight islands lie, and what their borders show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.finish.sheets import (
    ALIGN_PX,
    GAP_PX,
    LEAST_PX,
    LUMP_TEXELS,
    MIRROR_PX,
    SHEET_TEXELS,
    SMALL_TEXELS,
    Sheet,
    make_sheet,
    sheet_of_surfaces,
)

COUNTS = st.lists(st.sampled_from([0, 1, 16, 300, 1023, 1024, 5000, 40000, 200000]), min_size=1, max_size=30)


def boxes_sheet(sizes, *, cluster=None, at=None) -> Sheet:
    """The sheet of full boxes (height, width), each far from the others or at pixels ``at``."""
    start = [(0, 1000 * k) for k in range(len(sizes))] if at is None else at
    cells = [(k, r + row, c + col) for k, ((h, w), (r, c)) in enumerate(zip(sizes, start, strict=True))
             for row in range(h) for col in range(w)]  # fmt: skip
    surface, row, col = np.array(cells, np.int32).T
    group = surface if cluster is None else np.array(cluster)[surface]
    return make_sheet(np.arange(len(cells), dtype=np.int32), surface, group, row, col)


@settings(max_examples=100, deadline=None)
@given(counts=COUNTS, seed=st.integers(0, 2**32 - 1), labels=st.integers(1, 8))
def test_components_share_no_sheet_but_small_ones(counts, seed, labels):
    rng = np.random.default_rng(seed)
    counts = np.int32(counts)
    component = rng.integers(0, labels, len(counts)).astype(np.int32)
    sheet = sheet_of_surfaces(counts, component)
    size = np.bincount(component, weights=counts)
    for number in range(sheet.max() + 1):
        on = np.flatnonzero(sheet == number)
        here = np.unique(component[on])
        assert len(on) and (len(here) == 1 or (size[here] < SMALL_TEXELS).all())
        if len(here) > 1:
            assert counts[on].sum() < LUMP_TEXELS + SMALL_TEXELS
        # Only as large as asked for, give or take the island that is cut off last.
        assert counts[on].sum() <= 1.5 * SHEET_TEXELS + counts[on].max()
    small = size[(size > 0) & (size < SMALL_TEXELS)]
    lumps = {s for s, c in zip(sheet, component, strict=True) if 0 < size[c] < SMALL_TEXELS}
    assert len(lumps) <= small.sum() // LUMP_TEXELS + 1
    # Small components stay whole.
    for label in np.unique(component):
        assert size[label] >= SMALL_TEXELS or len(np.unique(sheet[component == label])) == 1
    # Names of components mean nothing.
    renamed = rng.permutation(labels)[component] * 17 + 3
    np.testing.assert_array_equal(sheet_of_surfaces(counts, renamed), sheet)


@settings(max_examples=60, deadline=None)
@given(
    sizes=st.lists(
        st.tuples(st.sampled_from([1, 2, 5, 13, 40]), st.sampled_from([1, 3, 9, 26])), min_size=1, max_size=25
    )
)
def test_islands_lie_whole_and_apart(sizes):
    sheet = boxes_sheet(sizes)
    height, width = sheet.index.shape
    assert height % ALIGN_PX == width % ALIGN_PX == 0 and min(height, width) >= LEAST_PX
    np.testing.assert_array_equal(sheet.index[sheet.row, sheet.col], np.arange(len(sheet.texels)))
    assert (sheet.index >= 0).sum() == len(sheet.texels)
    island = np.where(sheet.index >= 0, sheet.surface[sheet.index], -1)
    for number, (h, w) in enumerate(sizes):
        row, col = np.nonzero(island == number)
        assert (np.ptp(row) + 1, np.ptp(col) + 1) == (h, w)
        # Nothing else within the gap.
        around = island[max(row.min() - GAP_PX, 0) : row.max() + GAP_PX + 1,
                        max(col.min() - GAP_PX, 0) : col.max() + GAP_PX + 1]  # fmt: skip
        assert set(np.unique(around)) <= {-1, number}


def test_the_same_wherever_it_lies_on_the_page():
    sizes = [(40, 40), (7, 20), (20, 7)]
    a, b = boxes_sheet(sizes), boxes_sheet(sizes, at=[(500, 3), (2, 900), (77, 0)])
    np.testing.assert_array_equal(a.index, b.index)
    np.testing.assert_array_equal(
        a.sources(np.arange(1880, dtype=np.int32)), b.sources(np.arange(1880, dtype=np.int32))
    )


def test_a_cluster_keeps_its_places_where_that_is_tighter():
    """Sixteen single texels of one object, two apart: together 7 x 7 pixels instead of 16 times 4 x 4."""
    at = [(2 * (k // 4), 2 * (k % 4)) for k in range(16)]
    sheet = boxes_sheet([(1, 1)] * 16, cluster=[0] * 16, at=at)
    place = np.stack([sheet.row, sheet.col], axis=1)
    np.testing.assert_array_equal(place - place[0], at)
    wide = boxes_sheet([(1, 1)] * 16, cluster=[0] * 16, at=[(9 * r, 9 * c) for r, c in at])
    assert np.ptp(wide.row) < 30


def test_tighter_than_pages():
    """Five walls of a room, as on a page of 128 pixels that takes 144 x 144 with a frame: 30 % less."""
    sizes = [(41, 41)] * 5 + [(26, 14)] * 2 + [(13, 26)] * 2 + [(14, 13)] * 8
    sheet = boxes_sheet(sizes)
    assert sheet.index.size <= 0.75 * 144**2
    many = boxes_sheet([(h, w) for h in range(4, 24) for w in range(4, 24)])
    assert many.index.size < 1.15 * sum((h + GAP_PX) * (w + GAP_PX) for h in range(4, 24) for w in range(4, 24))


@pytest.mark.parametrize("size", [(1, 1), (1, 900), (900, 1), (300, 200)])
def test_any_island_has_a_sheet(size):
    sheet = boxes_sheet([size])
    assert len(sheet.texels) == size[0] * size[1] and (np.array(sheet.index.shape) < np.array(size) + 32).all()


def mirrored(sheet: Sheet, stand_in: np.ndarray, row: int, col: int, centre: int) -> int:
    """What a pixel shows that is mirrored around ``centre``, by the rule as it is told."""
    nearest = stand_in[centre]
    if nearest < 0:
        return len(stand_in)
    at = 2 * sheet.row[nearest] - row, 2 * sheet.col[nearest] - col
    beyond = sheet.index[tuple(min(max(x, 0), side - 1) for x, side in zip(at, sheet.index.shape, strict=True))]
    if beyond >= 0 and sheet.surface[beyond] == sheet.surface[nearest] and stand_in[beyond] == beyond:
        return beyond
    return nearest


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.1, 0.6, 1.0]))
def test_what_pixels_show(seed, share):
    rng = np.random.default_rng(seed)
    sheet = boxes_sheet([(9, 12), (1, 7), (1, 1), (5, 3)])
    place = np.stack([sheet.row, sheet.col], axis=1)
    stand_in = np.arange(len(place), dtype=np.int32)
    valid = rng.random(len(place)) >= share
    for lost in np.flatnonzero(~valid):
        near = np.flatnonzero(valid & (sheet.surface == sheet.surface[lost]))
        stand_in[lost] = near[((place[near] - place[lost]) ** 2).sum(axis=1).argmin()] if len(near) else -1
    shown = sheet.sources(stand_in).reshape(sheet.index.shape)
    np.testing.assert_array_equal(shown[sheet.row[valid], sheet.col[valid]], np.flatnonzero(valid))
    for row, col in np.ndindex(shown.shape):
        own = sheet.index[row, col]
        distance = np.hypot(*(place - [row, col]).T)
        if own < 0 and distance.min() > MIRROR_PX:
            assert shown[row, col] == len(place)
        else:
            near = [own] if own >= 0 else np.flatnonzero(distance == distance.min())
            assert shown[row, col] in [mirrored(sheet, stand_in, row, col, c) for c in near]
