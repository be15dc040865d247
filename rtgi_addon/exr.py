# SPDX-License-Identifier: GPL-3.0-or-later
"""Light-map pages as float EXR files, bit for bit, through Blender's own image code.

The last step of a bake (arrays -> files) and the first of a preview. Row 0 is the bottom row, RGB is linear
irradiance (W/m²) and alpha is validity. Files appear whole or not at all.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from .backend.errors import BakeError
from .backend.scene import Bool, Float32
from .output import whole_file
from .scenes import remove_scene


def write_page(path: str | os.PathLike[str], rgb: Float32, valid: Bool) -> None:
    """Write ``rgb`` (H, W, 3) and ``valid`` (H, W) to ``path``; the same arrays give the same bytes.

    Raises :class:`BakeError` where the file cannot be written; an older file of that name then stays as it is.
    """
    path = Path(path)
    height, width = valid.shape
    if rgb.shape != (height, width, 3):
        raise ValueError(f"rgb is {rgb.shape}, valid is {valid.shape}: want (H, W, 3) and (H, W)")
    pixels = np.empty((height, width, 4), np.float32)
    pixels[..., :3] = rgb
    pixels[..., 3] = valid
    if not path.parent.is_dir():  # Blender would make it, and then hide why the file cannot be written
        raise BakeError(f"{path}: its folder does not exist; make it or choose another output folder")
    try:
        with whole_file(path) as part, _pixel_image(pixels) as image, _exr_scene() as scene:
            image.save_render(str(part), scene=scene)
    except (OSError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error: ")
        raise BakeError(f"{path}: cannot be written ({reason}); check free space and permissions") from error


def read_page(path: str | os.PathLike[str]) -> tuple[Float32, Bool]:
    """The (H, W, 3) irradiance and (H, W) validity that :func:`write_page` wrote."""
    try:
        image = bpy.data.images.load(str(path), check_existing=False)
    except RuntimeError as error:
        raise BakeError(f"{path}: cannot be read; bake that frame again") from error
    try:
        image.colorspace_settings.name = "Non-Color"  # set before the pixels are first asked for
        image.alpha_mode = "CHANNEL_PACKED"
        width, height = image.size
        if not width or not height:
            raise BakeError(f"{path}: is not a whole image; bake that frame again")
        pixels = np.zeros(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    page = pixels.reshape(height, width, 4)
    return np.ascontiguousarray(page[..., :3]), page[..., 3] > 0.5


@contextlib.contextmanager
def _pixel_image(pixels: Float32) -> Iterator[bpy.types.Image]:
    """``pixels`` (H, W, 4) as an image datablock that nothing colour manages."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("rtgi_page", width, height, alpha=True, float_buffer=True)
    try:
        image.colorspace_settings.name = "Non-Color"  # else Blender writes sRGB-encoded numbers
        image.alpha_mode = "CHANNEL_PACKED"  # else RGB is multiplied by alpha
        image.pixels.foreach_set(pixels.ravel())
        yield image
    finally:
        bpy.data.images.remove(image)


@contextlib.contextmanager
def _exr_scene() -> Iterator[bpy.types.Scene]:
    """A scene of our own that holds the file format: ``Image.save`` cannot compress, 2.6 times larger."""
    scene = bpy.data.scenes.new("rtgi_exr")
    try:
        settings = scene.render.image_settings
        settings.file_format = "OPEN_EXR"
        settings.color_mode = "RGBA"
        settings.color_depth = "32"
        settings.exr_codec = "ZIP"
        yield scene
    finally:
        remove_scene(scene)
