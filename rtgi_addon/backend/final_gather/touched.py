# SPDX-License-Identifier: GPL-3.0-or-later
"""Which gather rays does a moved object touch? The swept test (see ``selection.sweep``) for rays that are not stored.

A gather ray's origin and direction follow from its texel and pattern, so only its length is kept. A texel sees a place
as a cone: one number per cosine ray tells whether it lies within. Only the rays that do are made and tested in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..sampling import dot
from ..scene import Bool, Float32, Int32
from ..selection.sweep import END_MARGIN, Sweep, meets, touched_by
from ..surface.tracing import CULL_MARGIN, Place
from .gather import GatherRays


@dataclass(frozen=True)
class Kept:
    """What is stored of the rays of m texels."""

    asked: Bool  # (m,) False: the texel itself moved, or needs no test
    hits_moved: Bool  # (m, cosine) the ray ended on an instance that moved
    hits_unknown: Bool  # (m, cosine) it ended on a side that no texel tells of
    distance: Float32  # (m, cosine) m, inf where it escaped
    seen: Bool  # (m, bright) the aim is in sight
    hidden: Bool  # (m, bright) something that may move stands before it


@dataclass(frozen=True)
class Touched:
    """Of m texels: which rays an object touches, where it was or where it is."""

    cosine: Bool  # (m, cosine)
    aimed: Bool  # (m, bright)
    tested: int  # rays that were looked at one by one


def touched_rays(rays: GatherRays, sweep: Sweep, texel: Int32, kept: Kept, reach: Float32) -> Touched:
    """The rays of those of ``texel`` (m,) that are asked for; reach (n,) of all texels' points from their middle.

    A ray that met an object where it was ended on it, and an aim in sight had nothing before it; so the places left
    matter only for what is not known. Samples that aim at what moved count as touched, whether they meet it or not.
    """
    asked = kept.asked[:, None]
    cosine = kept.hits_moved & asked
    aimed = np.zeros(kept.seen.shape, np.bool_)
    at, of, number = _chosen(kept.hits_unknown & asked & ~cosine, texel)
    _, origins, directions = rays.cosine_segments(of, number)
    cosine.reshape(-1)[at] = touched_by(sweep.left, origins, directions, kept.distance.reshape(-1)[at])
    tested = len(at)
    if rays.aims is not None:
        aimed |= _aimed_at_moved(rays, sweep, texel) & asked
        at, of, number = _chosen(kept.hidden & asked & ~aimed, texel)
        aim, _, origins, ways = rays.aimed_segments(of, number)
        aimed.reshape(-1)[at] = touched_by(sweep.left, origins, ways, _ends(rays, aim))
        tested += len(at)
    for place in sweep.taken:
        view = _view(rays, place, texel, kept.asked, reach)
        at, of, number = _chosen(_cosine_near(rays, view, texel, kept.distance) & ~cosine, texel)
        _, origins, directions = rays.cosine_segments(of, number)
        cosine.reshape(-1)[at] = meets(place, origins, directions, kept.distance.reshape(-1)[at])
        tested += len(at)
        if rays.aims is not None:
            at, of, number = _chosen(_aimed_near(rays, view, texel) & kept.seen & ~aimed, texel)
            aim, _, origins, ways = rays.aimed_segments(of, number)
            aimed.reshape(-1)[at] = meets(place, origins, ways, _ends(rays, aim))
            tested += len(at)
    return Touched(cosine, aimed, tested)


def _chosen(mask: Bool, texel: Int32) -> tuple[NDArray[np.int64], Int32, Int32]:
    """((r,) flat place, (r,) texel, (r,) number) of the rays in ``mask`` (m, K)."""
    at = np.flatnonzero(mask)  # several times faster than nonzero in two dimensions
    row = at // max(mask.shape[1], 1)
    return at, texel[row], (at - row * mask.shape[1]).astype(np.int32)


def _ends(rays: GatherRays, aim: NDArray[np.int64]) -> Float32:
    assert rays.aims is not None
    return np.where(rays.aims.is_sky.take(aim), np.float32(np.inf), np.float32(1))


@dataclass(frozen=True)
class _View:
    """How k of the texels see a place: the others have it below their horizon."""

    row: Int32  # (k,) of the m texels
    away: tuple[Float32, Float32, Float32]  # (k,) each: from the texel to the sphere's centre, m
    squared: Float32  # (k,) its squared length
    radius: Float32  # (k,) of the sphere that a ray from the texel's middle must meet


def _view(rays: GatherRays, place: Place, texel: Int32, asked: Bool, reach: Float32) -> _View:
    away = place.centre.astype(np.float32) - rays.frame.position.take(texel, axis=0)
    radius = np.float32(place.radius) + reach.take(texel)
    above = dot(away, rays.frame.normal.take(texel, axis=0)) >= -radius
    row = np.flatnonzero(above & asked).astype(np.int32)
    away, radius = away[row], radius[row]
    return _View(row, (away[:, 0], away[:, 1], away[:, 2]), dot(away, away), radius)


def _cosine_near(rays: GatherRays, view: _View, texel: Int32, distance: Float32) -> Bool:
    """(m, cosine) may the ray meet the sphere?"""
    near = np.zeros(distance.shape, np.bool_)
    of, (ax, ay, az) = texel[view.row], view.away
    pattern = rays.pattern.take(of)
    along = np.zeros((len(of), rays.n_cosine), np.float32)
    for table, axis in zip(rays.cosine_table.directions, rays.axes, strict=True):
        x, y, z = (a.take(of) for a in axis)
        along += table.take(pattern, axis=0) * (ax * x + ay * y + az * z)[:, None]
    # The sphere fills the cone of directions whose part along the axis is at least the tangent's length.
    tangent2 = view.squared * np.float32(1 - CULL_MARGIN) - view.radius * view.radius
    tangent = np.where(tangent2 > 0, np.sqrt(np.maximum(tangent2, 0)), -np.inf).astype(np.float32)
    first = (np.sqrt(view.squared) - view.radius) * np.float32(1 - END_MARGIN)
    near[view.row] = (along >= tangent[:, None] * np.float32(1 - CULL_MARGIN)) & (distance[view.row] >= first[:, None])
    return near


def _aimed_near(rays: GatherRays, view: _View, texel: Int32) -> Bool:
    """(m, bright) may the segment to the aim meet the sphere?"""
    assert rays.aims is not None
    near = np.zeros((len(texel), rays.n_bright), np.bool_)
    of = texel[view.row]
    pattern = rays.aim_pattern.take(of)
    shape = (-1, rays.n_bright)
    is_sky = rays.aims.is_sky.reshape(shape).take(pattern, axis=0)
    from_here = ~is_sky
    along = np.zeros((len(of), rays.n_bright), np.float32)
    length = np.zeros_like(along)
    for k, a in enumerate(view.away):
        way = rays.aims.point[:, k].reshape(shape).take(pattern, axis=0)
        way -= rays.frame.position[:, k].take(of)[:, None] * from_here
        along += way * a[:, None]
        length += way * way
    squared, radius = view.squared[:, None], view.radius[:, None]
    beside = squared * length * np.float32(1 - CULL_MARGIN) - along * along <= radius * radius * length
    reached = is_sky | (along - radius * np.sqrt(length) <= length * np.float32(1 + END_MARGIN))
    near[view.row] = (squared <= radius * radius) | (beside & reached & (along > 0))
    return near


def _aimed_at_moved(rays: GatherRays, sweep: Sweep, texel: Int32) -> Bool:
    """(m, bright) does the sample aim at an instance that moved?"""
    assert rays.aims is not None
    instance = rays.texels.instance
    moved = ~rays.aims.is_sky
    moved[moved] = sweep.moved[instance[rays.aims.target[moved]]]
    return np.asarray(moved.reshape(-1, rays.n_bright).take(rays.aim_pattern.take(texel), axis=0))
