# SPDX-License-Identifier: GPL-3.0-or-later
"""Animations of 24 frames that the bench and the tests bake: one thing changes in each. No Blender is needed.

To add one, write a function that gives a :class:`FrameSequence` and name it in ``SEQUENCES``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rtgi_addon.backend.scene import Atlas, Float32, Float64, FrameState, Instance, Mesh, Scene
from rtgi_addon.backend.settings import AimBounced
from tests.backend.scenes import cornell, grid_atlas, mesh_of_triangles, point_light, translation

from .rooms import BLOCK_HEIGHT, door_at, larsen_box, turned, two_rooms

FRAMES = 24
#: Guide frames of a sequence at most.
GUIDES = 5
#: Texels along a wall of the Cornell box: 12k texels in all.
CORNELL = 44
#: Larsen04 §8: photon groups, and photons in each.
LARSEN_GROUPS = (77, 40)


@dataclass(frozen=True)
class FrameSequence:
    """A scene, its atlas, and its frames."""

    name: str
    title: str
    scene: Scene
    atlas: Atlas
    states: tuple[FrameState, ...]
    options: dict[str, Any] = field(default_factory=dict)  # settings of a bake that differ from the defaults

    @property
    def guide(self) -> tuple[FrameState, ...]:
        """Frames spread evenly over the sequence, whose light tells where gather rays are aimed (``Session``)."""
        count = len(self.states)
        chosen = np.unique(np.linspace(0, count - 1, min(GUIDES, count)).round().astype(int))
        return tuple(self.states[i] for i in chosen)


def moved(scene: Scene, frame: int, places: dict[str, Float64]) -> FrameState:
    """The scene's own state with the named instances placed at (4, 4) matrices."""
    state = scene.first_frame(frame)
    matrices = state.matrix_world.copy()
    number = {instance.name: i for i, instance in enumerate(scene.instances)}
    for name, matrix in places.items():
        matrices[number[name]] = matrix
    return replace(state, matrix_world=matrices)


def _frames(make: Callable[[int, float], FrameState], count: int) -> tuple[FrameState, ...]:
    """``make(frame, t)`` for frames 1.. and t from 0 to 1."""
    return tuple(make(i + 1, i / max(count - 1, 1)) for i in range(count))


def rigid_mover(texels: int = CORNELL, frames: int = FRAMES) -> FrameSequence:
    """The short block slides a metre along the front of the box and turns by 90 degrees."""
    scene, atlas = cornell(texels, moving=True)
    states = _frames(lambda f, t: moved(scene, f, {"short": turned(t * np.pi / 2, t - 0.5, -0.55, 0.3)}), frames)
    return FrameSequence("mover", "A block slides and turns", scene, atlas, states)


def slow_mover(texels: int = CORNELL, frames: int = FRAMES) -> FrameSequence:
    """The short block slides 2 mm a frame."""
    scene, atlas = cornell(texels, moving=True)
    states = _frames(lambda f, _: moved(scene, f, {"short": turned(-0.29, 0.35 - 0.002 * (f - 1), -0.5, 0.3)}), frames)
    return FrameSequence("slow", "A block slides 2 mm a frame", scene, atlas, states)


def deforming(texels: int = CORNELL, frames: int = FRAMES) -> FrameSequence:
    """A flag of 288 triangles, mapped on both sides, waves in front of the tall block."""
    base, _ = cornell(texels)
    side = max(2, round(0.45 * texels))
    flag = _flag(0.0)[0]
    kept = [*range(5), 6]
    meshes = (*(base.meshes[i] for i in kept), flag)
    matrices = [base.instances[i].matrix_world for i in kept] + [translation(0.1, -0.4, 0.9)]
    instances = tuple(Instance(m.name, i, matrices[i], deforming=m is flag) for i, m in enumerate(meshes))
    scene = Scene(meshes, instances, base.materials, base.lights)
    face = max(2, round(texels * 0.3))
    sizes = [(texels, texels)] * 5 + [(3 * (face + 2), 2 * (face + 2)), (side, side)]
    atlas = grid_atlas(scene, sizes, back=(6,))

    def state(frame: int, t: float) -> FrameState:
        _, vertices, normals = _flag(2 * np.pi * t)
        return replace(scene.first_frame(frame), vertices={6: vertices}, corner_normals={6: normals})

    return FrameSequence("deforming", "A flag waves", scene, atlas, _frames(state, frames))


def _flag(phase: float, n: int = 12) -> tuple[Mesh, Float32, Float32]:
    """(mesh, its vertices (v, 3), its corner normals (t, 3, 3)): 0.9 m by 0.9 m in x and z, waving along y."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    corners = np.stack([(i, j), (i + 1, j), (i + 1, j + 1), (i, j), (i + 1, j + 1), (i, j + 1)], axis=1)
    uv = corners.transpose(2, 1, 0).reshape(-1, 3, 2) / n  # (2 n², 3, 2)
    u, v = uv[..., 0], uv[..., 1]
    wave = 6 * u + 2 * v - phase
    points = 0.9 * np.stack([u - 0.5, 0.12 * u * np.sin(wave), v - 0.5], axis=-1)
    du, dv = 0.12 * (np.sin(wave) + 6 * u * np.cos(wave)), 0.12 * 2 * u * np.cos(wave)
    normals = np.stack([du, -np.ones_like(u), dv], axis=-1)
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    mesh = mesh_of_triangles("flag", points, uv, np.zeros(len(uv), int), normals)
    return mesh, mesh.vertices, normals


def moving_lamp(texels: int = CORNELL, frames: int = FRAMES) -> FrameSequence:
    """The lamp goes round under the ceiling; nothing else moves."""
    scene, atlas = cornell(texels)

    def state(frame: int, t: float) -> FrameState:
        angle = 2 * np.pi * t
        lamp = point_light((0.6 * np.cos(angle), 0.6 * np.sin(angle), 1.7), 50.0)
        return replace(scene.first_frame(frame), lights=(lamp,))

    return FrameSequence("lamp", "A lamp moves", scene, atlas, _frames(state, frames))


def lamp_off(texels: int = CORNELL, frames: int = FRAMES) -> FrameSequence:
    """One of two lamps is dark in the second half."""
    base, atlas = cornell(texels)
    lamps = (point_light((-0.5, 0, 1.8), 30.0, "west"), point_light((0.5, -0.3, 1.8), 20.0, "east"))
    scene = replace(base, lights=lamps)
    dark = (replace(lamps[0], power=(0.0, 0.0, 0.0)), lamps[1])
    states = _frames(lambda f, t: replace(scene.first_frame(f), lights=lamps if t < 0.5 else dark), frames)
    return FrameSequence("off", "A lamp is switched off", scene, atlas, states)


def appearing(texels: int = CORNELL, frames: int = FRAMES) -> FrameSequence:
    """The short block is there in the middle third alone."""
    scene, atlas = cornell(texels, moving=True)
    number = [i.name for i in scene.instances].index("short")

    def state(frame: int, t: float) -> FrameState:
        visible = np.ones(len(scene.instances), np.bool_)
        visible[number] = 1 / 3 <= t < 2 / 3
        return replace(scene.first_frame(frame), visible=visible)

    return FrameSequence("appears", "A block appears and vanishes", scene, atlas, _frames(state, frames))


def door(texels_per_metre: float = 14.0, frames: int = FRAMES) -> FrameSequence:
    """The door between two rooms is shut for a sixth of the time, then slides open."""
    scene, atlas = two_rooms(texels_per_metre, doorway=True)
    states = _frames(lambda f, t: moved(scene, f, {"door": door_at(max(0.0, 1.2 * t - 0.2))}), frames)
    return FrameSequence("door", "A door opens between two rooms", scene, atlas, states)


def closed_rooms(texels_per_metre: float = 14.0, frames: int = FRAMES) -> FrameSequence:
    """Two closed rooms; a block slides and turns in one."""
    scene, atlas = two_rooms(texels_per_metre, doorway=False)
    states = _frames(lambda f, t: moved(scene, f, {"A block": turned(t, -1.6 + t, -0.4, BLOCK_HEIGHT)}), frames)
    return FrameSequence("closed", "A block moves in one of two closed rooms", scene, atlas, states)


def still(texels: int = CORNELL, frames: int = FRAMES) -> FrameSequence:
    """Nothing changes, though the short block could move."""
    scene, atlas = cornell(texels, moving=True)
    return FrameSequence("still", "Nothing moves", scene, atlas, _frames(lambda f, _: scene.first_frame(f), frames))


def larsen(frames: int = FRAMES) -> FrameSequence:
    """Larsen04 §8's own size: 140 texels, two movers, 77 groups of 40 photons."""
    scene, atlas = larsen_box()

    def state(frame: int, t: float) -> FrameState:
        cube, ball = turned(t, 0.4, -0.6 + t, 0.25), translation(-0.4, 0.5 - t, 0.3 + 0.4 * t)
        return moved(scene, frame, {"cube": cube, "ball": ball})

    groups, each = LARSEN_GROUPS
    options = {"aim_bounced": AimBounced.PHOTONS, "photons": groups * each}
    return FrameSequence("larsen", "Larsen04 §8: 140 texels, two movers", scene, atlas, _frames(state, frames), options)


SEQUENCES: dict[str, Callable[[], FrameSequence]] = {
    "mover": rigid_mover,
    "slow": slow_mover,
    "deforming": deforming,
    "lamp": moving_lamp,
    "off": lamp_off,
    "appears": appearing,
    "door": door,
    "closed": closed_rooms,
    "still": still,
    "larsen": larsen,
}
