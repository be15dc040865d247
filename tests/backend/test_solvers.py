# SPDX-License-Identifier: GPL-3.0-or-later
"""Krylov solvers against dense float64 solutions and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.final_gather.products import row_products
from rtgi_addon.backend.final_gather.solvers import _orthogonal, conjugate_gradients, solve_fixed_point
from rtgi_addon.backend.final_gather.strands import Strands
from rtgi_addon.backend.parallel import Workers


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
    matrix = 0.99 * links(rng, 300)
    b = rng.random((300, 3)).astype(np.float32)
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
    assert not together.x[:, 1].any() and together.residual[0, 1] == 0
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


def block_diagonal(rng: np.random.Generator, sizes, albedo: float = 0.9):
    """Groups that exchange nothing, their rows shuffled: (row products' target, weight, (n,) group)."""
    count, width = int(sum(sizes)), 7
    first = np.cumsum(sizes) - sizes
    group = np.repeat(np.arange(len(sizes)), sizes)
    target = first[group][:, None] + (rng.random((count, width)) * np.asarray(sizes)[group][:, None]).astype(int)
    weight = rng.random((count, width)) ** 4
    weight *= albedo / weight.sum(axis=1, keepdims=True)
    order = rng.permutation(count)  # new row -> old row
    number = np.argsort(order)
    return number[target[order]].astype(np.int32), weight[order].astype(np.float32), group[order].astype(np.int32)


def operator_of(target, weight):
    return row_products(target, weight, len(target), Workers(1))


def only(rows, target, weight):
    """The operator on some rows that exchange nothing with the others."""
    number = np.full(len(target), -1, np.int32)
    number[rows] = np.arange(len(rows))
    return operator_of(number[target[rows]], weight[rows])


def same_bits(a, b):
    assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), sizes=st.lists(st.integers(1, 300), min_size=1, max_size=7))
def test_a_group_has_the_bits_it_has_alone(seed, sizes):
    """Whatever the other groups hold, whether they are there, and whatever the labels."""
    rng = np.random.default_rng(seed)
    target, weight, group = block_diagonal(rng, sizes)
    b = (rng.random((len(group), 3)) ** 6 * 10.0 ** rng.integers(-9, 9, (len(sizes), 3))[group]).astype(np.float32)
    together = solve_fixed_point(operator_of(target, weight), b, group=group, tolerance=1e-5)
    assert together.converged.all() and together.residual.shape == (len(sizes), 3)
    relabelled = rng.permutation(100_000)[: len(sizes)].astype(np.int32)[group]
    same_bits(solve_fixed_point(operator_of(target, weight), b, group=relabelled, tolerance=1e-5).x, together.x)
    for number in range(len(sizes)):
        rows = np.flatnonzero(group == number)
        alone = solve_fixed_point(only(rows, target, weight), b[rows], tolerance=1e-5)
        same_bits(alone.x, np.ascontiguousarray(together.x[rows]))
        same_bits(alone.residual, together.residual[number : number + 1])
        others = np.where((group == number)[:, None], b, b[::-1] * np.float32(1e5))
        changed = solve_fixed_point(operator_of(target, weight), others, group=group, tolerance=1e-5)
        same_bits(np.ascontiguousarray(changed.x[rows]), alone.x)


def test_groups_that_restart_keep_their_bits_beside_groups_that_end_at_once():
    """A corridor needs several cycles; a room beside it ends within the first. Each as if alone."""
    rng = np.random.default_rng(8)
    count = 700
    near = (np.arange(count)[:, None] + np.arange(-3, 4)).clip(0, count - 1).astype(np.int32)
    room, weight, _ = block_diagonal(rng, [200], albedo=0.5)
    target = np.concatenate([near, room + count]).astype(np.int32)
    weight = np.concatenate([np.full((count, 7), 0.995 / 7, np.float32), weight])
    group = np.repeat([4, 2], [count, 200]).astype(np.int32)
    b = rng.random((count + 200, 3)).astype(np.float32) ** 20
    together = solve_fixed_point(operator_of(target, weight), b, group=group)
    corridor = solve_fixed_point(operator_of(near, weight[:count]), b[:count])
    other = solve_fixed_point(operator_of(room, weight[count:]), b[count:])
    assert corridor.products > 26 > other.products and together.converged.all()
    assert together.groups.tolist() == [2, 4] and together.products == corridor.products
    same_bits(together.x[:count], corridor.x)
    same_bits(together.x[count:], other.x)
    same_bits(together.residual, np.concatenate([other.residual, corridor.residual]))


def test_a_group_does_not_spend_the_products_of_another():
    """A corridor that takes a whole cycle beside a nearly white room that takes a short one and more after it."""
    rng = np.random.default_rng(17)
    near = (np.arange(700)[:, None] + np.arange(-3, 4)).clip(0, 699).astype(np.int32)
    corridor = operator_of(near, np.full((700, 7), 0.999 / 7, np.float32))
    everywhere = np.repeat(np.arange(400, dtype=np.int32)[None], 400, axis=0)
    room = operator_of(everywhere, (0.999 * links(rng, 400, sky=0)).astype(np.float32))
    b = rng.random((1100, 1)).astype(np.float32)
    b[:700] **= 20
    alone = solve_fixed_point(room, b[700:], max_products=28, tolerance=1e-6)
    together = solve_fixed_point(
        lambda x: np.concatenate([corridor(x[:700]), room(x[700:])]),
        b,
        group=np.repeat([0, 1], [700, 400]).astype(np.int32),
        max_products=28,
        tolerance=1e-6,
    )
    assert alone.products > 14 and not together.converged[0, 0]
    same_bits(together.x[700:], alone.x)


def test_most_products_hold_for_each_group():
    rng = np.random.default_rng(9)
    target, weight, group = block_diagonal(rng, [90, 400, 30], albedo=0.999)
    b = rng.random((520, 3)).astype(np.float32) ** 9
    few = solve_fixed_point(operator_of(target, weight), b, group=group, max_products=5, tolerance=1e-7)
    for number in range(3):
        rows = np.flatnonzero(group == number)
        alone = solve_fixed_point(only(rows, target, weight), b[rows], max_products=5, tolerance=1e-7)
        assert alone.products <= 6 and not alone.converged.any()
        same_bits(alone.x, np.ascontiguousarray(few.x[rows]))


def test_rows_that_exchange_nothing_are_given_zeros_and_keep_b():
    rng = np.random.default_rng(10)
    target, weight, group = block_diagonal(rng, [150, 60])
    b = rng.random((210, 3)).astype(np.float32)
    whole = solve_fixed_point(operator_of(target, weight), b, group=group)
    idle = group == 1
    group[idle] = -1
    seen = []

    def operator(x):
        seen.append(np.abs(x[idle]).max())
        return operator_of(target, weight)(x) + idle[:, None]  # what it says about those rows is not asked for

    solution = solve_fixed_point(operator, b, group=group)
    assert max(seen) == 0 and solution.groups.tolist() == [0] and solution.converged.shape == (1, 3)
    same_bits(solution.x[idle], b[idle])
    same_bits(solution.x[~idle], whole.x[~idle])

    def refuse(x):
        raise AssertionError("nothing to multiply")

    nothing = solve_fixed_point(refuse, b, group=np.full(210, -1, np.int32))
    same_bits(nothing.x, b)
    assert nothing.products == 0 and nothing.residual.shape == (0, 3) and nothing.converged.all()


def test_one_label_for_all_is_no_label():
    rng = np.random.default_rng(11)
    target, weight, _ = block_diagonal(rng, [333])
    b = rng.random((333, 3)).astype(np.float32)
    plain = solve_fixed_point(operator_of(target, weight), b)
    labelled = solve_fixed_point(operator_of(target, weight), b, group=np.full(333, 12345, np.int32))
    same_bits(plain.x, labelled.x)
    assert labelled.groups.tolist() == [12345] and plain.groups.tolist() == [0]


def test_warm_start_of_groups_multiplies_only_for_those_with_light():
    rng = np.random.default_rng(12)
    target, weight, group = block_diagonal(rng, [80, 80, 80])
    b = rng.random((240, 3)).astype(np.float32)
    b[group == 1] = 0
    cold = solve_fixed_point(operator_of(target, weight), b, group=group)
    first = np.where((group == 1)[:, None], np.float32(7), cold.x)  # the lamp there has gone out
    warm = solve_fixed_point(operator_of(target, weight), b, group=group, start=first)
    assert warm.products == 1 and warm.converged.all()
    same_bits(warm.x, cold.x)


@pytest.mark.parametrize("seed", range(4))
def test_the_residual_never_grows_even_where_there_is_no_solution(seed):
    """A closed white room: the operator's rows sum to 1."""
    rng = np.random.default_rng(seed)
    operator, _ = counted(links(rng, 400, sky=0))
    b = rng.random((400, 1)).astype(np.float32)
    solution = solve_fixed_point(operator, b)
    assert not solution.converged.any() and solution.residual.max() <= 1 and np.abs(solution.x).max() < 1e4
    room, weight, _ = block_diagonal(rng, [100])
    beside = solve_fixed_point(
        lambda x: np.concatenate([operator(x[:400]), operator_of(room, weight)(x[400:])]),
        np.concatenate([b, b[:100]]),
        group=np.repeat([0, 1], [400, 100]).astype(np.int32),
    )
    same_bits(beside.x[:400], solution.x)
    same_bits(beside.x[400:], solve_fixed_point(operator_of(room, weight), b[:100]).x)


def test_no_step_along_a_direction_that_changes_nothing():
    """One minus the mean of all has the constants as null vectors: only what differs from the mean can be met."""
    b = np.random.default_rng(14).random((50, 3)).astype(np.float32)
    mean = np.full((50, 50), 1 / 50)
    solution = solve_fixed_point(lambda x: (mean @ x).astype(np.float32), b)
    assert solution.products <= 4 and not solution.converged.any()
    spread = np.linalg.norm(b.mean(axis=0) * np.ones((50, 1)), axis=0) / np.linalg.norm(b, axis=0)
    np.testing.assert_allclose(solution.residual[0], spread, rtol=1e-4)
    assert np.abs(solution.x).max() < 10


def test_basis_is_orthogonal_though_most_of_a_product_lies_in_it():
    rng = np.random.default_rng(15)
    strands = Strands(None, 5000)
    basis = strands.to_columns(np.linalg.qr(rng.normal(size=(5000, 6)))[0].astype(np.float32))[:, None]
    inside = strands.combination(basis, rng.normal(size=(6, 1, 1)))
    outside = strands.to_columns(rng.normal(size=(5000, 1)).astype(np.float32) * np.float32(1e-6))
    vector, _, last = _orthogonal(strands, inside + outside, basis)
    assert 5e-5 < last[0, 0] < 1e-4
    assert np.abs(strands.projections(basis, vector)).max() < 2e-7 * last[0, 0]


def test_sums_of_many_rows():
    """The blocks' sums are added in float64: a float32 sum of half a million would be off in the eighth digit."""
    rng = np.random.default_rng(16)
    group = rng.integers(0, 3, 500_000).astype(np.int32)
    values = (rng.random((500_000, 2)) + 1).astype(np.float32)
    strands = Strands(group, len(group))
    columns = strands.to_columns(values)
    exact = [[np.dot(v := values[group == g, c].astype(np.float64), v) for g in range(3)] for c in range(2)]
    np.testing.assert_allclose(strands.dots(columns, columns), exact, rtol=3e-9)
    same_bits(np.ascontiguousarray(strands.to_rows(columns)), values)


def test_not_finite_is_refused_in_rows_left_out_as_well():
    b = np.ones((4, 3), np.float32)
    b[3, 2] = np.inf
    with pytest.raises(ValueError, match="right-hand side is not finite in column 2"):
        solve_fixed_point(np.zeros_like, b, group=np.array([0, 0, 0, -1], np.int32))


def test_conjugate_gradients_of_groups():
    rng = np.random.default_rng(13)
    sizes = [70, 1, 30]
    group = np.repeat([5, -1, 3], sizes)
    matrices = []
    for size in sizes:
        root = rng.normal(size=(size, size)) / np.sqrt(size)
        matrices.append(scipy.sparse.csr_matrix((root @ root.T + 0.1 * np.eye(size)).astype(np.float32)))
    matrix = scipy.sparse.block_diag(matrices).tocsr()
    b = (rng.normal(size=(101, 3)) * np.where(group == 3, 1e6, 1)[:, None]).astype(np.float32)
    order = rng.permutation(101)
    together = conjugate_gradients(
        lambda x: np.asarray(matrix[order][:, order] @ x, np.float32), b[order], group=group[order].astype(np.int32)
    )
    assert together.converged.all() and together.groups.tolist() == [3, 5]
    assert not together.x[group[order] == -1].any()
    for label, part in ((5, matrices[0]), (3, matrices[2])):
        alone = conjugate_gradients(lambda x, m=part: np.asarray(m @ x, np.float32), b[group == label])
        found = together.x[np.argsort(order)][group == label]
        np.testing.assert_allclose(found, alone.x, rtol=0, atol=1e-4 * np.abs(alone.x).max())
        exact = np.linalg.solve(part.toarray().astype(np.float64), b[group == label])
        assert np.abs(found - exact).max() <= 2e-3 * np.abs(exact).max()
