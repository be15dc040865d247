# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance at points of an open .blend by Cycles alone: one small triangle per point, baked, and seen by no ray.

The user's scene stays as it is; the triangles hang just above its surfaces, in the place and with the normal of the
points. So the result depends on no light-map layout, on no choice of sides, and on no margin of a bake.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from rtgi_addon.backend.scene import Float32, Float64

from .surface_points import SurfacePoints

#: Points are lifted by this share of the scene's diagonal: far above rounding, far below a texel.
LIFT = 2e-5
#: Size of a point's triangle as a share of the grid's spacing, so that none reaches into a neighbouring wall.
TRIANGLE_SIZE = 0.2
#: Cycles' settings for an unbiased result.
CYCLES = {
    "device": "CPU", "use_adaptive_sampling": False, "use_denoising": False, "sample_clamp_direct": 0.0,
    "sample_clamp_indirect": 0.0, "blur_glossy": 0.0, "caustics_reflective": True, "caustics_refractive": True,
    "max_bounces": 32, "diffuse_bounces": 32, "glossy_bounces": 32, "transmission_bounces": 32,
    "transparent_max_bounces": 32, "use_light_tree": True, "light_sampling_threshold": 0.0, "use_fast_gi": False,
    "use_animated_seed": False, "use_guiding": False,
}  # fmt: skip


def configure_cycles(scene: bpy.types.Scene) -> None:
    """Cycles without any clamping or shortening of paths."""
    scene.render.engine = "CYCLES"
    scene.render.use_simplify = False
    for name, value in CYCLES.items():
        setattr(scene.cycles, name, value)
    bake = scene.render.bake
    bake.use_selected_to_active, bake.use_clear, bake.margin, bake.target = False, True, 0, "IMAGE_TEXTURES"


class PointBaker:
    """Holds the triangles in the open scene; :meth:`bake` gives irradiance at the points."""

    def __init__(self, points: SurfacePoints, diagonal: float) -> None:
        self._count = len(points.position)
        self._side = int(np.ceil(np.sqrt(self._count)))
        self._image = bpy.data.images.new("reference", self._side, self._side, float_buffer=True, is_data=True)
        self._object = bpy.data.objects.new("reference", self._mesh(points, diagonal * LIFT))
        bpy.context.scene.collection.objects.link(self._object)
        # Camera rays must see it, or Cycles does not bake it; there are none.
        for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
            setattr(self._object, f"visible_{ray}", False)
        bpy.context.view_layer.update()

    def _mesh(self, points: SurfacePoints, lift: float) -> bpy.types.Mesh:
        corner = np.arange(3 * self._count, dtype=np.int32)
        mesh = bpy.data.meshes.new("reference")
        mesh.vertices.add(len(corner))
        mesh.vertices.foreach_set("co", _triangles(points, lift).astype(np.float32).ravel())
        mesh.loops.add(len(corner))
        mesh.loops.foreach_set("vertex_index", corner)
        mesh.polygons.add(self._count)
        mesh.polygons.foreach_set("loop_start", corner[::3].copy())
        mesh.update(calc_edges=True)
        layer = mesh.uv_layers.new(name="reference")
        pixel = np.stack([np.arange(self._count) % self._side, np.arange(self._count) // self._side], axis=1)
        inside = np.array([[0.02, 0.02], [0.98, 0.02], [0.5, 0.98]])  # holds the pixel's centre, touches no other pixel
        layer.uv.foreach_set("vector", ((pixel[:, None] + inside) / self._side).astype(np.float32).ravel())
        mesh.polygons.foreach_set("use_smooth", np.ones(self._count, np.bool_))
        mesh.normals_split_custom_set(np.repeat(points.normal, 3, axis=0).tolist())
        mesh.materials.append(_material(self._image))
        return mesh

    def bake(self, passes: set[str], *, samples: int, seed: int) -> Float32:
        """(p, 3) W/m²: the DIRECT and/or INDIRECT light of ``passes``."""
        scene = bpy.context.scene
        scene.cycles.samples, scene.cycles.seed = samples, seed
        for selected in bpy.context.selected_objects:
            selected.select_set(False)
        self._object.select_set(True)
        bpy.context.view_layer.objects.active = self._object
        bpy.ops.object.bake(type="DIFFUSE", pass_filter=passes)
        pixels = np.zeros(self._side * self._side * 4, np.float32)
        self._image.pixels.foreach_get(pixels)
        # Without COLOR the pass is reflected radiance over albedo: irradiance / pi.
        return pixels.reshape(-1, 4)[: self._count, :3] * np.float32(np.pi)


def _triangles(points: SurfacePoints, lift: float) -> Float64:
    """(p, 3, 3) world: a triangle around each lifted point, counter-clockwise about its geometric normal."""
    n = points.geometric_normal
    across = np.where(np.abs(n[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    t = np.cross(across, n)
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    b = np.cross(n, t)
    size = np.maximum(points.spacing * TRIANGLE_SIZE, lift)[:, None]
    centre = points.position + n * lift
    angles = np.deg2rad([90.0, 210.0, 330.0])
    return np.stack([centre + size / 2 * (t * np.cos(a) + b * np.sin(a)) for a in angles], axis=1)


def _material(image: bpy.types.Image) -> bpy.types.Material:
    """A diffuse material whose active node is ``image``, where Blender bakes to."""
    material = bpy.data.materials.new("reference")
    if hasattr(material, "use_nodes") and not material.use_nodes:
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    diffuse, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    nodes.active = texture
    return material


@contextmanager
def lamps_off(scene: bpy.types.Scene) -> Iterator[None]:
    """The scene without its lamps; emissive meshes and the sky go on shining."""
    lamps = [o for o in scene.objects if o.type == "LIGHT" and not o.hide_render]
    for lamp in lamps:
        lamp.hide_render = True
    try:
        instances = bpy.context.evaluated_depsgraph_get().object_instances
        if left := sorted(i.object.name for i in instances if i.object.type == "LIGHT" and not i.object.hide_render):
            raise ValueError(f"lamps {left} are not objects of the scene itself and cannot be switched off")
        yield
    finally:
        for lamp in lamps:
            lamp.hide_render = False


def undrawn_light(baker: PointBaker, scene: bpy.types.Scene, *, samples: int, seed: int) -> Float32:
    """(p, 3) W/m² of the light that Eevee does not draw itself: all indirect light, and the direct light of sky and
    emissive meshes."""
    irradiance = baker.bake({"INDIRECT"}, samples=samples, seed=seed)
    with lamps_off(scene):
        return irradiance + baker.bake({"DIRECT"}, samples=samples, seed=seed)
