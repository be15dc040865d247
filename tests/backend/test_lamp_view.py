# SPDX-License-Identifier: GPL-3.0-or-later
"""What points see of lamps: closed forms, agreement with the photons' flux, and bounds on single samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.lamps import lights as lt
from rtgi_addon.backend.lamps.lamp_view import may_see, view_lamp
from rtgi_addon.backend.lamps.spherical_rectangle import pdf_rectangle, sample_rectangle, see_rectangle
from rtgi_addon.backend.scene import AreaShape, Light, LightKind
from tests.backend.lamps import BOX, LAMPS, ORIGIN, POWER, lamp, numbers
from tests.backend.scenes import translation

VIEWS = {
    "point": (LAMPS["point"], lambda d, c: c / (4 * np.pi * d**2)),
    "soft": (replace(LAMPS["point"], radius=0.4), lambda d, c: c / (4 * np.pi * (d**2 + 0.16))),
    "sphere": (replace(LAMPS["point"], radius=0.4, soft_falloff=False), lambda d, c: c / (4 * np.pi * d**2)),
}


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("distance", [0.9, 3.0, 50.0])
def test_irradiance_of_round_lamps(name: str, distance: float) -> None:
    """Closed forms measured in Cycles: a facing disk P c / (4π (d² + r²)), a sphere P c / (4π d²)."""
    light, expected = VIEWS[name]
    towards = np.array([0.36, 0.48, 0.8])
    normal = np.array([0.0, 0.0, 1.0], np.float32)
    point = lt.place_lamp(light, ORIGIN).position - towards * distance
    u, v, *_ = numbers(20_000)
    points = np.tile(point.astype(np.float32), (len(u), 1))
    view = view_lamp(
        light,
        points,
        u.astype(np.float32),
        v.astype(np.float32),
        origin=ORIGIN,
        nearest=np.full(len(u), 1e-6, np.float32),
        far=9,
    )
    mean = (view.strength * np.maximum(view.direction @ normal, 0)).mean(dtype=np.float64)
    assert mean == pytest.approx(expected(distance, 0.8), rel=3e-3)
    assert np.abs(view.distance - distance).max() <= 0.45


@pytest.mark.parametrize("name", [n for n in LAMPS if "sun" not in n])
def test_what_points_see_is_what_lamps_send(name: str) -> None:
    """Far out, irradiance over a sphere around the lamp adds up to its flux: photons and shadow rays agree."""
    light = LAMPS[name]
    place = lt.place_lamp(light, ORIGIN)
    count = 200_000
    rng = np.random.default_rng(5)
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    if name == "beam":  # half a degree wide: look only where it goes
        z = 1 - rng.random(count) * (1 - np.cos(0.06))
        angle = rng.random(count) * 2 * np.pi
        r = np.sqrt(1 - z * z)
        out = np.outer(r * np.cos(angle), place.x) + np.outer(r * np.sin(angle), place.y) + np.outer(z, place.axis)
    sphere = 4 * np.pi * 400**2 * ((1 - np.cos(0.06)) / 2 if name == "beam" else 1)
    points = (place.position + 400 * out).astype(np.float32)
    u, v = rng.random((2, count)).astype(np.float32)
    view = view_lamp(light, points, u, v, origin=ORIGIN, nearest=np.full(count, 1e-4, np.float32), far=9)
    strength = view.strength * -(view.direction * out).sum(axis=1)
    assert (strength > -1e-9).all()
    flux = strength.mean() * sphere * np.array(POWER)
    assert flux == pytest.approx(lt.lamp_flux(light, BOX), rel=0.02)


def test_sun_gives_its_strength_on_a_facing_plane() -> None:
    for angle in (0.0, 0.05, 1.0):
        light = lamp(LightKind.SUN, angle=angle)
        u, v, *_ = (n.astype(np.float32) for n in numbers(20_000))
        view = view_lamp(light, np.zeros((len(u), 3), np.float32), u, v, origin=ORIGIN, nearest=u, far=77.0)
        facing = -lt.place_lamp(light, ORIGIN).axis
        mean = (view.strength * (view.direction @ facing)).mean(dtype=np.float64)
        assert mean == pytest.approx(1, rel=1e-3)
        assert (view.distance == 77).all()


@pytest.mark.parametrize("name", LAMPS)
def test_may_see_never_hides_a_lit_point(name: str) -> None:
    light = LAMPS[name]
    rng = np.random.default_rng(11)
    count = 30_000
    points = rng.normal(scale=3, size=(count, 3)).astype(np.float32)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = may_see(light, points, normals, np.full(count, 1e-4, np.float32), origin=ORIGIN)
    u, v = rng.random((2, count)).astype(np.float32)
    view = view_lamp(light, points, u, v, origin=ORIGIN, nearest=np.full(count, 1e-6, np.float32), far=9)
    lit = (view.strength > 0) & ((view.direction * normals).sum(axis=1) > 1e-5)
    assert not (lit & ~seen).any()
    assert lit.any() and (~seen).any()


def test_lamp_in_front_of_nothing_and_on_the_point_itself() -> None:
    light = Light("l", LightKind.POINT, translation(0, 0, 0), (1, 1, 1), radius=0.1)
    zero = np.zeros((3, 3), np.float32)
    view = view_lamp(
        light, zero, zero[:, 0], zero[:, 0], origin=np.zeros(3), nearest=np.full(3, 1e-3, np.float32), far=1
    )
    assert np.isfinite(view.strength).all() and np.isfinite(view.direction).all()


def test_spherical_rectangle_is_uniform_in_solid_angle() -> None:
    """Its solid angle has a closed form on the axis, and its points make the mean of any function of direction."""
    x, y = np.eye(3)[:2]
    count = 40_000
    u, v, *_ = numbers(count)
    for distance in (0.05, 1.0, 20.0):
        on_axis = see_rectangle(np.array([[0.0, 0.0, distance]]), x, y, (2.0, 2.0))
        expected = 4 * np.arcsin(1 / (1 + distance**2))
        assert on_axis.solid_angle[0] == pytest.approx(expected, rel=1e-6)
        assert pdf_rectangle(on_axis)[0] == pytest.approx(1 / expected, rel=1e-6)
    centre = np.array([0.4, -0.9, 0.3])
    seen = see_rectangle(np.tile(centre, (count, 1)), x, y, (2.0, 1.0))
    at = sample_rectangle(seen, u, v)
    assert np.abs(at[:, 0]).max() <= 1 + 1e-9 and np.abs(at[:, 1]).max() <= 0.5 + 1e-9
    grid = (np.arange(500) + 0.5) / 500 - 0.5
    gx, gy = (g.ravel() for g in np.meshgrid(grid * 2, grid))
    towards = centre + np.stack([gx, gy, 0 * gx], axis=1)
    squared = (towards**2).sum(axis=1)
    weight = 0.3 / squared**1.5  # solid angle of each cell, to a factor
    assert seen.solid_angle[0] == pytest.approx(weight.mean() * 2.0, rel=1e-3)
    for function in (lambda a, b: a, lambda a, b: b * b, lambda a, b: (a > 0.3) * 1.0, lambda a, b: a * b):
        mean = (function(gx, gy) * weight).sum() / weight.sum()
        assert function(at[:, 0], at[:, 1]).mean() == pytest.approx(mean, abs=2e-3)


@pytest.mark.parametrize("shape", list(AreaShape))
def test_no_sample_of_a_near_area_lamp_weighs_more_than_its_half_space(shape: AreaShape) -> None:
    light = Light("area", LightKind.AREA, translation(0, 0, 0), (1.0, 1.0, 1.0), size=(1.0, 1.0), shape=shape)
    rng = np.random.default_rng(2)
    points = (rng.random((5000, 3)) - (0.5, 0.5, 1.0)) * (1.2, 1.2, 0.3)
    u, v = rng.random((2, 5000)).astype(np.float32)
    near = np.full(5000, 1e-6, np.float32)
    view = view_lamp(light, points.astype(np.float32), u, v, origin=np.zeros(3), nearest=near, far=1)
    area = 1.0 if shape == AreaShape.RECTANGLE else np.pi / 4
    assert view.strength.max() <= 2 * np.pi / (np.pi * area) * (1 + 1e-6)
