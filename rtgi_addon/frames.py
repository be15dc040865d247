# SPDX-License-Identifier: GPL-3.0-or-later
"""The frames of a bake: each one's light computed by the session and written before the next begins.

After ``pack``, the last stages of ``bake``. A frame is noted in bake.json once its maps are on disk; a frame that an
earlier run finished from the same input is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from itertools import islice
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .backend.errors import BakeError, Cancelled
from .backend.final_gather.choice import ChoiceFile
from .backend.lamps.lights import is_dark
from .backend.progress import Report
from .backend.scene import Atlas, FrameState, LightMaps, Material, Scene
from .backend.session import Session
from .backend.stats import FrameStats
from .backend.surface.geometry import Geometry
from .backend.surface.texels import Texels, place_texels
from .environment import choices_file, device, library_folders, versions
from .exr import write_page
from .extract import frame_state
from .job import Plan
from .output import FORMAT, GUIDE, BakeFolder, FrameFailed, digest, folder_problems, map_bytes, map_name, write_arrays
from .source import SourceScene
from .terminal import Listener

#: States of a moving scene that are searched for lit sides; a search takes about a third of a frame's bake.
SIDES_TESTED = 8
#: States whose light tells where gather rays are aimed; each takes a frame's direct light.
GUIDES = 8


class FrameStates(Sequence[FrameState]):
    """The state of the open scene at each of ``frames``, read when asked for and not kept.

    ``materials`` are those of the first frame; without them, animated ones are not followed. Leaves the scene at the
    frame last read.
    """

    def __init__(self, source: SourceScene, frames: Sequence[int], materials: Sequence[Material] | None) -> None:
        self._source, self._frames, self._materials = source, frames, materials

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> FrameState:
        frame = self._frames[index]
        bpy.context.scene.frame_set(frame)
        return frame_state(self._source, frame, constants=self._materials)


def telling_states(states: Sequence[FrameState], report: Report) -> list[FrameState]:
    """The states that decide which sides light can reach: SIDES_TESTED of them evenly spaced, and each in which objects
    are shown, or lamps, sky or materials shine, that were not together before."""
    count = len(states)
    chosen = {round(i * (count - 1) / (SIDES_TESTED - 1)) for i in range(SIDES_TESTED)}
    told, seen = [], set()
    for index, state in enumerate(states):
        report("sides", index, count)
        glows = () if state.materials is None else tuple(max(m.emission) > 0 for m in state.materials)
        lamps = tuple(is_dark(light) for light in state.lights)
        kind = (state.visible.tobytes(), lamps, glows, state.world is None or state.world.is_black)
        if index in chosen or kind not in seen:
            told.append(state)
        seen.add(kind)
    return told


def guide_of(telling: Sequence[FrameState]) -> list[FrameState]:
    """Of the telling states at most GUIDES, evenly chosen, the first among them: the session lights each once more."""
    step = max(1, -(-(len(telling) - 1) // max(GUIDES - 1, 1)))
    return list(telling[::step])


def open_folder(plan: Plan) -> BakeFolder:
    """The folder that ``plan`` fills; the first thing that is written."""
    size = {"resolution": plan.atlas.resolution, "pages": plan.atlas.page_count, "kinds": 2}
    needed = 0 if plan.job.resume else map_bytes(frames=len(plan.frames), **size)
    if problems := folder_problems(plan.out, needed):
        raise BakeError(*problems)
    return BakeFolder(plan.out, header(plan), resume=plan.job.resume)


def bake_frames(plan: Plan, folder: BakeFolder, listener: Listener) -> list[dict[str, Any]]:
    """Bake and write all frames of ``plan``; their records as in bake.json, each with ``kept``."""
    records, said = [], set(plan.warnings)
    with ExitStack() as stack:
        session = _once(lambda: stack.enter_context(_session(plan, listener)))
        for index, frame in enumerate(plan.frames):
            listener.frame_begins(frame, index, len(plan.frames))
            kept = {(record["gather"], record["view_pixels"]) for record in records if record["kept"]}
            records.append(_frame(plan, folder, session, index, kept))
            listener.frame_done(frame, records[-1])
            for text in records[-1]["warnings"]:
                if text not in said:  # what holds for every frame is said once
                    listener.warn(text)
                    said.add(text)
        if plan.job.texels:
            listener.report("texels", 0, 1)
            write_arrays(plan.out / "texels.npz", texel_arrays(plan, session().texels))
            listener.report("texels", 1, 1)
    return records


def _require_one_gather(frame: int, stats: FrameStats, kept: set[tuple[str, int]]) -> None:
    """Raises BakeError where the frames ``kept`` of an earlier run, their gathers and pixels, were gathered in another
    way: the maps would change midway."""
    if kept and (stats.gather, stats.view_pixels) not in kept:
        ways = ", ".join(sorted(gather for gather, _ in kept))
        remedy = "bake anew without --resume, with the gather named by --gather"
        raise BakeError(f"frame {frame}: gathered by {stats.gather}, the frames kept by {ways}; {remedy}")


def _session(plan: Plan, listener: Listener) -> Session:
    return Session(
        plan.scene, plan.atlas, plan.job.settings, plan.states[0], guide=plan.guide, oidn_paths=library_folders(),
        choices=ChoiceFile(choices_file()), report=listener.report,
    )  # fmt: skip


def _once(make: Callable[[], Session]) -> Callable[[], Session]:
    """``make``, called when first needed: a resumed bake that has all its frames needs no session."""
    made: list[Session] = []

    def get() -> Session:
        if not made:
            made.append(make())
        return made[0]

    return get


def _frame(
    plan: Plan, folder: BakeFolder, session: Callable[[], Session], index: int, kept: set[tuple[str, int]]
) -> dict[str, Any]:
    """The frame's record; ``kept``: gathers and pixels of the frames before that an earlier run left."""
    placing, frame = FrameStats(), plan.frames[index]
    with placing.stage("extract"):
        state = plan.states[index]
        key = digest(state)
    if (finished := folder.finished_or_none(frame, key)) is not None:
        return {**finished, "kept": True}
    result = session().advance(state)
    stats = result.stats
    _require_one_gather(frame, stats, kept)
    with stats.stage("write"):
        names = _write_maps(plan, result.maps)
    record = {**asdict(stats), "seconds": {**placing.seconds, **stats.seconds}, "state": key, "files": names}
    return {**folder.commit(frame, record), "kept": False}


def _write_maps(plan: Plan, maps: LightMaps) -> list[str]:
    """Write all pages of all maps; their names."""
    names = []
    for kind, pages in (("iim", maps.iim), ("aim", maps.aim), ("caustics", maps.caustics)):
        for page in range(0 if pages is None else len(pages)):
            names.append(map_name(kind, page, maps.frame))
            write_page(plan.out / names[-1], pages[page], maps.valid[page])
    return names


@contextmanager
def failing(folder: BakeFolder) -> Iterator[None]:
    """Note in bake.json how the frames ended when they did not end well."""
    try:
        yield
    except BaseException as fault:
        # On a full disk the note may fail too; bake.json then still lists each finished frame.
        with suppress(OSError):
            folder.close("cancelled" if isinstance(fault, Cancelled) else "failed")
        if isinstance(fault, BakeError):
            raise FrameFailed(*fault.problems) from fault
        if isinstance(fault, OSError):
            remedy = "mend that and go on with --resume"
            raise FrameFailed(f"{fault.filename or folder.path}: {fault.strerror or fault}; {remedy}") from fault
        raise


def header(plan: Plan) -> dict[str, Any]:
    """bake.json without its frames."""
    return {
        "format": FORMAT,
        "versions": versions(),
        "device": device(plan.job.settings.threads),
        "settings": asdict(plan.job.settings),
        "first_frame": plan.frames[0],
        "frames_asked": list(plan.frames),
        "atlas": describe_atlas(plan.scene, plan.atlas),
        "setup_seconds": plan.setup_seconds,
        "warnings": list(plan.warnings),
        "fingerprint": {**fingerprint(plan.scene, plan.atlas), GUIDE: digest(plan.guide)},
    }


def describe_atlas(scene: Scene, atlas: Atlas) -> dict[str, Any]:
    """Pages and, for each side of each object, its rectangle in pixels: x, y from the bottom left, width, height."""
    objects = []
    for instance, front, back in zip(scene.instances, atlas.front, atlas.back, strict=True):
        for side, place in (("front", front), ("back", back)):
            if place is not None:
                rectangle = [round(v * atlas.resolution) for v in (*place.offset, *place.scale)]
                objects.append({"name": instance.name, "side": side, **asdict(place), "rectangle": rectangle})
    return {"resolution": atlas.resolution, "pages": atlas.page_count, "objects": objects}


def fingerprint(scene: Scene, atlas: Atlas) -> dict[str, str]:
    """Digests by the words for what they cover; what moves is in each frame's own ``state``."""
    bare = [replace(mesh, albedo_map=None, emission_map=None) for mesh in scene.meshes]
    textures = [(mesh.albedo_map, mesh.emission_map) for mesh in scene.meshes]
    return {
        "geometry": digest(bare),
        "set of objects": digest(scene.instances),
        "materials or textures": digest([scene.materials, textures]),
        "lamps": digest(scene.lights),
        "world": digest(scene.world),
        "layout of the light maps": digest(atlas),
    }


def texel_arrays(plan: Plan, texels: Texels) -> Iterator[tuple[str, NDArray[Any]]]:
    """The arrays of texels.npz (DESIGN §7), world space; positions of later frames only where something moves."""
    geometry = Geometry(plan.scene, plan.states[0])
    placed = place_texels(texels, geometry)
    yield from (("page", texels.page), ("row", texels.row), ("col", texels.col))
    yield "position", geometry.origin + placed.position
    yield from (("normal", placed.normal), ("area", placed.area))
    yield from (("object", texels.instance), ("side", texels.side), ("surface", texels.surface))
    yield "names", np.array([instance.name for instance in plan.scene.instances])
    if any(instance.moving or instance.deforming for instance in plan.scene.instances):
        for frame, state in zip(plan.frames[1:], islice(plan.states, 1, None), strict=True):
            geometry.update(state)
            yield f"position_{frame:04d}", geometry.origin + place_texels(texels, geometry).position
