# SPDX-License-Identifier: GPL-3.0-or-later
"""Kept photons are those of a trace from scratch, to the last bit, whatever happened before; and little is traced."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.lamps.emission import MESHES, SKY, all_photons
from rtgi_addon.backend.photon import path_pool
from rtgi_addon.backend.photon.paths import END_ESCAPED, PhotonPaths
from rtgi_addon.backend.photon.photon_light import Hits, PhotonLight
from rtgi_addon.backend.photon.photon_map import (
    bounced_hits,
    caustic_hits,
    direct_hits,
    lamp_hits,
    make_photon_map,
    photon_irradiance,
)
from rtgi_addon.backend.photon.photons import trace_photons
from rtgi_addon.backend.scene import FrameState, Instance, Light, LightKind, Material, Scene, World
from rtgi_addon.backend.settings import Selection
from tests.backend.movie import Movie
from tests.backend.scenes import box, cornell, grid_atlas, point_light, quad, sphere, translation

GLASS = Material("glass", (0.1, 0.1, 0.1), transmission=(0.8, 0.7, 0.6), ior=1.5)
GLOW = Material("glow", (0.2, 0.2, 0.2), emission=(2.0, 1.0, 0.3))
SHORT = 5  # instances of cornell()


def identical(a: PhotonPaths, b: PhotonPaths) -> bool:
    return all(getattr(a, f.name).tobytes() == getattr(b, f.name).tobytes() for f in fields(PhotonPaths))


def turned(angle: float, x: float, y: float, z: float) -> np.ndarray:
    matrix = translation(x, y, z)
    c, s = np.cos(angle), np.sin(angle)
    matrix[:2, :2] = [[c, -s], [s, c]]
    return matrix


def rich_scene() -> tuple[Scene, object]:
    """Cornell's box with a moving block, a moving glass ball, a deforming block, a glowing mover, two lamps, a sky."""
    scene, _ = cornell(10)
    ball = sphere("ball", 0.25, rings=6, inward=False, material=3)
    glow = box("glow", (0.2, 0.2, 0.2), texels=3, material=4)
    count = len(scene.instances)
    instances = [replace(i, moving=i.name == "short", deforming=i.name == "tall") for i in scene.instances]
    instances.append(Instance("ball", len(scene.meshes), translation(-0.5, -0.6, 0.3), moving=True))
    instances.append(Instance("glow", len(scene.meshes) + 1, translation(0.6, 0.6, 1.4), moving=True))
    lamps = (
        point_light((0, 0, 1.9), 50.0),
        Light("area", LightKind.AREA, translation(0.4, -0.4, 1.8), (20.0, 8.0, 1.0), size=(0.3, 0.2)),
        Light("sun", LightKind.SUN, translation(0, 0, 3), (3.0, 3.0, 2.0), angle=0.02),
    )
    scene = Scene(
        (*scene.meshes, ball, glow),
        tuple(instances),
        (*scene.materials, GLASS, GLOW),
        lamps,
        World(np.array([[[0.3, 0.4, 0.6]], [[0.1, 0.2, 0.9]]], np.float32)),
    )
    sizes = [(10, 10)] * 5 + [(15, 10)] * 2 + [(12, 6), (15, 10)]
    assert len(sizes) == count + 2
    return scene, grid_atlas(scene, sizes)


Act = Callable[[FrameState, Scene, np.random.Generator], FrameState]


def move(instance: int) -> Act:
    def act(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
        matrices = state.matrix_world.copy()
        matrices[instance] = turned(rng.uniform(0, 6), *rng.uniform(-0.8, 0.8, 2), rng.uniform(0.1, 1.7))
        return replace(state, matrix_world=matrices)

    return act


def switch(instance: int) -> Act:
    def act(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
        visible = state.visible.copy()
        visible[instance] ^= True
        return replace(state, visible=visible)

    return act


def deform(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    mesh = scene.meshes[SHORT + 1]
    return replace(
        state, vertices={SHORT + 1: (mesh.vertices * rng.uniform(0.7, 1.2, (1, 3))).astype(np.float32)},
        corner_normals={SHORT + 1: mesh.corner_normals},
    )  # fmt: skip


def change_lamp(number: int, **changed: Callable) -> Act:
    def act(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
        lamps = list(state.lights)
        lamps[number] = replace(lamps[number], **{name: draw(rng) for name, draw in changed.items()})
        return replace(state, lights=tuple(lamps))

    return act


def add_lamp(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    if len(state.lights) > 4:
        return replace(state, lights=state.lights[:1])
    return replace(state, lights=(*state.lights, point_light(rng.uniform(0.2, 0.9, 3), 10.0)))


def recolour(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    materials = list(state.materials or scene.materials)
    number = int(rng.integers(len(materials)))
    materials[number] = replace(materials[number], albedo=tuple(rng.uniform(0, 1, 3)))
    return replace(state, materials=tuple(materials))


def fade_block(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    materials = list(state.materials or scene.materials)
    materials[3] = replace(materials[3], opacity=float(rng.choice([0.3, 1.0])), ior=float(rng.uniform(1.1, 2)))
    return replace(state, materials=tuple(materials))


def dim_sky(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    return replace(state, world=World(state.world.radiance * np.float32(rng.uniform(0.3, 1.5))))


ACTS: dict[str, Act] = {
    "still": lambda state, scene, rng: state,
    "block": move(SHORT),
    "ball": move(SHORT + 2),
    "glow": move(SHORT + 3),
    "deform": deform,
    "vanish": switch(SHORT),
    "ball vanishes": switch(SHORT + 2),
    "wall vanishes": switch(2),
    "lamp moves": change_lamp(0, matrix_world=lambda r: translation(*r.uniform(0.1, 0.9, 3))),
    "lamp dims": change_lamp(0, power=lambda r: (float(r.uniform(5, 80)),) * 3),
    "lamp colours": change_lamp(-1, power=lambda r: tuple(r.uniform(0, 30, 3))),
    "lamp off": change_lamp(0, power=lambda r: (0.0, 0.0, 0.0)),
    "lamps come and go": add_lamp,
    "recolour": recolour,
    "fade": fade_block,
    "sky": dim_sky,
}


@given(
    st.lists(st.lists(st.sampled_from(sorted(ACTS)), min_size=1, max_size=2), min_size=1, max_size=6),
    st.integers(0, 99),
)
@settings(max_examples=25, deadline=None)
def test_swept_frames_are_traces_from_scratch(acts: list[list[str]], seed: int) -> None:
    """Any sequence of changes: what is kept and what is traced again are together what a fresh trace gives."""
    movie = Movie(*rich_scene(), photons=1500)
    rng = np.random.default_rng(seed)
    store, state = movie.store(Selection.SWEPT), movie.first
    movie.update(store, movie.shot(state))
    for names in acts:
        for name in names:
            state = ACTS[name](state, movie.scene, rng)
        before = store.paths
        shot = movie.shot(state)
        update = movie.update(store, shot)
        scratch = movie.scratch(shot)
        assert identical(store.paths, scratch.paths)
        assert update.pending == 0 and update.kept + update.traced == sum(shot.counts.values())
        assert np.array_equal(update.delta_f > 0, changed_surfaces(movie, before, store.paths, all_hits))
        assert np.array_equal(update.delta_i > 0, changed_surfaces(movie, before, store.paths, bounced_hits))


def all_hits(paths: PhotonPaths) -> np.ndarray:
    return np.ones(len(paths.triangle), bool)


def changed_surfaces(movie: Movie, before: PhotonPaths, after: PhotonPaths, chosen) -> np.ndarray:
    """Surfaces whose hits are no longer the same, in the same order."""
    lists = []
    for paths in (before, after):
        rows = np.nonzero(chosen(paths) & (paths.texel >= 0))[0]
        light, index = paths.light[paths.path_of_hit[rows]], paths.index[paths.path_of_hit[rows]]
        row_bytes = np.concatenate(
            [np.ascontiguousarray(c).view(np.uint8).reshape(len(rows), -1)
             for c in (light, index, paths.texel[rows], paths.start[rows], paths.direction[rows],
                       paths.distance[rows], paths.flux[rows], paths.flags[rows])], axis=1,
        )  # fmt: skip
        surface = movie.texels.surface[paths.texel[rows]]
        lists.append([row_bytes[surface == s].tobytes() for s in range(movie.texels.surface_count)])
    return np.array([a != b for a, b in zip(*lists, strict=True)])


def test_from_scratch_is_trace_photons() -> None:
    """The store's paths are the tracer's: flux in W, order by light and index."""
    movie = Movie(*rich_scene(), photons=2000)
    shot = movie.shot(movie.first)
    store = movie.store(Selection.SWEPT)
    movie.update(store, shot)
    light, index = all_photons(shot.counts)
    paths, _ = trace_photons(
        shot.sources, shot.counts, light, index, surfaces=movie.placed.surfaces, tracer=movie.placed.tracer,
        workers=movie.workers, max_bounces=24, seed=3,
    )  # fmt: skip
    assert identical(store.paths, paths) and {MESHES, SKY} < set(light.tolist())
    assert (paths.end == END_ESCAPED).any()


@pytest.mark.parametrize("budget", [None, 150])
@pytest.mark.parametrize("selection", [Selection.SWEPT, Selection.PROBE])
@pytest.mark.parametrize("name", ["block", "deform", "vanish", "lamp moves", "recolour", "lamps come and go"])
def test_converges(selection: Selection, budget: int | None, name: str) -> None:
    """With a budget, or with probes, the same paths are there after some still frames; never more than the budget."""
    movie = Movie(*rich_scene(), photons=1500)
    rng = np.random.default_rng(5)
    store = movie.store(selection, group_size=12)
    movie.update(store, movie.shot(movie.first))
    state = movie.first
    for _ in range(2):
        state = ACTS[name](state, movie.scene, rng)
        update = movie.update(store, movie.shot(state), budget=budget)
        assert budget is None or update.traced <= budget + update.probed
    still = movie.shot(state)
    if selection is Selection.SWEPT:
        left = 0 if budget is None else -(-1500 // budget)
    else:
        left = int(np.diff(store._groups.first_member).max()) + (0 if budget is None else -(-1500 // budget))
    for _ in range(left):
        movie.update(store, still, budget=budget)
    assert identical(store.paths, movie.scratch(still).paths)
    update = movie.update(store, still, budget=budget)
    assert update.pending == update.invalidated == 0 and update.traced == update.probed and not update.delta_f.any()


def test_budget_serves_every_photon() -> None:
    """A mover that never rests: no disturbed photon waits longer than the queue is long."""
    movie = Movie(*cornell(8, moving=True), photons=1000)
    store = movie.store(Selection.SWEPT)
    movie.update(store, movie.shot(movie.first))
    state = change_lamp(0, matrix_world=lambda r: translation(0.2, 0.1, 1.5))(movie.first, movie.scene, None)
    shot = movie.shot(state)
    seen = [movie.update(store, shot, budget=100).pending for _ in range(10)]
    assert seen == list(range(900, -1, -100))


def test_nothing_changed_nothing_traced() -> None:
    movie = Movie(*rich_scene(), photons=1500)
    for selection in (Selection.SWEPT, Selection.PROBE):
        store = movie.store(selection)
        shot = movie.shot(movie.first)
        movie.update(store, shot)
        paths = store.paths
        update = movie.update(store, movie.shot(movie.first))
        assert store.paths is paths
        assert update.traced == update.probed and update.invalidated == 0
        assert (update.probed > 0) == (selection is Selection.PROBE) and (update.rays > 0) == (update.probed > 0)
        assert not update.delta_f.any() and not update.delta_i.any() and not update.delta_aim.any()


def test_dimming_traces_nothing() -> None:
    """A lamp, the sky and a glowing mesh at other strengths, lamp and mesh a little recoloured: only flux changes."""
    movie = Movie(*rich_scene(), photons=1500)
    store = movie.store(Selection.SWEPT)
    movie.update(store, movie.shot(movie.first))
    before = store.paths
    state = change_lamp(0, power=lambda r: (50.0 * 0.91, 49.0 * 0.91, 50.0 * 0.9))(movie.first, movie.scene, None)
    glow = replace(GLOW, emission=tuple(0.97 * e for e in GLOW.emission))
    state = replace(
        state, world=World(state.world.radiance * np.float32(1.05)), materials=(*movie.scene.materials[:4], glow)
    )
    shot = movie.shot(state)
    update = movie.update(store, shot)
    assert update.traced == update.rays == 0 and (update.delta_f > 0).any()
    assert identical(store.paths, movie.scratch(shot).paths)
    assert store.paths.start.tobytes() == before.start.tobytes()
    ratio = store.paths.flux.astype(float).sum(axis=0) / before.flux.astype(float).sum(axis=0)
    assert (0.8 < ratio).all() and (ratio < 1.05).all()


def test_only_disturbed_photons_are_traced() -> None:
    """The swept test is exact: of the photons traced again, all but those at its margin take another way."""
    movie = Movie(*cornell(8, moving=True), photons=6000)
    store = movie.store(Selection.SWEPT)
    movie.update(store, movie.shot(movie.first))
    before = store.paths
    matrices = movie.first.matrix_world.copy()
    matrices[SHORT] = turned(-0.29, 0.36, -0.35, 0.3)
    update = movie.update(store, movie.shot(replace(movie.first, matrix_world=matrices)))
    met = [np.bincount(p.path_of_hit[on_block(movie, p)], minlength=6000) > 0 for p in (before, store.paths)]
    met_before_or_now = int((met[0] | met[1]).sum())
    # A ray that the block only grazed has met it at neither place.
    assert met_before_or_now <= update.traced <= met_before_or_now + 6 and update.traced == update.invalidated
    assert 0.02 < update.traced / 6000 < 0.6


def on_block(movie: Movie, paths: PhotonPaths) -> np.ndarray:
    return movie.placed.geometry.instance_of_triangle[paths.triangle] == SHORT


def test_a_change_in_one_closed_room_traces_nothing_in_the_other() -> None:
    rooms = [box("a", (2, 2, 2), texels=4, inward=True), box("b", (2, 2, 2), texels=4, inward=True)]
    thing = box("thing", (0.4, 0.4, 0.4), texels=3)
    scene = Scene(
        (*rooms, thing),
        (Instance("a", 0, translation(-2, 0, 0)), Instance("b", 1, translation(2, 0, 0)),
         Instance("thing", 2, translation(2, 0, -0.5), moving=True)),
        (Material("m", (0.7, 0.7, 0.7)),),
        (point_light((-2, 0, 0.5)), point_light((2, 0, 0.5))),
    )  # fmt: skip
    movie = Movie(scene, grid_atlas(scene, [(18, 12), (18, 12), (15, 10)]), photons=3000)
    store = movie.store(Selection.SWEPT)
    movie.update(store, movie.shot(movie.first))
    matrices = movie.first.matrix_world.copy()
    matrices[2] = translation(2.2, 0.1, -0.4)
    update = movie.update(store, movie.shot(replace(movie.first, matrix_world=matrices)))
    of_surface = np.zeros(movie.texels.surface_count, int)
    of_surface[movie.texels.surface] = movie.texels.instance
    assert (update.delta_f[of_surface == 0] == 0).all() and (update.delta_f[of_surface == 1] > 0).any()
    assert 0 < update.invalidated < 1500


def test_deltas_are_the_flux_that_came_and_went() -> None:
    """A block between lamp and floor appears: what the floor loses is its Δ_f, less what reaches it otherwise."""
    floor = quad("floor", [(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)])
    plate = quad("plate", [(-0.5, -0.5, 1), (0.5, -0.5, 1), (0.5, 0.5, 1), (-0.5, 0.5, 1)])
    scene = Scene(
        (floor, plate), (Instance("floor", 0, np.eye(4)), Instance("plate", 1, np.eye(4), moving=True)),
        (Material("black", (0.0, 0.0, 0.0)),), (point_light((0, 0, 2), 100.0),),
    )  # fmt: skip
    movie = Movie(scene, grid_atlas(scene, [(8, 8), (4, 4)], back=(1,)), photons=20_000)
    shown, hidden = movie.first, replace(movie.first, visible=np.array([True, False]))
    store = movie.store(Selection.SWEPT)
    movie.update(store, movie.shot(hidden))
    update = movie.update(store, movie.shot(shown))
    caught = 4 * np.arcsin(0.5**2 / (0.5**2 + 1)) / (4 * np.pi) * 100  # of the solid angle of the square
    assert update.delta_f[0] == pytest.approx(caught, rel=0.02) and update.delta_f[1] == update.delta_f[0]
    assert not update.delta_i.any() and not update.delta_aim.any()


@pytest.mark.parametrize("selection", list(Selection))
def test_no_lights_and_no_photons(selection: Selection) -> None:
    movie = Movie(*rich_scene(), photons=300)
    store = movie.store(selection)
    dark = replace(
        movie.first, lights=(), world=None,
        materials=tuple(replace(m, emission=(0.0, 0.0, 0.0)) for m in movie.scene.materials),
    )  # fmt: skip
    for state in (dark, movie.first, dark, dark, movie.first):
        shot = movie.shot(state)
        update = movie.update(store, shot)
        assert update.pending == 0 and identical(store.paths, movie.scratch(shot).paths)
        assert len(store.paths.light) == (0 if state is dark else 300)


def test_all_escape() -> None:
    """Rays into the void are segments too: what flies into their way is hit."""
    thing = box("thing", (0.5, 0.5, 0.5), texels=3)
    scene = Scene(
        (thing,), (Instance("thing", 0, translation(0, 0, 9), moving=True),), (Material("m", (0.5,) * 3),),
        (Light("spot", LightKind.SPOT, translation(0, 0, 2), (10.0,) * 3, cone=0.4),),
    )  # fmt: skip
    movie = Movie(scene, grid_atlas(scene, [(15, 10)]), photons=500)
    store = movie.store(Selection.SWEPT)
    assert movie.update(store, movie.shot(movie.first)).delta_f.sum() == 0 and len(store.paths.triangle) == 0
    shot = movie.shot(replace(movie.first, matrix_world=np.array([translation(0.1, 0, -3)])))
    update = movie.update(store, shot)
    assert 0 < update.traced < 500 and len(store.paths.triangle) > 0
    assert identical(store.paths, movie.scratch(shot).paths)


def test_the_pool_is_put_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """However often hits are replaced, memory stays bounded and nothing is seen of it."""
    monkeypatch.setattr(path_pool, "_LEAST_DEAD", 16)
    movie = Movie(*cornell(8, moving=True), photons=800)
    store, rng, state = movie.store(Selection.SWEPT), np.random.default_rng(0), movie.first
    for _ in range(12):
        shot = movie.shot(state)
        movie.update(store, shot)
        assert identical(store.paths, movie.scratch(shot).paths)
        assert len(store._pool.path) <= 1.5 * len(store.paths.triangle) + 16
        state = move(SHORT)(state, movie.scene, rng)


def test_threads_change_nothing() -> None:
    stores = []
    for threads in (1, 3):
        movie = Movie(*rich_scene(), photons=6000, threads=threads)
        store, rng, state = movie.store(Selection.SWEPT), np.random.default_rng(2), movie.first
        updates = []
        for name in ("still", "block", "lamp moves", "recolour"):
            state = ACTS[name](state, movie.scene, rng)
            updates.append(movie.update(store, movie.shot(state)))
        stores.append((store.paths, updates))
    (one, few), (other, many) = stores
    assert identical(one, other)
    for a, b in zip(few, many, strict=True):
        assert all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


# --- density --------------------------------------------------------------------------------------------------------


HITS_OF_KIND = {
    Hits.DIRECT: lambda paths: direct_hits(paths) & lamp_hits(paths),
    Hits.BOUNCED: lambda paths: bounced_hits(paths) | ~lamp_hits(paths),
    Hits.CAUSTIC: caustic_hits,
}


@pytest.mark.parametrize("seed", range(3))
def test_kept_maps_are_those_of_a_full_computation(seed: int) -> None:
    """Only stale surfaces are computed again; after any story the maps' bits are those of a trace from scratch."""
    movie = Movie(*rich_scene(), photons=4000)
    rng, state = np.random.default_rng(seed), movie.first
    light = PhotonLight(movie.store(Selection.SWEPT), nearest=24)
    for name in ["still", "still", *rng.permutation(sorted(ACTS))[:8]]:
        state = ACTS[name](state, movie.scene, rng)
        shot = movie.shot(state)
        movie.follow(light, shot)
        scratch = movie.scratch(shot).paths
        for kind, hits in HITS_OF_KIND.items():
            got = light.irradiance(movie.placed, kind)
            found = make_photon_map(scratch, hits(scratch))
            assert (
                got.tobytes()
                == photon_irradiance(found, movie.texels, movie.placed.frame, movie.workers, k=24).tobytes()
            )
            assert got is light.irradiance(movie.placed, kind)
        assert light.irradiance(movie.placed, Hits.BOUNCED).any()


def test_a_surface_that_slides_under_its_photons_is_stale() -> None:
    """A plate that moves by less than a texel in its own plane: most hits stay, but where the texels lie does not."""
    plate = quad("plate", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    scene = Scene(
        (plate,), (Instance("plate", 0, np.eye(4), moving=True),), (Material("m", (0.0,) * 3),),
        (Light("spot", LightKind.SPOT, translation(0, 0, 2), (10.0,) * 3, cone=0.1),),
    )  # fmt: skip
    movie = Movie(scene, grid_atlas(scene, [(1, 1)]), photons=500)
    light = PhotonLight(movie.store(Selection.SWEPT), nearest=24)
    movie.follow(light, movie.shot(movie.first))
    light.irradiance(movie.placed, Hits.DIRECT)
    update = movie.follow(light, movie.shot(replace(movie.first, matrix_world=np.array([translation(0.01, 0, 0)]))))
    assert update.traced == 500 and update.delta_f.sum() < 0.01 * 10 and light.stale(movie.placed, Hits.DIRECT).all()


def density(movie: Movie, paths: PhotonPaths, k: int, surfaces=None) -> np.ndarray:
    found = make_photon_map(paths, bounced_hits(paths) | ~lamp_hits(paths))
    return photon_irradiance(found, movie.texels, movie.placed.frame, movie.workers, k=k, surfaces=surfaces)


def test_a_surface_gets_the_same_density_in_any_company() -> None:
    movie = Movie(*rich_scene(), photons=8000)
    store = movie.store(Selection.SWEPT)
    movie.update(store, movie.shot(movie.first))
    whole = density(movie, store.paths, 24)
    rng = np.random.default_rng(0)
    for size in (1, 2, 5, 20):
        chosen = np.zeros(movie.texels.surface_count, bool)
        chosen[rng.permutation(len(chosen))[:size]] = True
        part = density(movie, store.paths_on(chosen), 24, surfaces=chosen)
        on = chosen[movie.texels.surface]
        assert part[on].tobytes() == whole[on].tobytes() and not part[~on].any()


# --- caustics -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["still", "block", "ball", "ball vanishes", "lamp moves", "lamp dims", "fade", "recolour"]
)
def test_caustic_photons(name: str) -> None:
    movie = Movie(*rich_scene(), photons=1500, caustics=True)
    store, rng = movie.store(Selection.SWEPT), np.random.default_rng(4)
    movie.update(store, movie.shot(movie.first))
    assert caustic_hits(store.paths).any()
    first = movie.shot(movie.first).counts
    shot = movie.shot(ACTS[name](movie.first, movie.scene, rng))
    update = movie.update(store, shot)
    scratch = movie.scratch(shot)
    assert identical(store.paths, scratch.paths)
    photons = [make_photon_map(s.paths, caustic_hits(s.paths)) for s in (store, scratch)]
    maps = [photon_irradiance(p, movie.texels, movie.placed.frame, movie.workers, k=16) for p in photons]
    assert maps[0].tobytes() == maps[1].tobytes()
    if name in ("still", "lamp dims"):  # a lamp that dims much leaves photons to others, no more
        assert update.traced == sum(max(n - first[light], 0) for light, n in shot.counts.items())
