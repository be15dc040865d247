# SPDX-License-Identifier: GPL-3.0-or-later
"""What extraction hands on before there are light-map UVs: plain arrays, no bpy here.

``extract`` fills a :class:`SourceScene`; ``unwrap`` gives each mesh a :class:`Layout`; ``materials`` evaluates
albedo and emission over the layouts; together they make the ``backend.scene.Scene`` that is baked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .backend.scene import Float32, Float64, Instance, Int32, Light, World


@dataclass(frozen=True)
class SourceMesh:
    """One mesh as the depsgraph evaluates it, shared by all instances of it; t triangles, v vertices."""

    name: str  # of the object it was evaluated from, for messages
    vertices: Float32  # (v, 3) object
    triangles: Int32  # (t, 3)
    corner_normals: Float32  # (t, 3, 3) object, unit
    loop_of_corner: Int32  # (t, 3) mesh loop (face corner) of each triangle corner
    polygon_of_triangle: Int32  # (t,)
    material_of_triangle: Int32  # (t,) index into SourceScene.material_names
    rtgi_uv: Float32 | None  # (t, 3, 2) the mesh's own layer named RTGI, where it has a valid one


@dataclass(frozen=True)
class SourceScene:
    """The user's scene before unwrapping. Instances index ``meshes``."""

    meshes: tuple[SourceMesh, ...]
    instances: tuple[Instance, ...]
    material_names: tuple[str | None, ...]  # None: Blender's default grey for a face without a material
    lights: tuple[Light, ...]  # of all frames, by first appearance, as in the first; dark where not there yet
    world: World | None
    warnings: tuple[str, ...] = ()
    keys: tuple[tuple[str | int, ...], ...] = ()  # by instance: what finds its object again in another frame
    looks: tuple[bytes | None, ...] = ()  # by instance: which variant of its object it is; None: the only one
    first_frames: tuple[int, ...] = ()  # by instance: where it is first seen
    lit: bool = True  # a lamp or the sky gives light in some frame
    lamp_keys: tuple[tuple[str | int, ...], ...] = ()  # what finds each lamp again in another frame
    lamp_frames: tuple[tuple[int, ...], ...] = ()  # by lamp: those of the frames in which it is there


@dataclass(frozen=True)
class Layout:
    """The light-map UVs of one mesh."""

    corner_uv: Float32  # (t, 3, 2) in [0, 1]
    island_of_triangle: Int32  # (t,)
    size: tuple[float, float]  # object-space metres that the unit of u and of v spans; 0 for a mesh without area


def world_area(mesh: SourceMesh, linear: Float64) -> float:
    """m² of all finite triangles under ``linear`` (3, 3)."""
    corners = np.einsum("tci,ji->tcj", mesh.vertices[mesh.triangles], np.asarray(linear, np.float64))
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(np.einsum("ti,ti->t", cross, cross))
    return float(np.sum(area[np.isfinite(area)]))
