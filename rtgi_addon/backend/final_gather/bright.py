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
    """What aimed samples choose from: the probability of each of the m targets."""

    probability: Float32  # (m,) sums to one
    cdf: Float64  # (m + 1,)

    @property
    def any(self) -> bool:
        return bool(self.cdf[-1] > 0)

    def targets(self, choice: Float32) -> Int32:
        """(n,) the target that each number (n,) in [0, 1) chooses."""
        chosen = np.searchsorted(self.cdf, choice, side="right") - 1
        return np.clip(chosen, 0, max(len(self.probability) - 1, 0)).astype(np.int32)


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


def bright_targets(weights: Sequence[Float64]) -> BrightTargets:
    """Odds for a whole bake: the mean of the ``weights`` (m,) of its guide states, of those that have light.

    What is lit in one frame and dark in the next is aimed at in both: odds that followed the light would make every
    aimed ray another one whenever a lamp moves.
    """
    weight = np.sum(weights, axis=0)
    total = weight.sum()
    if not total > 0:
        return BrightTargets(np.zeros(len(weight), np.float32), np.zeros(len(weight) + 1))
    cdf = np.concatenate([[0.0], np.cumsum(weight) / total])
    cdf[1:][cdf[1:] == cdf[-1]] = 1.0
    return BrightTargets((weight / total).astype(np.float32), cdf)
