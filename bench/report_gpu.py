# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of docs/benchmarks.md on the gather by views: times beside Larsen04's table 2, errors, what is held to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtgi_addon.backend.final_gather.views.view import coverage
from rtgi_addon.backend.gpu.context import GpuInfo
from rtgi_addon.backend.settings import Gather

from .document import machine_lines, write_part
from .errors import Errors
from .gpu_accuracy import BUMP, RADIUS, REFERENCE, SCENES
from .gpu_parts import KINDS
from .gpu_results import Accuracy, FrameTime, GatherTime, GpuResult, StandIn, SumTime
from .table import LEAST_WHOLE

#: Held to: µs of a gather of 32² pixels on the plane at 34 polygons by software; error of hemicubes of 64 pixels, ...
SOFTWARE_US, ERROR = 60.0, 0.015
#: ... by a GPU µs of a gather of 32² at so many polygons, and ms of a frame of 12k texels.
GPU_US, FRAME_MS = {13_000: 1.0, 133_000: 2.0}, 10.0
#: Whether a figure is as it is held to (None: it was not measured), and the figure.
Verdict = tuple[bool | None, str]
NO_GPU, NO_SOFTWARE = (None, "not measured: no GPU on this machine"), (None, "not measured: this is a GPU")
_COLUMNS = (Gather.PLANE, Gather.HEMICUBE, Gather.RAYS, Gather.LINKS)
_TITLE = "## The gather by views, on a GPU"


def write_gpu(result: GpuResult, docs: Path) -> None:
    if result.device is None:
        write_part(docs, "gpu", f"{_TITLE}\n\nNot measured: {result.absent}.")
        return
    parts = [
        _head(result, result.device),
        _larsen(result.times, result.sum_path),
        _accuracy(result.accuracies),
        _sums(result.sums),
        _stand_ins(result.stand_ins),
        _frames(result.frames),
        _verdicts(result, result.device),
    ]
    write_part(docs, "gpu", "\n".join(parts))


def device_words(device: GpuInfo) -> str:
    """What draws, and whether that is a GPU at all."""
    name = f"{device.renderer}, OpenGL {device.version}"
    return f"software on the processor's threads ({name})" if device.software else f"a GPU ({name})"


def _head(result: GpuResult, device: GpuInfo) -> str:
    caution = (
        "\n**No figure here is a GPU's.** Software shades every vertex and pixel on the processor: how long it\n"
        "takes says how much work there is, not how long a GPU would take for it.\n"
        if device.software
        else ""
    )
    return f"""{_TITLE}

The scene is drawn from every texel, as in Larsen04 §4, or rays are traced from it in a compute shader; what each pixel
sees stays on the device and is summed for whatever light there is.
{caution}
{machine_lines(result.machine, "no GPU used" if device.software else f"GPU {device.renderer}")}
- **Device:** {device_words(device)}.
- **Load average** of the machine before the run: {result.machine.load}.
- **Paths:** plane and hemicube are raster, triangles through vertex and fragment shaders; rays are compute shaders;
  links are rays that Embree traces on the processor.
- **Times** are medians of at least three batches after one that is not counted. View: from the eye's place to what its
  pixels see, all waiting for the device included. Sum: from radiosity in main memory to irradiance there, tables sent
  and sums read back. Before either a few rays of each texel tell what of it lies open; they are timed with the frame.
"""


def _larsen(times: Sequence[GatherTime], sum_path: str) -> str:
    sizes = dict.fromkeys((t.size, t.polygons) for t in times)
    rows = "\n".join(_larsen_row([t for t in times if (t.size, t.polygons) == key]) for key in sorted(sizes))
    titles = " | ".join(f"{kind} ({path})" for kind, path in dict.fromkeys((t.kind, t.path) for t in _ordered(times)))
    skipped = "".join(
        f"\nNot measured: {t.kind}, {t.size} × {t.size}, {t.polygons} polygons: {t.skipped}.\n"
        for t in times
        if t.skipped
    )
    return f"""### Larsen04's table 2: one final gather, µs

View + sum = both, for each texel of a batch; behind it, how many texels that was. The walls are cut and made bumpy
until the box has as many triangles as the paper's; none has a stand-in. The paper's GeForce FX 5950 of 2003 drew one
view at a time. Sums are by {sum_path}. Links trace as many rays, half of them aimed, and sum what they bring at once.

| pixels | triangles | paper | {titles} |
| --- | --- | --- |{" --- |" * (titles.count("|") + 1)}
{rows}
{skipped}"""


def _ordered(times: Sequence[GatherTime]) -> list[GatherTime]:
    return sorted(times, key=lambda t: _COLUMNS.index(t.kind))


def _larsen_row(times: Sequence[GatherTime]) -> str:
    one = times[0]
    cells = " | ".join(_larsen_cell(t) for t in _ordered(times))
    return f"| {one.size} × {one.size} | {one.triangles} | {one.paper:.0f} | {cells} |"


def _larsen_cell(t: GatherTime) -> str:
    if t.skipped:
        return "-"
    if t.kind is Gather.LINKS:
        return f"**{short_us(t.both)}** ({t.texels})"
    return f"{short_us(t.view)} + {short_us(t.sums)} = **{short_us(t.both)}** ({t.texels})"


def short_us(value: float) -> str:
    """Three digits, but no digit of a whole number left out."""
    return f"{value:.0f}" if value >= 99.95 else f"{value:.1f}" if value >= 9.995 else f"{value:.2f}"


def _accuracy(accuracies: Sequence[Accuracy]) -> str:
    rows = "\n".join(
        f"| {a.scene} | {a.kind} ({a.path}) | {a.size} × {a.size} | {_rmse(a.errors)} "
        f"| {a.errors.bias:+.2%} | {a.errors.percentile_95:.2%} | {_rmse(a.whole)} "
        f"| {a.errors.reference_noise:.2%} | {a.errors.texels} |"
        for a in accuracies
    )
    resolutions = ", ".join(f"{name} {pixels}²" for name, pixels in SCENES.items())
    return f"""### Error

Against links of {REFERENCE.total} rays a texel, given the same radiosity (a bake's, all its bounces in it), so that
the gather alone is compared; nothing is denoised. At valid texels chosen at random, of the demo scenes with atlases of
{resolutions} pixels. Error: RMS difference over the reference's mean; the
reference is the mean of two seeds, and its noise, told by their difference, is taken out in quadrature. Bias is the
mean difference and P95 the 95th percentile of the absolute one, over the same mean. Whole: the error without texels
that are surface by less than {LEAST_WHOLE:.0%}, as in the part on speed.

The plane sees {coverage(Gather.PLANE):.0%} of the cosine-weighted hemisphere and none of the light that comes in flat:
that is its bias, which no number of pixels mends. Links and rays start at a texel's eight points, a view is seen from
one, or from a few where one does not stand for the texel: few texels that lie on both sides of something thin can be
most of an error.

| scene | gather | pixels | error | bias | P95 | whole | reference's noise | texels |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{rows}
"""


def _rmse(errors: Errors) -> str:
    return f"{errors.relative_rmse:.2%}" if errors.relative_rmse > 0 else "below the noise"


def _sums(sums: Sequence[SumTime]) -> str:
    rows = "\n".join(
        f"| {s.kind} | {s.size} × {s.size} | {s.way} | {s.path} | {short_us(s.microseconds)} | {s.difference:.1g} |"
        for s in sums
    )
    return f"""### Sums: exact and by mip-map

Of the same views of the Cornell box, µs a view, the image's making and the reading back included. Exact sums are what
a bake uses; the mean by the mip-map hardware is the paper's. Difference: RMS from the first row, over the mean.

| gather | pixels | sum | path | µs | difference |
| --- | --- | --- | --- | --- | --- |
{rows}
"""


def _stand_ins(stand_ins: Sequence[StandIn]) -> str:
    rows = "\n".join(
        f"| {s.triangles} | {short_us(s.microseconds)} | {1000 * s.deviation[0]:.1f} | {1000 * s.deviation[1]:.1f} "
        f"| {_rmse(s.errors)} | {s.errors.bias:+.2%} | {s.difference:.2%} |"
        for s in stand_ins
    )
    first = stand_ins[0].errors
    return f"""### Stand-ins of large meshes

Hemicubes of 32 × 32 pixels (raster) from {first.texels} texels on the walls of a room of 2 m, in which hangs a ball of
{RADIUS:g} m radius with bumps of {1000 * BUMP:.0f} mm. Deviation: how far vertices of the mesh lie from those that
stand for them. Error and bias: as above, against links to the ball as it is (their noise:
{first.reference_noise:.2%}). Difference: RMS from the views of the ball as it is, over the mean.

| triangles of the ball | view, µs | deviation, RMS, mm | largest | error | bias | difference |
| --- | --- | --- | --- | --- | --- | --- |
{rows}
"""


def _frames(frames: Sequence[FrameTime]) -> str:
    rows = "\n".join(_frame_row(f) for f in frames)
    return f"""### A frame of 12k texels, ms

The Cornell box, as if every texel had moved: all views made anew, with the rays that tell which points lie in the open
and the eyes' places, and one product. A lamp that moves draws nothing: each step to radiosity's fixed point is one
product, and so is the IIM.

| gather | pixels | texels | all views anew | of it drawing | one product | both |
| --- | --- | --- | --- | --- | --- | --- |
{rows}
"""


def _frame_row(f: FrameTime) -> str:
    about = f"| {f.kind} ({f.path}) | {f.size} × {f.size} | {f.texels} "
    if f.skipped:
        return f"{about}| not measured: {f.skipped} | - | - | - |"
    return f"{about}| {f.renewed:.1f} | {f.drawn:.1f} | {f.product:.2f} | {f.frame:.1f} |"


def _verdicts(result: GpuResult, device: GpuInfo) -> str:
    bars = [
        (
            f"32 × 32 on the plane at 34 triangles, software: at most {SOFTWARE_US:.0f} µs",
            _plane(result.times) if device.software else NO_SOFTWARE,
        ),
        *(
            (f"hemicube of 64 × 64 against links of {REFERENCE.total} rays, {scene}: at most {ERROR:.1%}", found)
            for scene, found in ((scene, _error(result, scene)) for scene in SCENES)
        ),
        *(
            (
                f"32 × 32 at {polygons // 1000}k triangles, a GPU: at most {most:g} µs",
                NO_GPU if device.software else _fastest(result.times, polygons, most),
            )
            for polygons, most in GPU_US.items()
        ),
        (
            f"12k texels anew and one product, a GPU: at most {FRAME_MS:.0f} ms",
            NO_GPU if device.software else _frame(result.frames),
        ),
    ]  # fmt: skip
    rows = "\n".join(f"| {bar} | {value}{' **missed**' if good is False else ''} |" for bar, (good, value) in bars)
    return f"""### Held to

Of a GPU the fastest of {", ".join(KINDS[:-1])} and {KINDS[-1]} counts.

| held to | figure |
| --- | --- |
{rows}
"""


def _plane(times: Sequence[GatherTime]) -> Verdict:
    one = next(t for t in times if (t.kind, t.size, t.polygons) == (Gather.PLANE, 32, 34))
    return _at_most(one.both, SOFTWARE_US, f"{short_us(one.both)} µs") if not one.skipped else (None, one.skipped)


def _error(result: GpuResult, scene: str) -> Verdict:
    found = next(a for a in result.accuracies if (a.scene, a.kind, a.size) == (scene, Gather.HEMICUBE, 64))
    words = f"{_rmse(found.errors)} (whole: {_rmse(found.whole)})"
    return _at_most(found.errors.relative_rmse, ERROR, words)


def _fastest(times: Sequence[GatherTime], polygons: int, most: float) -> Verdict:
    known = [t for t in times if (t.size, t.polygons) == (32, polygons) and t.kind in KINDS and not t.skipped]
    if not known:
        return None, "not measured"
    best = min(known, key=lambda t: t.both)
    return _at_most(best.both, most, f"{short_us(best.both)} µs ({best.kind}, {best.path})")


def _frame(frames: Sequence[FrameTime]) -> Verdict:
    known = [f for f in frames if not f.skipped]
    if not known:
        return None, "not measured"
    best = min(known, key=lambda f: f.frame)
    return _at_most(best.frame, FRAME_MS, f"{best.frame:.1f} ms ({best.kind}, {best.path})")


def _at_most(value: float, most: float, words: str) -> Verdict:
    return value <= most, words
