# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake says: JSON lines, plain lines, the bar, and a stdout that stays clean."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

from rtgi_addon.backend.errors import Cancelled
from rtgi_addon.terminal import Bar, JsonLines, Listener, Plain, describe

ROOT = Path(__file__).parents[2]
RECORD: dict[str, Any] = {"seconds": {"gather": 0.5, "write": 0.25}, "estimated_error": 0.031}


def bake_with(listener: Listener) -> None:
    """The calls that a bake of two frames makes."""
    listener.report("extract", 0, 2)
    listener.report("extract", 2, 2)
    listener.warn("Cube: two faces overlap")
    for index, frame in enumerate((5, 7)):
        listener.frame_begins(frame, index, 2)
        for done in range(1001):
            listener.report("gather", done, 1000)
        listener.frame_done(frame, RECORD)
    listener.finish("done", {"frames": 2}, ["2 frames"])


def run_python(code: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=ROOT, capture_output=True, text=True, timeout=60, **options
    )


def test_each_json_line_is_an_object_and_the_last_says_how_it_ended() -> None:
    out = io.StringIO()
    bake_with(JsonLines(out, clock=lambda: 0.0))
    events = [json.loads(line) for line in out.getvalue().splitlines()]
    assert {e["event"] for e in events} == {"progress", "warning", "frame_begins", "frame", "done"}
    assert events[-1] == {"event": "done", "frames": 2, "lines": ["2 frames"]}
    assert {"event": "frame", "frame": 7, **RECORD} in events
    gather = [(e["frame"], e["done"]) for e in events if e.get("stage") == "gather"]
    assert gather == [(5, 0), (5, 1000), (7, 0), (7, 1000)]  # a clock that stands still lets only the ends pass


def test_json_progress_is_thinned_by_time_alone() -> None:
    out, now = io.StringIO(), iter(i * 0.04 for i in range(100))
    lines = JsonLines(out, clock=lambda: next(now))
    for done in range(11):
        lines.report("gather", done, 100)
    assert [json.loads(text)["done"] for text in out.getvalue().splitlines()] == [0, 3, 6, 9]


def test_plain_lines_keep_stdout_for_the_summary() -> None:
    out, log = io.StringIO(), io.StringIO()
    bake_with(Plain(out, log))
    assert out.getvalue() == "2 frames\n"
    assert log.getvalue().splitlines() == [
        "extract",
        "warning: Cube: two faces overlap",
        "frame 5 (1/2): 0.75 s, estimated error 3.1%",
        "frame 7 (2/2): 0.75 s, estimated error 3.1%",
    ]


def test_the_bar_shows_stage_and_counts_and_leaves_the_summary() -> None:
    out, terminal = io.StringIO(), io.StringIO()
    bake_with(Bar(out, terminal))
    assert out.getvalue() == "2 frames\n"
    drawn = terminal.getvalue()
    for text in ("extract", "gather", "1000/1000", "frame 5", "frame 7", "2/2", "warning: Cube: two faces overlap"):
        assert text in drawn


def test_a_refusal_is_not_on_stdout() -> None:
    out, log = io.StringIO(), io.StringIO()
    Plain(out, log).finish("refused", {"problems": ["a"]}, ["error: a"])
    assert (out.getvalue(), log.getvalue()) == ("", "error: a\n")


@pytest.mark.parametrize("make", [lambda: JsonLines(io.StringIO()), lambda: Plain(io.StringIO(), io.StringIO())])
def test_a_cancelled_listener_stops_the_work_at_its_next_report(make: Any) -> None:
    listener = make()
    listener.report("gather", 0, 2)
    listener.cancelled = True
    with pytest.raises(Cancelled):
        listener.report("gather", 1, 2)


def test_a_kept_frame_says_so() -> None:
    assert describe({**RECORD, "kept": True}) == "kept"
    assert describe({"seconds": {"gather": 2.0}, "estimated_error": None}) == "2.00 s"


def test_what_c_code_and_children_print_never_reaches_our_stdout() -> None:
    done = run_python("""
        import ctypes, os, subprocess, sys
        from rtgi_addon.terminal import own_stdout
        print("before")
        with own_stdout() as out:
            os.write(1, b"from C\\n")
            ctypes.CDLL(None).puts(b"from C, buffered")
            print("from Python")
            subprocess.run(["echo", "from a child"])
            out.write("ours\\n")
        print("after")
    """)
    assert done.stdout == "before\nours\nafter\n"
    assert set(done.stderr.splitlines()) == {"from C", "from C, buffered", "from Python", "from a child"}


def test_hushed_chatter_goes_nowhere() -> None:
    done = run_python("""
        import os
        from rtgi_addon.terminal import own_stdout
        with own_stdout(hush=True) as out:
            os.write(1, b"from C\\n")
            out.write("ours\\n")
    """)
    assert (done.stdout, done.stderr) == ("ours\n", "")


def test_a_reader_that_leaves_ends_the_talk_and_not_the_work(tmp_path: Path) -> None:
    code = f"""
        import pathlib
        from rtgi_addon.terminal import JsonLines, own_stdout
        with own_stdout() as out:
            lines = JsonLines(out)
            for frame in range(20000):
                lines.frame_begins(frame, frame, 20000)
            lines.finish("done", {{}}, [])
        pathlib.Path({str(tmp_path / "done")!r}).touch()
    """
    script = tmp_path / "talk.py"
    script.write_text(textwrap.dedent(code))
    shell = f"PYTHONPATH={ROOT} {sys.executable} {script} | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["frame"] == 0
    assert (tmp_path / "done").exists()
