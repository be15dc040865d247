# SPDX-License-Identifier: GPL-3.0-or-later
"""What the build scripts share: an empty file, meshes from arrays, plain diffuse materials, keys, saving.

Each script beside this one is run by itself, ``python build_NAME.py [FILE]``, in a Python that has bpy, and writes
NAME.blend here or FILE. Metres and watts; z is up. Everything is made from numbers, so that a build repeats exactly.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from math import radians
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

Colour = tuple[float, float, float]
FRAMES = 24


def new_scene(*, size: tuple[int, int], frame_end: int = 1) -> bpy.types.Scene:
    """An empty file at factory settings, drawn by Eevee with its own approximation of indirect light off."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    engines = {item.identifier for item in scene.render.bl_rna.properties["engine"].enum_items}
    scene.render.engine = "BLENDER_EEVEE_NEXT" if "BLENDER_EEVEE_NEXT" in engines else "BLENDER_EEVEE"
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.fps = FRAMES
    scene.frame_start, scene.frame_end = 1, frame_end
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.cycles.samples = 256
    scene.eevee.taa_render_samples = 32
    scene.world = bpy.data.worlds.new("World")
    set_world_colour(scene.world, (0.0, 0.0, 0.0))
    return scene


def set_world_colour(world: bpy.types.World, colour: Colour) -> None:
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (*colour, 1.0)


def diffuse(name: str, colour: Colour) -> bpy.types.Material:
    """A Lambertian material: Diffuse BSDF alone. The colour is linear reflectance."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.diffuse_color = (*colour, 1.0)  # the solid viewport's
    tree = material.node_tree
    tree.nodes.clear()
    bsdf, output = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
    bsdf.inputs["Color"].default_value = (*colour, 1.0)
    output.location.x = 300
    tree.links.new(bsdf.outputs["BSDF"], output.inputs["Surface"])
    return material


def add_mesh(
    name: str,
    vertices: Sequence | np.ndarray,
    faces: Sequence | np.ndarray,
    *materials: bpy.types.Material,
    slots: Sequence[int] | None = None,
    smooth: bool = False,
) -> bpy.types.Object:
    """A mesh object at the origin; ``slots`` is the material index of each face."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(vertices, float).tolist(), [], [list(map(int, face)) for face in faces])
    for material in materials:
        mesh.materials.append(material)
    if slots is not None:
        mesh.polygons.foreach_set("material_index", np.asarray(slots, np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(mesh.polygons), smooth))
    mesh.update()
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def add_quad(name: str, corners: Sequence[Sequence[float]], material: bpy.types.Material) -> bpy.types.Object:
    """One rectangle; it faces the side from which its corners run anticlockwise."""
    return add_mesh(name, corners, [(0, 1, 2, 3)], material)


def box_arrays(low: Sequence[float], high: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Corners (8, 3) and faces (6, 4), normals outward: -x, +x, -y, +y, -z, +z."""
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.asarray(low, float) + corners * (np.asarray(high, float) - np.asarray(low, float)), np.array(faces)


def add_boxes(
    name: str,
    boxes: Sequence[tuple[Sequence[float], Sequence[float]]],
    *materials: bpy.types.Material,
    slots: Sequence[int] | None = None,
) -> bpy.types.Object:
    """One mesh of boxes, each given by two opposite corners; ``slots`` is the material index of each box."""
    parts = [box_arrays(*box) for box in boxes]
    vertices = np.concatenate([corners for corners, _ in parts])
    faces = np.concatenate([part + 8 * i for i, (_, part) in enumerate(parts)])
    return add_mesh(name, vertices, faces, *materials, slots=None if slots is None else np.repeat(slots, 6))


def add_lathe(
    name: str,
    profile: Sequence[tuple[float, float]],
    material: bpy.types.Material,
    *,
    around: int = 32,
    smooth: bool = True,
) -> bpy.types.Object:
    """A profile of (radius, z) from top to bottom turned about z; it faces outward. Radius 0 at an end closes it."""
    closed_top, closed_end = profile[0][0] == 0, profile[-1][0] == 0
    rings = profile[int(closed_top) : len(profile) - int(closed_end)]
    phi = np.arange(around) * 2 * np.pi / around
    circle = np.stack([np.cos(phi), np.sin(phi), np.zeros(around)], -1)
    vertices = np.concatenate([circle * radius + (0, 0, z) for radius, z in rings])
    i, j = np.meshgrid(np.arange(len(rings) - 1) * around, np.arange(around), indexing="ij")
    a, b = (i + j).ravel(), (i + (j + 1) % around).ravel()
    faces = np.stack([a, a + around, b + around, b], -1).tolist()
    for closed, point, first, step in (
        (closed_top, profile[0], 0, 1),
        (closed_end, profile[-1], (len(rings) - 1) * around, -1),
    ):
        if closed:
            edges = [(first + k, first + (k + 1) % around)[::step] for k in range(around)]
            faces += [(len(vertices), *edge) for edge in edges]
            vertices = np.concatenate([vertices, [(0, 0, point[1])]])
    return add_mesh(name, vertices, faces, material, smooth=smooth)


def add_ball(name: str, radius: float, material: bpy.types.Material, *, around: int = 32) -> bpy.types.Object:
    theta = np.linspace(0, np.pi, around // 2 + 1)
    profile = [
        (0.0, radius),
        *zip(radius * np.sin(theta[1:-1]), radius * np.cos(theta[1:-1]), strict=True),
        (0.0, -radius),
    ]
    return add_lathe(name, profile, material, around=around)


def add_point_light(
    name: str, location: Sequence[float], watts: float, *, colour: Colour = (1.0, 1.0, 1.0), radius: float = 0.05
) -> bpy.types.Object:
    light = bpy.data.lights.new(name, "POINT")
    light.energy, light.color, light.shadow_soft_size = watts, colour, radius
    return _add_object(name, light, location)


def add_camera(
    location: Sequence[float], target: Sequence[float], *, lens: float, clip_start: float = 0.05
) -> bpy.types.Object:
    """The scene's camera; ``lens`` in millimetres of a 36 mm film."""
    camera = bpy.data.cameras.new("Camera")
    camera.lens, camera.clip_start = lens, clip_start
    obj = _add_object("Camera", camera, location)
    obj.rotation_euler = (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.camera = obj
    return obj


def _add_object(name: str, data: bpy.types.ID, location: Sequence[float]) -> bpy.types.Object:
    obj = bpy.data.objects.new(name, data)
    obj.location = location
    bpy.context.scene.collection.objects.link(obj)
    return obj


def place(obj: bpy.types.Object, location: Sequence[float], *, turn: float = 0.0) -> bpy.types.Object:
    """Put ``obj`` at ``location``, turned by ``turn`` degrees about z."""
    obj.location, obj.rotation_euler = location, (0.0, 0.0, radians(turn))
    return obj


def add_rtgi_layer(obj: bpy.types.Object, corner_uv: np.ndarray) -> None:
    """A light-map layer made by hand, which RTGI keeps: ``corner_uv`` (loops, 2)."""
    layer = obj.data.uv_layers.new(name="RTGI")
    layer.uv.foreach_set("vector", np.asarray(corner_uv, np.float32).ravel())


def save(script: str) -> None:
    """Save beside the script, as NAME.blend of build_NAME.py, or where the command line says."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(script).with_name(Path(script).stem[6:] + ".blend")
    bpy.context.preferences.filepaths.save_version = 0
    bpy.context.scene.frame_set(1)
    bpy.data.orphans_purge(do_recursive=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(target.resolve()), compress=True, relative_remap=True)
