# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed against error: its part of docs/benchmarks.md and its plots, from the points of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from .document import PLOTS, machine_lines, write_part
from .points import Crossing, Point, crossing_or_none
from .reference import load_reference
from .results import Machine
from .table import HELD_TO, LEAST_WHOLE, TARGETS, BenchScene, Curve

STYLE = {
    Curve.OURS: {"color": "#d95f02", "linestyle": ":", "marker": "o", "fillstyle": "none"},
    Curve.OURS_DENOISED: {"color": "#d95f02", "linestyle": "-", "marker": "o"},
    Curve.CYCLES: {"color": "#1b5e9e", "linestyle": ":", "marker": "s", "fillstyle": "none"},
    Curve.CYCLES_DENOISED: {"color": "#1b5e9e", "linestyle": "-", "marker": "s"},
}


def write_report(
    results: Mapping[BenchScene, Sequence[Point]], machines: Mapping[BenchScene, Machine], docs: Path
) -> None:
    """Write the part into ``docs``/benchmarks.md and one plot for each scene."""
    (docs / PLOTS).mkdir(parents=True, exist_ok=True)
    parts = [_head(next(iter(machines.values())))]
    for scene, points in results.items():
        _plot(scene, points, docs / PLOTS / f"{scene.name}.png")
        parts.append(_scene(scene, points, machines[scene]))
    write_part(docs, "speed", "\n".join(parts))


def _head(machine: Machine) -> str:
    return f"""## Speed against error

One frame, beside Cycles; the engines take turns.

{machine_lines(machine)}
- **Error:** RMS difference from the reference over texels and channels, divided by the reference's mean; the
  reference's own noise is taken out in quadrature. Bias is the mean difference, P95 the 95th percentile of the
  absolute difference, both divided by the same mean. Medians over seeds.
- **Reference:** Cycles at up to 16 points in each texel, unclamped, 32 bounces, the mean of passes with different
  seeds (`tests/reference/make_reference.py`). Nothing of RTGI's estimator is in it. Texels that lie
  partly under another object, or mostly beside their surface, are left out; how many is said below.
- **RTGI's seconds:** a new session and one frame, from arrays to finished maps: BVH, texels, direct light, gather,
  denoising, padding. Extraction from Blender and writing files are not in them.
- **Cycles' seconds:** Blender's bake operator on one joined mesh, from the scene to the image. Only the indirect pass
  is baked. Clamping is off and paths are long, as in the reference; else it would be biased.
- **+ OIDN:** Open Image Denoise's RT filter on the CPU, the copy that Blender ships, with the same masks, mirrored
  borders and scaling per surface for both. (That copy has no weights for the light-map filter.)
- **Memory:** the most that the process held during the bake, above what it held with the scene extracted.
"""


def _scene(scene: BenchScene, points: Sequence[Point], machine: Machine) -> str:
    reference = load_reference(scene.reference)
    made, count = reference.made, len(reference.mean)
    under = int((reference.open < 1).sum())
    partly = int(((reference.open >= 1) & (reference.whole < LEAST_WHOLE)).sum())
    noise = float((reference.standard_error.astype(float) ** 2).mean() ** 0.5 / reference.mean.mean())
    compared = count - under - partly
    passes = f"{len(made['seeds'])} passes of {made['samples_per_point_and_pass']} samples at each point"
    rows = "\n".join(_row(p) for p in points)
    return f"""
### {scene.title}

Atlas of {made["resolution"]} x {made["resolution"]} pixels, compared at {compared} texels chosen at random. Of
the {count} texels of the reference {under} lie under or partly under another object and {partly} are surface by less
than {LEAST_WHOLE:.0%}; these are left out. The reference took {made["seconds"]:.0f} s ({passes}, Blender
{made["blender"]}); its own noise is {noise:.2%}. Load average of the machine before the run: {machine.load}.

![error against seconds]({PLOTS}/{scene.name}.png)

| method | seeds | seconds (range) | error | P95 | bias | memory | RTGI's own estimate |
| --- | --- | --- | --- | --- | --- | --- | --- |
{rows}

{_ratios(points)}
"""


def _row(p: Point) -> str:
    low, high = p.seconds_range
    memory = "" if p.peak_bytes is None else f"{p.peak_bytes / 2**20:.0f} MiB"
    estimate = "" if p.estimated_error is None else f"{p.estimated_error:.2%}"
    return (
        f"| {p.curve.value}, {p.label} | {p.seeds} | {p.seconds:.3f} ({low:.3f}-{high:.3f}) | {p.relative_rmse:.2%} "
        f"| {p.percentile_95:.2%} | {p.bias:+.2%} | {memory} | {estimate} |"
    )


def _ratios(points: Sequence[Point]) -> str:
    """Seconds at equal error, straight lines between points in log-log."""
    lines = [
        f"| error | {Curve.OURS_DENOISED} | {Curve.CYCLES_DENOISED} | ratio |",
        "| --- | --- | --- | --- |",
    ]
    for error in TARGETS:
        ours, theirs = (
            crossing_or_none([p for p in points if p.curve is curve], error)
            for curve in (Curve.OURS_DENOISED, Curve.CYCLES_DENOISED)
        )
        lines.append(f"| {error:.0%} | {_seconds(ours)} | {_seconds(theirs)} | {_ratio(ours, theirs)} |")
    return "\n".join(lines) + "\n\n" + _verdict(points)


def _seconds(crossing: Crossing | None) -> str:
    if crossing is None:
        return "not reached"
    return f"{'at most ' if crossing.at_most else ''}{crossing.seconds:.3f} s"


def _ratio(ours: Crossing | None, theirs: Crossing | None) -> str:
    if ours is None or theirs is None:
        return "-"
    mark = "at least " if ours.at_most else "at most " if theirs.at_most else ""
    return f"{mark}{theirs.seconds / ours.seconds:.1f}"


def _verdict(points: Sequence[Point]) -> str:
    ours, theirs = (
        crossing_or_none([p for p in points if p.curve is curve], TARGETS[0])
        for curve in (Curve.OURS_DENOISED, Curve.CYCLES_DENOISED)
    )
    wanted = f"Held to: {TARGETS[0]:.0%} at least {HELD_TO:.0f} times sooner than Cycles + OIDN."
    if ours is None:
        return f"{wanted} **Missed**: {Curve.OURS_DENOISED} does not reach it."
    if theirs is None:
        return f"{wanted} Cycles + OIDN does not reach it with the samples tried."
    ratio = theirs.seconds / ours.seconds
    return f"{wanted} {'Met' if ratio >= HELD_TO else '**Missed**'}: {ratio:.1f} times."


def _plot(scene: BenchScene, points: Sequence[Point], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import FuncFormatter, LogLocator

    figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    for curve in Curve:
        own = sorted((p for p in points if p.curve is curve), key=lambda p: p.seconds)
        axes.loglog([p.seconds for p in own], [100 * p.relative_rmse for p in own], label=curve.value, **STYLE[curve])
        for p in own:
            # Labels of the filtered curves would hide one another; they are the same as above them.
            if curve in {Curve.OURS, Curve.CYCLES}:
                at = (p.seconds, 100 * p.relative_rmse)
                axes.annotate(p.label, at, (5, 5), textcoords="offset points", fontsize=8, color=STYLE[curve]["color"])
    for error in TARGETS:
        axes.axhline(100 * error, color="0.75", linewidth=0.8, zorder=0)
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter("")
    axes.set_xlabel("seconds")
    axes.set_ylabel("RMS error / mean, %")
    axes.set_title(f"{scene.title}: {load_reference(scene.reference).made['resolution']}² atlas", fontsize=10)
    axes.grid(which="major", color="0.92")
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=120)
    plt.close(figure)
