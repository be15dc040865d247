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
    with frame_kept(scene), _direct_light_only(scene), _picture_settings(scene, size, samples):
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
        stack.enter_context(_kept(render, engine=eevee_engine(), filepath=render.filepath))
        off = dict.fromkeys(("use_sequencer", "use_multiview", "use_border", "use_file_extension"), False)
        stack.enter_context(_kept(render, **off))
        if size is not None:
            stack.enter_context(_kept(render, resolution_x=size[0], resolution_y=size[1], resolution_percentage=100))
        stack.enter_context(_kept(scene.eevee, taa_render_samples=samples or scene.eevee.taa_render_samples))
        if hasattr(image, "media_type"):  # from 5.0; it decides which formats there are
            stack.enter_context(_kept(image, media_type="IMAGE"))
        mode = "RGBA" if render.film_transparent else "RGB"
        # Last set is first put back, and the format decides which depths and modes there are.
        for name, value in (("file_format", "PNG"), ("color_mode", mode), ("color_depth", "8")):
            stack.enter_context(_kept(image, **{name: value}))
        yield


@contextmanager
def _direct_light_only(scene: bpy.types.Scene) -> Iterator[None]:
    """No light in Eevee but that of lamps and of the maps; the sky still shows behind."""
    probes = [o for o in scene.objects if o.type == "LIGHT_PROBE" and o.data.type == "VOLUME"]
    with ExitStack() as stack:
        # The threshold cuts far lamps off; no screen-space or fast global illumination.
        stack.enter_context(_kept(scene.eevee, use_raytracing=False, light_threshold=1e-4))
        for probe in probes:  # baked irradiance
            stack.enter_context(_kept(probe, hide_render=True))
        if scene.world is not None:
            stack.enter_context(_backdrop_only(scene))
        yield


@contextmanager
def _backdrop_only(scene: bpy.types.Scene) -> Iterator[None]:
    """A copy of the scene's world that the camera sees and that lights nothing."""
    original = scene.world
    copy = original.copy()
    try:
        if not (copy.node_tree is not None and (bpy.app.version >= (5, 0) or copy.use_nodes)):
            _make_plain_nodes(copy)
        tree = copy.node_tree
        for output in [n for n in tree.nodes if n.bl_idname == "ShaderNodeOutputWorld"]:
            for link in list(output.inputs["Surface"].links):
                mix, path = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeLightPath")
                tree.links.new(path.outputs["Is Camera Ray"], mix.inputs["Fac"])
                tree.links.new(link.from_socket, mix.inputs[2])  # the first stays black
                tree.links.new(mix.outputs[0], output.inputs["Surface"])
        scene.world = copy
        yield
    finally:
        scene.world = original
        bpy.data.worlds.remove(copy)


def _make_plain_nodes(world: bpy.types.World) -> None:
    """Nodes for a world that has none and shows its colour."""
    if bpy.app.version < (5, 0):
        world.use_nodes = True
    nodes = world.node_tree.nodes
    nodes.clear()
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (*world.color, 1.0)
    world.node_tree.links.new(background.outputs[0], output.inputs["Surface"])


@contextmanager
def _kept(block: bpy.types.bpy_struct, **values: object) -> Iterator[None]:
    """``values`` on ``block`` for a while."""
    before = {name: getattr(block, name) for name in values}
    try:
        for name, value in values.items():
            setattr(block, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(block, name, value)
