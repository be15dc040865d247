# SPDX-License-Identifier: GPL-3.0-or-later
"""Direct irradiance by shadow rays: closed forms by kind of lamp, shadows, and only the rays that are needed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.lamps.direct import (
    MOST_SHEETS,
    direct_irradiance,
    irradiance_of,
    lamp_irradiance,
    make_receivers,
    make_shadows,
    reached,
)
from rtgi_addon.backend.photon.photon_map import direct_hits
from rtgi_addon.backend.scene import AreaShape, Instance, Light, LightKind, Material, Scene
from tests.backend.lamps import LAMPS
from tests.backend.rig import Rig, make_rig
from tests.backend.scenes import cornell, grid_atlas, point_light, quad, sphere, translation

WHITE = Material("white")
SIZE = 16


def floor(half: float = 2.0, material: int = 0):
    return quad("floor", [(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)], material=material)


def floor_rig(*lights: Light, over=(), materials=(WHITE,)) -> Rig:
    """A floor of 4 m at z = 0 with whatever hangs over it; instance 0 is the floor."""
    meshes = (floor(), *over)
    instances = tuple(Instance(m.name, i, np.eye(4)) for i, m in enumerate(meshes))
    scene = Scene(meshes, instances, materials, lights)
    return make_rig(scene, grid_atlas(scene, [(SIZE, SIZE)] * len(meshes)))


def of_floor(rig: Rig) -> np.ndarray:
    return np.nonzero(rig.texels.instance == 0)[0]


def places(rig: Rig) -> np.ndarray:
    """(n, 3) world."""
    return rig.frame.position[of_floor(rig)] + rig.geometry.origin


def sheet(height: float, half: float, material: int = 0):
    return quad(
        f"sheet {height}",
        [(-half, -half, height), (half, -half, height), (half, half, height), (-half, half, height)],
        material=material,
    )


def test_point_lamp() -> None:
    rig = floor_rig(point_light((0.3, 0.1, 1.0), 100))
    towards = np.array([0.3, 0.1, 1.0]) - places(rig)
    distance = np.linalg.norm(towards, axis=1)
    expected = 100 * towards[:, 2] / distance / (4 * np.pi * distance**2)
    assert rig.direct(1) == pytest.approx(np.repeat(expected[:, None], 3, axis=1), rel=1e-4)


def test_more_samples_average_over_the_texel() -> None:
    """A texel of 0.25 m right under a lamp: the mean over its footprint, not the value at its centre."""
    rig = floor_rig(point_light((0.125, 0.125, 0.2), 100))
    at = int(np.argmin(np.abs(places(rig)[:, :2] - 0.125).sum(axis=1)))
    grid = (np.arange(400) + 0.5) / 400 * 0.25 - 0.125
    x, y = np.meshgrid(grid, grid)
    mean = (100 * 0.2 / (4 * np.pi * (x**2 + y**2 + 0.04) ** 1.5)).mean()
    assert rig.direct(1024)[at, 0] == pytest.approx(mean, rel=0.02)  # eight points of the footprint
    assert rig.direct(1)[at, 0] == pytest.approx(100 / (4 * np.pi * 0.04), rel=1e-3)


def test_sun_is_irradiance_on_a_facing_plane() -> None:
    tilt = np.eye(4)
    tilt[:3, :3] = [[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]  # looks down its -z, tilted: cosine 0.6
    for angle in (0.0, 0.02):
        rig = floor_rig(Light("sun", LightKind.SUN, tilt, (2.0, 1.0, 0.0), angle=angle))
        assert rig.direct(16) == pytest.approx(np.tile([1.2, 0.6, 0.0], (SIZE**2, 1)), rel=2e-2 if angle else 1e-5)


@pytest.mark.parametrize("shape", list(AreaShape))
def test_area_lamp_against_quadrature(shape: AreaShape) -> None:
    light = Light("area", LightKind.AREA, translation(0, 0, 1.5), (100.0,) * 3, size=(1.0, 0.5), shape=shape)
    rig = floor_rig(light)
    grid = (np.arange(60) + 0.5) / 60 - 0.5
    x, y = (g.ravel() for g in np.meshgrid(grid, grid))
    keep = x**2 + y**2 < 0.25 if shape == AreaShape.ELLIPSE else np.ones(len(x), bool)
    on_lamp = np.stack([x[keep], y[keep] * 0.5, np.full(keep.sum(), 1.5)], axis=1)
    towards = on_lamp[None] - places(rig)[:, None]
    squared = (towards**2).sum(axis=2)
    expected = (100 / np.pi * 1.5**2 / squared**2).mean(axis=1)
    assert rig.direct(256)[:, 0] == pytest.approx(expected, rel=0.02)
    assert np.median(rig.direct(64)[:, 0] / expected) == pytest.approx(1, abs=2e-3)


def test_spot_lights_its_cone_alone() -> None:
    light = Light("spot", LightKind.SPOT, translation(0, 0, 2), (100.0,) * 3, cone=0.5, blend=0.0)
    rig = floor_rig(light)
    radius = np.linalg.norm(places(rig)[:, :2], axis=1)
    got = rig.direct(1)[:, 0]
    edge = 2 * np.tan(0.5)
    assert (got[radius > edge + 1e-3] == 0).all()
    inside = radius < edge - 1e-3
    assert got[inside] == pytest.approx(100 * 2 / (4 * np.pi * (radius[inside] ** 2 + 4) ** 1.5), rel=1e-4)
    _, rays = direct_irradiance((light,), rig.frame, shadows_of(rig), rig.workers, samples=1, seed=0)
    assert rays == inside.sum()


def shadows_of(rig: Rig):
    return make_shadows(rig.tracer, rig.geometry, rig.scene.materials)


def test_a_wall_in_between_casts_a_hard_shadow() -> None:
    lamp = point_light((0, 0, 2), 100)
    rig = floor_rig(lamp, over=(sheet(1.0, 0.5),))
    lit = rig.direct(1)[of_floor(rig), 0] > 0
    inside = np.abs(places(rig)[:, :2]).max(axis=1) < 1.0
    assert np.array_equal(lit, ~inside)
    through = floor_rig(replace(lamp, casts_shadow=False), over=(sheet(1.0, 0.5),))
    assert (through.direct(1)[of_floor(through), 0] > 0).all()


def test_penumbra_of_a_sphere_is_the_share_of_it_that_is_seen() -> None:
    """Under the edge of a half plane exactly half of the lamp shows."""
    edge = quad("edge", [(0, -9, 1), (9, -9, 1), (9, 9, 1), (0, 9, 1)])
    for soft in (True, False):
        lamp = replace(point_light((0, 0, 2), 100), radius=0.2, soft_falloff=soft)
        rig = floor_rig(lamp, over=(edge,))
        free = floor_rig(lamp)
        share = rig.direct(1024)[of_floor(rig), 0] / free.direct(1024)[:, 0]
        x = places(rig)[:, 0]
        assert (share[x > 0.35] == 0).all() and share[x < -0.35] == pytest.approx(1, abs=1e-4)
        near = np.abs(x) < 0.13  # the two columns of texels that meet at the edge's shadow
        assert share[near].mean() == pytest.approx(0.5, abs=0.02)


def test_transparent_sheets_let_their_share_through() -> None:
    lamp = point_light((0, 0, 2), 100)
    half, third = Material("half", opacity=0.5), Material("third", opacity=1 / 3)
    sheets = (sheet(0.5, 9.0, 1), sheet(1.0, 9.0, 2))
    rig = floor_rig(lamp, over=sheets, materials=(WHITE, half, third))
    free = floor_rig(lamp)
    assert rig.direct(4)[of_floor(rig)] == pytest.approx(free.direct(4) / 3, rel=1e-4)
    glass = Material("glass", transmission=(1.0, 1.0, 1.0))
    blocked = floor_rig(lamp, over=(sheet(1.0, 9.0, 1),), materials=(WHITE, glass))
    assert (blocked.direct(4)[of_floor(blocked)] == 0).all()


def test_a_hundred_sheets_end_in_the_dark() -> None:
    sheets = tuple(sheet(0.5 + 0.01 * i, 9.0, 1) for i in range(MOST_SHEETS + 5))
    rig = floor_rig(point_light((0, 0, 2)), over=sheets, materials=(WHITE, Material("thin", opacity=0.01)))
    assert (rig.direct(1)[of_floor(rig)] == 0).all()


def test_a_lamp_on_the_wall_or_on_a_texel_is_finite() -> None:
    for height in (0.0, 1e-7, 1e-3):
        rig = floor_rig(point_light((0.125, 0.125, height), 100))
        got = rig.direct(4)
        assert np.isfinite(got).all() and (got >= 0).all()
    ceiling = Light("area", LightKind.AREA, translation(0, 0, 2), (100.0,) * 3, size=(1.0, 1.0))
    rig = floor_rig(ceiling, over=(sheet(2.0, 5.0),))
    free = floor_rig(ceiling)
    assert rig.direct(4)[of_floor(rig)] == pytest.approx(free.direct(4), rel=1e-4)


def test_the_back_side_gets_nothing_and_costs_nothing() -> None:
    rig = floor_rig(point_light((0, 0, -1), 100))
    irradiance, rays = direct_irradiance(rig.state.lights, rig.frame, shadows_of(rig), rig.workers, samples=4, seed=0)
    assert (irradiance == 0).all() and rays == 0


def test_black_lamps_cost_nothing() -> None:
    dark = replace(point_light((0, 0, 1)), power=(0.0, 0.0, 0.0), radius=0.2)
    rig = floor_rig(dark)
    irradiance, rays = direct_irradiance((dark,), rig.frame, shadows_of(rig), rig.workers, samples=4, seed=0)
    assert (irradiance == 0).all() and rays == 0


def test_inside_a_sphere_direct_light_is_even() -> None:
    mesh = sphere("ball", 2.0, rings=24)
    scene = Scene((mesh,), (Instance("ball", 0, np.eye(4)),), (WHITE,), (point_light((0, 0, 0), 100),))
    got = make_rig(scene, grid_atlas(scene, [(48, 24)])).direct(4)[:, 0]
    expected = 100 / (16 * np.pi)
    assert np.median(got) == pytest.approx(expected, rel=0.01)
    assert got == pytest.approx(np.full(len(got), expected), rel=0.05)  # facets at the poles are coarse


def test_shadow_rays_agree_with_photons() -> None:
    scene, atlas = cornell(12)
    lamps = (
        replace(scene.lights[0], radius=0.05, soft_falloff=False),  # photons leave a sphere
        Light("spot", LightKind.SPOT, translation(0.4, 0.2, 1.8), (40.0,) * 3, cone=0.7, blend=0.6),
        Light("area", LightKind.AREA, translation(-0.3, 0, 1.95), (30.0,) * 3, size=(0.4, 0.4), spread=1.9),
    )
    rig = make_rig(replace(scene, lights=lamps), atlas)
    paths, _ = rig.photons(60_000)
    hits = direct_hits(paths) & (paths.texel >= 0)
    instance = rig.texels.instance[paths.texel[hits]]
    photons = np.bincount(instance, paths.flux[hits, 0].astype(float), minlength=7)
    rays = np.bincount(rig.texels.instance, rig.direct(64)[:, 0] * rig.frame.area.astype(float), minlength=7)
    assert rays == pytest.approx(photons, rel=0.04)


def test_threads_and_seeds() -> None:
    scene, atlas = cornell(12)
    soft = replace(scene, lights=(replace(scene.lights[0], radius=0.08),))
    one, three = (make_rig(soft, atlas, threads=t).direct(4) for t in (1, 3))
    assert one.tobytes() == three.tobytes()
    other = make_rig(soft, atlas).direct(4, seed=1)
    assert not np.array_equal(one, other)
    assert other.mean() == pytest.approx(one.mean(), rel=0.02)


@pytest.mark.parametrize("name", LAMPS)
@pytest.mark.parametrize("samples", [1, 5])
@pytest.mark.parametrize("opacity", [1.0, 0.3])
def test_any_of_the_texels_alone_get_the_same_bits(name: str, samples: int, opacity: float) -> None:
    """However few are asked for, in whatever order and chunks."""
    scene, atlas = cornell(16)
    tilted = translation(0.3, -0.4, 1.6)
    tilted[:3, :3] = [[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]  # its light comes in by the open front
    lamp = replace(LAMPS[name], matrix_world=tilted)
    looks = (replace(scene.materials[0], opacity=opacity), *scene.materials[1:])
    rig = make_rig(replace(scene, lights=(lamp,), materials=looks), atlas, threads=2)
    shadows, rng = shadows_of(rig), np.random.default_rng(samples)
    receivers = make_receivers(rig.frame, rig.geometry, samples=samples)
    whole = direct_irradiance((lamp,), rig.frame, shadows, rig.workers, samples=samples, seed=3)[0]
    assert (whole > 0).any()
    for count in (1, 2, 3, 17, 500):
        texels = rng.choice(rig.texels.count, count, replace=False).astype(np.int32)
        strength = lamp_irradiance(lamp, 0, texels, receivers, shadows, rig.workers, seed=3).strength
        assert irradiance_of(lamp, strength).tobytes() == whole[texels].tobytes()
        part = make_receivers(rig.frame, rig.geometry, samples=samples, texels=texels)
        assert part.offset.tobytes() == receivers.offset[texels].tobytes()
        assert part.reach.tobytes() == receivers.reach[texels].tobytes()
        seen = reached(lamp, receivers, rig.geometry.origin)
        assert np.array_equal(reached(lamp, receivers, rig.geometry.origin, texels), seen[texels])
