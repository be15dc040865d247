# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertex positions over frames as a .pc2 file, which Blender's Mesh Cache modifier plays back.

So that a deforming stand-in follows the frame without a handler, in a saved file as well.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from .backend.scene import Float32
from .lightmap_sampling import stored_path
from .output import whole_file

_HEADER = struct.Struct("<12siiffi")  # signature, version, points, first frame, frames per sample, samples


def write_pc2(path: Path, positions: Sequence[Float32]) -> None:
    """One sample of (v, 3) object-space positions for each frame."""
    with whole_file(path) as part, part.open("wb") as file:
        file.write(_HEADER.pack(b"POINTCACHE2\0", 1, len(positions[0]), 0.0, 1.0, len(positions)))
        for sample in positions:
            file.write(np.ascontiguousarray(sample, "<f4").tobytes())


def play_pc2(obj: bpy.types.Object, path: Path, frames: Sequence[int]) -> None:
    """Let ``obj`` show sample i of ``path`` at ``frames[i]``; evenly spaced frames, the ends hold."""
    modifier = obj.modifiers.new("RTGI frames", "MESH_CACHE")
    modifier.cache_format = "PC2"
    modifier.filepath = stored_path(path)
    modifier.interpolation = "LINEAR"
    modifier.time_mode, modifier.play_mode = "FRAME", "SCENE"
    modifier.forward_axis, modifier.up_axis = "POS_Y", "POS_Z"
    # Blender plays sample frame * frame_scale - frame_start.
    modifier.frame_scale = 1.0 / (frames[1] - frames[0]) if len(frames) > 1 else 1.0
    modifier.frame_start = frames[0] * modifier.frame_scale
