# SPDX-License-Identifier: GPL-3.0-or-later
"""Pass "rays": every entry of a tile is what a ray of the texel's own Hammersley set meets; and bakes by such views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.final_gather.views.entries import make_entries
from rtgi_addon.backend.final_gather.views.rays import ViewRays
from rtgi_addon.backend.final_gather.views.target import Eyes, Target
from rtgi_addon.backend.final_gather.views.view import make_view
from rtgi_addon.backend.gpu.compute_tracer import ComputeTracer
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.sampling import frames
from rtgi_addon.backend.scene import Scene, World
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import BakeSettings, Gather
from rtgi_addon.backend.surface.tracing import EmbreeTracer
from tests.backend import scenes
from tests.backend.test_session import bake, sphere_room
from tests.gpu.looks import lifted_box, tiles
from tests.gpu.test_device import frames_of

SIZE = 16


def reversed_digits(number: np.ndarray, base: int) -> np.ndarray:
    """0.d0 d1 d2 ... of the digits of ``number``."""
    value, place, rest = np.zeros(len(number)), 1.0, number.copy()
    while rest.any():
        place /= base
        value += place * (rest % base)
        rest //= base
    return value


def rays_of(eyes: Eyes) -> tuple[np.ndarray, np.ndarray]:
    """((m, K, 3), (m, K, 3)) origins and directions that rays.glsl says the views of ``eyes`` (m,) have."""
    ray = np.arange(SIZE * SIZE)
    across = ((ray + 0.5) / len(ray) + eyes.shift[:, 1:]) % 1
    angle = 2 * np.pi * ((reversed_digits(ray, 2) + eyes.shift[:, :1]) % 1)
    ring, height = np.sqrt(across), np.sqrt(1 - across)
    x, y, z = ((f * g)[:, :, None] for f, g in ((ring, np.cos(angle)), (ring, np.sin(angle)), (height, 1)))
    tangent, normal = eyes.tangent[:, None], eyes.normal[:, None]
    ways = x * tangent + y * np.cross(normal, tangent) + z * normal
    opened_first = np.argsort(~eyes.opened, axis=1, kind="stable")
    turn = (reversed_digits(ray, 3) * eyes.opened.sum(axis=1, keepdims=True)).astype(int)
    start = np.take_along_axis(opened_first, turn, axis=1)
    return np.take_along_axis(eyes.points, start[:, :, None], axis=1), ways


@pytest.mark.parametrize("sky", [None, World(np.random.default_rng(1).random((4, 8, 3), np.float32))])
@pytest.mark.parametrize("moved", [False, True])
def test_entries_are_what_the_rays_meet(compute_gpu, moved: bool, sky: World | None) -> None:
    scene, atlas = lifted_box(moving=True)
    scene = replace(scene, world=sky)
    placed = PlacedScene(
        scene, atlas, scene.first_frame(), (), Workers(1), lambda *of_frame: ComputeTracer(*of_frame, compute_gpu)
    )
    entries, texels = make_entries(placed.texels, placed.sky), placed.texels
    views = ViewRays(compute_gpu, make_view(Gather.RAYS, SIZE), placed.geometry, texels, placed.tracer, entries)
    if moved:
        state = scene.first_frame()
        matrices = state.matrix_world.copy()
        matrices[-1, :3, 3] += 0.1
        state = replace(state, frame=2, matrix_world=matrices)
        change = placed.follow(state)
        views.follow(np.flatnonzero(change.sweep.moved), state)
    chosen = np.arange(0, texels.count, 19)
    rng, frame = np.random.default_rng(3), placed.frame
    opened = rng.random((len(chosen), 8)) < 0.6
    opened[:, 3] = True
    eyes = Eyes(
        frame.position[chosen], frames(frame.normal[chosen])[0], frame.normal[chosen], frame.geometric_normal[chosen],
        texels.instance[chosen], frame.points[chosen], opened, rng.random((len(chosen), 2), np.float32),
        np.zeros(len(chosen), np.bool_),
    )  # fmt: skip
    target = Target(compute_gpu, make_view(Gather.RAYS, SIZE), 8, -(-len(chosen) // 8))
    views.draw(target, np.arange(len(chosen), dtype=np.int32), eyes)
    found = entries.target[tiles(target)[: len(chosen)].reshape(len(chosen), -1)]
    origins, ways = (part.reshape(-1, 3).astype(np.float32) for part in rays_of(eyes))
    hits = EmbreeTracer(scene, placed.geometry, placed.state, Workers(1)).intersect(origins, ways)
    wanted = texels.of_hits(hits.triangle, hits.u, hits.v, hits.back)
    if placed.sky is not None:
        escaped = hits.triangle < 0
        wanted[escaped] = texels.count + placed.sky.of_directions(ways[escaped])
    assert (found.reshape(-1) == wanted).mean() >= 0.995
    target.release()
    views.release()


@pytest.mark.parametrize("albedo", [0.5, 0.9])
def test_lamp_in_a_sphere(compute_gpu, albedo: float) -> None:
    settings = BakeSettings(denoise=False, quality="draft", gather="rays")
    iim, _, _, _, result = bake(*sphere_room(albedo, 2.0, 60.0), settings)
    assert result.stats.gather == "rays" and result.stats.view_pixels == 16 and result.stats.views_drawn > 0
    np.testing.assert_allclose(iim, 60.0 / (16 * np.pi) * albedo / (1 - albedo), rtol=0.01)


def lit(scene: Scene, atlas, states, gather: str):
    settings = BakeSettings(resolution=atlas.resolution, quality="draft", denoise=False, gather=gather)
    with Session(scene, atlas, settings, states[0], guide=frames_of(scene)) as session:
        return [session.advance(state) for state in states]


def test_rays_agree_with_links_and_a_frame_hangs_on_none_lit_before_it(compute_gpu) -> None:
    scene, atlas = scenes.cornell(10, moving=True)
    states = frames_of(scene)
    followed, (afresh,) = lit(scene, atlas, states, "rays"), lit(scene, atlas, states[2:], "rays")
    assert 0 < followed[2].stats.views_drawn <= afresh.stats.views_drawn
    assert np.array_equal(followed[2].maps.iim, afresh.maps.iim)
    assert np.array_equal(followed[2].maps.aim, afresh.maps.aim)
    by_links = lit(scene, atlas, states, "links")[2].maps
    both = by_links.valid & afresh.maps.valid
    mean = by_links.iim[both].mean()
    assert abs(afresh.maps.iim[both].mean() - mean) < 0.02 * mean
