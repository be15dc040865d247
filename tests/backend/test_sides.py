# SPDX-License-Identifier: GPL-3.0-or-later
"""Which sides light reaches, in scenes where the answer is known."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.layout.sides import lit_sides
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import Instance, Light, LightKind, Material, Mesh, Scene, World
from tests.backend.scenes import (
    WHITE,
    box,
    constant_sky,
    cornell,
    mesh_of_triangles,
    point_light,
    quad,
    translation,
)

GLASS = Material("glass", (0.0, 0.0, 0.0), transmission=(1.0, 1.0, 1.0))
GLOW = Material("glow", emission=(1.0, 1.0, 1.0))
SKY = constant_sky(1.0)


def make(*placed: tuple[Mesh, np.ndarray], lights: tuple[Light, ...] = (), world: World | None = None) -> Scene:
    instances = tuple(Instance(f"{m.name}{i}", i, matrix) for i, (m, matrix) in enumerate(placed))
    return Scene(tuple(m for m, _ in placed), instances, (WHITE, GLASS, GLOW), lights, world)


def sides(scene: Scene) -> str:
    """One letter an instance: F front, B back, 2 both, - none."""
    front, back = lit_sides(scene, [scene.first_frame()])
    return "".join("-FB2"[int(f) + 2 * int(b)] for f, b in zip(front, back, strict=True))


def sun(x: float, y: float, z: float) -> Light:
    """A sun that shines along (x, y, z)."""
    direction = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    side = np.cross(direction, [0.31, 0.9, 0.2])
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([side, np.cross(-direction, side), -direction], axis=1)
    return Light("sun", LightKind.SUN, matrix, (1.0, 1.0, 1.0))


def plane(size: float = 2.0, material: int = 0) -> Mesh:
    h = size / 2
    return quad("plane", [(-h, -h, 0), (h, -h, 0), (h, h, 0), (-h, h, 0)], material=material)


def six_walls(size: float, *, inward: bool) -> list[tuple[Mesh, np.ndarray]]:
    """A closed room of six separate quads."""
    whole = box("room", (size,) * 3, texels=4, inward=inward)
    walls = []
    for face in range(6):
        rows = slice(2 * face, 2 * face + 2)
        corners = whole.vertices[whole.triangles[rows]]
        walls.append((mesh_of_triangles(f"wall{face}", corners, whole.corner_uv[rows], [0, 0]), np.eye(4)))
    return walls


def turned_over(scene: Scene) -> Scene:
    """The same surfaces with their fronts on the other side."""
    meshes = tuple(replace(m, triangles=m.triangles[:, ::-1].copy()) for m in scene.meshes)
    return replace(scene, meshes=meshes)


@pytest.mark.parametrize("lights, world", [((sun(0.2, 0.3, -1),), None), ((), SKY), ((point_light((3, 0, 1)),), None)])
def test_closed_solid_is_lit_outside_only(lights: tuple[Light, ...], world: World | None) -> None:
    assert sides(make((box("b", (1, 1, 1), texels=4), np.eye(4)), lights=lights, world=world)) == "F"


def test_lamp_inside_closed_box_lights_its_inside() -> None:
    scene = make((box("b", (1, 1, 1), texels=4), np.eye(4)), lights=(point_light((0.1, 0.2, 0)),))
    assert sides(scene) == "B"
    assert sides(replace(scene, world=SKY)) == "2"


@pytest.mark.parametrize("inward, expected", [(True, "F"), (False, "B")])
def test_closed_room_with_lamp_faces_either_way(inward: bool, expected: str) -> None:
    room, crate = six_walls(4.0, inward=inward), (box("crate", (1, 1, 1), texels=4), translation(0, 0, -1.4))
    assert sides(make(*room, crate, lights=(point_light((0, 0, 1.5)),))) == expected * 6 + "F"


def test_outside_of_a_closed_room_under_the_sky() -> None:
    room = six_walls(4.0, inward=True)
    assert sides(make(*room, world=SKY)) == "B" * 6
    assert sides(make(*room, world=SKY, lights=(point_light((0, 0, 0)),))) == "2" * 6


def test_open_cornell_box() -> None:
    scene, _ = cornell()
    assert sides(scene) == "FFFFFFF"
    assert sides(replace(scene, world=SKY)) == "22222FF"
    outward = turned_over(scene)
    assert sides(outward) == "BBBBBBB"
    assert sides(replace(outward, world=SKY)) == "22222BB"


def test_sunk_block_does_not_light_the_floor_from_below() -> None:
    """The block's front sees the lamp above the floor and the floor's back below it: two places of one side."""
    scene, _ = cornell()
    matrices = [i.matrix_world for i in scene.instances]
    matrices[5] = matrices[5] @ translation(0, 0, -0.2)
    instances = tuple(replace(i, matrix_world=m) for i, m in zip(scene.instances, matrices, strict=True))
    assert sides(replace(scene, instances=instances)) == "FFFFFFF"


def test_plane_alone() -> None:
    assert sides(make((plane(), np.eye(4)))) == "-"
    assert sides(make((plane(), np.eye(4)), world=SKY)) == "2"
    assert sides(make((plane(), np.eye(4)), lights=(sun(0, 0.1, -1),))) == "F"
    assert sides(make((plane(), np.eye(4)), lights=(sun(0, 0.1, 1),))) == "B"
    assert sides(make((plane(material=2), np.eye(4)))) == "2"


def test_sky_that_is_black_below_lights_no_underside() -> None:
    radiance = np.zeros((2, 1, 3), np.float32)
    radiance[1] = 1.0  # the last row looks up
    assert sides(make((plane(), np.eye(4)), world=World(radiance))) == "F"


def test_plane_on_the_floor() -> None:
    """A rug: its underside is in the dark, and so is what it covers, but not the rest of the floor."""
    assert (
        sides(make((plane(8.0), np.eye(4)), (plane(2.0), translation(0, 0, 0.001)), lights=(sun(0, 0.3, -1),))) == "FF"
    )


def test_mirrored_instance_keeps_its_front() -> None:
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    # The mirrored plane's front still counts as its own front; it now looks down.
    assert sides(make((plane(), mirror), lights=(sun(0, 0.1, 1),))) == "F"


def two_rooms(*, door: bool) -> Scene:
    """A closed room cut in two by a wall of no thickness, at x = 0; a lamp on the positive side."""
    whole = box("room", (4, 2, 2), texels=4, inward=True)
    left, right = (
        (mesh_of_triangles(name, c, u, np.arange(len(c)) // 2), np.eye(4))
        for name, c, u in (_half(whole, -1), _half(whole, 1))
    )
    low = -0.6 if door else -1.0
    wall = quad("wall", [(0, low, -1), (0, 1, -1), (0, 1, 1), (0, low, 1)])
    return make(left, right, (wall, np.eye(4)), lights=(point_light((1.2, 0.3, 0.5)),))


def _half(whole: Mesh, sign: int) -> tuple[str, np.ndarray, np.ndarray]:
    """The faces of the box pushed to one side of x = 0; the face in the middle is left out."""
    corners = whole.vertices[whole.triangles].copy()
    inner = (corners[..., 0] * sign < 0).all(axis=1)
    corners[..., 0] = np.where(corners[..., 0] * sign < 0, 0.0, corners[..., 0])
    return f"half{sign}", corners[~inner], whole.corner_uv[~inner]


def test_thin_wall_between_two_rooms() -> None:
    assert sides(two_rooms(door=False)) == "-FF"
    assert sides(two_rooms(door=True)) == "FF2"


def test_states_are_united() -> None:
    """The lamp moves from one room to the other; the door opens."""
    scene = two_rooms(door=False)
    first = scene.first_frame()
    front, back = lit_sides(scene, [first, replace(first, lights=(point_light((-1.2, 0, 0)),))])
    assert front.tolist() == [True, True, True] and back.tolist() == [False, False, True]
    moving = replace(scene, instances=(*scene.instances[:2], replace(scene.instances[2], moving=True)))
    matrices = first.matrix_world.copy()
    matrices[2] = translation(0, 1.5, 0)
    front, back = lit_sides(moving, [first, replace(first, matrix_world=matrices)])
    # Slid aside, the wall pokes out of the room, so that only where it is inside counts.
    assert front.tolist() == [True, True, True] and back.tolist() == [False, False, True]
    hidden = replace(first, visible=np.array([True, True, False]))
    front, back = lit_sides(moving, [first, hidden])
    assert front.tolist() == [True, True, True] and not back.any()


def test_lamp_that_is_lit_in_one_frame_of_many() -> None:
    """States that differ only in a lamp's being dark are told apart, however many there are."""
    scene = make((plane(), np.eye(4)), lights=(point_light((0, 0, 1), 0.0),))
    dark = scene.first_frame()
    lit = replace(dark, lights=(point_light((0, 0, 1), 0.1),))
    front, back = lit_sides(scene, [dark] * 77 + [lit] + [dark] * 122)
    assert front.tolist() == [True] and back.tolist() == [False]


def test_what_is_shown_for_a_moment_is_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty objects, each there in one state alone, and time to look at four states."""
    monkeypatch.setattr("rtgi_addon.backend.layout.sides.MOST_RAYS", 1)
    monkeypatch.setattr("rtgi_addon.backend.layout.sides.LEAST_STATES", 4)
    scene = make(*((plane(), translation(3 * i, 0, 0)) for i in range(40)), world=SKY)
    states = [replace(scene.first_frame(), visible=np.arange(40) == i) for i in range(40)]
    front, back = lit_sides(scene, states)
    assert front.all() and back.all()


def test_unchanging_states_cost_nothing() -> None:
    """Only a lamp's power changes: one look is enough, and later states are read but not traced."""
    scene, _ = cornell()
    state = scene.first_frame()
    states = [replace(state, lights=(point_light((0, 0, 1.9), 1.0 + i),)) for i in range(200)]
    start = time.process_time()
    one = lit_sides(scene, states[:1])
    middle = time.process_time()
    assert np.array_equal(one, lit_sides(scene, states))
    assert time.process_time() - middle < 3 * (middle - start) + 0.1


def test_light_through_a_small_window() -> None:
    """A room whose ceiling has a hole of 0.2 m; sun through it meets the floor, the walls see it from there."""
    h, g = 2.0, 0.1
    room = six_walls(4.0, inward=True)
    ceiling = next(i for i, (m, _) in enumerate(room) if (m.vertices[:, 2] > 1.9).all())
    frame = [
        [(-h, g, h), (h, g, h), (h, h, h), (-h, h, h)],
        [(-h, -h, h), (h, -h, h), (h, -g, h), (-h, -g, h)],
        [(-h, -g, h), (-g, -g, h), (-g, g, h), (-h, g, h)],
        [(g, -g, h), (h, -g, h), (h, g, h), (g, g, h)],
    ]
    strips = [(quad("strip", f[::-1]), np.eye(4)) for f in frame]
    walls = [wall for i, wall in enumerate(room) if i != ceiling]
    found = sides(make(*walls, *strips, lights=(sun(0, 0, -1),)))
    assert found[:5] == "F" * 5
    assert found[5:] == "2222"  # the sun on the roof, the floor's light below


def test_glass_lets_light_in_and_walls_do_not() -> None:
    room = six_walls(4.0, inward=True)
    top = next(i for i, (m, _) in enumerate(room) if (m.vertices[:, 2] > 1.9).all())
    pane = replace(room[top][0], material_of_triangle=np.ones(2, np.int32))
    glazed = [(pane, np.eye(4)) if i == top else wall for i, wall in enumerate(room)]
    for options in ({"lights": (sun(0.1, 0.2, -1),)}, {"world": SKY}):
        assert all(s in "F2" for s in sides(make(*glazed, **options)))
        dark = sides(make(*room, **options))
        assert "F" not in dark and "2" not in dark


def test_lamp_without_shadow_shines_through_walls() -> None:
    lamp = replace(point_light((0, 0, 9)), casts_shadow=False)
    room = six_walls(4.0, inward=True)
    floor = next(i for i, (m, _) in enumerate(room) if (m.vertices[:, 2] < -1.9).all())
    assert sides(make(*room, lights=(lamp,)))[floor] == "F"


def test_what_receives_no_light_and_dark_lamps() -> None:
    scene = make((plane(), np.eye(4)), lights=(replace(point_light((0, 0, 1)), power=(0.0, 0.0, 0.0)),))
    assert sides(scene) == "-"
    lit = replace(scene, lights=(point_light((0, 0, 1)),))
    holdout = replace(lit, instances=(replace(lit.instances[0], receives_light=False),))
    assert sides(lit) == "F" and sides(holdout) == "-"


def test_degenerate_and_empty() -> None:
    flat = mesh_of_triangles("flat", np.zeros((2, 3, 3)), np.zeros((2, 3, 2)), [0, 0], normals=np.zeros((2, 3, 3)))
    assert sides(make((flat, np.eye(4)), (plane(), np.eye(4)), world=SKY)) == "-2"
    assert sides(make((plane(), np.diag([0.0, 0.0, 0.0, 1.0])), world=SKY)) == "-"
    assert sides(make(world=SKY)) == ""


def test_far_from_the_origin_and_at_any_scale() -> None:
    scene, _ = cornell()
    for scale, shift in ((1.0, 1e6), (1e-3, 0.0), (1e3, 0.0)):
        place = translation(shift, -shift, shift) @ np.diag([scale, scale, scale, 1.0])
        instances = tuple(replace(i, matrix_world=place @ i.matrix_world) for i in scene.instances)
        lamp = replace(scene.lights[0], matrix_world=place @ scene.lights[0].matrix_world)
        assert sides(replace(scene, instances=instances, lights=(lamp,))) == "FFFFFFF"


def test_same_answer_for_any_number_of_threads() -> None:
    scene, _ = cornell()
    answers = []
    for threads in (1, 3):
        workers = Workers(threads)
        answers.append(np.concatenate(lit_sides(scene, [scene.first_frame()], workers=workers)))
        workers.close()
    assert np.array_equal(*answers)


def test_thousand_instances_take_about_a_second() -> None:
    crate, room = box("crate", (0.1,) * 3, texels=4), box("room", (30,) * 3, texels=4, inward=True)
    places = np.random.default_rng(0).uniform(-14, 14, (1000, 3))
    instances = tuple(Instance(f"c{i}", 0, translation(*p)) for i, p in enumerate(places))
    scene = Scene((crate, room), (*instances, Instance("room", 1, np.eye(4))), (WHITE,), (point_light((0, 0, 0)),))
    start = time.process_time()
    assert sides(scene) == "F" * 1001
    assert time.process_time() - start < 4.0  # 0.5 s on a quiet core
