# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes one scene by all methods, engines taking turns so that a busy moment of the machine falls on all of them."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from .results import Machine, Run
from .table import CYCLES, CYCLES_FULL, OURS, BenchScene

log = logging.getLogger("bench")


def bench_scene(scene: BenchScene, *, full: bool = False) -> tuple[list[Run], Machine]:
    """All runs of ``scene`` in the order they were made, and what they were made on."""
    cycles = CYCLES_FULL if full else CYCLES
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    with _worker("ours", scene) as ours, _worker("cycles", scene) as other:
        machine = _same_machine(_answer(ours), _answer(other), load)
        runs: list[Run] = []
        for seed in range(max(m.seeds for m in (*OURS, *cycles))):
            for connection, methods in ((ours, OURS), (other, cycles)):
                for method in methods:
                    if seed < method.seeds:
                        connection.send((method, seed))
                        runs += _logged(scene, _answer(connection))
        return runs, machine


def _same_machine(ours: dict[str, Any], other: dict[str, Any], load: str) -> Machine:
    if not np.array_equal(ours["compared"], other["compared"]):
        raise RuntimeError("the engines were given different texels")
    return Machine(ours["device"]["name"], ours["device"]["threads"], ours["versions"], load)


def _serve(engine: str, connection: Connection, scene: BenchScene) -> None:
    """A worker's whole life, in its own process."""
    from . import worker

    (worker.serve_ours if engine == "ours" else worker.serve_cycles)(connection, scene)


@contextmanager
def _worker(engine: str, scene: BenchScene) -> Iterator[Connection]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(engine, theirs, scene), daemon=True)
    process.start()
    theirs.close()  # so that a dead worker ends the wait for it
    try:
        yield ours
        ours.send(None)
        process.join()
    finally:
        process.terminate()


def _answer(connection: Connection) -> Any:
    try:
        return connection.recv()
    except EOFError:
        raise RuntimeError("a worker ended early; its own message is above") from None


def _logged(scene: BenchScene, runs: list[Run]) -> list[Run]:
    for run in runs:
        e = run.errors
        log.info(
            "%s, %s %s, seed %d: %.3f s, error %.2f %%, bias %+.2f %%",
            scene.name, run.curve.value, run.label, run.seed, run.cost.seconds,
            100 * e.relative_rmse, 100 * e.bias,
        )  # fmt: skip
    return runs
