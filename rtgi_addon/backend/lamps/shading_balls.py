# SPDX-License-Identifier: GPL-3.0-or-later
"""Which texels' shadow rays to a lamp may pass through one of some balls: those that what is in them may shade.

All rays from about a texel to a lamp's own ball run within a tapered capsule, those to a sun within a widened cone.
Both are tested in closed form, in float64, wider by more than the rays' float32 can stray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Bool, Float32, Float64, Light, LightKind
from .lights import LampPlace, place_lamp

#: A traced ray strays from its line by a few float32 roundings (6e-8) of its length and of its coordinates, and by
#: another at each of at most 64 transparent sheets: together less than half of this share of both.
STRAY = 1e-5
#: A sun this wide (half its angle, rad) is taken as the whole sky.
WIDE_SUN = np.pi / 2 - 1e-3
#: Balls that one texel is tested against, at most: more would cost more than tracing its rays.
MOST_BALLS = 32

Columns = tuple[Float64, Float64, Float64]


@dataclass(frozen=True)
class Balls:
    """m of them, local space."""

    centre: Float64  # (m, 3)
    radius: Float64  # (m,) m


def no_balls() -> Balls:
    return Balls(np.zeros((0, 3)), np.zeros(0))


def together(*several: Balls) -> Balls:
    """All of them; neighbours joined until there are at most MOST_BALLS."""
    balls = Balls(np.concatenate([b.centre for b in several]), np.concatenate([b.radius for b in several]))
    while len(balls.radius) > MOST_BALLS:
        widest = np.argmax(np.ptp(balls.centre, axis=0))
        order = np.argsort(balls.centre[:, widest], kind="stable")
        balls = _joined(balls, order[0::2], np.append(order[1::2], order[-1:])[: len(order[0::2])])
    return balls


def _joined(balls: Balls, a: NDArray[np.int64], b: NDArray[np.int64]) -> Balls:
    """For each pair of ``balls`` the least that holds both."""
    way = balls.centre[b] - balls.centre[a]
    apart = np.sqrt((way * way).sum(axis=1))
    one, other = balls.radius[a], balls.radius[b]
    radius = np.maximum((one + other + apart) / 2, np.maximum(one, other))
    along = np.clip((radius - one) / np.where(apart > 0, apart, 1), 0, 1)
    return Balls(balls.centre[a] + way * along[:, None], radius * (1 + 1e-9))


def may_shade(light: Light, position: Float32, reach: Float32, balls: Balls, *, origin: Float64) -> Bool:
    """(n,) may a ray to ``light`` from within ``reach`` (n,) m of ``position`` (n, 3) meet one of ``balls``?

    Conservative: it never says False of a ray that does. ``origin`` is the place of local space in the world.
    """
    place = place_lamp(light, origin)
    at = _columns(position.astype(np.float64))
    largest = np.maximum(np.maximum(np.abs(at[0]), np.abs(at[1])), np.abs(at[2]))
    start = reach.astype(np.float64) + STRAY * largest
    found = np.zeros(len(position), np.bool_)
    if light.kind == LightKind.SUN and light.angle >= WIDE_SUN:
        return ~found if len(balls.radius) else found
    capsule = None if light.kind == LightKind.SUN else _capsule(light, place, at, start)
    for centre, radius in zip(balls.centre.tolist(), balls.radius.tolist(), strict=True):
        towards = centre[0] - at[0], centre[1] - at[1], centre[2] - at[2]
        wide = radius + STRAY * (max(map(abs, centre)) + radius)
        found |= _in_cone(light, place, towards, start + wide) if capsule is None else capsule.meets(towards, wide)
    return found


@dataclass(frozen=True)
class _Capsules:
    """Hulls of two balls each: about a texel and about a lamp."""

    path: Columns  # unit, from the texel to the lamp
    length: Float64  # (n,) m
    start: Float64  # (n,) m, radius at the texel
    taper: Float64  # (n,) what the radius grows by a metre of the path
    slope: Float64  # (n,) tangent of the angle that this opens
    nested: Bool  # (n,) one of the two balls holds the other

    def meets(self, towards: Columns, radius: float) -> Bool:
        """(n,) does each come within ``radius`` of the point that lies ``towards`` from its texel?

        With s the way along the path, what is left of the distance is convex in s: its least value lies where its
        slope is zero, or at an end.
        """
        foot = _dot(towards, self.path)
        beside = np.sqrt(np.maximum(_dot(towards, towards) - foot * foot, 0))
        s = np.clip(foot + beside * self.slope, 0, self.length)
        away = s - foot
        left = np.sqrt(beside * beside + away * away) - self.taper * s
        return np.asarray((left <= self.start + radius) | self.nested)


def _capsule(light: Light, place: LampPlace, at: Columns, start: Float64) -> _Capsules:
    x, y, z = place.position.tolist()
    path = x - at[0], y - at[1], z - at[2]
    length = np.sqrt(_dot(path, path))
    span = np.maximum(length, 1e-300)
    size = float(np.hypot(*light.size)) / 2 if light.kind == LightKind.AREA else light.radius
    taper = (size - start + STRAY * length) / span
    nested = np.abs(taper) >= 1 - 1e-6
    slope = taper / np.sqrt(np.where(nested, 1, 1 - taper * taper))
    unit = path[0] / span, path[1] / span, path[2] / span
    return _Capsules(unit, length, start, taper, np.where(nested, 0, slope), nested)


def _in_cone(light: Light, place: LampPlace, towards: Columns, near: Float64) -> Bool:
    """(n,) do rays to the sun come as close as ``near`` to the point that lies ``towards`` from each texel?"""
    x, y, z = (-place.axis).tolist()
    cosine, sine = np.cos(light.angle), np.sin(light.angle)
    squared = _dot(towards, towards)
    along = towards[0] * x + towards[1] * y + towards[2] * z
    beside = np.sqrt(np.maximum(squared - along * along, 0))
    distance = np.sqrt(squared)
    at_side = along * cosine + beside * sine > 0  # else the cone's tip is nearest
    apart = np.where(at_side, np.maximum(beside * cosine - along * sine, 0), distance)
    return np.asarray(apart <= near + STRAY * distance)


def _columns(vectors: Float64) -> Columns:
    return vectors[:, 0].copy(), vectors[:, 1].copy(), vectors[:, 2].copy()


def _dot(a: Columns, b: Columns) -> Float64:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
