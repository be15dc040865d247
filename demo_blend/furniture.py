# SPDX-License-Identifier: GPL-3.0-or-later
"""Furniture of the interior. Each piece stands on z = 0 about its own origin, its front toward -y; sizes in metres."""

from __future__ import annotations

import bpy
import numpy as np
from interior_looks import paint
from kit import Colour, add_boxes, add_lathe, add_mesh

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def soften(obj: bpy.types.Object, width: float, segments: int = 3) -> bpy.types.Object:
    """Round the edges with a bevel, shaded smooth."""
    bevel = obj.modifiers.new("Bevel", "BEVEL")
    bevel.width, bevel.segments, bevel.harden_normals = width, segments, True
    obj.data.polygons.foreach_set("use_smooth", np.ones(len(obj.data.polygons), bool))
    return obj


def legs(x: float, y: float, height: float, thick: float) -> list[Box]:
    """Four square legs whose outer corners are at ±x, ±y."""
    low = [(sx * x - (thick if sx > 0 else 0), sy * y - (thick if sy > 0 else 0)) for sx in (-1, 1) for sy in (-1, 1)]
    return [((a, b, 0.0), (a + thick, b + thick, height)) for a, b in low]


def add_sofa(cloth: bpy.types.Material, wood: bpy.types.Material, accents: list[bpy.types.Material]) -> list:
    """2.1 m wide, back at y = 0.45: a frame, two seats, two back cushions, two loose ones, four feet."""
    frame = [((-1.05, -0.42, 0.12), (1.05, 0.45, 0.3)), ((-1.05, 0.25, 0.3), (1.05, 0.45, 0.8))]
    frame += [((-1.05, -0.42, 0.3), (-0.87, 0.25, 0.6)), ((0.87, -0.42, 0.3), (1.05, 0.25, 0.6))]
    seats = [((x, -0.44, 0.3), (x + 0.86, 0.24, 0.45)) for x in (-0.865, 0.005)]
    backs = [((x, 0.06, 0.46), (x + 0.84, 0.24, 0.83)) for x in (-0.855, 0.015)]
    parts = [soften(add_boxes("Sofa frame", frame, cloth), 0.04), soften(add_boxes("Sofa seats", seats, cloth), 0.05)]
    parts.append(soften(add_boxes("Sofa back cushions", backs, cloth), 0.07, 4))
    parts.append(add_boxes("Sofa feet", legs(0.98, 0.35, 0.12, 0.06), wood))
    for i, (x, tilt, material) in enumerate(zip((-0.62, 0.58), (0.35, -0.25), accents, strict=True)):
        cushion = add_boxes(f"Cushion {i + 1}", [((-0.22, -0.07, -0.21), (0.22, 0.07, 0.21))], material)
        soften(cushion, 0.065, 4)
        cushion.location, cushion.rotation_euler = (x, -0.08, 0.68), (-0.35, tilt, 0.0)
        parts.append(cushion)
    return parts


def add_chair(wood: bpy.types.Material, seat: bpy.types.Material) -> bpy.types.Object:
    """A chair as one mesh, for linked duplicates: its back is at +y."""
    boxes = legs(0.2, 0.2, 0.43, 0.035)
    boxes += [((x, 0.165, 0.43), (x + 0.035, 0.2, 0.86)) for x in (-0.2, 0.165)]
    boxes += [((-0.165, 0.17, z), (0.165, 0.19, z + 0.09)) for z in (0.76, 0.62)]
    boxes.append(((-0.21, -0.21, 0.43), (0.21, 0.165, 0.465)))
    return add_boxes("Chair", boxes, wood, seat, slots=[0] * (len(boxes) - 1) + [1])


def add_table(wood: bpy.types.Material) -> bpy.types.Object:
    top = ((-0.42, -0.65, 0.71), (0.42, 0.65, 0.745))
    return soften(add_boxes("Dining table", [top, *legs(0.38, 0.61, 0.71, 0.06)], wood), 0.006, 2)


def add_coffee_table(wood: bpy.types.Material) -> list[bpy.types.Object]:
    rim = [(0.0, 0.42), (0.43, 0.42), (0.445, 0.413), (0.45, 0.4), (0.445, 0.387), (0.43, 0.38), (0.0, 0.38)]
    top = add_lathe("Coffee table", rim, wood, around=48)
    top.data.set_sharp_from_angle(angle=0.9)
    stand = [(0.035, 0.38), (0.035, 0.05), (0.05, 0.035), (0.24, 0.02), (0.25, 0.0)]
    return [top, add_lathe("Coffee table foot", stand, wood)]


def add_shelves(wood: bpy.types.Material, width: float, heights: tuple[float, ...], depth: float) -> bpy.types.Object:
    boards = [((-width / 2, -depth, z), (width / 2, 0.0, z + 0.025)) for z in heights]
    return add_boxes("Shelves", boards, wood)


def add_books(name: str, count: int, seed: int, materials: list[bpy.types.Material]) -> bpy.types.Object:
    """A row of books along +x from the origin, one mesh."""
    random = np.random.default_rng(seed)
    thick, tall = random.uniform(0.018, 0.045, count), random.uniform(0.19, 0.27, count)
    deep, start = random.uniform(0.13, 0.17, count), np.concatenate([[0], np.cumsum(thick + 0.0015)[:-1]])
    boxes = [((x, -d, 0.0), (x + w, 0.0, h)) for x, w, h, d in zip(start, thick, tall, deep, strict=True)]
    return add_boxes(name, boxes, *materials, slots=random.integers(0, len(materials), count))


def add_plant(leaf: bpy.types.Material, pot: bpy.types.Material, earth: bpy.types.Material) -> list[bpy.types.Object]:
    """A pot with thin, arching leaves in a rosette: each leaf is a bent strip that tapers."""
    bowl = [(0.16, 0.34), (0.175, 0.33), (0.17, 0.25), (0.13, 0.02), (0.12, 0.0), (0.0, 0.0)]
    parts = [add_lathe("Plant pot", bowl, pot), add_lathe("Earth", [(0.0, 0.305), (0.165, 0.3)], earth)]
    t = np.linspace(0, 1, 8)
    vertices, faces, count = [], [], 22
    for i in range(count):
        turn, lean = i * 2.399963, 0.25 + 0.75 * (i / count)  # the golden angle
        reach, rise = 0.55 * lean * t**1.3, 0.30 + (0.95 - 0.45 * lean) * t - 0.5 * lean * t**2.5
        half = 0.038 * np.sin(np.pi * (0.12 + 0.88 * t)) + 0.002
        along, across = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
        spine = (0.02 + reach)[:, None] * along + rise[:, None] * (0, 0, 1)
        strip = np.stack([spine - half[:, None] * across, spine + half[:, None] * across], 1).reshape(-1, 3)
        base = np.arange(7)[:, None] * 2 + 16 * i
        vertices.append(strip)
        faces.append(base + [0, 2, 3, 1])
    parts.append(add_mesh("Leaves", np.concatenate(vertices), np.concatenate(faces), leaf, smooth=True))
    return parts


def add_curtain(name: str, y0: float, y1: float, cloth: bpy.types.Material) -> bpy.types.Object:
    """A hanging cloth from y0 to y1 in the plane x = 0, in waves, a little wider at the hem; it has no thickness."""
    along, down = np.linspace(0, 1, 65), np.linspace(0, 1, 7)
    u, v = np.meshgrid(along, down, indexing="ij")
    x = (0.025 + 0.02 * v) * np.sin(2 * np.pi * 6 * u + 0.6 * v)
    y = y0 + (y1 - y0) * (u + (u - 0.5) * 0.08 * v)
    vertices = np.stack([x, y, 2.5 - 2.46 * v], -1).reshape(-1, 3)
    a = (np.arange(64)[:, None] * 7 + np.arange(6)).ravel()
    return add_mesh(name, vertices, np.stack([a, a + 1, a + 8, a + 7], -1), cloth, smooth=True)


def add_rod(name: str, start: tuple, end: tuple, radius: float, material: bpy.types.Material) -> bpy.types.Object:
    """A rod or cable: a curve with a round bevel, not a mesh."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution, curve.use_fill_caps = "3D", radius, 2, True
    spline = curve.splines.new("POLY")
    spline.points.add(1)
    for point, at in zip(spline.points, (start, end), strict=True):
        point.co = (*at, 1.0)
    curve.materials.append(material)
    obj = bpy.data.objects.new(name, curve)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def add_shade(name: str, top: float, bottom: float, height: float, cloth: bpy.types.Material) -> bpy.types.Object:
    """A lamp shade, open above and below, its lower rim at z = 0: a cone with the given radii, 3 mm thick."""
    shade = add_lathe(name, [(top, height), (bottom, 0.0)], cloth, around=40)
    shade.modifiers.new("Solidify", "SOLIDIFY").thickness = 0.003
    return shade


def book_cloths() -> list[bpy.types.Material]:
    colours: dict[str, Colour] = {
        "Book red": (0.45, 0.08, 0.06),
        "Book blue": (0.07, 0.16, 0.33),
        "Book green": (0.1, 0.25, 0.13),
        "Book cream": (0.7, 0.62, 0.45),
        "Book ochre": (0.6, 0.36, 0.09),
    }
    return [paint(name, colour) for name, colour in colours.items()]
