# SPDX-License-Identifier: GPL-3.0-or-later
"""Krylov solvers against dense float64 solutions and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.final_gather.solvers import conjugate_gradients, solve_fixed_point


def links(rng: np.random.Generator, count: int, sky: float = 1e-3) -> np.ndarray:
    """(n, n) float64 form factors: rows sum to 1 - sky, most of the weight on a few."""
    matrix = rng.random((count, count)) ** 8
    return matrix * ((1 - sky) / matrix.sum(axis=1, keepdims=True))


def counted(matrix: np.ndarray):
    calls = []

    def operator(x):
        calls.append(x.shape)
        return (matrix @ x).astype(np.float32)

    return operator, calls


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), albedo=st.floats(0, 0.99), count=st.integers(1, 90))
def test_fixed_point_is_the_dense_solution(seed, albedo, count):
    rng = np.random.default_rng(seed)
    matrix = albedo * links(rng, count)
    b = (rng.random((count, 3)) ** 6).astype(np.float32)
    operator, calls = counted(matrix)
    solution = solve_fixed_point(operator, b, tolerance=1e-5)
    exact = np.linalg.solve(np.eye(count) - matrix, b.astype(np.float64))
    assert solution.converged.all() and (solution.residual <= 1e-5).all()
    assert solution.products == len(calls) <= 40
    # |error| <= |(I - A)^-1| |residual|; the inverse of a row-stochastic kernel is at most 1 / (1 - albedo) in rows.
    bound = 1e-5 * np.sqrt(count) / (1 - albedo) * np.linalg.norm(b, axis=0)
    assert (np.abs(solution.x - exact).max(axis=0) <= bound + 1e-6 * exact.max(axis=0)).all()


@pytest.mark.parametrize("albedo", [0.1, 0.5, 0.9, 0.98, 0.99])
def test_integrating_sphere_closed_form(albedo):
    """Every texel of a sphere sees all others alike: E = D / (1 - albedo), whatever D's mean is."""
    count = 3000
    direct = (np.random.default_rng(1).random((count, 3)) * [1, 10, 1e-5]).astype(np.float32)

    def mean_of_all(x):
        return np.broadcast_to(np.float32(albedo) * x.mean(axis=0, dtype=np.float64).astype(np.float32), x.shape).copy()

    solution = solve_fixed_point(mean_of_all, direct, tolerance=1e-5)
    expected = direct + direct.mean(axis=0, dtype=np.float64) * albedo / (1 - albedo)
    np.testing.assert_allclose(solution.x, expected, rtol=2e-4)
    assert solution.products <= 5  # rank one: two products, whatever the albedo; plain iteration needs a thousand


def test_fewer_products_than_bounces():
    rng = np.random.default_rng(2)
    matrix = 0.99 * links(rng, 800)
    b = rng.random((800, 3)).astype(np.float32)
    operator, calls = counted(matrix)
    solution = solve_fixed_point(operator, b, tolerance=1e-4)
    x, bounces = b.astype(np.float64), 0
    while np.linalg.norm(b + matrix @ x - x) > 1e-4 * np.linalg.norm(b):
        x, bounces = b + matrix @ x, bounces + 1
    assert solution.converged.all() and len(calls) <= 20 and bounces > 300


def test_slow_mixing_needs_restarts_and_still_converges():
    """A corridor whose cells see 10 neighbours each way: more products than the basis holds."""
    count = 3000
    chain = scipy.sparse.diags([np.full(count, 0.99 / 21)] * 21, range(-10, 11), shape=(count, count)).tocsr()
    b = np.zeros((count, 3), np.float32)
    b[count // 2] = 1
    solution = solve_fixed_point(lambda x: (chain @ x).astype(np.float32), b, tolerance=1e-5)
    exact = scipy.sparse.linalg.spsolve((scipy.sparse.identity(count) - chain).tocsc(), b[:, 0].astype(np.float64))
    assert solution.products > 24 and solution.converged.all()
    np.testing.assert_allclose(solution.x[:, 1], exact, atol=3e-4 * exact.max())


def test_columns_are_independent():
    rng = np.random.default_rng(3)
    matrix = 0.9 * links(rng, 300)
    operator, _ = counted(matrix)
    b = rng.random((300, 3)).astype(np.float32)
    alone = solve_fixed_point(operator, b[:, :1], tolerance=1e-6).x
    b[:, 1] = 0
    b[:, 2] *= 1e12
    together = solve_fixed_point(operator, b, tolerance=1e-6)
    np.testing.assert_allclose(together.x[:, :1], alone, rtol=1e-5)
    assert not together.x[:, 1].any() and together.residual[1] == 0
    assert together.converged.all()


@settings(max_examples=20, deadline=None)
@given(exponent=st.integers(-100, 100))
def test_scale_by_powers_of_two_is_exact(exponent):
    rng = np.random.default_rng(4)
    operator, _ = counted((0.9 * links(rng, 60)).astype(np.float32))
    b = rng.random((60, 3)).astype(np.float32)
    k = np.float32(2.0**exponent)
    np.testing.assert_array_equal(solve_fixed_point(operator, b * k).x, solve_fixed_point(operator, b).x * k)


def test_zero_right_hand_side_uses_no_product():
    def refuse(x):
        raise AssertionError("nothing to multiply")

    solution = solve_fixed_point(refuse, np.zeros((7, 3), np.float32))
    assert solution.products == 0 and not solution.x.any() and solution.converged.all()


def test_no_light_sent_back():
    b = np.random.default_rng(5).random((10, 3)).astype(np.float32)
    solution = solve_fixed_point(np.zeros_like, b)
    assert solution.products == 2  # one, and one to check the residual
    np.testing.assert_allclose(solution.x, b, rtol=3e-7)


def test_warm_start_costs_one_product():
    rng = np.random.default_rng(6)
    operator, calls = counted(0.95 * links(rng, 200))
    b = rng.random((200, 3)).astype(np.float32)
    cold = solve_fixed_point(operator, b)
    calls.clear()
    warm = solve_fixed_point(operator, b, start=cold.x)
    assert warm.products == len(calls) == 1 and np.array_equal(warm.x, cold.x)


def test_closed_white_room_has_no_solution_and_says_so():
    """Albedo 1 and no way out: the fixed point does not exist. The solver ends, finite, and does not claim success."""
    matrix = np.full((50, 50), 1 / 50)
    operator, _ = counted(matrix)
    solution = solve_fixed_point(operator, np.ones((50, 3), np.float32))
    assert not solution.converged.any() and np.isfinite(solution.x).all() and solution.products <= 200


def test_not_finite_is_refused():
    b = np.ones((4, 3), np.float32)
    with pytest.raises(ValueError, match="right-hand side is not finite in column 1"):
        solve_fixed_point(np.zeros_like, b * np.array([1, np.nan, 1], np.float32))
    with pytest.raises(ValueError, match="product is not finite"):
        solve_fixed_point(lambda x: x * np.float32(np.inf), b)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 80))
def test_conjugate_gradients_against_dense(seed, count):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, count)) / np.sqrt(count)
    matrix = root @ root.T + 0.1 * np.eye(count)
    b = rng.normal(size=(count, 3)).astype(np.float32)
    b[:, 1] = 0
    operator, calls = counted(matrix)
    solution = conjugate_gradients(operator, b, tolerance=1e-5)
    assert solution.converged.all() and solution.products == len(calls)
    error = np.linalg.norm(solution.x - np.linalg.solve(matrix, b), axis=0)
    assert (error <= 1e-5 / 0.1 * 2 * np.linalg.norm(b, axis=0) + 1e-30).all()


def test_conjugate_gradients_of_a_semi_definite_operator():
    """A graph Laplacian has the constants as null vectors; a balanced right-hand side is still solved."""
    count = 40
    laplacian = np.diag([1.0, *[2.0] * (count - 2), 1.0]) - np.eye(count, k=1) - np.eye(count, k=-1)
    x = np.random.default_rng(7).normal(size=(count, 2))
    x -= x.mean(axis=0)
    operator, _ = counted(laplacian)
    solution = conjugate_gradients(operator, (laplacian @ x).astype(np.float32), tolerance=1e-6)
    np.testing.assert_allclose(solution.x - solution.x.mean(axis=0), x, atol=2e-3)
