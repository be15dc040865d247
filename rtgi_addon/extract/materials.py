# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's materials as backend materials and, where they vary over a mesh, as albedo and emission maps.

All materials are evaluated together on a palette of one quad each; only meshes with a material that varies are baked
over their own light-map layout. Rough reflection counts as diffuse, so that its energy is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ..backend.errors import BakeError
from ..backend.progress import Report
from ..backend.scene import Bool, Float32, Float64, Material
from ..source import Layout, SourceScene
from . import nodes
from .as_rendered import read_as_rendered
from .lobes import OUTPUT, Lobes, read_lobes
from .meshes import UV_LAYER
from .placed import placed_meshes
from .proxies import Carried, build_proxy, read_carried
from .stepping import frame_kept
from .texture_bake import Evaluated, bake_over_uv, bake_slots

#: Pixels of one material's cell of the palette; the inner ones are read.
CELL = 4
#: Samples per texel of a textured mesh: texels are coarser than most textures.
TEXTURE_SAMPLES = 4
DEFAULT_NAME = "(no material)"


@dataclass(frozen=True)
class Appearance:
    """Follows SourceScene.material_names and .meshes."""

    materials: tuple[Material, ...]
    albedo_maps: list[Float32 | None]  # (h, w, 3) over the mesh's layout
    emission_maps: list[Float32 | None]  # (h, w, 3) radiance, W/(m² sr)
    warnings: tuple[str, ...] = ()


def evaluate_materials(
    source: SourceScene, layouts: Sequence[Layout], resolution_px: Sequence[tuple[int, int]], report: Report
) -> Appearance:
    """``resolution_px`` (width, height) of each mesh's maps. The scene must be at the first frame of the bake."""
    warnings: dict[str, None] = {}  # keeps order
    materials = [_find(name) for name in source.material_names]
    _require_images(materials)
    lobes = [Lobes() if m is None else read_lobes(m) for m in materials]
    for material, lobe in zip(materials, lobes, strict=True):
        warnings.update({f"material {material.name}: {note}": None for note in lobe.notes if material is not None})
    varies = np.array([m is not None and _varies(m) for m in materials], np.bool_)
    textured = [i for i, m in enumerate(source.meshes) if varies[np.unique(m.material_of_triangle)].any()]
    report("materials", 0, 1 + len(textured))
    constants = _evaluate_constants(source.material_names, materials, lobes, varies, warnings)
    albedo: list[Float32 | None] = [None] * len(source.meshes)
    emission: list[Float32 | None] = [None] * len(source.meshes)
    carried = _read_carried(source, textured) if textured else {}
    for done, index in enumerate(textured):
        report("materials", 1 + done, 1 + len(textured))
        albedo[index], emission[index] = _bake_mesh(
            source, index, layouts[index], resolution_px[index], carried[index], materials, lobes, warnings
        )
        _tell_instances(source, index, materials, varies, warnings)
    constants = _with_means(constants, source, varies, albedo, emission)
    _require_light(source, constants, emission)
    report("materials", 1 + len(textured), 1 + len(textured))
    return Appearance(constants, albedo, emission, tuple(warnings))


def animated_constants(source: SourceScene, constants: Sequence[Material]) -> tuple[Material, ...] | None:
    """``constants`` with the animated ones evaluated at the current frame; None where none is."""
    materials = [_find(name) for name in source.material_names]
    moving = [i for i, m in enumerate(materials) if nodes.is_time_dependent(m) and not _varies(m)]
    if not moving:
        return None
    some = [materials[i] for i in moving]
    lobes = [read_lobes(m) for m in some]
    names = [source.material_names[i] for i in moving]
    new = _evaluate_constants(names, some, lobes, np.zeros(len(some), np.bool_), {})
    out = list(constants)
    for index, material in zip(moving, new, strict=True):
        out[index] = material
    return tuple(out)


# --- one value per material ---------------------------------------------------------------------------------------


def _evaluate_constants(
    names: Sequence[str | None],
    materials: Sequence[bpy.types.Material | None],
    lobes: Sequence[Lobes],
    varies: Bool,
    warnings: dict[str, None],
) -> tuple[Material, ...]:
    if not materials:
        return ()
    cells = bake_over_uv(_palette(len(materials)), materials, (CELL * len(materials), CELL), margin=0)
    out = []
    for index, (name, lobe) in enumerate(zip(names, lobes, strict=True)):
        inner = (slice(1, CELL - 1), slice(index * CELL + 1, (index + 1) * CELL - 1))
        cell = Evaluated(*(getattr(cells, field)[inner] for field in ("diffuse", "glossy", "transmission", "emission")))
        albedo = _reflectance(cell, lobe).mean(axis=(0, 1))
        if not varies[index]:
            albedo = _clamped(albedo, name, warnings)
        opacity = 1 - float(np.clip(lobe.transparent.mean(), 0, 1))
        out.append(
            Material(
                name=name or DEFAULT_NAME,
                albedo=_rgb(albedo),
                emission=_rgb(np.maximum(cell.emission.mean(axis=(0, 1)), 0)),
                specular=_rgb(_unmixed(lobe.specular, opacity)),
                transmission=_rgb(_unmixed(lobe.transmission, opacity)),
                ior=lobe.ior,
                opacity=opacity,
            )
        )
    return tuple(out)


def _reflectance(cell: Evaluated, lobe: Lobes) -> Float32:
    """(h, w, 3) what is neither mirror nor glass, of the light that the surface does not let straight through."""
    opacity = 1 - float(np.clip(lobe.transparent.mean(), 0, 1))
    rough = cell.glossy - lobe.specular.astype(np.float32)
    if lobe.transmission.max() > 0:
        # Glass reflects by Fresnel's law, which the tracer follows from the index of refraction.
        rough = np.zeros_like(rough)
    return np.asarray(_unmixed(cell.diffuse + np.maximum(rough, 0), opacity), np.float32)


def _unmixed(share: Float32 | Float64, opacity: float) -> Float64:
    """Cycles weighs what it gives by opacity; backend materials hold it for the opaque part."""
    return np.asarray(share / opacity if opacity > 1e-6 else np.zeros_like(share), np.float64)


def _clamped(albedo: Float64, name: str | None, warnings: dict[str, None]) -> Float64:
    if albedo.max(initial=0.0) > 1 + 1e-5:
        warnings[
            f"material {name}: reflects more light than it gets ({albedo.max():.3g}); its albedo is clamped to 1"
        ] = None
    return np.clip(albedo, 0, 1)


def _palette(count: int) -> bpy.types.Mesh:
    """One quad per material, each over its own square of the UV layer RTGI."""
    mesh = bpy.data.meshes.new("rtgi_palette")
    left = np.arange(count, dtype=np.float64)
    x = np.stack([left, left + 1, left + 1, left], axis=1)
    y = np.broadcast_to([0.0, 0.0, 1.0, 1.0], x.shape)
    faces = np.arange(4 * count).reshape(-1, 4)
    mesh.from_pydata(np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).tolist(), [], faces.tolist())
    layer = mesh.uv_layers.new(name=UV_LAYER)
    layer.uv.foreach_set("vector", np.stack([x / count, y], axis=-1).astype(np.float32).ravel())
    index = mesh.attributes.new("material_index", "INT", "FACE")
    index.data.foreach_set("value", np.arange(count, dtype=np.int32))
    return mesh


# --- maps over a mesh ---------------------------------------------------------------------------------------------


def _bake_mesh(
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
    albedo = _reflectance(maps, some[0])
    if slots is not None:
        for number, lobe in enumerate(some):
            albedo = np.where((slots == number)[..., None], _reflectance(maps, lobe), albedo)
    over = float(albedo.max(initial=0.0))
    if over > 1 + 1e-4:
        names = ", ".join(str(source.material_names[i]) for i in used)
        warnings[f"material {names} on {mesh.name}: reflects more light than it gets ({over:.3g}); clamped to 1"] = None
    shines = maps.emission.max(initial=0.0) > 0
    return np.clip(albedo, 0, 1), np.maximum(maps.emission, 0) if shines else None


def _read_carried(source: SourceScene, meshes: Sequence[int]) -> dict[int, Carried]:
    """By mesh: what shaders read of its first instance, at the frame where that is first seen."""
    scene, view_layer = bpy.context.scene, bpy.context.view_layer
    first = {mesh: next(i for i, inst in enumerate(source.instances) if inst.mesh == mesh) for mesh in meshes}
    mesh_of_key = {source.keys[instance]: mesh for mesh, instance in first.items()}
    found: dict[int, Carried] = {}

    def read(depsgraph: bpy.types.Depsgraph) -> None:
        for placed in placed_meshes(depsgraph, lambda _line: None):
            mesh = mesh_of_key.get(placed.key)
            if mesh is not None and mesh not in found:
                found[mesh] = read_carried(placed.object, placed.data, placed.matrix)

    with frame_kept(scene):
        for frame in sorted({source.first_frames[instance] for instance in first.values()}):
            if scene.frame_current != frame:
                scene.frame_set(frame)
            read_as_rendered(scene, view_layer, read)
    return found


def _tell_instances(
    source: SourceScene,
    index: int,
    materials: Sequence[bpy.types.Material | None],
    varies: Bool,
    warnings: dict[str, None],
) -> None:
    """Maps are shared by the instances of a mesh: say so where a material would look different on each."""
    used = [i for i in np.unique(source.meshes[index].material_of_triangle) if varies[i]]
    users = [i.name for i in source.instances if i.mesh == index]
    for material in (materials[i] for i in used):
        kinds = {n.bl_idname for n in nodes.reachable(material.node_tree, OUTPUT)} & nodes.OBJECT_NODES
        if len(users) > 1 and any(_differs(n) for n in nodes.reachable(material.node_tree, OUTPUT)):
            warnings[
                f"material {material.name}: depends on the object it is on ({', '.join(sorted(kinds))}); all "
                f"{len(users)} instances of {source.meshes[index].name} are baked with the look of {users[0]}"
            ] = None
        if nodes.is_time_dependent(material):
            warnings[
                f"material {material.name}: its texture is animated; the bake keeps the look of its first frame"
            ] = None


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


def _with_means(
    constants: Sequence[Material],
    source: SourceScene,
    varies: Bool,
    albedo: Sequence[Float32 | None],
    emission: Sequence[Float32 | None],
) -> tuple[Material, ...]:
    """Materials that vary get the mean over the first map that shows them, for whoever looks at one number."""
    out = list(constants)
    for index in np.flatnonzero(varies):
        for mesh, picture, glow in zip(source.meshes, albedo, emission, strict=True):
            if picture is not None and (mesh.material_of_triangle == index).any():
                shine = np.zeros(3) if glow is None else glow.mean(axis=(0, 1), dtype=np.float64)
                mean = picture.mean(axis=(0, 1), dtype=np.float64)
                out[index] = replace(out[index], albedo=_rgb(mean), emission=_rgb(shine))
                break
    return tuple(out)


# --- what the user must mend --------------------------------------------------------------------------------------


def _find(name: str | None) -> bpy.types.Material | None:
    if name is None:
        return None
    for material in bpy.data.materials:
        if material.name_full == name:
            return material
    raise BakeError(f"material {name}: no longer in the file; start the bake again")


def _varies(material: bpy.types.Material) -> bool:
    """Does it differ from point to point, as far as its nodes can tell?"""
    if not nodes.uses_nodes(material):
        return False
    return any(n.bl_idname not in nodes.PLAIN_NODES for n in nodes.reachable(material.node_tree, OUTPUT))


def _require_images(materials: Sequence[bpy.types.Material | None]) -> None:
    problems = [
        f"material {material.name}: image file {path} is missing; restore or relink it, or remove the node"
        for material in materials
        if material is not None and nodes.uses_nodes(material)
        for path in nodes.missing_images(material.node_tree, OUTPUT)
    ]
    if problems:
        raise BakeError(*problems)


def _require_light(source: SourceScene, constants: Sequence[Material], emission: Sequence[Float32 | None]) -> None:
    shines = any(glow is not None for glow in emission) or any(max(m.emission) > 0 for m in constants)
    animated = any(nodes.is_time_dependent(_find(name)) for name in source.material_names if name is not None)
    if not (source.lit or shines or animated):
        raise BakeError(
            "the scene has no light: every lamp is off, the world is black and no material emits; "
            "add a lamp, give the world a colour, or give a material some emission"
        )


def _rgb(values: Float64) -> tuple[float, float, float]:
    red, green, blue = (float(v) for v in values)
    return red, green, blue
