# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's smart_project for arrays: charts of large meshes, by planar projection.

The operator works on the polygons, in a scene of its own that is removed again; it needs no window and leaves the
user's selection, mode and active objects alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from .backend.scene import Bool, Float32, Int32
from .scenes import remove_scene
from .source import SourceMesh

Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class Faces:
    """The polygons that triangles (t,) were cut from. Corners of one loop have one number."""

    polygon: Int64  # (t,)
    loop: Int64  # (t, 3) rising along each polygon's border


def whole_faces(mesh: SourceMesh, solid: Bool) -> Faces:
    """Faces of the ``solid`` triangles; those of a polygon with others, too, are polygons of their own."""
    broken = np.isin(mesh.polygon_of_triangle, mesh.polygon_of_triangle[~solid])[solid]
    polygon = mesh.polygon_of_triangle[solid].astype(np.int64)
    loop = mesh.loop_of_corner[solid].astype(np.int64)
    own = np.arange(len(polygon))
    polygon = np.where(broken, own + polygon.max(initial=0) + 1, polygon)
    own_loop = 3 * own[:, None] + np.arange(3) + loop.max(initial=0) + 1
    return Faces(polygon, np.where(broken[:, None], own_loop, loop))


def smart_project(vertices: Float32, triangles: Int32, faces: Faces) -> Float32:
    """(t, 3, 2) UVs by Blender's smart_project, on a mesh and in a scene of its own that are gone afterwards."""
    mesh, loop_of_corner = _temporary_mesh(vertices, triangles, faces)
    target = bpy.data.objects.new("rtgi_unwrap", mesh)
    scene = bpy.data.scenes.new("rtgi_unwrap")
    try:
        scene.collection.objects.link(target)
        layer = scene.view_layers[0]
        layer.objects.active = target
        objects = {"object": target, "active_object": target, "edit_object": target, "selected_objects": [target]}
        with bpy.context.temp_override(scene=scene, view_layer=layer, **objects):
            bpy.ops.object.mode_set(mode="EDIT")
            try:
                bpy.ops.mesh.select_all(action="SELECT")
                # The margin only keeps islands from sharing corners; they are packed again.
                bpy.ops.uv.smart_project(island_margin=1e-3, margin_method="FRACTION", correct_aspect=False)
            finally:
                bpy.ops.object.mode_set(mode="OBJECT")
        uv = np.zeros(2 * len(mesh.loops), np.float32)
        mesh.uv_layers[0].uv.foreach_get("vector", uv)
        return uv.reshape(-1, 2)[loop_of_corner]
    finally:
        bpy.data.objects.remove(target)
        remove_scene(scene)
        bpy.data.meshes.remove(mesh)


def _temporary_mesh(vertices: Float32, triangles: Int32, faces: Faces) -> tuple[bpy.types.Mesh, Int64]:
    """A mesh of the polygons, and (t, 3) its loop of each triangle corner."""
    used, vertex = np.unique(triangles, return_inverse=True)
    # Loops in order of polygon, then border.
    order = np.lexsort((faces.loop.ravel(), np.repeat(faces.polygon, 3)))
    loop, polygon = faces.loop.ravel()[order], np.repeat(faces.polygon, 3)[order]
    new = np.concatenate([[True], loop[1:] != loop[:-1]])
    loop_of_corner = np.zeros(len(order), np.int64)
    loop_of_corner[order] = np.cumsum(new) - 1
    starts = np.nonzero(np.concatenate([[True], np.diff(polygon[new]) != 0]))[0]
    mesh = bpy.data.meshes.new("rtgi_unwrap")
    mesh.vertices.add(len(used))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices[used], np.float32).ravel())
    mesh.loops.add(int(new.sum()))
    mesh.loops.foreach_set("vertex_index", vertex.ravel()[order][new].astype(np.int32))
    mesh.polygons.add(len(starts))
    mesh.polygons.foreach_set("loop_start", starts.astype(np.int32))
    mesh.update(calc_edges=True)
    mesh.uv_layers.new(name="UVMap", do_init=False)
    return mesh, loop_of_corner.reshape(-1, 3)
