# SPDX-License-Identifier: GPL-3.0-or-later
"""Sequences of small frames in which one thing changes, and the law that holds all of them: a frame's maps are a
function of its own state, never of the frames that were lit before it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.rooms import turned
from bench.sequences import FrameSequence, moved
from rtgi_addon.backend.scene import (
    Atlas,
    FrameState,
    Instance,
    Light,
    LightKind,
    LightMaps,
    Material,
    Mesh,
    Scene,
    World,
)
from rtgi_addon.backend.session import FrameResult, Session
from rtgi_addon.backend.settings import BakeSettings, Quality, Selection
from tests.backend.scenes import GREEN, RED, WHITE, box, cornell, grid_atlas, point_light, quad, sphere, translation

FRAMES = 24
BARE = BakeSettings(
    denoise=False, quality=Quality.DRAFT, threads=1, photons=600, nearest_photons=16, direct_samples=2, max_specular=3
)
#: Frames of a story in the order in which they are lit: forwards, the last again, jumps, back to the start, and on.
ORDER = (*range(FRAMES), 23, 11, 12, 11, 3, 20, 0, 0, 16, 14, 5)
#: Frames that a session of their own lights as well.
ALONE = (7, 23)

MIRROR, GLASS, PANE, GLOW, PAINT = 3, 4, 5, 6, 7  # materials of studio()
LOOKS = (
    WHITE,
    RED,
    GREEN,
    Material("mirror", (0.1, 0.1, 0.1), specular=(0.8, 0.7, 0.6)),
    Material("glass", (0.0, 0.0, 0.0), transmission=(0.9, 0.8, 0.9), ior=1.4),
    Material("pane", (0.3, 0.3, 0.6), opacity=0.5),
    Material("glow", (0.2, 0.2, 0.2), emission=(3.0, 1.0, 0.3)),
    Material("paint", (0.6, 0.5, 0.2)),
)


# --- scenes -----------------------------------------------------------------------------------------------------------


MOVERS = ("short", "glass", "pane", "glow", "ball", "flap")


def studio(texels: int = 5, *, moving: Sequence[str] = MOVERS) -> tuple[Scene, Atlas]:
    """Cornell's box, open to a sky, with a mirror on its back wall, a glass ball, a see-through sheet, a box that glows
    and a smooth ball. Those of MOVERS that are ``moving`` may move, or in the flap's case deform."""
    base, _ = cornell(texels)
    face = 2
    meshes = [*base.meshes[:5]]
    meshes += [box("short", (0.5, 0.5, 0.5), texels=face, material=PAINT), box("tall", (0.5, 0.5, 1.2), texels=face)]
    meshes += [
        quad("mirror", [(-0.7, 0.97, 0.3), (0.7, 0.97, 0.3), (0.7, 0.97, 1.6), (-0.7, 0.97, 1.6)], material=MIRROR),
        sphere("glass", 0.22, rings=5, inward=False, material=GLASS),
        quad("pane", [(-0.4, 0, -0.4), (0.4, 0, -0.4), (0.4, 0, 0.4), (-0.4, 0, 0.4)], material=PANE),
        box("glow", (0.2, 0.2, 0.2), texels=face, material=GLOW),
        sphere("ball", 0.2, rings=5, inward=False, material=PAINT),
        quad("flap", [(-0.3, -0.3, 0), (0.3, -0.3, 0), (0.3, 0.3, 0), (-0.3, 0.3, 0)]),
    ]
    places = {
        "short": turned(-0.29, 0.35, -0.35, 0.25), "tall": turned(0.3, -0.45, 0.4, 0.6),
        "glass": translation(-0.35, -0.5, 0.4), "pane": translation(0.3, 0.2, 1.0), "glow": translation(0.6, 0.5, 0.1),
        "ball": translation(-0.1, -0.7, 0.2), "flap": translation(-0.5, -0.3, 1.3),
    }  # fmt: skip
    instances = tuple(
        Instance(
            m.name, i, places.get(m.name, np.eye(4)), moving=m.name in moving and m.name != "flap",
            deforming=m.name == "flap" and "flap" in moving,
        )
        for i, m in enumerate(meshes)
    )  # fmt: skip
    lamps = (point_light((0.1, 0, 1.9), 40.0), Light("sun", LightKind.SUN, tilted(0.9), (2.0, 1.8, 1.5), angle=0.02))
    sky = World(np.array([[[0.3, 0.4, 0.6]], [[0.1, 0.2, 0.9]]], np.float32))
    scene = Scene(tuple(meshes), instances, LOOKS, lamps, sky)
    return scene, grid_atlas(scene, [_size(m, texels, face) for m in meshes], back=(9, 12))


def _size(mesh: Mesh, texels: int, face: int) -> tuple[int, int]:
    if mesh.island_count == 6:
        return 3 * (face + 2), 2 * (face + 2)
    return (8, 4) if mesh.name in ("glass", "ball") else (texels, texels)


def tilted(angle: float, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """(4, 4) rotation about x by ``angle``, then to (x, y, z): a lamp that shines down and, for > 0, towards +y."""
    matrix = translation(x, y, z)
    c, s = np.cos(angle), np.sin(angle)
    matrix[1:3, 1:3] = [[c, -s], [s, c]]
    return matrix


def number_of(scene: Scene, name: str) -> int:
    return [i.name for i in scene.instances].index(name)


def frames(make: Callable[[int, float], FrameState], count: int = FRAMES) -> tuple[FrameState, ...]:
    """``make(frame, t)`` for frames 1 to ``count`` and t from 0 to 1."""
    return tuple(make(i + 1, i / (count - 1)) for i in range(count))


def placed(scene: Scene, at: Callable[[float], dict[str, np.ndarray]]) -> tuple[FrameState, ...]:
    """Frames in which the named instances stand at ``at(t)``."""
    return frames(lambda f, t: moved(scene, f, at(t)))


def shown(scene: Scene, name: str, at: Callable[[float], bool]) -> tuple[FrameState, ...]:
    """Frames in which the named instance is visible where ``at(t)``."""

    def make(frame: int, t: float) -> FrameState:
        visible = np.ones(len(scene.instances), np.bool_)
        visible[number_of(scene, name)] = at(t)
        return replace(scene.first_frame(frame), visible=visible)

    return frames(make)


def lit(scene: Scene, at: Callable[[float], tuple[Light, ...]]) -> tuple[FrameState, ...]:
    """Frames with the lamps ``at(t)``."""
    return frames(lambda f, t: replace(scene.first_frame(f), lights=at(t)))


def looking(scene: Scene, number: int, at: Callable[[float], dict]) -> tuple[FrameState, ...]:
    """Frames in which values of material ``number`` are those of ``at(t)``."""

    def make(frame: int, t: float) -> FrameState:
        looks = list(scene.materials)
        looks[number] = replace(looks[number], **at(t))
        return replace(scene.first_frame(frame), materials=tuple(looks))

    return frames(make)


def under(scene: Scene, at: Callable[[float], World | None]) -> tuple[FrameState, ...]:
    """Frames with the sky ``at(t)``."""
    return frames(lambda f, t: replace(scene.first_frame(f), world=at(t)))


def bent(mesh: Mesh, amount: float) -> tuple[np.ndarray, np.ndarray]:
    """((v, 3), (t, 3, 3)) vertices of ``mesh`` bent upwards along x, and the flat normals that go with them."""
    vertices = mesh.vertices.copy()
    vertices[:, 2] += np.float32(amount) * vertices[:, 0]
    corners = vertices[mesh.triangles].astype(np.float64)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.repeat((face / np.linalg.norm(face, axis=1, keepdims=True))[:, None], 3, axis=1)
    return vertices, normals.astype(np.float32)


# --- the law ----------------------------------------------------------------------------------------------------------


def settings_of(story: FrameSequence, base: BakeSettings = BARE) -> BakeSettings:
    return replace(base, resolution=max(16, story.atlas.resolution), **story.options)


def differences(a: LightMaps, b: LightMaps) -> list[str]:
    """Which maps differ in any bit, at how many pixels, and by how much."""
    found = []
    for name in ("iim", "aim", "caustics", "valid"):
        x, y = getattr(a, name), getattr(b, name)
        if x is None or y is None:
            if x is not y:
                found.append(f"{name}: only one has it")
        elif x.tobytes() != y.tobytes():
            apart = np.abs(x.astype(np.float64) - y)
            found.append(f"{name}: {np.count_nonzero(apart)} values, by {apart.max():.3g} of {np.abs(y).max():.3g}")
    return found


def play(
    story: FrameSequence, settings: BakeSettings, order: Iterable[int], *, oidn: Sequence[Path] = ()
) -> list[FrameResult]:
    """The frames ``order`` (from 0) of ``story``, lit one after the other by one session."""
    with Session(
        story.scene, story.atlas, settings, story.states[0], guide=story.guide[::4], oidn_paths=oidn
    ) as session:
        return [session.advance(story.states[n]) for n in order]


def assert_lawful(
    story: FrameSequence, settings: BakeSettings, *, order: Sequence[int] = ORDER, alone: Sequence[int] = ALONE,
    oidn: Sequence[Path] = (),
) -> list[FrameResult]:  # fmt: skip
    """Frames lit in any ``order`` are, to the last bit, those of selection OFF and of sessions that light one alone."""
    results = play(story, settings, order, oidn=oidn)
    scratch = replace(settings, selection=Selection.OFF)
    distinct = sorted(set(order))
    wanted = dict(zip(distinct, play(story, scratch, distinct, oidn=oidn), strict=True))
    for turn, (n, result) in enumerate(zip(order, results, strict=True)):
        assert result.maps.frame == story.states[n].frame
        assert not (found := differences(result.maps, wanted[n].maps)), (
            f"frame {n}, the {turn}th after {order[:turn][-3:]}: {found}"
        )
    for n in alone:
        fresh = play(story, settings, [n], oidn=oidn)[0]
        assert not (found := differences(fresh.maps, wanted[n].maps)), f"frame {n} alone: {found}"
    return results
