# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake says while it runs: a bar on a terminal, JSON lines for programs, plain lines otherwise. No bpy here.

Blender writes to the C-level stdout as it pleases, so :func:`own_stdout` keeps the real one for these lines and
sends everything else to stderr. A reader that goes away (``| head``) ends the talking, not the work.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from typing import Any, TextIO

from tqdm import tqdm

from .backend.errors import Cancelled

#: A stage that reports faster than this is thinned out; its first and last report always pass.
SECONDS_BETWEEN_REPORTS = 0.1


class Listener:
    """Hears of a bake and says nothing; the others say it. All calls come from the thread that bakes."""

    #: Set by whoever wants the bake to stop, from any thread or signal handler.
    cancelled = False

    def report(self, stage: str, done: int, total: int) -> None:
        """Where the work is, as in ``backend.progress``."""
        if self.cancelled:
            raise Cancelled

    def frame_begins(self, frame: int, index: int, count: int) -> None: ...

    def frame_done(self, frame: int, record: dict[str, Any]) -> None: ...

    def warn(self, text: str) -> None: ...

    def finish(self, event: str, fields: dict[str, Any], lines: Sequence[str]) -> None:
        """The last call. ``event`` is done, cancelled, failed or refused; ``lines`` say it in words."""


class Stream:
    """Text lines to a file that may be closed at the far end; after that, silence."""

    def __init__(self, file: TextIO) -> None:
        self._file: TextIO | None = file

    def line(self, text: str) -> None:
        if self._file is None:
            return
        try:
            self._file.write(text + "\n")
            self._file.flush()
        except (
            BrokenPipeError,
            ValueError,
        ):  # the reader left; ValueError: the file is closed
            self._file = None


class JsonLines(Listener):
    """One JSON object per line: ``{"event": "progress" | "frame" | "warning" | "done" | ..., ...}``."""

    def __init__(self, out: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._out, self._clock = Stream(out), clock
        self._stage, self._said = "", -1.0
        self._frame: int | None = None

    def report(self, stage: str, done: int, total: int) -> None:
        super().report(stage, done, total)
        now = self._clock()
        if stage == self._stage and done < total and now - self._said < SECONDS_BETWEEN_REPORTS:
            return
        self._stage, self._said = stage, now
        place: dict[str, Any] = {} if self._frame is None else {"frame": self._frame}
        self._say("progress", stage=stage, done=done, total=total, **place)

    def frame_begins(self, frame: int, index: int, count: int) -> None:
        self._frame = frame
        self._stage = ""
        self._say("frame_begins", frame=frame, index=index, count=count)

    def frame_done(self, frame: int, record: dict[str, Any]) -> None:
        self._say("frame", frame=frame, **record)

    def warn(self, text: str) -> None:
        self._say("warning", text=text)

    def finish(self, event: str, fields: dict[str, Any], lines: Sequence[str]) -> None:
        self._say(event, **fields, lines=list(lines))

    def _say(self, event: str, **fields: Any) -> None:
        self._out.line(json.dumps({"event": event, **fields}, allow_nan=False))


class Plain(Listener):
    """A line per stage, later per frame, on stderr and the summary on stdout: for logs."""

    def __init__(self, out: TextIO, log: TextIO) -> None:
        self._out, self._log = Stream(out), Stream(log)
        self._stage, self._place = "", ""

    def report(self, stage: str, done: int, total: int) -> None:
        super().report(stage, done, total)
        if stage != self._stage and not self._place:
            self._log.line(stage)
        self._stage = stage

    def frame_begins(self, frame: int, index: int, count: int) -> None:
        self._place = f"frame {frame} ({index + 1}/{count})"

    def frame_done(self, frame: int, record: dict[str, Any]) -> None:
        self._log.line(f"{self._place}: {describe(record)}")

    def warn(self, text: str) -> None:
        self._log.line(f"warning: {text}")

    def finish(self, event: str, fields: dict[str, Any], lines: Sequence[str]) -> None:
        for text in lines:
            (self._out if event == "done" else self._log).line(text)


class Bar(Listener):
    """Two bars on a terminal: frames with the time left, and the stage at work."""

    def __init__(self, out: TextIO, terminal: TextIO) -> None:
        self._out, self._terminal = Stream(out), terminal
        self._frames: tqdm[Any] | None = None
        self._stage: tqdm[Any] | None = None

    def report(self, stage: str, done: int, total: int) -> None:
        super().report(stage, done, total)
        if self._stage is None:
            layout = "{desc:<20} {bar:24} {n_fmt}/{total_fmt} {remaining}"
            self._stage = tqdm(desc=stage, total=total, file=self._terminal, leave=False, bar_format=layout)
        new = self._stage.desc != stage
        self._stage.set_description_str(stage, refresh=False)
        if self._stage.total != total or done < self._stage.n:
            self._stage.reset(total)
        self._stage.update(done - self._stage.n)
        if new or done == total:
            self._stage.refresh()

    def frame_begins(self, frame: int, index: int, count: int) -> None:
        if self._frames is None:
            self._frames = tqdm(
                total=count,
                initial=index,
                file=self._terminal,
                leave=False,
                position=1,
                bar_format="{desc:<20} {bar:24} {n_fmt}/{total_fmt} {elapsed} < {remaining}",
            )
        self._frames.n = index
        self._frames.set_description_str(f"frame {frame}")

    def frame_done(self, frame: int, record: dict[str, Any]) -> None:
        if self._frames is not None:
            self._frames.update(1)

    def warn(self, text: str) -> None:
        tqdm.write(f"warning: {text}", file=self._terminal)

    def finish(self, event: str, fields: dict[str, Any], lines: Sequence[str]) -> None:
        for bar in (self._stage, self._frames):
            if bar is not None:
                bar.close()
        for text in lines:
            (self._out if event == "done" else Stream(self._terminal)).line(text)


def describe(record: dict[str, Any]) -> str:
    """A frame's record in a few words."""
    if record.get("kept"):
        return "kept"
    error = record.get("estimated_error")
    return f"{sum(record['seconds'].values()):.2f} s" + ("" if error is None else f", estimated error {error:.1%}")


def make_listener(out: TextIO, *, as_json: bool) -> Listener:
    """The listener that suits where stdout (``out``) and stderr go."""
    if as_json:
        return JsonLines(out)
    return Bar(out, sys.stderr) if sys.stderr.isatty() else Plain(out, sys.stderr)


@contextmanager
def own_stdout(*, hush: bool = False) -> Iterator[TextIO]:
    """The real stdout as a text file; what others write to it goes to stderr meanwhile, or nowhere (``hush``).

    Both are turned: file descriptor 1, for C, and ``sys.stdout``, which need not write to it.
    """
    _flush()
    python, kept = sys.stdout, os.dup(1)
    real = python if python.fileno() != 1 else os.fdopen(os.dup(1), "w", encoding="utf-8", newline="\n")
    other = open(os.devnull, "w", encoding="utf-8") if hush else sys.stderr
    os.dup2(other.fileno(), 1)
    try:
        with redirect_stdout(other):
            yield real
    finally:
        with suppress(BrokenPipeError):  # the reader left while the last line was buffered
            real.flush()
        _flush()
        os.dup2(kept, 1)
        os.close(kept)
        for file in {real, other} - {python, sys.stderr}:
            with suppress(BrokenPipeError):
                file.close()


def _flush() -> None:
    """Empty Python's and C's buffers of stdout: Blender's lines wait in C's, and would come out much later."""
    with suppress(BrokenPipeError):
        sys.stdout.flush()
    ctypes.CDLL("ucrtbase" if os.name == "nt" else None).fflush(None)
