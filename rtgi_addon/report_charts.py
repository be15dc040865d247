# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts over frames as inline SVG: stacked bars, lines over them, and a legend that tells the numbers of a frame.

Colours and type are classes of report_page.html, so that one picture suits light and dark. No bpy here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from statistics import median

#: Of the drawing, in units that are CSS pixels at the page's full width.
HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 196, 52, 8, 16, 24
WIDE, NARROW = 1040, 508
#: Widest bar, and the slot from which on bars stand apart.
BAR, APART = 44.0, 5.0
#: About how many numbers an axis has.
TICKS, LABELS = 4, 10
#: Bars so many times higher than those of all other frames are cut off, with their number on top: a bake's first frame
#: is computed whole, and would flatten the rest. One frame may be, and one more for each so many.
CUT, CUT_FRAMES = 3.0, 50

Values = tuple[float | None, ...]


@dataclass(frozen=True)
class Series:
    """One value per frame; None where the frame has none."""

    name: str
    values: Values
    colour: str  # a CSS class


@dataclass(frozen=True)
class Chart:
    """Bars stand on each other in the order given; lines are drawn over them on the same scale."""

    title: str
    unit: str
    frames: tuple[int, ...]
    tell: Callable[[float], str]  # a value for the legend
    bars: tuple[Series, ...] = ()
    lines: tuple[Series, ...] = ()
    level: tuple[str, float] | None = None  # a value asked for, drawn across
    wide: bool = False

    @property
    def is_empty(self) -> bool:
        return not any(value for series in (*self.bars, *self.lines) for value in series.values)


def draw(chart: Chart) -> str:
    """``chart`` as an HTML figure."""
    top, step = scale_of(_end(chart))
    width = WIDE if chart.wide else NARROW
    slot = (width - LEFT - RIGHT) / len(chart.frames)
    paper = _Paper(width, slot, top)
    parts = [
        *_axes(chart, paper, step),
        *_bars(chart, paper),
        *_cuts(chart, paper),
        *(_line(s, paper) for s in chart.lines if any(s.values)),
    ]
    if chart.level is not None:
        y = paper.y(chart.level[1])
        parts.append(f'<path class="level" d="M{LEFT} {y:.1f}H{width - RIGHT}"/>')
    place = f'data-left="{LEFT}" data-slot="{slot:.4f}" data-width="{width}"'
    cursor = f'<rect class="cursor" y="{TOP}" width="{max(slot, 1):.2f}" height="{HEIGHT - TOP - BOTTOM}" hidden=""/>'
    return (
        f'<figure class="chart{" wide" * chart.wide}"><figcaption><b>{escape(chart.title)}</b>'
        f' <span class="unit">{escape(chart.unit)}</span> <span class="which"></span></figcaption>'
        f'<svg viewBox="0 0 {width} {HEIGHT}" role="img" aria-label="{escape(chart.title)}" {place}>'
        f"{cursor}{''.join(parts)}</svg>{_legend(chart)}</figure>"
    )


@dataclass(frozen=True)
class _Paper:
    width: int
    slot: float  # of a frame
    top: float  # the value at the upper end

    def x(self, index: int) -> float:
        """The middle of a frame."""
        return LEFT + (index + 0.5) * self.slot

    def y(self, value: float) -> float:
        """Where ``value`` ends, at most at the end of the axis."""
        return HEIGHT - BOTTOM - min(value / self.top, 1.0) * (HEIGHT - TOP - BOTTOM)

    @property
    def bar(self) -> float:
        return min(BAR, self.slot * 0.8) if self.slot >= APART else self.slot


def scale_of(highest: float) -> tuple[float, float]:
    """The end of an axis from 0 that holds ``highest``, and its step: 1, 2 or 5 times a power of ten."""
    if highest <= 0:
        return 1.0, 1.0
    power = 10.0 ** math.floor(math.log10(highest / TICKS))
    step = next(m * power for m in (1, 2, 5, 10) if m * power * TICKS >= highest * (1 - 1e-9))
    return math.ceil(highest / step - 1e-9) * step, step


def brief(value: float) -> str:
    """A number on an axis: 1.5k, 20M."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"


def _stacks(chart: Chart) -> list[float]:
    return [sum(series.values[i] or 0 for series in chart.bars) for i in range(len(chart.frames))]


def _end(chart: Chart) -> float:
    """What the axis must hold."""
    stacks = sorted(_stacks(chart), reverse=True)
    few = 1 + len(stacks) // CUT_FRAMES
    cut = len(stacks) > few and 0 < CUT * stacks[few] < stacks[0]
    lines = [value or 0 for series in chart.lines for value in series.values]
    return max((stacks[few] if cut else stacks[0], *lines, 0 if chart.level is None else chart.level[1]))


def _cuts(chart: Chart, paper: _Paper) -> list[str]:
    """The numbers of the bars that are cut off."""
    return [
        f'<text x="{paper.x(index) - paper.bar / 2:.1f}" y="{TOP - 4}">↑ {escape(chart.tell(stack))}</text>'
        for index, stack in enumerate(_stacks(chart))
        if stack > paper.top * (1 + 1e-9)
    ]


def _axes(chart: Chart, paper: _Paper, step: float) -> list[str]:
    parts = []
    for tick in range(round(paper.top / step) + 1):
        y = paper.y(tick * step)
        parts.append(f'<path class="{"grid" if tick else "base"}" d="M{LEFT} {y:.1f}H{paper.width - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{brief(tick * step)}</text>')
    count = len(chart.frames)
    every = next(m * 10**p for p in range(9) for m in (1, 2, 5) if m * 10**p * LABELS >= count)
    for index in range(0, count, every):
        x, y = paper.x(index), HEIGHT - BOTTOM + 16
        parts.append(f'<text x="{x:.1f}" y="{y}" text-anchor="middle">{chart.frames[index]}</text>')
    return parts


def _bars(chart: Chart, paper: _Paper) -> list[str]:
    """One path for each series: some pages have thousands of bars."""
    below = [0.0] * len(chart.frames)
    shown = [min(1.0, paper.top / stack) if stack else 1.0 for stack in _stacks(chart)]  # a cut bar keeps its shares
    parts = []
    for series in chart.bars:
        boxes = []
        for index, value in enumerate(series.values):
            if value:
                x, foot = paper.x(index) - paper.bar / 2, paper.y(below[index])
                below[index] += value * shown[index]
                height = foot - paper.y(below[index])
                boxes.append(f"M{x:.2f} {foot:.2f}v{-height:.2f}h{paper.bar:.2f}v{height:.2f}z")
        parts.append(f'<path class="{series.colour}" d="{"".join(boxes)}"/>')
    return parts


def _line(series: Series, paper: _Paper) -> str:
    """Dots joined where frames follow each other; many frames need no dots."""
    path, pen_down = [], False
    for index, value in enumerate(series.values):
        if value is not None:
            path.append(f"{'L' if pen_down else 'M'}{paper.x(index):.1f} {paper.y(value):.1f}h0")
        pen_down = value is not None
    dots = [f"M{part[1:]}" for part in path] if paper.slot >= 2 * APART else []
    return (
        f'<path class="line {series.colour}" d="{"".join(path)}"/>'
        f'<path class="dots {series.colour}" d="{"".join(dots)}"/>'
    )


def _legend(chart: Chart) -> str:
    entries = []
    for kind, series in [("bar", s) for s in chart.bars] + [("line", s) for s in chart.lines]:
        told = ["–" if value is None else chart.tell(value) for value in series.values]
        known = [value for value in series.values if value is not None]
        usual = chart.tell(median(known)) if known else "–"
        entries.append(
            f'<li><i class="{kind} {series.colour}"></i>{escape(series.name)}'
            f' <output data-told="{escape("|".join(told))}">{escape(usual)}</output></li>'
        )
    if chart.level is not None:
        name, value = chart.level
        entries.append(f'<li><i class="level"></i>{escape(name)} <output>{escape(chart.tell(value))}</output></li>')
    return f"<ul>{''.join(entries)}</ul>"


def numbers(values: Sequence[int | None]) -> Values:
    """Counts as values of a series."""
    return tuple(None if value is None else float(value) for value in values)
