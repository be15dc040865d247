# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene exactly as a render would see it: a depsgraph in render mode, without touching the user's scene.

Blender evaluates render visibility, render levels of modifiers, render resolution of curves and simplify only for
render engines. So extraction is a render engine of its own: it is asked to render a copy of the scene (a copy of the
settings; objects and collections are the user's own), reads the depsgraph that it is given, and draws nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import bpy

from ..scenes import remove_scene

R = TypeVar("R")

ENGINE = "RTGI_EXTRACT"
#: A render's own handlers would tell others of a render that nobody sees.
RENDER_HANDLERS = ("render_init", "render_pre", "render_post", "render_stats", "render_complete", "render_cancel")


def read_as_rendered(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, read: Callable[..., R]) -> R:
    """``read(depsgraph)`` at the scene's current frame. What it returns must not hold evaluated data."""
    answers: list[R] = []
    faults: list[BaseException] = []

    def render(_self: bpy.types.RenderEngine, depsgraph: bpy.types.Depsgraph) -> None:
        try:  # Blender would print an exception and go on; it belongs to the caller.
            answers.append(read(depsgraph))
        except BaseException as fault:
            faults.append(fault)

    engine = type("RTGI_EXTRACT_engine", (bpy.types.RenderEngine,), _engine_body(render))
    bpy.utils.register_class(engine)
    try:
        with quiet_render_handlers(), _copy_to_render(scene, view_layer) as copy:
            bpy.ops.render.render(scene=copy.name)
    finally:
        bpy.utils.unregister_class(engine)
    if faults:
        raise faults[0]
    if not answers:
        raise RuntimeError("Blender did not evaluate the scene for rendering")
    return answers[0]


def _engine_body(render: Callable[..., None]) -> dict[str, object]:
    return {"bl_idname": ENGINE, "bl_label": "RTGI extraction", "bl_use_preview": False, "render": render}


@contextmanager
def _copy_to_render(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> Iterator[bpy.types.Scene]:
    """A copy with a camera, a few pixels and one view layer, gone afterwards."""
    data = bpy.data.cameras.new("rtgi_extract")
    camera = bpy.data.objects.new("rtgi_extract", data)
    copy = scene.copy()
    try:
        copy.camera = camera
        copy.timeline_markers.clear()  # a marker may bind a camera that is gone
        for layer in copy.view_layers:
            layer.use = layer.name == view_layer.name
        render = copy.render
        render.engine = ENGINE
        render.resolution_x = render.resolution_y = 4
        render.resolution_percentage = 100
        render.use_compositing = render.use_sequencer = render.use_multiview = False
        render.use_motion_blur = render.use_border = render.use_persistent_data = False
        yield copy
    finally:
        remove_scene(copy)
        bpy.data.objects.remove(camera)
        bpy.data.cameras.remove(data)


@contextmanager
def quiet_render_handlers() -> Iterator[None]:
    """No add-on hears of the renders inside."""
    kept = {name: list(getattr(bpy.app.handlers, name)) for name in RENDER_HANDLERS}
    try:
        for name in RENDER_HANDLERS:
            getattr(bpy.app.handlers, name).clear()
        yield
    finally:
        for name, handlers in kept.items():
            getattr(bpy.app.handlers, name)[:] = handlers
