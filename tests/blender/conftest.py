# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of the tests that run inside the real bpy: one Blender for the session, one empty file for each test.

bpy is one process-wide program. It starts from factory settings here, so that a developer's own preferences,
start-up file and add-ons cannot change a result.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest


@pytest.fixture(scope="session", autouse=True)
def caches_apart(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What bakes note about this machine goes to a folder of the tests', here and in child processes; Mesa's compiled
    shaders, which take half a minute, stay where they are."""
    caches = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    os.environ.setdefault("MESA_SHADER_CACHE_DIR", caches)
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("caches"))


@pytest.fixture(scope="session", autouse=True)
def blender() -> Iterator[object]:
    """The bpy module at factory settings."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield bpy


@pytest.fixture(autouse=True)
def empty_file(blender: object) -> bpy.types.Scene:
    """A file with one empty scene and nothing else; its scene. Cycles on the CPU, one sample."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 1
    return scene


@pytest.fixture
def add_mesh(empty_file: bpy.types.Scene) -> Callable[..., bpy.types.Object]:
    """``add_mesh(name, vertices, faces, location=..., material=...)``: a new mesh object in the scene."""

    def add(
        name: str,
        vertices: object,
        faces: object,
        *,
        location: tuple[float, float, float] = (0.0, 0.0, 0.0),
        material: bpy.types.Material | None = None,
    ) -> bpy.types.Object:
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(np.asarray(vertices, float).tolist(), [], [list(map(int, f)) for f in faces])
        if material is not None:
            mesh.materials.append(material)
        obj = bpy.data.objects.new(name, mesh)
        obj.location = location
        bpy.context.scene.collection.objects.link(obj)
        bpy.context.view_layer.update()
        return obj

    return add


@pytest.fixture
def add_plane(add_mesh: Callable[..., bpy.types.Object]) -> Callable[..., bpy.types.Object]:
    """``add_plane(name, size=2, ...)``: a square facing +z, centred on its origin."""

    def add(name: str = "Plane", *, size: float = 2.0, **options: object) -> bpy.types.Object:
        h = size / 2
        return add_mesh(name, [(-h, -h, 0), (h, -h, 0), (h, h, 0), (-h, h, 0)], [(0, 1, 2, 3)], **options)

    return add


@pytest.fixture
def add_cube(add_mesh: Callable[..., bpy.types.Object]) -> Callable[..., bpy.types.Object]:
    """``add_cube(name, size=2, ...)``: a cube of six quads, normals outward."""

    def add(name: str = "Cube", *, size: float = 2.0, **options: object) -> bpy.types.Object:
        h = size / 2
        corners = [(x, y, z) for x in (-h, h) for y in (-h, h) for z in (-h, h)]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return add_mesh(name, corners, faces, **options)

    return add
