# SPDX-License-Identifier: GPL-3.0-or-later
"""Direct irradiance of texels from lamps, by shadow rays (DESIGN §4: less noise for the time than photons).

Each texel and lamp gets ``samples`` stratified rays from the texel's footprint to the lamp's area. Texels that a lamp
cannot reach are left out before any number is drawn, and samples that would bring nothing before any ray is traced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..parallel import CHUNK_RAYS, Workers
from ..sampling import dot, stratified_pair, unit_float32
from ..scene import Bool, Float32, Float64, Int32, Light, LightKind, Material
from ..surface.geometry import Geometry
from ..surface.texels import TexelFrame
from ..surface.tracing import FREE, WALL, Tracer
from .lamp_view import may_see, view_lamp
from .lights import is_dark

#: Transparent sheets that one shadow ray may cross; Cycles' default number of transparent bounces is 8.
MOST_SHEETS = 64


@dataclass(frozen=True)
class Shadows:
    """How much light gets from one point to another."""

    tracer: Tracer
    geometry: Geometry
    transparency: Float32 | None  # (materials,) 1 - opacity; None: every material is opaque

    def passing(self, origins: Float32, directions: Float32, distances: Float32) -> tuple[Float32, Bool, int]:
        """((n,) share that arrives, (n,) none ever will, whatever moves, rays traced).

        Glass and mirrors block, as in Cycles without shadow caustics.
        """
        if self.transparency is None:
            blocked = self.tracer.blocked(origins, directions, distances)
            return (blocked == FREE).astype(np.float32), np.asarray(blocked == WALL), len(origins)
        share, rays = self._through_sheets(self.transparency, origins, directions, distances)
        return share, np.zeros(len(origins), np.bool_), rays

    def _through_sheets(
        self, transparency: Float32, origins: Float32, directions: Float32, distances: Float32
    ) -> tuple[Float32, int]:
        share = np.ones(len(origins), np.float32)
        alive = np.arange(len(origins))
        start, left = origins.copy(), distances.copy()
        rays = 0
        for _ in range(MOST_SHEETS):
            if not len(alive):
                break
            hits = self.tracer.intersect(start[alive], directions[alive])
            rays += len(alive)
            met = (hits.triangle >= 0) & (hits.distance < left[alive])
            alive, triangle, distance = alive[met], hits.triangle[met], hits.distance[met]
            share[alive] *= transparency[self.geometry.material_of_triangle[triangle]]
            on = share[alive] > 0
            alive, distance = alive[on], distance[on]
            at = start[alive] + directions[alive] * distance[:, None]
            lift = self.geometry.offset_length(at)
            start[alive] = at + directions[alive] * lift[:, None]
            left[alive] -= distance + lift
            alive = alive[left[alive] > 0]
        share[alive] = 0
        return share, rays


def make_shadows(tracer: Tracer, geometry: Geometry, materials: Sequence[Material]) -> Shadows:
    """Shadow tests that pay for transparency only where a material has some."""
    transparency = 1 - np.clip(np.array([m.opacity for m in materials], np.float32), 0, 1)
    return Shadows(tracer, geometry, transparency if np.any(transparency > 0) else None)


@dataclass(frozen=True)
class Receivers:
    """n texels of one frame and where their shadow rays start."""

    frame: TexelFrame
    samples: int  # rays of a texel to a lamp: one starts at its position, several at points of its footprint
    offset: Float32  # (n,) m that rays are lifted off the surface
    reach: Float32  # (n,) m from the position, within which they start


def make_receivers(
    frame: TexelFrame, geometry: Geometry, *, samples: int, texels: Int32 | slice = slice(None)
) -> Receivers:
    """``offset`` and ``reach`` are those of ``texels``."""
    position = frame.position[texels]
    offset = geometry.offset_length(position)
    if samples == 1:
        return Receivers(frame, samples, offset, offset)
    return Receivers(frame, samples, offset, offset + frame.reach[texels])


def direct_irradiance(
    lights: Sequence[Light], frame: TexelFrame, shadows: Shadows, workers: Workers, *, samples: int, seed: int
) -> tuple[Float32, int]:
    """((n, 3) W/m², rays traced) from all lamps together, on the texels of ``frame``."""
    total = np.zeros((len(frame.position), 3), np.float32)
    receivers = make_receivers(frame, shadows.geometry, samples=samples)
    rays = 0
    for number, light in enumerate(lights):
        if not is_dark(light):
            texels = np.nonzero(reached(light, receivers, shadows.geometry.origin))[0].astype(np.int32)
            strength = np.zeros(len(total), np.float32)
            got = lamp_irradiance(light, number, texels, receivers, shadows, workers, seed=seed)
            strength[texels] = got.strength
            total += irradiance_of(light, strength)
            rays += got.rays
    return total, rays


def irradiance_of(light: Light, strength: Float32) -> Float32:
    """(k, 3) W/m² where ``light`` gives ``strength`` (k,) 1/m² per unit of its power."""
    return np.asarray(strength[:, None] * np.maximum(np.asarray(light.power, np.float32), 0))


def reached(light: Light, receivers: Receivers, origin: Float64, texels: Int32 | slice = slice(None)) -> Bool:
    """(k,) could ``light`` reach each of ``texels`` (k,), were nothing in its way? Those that it cannot cost no ray."""
    frame = receivers.frame
    position, reach = frame.position[texels], receivers.reach[texels]
    seen = may_see(light, position, frame.normal[texels], reach, origin=origin)
    return seen & may_see(light, position, frame.geometric_normal[texels], reach, origin=origin)


@dataclass(frozen=True)
class LampLight:
    """What a lamp gives k texels."""

    strength: Float32  # (k,) 1/m², irradiance per unit of the lamp's power
    walled: Bool  # (k,) it will give nothing else as long as texel and lamp stay, whatever else moves
    rays: int


def lamp_irradiance(
    light: Light, number: int, texels: Int32, receivers: Receivers, shadows: Shadows, workers: Workers, *, seed: int
) -> LampLight:
    """The light of ``texels`` (k,), of which one that is not :func:`reached` gets nothing.

    ``number`` seeds its samples. A texel gets the same bits whichever others are asked for with it.
    """

    def part(rows: slice) -> LampLight:
        return _sampled(light, number, texels[rows], receivers, shadows, seed)

    # Few texels are still cut in two, for two threads.
    chunk = min(max(1, CHUNK_RAYS // receivers.samples), max(512, -(-len(texels) // 2)))
    done = workers.map_slices(part, len(texels), chunk)
    if not done:
        return LampLight(np.zeros(0, np.float32), np.zeros(0, np.bool_), 0)
    strength, walled = np.concatenate([d.strength for d in done]), np.concatenate([d.walled for d in done])
    return LampLight(strength, walled, sum(d.rays for d in done))


def _sampled(light: Light, number: int, texels: Int32, receivers: Receivers, shadows: Shadows, seed: int) -> LampLight:
    """Of the texels (k,) of one chunk."""
    frame, samples = receivers.frame, receivers.samples
    keys = texels.astype(np.uint32)
    of_ray = np.repeat(texels, samples)
    lift = receivers.offset[of_ray]
    points = frame.position[of_ray] + frame.geometric_normal[of_ray] * lift[:, None]
    if samples > 1:
        x, _ = (unit_float32(n).reshape(-1) for n in stratified_pair(keys, samples, pair=2 * number, seed=seed))
        points = frame.points[of_ray, (x * frame.points.shape[1]).astype(np.int64)]
    u, v = (unit_float32(n).reshape(-1) for n in stratified_pair(keys, samples, pair=2 * number + 1, seed=seed))
    view = view_lamp(light, points, u, v, origin=shadows.geometry.origin, nearest=lift, far=_far(shadows.geometry))
    cosine = dot(frame.normal[of_ray], view.direction)
    # Behind its own face a point is in its own shadow, whatever its smooth normal says.
    faces = dot(frame.geometric_normal[of_ray], view.direction) > 0
    strength = np.where(faces, np.maximum(cosine, 0), 0) * view.strength
    rows = np.nonzero(strength > 0)[0]
    open_rays = strength > 0
    rays = 0
    if light.casts_shadow and len(rows):
        # Lamps may lie on a wall: the ray ends before it.
        distances = view.distance[rows] - lift[rows] * (0 if light.kind == LightKind.SUN else 2)
        near = distances <= 0
        passing, walled, rays = shadows.passing(points[rows], view.direction[rows], np.maximum(distances, 0))
        strength[rows] *= np.where(near, np.float32(1), passing)
        open_rays[rows] = ~walled | near
    mean = strength.reshape(-1, samples).sum(axis=1) / np.float32(samples)
    return LampLight(mean, ~open_rays.reshape(-1, samples).any(axis=1), rays)


def _far(geometry: Geometry) -> float:
    """m: longer than any ray within the scene."""
    return 4 * geometry.extent + 1
