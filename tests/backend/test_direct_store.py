# SPDX-License-Identifier: GPL-3.0-or-later
"""Kept direct light: the bits of a fresh computation whatever changed, for only the rays that the change asks for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.lamps.direct import direct_irradiance, make_receivers, make_shadows
from rtgi_addon.backend.lamps.direct_store import DirectStore, DirectUpdate
from rtgi_addon.backend.lamps.lights import is_dark
from rtgi_addon.backend.lamps.shading_balls import MOST_BALLS, Balls, may_shade, together
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import BLACK, FrameState, Instance, Light, LightKind, Material, Scene
from rtgi_addon.backend.selection.sweep import Sweep
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.texels import make_texels, place_texels
from rtgi_addon.backend.surface.tracing import EmbreeTracer
from tests.backend.lamps import LAMPS
from tests.backend.scenes import box, cornell, grid_atlas, point_light, quad, translation

SEED = 5


class Bake:
    """A store that follows a scene over its frames, each compared with a computation from nothing."""

    def __init__(self, scene: Scene, atlas, *, samples: int = 2, threads: int = 2) -> None:
        self.scene, self.state, self.samples = scene, scene.first_frame(), samples
        self.workers = Workers(threads)
        self.geometry = Geometry(scene, self.state)
        self.tracer = EmbreeTracer(scene, self.geometry, self.state, self.workers)
        self.texels = make_texels(scene, atlas, self.geometry)
        self.store = DirectStore()
        self.before = np.full((self.texels.count, 3), np.nan, np.float32)
        self.fresh_rays = 0
        self.first = self.advance(self.state)

    def advance(self, state: FrameState) -> DirectUpdate:
        moved = self.geometry.update(state)
        movement = self.tracer.update(state, moved)
        sweep = Sweep(movement.left, movement.taken, np.isin(np.arange(len(self.scene.instances)), moved), self.workers)
        first = np.isnan(self.before).any()
        shadows = make_shadows(self.tracer, self.geometry, state.materials or self.scene.materials)
        frame = place_texels(self.texels, self.geometry)
        update = self.store.update(
            state.lights,
            frame,
            shadows,
            self.workers,
            sweep=None if first or movement.rebuilt else sweep,
            changed_texels=np.isin(self.texels.instance, moved),
            samples=self.samples,
            seed=SEED,
        )
        kept, made = self.store._now.receivers, make_receivers(frame, self.geometry, samples=self.samples)
        assert kept.offset.tobytes() == made.offset.tobytes() and kept.reach.tobytes() == made.reach.tobytes()
        fresh, self.fresh_rays = direct_irradiance(
            state.lights, frame, shadows, self.workers, samples=self.samples, seed=SEED
        )
        assert update.direct.tobytes() == fresh.tobytes()
        assert np.array_equal(update.changed, (fresh.view(np.uint32) != self.before.view(np.uint32)).any(axis=1))
        assert update.lamps_updated + update.lamps_kept == sum(not is_dark(light) for light in state.lights)
        assert update.rays <= self.fresh_rays
        self.before, self.state = fresh, state
        return update

    def change(self, **values: object) -> DirectUpdate:
        return self.advance(replace(self.state, frame=self.state.frame + 1, **values))

    def lit_by(self, *lights: Light) -> DirectUpdate:
        return self.change(lights=lights)

    def moved(self, instance: int, x: float, y: float, z: float) -> DirectUpdate:
        matrices = self.state.matrix_world.copy()
        matrices[instance, :3, 3] += x, y, z
        return self.change(matrix_world=matrices)

    def looking(self, material: int, opacity: float) -> DirectUpdate:
        looks = list(self.state.materials or self.scene.materials)
        looks[material] = replace(looks[material], opacity=opacity)
        return self.change(materials=tuple(looks))


def room(*lights: Light, texels: int = 10, movers: int = 3, opacity: float = 1.0) -> Bake:
    """The Cornell box with a flag that may deform (7) and small crates that may move (8, 9, ...), of material 3."""
    scene, _ = cornell(texels)
    flag = quad("flag", [(-0.9, 0.8, 1.2), (-0.2, 0.8, 1.2), (-0.2, 0.8, 1.7), (-0.9, 0.8, 1.7)])
    meshes = (*scene.meshes, flag, box("crate", (0.2, 0.3, 0.2), texels=3, material=3))
    places = [translation(-0.8 + 0.4 * i, -0.8, 0.1) for i in range(movers)]
    still = (*scene.instances, Instance("flag", 7, np.eye(4), deforming=True))
    crates = tuple(Instance(f"crate {i}", 8, place, moving=True) for i, place in enumerate(places))
    looks = (*scene.materials, Material("crate", opacity=opacity))
    whole = Scene(meshes, still + crates, looks, lights or scene.lights)
    face = max(2, round(texels * 0.3))
    sizes = [(texels, texels)] * 5 + [(3 * (face + 2), 2 * (face + 2))] * 2 + [(4, 4)] + [(15, 10)] * movers
    return Bake(whole, grid_atlas(whole, sizes))


# --- what costs no ray --------------------------------------------------------------------------------------------


def soft(position=(0, 0, 1.9), power: float = 50.0) -> Light:
    return replace(point_light(position, power), radius=0.1)


def test_where_nothing_changed_nothing_is_done() -> None:
    bake = room(soft(), LAMPS["sun"])
    assert bake.first.rays == bake.fresh_rays > 0 and bake.first.changed.all() and bake.first.lamps_updated == 2
    update = bake.change()
    assert (update.rays, update.lamps_updated, update.lamps_kept) == (0, 0, 2)
    assert update.direct is bake.first.direct and not update.changed.any()
    with pytest.raises(ValueError):
        update.direct[0] = 1


def test_power_and_colour_cost_no_ray() -> None:
    bake = room(soft(), soft((0.5, 0, 1)))
    first, second = bake.state.lights
    for power in ((10.0, 10.0, 10.0), (0.0, 3.0, 5.0)):
        update = bake.lit_by(first, replace(second, power=power))
        assert update.rays == 0 and update.lamps_kept == 2 and update.changed.any()
    assert bake.lit_by(first, replace(second, power=BLACK)).rays == 0
    again = bake.lit_by(first, second)
    assert again.rays == 0 and again.direct.tobytes() == bake.first.direct.tobytes()


def test_only_the_lamp_that_changed_is_traced() -> None:
    bake = room(soft(), soft((0.5, 0, 1)))
    first, second = bake.state.lights
    alone = room(second).fresh_rays
    for light in (
        replace(second, radius=0.2),
        replace(second, radius=0.2, soft_falloff=False),
        replace(second, kind=LightKind.SPOT, cone=1.0),
        replace(second, kind=LightKind.SPOT, cone=1.0, blend=0.5),
        replace(second, matrix_world=translation(0.4, 0, 1)),
    ):
        update = bake.lit_by(first, light)
        assert 0 < update.rays <= alone * 1.2 and (update.lamps_updated, update.lamps_kept) == (1, 1)
    free = replace(bake.state.lights[1], casts_shadow=False)
    update = bake.lit_by(first, free)
    assert (update.rays, update.lamps_updated) == (0, 1) and update.changed.any()  # computed anew, but without rays
    assert bake.moved(8, 0.1, 0, 0).rays < 0.5 * alone


@pytest.mark.parametrize("spread", [3.0, 1.5])
def test_the_shape_of_an_area_lamp_counts(spread: float) -> None:
    bake = room(replace(LAMPS["area"], matrix_world=translation(0, 0, 1.8)))
    (lamp,) = bake.state.lights
    for light in (replace(lamp, spread=spread), replace(lamp, size=(0.4, 1.0)), replace(LAMPS["ellipse"])):
        assert bake.lit_by(light).changed.any()


def test_a_sun_may_stand_anywhere() -> None:
    bake = room(LAMPS["sun"])
    update = bake.lit_by(replace(LAMPS["sun"], matrix_world=translation(9, 0, 0) @ LAMPS["sun"].matrix_world))
    assert (update.rays, update.lamps_kept) == (0, 1)


def test_a_lamp_more_or_less_leaves_the_others() -> None:
    bake = room(soft())
    (first,) = bake.state.lights
    update = bake.lit_by(first, soft((0.5, 0, 1)))
    assert (update.lamps_updated, update.lamps_kept) == (1, 1)
    assert bake.lit_by(first).rays == 0
    assert bake.lit_by().changed.any() and not bake.lit_by().changed.any()
    assert bake.lit_by(first).lamps_updated == 1  # those that left the scene are forgotten


# --- what moves ---------------------------------------------------------------------------------------------------


def test_a_mover_in_a_corner_costs_few_rays() -> None:
    bake = room(soft(), texels=24)
    update = bake.moved(8, 0.01, 0.01, 0)
    assert 0 < update.rays < 0.12 * bake.fresh_rays
    assert 0 < update.changed.sum() < 0.1 * bake.texels.count


def test_objects_come_and_go() -> None:
    bake = room(soft(), texels=24)
    for visible in (False, True):
        update = bake.change(visible=np.arange(11) != 8 if not visible else np.ones(11, bool))
        assert 0 < update.rays < 0.1 * bake.fresh_rays and update.changed.any()


def test_a_dark_lamp_learns_what_it_missed() -> None:
    bake = room(soft(), texels=24)
    (lamp,) = bake.state.lights
    assert bake.lit_by(replace(lamp, power=BLACK)).rays == 0
    for step in range(3):
        update = bake.moved(8 + step, 0.1, 0.05, 0)
        assert (update.rays, update.lamps_kept) == (0, 0) and not update.direct.any()
    update = bake.lit_by(lamp)
    assert 0 < update.rays < 0.4 * bake.fresh_rays
    assert bake.lit_by(replace(lamp, power=BLACK)).rays == 0
    assert bake.lit_by(replace(lamp, radius=0.3)).rays == bake.fresh_rays  # it came back as another


def test_a_dark_lamp_without_shadows_learns_which_texels_moved() -> None:
    bake = room(replace(soft(), casts_shadow=False))
    (lamp,) = bake.state.lights
    bake.lit_by(replace(lamp, power=BLACK))
    for crate in (8, 9):
        bake.moved(crate, 0.1, 0.05, 0.3)
    update = bake.lit_by(lamp)
    assert update.rays == 0 and update.lamps_updated == 1


def test_many_movers_are_taken_together() -> None:
    bake = room(soft(), movers=MOST_BALLS + 5)
    matrices = bake.state.matrix_world.copy()
    matrices[8:, 2, 3] += np.linspace(0, 0.3, MOST_BALLS + 5)
    assert bake.change(matrix_world=matrices).rays < bake.fresh_rays


def test_what_was_said_to_stay_put_may_move_all_the_same() -> None:
    bake = room(soft())
    assert bake.moved(5, 0.1, 0.1, 0).rays == bake.fresh_rays


# --- transparency -------------------------------------------------------------------------------------------------


def test_opacity_counts_where_it_is_seen() -> None:
    bake = room(soft(), texels=24, movers=1, opacity=0.5)
    update = bake.looking(3, 0.25)
    assert 0 < update.rays < 0.15 * bake.fresh_rays and update.changed.any()
    assert bake.change().rays == 0
    for opacity in (1.0, 0.5, 0.0):  # the way that rays are traced changes with the first sheet and the last
        assert bake.looking(3, opacity).changed.any()


# --- everything at once -------------------------------------------------------------------------------------------


def some_lamp(rng: np.random.Generator) -> Light:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = translation(*rng.uniform([-0.9, -0.9, 0.2], [0.9, 0.9, 1.9]))
    matrix[:3, :3] = turn * np.sign(np.linalg.det(turn))
    lamp = LAMPS[list(LAMPS)[rng.integers(len(LAMPS))]]
    return replace(lamp, matrix_world=matrix, power=tuple(rng.uniform(0, 50, 3)), casts_shadow=bool(rng.random() < 0.9))


def changed_lamp(light: Light, rng: np.random.Generator) -> Light:
    match rng.integers(6):
        case 0:
            return replace(light, power=BLACK)
        case 1 | 2:
            return replace(light, power=tuple(rng.uniform(0, 50, 3)))
        case 3:
            return replace(light, matrix_world=light.matrix_world @ translation(0.05, 0, 0))
        case 4:
            return some_lamp(rng)
        case _:
            sizes = {"radius": light.radius + 0.01, "angle": light.angle + 0.01, "size": (0.3, 0.4)}
            return replace(light, **sizes, casts_shadow=not light.casts_shadow)


def changed_state(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    matrices, visible, lights = state.matrix_world.copy(), state.visible.copy(), list(state.lights)
    vertices, looks = dict(state.vertices), list(state.materials or scene.materials)
    for _ in range(rng.integers(3)):
        match rng.integers(6):
            case 0:
                matrices[rng.integers(8, 11), :3, 3] += rng.normal(scale=0.1, size=3)
            case 1:
                matrices[rng.integers(8, 11), :3, :3] *= rng.uniform(0.8, 1.3)
            case 2:
                visible[rng.integers(8, 11)] ^= True
            case 3:
                vertices[7] = scene.meshes[7].vertices + rng.normal(scale=0.05, size=(6, 3)).astype(np.float32)
            case 4:
                looks[3] = replace(looks[3], opacity=float(rng.choice([0.2, 0.5, 1.0])))
            case _:
                number = rng.integers(len(lights))
                lights[number] = changed_lamp(lights[number], rng)
    if rng.random() < 0.1:
        lights = [*lights, some_lamp(rng)][-3:]
    return FrameState(
        state.frame + 1, matrices, visible, tuple(lights), None, vertices=vertices, materials=tuple(looks)
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3]))
def test_whatever_changes_the_bits_are_those_of_a_fresh_computation(seed: int, threads: int) -> None:
    """``Bake.advance`` compares each frame."""
    rng = np.random.default_rng(seed)
    bake = room(some_lamp(rng), some_lamp(rng), opacity=float(rng.choice([0.5, 1.0])))
    bake.workers, bake.samples = Workers(threads), 1 + int(seed % 3)
    for _ in range(8):
        bake.advance(changed_state(bake.state, bake.scene, rng))


def test_other_samples_start_afresh() -> None:
    bake = room(soft())
    bake.samples = 3
    assert bake.change().rays == bake.fresh_rays


class Fault(Exception):
    pass


def test_after_an_interrupted_update_nothing_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    bake = room(soft(), soft((0.5, 0, 1)))

    def fail(*_args: object) -> None:
        raise Fault

    with monkeypatch.context() as patch:
        patch.setattr(bake.tracer, "blocked", fail)
        with pytest.raises(Fault):
            bake.moved(8, 0.1, 0.1, 0)
    assert bake.change().rays == bake.fresh_rays
    with monkeypatch.context() as patch:
        patch.setattr(bake.tracer, "blocked", fail)
        with pytest.raises(Fault):
            bake.moved(8, 0.1, 0.1, 0)
    assert not bake.lit_by().direct.any()


# --- the balls ----------------------------------------------------------------------------------------------------


def ways(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) in the unit ball, half of them on its surface."""
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return way * np.where(np.arange(count) % 2, 1, np.cbrt(rng.random(count)))[:, None]


def nearest(start: np.ndarray, end: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(k,) m from ``centre`` to the segments."""
    way = end - start
    along = np.clip(((centre - start) * way).sum(axis=1) / (way * way).sum(axis=1), 0, 1)
    return np.linalg.norm(start + way * along[:, None] - centre, axis=1)


def rays_to(light: Light, position: np.ndarray, reach: float, origin: np.ndarray, rng: np.random.Generator):
    """((k, 3), (k, 3)) starts and ends; some along the outline of all of them."""
    way, count = ways(rng, 1000), 1000
    start = position + reach * way
    if light.kind == LightKind.SUN:
        tilt, turn = light.angle * np.sqrt(rng.random(count)), rng.random(count) * 2 * np.pi
        local = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
        return start, start + 100 * local @ light.matrix_world[:3, :3].T
    size = float(np.hypot(*light.size)) / 2 if light.kind == LightKind.AREA else light.radius
    other = np.where(rng.random((count, 1)) < 0.5, way, ways(rng, count))
    return start, light.matrix_world[:3, 3] - origin + size * other


@pytest.mark.parametrize("name", LAMPS)
def test_every_ray_through_the_ball_is_found_and_few_others(name: str) -> None:
    rng = np.random.default_rng(len(name))
    said = passes = 0
    for _ in range(300):
        origin, light = rng.normal(size=3), replace(LAMPS[name], matrix_world=some_lamp(rng).matrix_world)
        position = rng.uniform(-2, 2, 3).astype(np.float32)
        reach, radius = float(rng.choice([1e-3, 0.3])), float(rng.choice([0.05, 0.5]))
        start, end = rays_to(light, position, reach, origin, rng)
        beyond = rng.uniform(-0.2, 1.2) / (50 if light.kind == LightKind.SUN else 1)
        centre = start[0] + (end[0] - start[0]) * beyond + rng.normal(scale=radius + reach, size=3)
        balls = Balls(centre[None], np.array([radius]))
        (found,) = may_shade(light, position[None], np.float32([reach]), balls, origin=origin)
        near = nearest(start, end, centre).min() <= radius
        assert found or not near
        said, passes = said + found, passes + near
    assert 50 < passes < 290 and said <= passes * 1.1


@pytest.mark.parametrize("count", [1, MOST_BALLS, MOST_BALLS + 1, 500])
def test_joined_balls_hold_those_they_were_made_of(count: int) -> None:
    rng = np.random.default_rng(count)
    small = Balls(rng.normal(size=(count, 3)), rng.random(count))
    joined = together(Balls(small.centre[:1], small.radius[:1]), Balls(small.centre[1:], small.radius[1:]))
    assert len(joined.radius) <= MOST_BALLS
    apart = np.linalg.norm(small.centre[:, None] - joined.centre[None], axis=2)
    assert (apart + small.radius[:, None] <= joined.radius[None] + 1e-9).any(axis=1).all()
