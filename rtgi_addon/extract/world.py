# SPDX-License-Identifier: GPL-3.0-or-later
"""The sky as a radiance map: what Cycles draws of the user's world through a panoramic camera.

A plain colour needs no camera. Small bright spots (suns of HDRIs and sky textures) are drawn again in fine pixels,
since a coarse pixel's few samples would miss their power.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

from ..backend.errors import BakeError
from ..backend.scene import Float32, Float64, World
from . import nodes
from .as_rendered import quiet_render_handlers
from .cycles_scene import cycles_scene, temporary

Warn = Callable[[str], None]

OUTPUT = "ShaderNodeOutputWorld"
#: Map width in pixels, twice the height: an HDRI holds detail that a gradient does not.
WIDTH_PLAIN, WIDTH_IMAGE = 512, 1024
SAMPLES = 4
#: A pixel that gives more than this share of the light of the whole sky is drawn again ...
BRIGHT_SHARE = 0.002
#: ... in this many pixels squared; at most this many map pixels wide and high.
FINE, FINE_WINDOW = 16, 16
#: What a world's tree is told of the ray: the one that a diffuse surface sends out.
RAY_ANSWERS = {"Is Camera Ray": 0.0, "Is Diffuse Ray": 1.0, "Is Reflection Ray": 1.0}


def is_animated(world: bpy.types.World | None) -> bool:
    """Can the sky differ between frames?"""
    return nodes.is_time_dependent(world)


def evaluate_world(world: bpy.types.World | None, warn: Warn) -> World | None:
    """``world`` at the current frame; None without a world."""
    if world is None:
        return None
    if not world.cycles_visibility.diffuse:
        warn(f"world {world.name}: hidden from diffuse rays; it gives no light")
        return World(np.zeros((1, 1, 3), np.float32))
    constant = _constant_colour(world)
    if constant is not None:
        return World(np.maximum(constant, 0).astype(np.float32).reshape(1, 1, 3))
    missing = nodes.missing_images(world.node_tree, OUTPUT)
    if missing:
        raise BakeError(
            *(f"world {world.name}: image file {path} is missing; restore or relink it" for path in missing)
        )
    tree = list(nodes.reachable(world.node_tree, OUTPUT))
    width = WIDTH_IMAGE if any(isinstance(getattr(n, "image", None), bpy.types.Image) for n in tree) else WIDTH_PLAIN
    if any(n.bl_idname == "ShaderNodeLightPath" and n.id_data != world.node_tree for n in tree):
        warn(f"world {world.name}: a Light Path node inside a group answers as to the camera; move it out of the group")
    return World(_draw(world, width))


def _constant_colour(world: bpy.types.World) -> Float64 | None:
    """(3,) radiance where the tree is nothing but a Background with plain inputs."""
    if not nodes.uses_nodes(world):
        return np.array(world.color, np.float64)
    shader = nodes.output_link(world.node_tree, OUTPUT, "Surface")
    if shader is None:
        return np.zeros(3)
    if shader.bl_idname != "ShaderNodeBackground" or shader.mute:
        return None
    colour, strength = (nodes.constant_input(shader, key) for key in ("Color", "Strength"))
    if colour is None or strength is None:
        return None
    return np.array(colour[:3], np.float64) * strength[0]


def _draw(world: bpy.types.World, width: int) -> Float32:
    """(width / 2, width, 3) radiance, row 0 down."""
    with cycles_scene(SAMPLES) as scene, temporary() as blocks, tempfile.TemporaryDirectory() as folder:
        copy = world.copy()
        blocks.append(copy)
        _answer_light_path(copy.node_tree)
        copy.cycles_visibility.camera = True
        scene.world = copy
        with bpy.context.temp_override(scene=scene):  # Cycles' own callback looks at the context's world
            copy.cycles.sampling_method = "NONE"  # a map of lights takes seconds, and only a camera looks here
        _set_camera(scene, blocks)
        radiance = _render(scene, width, None, Path(folder))
        window = _bright_window(radiance)
        if window is not None:
            fine = _render(scene, width * FINE, window, Path(folder))
            rows, columns = window
            radiance[rows, columns] = fine.reshape(
                rows.stop - rows.start, FINE, columns.stop - columns.start, FINE, 3
            ).mean(axis=(1, 3))
    return np.maximum(np.nan_to_num(radiance, posinf=0, neginf=0), 0).astype(np.float32)


def _answer_light_path(tree: bpy.types.NodeTree) -> None:
    """Skies often show one picture to the camera and another to the light; take the one that lights."""
    for node in tree.nodes:
        if node.bl_idname == "ShaderNodeLightPath":
            for output in node.outputs:
                for link in list(output.links):
                    link.to_socket.default_value = RAY_ANSWERS.get(output.name, 0.0)
                    tree.links.remove(link)


def _set_camera(scene: bpy.types.Scene, blocks: list[bpy.types.ID]) -> None:
    data = bpy.data.cameras.new("rtgi_sky")
    camera = bpy.data.objects.new("rtgi_sky", data)
    blocks += [data, camera]
    data.type = "PANO"
    panorama = data if hasattr(data, "panorama_type") else data.cycles  # moved in Blender 5.0
    panorama.panorama_type = "EQUIRECTANGULAR"
    # Looking along +x with z up, so that the picture's centre is where World's mapping has u = 1/2.
    camera.rotation_euler = (math.pi / 2, 0.0, -math.pi / 2)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.filter_width = 1.0


def _render(scene: bpy.types.Scene, width: int, window: tuple[slice, slice] | None, folder: Path) -> Float32:
    """(h, w, 3) of the whole map, or of the ``window`` (rows, columns of the coarse map) at ``width``."""
    height, render = width // 2, scene.render
    render.resolution_x, render.resolution_y = width, height
    render.use_border = render.use_crop_to_border = window is not None
    if window is not None:
        coarse = width // FINE
        rows, columns = window
        # Blender cuts the border down to whole pixels; an eighth of one keeps rounding from losing one.
        past = 0.125 / width
        render.border_min_x, render.border_max_x = columns.start / coarse + past, columns.stop / coarse + past
        render.border_min_y, render.border_max_y = 2 * (rows.start / coarse + past), 2 * (rows.stop / coarse + past)
    picture = render.image_settings
    if hasattr(picture, "media_type"):  # Blender 5.0
        picture.media_type = "IMAGE"
    picture.file_format, picture.color_mode, picture.color_depth = "OPEN_EXR", "RGB", "32"
    picture.exr_codec = "NONE"
    path = folder / f"sky{width}.exr"
    render.filepath = str(path)
    render.use_file_extension = False
    with quiet_render_handlers():
        bpy.ops.render.render(scene=scene.name, write_still=True)
    return _load(path, window, FINE)


def _load(path: Path, window: tuple[slice, slice] | None, fine: int) -> Float32:
    with temporary() as blocks:
        image = bpy.data.images.load(str(path))
        blocks.append(image)
        image.colorspace_settings.name = "Non-Color"
        width, height = image.size
        if window is not None:
            expected = ((window[1].stop - window[1].start) * fine, (window[0].stop - window[0].start) * fine)
            if (width, height) != expected:
                raise RuntimeError(f"Cycles drew {width}x{height} pixels of the sky where {expected} were asked for")
        pixels = np.zeros(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, 4)[..., :3].copy()


def _bright_window(radiance: Float32) -> tuple[slice, slice] | None:
    """The rows and columns around the brightest spot, where such a spot gives much of the light."""
    height, width = radiance.shape[:2]
    solid_angle = np.diff(np.sin((np.arange(height + 1) / height - 0.5) * np.pi))
    flux = np.maximum(radiance.max(axis=2), 0) * solid_angle[:, None]
    row, column = np.unravel_index(int(flux.argmax()), flux.shape)
    if not flux[row, column] > BRIGHT_SHARE * flux.sum():
        return None
    rows = _around(int(row), height)
    columns = _around(int(column), width)
    return rows, columns


def _around(centre: int, size: int) -> slice:
    start = min(max(centre - FINE_WINDOW // 2, 0), size - FINE_WINDOW)
    return slice(start, start + FINE_WINDOW)
