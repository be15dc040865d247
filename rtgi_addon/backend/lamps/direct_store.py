# SPDX-License-Identifier: GPL-3.0-or-later
"""Direct light kept from frame to frame: of each lamp the irradiance that it gives per unit of its power.

A lamp that only dims or changes colour costs no ray. Where objects moved, only texels whose shadow rays to a lamp may
meet them are computed again. What is kept has the bits that a fresh computation would give. 6 bytes a texel and lamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..parallel import Workers
from ..sampling import UInt32
from ..scene import Bool, Float32, Int32, Light, LightKind
from ..selection.sweep import Sweep
from ..surface.geometry import Geometry
from ..surface.texels import TexelFrame
from .direct import LampLight, Receivers, Shadows, irradiance_of, lamp_irradiance, make_receivers, reached
from .lights import is_dark
from .shading_balls import Balls, may_shade, no_balls, together

#: Texels tested against balls at a time: their columns stay in a core's cache.
CHUNK_TEXELS = 1 << 13


@dataclass(frozen=True)
class DirectUpdate:
    """Direct light of one frame, n texels."""

    direct: Float32  # (n, 3) W/m², not writeable
    changed: Bool  # (n,) differs in some bit from the frame before
    rays: int
    lamps_updated: int  # lit lamps of which some texel was computed
    lamps_kept: int  # lit lamps of which none was


@dataclass
class _Lamp:
    """One lamp's light as of when it was last lit, and what changed since then."""

    shape: tuple[object, ...]
    reached: Bool  # (n,) see ``direct.reached``
    strength: Float32  # (n,) 1/m²
    walled: Bool  # (n,) see ``direct.LampLight``
    balls: Balls  # rays through them may fare otherwise now
    moved: Bool | None  # (n,) texels that are not where they were; None: none

    def miss(self, change: _Change) -> None:
        if len(change.balls.radius):
            self.balls = together(self.balls, change.balls)
        if change.moved is not None:
            self.moved = change.moved.copy() if self.moved is None else self.moved | change.moved


@dataclass(frozen=True)
class _Change:
    """From the frame before to this one."""

    balls: Balls
    moved: Bool | None


@dataclass(frozen=True)
class _Now:
    """All that a lamp's light follows from but the lamp."""

    receivers: Receivers
    shadows: Shadows
    workers: Workers
    seed: int


class DirectStore:
    """Direct light of a bake. A lamp is known by its place in the frames' ``lights``, which also seeds its samples."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._lamps: dict[int, _Lamp] = {}
        self._powers: list[tuple[float, float, float] | None] | None = None  # by lamp; None: dark
        self._direct: Float32 | None = None
        self._now: _Now | None = None

    def update(
        self,
        lights: Sequence[Light],
        frame: TexelFrame,
        shadows: Shadows,
        workers: Workers,
        *,
        sweep: Sweep | None,
        changed_texels: Bool,
        samples: int,
        seed: int,
    ) -> DirectUpdate:
        """The light of ``lights`` on the texels of ``frame``: what ``direct_irradiance`` gives, to the last bit.

        ``sweep``: what moved since the last update; None where that is not known, and nothing is kept.
        ``changed_texels`` (n,): those whose rows of ``frame`` may differ from the last.
        """
        last, self._now = self._now, None
        change = None if last is None else _change(last, frame, shadows, sweep, changed_texels, samples, seed)
        if last is None or change is None:
            self._lamps, self._powers = {}, None
            change = _Change(no_balls(), None)
            receivers = make_receivers(frame, shadows.geometry, samples=samples)
        else:
            receivers = _followed(last.receivers, frame, shadows.geometry, change.moved)
        now = _Now(receivers, shadows, workers, seed)
        differ = np.zeros(len(frame.position), np.bool_)  # in some lamp's light
        computed = [self._lamp(number, light, now, change, differ) for number, light in enumerate(lights)]
        for number in [n for n in self._lamps if n >= len(lights)]:
            del self._lamps[number]
        direct, changed = self._sum(lights, differ)
        self._now = now  # set once all is done: after an interrupted update nothing is kept
        lit = [done for done in computed if done is not None]
        updated = sum(texels > 0 for texels, _ in lit)
        return DirectUpdate(direct, changed, sum(rays for _, rays in lit), updated, len(lit) - updated)

    def _lamp(self, number: int, light: Light, now: _Now, change: _Change, differ: Bool) -> tuple[int, int] | None:
        """(texels computed, rays traced), None for a dark lamp. Adds to ``differ`` (n,) where its light differs."""
        lamp = self._lamps.get(number)
        if lamp is not None:
            lamp.miss(change)
        if is_dark(light):
            return None
        if lamp is not None and lamp.shape == _shape(light):
            return _renewed(lamp, light, number, now, differ)
        seen = reached(light, now.receivers, now.shadows.geometry.origin)
        strength, walled = np.zeros(len(seen), np.float32), np.zeros(len(seen), np.bool_)
        texels = np.nonzero(seen)[0].astype(np.int32)
        got = _light(light, number, texels, now)
        strength[texels], walled[texels] = got.strength, got.walled
        if lamp is not None:
            differ |= _bits(lamp.strength) != _bits(strength)
        self._lamps[number] = _Lamp(_shape(light), seen, strength, walled, no_balls(), None)
        return len(texels), got.rays

    def _sum(self, lights: Sequence[Light], differ: Bool) -> tuple[Float32, Bool]:
        """((n, 3) W/m² of all lamps, (n,) where that is new). ``differ``: where some lamp's strength is."""
        before = self._direct if self._direct is not None and len(self._direct) == len(differ) else None
        powers = [None if is_dark(light) else light.power for light in lights]
        if before is None or powers != self._powers:
            differ = np.ones_like(differ)
        rows = np.nonzero(differ)[0]
        if before is not None and not len(rows):
            return before, differ
        part = np.zeros((len(rows), 3), np.float32)
        for number, light in enumerate(lights):
            if powers[number] is not None:
                part += irradiance_of(light, self._lamps[number].strength[rows])
        direct, changed = np.zeros((len(differ), 3), np.float32), differ
        if before is not None:
            direct, changed = before.copy(), np.zeros_like(differ)
            changed[rows] = (_bits(before[rows]) != _bits(part)).any(axis=1)
        direct[rows] = part
        direct.flags.writeable = False
        self._direct, self._powers = direct, powers
        return direct, changed


def _change(
    last: _Now,
    frame: TexelFrame,
    shadows: Shadows,
    sweep: Sweep | None,
    changed_texels: Bool,
    samples: int,
    seed: int,
) -> _Change | None:
    """What changed since ``last``; None where no light can be kept."""
    same = (last.receivers.samples, last.seed) == (samples, seed)
    if sweep is None or not same or len(last.receivers.offset) != len(frame.position):
        return None
    if (faded := _faded(shadows, last.shadows.transparency)) is None:
        return None
    places = Balls(
        np.array([place.centre for place in sweep.places], np.float64).reshape(-1, 3),
        np.array([place.radius for place in sweep.places], np.float64),
    )
    return _Change(together(faded, places), changed_texels if changed_texels.any() else None)


def _faded(shadows: Shadows, before: Float32 | None) -> Balls | None:
    """Around the instances of which a material lets another share of light through than ``before``. None: every shadow
    ray is traced in another way than before."""
    after = shadows.transparency
    if before is None and after is None:
        return no_balls()
    if before is None or after is None or len(before) != len(after):
        return None
    geometry = shadows.geometry
    triangles = np.nonzero((before != after)[geometry.material_of_triangle])[0]
    instances = np.unique(geometry.instance_of_triangle[triangles]).tolist()
    return together(*(_around(geometry, instance) for instance in instances), no_balls())


def _around(geometry: Geometry, instance: int) -> Balls:
    """The ball of one instance, wider by more than rays are lifted."""
    points = geometry.corners[geometry.triangles_of(instance)].reshape(-1, 3).astype(np.float64)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    away = points - centre
    radius = np.sqrt((away * away).sum(axis=1).max())
    lift = 4 * geometry.offset_length((np.abs(centre) + radius).astype(np.float32)[None])[0]
    return Balls(centre[None], np.array([radius + lift]))


def _followed(receivers: Receivers, frame: TexelFrame, geometry: Geometry, moved: Bool | None) -> Receivers:
    """``receivers`` as ``make_receivers`` would have them in ``frame``."""
    if moved is None:
        return replace(receivers, frame=frame)
    texels = np.nonzero(moved)[0].astype(np.int32)
    part = make_receivers(frame, geometry, samples=receivers.samples, texels=texels)
    offset, reach = receivers.offset.copy(), receivers.reach.copy()
    offset[texels], reach[texels] = part.offset, part.reach
    return replace(receivers, frame=frame, offset=offset, reach=reach)


def _renewed(lamp: _Lamp, light: Light, number: int, now: _Now, differ: Bool) -> tuple[int, int]:
    """Bring the light of a lamp that kept its place and shape up to date; (texels computed, rays traced)."""
    again = np.zeros(len(differ), np.bool_) if lamp.moved is None else lamp.moved
    if lamp.moved is not None:
        texels = np.nonzero(again)[0].astype(np.int32)
        lamp.reached[texels] = reached(light, now.receivers, now.shadows.geometry.origin, texels)
        lost = texels[~lamp.reached[texels]]
        differ[lost] |= lamp.strength[lost] != 0
        lamp.strength[lost] = 0
    if light.casts_shadow and len(lamp.balls.radius):
        texels = np.nonzero(lamp.reached & ~lamp.walled & ~again)[0]
        again[texels] = _shaded(light, texels, lamp.balls, now)
    texels = np.nonzero(again & lamp.reached)[0].astype(np.int32)
    got = _light(light, number, texels, now)
    differ[texels] |= _bits(got.strength) != _bits(lamp.strength[texels])
    lamp.strength[texels], lamp.walled[texels] = got.strength, got.walled
    lamp.balls, lamp.moved = no_balls(), None
    return len(texels), got.rays


def _shaded(light: Light, texels: Int32, balls: Balls, now: _Now) -> Bool:
    """(k,) may what is in ``balls`` stand between ``light`` and each of ``texels`` (k,)?"""
    receivers, origin = now.receivers, now.shadows.geometry.origin

    def part(rows: slice) -> Bool:
        at = texels[rows]
        return may_shade(light, receivers.frame.position[at], receivers.reach[at], balls, origin=origin)

    parts = now.workers.map_slices(part, len(texels), CHUNK_TEXELS)
    return np.concatenate(parts) if parts else np.zeros(0, np.bool_)


def _light(light: Light, number: int, texels: Int32, now: _Now) -> LampLight:
    return lamp_irradiance(light, number, texels, now.receivers, now.shadows, now.workers, seed=now.seed)


def _shape(light: Light) -> tuple[object, ...]:
    """All of ``light`` that its light per unit of power follows from; where a sun stands does not matter."""
    matrix = np.asarray(light.matrix_world, np.float64)
    place = matrix[:3, :3] if light.kind == LightKind.SUN else matrix[:3]
    beam = (
        light.radius,
        light.soft_falloff,
        light.angle,
        light.cone,
        light.blend,
        light.size,
        light.shape,
        light.spread,
    )
    return (light.kind, place.tobytes(), *beam, light.casts_shadow)


def _bits(values: Float32) -> UInt32:
    return values.view(np.uint32)
