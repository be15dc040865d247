# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance from photons: the nearest k of the texel's own surface, right at borders and in expectation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.photon.photon_map import (
    PhotonMap,
    bounced_hits,
    caustic_hits,
    direct_hits,
    lamp_hits,
    make_photon_map,
    photon_irradiance,
)
from rtgi_addon.backend.scene import Instance, Material, Scene
from tests.backend.rig import Rig, make_rig
from tests.backend.scenes import constant_sky, cornell, grid_atlas, point_light, quad, sphere

GREY = Material("grey", (0.5,) * 3)


def plate_rig(count: int = 1, size: int = 32) -> Rig:
    """Plates of 1 m², side by side without a gap."""
    meshes = tuple(quad(f"p{i}", [(i, 0, 0), (i + 1, 0, 0), (i + 1, 1, 0), (i, 1, 0)]) for i in range(count))
    instances = tuple(Instance(m.name, i, np.eye(4)) for i, m in enumerate(meshes))
    scene = Scene(meshes, instances, (GREY,), (point_light((0, 0, 5)),))
    return make_rig(scene, grid_atlas(scene, [(size, size)] * count))


def even_photons(rig: Rig, per_plate: int, *, flux: tuple[float, ...], seed: int = 0) -> PhotonMap:
    """``flux[i]`` W spread at random over plate i."""
    rng = np.random.default_rng(seed)
    plates = np.repeat(np.arange(len(flux)), per_plate)
    position = np.zeros((len(plates), 3))
    position[:, 0] = plates + rng.random(len(plates))
    position[:, 1] = rng.random(len(plates))
    each = np.array(flux)[plates] / per_plate
    local = (position - rig.geometry.origin).astype(np.float32)
    texel = rig.texels.of_hits(*plate_hits(plates, position))
    return PhotonMap(local, np.repeat(each[:, None], 3, axis=1).astype(np.float32), texel)


def plate_hits(plates: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, ...]:
    """(triangle, u, v, back): each plate is two triangles from its corner at x = plate, y = 0."""
    x, y = position[:, 0] - plates, position[:, 1]
    lower = x >= y  # corners (0,0) (1,0) (1,1); the other has (0,0) (1,1) (0,1)
    u, v = np.where(lower, x - y, x), np.where(lower, y, y - x)
    triangle = (2 * plates + ~lower).astype(np.int32)
    return triangle, u.astype(np.float32), v.astype(np.float32), np.zeros(len(x), bool)


def estimate(rig: Rig, photons: PhotonMap, k: int, threads: int = 1) -> np.ndarray:
    return photon_irradiance(photons, rig.texels, rig.frame, Workers(threads), k=k)


def border_distance(rig: Rig) -> np.ndarray:
    at = rig.frame.position + rig.geometry.origin
    return np.minimum(np.minimum(at[:, 0], 1 - at[:, 0]), np.minimum(at[:, 1], 1 - at[:, 1]))


@pytest.mark.parametrize("k", [16, 64, 200])
def test_even_light_is_even_up_to_the_border(k: int) -> None:
    rig = plate_rig()
    seeds = [estimate(rig, even_photons(rig, 4000, flux=(3.0,), seed=s), k)[:, 0] for s in range(8)]
    mean = np.mean(seeds, axis=0)
    border = border_distance(rig) < np.sqrt(k / (np.pi * 4000)) / 2
    assert border.sum() > 50
    assert mean[~border].mean() == pytest.approx(3, rel=0.02)
    # Without the correction a straight border loses half, a corner three quarters.
    assert mean[border].mean() == pytest.approx(3, rel=0.1)
    assert np.std(seeds[0][~border]) / 3 < 2.0 / np.sqrt(k)


def test_photons_of_other_surfaces_do_not_count() -> None:
    rig = plate_rig(3)
    got = estimate(rig, even_photons(rig, 3000, flux=(1.0, 0.0, 5.0)), 32)[:, 0]
    for plate, expected in enumerate((1.0, 0.0, 5.0)):
        assert got[rig.texels.surface == plate].mean() == pytest.approx(expected, rel=0.05, abs=1e-9)
    assert (got[rig.texels.surface == 1] == 0).all()


def test_few_photons_are_spread_over_the_surface() -> None:
    rig = plate_rig(2)
    photons = even_photons(rig, 10, flux=(2.0, 7.0))
    got = estimate(rig, photons, 64)[:, 0]
    assert got == pytest.approx(np.where(rig.texels.surface == 0, 2.0, 7.0), rel=1e-3)
    none = PhotonMap(photons.position[:0], photons.flux[:0], photons.texel[:0])
    assert (estimate(rig, none, 64) == 0).all()


def test_all_photons_in_one_point_stay_finite() -> None:
    rig = plate_rig()
    photons = even_photons(rig, 100, flux=(1.0,))
    at = np.zeros(100, int)
    piled = replace(photons, position=photons.position[at], texel=photons.texel[at])
    got = estimate(rig, piled, 16)
    assert np.isfinite(got).all() and (got >= 0).all()
    assert got.max() <= 1.0 / rig.frame.area.min() * (1 + 1e-5)


def test_threads_change_nothing() -> None:
    rig = plate_rig()
    photons = even_photons(rig, 3000, flux=(1.0,))
    assert estimate(rig, photons, 32).tobytes() == estimate(rig, photons, 32, threads=3).tobytes()


def test_sphere_against_the_closed_form() -> None:
    mesh = sphere("ball", 2.0, rings=24)
    scene = Scene(
        (mesh,), (Instance("ball", 0, np.eye(4)),), (Material("m", (0.6,) * 3),), (point_light((0, 0, 0), 100),)
    )
    rig = make_rig(scene, grid_atlas(scene, [(48, 24)]))
    paths, _ = rig.photons(30_000)
    direct = 100 / (16 * np.pi)
    for hits, expected in ((direct_hits(paths), direct), (bounced_hits(paths), direct * 0.6 / 0.4)):
        got = photon_irradiance(make_photon_map(paths, hits), rig.texels, rig.frame, rig.workers, k=128)
        assert np.median(got[:, 0]) == pytest.approx(expected, rel=0.03)
        assert got[:, 0].mean() == pytest.approx(expected, rel=0.03)


def test_photons_agree_with_shadow_rays_on_the_cornell_box() -> None:
    scene, atlas = cornell(20)
    rig = make_rig(scene, atlas)
    paths, _ = rig.photons(150_000)
    photons = make_photon_map(paths, direct_hits(paths))
    got = photon_irradiance(photons, rig.texels, rig.frame, rig.workers, k=48)[:, 0]
    rays = rig.direct(16)[:, 0]
    walls = rig.texels.instance < 5
    flux = [(e * rig.frame.area)[walls].sum(dtype=np.float64) for e in (got, rays)]
    assert flux[0] == pytest.approx(flux[1], rel=0.03)
    lit = walls & (rays > np.median(rays[walls]))
    assert np.median(np.abs(got[lit] / rays[lit] - 1)) < 0.15


def test_kinds_of_hits_are_a_partition() -> None:
    scene, atlas = cornell(10)
    shiny = replace(scene.materials[0], specular=(0.3, 0.3, 0.3))
    scene = replace(scene, materials=(shiny, *scene.materials[1:]), world=constant_sky(0.2))
    paths, _ = make_rig(scene, atlas).photons(4_000)
    kinds = [direct_hits(paths), caustic_hits(paths), bounced_hits(paths)]
    assert (np.sum(kinds, axis=0) == 1).all() and all(k.any() for k in kinds)
    lamps = lamp_hits(paths)
    assert lamps.any() and not lamps.all()
    assert np.array_equal(lamps, paths.light[paths.path_of_hit] >= 0)
