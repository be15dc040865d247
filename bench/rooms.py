# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes made of arrays for the bench of animation: what tests/backend/scenes.py has not. No Blender is needed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtgi_addon.backend.scene import Atlas, Float64, Instance, Mesh, Scene
from tests.backend.scenes import (
    GREEN,
    RED,
    WHITE,
    box,
    cornell,
    grid_atlas,
    mesh_of_triangles,
    point_light,
    quad,
    sphere,
    translation,
)

Point = tuple[float, float, float]
#: Half the gap between the two rooms; a door runs in it.
HALF_GAP = 0.06
#: Where the rooms' blocks of 0.5 m float, m.
BLOCK_HEIGHT = 0.27
#: The doorway: half its width and its height, and by how much the door is larger on every side.
DOORWAY, DOOR_OVERLAP = (0.4, 1.5), 0.1


def turned(angle: float, x: float, y: float, z: float) -> Float64:
    """(4, 4) rotation about z by ``angle``, then to (x, y, z)."""
    matrix = translation(x, y, z)
    c, s = np.cos(angle), np.sin(angle)
    matrix[:2, :2] = [[c, -s], [s, c]]
    return matrix


def walls(name: str, low: Point, high: Point, *, skip: Sequence[str] = ()) -> list[Mesh]:
    """The six sides of a room as quads that face inward, without those in ``skip``."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    sides = {
        "floor": [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)],
        "ceiling": [(x0, y1, z1), (x1, y1, z1), (x1, y0, z1), (x0, y0, z1)],
        "back": [(x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)],
        "front": [(x1, y0, z0), (x0, y0, z0), (x0, y0, z1), (x1, y0, z1)],
        "left": [(x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)],
        "right": [(x1, y1, z0), (x1, y0, z0), (x1, y0, z1), (x1, y1, z1)],
    }
    tint = {"left": 1, "right": 2}
    return [quad(f"{name} {k}", c, material=tint.get(k, 0)) for k, c in sides.items() if k not in skip]


def two_rooms(texels_per_metre: float = 14.0, *, doorway: bool) -> tuple[Scene, Atlas]:
    """Two closed rooms of 2 m, a lamp and a block in each; ``doorway``: an opening between them with a sliding door.

    The door runs between the two skins of the wall and overlaps the opening, so that no ray passes it when it is shut.
    """
    meshes: list[Mesh] = []
    for name, x0, x1, inner in (("A", -2 - HALF_GAP, -HALF_GAP, "right"), ("B", HALF_GAP, 2 + HALF_GAP, "left")):
        meshes += walls(name, (x0, -1, 0), (x1, 1, 2), skip=[inner] if doorway else [])
        if doorway:
            meshes += _wall_with_doorway(name, -HALF_GAP if name == "A" else HALF_GAP, faces_left=name == "A")
    matrices = [np.eye(4)] * len(meshes)
    face = max(2, round(0.5 * texels_per_metre))
    meshes += [box(f"{name} block", (0.5, 0.5, 0.5), texels=face) for name in "AB"]
    # Above the floor: texels that lie in its plane look down beside it, into the void that both rooms share.
    matrices += [translation(-1.2, 0.3, BLOCK_HEIGHT), translation(1.2, 0.3, BLOCK_HEIGHT)]
    moving = {"A block"}
    if doorway:
        width, height = 2 * (DOORWAY[0] + DOOR_OVERLAP), DOORWAY[1] + 2 * DOOR_OVERLAP
        meshes.append(box("door", (HALF_GAP, width, height), texels=face))
        matrices.append(door_at(0.0))
        moving = {"door"}
    instances = tuple(Instance(m.name, i, matrices[i], moving=m.name in moving) for i, m in enumerate(meshes))
    lamps = (point_light((-1.06, 0, 1.8), 60.0, "A lamp"), point_light((1.06, 0, 1.8), 6.0, "B lamp"))
    scene = Scene(tuple(meshes), instances, (WHITE, RED, GREEN), lamps)
    return scene, grid_atlas(scene, [_map_size(m, texels_per_metre, face) for m in meshes])


def door_at(opened: float) -> Float64:
    """(4, 4) where the door of :func:`two_rooms` is; ``opened`` from 0 to 1."""
    travel = 2 * (DOORWAY[0] + DOOR_OVERLAP)
    return translation(0, opened * travel, DOORWAY[1] / 2)


def _wall_with_doorway(name: str, x: float, *, faces_left: bool) -> list[Mesh]:
    half, top = DOORWAY
    parts = {"south": (-1, -half, 0, 2), "north": (half, 1, 0, 2), "lintel": (-half, half, top, 2)}
    meshes = []
    for key, (y0, y1, z0, z1) in parts.items():
        corners = [(x, y0, z0), (x, y1, z0), (x, y1, z1), (x, y0, z1)]
        meshes.append(quad(f"{name} {key}", corners[::-1] if faces_left else corners))
    return meshes


def _map_size(mesh: Mesh, density: float, face: int) -> tuple[int, int]:
    if mesh.island_count == 6:
        return 3 * (face + 2), 2 * (face + 2)
    p = mesh.vertices[mesh.triangles[0]]  # a quad's first triangle: corners 0, 1, 2
    sides = np.linalg.norm(p[1] - p[0]), np.linalg.norm(p[2] - p[1])
    return max(2, round(float(sides[0]) * density)), max(2, round(float(sides[1]) * density))


def larsen_box() -> tuple[Scene, Atlas]:
    """Larsen04 Figure 4 by its numbers (§8): five walls of 5 × 5 texels, a cube and a ball that move, 140 in all."""
    base, _ = cornell(5)
    meshes = (*base.meshes[:5], box("cube", (0.5, 0.5, 0.5), texels=1), sphere("ball", 0.3, rings=12, inward=False))
    matrices = [np.eye(4)] * 5 + [translation(0.4, -0.3, 0.25), translation(-0.4, 0.2, 0.3)]
    instances = tuple(Instance(m.name, i, matrices[i], moving=i >= 5) for i, m in enumerate(meshes))
    scene = Scene(meshes, instances, base.materials, base.lights)
    return scene, grid_atlas(scene, [(5, 5)] * 5 + [(9, 6), (3, 3)])


def bumpy_cornell(triangles: int, texels: int, *, moving: bool = True) -> tuple[Scene, Atlas]:
    """The Cornell box with its five walls cut into about ``triangles`` in all, and made bumpy (Larsen04 §8)."""
    base, atlas = cornell(texels, moving=moving)
    n = max(1, round(np.sqrt((triangles - 24) / 10)))
    rough = [_bumpy(m, n) if i < 5 and n > 1 else m for i, m in enumerate(base.meshes)]
    return Scene(tuple(rough), base.instances, base.materials, base.lights), atlas


def _bumpy(flat: Mesh, n: int, height: float = 0.01) -> Mesh:
    """The quad ``flat`` as a grid of n by n, its inner points lifted by up to ``height`` m."""
    p = flat.vertices[flat.triangles].astype(np.float64)  # (2, 3, 3): corners 0 1 2, 0 2 3
    origin, u, v = p[0, 0], p[0, 1] - p[0, 0], p[1, 2] - p[0, 0]
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    a, b = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    waves = np.pi * max(2, n // 4)
    lift = height * np.sin(waves * a) * np.sin(waves * b)  # zero along the border: the box stays shut
    points = origin + a[..., None] * u + b[..., None] * v + lift[..., None] * normal
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    corners = np.stack([(i, j), (i + 1, j), (i + 1, j + 1), (i, j), (i + 1, j + 1), (i, j + 1)], axis=1)  # (2, 6, n²)
    at = corners.transpose(2, 1, 0).reshape(-1, 2)
    uv = np.stack([a, b], axis=-1)[at[:, 0], at[:, 1]]
    count = 2 * n * n
    material = int(flat.material_of_triangle[0])
    return mesh_of_triangles(flat.name, points[at[:, 0], at[:, 1]], uv, np.zeros(count, int), material=material)


def hall(moving: int, *, joined: bool = False, side: int = 8) -> tuple[Scene, Atlas]:
    """A hall with ``side``² small blocks above its floor, ``moving`` of which are movers; ``joined``: one object."""
    meshes = walls("hall", (-2, -2, 0), (2, 2, 2))
    instances = [Instance(m.name, i, np.eye(4)) for i, m in enumerate(meshes)]
    sizes = [(32, 32)] * len(meshes)
    block = box("block", (0.25, 0.25, 0.25), texels=5)
    order = np.random.default_rng(4).permutation(side * side)  # movers among the others, not in a corner
    places = []
    for number, cell in enumerate(order):
        x, y = (np.array(divmod(int(cell), side)) + 0.5) * 4 / side - 2
        places.append(turned(0.4 * number, x, y, 0.2))
    if joined:
        for name, part in (("movers", places[:moving]), ("others", places[moving:])):
            if part:
                instances.append(Instance(name, len(meshes), np.eye(4), moving=name == "movers"))
                meshes.append(_joined(name, block, part))
                columns, rows = _grid(len(part))
                sizes.append((21 * columns, 14 * rows))
    else:
        number = len(meshes)
        instances += [Instance(f"block {n}", number, m, moving=n < moving) for n, m in enumerate(places)]
        meshes.append(block)
        sizes += [(21, 14)] * len(places)
    scene = Scene(tuple(meshes), tuple(instances), (WHITE, RED, GREEN), (point_light((0, 0, 1.8), 100.0),))
    return scene, grid_atlas(scene, sizes)


def _grid(count: int) -> tuple[int, int]:
    """Columns and rows that hold ``count`` cells of 3 by 2 in about a square."""
    columns = max(1, round(float(np.sqrt(count * 2 / 3))))
    return columns, -(-count // columns)


def _joined(name: str, mesh: Mesh, matrices: Sequence[Float64]) -> Mesh:
    """Copies of ``mesh`` placed by ``matrices``, as one mesh with islands of their own."""
    columns, rows = _grid(len(matrices))
    corners, uv, islands = [], [], []
    for number, matrix in enumerate(matrices):
        placed = mesh.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        corners.append(placed[mesh.triangles])
        uv.append((mesh.corner_uv + (number % columns, number // columns)) / (columns, rows))
        islands.append(mesh.island_of_triangle + number * mesh.island_count)
    return mesh_of_triangles(name, np.concatenate(corners), np.concatenate(uv), np.concatenate(islands))
