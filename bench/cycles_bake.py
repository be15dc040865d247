# SPDX-License-Identifier: GPL-3.0-or-later
"""The opponent: Cycles' own bake of indirect light into the same atlas, as fast as Blender can be asked to do it.

All meshes are joined into one, since Blender sets Cycles up anew for each baked object. What is timed is Blender's
bake operator: handing over the scene, building the BVH, sampling, writing the image.
"""

from __future__ import annotations

import bpy
import numpy as np

from rtgi_addon.backend.scene import Float32, Float64, Placement
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.texels import Texels

from .measure import Cost, Meter
from .prepare import Prepared

#: Nodes whose result depends on the object or on its UV layers, which a joined mesh does not have.
OBJECT_NODES = {
    "ShaderNodeTexCoord",
    "ShaderNodeUVMap",
    "ShaderNodeTexImage",
    "ShaderNodeAttribute",
    "ShaderNodeObjectInfo",
}
#: Unclamped and with long paths, as the reference; the rest is Blender's default.
CYCLES = {
    "device": "CPU", "use_adaptive_sampling": False, "use_denoising": False, "sample_clamp_direct": 0.0,
    "sample_clamp_indirect": 0.0, "blur_glossy": 0.0, "max_bounces": 32, "diffuse_bounces": 32, "glossy_bounces": 32,
}  # fmt: skip


class CyclesBake:
    """The open scene, its meshes replaced by one that Cycles bakes to the atlas of ``prepared`` (one page)."""

    def __init__(self, prepared: Prepared, texels: Texels, meter: Meter) -> None:
        if prepared.atlas.page_count != 1:
            raise ValueError(f"{prepared.atlas.page_count} atlas pages: the Cycles bake takes one")
        self._texels, self._meter = texels, meter
        side = prepared.atlas.resolution
        self._image = bpy.data.images.new("bench", side, side, float_buffer=True, is_data=True)
        scene = bpy.context.scene
        scene.frame_set(prepared.first.frame)
        joined = _joined_mesh(prepared, self._image)
        for obj in list(scene.objects):
            if obj.type not in {"LIGHT", "CAMERA"}:
                bpy.data.objects.remove(obj)
        self._object = bpy.data.objects.new("bench", joined)
        scene.collection.objects.link(self._object)
        _configure(scene)

    def run(self, samples: int, seed: int) -> tuple[Float32, Cost]:
        """(n, 3) W/m² indirect irradiance of all texels."""
        scene = bpy.context.scene
        scene.cycles.samples, scene.cycles.seed = samples, seed
        self._object.select_set(True)
        bpy.context.view_layer.objects.active = self._object
        _, cost = self._meter.measured(lambda: bpy.ops.object.bake(type="DIFFUSE", pass_filter={"INDIRECT"}))
        pixels = np.zeros(4 * self._texels.index.size, np.float32)
        self._image.pixels.foreach_get(pixels)
        page = pixels.reshape(*self._texels.index.shape[1:], 4)
        return page[self._texels.row, self._texels.col, :3] * np.float32(np.pi), cost


def _configure(scene: bpy.types.Scene) -> None:
    scene.render.engine = "CYCLES"
    for name, value in CYCLES.items():
        setattr(scene.cycles, name, value)
    bake = scene.render.bake
    bake.use_selected_to_active, bake.use_clear, bake.target = False, True, "IMAGE_TEXTURES"
    bake.margin, bake.margin_type = 2, "EXTEND"


def _joined_mesh(prepared: Prepared, image: bpy.types.Image) -> bpy.types.Mesh:
    """All triangles in world space with the atlas as UVs; those mapped on their back alone are turned round."""
    geometry = Geometry(prepared.scene, prepared.first)
    corners = geometry.corners + geometry.origin
    normals, uv = geometry.corner_normals.copy(), np.full((len(corners), 3, 2), -1.0)
    for number, instance in enumerate(prepared.scene.instances):
        front, back = prepared.atlas.front[number], prepared.atlas.back[number]
        if front is not None and back is not None:
            raise ValueError(f"{instance.name}: both sides are mapped, a Cycles bake has one")
        rows, place = geometry.triangles_of(number), front or back
        if place is not None:
            uv[rows] = _page_uv(prepared.scene.meshes[instance.mesh].corner_uv, place)
        if back is not None:
            normals[rows] *= -1
        if (back is not None) != bool(geometry.mirrored[number]):
            for array in (corners, normals, uv):
                array[rows] = array[rows][:, ::-1]
    mesh = _mesh(corners, uv)
    mesh.polygons.foreach_set("material_index", geometry.material_of_triangle)
    mesh.polygons.foreach_set("use_smooth", np.ones(len(corners), np.bool_))
    mesh.normals_split_custom_set(normals.reshape(-1, 3).tolist())
    for material in prepared.scene.materials:
        mesh.materials.append(_baking_material(material.name, image))
    return mesh


def _page_uv(corner_uv: Float32, place: Placement) -> Float64:
    return np.asarray(corner_uv.astype(np.float64) * place.scale + place.offset, np.float64)


def _mesh(corners: Float64, uv: Float64) -> bpy.types.Mesh:
    count = len(corners)
    mesh = bpy.data.meshes.new("bench")
    mesh.vertices.add(3 * count)
    mesh.vertices.foreach_set("co", corners.astype(np.float32).ravel())
    mesh.loops.add(3 * count)
    mesh.loops.foreach_set("vertex_index", np.arange(3 * count, dtype=np.int32))
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.uv_layers.new(name="bench").uv.foreach_set("vector", uv.astype(np.float32).ravel())
    return mesh


def _baking_material(name: str, image: bpy.types.Image) -> bpy.types.Material:
    """A copy of the material ``name`` whose active node is ``image``."""
    material = bpy.data.materials[name].copy()
    nodes = material.node_tree.nodes
    if varying := sorted({node.bl_idname for node in nodes} & OBJECT_NODES):
        raise ValueError(f"{name}: has {', '.join(varying)}; the Cycles bake takes uniform materials")
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    nodes.active = texture
    return material
