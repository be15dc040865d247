# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole bake against closed forms, laws of light, and itself. No denoising: these are the estimators alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.scene import Atlas, Instance, LightMaps, Material, Scene
from rtgi_addon.backend.session import FrameStats, Session
from rtgi_addon.backend.settings import AimBounced, AimDirect, BakeSettings, Quality
from rtgi_addon.backend.surface.texels import place_texels
from tests.backend import scenes

BARE = BakeSettings(denoise=False, quality=Quality.PREVIEW, threads=1)


def bake(scene: Scene, atlas, settings: BakeSettings = BARE):
    """((n, 3) IIM, (n, 3) AIM, session's texels, (n,) area, result) of the first frame, valid texels only."""
    state = scene.first_frame()
    with Session(scene, atlas, replace(settings, resolution=max(16, atlas.resolution)), state) as session:
        result = session.advance(state)
        t = session.texels
        ok = result.maps.valid[t.page, t.row, t.col]
        at = t.page[ok], t.row[ok], t.col[ok]
        area = place_texels(t, session.geometry).area[ok]
        assert np.isfinite(result.maps.iim).all() and np.isfinite(result.maps.aim).all()
        assert (result.maps.iim >= 0).all() and (result.maps.aim >= 0).all()
        return result.maps.iim[at], result.maps.aim[at], t.instance[ok], area, result


def sphere_room(albedo: float, radius: float = 1.0, power: float = 100.0, *, smooth: bool = True):
    mesh = scenes.sphere("room", radius, rings=48, smooth=smooth)
    lamp = scenes.point_light((0, 0, 0), power)
    scene = Scene((mesh,), (Instance("room", 0, np.eye(4)),), (Material("wall", (albedo,) * 3),), (lamp,))
    return scene, scenes.grid_atlas(scene, [(48, 24)])


@pytest.mark.parametrize("albedo, within", [(0.1, 0.01), (0.5, 0.01), (0.9, 0.01), (0.98, 0.03)])
@pytest.mark.parametrize("smooth", [True, False])
def test_lamp_in_a_sphere(albedo, within, smooth):
    """E_indirect = P / (4πR²) · ρ / (1 - ρ), the same everywhere."""
    iim, aim, _, _, _ = bake(*sphere_room(albedo, 2.0, 60.0, smooth=smooth))
    direct = 60.0 / (4 * np.pi * 4)
    np.testing.assert_allclose(iim, direct * albedo / (1 - albedo), rtol=within)
    # Flat facets at the poles are long: their corners are turned from the lamp by 10°.
    np.testing.assert_allclose(aim - iim, direct, rtol=0.01 if smooth else 0.02)


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.9])
def test_white_furnace(albedo):
    """A closed box that glows everywhere with L: E = πL / (1 - ρ) at every texel, corners too."""
    mesh = scenes.box("furnace", (2, 3, 4), texels=8, inward=True)
    scene = Scene((mesh,), (Instance("furnace", 0, np.eye(4)),), (Material("wall", (albedo,) * 3, (2.0, 2.0, 2.0)),))
    iim, _, _, _, _ = bake(scene, scenes.grid_atlas(scene, [(30, 20)]))
    np.testing.assert_allclose(iim, np.pi * 2 / (1 - albedo), rtol=2e-3)


def test_convex_object_in_a_uniform_sky():
    mesh = scenes.sphere("ball", 1.0, rings=24, inward=False)
    scene = Scene((mesh,), (Instance("ball", 0, np.eye(4)),), (scenes.WHITE,), (), scenes.constant_sky(0.7))
    iim, _, _, _, _ = bake(scene, scenes.grid_atlas(scene, [(32, 16)]))
    assert np.median(iim) == pytest.approx(np.pi * 0.7, rel=1e-5)
    # The poles' texels span facets that are turned from one another; a ray may enter the ball there.
    np.testing.assert_allclose(iim, np.pi * 0.7, rtol=0.02)


def glowing_square_and_receiver(corners):
    """A unit square that glows upwards with L = 1 from z = 0, and a black unit square with ``corners``."""
    glow, dark = Material("glow", (0, 0, 0), (1, 1, 1)), Material("dark", (0, 0, 0))
    lamp = scenes.quad("lamp", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    receiver = scenes.quad("receiver", corners, material=1)
    scene = Scene((lamp, receiver), (Instance("lamp", 0, np.eye(4)), Instance("receiver", 1, np.eye(4))), (glow, dark))
    return scene, scenes.grid_atlas(scene, [(24, 24)] * 2)


@pytest.mark.parametrize(
    "corners, form_factor",
    [
        ([(0, 1, 1), (1, 1, 1), (1, 0, 1), (0, 0, 1)], 0.199825),  # facing squares, distance = side
        ([(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)], 0.200044),  # adjoining squares at a right angle
    ],
)
def test_form_factors_of_squares(corners, form_factor):
    """Mean irradiance is π L F (Howell, C-11 and C-14)."""
    iim, _, instance, _, _ = bake(*glowing_square_and_receiver(corners), replace(BARE, quality=Quality.FINAL))
    assert iim[instance == 1].mean() == pytest.approx(np.pi * form_factor, rel=0.01)


def test_energy_of_a_closed_room_balances():
    """Absorbed = emitted: ∫ (1 - ρ) E dA equals the lamp's power."""
    mesh = scenes.box("room", (2, 3, 2.5), texels=24, inward=True)
    lamp = scenes.point_light((0.3, -0.5, 0.4), 80.0)
    scene = Scene((mesh,), (Instance("room", 0, np.eye(4)),), (Material("wall", (0.7, 0.4, 0.2)),), (lamp,))
    settings = replace(BARE, quality=Quality.PREVIEW, direct_samples=16)
    _, aim, _, area, _ = bake(scene, scenes.grid_atlas(scene, [(78, 52)]), settings)
    absorbed = ((1 - np.array([0.7, 0.4, 0.2])) * aim * area[:, None]).sum(axis=0)
    np.testing.assert_allclose(absorbed, 80.0, rtol=0.01)


def test_photons_and_feedback_agree():
    """Two independent estimates of the bounced light in the Cornell box."""
    scene, atlas = scenes.cornell(16)
    feedback, _, instance, _, _ = bake(scene, atlas, replace(BARE, quality=Quality.FINAL))
    by_photons = replace(BARE, quality=Quality.FINAL, aim_bounced=AimBounced.PHOTONS, photons=150_000)
    photons, _, _, _, result = bake(scene, atlas, by_photons)
    assert result.stats.photons_traced == 150_000
    for wall in range(5):
        rows = instance == wall
        np.testing.assert_allclose(photons[rows].mean(axis=0), feedback[rows].mean(axis=0), rtol=0.03)


def test_the_papers_own_aim_is_close_to_the_shadow_rayed_one():
    scene, atlas = scenes.cornell(16)
    _, rayed, instance, _, _ = bake(scene, atlas)
    _, paper, _, _, _ = bake(scene, atlas, replace(BARE, aim_direct=AimDirect.PHOTONS, photons=200_000))
    for wall in range(5):
        assert paper[instance == wall].mean() == pytest.approx(rayed[instance == wall].mean(), rel=0.05)


def lamp_and_receiver(lamp_height: float, *, mirror: bool):
    """A glowing square at ``lamp_height`` and a black one beside it at height 1, facing down; a mirror at height 0."""
    glow, dark = Material("glow", (0, 0, 0), (1, 1, 1)), Material("dark", (0, 0, 0))
    z = lamp_height
    lamp = [(0, 0, z), (1, 0, z), (1, 1, z), (0, 1, z)]  # its front has the map: towards the mirror, or the receiver
    meshes = [
        scenes.quad("lamp", lamp[::-1] if mirror else lamp),
        scenes.quad("receiver", [(2, 1, 1), (3, 1, 1), (3, 0, 1), (2, 0, 1)], material=1),
    ]
    if mirror:
        meshes.append(scenes.quad("mirror", [(-9, -9, 0), (12, -9, 0), (12, 9, 0), (-9, 9, 0)], material=2))
    instances = tuple(Instance(m.name, i, np.eye(4)) for i, m in enumerate(meshes))
    scene = Scene(tuple(meshes), instances, (glow, dark, Material("mirror", (0, 0, 0), specular=(0.8, 0.4, 0.0))))
    return scene, scenes.grid_atlas(scene, [(8, 8)] * len(meshes))


def test_what_a_mirror_shows_lights_like_its_image():
    """Lamp and receiver in one plane see each other in the mirror alone, where the lamp seems to be at height -1."""
    seen = []
    for seed in range(4):  # by the mirror only cosine rays find the lamp
        by_mirror, _, at, _, _ = bake(
            *lamp_and_receiver(1.0, mirror=True), replace(BARE, quality=Quality.FINAL, seed=seed)
        )
        seen.append(by_mirror[at == 1].mean(axis=0))
    image, _, at_image, _, _ = bake(*lamp_and_receiver(-1.0, mirror=False), replace(BARE, quality=Quality.FINAL))
    expected = np.array([0.8, 0.4, 0.0]) * image[at_image == 1].mean(axis=0)
    np.testing.assert_allclose(np.mean(seen, axis=0), expected, rtol=0.05, atol=1e-9)


@pytest.mark.parametrize(
    "pane, share",
    [
        (Material("clear glass", (0, 0, 0), transmission=(1, 1, 1), ior=1.0), 1.0),
        (Material("tinted glass", (0, 0, 0), transmission=(0.5, 0.25, 0), ior=1.0), np.array([0.5, 0.25, 0])),
        (Material("half there", (0, 0, 0), opacity=0.5), 0.5),
    ],
)
def test_light_through_a_pane(pane, share):
    scene, _ = glowing_square_and_receiver([(0, 1, 1), (1, 1, 1), (1, 0, 1), (0, 0, 1)])
    sheet = scenes.quad("pane", [(-9, -9, 0.5), (9, -9, 0.5), (9, 9, 0.5), (-9, 9, 0.5)], material=2)
    scene = Scene((*scene.meshes, sheet), (*scene.instances, Instance("pane", 2, np.eye(4))), (*scene.materials, pane))
    atlas = scenes.grid_atlas(scene, [(16, 16), (16, 16), (4, 4)])
    iim, _, instance, _, _ = bake(scene, atlas, replace(BARE, quality=Quality.FINAL))
    expected = np.pi * 0.199825 * np.ones(3) * share
    np.testing.assert_allclose(iim[instance == 1].mean(axis=0), expected, rtol=0.04, atol=1e-6)


def test_texels_under_a_block_are_not_valid_and_take_their_neighbours_light():
    scene, atlas = scenes.cornell(24)
    state = scene.first_frame()
    with Session(scene, atlas, replace(BARE, resolution=atlas.resolution), state) as session:
        maps = session.advance(state).maps
        t, world = session.texels, place_texels(session.texels, session.geometry).position + session.geometry.origin
    short = np.linalg.inv(scene.instances[5].matrix_world)
    inside = np.abs((world @ short[:3, :3].T + short[:3, 3])[:, :2]).max(axis=1)
    floor = t.instance == 0
    valid = maps.valid[t.page, t.row, t.col]
    assert not valid[floor & (inside < 0.25)].any()
    assert valid[floor & (inside > 0.4) & (world[:, 0] > 0)].all()
    assert (maps.iim[t.page, t.row, t.col][floor & (inside < 0.25)] > 0).all()


def test_thread_count_and_repetition_change_no_bit():
    scene, atlas = scenes.cornell(16)
    one = bake(scene, atlas)[4].maps
    for threads in (1, 2, 3):
        assert_same_maps(one, bake(scene, atlas, replace(BARE, threads=threads))[4].maps)


def assert_same_maps(a: LightMaps, b: LightMaps) -> None:
    np.testing.assert_array_equal(a.iim, b.iim)
    np.testing.assert_array_equal(a.aim, b.aim)
    np.testing.assert_array_equal(a.valid, b.valid)


@given(scale=st.floats(1e-3, 1e3))
@settings(max_examples=5, deadline=None)
def test_light_is_linear_in_power(scale):
    scene, atlas = scenes.cornell(8)
    brighter = replace(scene, lights=(replace(scene.lights[0], power=(50.0 * scale,) * 3),))
    np.testing.assert_allclose(bake(brighter, atlas)[0], scale * bake(scene, atlas)[0], rtol=1e-3, atol=1e-6 * scale)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_lamps_obey_the_inverse_square_law_at_any_size(scale):
    scene, atlas = scenes.cornell(12)
    matrix = np.diag([scale, scale, scale, 1.0])
    instances = tuple(replace(i, matrix_world=matrix @ i.matrix_world) for i in scene.instances)
    lamp = replace(scene.lights[0], matrix_world=matrix @ scene.lights[0].matrix_world)
    scaled = replace(scene, instances=instances, lights=(lamp,))
    expected = bake(scene, atlas)[0].mean()
    assert bake(scaled, atlas)[0].mean() * scale**2 == pytest.approx(expected, rel=0.02)


def test_a_scene_a_million_metres_out_is_lit_alike():
    scene, atlas = scenes.cornell(12)
    shift = scenes.translation(1e6, -1e6, 2e5)
    instances = tuple(replace(i, matrix_world=shift @ i.matrix_world) for i in scene.instances)
    lamp = replace(scene.lights[0], matrix_world=shift @ scene.lights[0].matrix_world)
    far = replace(scene, instances=instances, lights=(lamp,))
    near_iim, far_iim = bake(scene, atlas)[0], bake(far, atlas)[0]
    assert far_iim.mean() == pytest.approx(near_iim.mean(), rel=0.01)


def test_counts_are_what_the_settings_say():
    scene, atlas = scenes.cornell(16)
    stats: FrameStats = bake(scene, atlas)[4].stats
    assert (stats.cosine_rays, stats.bright_rays) == (32, 32)
    assert stats.links_traced <= stats.texels_updated * 70
    assert stats.links_traced >= stats.texels_updated * 32
    assert stats.surfaces_updated == 5 + 12


def test_target_error_is_met_by_its_own_estimate_and_in_truth():
    scene, atlas = scenes.cornell(16)
    truth = np.mean([bake(scene, atlas, replace(BARE, quality=Quality.FINAL, seed=s))[0] for s in range(8, 16)], axis=0)
    iim, _, _, _, result = bake(scene, atlas, replace(BARE, target_error=0.05))
    assert result.stats.estimated_error <= 0.05
    assert np.sqrt(np.mean((iim - truth) ** 2)) / truth.mean() <= 0.05 * 1.5


def test_scenes_with_nothing_to_light():
    """No faces, no light, one triangle: black maps, no fault."""
    empty = Scene((), (), ())
    iim, _, _, _, result = bake(empty, Atlas(16, 1, (), ()))
    assert iim.shape == (0, 3) and result.stats.estimated_error is None
    one = scenes.mesh_of_triangles("one", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0], [1, 0], [0, 1]], [0])
    scene = Scene((one,), (Instance("one", 0, np.eye(4)),), (scenes.WHITE,))
    iim, aim, _, _, _ = bake(scene, scenes.grid_atlas(scene, [(1, 1)]))
    assert len(iim) == 1 and not iim.any() and not aim.any()
