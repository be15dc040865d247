# SPDX-License-Identifier: GPL-3.0-or-later
"""Photon paths: mirrors and glass send light where they should, paths are whole, and the same whoever traces them."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.lamps.emission import all_photons, photon_counts
from rtgi_addon.backend.photon import photons as ph
from rtgi_addon.backend.photon.paths import (
    BACK,
    END_ABSORBED,
    END_CUT,
    END_ESCAPED,
    PhotonPaths,
    join_paths,
    take_paths,
)
from rtgi_addon.backend.photon.photon_map import bounced_hits, caustic_hits, direct_hits, lamp_hits
from rtgi_addon.backend.scene import Atlas, Instance, Material, Scene
from rtgi_addon.backend.surface.scatter import choose, reflect, refract
from tests.backend.rig import make_rig
from tests.backend.scenes import box, cornell, grid_atlas, point_light, quad, sphere

BLACK = Material("black", (0.0, 0.0, 0.0))
MIRROR = Material("mirror", (0.0, 0.0, 0.0), specular=(1.0, 0.9, 0.5))
GLASS = Material("glass", (0.0, 0.0, 0.0), transmission=(1.0, 1.0, 1.0), ior=1.5)


def instances(*meshes) -> tuple[Instance, ...]:
    return tuple(Instance(m.name, i, np.eye(4)) for i, m in enumerate(meshes))


def scene_of(*meshes, materials, lights) -> Scene:
    return Scene(tuple(meshes), instances(*meshes), materials, lights)


def room(size: float = 4.0, material: int = 0):
    return box("room", (size,) * 3, texels=8, inward=True, material=material)


def flux(paths: PhotonPaths, chosen: np.ndarray) -> np.ndarray:
    return paths.flux[chosen].sum(axis=0, dtype=np.float64)


def identical(a: PhotonPaths, b: PhotonPaths) -> bool:
    return all(getattr(a, f.name).tobytes() == getattr(b, f.name).tobytes() for f in fields(PhotonPaths))


def glass_room(lamp, glass) -> Scene:
    return scene_of(room(), glass, materials=(BLACK, GLASS), lights=(lamp,))


ROOM_ATLAS = [(30, 20), (30, 20)]


def test_mirror_feeds_a_wall() -> None:
    """A patch above a wide mirror gets the flux of the lamp's mirror image: P Ω / 4π, times the mirror's colour."""
    mirror = quad("mirror", [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], material=1)
    patch = quad("patch", [(-1, 1, 3), (1, 1, 3), (1, -1, 3), (-1, -1, 3)])
    scene = scene_of(mirror, patch, materials=(BLACK, MIRROR), lights=(point_light((0, 0, 1), 100),))
    rig = make_rig(scene, grid_atlas(scene, [(8, 8), (8, 8)]))
    paths, _ = rig.photons(60_000)
    on_patch = rig.geometry.instance_of_triangle[paths.triangle] == 1
    straight = 4 * np.arcsin(1 / (1 + 2**2)) / (4 * np.pi) * 100
    mirrored = 4 * np.arcsin(1 / (1 + 4**2)) / (4 * np.pi) * 100
    assert flux(paths, on_patch & direct_hits(paths)) == pytest.approx(np.full(3, straight), rel=0.01)
    expected = mirrored * np.array(MIRROR.specular)
    assert flux(paths, on_patch & caustic_hits(paths)) == pytest.approx(expected, rel=0.03)
    assert not bounced_hits(paths).any() and lamp_hits(paths).all()


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (1.2, 0.3, -0.4)], ids=["inside", "outside"])
@pytest.mark.parametrize("smooth", [True, False])
def test_glass_sphere_conserves_flux(at, smooth: bool) -> None:
    glass = sphere("glass", 0.8, rings=12, inward=False, smooth=smooth, material=1)
    scene = glass_room(point_light(at, 100), glass)
    paths, book = make_rig(scene, grid_atlas(scene, ROOM_ATLAS)).photons(8_000, max_bounces=512)
    on_room = paths.texel >= 0
    on_room &= make_rig(scene, grid_atlas(scene, ROOM_ATLAS)).geometry.instance_of_triangle[paths.triangle] == 0
    arrived = flux(paths, on_room)
    assert book.escaped == pytest.approx(np.zeros(3))
    # A faceted ball traps a few rays by total internal reflection; the rest must all arrive.
    assert arrived + book.cut == pytest.approx(np.full(3, 100.0), rel=1e-5)
    assert (book.cut < 3).all()


def test_total_internal_reflection_ends() -> None:
    """In a glass cube only directions within the critical angle of an axis get out: 1 - 3 (1 - cos) stays in."""
    cube = box("cube", (1, 1, 1), texels=4, material=1)
    scene = glass_room(point_light((0.11, 0.07, -0.05), 100), cube)
    _, book = make_rig(scene, grid_atlas(scene, ROOM_ATLAS)).photons(20_000, max_bounces=60)
    critical = np.sqrt(1 - 1 / 1.5**2)
    assert book.cut == pytest.approx(np.full(3, 100 * (1 - 3 * (1 - critical))), rel=0.02)
    assert book.emitted == pytest.approx(book.absorbed + book.escaped + book.cut, rel=1e-5)


def test_mirror_facing_mirror_ends() -> None:
    low = quad("low", [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)])
    high = quad("high", [(-9, 9, 1), (9, 9, 1), (9, -9, 1), (-9, -9, 1)])
    perfect = Material("perfect", (0.0, 0.0, 0.0), specular=(1.0, 1.0, 1.0))
    scene = scene_of(low, high, materials=(perfect,), lights=(point_light((0, 0, 0.4), 100),))
    paths, book = make_rig(scene, grid_atlas(scene, [(4, 4), (4, 4)])).photons(2_000, max_bounces=50)
    assert np.diff(paths.first_hit).max() == 50
    assert (book.cut > 0).all() and (book.escaped > 0).all()
    assert book.absorbed == pytest.approx(np.zeros(3), abs=1e-4)
    assert book.emitted == pytest.approx(book.escaped + book.cut, rel=1e-5)
    assert (paths.end == END_CUT).any() and (paths.end == END_ESCAPED).any() and not (paths.end == END_ABSORBED).any()


def test_opacity_lets_light_straight_through() -> None:
    sheet = quad("sheet", [(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)], material=1)
    half = Material("half", (0.0, 0.0, 0.0), opacity=0.25)
    scene = scene_of(room(10.0), sheet, materials=(BLACK, half), lights=(point_light((0, 0, 2.0), 100),))
    rig = make_rig(scene, grid_atlas(scene, ROOM_ATLAS))
    paths, _ = rig.photons(40_000)
    assert direct_hits(paths).all()
    on_room = rig.geometry.instance_of_triangle[paths.triangle] == 0
    below = on_room & (paths.position[:, 2] < 0)
    above = on_room & ~below
    through = flux(paths, below)[0]
    assert through / (100 - flux(paths, above)[0]) == pytest.approx(0.75, rel=0.02)


def test_a_side_without_map_absorbs() -> None:
    scene, atlas = cornell(8)
    nothing = Atlas(atlas.resolution, atlas.page_count, (None,) * len(atlas.front), atlas.back)
    paths, book = make_rig(scene, nothing).photons(2_000)
    assert (paths.texel == -1).all() and np.diff(paths.first_hit).max() == 1
    assert book.unlit == pytest.approx(book.absorbed) and (book.unlit > 0).all()


def test_light_from_behind_lands_on_the_back() -> None:
    wall = quad("wall", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    scene = scene_of(wall, materials=(BLACK,), lights=(point_light((0, 0, -1), 100),))
    paths, _ = make_rig(scene, grid_atlas(scene, [(4, 4)], back=(0,))).photons(1_000)
    assert ((paths.flags & BACK) > 0).all() and (paths.texel >= 16).all()


def test_paths_are_whole() -> None:
    """Hits lie where origin and directions lead, and the flux of the brightest channel never grows."""
    scene, atlas = cornell(12)
    rig = make_rig(scene, atlas)
    paths, book = rig.photons(5_000, max_bounces=40)
    length = np.diff(paths.first_hit)
    assert length.max() > 4 and book.rays == length.sum() + (paths.end == END_ESCAPED).sum()
    before = np.roll(paths.position, 1, axis=0)
    starts = paths.first_hit[:-1][length > 0]
    before[starts] = paths.origin[length > 0]
    step = paths.position - before
    across = np.cross(step, paths.direction)
    assert np.abs(across).max() < 1e-4 * rig.geometry.extent
    assert ((step * paths.direction).sum(axis=1) > 0).all()
    brightest = paths.flux.max(axis=1)
    later = np.ones(len(brightest), bool)
    later[starts] = False
    assert (brightest[1:][later[1:]] <= brightest[:-1][later[1:]] * (1 + 1e-5)).all()
    assert np.array_equal(paths.bounce_of_hit == 0, ~later)
    assert np.array_equal(bounced_hits(paths), later)  # all diffuse: every later hit has bounced


@pytest.mark.parametrize("moving", [False, True])
def test_any_subset_gives_the_same_bits(moving: bool) -> None:
    scene, atlas = cornell(12, moving=moving)
    glass = replace(scene.materials[0], transmission=(0.3, 0.2, 0.1), specular=(0.1, 0.1, 0.1))
    scene = replace(
        scene, materials=(glass, *scene.materials[1:]), lights=(*scene.lights, point_light((0.5, 0.2, 1.0), 20))
    )
    rig = make_rig(scene, atlas)
    counts = photon_counts(rig.sources, 6_000)
    light, index = all_photons(counts)
    whole, _ = rig.photons(6_000, seed=4)
    for size in (1, 2, 3, 17, 500):
        rows = np.random.default_rng(size).permutation(len(light))[:size]
        part, _ = rig.photons(6_000, seed=4, light=light[rows], index=index[rows])
        assert identical(part, take_paths(whole, rows))


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ph, "CHUNK_PHOTONS", 1000)
    scene, atlas = cornell(12)
    one, book_one = make_rig(scene, atlas, threads=1).photons(5_500)
    three, book_three = make_rig(scene, atlas, threads=3).photons(5_500)
    assert identical(one, three)
    assert all(np.array_equal(getattr(book_one, f.name), getattr(book_three, f.name)) for f in fields(book_one))


def test_seeds_differ_but_agree_on_average() -> None:
    scene, atlas = cornell(12)
    rig = make_rig(scene, atlas)
    a, b = (rig.photons(10_000, seed=s)[0] for s in (0, 1))
    assert not identical(a, b)
    assert flux(a, bounced_hits(a)) == pytest.approx(flux(b, bounced_hits(b)), rel=0.03)


def test_join_and_take_are_inverse() -> None:
    scene, atlas = cornell(8)
    paths, _ = make_rig(scene, atlas).photons(500)
    halves = [take_paths(paths, np.arange(0, 200)), take_paths(paths, np.arange(200, len(paths.light)))]
    assert identical(join_paths(halves), paths)
    empty = join_paths([])
    assert len(empty.light) == 0 and empty.first_hit.tolist() == [0]


def test_a_source_that_went_dark_carries_nothing() -> None:
    scene, atlas = cornell(8)
    paths, book = make_rig(scene, atlas).photons(100, light=np.full(5, 7, np.int32), index=np.arange(5))
    assert len(paths.triangle) == 0 and (book.emitted == 0).all() and (paths.end == END_ABSORBED).all()


@given(st.integers(0, 2**31), st.floats(1.05, 2.6))
@settings(max_examples=40, deadline=None)
def test_snell_and_fresnel(seed: int, ior: float) -> None:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    normal = np.tile([0.0, 0.0, 1.0], (50, 1))
    direction[:, 2] = -np.abs(direction[:, 2])
    ratio = np.where(np.arange(50) % 2 == 0, ior, 1 / ior)
    out, fresnel = refract(direction, normal, ratio)
    sine = np.sqrt(1 - direction[:, 2] ** 2)
    total = ratio * sine >= 1
    assert (fresnel[total] == 1).all() and ((fresnel >= 0) & (fresnel <= 1)).all()
    assert np.allclose(np.sqrt(out[~total, 0] ** 2 + out[~total, 1] ** 2), (ratio * sine)[~total], atol=1e-6)
    # Reversibility: the way back has the same reflectance.
    _, back = refract(-out[~total], -normal[~total], 1 / ratio[~total])
    steady = fresnel[~total] < 0.95  # the slope is infinite at the critical angle
    assert np.allclose(back[steady], fresnel[~total][steady], atol=2e-3)
    mirrored = reflect(direction, normal, normal)
    assert np.allclose(mirrored[:, 2], -direction[:, 2]) and np.allclose(mirrored[:, :2], direction[:, :2])


def test_fresnel_at_normal_incidence() -> None:
    _, fresnel = refract(np.array([[0.0, 0.0, -1.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([1 / 1.5]))
    assert fresnel[0] == pytest.approx(((1.5 - 1) / (1.5 + 1)) ** 2, rel=1e-5)


def test_events_are_unbiased() -> None:
    """On average each lobe carries flux times its share, also where shares of other channels add to more than one."""
    count = 200_000
    number = ((np.arange(count) + 0.5) / count).astype(np.float32)
    flux_in = np.tile(np.float32([2.0, 1.0, 0.5]), (count, 1))
    shares = [np.tile(np.float32(s), (count, 1)) for s in ([0.1, 0.9, 0.0], [0.7, 0.0, 0.2], [0.1, 0.1, 0.8])]
    kind, after = choose(shares, flux_in, number)
    for k, share in enumerate(shares):
        mean = np.where((kind == k)[:, None], after, 0).mean(axis=0, dtype=np.float64)
        assert mean == pytest.approx(flux_in[0] * share[0], rel=1e-3, abs=1e-6)
    assert (after[kind == 3] == 0).all()
