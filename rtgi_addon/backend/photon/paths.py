# SPDX-License-Identifier: GPL-3.0-or-later
"""Photon paths as arrays, and what is done with them whole: joined, taken apart, scaled, added up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lamps.emission import Int64
from ..scene import Float32, Float64, Int32

UInt8 = NDArray[np.uint8]

#: Flags of a hit. Light that only went straight through (opacity) has none of the first two.
AFTER_DIFFUSE = np.uint8(1)  # reflected diffusely before this hit
AFTER_SPECULAR = np.uint8(2)  # reflected by a mirror or refracted before this hit
BACK = np.uint8(4)  # landed on the back side

#: How a path ended.
END_ABSORBED, END_ESCAPED, END_CUT = np.uint8(0), np.uint8(1), np.uint8(2)


@dataclass(frozen=True)
class PhotonPaths:
    """p paths and their h hits; path i owns hits first_hit[i] to first_hit[i + 1], in order of bounce.

    49 bytes a hit, 69 a path. ``flux`` is what arrives, before reflection: W, or without unit while a path is kept
    apart from its light's power (see :class:`Starts`). A hit's ray is kept too, so that it can be tested again.
    """

    light: Int32  # (p,) see ``emission``
    index: Int64  # (p,) photon's number within its light
    first_hit: Int64  # (p + 1,)
    origin: Float32  # (p, 3) local, where the photon started
    end: UInt8  # (p,) END_...
    end_origin: Float32  # (p, 3) local, where an escaped or cut photon's last ray begins; else the same as origin
    end_direction: Float32  # (p, 3) of travel at the end: where an escaped or cut photon goes
    end_flux: Float32  # (p, 3) W carried at the end, 0 when absorbed
    triangle: Int32  # (h,) scene-wide
    texel: Int32  # (h,) -1 on a side without map
    start: Float32  # (h, 3) local, where the ray began that hit here
    direction: Float32  # (h, 3) unit, of travel before the hit
    distance: Float32  # (h,) m from start
    flux: Float32  # (h, 3) W
    flags: UInt8  # (h,)

    @property
    def position(self) -> Float32:
        """(h, 3) local."""
        return np.asarray(self.start + self.direction * self.distance[:, None], np.float32)

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

    def hits_of(self, paths: NDArray[np.integer[Any]]) -> Int64:
        """Hits of ``paths`` (k,), one path after the other."""
        length = np.diff(self.first_hit)[paths]
        first = np.cumsum(length) - length
        return np.asarray(np.arange(int(length.sum())) + np.repeat(self.first_hit[paths] - first, length))


#: Fields of PhotonPaths with one row for each path, and for each hit.
PATH_FIELDS = ("light", "index", "origin", "end", "end_origin", "end_direction", "end_flux")
HIT_FIELDS = ("triangle", "texel", "start", "direction", "distance", "flux", "flags")


@dataclass(frozen=True)
class EnergyBook:
    """Where the flux went, (3,) W each: emitted = absorbed + escaped + cut, to rounding."""

    emitted: Float64
    absorbed: Float64  # of it `unlit`
    unlit: Float64  # landed on a side that has no map and sends nothing back
    escaped: Float64
    cut: Float64  # still in flight after max_bounces hits
    rays: int


def scaled_paths(paths: PhotonPaths, factor: Float32) -> PhotonPaths:
    """``paths`` with the flux of each multiplied by its ``factor`` (p, 3)."""
    flux = paths.flux * np.repeat(factor, np.diff(paths.first_hit), axis=0)
    return replace(paths, flux=flux, end_flux=paths.end_flux * factor)


def energy_book(paths: PhotonPaths, rays: int) -> EnergyBook:
    """Where the flux of ``paths`` went."""
    first, last = paths.first_hit[:-1], paths.first_hit[1:] - 1
    landed = last >= first

    def total(flux: Float32) -> Float64:
        return np.asarray(flux.sum(axis=0, dtype=np.float64))

    arrived = total(paths.flux[first[landed]])
    final = last[landed & (paths.end == END_ABSORBED)]
    return EnergyBook(
        emitted=arrived + total(paths.end_flux[~landed]),
        absorbed=arrived - total(paths.end_flux[landed]),
        unlit=total(paths.flux[final[paths.texel[final] < 0]]),
        escaped=total(paths.end_flux[paths.end == END_ESCAPED]),
        cut=total(paths.end_flux[paths.end == END_CUT]),
        rays=rays,
    )


def join_paths(parts: Sequence[PhotonPaths]) -> PhotonPaths:
    """All paths of ``parts``, in order."""
    if len(parts) == 1:
        return parts[0]
    parts = parts or [_no_paths()]
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
    first = np.concatenate([[0], np.cumsum(np.diff(paths.first_hit)[keep])]).astype(np.int64)
    hits = paths.hits_of(keep)
    return PhotonPaths(
        first_hit=first,
        **{name: getattr(paths, name).take(keep, axis=0) for name in PATH_FIELDS},
        **{name: getattr(paths, name).take(hits, axis=0) for name in HIT_FIELDS},
    )


def _no_paths() -> PhotonPaths:
    vectors, numbers = np.zeros((0, 3), np.float32), np.zeros(0, np.int32)
    none = np.zeros(0, np.uint8)
    return PhotonPaths(
        light=numbers, index=numbers.astype(np.int64), first_hit=np.zeros(1, np.int64), origin=vectors, end=none,
        end_origin=vectors, end_direction=vectors, end_flux=vectors, triangle=numbers, texel=numbers, start=vectors,
        direction=vectors, distance=np.zeros(0, np.float32), flux=vectors, flags=none,
    )  # fmt: skip
