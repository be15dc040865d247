# SPDX-License-Identifier: GPL-3.0-or-later
"""Small scenes made of arrays, with their atlas: what backend tests and benches bake."""

from __future__ import annotations

import numpy as np

from rtgi_addon.backend.scene import (
    Atlas,
    Instance,
    Light,
    LightKind,
    Material,
    Mesh,
    Placement,
    Scene,
    World,
)

WHITE = Material("white", (0.73, 0.73, 0.73))
RED = Material("red", (0.63, 0.065, 0.05))
GREEN = Material("green", (0.14, 0.45, 0.091))


def translation(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def mesh_of_triangles(name: str, corners, corner_uv, islands, normals=None, material: int = 0) -> Mesh:
    """A mesh whose triangles share no vertices; flat normals unless (t, 3, 3) ``normals`` are given."""
    corners = np.asarray(corners, np.float32).reshape(-1, 3, 3)
    count = len(corners)
    if normals is None:
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = np.repeat((face / np.linalg.norm(face, axis=1, keepdims=True))[:, None], 3, axis=1)
    return Mesh(
        name=name,
        vertices=corners.reshape(-1, 3),
        triangles=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        corner_normals=np.asarray(normals, np.float32),
        corner_uv=np.asarray(corner_uv, np.float32).reshape(-1, 3, 2),
        island_of_triangle=np.asarray(islands, np.int32),
        material_of_triangle=np.full(count, material, np.int32),
    )


def quad(name: str, corners, material: int = 0) -> Mesh:
    """One rectangle, corners counter-clockwise seen from its front, filling its light map."""
    p = np.asarray(corners, np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    split = [[0, 1, 2], [0, 2, 3]]
    return mesh_of_triangles(name, p[split], uv[split], [0, 0], material=material)


def box(name: str, size, *, texels: int, inward: bool = False, material: int = 0) -> Mesh:
    """A box around the origin, six islands in a 3 by 2 grid with a texel free between them at ``texels`` a face."""
    x, y, z = np.asarray(size, np.float64) / 2
    faces = [
        [(-x, -y, -z), (-x, y, -z), (x, y, -z), (x, -y, -z)],
        [(-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)],
        [(-x, -y, -z), (x, -y, -z), (x, -y, z), (-x, -y, z)],
        [(x, y, -z), (-x, y, -z), (-x, y, z), (x, y, z)],
        [(-x, y, -z), (-x, -y, -z), (-x, -y, z), (-x, y, z)],
        [(x, -y, -z), (x, y, -z), (x, y, z), (x, -y, z)],
    ]
    cell = texels + 2
    corners, uvs, islands = [], [], []
    for number, face in enumerate(faces):
        p = np.array(face[::-1] if inward else face)
        low = np.array([number % 3 * cell + 1, number // 3 * cell + 1])
        uv = (low + np.array([[0, 0], [texels, 0], [texels, texels], [0, texels]])) / (3 * cell, 2 * cell)
        for triangle in ([0, 1, 2], [0, 2, 3]):
            corners.append(p[triangle])
            uvs.append(uv[triangle])
            islands.append(number)
    return mesh_of_triangles(name, corners, uvs, islands, material=material)


def sphere(
    name: str, radius: float, *, rings: int, inward: bool = True, smooth: bool = True, material: int = 0
) -> Mesh:
    """A latitude-longitude sphere, one island whose map is longitude by height (equal areas)."""
    segments = 2 * rings
    heights = np.linspace(-1, 1, rings + 1)
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    h, a = np.meshgrid(heights, angles, indexing="ij")
    ring = np.sqrt(np.maximum(1 - h**2, 0))
    unit = np.stack([ring * np.cos(a), ring * np.sin(a), h], axis=-1)
    uv = np.stack([a / (2 * np.pi), (h + 1) / 2], axis=-1)
    i, j = np.meshgrid(np.arange(rings), np.arange(segments), indexing="ij")
    quads = [(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)]
    p = np.stack([unit[q] for q in quads], axis=2).reshape(-1, 4, 3)
    t = np.stack([uv[q] for q in quads], axis=2).reshape(-1, 4, 2)
    split = [[0, 1, 2], [0, 2, 3]]
    corners, corner_uv = p[:, split].reshape(-1, 3, 3), t[:, split].reshape(-1, 3, 2)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    corners, corner_uv = corners[area > 1e-9], corner_uv[area > 1e-9]
    if inward:
        corners, corner_uv = corners[:, ::-1], corner_uv[:, ::-1]
    normals = (-corners if inward else corners) if smooth else None
    return mesh_of_triangles(name, corners * radius, corner_uv, np.zeros(len(corners), int), normals, material)


def grid_atlas(scene: Scene, sizes: list[tuple[int, int]], *, back: tuple[int, ...] = ()) -> Atlas:
    """Rectangles of (width, height) px in rows, two pixels apart, on one page; ``back`` lists instances mapped
    on both sides."""
    wanted = [(i, 0) for i in range(len(sizes))] + [(i, 1) for i in back]
    total = sum((sizes[i][0] + 2) * (sizes[i][1] + 2) for i, _ in wanted)
    side = max(int(np.sqrt(total)), max(w + 2 for w, _ in sizes))
    x = y = row_height = 0
    spots = {}
    for i, s in sorted(wanted, key=lambda w: -sizes[w[0]][1]):
        width, height = sizes[i]
        if x + width + 2 > side:
            x, y, row_height = 0, y + row_height, 0
        spots[i, s] = (x + 1, y + 1)
        x, row_height = x + width + 2, max(row_height, height + 2)
    resolution = max(side, y + row_height)

    def placement(i: int, s: int) -> Placement | None:
        if (i, s) not in spots:
            return None
        scale = (sizes[i][0] / resolution, sizes[i][1] / resolution)
        return Placement(0, scale, (spots[i, s][0] / resolution, spots[i, s][1] / resolution))

    count = len(scene.instances)
    return Atlas(
        resolution, 1, tuple(placement(i, 0) for i in range(count)), tuple(placement(i, 1) for i in range(count))
    )


def point_light(position, power=100.0, name: str = "lamp") -> Light:
    return Light(name, LightKind.POINT, translation(*position), (float(power),) * 3)


def constant_sky(radiance: float) -> World:
    return World(np.full((1, 1, 3), radiance, np.float32))


def cornell(texels: int = 44, *, moving: bool = False) -> tuple[Scene, Atlas]:
    """The box of 2 m with two blocks, an open front, a point lamp under the ceiling; ``texels`` along a wall."""
    s = 1.0
    walls = [
        quad("floor", [(-s, -s, 0), (s, -s, 0), (s, s, 0), (-s, s, 0)]),
        quad("ceiling", [(-s, s, 2), (s, s, 2), (s, -s, 2), (-s, -s, 2)]),
        quad("back", [(-s, s, 0), (s, s, 0), (s, s, 2), (-s, s, 2)]),
        quad("left", [(-s, -s, 0), (-s, s, 0), (-s, s, 2), (-s, -s, 2)], material=1),
        quad("right", [(s, s, 0), (s, -s, 0), (s, -s, 2), (s, s, 2)], material=2),
    ]
    face = max(2, round(texels * 0.3))
    blocks = [box("short", (0.6, 0.6, 0.6), texels=face), box("tall", (0.6, 0.6, 1.2), texels=face)]

    def turned(angle: float, x: float, y: float, z: float) -> np.ndarray:
        matrix = translation(x, y, z)
        c, s_ = np.cos(angle), np.sin(angle)
        matrix[:2, :2] = [[c, -s_], [s_, c]]
        return matrix

    matrices = [np.eye(4)] * 5 + [turned(-0.29, 0.35, -0.35, 0.3), turned(0.3, -0.35, 0.3, 0.6)]
    meshes = (*walls, *blocks)
    instances = tuple(
        Instance(m.name, i, matrices[i], moving=moving and m.name == "short") for i, m in enumerate(meshes)
    )
    scene = Scene(meshes, instances, (WHITE, RED, GREEN), (point_light((0, 0, 1.9), 50.0),))
    sizes = [(texels, texels)] * 5 + [(3 * (face + 2), 2 * (face + 2))] * 2
    return scene, grid_atlas(scene, sizes)
