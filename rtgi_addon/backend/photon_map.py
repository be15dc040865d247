# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance from photons: the k nearest of the texel's own surface over the area they span (Larsen04 §3).

One k-d tree holds all surfaces: a fourth coordinate keeps them so far apart that no search crosses from one to
another, which is the paper's tree per surface with one call for all texels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .emission import MESHES, SKY
from .parallel import Workers
from .photons import AFTER_DIFFUSE, AFTER_SPECULAR, PhotonPaths
from .scene import Bool, Float32, Float64, Int32
from .texels import TexelFrame, Texels

Rows = NDArray[np.int64]

#: Within so many texel widths the count of texels says little about the area, and the disk is taken as it is.
_DISK_TEXELS = 1.5

#: The k photons of an estimate span at least this share of their texel.
_LEAST_SHARE_OF_TEXEL = 1e-4


@dataclass(frozen=True)
class PhotonMap:
    """m photons that landed on texels."""

    position: Float32  # (m, 3) local
    flux: Float32  # (m, 3) W
    surface: Int32  # (m,)


def make_photon_map(paths: PhotonPaths, texels: Texels, hits: Bool) -> PhotonMap:
    """The chosen ``hits`` (h,) of ``paths``, but for those on sides without a map."""
    rows = np.nonzero(hits & (paths.texel >= 0))[0]
    return PhotonMap(paths.position[rows], paths.flux[rows], texels.surface[paths.texel[rows]])


def bounced_hits(paths: PhotonPaths) -> Bool:
    """(h,) light that was reflected diffusely before."""
    return np.asarray((paths.flags & AFTER_DIFFUSE) > 0)


def caustic_hits(paths: PhotonPaths) -> Bool:
    """(h,) light of any source that came by mirrors and glass alone (LS+D)."""
    return np.asarray((paths.flags & (AFTER_DIFFUSE | AFTER_SPECULAR)) == AFTER_SPECULAR)


def direct_hits(paths: PhotonPaths) -> Bool:
    """(h,) light straight from its source."""
    return np.asarray((paths.flags & (AFTER_DIFFUSE | AFTER_SPECULAR)) == 0)


def lamp_hits(paths: PhotonPaths) -> Bool:
    """(h,) light of lamps, as against the sky's and emissive meshes', which no shadow ray brings."""
    return ~np.isin(paths.light, (MESHES, SKY))[paths.path_of_hit]


def photon_irradiance(photons: PhotonMap, texels: Texels, frame: TexelFrame, workers: Workers, *, k: int) -> Float32:
    """(n, 3) W/m² at each texel.

    The farthest of the k photons only sets the radius: counting it too would make the estimate too bright by
    1/(k - 1) where photons lie evenly. A surface with no more than k photons gets their flux over its whole area.
    """
    out = np.zeros((texels.count, 3), np.float32)
    count = np.bincount(photons.surface, minlength=texels.surface_count)
    area = np.bincount(texels.surface, frame.area, minlength=texels.surface_count).astype(np.float64)
    few = count <= k
    rows = np.nonzero(few[texels.surface] & (count[texels.surface] > 0))[0]
    if len(rows):
        out[rows] = _mean_irradiance(photons, area, texels.surface_count)[texels.surface[rows]]
    rows = np.nonzero(~few[texels.surface])[0]
    if len(rows):
        out[rows] = _nearest(photons, texels, frame, workers, rows, area, k)
    return out


def _mean_irradiance(photons: PhotonMap, area: Float64, surfaces: int) -> Float64:
    """(surfaces, 3) W/m²."""
    flux = np.stack([np.bincount(photons.surface, photons.flux[:, c], minlength=surfaces) for c in range(3)], axis=1)
    return np.divide(flux, area[:, None], out=np.zeros_like(flux), where=area[:, None] > 0)


def _nearest(
    photons: PhotonMap, texels: Texels, frame: TexelFrame, workers: Workers, rows: Rows, surface_area: Float64, k: int
) -> Float32:
    """(m, 3) for texels ``rows`` (m,), whose surfaces have more than k photons."""
    low, high = frame.position.min(axis=0), frame.position.max(axis=0)
    apart = 4.0 * float(np.abs(high - low).max()) + 1e-6
    tree = cKDTree(_with_surface(photons.position, photons.surface, apart))
    # Texels in any order of the tree's leaves are searched alike; the library spreads them over its own threads.
    places = _with_surface(frame.position[rows], texels.surface[rows], apart)
    distance, nearest = tree.query(places, k=k, workers=workers.count)
    radius = distance[:, -1]
    flux = photons.flux.astype(np.float64)[nearest[:, :-1]].sum(axis=1)
    area = _spanned_area(texels, frame, workers, rows, surface_area, radius, apart)
    # k photons in one point span nothing; a texel thick with photons may have its k within a small part of it.
    least = np.maximum(frame.area[rows] * _LEAST_SHARE_OF_TEXEL, np.finfo(np.float32).tiny)
    return np.asarray(flux / np.maximum(area, least)[:, None], np.float32)


def _spanned_area(
    texels: Texels,
    frame: TexelFrame,
    workers: Workers,
    rows: Rows,
    surface_area: Float64,
    radius: Float64,
    apart: float,
) -> Float64:
    """(m,) m²: the part of the disk of ``radius`` that lies on the surface, for texels near its border less than all.

    Counted in texels of the surface; where that says little (small disks) or more than the disk has, the disk is taken.
    """
    disk = np.pi * radius * radius
    number = np.maximum(np.bincount(texels.surface, minlength=texels.surface_count), 1)
    texel = (surface_area / number)[texels.surface[rows]]
    wide = np.nonzero(radius > _DISK_TEXELS * np.sqrt(texel))[0]
    if not len(wide):
        return disk
    tree = cKDTree(_with_surface(frame.position, texels.surface, apart))
    places = _with_surface(frame.position[rows[wide]], texels.surface[rows[wide]], apart)
    inside = tree.query_ball_point(places, radius[wide], return_length=True, workers=workers.count)
    disk[wide] = np.minimum(disk[wide], inside * texel[wide])
    return np.asarray(disk)


def _with_surface(position: Float32, surface: Int32, apart: float) -> Float64:
    """(m, 4) positions with the surface's number, times ``apart`` m, as fourth coordinate."""
    return np.concatenate([position.astype(np.float64), surface[:, None] * apart], axis=1)
