# SPDX-License-Identifier: GPL-3.0-or-later
"""The bench of the gather by views: what its report says of a GPU, of software and of neither. No OpenGL is needed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.document import read_parts
from bench.errors import Errors
from bench.gpu_accuracy import SCENES, SIZES, ball_room
from bench.gpu_gather import _runs
from bench.gpu_parts import KINDS, anew, lit_by_lamps, placed_scene
from bench.gpu_results import (
    COMPUTE,
    RASTER,
    Accuracy,
    FrameTime,
    GatherTime,
    GpuResult,
    StandIn,
    SumTime,
    path_of,
)
from bench.larsen_tables import PAPER_GATHER
from bench.report_gpu import short_us, write_gpu
from bench.results import Machine
from rtgi_addon.backend.gpu.context import GpuInfo
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.settings import Gather
from tests.backend.scenes import cornell

MACHINE = Machine("A processor", 2, {"rtgi": "0.1.0"}, "0.3")
SOFTWARE = GpuInfo("llvmpipe (LLVM 15)", "4.5 (Core Profile)", 450, True, 16384, 2048, 65536, 1 << 27)
CARD = replace(SOFTWARE, renderer="A card", software=False)


def gather_times(plane: float, others: float) -> tuple[GatherTime, ...]:
    """``plane`` and ``others``: µs of a view; each sum takes 10."""
    rows = []
    for polygons, rays in PAPER_GATHER:
        for kind in (Gather.LINKS, *KINDS):
            view = {Gather.PLANE: plane, Gather.LINKS: 123.4}.get(kind, others)
            about = GatherTime(kind, round(rays**0.5), polygons, polygons, 1000 * PAPER_GATHER[polygons, rays],
                               path_of(kind), 3008)  # fmt: skip
            rows.append(replace(about, view=view, sums=0.0 if kind is Gather.LINKS else 10.0))
    return tuple(rows)


def errors(error: float, bias: float = 0.001) -> Errors:
    return Errors(error, error, bias, 2 * error, 0.004, 1500)


def result(device: GpuInfo, *, plane: float = 45.0, others: float = 230.0, error: float = 0.012) -> GpuResult:
    return GpuResult(
        MACHINE, device, sum_path=RASTER if device.software else COMPUTE, times=gather_times(plane, others),
        accuracies=tuple(
            Accuracy(scene, kind, path_of(kind), size, errors(0.12, -0.034) if kind is Gather.PLANE else errors(error),
                     errors(error / 2))
            for scene in SCENES for kind in KINDS for size in SIZES
        ),
        sums=(SumTime(Gather.PLANE, 32, "exact", RASTER, 19.6, 0.0),
              SumTime(Gather.PLANE, 32, "mip-map", RASTER, 70.6, 1.2e-7)),
        stand_ins=(StandIn(101_760, 157_543.0, (0.0, 0.0), errors(0.017), 0.0),
                   StandIn(4_006, 4_965.5, (0.0211, 0.0554), errors(0.0176), 0.0022)),
        frames=(FrameTime(Gather.PLANE, RASTER, 32, 11_708, 7.0, 5.0, 1.25),
                FrameTime(Gather.RAYS, COMPUTE, 32, 11_708, skipped="about 12 s a frame")),
    )  # fmt: skip


def written(result: GpuResult, docs: Path) -> str:
    write_gpu(result, docs)
    return read_parts((docs / "benchmarks.md").read_text(encoding="utf-8"))["gpu"]


def test_software_is_called_software_and_no_gpu_is_made_up(tmp_path: Path) -> None:
    text = written(result(SOFTWARE), tmp_path)
    assert "2 threads, no GPU used" in text
    assert "**Device:** software on the processor's threads (llvmpipe (LLVM 15), OpenGL 4.5 (Core Profile))." in text
    assert "**No figure here is a GPU's.**" in text
    assert "| 32 × 32 on the plane at 34 triangles, software: at most 60 µs | 55.0 µs |" in text
    assert "| 32 × 32 at 13k triangles, a GPU: at most 1 µs | not measured: no GPU on this machine |" in text
    assert "| 32 × 32 at 133k triangles, a GPU: at most 2 µs | not measured: no GPU on this machine |" in text
    assert "a GPU: at most 10 ms | not measured: no GPU on this machine |" in text
    assert "missed" not in text


def test_a_gpu_is_held_to_its_own_figures_by_its_fastest_gather(tmp_path: Path) -> None:
    fast = replace(result(CARD), times=tuple(replace(t, view=0.5, sums=0.25) for t in gather_times(1, 1)))
    fast = replace(fast, times=tuple(replace(t, view=9.0) if t.kind is Gather.PLANE else t for t in fast.times))
    text = written(fast, tmp_path)
    assert "**Device:** a GPU (A card, OpenGL 4.5 (Core Profile))." in text
    assert "no GPU used" not in text and "No figure here is a GPU's" not in text
    assert "software: at most 60 µs | not measured: this is a GPU |" in text
    assert "| 32 × 32 at 13k triangles, a GPU: at most 1 µs | 0.75 µs (hemicube, raster) |" in text
    assert "| 12k texels anew and one product, a GPU: at most 10 ms | 8.2 ms (plane, raster) |" in text


def test_tables_give_the_paths_and_the_papers_numbers(tmp_path: Path) -> None:
    text = written(result(SOFTWARE), tmp_path)
    assert "| pixels | triangles | paper | plane (raster) | hemicube (raster) | rays (compute) | links (CPU) |" in text
    cells = "45.0 + 10.0 = **55.0** (3008) | 230 + 10.0 = **240** (3008) | 230 + 10.0 = **240** (3008) | **123** (3008)"
    assert f"| 32 × 32 | 34 | 780 | {cells} |" in text
    assert "| cornell | plane (raster) | 16 × 16 | 12.00% | -3.40% | 24.00% | 0.60% | 0.40% | 1500 |" in text
    assert "| plane | 32 × 32 | exact | raster | 19.6 | 0 |" in text
    assert "| plane | 32 × 32 | mip-map | raster | 70.6 | 1e-07 |" in text
    assert "| 4006 | 4966 | 21.1 | 55.4 | 1.76% | +0.10% | 0.22% |" in text
    assert "| plane (raster) | 32 × 32 | 11708 | 7.0 | 5.0 | 1.25 | 8.2 |" in text
    assert "| rays (compute) | 32 × 32 | 11708 | not measured: about 12 s a frame | - | - | - |" in text


def test_an_error_below_the_references_noise_is_not_called_nothing(tmp_path: Path) -> None:
    text = written(result(SOFTWARE, error=0.0), tmp_path)
    assert "| interior | rays (compute) | 64 × 64 | below the noise | +0.10% | 0.00% | below the noise |" in text


def test_what_is_not_met_is_missed(tmp_path: Path) -> None:
    text = written(result(SOFTWARE, plane=61.0, error=0.022), tmp_path)
    assert "software: at most 60 µs | 71.0 µs **missed** |" in text
    for scene in SCENES:
        assert (
            f"hemicube of 64 × 64 against links of 4096 rays, {scene}: at most 1.5% | 2.20% (whole: 1.10%) **missed** |"
            in text
        )
    text = written(result(CARD, plane=2.0, others=3.0), tmp_path)
    assert "| 32 × 32 at 13k triangles, a GPU: at most 1 µs | 12.0 µs (plane, raster) **missed** |" in text


def test_what_was_left_out_is_named_with_its_reason(tmp_path: Path) -> None:
    whole = result(SOFTWARE)
    times = tuple(
        replace(t, view=0.0, sums=0.0, skipped="1.2 s a view") if t.kind is Gather.HEMICUBE and t.size == 8 else t
        for t in whole.times
    )
    text = written(replace(whole, times=times), tmp_path)
    assert "| 8 × 8 | 34 | 750 | 45.0 + 10.0 = **55.0** (3008) | - | 230 + 10.0 = **240** (3008) |" in text
    assert "Not measured: hemicube, 8 × 8, 133000 polygons: 1.2 s a view." in text


def test_without_opengl_one_line_says_so_and_no_figure_is_given(tmp_path: Path) -> None:
    text = written(GpuResult(MACHINE, None, "no OpenGL 3.3: libEGL.so not loaded"), tmp_path)
    assert text == "## The gather by views, on a GPU\n\nNot measured: no OpenGL 3.3: libEGL.so not loaded."


@pytest.mark.parametrize(
    "value, text",
    [(0.751, "0.75"), (9.99, "9.99"), (9.999, "10.0"), (99.94, "99.9"), (99.96, "100"), (15940.2, "15940")],
)
def test_microseconds_have_three_digits(value: float, text: str) -> None:
    assert short_us(value) == text


def test_batches_are_spread_over_all_texels() -> None:
    runs = _runs(100, 8, 3)
    assert [(run[0], run[-1], len(run)) for run in runs] == [(0, 7, 8), (46, 53, 8), (92, 99, 8)]
    assert all(np.array_equal(run, np.arange(5)) for run in _runs(5, 5, 4))


def test_anew_is_a_change_that_moves_nothing() -> None:
    placed = placed_scene(*cornell(7), Workers(1))
    change = anew(placed)
    assert change.sweep.any and change.texels.all() and change.rays_hold and not change.sweep.places
    sent = lit_by_lamps(placed)
    assert sent.shape == (placed.texels.count, 3) and (sent >= 0).all() and sent.any()


def test_the_dense_ball_is_dense_and_hangs_free_in_its_room() -> None:
    scene, _ = ball_room()
    ball = scene.meshes[-1]
    assert 95_000 < ball.triangle_count < 110_000
    away = np.linalg.norm(ball.vertices, axis=1)
    assert 0.48 < away.min() < 0.495 and 0.505 < away.max() < 0.52
