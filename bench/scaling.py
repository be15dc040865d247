# SPDX-License-Identifier: GPL-3.0-or-later
"""How the cost of a frame grows: with the part of the scene that moves, with texels, rays, photons and triangles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rtgi_addon.backend.scene import Atlas, Float64, FrameState, Instance, Scene
from rtgi_addon.backend.settings import AimBounced, BakeSettings, Quality, SampleCounts
from tests.backend.scenes import cornell

from .baking import settings_of
from .frames import Played, play
from .rooms import bumpy_cornell, hall, turned
from .sequences import FrameSequence, moved

#: Frames of each point; the first is not timed, one in so many of the others is baked from scratch too.
FRAMES, SCRATCH_EVERY = 6, 3
#: Blocks of the hall that move, of 64.
MOVING = (1, 4, 16, 32, 64)
TEXELS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000)
RAYS = (16, 64, 256, 1024)
PHOTONS = (1_000, 10_000, 100_000, 1_000_000)
TRIANGLES = (100, 1_000, 10_000, 100_000, 1_000_000)
#: Texels along a wall, 3k in all, where something else grows.
SMALL = 22


@dataclass(frozen=True)
class Point:
    x: float
    played: Played


@dataclass(frozen=True)
class Sweep:
    """One quantity grows and all else stays."""

    name: str
    axis: str  # of the plot
    scene: str  # what was baked
    points: tuple[Point, ...]

    def slopes(self) -> tuple[float, float]:
        """Exponents (selected, from scratch) of cost ~ x^slope over the upper half of the range."""
        x = [p.x for p in self.points]
        return slope(x, [p.played.selected.seconds for p in self.points]), slope(
            x, [p.played.scratch.seconds for p in self.points]
        )


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Least squares of log y over log x, for x from the middle (in log) of its range up."""
    at, cost = np.log(np.asarray(x, np.float64)), np.log(np.asarray(y, np.float64))
    upper = at >= (at.min() + at.max()) / 2 - 1e-9
    return float(np.polyfit(at[upper], cost[upper], 1)[0])


def sweeps(oidn: Sequence[Path]) -> Iterator[Sweep]:
    """All of them, one after the other."""
    draft = BakeSettings(quality=Quality.DRAFT)
    photons = replace(draft, aim_bounced=AimBounced.PHOTONS)
    yield _sweep(
        "fraction", "part of the blocks that moves", "hall with 64 blocks, those that move are one object", MOVING,
        lambda n: (_hall_sequence(n, joined=True), draft), oidn,
    )  # fmt: skip
    yield _sweep(
        "movers", "objects that move", "hall with 64 blocks, each an object", MOVING,
        lambda n: (_hall_sequence(n, joined=False), draft), oidn,
    )  # fmt: skip
    yield _sweep(
        "texels", "texels", "Cornell box, one mover", TEXELS,
        lambda n: (_cornell_sequence(*cornell(_side_of(n), moving=True)), draft), oidn,
    )  # fmt: skip
    yield _sweep(
        "rays", "gather rays a texel", "Cornell box, one mover", RAYS,
        lambda n: (_cornell_sequence(*cornell(SMALL, moving=True)), settings_of(SampleCounts(n // 2, n // 2))), oidn,
    )  # fmt: skip
    yield _sweep(
        "photons", "photons", "Cornell box, one mover, AIM by photons", PHOTONS,
        lambda n: (_cornell_sequence(*cornell(SMALL, moving=True)), replace(photons, photons=n)), oidn,
    )  # fmt: skip
    yield _sweep(
        "triangles", "triangles", "Cornell box with bumpy walls, one mover", TRIANGLES,
        lambda n: (_cornell_sequence(*bumpy_cornell(n, SMALL)), draft), oidn,
    )  # fmt: skip


def _sweep(
    name: str, axis: str, scene: str, wanted: Sequence[int],
    make: Callable[[int], tuple[FrameSequence, BakeSettings]], oidn: Sequence[Path],
) -> Sweep:  # fmt: skip
    points = []
    for n in wanted:
        sequence, settings = make(n)
        played = play(sequence, settings, oidn, scratch_every=SCRATCH_EVERY)
        exact = {"texels": played.texels, "triangles": _triangles(sequence.scene), "fraction": n / max(MOVING)}
        points.append(Point(exact.get(name, n), played))
    return Sweep(name, axis, scene, tuple(points))


def _triangles(scene: Scene) -> int:
    return sum(scene.meshes[i.mesh].triangle_count for i in scene.instances)


def _side_of(texels: int) -> int:
    """Texels along a wall so that walls (5 n²) and blocks (12 · (0.3 n)²) have so many in all."""
    return max(7, round(float(np.sqrt(texels / (5 + 12 * 0.09)))))


def _cornell_sequence(scene: Scene, atlas: Atlas) -> FrameSequence:
    def state(frame: int) -> FrameState:
        return moved(scene, frame, {"short": turned(0.1 * frame, 0.05 * frame, -0.55, 0.3)})

    return FrameSequence("cornell", "", scene, atlas, tuple(state(f) for f in range(FRAMES)))


def _hall_sequence(count: int, *, joined: bool) -> FrameSequence:
    """``count`` blocks bob up and down."""
    scene, atlas = hall(count, joined=joined)
    movers = [i for i in scene.instances if i.moving]

    def state(frame: int) -> FrameState:
        lift = [0.05 * np.sin(frame + number) for number in range(len(movers))]
        return moved(scene, frame, {i.name: _lifted(i, z) for i, z in zip(movers, lift, strict=True)})

    return FrameSequence("hall", "", scene, atlas, tuple(state(f) for f in range(FRAMES)))


def _lifted(instance: Instance, z: float) -> Float64:
    matrix = instance.matrix_world.copy()
    matrix[2, 3] += z
    return matrix
