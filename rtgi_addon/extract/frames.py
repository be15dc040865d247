# SPDX-License-Identifier: GPL-3.0-or-later
"""One frame's state, read after the caller has set the frame: matrices, deformed vertices, lamps, sky, materials.

Topology and textures are in the SourceScene already; only what moves is read again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np

from ..backend.errors import BakeError
from ..backend.scene import Bool, Float32, Float64, FrameState, Light, Material
from ..source import SourceScene
from . import lights, materials, world
from .as_rendered import read_as_rendered
from .lobes import Lobes
from .meshes import loop_normals, positions
from .placed import Placed, placed_meshes
from .variants import Finder

_NEW = "appears in frame {}, which the bake was not told of; bake it again"


@dataclass
class Reading:
    """What one visit to the depsgraph fills."""

    matrix: Float64  # (n, 4, 4)
    visible: Bool  # (n,)
    vertices: dict[int, Float32] = field(default_factory=dict)
    corner_normals: dict[int, Float32] = field(default_factory=dict)
    lamps: tuple[Light, ...] = ()
    lobes: dict[int, Lobes] = field(default_factory=dict)


def frame_state(source: SourceScene, frame: int, *, constants: Sequence[Material] | None = None) -> FrameState:
    """The context's scene at ``frame``, which must be its current one.

    ``constants`` are the materials of the first frame (``Appearance.materials``); with them, those that are animated
    are evaluated anew.
    """
    scene = bpy.context.scene
    if scene.frame_current != frame:
        raise ValueError(f"the scene is at frame {scene.frame_current}, not {frame}: set the frame first")
    reading = read_as_rendered(scene, bpy.context.view_layer, lambda depsgraph: _read(depsgraph, source, frame))
    sky = world.evaluate_world(scene.world, _told_already) if world.is_animated(scene.world) else source.world
    return FrameState(
        frame=frame,
        matrix_world=reading.matrix,
        visible=reading.visible,
        lights=reading.lamps,
        world=sky,
        vertices=reading.vertices,
        corner_normals=reading.corner_normals,
        materials=None if constants is None else materials.animated_constants(source, constants, reading.lobes),
    )


def _told_already(_line: str) -> None:
    """extract_source visited this frame and kept its warnings."""


def _read(depsgraph: bpy.types.Depsgraph, source: SourceScene, frame: int) -> Reading:
    finder = Finder(source)
    still = np.array([i.matrix_world for i in source.instances], np.float64).reshape(-1, 4, 4)
    reading = Reading(still, np.zeros(len(still), np.bool_))
    for placed in placed_meshes(depsgraph, _told_already):
        index = finder.index_or_none(placed)
        if index is None:
            raise BakeError(_unknown(placed, frame, seen=finder.knows(placed.key)))
        reading.matrix[index] = placed.matrix
        reading.visible[index] = True
        instance = source.instances[index]
        if instance.deforming and instance.mesh not in reading.vertices:
            _read_deformed(placed, source, instance.mesh, frame, reading)
    found = lights.lights_of(depsgraph, _told_already)
    if new := [lamp.name for key, lamp in found.items() if key not in source.lamp_keys]:
        raise BakeError(f"{new[0]}: {_NEW.format(frame)}")
    reading.lamps = lights.in_order(found, source.lamp_keys, source.lights)
    reading.lobes = materials.animated_lobes(source, depsgraph)
    return reading


def _unknown(placed: Placed, frame: int, *, seen: bool) -> str:
    if not seen:
        return f"{placed.name}: {_NEW.format(frame)}"
    return (
        f"{placed.name}: has other faces or materials in frame {frame} than when that frame was first looked at; bake "
        "its simulation to disk first, so that a frame is always the same"
    )


def _read_deformed(placed: Placed, source: SourceScene, mesh: int, frame: int, reading: Reading) -> None:
    known, vertices = source.meshes[mesh], positions(placed.data)
    if len(vertices) != len(known.vertices) or len(placed.data.loops) <= known.loop_of_corner.max(initial=-1):
        raise BakeError(
            f"{placed.name}: has other faces in frame {frame} than when that frame was first looked at; bake its "
            "simulation to disk first, so that a frame is always the same"
        )
    # Vertices that are not finite in any frame belong to no triangle.
    reading.vertices[mesh] = np.nan_to_num(vertices, posinf=0, neginf=0)
    reading.corner_normals[mesh] = np.nan_to_num(loop_normals(placed.data)[known.loop_of_corner])
