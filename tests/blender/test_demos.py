# SPDX-License-Identifier: GPL-3.0-or-later
"""The scenes of demo_blend/: each is what its script builds, small, in one file, and shows what it says it does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Vector
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

FOLDER = Path(__file__).resolve().parents[2] / "demo_blend"
NAMES = sorted(path.stem.removeprefix("build_") for path in FOLDER.glob("build_*.py"))


def opened(name: str) -> bpy.types.Scene:
    bpy.ops.wm.open_mainfile(filepath=str(FOLDER / f"{name}.blend"))
    return bpy.context.scene


def evaluated_meshes() -> dict[str, bpy.types.Mesh]:
    """The final mesh of each object, copied so that it outlives the depsgraph."""
    graph = bpy.context.evaluated_depsgraph_get()
    objects = [obj for obj in bpy.context.scene.objects if obj.type in ("MESH", "CURVE")]
    return {obj.name: bpy.data.meshes.new_from_object(obj.evaluated_get(graph), depsgraph=graph) for obj in objects}


def content(path: Path) -> dict[str, Any]:
    """All of a file that its script decides, in a form that compares."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    scene = bpy.context.scene
    found: dict[str, Any] = {
        "frames": (scene.frame_start, scene.frame_end, scene.render.fps),
        "size": (scene.render.resolution_x, scene.render.resolution_y),
        "images": {image.name: tuple(image.size) for image in bpy.data.images if image.size[0]},
        "lights": {light.name: (light.type, round(light.energy, 4)) for light in bpy.data.lights},
        "materials": sorted(material.name for material in bpy.data.materials),
        "matrices": {},
    }
    for frame in (scene.frame_start, scene.frame_end):
        scene.frame_set(frame)
        matrices = {obj.name: np.array(obj.matrix_world).round(4).tolist() for obj in scene.objects}
        found["matrices"][frame] = matrices
    found["polygons"] = {name: len(mesh.polygons) for name, mesh in evaluated_meshes().items()}
    return found


def test_the_four_demos_are_there() -> None:
    assert NAMES == ["cornell", "interior", "larsen_box", "two_rooms"]


@pytest.mark.parametrize("name", NAMES)
def test_the_script_builds_the_saved_file(name: str, tmp_path: Path) -> None:
    built = tmp_path / "built.blend"
    command = [sys.executable, str(FOLDER / f"build_{name}.py"), str(built)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert content(built) == content(FOLDER / f"{name}.blend")


@pytest.mark.parametrize("name", NAMES)
def test_a_demo_is_small_and_needs_no_other_file(name: str) -> None:
    scene = opened(name)
    assert (FOLDER / f"{name}.blend").stat().st_size <= 300 * 1024
    assert all(image.packed_file for image in bpy.data.images if image.size[0])
    assert not bpy.data.libraries and not bpy.data.texts and not bpy.data.sounds
    assert scene.camera and any(obj.type == "LIGHT" for obj in scene.objects)
    assert bpy.data.version[:2] == (4, 2)  # the oldest Blender supported can open it


@pytest.mark.parametrize("name", NAMES)
def test_all_materials_scatter_diffusely(name: str) -> None:
    """So that light maps alone carry the whole picture, and Cycles can be compared region by region."""
    opened(name)
    for material in bpy.data.materials:
        for node in material.node_tree.nodes:
            assert not node.type.startswith("BSDF_") or node.type in ("BSDF_DIFFUSE", "BSDF_PRINCIPLED")
            if node.type == "BSDF_PRINCIPLED":
                assert node.inputs["Specular IOR Level"].default_value == 0
                assert node.inputs["Metallic"].default_value == 0
                assert node.inputs["Transmission Weight"].default_value == 0


def test_cornell_moves_one_block_rigidly_and_apart_from_the_other() -> None:
    scene = opened("cornell")
    places = {}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        places[frame] = {obj.name: np.array(obj.matrix_world) for obj in scene.objects}
        corners = np.array([(x, y, 0, 1) for x in (-0.3, 0.3) for y in (-0.3, 0.3)])
        short, tall = ((corners @ places[frame][name].T)[:, :2] for name in ("Short block", "Tall block"))
        assert short[:, 1].max() < tall[:, 1].min()
        assert np.abs(short).max() < 1 and np.abs(tall).max() < 1
    moved = {name for name in places[1] if not np.array_equal(places[1][name], places[scene.frame_end][name])}
    assert moved == {"Short block"} and scene.frame_end == 24
    turn = places[12]["Short block"][:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)


def test_larsen_box_has_13000_polygons_in_16_surfaces() -> None:
    opened("larsen_box")
    meshes = evaluated_meshes()
    assert sum(len(mesh.polygons) for mesh in meshes.values()) == pytest.approx(13_000, rel=0.05)
    assert sum(islands(mesh) for mesh in meshes.values()) == 16
    used = [{polygon.material_index for polygon in mesh.polygons} for mesh in meshes.values()]
    assert sum(len(slots) for slots in used) == len(bpy.data.materials) == 16
    colours = [tuple(material.diffuse_color) for material in bpy.data.materials]
    assert len(set(colours)) == 16
    floor = np.array([vertex.co.z for vertex in meshes["Floor"].vertices])
    assert floor.std() > 0.02 and np.abs(floor).max() <= 0.2


def islands(mesh: bpy.types.Mesh) -> int:
    """Pieces of the RTGI layer: face corners joined where they share a vertex and its place in the layer."""
    uv = np.array([point.vector for point in mesh.uv_layers["RTGI"].uv])
    assert uv.min() >= 0 and uv.max() <= 1
    vertex = np.array([loop.vertex_index for loop in mesh.loops])
    _, corner = np.unique(np.column_stack([vertex, uv.round(5)]), axis=0, return_inverse=True)
    corner = corner.ravel()
    last = np.arange(len(corner))
    for polygon in mesh.polygons:
        last[polygon.loop_start : polygon.loop_start + polygon.loop_total] = polygon.loop_start
    graph = coo_matrix((np.ones(len(corner)), (corner, corner[last])), shape=(corner.max() + 1,) * 2)
    return int(connected_components(graph, directed=False)[0])


def struck(scene: bpy.types.Scene, origin: tuple[float, float, float], *, count: int = 4000) -> set[str | None]:
    """Names of what rays from ``origin`` hit first, evenly over all directions; None for a ray that escapes."""
    graph = bpy.context.evaluated_depsgraph_get()
    k = np.arange(count) + 0.5
    z, phi = 1 - 2 * k / count, k * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    names = set()
    for direction in np.stack([r * np.cos(phi), r * np.sin(phi), z], -1):
        hit, _, _, _, obj, _ = scene.ray_cast(graph, Vector(origin), Vector(direction))
        names.add(obj.name if hit else None)
    return names


def test_larsen_box_is_closed() -> None:
    scene = opened("larsen_box")
    names = struck(scene, tuple(scene.objects["Lamp"].location))
    assert None not in names and "Floor" in names and "Front wall" in names


def test_two_rooms_are_closed_until_the_wall_opens() -> None:
    scene = opened("two_rooms")
    right = {obj.name for obj in scene.objects if obj.type == "MESH" and (obj.location.x > 0.2 or "Right" in obj.name)}
    assert len(right) == 8  # five faces of the room, pedestal, ball, bench
    for frame, open_ in ((1, False), (6, False), (14, True)):
        scene.frame_set(frame)
        for lamp in ("Left lamp 1", "Left lamp 2"):
            names = struck(scene, tuple(scene.objects[lamp].location))
            assert None not in names
            assert bool(names & right) is open_, (frame, lamp, names & right)


def test_two_rooms_right_lamps_go_out() -> None:
    scene = opened("two_rooms")
    watts = {}
    for frame in (16, 17, 20, 24):
        scene.frame_set(frame)
        watts[frame] = {obj.name: obj.data.energy for obj in scene.objects if obj.type == "LIGHT"}
    assert len(watts[16]) == 4 and min(watts[16].values()) > 0
    assert {name for name, power in watts[24].items() if power == 0} == {"Right lamp 1", "Right lamp 2"}
    assert watts[17] == watts[16] and watts[20] == watts[24]


def test_interior_has_what_a_room_has() -> None:
    scene = opened("interior")
    chairs = [obj for obj in scene.objects if obj.name.startswith("Chair")]
    assert len(chairs) == 4 and len({obj.data.name for obj in chairs}) == 1
    assert {light.type for light in bpy.data.lights} == {"SUN", "POINT"}
    world = {node.type for node in scene.world.node_tree.nodes}
    assert "TEX_ENVIRONMENT" in world
    emission = bpy.data.materials["Screen"].node_tree.nodes["Principled BSDF"].inputs
    assert emission["Emission Color"].is_linked and emission["Emission Strength"].default_value > 0
    kinds = {modifier.type for obj in scene.objects for modifier in obj.modifiers}
    assert {"BEVEL", "SOLIDIFY"} <= kinds and any(obj.type == "CURVE" for obj in scene.objects)
    triangles = sum(len(polygon.vertices) - 2 for mesh in evaluated_meshes().values() for polygon in mesh.polygons)
    assert 10_000 <= triangles <= 60_000


def test_interior_sun_falls_through_the_window_onto_the_floor() -> None:
    scene = opened("interior")
    graph = bpy.context.evaluated_depsgraph_get()
    sun = scene.objects["Sun"].matrix_world.to_3x3() @ Vector((0, 0, -1))
    points = np.random.default_rng(1).uniform((0.0, 1.0, 0.75), (0.0, 3.3, 2.35), (400, 3))
    hits = [scene.ray_cast(graph, Vector(point) - 4 * sun, sun) for point in points]
    names = [hit[4].name for hit in hits]
    assert names.count("Rug") + names.count("Floor") > 80
    assert struck(scene, (2.8, 2.2, 1.5)) >= {"Floor", "Ceiling", "Screen", "Painting", "Rug", None}
