# SPDX-License-Identifier: GPL-3.0-or-later
"""two_rooms.blend: Larsen04 Figure 5. Two closed rooms with two lamps each; the wall between them slides away, then
the right room's lamps go out and it is lit by what the left room sends.

The camera stands in front and its near clipping plane takes the front wall off, so the rooms stay closed for the light.
"""

from __future__ import annotations

import bpy
import numpy as np
from kit import (
    FRAMES,
    add_ball,
    add_boxes,
    add_camera,
    add_mesh,
    add_point_light,
    add_quad,
    diffuse,
    new_scene,
    place,
    save,
)

WIDTH, DEPTH, HEIGHT = 3.6, 3.6, 2.6  # of each room, m
WALL = 0.12  # thickness of the sliding wall, m
OPENING, DARKENING = (6, 14), (17, 20)  # first and last frame
WATTS = 34.0


def build() -> None:
    new_scene(size=(960, 400), frame_end=FRAMES)
    white, oak = diffuse("Plaster", (0.72, 0.71, 0.69)), diffuse("Oak", (0.42, 0.27, 0.14))
    left, right = -WIDTH - WALL / 2, WIDTH + WALL / 2
    add_shell("Left", left, -WALL / 2, diffuse("Ochre", (0.74, 0.42, 0.12)), white, outer="west")
    add_shell("Right", WALL / 2, right, diffuse("Blue", (0.12, 0.3, 0.58)), white, outer="east")
    add_frame(white)
    slide(add_sliding_wall(diffuse("Wall", (0.6, 0.6, 0.57))))
    add_furniture(left / 2, right / 2, oak)
    for name, x, y in (("Left lamp 1", -2.6, 0.5), ("Left lamp 2", -1.1, -0.5)):
        add_point_light(name, (x, y, 2.25), WATTS, colour=(1.0, 0.88, 0.72))
    for name, x, y in (("Right lamp 1", 1.1, 0.5), ("Right lamp 2", 2.6, -0.5)):
        go_out(add_point_light(name, (x, y, 2.25), WATTS, colour=(0.86, 0.93, 1.0)))
    add_camera((0.0, -8.6, 1.75), (0.0, 0.0, 1.28), lens=35.0, clip_start=8.6 - DEPTH / 2 + 0.25)


def add_shell(
    name: str, x0: float, x1: float, accent: bpy.types.Material, white: bpy.types.Material, *, outer: str
) -> None:
    """Floor, ceiling and three walls from x0 to x1, facing inward; the wall between the rooms is not one of them."""
    y0, y1, z1 = -DEPTH / 2, DEPTH / 2, HEIGHT
    add_quad(f"{name} floor", [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)], white)
    add_quad(f"{name} ceiling", [(x0, y1, z1), (x1, y1, z1), (x1, y0, z1), (x0, y0, z1)], white)
    add_quad(f"{name} back wall", [(x0, y1, 0), (x1, y1, 0), (x1, y1, z1), (x0, y1, z1)], white)
    add_quad(f"{name} front wall", [(x1, y0, 0), (x0, y0, 0), (x0, y0, z1), (x1, y0, z1)], white)
    side = {
        "west": [(x0, y0, 0), (x0, y1, 0), (x0, y1, z1), (x0, y0, z1)],
        "east": [(x1, y1, 0), (x1, y0, 0), (x1, y0, z1), (x1, y1, z1)],
    }
    add_quad(f"{name} {outer} wall", side[outer], accent)


def add_frame(material: bpy.types.Material) -> None:
    """What the sliding wall runs in: closes the gap between the rooms above, below, in front and behind."""
    x, y, z = WALL / 2, DEPTH / 2, HEIGHT
    quads = [
        [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)],
        [(-x, y, z), (x, y, z), (x, -y, z), (-x, -y, z)],
        [(x, -y, 0), (-x, -y, 0), (-x, -y, z), (x, -y, z)],
        [(-x, y, 0), (x, y, 0), (x, y, z), (-x, y, z)],
    ]
    add_mesh("Frame", np.concatenate(quads), np.arange(16).reshape(4, 4), material)


def add_sliding_wall(material: bpy.types.Material) -> bpy.types.Object:
    """A little larger than the opening on every side, so that no light passes while it is shut."""
    x, y, over = WALL / 2 - 0.01, DEPTH / 2, 0.05
    return add_boxes("Sliding wall", [((-x, -y - over, -over), (x, y + over, HEIGHT + over))], material)


def slide(wall: bpy.types.Object) -> None:
    """Backward, out of the rooms, until a post of 20 cm is left."""
    for frame, y in zip(OPENING, (0.0, DEPTH - 0.2), strict=True):
        wall.location.y = y
        wall.keyframe_insert("location", index=1, frame=frame)


def go_out(lamp: bpy.types.Object) -> None:
    for frame, watts in zip(DARKENING, (WATTS, 0.0), strict=True):
        lamp.data.energy = watts
        lamp.data.keyframe_insert("energy", frame=frame)


def add_furniture(left: float, right: float, oak: bpy.types.Material) -> None:
    """In the left room a table; in the right a pedestal with a ball and a bench."""
    top, legs = ((-0.7, -0.4, 0.68), (0.7, 0.4, 0.74)), []
    for x in (-0.64, 0.56):
        legs += [((x, y, 0), (x + 0.08, y + 0.08, 0.68)) for y in (-0.36, 0.28)]
    place(add_boxes("Table", [top, *legs], oak), (left, 0.35, 0), turn=12)
    place(add_boxes("Chest", [((-0.45, -0.28, 0), (0.45, 0.28, 0.55))], oak), (left - 0.9, -0.75, 0), turn=-30)
    place(add_boxes("Pedestal", [((-0.25, -0.25, 0), (0.25, 0.25, 0.8))], oak), (right + 0.35, 0.4, 0), turn=25)
    bench = [((-0.65, -0.2, 0.38), (0.65, 0.2, 0.45)), ((-0.55, -0.18, 0), (-0.45, 0.18, 0.38))]
    bench.append(((0.45, -0.18, 0), (0.55, 0.18, 0.38)))
    place(add_boxes("Bench", bench, oak), (right - 0.7, -0.65, 0), turn=-15)
    place(add_ball("Ball", 0.3, diffuse("Chalk", (0.8, 0.79, 0.77))), (right + 0.35, 0.4, 1.1))


if __name__ == "__main__":
    build()
    save(__file__)
