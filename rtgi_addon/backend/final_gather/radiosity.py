# SPDX-License-Identifier: GPL-3.0-or-later
"""The AIM by feedback: all light at every texel, from the links alone, without photon noise.

What arrives at the texels is x = D + G (ρ x + m): D by other ways (lamps, caustics), G the links, ρ albedo, m emitted
radiosity. That linear system is radiosity's; it is solved, not iterated bounce by bounce, so that rooms of albedo 0.98
need a dozen products instead of hundreds. Surfaces that exchange no light are solved apart, and again only where
something differs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene import Float32, Int32
from .kept_gather import Irradiance
from .solvers import solve_fixed_point

#: Relative residual of the solution: far below the noise of any sample count.
TOLERANCE = 1e-4
MOST_PRODUCTS = 200


def solve(
    links: Irradiance, texels: NDArray[np.int64], group: Int32, b: Float32, albedo: Float32, targets: int
) -> Float32:
    """(r, 3) the AIM of ``texels`` (r,) at radiosity's fixed point.

    links of those texels to all ``targets`` · group (r,): texels that exchange light have one number, those that
    exchange none -1; no group may be cut · b (r, 3): irradiance by other ways than from texels · albedo (r, 3).
    """
    columns, share = np.zeros((3, targets), np.float32), np.ascontiguousarray(albedo.T)
    everything = len(texels) and texels[0] == 0 and texels[-1] == len(texels) - 1
    where: slice | NDArray[np.int64] = slice(0, len(texels)) if everything else texels

    def bounce(x: Float32) -> Float32:
        columns[:, where] = share * x.T
        return links.irradiance(columns.T)

    solution = solve_fixed_point(bounce, b, group=group, tolerance=TOLERANCE, max_products=MOST_PRODUCTS)
    return np.maximum(solution.x, 0).astype(np.float32)


def sent_by_targets(irradiance: Float32, albedo: Float32, emitted: Float32) -> Float32:
    """(m, 3) radiosity of all targets: what ``irradiance`` (n, 3) on the texels sends back, plus what is emitted."""
    radiosity = emitted.copy()
    radiosity[: len(irradiance)] += albedo * irradiance
    return radiosity
