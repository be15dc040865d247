# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's scene over the frames of a bake: which meshes there are, who uses them, what moves and what deforms.

Every frame is visited once, since only that tells a mover from a still object and finds objects whose faces change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from ..backend.errors import BakeError
from ..backend.progress import Report
from ..backend.scene import Bool, Instance, Light, World
from ..source import SourceMesh, SourceScene
from . import lights, world
from .as_rendered import read_as_rendered
from .meshes import Faces, MeshArrays, faces_of, positions, read_mesh, shape_digest, without_vertices
from .placed import Key, Placed, placed_meshes
from .stepping import frame_kept
from .variants import MAX_EXTRA_TRIANGLES, MAX_VARIANTS, coarseness, look_of, variant_name

#: What one instance uses in one frame: the number of an evaluated mesh of that frame.
MeshUse = int


@dataclass
class Seen:
    """One instance over the frames: one look of an object."""

    first: Placed
    uses: dict[int, MeshUse] = field(default_factory=dict)  # by frame
    moving: bool = False


@dataclass
class Census:
    """All that the visits to the frames found."""

    warnings: list[str] = field(default_factory=list)
    seen: dict[Key, dict[bytes, Seen]] = field(default_factory=dict)  # by object and look
    arrays: dict[tuple[int, MeshUse], MeshArrays] = field(default_factory=dict)  # where an instance is first met
    faces: dict[tuple[int, MeshUse], Faces] = field(default_factory=dict)
    shape: dict[tuple[int, MeshUse], bytes] = field(default_factory=dict)  # differs where vertices or normals do
    bad: dict[tuple[int, MeshUse], Bool] = field(default_factory=dict)  # non-finite vertices
    lamps: dict[Key, Light] = field(default_factory=dict)  # as first met
    lamp_frames: dict[Key, list[int]] = field(default_factory=dict)
    lit: bool = False  # by a lamp or the sky, in any frame
    extra_triangles: int = 0  # of all looks of objects but their first

    def warn(self, line: str) -> None:
        if line not in self.warnings:
            self.warnings.append(line)


def extract_source(frames: Sequence[int], report: Report) -> SourceScene:
    """The context's scene as a render over ``frames`` would see it, positions as in the first frame.

    Steps through the frames in order (so that simulations and frame handlers run) and goes back to the frame it found.
    """
    if not frames:
        raise ValueError("extract_source needs at least one frame")
    scene, view_layer = bpy.context.scene, bpy.context.view_layer
    census, worlds = Census(), None
    with frame_kept(scene):
        for done, frame in enumerate(frames):
            report("extract", done, len(frames))
            scene.frame_set(frame)
            read_as_rendered(scene, view_layer, lambda depsgraph, at=frame: _visit(depsgraph, at, census))
            if done == 0 or world.is_animated(scene.world):
                sky = world.evaluate_world(scene.world, census.warn)
                worlds = sky if done == 0 else worlds
                census.lit |= sky is not None and not sky.is_black
    if not census.seen:
        raise BakeError(
            f"scene {scene.name}: nothing to bake, no mesh, curve, text or metaball is visible in a render; "
            "add one or enable it for rendering"
        )
    source = _assemble(census, frames, worlds)
    report("extract", len(frames), len(frames))
    return source


def _visit(depsgraph: bpy.types.Depsgraph, frame: int, census: Census) -> None:
    number_of: dict[int, MeshUse] = {}  # by address: evaluated meshes live as long as this visit
    for placed in placed_meshes(depsgraph, census.warn):
        address = placed.data.as_pointer()
        use = number_of.setdefault(address, len(number_of))
        if (frame, use) not in census.shape:
            _examine(placed, (frame, use), census)
        looks, look = census.seen.setdefault(placed.key, {}), look_of(placed, census.faces[frame, use])
        known = looks.get(look)
        if known is None:
            known = looks[look] = Seen(replace(placed, data=None, object=None))
            if (frame, use) not in census.arrays:
                census.arrays[frame, use] = read_mesh(placed.data, placed.name, warn=census.warn)
            _require_few(placed.name, len(looks), census, (frame, use))
        else:
            known.moving |= not np.array_equal(known.first.matrix, placed.matrix)
        known.uses[frame] = use
    for key, lamp in lights.lights_of(depsgraph, census.warn).items():
        census.lamps.setdefault(key, lamp)
        census.lamp_frames.setdefault(key, []).append(frame)
        census.lit |= max(lamp.power) > 0


def _examine(placed: Placed, at: tuple[int, MeshUse], census: Census) -> None:
    census.faces[at], census.shape[at] = faces_of(placed.data), shape_digest(placed.data)
    finite = np.isfinite(positions(placed.data)).all(axis=1)
    if not finite.all():
        census.bad[at] = ~finite


def _require_few(name: str, looks: int, census: Census, at: tuple[int, MeshUse]) -> None:
    """Refuse an object that changes so often that its maps would be of no use, or fill the memory."""
    if looks > 1:
        census.extra_triangles += len(census.arrays[at].triangles)
    if looks > MAX_VARIANTS or census.extra_triangles > MAX_EXTRA_TRIANGLES:
        raise BakeError(
            f"{name}: its faces or materials change too often, {looks} times up to frame {at[0]}, and it needs other "
            "light maps each time; bake fewer frames at a time with --frames, or give it fewer faces"
        )


def _assemble(census: Census, frames: Sequence[int], sky: World | None) -> SourceScene:
    """Instances that use the same mesh with the same materials in every frame share a SourceMesh."""
    material_index: dict[str | None, int] = {}
    mesh_index: dict[tuple[object, ...], int] = {}
    meshes: list[SourceMesh] = []
    instances: list[Instance] = []
    names, objects = _names(census, frames)
    for name, seen in zip(names, _all_seen(census), strict=True):
        group = (tuple(sorted(seen.uses.items())), seen.first.materials)
        if group not in mesh_index:
            mesh_index[group] = len(meshes)
            meshes.append(_source_mesh(seen, census, material_index))
        instances.append(
            Instance(
                name=name,
                mesh=mesh_index[group],
                matrix_world=seen.first.matrix,
                moving=seen.moving or len(seen.uses) < len(set(frames)),
                deforming=len({census.shape[at] for at in seen.uses.items()}) > 1,
                blocks_light=seen.first.blocks_light,
                receives_light=seen.first.receives_light,
            )
        )
    _require_faces(meshes)
    if line := coarseness(meshes, instances, objects):
        census.warn(line)
    return SourceScene(
        meshes=tuple(meshes),
        instances=tuple(instances),
        material_names=tuple(material_index),
        lights=_first_lights(census, frames[0]),
        world=sky,
        warnings=tuple(census.warnings),
        keys=tuple(key for key, looks in census.seen.items() for _ in looks),
        looks=tuple(look if len(looks) > 1 else None for looks in census.seen.values() for look in looks),
        first_frames=tuple(next(iter(seen.uses)) for seen in _all_seen(census)),
        lit=census.lit,
        lamp_keys=tuple(census.lamps),
        lamp_frames=tuple(tuple(shown) for shown in census.lamp_frames.values()),
    )


def _first_lights(census: Census, frame: int) -> tuple[Light, ...]:
    """The lamps of all frames as they are in the first ``frame``, under unique names."""
    names = unique_names([lamp.name for lamp in census.lamps.values()])
    known = [replace(lamp, name=name) for lamp, name in zip(census.lamps.values(), names, strict=True)]
    there = {key: lamp for key, lamp in census.lamps.items() if frame in census.lamp_frames[key]}
    return lights.in_order(there, tuple(census.lamps), known)


def _all_seen(census: Census) -> list[Seen]:
    """In the order of the scene's instances: those of one object side by side."""
    return [seen for looks in census.seen.values() for seen in looks.values()]


def _names(census: Census, frames: Sequence[int]) -> tuple[list[str], dict[str, list[int]]]:
    """The name of each instance, unique; and by the names of objects, the numbers of each one's instances."""
    names: list[str] = []
    objects: dict[str, list[int]] = {}
    variants = [list(looks.values()) for looks in census.seen.values()]
    for name, of_object in zip(unique_names([seen[0].first.name for seen in variants]), variants, strict=True):
        objects[name] = list(range(len(names), len(names) + len(of_object)))
        several = len(of_object) > 1
        names += [variant_name(name, list(seen.uses), frames) if several else name for seen in of_object]
    return unique_names(names), objects


def _source_mesh(seen: Seen, census: Census, material_index: dict[str | None, int]) -> SourceMesh:
    arrays = census.arrays[next(iter(seen.uses.items()))]
    bad = np.zeros(len(arrays.vertices), np.bool_)
    for at in seen.uses.items():
        bad |= census.bad.get(at, False)
    if bad.any():
        before = len(arrays.triangles)
        arrays = without_vertices(arrays, bad)
        census.warn(
            f"{seen.first.name}: {int(bad.sum())} of its vertices are not finite; the {before - len(arrays.triangles)} "
            "triangles at them are left out"
        )
    slots = seen.first.materials or (None,)
    number = np.array([material_index.setdefault(name, len(material_index)) for name in slots], np.int32)
    return SourceMesh(
        name=seen.first.name,
        vertices=arrays.vertices,
        triangles=arrays.triangles,
        corner_normals=arrays.corner_normals,
        loop_of_corner=arrays.loop_of_corner,
        polygon_of_triangle=arrays.polygon_of_triangle,
        material_of_triangle=number[arrays.slot_of_triangle],
        rtgi_uv=arrays.rtgi_uv,
    )


def _require_faces(meshes: Sequence[SourceMesh]) -> None:
    if not any(len(mesh.triangles) for mesh in meshes):
        raise BakeError("nothing to bake: no face of any object has finite vertices; repair or replace the meshes")


def unique_names(names: Sequence[str]) -> list[str]:
    """``names`` with "#2", "#3" ... after those that came before."""
    count: dict[str, int] = {}
    taken = set(names)
    out = []
    for name in names:
        count[name] = count.get(name, 0) + 1
        unique = name
        while count[name] > 1 and (unique := f"{name}#{count[name]}") in taken:
            count[name] += 1
        taken.add(unique)
        out.append(unique)
    return out
