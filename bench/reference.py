# SPDX-License-Identifier: GPL-3.0-or-later
"""Stored references: converged irradiance at some texels of a scene, and how it was made.

A reference belongs to surface, not to pixels of an atlas: its texels are found again in a bake by object and place,
and a bake whose texels lie elsewhere or are of another size is refused.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rtgi_addon.backend.scene import Float32, Float64, Int32

#: Blender's versions evaluate a bevelled or solidified mesh a little differently: a few texels lie elsewhere.
MOST_LOST = 0.01
#: A texel is the reference's if it lies within this share of its side from it (partly covered ones are not placed
#: alike by all), ...
SAME_PLACE = 0.3
#: ... if its side differs by no more than this share, for wholly covered ones, ...
SAME_SIZE = 0.05
#: ... and if the normals differ by less than about 8 degrees.
SAME_NORMAL = 0.99


@dataclass(frozen=True)
class TexelTable:
    """n texels in the world, of a bake or of a reference; as in texels.npz."""

    position: Float64  # (n, 3) m
    normal: Float32  # (n, 3) unit
    area: Float32  # (n,) m²
    object: Int32  # (n,) index into names
    names: tuple[str, ...]


@dataclass(frozen=True)
class Reference:
    """The IIM (with caustics) at the texels of ``table``, W/m²."""

    table: TexelTable
    mean: Float32  # (n, 3)
    standard_error: Float32  # (n, 3)
    whole: Float32  # (n,) share of the texel's pixel that is surface
    open: Float32  # (n,) share of that surface which is not under other geometry; the mean is over this part
    made: dict[str, Any]  # how: versions, settings, seeds, seconds

    def save(self, path: Path) -> None:
        t = self.table
        np.savez_compressed(
            path,
            position=t.position.astype(np.float32),
            normal=t.normal.astype(np.float16),
            area=t.area.astype(np.float32),
            object=t.object.astype(np.int16),
            names=np.array(t.names),
            mean=self.mean.astype(np.float32),
            standard_error=self.standard_error.astype(np.float16),
            whole=self.whole.astype(np.float16),
            open=self.open.astype(np.float16),
            made=np.array(json.dumps(self.made, indent=1)),
        )


def load_reference(path: Path) -> Reference:
    with np.load(path, allow_pickle=False) as file:
        normal = file["normal"].astype(np.float32)
        table = TexelTable(
            file["position"].astype(np.float64),
            normal / np.linalg.norm(normal, axis=1, keepdims=True),
            file["area"],
            file["object"].astype(np.int32),
            tuple(file["names"].tolist()),
        )
        columns = (file[name].astype(np.float32) for name in ("mean", "standard_error", "whole", "open"))
        return Reference(table, *columns, json.loads(str(file["made"])))


def match(reference: Reference, baked: TexelTable) -> Int32:
    """(n,) the texel of ``baked`` that each of the reference's is, -1 where there is none.

    Raises ValueError where more than MOST_LOST of them have none: then the scene is another.
    """
    table = reference.table
    found = np.full(len(table.position), -1, np.int32)
    for number, name in enumerate(table.names):
        rows = np.nonzero(table.object == number)[0]
        if not len(rows):
            continue
        if name not in baked.names:
            raise ValueError(f"{name}: not in the bake; the scene has changed, make its reference anew")
        own = np.nonzero(baked.object == baked.names.index(name))[0]
        found[rows] = _nearest(reference, baked, rows, own)
    lost = np.nonzero(found < 0)[0]
    if len(lost) > MOST_LOST * len(found):
        names = sorted({table.names[i] for i in table.object[lost]})
        raise ValueError(
            f"{len(lost)} of {len(found)} texels of the reference ({', '.join(names)}) are not in the bake: "
            "scene, layout or resolution have changed, make the reference anew"
        )
    return found


def _nearest(reference: Reference, baked: TexelTable, rows: Int32, own: Int32) -> Int32:
    """The nearest of the texels ``own`` with the same normal and size, or -1."""
    table = reference.table
    result = np.full(len(rows), -1, np.int32)
    if not len(own):
        return result
    # Both sides of a wall share a place: a step along the normal by a texel tells them apart.
    side = float(np.sqrt(np.median(table.area[rows])))
    near, nearest = cKDTree(baked.position[own] + side * baked.normal[own]).query(
        table.position[rows] + side * table.normal[rows]
    )
    at = own[nearest]
    sizes = np.sqrt(baked.area[at] / table.area[rows])
    same_size = (np.abs(sizes - 1) < SAME_SIZE) | (reference.whole[rows] < 1)
    alike = np.einsum("ij,ij->i", baked.normal[at], table.normal[rows]) > SAME_NORMAL
    good = alike & (near < SAME_PLACE * side) & same_size
    result[good] = at[good]
    return result
