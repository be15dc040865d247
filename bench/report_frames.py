# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of docs/benchmarks.md on animation: cost of a frame with selection, how it grows, Larsen04's tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .animation import KINDS, FramesResult, LarsenResult, ScalingResult
from .document import PLOTS, machine_lines, write_part
from .flicker import COUNTS as FLICKER_COUNTS
from .flicker import FAR, Flicker
from .flicker import FRAMES as FLICKER_FRAMES
from .flicker import SEEDS as FLICKER_SEEDS
from .frames import CONVERGED, SCRATCH_EVERY, SEEDS, Played
from .larsen_tables import BATCH, NEAREST
from .report_plots import plot_frames, plot_scaling, short
from .scaling import Sweep

#: Held to: frames a second with a mover and with a moving lamp, ...
MOVER_RATE, LAMP_RATE = 20.0, 10.0
#: ... times cheaper than from scratch, error over the one from scratch, ...
CHEAPER, ERROR_RATIO = 5.0, 1.1
#: ... ms a frame where nothing changed, ms for Larsen04's own size, share by which far texels may flicker, ...
STILL_MS, LARSEN_MS, FLICKER = 5.0, 10.0, 0.01
#: ... relative difference between selected maps and maps from scratch.
SAME = 1e-5


def write_frames(result: FramesResult, docs: Path) -> None:
    (docs / PLOTS).mkdir(parents=True, exist_ok=True)
    parts = [_frames_head(result)]
    for kind in KINDS:
        played = [p for p in result.played if p.label == kind]
        plot_frames(played, docs / PLOTS / f"frames_{kind}.png")
        parts.append(_quality(kind, played))
    parts.append(_flickers(result.flickers))
    parts.append(_verdicts(result))
    write_part(docs, "frames", "\n".join(parts))


def _frames_head(result: FramesResult) -> str:
    noise = max(e.reference_noise for p in result.played if p.errors for e in p.errors)
    return f"""## Animation: only what changed

Sequences of 24 frames in which one thing changes (`bench/sequences.py`), baked with selection and from scratch
(`--selection off`), taking turns frame by frame.

{machine_lines(result.machine)}
- **Load average** of the machine before the run: {result.machine.load}.
- **ms:** wall clock of `Session.advance`, from the frame's state to finished maps. Median over the frames after the
  first; from scratch over one frame in {SCRATCH_EVERY}. Slowest: the slowest frame with selection; for what happens
  once, the frame in which it does. Ratio: of the medians.
- **Rays, links, photons:** means over the same frames. Links traced: gather samples made anew; those whose target faces
  away need no ray. Tested: kept ones that were looked at one by one since an object moved near them. Kept: the share
  that was not made again.
- **Error:** as for one frame above, but from bakes of our own: the mean of {len(SEEDS)} bakes of {CONVERGED.total} rays
  with other seeds, not denoised, every frame from scratch, at two frames; their own noise, at most {noise:.1%}, is
  taken out in quadrature. It shows noise and what the denoiser does to it; what the method itself leaves out, only the
  comparison with Cycles shows.
- **Difference:** the largest between a selected map and the same frame's from scratch, over texels and frames, relative
  to the texel (or to 1 % of the mean, where that is more).
"""


def _quality(name: str, played: Sequence[Played]) -> str:
    rows = "\n".join(_row(p) for p in played)
    counts = "\n".join(_counts_row(p) for p in played)
    return f"""### {name.capitalize()}

![milliseconds by stage]({PLOTS}/frames_{name}.png)

| sequence | texels | ms | slowest | ms from scratch | ratio | frames/s | error | from scratch | difference |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{rows}

| sequence | rays | from scratch | links traced | tested | kept | photons traced | kept | texels updated | surfaces |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{counts}
"""


def _row(p: Played) -> str:
    errors = "- | -" if p.errors is None else f"{p.errors[0].relative_rmse:.2%} | {p.errors[1].relative_rmse:.2%}"
    return (
        f"| {p.title} | {p.texels} | {_ms(p.selected.seconds)} | {_ms(p.selected.slowest)} | {_ms(p.scratch.seconds)} "
        f"| {p.ratio:.1f} | {p.selected.rate:.1f} | {errors} | {p.difference:.1g} |"
    )


def _counts_row(p: Played) -> str:
    c, s = p.selected.counts, p.scratch.counts
    return (
        f"| {p.title} | {short(c['rays'])} | {short(s['rays'])} | {short(c['links_traced'])} "
        f"| {short(c['links_tested'])} | {_share(c, 'links_kept', 'links_traced')} | {short(c['photons_traced'])} "
        f"| {_share(c, 'photons_kept', 'photons_traced')} | {_share(c, 'texels_updated', 'texels_kept')} "
        f"| {c['surfaces_updated']:.1f} of {c['surfaces_updated'] + c['surfaces_kept']:.0f} |"
    )


def _share(counts: dict[str, float], one: str, other: str) -> str:
    total = counts[one] + counts[other]
    return "-" if total == 0 else f"{counts[one] / total:.1%}"


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.1f}" if seconds >= 0.001 else f"{1000 * seconds:.2f}"


def _flickers(flickers: Sequence[Flicker]) -> str:
    rows = "\n".join(
        f"| {f.label} | {f.texels} | {f.percentile_95:.3%} | {f.largest:.3%} | {f.true_change:.3%} |" for f in flickers
    )
    rays = FLICKER_COUNTS.total * len(FLICKER_SEEDS)
    return f"""### Flicker

The block slides 2 mm a frame. At texels farther than {FAR} m from it, frames {FLICKER_FRAMES[0] + 1} to
{FLICKER_FRAMES[-1] + 1}: the change from frame to frame, less the true change, as a share of the texel (or of 1 % of
the mean, where that is more). The true change is that of bakes with {rays} rays a texel, the same in every frame.

| quality | texels | 95th percentile | largest | true change, 95th percentile |
| --- | --- | --- | --- | --- |
{rows}
"""


def _verdicts(result: FramesResult) -> str:
    """One line for each bar, a column for each way of playing."""
    columns = [_bars(result, kind) for kind in KINDS]
    rows = "\n".join(
        f"| {bars[0][0]} | " + " | ".join(f"{value}{'' if good else ' **missed**'}" for _, good, value in bars) + " |"
        for bars in zip(*columns, strict=True)
    )
    return f"""### Held to

Live is draft without the error estimate.

| held to | {" | ".join(KINDS)} |
| --- |{" --- |" * len(KINDS)}
{rows}
"""


def _bars(result: FramesResult, kind: str) -> list[tuple[str, bool, str]]:
    """What is held to, whether it is met, the figure."""
    default = {p.sequence: p for p in result.played if p.label == kind}
    # Live maps are a draft's.
    flicker = next((f for f in result.flickers if f.label == kind), result.flickers[-1])
    mover, lamp, still, larsen, closed = (default[k] for k in ("mover", "lamp", "still", "larsen", "closed"))
    other_room = _updated_beyond_half(closed)
    worst = max(default.values(), key=lambda p: p.difference)
    traced = lamp.selected.counts["links_traced"]
    assert mover.errors is not None
    error = mover.errors[0].relative_rmse / mover.errors[1].relative_rmse
    return [
        (f"a mover, 12k texels: at least {MOVER_RATE:.0f} frames/s", mover.selected.rate >= MOVER_RATE,
         f"{mover.selected.rate:.1f}"),
        (f"... at least {CHEAPER:.0f} times cheaper than from scratch", mover.ratio >= CHEAPER, f"{mover.ratio:.1f}"),
        (f"... error at most {ERROR_RATIO} times the one from scratch", error <= ERROR_RATIO, f"{error:.3f}"),
        (f"a moving lamp: at least {LAMP_RATE:.0f} frames/s, no gather ray",
         lamp.selected.rate >= LAMP_RATE and traced == 0, f"{lamp.selected.rate:.1f}, {traced:.0f} rays"),
        (f"nothing changed: less than {STILL_MS:.0f} ms and no ray",
         still.selected.seconds < STILL_MS / 1000 and still.selected.counts["rays"] == 0,
         f"{_ms(still.selected.seconds)} ms, {still.selected.counts['rays']:.0f} rays"),
        ("two closed rooms: no surface of the other room updated", other_room == 0, f"{other_room:.1f} surfaces"),
        (f"Larsen04's size, every texel in every frame: at most {LARSEN_MS:.0f} ms",
         larsen.selected.seconds <= LARSEN_MS / 1000, f"{_ms(larsen.selected.seconds)} ms"),
        (f"flicker far from a slow mover: at most {FLICKER:.0%}", flicker.percentile_95 <= FLICKER,
         f"{flicker.percentile_95:.2%}"),
        (f"selected maps as from scratch, to {SAME:g}", worst.difference <= SAME,
         f"{worst.difference:.1g} ({worst.title.lower()})"),
    ]  # fmt: skip


def _updated_beyond_half(closed: Played) -> float:
    """Surfaces updated in a frame beyond the half of them that is the mover's room: both rooms have as many."""
    c = closed.selected.counts
    return max(0.0, c["surfaces_updated"] - (c["surfaces_updated"] + c["surfaces_kept"]) / 2)


def write_scaling(result: ScalingResult, docs: Path) -> None:
    (docs / PLOTS).mkdir(parents=True, exist_ok=True)
    plot_scaling(result.sweeps, docs / PLOTS / "scaling.png")
    parts = [
        f"""## How the cost of a frame grows

{machine_lines(result.machine)}
- **Load average** of the machine before the run: {result.machine.load}.
- Quality draft, but where rays are what grows. Medians over {_frame_counts(result)} frames, with selection and from
  scratch. First frame: with selection, from arrays to maps, the session's own set-up included.
- **Slope:** s of cost ~ x^s, least squares in log-log over the upper half of the range, where what every frame costs
  anyway weighs least.

![milliseconds against size]({PLOTS}/scaling.png)
"""
    ]
    parts += [_sweep(s) for s in result.sweeps]
    write_part(docs, "scaling", "\n".join(parts))


def _frame_counts(result: ScalingResult) -> str:
    played = result.sweeps[0].points[0].played
    return f"{played.selected.frames} and {played.scratch.frames}"


def _sweep(sweep: Sweep) -> str:
    rows = "\n".join(
        f"| {short(p.x)} | {short(p.played.texels)} | {_ms(p.played.selected.seconds)} "
        f"| {_ms(p.played.scratch.seconds)} | {p.played.ratio:.1f} | {p.played.first:.2f} |"
        for p in sweep.points
    )
    selected, scratch = sweep.slopes()
    return f"""### {sweep.axis[0].upper()}{sweep.axis[1:]}

{sweep.scene[0].upper()}{sweep.scene[1:]}. Slope {selected:.2f} with selection, {scratch:.2f} from scratch.

| {sweep.axis} | all texels | ms | ms from scratch | ratio | first frame, s |
| --- | --- | --- | --- | --- | --- |
{rows}
"""


def write_larsen(result: LarsenResult, docs: Path) -> None:
    look_ups = "\n".join(
        f"| {r.photons} | {r.paper_build:.2f} | {r.build:.3f} | {r.paper_lookup:.3f} | {r.alone:.3f} "
        f"| {r.together:.4f} |"
        for r in result.look_ups
    )
    gathers = "\n".join(
        f"| {g.rays} | {g.polygons} | {g.triangles} | {g.paper:.2f} | {g.alone:.2f} | {g.together:.4f} |"
        for g in result.gathers
    )
    write_part(
        docs,
        "larsen",
        f"""## Larsen04's tables 1 and 2

The paper's machine was a 2.4 GHz Pentium 4 of 2003 with a GeForce FX 5950: the ratio of its times to ours says as much
about twenty years of hardware as about method. Medians; load average before the run: {result.machine.load}.

{machine_lines(result.machine)}

### Table 1: photons in a k-d tree, ms

Building (the paper: balancing) the tree, and one irradiance from the {NEAREST} nearest photons. Alone: one look-up
called by itself from Python. Together: each of 4096 look-ups in one call on all threads, with the tree's building and
the correction at borders, which the paper has not.

| photons | paper, build | ours, build | paper, look-up | ours, alone | ours, together |
| --- | --- | --- | --- | --- | --- |
{look_ups}

### Table 2: one final gather, ms

The paper renders the scene from a texel on the GPU; ours traces as many rays with Embree on the CPU and sums what they
bring. Alone: one texel called by itself from Python. Together: each of {BATCH} texels gathered as a bake does it.

| rays | polygons, paper | triangles, ours | paper | ours, alone | ours, together |
| --- | --- | --- | --- | --- | --- |
{gathers}
""",
    )
