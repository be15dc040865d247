# SPDX-License-Identifier: GPL-3.0-or-later
"""Eevee pictures as numbers: raw, in floats, each pixel its centre, so that closed forms hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

EEVEE = "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"


def read_picture(path: Path) -> np.ndarray:
    """(rows, columns, 4), row 0 at the bottom."""
    image = bpy.data.images.load(str(path), check_existing=False)
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.array(image.pixels[:], np.float32).reshape(height, width, 4)
    bpy.data.images.remove(image)
    return pixels


def set_up_eevee(scene: bpy.types.Scene) -> None:
    """One sample and no shadows: software GL needs a second for each."""
    scene.render.engine = EEVEE
    scene.eevee.taa_render_samples, scene.eevee.use_shadows = 1, False
    scene.render.filter_size = 0.0  # a pixel shows its centre
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.resolution_percentage = 100


def camera_above(scene: bpy.types.Scene, span: float) -> bpy.types.Object:
    """An orthographic camera that looks down at a square of ``span`` metres around the origin."""
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", span, (0, 0, 10)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


def eevee_from_above(scene: bpy.types.Scene, folder: Path) -> Callable[..., np.ndarray]:
    """``draw(width=w, height=h, span=metres)`` gives (rows, columns, 3), row 0 at the bottom."""
    camera = camera_above(scene, 2.0)
    set_up_eevee(scene)
    scene.render.filepath = str(folder / "picture.exr")

    def draw(*, width: int = 8, height: int = 8, span: float = 2.0) -> np.ndarray:
        scene.render.resolution_x, scene.render.resolution_y = width, height
        camera.data.ortho_scale = span
        bpy.ops.render.render(write_still=True)
        return read_picture(Path(scene.render.filepath))[..., :3]

    return draw
