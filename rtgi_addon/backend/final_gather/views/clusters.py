# SPDX-License-Identifier: GPL-3.0-or-later
"""Groups of neighbouring triangles, so that a gather draws only what lies before the texels it draws for.

A texel receives light from the half space its normal points into; whole clusters behind that of every texel of a group
need not be drawn. Local space (see ``surface/geometry``). Conservative everywhere: a triangle of which any corner is in
front of any texel is never left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene import Bool, Float32, Float64, Int32

Int64 = NDArray[np.int64]

#: Bits of a Morton code for each axis; three axes fit into 30.
AXIS_BITS = 10
#: Distances of clusters from planes that are in memory at once: 16 MB of float64.
DISTANCES_AT_ONCE = 1 << 21
#: Rounding of a position, as share of its largest coordinate: four float32 steps, for corners that were placed, moved
#: into a view and tested in float32.
ROUNDING = 2.0**-22


@dataclass(frozen=True)
class Clusters:
    """c groups of t triangles, each of one instance; cluster k is ``order[first[k] : first[k + 1]]``."""

    order: Int32  # (t,) triangles, instance by instance, neighbours close together
    first: Int32  # (c + 1,) start of each cluster in ``order``; ends with t
    instance: Int32  # (c,)

    @property
    def count(self) -> int:
        return len(self.instance)


def make_clusters(corners: Float32, instance: Int32, size: int = 256) -> Clusters:
    """Clusters of at most ``size`` triangles along a Morton curve through each instance (Morton 1966).

    corners (t, 3, 3) local; instance (t,) non-decreasing. Triangles with a non-finite corner come last in their
    instance. Raises ValueError when the shapes do not match or instances are out of order.
    """
    count = len(corners)
    if corners.shape != (count, 3, 3) or instance.shape != (count,):
        raise ValueError(f"corners are (t, 3, 3) and instance (t,), not {corners.shape} and {instance.shape}")
    if size < 1 or (instance[1:] < instance[:-1]).any():
        raise ValueError("clusters hold a triangle at least, and instances do not decrease")
    new = np.ones(count, np.bool_)
    new[1:] = instance[1:] != instance[:-1]
    start = np.flatnonzero(new)
    run = np.cumsum(new) - 1  # (t,) which instance, of those that have triangles
    key = (run << (3 * AXIS_BITS + 1)) | _morton(corners, start, run)
    order = np.argsort(key, kind="stable")
    cut = np.flatnonzero((np.arange(count) - start[run]) % size == 0)
    return Clusters(
        order=order.astype(np.int32),
        first=np.concatenate([cut, [count]]).astype(np.int32),
        instance=instance[cut].astype(np.int32),
    )


def _boxes(corners: Float32) -> tuple[Float32, Float32, Bool]:
    """((t, 3) lowest, (t, 3) highest coordinates, (t,) all of them finite) of the triangles ``corners`` (t, 3, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    # Finite numbers do not overflow; a NaN or an infinity of any corner comes through.
    with np.errstate(invalid="ignore"):
        ends = low * np.float32(0.25) - high * np.float32(0.25)
    return low, high, np.isfinite(ends[:, 0]) & np.isfinite(ends[:, 1]) & np.isfinite(ends[:, 2])


def _morton(corners: Float32, start: Int64, run: Int64) -> Int64:
    """(t,) place of each centroid along the curve through its run's bounding cube; 2^30 for non-finite triangles."""
    code = np.full(len(corners), 1 << (3 * AXIS_BITS), np.int64)
    low, high, finite = _boxes(corners)
    if not finite.any():
        return code
    low[~finite], high[~finite] = np.inf, -np.inf
    low_of_run = np.minimum.reduceat(low, start).astype(np.float64)
    side = (np.maximum.reduceat(high, start) - low_of_run).max(axis=1)  # -inf where all of a run is non-finite
    scale = np.where(side > 0, (2**AXIS_BITS - 1) / np.where(side > 0, side, 1.0), 0.0)
    good = corners[finite].astype(np.float64)
    own = run[finite]
    for axis in range(3):
        centre = (good[:, 0, axis] + good[:, 1, axis] + good[:, 2, axis]) / 3
        cell = ((centre - low_of_run[own, axis]) * scale[own]).astype(np.int64)
        bits = _spread_bits(np.clip(cell, 0, 2**AXIS_BITS - 1)) << (2 - axis)
        code[finite] = bits if axis == 0 else code[finite] | bits
    return code


def _spread_bits(value: Int64) -> Int64:
    """``value`` (n,) of AXIS_BITS bits with two zeros between any two of them."""
    value = (value | value << 16) & 0x030000FF
    value = (value | value << 8) & 0x0300F00F
    value = (value | value << 4) & 0x030C30C3
    return np.asarray((value | value << 2) & 0x09249249)


def cluster_spheres(corners: Float32, clusters: Clusters) -> tuple[Float32, Float32]:
    """((c, 3) centre, (c,) radius, m) of a sphere around each cluster's finite triangles, rounded up.

    corners (t, 3, 3) local, of the triangles the clusters were made of, wherever they are by now. A cluster without a
    finite triangle has radius -inf.
    """
    if not clusters.count:
        return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    ordered = corners[clusters.order]
    start = clusters.first[:-1]
    low, high, finite = _boxes(ordered)
    low[~finite], high[~finite] = np.inf, -np.inf
    low, high = np.minimum.reduceat(low, start), np.maximum.reduceat(high, start)
    some = np.isfinite(low[:, 0])
    low[~some], high[~some] = 0.0, 0.0
    centre = low / 2 + high / 2
    square = np.where(finite, _farthest(ordered, np.repeat(centre, np.diff(clusters.first), axis=0)), 0.0)
    radius = np.sqrt(np.maximum.reduceat(square, start))
    with np.errstate(over="ignore"):  # an infinite radius is always in front
        # A step up after rounding to float32 is more than either rounding took off.
        rounded = np.nextafter(radius.astype(np.float32), np.float32(np.inf))
    return centre, np.where(some, rounded, np.float32(-np.inf))


def _farthest(corners: Float32, centre: Float32) -> Float64:
    """(t,) m², from ``centre`` (t, 3) to the farthest of ``corners`` (t, 3, 3), to float64."""
    wide = centre.astype(np.float64)
    farthest = np.zeros(len(centre))
    for corner in range(3):
        with np.errstate(invalid="ignore"):  # infinite corners belong to no sphere
            away = corners[:, corner] - wide
        farthest = np.maximum(farthest, np.einsum("ij,ij->i", away, away))
    return farthest


def in_front(centre: Float32, radius: Float32, eye: Float32, normal: Float32) -> Bool:
    """(c,) does the sphere reach into the half space before at least one eye?

    centre (c, 3) and radius (c,) as by :func:`cluster_spheres`; eye, normal (m, 3) local, of any length but zero. Eyes
    or normals that are not finite see nothing. All eyes of one normal are one plane, the farthest back of theirs.
    """
    seen = np.zeros(len(centre), np.bool_)
    normals, least, reach = _planes(eye, normal)
    slack = radius.astype(np.float64)
    slack += ROUNDING * (np.abs(centre).max(axis=1, initial=0) + reach + np.where(radius > 0, radius, 0))
    parts = -(-len(centre) * len(normals) // DISTANCES_AT_ONCE)
    rest = np.flatnonzero(radius >= 0)
    # Every part of the planes looks everywhere, so most clusters are seen by the first and cost no more.
    for part in range(parts):
        near = centre[rest].astype(np.float64) @ normals[part::parts].T - least[part::parts]
        found = near.max(axis=1, initial=-np.inf) + slack[rest] > 0
        seen[rest[found]] = True
        rest = rest[~found]
    return seen


def _planes(eye: Float32, normal: Float32) -> tuple[Float64, Float64, float]:
    """((u, 3) different unit normals, (u,) least eye · normal of each, largest coordinate of any eye)."""
    good = np.isfinite(eye).all(axis=1) & np.isfinite(normal).all(axis=1) & (normal != 0).any(axis=1)
    eyes = eye[good].astype(np.float64)
    order = np.lexsort(normal[good].T)
    ordered = normal[good][order]
    new = np.ones(len(ordered), np.bool_)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    start = np.flatnonzero(new)
    if not len(start):
        return np.zeros((0, 3)), np.zeros(0), 0.0
    normals = ordered[start].astype(np.float64)
    normals /= np.sqrt((normals * normals).sum(axis=1, keepdims=True))
    along = (eyes[order] * normals[np.cumsum(new) - 1]).sum(axis=1)
    return normals, np.minimum.reduceat(along, start), float(np.abs(eyes).max())
