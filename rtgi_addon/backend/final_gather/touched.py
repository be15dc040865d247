# SPDX-License-Identifier: GPL-3.0-or-later
"""Which gather rays does a moved object touch? The swept test (see ``selection.sweep``) for rays that are not stored.

A gather ray's origin and direction follow from its texel and pattern, so only its length is kept. A texel sees a place
as a cone: one number per cosine ray tells whether it lies within. Only the rays that do are made and tested in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sampling import dot
from ..scene import Bool, Float32, Int32
from ..selection.sweep import CULL_MARGIN, END_MARGIN, Sweep, meets
from ..surface.tracing import Place
from .gather import GatherRays


@dataclass(frozen=True)
class Touched:
    """Of m texels: which rays meet a place."""

    cosine: Bool  # (m, cosine)
    aimed: Bool  # (m, bright)
    tested: int  # rays that were looked at one by one


def touched_rays(
    rays: GatherRays, sweep: Sweep, texel: Int32, distance: Float32, open_aims: Bool, reach: Float32
) -> Touched:
    """The rays of ``texel`` (m,), which did not move.

    distance (m, cosine) of their hits · open_aims (m, bright) False: nothing that moves can uncover the aim · reach
    (n,) of all texels' points from their middle. Aimed samples whose target moved count as touched, whether they meet
    it or not.
    """
    cosine = np.zeros((len(texel), rays.n_cosine), np.bool_)
    aimed = np.zeros((len(texel), rays.n_bright), np.bool_)
    tested = 0
    if rays.aims is not None:
        aimed |= _aimed_at_moved(rays, sweep, texel)
    for place in sweep.places:
        view = _view(rays, place, texel, reach)
        row, number = np.nonzero(_cosine_near(rays, view, texel, distance) & ~cosine)
        tested += len(row)
        if len(row):
            of, number = texel[row], number.astype(np.int32)
            _, origins, directions = rays.cosine_segments(of, number)
            met = meets(place, origins, directions, distance[row, number])
            cosine[row[met], number[met]] = True
        if rays.aims is None:
            continue
        row, number = np.nonzero(_aimed_near(rays, view, texel) & open_aims & ~aimed)
        tested += len(row)
        if len(row):
            at, _, origins, ways = rays.aimed_segments(texel[row], number.astype(np.int32))
            ends = np.where(rays.aims.is_sky.take(at), np.float32(np.inf), np.float32(1))
            met = meets(place, origins, ways, ends)
            aimed[row[met], number[met]] = True
    return Touched(cosine, aimed, tested)


@dataclass(frozen=True)
class _View:
    """How k of the texels see a place: the others have it below their horizon."""

    row: Int32  # (k,) of the m texels
    away: tuple[Float32, Float32, Float32]  # (k,) each: from the texel to the sphere's centre, m
    squared: Float32  # (k,) its squared length
    radius: Float32  # (k,) of the sphere that a ray from the texel's middle must meet


def _view(rays: GatherRays, place: Place, texel: Int32, reach: Float32) -> _View:
    away = place.centre.astype(np.float32) - rays.frame.position.take(texel, axis=0)
    radius = np.float32(place.radius) + reach.take(texel)
    row = np.nonzero(dot(away, rays.frame.normal.take(texel, axis=0)) >= -radius)[0].astype(np.int32)
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
