# SPDX-License-Identifier: GPL-3.0-or-later
"""Clusters of triangles: whole, compact, and never culled while any of their triangles is in front."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.final_gather.views import clusters as clusters_module
from rtgi_addon.backend.final_gather.views.clusters import Clusters, cluster_spheres, in_front, make_clusters

TRY = settings(max_examples=150, deadline=None, derandomize=True)


def grid_corners(count: int) -> np.ndarray:
    """(2 count², 3, 3) the unit square, row by row."""
    line = np.linspace(0, 1, count + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    p = np.stack([x, y, 0 * x], axis=-1)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    split = [np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]
    return np.stack(split, axis=2).reshape(-1, 3, 3).astype(np.float32)


def cluster_of_triangle(clusters: Clusters) -> np.ndarray:
    cluster = np.zeros(len(clusters.order), np.int64)
    cluster[clusters.order] = np.repeat(np.arange(clusters.count), np.diff(clusters.first))
    return cluster


def check(clusters: Clusters, instance: np.ndarray, size: int) -> None:
    """Every triangle in one cluster, which belongs to its instance and is not too large."""
    assert np.array_equal(np.sort(clusters.order), np.arange(len(instance)))
    assert clusters.first[0] == 0 and clusters.first[-1] == len(instance)
    counts = np.diff(clusters.first)
    assert ((counts > 0) & (counts <= size)).all()
    assert np.array_equal(instance[clusters.order], np.repeat(clusters.instance, counts))
    assert clusters.count == sum(-(-n // size) for n in np.unique(instance, return_counts=True)[1])


def test_instances_are_cut_by_themselves() -> None:
    instance = np.repeat(np.array([0, 2, 3, 7], np.int32), [300, 1, 256, 1000])
    corners = np.random.default_rng(0).normal(size=(len(instance), 3, 3)).astype(np.float32)
    clusters = make_clusters(corners, instance)
    check(clusters, instance, 256)
    assert clusters.instance.tolist() == [0, 0, 2, 3, 7, 7, 7, 7]


def test_clusters_are_compact() -> None:
    """256 of 2 · 64² triangles on a square are best a square of 1/32 of its area."""
    corners = grid_corners(64)
    shuffled = corners[np.random.default_rng(1).permutation(len(corners))]
    for ordered in (corners, shuffled):
        _, radius = cluster_spheres(ordered, make_clusters(ordered, np.zeros(len(ordered), np.int32)))
        ideal = np.sqrt(1 / 32) * np.sqrt(2) / 2
        assert radius.mean() < 2 * ideal


def test_the_curve_visits_octants_in_turn() -> None:
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    triangles = np.repeat(corner[:, None], 3, axis=1)[::-1]
    assert make_clusters(triangles, np.zeros(8, np.int32), 1).order.tolist() == list(range(7, -1, -1))


def test_spheres_hold_their_triangles_far_from_the_origin() -> None:
    for shift in (0.0, 1e6, 1e30):
        corners = grid_corners(32) + np.float32(shift)
        clusters = make_clusters(corners, np.zeros(len(corners), np.int32), 64)
        centre, radius = cluster_spheres(corners, clusters)
        assert (centre.dtype, radius.dtype) == (np.float32, np.float32)
        own = cluster_of_triangle(clusters)
        away = np.linalg.norm(corners.astype(np.float64) - centre[own, None].astype(np.float64), axis=2)
        assert (away.max(axis=1) <= radius[own]).all()


def test_lost_triangles() -> None:
    corners = grid_corners(8)
    corners[::3, 1, 0] = np.nan
    corners[1::7, 2, 2] = np.inf
    instance = np.repeat(np.arange(2, dtype=np.int32), 64)
    corners[64:] = np.nan
    clusters = make_clusters(corners, instance, 8)
    check(clusters, instance, 8)
    centre, radius = cluster_spheres(corners, clusters)
    assert np.isfinite(centre).all()
    finite = np.isfinite(corners).all(axis=(1, 2))
    some = np.bincount(cluster_of_triangle(clusters), finite) > 0
    assert np.array_equal(radius >= 0, some)
    assert some.sum() == -(-finite.sum() // 8)  # the lost ones are together
    eye = np.array([[0, 0, -1e3]], np.float32)
    assert np.array_equal(in_front(centre, radius, eye, np.array([[0, 0, 1]], np.float32)), some)


def test_nothing_at_all() -> None:
    none = make_clusters(np.zeros((0, 3, 3), np.float32), np.zeros(0, np.int32))
    centre, radius = cluster_spheres(np.zeros((0, 3, 3), np.float32), none)
    eye = np.ones((3, 3), np.float32)
    assert (none.count, none.first.tolist()) == (0, [0])
    assert in_front(centre, radius, eye, eye).shape == (0,)
    one = np.ones((1, 3), np.float32), np.ones(1, np.float32)
    assert not in_front(*one, eye[:0], eye[:0]).any()
    assert not in_front(*one, eye * np.float32(np.nan), eye).any()
    assert not in_front(*one, eye, eye * 0).any()


def test_wrong_arguments_are_told() -> None:
    corners = np.zeros((4, 3, 3), np.float32)
    for instance, size in (([0, 1, 0, 1], 2), ([0, 0, 0], 2), ([0, 0, 0, 0], 0)):
        with pytest.raises(ValueError, match=r"instance|triangle"):
            make_clusters(corners, np.array(instance, np.int32), size)


def test_what_lies_behind_is_left_out() -> None:
    """A floor's texels look up: half of a cube of triangles below them is not drawn."""
    rng = np.random.default_rng(3)
    corners = (rng.uniform(-1, 1, (20000, 1, 3)) + rng.normal(size=(20000, 3, 3)) * 0.01).astype(np.float32)
    clusters = make_clusters(corners, np.zeros(20000, np.int32), 64)
    centre, radius = cluster_spheres(corners, clusters)
    eye = np.concatenate([rng.uniform(-1, 1, (500, 2)), np.zeros((500, 1))], axis=1).astype(np.float32)
    up = np.tile(np.array([0, 0, 1], np.float32), (500, 1))
    seen = in_front(centre, radius, eye, up)
    assert np.array_equal(seen, centre[:, 2] + radius > 0)
    assert 0.5 < seen.mean() < 0.8
    assert np.array_equal(in_front(centre, radius, eye, -3 * up), centre[:, 2] - radius < 0)


def test_memory_is_bounded_and_parts_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    centre, radius = rng.normal(size=(400, 3)).astype(np.float32), np.full(400, 0.01, np.float32)
    eye = rng.normal(size=(300, 3)).astype(np.float32) + np.float32([0, 0, 2])
    normal = (rng.normal(size=(300, 3)) * 0.1 + [0, 0, 1]).astype(np.float32)
    whole = in_front(centre, radius, eye, normal)
    assert 0 < whole.sum() < 400
    monkeypatch.setattr(clusters_module, "DISTANCES_AT_ONCE", 1000)
    assert np.array_equal(in_front(centre, radius, eye, normal), whole)


numbers = st.one_of(st.floats(-4, 4, width=32), st.integers(-2, 2).map(float), st.just(float("nan")))
vectors = st.tuples(numbers, numbers, numbers)


@TRY
@given(
    corners=st.lists(st.tuples(vectors, vectors, vectors), min_size=1, max_size=30),
    eyes=st.lists(st.tuples(vectors, vectors), max_size=8),
    size=st.integers(1, 8),
    shift=st.sampled_from([0.0, 1e3, 1e6, -1e6]),
    scale=st.sampled_from([1.0, 1e-3, 1e3]),
)
def test_nothing_in_front_is_ever_left_out(corners, eyes, size: int, shift: float, scale: float) -> None:
    place = np.float32(scale), np.float32(shift)
    triangles = np.array(corners, np.float32).reshape(-1, 3, 3) * place[0] + place[1]
    eye = np.array([e for e, _ in eyes], np.float32).reshape(-1, 3) * place[0] + place[1]
    normal = np.array([n for _, n in eyes], np.float64).reshape(-1, 3)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0).astype(np.float32)
    instance = np.sort(np.random.default_rng(size).integers(0, 3, len(triangles))).astype(np.int32)
    clusters = make_clusters(triangles, instance, size)
    check(clusters, instance, size)
    seen = in_front(*cluster_spheres(triangles, clusters), eye, normal)
    finite = np.isfinite(triangles).all(axis=(1, 2))
    wide = triangles.astype(np.float64)[:, :, None] - eye.astype(np.float64)  # (t, 3, m, 3)
    before = (wide * normal.astype(np.float64)).sum(axis=3) > 0
    # Also by float32 throughout, as a graphics card may see it.
    before |= ((triangles[:, :, None] - eye) * normal).sum(axis=3) > 0
    visible = before.any(axis=(1, 2)) & finite
    assert seen[cluster_of_triangle(clusters)[visible]].all()
