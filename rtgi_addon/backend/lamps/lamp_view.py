# SPDX-License-Identifier: GPL-3.0-or-later
"""How a point sees a lamp: where a shadow ray goes and what it brings, and which points need none.

A point or spot lamp with a radius is a sphere, or with soft falloff the disk through its centre that faces the point,
as in Cycles. Local space (see ``geometry``); ``origin`` is its place in the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sampling import dot, sample_cone, to_frame
from ..scene import AreaShape, Bool, Float32, Float64, Light, LightKind
from .lights import (
    FULL_SPREAD,
    LampPlace,
    area_points,
    facing_disk,
    half_spread,
    place_lamp,
    spot_profile,
    spread_profile,
    sun_strength,
    to_axes,
)
from .spherical_rectangle import sample_rectangle, see_rectangle

#: An area lamp is near when its area is more than this share of the squared distance. For a rectangle 1/r² then
#: varies by a third; an ellipse pays with a fifth of its samples, so it waits until that is the lesser evil.
NEAR_AREA = {AreaShape.RECTANGLE: 0.1, AreaShape.ELLIPSE: 1.0}


@dataclass(frozen=True)
class LampView:
    """What n points see of a lamp: E = power · strength · cosine, on average over the numbers, where not in shadow."""

    direction: Float32  # (n, 3) unit, towards the lamp
    distance: Float32  # (n,) m
    strength: Float32  # (n,) 1/m² (sun: 1)


def view_lamp(
    light: Light, points: Float32, u: Float32, v: Float32, *, origin: Float64, nearest: Float32, far: float
) -> LampView:
    """A point of the lamp for each of ``points`` (n, 3). ``nearest`` (n,) m bounds 1/r² where a lamp touches a wall;
    ``far`` m is the length of a ray that leaves the scene."""
    place = place_lamp(light, origin)
    if light.kind == LightKind.SUN:
        local = sample_cone(u, v, float(np.cos(light.angle)))
        direction = -to_axes(local, place).astype(np.float32)
        return LampView(
            direction,
            np.full(len(points), far, np.float32),
            np.full(len(points), sun_strength(light.angle), np.float32),
        )
    centre = place.position.astype(np.float32) - points  # towards the centre
    if light.kind == LightKind.AREA:
        return _view_area(light, place, centre, u, v, nearest)
    if light.radius > 0 and not light.soft_falloff:
        direction, distance, strength = _view_sphere(centre, light.radius, u, v)
    else:
        facing = _unit(centre, nearest)[0]
        towards = centre + facing_disk(facing, light.radius, u, v).astype(np.float32)
        direction, distance, falloff = _unit(towards, nearest)
        strength = falloff / np.float32(4 * np.pi) * dot(facing, direction)
    if light.kind == LightKind.SPOT:
        cosine = -dot(direction, place.axis.astype(np.float32)[None])
        strength *= spot_profile(cosine, light.cone, light.blend)
    return LampView(direction, distance, strength.astype(np.float32))


def _view_area(light: Light, place: LampPlace, centre: Float32, u: Float32, v: Float32, nearest: Float32) -> LampView:
    """Far away: points uniform on the lamp. Near: directions uniform in the solid angle of its rectangle, which
    bounds what one sample can weigh; an ellipse wastes the samples in the rectangle's corners."""
    direction, distance, falloff = _unit(centre + area_points(light, place, u, v).astype(np.float32), nearest)
    axis = place.axis.astype(np.float32)[None]
    cosine = -dot(direction, axis)
    strength = np.maximum(cosine, 0) * falloff / np.float32(np.pi)
    near = np.nonzero(light.size[0] * light.size[1] > NEAR_AREA[light.shape] * dot(centre, centre))[0]
    if len(near):
        seen = see_rectangle(centre[near], place.x, place.y, light.size)
        at = sample_rectangle(seen, u[near], v[near])
        towards = centre[near] + (at[:, :1] * place.x + at[:, 1:] * place.y).astype(np.float32)
        direction[near], distance[near], _ = _unit(towards, nearest[near])
        cosine[near] = -dot(direction[near], axis)
        area, on_lamp = light.size[0] * light.size[1], np.ones(len(near), np.bool_)
        if light.shape == AreaShape.ELLIPSE:
            area *= np.pi / 4
            on_lamp = ((2 * at / np.asarray(light.size)) ** 2).sum(axis=1) <= 1
        strength[near] = np.where(on_lamp & (cosine[near] > 0), seen.solid_angle / (np.pi * area), 0)
    if light.spread < FULL_SPREAD:
        strength *= spread_profile(cosine, half_spread(light))
    return LampView(direction, distance, strength)


def _view_sphere(centre: Float32, radius: float, u: Float32, v: Float32) -> tuple[Float32, Float32, Float32]:
    """View of a sphere of radiance 1/(4π² r²): directions uniform in the cone that it fills. From within it fills a
    half space."""
    facing, distance, _ = _unit(centre, np.zeros(1, np.float32))
    sine_squared = np.minimum(np.float32(radius * radius) / np.maximum(distance * distance, np.float32(1e-30)), 1)
    spread = sine_squared / (1 + np.sqrt(1 - sine_squared))  # 1 - cos, without cancellation
    direction = to_frame(sample_cone(u, v, 1 - spread), facing)
    # Distance to the sphere along the ray: the near one of the two solutions.
    along = dot(centre, direction)
    half_chord = np.sqrt(np.maximum(along * along - distance * distance + np.float32(radius * radius), 0))
    strength = spread * np.float32(1 / (2 * np.pi * radius * radius))
    return direction, np.maximum(along - half_chord, 0), strength


def may_see(light: Light, points: Float32, normals: Float32, reach: Float32, *, origin: Float64) -> Bool:
    """(n,) bool: False where no point within ``reach`` (n,) m of ``points`` can get light, by facing away or being
    outside of the lamp's cone or half space. Conservative: it never says False of a lit one."""
    place = place_lamp(light, origin)
    axis = place.axis.astype(np.float32)
    if light.kind == LightKind.SUN:
        return np.asarray((normals * -axis).sum(axis=1) > -np.sin(min(light.angle, np.pi / 2)))
    centre = place.position.astype(np.float32) - points
    size = light.radius if light.kind != LightKind.AREA else float(np.hypot(*light.size)) / 2
    slack = reach + np.float32(size)
    seen = dot(normals, centre) > -slack
    along = -(centre * axis).sum(axis=1)  # how far before the lamp
    if light.kind == LightKind.AREA:
        seen &= along > -reach
    if light.kind == LightKind.SPOT and light.cone < np.pi / 2:
        # Distance to the cone's surface (negative inside); its tip pulled back so that it holds the whole disk.
        across = np.sqrt(np.maximum(dot(centre, centre) - along * along, 0))
        seen &= across * np.cos(light.cone) - along * np.sin(light.cone) <= slack
    return np.asarray(seen)


def _unit(towards: Float32, nearest: Float32) -> tuple[Float32, Float32, Float32]:
    """(unit vectors, lengths, 1/length² bounded by ``nearest``)."""
    squared = dot(towards, towards)
    length = np.sqrt(squared)
    direction = towards / np.maximum(length, np.float32(1e-30))[:, None]
    return direction, length, 1 / np.maximum(squared, np.maximum(nearest * nearest, np.float32(1e-30)))
