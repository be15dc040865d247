# SPDX-License-Identifier: GPL-3.0-or-later
"""How a stand-in moves, deforms and shows itself over the frames, as an object of Blender can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from .backend.scene import Float32, Float64, FrameState
from .source import SourceScene


@dataclass
class Motion:
    """One stand-in over the frames: matrices (f, 4, 4), shown (f,), vertices f × (v, 3) if it deforms."""

    matrix: Float64
    shown: NDArray[np.bool_]
    vertices: list[Float32] | None = None


def motions(source: SourceScene, states: Sequence[FrameState], chosen: Sequence[int]) -> dict[int, Motion]:
    """The motion of the ``chosen`` instances; read before the scene is changed, for it is the scene's own."""
    out = {}
    for index in chosen:
        instance = source.instances[index]
        rest = source.meshes[instance.mesh].vertices
        shown = np.array([s.visible[index] for s in states])
        at = held(shown)
        vertices = [states[i].vertices.get(instance.mesh, rest) for i in at] if instance.deforming else None
        out[index] = Motion(np.array([states[i].matrix_world[index] for i in at]), shown, vertices)
    return out


def held(shown: NDArray[np.bool_]) -> list[int]:
    """For each frame the nearest one before in which it is ``shown``, else the first of all: what vanishes must not
    be on its way to somewhere else in the frames between."""
    last = np.maximum.accumulate(np.where(shown, np.arange(len(shown)), -1))
    first = int(np.argmax(shown))
    return [first if i < 0 else i for i in last.tolist()]


def span_shown(motion: Motion) -> slice:
    """The frames from the first to the last in which it is shown; all if there is none."""
    shown = np.flatnonzero(motion.shown).tolist()
    return slice(shown[0], shown[-1] + 1) if shown else slice(0, len(motion.shown))


def to_rigid(motion: Motion, rest: Float32) -> Motion:
    """The same motion with matrices that an object can have: a shear, which it cannot, goes into the vertices."""
    if all(_is_rigid_or_scaled(m) for m in motion.matrix):
        return motion
    vertices = motion.vertices or [rest] * len(motion.matrix)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0]) if np.linalg.det(motion.matrix[0][:3, :3]) < 0 else np.eye(4)
    world = [mirror @ m for m in motion.matrix]  # the mirror is its own inverse
    moved = [
        (v.astype(np.float64) @ m[:3, :3].T + m[:3, 3]).astype(np.float32) for v, m in zip(vertices, world, strict=True)
    ]
    return Motion(np.repeat(mirror[None], len(world), axis=0), motion.shown, moved)


def _is_rigid_or_scaled(matrix: Float64) -> bool:
    again = np.array(Matrix.LocRotScale(*Matrix(matrix.tolist()).decompose()))
    return bool(np.allclose(again, matrix, rtol=1e-5, atol=1e-5 * np.abs(matrix[:3, :3]).max()))
