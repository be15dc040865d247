# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m bench``: run, compare, write docs/benchmarks.md. Minutes; ``--full`` takes Cycles to more samples."""

from __future__ import annotations

import argparse
import logging

from .points import points_of
from .report import write_report
from .run import bench_scene
from .table import ROOT, SCENES


def main() -> None:
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument("--full", action="store_true", help="more samples for Cycles")
    parser.add_argument("--scene", action="append", choices=[s.name for s in SCENES], help="default: all")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    wanted = [s for s in SCENES if arguments.scene is None or s.name in arguments.scene]
    points, machines = {}, {}
    for scene in wanted:
        runs, machines[scene] = bench_scene(scene, full=arguments.full)
        points[scene] = points_of(runs)
        write_report(points, machines, ROOT / "docs")  # anew after each scene: a run cut short is not lost


if __name__ == "__main__":
    main()
