# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays hit what they should, whatever the transform, the distance from the origin, and how often things moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import Instance, Scene
from rtgi_addon.backend.surface.geometry import Geometry, triangle_normals
from rtgi_addon.backend.surface.tracing import EmbreeTracer
from tests.backend import scenes

UNIT_QUAD = scenes.quad("quad", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])


def tracer_of(*instances: Instance, threads: int = 1, state=None):
    scene = Scene((UNIT_QUAD,), instances, (scenes.WHITE,))
    state = state or scene.first_frame()
    geometry = Geometry(scene, state)
    return scene, geometry, EmbreeTracer(scene, geometry, state, Workers(threads))


def rays(count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-2, 2, (count, 3)).astype(np.float32), rng.normal(size=(count, 3)).astype(np.float32)


matrices = st.lists(st.floats(-2, 2), min_size=9, max_size=9).map(lambda v: np.array(v).reshape(3, 3))


@given(linear=matrices, moving=st.booleans())
@settings(max_examples=40, deadline=None)
def test_transformed_quad_is_hit_where_its_plane_says(linear, moving):
    """Any affine transform: distance and side agree with the plane through the transformed corners."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    if abs(np.linalg.det(linear)) < 1e-2:
        return
    _, geometry, tracer = tracer_of(Instance("q", 0, matrix, moving=moving))
    normal = geometry.normals[0].astype(np.float64)
    outward = linear @ np.array([0, 0, 1.0])
    assert normal @ outward > 0  # the object's own front stays the front, mirrored or not
    for side in (1.0, -1.0):
        origin = (normal * side)[None].astype(np.float32)
        hit = tracer.intersect(origin, -origin)
        assert hit.triangle[0] >= 0
        assert hit.distance[0] == pytest.approx(1.0, abs=1e-3)
        assert hit.back[0] == (side < 0)


@given(
    away=st.tuples(*[st.floats(-5e3, 5e3)] * 3),
    turn=st.floats(0, 6),
    lift=st.floats(1e-5, 1e-3),
    seed=st.integers(0, 99),
)
@settings(max_examples=30, deadline=None)
def test_a_mover_far_from_its_own_origin_is_hit_as_finely_as_any(away, turn, lift, seed):
    """Mesh kilometres from the pivot it turns about, the object beside the scene's origin: rays that start 10 µm above
    it and leave do not meet it, and those that come down do."""
    matrix = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    matrix[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    matrix[:3, 3] = -matrix[:3, :3] @ np.array(away)
    moved = replace(UNIT_QUAD, vertices=(UNIT_QUAD.vertices.astype(np.float64) + away).astype(np.float32))
    scene = Scene((moved,), (Instance("q", 0, matrix, moving=True),), (scenes.WHITE,))
    geometry = Geometry(scene, scene.first_frame())
    tracer = EmbreeTracer(scene, geometry, scene.first_frame(), Workers(1))
    rng = np.random.default_rng(seed)
    n = geometry.normals[rng.integers(0, 2, 200)]
    weights = rng.dirichlet([2, 2, 2], 200)
    start = (np.einsum("nk,nkj->nj", weights, geometry.corners[rng.integers(0, 2, 200)]) + n * lift).astype(np.float32)
    outward = (rng.normal(size=(200, 3)) * 0.3 + n).astype(np.float32)
    up = (outward * n).sum(axis=1) > 0.05
    assert not tracer.occluded(start[up], outward[up], np.full(up.sum(), np.inf, np.float32)).any()
    down = tracer.intersect(start, -n)
    assert (down.triangle >= 0).all()
    np.testing.assert_allclose(down.distance, lift, atol=2e-6)


def test_mover_and_still_instance_agree():
    """A rigid mover, traced in its own space, gives the hits of the same object built into the still scene."""
    matrix = scenes.translation(0.3, -0.2, 0.5)
    matrix[:3, :3] = [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]
    still = tracer_of(Instance("q", 0, matrix))[2]
    mover = tracer_of(Instance("q", 0, matrix, moving=True))[2]
    origins, directions = rays(20_000)
    a, b = still.intersect(origins, directions), mover.intersect(origins, directions)
    same = a.triangle == b.triangle
    assert same.mean() > 0.999  # rays along an edge may differ by rounding
    hit = same & (a.triangle >= 0)
    assert hit.sum() > 500
    np.testing.assert_allclose(a.distance[hit], b.distance[hit], rtol=1e-4)
    np.testing.assert_allclose(a.u[hit], b.u[hit], atol=1e-3)


def test_following_a_move_equals_building_there():
    start, end = np.eye(4), scenes.translation(0, 0, 1.5)
    scene, geometry, tracer = tracer_of(Instance("a", 0, start, moving=True), Instance("b", 0, np.eye(4)))
    state = replace(scene.first_frame(), matrix_world=np.array([end, np.eye(4)]))
    changed = geometry.update(state)
    assert changed == [0]
    tracer.update(state, changed)
    fresh = EmbreeTracer(scene, geometry, state, Workers(1))
    origins, directions = rays(5_000, 1)
    a, b = tracer.intersect(origins, directions), fresh.intersect(origins, directions)
    np.testing.assert_array_equal(a.triangle, b.triangle)
    np.testing.assert_array_equal(a.distance[a.triangle >= 0], b.distance[a.triangle >= 0])


def test_hidden_instances_and_those_that_do_not_block_are_not_hit():
    scene, geometry, tracer = tracer_of(
        Instance("a", 0, np.eye(4)), Instance("b", 0, scenes.translation(0, 0, 1), blocks_light=False)
    )
    down = np.array([[0, 0, -1]], np.float32)
    above = np.array([[0.1, 0.2, 2]], np.float32) - geometry.origin.astype(np.float32)
    assert tracer.intersect(above, down).triangle[0] in (0, 1)
    state = replace(scene.first_frame(), visible=np.array([False, True]))
    tracer.update(state, geometry.update(state))
    assert tracer.intersect(above, down).triangle[0] == -1
    tracer.update(scene.first_frame(), [])
    assert tracer.intersect(above, down).triangle[0] in (0, 1)


def test_occluded_stops_at_the_given_distance():
    _, _, tracer = tracer_of(Instance("q", 0, np.eye(4)))
    origin, way = np.array([[0.1, 0.2, 1]] * 2, np.float32), np.array([[0, 0, -2]] * 2, np.float32)
    assert tracer.occluded(origin, way, np.array([0.49, 0.51], np.float32)).tolist() == [False, True]


def test_thread_count_changes_no_bit():
    instances = (Instance("a", 0, np.eye(4)), Instance("b", 0, scenes.translation(0.5, 0, 0.7), moving=True))
    one, two = tracer_of(*instances, threads=1)[2], tracer_of(*instances, threads=2)[2]
    origins, directions = rays(200_000)
    a, b = one.intersect(origins, directions), two.intersect(origins, directions)
    for name in ("triangle", "u", "v", "distance", "cosine"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_million_metres_out_nothing_is_lost():
    far = scenes.translation(1e6, -2e6, 5e5)
    _, near_geometry, near = tracer_of(Instance("q", 0, np.eye(4)))
    _, far_geometry, away = tracer_of(Instance("q", 0, far))
    np.testing.assert_allclose(far_geometry.corners, near_geometry.corners, atol=1e-6)
    origins, directions = rays(2_000)
    np.testing.assert_array_equal(
        near.intersect(origins, directions).triangle, away.intersect(origins, directions).triangle
    )


def test_empty_scene_answers():
    scene = Scene((), (), ())
    state = scene.first_frame()
    tracer = EmbreeTracer(scene, Geometry(scene, state), state, Workers(1))
    assert tracer.intersect(*rays(4)).triangle.tolist() == [-1] * 4
    assert not tracer.occluded(*rays(4), np.ones(4, np.float32)).any()


def test_degenerate_triangles_have_no_normal_and_tiny_ones_do():
    corners = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 0, 0], [1e-6, 0, 0], [0, 1e-6, 0]]])
    np.testing.assert_allclose(triangle_normals(corners), [[0, 0, 0], [0, 0, 1]])
