# SPDX-License-Identifier: GPL-3.0-or-later
"""One lamp of each kind and setting, and the numbers that photons are made from."""

from __future__ import annotations

import numpy as np

from rtgi_addon.backend.lamps import lights as lt
from rtgi_addon.backend.sampling import photon_numbers, unit_float64
from rtgi_addon.backend.scene import AreaShape, Light, LightKind

ORIGIN = np.array([3.0, -2.0, 1.0])
BOX = lt.Bounds(np.array([-1.0, -2.0, -0.5]), np.array([1.0, 2.0, 0.5]))
POWER = (10.0, 20.0, 5.0)


def numbers(count: int = 40_000) -> list[np.ndarray]:
    index = np.arange(count, dtype=np.uint32)
    return [unit_float64(n) for n in photon_numbers(np.zeros(count, np.int32), index, 0)]


def turned() -> np.ndarray:
    """A rotation with scale, which lamps ignore."""
    q, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = q * np.sign(np.linalg.det(q)) * 2.5
    matrix[:3, 3] = ORIGIN + (0.2, 0.3, 2.0)
    return matrix


def lamp(kind: LightKind, **values) -> Light:
    return Light("lamp", kind, turned(), POWER, **values)


LAMPS = {
    "point": lamp(LightKind.POINT),
    "sphere": lamp(LightKind.POINT, radius=0.3),
    "spot": lamp(LightKind.SPOT, cone=0.6, blend=0.4),
    "hard spot": lamp(LightKind.SPOT, cone=0.9, blend=0.0),
    "soft spot": lamp(LightKind.SPOT, cone=1.3, blend=1.0, radius=0.1),
    "wide spot": lamp(LightKind.SPOT, cone=1.5, blend=0.15),
    "area": lamp(LightKind.AREA, size=(0.5, 2.0)),
    "ellipse": lamp(LightKind.AREA, size=(0.5, 2.0), shape=AreaShape.ELLIPSE, spread=1.4),
    "beam": lamp(LightKind.AREA, size=(0.5, 0.5), spread=0.1),
    "sun": lamp(LightKind.SUN, angle=0.05),
    "sharp sun": lamp(LightKind.SUN),
}
