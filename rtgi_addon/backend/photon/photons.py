# SPDX-License-Identifier: GPL-3.0-or-later
"""Photon tracing (Larsen04 §2): every photon's path through the scene, kept whole in arrays.

A photon's path depends on (light, index, seed) and the scene alone, so :func:`trace_photons` on a subset gives the
same bits as tracing all. It does not depend on how bright its light is: photons fly with unit flux and are scaled at
the end. The loop runs over bounces only. Lambertian surfaces send light back about their geometric normal (what leaves
them is then what the gather sees of them); mirrors and glass use the shading normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lamps.emission import Int64, PhotonSource
from ..parallel import Workers
from ..progress import Report, silent
from ..sampling import photon_numbers, unit_float32, unit_float64
from ..scene import Float32, Float64, Int32
from ..surface.scatter import ABSORBED, Surfaces, scatter
from ..surface.tracing import Hits, Tracer
from .paths import (
    AFTER_DIFFUSE,
    AFTER_SPECULAR,
    BACK,
    END_ABSORBED,
    END_CUT,
    END_ESCAPED,
    EnergyBook,
    PhotonPaths,
    UInt8,
    energy_book,
    join_paths,
    scaled_paths,
)

_FLAG_OF_KIND = np.array([AFTER_DIFFUSE, AFTER_SPECULAR, AFTER_SPECULAR, 0, 0], np.uint8)  # by scatter's kinds

#: Photons traced together: smaller than other chunks, since ten arrays of them must stay in cache (measured).
CHUNK_PHOTONS = 1 << 15
_LEAST_CHUNK = 1 << 11  # below it a thread costs more than it brings
_CHUNKS_PER_REPORT = 64

#: A photon's path follows its colour in so many steps of each channel. Fewer steps: a light may change its colour more
#: before paths change. More: the odds fit the colour better. Either way the estimate has no bias.
GUIDE_STEPS = 16


@dataclass(frozen=True)
class Starts:
    """n photons as their lights send them out: ``guide`` * ``scale`` is a photon's flux times its light's count.

    A path follows from origin, direction and guide alone; the guide is the flux that it is traced with.
    """

    origin: Float32  # (n, 3) local
    direction: Float32  # (n, 3) unit
    guide: Float32  # (n, 3) brightest channel 1, in steps of 1 / GUIDE_STEPS; 0 for photons that carry nothing
    scale: Float32  # (n, 3) W


def trace_photons(
    sources: Sequence[PhotonSource],
    counts: dict[int, int],
    light: Int32,
    index: Int64,
    *,
    surfaces: Surfaces,
    tracer: Tracer,
    workers: Workers,
    max_bounces: int,
    seed: int = 0,
    diffuse: bool = True,
    report: Report = silent,
) -> tuple[PhotonPaths, EnergyBook]:
    """Paths of the photons ``index`` (p,) of ``light`` (p,), any subset of those that ``counts`` shares out.

    ``counts`` (photons of each light) sets each photon's flux. ``emission.all_photons(counts)`` is everything. With
    ``diffuse`` False paths end where they are not mirrored, refracted or let through: caustics need no more.
    """
    starts = emit_photons(sources, light, index, workers=workers, seed=seed)
    paths, rays = trace_starts(
        starts, light, index, surfaces=surfaces, tracer=tracer, workers=workers,
        max_bounces=max_bounces, seed=seed, diffuse=diffuse, report=report,
    )  # fmt: skip
    paths = scaled_paths(paths, flux_factor(starts.scale, light, counts))
    return paths, energy_book(paths, rays)


def emit_photons(
    sources: Sequence[PhotonSource], light: Int32, index: Int64, *, workers: Workers, seed: int = 0
) -> Starts:
    """Photons ``index`` (n,) of ``light`` (n,); those of a source that is no longer there carry nothing."""
    by_light = {s.light: s for s in sources}
    parts = workers.map_slices(lambda s: _emit(by_light, light[s], index[s], seed), len(light), CHUNK_PHOTONS)
    if len(parts) == 1:
        return parts[0]
    none = [np.zeros((0, 3), np.float32)]
    return Starts(*(np.concatenate([getattr(p, f.name) for p in parts] or none) for f in fields(Starts)))


def trace_starts(
    starts: Starts,
    light: Int32,
    index: Int64,
    *,
    surfaces: Surfaces,
    tracer: Tracer,
    workers: Workers,
    max_bounces: int,
    seed: int = 0,
    diffuse: bool = True,
    report: Report = silent,
) -> tuple[PhotonPaths, int]:
    """Paths with the flux of their guides, and the number of rays they took."""

    def trace_chunk(rows: slice) -> tuple[PhotonPaths, int]:
        flight = _Flight(
            np.arange(rows.stop - rows.start, dtype=np.int32), light[rows], index[rows].astype(np.uint32),
            starts.origin[rows], starts.direction[rows], starts.guide[rows],
            np.zeros(rows.stop - rows.start, np.uint8),
        )  # fmt: skip
        return _trace(flight, surfaces, tracer, max_bounces, seed, diffuse)

    paths: list[PhotonPaths] = []
    rays = 0
    chunk = min(CHUNK_PHOTONS, max(_LEAST_CHUNK, -(-len(light) // workers.count)))
    step = chunk * _CHUNKS_PER_REPORT
    for first in range(0, len(light), step):
        count = min(step, len(light) - first)
        done = workers.map_slices(
            lambda s, first=first: trace_chunk(slice(first + s.start, first + s.stop)),  # type: ignore[misc]
            count,
            chunk,
        )
        paths += [d[0] for d in done]
        rays += sum(d[1] for d in done)
        report("photons", first + count, len(light))
    return join_paths(paths), rays


def flux_factor(scale: Float32, light: Int32, counts: dict[int, int]) -> Float32:
    """(n, 3) W: the flux of a photon for each unit of its guide. ``scale`` (n, 3) of ``light`` (n,)."""
    count = np.ones(len(light), np.float32)
    for number in np.unique(light).tolist():
        count[light == number] = counts.get(number, 1)
    return np.asarray(scale / count[:, None], np.float32)


@dataclass
class _Flight:
    """The photons still under way in one chunk."""

    path: Int32  # (k,) row in the chunk
    light: Int32
    index: NDArray[np.uint32]
    origin: Float32  # (k, 3)
    direction: Float32  # (k, 3)
    flux: Float32  # (k, 3)
    flags: UInt8  # (k,)

    def keep(self, rows: NDArray[np.integer[Any]]) -> None:
        """Only ``rows`` fly on."""
        for f in fields(self):
            setattr(self, f.name, getattr(self, f.name).take(rows, axis=0))


@dataclass(frozen=True)
class _Landing:
    """The hits of one bounce, as :class:`PhotonPaths` stores them."""

    path: Int32  # (k,) row in the chunk
    triangle: Int32
    texel: Int32
    start: Float32
    direction: Float32
    distance: Float32
    flux: Float32
    flags: UInt8
    position: Float32


def _emit(by_light: dict[int, PhotonSource], light: Int32, index: Int64, seed: int) -> Starts:
    count = len(light)
    origin, direction, guide, scale = (np.zeros((count, 3), np.float32) for _ in range(4))
    direction[:, 2] = -1
    numbers = [unit_float64(n) for n in photon_numbers(light, index.astype(np.uint32), 0, seed=seed)]
    for number in np.unique(light).tolist():
        if number not in by_light:
            continue
        rows = np.nonzero(light == number)[0]
        emission = by_light[number].emit([n[rows] for n in numbers])
        origin[rows], direction[rows] = emission.origin, emission.direction
        guide[rows], scale[rows] = _guides(emission.weight)
    return Starts(origin, direction, guide, scale)


def _guides(weight: Float64) -> tuple[Float32, Float32]:
    """((n, 3), (n, 3)) guide and scale of photons of ``weight`` (n, 3) W.

    The share of each channel is rounded, but never to nothing: its light would be lost.
    """
    brightest = np.maximum(np.maximum(weight[:, 0], weight[:, 1]), weight[:, 2])[:, None]
    share = np.divide(weight, brightest, out=np.zeros(weight.shape), where=brightest > 0)
    steps = np.where(share > 0, np.maximum(np.rint(share * GUIDE_STEPS), 1), 0)
    guide = steps / GUIDE_STEPS
    scale = np.divide(weight, guide, out=np.zeros(weight.shape), where=guide > 0)
    return guide.astype(np.float32), scale.astype(np.float32)


def _trace(
    flight: _Flight, surfaces: Surfaces, tracer: Tracer, max_bounces: int, seed: int, diffuse: bool
) -> tuple[PhotonPaths, int]:
    count = len(flight.path)
    light, index, origin = flight.light, flight.index.astype(np.int64), flight.origin
    end = np.full(count, END_ABSORBED, np.uint8)
    end_origin, end_direction, end_flux = origin.copy(), flight.direction.copy(), np.zeros((count, 3), np.float32)
    landings: list[_Landing] = []
    rays = 0
    flight.keep(np.nonzero(flight.flux.max(axis=1, initial=0) > 0)[0])

    def finish(rows: NDArray[np.integer[Any]], how: np.uint8) -> None:
        path = flight.path[rows]
        end[path], end_origin[path] = how, flight.origin[rows]
        end_direction[path], end_flux[path] = flight.direction[rows], flight.flux[rows]

    for bounce in range(1, max_bounces + 1):
        if not len(flight.path):
            break
        hits = tracer.intersect(flight.origin, flight.direction)
        rays += len(flight.path)
        finish(np.nonzero(hits.triangle < 0)[0], END_ESCAPED)
        landed = np.nonzero(hits.triangle >= 0)[0]
        if len(landed) < len(flight.path):
            flight.keep(landed)
            hits = hits.take(landed)
        landing = _land(flight, hits, surfaces)
        landings.append(landing)
        numbers = [unit_float32(n) for n in photon_numbers(flight.light, flight.index, bounce, seed=seed)]
        after = scatter(
            surfaces, hits, landing.texel, landing.position, flight.direction, flight.flux, numbers, diffuse=diffuse
        )
        flight.origin, flight.direction, flight.flux = after.origin, after.direction, after.flux
        flight.flags = flight.flags | _FLAG_OF_KIND[after.kind]
        flight.keep(np.nonzero(after.kind != ABSORBED)[0])
    finish(np.arange(len(flight.path)), END_CUT)
    return _gather_paths(landings, light, index, origin, (end, end_origin, end_direction, end_flux)), rays


def _land(flight: _Flight, hits: Hits, surfaces: Surfaces) -> _Landing:
    return _Landing(
        path=flight.path,
        triangle=hits.triangle,
        texel=surfaces.texel_of_hits(hits.triangle, hits.u, hits.v, hits.back),
        start=flight.origin,
        direction=flight.direction,
        distance=hits.distance,
        flux=flight.flux,
        flags=flight.flags | np.where(hits.back, BACK, np.uint8(0)),
        position=flight.origin + flight.direction * hits.distance[:, None],
    )


def _gather_paths(
    landings: list[_Landing],
    light: Int32,
    index: Int64,
    origin: Float32,
    ends: tuple[UInt8, Float32, Float32, Float32],
) -> PhotonPaths:
    """Hits of all bounces put in order of path: hit b of a path is its b-th, so each row's place is known."""
    length = np.zeros(len(light), np.int64)
    for landing in landings:
        length[landing.path] += 1
    first = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    total = int(first[-1])

    def column(name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        out: NDArray[Any] = np.zeros(shape, dtype)
        for bounce, landing in enumerate(landings):
            out[first[landing.path] + bounce] = getattr(landing, name)
        return out

    return PhotonPaths(
        light=light,
        index=index,
        first_hit=first,
        origin=origin,
        end=ends[0],
        end_origin=ends[1],
        end_direction=ends[2],
        end_flux=ends[3],
        triangle=column("triangle", (total,), np.int32),
        texel=column("texel", (total,), np.int32),
        start=column("start", (total, 3), np.float32),
        direction=column("direction", (total, 3), np.float32),
        distance=column("distance", (total,), np.float32),
        flux=column("flux", (total, 3), np.float32),
        flags=column("flags", (total,), np.uint8),
    )
