# SPDX-License-Identifier: GPL-3.0-or-later
"""Points of a rectangle, uniform over the solid angle that it fills (Ureña, Fajardo and King 2013).

Close to an area lamp this keeps shadow rays from weighing 1/r²: each brings radiance times solid angle times cosine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sampling import Floats
from ..scene import Float64

_EDGE = 1 - 1e-12


@dataclass(frozen=True)
class SphericalRectangle:
    """A rectangle as seen from each of n points, in the rectangle's own axes with the point as origin."""

    x0: Float64  # (n,) m
    x1: Float64
    y0: Float64
    y1: Float64
    z: Float64  # (n,) m, never positive
    b0: Float64  # (n,) z of the normals of the planes through the lower and the upper edge
    b1: Float64
    k: Float64  # (n,)
    solid_angle: Float64  # (n,) sr


def see_rectangle(towards_centre: Floats, x: Float64, y: Float64, size: tuple[float, float]) -> SphericalRectangle:
    """``towards_centre`` (n, 3) from each point; ``x``, ``y`` (3,) the rectangle's unit axes, ``size`` m along them."""
    centre = towards_centre.astype(np.float64)
    at_x, at_y = (centre * x).sum(axis=1), (centre * y).sum(axis=1)
    z = -np.abs((centre * np.cross(x, y)).sum(axis=1))
    x0, x1 = at_x - size[0] / 2, at_x + size[0] / 2
    y0, y1 = at_y - size[1] / 2, at_y + size[1] / 2
    # Normals of the four planes through the point and an edge: only their z is needed (§3.1).
    span = np.stack([x0 - x1, y1 - y0, x1 - x0, y0 - y1])
    height = np.stack([y0, x1, y1, x0]) * span
    height /= np.sqrt(np.maximum(z * z * span * span + height * height, 1e-300))
    angle = np.arccos(np.clip(-height * np.roll(height, -1, axis=0), -1, 1))
    k = 2 * np.pi - angle[2] - angle[3]
    return SphericalRectangle(x0, x1, y0, y1, z, height[0], height[2], k, angle[0] + angle[1] - k)


def sample_rectangle(seen: SphericalRectangle, u: Floats, v: Floats) -> Float64:
    """(n, 2) m: a point of each rectangle along its axes from its centre, density 1/solid_angle (§3.2)."""
    turn = u * seen.solid_angle + seen.k
    slope = (np.cos(turn) * seen.b0 - seen.b1) / np.where(np.abs(np.sin(turn)) > 1e-12, np.sin(turn), 1e-12)
    cosine = np.copysign(1 / np.sqrt(np.maximum(slope * slope + seen.b0 * seen.b0, 1e-300)), slope)
    cosine = np.clip(cosine, -_EDGE, _EDGE)
    x = np.clip(-cosine * seen.z / np.sqrt(1 - cosine * cosine), seen.x0, seen.x1)
    away = np.sqrt(np.maximum(x * x + seen.z * seen.z, 1e-300))
    low = seen.y0 / np.sqrt(away * away + seen.y0 * seen.y0)
    high = seen.y1 / np.sqrt(away * away + seen.y1 * seen.y1)
    share = np.clip(low + v * (high - low), -_EDGE, _EDGE)
    y = np.clip(share * away / np.sqrt(1 - share * share), seen.y0, seen.y1)
    return np.stack([x - (seen.x0 + seen.x1) / 2, y - (seen.y0 + seen.y1) / 2], axis=1)


def pdf_rectangle(seen: SphericalRectangle) -> Float64:
    """(n,) 1/sr."""
    return np.asarray(1 / seen.solid_angle)
