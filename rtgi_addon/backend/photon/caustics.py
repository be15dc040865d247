# SPDX-License-Identifier: GPL-3.0-or-later
"""Caustics: lamps' light that reaches a surface by mirrors and glass alone (LS+D; Larsen04 §5, Jensen 2001 §9.2).

Photons are sent only to where specular generators are: each lamp draws a generator's bounding sphere and a photon
that can meet it; where spheres overlap the density is that of the mixture, so no light is counted twice. The sky's
and emissive meshes' caustics need no photons: the gather's rays go through mirrors and glass (DESIGN §4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..lamps.emission import PhotonSource, lamp_identity
from ..lamps.lights import (
    FULL_SPREAD,
    Bounds,
    Emission,
    LampPlace,
    area_points,
    facing_disk,
    half_spread,
    is_dark,
    place_lamp,
    spot_profile,
    spread_profile,
    sun_strength,
    to_axes,
)
from ..sampling import make_discrete, photon_numbers, sample_cone, to_frame, unit_float64
from ..scene import Float64, FrameState, Light, LightKind, Material, Scene
from ..surface.geometry import Geometry

#: More generators than this are taken as one sphere around all: the mixture's density costs one test for each.
MOST_GENERATORS = 32
_FLUX_POINTS = 256


@dataclass(frozen=True)
class Generators:
    """Bounding spheres of what mirrors or refracts; g of them."""

    centre: Float64  # (g, 3) local
    radius: Float64  # (g,) m


@dataclass(frozen=True)
class AimedSource:
    """A lamp that sends photons towards generators only; a :class:`~.emission.PhotonSource`."""

    light: int
    lamp: Light
    origin: Float64  # (3,) world place of local space
    bounds: Bounds
    generators: Generators

    @property
    def flux(self) -> Float64:
        """(3,) W sent towards generators, estimated from a few photons; shares out the real ones."""
        light = np.full(_FLUX_POINTS, self.light, np.int32)
        numbers = photon_numbers(light, np.arange(_FLUX_POINTS, dtype=np.uint32), 0)
        return np.asarray(self.emit([unit_float64(n) for n in numbers]).weight.mean(axis=0))

    @property
    def identity(self) -> bytes:
        return lamp_identity(self.lamp, self.origin, self.bounds, self.generators.centre, self.generators.radius)

    def emit(self, numbers: list[Float64]) -> Emission:
        place = place_lamp(self.lamp, self.origin)
        power = np.maximum(np.asarray(self.lamp.power, np.float64), 0)
        if self.lamp.kind == LightKind.SUN:
            return _aimed_sun(self.lamp, place, power, self.generators, self.bounds, numbers)
        if self.lamp.kind == LightKind.AREA:
            start = place.position + area_points(self.lamp, place, numbers[2], numbers[3])
            direction, density = _aimed_directions(start, 0.0, self.generators, numbers)
            cosine = (direction * place.axis).sum(axis=1)
            profile = 1.0 if self.lamp.spread >= FULL_SPREAD else spread_profile(cosine, half_spread(self.lamp))
            strength = np.maximum(cosine, 0) / np.pi * profile
        else:
            centre = np.broadcast_to(place.position, (len(numbers[0]), 3))
            direction, density = _aimed_directions(centre, self.lamp.radius, self.generators, numbers)
            start = centre + facing_disk(direction, self.lamp.radius, numbers[2], numbers[3])
            strength = np.full(len(direction), 1 / (4 * np.pi))
            if self.lamp.kind == LightKind.SPOT:
                cosine = (direction * place.axis).sum(axis=1)
                strength *= spot_profile(cosine, self.lamp.cone, self.lamp.blend)
        return Emission(start, direction, power * (strength / density)[:, None])


def find_generators(scene: Scene, state: FrameState, geometry: Geometry, materials: Sequence[Material]) -> Generators:
    """One bounding sphere for each visible instance's specular triangles; one for all where there are too many."""
    specular = np.array([m.is_specular and m.opacity > 0 for m in materials], np.bool_)
    if not specular.any():
        return Generators(np.zeros((0, 3)), np.zeros(0))
    blocks = np.array([i.blocks_light for i in scene.instances], np.bool_) & state.visible
    usable = specular[geometry.material_of_triangle] & blocks[geometry.instance_of_triangle]
    rows = np.nonzero(usable & np.any(geometry.normals != 0, axis=1))[0]
    if not len(rows):
        return Generators(np.zeros((0, 3)), np.zeros(0))
    _, group = np.unique(geometry.instance_of_triangle[rows], return_inverse=True)
    if group.max() >= MOST_GENERATORS:
        group = np.zeros_like(group)
    count = int(group.max()) + 1
    corners = geometry.corners[rows].astype(np.float64)  # (m, 3, 3)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, group, corners.min(axis=1))
    np.maximum.at(high, group, corners.max(axis=1))
    centre = (low + high) / 2
    reach = np.sqrt(((corners - centre[group][:, None]) ** 2).sum(axis=2)).max(axis=1)
    radius = np.zeros(count)
    np.maximum.at(radius, group, reach)
    return Generators(centre, radius * (1 + 1e-5))


def caustic_sources(
    state: FrameState, geometry: Geometry, bounds: Bounds, generators: Generators
) -> list[PhotonSource]:
    """The lamps that send anything towards a generator."""
    if not len(generators.radius):
        return []
    lamps = [
        AimedSource(number, lamp, geometry.origin, bounds, generators)
        for number, lamp in enumerate(state.lights)
        if not is_dark(lamp)
    ]
    return [lamp for lamp in lamps if max(lamp.flux) > 0]


def _aimed_directions(
    start: Float64, lamp_radius: float, generators: Generators, numbers: list[Float64]
) -> tuple[Float64, Float64]:
    """((n, 3), (n,) 1/sr) directions from ``start`` (n, 3) that pass within ``lamp_radius`` of a generator's sphere.

    A generator is drawn by the solid angle of its cone, so that where cones do not overlap all photons weigh the same.
    """
    towards = generators.centre - start[:, None]  # (n, g, 3)
    squared = (towards * towards).sum(axis=2)
    sine_squared = np.minimum((generators.radius + lamp_radius) ** 2 / np.maximum(squared, 1e-300), 1)
    # From within a sphere any direction meets it.
    width = np.where(sine_squared < 1, sine_squared / (1 + np.sqrt(1 - sine_squared)), 2)  # (n, g) 1 - cos
    cumulative = np.cumsum(width, axis=1)
    picked = (numbers[4][:, None] * cumulative[:, -1:] >= cumulative).sum(axis=1)
    picked = np.minimum(picked, len(generators.radius) - 1)
    rows = np.arange(len(start))
    axis = towards[rows, picked] / np.sqrt(np.maximum(squared[rows, picked], 1e-300))[:, None]
    axis[squared[rows, picked] <= 0] = (0, 0, 1)
    local = sample_cone(numbers[0], numbers[1], 1 - width[rows, picked])
    direction = np.asarray(to_frame(local, axis), np.float64)
    along = (towards * direction[:, None]).sum(axis=2) / np.sqrt(np.maximum(squared, 1e-300))
    inside = along >= 1 - width - 1e-12
    inside[rows, picked] = True
    # Mixture: sum over cones of (width / total) / (2π width) for those that hold the direction.
    density = inside.sum(axis=1) / (2 * np.pi * cumulative[:, -1])
    return direction, density


def _aimed_sun(
    lamp: Light, place: LampPlace, power: Float64, generators: Generators, bounds: Bounds, numbers: list[Float64]
) -> Emission:
    """Parallel light through the generators' outlines: disks across each photon's direction."""
    direction = to_axes(sample_cone(numbers[2], numbers[3], np.cos(lamp.angle)), place)
    area = np.pi * generators.radius**2
    odds = make_discrete(area)
    picked, _ = odds.sample(numbers[4])
    offset = facing_disk(direction, 1.0, numbers[0], numbers[1]) * generators.radius[picked][:, None]
    through = generators.centre[picked] + offset
    towards = generators.centre - through[:, None]  # (n, g, 3)
    along = (towards * direction[:, None]).sum(axis=2)
    beside = (towards * towards).sum(axis=2) - along * along
    inside = beside <= generators.radius**2 * (1 + 1e-9)
    inside[np.arange(len(through)), picked] = True
    weight = area.sum() / inside.sum(axis=1) * sun_strength(lamp.angle)
    # The start lies before everything that could be in the way.
    before = 2 * np.sqrt(((bounds.high - bounds.low) ** 2).sum())
    return Emission(through - direction * before, direction, power * weight[:, None])
