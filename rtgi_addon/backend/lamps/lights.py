# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps: how each kind sends light out, as Cycles' lamps do (DESIGN §4). How a point sees them: ``lamp_view``.

A point or spot lamp of radius r sends photons like a Lambertian sphere. All functions work in local space (see
``geometry``); ``origin`` is its place in the world. Numbers are (n,) in [0, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sampling import Floats, frames, sample_cone, sample_cosine_hemisphere, sample_disk, sample_sphere
from ..scene import AreaShape, Float64, Light, LightKind

#: Cycles' narrowest spread of an area lamp.
MIN_SPREAD = np.pi / 180
#: A spread this close to a half sphere is plain Lambertian; the tangent of its half angle is no longer finite.
FULL_SPREAD = np.pi - 1e-3


@dataclass(frozen=True)
class Bounds:
    """The local-space box that holds all that rays can hit; photons from infinitely far enter through its faces."""

    low: Float64  # (3,) m
    high: Float64  # (3,) m

    @property
    def is_empty(self) -> bool:
        """No box at all, or a single point."""
        return not bool(np.any(self.high > self.low))


@dataclass(frozen=True)
class Emission:
    """n photons at their start. The mean of ``weight`` over all numbers is the flux of the light."""

    origin: Float64  # (n, 3) local
    direction: Float64  # (n, 3) unit, of travel
    weight: Float64  # (n, 3) W: the photon's flux times the number of photons


@dataclass(frozen=True)
class LampPlace:
    """Where a lamp stands, local space."""

    position: Float64  # (3,)
    x: Float64  # (3,) unit
    y: Float64  # (3,) unit
    axis: Float64  # (3,) unit, where it looks


def is_dark(light: Light) -> bool:
    """Does it send out nothing, whatever its kind?"""
    flat = light.kind == LightKind.AREA and min(light.size) <= 0
    return max(light.power) <= 0 or flat or (light.kind == LightKind.SPOT and light.cone <= 0)


def place_lamp(light: Light, origin: Float64) -> LampPlace:
    """The lamp's frame; its scale is left out."""
    matrix = np.asarray(light.matrix_world, np.float64)
    columns = matrix[:3, :3]
    length = np.sqrt((columns * columns).sum(axis=0))
    x, y, z = (columns / np.where(length > 0, length, 1)).T
    return LampPlace(matrix[:3, 3] - origin, x, y, -z)


def lamp_flux(light: Light, bounds: Bounds) -> Float64:
    """(3,) W that the lamp sends out; of a sun, into the box."""
    power = np.maximum(np.asarray(light.power, np.float64), 0)
    if is_dark(light):
        return np.zeros(3)
    if light.kind == LightKind.SPOT:
        return power * spot_solid_angle(light.cone, light.blend) / (4 * np.pi)
    if light.kind == LightKind.SUN:
        axis = place_lamp(light, np.zeros(3)).axis[None, :]
        return power * float(projected_faces(axis, bounds).sum())
    return power


# --- photons ------------------------------------------------------------------------------------------------------


def emit_lamp(light: Light, numbers: list[Float64], *, origin: Float64, bounds: Bounds) -> Emission:
    """Photons drawn exactly from the lamp's own distribution: all have the same flux.

    Numbers 0 and 1 choose what spreads photons over the scene (the direction; for suns and beams the position), so
    photons of one Halton cell of them stay together; 2 and 3 the other, 4 the face that a sun enters by.
    """
    place = place_lamp(light, origin)
    power = np.maximum(np.asarray(light.power, np.float64), 0)
    if light.kind == LightKind.SUN:
        return _emit_sun(light, place, power, numbers, bounds)
    if light.kind == LightKind.AREA:
        direction = to_axes(_area_directions(light, numbers[0], numbers[1]), place)
        start = place.position + area_points(light, place, numbers[2], numbers[3])
        return Emission(start, direction, np.broadcast_to(power, start.shape))
    if light.kind == LightKind.SPOT:
        direction = to_axes(sample_spot(numbers[0], numbers[1], light.cone, light.blend), place)
    else:
        direction = sample_sphere(numbers[0], numbers[1])
    start = place.position + facing_disk(direction, light.radius, numbers[2], numbers[3])
    return Emission(start, direction, np.broadcast_to(lamp_flux(light, bounds), start.shape))


def _emit_sun(light: Light, place: LampPlace, power: Float64, numbers: list[Float64], bounds: Bounds) -> Emission:
    direction = to_axes(sample_cone(numbers[2], numbers[3], np.cos(light.angle)), place)
    start, area = enter_box(direction, bounds, numbers[0], numbers[1], numbers[4])
    # Uniform radiance in the cone: the flux through the box goes with what each direction sees of it.
    return Emission(start, direction, power * (area * sun_strength(light.angle))[:, None])


def facing_disk(direction: Floats, radius: float, u: Floats, v: Floats) -> Floats:
    """(n, 3) offsets on the disk of ``radius`` across each direction: with all directions, a Lambertian sphere."""
    if radius <= 0:
        return np.zeros_like(direction)
    disk = sample_disk(u, v) * radius
    tangent, bitangent = frames(direction)
    return np.asarray(tangent * disk[:, :1] + bitangent * disk[:, 1:])


def enter_box(direction: Float64, bounds: Bounds, u: Float64, v: Float64, choice: Float64) -> tuple[Float64, Float64]:
    """((n, 3) m, (n,) m²) uniform points of the box's outline as seen along each direction, and the outline's area.

    A line enters a box through exactly one of the three faces turned against it.
    """
    faces = projected_faces(direction, bounds)  # (n, 3)
    total = faces.sum(axis=1)
    picked = choice * total
    axis = (picked >= faces[:, 0]).astype(np.int64) + (picked >= faces[:, 0] + faces[:, 1])
    side = np.where(direction > 0, bounds.low, bounds.high)  # (n, 3) the face's coordinate, by axis
    size = bounds.high - bounds.low
    rows = np.arange(len(direction))
    start = np.zeros_like(direction)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    start[rows, axis] = side[rows, axis]
    start[rows, first] = bounds.low[first] + u * size[first]
    start[rows, second] = bounds.low[second] + v * size[second]
    return start, total


def projected_faces(direction: Float64, bounds: Bounds) -> Float64:
    """(n, 3) m²: the box's face across each axis, as seen along ``direction``."""
    x, y, z = bounds.high - bounds.low
    return np.asarray(np.abs(direction) * np.array([y * z, z * x, x * y]))


def to_axes(local: Floats, place: LampPlace) -> Float64:
    """(n, 3) vectors about +z turned to the lamp's own axis."""
    return np.asarray(local[:, :1] * place.x + local[:, 1:2] * place.y + local[:, 2:] * place.axis, np.float64)


def area_points(light: Light, place: LampPlace, u: Floats, v: Floats) -> Floats:
    """(n, 3) uniform points of the lamp about its centre."""
    if light.shape == AreaShape.ELLIPSE:
        at = sample_disk(u, v) * 0.5
    else:
        at = np.stack([u, v], axis=1) - 0.5
    at = at * np.asarray(light.size)
    return np.asarray(at[:, :1] * place.x + at[:, 1:] * place.y, u.dtype)


def _area_directions(light: Light, u: Float64, v: Float64) -> Float64:
    if light.spread >= FULL_SPREAD:
        return np.asarray(sample_cosine_hemisphere(u, v), np.float64)
    return sample_spread(u, v, half_spread(light))


# --- profiles -----------------------------------------------------------------------------------------------------


def spot_profile(cosine: Floats, cone: float, blend: float) -> Floats:
    """(n,) share of the intensity at ``cosine`` to the axis: 1 inside, 0 outside, Cycles' smoothstep between."""
    edge = np.cos(cone)
    width = (1 - edge) * blend
    if width <= 0:
        return np.asarray(cosine >= edge, cosine.dtype)
    t = np.clip((cosine - edge) / width, 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def spot_solid_angle(cone: float, blend: float) -> float:
    """Sr: the profile's integral over all directions."""
    return float(2 * np.pi * (1 - np.cos(cone)) * (1 - min(max(blend, 0.0), 1.0) / 2))


def sample_spot(u: Float64, v: Float64, cone: float, blend: float) -> Float64:
    """(n, 3) directions about +z in proportion to the profile."""
    if blend <= 0:
        return sample_cone(u, v, np.cos(cone))
    # In units of the blended width, from the edge inwards, the profile integrates to t³ - t⁴/2, then to t - 1/2.
    whole = 1 / blend - 0.5
    y = u * whole
    t = np.where(y < 0.5, _inverse_smoothstep_integral(np.minimum(y, 0.5)), y + 0.5)
    cosine = np.minimum(np.cos(cone) + t * (1 - np.cos(cone)) * blend, 1.0)
    sine = np.sqrt(np.maximum(1 - cosine * cosine, 0))
    angle = v * (2 * np.pi)
    return np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)


def pdf_spot(cosine: Floats, cone: float, blend: float) -> Floats:
    """(n,) 1/sr."""
    return np.asarray(spot_profile(cosine, cone, blend) / spot_solid_angle(cone, blend))


def _inverse_smoothstep_integral(y: Float64) -> Float64:
    """t in [0, 1] with t³ - t⁴/2 = y: Newton from the cube root, which is right to first order at both ends."""
    t = np.cbrt(y) * (1 + 0.26 * y)
    for _ in range(4):
        slope = np.maximum(t * t * (3 - 2 * t), 1e-30)
        t = np.clip(t - (t * t * t * (1 - t / 2) - y) / slope, 0, 1)
    return np.asarray(t)


def half_spread(light: Light) -> float:
    return max(light.spread, MIN_SPREAD) / 2


def spread_profile(cosine: Floats, half: float) -> Floats:
    """(n,) Cycles' soft-box: what the slats of a grid let through at ``cosine``, scaled to keep the lamp's flux."""
    scale = 1 / (np.tan(half) - half)
    tangent = np.sqrt(np.maximum(1 - cosine * cosine, 0)) / np.maximum(cosine, 1e-6)
    return np.where(cosine > 0, np.maximum(np.tan(half) - tangent, 0) * scale, 0).astype(cosine.dtype)


def sample_spread(u: Float64, v: Float64, half: float) -> Float64:
    """(n, 3) directions about +z in proportion to cosine times :func:`spread_profile`."""
    limit, scale = np.tan(half), 1 / (np.tan(half) - half)
    table = np.linspace(0, half, 1025)
    angle = np.interp(u, _spread_cdf(table, limit, scale), table)
    for _ in range(3):
        slope = 2 * np.sin(angle) * (limit * np.cos(angle) - np.sin(angle)) * scale
        step = (_spread_cdf(angle, limit, scale) - u) / np.maximum(slope, 1e-9)
        angle = np.asarray(np.clip(angle - np.clip(step, -half / 1024, half / 1024), 0, half))
    turn = v * (2 * np.pi)
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)


def pdf_spread(cosine: Floats, half: float) -> Floats:
    """(n,) 1/sr."""
    return np.asarray(spread_profile(cosine, half) * np.maximum(cosine, 0) / np.pi)


def _spread_cdf(angle: Float64, limit: float, scale: float) -> Float64:
    sine = np.sin(angle)
    return np.asarray((limit * sine * sine - angle + sine * np.cos(angle)) * scale)


def sun_strength(angle: float) -> float:
    """Radiance times solid angle of a sun that gives 1 W/m² on a surface facing it: one over the cone's mean cosine."""
    return float(2 / (1 + np.cos(angle)))
