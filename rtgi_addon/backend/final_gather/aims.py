# SPDX-License-Identifier: GPL-3.0-or-later
"""Where aimed samples end: points on the bright targets, the same for all texels that share a pattern.

Which target a sample aims at hangs on the bake's odds alone (see ``bright``), so it is the same in every frame; where
that target lies follows the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    on: NDArray[np.int64]  # (r P b,) which of a texel's points
    room: NDArray[np.int64]  # (r P b,) of the texels that aim so
    point: Float32  # (r P b, 3) local, lifted off the surface; of the sky a unit direction
    normal: Float32  # (r P b, 3) out of the target's side; zero for the sky
    density: Float32  # (r P b,) of samples on the target: per m², of the sky per sr


def place_aims(
    table: BrightPatterns, bright: BrightTargets, texels: Texels, frame: TexelFrame, geometry: Geometry, sky: Sky | None
) -> Aims:
    """The aims of ``table``'s samples where their targets lie in ``frame``."""
    chosen = bright.targets(table.choice.reshape(-1))  # (r, P b)
    target = chosen.reshape(-1)
    is_sky = target >= texels.count
    place = np.tile(table.target.reshape(-1, 2), (bright.room_count, 1))
    count = len(target)
    aims = Aims(
        target=target,
        is_sky=is_sky,
        on=(place[:, 0] * POINTS).astype(np.int64),
        room=np.repeat(np.arange(bright.room_count), chosen.shape[1]),
        point=np.zeros((count, 3), np.float32),
        normal=np.zeros((count, 3), np.float32),
        density=np.zeros(count, np.float32),
    )
    if sky is not None and is_sky.any():
        rows = np.nonzero(is_sky)[0]
        aims.point[rows] = sky.directions(target[rows] - texels.count, place[rows, 0], place[rows, 1])
        aims.density[rows] = (
            bright.probability[aims.room[rows], target[rows]] / sky.solid_angle[target[rows] - texels.count]
        )
    follow_aims(aims, np.nonzero(~is_sky)[0], bright, texels, frame, geometry)
    return aims


def follow_aims(
    aims: Aims, rows: NDArray[np.int64], bright: BrightTargets, texels: Texels, frame: TexelFrame, geometry: Geometry
) -> None:
    """Bring the aims ``rows`` (k,), all at texels, to where those lie in ``frame``."""
    target, on = aims.target[rows], aims.on[rows]
    aims.point[rows] = frame.points[target, on]
    facing = np.where(texels.side[target] == BACK, np.float32(-1), np.float32(1))
    aims.normal[rows] = geometry.normals[texels.point_triangle[target, on]] * facing[:, None]
    aims.density[rows] = density_on_texels(bright.probability[aims.room[rows], target], frame.area[target])


def target_density(bright: BrightTargets, area: Float32, sky: Sky | None) -> Float32:
    """(r, m) of aimed samples on each target: probability per m² of a texel, per sr of a patch of sky.

    Nothing is aimed at a sky that no guide state has.
    """
    count = len(area)
    on_texels = density_on_texels(bright.probability[:, :count], area)
    if sky is None:
        return on_texels
    on_sky = np.zeros((len(on_texels), sky.count), np.float32)
    if bright.probability.shape[1] > count:
        on_sky[:] = bright.probability[:, count:] / sky.solid_angle
    return np.concatenate([on_texels, on_sky], axis=1)


def density_on_texels(probability: Float32, area: Float32) -> Float32:
    """1/m²; arrays that broadcast."""
    return np.asarray(probability / np.maximum(area, np.finfo(np.float32).tiny), np.float32)
