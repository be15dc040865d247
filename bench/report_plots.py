# SPDX-License-Identifier: GPL-3.0-or-later
"""Plots of the animation bench: milliseconds by stage, and cost against size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .frames import Played
from .scaling import Sweep

#: With selection, and from scratch: the colours of the other plots.
OURS, OTHER = "#d95f02", "#1b5e9e"
#: Stages in a frame's order share a ramp; what is left of the wall clock is grey.
RAMP = ("#7b3294", "#c2559d", "#e8765a", "#f5a54a", "#f7d060", "#9ccb86", "#4da79b", "#2f6f9f", "#29487d")
REST = "0.75"
#: Least range of a panel's cost, highest over lowest: in a smaller one noise looks like a trend.
LEAST_SPAN = 20.0


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def plot_frames(played: Sequence[Played], path: Path) -> None:
    """Two bars for each sequence, selected above from scratch, in the colours of their stages."""
    plt = _pyplot()
    stages = list(dict.fromkeys(name for p in played for name in (*p.selected.stages, *p.scratch.stages)))
    colours = {name: RAMP[i % len(RAMP)] for i, name in enumerate(stages)}
    figure, axes = plt.subplots(figsize=(8.4, 0.55 * len(played) + 1.2), layout="constrained")
    places = np.arange(len(played))[::-1].astype(float)
    for offset, costs in ((0.19, [p.selected for p in played]), (-0.19, [p.scratch for p in played])):
        left = np.zeros(len(played))
        for name in stages:
            width = 1000 * np.array([c.stages.get(name, 0.0) for c in costs])
            label = name if offset > 0 else None
            axes.barh(places + offset, width, 0.34, left=left, color=colours[name], label=label)
            left += width
        total = 1000 * np.array([c.seconds for c in costs])
        axes.barh(places + offset, np.maximum(total - left, 0), 0.34, left=left, color=REST,
                  label="rest" if offset > 0 else None)  # fmt: skip
        for y, ms, end in zip(places + offset, total, np.maximum(total, left), strict=True):
            axes.annotate(f"{ms:.3g}", (end, y), (4, 0), textcoords="offset points", va="center", fontsize=7.5)
    axes.set_yticks(places, [p.title for p in played], fontsize=8.5)
    axes.set_xlabel("ms a frame; upper bar: selected, lower bar: from scratch")
    axes.margins(x=0.06)
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)
    axes.tick_params(axis="y", length=0)
    _plain(axes)
    figure.legend(loc="outside upper center", ncols=5, frameon=False, fontsize=8)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def plot_scaling(sweeps: Sequence[Sweep], path: Path) -> None:
    """A panel for each sweep, log-log, with the fitted slopes in the legend."""
    plt = _pyplot()
    rows = (len(sweeps) + 1) // 2
    figure, panels = plt.subplots(rows, 2, figsize=(9.6, 3.7 * rows), layout="constrained", squeeze=False)
    for axes, sweep in zip(panels.ravel(), sweeps, strict=False):
        _panel(axes, sweep)
    for axes in panels.ravel()[len(sweeps) :]:
        axes.set_visible(False)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _panel(axes: Any, sweep: Sweep) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator

    x = np.array([p.x for p in sweep.points])
    selected, scratch = sweep.slopes()
    curves = (
        ("from scratch", scratch, OTHER, "s", [p.played.scratch.seconds for p in sweep.points]),
        ("selected", selected, OURS, "o", [p.played.selected.seconds for p in sweep.points]),
    )
    for name, fitted, colour, marker, seconds in curves:
        axes.loglog(x, 1000 * np.array(seconds), color=colour, marker=marker, label=f"{name}, slope {fitted:.2f}")
    low, high = axes.get_ylim()
    if high / low < LEAST_SPAN:
        middle = np.sqrt(low * high)
        axes.set_ylim(middle / np.sqrt(LEAST_SPAN), middle * np.sqrt(LEAST_SPAN))
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axes.xaxis.set_minor_formatter("")
    axes.yaxis.set_minor_formatter("")
    axes.set_xlabel(sweep.axis)
    axes.set_ylabel("ms a frame")
    axes.set_title(sweep.scene, fontsize=9)
    axes.grid(which="major", color="0.92")
    axes.legend(frameon=False, fontsize=8)
    _plain(axes)


def short(value: float) -> str:
    """A number as its ticks and tables show it: 1.04k, 300k, 1M."""
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if value >= 0.9995 * unit:
            return f"{value / unit:.3g}{name}"
    return f"{value:.3g}"


def _plain(axes: Any) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
