# SPDX-License-Identifier: GPL-3.0-or-later
"""Which charts a bake's record gives: what each frame cost, how good it is, and what of it was computed anew.

A count that no frame has (an older bake's) is left out; one that is zero throughout is named instead of drawn. No bpy.
"""

from __future__ import annotations

from html import escape

from .report_charts import Chart, Series, Values, draw
from .report_record import BakedFrame, BakeRecord

#: Stages that are drawn apart, the costliest; the others are one.
STAGES = 6
#: From so many frames on, cost and error take the whole width.
WIDE_FRAMES = 16


def duration(seconds: float) -> str:
    """38 ms, 2.90 s, 1 min 12 s, 2 h 05 min."""
    if seconds < 0.0995:
        return f"{seconds * 1000:.2g} ms"
    if seconds < 59.95:
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def percent(share: float) -> str:
    """0.02 as 2.0 %."""
    return f"{share:.1%}".replace("%", "\N{NARROW NO-BREAK SPACE}%")


def whole(count: float) -> str:
    """1234567 as 1 234 567."""
    return f"{count:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def charts(baked: BakeRecord) -> str:
    """The sections with all charts of ``baked``, which has a frame."""
    frames = baked.frames
    work = [chart for chart in _work(frames) if chart.bars]
    drawn = [draw(chart) for chart in work if not chart.is_empty]
    idle = [chart.title.lower() for chart in work if chart.is_empty]
    note = f'<p class="soft">None in this bake: {escape(", ".join(idle))}.</p>' if idle else ""
    return (
        f'<h2>Cost and error</h2><div class="charts">{draw(_seconds(frames))}{draw(_error(baked))}</div>'
        f'<h2>What was computed anew</h2><div class="charts">{"".join(drawn)}</div>{note}'
    )


def _seconds(frames: tuple[BakedFrame, ...]) -> Chart:
    sums: dict[str, float] = {}
    for frame in frames:
        for stage, seconds in frame.seconds.items():
            sums[stage] = sums.get(stage, 0.0) + seconds
    costly = set(sorted(sums, key=lambda stage: -sums[stage])[:STAGES])
    bars = [
        Series(stage, tuple(frame.seconds.get(stage, 0.0) for frame in frames), f"c{number}")
        for number, stage in enumerate(stage for stage in sums if stage in costly)
    ]
    others = [stage for stage in sums if stage not in costly]
    if others:
        rest = tuple(sum(frame.seconds.get(stage, 0.0) for stage in others) for frame in frames)
        bars.append(Series("all else", rest, "kept"))
    return Chart("Time by stage", "seconds a frame", _numbers(frames), duration, tuple(bars), wide=_wide(frames))


def _error(baked: BakeRecord) -> Chart:
    """In per cent. Black frames have none."""
    values = tuple(None if frame.error is None else 100 * frame.error for frame in baked.frames)
    asked = baked.settings.get("target_error")
    return Chart(
        title="Estimated error",
        unit="% of the IIM's mean, RMS",
        frames=_numbers(baked.frames),
        tell=lambda value: percent(value / 100),
        lines=(Series("estimated error", values, "c5"),),
        level=None if asked is None else ("asked for", 100 * asked),
        wide=_wide(baked.frames),
    )


def _work(frames: tuple[BakedFrame, ...]) -> list[Chart]:
    """New on the axis, kept above it in grey, and lines for what was looked at on the way."""

    def chart(title: str, bars: dict[str, str], lines: dict[str, str]) -> Chart:
        return Chart(
            title,
            "a frame",
            _numbers(frames),
            whole,
            tuple(_counted(frames, bars, ("c0", "kept"))),
            tuple(_counted(frames, lines, ("c1", "c5"))),
        )

    return [
        chart("Rays", {"rays": "traced, of every kind"}, {}),
        chart("Links", {"links_traced": "traced", "links_kept": "kept"}, {"links_tested": "tested"}),
        chart(
            "Photons",
            {"photons_traced": "traced", "photons_kept": "kept"},
            {"photons_probed": "probed", "photons_invalidated": "found disturbed"},
        ),
        chart("Surfaces", {"surfaces_updated": "updated", "surfaces_kept": "kept"}, {}),
        chart("Texels", {"texels_updated": "updated", "texels_kept": "kept"}, {}),
    ]


def _counted(frames: tuple[BakedFrame, ...], names: dict[str, str], colours: tuple[str, str]) -> list[Series]:
    """A series for each count that some frame has."""
    found = []
    for (key, name), colour in zip(names.items(), colours, strict=False):
        values: Values = tuple(frame.counts.get(key) for frame in frames)
        if any(value is not None for value in values):
            found.append(Series(name, values, colour))
    return found


def _wide(frames: tuple[BakedFrame, ...]) -> bool:
    return len(frames) >= WIDE_FRAMES


def _numbers(frames: tuple[BakedFrame, ...]) -> tuple[int, ...]:
    return tuple(frame.number for frame in frames)
