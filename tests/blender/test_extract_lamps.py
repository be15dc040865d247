# SPDX-License-Identifier: GPL-3.0-or-later
"""A lamp has one place among the lights of all frames, whichever others come and go: its samples hang on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import bpy
import pytest

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.scene import BLACK, FrameState
from rtgi_addon.extract import extract_source, frame_state
from rtgi_addon.frames import FrameStates, telling_states
from rtgi_addon.source import SourceScene

AddObject = Callable[..., bpy.types.Object]
FRAMES = (1, 2, 3, 4)


def silent(*_args: object) -> None:
    pass


@pytest.fixture(autouse=True)
def floor(add_plane: AddObject) -> bpy.types.Object:
    return add_plane("Floor")


def at(source: SourceScene, frame: int) -> FrameState:
    bpy.context.scene.frame_set(frame)
    return frame_state(source, frame)


def add_lamp(name: str, x: float, *, energy: float = 10.0, collection: bpy.types.Collection | None = None):
    data = bpy.data.lights.new(name, "POINT")
    data.energy = energy
    lamp = bpy.data.objects.new(name, data)
    lamp.location.x = x
    (collection or bpy.context.scene.collection).objects.link(lamp)
    return lamp


def animate(owner: object, path: str, values: dict[int, object]) -> None:
    for frame, value in values.items():
        setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)


def lit(state: FrameState) -> dict[str, tuple[float, float]]:
    """By name: power and x of the lamps that shine."""
    return {
        light.name: (light.power[0], float(light.matrix_world[0, 3])) for light in state.lights if max(light.power) > 0
    }


def places(states: list[FrameState]) -> list[str]:
    """Names of the lights, which are the same in each state."""
    names = [[light.name for light in state.lights] for state in states]
    assert all(row == names[0] for row in names)
    return names[0]


def test_a_lamp_that_is_hidden_leaves_the_others_where_they_are() -> None:
    first, second, third = (add_lamp(name, x) for name, x in (("A", 1.0), ("B", 2.0), ("C", 3.0)))
    animate(first, "hide_render", {1: True, 3: False, 4: True})
    animate(second, "hide_render", {1: False, 2: True, 4: False})
    source = extract_source(FRAMES, silent)
    states = [at(source, frame) for frame in FRAMES]
    assert places(states) == ["B", "C", "A"]  # as they first appear
    assert [sorted(lit(state)) for state in states] == [["B", "C"], ["C"], ["A", "C"], ["B", "C"]]
    assert [light.name for light in source.lights] == ["B", "C", "A"]
    assert lit(states[0]) == {light.name: (10.0, light.matrix_world[0, 3]) for light in source.lights[:2]}
    assert source.lights[2].power == BLACK and source.lights[2].matrix_world[0, 3] == pytest.approx(1.0)
    assert source.lamp_frames == ((1, 4), FRAMES, (3,))
    assert third.name == "C"


def test_one_that_is_not_there_is_as_it_was_first_met_but_dark() -> None:
    lamp = add_lamp("A", 1.0)
    lamp.data.shadow_soft_size = 0.3
    animate(lamp, "hide_render", {1: True, 2: False, 4: True})
    lamp.location.x = 5.0
    lamp.keyframe_insert("location", index=0, frame=2)
    lamp.location.x = 7.0
    lamp.keyframe_insert("location", index=0, frame=3)
    source = extract_source(FRAMES, silent)
    there = at(source, 2).lights
    for frame in (1, 4):
        (light,) = at(source, frame).lights
        assert (light.power, light.radius, light.matrix_world[0, 3]) == (BLACK, there[0].radius, 5.0)
    assert at(source, 3).lights[0].matrix_world[0, 3] == pytest.approx(7.0)
    assert at(source, 4).lights[0].matrix_world.tobytes() == there[0].matrix_world.tobytes()  # whatever came before


def test_energy_to_nothing_and_back() -> None:
    dimmed = add_lamp("A", 1.0)
    add_lamp("B", 2.0, energy=5.0)
    animate(dimmed.data, "energy", {1: 10.0, 2: 0.0, 3: 0.0, 4: 20.0})
    source = extract_source(FRAMES, silent)
    states = [at(source, frame) for frame in FRAMES]
    assert places(states) == ["A", "B"]
    assert [state.lights[0].power[0] for state in states] == pytest.approx([10, 0, 0, 20])
    assert all(state.lights[1].power[0] == pytest.approx(5) for state in states)
    assert source.lamp_frames == (FRAMES, FRAMES)


def test_instanced_lamps_that_vanish(add_plane: AddObject) -> None:
    """Three carts with a lamp each; the first leaves, then the lamp in all of them."""
    group = bpy.data.collections.new("Cart")
    carried = add_lamp("Bulb", 0.5, collection=group)
    carts = []
    for x in (1.0, 2.0, 3.0):
        cart = bpy.data.objects.new("Cart", None)
        cart.instance_type, cart.instance_collection, cart.location.x = "COLLECTION", group, x
        bpy.context.scene.collection.objects.link(cart)
        carts.append(cart)
    animate(carts[0], "hide_render", {1: False, 2: True})
    animate(carried, "hide_render", {1: False, 3: True, 4: False})
    source = extract_source(FRAMES, silent)
    states = [at(source, frame) for frame in FRAMES]
    names = places(states)
    assert len(set(names)) == 3 == len(source.lights)
    shining = [sorted(x for _, x in lit(state).values()) for state in states]
    assert shining == [[1.5, 2.5, 3.5], [2.5, 3.5], [], [2.5, 3.5]]
    assert {name: lit(states[0])[name] for name in lit(states[1])} == lit(states[1])  # the same names, places and all


def test_instances_of_one_object_that_share_a_name(add_plane: AddObject) -> None:
    """A lamp on each vertex of a mesh: one name, several lamps, told apart in every frame."""
    lamp, carrier = add_lamp("Bulb", 0.0), add_plane("Carrier")
    lamp.parent, carrier.instance_type = carrier, "VERTS"
    carrier.hide_render = True
    animate(carrier, "show_instancer_for_render", {1: True})
    animate(carrier, "hide_render", {1: False, 3: True, 4: False})
    source = extract_source(FRAMES, silent)
    states = [at(source, frame) for frame in FRAMES]
    names = places(states)
    assert len(set(names)) == len(names) >= 4
    shining = [lit(state) for state in states]
    assert shining[0] == shining[1] == shining[3] and len(shining[0]) >= 4
    assert set(shining[2]) < set(shining[0])


def test_any_order_of_frames_gives_the_same_lights() -> None:
    for name, frames in (("A", {1: True, 2: False, 3: True}), ("B", {1: False, 3: True, 4: False})):
        animate(add_lamp(name, 1.0), "hide_render", frames)
    source = extract_source(FRAMES, silent)
    forth = {frame: at(source, frame).lights for frame in FRAMES}
    back = {frame: at(source, frame).lights for frame in reversed(FRAMES)}
    for frame in FRAMES:
        for one, other in zip(forth[frame], back[frame], strict=True):
            assert replace(one, matrix_world=None) == replace(other, matrix_world=None)
            assert one.matrix_world.tobytes() == other.matrix_world.tobytes()


def test_a_lamp_that_the_bake_was_not_told_of_is_refused() -> None:
    animate(add_lamp("Late", 1.0), "hide_render", {1: True, 4: False})
    source = extract_source((1, 2), silent)
    assert source.lights == () and not source.lit
    with pytest.raises(BakeError, match="Late: appears in frame 4"):
        at(source, 4)


def test_sides_are_searched_when_a_lamp_appears() -> None:
    frames = tuple(range(1, 41))
    animate(add_lamp("Late", 1.0), "hide_render", {1: True, 22: False, 23: True})
    source = extract_source(frames, silent)
    assert source.lit
    told = [state.frame for state in telling_states(FrameStates(source, frames, None), silent)]
    assert 22 in told and len(told) == 9
