# SPDX-License-Identifier: GPL-3.0-or-later
"""Where aimed samples end: points on the bright targets, the same for all texels that share a pattern.

Which target a sample aims at hangs on the bake's odds alone (see ``bright``), so it is the same in every frame; where
that target lies follows the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..lamps.sky import Sky
from ..scene import Bool, Float32, Int32
from ..surface.geometry import Geometry
from ..surface.rasterise import POINTS
from ..surface.texels import BACK, TexelFrame, Texels
from .bright import BrightTargets
from .patterns import BrightPatterns


@dataclass(frozen=True)
class Aims:
    """The aims of P patterns of b samples in r rooms in one frame; row (room P + pattern) b + sample."""

    target: Int32  # (r P b,) texel, or texels' count + patch of sky
    is_sky: Bool  # (r P b,)
    point: Float32  # (r P b, 3) local, lifted off the surface; of the sky a unit direction
    normal: Float32  # (r P b, 3) out of the target's side; zero for the sky
    density: Float32  # (r P b,) of samples on the target: per m², of the sky per sr


def place_aims(
    table: BrightPatterns, bright: BrightTargets, texels: Texels, frame: TexelFrame, geometry: Geometry, sky: Sky | None
) -> Aims:
    """The aims of ``table``'s samples where their targets lie in ``frame``."""
    chosen = bright.targets(table.choice.reshape(-1))  # (r, P b)
    density = np.take_along_axis(target_density(bright, frame.area, sky), chosen, axis=1).reshape(-1)
    target = chosen.reshape(-1)
    solid = target < texels.count
    place = np.tile(table.target.reshape(-1, 2), (bright.room_count, 1))
    points, normals = np.zeros((len(target), 3), np.float32), np.zeros((len(target), 3), np.float32)
    t, on = target[solid], (place[solid, 0] * POINTS).astype(np.int64)
    points[solid] = frame.points[t, on]
    facing = np.where(texels.side[t] == BACK, np.float32(-1), np.float32(1))
    normals[solid] = geometry.normals[texels.point_triangle[t, on]] * facing[:, None]
    if sky is not None and not solid.all():
        points[~solid] = sky.directions(target[~solid] - texels.count, place[~solid, 0], place[~solid, 1])
    return Aims(target, ~solid, points, normals, density)


def target_density(bright: BrightTargets, area: Float32, sky: Sky | None) -> Float32:
    """(r, m) of aimed samples on each target: probability per m² of a texel, per sr of a patch of sky."""
    count = len(area)
    solid_angle = np.float32(1) if sky is None else sky.solid_angle
    on_texels = bright.probability[:, :count] / np.maximum(area, np.finfo(np.float32).tiny)
    return np.asarray(np.concatenate([on_texels, bright.probability[:, count:] / solid_angle], axis=1), np.float32)
