# SPDX-License-Identifier: GPL-3.0-or-later
"""Eevee pictures of a scene that shows its light maps, and a video of them.

The last stage of ``rtgi render``. Eevee's own indirect light is off, so that nothing is counted twice: the maps hold
bounced, sky and emissive light. Lamps, shadows and the view transform are the user's. All settings are put back.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import bpy

from .backend.errors import BakeError
from .backend.progress import Report
from .eevee_light import direct_light_only, kept
from .extract.source_scene import frame_kept
from .output import whole_file
from .video import write_video

PREFIX = "preview"


@dataclass(frozen=True)
class Preview:
    """What was drawn."""

    pictures: tuple[Path, ...]  # preview.0001.png, ... one for each frame
    video: Path | None  # preview.mp4, of two frames or more
    warnings: tuple[str, ...]


def render_preview(
    folder: Path,
    frames: Sequence[int],
    *,
    size: tuple[int, int] | None = None,
    samples: int | None = None,
    report: Report,
) -> Preview:
    """Draw ``frames`` of the open scene into ``folder``; its light maps are applied already.

    ``size`` (width, height) in pixels and Eevee ``samples`` a pixel are the scene's own where None. The report may
    raise Cancelled; finished pictures stay.
    """
    scene = bpy.context.scene
    _require_camera(scene)
    pictures = []
    with frame_kept(scene), direct_light_only(scene), _picture_settings(scene, size, samples):
        for done, frame in enumerate(frames):
            report("render", done, len(frames))
            scene.frame_set(frame)
            pictures.append(folder / f"{PREFIX}.{frame:04d}.png")
            _render(scene, pictures[-1])
        report("render", len(frames), len(frames))
    video, warnings = None, []
    if len(pictures) > 1:
        report("video", 0, 1)
        base = scene.render.fps_base * (frames[1] - frames[0])
        if bpy.app.build_options.codec_ffmpeg:
            video = folder / f"{PREFIX}.mp4"
            write_video(video, pictures, fps=scene.render.fps, fps_base=base)
        else:
            warnings.append("video: this Blender was built without FFmpeg, so there are pictures only")
        report("video", 1, 1)
    return Preview(tuple(pictures), video, tuple(warnings))


def eevee_engine() -> str:
    """Eevee's name in this Blender."""
    return "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"


def _require_camera(scene: bpy.types.Scene) -> None:
    if scene.camera is None:
        raise BakeError(f"scene {scene.name}: has no camera to draw a preview from; add one and make it active")


def _render(scene: bpy.types.Scene, path: Path) -> None:
    try:
        with whole_file(path) as part:
            scene.render.filepath = str(part)
            bpy.ops.render.render(write_still=True, scene=scene.name)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error: ")
        raise BakeError(f"{path}: Eevee could not draw it ({reason}); check the graphics driver and --out") from error
    except OSError as error:
        raise BakeError(f"{path}: cannot be written ({error.strerror}); check free space and permissions") from error


@contextmanager
def _picture_settings(scene: bpy.types.Scene, size: tuple[int, int] | None, samples: int | None) -> Iterator[None]:
    """PNG files by Eevee at the size asked for; the compositor stays, the sequencer would replace the picture."""
    render, image = scene.render, scene.render.image_settings
    with ExitStack() as stack:
        stack.enter_context(kept(render, engine=eevee_engine(), filepath=render.filepath))
        off = dict.fromkeys(("use_sequencer", "use_multiview", "use_border", "use_file_extension"), False)
        stack.enter_context(kept(render, **off))
        if size is not None:
            stack.enter_context(kept(render, resolution_x=size[0], resolution_y=size[1], resolution_percentage=100))
        stack.enter_context(kept(scene.eevee, taa_render_samples=samples or scene.eevee.taa_render_samples))
        if hasattr(image, "media_type"):  # from 5.0; it decides which formats there are
            stack.enter_context(kept(image, media_type="IMAGE"))
        mode = "RGBA" if render.film_transparent else "RGB"
        # Last set is first put back, and the format decides which depths and modes there are.
        for name, value in (("file_format", "PNG"), ("color_mode", mode), ("color_depth", "8")):
            stack.enter_context(kept(image, **{name: value}))
        yield
