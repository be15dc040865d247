# SPDX-License-Identifier: GPL-3.0-or-later
"""Bright targets: where a final gather aims its samples, since a cosine ray seldom finds a small bright spot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..lamps.sky import Sky
from ..scene import Float32, Float64, Int32


@dataclass(frozen=True)
class BrightTargets:
    """What aimed samples of n texels choose from: the odds of each of the m targets, other ones in each of r rooms."""

    room: Int32  # (n,) of each texel
    probability: Float32  # (r, m) sums to one in each room, or to zero in all
    cdf: Float64  # (r, m + 1)

    @property
    def any(self) -> bool:
        return bool(self.cdf[0, -1] > 0)

    @property
    def room_count(self) -> int:
        return len(self.cdf)

    def targets(self, choice: Float32) -> Int32:
        """(r, k) the target that each number (k,) in [0, 1) chooses in each room."""
        chosen = np.stack([np.searchsorted(cdf, choice, side="right") - 1 for cdf in self.cdf])
        return np.asarray(np.clip(chosen, 0, max(self.probability.shape[1] - 1, 0)), np.int32)


def bright_weight(radiosity: Float32, area: Float32, sky: Sky | None, extent: float) -> Float64:
    """(m,) expected share of a receiver's irradiance, summing to one or zero: B A for texels, π L Ω (D/4)² for sky.

    radiosity (n + sky.count, 3) W/m² · area (n,) m² · extent: the scene's diagonal D; its quarter stands for the
    distance of a typical target.
    """
    luminance = radiosity.astype(np.float64).sum(axis=1)
    weight = np.zeros(len(radiosity))
    count = len(area)
    weight[:count] = luminance[:count] * area
    if sky is not None and sky.count > 1:
        # A sky of one colour is best sampled by the cosine rays alone.
        weight[count:] = luminance[count:] * sky.solid_angle * (extent / 4) ** 2
    total = weight.sum()
    return weight / total if total > 0 else weight


def bright_targets(weights: Sequence[Float64], room: Int32) -> BrightTargets:
    """Odds for a whole bake: the mean of the ``weights`` (m,) of its guide states, of those that have light.

    What is lit in one frame and dark in the next is aimed at in both: odds that followed the light would make every
    aimed ray another one whenever a lamp moves. room (n,) of each texel, see ``rooms``: samples are aimed at targets of
    the texel's own room and at the sky; those of room 0, and of rooms without any light, at all.
    """
    mean = np.sum(weights, axis=0)
    count = int(room.max(initial=0)) + 1
    of_room = np.zeros((count, len(mean)))
    for number in range(count):
        of_room[number] = mean
        of_room[number, : len(room)][room != number] *= number == 0
        if not of_room[number].any():
            of_room[number] = mean
    total = of_room.sum(axis=1, keepdims=True)
    odds = np.divide(of_room, total, out=np.zeros_like(of_room), where=total > 0)
    cdf = np.concatenate([np.zeros((count, 1)), np.cumsum(odds, axis=1)], axis=1)
    # A number just below one must land on the last target that has odds, not behind it.
    cdf[:, 1:][(cdf[:, 1:] == cdf[:, -1:]) & (total > 0)] = 1.0
    return BrightTargets(room, odds.astype(np.float32), cdf)
