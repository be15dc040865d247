# SPDX-License-Identifier: GPL-3.0-or-later
"""Aimed caustic photons bring the same light as photons sent everywhere, with far fewer of them."""

from __future__ import annotations

import numpy as np
import pytest

from rtgi_addon.backend.lamps.emission import all_photons, photon_counts
from rtgi_addon.backend.photon.caustics import (
    MOST_GENERATORS,
    caustic_sources,
    find_generators,
)
from rtgi_addon.backend.photon.paths import take_paths
from rtgi_addon.backend.photon.photon_map import caustic_hits, make_photon_map, photon_irradiance
from rtgi_addon.backend.photon.photons import trace_photons
from rtgi_addon.backend.scene import Instance, Light, LightKind, Material, Scene
from tests.backend.rig import Rig, make_rig
from tests.backend.scenes import box, grid_atlas, point_light, quad, sphere, translation

BLACK = Material("black", (0.0, 0.0, 0.0))
GLASS = Material("glass", (0.0, 0.0, 0.0), transmission=(1.0, 0.8, 0.6), ior=1.5)
MIRROR = Material("mirror", (0.0, 0.0, 0.0), specular=(0.9, 0.9, 0.9))


def rig_with(light: Light, *places, radius: float = 0.4) -> Rig:
    """A black room of 4 m with a glass ball at each place and a mirror ball near the last."""
    ball = sphere("ball", radius, rings=8, inward=False, material=1)
    mirror = sphere("mirror", 0.3, rings=8, inward=False, material=2)
    room = box("room", (4, 4, 4), texels=10, inward=True)
    meshes = (room, ball, mirror)
    instances = [Instance("room", 0, np.eye(4))]
    instances += [Instance(f"ball {i}", 1, translation(*p)) for i, p in enumerate(places)]
    x, y, z = places[-1]
    instances += [Instance("mirror", 2, translation(x, y - 0.5, z))]
    scene = Scene(meshes, tuple(instances), (BLACK, GLASS, MIRROR), (light,))
    sizes = [(36, 24)] + [(16, 8)] * (len(instances) - 1)
    return make_rig(scene, grid_atlas(scene, sizes))


def aimed(rig: Rig, count: int):
    generators = find_generators(rig.scene, rig.state, rig.geometry, rig.scene.materials)
    sources = caustic_sources(rig.state, rig.geometry, rig.bounds, generators)
    counts = photon_counts(sources, count)
    paths, _ = trace_photons(
        sources, counts, *all_photons(counts), surfaces=rig.surfaces, tracer=rig.tracer, workers=rig.workers,
        max_bounces=32, diffuse=False,
    )  # fmt: skip
    return take_paths(paths, np.unique(paths.path_of_hit[caustic_hits(paths)]))


def map_of(paths):
    """Photons that came by mirrors and glass alone."""
    return make_photon_map(paths, caustic_hits(paths))


def walls(rig: Rig, paths) -> np.ndarray:
    """(6, 3) W of LS+D light on each wall."""
    hits = caustic_hits(paths) & (rig.geometry.instance_of_triangle[paths.triangle] == 0)
    wall = paths.triangle[hits] // 2
    return np.stack([np.bincount(wall, paths.flux[hits, c].astype(float), minlength=6) for c in range(3)], axis=1)


DOWN = translation(0.2, 0.1, 1.8)
LIGHTS = {
    "point": point_light((0.2, 0.1, 1.8), 100),
    "sphere": Light("l", LightKind.POINT, DOWN, (100.0,) * 3, radius=0.15),
    "spot": Light("l", LightKind.SPOT, DOWN, (100.0,) * 3, cone=0.8, blend=0.5),
    "area": Light("l", LightKind.AREA, DOWN, (100.0,) * 3, size=(0.5, 0.3), spread=2.2),
    "sun": Light("l", LightKind.SUN, np.eye(4), (10.0,) * 3, angle=0.03),
    "inside": point_light((-0.1, 0.05, 0.0), 100),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_aimed_photons_bring_the_same_light(name: str) -> None:
    rig = rig_with(LIGHTS[name], (-0.1, 0.0, 0.0), (0.35, 0.2, 0.2))
    if name == "sun":  # out of the room the sun must come in: leave its roof out of the rays' way
        open_room = quad("room", [(-2, -2, -2), (2, -2, -2), (2, 2, -2), (-2, 2, -2)])
        scene = Scene((open_room, *rig.scene.meshes[1:]), rig.scene.instances, rig.scene.materials, rig.scene.lights)
        rig = make_rig(scene, grid_atlas(scene, [(20, 20)] + [(16, 8)] * 3))
    everywhere, _ = rig.photons(120_000, max_bounces=32)
    expected = walls(rig, everywhere)
    paths = aimed(rig, 30_000)
    got = walls(rig, paths)
    assert expected.sum() > 0
    assert got.sum(axis=0) == pytest.approx(expected.sum(axis=0), rel=0.02)
    bright = expected[:, 0] > 0.1 * expected[:, 0].sum()
    assert got[bright, 0] == pytest.approx(expected[bright, 0], rel=0.06)


def test_aiming_wastes_little() -> None:
    rig = rig_with(LIGHTS["point"], (0.0, 0.0, -1.0), radius=0.2)
    everywhere, _ = rig.photons(20_000, max_bounces=32)
    useful = len(np.unique(everywhere.path_of_hit[caustic_hits(everywhere)])) / 20_000
    assert useful < 0.05 and len(aimed(rig, 20_000).light) / 20_000 > 0.5


def test_only_paths_by_mirror_or_glass_are_kept() -> None:
    rig = rig_with(LIGHTS["area"], (-0.1, 0.0, 0.0))
    paths = aimed(rig, 5_000)
    first = rig.geometry.material_of_triangle[paths.triangle[paths.first_hit[:-1]]]
    assert (first > 0).all() and len(paths.light) > 100


def test_caustic_under_a_glass_ball_is_brighter_than_without() -> None:
    rig = rig_with(LIGHTS["point"], (0.2, 0.1, -1.2))
    irradiance = photon_irradiance(map_of(aimed(rig, 20_000)), rig.texels, rig.frame, rig.workers, k=32)
    assert np.isfinite(irradiance).all() and (irradiance >= 0).all()
    at = rig.frame.position + rig.geometry.origin
    floor = (rig.texels.instance == 0) & (at[:, 2] < -1.99)
    below = np.argmin(np.where(floor, np.hypot(at[:, 0] - 0.2, at[:, 1] - 0.1), np.inf))
    assert irradiance[below, 0] > 2 * 100 / (4 * np.pi * 3.8**2)
    # The glass is red: what passed has its colour.
    assert irradiance[below, 2] < irradiance[below, 0]
    area = rig.frame.area.astype(float)
    room = rig.texels.instance == 0
    flux = (irradiance[room] * area[room, None]).sum(axis=0)
    assert flux == pytest.approx(walls(rig, aimed(rig, 20_000)).sum(axis=0), rel=0.1)


def test_no_generators_no_photons() -> None:
    room = box("room", (4, 4, 4), texels=4, inward=True)
    scene = Scene((room,), (Instance("room", 0, np.eye(4)),), (BLACK,), (LIGHTS["point"],))
    rig = make_rig(scene, grid_atlas(scene, [(18, 12)]))
    generators = find_generators(scene, rig.state, rig.geometry, scene.materials)
    assert len(generators.radius) == 0
    assert caustic_sources(rig.state, rig.geometry, rig.bounds, generators) == []
    assert len(aimed(rig, 100).light) == 0


def test_generators_hold_their_triangles_and_many_become_one() -> None:
    rig = rig_with(LIGHTS["point"], (-0.1, 0.0, 0.0), (0.5, 0.2, 0.2))
    generators = find_generators(rig.scene, rig.state, rig.geometry, rig.scene.materials)
    assert len(generators.radius) == 3
    assert sorted(generators.radius) == pytest.approx([0.3, 0.4, 0.4], rel=1e-3)
    places = [(x, y, -1.0) for x in np.linspace(-1, 1, 6) for y in np.linspace(-1, 1, 6)]
    many = rig_with(LIGHTS["point"], *places, radius=0.1)
    assert len(places) > MOST_GENERATORS
    one = find_generators(many.scene, many.state, many.geometry, many.scene.materials)
    assert len(one.radius) == 1
    corners = many.geometry.corners[many.geometry.instance_of_triangle > 0].reshape(-1, 3)
    assert (np.linalg.norm(corners - one.centre[0], axis=1) <= one.radius[0]).all()
