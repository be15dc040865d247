# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked light maps on the open scene, and off it again.

After ``write``, before a preview or a saved copy. Each lit object carries its rectangle of the atlas in custom
properties and the layout in its UV layer RTGI; one node group, shared by all materials, reads both. What is added is
marked in the file itself, so that :func:`remove_lightmaps` needs no record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from .backend.errors import BakeError
from .backend.scene import Atlas, FrameState, Placement
from .eevee_light import restore_world
from .extract.as_rendered import read_as_rendered
from .extract.source_scene import frame_kept
from .lightmap_nodes import make_group, remove_group
from .lightmap_sampling import MARK, OFFSET_PROPERTIES, SCALE_PROPERTIES, UV_LAYER, MapFiles
from .lightmap_slots import light_materials, unlight_materials
from .motion import Motion, held, motions, span_shown, to_rigid
from .point_cache import play_pc2, write_pc2
from .source import Layout, SourceScene
from .standins import Survey, add_object, hide_originals, make_mesh, remove_standins, survey
from .unwrap import loop_uv, write_uv_layer

_UV_ADDED = MARK + "_uv"


@dataclass(frozen=True)
class Applied:
    """What was put on the scene."""

    objects: tuple[str, ...]  # full names of those that show light maps, stand-ins among them
    standins: int
    warnings: tuple[str, ...]


def apply_lightmaps(
    source: SourceScene, layouts: Sequence[Layout], atlas: Atlas, maps: MapFiles, states: Sequence[FrameState]
) -> Applied:
    """Make Eevee draw ``maps`` on the open scene; ``states`` are those of ``maps.frames``.

    ``source`` and ``layouts`` are of this scene at its present, unlit state. Deforming stand-ins keep their vertices
    in files beside the maps. Leaves the scene's frame as it was.
    """
    remove_lightmaps()
    _require(maps)
    scene = bpy.context.scene
    with frame_kept(scene):
        found = Survey()
        for frame in maps.frames:
            new_lamps = any(shown[0] == frame for shown in source.lamp_frames)
            if new_lamps or len(found.known) < len(source.instances):
                scene.frame_set(frame)
                read_as_rendered(scene, bpy.context.view_layer, lambda depsgraph: survey(depsgraph, source, found))
        chosen = sorted(found.known - set(found.own))
        moves, lamps = _motions(source, states, chosen, found)
    try:
        return _apply(source, layouts, atlas, maps, found, moves, lamps)
    except BaseException:  # a full disk, an interrupt: the scene must not stay half lit
        remove_lightmaps()
        raise


def _apply(
    source: SourceScene,
    layouts: Sequence[Layout],
    atlas: Atlas,
    maps: MapFiles,
    found: Survey,
    moves: dict[int, Motion],
    lamps: dict[str, Motion],
) -> Applied:
    group = make_group(maps)
    lit = _place_own(source, layouts, atlas, found) + _add_standins(source, layouts, atlas, maps, found, moves)
    lamp_data = {light.name_full: light for light in bpy.data.lights}
    for name, motion in lamps.items():
        add_object(name, lamp_data[found.lamps[name]], motion, maps.frames)
    hide_originals(found.hidden)
    warnings = light_materials(lit, group)
    return Applied(tuple(obj.name_full for obj in lit), len(moves), (*found.lost, *warnings))


def remove_lightmaps() -> None:
    """Take everything :func:`apply_lightmaps` added off the open file; the scene is as it was."""
    restore_world(bpy.context.scene)
    unlight_materials()
    remove_standins()
    remove_group()
    for obj in bpy.data.objects:
        for name in (*SCALE_PROPERTIES, *OFFSET_PROPERTIES):
            if name in obj:
                del obj[name]
    for mesh in [m for m in bpy.data.meshes if m.get(_UV_ADDED)]:
        del mesh[_UV_ADDED]
        layers = mesh.uv_layers
        if UV_LAYER in layers:
            used = [(layer.name, layer.active, layer.active_render) for layer in layers if layer.name != UV_LAYER]
            layers.remove(layers[UV_LAYER])
            for name, active, rendered in used:
                layers[name].active = active or layers[name].active
                layers[name].active_render = rendered or layers[name].active_render


def _require(maps: MapFiles) -> None:
    missing = [
        f"{path}: does not exist; bake that frame"
        for frame in maps.frames
        for kind in maps.kinds
        for path in (maps.path(kind, page, frame) for page in range(maps.page_count))
        if not path.is_file()
    ]
    if missing:
        raise BakeError(*missing)


def _motions(
    source: SourceScene, states: Sequence[FrameState], chosen: Sequence[int], found: Survey
) -> tuple[dict[int, Motion], dict[str, Motion]]:
    """Of the ``chosen`` instances and of the lamps of hidden instancers, over all frames."""
    if not chosen:
        return {}, {}
    read = [states[i] for i in range(len(states))]  # once: each is a visit to the scene
    lamps = {}
    for number, light in enumerate(source.lights):
        if light.name in found.lamps:
            shown = np.isin([state.frame for state in read], source.lamp_frames[number])
            matrices = np.array([read[i].lights[number].matrix_world for i in held(shown)])
            lamps[light.name] = Motion(matrices, shown)
    return motions(source, read, chosen), lamps


def _place_own(source: SourceScene, layouts: Sequence[Layout], atlas: Atlas, found: Survey) -> list[bpy.types.Object]:
    """UV layers and properties of the objects that keep themselves; those that are lit."""
    objects = {obj.name_full: obj for obj in bpy.data.objects}
    lit = []
    for index, name in found.own.items():
        obj, mesh = objects[name], source.instances[index].mesh
        if not _set_placement(obj, atlas.front[index], atlas.back[index]):
            continue
        lit.append(obj)
        if source.meshes[mesh].rtgi_uv is None and not obj.data.get(_UV_ADDED):
            loops = len(obj.data.loops)
            write_uv_layer(obj.data, loop_uv(source.meshes[mesh], layouts[mesh].corner_uv, loops))
            obj.data[_UV_ADDED] = True
    return lit


def _add_standins(
    source: SourceScene,
    layouts: Sequence[Layout],
    atlas: Atlas,
    maps: MapFiles,
    found: Survey,
    moves: dict[int, Motion],
) -> list[bpy.types.Object]:
    """The stand-ins; those that are lit. Instances share a mesh where none is sheared or deforms."""
    shared: dict[int, bpy.types.Mesh] = {}
    lit = []
    for index, motion in moves.items():
        name, mesh = source.instances[index].name, source.instances[index].mesh
        copy = found.copies[mesh]
        motion = to_rigid(motion, copy.positions)
        uv = loop_uv(source.meshes[mesh], layouts[mesh].corner_uv, len(copy.vertex_of_loop))
        if motion.vertices is not None:
            data = make_mesh(copy, name, uv)
        else:
            data = shared[mesh] = shared.get(mesh) or make_mesh(copy, source.meshes[mesh].name, uv)
        obj = add_object(name, data, motion, maps.frames)
        if motion.vertices is not None:
            path, span = maps.folder / f"standin.{index:04d}.pc2", span_shown(motion)
            write_pc2(path, motion.vertices[span])
            play_pc2(obj, path, maps.frames[span])
        if _set_placement(obj, atlas.front[index], atlas.back[index]):
            lit.append(obj)
    return lit


def _set_placement(obj: bpy.types.Object, front: Placement | None, back: Placement | None) -> bool:
    """Give ``obj`` its rectangles; False if it has none."""
    for place, scale, offset in zip((front, back), SCALE_PROPERTIES, OFFSET_PROPERTIES, strict=True):
        if place is not None:
            obj[scale] = (*map(float, place.scale), place.page + 1.0)
            obj[offset] = (*map(float, place.offset), 0.0)
    return front is not None or back is not None


def map_files(folder: Path, *, page_count: int, frames: Sequence[int]) -> MapFiles:
    """The maps that a bake left in ``folder``; caustics where it made any."""
    has_caustics = (folder / f"caustics.p0.{frames[0]:04d}.exr").is_file()
    return MapFiles(folder, ("iim", "caustics") if has_caustics else ("iim",), page_count, tuple(frames))
