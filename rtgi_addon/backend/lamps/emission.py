# SPDX-License-Identifier: GPL-3.0-or-later
"""Photon sources: lamps, emissive meshes and the sky behind one interface, and who emits how many photons.

A source keeps its number (``light``) however many others come and go: lamps are numbered as in the frame's lights,
all emissive meshes together are MESHES, the sky is SKY. Photons of the last two carry light that no shadow ray does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from hashlib import blake2b
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..sampling import Discrete, Floats, make_discrete, sample_cosine_about, sample_triangle
from ..scene import Bool, Float32, Float64, FrameState, Int32, Light, Material, Scene
from ..surface.geometry import Geometry
from ..surface.texels import sample_map
from .lights import Bounds, Emission, emit_lamp, enter_box, is_dark, lamp_flux
from .sky import Sky, make_sky

Int64 = NDArray[np.int64]

MESHES = -1
SKY = -2

#: Points of a triangle at which its emission map is averaged for the odds, and the least share of the map's own mean
#: that a triangle gets, so that a bright pixel between the points is still found.
_MAP_POINTS = 16
_LEAST_SHARE = 0.05


class PhotonSource(Protocol):
    """What the photon tracer needs of a light."""

    @property
    def light(self) -> int:
        """Its number in photon paths."""
        ...

    @property
    def flux(self) -> Float64:
        """(3,) W sent out; for sources with a map an estimate, used to share out photons."""
        ...

    @property
    def identity(self) -> bytes:
        """The same for sources that send out the same photons: then nothing of them need be looked at again."""
        ...

    def emit(self, numbers: list[Float64]) -> Emission:
        """One photon for each of the numbers (EMISSION_DIMENSIONS arrays (n,) in [0, 1))."""
        ...


@dataclass(frozen=True)
class LampSource:
    """A lamp as photon source. ``casts_shadow`` is for shadow rays alone: a photon lands on what it meets."""

    light: int
    lamp: Light
    origin: Float64  # (3,) world place of local space
    bounds: Bounds

    @property
    def flux(self) -> Float64:
        return lamp_flux(self.lamp, self.bounds)

    @property
    def identity(self) -> bytes:
        return lamp_identity(self.lamp, self.origin, self.bounds)

    def emit(self, numbers: list[Float64]) -> Emission:
        return emit_lamp(self.lamp, numbers, origin=self.origin, bounds=self.bounds)


@dataclass(frozen=True)
class SkySource:
    """The sky, entering through the faces of the scene's box; its patches drawn by radiance times solid angle."""

    sky: Sky
    bounds: Bounds
    odds: Discrete
    light: int = SKY

    @property
    def flux(self) -> Float64:
        x, y, z = self.bounds.high - self.bounds.low
        mean_outline = (x * y + y * z + z * x) / 2  # of a convex body: a quarter of its surface
        return np.asarray(
            (self.sky.radiance * self.sky.solid_angle[:, None]).sum(axis=0, dtype=np.float64) * mean_outline
        )

    @property
    def identity(self) -> bytes:
        return fingerprint(self.sky.radiance, self.sky.rows, self.odds.cdf, self.bounds.low, self.bounds.high)

    def emit(self, numbers: list[Float64]) -> Emission:
        patch, across = self.odds.sample(numbers[0])
        travel = -self.sky.directions(patch, across.astype(np.float32), numbers[1].astype(np.float32)).astype(
            np.float64
        )
        start, area = enter_box(travel, self.bounds, numbers[2], numbers[3], numbers[4])
        share = self.sky.solid_angle[patch] * area / self.odds.pdf(patch)
        return Emission(start, travel, self.sky.radiance[patch] * share[:, None])


@dataclass(frozen=True)
class MeshSource:
    """All emissive triangles; an entry is one side of one triangle."""

    scene: Scene
    geometry: Geometry
    triangle: Int32  # (m,) scene-wide
    back: Bool  # (m,)
    emission: Float32  # (m, 3) W/(m² sr), where there is no map
    area: Float64  # (m,) m²
    odds: Discrete
    flux: Float64  # (3,) W
    light: int = MESHES

    @property
    def identity(self) -> bytes:
        corners, normals = self.geometry.corners[self.triangle], self.geometry.normals[self.triangle]
        return fingerprint(self.triangle, self.back, self.emission, self.odds.cdf, corners, normals)

    def emit(self, numbers: list[Float64]) -> Emission:
        entry, _ = self.odds.sample(numbers[4])
        triangle = self.triangle[entry]
        u, v = sample_triangle(numbers[2], numbers[3])
        corners = self.geometry.corners[triangle].astype(np.float64)
        start = corners[:, 0] * (1 - u - v)[:, None] + corners[:, 1] * u[:, None] + corners[:, 2] * v[:, None]
        normal = self.geometry.normals[triangle] * np.where(self.back[entry], -1.0, 1.0)[:, None]
        lift = self.geometry.offset_length(start.astype(np.float32))
        radiance = mapped_emission(self.scene, self.geometry, triangle, u, v, self.emission[entry])
        weight = radiance * (np.pi * self.area[entry] / self.odds.pdf(entry))[:, None]
        direction = sample_cosine_about(normal, numbers[0], numbers[1])
        return Emission(start + normal * lift[:, None], np.asarray(direction, np.float64), weight)


def make_sources(
    scene: Scene, state: FrameState, geometry: Geometry, bounds: Bounds, *, sides: Bool | None = None
) -> list[PhotonSource]:
    """All sources that send anything out. ``sides`` (instances, 2): does the front, the back send light (default all)?

    ``bounds`` must hold everything that light can hit (:func:`grown_bounds`).
    """
    sources: list[PhotonSource] = []
    for number, lamp in enumerate(state.lights):
        if not is_dark(lamp) and max(lamp_flux(lamp, bounds)) > 0:
            sources.append(LampSource(number, lamp, geometry.origin, bounds))
    meshes = _mesh_source(scene, state, geometry, sides)
    if meshes is not None:
        sources.append(meshes)
    sky = make_sky(state.world)
    if sky is not None and not bounds.is_empty:
        weights = np.maximum(sky.radiance.max(axis=1), 0) * sky.solid_angle
        sources.append(SkySource(sky, bounds, steady_odds(weights)))
    return sources


def make_bounds(geometry: Geometry) -> Bounds:
    """The box of all triangles, widened by a little so that it encloses flat scenes."""
    if geometry.triangle_count == 0:
        return Bounds(np.zeros(3), np.zeros(3))
    corners = geometry.corners.reshape(-1, 3)
    low, high = _extremes(corners)
    if not np.isfinite([low, high]).all():
        good = corners[np.isfinite(corners).all(axis=1)]
        if not len(good):
            return Bounds(np.zeros(3), np.zeros(3))
        low, high = _extremes(good)
    margin = 1e-4 * float(np.sqrt(((high - low) ** 2).sum()))
    return Bounds(low - margin, high + margin)


def _extremes(points: Float32) -> tuple[Float64, Float64]:
    """(3,), (3,) least and greatest of ``points`` (n, 3), n > 0; not finite if one is not.

    NumPy takes the least of long rows 17 times faster than that of rows of three (measured), so most go by 64.
    """
    whole = len(points) // 64 * 64
    parts = [part for part in (points[:whole].reshape(-1, 3 * 64), points[whole:]) if len(part)]
    low = np.min([part.min(axis=0).reshape(-1, 3).min(axis=0) for part in parts], axis=0)
    high = np.max([part.max(axis=0).reshape(-1, 3).max(axis=0) for part in parts], axis=0)
    return low.astype(np.float64), high.astype(np.float64)


def grown_bounds(base: Bounds, geometry: Geometry) -> Bounds:
    """``base`` itself while it holds all triangles of ``geometry``, else each side moved out as far as it must be.

    Sun and sky photons start on the box, so one that stays the same keeps their paths: sides move by the base's
    diagonal over 16, over 8, over 4 and so on. A function of its arguments alone: give it the session's first box in
    every frame, never the last result.
    """
    now = make_bounds(geometry)
    if base.is_empty or now.is_empty:
        return now if base.is_empty else base
    # The margin of `now` is not demanded: else a scene that only breathes would move the box in every frame.
    slack = (now.high - now.low).max() * 1e-4
    step = float(np.sqrt(((base.high - base.low) ** 2).sum())) / 16

    def outset(missing: Float64) -> Float64:
        doublings = np.ceil(np.log2(np.maximum(missing / step, 1)))
        return np.where(missing > slack, step * 2.0**doublings, 0)

    low, high = outset(base.low - now.low), outset(now.high - base.high)
    return Bounds(base.low - low, base.high + high) if np.any(low) or np.any(high) else base


def photon_counts(sources: Sequence[PhotonSource], total: int) -> dict[int, int]:
    """Photons of each light, by its brightest channel; every source gets at least one, so none is lost.

    Lights are weighed by the power of two next to their flux, each alone: while none passes from one power to the
    next, no count changes, so a light that dims keeps its photons and leaves the others theirs. Passing one moves
    photons from it to the others or back: these alone are traced. The price is that a light may get from half to twice
    its share; the total stays.
    """
    flux = np.array([max(s.flux) for s in sources])
    if not len(flux):
        return {}
    weight = np.where(flux > 0, 2.0 ** np.rint(np.log2(np.maximum(flux, 1e-300))), 0)
    if not weight.any():
        weight[:] = 1
    share = np.maximum(np.floor(weight / weight.sum() * total), 1).astype(np.int64)
    share[int(np.argmax(weight))] += max(total - int(share.sum()), 0)
    return {s.light: int(n) for s, n in zip(sources, share, strict=True)}


def steady_odds(weights: Floats) -> Discrete:
    """Odds in proportion to ``weights`` (m,) to 3 %: rounded, so that they stay the same bits when all weights are
    multiplied by one number. Raises ValueError where none is positive."""
    largest = weights.max(initial=0)
    if not largest > 0:
        raise ValueError("weights: at least one must be positive")
    mantissa, exponent = np.frexp(weights.astype(np.float64) / float(largest))
    return make_discrete(np.ldexp(np.rint(mantissa * 32) / 32, exponent))


def fingerprint(*parts: object) -> bytes:
    """16 bytes that differ where any of ``parts`` (arrays, numbers, strings, tuples of numbers) differs."""
    digest = blake2b(digest_size=16)
    for part in parts:
        array = np.asarray(part)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.digest()


def lamp_identity(lamp: Light, origin: Float64, bounds: Bounds, *more: object) -> bytes:
    """Of a lamp with everything else that its photons depend on."""
    return fingerprint(*(getattr(lamp, f.name) for f in fields(lamp)), origin, bounds.low, bounds.high, *more)


def all_photons(counts: dict[int, int]) -> tuple[Int32, Int64]:
    """((n,), (n,)) light and index of every photon of ``counts``."""
    light = np.repeat(np.array(list(counts), np.int32), list(counts.values()))
    index = np.concatenate([np.arange(n, dtype=np.int64) for n in counts.values()] or [np.zeros(0, np.int64)])
    return light, index


def _mesh_source(scene: Scene, state: FrameState, geometry: Geometry, sides: Bool | None) -> MeshSource | None:
    materials = state.materials or scene.materials
    mean = _mean_emission(scene, geometry, materials)  # (t, 3)
    lit = np.array([i.blocks_light for i in scene.instances], np.bool_) & state.visible
    sends = np.ones((len(scene.instances), 2), np.bool_) if sides is None else sides
    glowing = (mean.max(axis=1, initial=0) > 0) & np.any(geometry.normals != 0, axis=1)
    of_instance = geometry.instance_of_triangle
    rows = [np.nonzero(glowing & (lit & sends[:, side])[of_instance])[0] for side in (0, 1)]
    triangle = np.concatenate(rows).astype(np.int32)
    if not len(triangle):
        return None
    edges = np.diff(geometry.corners[triangle].astype(np.float64), axis=1)
    cross = np.cross(edges[:, 0], edges[:, 1])
    area = np.sqrt((cross * cross).sum(axis=1)) / 2
    flux = mean[triangle] * (np.pi * area)[:, None]
    base = np.array([m.emission for m in materials], np.float32)[geometry.material_of_triangle[triangle]]
    back = np.repeat([False, True], [len(r) for r in rows])
    return MeshSource(
        scene, geometry, triangle, back, base, area, steady_odds(flux.max(axis=1)), np.asarray(flux.sum(axis=0))
    )


def mapped_emission(
    scene: Scene, geometry: Geometry, triangle: Int32, u: Float64, v: Float64, emission: Float32
) -> Float32:
    """(n, 3) W/(m² sr) at points of triangles: ``emission`` (n, 3), or the mesh's map where it has one."""
    out = emission.copy()
    instance = geometry.instance_of_triangle[triangle]
    mesh_of_instance = np.array([i.mesh for i in scene.instances], np.int64)
    for number, mesh in enumerate(scene.meshes):
        if mesh.emission_map is None:
            continue
        rows = np.nonzero(mesh_of_instance[instance] == number)[0]
        corner_uv = mesh.corner_uv[triangle[rows] - geometry.first_triangle[instance[rows]]]
        weights = np.stack([1 - u[rows] - v[rows], u[rows], v[rows]], axis=1)[:, :, None]
        out[rows] = sample_map(mesh.emission_map, (corner_uv * weights).sum(axis=1))
    return np.maximum(out, 0)


def _mean_emission(scene: Scene, geometry: Geometry, materials: Sequence[Material]) -> Float32:
    """(t, 3) W/(m² sr), over each triangle; only the odds hang on it."""
    table = np.array([m.emission for m in materials], np.float32).reshape(-1, 3)
    mean: Float32 = np.maximum(table[geometry.material_of_triangle], 0)
    step = (np.arange(_MAP_POINTS) + 0.5) / _MAP_POINTS
    u, v = sample_triangle(step, (np.arange(_MAP_POINTS) * 0.618034) % 1)
    weights = np.stack([1 - u - v, u, v], axis=1)  # (points, 3)
    for number, instance in enumerate(scene.instances):
        mesh = scene.meshes[instance.mesh]
        if mesh.emission_map is None or not np.any(mesh.emission_map > 0):
            continue
        uv = np.einsum("pc,tcx->tpx", weights, mesh.corner_uv.astype(np.float64))  # (t, points, 2)
        sampled = sample_map(mesh.emission_map, uv.reshape(-1, 2)).reshape(-1, _MAP_POINTS, 3)
        least = np.maximum(mesh.emission_map, 0).mean(axis=(0, 1), dtype=np.float64) * _LEAST_SHARE
        mean[geometry.triangles_of(number)] = np.maximum(sampled, 0).mean(axis=1) + least
    return mean
