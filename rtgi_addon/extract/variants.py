# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that are not the same in all frames: each look of one is an instance of its own, a variant of the object.

A look is all that an instance of a scene cannot change: its faces, their materials, whether it blocks and receives
light. A variant is visible in the frames where its object has that look, so to all later stages such an object is
several that appear and vanish.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

from ..backend.scene import Instance
from ..source import SourceMesh, SourceScene, world_area
from .meshes import Faces, faces_of
from .placed import Key, Placed

#: Looks of one object at most. So many share one page's texels that each has a sixteenth of them across: not 50 across
#: for a fluid alone on the default page. A range of frames can be baked in parts without loss.
MAX_VARIANTS = 256
#: Triangles of all looks but the first, over all objects, at most. Every look is in memory for the whole bake: 260
#: bytes a triangle, 460 at times (measured), so up to 3.6 GiB.
MAX_EXTRA_TRIANGLES = 1 << 23
#: How much coarser all maps may become by the looks of objects before it is told.
COARSER_UNTOLD = 1.5
#: Runs of frames that a name lists.
RUNS_NAMED = 3


def look_of(placed: Placed, faces: Faces) -> bytes:
    """The same if and only if one variant may stand for what is ``placed``; ``faces`` are those of its mesh."""
    names = [placed.materials[slot] for slot in faces.slots if slot < len(placed.materials)]
    rest = repr((names, placed.blocks_light, placed.receives_light))
    return hashlib.blake2b(faces.digest + rest.encode(), digest_size=16).digest()


class Finder:
    """Which instance of ``source`` something placed is."""

    def __init__(self, source: SourceScene) -> None:
        self._index = {both: i for i, both in enumerate(zip(source.keys, source.looks, strict=True))}
        self._keys = set(source.keys)

    def knows(self, key: Key) -> bool:
        """Is there an instance of this object, whatever its look?"""
        return key in self._keys

    def index_or_none(self, placed: Placed) -> int | None:
        """None for an object, or a look of one, that ``source`` does not have."""
        if placed.key not in self._keys:
            return None
        alone = self._index.get((placed.key, None))
        return self._index.get((placed.key, look_of(placed, faces_of(placed.data)))) if alone is None else alone


def variant_name(name: str, shown: Sequence[int], frames: Sequence[int]) -> str:
    """``name [frames 3 to 9, 14]``: that of the variant ``shown`` in these of ``frames``."""
    runs = []
    for is_shown, run in groupby(sorted(set(frames)), set(shown).__contains__):
        first, *others = run
        if is_shown:
            runs.append(f"{first} to {others[-1]}" if others else f"{first}")
    listed = ", ".join(runs[:RUNS_NAMED]) + (", ..." if len(runs) > RUNS_NAMED else "")
    return f"{name} [frame{'s' * (len(shown) > 1)} {listed}]"


def coarseness(
    meshes: Sequence[SourceMesh], instances: Sequence[Instance], objects: Mapping[str, Sequence[int]]
) -> str:
    """What is to be told of ``objects``, the numbers of each one's instances by name: "" where maps hardly suffer."""
    if all(len(v) == 1 for v in objects.values()):
        return ""
    area = np.array([world_area(meshes[i.mesh], i.matrix_world[:3, :3]) for i in instances])
    extra = {name: float(area[list(v)].sum() - area[list(v)].max()) for name, v in objects.items() if len(v) > 1}
    alone = float(area.sum()) - sum(extra.values())
    if alone <= 0 or (coarser := (float(area.sum()) / alone) ** 0.5) < COARSER_UNTOLD:
        return ""
    worst = max(extra, key=lambda name: extra[name])
    others = f" (and {len(extra) - 1} more objects alike)" if len(extra) > 1 else ""
    return (
        f"{worst}: its faces or materials change between frames, so it takes {len(objects[worst])} sets of light maps"
        f"{others}, and all maps get {coarser:.1f} times coarser; bake fewer frames at a time, or raise --resolution"
    )
