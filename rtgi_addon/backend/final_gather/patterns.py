# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables of gather-ray patterns. Each texel takes one by its number, so no ray needs random numbers of its own.

PATTERNS digit-scrambled copies of one low-discrepancy set: within a texel the rays are well spread, and two texels
rarely share a pattern, so what error is left looks like noise, which the denoiser removes best.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..sampling import UInt32, hash_keys, sample_cosine_hemisphere, stratified_pair, unit_float32
from ..scene import Float32, Int32
from ..surface.rasterise import POINTS

PATTERNS = 1024


@dataclass(frozen=True)
class CosinePatterns:
    """P patterns of c rays."""

    directions: Float32  # (P, c, 3) cosine-distributed about +z
    start: Int32  # (P, c) which of the texel's points the ray starts from


@dataclass(frozen=True)
class BrightPatterns:
    """P patterns of b aimed samples: uniform numbers for the choice of target, the point on it, the start."""

    choice: Float32  # (P, b) in [0, 1), stratified within a pattern
    target: Float32  # (P, b, 2) in [0, 1)
    start: Int32  # (P, b) which of the texel's points the ray starts from


@lru_cache(maxsize=8)
def cosine_patterns(count: int, seed: int) -> CosinePatterns:
    keys = np.arange(PATTERNS, dtype=np.uint32)
    u, v = (unit_float32(x).reshape(-1) for x in stratified_pair(keys, count, pair=0, seed=seed))
    directions = sample_cosine_hemisphere(u, v).astype(np.float32).reshape(PATTERNS, count, 3)
    return CosinePatterns(directions, _starts(keys, count, 1, seed))


@lru_cache(maxsize=8)
def bright_patterns(count: int, seed: int) -> BrightPatterns:
    keys = np.arange(PATTERNS, dtype=np.uint32)
    # A (0, 2)-sequence: the first half of the samples is stratified by itself, and so is the second.
    choice = unit_float32(stratified_pair(keys, count, pair=4, seed=seed)[0])
    on_target = np.stack([unit_float32(x) for x in stratified_pair(keys, count, pair=2, seed=seed)], axis=-1)
    return BrightPatterns(choice, on_target.astype(np.float32), _starts(keys, count, 3, seed))


def _starts(keys: UInt32, count: int, pair: int, seed: int) -> Int32:
    """(P, count) points 0..POINTS-1, each as often as the others, in an order of its own for each pattern."""
    spread = unit_float32(stratified_pair(keys, count, pair=pair, seed=seed)[0])
    return (spread * POINTS).astype(np.int32)


def pattern_of_texels(first: int, stop: int, seed: int) -> Int32:
    """(stop - first,) the pattern of each texel numbered ``first`` .. ``stop`` - 1."""
    return (hash_keys(np.arange(first, stop), 11, seed) % np.uint32(PATTERNS)).astype(np.int32)
