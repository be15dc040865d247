# SPDX-License-Identifier: GPL-3.0-or-later
"""Padding of light-map pages: nearest texel, no crossing, borders right for bilinear lookups."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.finish.dilate import DilationMap, nearest_texel


def islands(seed: int, pages: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Random overlapping rectangles: (pages, size, size) texel index and (n,) island of each texel."""
    rng = np.random.default_rng(seed)
    island = np.full((pages, size, size), -1)
    for number in range(5):
        page, row, col = rng.integers(pages), *rng.integers(0, size, 2)
        island[page, row : row + rng.integers(1, 9), col : col + rng.integers(1, 9)] = number
    valid = island >= 0
    index = np.full(island.shape, -1, np.int32)
    index[valid] = np.arange(valid.sum())
    return index, island[valid]


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    pages=st.integers(1, 2),
    size=st.integers(2, 24),
    padding=st.sampled_from([0.0, 1.0, 1.5, 4.0, 100.0]),
)
def test_every_pixel_shows_its_nearest_texel(seed, pages, size, padding):
    index, _ = islands(seed, pages, size)
    dilation = DilationMap(index, padding)
    np.testing.assert_array_equal(dilation.texel[index >= 0], index[index >= 0])
    for page in range(pages):
        own = np.argwhere(index[page] >= 0)
        for row, col in np.ndindex(size, size):
            to_texels = np.hypot(*(own - [row, col]).T) if len(own) else np.array([np.inf])
            shown = dilation.texel[page, row, col]
            if to_texels.min() > padding:
                assert shown == -1
            else:
                place = np.argwhere(index[page] == shown)[0]
                assert np.isclose(np.hypot(*(place - [row, col])), to_texels.min())
    np.testing.assert_array_equal(dilation.filled, (dilation.texel >= 0) & (index < 0))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), channels=st.sampled_from([1, 3, 4]))
def test_pages_hold_texels_and_nothing_new(seed, channels):
    index, _ = islands(seed, 2, 20)
    values = np.random.default_rng(seed).random((index.max() + 1, channels)).astype(np.float32) + 1
    dilation = DilationMap(index)
    pages = dilation.apply(values)
    assert pages.shape == (2, 20, 20, channels) and pages.dtype == np.float32
    np.testing.assert_array_equal(pages[index >= 0], values)
    assert not pages[(index < 0) & ~dilation.filled].any()
    if len(values):  # linear, and a constant stays that constant
        np.testing.assert_array_equal(dilation.apply(values * 2), pages * 2)
        flat = dilation.apply(np.full_like(values, 7))
        assert set(np.unique(flat)) <= {0.0, 7.0} and (flat[dilation.filled] == 7).all()


def test_two_islands_share_the_gap_and_never_mix():
    island = np.full((1, 20, 24), -1)
    island[0, 4:16, 2:10], island[0, 4:16, 14:22] = 0, 1
    index = np.full(island.shape, -1, np.int32)
    index[island >= 0] = np.arange((island >= 0).sum())
    values = np.repeat(island[island >= 0][:, None] * 1000.0, 3, axis=1).astype(np.float32)
    page = DilationMap(index, 4).apply(values)[0, :, :, 0]
    assert not page[:, :12].any() and (page[4:16, 12:] == 1000).all()
    # Bilinear lookups anywhere on either island, up to its outermost edge, see that island alone.
    for low, high, value in ((2, 10, 0), (14, 22, 1000)):
        for x in np.linspace(low, high, 33) - 0.5:
            left = int(np.floor(x))
            assert (page[3:17, left : left + 2] == value).all()


def test_page_without_texels_stays_black():
    index = np.full((2, 8, 8), -1, np.int32)
    index[1, 3, 3] = 0
    pages = DilationMap(index, 1).apply(np.ones((1, 3), np.float32))
    assert not pages[0].any() and pages[1, :, :, 0].sum() == 5
    assert DilationMap(index[:0]).apply(np.zeros((0, 3), np.float32)).shape == (0, 8, 8, 3)
    assert (nearest_texel(index[0], 3) == -1).all()
