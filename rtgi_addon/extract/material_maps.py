# SPDX-License-Identifier: GPL-3.0-or-later
"""Albedo and emission maps of one mesh whose materials vary over it, baked over its light-map layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import bpy
import numpy as np

from ..backend.scene import Bool, Float32, Float64, Int32, Material
from ..source import Layout, SourceMesh, SourceScene
from . import nodes
from .as_rendered import read_as_rendered
from .lobes import OUTPUT, Lobes
from .palette import reflectance, to_rgb
from .placed import placed_meshes
from .proxies import Carried, build_proxy, read_carried
from .stepping import frame_kept
from .texture_bake import bake_over_uv, bake_slots
from .variants import Finder

#: Samples per texel of a textured mesh: texels are coarser than most textures.
TEXTURE_SAMPLES = 4
#: About how many points of a map its mean is taken over.
MEAN_POINTS = 20_000


def bake_mesh(
    source: SourceScene,
    index: int,
    layout: Layout,
    size_px: tuple[int, int],
    carried: Carried,
    materials: Sequence[bpy.types.Material | None],
    lobes: Sequence[Lobes],
    warnings: dict[str, None],
) -> tuple[Float32, Float32 | None]:
    """(albedo map, emission map or None where nothing shines)."""
    mesh = source.meshes[index]
    used, slot = np.unique(mesh.material_of_triangle, return_inverse=True)
    proxy = build_proxy(mesh, layout, carried)
    attribute = proxy.attributes.get("material_index") or proxy.attributes.new("material_index", "INT", "FACE")
    attribute.data.foreach_set("value", slot.astype(np.int32).ravel())
    some = [lobes[i] for i in used]
    mixed = len(used) > 1 and any(lobe.any for lobe in some)
    slots = bake_slots(proxy.copy(), len(used), size_px) if mixed else None
    maps = bake_over_uv(
        proxy,
        [materials[i] for i in used],
        size_px,
        matrix=carried.matrix,
        color=carried.color,
        pass_index=carried.pass_index,
        samples=TEXTURE_SAMPLES,
    )
    albedo = reflectance(maps, some[0])
    if slots is not None:
        for number, lobe in enumerate(some):
            albedo = np.where((slots == number)[..., None], reflectance(maps, lobe), albedo)
    over = float(albedo.max(initial=0.0))
    if over > 1 + 1e-4:
        names = ", ".join(str(source.material_names[i]) for i in used)
        warnings[f"material {names} on {mesh.name}: reflects more light than it gets ({over:.3g}); clamped to 1"] = None
    shines = maps.emission.max(initial=0.0) > 0
    return np.clip(albedo, 0, 1), np.maximum(maps.emission, 0) if shines else None


def carried_of(source: SourceScene, meshes: Sequence[int]) -> dict[int, Carried]:
    """By mesh: what shaders read of its first instance, at the frame where that is first seen."""
    scene, view_layer = bpy.context.scene, bpy.context.view_layer
    first = {mesh: next(i for i, inst in enumerate(source.instances) if inst.mesh == mesh) for mesh in meshes}
    mesh_of_instance, finder = {instance: mesh for mesh, instance in first.items()}, Finder(source)
    found: dict[int, Carried] = {}

    def read(depsgraph: bpy.types.Depsgraph) -> None:
        for placed in placed_meshes(depsgraph, lambda _line: None):
            mesh = mesh_of_instance.get(finder.index_or_none(placed))
            if mesh is not None and mesh not in found:
                found[mesh] = read_carried(placed.object, placed.data, placed.matrix)

    with frame_kept(scene):
        for frame in sorted({source.first_frames[instance] for instance in first.values()}):
            if scene.frame_current != frame:
                scene.frame_set(frame)
            read_as_rendered(scene, view_layer, read)
    return found


def tell_instances(
    source: SourceScene,
    index: int,
    materials: Sequence[bpy.types.Material | None],
    varies: Bool,
    warnings: dict[str, None],
) -> None:
    """Maps are shared by the instances of a mesh: say so where a material would look different on each."""
    name = source.meshes[index].name
    users = [i.name for i in source.instances if i.mesh == index]
    for number in np.unique(source.meshes[index].material_of_triangle):
        material = materials[number]
        if nodes.is_time_dependent(material):
            line = f"material {material.name}: is animated and {name} is textured; it keeps its look of the first frame"
            warnings[line] = None
        if varies[number] and len(users) > 1:
            kinds = sorted({n.bl_idname for n in nodes.reachable(material.node_tree, OUTPUT) if _differs(n)})
            if kinds:
                line = (
                    f"material {material.name}: depends on the object it is on ({', '.join(kinds)}); "
                    f"all {len(users)} instances of {name} are baked with the look of {users[0]}"
                )
                warnings[line] = None


def _barycentric_grid(side: int) -> Float64:
    """(side², 3) centres of the small triangles that cutting each edge in ``side`` gives."""
    a, b = (x.ravel() for x in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    up, down = a + b < side, a + b < side - 1
    first = np.concatenate([a[up] + 1 / 3, a[down] + 2 / 3]) / side
    second = np.concatenate([b[up] + 1 / 3, b[down] + 2 / 3]) / side
    return np.stack([first, second, 1 - first - second], axis=1)


def _differs(node: bpy.types.Node) -> bool:
    """Does it give other values on another instance of the same mesh?"""
    linked = {socket.name for socket in node.outputs if socket.is_linked}
    if node.bl_idname == "ShaderNodeObjectInfo":
        return bool(linked - {"Material Index"})
    if node.bl_idname == "ShaderNodeNewGeometry":
        return bool(linked & {"Position", "Normal", "True Normal"})
    if node.bl_idname == "ShaderNodeTexCoord":
        return bool(linked & {"Camera", "Window", "Reflection"}) or (node.object is not None and "Object" in linked)
    return node.bl_idname == "ShaderNodeAttribute" and node.attribute_type in {"OBJECT", "INSTANCER"}


def with_means(
    constants: Sequence[Material],
    source: SourceScene,
    layouts: Sequence[Layout],
    varies: Bool,
    albedo: Sequence[Float32 | None],
    emission: Sequence[Float32 | None],
) -> tuple[Material, ...]:
    """Materials that vary get the mean over the first mesh that shows them, for whoever looks at one number."""
    out = list(constants)
    for index in np.flatnonzero(varies):
        for mesh, layout, picture, glow in zip(source.meshes, layouts, albedo, emission, strict=True):
            rows = np.flatnonzero(mesh.material_of_triangle == index)
            if picture is not None and len(rows):
                mean = _mean_over(picture, mesh, layout, rows)
                shine = np.zeros(3) if glow is None else _mean_over(glow, mesh, layout, rows)
                out[index] = replace(out[index], albedo=to_rgb(mean), emission=to_rgb(shine))
                break
    return tuple(out)


def _mean_over(picture: Float32, mesh: SourceMesh, layout: Layout, rows: Int32) -> Float64:
    """(3,) of the map over the triangles ``rows``, by their area."""
    corners = mesh.vertices[mesh.triangles[rows]].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weight = np.sqrt(np.einsum("ij,ij->i", cross, cross))
    side = int(np.clip(np.sqrt(MEAN_POINTS / len(rows)), 1, 16))
    inner = layout.corner_uv[rows][:, None]  # (rows, 1, 3, 2)
    uv = (inner * _barycentric_grid(side)[None, :, :, None]).sum(axis=2)
    height, width = picture.shape[:2]
    column = np.clip((uv[..., 0] * width).astype(np.int32), 0, width - 1)
    row = np.clip((uv[..., 1] * height).astype(np.int32), 0, height - 1)
    values = picture[row, column].mean(axis=1, dtype=np.float64)  # (rows, 3)
    total = float(weight.sum())
    return (values * weight[:, None]).sum(axis=0) / total if total > 0 else values.mean(axis=0)
