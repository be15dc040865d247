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

from ..lamps.emission import MESHES, SKY
from ..parallel import CHUNK_RAYS, Workers
from ..scene import Bool, Float32, Float64, Int32
from ..surface.texels import TexelFrame, Texels
from .photons import AFTER_DIFFUSE, AFTER_SPECULAR, PhotonPaths

Rows = NDArray[np.int64]

#: Radii, as distance from the photon's radius in texel widths, over which texels are counted: two tame the jumps.
_COUNT_AT = (-0.25, 0.25)
#: Beyond so many texel widths the texels within a circle are π r², to better than 1 %.
_COUNTED_WIDTHS = 64


@dataclass(frozen=True)
class PhotonMap:
    """m photons that landed on texels."""

    position: Float32  # (m, 3) local
    flux: Float32  # (m, 3) W
    texel: Int32  # (m,)


def make_photon_map(paths: PhotonPaths, hits: Bool) -> PhotonMap:
    """The chosen ``hits`` (h,) of ``paths``, but for those on sides without a map."""
    rows = np.nonzero(hits & (paths.texel >= 0))[0]
    return PhotonMap(paths.position[rows], paths.flux[rows], paths.texel[rows])


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
    1/(k - 1) where photons lie evenly. A surface with no more than k photons gets their flux over its whole area; a
    texel that is larger than the disk of its k photons gets all that landed on it over its own area.
    """
    out = np.zeros((texels.count, 3), np.float32)
    surface = texels.surface[photons.texel]
    count = np.bincount(surface, minlength=texels.surface_count)
    few = count <= k
    rows = np.nonzero(few[texels.surface] & (count[texels.surface] > 0))[0]
    if len(rows):
        area = np.bincount(texels.surface, frame.area, minlength=texels.surface_count)
        out[rows] = _mean_irradiance(photons.flux, surface, np.asarray(area, np.float64))[texels.surface[rows]]
    rows = np.nonzero(~few[texels.surface])[0]
    if len(rows):
        out[rows] = _nearest(photons, surface, texels, frame, workers, rows, k)
    return out


def _mean_irradiance(flux: Float32, bin_of_photon: Int32, area: Float64) -> Float64:
    """(bins, 3) W/m²: all flux in each bin over its area."""
    total = np.stack([np.bincount(bin_of_photon, flux[:, c], minlength=len(area)) for c in range(3)], axis=1)
    return np.divide(total, area[:, None], out=np.zeros_like(total), where=area[:, None] > 0)


def _nearest(
    photons: PhotonMap, surface: Int32, texels: Texels, frame: TexelFrame, workers: Workers, rows: Rows, k: int
) -> Float64:
    """(m, 3) for texels ``rows`` (m,), whose surfaces have more than k photons."""
    apart = 4.0 * float(np.ptp(frame.position, axis=0).max()) + 1e-6
    tree = cKDTree(_with_surface(photons.position, surface, apart))
    places = _with_surface(frame.position[rows], texels.surface[rows], apart)
    distance, nearest = tree.query(places, k=k, workers=workers.count)
    radius = distance[:, -1]
    flux = _sums(photons.flux, nearest[:, :-1], workers)
    disk = np.pi * radius * radius
    texel_area = frame.area[rows].astype(np.float64)
    wide = disk > texel_area
    disk *= _share_on_surface(texels, frame, workers, rows, np.where(wide, radius, 0), apart)
    # k photons at one point, on a surface without extent: nothing to spread them over.
    solid = (disk > np.finfo(np.float32).tiny)[:, None]
    out = np.divide(flux, disk[:, None], out=np.zeros_like(flux), where=solid)
    per_texel = _mean_irradiance(photons.flux, photons.texel, frame.area.astype(np.float64))
    return np.where(wide[:, None], out, per_texel[rows])


def _sums(flux: Float32, nearest: Rows, workers: Workers) -> Float64:
    """(m, 3) sums of ``flux`` over each row of ``nearest`` (m, k)."""

    def part(rows: slice) -> Float64:
        return np.asarray(flux.take(nearest[rows], axis=0).sum(axis=1, dtype=np.float64))

    return np.concatenate(workers.map_slices(part, len(nearest), max(1, CHUNK_RAYS // nearest.shape[1])))


def _share_on_surface(
    texels: Texels, frame: TexelFrame, workers: Workers, rows: Rows, radius: Float64, apart: float
) -> Float64:
    """(m,) share of the disk of ``radius`` about each of ``rows`` that lies on its surface; less than 1 near a border.

    Counted in texels of the surface within the disk, against those of an endless square grid.
    """
    share = np.ones(len(rows))
    number = np.bincount(texels.surface, minlength=texels.surface_count)
    area = np.bincount(texels.surface, frame.area, minlength=texels.surface_count)
    width = np.sqrt(area / np.maximum(number, 1))[texels.surface[rows]]
    places = _with_surface(frame.position, texels.surface, apart)
    border = _border_texels(texels)
    to_border, _ = cKDTree(places[border]).query(places[rows], workers=workers.count)
    near = np.nonzero((radius > 0) & (width > 0) & (to_border < radius + width))[0]
    if not len(near):
        return share
    tree = cKDTree(places, leafsize=32)
    counted, expected = np.zeros(len(near)), np.zeros(len(near))
    for step in _COUNT_AT:
        reach = radius[near] + step * width[near]
        counted += tree.query_ball_point(places[rows[near]], reach, return_length=True, workers=workers.count)
        expected += _grid_points(reach / width[near])
    share[near] = np.minimum(counted / expected, 1)
    return share


def _border_texels(texels: Texels) -> Rows:
    """(b,) texels with a neighbour pixel that is not of their surface."""
    surface = np.where(texels.index >= 0, texels.surface.take(texels.index, mode="clip"), -1)
    padded = np.pad(surface, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
    page, row, col = texels.page, texels.row + 1, texels.col + 1
    around = ((1, 0), (-1, 0), (0, 1), (0, -1))
    return np.nonzero(np.any([padded[page, row + y, col + x] != texels.surface for y, x in around], axis=0))[0]


def _grid_points(radius: Float64) -> Float64:
    """(m,) points of the unit grid within ``radius`` of one of them."""
    steps = np.arange(-_COUNTED_WIDTHS, _COUNTED_WIDTHS + 1)
    squares = np.sort(np.add.outer(steps * steps, steps * steps).ravel())
    counted = np.searchsorted(squares, radius * radius, side="right")
    return np.where(radius < _COUNTED_WIDTHS, counted, np.pi * radius * radius)


def _with_surface(position: Float32, surface: Int32, apart: float) -> Float64:
    """(m, 4) positions with the surface's number, times ``apart`` m, as fourth coordinate."""
    return np.concatenate([position.astype(np.float64), surface[:, None] * apart], axis=1)
