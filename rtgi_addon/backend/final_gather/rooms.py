# SPDX-License-Identifier: GPL-3.0-or-later
"""Rooms: groups of surfaces that see one another, so that no sample is aimed at what lies behind a closed wall.

Found by a few rays, so an opening may be missed; what shines through it is then left to the cosine rays. That costs
noise, no light: the weights of all samples follow from the odds as they are.
"""

from __future__ import annotations

import numpy as np

from ..placed import PlacedScene
from ..sampling import hash_keys, sample_cosine_about, unit_float32
from ..scene import Int32
from ..surface.rasterise import POINTS
from .components import SurfaceGraph

#: Rays that look for what sees what; an opening of a thousandth of a room's walls is found by dozens.
RAYS = 1 << 15
#: Rooms with odds of their own; the smaller ones share those of all.
MOST_ROOMS = 8


def look_around(placed: PlacedScene, graph: SurfaceGraph, seed: int) -> int:
    """Add to ``graph`` which surfaces see which in the frame of ``placed``; rays traced."""
    count = placed.texels.count
    if not count:
        return 0
    ray = np.arange(RAYS)
    texel = (ray * count // RAYS).astype(np.int32)
    u, v = (unit_float32(hash_keys(ray, k, seed)) for k in range(2))
    directions = sample_cosine_about(placed.frame.normal.take(texel, axis=0), u, v)
    hits = placed.tracer.intersect(placed.frame.points[texel, ray % POINTS], directions)
    target = placed.texels.of_hits(hits.triangle, hits.u, hits.v, hits.back)
    surface = placed.texels.surface
    graph.add(surface[texel], np.where(target >= 0, surface.take(target, mode="clip"), np.int32(-1)))
    return RAYS


def rooms_of(graph: SurfaceGraph, surface: Int32) -> Int32:
    """(n,) the room of each texel, given its ``surface`` (n,): 1 and up for the largest; 0 for all others, and for all
    where there is one room alone."""
    labels = graph.labels()[surface]
    size = np.bincount(labels, graph.coupled()[surface])
    largest = np.argsort(-size, kind="stable")[:MOST_ROOMS]
    largest = largest[size[largest] > 0]
    number = np.zeros(len(size), np.int32)
    if len(largest) > 1:
        number[largest] = np.arange(1, len(largest) + 1)
    return np.asarray(number[labels])
