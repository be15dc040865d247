# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m bench``: run, and write docs/benchmarks.md. ``--only`` picks parts; ``--full``: more Cycles samples."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence

from .animation import bench_frames, bench_larsen, bench_scaling, in_process
from .document import PARTS
from .gpu_gather import bench_gpu
from .points import points_of
from .report import write_report
from .report_frames import write_frames, write_larsen, write_scaling
from .report_gpu import write_gpu
from .run import bench_scene
from .table import ROOT, SCENES, BenchScene

DOCS = ROOT / "docs"


def main() -> None:
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument("--only", action="append", choices=PARTS, help="default: all parts")
    parser.add_argument("--full", action="store_true", help="part speed: more samples for Cycles")
    parser.add_argument("--scene", action="append", choices=[s.name for s in SCENES], help="part speed: default all")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    wanted = arguments.only or PARTS
    if "speed" in wanted:
        scenes = [s for s in SCENES if arguments.scene is None or s.name in arguments.scene]
        _speed(scenes, full=arguments.full)
    if "frames" in wanted:
        write_frames(in_process(bench_frames), DOCS)
    if "scaling" in wanted:
        write_scaling(in_process(bench_scaling), DOCS)
    if "larsen" in wanted:
        write_larsen(in_process(bench_larsen), DOCS)
    if "gpu" in wanted:
        write_gpu(in_process(bench_gpu), DOCS)


def _speed(scenes: Sequence[BenchScene], *, full: bool) -> None:
    points, machines = {}, {}
    for scene in scenes:
        runs, machines[scene] = bench_scene(scene, full=full)
        points[scene] = points_of(runs)
        write_report(points, machines, DOCS)  # anew after each scene: a run cut short is not lost


if __name__ == "__main__":
    main()
