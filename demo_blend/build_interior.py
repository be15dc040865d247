# SPDX-License-Identifier: GPL-3.0-or-later
"""interior.blend: a living room by day. Sun and sky through one window, a television, two lamps, textured materials,
modifiers, curves, thin cloth and four chairs that share one mesh. All of it scatters diffusely.
"""

from __future__ import annotations

from math import radians

import bpy
import numpy as np
from furniture import (
    add_books,
    add_chair,
    add_coffee_table,
    add_curtain,
    add_plant,
    add_rod,
    add_shade,
    add_shelves,
    add_sofa,
    add_table,
    book_cloths,
    soften,
)
from interior_looks import (
    broadcast_pixels,
    landscape_pixels,
    paint,
    picture,
    planks,
    rug_pixels,
    screen,
    set_sky,
    sky_pixels,
)
from kit import (
    add_ball,
    add_boxes,
    add_camera,
    add_lathe,
    add_mesh,
    add_point_light,
    add_quad,
    new_scene,
    place,
    save,
)
from mathutils import Vector

X, Y, Z = 5.6, 4.4, 2.7  # the room, m; the window is in the wall x = 0
WINDOW = (1.0, 3.3, 0.75, 2.35)  # y from, to; z from, to
REVEAL = 0.18  # depth of the window's reveal, m
SUN_TRAVELS = (0.8, 0.3, -0.58)


def build() -> None:
    scene = new_scene(size=(960, 540))
    scene.view_settings.exposure = 0.7
    scene.view_settings.look = "AgX - Base Contrast"
    set_sky(scene.world, sky_pixels())
    wood, dark = paint("Oak", (0.46, 0.29, 0.15)), paint("Walnut", (0.16, 0.085, 0.045))
    white, black = paint("White paint", (0.78, 0.77, 0.74)), paint("Black lacquer", (0.02, 0.02, 0.022))
    add_room(white)
    add_window(white, black)
    add_living(wood, dark)
    add_dining(wood, dark)
    add_television(dark, black, white)
    add_lamps(black)
    add_sun()
    add_camera((4.75, 0.15, 1.5), (2.15, 4.4, 0.92), lens=20.0)


def add_room(white: bpy.types.Material) -> None:
    """Floor, ceiling and three walls facing inward, and skirting boards; the window's wall is made with the window."""
    sage = paint("Sage paint", (0.50, 0.56, 0.47))
    floor = planks("Floor boards", (0.62, 0.42, 0.24), (0.46, 0.29, 0.15))
    add_quad("Floor", [(0, 0, 0), (X, 0, 0), (X, Y, 0), (0, Y, 0)], floor)
    add_quad("Ceiling", [(0, Y, Z), (X, Y, Z), (X, 0, Z), (0, 0, Z)], white)
    add_quad("Back wall", [(0, Y, 0), (X, Y, 0), (X, Y, Z), (0, Y, Z)], sage)
    add_quad("Right wall", [(X, Y, 0), (X, 0, 0), (X, 0, Z), (X, Y, Z)], white)
    add_quad("Front wall", [(X, 0, 0), (0, 0, 0), (0, 0, Z), (X, 0, Z)], white)
    thick, high = 0.015, 0.09
    boards = [((0, 0, 0), (thick, Y, high)), ((X - thick, 0, 0), (X, Y, high))]
    boards += [((0, 0, 0), (X, thick, high)), ((0, Y - thick, 0), (X, Y, high))]
    add_boxes("Skirting boards", boards, white)


def add_window(white: bpy.types.Material, black: bpy.types.Material) -> None:
    """The wall with its opening and reveal, a frame of bars, a sill, curtains on a rod. No glass."""
    y0, y1, z0, z1 = WINDOW
    outer, inner = [(0, 0), (Y, 0), (Y, Z), (0, Z)], [(y0, z0), (y1, z0), (y1, z1), (y0, z1)]
    rings = [[(0, *p) for p in outer], [(0, *p) for p in inner], [(-REVEAL, *p) for p in inner]]
    faces = [(a + i, a + (i + 1) % 4, b + (i + 1) % 4, b + i) for a, b in ((0, 4), (4, 8)) for i in range(4)]
    add_mesh("Window wall", np.concatenate(rings), faces, white)
    x, w = -REVEAL + 0.04, 0.05
    # No two faces in one plane: Cycles lets them shadow one another. Everything goes a little into what it touches.
    a, b = 0.004, 0.003
    bars = [((x, y - a, z0 - a), (x + w, y + w + a, z1 + a)) for y in (y0, (y0 + y1 - w) / 2, y1 - w)]
    bars += [((x + b, y0 - b, z - b), (x + w - b, y1 + b, z + w + b)) for z in (z0, z1 - w - 0.42, z1 - w)]
    add_boxes("Window frame", bars, white)
    sill = ((-0.12, y0 - 0.06, z0 - 0.03), (0.08, y1 + 0.06, z0 + a))
    soften(add_boxes("Window sill", [sill], white), 0.008, 2)
    linen = paint("Linen", (0.68, 0.63, 0.55))
    for name, a, b in (("Curtain left", 0.42, 0.98), ("Curtain right", 3.32, 3.88)):
        place(add_curtain(name, a, b, linen), (0.11, 0, 0))
    add_rod("Curtain rod", (0.11, 0.3, 2.52), (0.11, 4.0, 2.52), 0.012, black)


def add_living(wood: bpy.types.Material, dark: bpy.types.Material) -> None:
    """Sofa and painting at the back wall, rug and coffee table before them, a plant in the corner."""
    accents = [paint("Mustard cloth", (0.66, 0.40, 0.07)), paint("Rose cloth", (0.60, 0.27, 0.22))]
    put(add_sofa(paint("Teal cloth", (0.06, 0.20, 0.22)), dark, accents), (2.3, 3.92, 0))
    add_panel("Painting", (1.35, 0.9), picture("Painting", landscape_pixels()), (2.3, Y - 0.03, 1.6))
    add_frame("Picture frame", (1.35, 0.9), dark, (2.3, Y, 1.6))
    rug = add_panel("Rug", (2.6, 1.8), picture("Rug", rug_pixels()), (2.35, 2.65, 0.012))
    rug.rotation_euler.x = 0.0
    put(add_coffee_table(wood), (2.35, 2.65, 0.012))
    clay, celadon = paint("Clay", (0.55, 0.24, 0.13)), paint("Celadon", (0.38, 0.55, 0.47))
    vase = [(0.045, 0.3), (0.035, 0.27), (0.035, 0.22), (0.075, 0.15), (0.09, 0.09), (0.075, 0.03), (0.05, 0), (0, 0)]
    place(add_lathe("Vase", vase, celadon), (2.2, 2.78, 0.432))
    place(add_ball("Ball", 0.09, paint("Coral", (0.75, 0.16, 0.09))), (2.52, 2.56, 0.522))
    pouf = [(0, 0.38), (0.2, 0.375), (0.29, 0.34), (0.34, 0.24), (0.34, 0.14), (0.29, 0.04), (0.22, 0.0), (0, 0)]
    place(add_lathe("Pouf", pouf, paint("Ochre cloth", (0.62, 0.38, 0.16)), around=40), (3.75, 2.75, 0))
    leaf, earth = paint("Leaf", (0.10, 0.26, 0.07)), paint("Earth", (0.06, 0.04, 0.03))
    put(add_plant(leaf, clay, earth), (0.55, 3.85, 0))


def add_dining(wood: bpy.types.Material, dark: bpy.types.Material) -> None:
    """A table by the window and four chairs that share one mesh; a bowl with fruit."""
    at = (1.2, 1.75)
    place(add_table(wood), (*at, 0))
    chair = add_chair(dark, paint("Seat", (0.66, 0.60, 0.49)))
    for i, (dx, dy, turn) in enumerate(((-0.52, -0.3, 90), (-0.5, 0.32, 84), (0.56, -0.3, -90), (0.66, 0.34, -112))):
        twin = chair if i == 0 else bpy.data.objects.new(f"Chair {i + 1}", chair.data)
        if i:
            bpy.context.scene.collection.objects.link(twin)
        place(twin, (at[0] + dx, at[1] + dy, 0), turn=turn)
    bowl = [(0.15, 0.08), (0.155, 0.075), (0.12, 0.025), (0.06, 0), (0, 0)]
    place(add_lathe("Bowl", bowl, paint("Bowl glaze", (0.7, 0.7, 0.68))), (at[0], at[1] - 0.05, 0.745))
    orange = paint("Orange", (0.80, 0.30, 0.03))
    for i, (x, y, z) in enumerate(((-0.05, -0.02, 0.055), (0.05, -0.03, 0.058), (0.0, 0.05, 0.056), (0.0, 0.0, 0.115))):
        place(add_ball(f"Orange {i + 1}", 0.045, orange, around=20), (at[0] + x, at[1] - 0.05 + y, 0.745 + z))


def add_television(dark: bpy.types.Material, black: bpy.types.Material, white: bpy.types.Material) -> None:
    """A low cabinet with a television on it, and two shelves of books above."""
    body = [((-0.8, -0.4, 0.12), (0.8, 0, 0.45))]
    doors = [((x + 0.008, -0.412, 0.14), (x + 0.525, -0.4, 0.43)) for x in (-0.8, -0.267, 0.267)]
    feet = [((x, y, 0), (x + 0.04, y + 0.04, 0.12)) for x in (-0.76, 0.72) for y in (-0.36, -0.06)]
    cabinet = add_boxes("Cabinet", [*body, *feet, *doors], dark, white, slots=[0] * 5 + [1] * 3)
    case = [((-0.6, -0.2, 0.51), (0.6, -0.16, 1.2)), ((-0.2, -0.28, 0.45), (0.2, -0.1, 0.465))]
    case.append(((-0.04, -0.19, 0.46), (0.04, -0.165, 0.52)))
    television = add_boxes("Television", case, black)
    shelves = add_shelves(dark, 1.4, (1.55, 1.93), 0.22)
    put([cabinet, television, shelves], (4.45, Y, 0))
    add_panel("Screen", (1.16, 0.6525), screen("Screen", broadcast_pixels(), 3.0), (4.45, Y - 0.202, 0.857))
    cloths = book_cloths()
    for name, count, seed, x, z in (
        ("Books low", 17, 3, 3.85, 1.575),
        ("Books high", 13, 5, 4.5, 1.955),
        ("Books few", 5, 8, 4.85, 1.575),
    ):
        place(add_books(name, count, seed, cloths), (x, Y - 0.02, z))
    jug = [(0.03, 0.2), (0.028, 0.15), (0.06, 0.1), (0.065, 0.05), (0.05, 0.0), (0.0, 0.0)]
    place(add_lathe("Jug", jug, white), (4.1, Y - 0.12, 1.955))


def add_lamps(black: bpy.types.Material) -> None:
    """A pendant over the table and a floor lamp beside the sofa, each a warm point light in an open shade."""
    paper, warm = paint("Paper", (0.80, 0.74, 0.62)), (1.0, 0.72, 0.42)
    place(add_shade("Pendant shade", 0.08, 0.24, 0.2, black), (1.2, 1.75, 1.62))
    add_rod("Pendant cable", (1.2, 1.75, 1.8), (1.2, 1.75, Z), 0.004, black)
    add_point_light("Pendant lamp", (1.2, 1.75, 1.7), 10.0, colour=warm, radius=0.03)
    base = [(0, 1.45), (0.012, 1.445), (0.012, 0.03), (0.03, 0.022), (0.14, 0.018), (0.15, 0.0), (0, 0)]
    place(add_lathe("Floor lamp", base, black), (3.52, 4.08, 0))
    place(add_shade("Floor lamp shade", 0.14, 0.2, 0.27, paper), (3.52, 4.08, 1.36))
    add_point_light("Floor lamp bulb", (3.52, 4.08, 1.52), 12.0, colour=warm, radius=0.03)


def add_sun() -> None:
    sun = bpy.data.lights.new("Sun", "SUN")
    sun.energy, sun.color, sun.angle = 14.0, (1.0, 0.9, 0.76), radians(1.0)
    obj = bpy.data.objects.new("Sun", sun)
    obj.rotation_euler = Vector(SUN_TRAVELS).to_track_quat("-Z", "Y").to_euler()
    obj.location = (-3.0, 0.5, 4.0)
    bpy.context.scene.collection.objects.link(obj)


def add_panel(
    name: str, size: tuple[float, float], material: bpy.types.Material, centre: tuple[float, float, float]
) -> bpy.types.Object:
    """An upright picture facing -y, with a UV map that lays an image over it once."""
    w, h = size[0] / 2, size[1] / 2
    panel = add_mesh(name, [(-w, -h, 0), (w, -h, 0), (w, h, 0), (-w, h, 0)], [(0, 1, 2, 3)], material)
    panel.data.uv_layers.new(name="UVMap").uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    panel.location, panel.rotation_euler = centre, (radians(90), 0, 0)
    return panel


def add_frame(
    name: str, size: tuple[float, float], material: bpy.types.Material, centre: tuple[float, float, float]
) -> None:
    """Four bars around a picture of ``size`` on the wall behind it."""
    w, h, bar, deep = size[0] / 2, size[1] / 2, 0.035, 0.045
    bars = [((-w - bar, -deep, z), (w + bar, 0, z + bar)) for z in (-h - bar, h)]
    bars += [((x, -deep, -h), (x + bar, 0, h)) for x in (-w - bar, w)]
    place(add_boxes(name, bars, material), centre)


def put(parts: list[bpy.types.Object], at: tuple[float, float, float]) -> None:
    """Move all parts of a piece of furniture by ``at``."""
    for part in parts:
        part.location += Vector(at)


if __name__ == "__main__":
    build()
    save(__file__)
