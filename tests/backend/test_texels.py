# SPDX-License-Identifier: GPL-3.0-or-later
"""Texels cover the surface once, know their place, and are found again from a hit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.scene import Atlas, Instance, Placement, Scene
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.rasterise import rasterise
from rtgi_addon.backend.surface.texels import make_texels, place_texels, stand_ins, texel_colours
from tests.backend import scenes


def texels_of(scene: Scene, atlas: Atlas):
    geometry = Geometry(scene, scene.first_frame())
    texels = make_texels(scene, atlas, geometry)
    return geometry, texels, place_texels(texels, geometry)


def one(mesh, matrix=None, size=(16, 16), **kwargs):
    scene = Scene((mesh,), (Instance(mesh.name, 0, np.eye(4) if matrix is None else matrix),), (scenes.WHITE,))
    return scene, scenes.grid_atlas(scene, [size], **kwargs)


def test_areas_of_the_cornell_box_sum_to_its_surface():
    _, _, frame = texels_of(*scenes.cornell(44))
    walls, short, tall = 5 * 4.0, 6 * 0.36, 2 * 0.36 + 4 * 0.72
    assert frame.area.sum() == pytest.approx(walls + short + tall, rel=1e-4)


def test_a_sphere_has_its_area_within_a_percent():
    _, _, frame = texels_of(*one(scenes.sphere("ball", 2.0, rings=32), size=(128, 64)))
    assert frame.area.sum() == pytest.approx(4 * np.pi * 4, rel=0.01)


def test_every_texel_is_found_from_its_own_point():
    scene, atlas = scenes.cornell(20)
    _, texels, _ = texels_of(scene, atlas)
    found = texels.of_hits(texels.triangle, texels.barycentric[:, 0], texels.barycentric[:, 1], texels.side == 1)
    np.testing.assert_array_equal(found, np.arange(texels.count))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_any_point_of_any_triangle_finds_a_texel_of_its_own_island(seed):
    """Also slivers, triangles smaller than a texel, and points on edges."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 1, (40, 3, 3))
    uv = rng.uniform(0.1, 0.9, (40, 1, 2)) + rng.uniform(-0.1, 0.1, (40, 3, 2)) * rng.choice(
        [1, 0.1, 0.001], (40, 1, 1)
    )
    mesh = scenes.mesh_of_triangles("soup", corners, uv, np.zeros(40, int))
    scene, atlas = one(mesh, size=(24, 24))
    _, texels, frame = texels_of(scene, atlas)
    u, v = rng.dirichlet([0.3, 0.3, 0.3], 40)[:, 1:].T.astype(np.float32)
    found = texels.of_hits(np.arange(40, dtype=np.int32), u, v, np.zeros(40, bool))
    assert (found >= 0).all()
    assert np.isfinite(frame.position).all() and (frame.area > 0).all()
    at = (uv[:, 0] * (1 - u - v)[:, None] + uv[:, 1] * u[:, None] + uv[:, 2] * v[:, None]) * 24 + 1
    assert np.abs(texels.col[found] + 0.5 - at[:, 0]).max() < 1.6  # its own pixel, or the next one


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_coverage_of_a_triangle_sums_to_its_area(seed):
    corners = np.random.default_rng(seed).uniform(0, 20, (1, 3, 2))
    e1, e2 = corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 0]
    area = abs(e1[0] * e2[1] - e1[1] * e2[0]) / 2
    texels = rasterise(corners, np.zeros(1, np.int32))
    assert texels.coverage.sum() == pytest.approx(area, rel=0.1, abs=3.0)
    assert len(np.unique(texels.row * 1000 + texels.col)) == len(texels.row)
    assert (texels.barycentric >= 0).all() and (texels.barycentric.sum(axis=1) <= 1 + 1e-6).all()


def test_back_side_has_own_texels_that_look_the_other_way():
    scene, atlas = one(scenes.quad("sheet", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]), size=(4, 4), back=(0,))
    _, texels, frame = texels_of(scene, atlas)
    assert texels.count == 32 and texels.surface_count == 2
    np.testing.assert_allclose(frame.normal[texels.side == 0], [[0, 0, 1]] * 16)
    np.testing.assert_allclose(frame.normal[texels.side == 1], [[0, 0, -1]] * 16)
    hit = np.array([0], np.int32), np.float32([0.2]), np.float32([0.2])
    assert texels.side[texels.of_hits(*hit, np.array([False]))[0]] == 0
    assert texels.side[texels.of_hits(*hit, np.array([True]))[0]] == 1


def test_a_side_without_map_gives_no_texel():
    scene, atlas = one(scenes.quad("sheet", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]), size=(4, 4))
    _, texels, _ = texels_of(scene, atlas)
    hit = np.array([0, -1], np.int32), np.float32([0.2, 0]), np.float32([0.2, 0])
    assert texels.of_hits(*hit, np.array([True, False])).tolist() == [-1, -1]


def test_positions_follow_the_instance_and_points_span_a_texel():
    matrix = np.diag([2.0, 3.0, 1.0, 1.0])
    matrix[:3, 3] = 5, 6, 7
    scene, atlas = one(scenes.quad("sheet", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]), matrix, size=(4, 4))
    geometry, texels, frame = texels_of(scene, atlas)
    world = frame.position + geometry.origin
    low = texels.col.min(), texels.row.min()
    expected = np.stack([5 + (texels.col - low[0] + 0.5) / 2, 6 + (texels.row - low[1] + 0.5) * 0.75], axis=1)
    np.testing.assert_allclose(world[:, :2], expected, atol=1e-5)
    assert np.ptp(frame.points[:, :, 0], axis=1) == pytest.approx(0.375, abs=1e-4)
    assert np.ptp(frame.points[:, :, 1], axis=1) == pytest.approx(0.5625, abs=1e-4)
    np.testing.assert_allclose(frame.area, 0.375, rtol=1e-4)


def test_maps_override_material_colours_texel_by_texel():
    image = np.arange(48, dtype=np.float32).reshape(4, 4, 3) / 48
    mesh = scenes.quad("sheet", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    mesh = type(mesh)(**{**vars(mesh), "albedo_map": image})
    scene, atlas = one(mesh, size=(4, 4))
    geometry, texels, _ = texels_of(scene, atlas)
    albedo, emission = texel_colours(texels, scene, geometry, scene.materials)
    expected = image[texels.row - texels.row.min(), texels.col - texels.col.min()]
    np.testing.assert_array_equal(albedo, expected)
    assert not emission.any()


def test_rectangle_that_leaves_its_page_is_refused():
    scene, _ = one(scenes.quad("sheet", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]))
    atlas = Atlas(16, 1, (Placement(0, (1.0, 1.0), (0.5, 0.0)),), (None,))
    with pytest.raises(ValueError, match="sheet"):
        texels_of(scene, atlas)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.02, 0.5, 0.98, 1.0]))
def test_stand_ins_are_the_nearest_valid_texels_of_their_surface(seed, share):
    _, texels, _ = texels_of(*scenes.cornell(24))
    rng = np.random.default_rng(seed)
    valid = rng.random(texels.count) >= share
    found = stand_ins(texels, valid)
    np.testing.assert_array_equal(found[valid], np.flatnonzero(valid))
    place = np.stack([texels.row, texels.col], axis=1).astype(np.int64)
    for lost in rng.permutation(np.flatnonzero(~valid))[:50]:
        near = np.flatnonzero(valid & (texels.surface == texels.surface[lost]))
        squared = ((place[near] - place[lost]) ** 2).sum(axis=1)
        assert found[lost] == -1 if not len(near) else found[lost] in near[squared == squared.min()]
    # What is hidden on other surfaces does not matter, nor which of several is taken.
    kept = texels.surface == rng.integers(texels.surface_count)
    other = np.where(kept, valid, rng.random(texels.count) >= 0.5)
    np.testing.assert_array_equal(stand_ins(texels, other)[kept], found[kept])
