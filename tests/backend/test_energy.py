# SPDX-License-Identifier: GPL-3.0-or-later
"""Energy: closed forms, and books that balance in closed and open scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.photon.photon_map import bounced_hits, direct_hits
from rtgi_addon.backend.scene import Atlas, Instance, Light, LightKind, Material, Scene
from tests.backend.rig import Rig, make_rig
from tests.backend.scenes import box, constant_sky, cornell, grid_atlas, point_light, quad, sphere, translation


def sphere_rig(albedo: float, *, radius: float = 2.0, centre=(0.0, 0.0, 0.0)) -> Rig:
    mesh = sphere("ball", radius, rings=24)
    grey = Material("grey", (albedo,) * 3)
    instance = Instance("ball", 0, translation(*centre))
    scene = Scene((mesh,), (instance,), (grey,), (point_light(centre, 100.0),))
    return make_rig(scene, grid_atlas(scene, [(48, 24)]))


@pytest.mark.parametrize("albedo", [0.0, 0.3, 0.9])
def test_light_in_a_sphere(albedo: float) -> None:
    """E_direct = P / 4πR²; what bounces adds ρ / (1 - ρ) of it (DESIGN §9)."""
    rig = sphere_rig(albedo)
    paths, book = rig.photons(20_000 if albedo < 0.5 else 8_000, max_bounces=1024)
    direct, bounced = (
        paths.flux[hits].sum(axis=0, dtype=np.float64) for hits in (direct_hits(paths), bounced_hits(paths))
    )
    assert direct == pytest.approx(np.full(3, 100.0), rel=1e-6)
    assert bounced / direct == pytest.approx(np.full(3, albedo / (1 - albedo)), rel=0.02, abs=1e-9)
    assert book.escaped == pytest.approx(np.zeros(3)) and book.unlit == pytest.approx(np.zeros(3))


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.8])
def test_white_furnace(albedo: float) -> None:
    """In a closed glowing room every wall gets πL / (1 - ρ)."""
    mesh = box("room", (1.0, 2.0, 3.0), texels=4, inward=True)
    scene = Scene(
        (mesh,), (Instance("room", 0, np.eye(4)),), (Material("glow", (albedo,) * 3, emission=(2.0, 1.0, 0.5)),)
    )
    rig = make_rig(scene, grid_atlas(scene, [(18, 12)]))
    (source,) = rig.sources
    assert source.flux == pytest.approx(np.array([2.0, 1.0, 0.5]) * 2 * np.pi * 22)
    paths, _ = rig.photons(30_000, max_bounces=512)
    inside = paths.texel >= 0
    irradiance = paths.flux[inside].sum(axis=0, dtype=np.float64) / 22
    assert irradiance == pytest.approx(np.pi * np.array([2.0, 1.0, 0.5]) / (1 - albedo), rel=0.02)


def mixed_materials(rng: np.random.Generator) -> tuple[Material, ...]:
    def rgb(high: float = 1.0) -> tuple[float, float, float]:
        r, g, b = rng.random(3) * high
        return float(r), float(g), float(b)

    return tuple(
        Material(f"m{i}", rgb(1.4), specular=rgb(0.6), transmission=rgb(0.6), opacity=float(rng.random()), ior=1.3)
        for i in range(3)
    )


@given(st.integers(0, 2**31))
@settings(max_examples=12, deadline=None)
def test_books_balance_in_any_scene(seed: int) -> None:
    """Emitted = absorbed + escaped + cut, whatever the materials (also albedo above one) and however open the box."""
    rng = np.random.default_rng(seed)
    scene, atlas = cornell(6)
    lamps = (
        point_light((0, 0, 1.5), 50),
        Light("spot", LightKind.SPOT, translation(0, 0, 1.9), (5.0, 0.0, 9.0), radius=0.1, blend=0.5),
        Light("area", LightKind.AREA, translation(0, 0, 1.9), (5.0, 1.0, 9.0), spread=2.0),
        Light("sun", LightKind.SUN, np.eye(4), (1.0, 1.0, 0.5), angle=0.1),
    )
    scene = replace(scene, materials=mixed_materials(rng), lights=lamps, world=constant_sky(0.3))
    bounces = int(rng.integers(1, 30))
    paths, book = make_rig(scene, atlas).photons(3_000, seed=seed, max_bounces=bounces)
    assert book.emitted == pytest.approx(book.absorbed + book.escaped + book.cut, rel=1e-5)
    assert (book.emitted > 0).all() and (book.escaped >= 0).all() and (book.cut >= 0).all()
    assert np.isfinite(paths.flux).all() and (paths.flux >= 0).all() and np.isfinite(paths.position).all()
    # Nothing makes light: what leaves or still flies is no more than what came, but for the roulette's noise.
    assert (book.escaped + book.cut <= book.emitted * 1.1).all()


def test_absorbed_is_what_surfaces_do_not_send_back() -> None:
    """The roulette's own books agree with the expectation flux · (1 - albedo), summed over all hits."""
    scene, atlas = cornell(10)
    rig = make_rig(scene, atlas)
    paths, book = rig.photons(20_000)
    albedo = rig.surfaces.albedo[paths.texel] * (paths.texel >= 0)[:, None]
    expected = (paths.flux * (1 - albedo)).sum(axis=0, dtype=np.float64)
    assert book.absorbed == pytest.approx(expected, rel=0.02)


def test_sun_and_sky_through_a_plane() -> None:
    """A facing plane of 4 m² under a sun of 3 W/m² gets 12 W; under a sky of radiance L each side gets πL."""
    plane = quad("plane", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    sun = Light("sun", LightKind.SUN, np.eye(4), (3.0, 3.0, 3.0))
    black = Material("black", (0.0, 0.0, 0.0))
    scene = Scene((plane,), (Instance("plane", 0, np.eye(4)),), (black,), (sun,), constant_sky(0.5))
    rig = make_rig(scene, grid_atlas(scene, [(4, 4)], back=(0,)))
    paths, _ = rig.photons(40_000)
    of_sun = paths.light[paths.path_of_hit] == 0
    assert paths.flux[of_sun].sum(axis=0) == pytest.approx(np.full(3, 12.0), rel=2e-3)
    back = rig.texels.side[paths.texel] == 1
    for side in (back, ~back):
        assert paths.flux[~of_sun & side].sum(axis=0) == pytest.approx(np.full(3, 0.5 * np.pi * 4), rel=0.02)


def test_far_from_the_origin_and_tiny_give_the_same_light() -> None:
    near, _ = sphere_rig(0.5).photons(4_000)
    far, _ = sphere_rig(0.5, centre=(1e6, -1e6, 1e6)).photons(4_000)
    tiny, book = sphere_rig(0.5, radius=1e-3).photons(4_000)
    for other in (far, tiny):
        assert other.flux.sum() == pytest.approx(near.flux.sum(), rel=0.03)
    assert book.escaped == pytest.approx(np.zeros(3))


def test_nothing_to_hit_and_nothing_to_shine() -> None:
    empty = Scene((), (), (), (point_light((0, 0, 0)),), constant_sky(1.0))
    rig = make_rig(empty, Atlas(4, 1, (), ()))
    paths, book = rig.photons(50)
    assert len(paths.triangle) == 0 and book.escaped == pytest.approx(book.emitted)
    scene, atlas = cornell(6)
    paths, book = make_rig(replace(scene, lights=()), atlas).photons(50)
    assert len(paths.light) == 0 and book.rays == 0
