# SPDX-License-Identifier: GPL-3.0-or-later
"""A finished bake taken up again for showing: the open scene, its layouts, and the atlas that bake.json describes.

Layouts are made anew, which gives the same ones while the geometry is the same; that is checked. Nothing is computed
or written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from .arguments import typed_settings
from .backend.errors import BakeError
from .backend.progress import Report
from .backend.scene import Atlas, FrameState, Placement, Scene
from .extract import Appearance, extract_source
from .frames import FrameStates, fingerprint
from .layouts import assemble, expected_densities, lay_out
from .lightmap_nodes import MapFiles
from .lightmaps import map_files
from .output import read_record
from .source import Layout, SourceScene


@dataclass(frozen=True)
class Baked:
    """What ``apply_lightmaps`` wants."""

    source: SourceScene
    layouts: list[Layout]
    atlas: Atlas
    maps: MapFiles
    states: Sequence[FrameState]  # of maps.frames


def reopen(folder: Path, report: Report) -> Baked:
    """The bake of the open scene that ``folder`` holds; of a bake cut short, the frames before the first gap."""
    record = read_record(folder)
    if record is None:
        raise BakeError(f"{folder}: holds no bake.json; bake the scene there first, with rtgi bake --out")
    asked = record["frames_asked"]
    frames = list(takewhile(lambda frame: str(frame) in record["frames"], asked))
    if not frames:
        raise BakeError(f"{folder}: its bake ended before the first frame; go on with rtgi bake --resume")
    source = extract_source(asked, report)
    layouts, _ = lay_out(source, expected_densities(source, typed_settings(record["settings"])), report)
    without_maps = [None] * len(source.meshes)
    scene = assemble(source, layouts, Appearance((), without_maps, without_maps))
    atlas = read_atlas(record["atlas"], scene)
    _require_same(folder, record, fingerprint(scene, atlas))
    maps = map_files(folder, page_count=atlas.page_count, frames=frames)
    return Baked(source, layouts, atlas, maps, FrameStates(source, frames, None))


def read_atlas(described: dict[str, Any], scene: Scene) -> Atlas:
    """What ``describe_atlas`` wrote; objects that ``scene`` does not have are left out."""
    index = {instance.name: number for number, instance in enumerate(scene.instances)}
    sides: dict[str, list[Placement | None]] = {side: [None] * len(scene.instances) for side in ("front", "back")}
    for entry in described["objects"]:
        if entry["name"] in index:
            place = Placement(entry["page"], tuple(entry["scale"]), tuple(entry["offset"]))
            sides[entry["side"]][index[entry["name"]]] = place
    return Atlas(described["resolution"], described["pages"], tuple(sides["front"]), tuple(sides["back"]))


def _require_same(folder: Path, record: dict[str, Any], now: dict[str, str]) -> None:
    changed = [name for name in ("geometry", "set of objects") if record["fingerprint"][name] != now[name]]
    if changed:
        raise BakeError(f"{folder}: the {' and the '.join(changed)} changed since it was baked; bake the scene again")
