# SPDX-License-Identifier: GPL-3.0-or-later
"""What may happen to the studio (see ``stories``) from one frame to the next, and random sequences of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench.rooms import turned
from bench.sequences import FrameSequence
from rtgi_addon.backend.scene import FrameState, Scene, World
from tests.backend.stories import GLASS, GLOW, MIRROR, PAINT, PANE, bent, number_of, studio, tilted

Act = Callable[[FrameState, Scene, np.random.Generator], FrameState]


def put(name: str) -> Act:
    """Anywhere in the box, turned, sometimes on the floor, mirrored, flat, or far away."""

    def act(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
        matrices = state.matrix_world.copy()
        height = float(rng.choice([0.25, rng.uniform(0.1, 1.8)]))
        matrix = turned(rng.uniform(0, 6), *rng.uniform(-0.9, 0.9, 2), height)
        matrix[:3, :3] *= rng.choice([1, 1, 1, -1, 1e-3, 0, 2.5])
        matrix[:3, 3] *= rng.choice([1, 1, 1, 1, 30])
        matrices[number_of(scene, name)] = matrix
        return replace(state, matrix_world=matrices)

    return act


def nudge(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    """All movers, by less than a millimetre."""
    matrices = state.matrix_world.copy()
    for name in ("short", "glass", "pane", "glow", "ball"):
        matrices[number_of(scene, name), :3, 3] += rng.normal(size=3) * 3e-4
    return replace(state, matrix_world=matrices)


def switch(name: str) -> Act:
    def act(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
        visible = state.visible.copy()
        visible[number_of(scene, name)] ^= True
        return replace(state, visible=visible)

    return act


def bend(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    flap = number_of(scene, "flap")
    vertices, normals = bent(scene.meshes[flap], rng.normal())
    return replace(state, vertices={flap: vertices}, corner_normals={flap: normals})


def light(**draw: Callable) -> Act:
    def act(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
        lamps = list(state.lights or scene.lights)
        number = int(rng.integers(len(lamps)))
        lamps[number] = replace(lamps[number], **{key: value(rng) for key, value in draw.items()})
        return replace(state, lights=tuple(lamps))

    return act


def look(material: int, **draw: Callable) -> Act:
    def act(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
        looks = list(state.materials or scene.materials)
        looks[material] = replace(looks[material], **{key: value(rng) for key, value in draw.items()})
        return replace(state, materials=tuple(looks))

    return act


def sky(state: FrameState, scene: Scene, rng: np.random.Generator) -> FrameState:
    shape = [(1, 1, 3), (2, 1, 3), (3, 4, 3)][rng.integers(3)]
    return replace(state, world=None if rng.random() < 0.2 else World(rng.random(shape).astype(np.float32)))


def rgb(rng: np.random.Generator) -> tuple[float, float, float]:
    return tuple(rng.choice([0.0, 0.3, 0.7], 3))


ACTS: dict[str, Act] = {
    "rest": lambda state, scene, rng: state,
    **{f"{name} moves": put(name) for name in ("short", "glass", "pane", "glow", "ball")},
    "all move a little": nudge,
    **{f"{name} comes or goes": switch(name) for name in ("short", "glass", "pane", "flap", "mirror", "ceiling")},
    "flap bends": bend,
    "lamp moves": light(matrix_world=lambda r: tilted(r.uniform(-1, 1), *r.uniform(-0.8, 0.8, 2), 1.7)),
    "lamp changes": light(power=lambda r: tuple(r.choice([0.0, 20.0, 40.0], 3))),
    "lamp off": light(power=lambda r: (0.0, 0.0, 0.0)),
    "no lamps": lambda state, scene, rng: replace(state, lights=()),
    "paint": look(PAINT, albedo=rgb),
    "glow": look(GLOW, emission=rgb),
    "pane": look(PANE, opacity=lambda r: float(r.choice([0.0, 0.4, 1.0]))),
    "mirror": look(MIRROR, specular=rgb),
    "glass": look(GLASS, ior=lambda r: float(r.uniform(1, 2))),
    "sky": sky,
}


def random_story(steps: list[list[str]], seed: int) -> FrameSequence:
    scene, atlas = studio(4)
    rng, states = np.random.default_rng(seed), [scene.first_frame()]
    for frame, names in enumerate(steps, 2):
        state = replace(states[-1], frame=frame)
        for name in names:
            state = ACTS[name](state, scene, rng)
        states.append(state)
    return FrameSequence("random", "", scene, atlas, tuple(states))
