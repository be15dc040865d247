# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps, emissive meshes and the sky send out the flux and the directions that Blender's units promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats

from rtgi_addon.backend.lamps import lights as lt
from rtgi_addon.backend.lamps.emission import (
    MESHES,
    SKY,
    LampSource,
    grown_bounds,
    make_bounds,
    make_sources,
    photon_counts,
)
from rtgi_addon.backend.scene import Instance, Light, LightKind, Material, Scene, World
from rtgi_addon.backend.surface.geometry import Geometry
from tests.backend.lamps import BOX, LAMPS, ORIGIN, POWER, numbers
from tests.backend.scenes import box, constant_sky, quad, translation


@pytest.mark.parametrize("name", LAMPS)
def test_photons_carry_the_lamps_flux(name: str) -> None:
    emission = lt.emit_lamp(LAMPS[name], numbers(), origin=ORIGIN, bounds=BOX)
    assert np.isfinite(emission.origin).all() and (emission.weight >= 0).all()
    assert np.allclose((emission.direction**2).sum(axis=1), 1, atol=1e-9)
    assert emission.weight.mean(axis=0) == pytest.approx(lt.lamp_flux(LAMPS[name], BOX), rel=2e-3)
    if not name.endswith("sun"):
        assert np.ptp(emission.weight, axis=0).max() == 0  # equal photons: exact importance sampling


@pytest.mark.parametrize("name", ["point", "sphere", "area", "ellipse", "beam"])
def test_blender_watts(name: str) -> None:
    assert lt.lamp_flux(LAMPS[name], BOX) == pytest.approx(POWER)


def test_spot_flux_is_the_cones_share_of_the_sphere() -> None:
    assert lt.lamp_flux(LAMPS["hard spot"], BOX) == pytest.approx(np.array(POWER) * (1 - np.cos(0.9)) / 2)


def axis_cosine(light: Light) -> np.ndarray:
    emission = lt.emit_lamp(light, numbers(), origin=ORIGIN, bounds=BOX)
    return emission.direction @ lt.place_lamp(light, ORIGIN).axis


def distribution(density, low: float, high: float):
    """The cumulative distribution of an unnormalised density of the cosine."""
    grid = np.linspace(low, high, 20_001)
    cumulative = integrate.cumulative_trapezoid(density(grid), grid, initial=0)
    return lambda x: np.interp(x, grid, cumulative / cumulative[-1])


@pytest.mark.parametrize("name", ["spot", "soft spot", "wide spot"])
def test_spot_photons_follow_the_profile(name: str) -> None:
    light = LAMPS[name]
    cdf = distribution(lambda c: lt.spot_profile(c, light.cone, light.blend), np.cos(light.cone), 1)
    cosine = axis_cosine(light)
    assert (cosine >= np.cos(light.cone) - 1e-12).all()
    assert stats.kstest(cosine, cdf).statistic < 1e-3
    area = integrate.quad(lambda c: float(lt.pdf_spot(np.array(c), light.cone, light.blend)), np.cos(light.cone), 1)[0]
    assert 2 * np.pi * area == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("spread", [0.1, 1.4, 3.0])
def test_spread_photons_follow_the_profile_and_keep_the_power(spread: float) -> None:
    light = replace(LAMPS["area"], spread=spread)
    half = spread / 2
    cdf = distribution(lambda c: lt.pdf_spread(c, half), np.cos(half), 1)
    assert stats.kstest(axis_cosine(light), cdf).statistic < 1e-3
    total = integrate.quad(lambda c: float(lt.pdf_spread(np.array(c), half)), np.cos(half), 1, limit=200)[0]
    assert 2 * np.pi * total == pytest.approx(1, rel=1e-6)


def test_lambertian_area_is_the_limit_of_the_spread() -> None:
    cosine = np.linspace(0.05, 1, 50)
    assert lt.spread_profile(cosine, (np.pi - 2e-3) / 2) == pytest.approx(np.ones(50), rel=0.03)


def test_area_photons_start_on_the_lamp() -> None:
    for name, limit in (("area", np.inf), ("ellipse", 1.0)):
        light = LAMPS[name]
        emission = lt.emit_lamp(light, numbers(4000), origin=ORIGIN, bounds=BOX)
        place = lt.place_lamp(light, ORIGIN)
        local = emission.origin - place.position
        x, y = local @ place.x / 0.25, local @ place.y / 1.0
        assert np.abs(local @ place.axis).max() < 1e-9
        assert max(np.abs(x).max(), np.abs(y).max()) <= 1 + 1e-9 and np.abs(x).max() > 0.95
        assert (x**2 + y**2).max() <= limit + 1e-9


def test_sphere_lamp_is_lambertian() -> None:
    """Photon lines pass the centre at distances uniform on a disk, whatever their direction."""
    light = LAMPS["sphere"]
    emission = lt.emit_lamp(light, numbers(), origin=ORIGIN, bounds=BOX)
    local = emission.origin - lt.place_lamp(light, ORIGIN).position
    assert np.abs((local * emission.direction).sum(axis=1)).max() < 1e-9
    assert stats.kstest((local**2).sum(axis=1) / 0.09, "uniform").statistic < 1e-3


def test_photons_enter_the_box_evenly() -> None:
    direction = np.tile([0.6, -0.48, 0.64], (40_000, 1))
    u, v, choice = np.random.default_rng(0).random((3, 40_000))
    start, area = lt.enter_box(direction, BOX, u, v, choice)
    assert ((start >= BOX.low - 1e-12) & (start <= BOX.high + 1e-12)).all()
    assert area[0] == pytest.approx(0.6 * 4 + 0.48 * 2 + 0.64 * 8)
    # Every start lies on a face that is turned against the light, in proportion to its outline.
    on_x, on_y, on_z = start[:, 0] == -1, start[:, 1] == 2, start[:, 2] == -0.5
    assert (on_x | on_y | on_z).all()
    assert [on_x.mean(), on_y.mean(), on_z.mean()] == pytest.approx([2.4 / 8.48, 0.96 / 8.48, 5.12 / 8.48], abs=0.01)


DARK = [
    Light("a", LightKind.POINT, np.eye(4), (0, 0, 0), radius=0.1),
    Light("b", LightKind.SPOT, np.eye(4), (1, 1, 1), cone=0.0),
    Light("c", LightKind.AREA, np.eye(4), (1, 1, 1), size=(0.0, 1.0)),
    Light("d", LightKind.SUN, np.eye(4), (0, 0, 0)),
]


@pytest.mark.parametrize("light", DARK, ids=lambda light: light.kind)
def test_a_dark_lamp_has_no_photons(light: Light) -> None:
    scene = Scene(
        (quad("q", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]),), (Instance("q", 0, np.eye(4)),), (Material("m"),)
    )
    state = replace(scene.first_frame(), lights=(light,))
    geometry = Geometry(scene, state)
    sources = make_sources(scene, state, geometry, make_bounds(geometry))
    assert sources == [] and photon_counts(sources, 1000) == {}


def test_photons_are_shared_by_flux_and_every_source_has_one() -> None:
    scene = Scene(
        (box("b", (1, 1, 1), texels=2),), (Instance("b", 0, np.eye(4)),), (Material("m", emission=(1, 2, 0)),)
    )
    lamps = (replace(LAMPS["point"], power=(1e-9, 0, 0)), replace(LAMPS["area"], power=(30.0, 10.0, 0.0)))
    state = replace(scene.first_frame(), lights=lamps, world=constant_sky(1.0))
    geometry = Geometry(scene, state)
    sources = make_sources(scene, state, geometry, make_bounds(geometry))
    counts = photon_counts(sources, 10_000)
    flux = {s.light: max(s.flux) for s in sources}
    assert set(counts) == {0, 1, MESHES, SKY} and sum(counts.values()) == 10_000
    assert counts[0] == 1
    # Both sides emit: 2 · π · 6 m² · 2 W/(m² sr).
    assert flux[MESHES] == pytest.approx(24 * np.pi, rel=1e-6)
    for light in (1, MESHES, SKY):
        assert 0.5 <= counts[light] / 10_000 / (flux[light] / sum(flux.values())) <= 2


def emissive_scene() -> Scene:
    image = np.zeros((4, 4, 3), np.float32)
    image[1, 2] = (8.0, 4.0, 0.0)
    mesh = quad("screen", [(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)])
    return Scene((replace(mesh, emission_map=image),), (Instance("screen", 0, np.eye(4)),), (Material("m"),))


@pytest.mark.parametrize("sides", [(True, True), (True, False), (False, True)])
def test_emission_maps_are_drawn_where_they_glow(sides: tuple[bool, bool]) -> None:
    scene = emissive_scene()
    state = scene.first_frame()
    geometry = Geometry(scene, state)
    (source,) = make_sources(scene, state, geometry, make_bounds(geometry), sides=np.array([sides]))
    emission = source.emit(numbers())
    pixel = 2.0 / 16
    expected = np.array([8.0, 4.0, 0.0]) * np.pi * pixel * sum(sides)
    assert emission.weight.mean(axis=0) == pytest.approx(expected, rel=0.03)
    glowing = emission.weight[:, 0] > 0
    start = emission.origin[glowing] + geometry.origin
    assert start[:, 0].min() >= 1.0 - 1e-5 and start[:, 0].max() <= 1.5 + 1e-5
    assert start[:, 1].min() >= 0.25 - 1e-5 and start[:, 1].max() <= 0.5 + 1e-5
    up = emission.direction[glowing, 2] > 0
    assert up.mean() == pytest.approx(sides[0] / sum(sides), abs=0.02)
    assert (emission.origin[glowing, 2] > 0).tolist() == up.tolist()


def test_sky_photons_carry_the_maps_light() -> None:
    """Through a cube, E = π L: flux is L · 4π · mean outline; of a patch, L · Ω · outline."""
    scene = Scene((box("b", (2, 2, 2), texels=2),), (Instance("b", 0, np.eye(4)),), (Material("m"),))
    image = np.zeros((8, 16, 3), np.float32)
    image[6, 3] = (5.0, 1.0, 0.0)
    for world in (constant_sky(0.5), World(image)):
        state = replace(scene.first_frame(), world=world)
        geometry = Geometry(scene, state)
        bounds = lt.Bounds(-np.ones(3), np.ones(3))
        (source,) = make_sources(scene, state, geometry, bounds)
        emission = source.emit(numbers())
        if world.radiance.size == 3:
            assert emission.weight.mean(axis=0) == pytest.approx(np.full(3, 0.5 * np.pi * 24), rel=5e-3)
            continue
        towards = -emission.direction
        low, high = np.sin(np.pi * (6 / 8 - 0.5)), np.sin(np.pi * (7 / 8 - 0.5))
        assert towards[:, 2].min() >= low - 1e-6 and towards[:, 2].max() <= high + 1e-6
        u = 0.5 - np.arctan2(towards[:, 1], towards[:, 0]) / (2 * np.pi)
        assert u.min() >= 3 / 16 - 1e-6 and u.max() <= 4 / 16 + 1e-6
        outline = np.abs(towards).sum(axis=1).mean() * 4
        solid_angle = (high - low) * 2 * np.pi / 16
        assert emission.weight[:, 0].mean() == pytest.approx(5 * solid_angle * outline, rel=5e-3)


def test_bounds_grow_only_when_they_must() -> None:
    scene = Scene((box("b", (1, 1, 1), texels=2),), (Instance("b", 0, np.eye(4), moving=True),), (Material("m"),))
    state = scene.first_frame()
    geometry = Geometry(scene, state)
    bounds = make_bounds(geometry)
    assert grown_bounds(bounds, geometry) is bounds
    geometry.update(replace(state, matrix_world=np.array([translation(2, 0, 0)])))
    grown = grown_bounds(bounds, geometry)
    step = np.sqrt(3) / 16
    out = grown.high[0] - bounds.high[0]
    assert grown.low.tolist() == bounds.low.tolist() and grown.high[1:].tolist() == bounds.high[1:].tolist()
    assert 2 - 1e-3 <= out < 4 and np.log2(out / step) == pytest.approx(round(np.log2(out / step)), abs=1e-2)
    geometry.update(replace(state, matrix_world=np.array([translation(2.3, 0, 0)])))
    assert grown_bounds(bounds, geometry).high.tolist() == grown.high.tolist()
    geometry.update(state)
    assert grown_bounds(bounds, geometry) is bounds


@given(st.lists(st.floats(1e-3, 1e5), min_size=1, max_size=6), st.floats(0.72, 1.4))
def test_counts_stay_while_lights_dim_a_little(powers: list[float], factor: float) -> None:
    """Every count hangs on powers of two alone; the total is kept, and each light gets near its share."""

    def counts(values: list[float]) -> list[int]:
        lamps = [replace(LAMPS["point"], power=(p, p / 2, 0.0)) for p in values]
        bounds = lt.Bounds(-np.ones(3), np.ones(3))
        sources = [LampSource(i, lamp, np.zeros(3), bounds) for i, lamp in enumerate(lamps)]
        return list(photon_counts(sources, 100_000).values())

    even = [2.0 ** round(np.log2(p)) for p in powers]
    # Within 2^±0.47 of a power of two: no light passes to the next one.
    assert counts(even) == counts([e * factor if i == 0 else e for i, e in enumerate(even)])
    got = np.array(counts(powers))
    assert 0 <= got.sum() - 100_000 < len(powers) and got.min() >= 1
    share = np.array(powers) / sum(powers) * 100_000
    assert (got <= 2 * share + len(powers) + 1).all() and (got + 1 >= share / 2 - 1).all()


@pytest.mark.parametrize("factor", [0.7, 0.3, 1.1])
def test_a_sky_that_dims_keeps_its_photons(factor: float) -> None:
    rng = np.random.default_rng(1)
    image = (rng.random((8, 16, 3)) ** 8 * 50).astype(np.float32)
    scene = Scene((box("b", (2, 2, 2), texels=2),), (Instance("b", 0, np.eye(4)),), (Material("m"),))
    geometry = Geometry(scene, scene.first_frame())
    emitted = []
    for world in (World(image), World(image * np.float32(factor))):
        (source,) = make_sources(
            scene, replace(scene.first_frame(), world=world), geometry, lt.Bounds(-np.ones(3), np.ones(3))
        )
        emitted.append(source.emit(numbers()))
    one, other = emitted
    assert one.origin.tobytes() == other.origin.tobytes() and one.direction.tobytes() == other.direction.tobytes()
    assert other.weight == pytest.approx(one.weight * factor, rel=1e-6)


@given(st.integers(1, 200), st.integers(0, 2**32 - 1), st.booleans())
def test_bounds_hold_every_finite_corner_and_little_more(count: int, seed: int, broken: bool) -> None:
    corners = np.random.default_rng(seed).normal(size=(count, 3, 3)).astype(np.float32)
    if broken:
        corners[seed % count, seed % 3, 0] = (np.nan, np.inf, -np.inf)[seed % 3]
    scene = Scene((quad("any", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]),), (Instance("any", 0, np.eye(4)),), ())
    geometry = Geometry(scene, scene.first_frame())
    geometry.corners = corners
    bounds = make_bounds(geometry)
    good = corners.reshape(-1, 3)[np.isfinite(corners).all(axis=2).ravel()].astype(np.float64)
    size = np.linalg.norm(np.ptp(good, axis=0))
    np.testing.assert_allclose(bounds.low, good.min(axis=0) - 1e-4 * size, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(bounds.high, good.max(axis=0) + 1e-4 * size, rtol=1e-9, atol=1e-12)
