# SPDX-License-Identifier: GPL-3.0-or-later
"""The gather by views, timed: Larsen04's table 2 again, sums of views in all ways, a frame of 12k texels.

On a GPU or on software that draws as one: what is measured is the same, and the result says which it was. Times are
medians after a call that is not counted; a view's begin when its texels' eyes are known and end when it is drawn.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np

from rtgi_addon.backend.final_gather.views.entries import make_entries
from rtgi_addon.backend.final_gather.views.sums import ViewSums
from rtgi_addon.backend.final_gather.views.target import Target
from rtgi_addon.backend.gpu.context import Gpu, GpuFailed, GpuUnavailable, open_gpu
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.scene import Float32, Int32
from rtgi_addon.backend.settings import Gather, SampleCounts
from tests.backend.scenes import cornell

from .animation import _surroundings
from .errors import Errors
from .gpu_accuracy import SCENES, accuracies, stand_in_errors
from .gpu_parts import (
    KINDS,
    REPEATS,
    anew,
    link_rays,
    lit_by_lamps,
    make_gather,
    median_seconds,
    placed_scene,
    rms,
    trace_by,
    watch,
)
from .gpu_results import COMPUTE, RASTER, FrameTime, GatherTime, GpuResult, SumTime, path_of
from .larsen_tables import BATCH, PAPER_GATHER, gather_all
from .rooms import bumpy_cornell
from .sequences import CORNELL

log = logging.getLogger("bench")
Row = TypeVar("Row")

#: Texels along a wall of the box whose gathers are timed, 3k or 12k in all: by software, by a GPU.
SOFTWARE_SIDE, HARDWARE_SIDE = 22, 44
#: Seconds for the counted draws of one figure, and repeats at most; a batch has so many texels at least. What would
#: take longer than LONGEST seconds even so is not measured.
BUDGET, MOST_REPEATS, LEAST_BATCH, LONGEST = 1.5, 9, 4, 20.0
#: Rays of a batch of links at most: all threads are busy.
LINK_RAYS = 1 << 20
#: Texels by which the time of a whole frame is guessed.
TRIAL = 256
#: Pixels along a view where sums and frames are timed: a preview's.
SIZE = 32


def bench_gpu() -> GpuResult:
    machine, _ = _surroundings()
    try:
        gpu = open_gpu()
    except GpuUnavailable as fault:
        return GpuResult(machine, None, str(fault))
    workers = Workers()
    try:
        log.info("%s, OpenGL %s", gpu.info.renderer, gpu.info.version)
        times = tuple(_logged(larsen_table(gpu, workers)))
        return GpuResult(
            machine, gpu.info,
            sum_path=COMPUTE if _computes_sums(gpu) else RASTER,
            times=times,
            sums=tuple(_logged(sum_times(gpu, workers))),
            frames=tuple(_logged(frame_times(gpu, workers))),
            stand_ins=tuple(_logged(stand_in_errors(gpu, workers))),
            accuracies=tuple(a for name in SCENES for a in _logged(accuracies(gpu, workers, name))),
        )  # fmt: skip
    finally:
        workers.close()
        gpu.close()


def _logged(rows: Iterator[Row]) -> Iterator[Row]:
    for row in rows:
        log.info("%s: %s", type(row).__name__, ", ".join(_words(value) for value in vars(row).values()))
        yield row


def _words(value: object) -> str:
    if isinstance(value, Errors):
        return f"{value.relative_rmse:.2%}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _computes_sums(gpu: Gpu) -> bool:
    """Were the sums so far by compute shaders? Told by what was compiled for them."""
    return any(str(name).startswith("sum") and compute for name, _, _, compute in gpu.programs)


def larsen_table(gpu: Gpu, workers: Workers) -> Iterator[GatherTime]:
    """The Cornell box with its walls cut into triangles and made bumpy; no stand-ins."""
    side = SOFTWARE_SIDE if gpu.info.software else HARDWARE_SIDE
    for polygons in dict.fromkeys(p for p, _ in PAPER_GATHER):
        placed = placed_scene(*bumpy_cornell(polygons, side, moving=False), workers)
        sent = lit_by_lamps(placed)
        for kind in (Gather.LINKS, *KINDS):
            if kind is Gather.RAYS and gpu.info.computes:
                trace_by(placed, gpu)
            for rays in (r for p, r in PAPER_GATHER if p == polygons):
                about = GatherTime(
                    kind, round(rays**0.5), polygons, placed.geometry.triangle_count,
                    1000 * PAPER_GATHER[polygons, rays], path_of(kind), 0,
                )  # fmt: skip
                yield _timed_links(about, placed, sent) if kind is Gather.LINKS else _timed(about, gpu, placed, sent)


def _timed_links(about: GatherTime, placed: PlacedScene, sent: Float32) -> GatherTime:
    """As ``larsen_tables`` times them: half of the rays aimed."""
    half, count = about.size**2 // 2, placed.texels.count
    tracer = link_rays(placed, sent, SampleCounts(half, half), seed=0)
    most = min(BATCH, LINK_RAYS // about.size**2)
    batch = np.random.default_rng(1).permutation(count)[:most].astype(np.int32)
    seconds = median_seconds(lambda: gather_all(tracer, batch, sent, 2 * half, placed.workers))
    return replace(about, texels=len(batch), view=1e6 * seconds / len(batch))


def _timed(about: GatherTime, gpu: Gpu, placed: PlacedScene, sent: Float32) -> GatherTime:
    if about.kind is Gather.RAYS and not gpu.info.computes:
        return replace(about, skipped="no compute shaders")
    try:
        gather = make_gather(gpu, placed, about.kind, about.size)
    except GpuFailed as fault:
        return replace(about, skipped=str(fault))
    drawing, everything = watch(gather, one_point=True), anew(placed)

    def draw(texels: Int32) -> float:
        """Seconds a texel."""
        gather.follow(placed, everything)
        before = drawing.seconds
        gather.renew(texels)
        return (drawing.seconds - before) / len(texels)

    each = [draw(run) for run in _runs(gather.count, LEAST_BATCH, 2)][-1]  # the first one's programs are compiled
    if each * LEAST_BATCH * REPEATS > LONGEST:
        gather.release()
        return replace(about, skipped=f"{each:.1f} s a view")
    each = draw(_runs(gather.count, _batch(each, gather.count), 1)[0])  # many at a time cost less
    batch = _batch(each, gather.count)
    repeats = int(np.clip(BUDGET / (batch * each), REPEATS, MOST_REPEATS))
    view = float(np.median([draw(run) for run in _runs(gather.count, batch, repeats)]))
    known = gather.irradiance()
    sums = median_seconds(lambda: known.irradiance(sent), repeats) / gather.count
    gather.release()
    return replace(about, texels=batch, view=1e6 * view, sums=1e6 * sums)


def _batch(each: float, count: int) -> int:
    """Texels that are drawn REPEATS times in about BUDGET, where one of ``count`` takes ``each`` seconds."""
    return int(np.clip(BUDGET / REPEATS / each, LEAST_BATCH, count))


def _runs(count: int, batch: int, number: int) -> list[Int32]:
    """``number`` times ``batch`` neighbouring ones of ``count`` texels, spread over all."""
    first = np.linspace(0, count - batch, number).astype(np.int32)
    return [np.arange(k, k + batch, dtype=np.int32) for k in first]


def sum_times(gpu: Gpu, workers: Workers) -> Iterator[SumTime]:
    """One target of views of the Cornell box, summed in all ways."""
    placed = placed_scene(*cornell(SOFTWARE_SIDE if gpu.info.software else HARDWARE_SIDE), workers)
    sent = make_entries(placed.texels, placed.sky).sent(lit_by_lamps(placed), None)
    for kind in (Gather.PLANE, Gather.HEMICUBE):
        gather = make_gather(gpu, placed, kind, SIZE)
        drawing = watch(gather)
        gather.renew(np.arange(gather.count, dtype=np.int32))
        assert drawing.target is not None
        exact = None
        for way, path, work in _ways(gpu, drawing.target, sent):
            seconds, found = median_seconds(work), work()[:, :3]
            exact = found if exact is None else exact
            each = 1e6 * seconds / drawing.target.tiles
            yield SumTime(kind, SIZE, way, path, each, rms(found, exact))
        gather.release()


def _ways(gpu: Gpu, target: Target, sent: Float32) -> Iterator[tuple[str, str, Callable[[], Float32]]]:
    """What gives the (t, 4) sums of ``target``, with the path it takes; ``sent`` (e, 4) by entries."""
    for by_groups in (False, True) if gpu.info.computes else (False,):
        sums = ViewSums(gpu, target.view, len(sent), by_groups=by_groups)
        sums.send(sent)
        yield "exact", COMPUTE if by_groups else RASTER, lambda s=sums: np.add(*s.sums(target, None))
        if not by_groups:
            yield "mip-map", RASTER, lambda s=sums: s.mip_map_sums(target)
        sums.release()


def frame_times(gpu: Gpu, workers: Workers) -> Iterator[FrameTime]:
    """The Cornell box of the bench's animations: 12k texels."""
    placed = placed_scene(*cornell(CORNELL, moving=True), workers)
    sent = lit_by_lamps(placed)
    for kind in KINDS:
        if kind is Gather.RAYS:
            if not gpu.info.computes:
                return
            trace_by(placed, gpu)
        yield _frame_time(gpu, placed, kind, sent)


def _frame_time(gpu: Gpu, placed: PlacedScene, kind: Gather, sent: Float32) -> FrameTime:
    gather = make_gather(gpu, placed, kind, SIZE)
    drawing, everything = watch(gather), anew(placed)
    about = FrameTime(kind, path_of(kind), SIZE, gather.count)

    def renew(texels: Int32) -> tuple[float, float]:
        """Milliseconds in all, and of drawing."""
        gather.follow(placed, everything)
        before, start = drawing.seconds, time.perf_counter()
        gather.renew(texels)
        return 1000 * (time.perf_counter() - start), 1000 * (drawing.seconds - before)

    each = [renew(run)[0] / TRIAL for run in _runs(gather.count, TRIAL, 2)][-1]
    expected = each * gather.count / 1000
    if expected * REPEATS > LONGEST:
        gather.release()
        return replace(about, skipped=f"about {expected:.0f} s a frame")
    whole = _runs(gather.count, gather.count, REPEATS + 1)
    renewed, drawn = np.median([renew(texels) for texels in whole][1:], axis=0)
    known = gather.irradiance()
    product = 1000 * median_seconds(lambda: known.irradiance(sent))
    gather.release()
    return replace(about, renewed=float(renewed), drawn=float(drawn), product=product)
