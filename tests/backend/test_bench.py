# SPDX-License-Identifier: GPL-3.0-or-later
"""The bench's own arithmetic: errors against a noisy reference, times at equal error, the report it writes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.errors import Errors, compare
from bench.measure import Cost, Meter
from bench.points import Point, crossing_or_none, points_of
from bench.reference import Reference, TexelTable, load_reference, match
from bench.report import write_report
from bench.results import Machine, Run
from bench.table import SCENES, BenchScene, Curve

POINT = Point(Curve.OURS_DENOISED, "", 1, 1.0, (1.0, 1.0), 0.1, 0.0, 0.2, None, None)


def test_noise_of_the_reference_does_not_count_as_error() -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.5, 1.5, (20_000, 3))
    noise, error = 0.05, 0.03
    reference = truth + noise * rng.standard_normal(truth.shape)
    ours = truth + error * rng.standard_normal(truth.shape) + 0.01
    errors = compare(ours.astype(np.float32), reference.astype(np.float32), np.full(truth.shape, noise, np.float32))
    assert errors.relative_rmse == pytest.approx(np.hypot(error, 0.01), rel=0.03)
    assert errors.raw_rmse == pytest.approx(np.sqrt(error**2 + 0.01**2 + noise**2), rel=0.02)
    assert errors.bias == pytest.approx(0.01, abs=0.001)
    assert errors.reference_noise == pytest.approx(noise, rel=1e-3)


def test_non_finite_values_are_refused_and_not_averaged() -> None:
    one = np.ones((2, 3), np.float32)
    with pytest.raises(ValueError, match="1 values are not finite"):
        compare(np.array([[1, 1, np.nan], [1, 1, 1]], np.float32), one, 0 * one)


@given(
    st.floats(-2, -0.2), st.floats(0.01, 1), st.lists(st.floats(0.01, 100), min_size=2, max_size=6, unique=True)
)  # fmt: skip
def test_times_at_equal_error_follow_a_power_law_exactly(slope: float, at_one: float, seconds: list[float]) -> None:
    points = [replace(POINT, seconds=s, relative_rmse=at_one * s**slope) for s in seconds]
    error = at_one * (min(seconds) * max(seconds)) ** (slope / 2)
    crossing = crossing_or_none(points, error)
    assert crossing is not None and not crossing.at_most
    assert crossing.seconds == pytest.approx(np.sqrt(min(seconds) * max(seconds)), rel=1e-6)


def test_an_error_never_reached_has_no_time_and_one_reached_at_once_is_a_bound() -> None:
    curve = [replace(POINT, seconds=s, relative_rmse=e) for s, e in ((1, 0.10), (4, 0.05))]
    assert crossing_or_none(curve, 0.04) is None
    first = crossing_or_none(curve, 0.2)
    assert first is not None and first.at_most and first.seconds == 1


def run(curve: Curve, label: str, seed: int, seconds: float, error: float) -> Run:
    return Run(curve, label, seed, Cost(seconds, 2**20), Errors(error, error, 0.001, 2 * error, 0.01, 100))


def test_points_are_medians_by_method() -> None:
    runs = [run(Curve.OURS, "draft", s, 1.0 + s, 0.1 * (s + 1)) for s in range(3)] + [run(Curve.CYCLES, "16", 0, 9, 1)]
    ours, cycles = points_of(runs)
    assert (ours.seeds, ours.seconds, ours.seconds_range, ours.relative_rmse) == (3, 2.0, (1.0, 3.0), 0.2)
    assert (cycles.seeds, cycles.label, cycles.peak_bytes) == (1, "16", 2**20)


def test_the_meter_sees_time_and_memory() -> None:
    result, cost = Meter().measured(lambda: float(np.ones(64 << 20, np.uint8).sum()))
    assert result == 64 << 20 and cost.seconds > 0
    assert cost.peak_bytes is None or 60 << 20 <= cost.peak_bytes < 256 << 20


@pytest.fixture
def small() -> Reference:
    table = TexelTable(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]),
        np.array([[0, 0, 1]] * 3, np.float32),
        np.ones(3, np.float32),
        np.array([0, 0, 1], np.int32),
        ("Floor", "Shelf"),
    )
    value = np.arange(9, dtype=np.float32).reshape(3, 3) + 1
    return Reference(table, value, value / 128, np.ones(3, np.float32), np.ones(3, np.float32), {"resolution": 8})


def test_a_stored_reference_comes_back(small: Reference, tmp_path: Path) -> None:
    small.save(tmp_path / "small.npz")
    again = load_reference(tmp_path / "small.npz")
    for name in ("mean", "standard_error", "whole", "open"):
        assert np.array_equal(getattr(again, name), getattr(small, name)), name
    assert np.array_equal(again.table.position, small.table.position)
    assert (again.table.names, again.made) == (small.table.names, small.made)


def test_texels_are_found_by_object_and_place_on_their_own_side(small: Reference) -> None:
    table = small.table
    order = [2, 1, 0]
    shuffled = TexelTable(
        table.position[order], table.normal[order], table.area, np.array([0, 1, 1], np.int32), ("Shelf", "Floor")
    )
    assert match(small, shuffled).tolist() == [2, 1, 0]
    with pytest.raises(ValueError, match="3 of 3 texels"):
        match(small, replace(table, normal=-table.normal))


def test_the_report_states_ratio_and_verdict(tmp_path: Path) -> None:
    scene: BenchScene = SCENES[0]
    runs = [
        run(curve, label, 0, seconds, error)
        for curve, label, seconds, error in (
            (Curve.OURS_DENOISED, "draft", 0.1, 0.08),
            (Curve.OURS_DENOISED, "preview", 0.4, 0.02),
            (Curve.CYCLES_DENOISED, "64 spp", 2.0, 0.08),
            (Curve.CYCLES_DENOISED, "256 spp", 8.0, 0.02),
        )
    ]
    machine = Machine("A processor", 2, {"rtgi": "0.1.0"}, "0.3")
    write_report({scene: points_of(runs)}, {scene: machine}, tmp_path)
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert "| 4% | 0.200 s | 4.000 s | 20.0 |" in text
    assert "**Missed**: 20.0 times" in text
    assert (tmp_path / "benchmarks" / f"{scene.name}.png").stat().st_size > 10_000
