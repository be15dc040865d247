# SPDX-License-Identifier: GPL-3.0-or-later
"""Products of (n, K) links: against float64, and the same bits in any part and with any number of threads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.final_gather import products
from rtgi_addon.backend.final_gather.products import row_products
from rtgi_addon.backend.parallel import Workers


def links(rng: np.random.Generator, count: int, width: int, targets: int):
    target = rng.integers(0, targets, (count, width)).astype(np.int32)
    weight = (rng.random((count, width)) / max(width, 1)).astype(np.float32)
    return target, weight


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 80),
    width=st.integers(0, 40),
    channels=st.integers(1, 4),
    by_columns=st.booleans(),
)
def test_against_float64(seed, count, width, channels, by_columns):
    rng = np.random.default_rng(seed)
    target, weight = links(rng, count, width, 50)
    x = rng.random((50, channels)).astype(np.float32)
    found = row_products(target, weight, 50, Workers(2))(np.asfortranarray(x) if by_columns else x)
    exact = np.einsum("nk,nkc->nc", weight.astype(np.float64), x[target].astype(np.float64))
    assert found.shape == (count, channels) and found.dtype == np.float32
    np.testing.assert_allclose(found, exact, rtol=5e-6, atol=1e-30)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_same_bits_in_any_part_and_with_any_number_of_threads(monkeypatch, threads):
    rng = np.random.default_rng(1)
    target, weight = links(rng, 3001, 64, 900)
    x = rng.random((900, 3)).astype(np.float32)
    whole = row_products(target, weight, 900, Workers(1))(x)
    monkeypatch.setattr(products, "PART_LINKS", 10_000)
    np.testing.assert_array_equal(row_products(target, weight, 900, Workers(threads))(x), whole)
    rows = np.flatnonzero(rng.random(3001) < 0.3)
    some = row_products(target[rows], weight[rows], 900, Workers(threads))(x)
    np.testing.assert_array_equal(some, whole[rows])


def test_links_are_kept_and_not_copied():
    """Links replaced in place are used by the next product."""
    target, weight = links(np.random.default_rng(2), 500, 8, 30)
    product = row_products(target[100:400], weight[100:400], 30, Workers(2))
    before = product(np.ones((30, 1), np.float32))
    target[150], weight[150] = 3, 2
    after = product(np.ones((30, 1), np.float32))
    assert after[50] == 16 and np.flatnonzero(before != after).tolist() == [50]


def test_what_would_read_foreign_memory_is_refused():
    target, weight = links(np.random.default_rng(3), 10, 4, 20)
    for wrong in (-1, 20):
        target[7, 2] = wrong
        with pytest.raises(ValueError, match="not all within 0 .. 19"):
            row_products(target, weight, 20, Workers(1))
    target[7, 2] = 0
    with pytest.raises(ValueError, match="x has 19 rows"):
        row_products(target, weight, 20, Workers(1))(np.ones((19, 3), np.float32))
    with pytest.raises(ValueError, match="int32"):
        row_products(target.astype(np.int64), weight, 20, Workers(1))
    with pytest.raises(ValueError, match="same"):
        row_products(target, weight[:, :3], 20, Workers(1))
