# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables of gather-ray patterns. Each texel takes one by its place on the page, so no ray needs numbers of its own.

Within a texel the rays are a digit-scrambled low-discrepancy set. The TILE × TILE texels of a tile take consecutive
parts of one such set: together they are as well spread as one texel with TILE² times the rays, so that what the
denoiser averages cancels. Tiles are scrambled each in its own way.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..sampling import hash_keys, sample_cosine_hemisphere, stratified_pair, unit_float32
from ..scene import Float32, Int32
from ..surface.rasterise import POINTS

#: Texels along a tile; a power of two.
TILE = 4
#: Scrambled sets; two tiles that look alike are rarely near.
SETS = 64
PATTERNS = SETS * TILE * TILE


@dataclass(frozen=True)
class CosinePatterns:
    """P patterns of c rays."""

    directions: tuple[Float32, Float32, Float32]  # x, y, z (P, c) each, cosine-distributed about +z
    start: Int32  # (P, c) which of the texel's points the ray starts from


@dataclass(frozen=True)
class BrightPatterns:
    """P patterns of b aimed samples: uniform numbers for the choice of target, the point on it, the start."""

    choice: Float32  # (P, b) in [0, 1), stratified within a pattern
    target: Float32  # (P, b, 2) in [0, 1)
    start: Int32  # (P, b) which of the texel's points the ray starts from


@lru_cache(maxsize=8)
def cosine_patterns(count: int, seed: int) -> CosinePatterns:
    u, v = (x.reshape(-1) for x in _pair(count, 0, seed))
    x, y, z = np.ascontiguousarray(sample_cosine_hemisphere(u, v).T, np.float32).reshape(3, PATTERNS, count)
    return CosinePatterns((x, y, z), _starts(count, 1, seed))


@lru_cache(maxsize=8)
def bright_patterns(count: int, seed: int) -> BrightPatterns:
    # A (0, 2)-sequence: the first half of the samples is stratified by itself, and so is the second.
    choice, _ = _pair(count, 4, seed)
    on_target = np.stack(_pair(count, 2, seed), axis=-1)
    return BrightPatterns(choice, on_target, _starts(count, 3, seed))


def _pair(count: int, pair: int, seed: int) -> tuple[Float32, Float32]:
    """(P, count), (P, count) points of the square: each set's sequence cut into the parts of its tile's texels."""
    keys = np.arange(SETS, dtype=np.uint32)
    x, y = stratified_pair(keys, TILE * TILE * count, pair=pair, seed=seed)
    return unit_float32(x).reshape(PATTERNS, count), unit_float32(y).reshape(PATTERNS, count)


def _starts(count: int, pair: int, seed: int) -> Int32:
    """(P, count) points 0..POINTS-1, each as often as the others, in an order of its own for each pattern."""
    return np.asarray(_pair(count, pair, seed)[0] * POINTS, np.int32)


def pattern_of_texels(page: Int32, row: Int32, col: Int32, seed: int) -> Int32:
    """(m,) the pattern of texels at ``page``, ``row``, ``col`` (m,)."""
    tile = hash_keys(page, row // TILE, col // TILE, seed) % np.uint32(SETS)
    # Neighbours in pairs, pairs of pairs: every 2 × 2 block of a tile is a part of its own.
    r, c = row % TILE, col % TILE
    within = (r & 1) | (c & 1) << 1 | (r & 2) << 1 | (c & 2) << 2
    return np.asarray(tile.astype(np.int32) * (TILE * TILE) + within, np.int32)
