# SPDX-License-Identifier: GPL-3.0-or-later
"""Previews: the light Eevee adds, the light it must not add, the settings it leaves, and the files.

Pictures are checked against Cycles region by region. Cycles also bakes the maps here, so that these tests are about
the preview alone: IIM = all light less the direct light of lamps.
"""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError, Cancelled
from rtgi_addon.backend.progress import silent
from rtgi_addon.exr import write_page
from rtgi_addon.lightmap_nodes import MapFiles, make_group
from rtgi_addon.lightmap_slots import light_materials
from rtgi_addon.preview import render_preview
from tests.blender.dumps import dump, dump_file
from tests.blender.pictures import EEVEE, camera_above, read_picture, set_up_eevee

SKY = (0.15, 0.25, 0.4)


def set_sky(scene: bpy.types.Scene, colour: tuple[float, float, float]) -> bpy.types.World:
    world = bpy.data.worlds.new("Sky")
    if world.node_tree is None:
        world.use_nodes = True
    world.probe_resolution = "128"
    nodes = world.node_tree.nodes
    nodes.clear()
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (*colour, 1.0)
    world.node_tree.links.new(background.outputs[0], output.inputs["Surface"])
    scene.world = world
    return world


def shaded(name: str, kind: str, colour: tuple[float, float, float], strength: float = 1.0) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    closure, output = nodes.new(kind), nodes.new("ShaderNodeOutputMaterial")
    closure.inputs["Color"].default_value = (*colour, 1.0)
    if "Strength" in closure.inputs:
        closure.inputs["Strength"].default_value = strength
    material.node_tree.links.new(closure.outputs[0], output.inputs["Surface"])
    return material


def add_layer(obj: bpy.types.Object) -> None:
    layer = obj.data.uv_layers.new(name="RTGI")
    layer.uv.foreach_set("vector", np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32).ravel())


def small(scene: bpy.types.Scene) -> None:
    set_up_eevee(scene)
    scene.render.image_settings.file_format = "PNG"


def lit_plane(add_plane, folder: Path, irradiance: dict[int, float], albedo: float = 0.5) -> bpy.types.Object:
    """A plane that shows maps of one irradiance for each frame."""
    plane = add_plane(material=shaded("Wall", "ShaderNodeBsdfDiffuse", (albedo,) * 3))
    add_layer(plane)
    plane["rtgi_front_scale"], plane["rtgi_front_offset"] = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    for frame, value in irradiance.items():
        page = np.full((4, 4, 3), value, np.float32)
        write_page(folder / f"iim.p0.{frame:04d}.exr", page, np.ones((4, 4), np.bool_))
    light_materials([plane], make_group(MapFiles(folder, ("iim",), 1, tuple(irradiance))))
    return plane


def test_sky_and_emitters_light_nothing_but_are_seen(empty_file, add_plane, tmp_path):
    """The surface has exactly a E / π of its map, however bright the sky and the panel beside it."""
    scene = empty_file
    small(scene)
    camera_above(scene, 8.0)
    set_sky(scene, SKY)
    lit_plane(add_plane, tmp_path, {1: 0.8})
    add_plane("Panel", material=shaded("Panel", "ShaderNodeEmission", (0.6, 0.3, 0.1), 1.0), location=(2.5, 0, 0.5))
    preview = render_preview(tmp_path, (1,), size=(32, 32), report=silent)
    picture = read_picture(preview.pictures[0])
    np.testing.assert_allclose(picture[16, 16, :3], 0.5 * 0.8 / math.pi, atol=1 / 255)
    np.testing.assert_allclose(picture[16, 26, :3], (0.6, 0.3, 0.1), atol=1 / 255)
    np.testing.assert_allclose(picture[2, 2, :3], SKY, atol=1 / 255)
    assert preview.video is None


def test_a_world_without_nodes_is_seen_and_lights_nothing(empty_file, add_plane, tmp_path):
    scene = empty_file
    small(scene)
    camera_above(scene, 8.0)
    scene.world = bpy.data.worlds.new("Plain")
    scene.world.color = SKY
    if scene.world.node_tree is not None:  # from 5.0 each world has nodes
        scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (*SKY, 1.0)
    scene.world.probe_resolution = "128"
    lit_plane(add_plane, tmp_path, {1: 0.8})
    picture = read_picture(render_preview(tmp_path, (1,), size=(32, 32), report=silent).pictures[0])
    np.testing.assert_allclose(picture[16, 16, :3], 0.5 * 0.8 / math.pi, atol=1 / 255)
    np.testing.assert_allclose(picture[2, 2, :3], SKY, atol=1 / 255)


def dump_scene(scene: bpy.types.Scene) -> dict[str, object]:
    blocks = {
        "scene": scene,
        "render": scene.render,
        "image": scene.render.image_settings,
        "eevee": scene.eevee,
        "view": scene.view_settings,
    }
    counts = {kind: len(getattr(bpy.data, kind)) for kind in ("scenes", "worlds", "objects", "cameras", "meshes")}
    return {name: dump(block) for name, block in blocks.items()} | counts | dump_file()


def test_everything_is_put_back(empty_file, add_plane, tmp_path):
    """After a render, a cancelled one and one that failed."""
    scene = empty_file
    small(scene)
    camera_above(scene, 8.0)
    set_sky(scene, SKY)
    lit_plane(add_plane, tmp_path, {1: 0.8, 2: 0.4})
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_percentage = 321, 50
    if hasattr(scene.render.image_settings, "media_type"):
        scene.render.image_settings.media_type = "IMAGE"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "16"
    scene.render.use_border = True
    scene.eevee.use_raytracing, scene.eevee.light_threshold = True, 0.02
    probe = bpy.data.objects.new("Probe", bpy.data.lightprobes.new("Probe", "VOLUME"))
    scene.collection.objects.link(probe)
    scene.frame_set(7)
    before = dump_scene(scene)
    render_preview(tmp_path, (1, 2), size=(16, 16), samples=2, report=silent)
    after = dump_scene(scene)
    for part in before:
        assert after[part] == before[part], part
    assert not probe.hide_render

    def cancel(stage: str, done: int, total: int) -> None:
        if done == 1:
            raise Cancelled

    (tmp_path / "cancelled").mkdir()
    with pytest.raises(Cancelled):
        render_preview(tmp_path / "cancelled", (1, 2), size=(16, 16), report=cancel)
    assert [p.name for p in (tmp_path / "cancelled").iterdir()] == ["preview.0001.png"]
    with pytest.raises(BakeError, match=r"preview\.0001\.png"):
        render_preview(tmp_path / "iim.p0.0001.exr", (1,), size=(16, 16), report=silent)
    after = dump_scene(scene)
    for part in before:
        assert after[part] == before[part], part


def test_video_shows_the_pictures_in_order(empty_file, add_plane, tmp_path):
    scene = empty_file
    small(scene)
    camera_above(scene, 2.0)
    scene.render.fps, scene.render.fps_base = 25, 1.0
    frames = (2, 4, 6)
    lit_plane(add_plane, tmp_path, {frame: frame * 0.5 for frame in frames}, albedo=0.9)
    preview = render_preview(tmp_path, frames, size=(33, 32), report=silent)
    assert [p.name for p in preview.pictures] == ["preview.0002.png", "preview.0004.png", "preview.0006.png"]
    for frame, picture in zip(frames, preview.pictures, strict=True):
        shown = read_picture(picture)[16, 16, 0]
        assert shown == pytest.approx(min(0.9 * frame * 0.5 / math.pi, 1.0), abs=1.5 / 255)
    clip = bpy.data.movieclips.load(str(preview.video))
    assert tuple(clip.size) == (32, 32)
    assert clip.frame_duration == 3
    assert clip.fps == pytest.approx(12.5, rel=0.02)  # every other frame at 25 a second
    bpy.data.movieclips.remove(clip)
    movie = bpy.data.images.load(str(preview.video))
    assert movie.source == "MOVIE"


def test_no_camera_is_named(empty_file, tmp_path):
    with pytest.raises(BakeError, match="has no camera"):
        render_preview(tmp_path, (1,), report=silent)


# --- against Cycles


def cycles_bake(scene: bpy.types.Scene, obj: bpy.types.Object, passes: set[str], samples: int, side: int) -> np.ndarray:
    """(side, side, 3) irradiance over the layer RTGI."""
    image = bpy.data.images.new("bake", side, side, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    nodes = obj.active_material.node_tree.nodes
    node = nodes.new("ShaderNodeTexImage")
    node.image, nodes.active = image, node
    for other in scene.objects:
        other.select_set(other is obj)
    bpy.context.view_layer.objects.active = obj
    scene.cycles.samples = samples
    bpy.ops.object.bake(type="DIFFUSE", pass_filter=passes, margin=0, uv_layer="RTGI", use_clear=True)
    pixels = np.array(image.pixels[:], np.float32).reshape(side, side, 4)[..., :3] * math.pi
    nodes.remove(node)
    bpy.data.images.remove(image)
    return pixels


def smooth(page: np.ndarray) -> np.ndarray:
    """A 3 × 3 mean, against the reference's own noise."""
    padded = np.pad(page, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = page.shape[:2]
    return sum(padded[y : y + height, x : x + width] for y in range(3) for x in range(3)) / 9


def test_sky_emitter_and_lamp_together_match_cycles(empty_file, add_plane, tmp_path):
    """Floor, red wall, glowing panel, sky and a lamp: means over a 6 × 6 grid of regions, each channel."""
    scene, side = empty_file, 24
    set_sky(scene, SKY)
    floor = add_plane("Floor", size=4.0, material=shaded("Floor", "ShaderNodeBsdfDiffuse", (0.6, 0.6, 0.6)))
    wall = add_plane("Wall", size=4.0, material=shaded("Red", "ShaderNodeBsdfDiffuse", (0.7, 0.2, 0.1)))
    wall.location, wall.rotation_euler = (0, 1.6, 1.2), (math.radians(60), 0, 0)
    panel = add_plane("Panel", size=0.8, material=shaded("Glow", "ShaderNodeEmission", (1.0, 0.8, 0.5), 1.5))
    panel.location, panel.rotation_euler = (-1.4, -0.4, 0.7), (0, math.radians(110), 0)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.location, lamp.data.energy, lamp.data.shadow_soft_size = (1.0, -1.2, 2.2), 25.0, 0.02
    scene.collection.objects.link(lamp)
    camera_above(scene, 3.6)
    small(scene)
    scene.render.engine = "CYCLES"
    scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = False, False
    scene.cycles.sample_clamp_indirect, scene.cycles.filter_width = 0.0, 0.01  # a pixel shows its centre

    lit = (floor, wall)
    for obj in lit:
        add_layer(obj)
    everything = [cycles_bake(scene, obj, {"DIRECT", "INDIRECT"}, 256, side) for obj in lit]
    world, scene.world, panel.hide_render = scene.world, None, True
    lamps = [cycles_bake(scene, obj, {"DIRECT"}, 32, side) for obj in lit]
    scene.world, panel.hide_render = world, False
    page = np.zeros((side, 2 * side, 3), np.float32)
    for index, (all_light, of_lamps) in enumerate(zip(everything, lamps, strict=True)):
        page[:, index * side : (index + 1) * side] = smooth(all_light - of_lamps)
    write_page(tmp_path / "iim.p0.0001.exr", np.maximum(page, 0), np.ones(page.shape[:2], np.bool_))

    scene.render.resolution_x = scene.render.resolution_y = 48
    scene.cycles.samples, scene.render.filepath = 512, str(tmp_path / "cycles.png")
    bpy.ops.render.render(write_still=True)
    expected = read_picture(tmp_path / "cycles.png")[..., :3]

    for index, obj in enumerate(lit):  # half a texel in, where neighbours on the page do not reach
        obj["rtgi_front_scale"] = (0.5 - 1 / (2 * side), 1.0, 1.0)
        obj["rtgi_front_offset"] = (0.5 * index + 1 / (4 * side), 0.0, 0.0)
    light_materials(lit, make_group(MapFiles(tmp_path, ("iim",), 1, (1,))))
    preview = render_preview(tmp_path, (1,), size=(48, 48), samples=4, report=silent)
    drawn = read_picture(preview.pictures[0])[..., :3]
    assert scene.render.engine == "CYCLES" != EEVEE

    def regions(picture: np.ndarray) -> np.ndarray:
        return picture.reshape(6, 8, 6, 8, 3).mean(axis=(1, 3))

    error = regions(drawn) - regions(expected)
    assert regions(expected).min() > 0.01
    assert np.median(np.abs(error) / regions(expected)) < 0.02
    np.testing.assert_allclose(regions(drawn), regions(expected), rtol=0.06, atol=0.01)
    # The picture would be wrong by far more if the sky or the panel were counted twice or left out.
    assert abs(error.mean()) < 0.005
