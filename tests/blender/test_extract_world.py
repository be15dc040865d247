# SPDX-License-Identifier: GPL-3.0-or-later
"""The sky map: right direction, right radiance, right power, whatever the world's node tree."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Quaternion, Vector

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.scene import World
from rtgi_addon.extract import extract_source

AddObject = Callable[..., bpy.types.Object]


def silent(*_args: object) -> None:
    pass


@pytest.fixture
def sky(add_plane: AddObject) -> bpy.types.World:
    """A world with a black Background; a plane stands in the scene."""
    add_plane("Floor")
    world = bpy.data.worlds.new("Sky")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    bpy.context.scene.world = world
    background_of(world).inputs["Color"].default_value = (0, 0, 0, 1)
    return world


def background_of(world: bpy.types.World) -> bpy.types.Node:
    return next(n for n in world.node_tree.nodes if n.bl_idname == "ShaderNodeBackground")


def feed(world: bpy.types.World, kind: str, socket: str = "Color") -> bpy.types.Node:
    """A new node of ``kind`` linked to the Background's colour."""
    node = world.node_tree.nodes.new(kind)
    world.node_tree.links.new(node.outputs[socket], background_of(world).inputs["Color"])
    return node


def environment(world: bpy.types.World, pixels: np.ndarray) -> bpy.types.Node:
    """An unfiltered environment texture of ``pixels`` (h, w, 3), row 0 at the bottom, packed into the file."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("env", width, height, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    image.pixels.foreach_set(np.concatenate([pixels, np.ones((height, width, 1))], axis=2).astype(np.float32).ravel())
    image.update()
    image.pack()
    node = feed(world, "ShaderNodeTexEnvironment")
    node.image, node.interpolation = image, "Closest"
    return node


def extracted() -> World:
    return extract_source([1], silent).world


def up_irradiance(world: World) -> np.ndarray:
    """(3,) W/m² on a floor that sees the whole sky."""
    height, width = world.radiance.shape[:2]
    edges = (np.arange(height + 1) / height - 0.5) * np.pi
    weight = np.maximum(np.diff(np.sin(np.maximum(edges, 0)) ** 2) / 2, 0) * 2 * np.pi / width
    return (world.radiance.astype(np.float64) * weight[:, None, None]).sum(axis=(0, 1))


def cycles_up_irradiance(samples: int) -> np.ndarray:
    """(3,) W/m² that Cycles bakes on the floor: the mean over its texels."""
    scene, floor = bpy.context.scene, bpy.data.objects["Floor"]
    floor.data.materials.clear()
    layer = floor.data.uv_layers.get("UVMap") or floor.data.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    image = bpy.data.images.new("bake", 8, 8, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    material = bpy.data.materials.new("white")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    target = material.node_tree.nodes.new("ShaderNodeTexImage")
    target.image = image
    material.node_tree.nodes.active = target
    floor.data.materials.append(material)
    scene.cycles.samples, scene.cycles.use_adaptive_sampling = samples, False
    bpy.context.view_layer.objects.active = floor
    floor.select_set(True)
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, margin=0, use_clear=True)
    pixels = np.zeros(8 * 8 * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(-1, 4)[:, :3].astype(np.float64).mean(axis=0) * np.pi


def test_no_world_and_a_plain_colour(sky: bpy.types.World) -> None:
    background = background_of(sky)
    assert extracted().is_black
    background.inputs["Color"].default_value = (0.2, 0.4, 0.8, 1)
    background.inputs["Strength"].default_value = 3.0
    world = extracted()
    assert world.radiance.shape == (1, 1, 3)
    assert np.allclose(world.radiance[0, 0], (0.6, 1.2, 2.4))
    assert np.allclose(np.pi * world.radiance[0, 0], cycles_up_irradiance(64), rtol=0.01)
    bpy.context.scene.world = None
    assert extracted() is None


def test_every_pixel_of_an_hdri_lies_where_the_documented_mapping_says(sky: bpy.types.World) -> None:
    pixels = np.random.default_rng(3).uniform(0, 4, (16, 32, 3)).astype(np.float32)
    environment(sky, pixels)
    radiance = extracted().radiance
    height, width = radiance.shape[:2]
    assert (height, width) == (512, 1024)
    centres = radiance[height // 32 :: height // 16, width // 64 :: width // 32]
    assert np.allclose(centres, pixels, rtol=1e-3)


def test_a_bright_pixel_lights_from_its_direction(sky: bpy.types.World) -> None:
    """Held to Cycles, not to the mapping: a floor turned to the direction gets all, one turned 60 degrees off half."""
    pixels = np.zeros((64, 128, 3), np.float32)
    row, column = 45, 30
    pixels[row, column] = 50
    environment(sky, pixels)
    radiance = extracted().radiance
    height, width = radiance.shape[:2]
    bright = radiance[..., 0] > 25
    rows, columns = np.nonzero(bright)
    azimuth = (0.5 - (columns.mean() + 0.5) / width) * 2 * math.pi
    elevation = ((rows.mean() + 0.5) / height - 0.5) * math.pi
    towards = Vector(
        (math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation))
    )
    solid_angle = (2 * math.pi / 128) * (math.sin((46 / 64 - 0.5) * math.pi) - math.sin((45 / 64 - 0.5) * math.pi))
    floor = bpy.data.objects["Floor"]
    floor.rotation_mode = "QUATERNION"
    floor.rotation_quaternion = Vector((0, 0, 1)).rotation_difference(towards)
    assert cycles_up_irradiance(256) == pytest.approx([50 * solid_angle] * 3, rel=0.02)
    floor.rotation_quaternion = Quaternion(towards.orthogonal(), math.radians(60)) @ floor.rotation_quaternion
    assert cycles_up_irradiance(256) == pytest.approx([25 * solid_angle] * 3, rel=0.03)


def test_a_strong_small_sun_in_an_hdri_keeps_its_power(sky: bpy.types.World) -> None:
    pixels = np.full((128, 256, 3), 0.5, np.float32)
    pixels[100, 77] = (8e4, 7e4, 6e4)
    environment(sky, pixels)
    assert np.allclose(up_irradiance(extracted()), cycles_up_irradiance(1024), rtol=0.02)


def test_a_sky_texture_with_its_sun_disc(sky: bpy.types.World) -> None:
    node = feed(sky, "ShaderNodeTexSky")
    node.sun_elevation, node.sun_rotation = math.radians(40), math.radians(70)
    background_of(sky).inputs["Strength"].default_value = 0.1
    world = extracted()
    row, column = np.unravel_index(world.radiance.max(axis=2).argmax(), world.radiance.shape[:2])
    height, width = world.radiance.shape[:2]
    assert (row + 0.5) / height == pytest.approx(0.5 + math.radians(40) / math.pi, abs=1.5 / height)
    azimuth = (0.5 - (column + 0.5) / width) * 2 * math.pi
    assert np.allclose(up_irradiance(world), cycles_up_irradiance(1024), rtol=0.02)
    assert math.cos(azimuth - (math.pi / 2 - math.radians(70))) > 0.999


def test_the_sky_that_lights_is_taken_not_the_one_that_the_camera_sees(sky: bpy.types.World) -> None:
    tree = sky.node_tree
    path, mix = tree.nodes.new("ShaderNodeLightPath"), tree.nodes.new("ShaderNodeMixShader")
    lights, shown = background_of(sky), tree.nodes.new("ShaderNodeBackground")
    lights.inputs["Color"].default_value = (1, 2, 3, 1)
    shown.inputs["Color"].default_value = (9, 9, 9, 1)
    output = next(n for n in tree.nodes if n.bl_idname == "ShaderNodeOutputWorld")
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    tree.links.new(lights.outputs[0], mix.inputs[1])
    tree.links.new(shown.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    links = len(tree.links)
    assert np.allclose(extracted().radiance, (1, 2, 3), rtol=1e-5)
    assert len(tree.links) == links


def test_a_world_hidden_from_diffuse_rays_is_dark_and_told(sky: bpy.types.World) -> None:
    background_of(sky).inputs["Color"].default_value = (1, 1, 1, 1)
    sky.cycles_visibility.diffuse = False
    source = extract_source([1], silent)
    assert source.world.is_black
    assert "hidden from diffuse rays" in source.warnings[0]


def test_a_missing_image_file_is_an_error(sky: bpy.types.World, tmp_path: Path) -> None:
    node = feed(sky, "ShaderNodeTexEnvironment")
    image = bpy.data.images.new("gone", 4, 4)
    image.source, image.filepath = "FILE", str(tmp_path / "gone.exr")
    node.image = image
    with pytest.raises(BakeError, match=r"world Sky: image file .*gone.exr is missing"):
        extracted()


def test_infinite_and_negative_radiance_become_finite(sky: bpy.types.World) -> None:
    gradient = feed(sky, "ShaderNodeTexGradient")
    divide = sky.node_tree.nodes.new("ShaderNodeMath")
    divide.operation = "SUBTRACT"
    divide.inputs[1].default_value = 0.5
    links = sky.node_tree.links
    links.new(gradient.outputs["Color"], divide.inputs[0])
    links.new(divide.outputs[0], background_of(sky).inputs["Color"])
    radiance = extracted().radiance
    assert np.isfinite(radiance).all()
    assert radiance.min() == 0
    assert radiance.max() > 0.3


def test_nothing_is_left_behind(sky: bpy.types.World) -> None:
    feed(sky, "ShaderNodeTexSky")

    def blocks() -> dict[str, list[str]]:
        kinds = ("scenes", "worlds", "cameras", "objects")
        found = {kind: [b.name for b in getattr(bpy.data, kind)] for kind in kinds}
        return found | {"images": [i.name for i in bpy.data.images if i.name != "Render Result"]}

    before = blocks()
    extracted()
    assert blocks() == before
