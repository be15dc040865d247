# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene of our own in which Cycles evaluates the user's node trees: made, used and removed.

Nothing of the user's is changed: trees are evaluated on copies of materials and worlds.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..scenes import remove_scene

#: Kinds of data that a evaluation may leave behind.
TEMPORARY = ("objects", "meshes", "cameras", "materials", "worlds", "images")


@contextmanager
def cycles_scene(samples: int) -> Iterator[bpy.types.Scene]:
    """An empty scene set to Cycles on the CPU at the frame of the user's scene, deterministic and without denoising.

    Objects linked to it and data that :func:`temporary` was told of are gone afterwards.
    """
    frame = bpy.context.scene.frame_current
    scene = bpy.data.scenes.new("rtgi_evaluate")
    try:
        scene.frame_current = frame
        scene.render.engine = "CYCLES"
        scene.render.use_compositing = scene.render.use_sequencer = False
        scene.render.resolution_percentage = 100
        settings = scene.cycles
        settings.device = "CPU"
        settings.samples = samples
        settings.seed = 0
        settings.use_animated_seed = False
        settings.use_adaptive_sampling = False
        settings.use_denoising = False
        settings.sample_clamp_direct = settings.sample_clamp_indirect = 0.0
        yield scene
    finally:
        remove_scene(scene)


@contextmanager
def temporary() -> Iterator[list[bpy.types.ID]]:
    """A list whose data-blocks are removed at the end, the latest first."""
    blocks: list[bpy.types.ID] = []
    try:
        yield blocks
    finally:
        for block in reversed(blocks):
            collection = next(getattr(bpy.data, kind) for kind in TEMPORARY if isinstance(block, _type_of(kind)))
            collection.remove(block)


def _type_of(kind: str) -> type[bpy.types.ID]:
    return {
        "objects": bpy.types.Object,
        "meshes": bpy.types.Mesh,
        "cameras": bpy.types.Camera,
        "materials": bpy.types.Material,
        "worlds": bpy.types.World,
        "images": bpy.types.Image,
    }[kind]
