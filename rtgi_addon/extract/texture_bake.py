# SPDX-License-Identifier: GPL-3.0-or-later
"""Cycles evaluates materials: reflectance and emission over a mesh's UV layer, no light involved.

Works on copies of the materials; each copy gets an image node, which is where Cycles bakes to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ..backend.scene import Float32, Float64, Int32
from .as_rendered import quiet_render_handlers
from .cycles_scene import cycles_scene, temporary
from .meshes import UV_LAYER

#: Texels around each island that repeat its border, for bilinear lookups.
MARGIN = 8
GREY = 0.8  # what Blender shows where a face has no material


@dataclass(frozen=True)
class Evaluated:
    """Pictures (h, w, 3), row 0 at the bottom. Reflectances are at normal incidence."""

    diffuse: Float32
    glossy: Float32
    emission: Float32  # radiance, W/(m² sr)


def bake_over_uv(
    mesh: bpy.types.Mesh,
    materials: Sequence[bpy.types.Material | None],
    size_px: tuple[int, int],
    *,
    matrix: Float64 | None = None,
    color: Sequence[float] = (1, 1, 1, 1),
    pass_index: int = 0,
    samples: int = 1,
    margin: int = MARGIN,
) -> Evaluated:
    """``mesh`` has the UV layer RTGI and ``material_index`` into ``materials``. It is removed."""
    kinds = ("DIFFUSE", "GLOSSY", "EMIT")
    with temporary() as blocks:
        blocks.append(mesh)
        image = _target(size_px, blocks)
        copies = [_bakeable_copy(material, image) for material in materials]
        blocks += copies
        pictures = _bake_all(
            kinds, mesh, copies, image, samples, margin, matrix=matrix, color=color, pass_index=pass_index
        )
    return Evaluated(*pictures)


def bake_slots(mesh: bpy.types.Mesh, count: int, size_px: tuple[int, int]) -> Int32:
    """(h, w) the material slot, of ``count``, that each texel of the layer RTGI shows. ``mesh`` is removed."""
    with temporary() as blocks:
        blocks.append(mesh)
        image = _target(size_px, blocks)
        numbers = []
        for slot in range(count):
            material = bpy.data.materials.new("rtgi_slot")
            _plain_shader(material, "ShaderNodeEmission", {"Color": (1.0, 1.0, 1.0, 1.0), "Strength": float(slot)})
            numbers.append(material)
        blocks += numbers
        for material in numbers:
            _aim_at(material, image)
        (picture,) = _bake_all(("EMIT",), mesh, numbers, image, 1, MARGIN)
    return np.clip(np.rint(picture[..., 0]), 0, count - 1).astype(np.int32)


def _target(size_px: tuple[int, int], blocks: list[bpy.types.ID]) -> bpy.types.Image:
    image = bpy.data.images.new("rtgi_bake", *size_px, alpha=True, float_buffer=True)
    blocks.append(image)
    image.colorspace_settings.name = "Non-Color"
    return image


def _bake_all(
    kinds: Sequence[str],
    mesh: bpy.types.Mesh,
    materials: Sequence[bpy.types.Material],
    image: bpy.types.Image,
    samples: int,
    margin: int,
    *,
    matrix: Float64 | None = None,
    color: Sequence[float] = (1, 1, 1, 1),
    pass_index: int = 0,
) -> list[Float32]:
    with cycles_scene(samples) as scene, temporary() as blocks:
        for material in materials:
            mesh.materials.append(material)
        obj = bpy.data.objects.new("rtgi_bake", mesh)
        blocks.append(obj)
        obj.color, obj.pass_index = color, pass_index
        if matrix is not None:
            obj.matrix_world = matrix.T.tolist()  # Blender takes columns
        scene.collection.objects.link(obj)
        view_layer = scene.view_layers[0]
        view_layer.update()
        obj.select_set(True, view_layer=view_layer)
        view_layer.objects.active = obj
        with quiet_render_handlers():
            return [_bake(kind, scene, obj, image, margin) for kind in kinds]


def _bakeable_copy(material: bpy.types.Material | None, image: bpy.types.Image) -> bpy.types.Material:
    if material is None:
        copy = bpy.data.materials.new("rtgi_bake")
        _plain_shader(copy, "ShaderNodeBsdfDiffuse", {"Color": (GREY, GREY, GREY, 1.0)})
    else:
        copy = material.copy()
        if bpy.app.version < (5, 0, 0) and not material.use_nodes:
            _plain_shader(copy, "ShaderNodeBsdfDiffuse", {"Color": tuple(material.diffuse_color)})
    _aim_at(copy, image)
    return copy


def _aim_at(material: bpy.types.Material, image: bpy.types.Image) -> None:
    """Cycles bakes a material into the image of its active node."""
    tree = material.node_tree
    for node in tree.nodes:
        node.select = False
    target = tree.nodes.new("ShaderNodeTexImage")
    target.image = image
    tree.nodes.active = target


def _plain_shader(material: bpy.types.Material, kind: str, values: dict[str, object]) -> None:
    """Make the node ``kind`` with these inputs the whole surface."""
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    shader, output = tree.nodes.new(kind), tree.nodes.new("ShaderNodeOutputMaterial")
    for key, value in values.items():
        shader.inputs[key].default_value = value
    tree.links.new(shader.outputs[0], output.inputs["Surface"])


def _bake(kind: str, scene: bpy.types.Scene, obj: bpy.types.Object, image: bpy.types.Image, margin: int) -> Float32:
    context = {
        "scene": scene,
        "view_layer": scene.view_layers[0],
        "object": obj,
        "active_object": obj,
        "selected_objects": [obj],
    }
    with bpy.context.temp_override(**context):
        bpy.ops.object.bake(
            type=kind,
            pass_filter=set() if kind == "EMIT" else {"COLOR"},
            margin=margin,
            margin_type="EXTEND",
            use_clear=True,
            target="IMAGE_TEXTURES",
            save_mode="INTERNAL",
            use_selected_to_active=False,
            use_split_materials=False,
            uv_layer=UV_LAYER,
        )
    width, height = image.size
    pixels = np.zeros(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return np.nan_to_num(pixels.reshape(height, width, 4)[..., :3], posinf=0, neginf=0)
