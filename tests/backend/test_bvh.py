# SPDX-License-Identifier: GPL-3.0-or-later
"""The hierarchy for compute shaders: every triangle in one leaf, boxes that hold what is below, rays that find it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.gpu.bvh import (
    EMPTY_LEAF,
    LEAF_STRIDE,
    LEAF_TRIANGLES,
    MAX_DEPTH,
    NODE,
    Bvh,
    build_bvh,
    hittable,
    pack_nodes,
    pack_triangles,
)


def soup(count: int, *, seed: int = 0, size: float = 0.1) -> np.ndarray:
    """(count, 3, 3) triangles of about ``size`` in the unit cube."""
    rng = np.random.default_rng(seed)
    return (rng.random((count, 1, 3)) + rng.normal(0, size, (count, 3, 3))).astype(np.float32)


def leaf_rows(bvh: Bvh) -> tuple[np.ndarray, np.ndarray]:
    """(l,), (l,) first row and count of every leaf that is not empty."""
    leaves = ~bvh.link[(bvh.link < 0) & (bvh.link != EMPTY_LEAF)].astype(np.int64)
    return leaves // LEAF_STRIDE, leaves % LEAF_STRIDE


def check(corners: np.ndarray) -> Bvh:
    """Build, and hold against all that the shader relies on."""
    bvh = build_bvh(corners)
    good = np.flatnonzero(hittable(corners))
    np.testing.assert_array_equal(np.sort(bvh.order), good)
    first, count = leaf_rows(bvh)
    assert (count <= LEAF_TRIANGLES).all() and (count >= 1).all()
    rows = np.sort(np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum()))
    np.testing.assert_array_equal(rows, np.arange(len(good)))
    inner = bvh.link[bvh.link >= 0]
    np.testing.assert_array_equal(np.sort(inner), np.arange(1, len(bvh.link)))  # each node but the root has one parent
    assert 1 <= bvh.depth <= MAX_DEPTH
    for node, side in np.argwhere(bvh.link != EMPTY_LEAF):
        low, high, link = bvh.low[node, side], bvh.high[node, side], int(bvh.link[node, side])
        if link >= 0:
            inside = np.concatenate([bvh.low[link], bvh.high[link]])
        else:
            at = ~link // LEAF_STRIDE
            inside = corners[bvh.order[at : at + ~link % LEAF_STRIDE]].reshape(-1, 3)
        np.testing.assert_array_equal(low, inside.min(axis=0))
        np.testing.assert_array_equal(high, inside.max(axis=0))
    return bvh


def moller_trumbore(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n,) float64 distances of rays to one triangle each, inf where they miss."""
    a, b, c = (corners[:, k].astype(np.float64) for k in range(3))
    across = np.cross(directions, c - a)
    with np.errstate(all="ignore"):
        scale = 1 / np.einsum("ij,ij->i", b - a, across)
        from_a = origins - a
        u = np.einsum("ij,ij->i", from_a, across) * scale
        up = np.cross(from_a, b - a)
        v = np.einsum("ij,ij->i", directions, up) * scale
        distance = np.einsum("ij,ij->i", c - a, up) * scale
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0), distance, np.inf)


def traverse(bvh: Bvh, corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n,) nearest distance by way of the hierarchy: all rays go down it side by side."""
    nearest = np.full(len(origins), np.inf)
    ray, node = np.arange(len(origins)), np.zeros(len(origins), np.int64)
    for _ in range(bvh.depth):
        ray, node, side = np.repeat(ray, 2), np.repeat(node, 2), np.tile([0, 1], len(ray))
        with np.errstate(all="ignore"):
            planes = np.stack([bvh.low[node, side], bvh.high[node, side]]).astype(np.float64)
            times = (planes - origins[ray]) / directions[ray]
        enter, leave = times.min(axis=0).max(axis=1), times.max(axis=0).min(axis=1)
        link = bvh.link[node, side]
        met = (np.maximum(enter, 0) <= leave + 1e-9 * np.abs(leave)) & (link != EMPTY_LEAF)
        ray, link = ray[met], link[met]
        leaf = ~link[link < 0].astype(np.int64)
        count = leaf % LEAF_STRIDE
        rows = np.repeat(leaf // LEAF_STRIDE - (np.cumsum(count) - count), count) + np.arange(count.sum())
        of_ray = np.repeat(ray[link < 0], count)
        found = moller_trumbore(corners[bvh.order[rows]], origins[of_ray], directions[of_ray])
        np.minimum.at(nearest, of_ray, found)
        ray, node = ray[link >= 0], link[link >= 0]
    assert not len(ray)
    return nearest


def brute_force(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n,) nearest distance over all triangles."""
    n, t = len(origins), len(corners)
    every = np.repeat(corners[None], n, axis=0).reshape(-1, 3, 3)
    found = moller_trumbore(every, np.repeat(origins, t, axis=0), np.repeat(directions, t, axis=0))
    return found.reshape(n, t).min(axis=1, initial=np.inf)


@pytest.mark.parametrize("count", [0, 1, 2, LEAF_TRIANGLES, LEAF_TRIANGLES + 1, 9, 100, 5000])
def test_any_number_of_triangles(count):
    check(soup(count))


@pytest.mark.parametrize("count", [5, 64, 1001])
def test_coincident_triangles_are_halved(count):
    bvh = check(np.repeat(soup(1), count, axis=0))
    assert bvh.depth <= np.ceil(np.log2(count / LEAF_TRIANGLES)) + 1


def test_triangles_that_cannot_be_hit_are_in_no_leaf_and_spoil_no_bounds():
    corners = soup(200)
    corners[3, 1, 2] = np.nan
    corners[50, 0] = np.inf
    corners[60, 2, 1] = -np.inf
    corners[70, 1] = corners[70, 2]
    corners[80] = [[0, 0, 0], [1, 2, 3], [2, 4, 6]]
    bvh = check(corners)
    assert not np.isin([3, 50, 60, 70, 80], bvh.order).any() and len(bvh.order) == 195
    assert np.isfinite(bvh.low).all() and np.isfinite(bvh.high).all()


def test_only_triangles_that_cannot_be_hit():
    bvh = check(np.full((7, 3, 3), np.nan, np.float32))
    assert len(bvh.order) == 0 and (bvh.link == EMPTY_LEAF).all()
    np.testing.assert_array_equal(bvh.bounds, np.zeros((2, 3)))


def test_depth_is_bounded_where_sah_would_go_on():
    """Each triangle twice as far out as the one before: the best border splits off one at a time."""
    far = 2.0 ** np.arange(-60, 60)
    shape = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    corners = (far[:, None, None] * (1 + 0.1 * shape)).astype(np.float32)
    assert 10 < check(corners).depth <= MAX_DEPTH


def test_coordinates_near_the_end_of_float32():
    check(soup(50) * np.float32(1e37))
    check(soup(50) * np.float32(1e25))
    check(soup(50) * np.float32(1e-30))


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(0, 150),
    size=st.sampled_from([0.0, 1e-4, 0.1, 2.0]),
    scale=st.sampled_from([1e-3, 1.0, 1e4]),
    doubled=st.booleans(),
    flat=st.booleans(),
    spoilt=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_any_soup_gives_every_ray_its_nearest_hit(seed, count, size, scale, doubled, flat, spoilt):
    rng = np.random.default_rng(seed)
    corners = soup(count, seed=seed, size=size) * np.float32(scale)
    if doubled:
        corners = corners[rng.integers(0, max(count, 1), count)] if count else corners
    if flat:
        corners[..., rng.integers(3)] = scale / 3
    if spoilt and count:
        corners[rng.integers(0, count, 5), rng.integers(0, 3, 5), rng.integers(0, 3, 5)] = np.nan
        corners[rng.integers(0, count, 5), 0] = corners[rng.integers(0, count, 5), 1]
    bvh = check(corners)
    origins = rng.uniform(-0.5, 1.5, (40, 3)) * scale
    directions = rng.normal(size=(40, 3))
    expected = brute_force(corners[hittable(corners)], origins, directions)
    np.testing.assert_array_equal(traverse(bvh, corners, origins, directions), expected)


def test_same_triangles_same_tree():
    corners = soup(3000)
    a, b = build_bvh(corners), build_bvh(corners.copy())
    for name in ("low", "high", "link", "order"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_sah_beats_halving():
    """A dense cluster in a sparse hall: the tree's expected cost is well under that of a tree split by counts."""
    corners = np.concatenate([soup(2000, size=0.001) * np.float32(0.01), soup(2000, seed=1, size=0.01)])

    def cost(bvh: Bvh) -> float:
        x, y, z = np.moveaxis((bvh.high - bvh.low).astype(np.float64), -1, 0)
        leaf = bvh.link < 0
        return float(((x * y + y * z + z * x) * np.where(leaf, ~bvh.link % LEAF_STRIDE, 1)).sum())

    halved = build_bvh(np.repeat(soup(1), len(corners), axis=0))
    order = np.argsort(corners.mean(axis=1)[:, 0])
    low, high = np.zeros_like(halved.low), np.zeros_like(halved.high)
    for node in range(len(halved.link) - 1, -1, -1):  # children come after their parents
        for side, link in enumerate(halved.link[node]):
            at = ~int(link) // LEAF_STRIDE
            below = corners[order[at : at + ~int(link) % LEAF_STRIDE]].reshape(-1, 3)
            boxes = below if link < 0 else np.concatenate([low[link], high[link]])
            low[node, side], high[node, side] = boxes.min(axis=0), boxes.max(axis=0)
    assert cost(build_bvh(corners)) < 0.6 * cost(Bvh(low, high, halved.link, halved.order, halved.depth))


def test_packed_links_point_into_a_shared_buffer():
    corners = soup(40)
    bvh = build_bvh(corners)
    packed = pack_nodes(bvh, 1000, 500)
    assert packed.dtype.itemsize == NODE.itemsize == 64
    links = np.stack([packed["left"], packed["right"]], axis=1)
    inner = bvh.link >= 0
    np.testing.assert_array_equal(links[inner], bvh.link[inner] + 1000)
    np.testing.assert_array_equal(~links[~inner] // LEAF_STRIDE, ~bvh.link[~inner] // LEAF_STRIDE + 500)
    np.testing.assert_array_equal(~links[~inner] % LEAF_STRIDE, ~bvh.link[~inner] % LEAF_STRIDE)
    np.testing.assert_array_equal(pack_nodes(build_bvh(corners[:1]), 7, 9)["right"], [EMPTY_LEAF])


def test_packed_triangles_keep_their_numbers():
    corners = soup(40)
    bvh = build_bvh(corners)
    number = np.arange(100, 140, dtype=np.int32)
    packed = pack_triangles(bvh, corners, number)
    assert packed.dtype.itemsize == 48
    np.testing.assert_array_equal(packed["number"], number[bvh.order])
    np.testing.assert_array_equal(packed["c"], corners[bvh.order, 2])
