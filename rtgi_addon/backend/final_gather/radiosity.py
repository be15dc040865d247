# SPDX-License-Identifier: GPL-3.0-or-later
"""The AIM by feedback: all light at every texel, from the links alone, without photon noise.

What arrives at the texels is x = D + G (ρ x + m), with D what comes by other ways (lamps, caustics), G the links,
ρ albedo and m emitted radiosity. That linear system is radiosity's; it is solved, not iterated bounce by bounce, so
that rooms of albedo 0.98 need a dozen products instead of hundreds.
"""

from __future__ import annotations

import numpy as np

from ..scene import Float32
from .links import Links
from .solvers import solve_fixed_point

#: Relative residual of the solution: far below the noise of any sample count.
TOLERANCE = 1e-4
MOST_PRODUCTS = 200


def solve(links: Links, outside: Float32, albedo: Float32, emitted: Float32) -> Float32:
    """(n, 3) the AIM at radiosity's fixed point.

    outside (n, 3): irradiance that does not come by links · albedo (n, 3) · emitted (m, 3): radiosity that targets
    send of themselves, W/m² (texels: π Le; sky patches: π L).
    """
    b = outside + links.irradiance(emitted) if emitted.any() else outside

    def bounce(x: Float32) -> Float32:
        return links.irradiance(_padded(albedo * x, len(emitted)))

    solution = solve_fixed_point(bounce, b, tolerance=TOLERANCE, max_products=MOST_PRODUCTS)
    return np.maximum(solution.x, 0).astype(np.float32)


def sent_by_targets(irradiance: Float32, albedo: Float32, emitted: Float32) -> Float32:
    """(m, 3) radiosity of all targets: what ``irradiance`` (n, 3) on the texels sends back, plus what is emitted."""
    radiosity = emitted.copy()
    radiosity[: len(irradiance)] += albedo * irradiance
    return radiosity


def _padded(values: Float32, rows: int) -> Float32:
    if len(values) == rows:
        return values
    out = np.zeros((rows, values.shape[1]), np.float32)
    out[: len(values)] = values
    return out
