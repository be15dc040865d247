# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams: which edges are cuts in one smooth surface, and what matching them may and may not change."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.final_gather.solvers import conjugate_gradients
from rtgi_addon.backend.finish import seams
from rtgi_addon.backend.finish.dilate import DilationMap
from rtgi_addon.backend.finish.seams import LEAST_TEXELS, SeamMatcher, find_seams
from rtgi_addon.backend.scene import Atlas, Instance, Material, Mesh, Placement, Scene
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.texels import Texels, make_texels

UP = np.float32([0, 0, 1])


def patchwork(tiles: int, per_tile: int = 2, gap: float = 0.04, seed: int = 0) -> Mesh:
    """The unit square in ``tiles``² UV islands, each in a shuffled place of the UV square and turned by quarters."""
    cells = tiles * per_tile
    corners = np.stack(np.meshgrid(np.arange(cells + 1), np.arange(cells + 1)), axis=-1).reshape(-1, 2)
    cell = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 2)
    quad = (cell[:, 1] * (cells + 1) + cell[:, 0])[:, None] + [0, 1, cells + 2, cells + 1]
    triangles = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)
    tile = np.concatenate([cell, cell]) // per_tile
    island = (tile[:, 1] * tiles + tile[:, 0]).astype(np.int32)
    rng = np.random.default_rng(seed)
    place, turn = rng.permutation(tiles**2)[island], rng.integers(0, 4, tiles**2)[island] * np.pi / 2
    local = corners[triangles] / per_tile - tile[:, None] - 0.5
    cos, sin = np.round(np.cos(turn))[:, None], np.round(np.sin(turn))[:, None]
    local = np.stack([cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]], axis=-1)
    origin = np.stack([place % tiles, place // tiles], axis=1)[:, None]
    uv = (origin + 0.5 + local * (1 - 2 * gap * tiles)) / tiles
    return Mesh(
        name="patchwork",
        vertices=np.c_[corners / cells, np.zeros(len(corners))].astype(np.float32),
        triangles=triangles,
        corner_normals=np.broadcast_to(UP, (len(triangles), 3, 3)).copy(),
        corner_uv=uv.astype(np.float32),
        island_of_triangle=island,
        material_of_triangle=np.zeros(len(triangles), np.int32),
    )


def matcher_of(*meshes: Mesh, resolution: int = 64, sides: int = 1) -> tuple[SeamMatcher, Texels]:
    """Each mesh on a page of its own, with ``sides`` sides."""
    instances = tuple(Instance(f"object {i}", i, np.eye(4)) for i in range(len(meshes)))
    scene = Scene(meshes, instances, (Material("white"),))
    front = tuple(Placement(i, (1.0, 1.0), (0.0, 0.0)) for i in range(len(meshes)))
    back = tuple(Placement(len(meshes) + i, (1.0, 1.0), (0.0, 0.0)) if sides == 2 else None for i in range(len(meshes)))
    atlas = Atlas(resolution, len(meshes) * sides, front, back)
    texels = make_texels(scene, atlas, Geometry(scene, scene.first_frame()))
    return SeamMatcher(scene, atlas, DilationMap(texels.index), texels.surface), texels


def lit(texels: Texels, seed: int = 0, noise: float = 0.02) -> np.ndarray:
    """Values around 1: each island off by up to 10 %, with texel noise."""
    rng = np.random.default_rng(seed)
    level = 1 + 0.1 * rng.random((texels.surface_count, 3))
    return (level[texels.surface] * (1 + noise * rng.standard_normal((texels.count, 3)))).astype(np.float32)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


@pytest.mark.parametrize(("tiles", "per_tile"), [(1, 3), (2, 1), (2, 3), (4, 2)])
def test_finds_the_cuts_of_a_patchwork(tiles, per_tile):
    mesh = patchwork(tiles, per_tile)
    seams = find_seams(mesh.triangles, mesh.corner_uv, mesh.corner_normals)
    assert len(seams.uv_a) == len(seams.uv_b) == 2 * tiles * per_tile * (tiles - 1)


def two_triangles(uv_shift=(0.5, 0.0), angle=0.0, order=(0, 1, 2)):
    """A square's two triangles: shared edge 0-2, second triangle's UVs shifted and its normals turned by ``angle``."""
    square = np.float32([[0, 0], [0.3, 0], [0.3, 0.3], [0, 0.3]])
    triangles = np.int32([[0, 1, 2], np.array([0, 2, 3])[list(order)]])
    uv = square[triangles]
    uv[1] += np.float32(uv_shift)
    normals = np.tile(UP, (2, 3, 1))
    normals[1] = [0, np.sin(np.radians(angle)), np.cos(np.radians(angle))]
    return triangles, uv, normals


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
def test_a_cut_pairs_the_same_ends(order):
    seams = find_seams(*two_triangles(order=order))
    assert len(seams.uv_a) == 1
    np.testing.assert_allclose(np.abs(seams.uv_b - seams.uv_a), [[[0.5, 0]] * 2], atol=1e-6)


def test_what_is_no_seam():
    triangles, uv, normals = two_triangles()
    assert len(find_seams(*two_triangles(uv_shift=(0, 0))).uv_a) == 0  # not cut
    assert len(find_seams(*two_triangles(angle=4.9)).uv_a) == 1
    assert len(find_seams(*two_triangles(angle=5.1)).uv_a) == 0  # a sharp edge
    assert len(find_seams(*two_triangles(angle=180)).uv_a) == 0  # a sheet with two faces
    three = (np.concatenate([a, a[1:]]) for a in (triangles, uv, normals))
    assert len(find_seams(*three).uv_a) == 0  # three triangles at one edge
    collapsed = uv.copy()
    collapsed[1] = 0.9
    assert len(find_seams(triangles, collapsed, normals).uv_a) == 0  # no length in UV
    assert len(find_seams(triangles[:0], uv[:0], normals[:0]).uv_a) == 0


def test_a_cylinder_is_cut_along_one_line():
    """One island whose left and right ends meet: the cut is inside one island, found by its UVs."""
    around, up = 12, 5
    ring, level = np.meshgrid(np.arange(around), np.arange(up))
    ring, level = ring.ravel(), level.ravel()
    after = (ring + 1) % around
    quad = np.stack([level * around + ring, level * around + after], axis=1)
    quad = np.concatenate([quad, quad[:, ::-1] + around], axis=1)
    uv_quad = np.stack([np.stack([ring + i, level + j], axis=1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))], axis=1)
    angle = np.arange((up + 1) * around) % around * 2 * np.pi / around
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1).astype(np.float32)
    split = [[0, 1, 2], [0, 2, 3]]
    triangles = quad[:, split].reshape(-1, 3).astype(np.int32)
    uv = (uv_quad[:, split].reshape(-1, 3, 2) / [around + 1, up + 1]).astype(np.float32)
    seams = find_seams(triangles, uv, normal[triangles])
    assert len(seams.uv_a) == up
    np.testing.assert_allclose(np.sort([seams.uv_a[..., 0], seams.uv_b[..., 0]], axis=0)[1], around / (around + 1))


@pytest.mark.parametrize(("tiles", "resolution"), [(2, 64), (4, 160)])
def test_jumps_close(tiles, resolution):
    matcher, texels = matcher_of(patchwork(tiles, gap=4 / resolution / 2), resolution=resolution)
    values = lit(texels)
    assert matcher.sample_count > 4 * (tiles - 1) * tiles * 5
    before, after = matcher.jumps(values), matcher.jumps(matcher.match(values))
    assert rms(before) > 0.03 and rms(after) < rms(before) / 15
    assert np.abs(after).max() < np.abs(before).max() / 8


def test_jumps_are_those_of_the_shown_page():
    """Two islands of 1 and 3: every sample sees 2, through bilinear lookups in padded pages."""
    matcher, texels = matcher_of(patchwork(2))
    values = np.where(texels.surface == 0, 3, 1)[:, None] * np.ones(3, np.float32)
    jumps = np.abs(matcher.jumps(values.astype(np.float32)))
    assert np.isclose(jumps, 2, atol=1e-5).any() and (np.isclose(jumps, 2, atol=1e-5) | (jumps < 1e-5)).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), level=st.floats(1e-6, 1e6))
def test_constants_stay_and_sums_are_kept(seed, level):
    matcher, texels = matcher_of(patchwork(2, seed=seed % 50))
    flat = np.full((texels.count, 3), level, np.float32)
    np.testing.assert_allclose(matcher.match(flat), flat, rtol=1e-6)
    values = lit(texels, seed) * np.float32(level)
    matched = matcher.match(values)
    np.testing.assert_allclose(matched.sum(axis=0, dtype=np.float64), values.sum(axis=0, dtype=np.float64), rtol=1e-6)
    # No value leaves the range that was there by more than the noise.
    assert matched.max() <= values.max() * 1.02 and matched.min() >= values.min() / 1.02


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), exponent=st.integers(-40, 40))
def test_linear_and_each_channel_by_itself(seed, exponent):
    matcher, texels = matcher_of(patchwork(2))
    values = lit(texels, seed)
    matched = matcher.match(values)
    np.testing.assert_array_equal(
        matcher.match(values * np.float32(2.0**exponent)), matched * np.float32(2.0**exponent)
    )
    single = np.zeros_like(values)
    single[:, 1] = values[:, 1]
    np.testing.assert_allclose(matcher.match(single)[:, 1], matched[:, 1], rtol=1e-6)
    assert not matcher.match(single)[:, [0, 2]].any()


def test_never_negative():
    matcher, texels = matcher_of(patchwork(2))
    values = np.where(texels.surface == 0, 1e6, 0)[:, None] * np.ones(3)
    matched = matcher.match(values.astype(np.float32))
    assert matched.min() >= 0 and np.isfinite(matched).all() and matched.max() <= 1e6 * 1.001


def test_only_texels_near_a_seam_change():
    matcher, texels = matcher_of(patchwork(2), resolution=128)
    values = lit(texels)
    changed = (matcher.match(values) != values).any(axis=1)
    assert 0 < changed.sum() <= matcher.texel_count < texels.count / 2


@pytest.mark.parametrize("factor", [0.0, 1.0, 1e6])
def test_objects_do_not_mix(factor):
    """A second object, black or a million times brighter, leaves the first one's bits as they are alone."""
    one, alone = matcher_of(patchwork(2, seed=1))
    two, both = matcher_of(patchwork(2, seed=1), patchwork(2, seed=2))
    values = lit(both)
    values[alone.count :] *= np.float32(factor)
    matched = two.match(values)
    np.testing.assert_array_equal(matched[: alone.count], one.match(values[: alone.count]))
    assert factor > 0 or not matched[alone.count :].any()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_was_matched_before_does_not_matter(seed):
    """Objects change at random, one, both or none: the bits of a matcher that never saw another frame."""
    rng = np.random.default_rng(seed)
    meshes = patchwork(2, seed=1), patchwork(2, seed=2)
    matcher, texels = matcher_of(*meshes)
    values = lit(texels, seed)
    for _ in range(4):
        values = values * rng.choice(np.float32([1, 1, 0.7, 1.3]), 2)[texels.instance][:, None]
        given_values = values.copy()
        result = matcher.match(given_values)
        np.testing.assert_array_equal(result, matcher_of(*meshes)[0].match(values))
        given_values[:] = result[:] = 7  # the caller's own


def test_only_what_changed_is_solved(monkeypatch):
    """The second object alone changes: the solver is given its rows, and none where nothing does."""
    matcher, texels = matcher_of(patchwork(2, seed=1), patchwork(2, seed=2))
    values = lit(texels)
    matcher.match(values)
    solved = []

    def spied(operator, b, *, group, **how):
        solved.append(int((group >= 0).sum()))
        return conjugate_gradients(operator, b, group=group, **how)

    monkeypatch.setattr(seams, "conjugate_gradients", spied)
    matcher.match(values)
    assert solved == []
    values[texels.instance == 1] *= 2
    matcher.match(values)
    assert len(solved) == 1 and 0 < solved[0] < matcher.texel_count


def test_both_sides_are_matched():
    front, _ = matcher_of(patchwork(2))
    both, texels = matcher_of(patchwork(2), sides=2)
    assert both.sample_count == 2 * front.sample_count
    values = lit(texels)
    assert rms(both.jumps(both.match(values))) < rms(both.jumps(values)) / 15


def test_nothing_to_match_costs_nothing():
    matcher, texels = matcher_of(patchwork(1))
    values = lit(texels)
    assert matcher.texel_count == matcher.sample_count == 0 and matcher.match(values) is values
    assert matcher.jumps(values).shape == (0, 3)


def test_a_smooth_shaded_rim_is_no_seam():
    """Faces back to back that share their shading normals: light may differ on their two sides."""
    triangles, uv, normals = two_triangles()
    flat = np.array([[0, 0, 1], [0, 0, 1]], np.float32)
    bent = np.array([[0, 0, 1], [np.sin(1.1), 0, np.cos(1.1)]], np.float32)
    assert len(find_seams(triangles, uv, normals, face_normals=flat).uv_a) == 1
    assert len(find_seams(triangles, uv, normals, face_normals=bent).uv_a) == 0
    bent[1] = np.sin(0.5), 0, np.cos(0.5)  # 29°: a tube of thirteen sides
    assert len(find_seams(triangles, uv, normals, face_normals=bent).uv_a) == 1


def test_islands_of_few_texels_keep_their_own_light():
    """Their cuts differ by the width of a texel; the same patchwork on more texels is matched."""
    coarse, texels = matcher_of(patchwork(4), resolution=24)
    assert np.bincount(texels.surface).max() < LEAST_TEXELS
    values = lit(texels)
    assert coarse.match(values) is values
    fine, texels = matcher_of(patchwork(4), resolution=128)
    assert np.bincount(texels.surface).min() >= LEAST_TEXELS
    assert fine.texel_count > 0
