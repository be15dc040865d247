# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures to one H.264 video, by Blender's own sequencer and FFmpeg, in a scene that is gone afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy

from .backend.errors import BakeError
from .output import whole_file
from .scenes import remove_scene


def write_video(path: Path, pictures: Sequence[Path], *, fps: int, fps_base: float) -> None:
    """``pictures``, all of one size and in one folder, as an .mp4 of ``fps / fps_base`` pictures a second.

    An odd last row or column is cut.
    """
    scene = bpy.data.scenes.new("rtgi_video")
    try:
        _lay_out(scene, pictures)
        _set_up(scene, pictures[0], len(pictures))
        scene.render.fps, scene.render.fps_base = fps, fps_base
        with whole_file(path) as part:
            scene.render.filepath = str(part)
            bpy.ops.render.render(animation=True, scene=scene.name)
    except (RuntimeError, OSError) as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error: ")
        raise BakeError(f"{path}: the video cannot be written ({reason}); the pictures are whole") from error
    finally:
        remove_scene(scene)


def _lay_out(scene: bpy.types.Scene, pictures: Sequence[Path]) -> None:
    editor = scene.sequence_editor_create()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences  # before 4.4
    strip = strips.new_image("pictures", str(pictures[0]), channel=1, frame_start=1, fit_method="ORIGINAL")
    for picture in pictures[1:]:
        strip.elements.append(picture.name)


def _set_up(scene: bpy.types.Scene, picture: Path, count: int) -> None:
    image = bpy.data.images.load(str(picture), check_existing=False)
    width, height = image.size
    bpy.data.images.remove(image)
    render = scene.render
    render.resolution_x, render.resolution_y = width - width % 2, height - height % 2  # H.264 halves the chroma
    render.resolution_percentage = 100
    scene.frame_start, scene.frame_end = 1, count
    render.use_sequencer, render.use_file_extension = True, False
    # The pictures hold display colours; another transform would be a second one.
    scene.view_settings.view_transform, scene.sequencer_colorspace_settings.name = "Standard", "sRGB"
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "VIDEO"
    render.image_settings.file_format = "FFMPEG"
    ffmpeg = render.ffmpeg
    ffmpeg.format, ffmpeg.codec, ffmpeg.audio_codec = "MPEG4", "H264", "NONE"
    ffmpeg.constant_rate_factor = "HIGH"
