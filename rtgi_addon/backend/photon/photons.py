# SPDX-License-Identifier: GPL-3.0-or-later
"""Photon tracing (Larsen04 §2): every photon's path through the scene, kept whole in arrays.

A photon's path depends on (light, index, seed) and the scene alone, so :func:`trace_photons` on a subset gives the
same bits as tracing all. The loop runs over bounces only. Lambertian surfaces send light back about their geometric
normal (what leaves them is then what the gather sees of them); mirrors and glass use the shading normal.
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
from ..surface.tracing import Hits, Tracer
from .scatter import ABSORBED, Surfaces, scatter

UInt8 = NDArray[np.uint8]

#: Flags of a hit. Light that only went straight through (opacity) has none of the first two.
AFTER_DIFFUSE = np.uint8(1)  # reflected diffusely before this hit
AFTER_SPECULAR = np.uint8(2)  # reflected by a mirror or refracted before this hit
BACK = np.uint8(4)  # landed on the back side

_FLAG_OF_KIND = np.array([AFTER_DIFFUSE, AFTER_SPECULAR, AFTER_SPECULAR, 0, 0], np.uint8)  # by scatter's kinds

#: How a path ended.
END_ABSORBED, END_ESCAPED, END_CUT = np.uint8(0), np.uint8(1), np.uint8(2)

#: Photons traced together: smaller than other chunks, since ten arrays of them must stay in cache (measured).
CHUNK_PHOTONS = 1 << 15
_CHUNKS_PER_REPORT = 64


@dataclass(frozen=True)
class PhotonPaths:
    """p paths and their h hits; path i owns hits first_hit[i] to first_hit[i + 1], in order of bounce.

    45 bytes a hit, 61 a path. ``flux`` is what arrives, before reflection.
    """

    light: Int32  # (p,) see ``emission``
    index: Int64  # (p,) photon's number within its light
    first_hit: Int64  # (p + 1,)
    origin: Float32  # (p, 3) local, where the photon started
    end: UInt8  # (p,) END_...
    end_direction: Float32  # (p, 3) of travel at the end: where an escaped or cut photon goes
    end_flux: Float32  # (p, 3) W carried at the end, 0 when absorbed
    triangle: Int32  # (h,) scene-wide
    texel: Int32  # (h,) -1 on a side without map
    position: Float32  # (h, 3) local
    direction: Float32  # (h, 3) unit, of travel before the hit
    flux: Float32  # (h, 3) W
    flags: UInt8  # (h,)

    @property
    def path_of_hit(self) -> Int32:
        """(h,) path number of each hit."""
        return np.repeat(np.arange(len(self.light), dtype=np.int32), np.diff(self.first_hit))

    @property
    def bounce_of_hit(self) -> Int32:
        """(h,) 0 for the first hit of a path."""
        return (np.arange(len(self.triangle)) - np.repeat(self.first_hit[:-1], np.diff(self.first_hit))).astype(
            np.int32
        )


@dataclass(frozen=True)
class EnergyBook:
    """Where the flux went, (3,) W each: emitted = absorbed + escaped + cut, to rounding."""

    emitted: Float64
    absorbed: Float64  # of it `unlit`
    unlit: Float64  # landed on a side that has no map and sends nothing back
    escaped: Float64
    cut: Float64  # still in flight after max_bounces hits
    rays: int

    @staticmethod
    def total(books: Sequence[EnergyBook]) -> EnergyBook:
        """The sum, in order."""
        columns = ([getattr(b, f.name) for b in books] for f in fields(EnergyBook) if f.name != "rays")
        emitted, absorbed, unlit, escaped, cut = (np.array(c).reshape(-1, 3).sum(axis=0) for c in columns)
        return EnergyBook(emitted, absorbed, unlit, escaped, cut, sum(b.rays for b in books))


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
    by_light = {s.light: s for s in sources}
    paths: list[PhotonPaths] = []
    books: list[EnergyBook] = []

    def trace_chunk(rows: slice) -> tuple[PhotonPaths, EnergyBook]:
        start = _start(by_light, counts, light[rows], index[rows], seed)
        return _trace(start, surfaces, tracer, max_bounces, seed, diffuse)

    step = CHUNK_PHOTONS * _CHUNKS_PER_REPORT
    for first in range(0, len(light), step):
        count = min(step, len(light) - first)
        done = workers.map_slices(
            lambda s, first=first: trace_chunk(slice(first + s.start, first + s.stop)),  # type: ignore[misc]
            count,
            CHUNK_PHOTONS,
        )
        paths += [d[0] for d in done]
        books += [d[1] for d in done]
        report("photons", first + count, len(light))
    return join_paths(paths), EnergyBook.total(books)


def join_paths(parts: Sequence[PhotonPaths]) -> PhotonPaths:
    """All paths of ``parts``, in order."""
    parts = parts or [_gather_paths([], *_nothing())]
    shift = np.cumsum([0] + [len(p.triangle) for p in parts])
    first = [p.first_hit[:-1] + s for p, s in zip(parts, shift, strict=False)] + [shift[-1:]]
    others = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts])
        for f in fields(PhotonPaths)
        if f.name != "first_hit"
    }
    return PhotonPaths(first_hit=np.concatenate(first).astype(np.int64), **others)


def take_paths(paths: PhotonPaths, keep: NDArray[np.integer[Any]]) -> PhotonPaths:
    """The paths ``keep`` (k,) of ``paths``, in that order."""
    length = np.diff(paths.first_hit)[keep]
    first = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    hits = np.arange(first[-1]) + np.repeat(paths.first_hit[keep] - first[:-1], length)
    path_fields = ("light", "index", "origin", "end", "end_direction", "end_flux")
    hit_fields = ("triangle", "texel", "position", "direction", "flux", "flags")
    return PhotonPaths(
        first_hit=first,
        **{name: getattr(paths, name)[keep] for name in path_fields},
        **{name: getattr(paths, name)[hits] for name in hit_fields},
    )


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
    position: Float32
    direction: Float32
    flux: Float32
    flags: UInt8


def _start(by_light: dict[int, PhotonSource], counts: dict[int, int], light: Int32, index: Int64, seed: int) -> _Flight:
    """Photons at their sources; those of a source that is no longer there carry nothing."""
    count = len(light)
    origin, direction, flux = (np.zeros((count, 3), np.float32) for _ in range(3))
    direction[:, 2] = -1
    numbers = [unit_float64(n) for n in photon_numbers(light, index.astype(np.uint32), 0, seed=seed)]
    for number in np.unique(light).tolist():
        if number not in by_light:
            continue
        rows = np.nonzero(light == number)[0]
        emission = by_light[number].emit([n[rows] for n in numbers])
        origin[rows], direction[rows] = emission.origin, emission.direction
        flux[rows] = emission.weight / counts[number]
    return _Flight(
        np.arange(count, dtype=np.int32),
        light,
        index.astype(np.uint32),
        origin,
        direction,
        flux,
        np.zeros(count, np.uint8),
    )


def _trace(
    flight: _Flight, surfaces: Surfaces, tracer: Tracer, max_bounces: int, seed: int, diffuse: bool
) -> tuple[PhotonPaths, EnergyBook]:
    count = len(flight.path)
    light, index, origin = flight.light, flight.index.astype(np.int64), flight.origin
    end = np.full(count, END_ABSORBED, np.uint8)
    end_direction, end_flux = flight.direction.copy(), np.zeros((count, 3), np.float32)
    landings: list[_Landing] = []
    emitted = flight.flux.sum(axis=0, dtype=np.float64)
    absorbed, unlit = np.zeros(3), np.zeros(3)
    rays = 0
    flight.keep(np.nonzero(flight.flux.max(axis=1, initial=0) > 0)[0])

    def finish(rows: NDArray[np.integer[Any]], how: np.uint8) -> None:
        path = flight.path[rows]
        end[path], end_direction[path], end_flux[path] = how, flight.direction[rows], flight.flux[rows]

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
        gone = after.kind == ABSORBED
        absorbed += (flight.flux - after.flux).sum(axis=0, dtype=np.float64)
        unlit += flight.flux[gone & (landing.texel < 0)].sum(axis=0, dtype=np.float64)
        flight.origin, flight.direction, flight.flux = after.origin, after.direction, after.flux
        flight.flags = flight.flags | _FLAG_OF_KIND[after.kind]
        flight.keep(np.nonzero(~gone)[0])
    finish(np.arange(len(flight.path)), END_CUT)
    escaped, cut = (end_flux[end == how].sum(axis=0, dtype=np.float64) for how in (END_ESCAPED, END_CUT))
    paths = _gather_paths(landings, light, index, origin, (end, end_direction, end_flux))
    return paths, EnergyBook(emitted, absorbed, unlit, escaped, cut, rays)


def _land(flight: _Flight, hits: Hits, surfaces: Surfaces) -> _Landing:
    return _Landing(
        path=flight.path,
        triangle=hits.triangle,
        texel=surfaces.texel_of_hits(hits.triangle, hits.u, hits.v, hits.back),
        position=flight.origin + flight.direction * hits.distance[:, None],
        direction=flight.direction,
        flux=flight.flux,
        flags=flight.flags | np.where(hits.back, BACK, np.uint8(0)),
    )


def _gather_paths(
    landings: list[_Landing], light: Int32, index: Int64, origin: Float32, ends: tuple[UInt8, Float32, Float32]
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
        end_direction=ends[1],
        end_flux=ends[2],
        triangle=column("triangle", (total,), np.int32),
        texel=column("texel", (total,), np.int32),
        position=column("position", (total, 3), np.float32),
        direction=column("direction", (total, 3), np.float32),
        flux=column("flux", (total, 3), np.float32),
        flags=column("flags", (total,), np.uint8),
    )


def _nothing() -> tuple[Int32, Int64, Float32, tuple[UInt8, Float32, Float32]]:
    vectors = np.zeros((0, 3), np.float32)
    return np.zeros(0, np.int32), np.zeros(0, np.int64), vectors, (np.zeros(0, np.uint8), vectors, vectors)
