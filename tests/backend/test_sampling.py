# SPDX-License-Identifier: GPL-3.0-or-later
"""Samplers follow their densities, numbers depend on their keys alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from rtgi_addon.backend import sampling as sm

COUNT = 40_000


def uniform_pairs(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.random(COUNT), rng.random(COUNT)


def chi_square_passes(observed: np.ndarray, expected: np.ndarray) -> bool:
    """At 0.1 %, over bins that expect at least five."""
    keep = expected > 5
    statistic = ((observed[keep] - expected[keep]) ** 2 / expected[keep]).sum()
    return bool(statistic < stats.chi2.ppf(0.999, keep.sum() - 1))


def direction_histogram(directions: np.ndarray) -> np.ndarray:
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    return np.histogram2d(directions[:, 2], angle, bins=(20, 12), range=((-1, 1), (-np.pi, np.pi)))[0]


def expected_histogram(pdf_of_cosine) -> np.ndarray:
    """(20, 12) counts from a density that depends on the cosine, by quadrature within each bin of z."""
    fine = (np.arange(20 * 2000) + 0.5) / (20 * 2000) * 2 - 1
    share = np.asarray(pdf_of_cosine(fine)).reshape(20, 2000).mean(axis=1) * 0.1 * 2 * np.pi
    return np.repeat(share[:, None] / 12, 12, axis=1) * COUNT


CASES = {
    "sphere": (sm.sample_sphere, lambda z: np.full_like(z, sm.pdf_sphere())),
    "cosine": (sm.sample_cosine_hemisphere, sm.pdf_cosine_hemisphere),
    "cone": (lambda u, v: sm.sample_cone(u, v, 0.35), lambda z: np.where(z > 0.35, sm.pdf_cone(0.35), 0)),
    "cosine about": (
        lambda u, v: sm.sample_cosine_about(np.tile([0.0, 0.0, 1.0], (COUNT, 1)), u, v),
        sm.pdf_cosine_hemisphere,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_directions_follow_their_density(name: str) -> None:
    sample, pdf = CASES[name]
    directions = sample(*uniform_pairs())
    assert np.allclose((directions**2).sum(axis=1), 1, atol=1e-9)
    expected = expected_histogram(pdf)
    assert expected.sum() == pytest.approx(COUNT, rel=1e-3)
    assert chi_square_passes(direction_histogram(directions), expected)


def test_chi_square_rejects_a_wrong_density() -> None:
    directions = sm.sample_sphere(*uniform_pairs())
    wrong = expected_histogram(lambda z: sm.pdf_sphere() * (1 + 0.15 * z))
    assert not chi_square_passes(direction_histogram(directions), wrong)


def test_disk_and_triangle_are_uniform() -> None:
    disk = sm.sample_disk(*uniform_pairs())
    radius_squared = (disk**2).sum(axis=1)
    assert stats.kstest(radius_squared, "uniform").pvalue > 1e-3
    assert sm.pdf_disk() * np.pi == pytest.approx(1)
    u, v = sm.sample_triangle(*uniform_pairs())
    assert (u >= 0).all() and (v >= 0).all() and (u + v <= 1 + 1e-12).all()
    counts = np.histogram2d(u, v, bins=4, range=((0, 1), (0, 1)))[0]
    inside = np.add.outer(np.arange(4), np.arange(4)) < 3
    assert chi_square_passes(counts[inside], np.full(6, COUNT / 8))


def test_float32_cosine_about_grazes_no_zero() -> None:
    normals = np.tile(np.float32([0, 0, 1]), (3, 1))
    u = np.float32([1 - 2**-24, 1, 0])
    out = sm.sample_cosine_about(normals, u, np.zeros(3, np.float32))
    assert np.isfinite(out).all() and np.allclose((out**2).sum(axis=1), 1, atol=1e-5)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_frames_are_right_handed(seed: int) -> None:
    n = np.random.default_rng(seed).normal(size=(64, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n[:3] = [[0, 0, 1], [0, 0, -1], [1, 0, 0]]
    t, b = sm.frames(n)
    assert np.allclose(np.cross(t, b), n, atol=1e-9)
    assert np.allclose((t * b).sum(axis=1), 0, atol=1e-9)
    assert np.allclose(sm.to_frame(np.tile([0.0, 0.0, 1.0], (64, 1)), n), n)


@pytest.mark.parametrize("dimension", range(6))
@pytest.mark.parametrize("seed", [0, 7])
def test_halton_puts_one_point_in_each_elementary_interval(dimension: int, seed: int) -> None:
    base = sm.PRIMES[dimension]
    digits = int(np.log(3000) / np.log(base))
    points = sm.unit_float64(sm.halton(np.arange(base**digits, dtype=np.uint32), dimension, seed=seed))
    cells = np.floor(points * base**digits + 1e-6).astype(int)
    assert np.array_equal(np.sort(cells), np.arange(base**digits))


def test_unscrambled_prefix_of_halton_matches_the_definition() -> None:
    """Scrambling permutes digits alone: points that share low digits share high ones."""
    index = np.arange(5000, dtype=np.uint32)
    points = sm.unit_float64(sm.halton(index, 1, seed=3))
    first_digit = np.floor(points * 3).astype(int)
    for digit in range(3):
        assert len(np.unique(first_digit[index % 3 == digit])) == 1


def test_photon_numbers_depend_on_the_keys_alone() -> None:
    rng = np.random.default_rng(0)
    light = rng.integers(-2, 3, 500).astype(np.int32)
    index = rng.integers(0, 2**27, 500).astype(np.uint32)
    for bounce in (0, 1, 4, 5, 40):
        whole = np.array(sm.photon_numbers(light, index, bounce, seed=9))
        some = rng.permutation(500)[:37]
        part = np.array(sm.photon_numbers(light[some], index[some], bounce, seed=9))
        assert np.array_equal(whole[:, some], part)
        other = np.array(sm.photon_numbers(light, index, bounce, seed=10))
        assert (whole != other).mean() > 0.99


def test_photon_numbers_are_uniform_and_uncorrelated() -> None:
    index = np.arange(20_000, dtype=np.uint32)
    numbers = [
        sm.unit_float32(n)
        for bounce in range(8)
        for n in sm.photon_numbers(np.zeros(len(index), np.int32), index, bounce)
    ]
    table = np.array(numbers)
    assert (table >= 0).all() and (table < 1).all()
    assert np.allclose(table.mean(axis=1), 0.5, atol=0.01)
    assert np.allclose(table.var(axis=1), 1 / 12, atol=0.002)
    correlation = np.corrcoef(table) - np.eye(len(table))
    assert np.abs(correlation).max() < 0.035


def test_hash_has_no_visible_order() -> None:
    bits = sm.hash_keys(np.arange(20_000), 5)
    assert stats.kstest(sm.unit_float64(bits), "uniform").pvalue > 1e-3
    assert np.abs(np.corrcoef(bits[:-1].astype(float), bits[1:].astype(float))[0, 1]) < 0.03
    assert not np.array_equal(sm.hash_keys(np.arange(9), 1, 2), sm.hash_keys(np.arange(9), 2, 1))


@pytest.mark.parametrize("count", [4, 16, 64])
def test_stratified_pairs_fill_every_cell(count: int) -> None:
    keys = np.arange(200, dtype=np.uint32)
    x, y = (sm.unit_float64(n) for n in sm.stratified_pair(keys, count, pair=1))
    side = int(np.sqrt(count))
    cell = np.floor(x * side).astype(int) * side + np.floor(y * side).astype(int)
    assert np.array_equal(np.sort(cell, axis=1), np.tile(np.arange(count), (200, 1)))
    assert x.mean() == pytest.approx(0.5, abs=0.01) and y.mean() == pytest.approx(0.5, abs=0.01)


def test_pairs_are_independent_of_each_other() -> None:
    """Of one key's 64 points, those in one eighth of the first pair's x lie anywhere in the second pair's."""
    keys = np.arange(4000, dtype=np.uint32)
    a = sm.unit_float64(sm.stratified_pair(keys, 64, pair=0)[0])
    b = sm.unit_float64(sm.stratified_pair(keys, 64, pair=1)[0])
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.01
    cells = np.floor(a * 8).astype(int) * 8 + np.floor(b * 8).astype(int)
    filled = np.array([len(np.unique(row)) for row in cells])
    assert filled.mean() > 30  # 64 balls thrown into 64 cells fill 41; tied pairs would fill 8


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-3))
@settings(max_examples=60, deadline=None)
def test_discrete_never_picks_the_impossible(weights: list[float]) -> None:
    odds = sm.make_discrete(np.array(weights))
    u = np.concatenate([np.linspace(0, 1, 513)[:-1], [1 - 2.0**-32]])
    index, rest = odds.sample(u)
    assert (np.array(weights)[index] > 0).all()
    assert ((rest >= 0) & (rest < 1)).all()
    assert odds.pdf(np.arange(len(weights))).sum() == pytest.approx(1)


def test_discrete_odds_and_rest() -> None:
    odds = sm.make_discrete(np.array([1.0, 0.0, 3.0]))
    index, rest = odds.sample(uniform_pairs()[0])
    assert np.bincount(index, minlength=3) / COUNT == pytest.approx([0.25, 0, 0.75], abs=0.01)
    assert stats.kstest(rest[index == 2], "uniform").pvalue > 1e-3
    with pytest.raises(ValueError, match="positive"):
        sm.make_discrete(np.zeros(3))
