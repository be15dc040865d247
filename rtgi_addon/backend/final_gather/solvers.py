# SPDX-License-Identifier: GPL-3.0-or-later
"""Iterative solvers whose bits do not depend on the number of threads: radiosity's fixed point, seams' least squares.

Data are float32; every scalar is a float64 of a sum taken in a fixed order, never through BLAS. Columns (red, green,
blue) share the products with the operator and nothing else: each has its own scalars and stops on its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..scene import Bool, Float32, Float64

Operator = Callable[[Float32], Float32]  # (n, c) -> (n, c), linear, each column by itself

#: Vectors kept between restarts. Radiosity ends within about 20 products at a spectral radius of 0.99.
BASIS_SIZE = 24
#: A float32 sum over this many elements is good to about 1e-6; the sums of blocks are added in float64.
BLOCK = 4096
#: A new direction shorter than this share of the product it came from is rounding, not direction.
BREAKDOWN = 1e-6
#: A restart that leaves more than this share of the residual has met the limit of float32.
STAGNATION = 0.7


@dataclass(frozen=True)
class Solution:
    """``residual`` (c,) is |b - M x| / |b| by column, 0 where b is zero; ``products`` counts uses of the operator."""

    x: Float32  # (n, c)
    products: int
    residual: Float64
    converged: Bool  # (c,) residual <= tolerance


def solve_fixed_point(
    operator: Operator,
    b: Float32,
    *,
    tolerance: float = 1e-4,
    max_products: int = 200,
    start: Float32 | None = None,
) -> Solution:
    """x (n, c) with x = b + operator(x), by restarted GMRES (Saad and Schultz 1986).

    The residual never grows, and no other method that uses as many products reaches a smaller one between restarts.
    ``start`` is a first guess, such as the frame before. Raises ValueError where b or a product is not finite.
    """
    unit, rhs = _scaled_to_one(_to_columns(b))
    length = _norms(rhs)
    scale = np.where(length > 0, length, 1.0)
    x = np.zeros_like(rhs) if start is None else _to_columns(start) / unit
    x[length == 0] = 0.0
    products, before = 0, np.full(len(length), np.inf)
    while True:
        residual = rhs.copy()
        if start is not None or products > 0:
            residual -= x - _to_columns(operator(_to_rows(x, b.shape)))
            products += 1
        left = _norms(residual) / scale
        _require_finite(left, "the operator's product")
        stuck = (left > STAGNATION * before) | (products >= max_products)
        todo = (left > tolerance) & ~stuck
        if not todo.any():
            return Solution(_to_rows(x * unit, b.shape), products, left, left <= tolerance)
        residual[~todo] = 0.0
        step, used = _gmres_cycle(
            lambda v: v - _to_columns(operator(_to_rows(v, b.shape))),
            residual,
            tolerance * scale,
            min(BASIS_SIZE, max_products - products),
        )
        x += step
        products += used
        before = left


def conjugate_gradients(
    operator: Operator, b: Float32, *, tolerance: float = 1e-5, max_products: int = 500
) -> Solution:
    """x (n, c) with operator(x) = b for a symmetric positive (semi-)definite operator (Hestenes and Stiefel 1952)."""
    unit, residual = _scaled_to_one(_to_columns(b))
    length = _norms(residual)
    scale = np.where(length > 0, length, 1.0)
    x = np.zeros_like(residual)
    direction = residual.copy()
    squared = length**2
    products = 0
    while products < max_products:
        active = np.sqrt(squared) > tolerance * scale
        if not active.any():
            break
        product = _to_columns(operator(_to_rows(direction, b.shape)))
        products += 1
        curvature = _dots(direction, product)
        _require_finite(curvature, "the operator's product")
        # No curvature: the direction is a null vector of a semi-definite operator, nothing is left to gain there.
        active &= curvature > 0
        if not active.any():
            break
        alpha = np.divide(squared, curvature, out=np.zeros_like(squared), where=active)
        _add_scaled(x, direction, alpha)
        _add_scaled(residual, product, -alpha)
        after = np.where(active, _dots(residual, residual), squared)
        beta = np.divide(after, squared, out=np.zeros_like(after), where=active)
        direction *= beta.astype(np.float32)[:, None, None]
        direction += residual
        direction[~active] = 0.0
        squared = after
    left = np.sqrt(squared) / scale
    return Solution(_to_rows(x * unit, b.shape), products, left, left <= tolerance)


def _gmres_cycle(operator: Operator, residual: Float32, target: Float64, size: int) -> tuple[Float32, int]:
    """The change of x after at most ``size`` products, and how many were used; all in column layout."""
    first = _norms(residual)
    columns = [_LeastSquares(float(length)) for length in first]
    basis = [_scaled(residual, first)]
    used = 0
    while used < size and any(not c.ended and c.residual > t for c, t in zip(columns, target, strict=True)):
        vector = operator(basis[-1])
        used += 1
        full = _norms(vector)
        _require_finite(full, "the operator's product")
        coefficients = np.zeros((len(columns), used + 1))
        for _ in range(2):  # Gram-Schmidt twice, since float32 loses what one pass would keep
            for row, earlier in enumerate(basis):
                overlap = _dots(earlier, vector)
                coefficients[:, row] += overlap
                _add_scaled(vector, earlier, -overlap)
        last = _norms(vector)
        last[last <= BREAKDOWN * full] = 0.0
        coefficients[:, used] = last
        for column, c, t in zip(columns, coefficients, target, strict=True):
            if not column.ended and column.residual > t:
                column.append(c.tolist())
        basis.append(_scaled(vector, last))
    step = np.zeros_like(residual)
    weights = np.zeros((len(columns), used))
    for index, column in enumerate(columns):
        found = column.solve()
        weights[index, : len(found)] = found
    for direction, weight in zip(basis, weights.T, strict=False):
        _add_scaled(step, direction, weight)
    return step, used


class _LeastSquares:
    """Hessenberg least squares of one column by Givens rotations, in Python floats (some tens of numbers)."""

    def __init__(self, length: float) -> None:
        self.triangle: list[list[float]] = []  # column by column
        self.rotations: list[tuple[float, float]] = []
        self.rhs = [length]
        self.ended = length == 0.0

    @property
    def residual(self) -> float:
        return abs(self.rhs[-1])

    def append(self, coefficients: list[float]) -> None:
        """Take the next Hessenberg column, one longer than the number of columns before plus one."""
        h = list(coefficients)
        for i, (cos, sin) in enumerate(self.rotations):
            h[i], h[i + 1] = cos * h[i] + sin * h[i + 1], cos * h[i + 1] - sin * h[i]
        diagonal = math.hypot(h[-2], h[-1])
        self.ended = h[-1] == 0.0
        if diagonal == 0.0:  # a null vector: this direction changes nothing
            return
        cos, sin = h[-2] / diagonal, h[-1] / diagonal
        self.rotations.append((cos, sin))
        self.triangle.append([*h[:-2], diagonal])
        last = self.rhs.pop()
        self.rhs += [cos * last, -sin * last]

    def solve(self) -> list[float]:
        """Weights of the basis vectors."""
        count = len(self.triangle)
        weights = [0.0] * count
        for i in reversed(range(count)):
            known = sum(self.triangle[j][i] * weights[j] for j in range(i + 1, count))
            weights[i] = (self.rhs[i] - known) / self.triangle[i][i]
        return weights


def _to_columns(rows: Float32) -> Float32:
    """(n, c) as (c, blocks, BLOCK), zeros at the end."""
    count, width = rows.shape
    blocks = max(1, -(-count // BLOCK))
    columns = np.zeros((width, blocks * BLOCK), np.float32)
    columns[:, :count] = rows.T
    return columns.reshape(width, blocks, BLOCK)


def _to_rows(columns: Float32, shape: tuple[int, ...]) -> Float32:
    return np.ascontiguousarray(columns.reshape(len(columns), -1)[:, : shape[0]].T)


def _scaled_to_one(columns: Float32) -> tuple[Float32, Float32]:
    """(c, 1, 1) powers of two, and ``columns`` over them: at most 1, so that squares stay in float32's range."""
    largest = np.abs(columns).max(axis=(1, 2)).astype(np.float64)
    _require_finite(largest, "the right-hand side")
    # Within float32's normal numbers, so that the division is exact.
    exponent = np.clip(np.frexp(largest)[1], -120, 120)
    unit = np.ldexp(1.0, np.where(largest > 0, exponent, 0)).astype(np.float32)[:, None, None]
    return unit, columns / unit


def _dots(a: Float32, b: Float32) -> Float64:
    """(c,) inner products."""
    return np.asarray(np.einsum("cbk,cbk->cb", a, b).sum(axis=1, dtype=np.float64))


def _norms(a: Float32) -> Float64:
    return np.sqrt(_dots(a, a))


def _add_scaled(target: Float32, vector: Float32, factor: Float64) -> None:
    target += factor.astype(np.float32)[:, None, None] * vector


def _scaled(vector: Float32, length: Float64) -> Float32:
    """``vector`` over ``length`` by column; zero where that is zero."""
    factor = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    return vector * factor.astype(np.float32)[:, None, None]


def _require_finite(values: Float64, what: str) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"{what} is not finite in column {int(np.flatnonzero(~np.isfinite(values))[0])}")
