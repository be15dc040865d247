# SPDX-License-Identifier: GPL-3.0-or-later
"""Iterative solvers whose bits do not depend on the number of threads: radiosity's fixed point, seams' least squares.

An operator may be block diagonal: groups of rows that exchange nothing. Each colour channel of each group, a strand,
has its own scalars and stops on its own; groups share the products with the operator and nothing else, so a group's
solution is the same to the last bit whatever the others hold, and when they are absent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Bool, Float32, Float64, Int32
from .hessenberg import HessenbergLeastSquares
from .strands import Strands

#: (n, c) -> (n, c), linear, each column by itself. Its argument is C or column order and not to be written to.
Operator = Callable[[Float32], Float32]

#: Vectors kept between restarts. Radiosity ends within about 20 products at a spectral radius of 0.99.
BASIS_SIZE = 24
#: A new direction shorter than this share of the product it came from is rounding, not direction.
BREAKDOWN = 1e-6
#: A product whose part outside the basis is a smaller share than this has lost more than a digit of it.
LOSS = 0.1
#: A restart that leaves more than this share of the residual has met the limit of float32.
STAGNATION = 0.7


@dataclass(frozen=True)
class Solution:
    """``residual`` is |b - M x| / |b|, 0 where b is zero; ``products`` counts uses of the operator."""

    x: Float32  # (n, c)
    products: int
    groups: Int32  # (g,) labels, rising
    residual: Float64  # (g, c)
    converged: Bool  # (g, c) residual <= tolerance


def solve_fixed_point(
    operator: Operator,
    b: Float32,
    *,
    group: Int32 | None = None,
    tolerance: float = 1e-4,
    max_products: int = 200,
    start: Float32 | None = None,
) -> Solution:
    """x (n, c) with x = b + operator(x), by restarted GMRES (Saad and Schultz 1986).

    group (n,): rows that exchange something have the same number; -1 marks rows that exchange nothing, x = b there
    and the operator is given zeros. None: one group. To solve some groups only, pass their rows (in the same order)
    and the operator on them: the bits are the same. ``max_products`` holds for each group.

    The residual never grows, and no other method that uses as many products reaches a smaller one between restarts.
    Where 1 - operator is singular and no step helps, x is ``start`` (a first guess) or 0. Raises ValueError where b
    or a product is not finite.
    """
    _require_finite(b.T, "the right-hand side")
    strands = Strands(group, len(b))
    unit, rhs = _scaled_to_one(strands, strands.to_columns(b))
    length = strands.norms(rhs)
    scale = np.where(length > 0, length, 1.0)
    x = np.zeros_like(rhs) if start is None else strands.scaled(strands.to_columns(start), 1 / unit)
    strands.clear(x, length == 0)
    kept, left = x, np.where(length > 0, 1.0, 0.0)
    before = np.full(length.shape, np.inf)
    going, spent, products = length > 0, np.zeros(length.shape, np.intp), 0

    def product(v: Float32) -> Float32:
        return strands.to_columns(operator(strands.to_rows(v)))

    while True:
        residual = rhs.copy()
        if going.any() and (start is not None or products):
            residual -= x
            residual += product(x)
            products += 1
            spent += going
            left = np.where(going, strands.norms(residual) / scale, left)
        _require_finite(left, "the operator's product")
        worse = left > before  # where 1 - M is singular, rounding alone gives a step: the x before it stands
        x = strands.chosen(worse, kept, x)
        left = np.where(worse, before, left)
        going &= (left > tolerance) & (left <= STAGNATION * before) & (spent < max_products)
        if not going.any():
            solved = strands.keep(strands.scaled(x, unit), b)
            return Solution(solved, products, strands.labels, left.T, left.T <= tolerance)
        limit = np.where(going, np.minimum(BASIS_SIZE, max_products - spent), 0)
        step, used = _gmres_cycle(product, strands, residual, tolerance * scale, limit)
        kept, x = x, x + step
        products += int(used.max())
        spent += used
        before = left


def conjugate_gradients(
    operator: Operator, b: Float32, *, group: Int32 | None = None, tolerance: float = 1e-5, max_products: int = 500
) -> Solution:
    """x (n, c) with operator(x) = b for a symmetric positive (semi-)definite operator (Hestenes and Stiefel 1952).

    group: as for ``solve_fixed_point``, but x = 0 in rows of -1.
    """
    _require_finite(b.T, "the right-hand side")
    strands = Strands(group, len(b))
    unit, residual = _scaled_to_one(strands, strands.to_columns(b))
    squared = strands.dots(residual, residual)
    length = np.sqrt(squared)
    scale = np.where(length > 0, length, 1.0)
    x = np.zeros_like(residual)
    direction = residual.copy()
    going = length > tolerance * scale
    products = 0
    while going.any() and products < max_products:
        product = strands.to_columns(operator(strands.to_rows(direction)))
        products += 1
        curvature = strands.dots(direction, product)
        _require_finite(curvature, "the operator's product")
        # No curvature: the direction is a null vector of a semi-definite operator, nothing is left to gain there.
        going &= curvature > 0
        alpha = np.divide(squared, curvature, out=np.zeros_like(squared), where=going)
        x += strands.scaled(direction, alpha)
        residual -= strands.scaled(product, alpha)
        after = np.where(going, strands.dots(residual, residual), squared)
        going &= np.sqrt(after) > tolerance * scale
        beta = np.divide(after, squared, out=np.zeros_like(after), where=going)
        direction = strands.scaled(direction, beta)
        direction += residual
        strands.clear(direction, ~going)
        squared = after
    left = (np.sqrt(squared) / scale).T
    solved = strands.keep(strands.scaled(x, unit), np.zeros_like(b))
    return Solution(solved, products, strands.labels, left, left <= tolerance)


def _gmres_cycle(
    product: Operator, strands: Strands, residual: Float32, target: Float64, limit: NDArray[np.intp]
) -> tuple[Float32, NDArray[np.intp]]:
    """The change of x, and how many products each strand (c, g) used, at most its ``limit``; all in columns."""
    length = strands.norms(residual)
    squares = HessenbergLeastSquares(length)
    used = np.zeros(length.shape, np.intp)
    active = (length > target) & (used < limit)
    basis = np.empty((int(limit.max()), *residual.shape), np.float32)  # only what is filled is read; most never is
    size = 0
    vector, last = residual, length
    while active.any():
        basis[size] = _unit_vector(strands, vector, last, active)
        size += 1
        used += active
        vector, overlaps, last = _orthogonal(strands, product(basis[size - 1]), basis[:size])
        # Krylov's space of 1 - M is M's, and the matrix there is one less M's.
        column = np.concatenate([-overlaps, -last[None]])
        column[-2] += 1
        squares.append(column, active)
        active = active & ~squares.ended & (squares.residual > target) & (used < limit)
    return strands.combination(basis[:size], squares.solve()), used


def _orthogonal(strands: Strands, vector: Float32, basis: Float32) -> tuple[Float32, Float64, Float64]:
    """(``vector`` without its parts along the basis, (j, c, g) those parts, (c, g) the length of what is left).

    Gram-Schmidt, and once more in strands that lost most of their length and with it digits (Daniel, Gragg, Kaufman
    and Stewart 1976).
    """
    overlaps = strands.projections(basis, vector)
    whole = (overlaps * overlaps).sum(axis=0)
    _require_finite(whole, "the operator's product")
    vector -= strands.combination(basis, overlaps)
    last = strands.norms(vector)
    again = last < LOSS * np.sqrt(whole)
    if again.any():
        more = np.where(again, strands.projections(basis, vector), 0.0)
        vector -= strands.combination(basis, more)
        overlaps += more
        last = strands.norms(vector)
    _require_finite(last, "the operator's product")
    last[last <= BREAKDOWN * np.sqrt(whole + last * last)] = 0.0
    return vector, overlaps, last


def _unit_vector(strands: Strands, vector: Float32, length: Float64, where: Bool) -> Float32:
    """``vector`` over ``length``; zero in strands that are not ``where``."""
    return strands.scaled(vector, np.divide(1.0, length, out=np.zeros_like(length), where=where))


def _scaled_to_one(strands: Strands, columns: Float32) -> tuple[Float64, Float32]:
    """(c, g) powers of two, and ``columns`` over them: at most 1, so that squares stay in float32's range."""
    largest = strands.largest(columns)
    # Within float32's normal numbers, so that the division is exact.
    exponent = np.clip(np.frexp(largest)[1], -120, 120)
    unit = np.ldexp(1.0, np.where(largest > 0, exponent, 0))
    return unit, strands.scaled(columns, 1 / unit)


def _require_finite(values: Float32 | Float64, what: str) -> None:
    """values (c, ...)"""
    if not np.isfinite(values).all():
        raise ValueError(f"{what} is not finite in column {int(np.argwhere(~np.isfinite(values))[0][0])}")
