# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``rtgi``: arguments in, exit code out. Started by Blender's --command or by ``python -m rtgi_addon``.

0 done · 2 bad input or usage, nothing computed or written · 3 failed, finished frames kept · 130 cancelled,
finished frames kept. bpy is imported when a command runs, so that --help and usage errors need no Blender.
"""

from __future__ import annotations

import argparse
import importlib.util
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Any

from .arguments import frames_of, make_parser, path_of, settings_of, size_of
from .backend.errors import BakeError, Cancelled
from .output import FrameFailed
from .terminal import Listener, make_listener, own_stdout

DONE, REFUSED, FAILED, CANCELLED = 0, 2, 3, 130

#: What a command hands back for its last line: fields for programs, and the same in words.
Summary = tuple[dict[str, Any], list[str]]


def run(argv: Sequence[str]) -> int:
    """Do what ``argv`` (without the program's name) asks; the exit code."""
    arguments: argparse.Namespace | BakeError
    try:
        arguments = make_parser().parse_args(list(argv))
    except BakeError as refusal:
        arguments = refusal
    except SystemExit:  # argparse's way to end --help
        return DONE
    as_json = "--json" in argv
    with own_stdout(hush=not as_json and sys.stderr.isatty()) as out:
        listener = make_listener(out, as_json=as_json)
        with _signals_cancel(listener):
            return _conclude(lambda: _dispatch(arguments, listener), listener)


def _dispatch(arguments: argparse.Namespace | BakeError, listener: Listener) -> Summary:
    if isinstance(arguments, BakeError):
        raise arguments
    return {"bake": _bake, "render": _render, "report": _report}[arguments.command](arguments, listener)


def _conclude(work: Callable[[], Summary], listener: Listener) -> int:
    """Run ``work``, say how it ended, and give the exit code for it."""
    try:
        fields, lines = work()
    except BakeError as fault:
        listener.finish("refused", {"problems": list(fault.problems)}, [f"error: {p}" for p in fault.problems])
        return REFUSED
    except FrameFailed as fault:
        listener.finish("failed", {"problems": list(fault.problems)}, [f"error: {p}" for p in fault.problems])
        return FAILED
    except Cancelled:
        listener.finish("cancelled", {}, ["cancelled; finished frames are kept (rtgi bake --resume goes on from them)"])
        return CANCELLED
    except Exception as fault:
        problem = f"{type(fault).__name__}: {fault}"
        listener.finish("failed", {"problems": [problem]}, [traceback.format_exc().rstrip(), f"error: {problem}"])
        return FAILED
    listener.finish("done", fields, lines)
    return DONE


@contextmanager
def _signals_cancel(listener: Listener) -> Iterator[None]:
    """SIGINT and SIGTERM ask for a stop at the next report; asked again, they stop at once."""

    def cancel(number: int, at: FrameType | None) -> None:
        if listener.cancelled:
            raise Cancelled
        listener.cancelled = True

    if threading.current_thread() is not threading.main_thread():
        yield  # Python delivers signals to the main thread alone
        return
    before = {number: signal.signal(number, cancel) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def _collecting(problems: list[str]) -> Iterator[None]:
    """Note a refusal and go on, so that a user hears of all of them at once."""
    try:
        yield
    except BakeError as refusal:
        problems.extend(refusal.problems)


def _bake(arguments: argparse.Namespace, listener: Listener) -> Summary:
    problems: list[str] = []
    settings, frames = None, None
    with _collecting(problems):
        settings = settings_of(arguments)
    with _collecting(problems):
        frames = frames_of(arguments.frames)
    if problems or settings is None:
        raise BakeError(*problems)
    _need_bpy()
    from .bake import bake
    from .job import BakeJob
    from .scene_file import named_or_open

    job = BakeJob(
        scene=named_or_open(path_of(arguments.scene)),
        frames=frames,
        out=path_of(arguments.out),
        settings=settings,
        resume=arguments.resume,
        texels=arguments.texels,
        save_blend=path_of(arguments.save_blend),
    )
    summary = bake(job, listener)
    return _plain(asdict(summary)), summary.in_words()


def _render(arguments: argparse.Namespace, listener: Listener) -> Summary:
    problems: list[str] = []
    frames, size = None, None
    with _collecting(problems):
        frames = frames_of(arguments.frames)
    with _collecting(problems):
        size = size_of(arguments.resolution)
    maps = path_of(arguments.maps)
    if problems or maps is None:
        raise BakeError(*problems)
    _need_bpy()
    from .scene_file import named_or_open
    from .show import ShowJob, show

    scene = named_or_open(path_of(arguments.scene))
    summary = show(ShowJob(maps, scene, frames, path_of(arguments.out), size, arguments.samples), listener)
    return _plain(asdict(summary)), summary.in_words()


def _report(arguments: argparse.Namespace, listener: Listener) -> Summary:
    maps = path_of(arguments.maps)
    assert maps is not None  # the parser asks for it
    _need_bpy()
    from .report import report

    summary = report(maps, path_of(arguments.out), listener)
    return _plain(asdict(summary)), summary.in_words()


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    """``fields`` with paths as text."""
    pictures = {"pictures": [str(path) for path in fields["pictures"]]} if "pictures" in fields else {}
    return {**{k: str(v) if isinstance(v, Path) else v for k, v in fields.items()}, **pictures}


def _need_bpy() -> None:
    if importlib.util.find_spec("bpy") is None:
        raise BakeError("bpy: this Python has no Blender in it; start by blender --command, or install bpy beside it")
