# SPDX-License-Identifier: GPL-3.0-or-later
"""The AIM by feedback: all light at every texel, from the links alone, without photon noise.

What arrives at the texels is x = D + G (ρ x + m), with D what comes by other ways (lamps, caustics), G the links,
ρ albedo and m emitted radiosity. That linear system is radiosity's; it is solved, not iterated bounce by bounce, so
that rooms of albedo 0.98 need a dozen products instead of hundreds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene import Float32
from .links import Links
from .solvers import solve_fixed_point

#: Relative residual of the solution: far below the noise of any sample count.
TOLERANCE = 1e-4
MOST_PRODUCTS = 200


@dataclass(frozen=True)
class Illumination:
    """Irradiance of n texels, (n, 3) W/m²."""

    aim: Float32  # all light
    iim: Float32  # what the links bring: bounced, sky, emissive surfaces
    products: int  # of the links matrix
    residual: float  # of the worst channel, relative


def solve(links: Links, outside: Float32, albedo: Float32, emitted: Float32) -> Illumination:
    """AIM and IIM at radiosity's fixed point.

    outside (n, 3): irradiance that does not come by links · albedo (n, 3) · emitted (m, 3): radiosity that targets
    send of themselves, W/m² (texels: π Le; sky patches: π L).
    """
    b = outside + links.irradiance(emitted)

    def bounce(x: Float32) -> Float32:
        return links.irradiance(_padded(albedo * x, len(emitted)))

    solution = solve_fixed_point(bounce, b, tolerance=TOLERANCE, max_products=MOST_PRODUCTS)
    aim = np.maximum(solution.x, 0).astype(np.float32)
    iim = gather(links, aim, albedo, emitted)
    return Illumination(aim, iim, solution.products + 2, float(solution.residual.max()))


def sent_by_targets(irradiance: Float32, albedo: Float32, emitted: Float32) -> Float32:
    """(m, 3) radiosity of all targets: what ``irradiance`` (n, 3) on the texels sends back, plus what is emitted."""
    radiosity = emitted.copy()
    radiosity[: len(irradiance)] += albedo * irradiance
    return radiosity


def gather(links: Links, aim: Float32, albedo: Float32, emitted: Float32, *, from_half: bool = False) -> Float32:
    """(n, 3) the IIM: one product of the links with what an AIM (n, 3) sends back, plus emission and sky."""
    return links.irradiance(sent_by_targets(aim, albedo, emitted), from_half=from_half)


def _padded(values: Float32, rows: int) -> Float32:
    if len(values) == rows:
        return values
    out = np.zeros((rows, values.shape[1]), np.float32)
    out[: len(values)] = values
    return out
