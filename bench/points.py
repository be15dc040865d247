# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs summed up: a point (seconds, error) per method, curves of points, and times at equal error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .results import Run
from .table import Curve


@dataclass(frozen=True)
class Point:
    """Medians over the seeds of one method."""

    curve: Curve
    label: str
    seeds: int
    seconds: float
    seconds_range: tuple[float, float]
    relative_rmse: float
    bias: float
    percentile_95: float
    peak_bytes: float | None
    estimated_error: float | None


def points_of(runs: Sequence[Run]) -> list[Point]:
    """One for each curve and label, in the order of their first runs, by curve."""
    groups: dict[tuple[Curve, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.curve, run.label), []).append(run)
    points = [_point(curve, label, group) for (curve, label), group in groups.items()]
    return sorted(points, key=lambda p: list(Curve).index(p.curve))


def _point(curve: Curve, label: str, runs: Sequence[Run]) -> Point:
    seconds = [r.cost.seconds for r in runs]
    peaks = [r.cost.peak_bytes for r in runs if r.cost.peak_bytes is not None]
    estimates = [r.estimated_error for r in runs if r.estimated_error is not None]
    return Point(
        curve=curve,
        label=label,
        seeds=len(runs),
        seconds=float(np.median(seconds)),
        seconds_range=(min(seconds), max(seconds)),
        relative_rmse=float(np.median([r.errors.relative_rmse for r in runs])),
        bias=float(np.median([r.errors.bias for r in runs])),
        percentile_95=float(np.median([r.errors.percentile_95 for r in runs])),
        peak_bytes=float(np.median(peaks)) if peaks else None,
        estimated_error=float(np.median(estimates)) if estimates else None,
    )


@dataclass(frozen=True)
class Crossing:
    """When a curve comes down to an error."""

    seconds: float
    at_most: bool  # its first point is below already: it may have been there sooner


def crossing_or_none(points: Sequence[Point], error: float) -> Crossing | None:
    """Where the curve through ``points`` reaches ``error``, straight in log-log; None if it never does."""
    curve = sorted(points, key=lambda p: p.seconds)
    for before, point in zip([None, *curve], curve, strict=False):
        if point.relative_rmse <= error:
            if before is None:
                return Crossing(point.seconds, at_most=True)
            x, y = np.log([before.seconds, point.seconds]), np.log([before.relative_rmse, point.relative_rmse])
            share = (np.log(error) - y[0]) / (y[1] - y[0])
            return Crossing(float(np.exp(x[0] + share * (x[1] - x[0]))), at_most=False)
    return None
