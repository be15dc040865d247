# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance from photons: the k nearest of the texel's own surface over the area they span (Larsen04 §3).

One k-d tree for each surface, as in the paper: what a surface gets depends on its own photons and texels alone, so any
subset of the surfaces computed alone gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..lamps.emission import MESHES, SKY
from ..parallel import CHUNK_RAYS, Workers
from ..scene import Bool, Float32, Float64, Int32
from ..surface.texels import TexelFrame, Texels
from .paths import AFTER_DIFFUSE, AFTER_SPECULAR, PhotonPaths

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


def photon_irradiance(
    photons: PhotonMap,
    texels: Texels,
    frame: TexelFrame,
    workers: Workers,
    *,
    k: int,
    surfaces: Bool | None = None,
) -> Float32:
    """(n, 3) W/m² at each texel; zero off the chosen ``surfaces`` (surface_count,), None for all.

    The farthest of the k photons only sets the radius: counting it too would make the estimate too bright by
    1/(k - 1) where photons lie evenly. A surface with no more than k photons gets their flux over its whole area; a
    texel that is larger than the disk of its k photons gets all that landed on it over its own area.
    """
    out = np.zeros((texels.count, 3), np.float32)
    surface = texels.surface[photons.texel]
    if surfaces is not None:
        kept = np.nonzero(surfaces[surface])[0]
        surface = surface[kept]
        photons = PhotonMap(photons.position[kept], photons.flux[kept], photons.texel[kept])
    count = np.bincount(surface, minlength=texels.surface_count)
    rows = np.nonzero(((count > 0) & (count <= k))[texels.surface])[0]
    if len(rows):
        area = np.bincount(texels.surface, frame.area, minlength=texels.surface_count)
        out[rows] = _mean_irradiance(photons.flux, surface, np.asarray(area, np.float64))[texels.surface[rows]]
    many = np.nonzero(count > k)[0]
    if not len(many):
        return out
    per_texel = _mean_irradiance(photons.flux, photons.texel, frame.area.astype(np.float64))
    border = np.zeros(texels.count, np.bool_)
    border[_border_texels(texels)] = True
    photons_of, texels_of = _members(surface, texels.surface_count), _members(texels.surface, texels.surface_count)
    inner = 1 if len(many) >= workers.count else workers.count

    def one(place: slice) -> None:
        number = int(many[place.start])
        mine, rows = photons_of(number), texels_of(number)
        patch = _Patch(frame.position[rows].astype(np.float64), frame.area[rows].astype(np.float64), border[rows])
        out[rows] = _nearest(photons.position[mine], photons.flux[mine], patch, per_texel[rows], k, inner)

    workers.map_slices(one, len(many), 1)
    return out


def _members(surface: Int32, surface_count: int) -> Callable[[int], Rows]:
    """The rows of each surface, in order."""
    order = np.argsort(surface, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(surface, minlength=surface_count))])
    return lambda number: order[first[number] : first[number + 1]]


def _mean_irradiance(flux: Float32, bin_of_photon: Int32, area: Float64) -> Float64:
    """(bins, 3) W/m²: all flux in each bin over its area."""
    total = np.stack([np.bincount(bin_of_photon, flux[:, c], minlength=len(area)) for c in range(3)], axis=1)
    return np.divide(total, area[:, None], out=np.zeros_like(total), where=area[:, None] > 0)


@dataclass(frozen=True)
class _Patch:
    """The t texels of one surface."""

    position: Float64  # (t, 3) local
    area: Float64  # (t,) m²
    border: Bool  # (t,)


def _nearest(position: Float32, flux: Float32, patch: _Patch, per_texel: Float64, k: int, threads: int) -> Float64:
    """(t, 3) for the texels of a surface with more than k photons at ``position`` (m, 3)."""
    distance, nearest = cKDTree(position.astype(np.float64)).query(patch.position, k=k, workers=threads)
    radius = distance[:, -1]
    disk = np.pi * radius * radius
    wide = disk > patch.area
    disk *= _share_on_surface(patch, np.where(wide, radius, 0), threads)
    # k photons at one point, on a surface without extent: nothing to spread them over.
    solid = (disk > np.finfo(np.float32).tiny)[:, None]
    total = _sums(flux, nearest[:, :-1])
    out = np.divide(total, disk[:, None], out=np.zeros_like(total), where=solid)
    return np.where(wide[:, None], out, per_texel)


def _sums(flux: Float32, nearest: Rows) -> Float64:
    """(t, 3) sums of ``flux`` over each row of ``nearest`` (t, k)."""
    step = max(1, CHUNK_RAYS // nearest.shape[1])
    parts = [nearest[first : first + step] for first in range(0, len(nearest), step)]
    return np.concatenate([flux.take(part, axis=0).sum(axis=1, dtype=np.float64) for part in parts])


def _share_on_surface(patch: _Patch, radius: Float64, threads: int) -> Float64:
    """(t,) share of the disk of ``radius`` about each texel that lies on the surface; less than 1 near a border.

    Counted in texels of the surface within the disk, against those of an endless square grid.
    """
    share = np.ones(len(radius))
    width = float(np.sqrt(patch.area.sum() / len(radius)))
    to_border, _ = cKDTree(patch.position[patch.border]).query(patch.position, workers=threads)
    near = np.nonzero((radius > 0) & (to_border < radius + width))[0]
    if not len(near) or width <= 0:
        return share
    tree = cKDTree(patch.position, leafsize=32)
    counted, expected = np.zeros(len(near)), np.zeros(len(near))
    for step in _COUNT_AT:
        reach = radius[near] + step * width
        counted += tree.query_ball_point(patch.position[near], reach, return_length=True, workers=threads)
        expected += _grid_points(reach / width)
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
    counted = np.searchsorted(_grid_distances(), radius * radius, side="right")
    return np.where(radius < _COUNTED_WIDTHS, counted, np.pi * radius * radius)


@lru_cache(maxsize=1)
def _grid_distances() -> Rows:
    """Squared distances of the unit grid's points from one of them, in order."""
    steps = np.arange(-_COUNTED_WIDTHS, _COUNTED_WIDTHS + 1)
    return np.sort(np.add.outer(steps * steps, steps * steps).ravel())
