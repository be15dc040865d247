# SPDX-License-Identifier: GPL-3.0-or-later
"""The law of selection over whole sequences: kept or made from scratch, lit in any order, a frame has the same bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bench import sequences
from bench.rooms import turned
from bench.sequences import FrameSequence
from rtgi_addon.backend.lamps.sky import make_sky
from rtgi_addon.backend.scene import Light, World
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import AimBounced, AimDirect, Caustics, Quality
from tests.backend.lamps import LAMPS
from tests.backend.scenes import constant_sky, cornell, point_light, translation
from tests.backend.stories import (
    ALONE,
    BARE,
    GLASS,
    GLOW,
    MIRROR,
    PAINT,
    PANE,
    assert_lawful,
    bent,
    frames,
    lit,
    looking,
    number_of,
    placed,
    settings_of,
    shown,
    studio,
    tilted,
    under,
)

Make = Callable[[], FrameSequence]


def in_studio(states: Callable, *moving: str, **options) -> Make:
    """A story in the studio: mirror, glass, sheet and sky are there, whatever happens; those ``moving`` may move."""

    def make() -> FrameSequence:
        scene, atlas = studio(moving=moving)
        return FrameSequence("studio", "", scene, atlas, states(scene), options)

    return make


def in_the_box(states: Callable, **options) -> Make:
    """A story in the plain box, whose short block may move; it stands on the floor."""

    def make() -> FrameSequence:
        scene, atlas = cornell(6, moving=True)
        return FrameSequence("box", "", scene, atlas, states(scene), options)

    return make


def flaps(scene) -> tuple:
    """The studio's flap bends to and fro; it is there twice in :func:`twice`."""
    mesh = number_of(scene, "flap")

    def make(frame: int, t: float):
        vertices, normals = bent(scene.meshes[mesh], float(np.sin(6 * t)))
        return replace(scene.first_frame(frame), vertices={mesh: vertices}, corner_normals={mesh: normals})

    return frames(make)


def lamp_along(light: Light) -> Callable:
    """A lamp that goes across the ceiling and turns."""
    return lambda scene: lit(scene, lambda t: (replace(light, matrix_world=tilted(0.4 - t, 1.2 * t - 0.6, 0.2, 1.8)),))


def lamps_of_all_kinds(scene) -> tuple:
    """One after the other, each at its place for three frames."""
    kinds = [replace(light, matrix_world=tilted(0.3, 0.3, -0.2, 1.7)) for light in LAMPS.values()]
    return lit(scene, lambda t: (kinds[min(int(t * 8), 7)], kinds[min(3 + int(t * 8), 10)]))


def switched(scene) -> tuple:
    """Lamps dim, take colours, go out for a third of the time, and are gone for the last frames."""
    first, second = point_light((0.4, 0, 1.8), 30.0, "a"), point_light((-0.5, 0.2, 1.7), 1.0, "b")

    def at(t: float) -> tuple[Light, ...]:
        power = (0.0, 0.0, 0.0) if 0.3 < t < 0.6 else (30 * (1 - t), 20.0, 40 * t)
        return () if t > 0.9 else (replace(first, power=power), replace(second, power=(9.0 if t > 0.5 else 4.0,) * 3))

    return lit(scene, at)


def skies(t: float) -> World | None:
    """One that turns blue; none; one of another layout; a plain one; black."""
    if t < 0.3:
        return World(np.array([[[0.3, 0.4, 0.6]], [[0.1, 0.2, 1.0 + t]]], np.float32))
    if t < 0.45:
        return None
    if t < 0.7:
        return World((np.arange(72).reshape(4, 6, 3) % 7 / 7).astype(np.float32))
    return constant_sky(0.5 if t < 0.85 else 0.0)


ROOMS: dict[str, Make] = {
    "rigid mover": lambda: sequences.rigid_mover(6),
    "deforming flag": lambda: sequences.deforming(6),
    "lamp off": lambda: sequences.lamp_off(6),
    "object appears": lambda: sequences.appearing(6),
    "door": lambda: sequences.door(3.0),
    "two rooms": lambda: sequences.closed_rooms(3.0),
    "Larsen's box": lambda: sequences.larsen(),
}
LAMP_STORIES: dict[str, Make] = {
    "point lamp moves": in_the_box(lamp_along(point_light((0, 0, 0), 30.0))),
    "ball lamp moves": in_studio(lamp_along(LAMPS["sphere"])),
    "spot moves": in_studio(lamp_along(LAMPS["soft spot"])),
    "area lamp moves": in_studio(lamp_along(LAMPS["ellipse"])),
    "sun moves": in_studio(lamp_along(LAMPS["sun"])),
    "lamps of all kinds": in_the_box(lamps_of_all_kinds),
    "lamps switched, dimmed, recoloured": in_studio(switched),
}
STUDIO: dict[str, Make] = {
    "smooth ball crosses mirror and glass": in_studio(
        lambda s: placed(s, lambda t: {"ball": translation(1.4 * t - 0.7, 0.4, 0.8)}), "ball"
    ),
    "glass crosses the lamp's light": in_studio(
        lambda s: placed(s, lambda t: {"glass": translation(0.1, 0.9 * t - 0.4, 1.2)}), "glass"
    ),
    "sheet swings": in_studio(lambda s: placed(s, lambda t: {"pane": turned(3 * t, 0.3, 0.2, 1.0)}), "pane"),
    "glowing box wanders": in_studio(
        lambda s: placed(s, lambda t: {"glow": translation(0.6 - t, 0.5 - t, 0.1 + t)}), "glow"
    ),
    "flap bends": in_studio(flaps, "flap"),
    "glass appears": in_studio(lambda s: shown(s, "glass", lambda t: 0.2 < t < 0.5 or t > 0.8), "glass"),
    "mirror, said to be still, vanishes": in_studio(lambda s: shown(s, "mirror", lambda t: t < 0.5)),
    "block, said to be still, moves": in_studio(
        lambda s: placed(s, lambda t: {"tall": translation(-0.4, 0.4, 0.6 + 0.1 * (t > 0.5))})
    ),
}
LOOK_STORIES: dict[str, Make] = {
    "albedo": in_studio(lambda s: looking(s, PAINT, lambda t: {"albedo": (t, 0.5, 1 - t)})),
    "albedo without mirrors": in_the_box(lambda s: looking(s, 1, lambda t: {"albedo": (t, 0.5, 1 - t)})),
    "albedo of glass": in_studio(lambda s: looking(s, GLASS, lambda t: {"albedo": (0.1 * t, 0.0, 0.1)})),
    "emission": in_studio(lambda s: looking(s, GLOW, lambda t: {"emission": (4 * t, 0.0, 1.0)})),
    "emission begins": in_the_box(lambda s: looking(s, 1, lambda t: {"emission": (max(0.0, t - 0.5),) * 3})),
    "opacity": in_studio(lambda s: looking(s, PANE, lambda t: {"opacity": 1 - 0.8 * abs(2 * t - 1)})),
    "a wall thins out": in_the_box(lambda s: looking(s, 2, lambda t: {"opacity": min(1.0, 2 - 2 * t)})),
    "mirror": in_studio(lambda s: looking(s, MIRROR, lambda t: {"specular": (max(0.0, 0.9 - t),) * 3})),
    "glass": in_studio(lambda s: looking(s, GLASS, lambda t: {"ior": 1.1 + t})),
    "sky": in_studio(lambda s: under(s, skies)),
    "sky with photons": in_studio(lambda s: under(s, skies), aim_bounced=AimBounced.PHOTONS),
}


@pytest.mark.parametrize("name", ROOMS)
def test_rooms(name: str) -> None:
    story = ROOMS[name]()
    assert_lawful(story, settings_of(story))


@pytest.mark.parametrize("name", LAMP_STORIES)
def test_lamps(name: str) -> None:
    story = LAMP_STORIES[name]()
    assert_lawful(story, settings_of(story))


@pytest.mark.parametrize("name", STUDIO)
def test_mirrors_glass_and_sheets(name: str) -> None:
    story = STUDIO[name]()
    results = assert_lawful(story, settings_of(story))
    assert any(r.maps.caustics is not None and r.maps.caustics.any() for r in results)


@pytest.mark.parametrize("name", LOOK_STORIES)
def test_materials_and_skies(name: str) -> None:
    story = LOOK_STORIES[name]()
    assert_lawful(story, settings_of(story))


@pytest.mark.parametrize(
    "name, direct",
    [
        ("smooth ball crosses mirror and glass", AimDirect.PHOTONS),
        ("glowing box wanders", AimDirect.SHADOW_RAYS),
        ("flap bends", AimDirect.PHOTONS),
    ],
)
def test_photons_for_aim(name: str, direct: AimDirect) -> None:
    story = STUDIO[name]()
    settings = replace(settings_of(story), aim_bounced=AimBounced.PHOTONS, aim_direct=direct, caustics=Caustics.ON)
    assert_lawful(story, settings, alone=ALONE[:1])


def test_a_sky_of_another_layout_sends_what_it_sent() -> None:
    """In all, and into each half of the sphere; a map of smaller whole parts comes back from a finer layout."""
    image = np.random.default_rng(2).random((4, 6, 3)).astype(np.float32)
    known = make_sky(World(image))
    for layout in ((4, 6), (8, 12), (2, 2), (6, 10), (1, 1)):
        fitted = make_sky(World(image), layout)
        assert (fitted.rows, fitted.columns) == layout
        for part in (slice(None), *([slice(fitted.count // 2), slice(fitted.count // 2, None)] * (layout[0] > 1))):
            same = slice(None) if part == slice(None) else slice(0, 12) if part.start is None else slice(12, None)
            np.testing.assert_allclose(
                (fitted.radiance * fitted.solid_angle[:, None])[part].sum(axis=0),
                (known.radiance * known.solid_angle[:, None])[same].sum(axis=0),
                rtol=1e-5,
            )
    fine = make_sky(World(image), (8, 12)).radiance.reshape(4, 2, 6, 2, 3)
    np.testing.assert_allclose(fine, np.broadcast_to(image[:, None, :, None], fine.shape), rtol=1e-6)


def test_a_sky_that_no_guide_knows_is_seen_all_the_same() -> None:
    """Nothing is aimed at it, so that its light is noisier, but none is lost."""
    scene, atlas = cornell(6)
    dim = replace(scene.lights[0], power=(1e-3,) * 3)
    scene = replace(scene, lights=(dim,), world=World(np.array([[[1.0, 2, 3]], [[3, 2, 1]]], np.float32)))
    dark = replace(scene, world=None).first_frame()
    choice = replace(BARE, quality=Quality.FINAL, resolution=atlas.resolution)
    with Session(scene, atlas, choice, dark) as unknown, Session(scene, atlas, choice, scene.first_frame()) as known:
        seen, expected = (s.advance(scene.first_frame()).maps.iim for s in (unknown, known))
    np.testing.assert_allclose(seen.mean(axis=(0, 1, 2)), expected.mean(axis=(0, 1, 2)), rtol=0.02)
