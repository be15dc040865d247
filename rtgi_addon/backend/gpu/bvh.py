# SPDX-License-Identifier: GPL-3.0-or-later
"""A bounding volume hierarchy over triangles, made by NumPy for ``shaders/inc/bvh.glsl``. Needs no OpenGL.

Binned SAH (Wald 2007) along the longest axis of the centroids, level by level: all open nodes of a level are split at
once, so Python loops over levels alone. An LBVH (Karras 2012) is built sooner, but rays take markedly longer in its
tree (Karras and Aila 2013), and here one tree serves many millions of rays. A node holds the boxes of its two children
(Aila and Laine 2009), so one fetch decides about both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Bool, Float32, Int32

Int64 = NDArray[np.int64]

#: Triangles of a leaf at most.
LEAF_TRIANGLES = 4
#: Nodes on the way from the root to a leaf at most: the shader's stack. Where SAH would go deeper, nodes are halved.
MAX_DEPTH = 40
#: Wald 2007 §3.2 finds 16 bins as good as any number above.
BINS = 16
#: Nodes whose bins are looked at together: 3 MB of them, where a level of a million triangles would take 100 MB.
NODES_AT_A_TIME = 1 << 13
#: A leaf's link is ~(first · LEAF_STRIDE + count): the count sits in the lowest three bits.
LEAF_STRIDE = 8
#: Triangles whose slots a link can count, in 31 bits.
MAX_TRIANGLES = (1 << 31) // LEAF_STRIDE
EMPTY_LEAF = -1

#: As ``Node`` and ``Triangle`` of ``inc/bvh.glsl`` lie in std430.
NODE = np.dtype(
    [
        ("left_low", "<f4", 3),
        ("left", "<i4"),
        ("left_high", "<f4", 3),
        ("right", "<i4"),
        ("right_low", "<f4", 3),
        ("unused_low", "<f4"),
        ("right_high", "<f4", 3),
        ("unused_high", "<f4"),
    ]
)
TRIANGLE = np.dtype(
    [
        ("a", "<f4", 3),
        ("number", "<i4"),
        ("b", "<f4", 3),
        ("unused_b", "<f4"),
        ("c", "<f4", 3),
        ("unused_c", "<f4"),
    ]
)


@dataclass(frozen=True)
class Bvh:
    """n nodes, the root first, over the k triangles that rays can hit; always at least one node."""

    low: Float32  # (n, 2, 3) lowest corner of each child's box; zeros where the child is an empty leaf
    high: Float32  # (n, 2, 3) highest corner
    link: Int32  # (n, 2) the child's node; or, negative, ~(first · LEAF_STRIDE + count): these rows of ``order``
    order: Int32  # (k,) triangles, leaf by leaf
    depth: int  # nodes on the longest way from the root to a leaf

    @property
    def bounds(self) -> tuple[Float32, Float32]:
        """(3,), (3,) lowest and highest corner of everything; zeros without a triangle."""
        used = self.link[0] != EMPTY_LEAF
        if not used.any():
            return np.zeros(3, np.float32), np.zeros(3, np.float32)
        return self.low[0, used].min(axis=0), self.high[0, used].max(axis=0)


def build_bvh(corners: Float32) -> Bvh:
    """The hierarchy over ``corners`` (t, 3, 3).

    Triangles with a corner that is not finite, and those of no area, are in no leaf. Raises ValueError beyond
    MAX_TRIANGLES.
    """
    corners = np.asarray(corners, np.float32)
    kept = np.flatnonzero(hittable(corners)).astype(np.int32)
    if len(kept) >= MAX_TRIANGLES:
        raise ValueError(f"{len(kept)} triangles: a hierarchy holds fewer than {MAX_TRIANGLES}")
    # Lowest corners, and highest ones with their signs turned: one minimum serves both.
    a, b, c = (corners[kept, k].T for k in range(3))
    boxes = np.concatenate([np.minimum(np.minimum(a, b), c), -np.maximum(np.maximum(a, b), c)])  # (6, k)
    if len(kept) <= LEAF_TRIANGLES:
        return _one_leaf(kept, boxes)
    order = np.zeros(len(kept), np.int32)
    level = _Level(kept, boxes, np.zeros(1, np.int64), np.array([len(kept)]))
    lows: list[Float32] = []
    highs: list[Float32] = []
    links: list[Int64] = []
    nodes = 0
    # Coordinates near float32's end overflow to costs that are not finite; such nodes are halved.
    with np.errstate(all="ignore"):
        while len(level.count):
            split = _split(level, depth=len(links) + 1)
            order[_ranges(split.first, split.count)] = split.triangles
            nodes += len(level.count)
            low_high = np.minimum.reduceat(split.boxes, _starts(split.count), axis=1).T.reshape(-1, 2, 6)
            lows.append(low_high[..., :3])
            highs.append(-low_high[..., 3:])
            is_open = split.count > LEAF_TRIANGLES
            leaf = ~(split.first * LEAF_STRIDE + split.count)
            links.append(np.where(is_open, nodes + np.cumsum(is_open) - 1, leaf).reshape(-1, 2))
            level = split.only(is_open)
    return Bvh(
        low=np.concatenate(lows),
        high=np.concatenate(highs),
        link=np.concatenate(links).astype(np.int32),
        order=order,
        depth=len(links),
    )


def hittable(corners: Float32) -> Bool:
    """(t,) have ``corners`` (t, 3, 3) finite coordinates and an area?"""
    finite = np.isfinite(corners.reshape(len(corners), 9)).all(axis=1)
    with np.errstate(all="ignore"):
        wide = corners.astype(np.float64)
        a, b = wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0]
        # In float64 a difference of float32 is exact or nearly so: corners in a line come out as zero.
        flat = a[:, [1, 2, 0]] * b[:, [2, 0, 1]] == a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
    return np.asarray(finite & ~flat.all(axis=1))


def pack_nodes(bvh: Bvh, first_node: int, first_triangle: int) -> NDArray[np.void]:
    """(n,) NODE with links for a buffer in which the hierarchy's own nodes and triangles start at these rows."""
    leaf = bvh.link < 0
    link = np.where(leaf, bvh.link - first_triangle * LEAF_STRIDE, bvh.link + first_node)
    link[bvh.link == EMPTY_LEAF] = EMPTY_LEAF
    packed = np.zeros(len(link), NODE)
    for side, name in enumerate(("left", "right")):
        packed[f"{name}_low"] = bvh.low[:, side]
        packed[f"{name}_high"] = bvh.high[:, side]
        packed[name] = link[:, side]
    return packed


def pack_triangles(bvh: Bvh, corners: Float32, number: Int32) -> NDArray[np.void]:
    """(k,) TRIANGLE in the order of leaves; ``corners`` (t, 3, 3) as they were built, ``number`` (t,) for hits."""
    packed = np.zeros(len(bvh.order), TRIANGLE)
    for corner, name in enumerate("abc"):
        packed[name] = corners[bvh.order, corner]
    packed["number"] = number[bvh.order]
    return packed


@dataclass(frozen=True)
class _Level:
    """s nodes side by side: the next ``count`` of m triangles each, which fill rows from ``first`` on in the end."""

    triangles: Int32  # (m,)
    boxes: Float32  # (6, m) lowest corners, highest ones negated
    first: Int64  # (s,)
    count: Int64  # (s,)

    def only(self, nodes: Bool) -> _Level:
        """Those of ``nodes`` (s,)."""
        rows = np.flatnonzero(np.repeat(nodes, self.count))
        return _Level(self.triangles[rows], self.boxes.take(rows, axis=1), self.first[nodes], self.count[nodes])


def _one_leaf(kept: Int32, boxes: Float32) -> Bvh:
    low, high = np.zeros((1, 2, 3), np.float32), np.zeros((1, 2, 3), np.float32)
    if len(kept):
        low[0, 0], high[0, 0] = boxes[:3].min(axis=1), -boxes[3:].min(axis=1)
    return Bvh(low, high, np.array([[~len(kept), EMPTY_LEAF]], np.int32), kept, 1)


def _split(level: _Level, depth: int) -> _Level:
    """Every node's two children, side by side (2s)."""
    nodes = len(level.count)
    key = np.repeat(np.arange(nodes) * BINS, level.count) + _bins(level)
    rows = _stable_order(key)
    key, boxes = key[rows], level.boxes.take(rows, axis=1)
    starts = np.append(_starts(level.count), len(key))
    left = np.zeros(nodes, np.int64)
    for begin in range(0, nodes, NODES_AT_A_TIME):
        end = min(begin + NODES_AT_A_TIME, nodes)
        rows_here = slice(starts[begin], starts[end])
        left[begin:end] = _left_counts(key[rows_here] - begin * BINS, boxes[:, rows_here], level.count[begin:end])
    larger = np.maximum(left, level.count - left)
    # No split found (all centroids in one bin), or one that leaves more than the levels below can halve.
    halved = (left == 0) | (depth + _levels(larger) > MAX_DEPTH)
    left = np.where(halved, level.count // 2, left)
    first = np.stack([level.first, level.first + left], axis=1).ravel()
    count = np.stack([left, level.count - left], axis=1).ravel()
    return _Level(level.triangles[rows], boxes, first, count)


def _bins(level: _Level) -> Int64:
    """(m,) bin of each triangle along the longest axis of its node's centroids; 0 where they all coincide."""
    starts, nodes = _starts(level.count), np.arange(len(level.count))
    centre = level.boxes[:3] - level.boxes[3:]  # (3, m) twice the centroid
    low = np.minimum.reduceat(centre, starts, axis=1)  # (3, s)
    width = np.maximum.reduceat(centre, starts, axis=1) - low
    axis = width.argmax(axis=0)
    low, width = low[axis, nodes], width[axis, nodes]
    scale = np.divide(BINS, width, out=np.zeros_like(width), where=(width > 0) & np.isfinite(width))
    scale[~np.isfinite(scale)] = 0  # a width of next to nothing
    along = np.take(centre, np.repeat(axis * centre.shape[1], level.count) + np.arange(centre.shape[1]))
    place = (along - np.repeat(low, level.count)) * np.repeat(scale, level.count)
    return np.asarray(np.clip(place, 0, BINS - 1), np.int64)


def _left_counts(key: Int64, boxes: Float32, count: Int64) -> Int64:
    """(s,) triangles left of the cheapest border between bins; 0 where no border has triangles on both sides.

    key (m,) node · BINS + bin, ascending; boxes (6, m) in that order; count (s,).
    """
    starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    shape = (6, len(count), BINS)
    bins = np.full(shape, np.inf, np.float32)
    bins.reshape(6, -1)[:, key[starts]] = np.minimum.reduceat(boxes, starts, axis=1)
    members = np.bincount(key, minlength=len(count) * BINS).reshape(-1, BINS)
    left = np.cumsum(members, axis=1)[:, :-1]  # (s, BINS - 1) triangles before each border
    cost = _areas(np.minimum.accumulate(bins, axis=2)[..., :-1]) * left
    behind = np.minimum.accumulate(bins[..., ::-1], axis=2)[..., -2::-1]
    cost += _areas(behind) * (count[:, None] - left)
    cost[(left == 0) | (left == count[:, None]) | ~np.isfinite(cost)] = np.inf
    best = cost.argmin(axis=1)[:, None]
    found = np.isfinite(np.take_along_axis(cost, best, axis=1))
    return np.asarray(np.where(found, np.take_along_axis(left, best, axis=1), 0)[:, 0])


def _areas(boxes: Float32) -> Float32:
    """Half the surfaces of ``boxes`` (6, ...); 0 of the empty one, whose corners are at infinity."""
    x, y, z = np.maximum(-(boxes[:3] + boxes[3:]), 0)
    return np.asarray(x * y + y * z + z * x)


def _levels(count: Int64) -> Int64:
    """Levels of nodes that halving needs until ``count`` triangles are in leaves."""
    return np.asarray(np.ceil(np.log2(np.maximum(count, LEAF_TRIANGLES) / LEAF_TRIANGLES)), np.int64)


def _stable_order(key: Int64) -> Int64:
    """What sorts ``key`` (m,), equal ones as they were. By 16 bits at a time, which NumPy sorts by counting."""
    rows = np.argsort(key.astype(np.uint16), kind="stable")
    if len(key) and int(key.max()) >> 16:
        rows = rows[np.argsort((key >> 16)[rows].astype(np.uint16), kind="stable")]
    return np.asarray(rows)


def _starts(count: Int64) -> Int64:
    """(s,) where each of the ranges of ``count`` begins, one after another."""
    return np.asarray(np.cumsum(count) - count)


def _ranges(first: Int64, count: Int64) -> Int64:
    """The numbers first[i] ... first[i] + count[i] - 1 of all i, one after another."""
    return np.asarray(np.repeat(first - _starts(count), count) + np.arange(int(count.sum())))
