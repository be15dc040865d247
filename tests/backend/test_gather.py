# SPDX-License-Identifier: GPL-3.0-or-later
"""Gather rays: weights that add up, targets that are right, sky that is sampled without bias."""

from __future__ import annotations

import numpy as np
import pytest

from rtgi_addon.backend.final_gather.bright import bright_targets, bright_weight
from rtgi_addon.backend.final_gather.gather import NO_TARGET, GatherRays
from rtgi_addon.backend.final_gather.link_store import LinkStore
from rtgi_addon.backend.final_gather.links import make_links
from rtgi_addon.backend.lamps.sky import make_sky
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import Instance, Scene, World
from rtgi_addon.backend.settings import SampleCounts
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.scatter import make_surfaces
from rtgi_addon.backend.surface.texels import make_texels, place_texels, texel_colours
from rtgi_addon.backend.surface.tracing import EmbreeTracer
from tests.backend import scenes


def gather_of(scene, atlas, radiosity, samples, *, seed=0):
    """(GatherRays, texels, frame, sky) with aimed samples following ``radiosity`` (of texels; sky is added)."""
    state = scene.first_frame()
    geometry = Geometry(scene, state)
    texels = make_texels(scene, atlas, geometry)
    frame = place_texels(texels, geometry)
    albedo, _ = texel_colours(texels, scene, geometry, scene.materials)
    sky = make_sky(scene.world)
    known = np.zeros((texels.count + (sky.count if sky else 0), 3), np.float32)
    known[: texels.count] = radiosity(texels, frame)[:, None] if radiosity else 0
    if sky:
        known[texels.count :] = sky.radiance * np.pi
    one_room = np.zeros(texels.count, np.int32)
    bright = bright_targets([bright_weight(known, frame.area, sky, geometry.extent)], one_room)
    tracer = EmbreeTracer(scene, geometry, state, Workers(1))
    surfaces = make_surfaces(geometry, texels, albedo, scene.materials)
    rays = GatherRays(texels, frame, geometry, surfaces, tracer, sky, bright, samples, max_specular=4, seed=seed)
    return rays, texels, frame, sky, len(known)


def links_of(rays, *, memory=1 << 30):
    store = LinkStore(rays, Workers(1), memory=memory)
    store.renew(rays, all_of(rays))
    return make_links(store, rays, Workers(1))


def all_of(rays):
    return np.arange(rays.texels.count, dtype=np.int32)


def closed_box():
    mesh = scenes.box("room", (2, 3, 2.5), texels=10, inward=True)
    scene = Scene((mesh,), (Instance("room", 0, np.eye(4)),), (scenes.WHITE,))
    return scene, scenes.grid_atlas(scene, [(36, 24)])


@pytest.mark.parametrize("cosine, bright", [(16, 16), (8, 24), (32, 4)])
def test_weights_sum_to_one_in_expectation(cosine, bright):
    """Whatever the aimed samples follow: here one corner of the floor, 100 times as bright as the rest."""

    def spot(texels, frame):
        return 1 + 99.0 * (np.abs(frame.position - frame.position[0]).max(axis=1) < 0.4)

    rays, texels, _, _, _ = gather_of(*closed_box(), spot, SampleCounts(cosine, bright))
    traced = rays.trace(all_of(rays))
    assert (traced.weight <= 1 / cosine + 1e-6).all() and (traced.weight >= 0).all()
    assert traced.usable.all()
    sums = traced.weight.sum(axis=1)
    assert sums.mean() == pytest.approx(1.0, abs=4 * sums.std() / np.sqrt(len(sums)) + 1e-3)


def test_chunks_do_not_matter():
    rays, texels, _, _, _ = gather_of(*closed_box(), lambda t, f: np.ones(t.count), SampleCounts(8, 8))
    whole, part = rays.trace(all_of(rays)), rays.trace(all_of(rays)[101:333])
    np.testing.assert_array_equal(whole.target[101:333], part.target)
    np.testing.assert_array_equal(whole.weight[101:333], part.weight)


def test_half_of_the_rays_estimates_the_same_light():
    scene, atlas = scenes.cornell(16)
    samples = SampleCounts(32, 32)
    rays, texels, frame, _, targets = gather_of(scene, atlas, lambda t, f: f.position[:, 2] > 0.9, samples)
    links = links_of(rays)
    radiosity = np.repeat((frame.position[:, 2:] > 0.9), 3, axis=1).astype(np.float32)
    whole, half = links.with_half(radiosity)
    np.testing.assert_array_equal(whole, links.irradiance(radiosity))
    assert half.mean() == pytest.approx(whole.mean(), rel=0.01)
    assert 0 < np.sqrt(np.mean((whole - half) ** 2)) < 0.2 * whole.mean()


def floor_under(world: World | None):
    floor = scenes.quad("floor", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    scene = Scene((floor,), (Instance("floor", 0, np.eye(4)),), (scenes.WHITE,), (), world)
    return scene, scenes.grid_atlas(scene, [(8, 8)])


@pytest.mark.parametrize("row", [33, 45, 60])
def test_one_bright_patch_of_sky_lights_like_the_sun(row):
    """E = L Ω cosθ from a patch of 1/64 of the height, which cosine rays alone would mostly miss."""
    image = np.zeros((64, 128, 3), np.float32)
    image[row, 70] = 500.0
    scene, atlas = floor_under(World(image))
    samples = SampleCounts(16, 16)
    rays, texels, _, sky, targets = gather_of(scene, atlas, None, samples)
    links = links_of(rays)
    radiosity = np.zeros((targets, 3), np.float32)
    radiosity[texels.count :] = sky.radiance * np.pi
    patch = row * 128 + 70
    edges = np.sin(np.pi * (np.array([row, row + 1]) / 64 - 0.5))
    cosine = edges.mean()  # mean of z over a band of equal solid angle per dz
    expected = 500.0 * sky.solid_angle[patch] * cosine
    assert links.irradiance(radiosity)[:, 0].mean() == pytest.approx(expected, rel=0.03)


def test_sky_patches_and_directions_agree():
    sky = make_sky(World(np.random.default_rng(1).random((32, 64, 3), np.float32)))
    patch = np.arange(sky.count, dtype=np.int32)
    for across, up in ((0.5, 0.5), (0.02, 0.02), (0.98, 0.98)):
        there = np.full(sky.count, across, np.float32), np.full(sky.count, up, np.float32)
        np.testing.assert_array_equal(sky.of_directions(sky.directions(patch, *there)), patch)
    assert sky.solid_angle.sum() == pytest.approx(4 * np.pi, rel=1e-5)


def test_a_finer_sky_is_averaged_without_losing_light():
    fine = World(np.random.default_rng(2).random((1024, 2048, 3), np.float32))
    sky = make_sky(fine)
    assert sky.rows == 256
    edges = np.sin(np.pi * (np.arange(1025) / 1024 - 0.5))
    flux = (fine.radiance.sum(axis=1) * (np.diff(edges) * 2 * np.pi / 2048)[:, None]).sum(axis=0)
    np.testing.assert_allclose((sky.radiance * sky.solid_angle[:, None]).sum(axis=0), flux, rtol=1e-3)


def test_rays_that_escape_a_black_world_end_nowhere():
    scene, atlas = floor_under(None)
    rays, texels, _, _, _ = gather_of(scene, atlas, None, SampleCounts(8, 8))
    traced = rays.trace(all_of(rays))
    assert traced.target.shape == (64, 8)  # nothing bright: no aimed samples
    assert (traced.target == NO_TARGET).all() and traced.usable.all()
