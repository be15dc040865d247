# SPDX-License-Identifier: GPL-3.0-or-later
"""Random numbers without a generator, and the densities they are turned into.

Every number is a function of integer keys alone (light, photon, bounce, dimension, seed), so any subset of the work
can be redone alone and gives the same bits. Numbers are 32-bit fixed point until :func:`unit_float32` or
:func:`unit_float64`. Each ``sample_x`` has its ``pdf_x``; densities are per solid angle or per area.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .scene import Float32, Float64, Int32

UInt32 = NDArray[np.uint32]
#: Either precision: the result has that of the numbers given.
Floats = NDArray[np.floating[Any]]

#: Halton bases. Beyond them numbers are hashed: Halton's high bases are no better than chance at usual counts.
PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59)
#: Dimensions of a photon that its emission uses, and each bounce after it.
EMISSION_DIMENSIONS = 5
BOUNCE_DIMENSIONS = 3

_TABLE_SIZE = 1 << 12  # entries of a digit table: 16 kB, stays in the first cache


# --- integer keys -> uniform bits ---------------------------------------------------------------------------------


def hash_uint32(value: UInt32) -> UInt32:
    """(n,) well mixed bits of (n,) integers: the PCG output hash (Jarzynski and Olano 2020, "pcg")."""
    state = value * np.uint32(747796405) + np.uint32(2891336453)
    word = ((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
    return np.asarray((word >> np.uint32(22)) ^ word)


def hash_keys(first: NDArray[np.integer[Any]], *keys: int | NDArray[np.integer[Any]]) -> UInt32:
    """(n,) bits of several keys, arrays (n,) or numbers; the order of the keys matters."""
    bits = hash_uint32(np.atleast_1d(first).astype(np.uint32))
    for key in keys:
        bits = hash_uint32(bits ^ np.asarray(np.asarray(key, np.int64) & 0xFFFFFFFF).astype(np.uint32))
    return bits


def unit_float32(bits: UInt32) -> Float32:
    """[0, 1) from the upper 24 bits."""
    return (bits >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def unit_float64(bits: UInt32) -> Float64:
    """[0, 1) from all 32 bits."""
    return np.asarray(bits * 2.0**-32)


@lru_cache(maxsize=256)
def _digit_tables(dimension: int, seed: int) -> tuple[int, UInt32, UInt32]:
    """(size, low, high): scrambled radical inverse of i % size and of i // size, fixed point.

    Each digit has a random permutation of its own (random digit scrambling), drawn from the seed.
    """
    base = PRIMES[dimension]
    digits = int(np.log(_TABLE_SIZE) / np.log(base) + 1e-9)
    size = base**digits
    rng = np.random.default_rng([seed, dimension])
    tables = []
    scale = 1.0
    for _ in range(2):
        rest = np.arange(size)
        value = np.zeros(size)
        for _ in range(digits):
            scale /= base
            value += rng.permutation(base)[rest % base] * scale
            rest = rest // base
        tables.append(np.minimum(np.floor(value * 2.0**32), 2.0**32 - 1).astype(np.uint32))
    return size, tables[0], tables[1]


def halton(index: UInt32, dimension: int, *, seed: int = 0) -> UInt32:
    """(n,) fixed-point scrambled Halton points in base ``PRIMES[dimension]``.

    Digits beyond two tables (base 2: index >> 24) are below the resolution of float32 and are left out.
    """
    size, low, high = _digit_tables(dimension, seed)
    block = index // np.uint32(size)
    bits = low.take(index - block * np.uint32(size))
    bits += high.take(block, mode="wrap")
    return bits


def photon_numbers(
    light: Int32, index: UInt32, bounce: int, *, dimensions: int | None = None, seed: int = 0
) -> list[UInt32]:
    """Fixed-point numbers (n,), one array per dimension, of photons ``index`` of ``light`` at ``bounce``.

    Bounce 0 is the emission (EMISSION_DIMENSIONS numbers), later ones have BOUNCE_DIMENSIONS each. They depend on
    nothing but the arguments. Lights share one Halton sequence, each rotated (Cranley and Patterson 1976).
    """
    if bounce == 0:
        first, count = 0, EMISSION_DIMENSIONS
    else:
        first, count = EMISSION_DIMENSIONS + (bounce - 1) * BOUNCE_DIMENSIONS, BOUNCE_DIMENSIONS
    count = count if dimensions is None else min(count, dimensions)
    numbers = []
    for dimension in range(first, first + count):
        if dimension < len(PRIMES):
            numbers.append(halton(index, dimension, seed=seed) + _rotation(light, dimension, seed))
        else:
            numbers.append(hash_keys(index, light, dimension, seed))
    return numbers


def _rotation(light: Int32, dimension: int, seed: int) -> UInt32:
    if len(light) == 0:
        return np.zeros(0, np.uint32)
    low = int(light.min())
    table = hash_keys(np.arange(low, int(light.max()) + 1), dimension, seed)
    return table.take(light - np.int32(low))


@lru_cache(maxsize=32)
def _sobol_pairs(count: int) -> tuple[int, UInt32, UInt32]:
    """(k, (count,), (2^k,)): the first ``count`` <= 2^k points of van der Corput's sequence, fixed point, and Sobol's
    second dimension by the upper k bits of the first."""
    bits = max(count - 1, 0).bit_length()
    index = np.arange(1 << bits, dtype=np.uint32)
    first, second = np.zeros(len(index), np.uint32), np.zeros(len(index), np.uint32)
    direction = 1 << 31
    for bit in range(32):
        on = (index >> np.uint32(bit)) & np.uint32(1)
        first |= on << np.uint32(31 - bit)
        second ^= on * np.uint32(direction)
        direction ^= direction >> 1
    return bits, first[:count], second[np.argsort(first)]


def _nested_shuffle(bits: UInt32, key: UInt32) -> UInt32:
    """A permutation in which each bit depends on the lower ones alone (Laine and Karras 2011, Burley 2020 §4)."""
    bits = bits ^ bits * np.uint32(0x3D20ADEA)
    bits = (bits + key) * ((key >> np.uint32(16)) | np.uint32(1))
    bits ^= bits * np.uint32(0x05526C56)
    bits ^= bits * np.uint32(0x53A22864)
    return bits


def stratified_pair(key: UInt32, count: int, *, pair: int, seed: int = 0) -> tuple[UInt32, UInt32]:
    """(n, count), (n, count) fixed-point points of the square: ``count`` stratified ones for each of n keys.

    A (0, 2)-sequence, digit-scrambled per key. Each ``pair`` runs through it in an order of its own, so that several
    pairs together fill the space of more dimensions (padding; Burley 2020 §5).
    """
    bits, first, second = _sobol_pairs(count)
    if bits == 0:
        slot = np.zeros((len(key), 1), np.uint32)
        x = slot
    else:
        low = np.uint32(32 - bits)
        slot = _nested_shuffle(first[None, :], hash_keys(key, 3 * pair, seed)[:, None]) >> low
        x = slot << low
    x = x ^ hash_keys(key, 3 * pair + 1, seed)[:, None]
    y = second.take(slot) ^ hash_keys(key, 3 * pair + 2, seed)[:, None]
    return x, y


# --- vectors ------------------------------------------------------------------------------------------------------


def dot(a: Floats, b: Floats) -> Floats:
    """(n,) of (n, 3) and (n, 3), summed in one fixed order."""
    product = a * b
    return np.asarray(product[:, 0] + product[:, 1] + product[:, 2])


def frames(normals: Floats) -> tuple[Floats, Floats]:
    """((n, 3), (n, 3)) two tangents that complete each unit normal to a right-handed frame (Duff et al. 2017)."""
    x, y, z = normals[:, 0], normals[:, 1], normals[:, 2]
    sign = np.copysign(np.ones_like(z), z)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    bitangent = np.stack([b, sign + y * y * a, -y], axis=1)
    return tangent, bitangent


def to_frame(local: Floats, normals: Floats) -> Floats:
    """(n, 3) vectors given in the frames of ``normals`` (z along the normal), in the space of the normals."""
    tangent, bitangent = frames(normals)
    return np.asarray(tangent * local[:, :1] + bitangent * local[:, 1:2] + normals * local[:, 2:])


# --- densities: u, v are (n,) in [0, 1) ------------------------------------------------------------------------------


def sample_disk(u: Floats, v: Floats) -> Floats:
    """(n, 2) uniform on the unit disk."""
    radius = np.sqrt(u)
    angle = v * u.dtype.type(2 * np.pi)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def pdf_disk() -> float:
    return 1 / np.pi


def sample_sphere(u: Floats, v: Floats) -> Floats:
    """(n, 3) uniform unit vectors."""
    one, two = u.dtype.type(1), u.dtype.type(2)
    z = one - two * u
    radius = np.sqrt(np.maximum(one - z * z, 0))
    angle = v * u.dtype.type(2 * np.pi)
    out = np.zeros((len(u), 3), u.dtype)
    np.multiply(radius, np.cos(angle), out=out[:, 0])
    np.multiply(radius, np.sin(angle), out=out[:, 1])
    out[:, 2] = z
    return out


def pdf_sphere() -> float:
    return 1 / (4 * np.pi)


def sample_cosine_hemisphere(u: Floats, v: Floats) -> Floats:
    """(n, 3) unit vectors about +z, density proportional to the cosine."""
    disk = sample_disk(u, v)
    return np.concatenate([disk, np.sqrt(np.maximum(1 - u, 0))[:, None]], axis=1)


def pdf_cosine_hemisphere(cosine: Floats) -> Floats:
    """(n,) 1/sr of directions at ``cosine`` to the normal."""
    return np.asarray(np.maximum(cosine, 0) / np.pi)


def sample_cosine_about(normals: Floats, u: Floats, v: Floats) -> Floats:
    """(n, 3) cosine-distributed unit vectors about ``normals``: normal plus a point of the unit sphere.

    Half the work of a frame. Density as :func:`pdf_cosine_hemisphere`.
    """
    out = sample_sphere(u, v)
    out += normals
    length_squared = dot(out, out)
    # Opposite to the normal the sum vanishes; the direction is then the normal itself.
    lost = length_squared < 1e-8
    if lost.any():
        out[lost], length_squared[lost] = normals[lost], 1
    out /= np.sqrt(length_squared)[:, None]
    return out


def sample_cone(u: Floats, v: Floats, cos_half: float | Floats) -> Floats:
    """(n, 3) uniform unit vectors within the cone about +z; ``cos_half`` is the cosine of half its angle."""
    z = 1 - u * (1 - cos_half)
    radius = np.sqrt(np.maximum(u * (1 - cos_half) * (1 + z), 0))  # sqrt(1 - z²) without cancellation
    angle = v * u.dtype.type(2 * np.pi)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def pdf_cone(cos_half: float) -> float:
    """1/sr within the cone."""
    return 1 / (2 * np.pi * (1 - cos_half))


def sample_triangle(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """((n,), (n,)) uniform barycentric weights of the second and third corner."""
    root = np.sqrt(u)
    return root * (1 - v), root * v


def pdf_triangle(area: Floats) -> Floats:
    """1/m² on a triangle of ``area``."""
    return np.asarray(1 / area)


@dataclass(frozen=True)
class Discrete:
    """One of m elements, with given odds."""

    cdf: Float64  # (m + 1,) from 0 to 1
    total: float  # sum of the weights it was made from

    def sample(self, u: Floats) -> tuple[Int32, Float64]:
        """((n,), (n,)) element drawn by ``u``, and what is left of ``u``, uniform again in [0, 1)."""
        index = np.searchsorted(self.cdf, u, side="right").astype(np.int32) - np.int32(1)
        low, high = self.cdf[index], self.cdf[index + 1]
        return index, np.clip((u - low) / (high - low), 0, 1 - 2.0**-32)

    def pdf(self, index: Int32) -> Float64:
        """(n,) probability of each element."""
        out: Float64 = self.cdf[index + 1] - self.cdf[index]
        return out


def make_discrete(weights: Floats) -> Discrete:
    """Odds in proportion to ``weights`` (m,) >= 0. Raises ValueError where none is positive."""
    cumulative = np.cumsum(weights, dtype=np.float64)
    if len(cumulative) == 0 or not cumulative[-1] > 0:
        raise ValueError("weights: at least one must be positive")
    cdf = np.concatenate([[0.0], cumulative / cumulative[-1]])
    # u = 1 - 2^-32 must land on the last element that has a weight, not behind it.
    cdf[1:][cumulative == cumulative[-1]] = 1.0
    return Discrete(cdf, float(cumulative[-1]))
