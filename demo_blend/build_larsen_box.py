# SPDX-License-Identifier: GPL-3.0-or-later
"""larsen_box.blend: the box with a bumpy floor of Larsen04 Figure 1, 13,000 polygons in 16 surfaces.

A closed room of six surfaces and two blocks of five, each surface in a colour of its own. The RTGI layers are made
here, "by hand using a 3D modelling tool" as in the paper's §3, so that a bake has the paper's 16 surfaces and no more.
"""

from __future__ import annotations

from colorsys import hsv_to_rgb

import bpy
import numpy as np
from kit import (
    add_camera,
    add_mesh,
    add_point_light,
    add_quad,
    add_rtgi_layer,
    box_arrays,
    diffuse,
    new_scene,
    place,
    save,
)

SIDE, HEIGHT = 4.0, 3.0  # m
ROWS, COLUMNS = 81, 80  # of floor squares, two triangles each: 12,960
SURFACES = 16
BUMP = 0.2  # m, largest height of the floor


def build() -> None:
    new_scene(size=(640, 480))
    colours = [hsv_to_rgb(i / SURFACES, 0.72, 0.75) for i in range(SURFACES)]
    materials = [diffuse(f"Surface {i + 1:02d}", colour) for i, colour in enumerate(colours)]
    # Neighbours in the room are far apart on the colour wheel.
    add_floor(materials[2])
    add_room([materials[i] for i in (9, 0, 6, 13, 4)])
    place(add_block("Tall block", 0.95, 2.05, [materials[i] for i in (1, 7, 12, 5, 10)]), (-0.8, 0.85, -0.3), turn=20)
    place(add_block("Short block", 0.9, 1.0, [materials[i] for i in (3, 8, 14, 11, 15)]), (0.75, 0.15, -0.3), turn=-18)
    add_point_light("Lamp", (1.1, 1.1, 2.55), 62.0)
    add_camera((0.0, -1.93, 2.0), (0.0, 0.6, 0.95), lens=17.0)


def add_floor(material: bpy.types.Material) -> None:
    """A fractal floor: octaves of smoothed random heights, each half as high and twice as fine as the one before."""
    height = np.zeros((ROWS + 1, COLUMNS + 1))
    random = np.random.default_rng(2004)
    for octave in range(5):
        height += noise(random.uniform(-1, 1, (4 * 2**octave + 1,) * 2), height.shape) / 2**octave
    height = np.round(height * BUMP / np.abs(height).max() * 256) / 256  # in steps of 4 mm: a smaller file
    v, u = np.meshgrid(np.linspace(0, 1, ROWS + 1), np.linspace(0, 1, COLUMNS + 1), indexing="ij")
    vertices = np.stack([(u - 0.5) * SIDE, (v - 0.5) * SIDE, height], -1).reshape(-1, 3)
    a = (np.arange(ROWS)[:, None] * (COLUMNS + 1) + np.arange(COLUMNS)).ravel()
    b, c, d = a + 1, a + COLUMNS + 2, a + COLUMNS + 1
    squares = np.stack([a, b, c, d], -1)
    floor = add_mesh("Floor", vertices, squares, material, smooth=True)
    floor.modifiers.new(
        "Triangulate", "TRIANGULATE"
    ).quad_method = "FIXED"  # here, not in the file, which it would double
    add_rtgi_layer(floor, np.stack([u, v], -1).reshape(-1, 2)[squares.ravel()])


def noise(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A grid of values as a smooth field of ``shape``: interpolated by smoothsteps."""
    for axis, count in enumerate(shape):
        at = np.linspace(0, values.shape[axis] - 1, count)
        cell = np.minimum(at.astype(int), values.shape[axis] - 2)
        t = at - cell
        t = (t * t * (3 - 2 * t)).reshape([-1, 1] if axis == 0 else [1, -1])
        values = np.take(values, cell, axis) * (1 - t) + np.take(values, cell + 1, axis) * t
    return values


def add_room(materials: list[bpy.types.Material]) -> None:
    """The ceiling and four walls, facing inward. The walls begin below the floor's deepest dent."""
    h, low, top = SIDE / 2, -BUMP - 0.01, HEIGHT
    quads = {
        "Ceiling": [(-h, h, top), (h, h, top), (h, -h, top), (-h, -h, top)],
        "Back wall": [(-h, h, low), (h, h, low), (h, h, top), (-h, h, top)],
        "Front wall": [(h, -h, low), (-h, -h, low), (-h, -h, top), (h, -h, top)],
        "Left wall": [(-h, -h, low), (-h, h, low), (-h, h, top), (-h, -h, top)],
        "Right wall": [(h, h, low), (h, -h, low), (h, -h, top), (h, h, top)],
    }
    for (name, corners), material in zip(quads.items(), materials, strict=True):
        wall = add_quad(name, corners, material)
        wide, high = (SIDE, SIDE if name == "Ceiling" else top - low)
        add_rtgi_layer(wall, np.array([(0, 0), (wide, 0), (wide, high), (0, high)]) / SIDE)


def add_block(name: str, width: float, height: float, materials: list[bpy.types.Material]) -> bpy.types.Object:
    """A block without a bottom, one material for each side; its foot stands in the floor."""
    corners, faces = box_arrays((-width / 2, -width / 2, 0), (width / 2, width / 2, height))
    block = add_mesh(name, corners, np.delete(faces, 4, 0), *materials, slots=range(5))
    add_rtgi_layer(block, np.concatenate(block_layer(block, width, height)))
    return block


def block_layer(block: bpy.types.Object, width: float, height: float) -> list[np.ndarray]:
    """Each side in a cell of its own, all to one scale: four sides in a row, the top above the first."""
    gap, total = 0.05 * width, 4 * width + 5 * 0.05 * width
    cells = []
    for i, polygon in enumerate(block.data.polygons):
        points = np.array([block.data.vertices[v].co for v in polygon.vertices])
        flat = points[:, :2] if i == 4 else np.stack([points[:, 1 if i < 2 else 0], points[:, 2]], -1)
        corner = (gap, height + 2 * gap) if i == 4 else (gap + i * (width + gap), gap)
        cells.append((flat - flat.min(0) + corner) / total)
    return cells


if __name__ == "__main__":
    build()
    save(__file__)
