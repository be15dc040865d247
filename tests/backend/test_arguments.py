# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line's arguments: one owner for the settings, and one clear line for each mistake."""

from __future__ import annotations

import dataclasses
from enum import Enum
from pathlib import Path
from typing import get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtgi_addon.arguments import LAST_FRAME, frames_of, make_parser, path_of, settings_of, size_of
from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.settings import BakeSettings

FIELDS = {f.name: f for f in dataclasses.fields(BakeSettings)}
HINTS = get_type_hints(BakeSettings)


def settings(*arguments: str) -> BakeSettings:
    return settings_of(make_parser().parse_args(["bake", "room.blend", *arguments]))


def test_without_options_the_settings_are_the_table_s_defaults() -> None:
    assert settings() == BakeSettings()


@pytest.mark.parametrize("name", FIELDS)
def test_each_setting_has_an_option_that_changes_it_alone(name: str) -> None:
    field, flag = FIELDS[name], name.replace("_", "-")
    if HINTS[name] is bool:
        changed = settings(f"--no-{flag}" if field.default else f"--{flag}")
        expected: object = not field.default
    elif isinstance(HINTS[name], type) and issubclass(HINTS[name], Enum):
        expected = list(HINTS[name])[-1]
        changed = settings(f"--{flag}", str(expected))
    else:
        expected = field.metadata["high"]
        changed = settings(f"--{flag}", repr(expected))
    assert expected != field.default
    assert changed == dataclasses.replace(BakeSettings(), **{name: expected})
    assert type(getattr(changed, name)) is type(expected) or expected == getattr(changed, name)


@pytest.mark.parametrize("name", [n for n, f in FIELDS.items() if f.metadata["low"] is not None])
def test_values_past_either_end_are_one_line_that_names_option_and_range(name: str) -> None:
    low, high, flag = FIELDS[name].metadata["low"], FIELDS[name].metadata["high"], "--" + name.replace("_", "-")
    for value in (low - 1, high + 1):
        with pytest.raises(BakeError) as refused:
            settings(f"{flag}={value}")
        (problem,) = refused.value.problems
        assert problem.startswith(f"{flag} {value}")
        assert f"[{low}, {high}]" in problem


def test_every_value_out_of_range_is_told_at_once() -> None:
    with pytest.raises(BakeError) as refused:
        settings("--resolution", "8", "--photons", "0", "--target-error", "nan")
    assert [p.split()[0] for p in refused.value.problems] == ["--resolution", "--target-error", "--photons"]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["bake", "a.blend", "--quality", "best"],
        ["bake", "a.blend", "--gather", "lightcuts"],
        ["bake", "a.blend", "--device", "fpga"],
        ["bake", "a.blend", "--no-selective", "--selection", "swept"],
        ["bake", "a.blend", "--resolution", "1k"],
        ["bake", "a.blend", "--resolution", "64", "--density", "10"],
        ["bake", "a.blend", "--quality", "final", "--target-error", "0.02"],
        ["bake", "a.blend", "b.blend"],
        ["bake", "a.blend", "--res", "64"],  # no abbreviations: a later option could change their meaning
        ["paint", "a.blend"],
        ["render", "a.blend"],
        ["render", "a.blend", "--maps", "out", "--samples", "many"],
        ["report"],
        ["report", "out", "other"],
        ["report", "out", "--frames", "1-3"],
    ],
)
def test_usage_errors_are_one_line_with_a_remedy(arguments: list[str]) -> None:
    with pytest.raises(BakeError) as refused:
        make_parser().parse_args(arguments)
    (problem,) = refused.value.problems
    assert "\n" not in problem
    assert "--help" in problem


def test_a_report_wants_a_folder_and_takes_a_file() -> None:
    arguments = make_parser().parse_args(["report", "maps", "--out", "page.html", "--json"])
    assert (arguments.command, arguments.maps, arguments.out, arguments.json) == ("report", "maps", "page.html", True)
    assert make_parser().parse_args(["report", "maps"]).out is None


def test_help_names_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        make_parser().parse_args(["bake", "--help"])
    assert left.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for name, field in FIELDS.items():
        assert name.replace("_", "-") in text
        assert field.metadata["help"] in text


@given(st.integers(0, 9999), st.integers(0, 500), st.integers(1, 60))
def test_ranges_hold_the_first_frame_then_every_step_up_to_the_last(first: int, length: int, step: int) -> None:
    frames = frames_of(f"{first}-{first + length}:{step}")
    assert frames is not None
    assert list(frames) == [f for f in range(first, first + length + 1) if (f - first) % step == 0]
    assert frames_of(f"{first}-{first + length}") == range(first, first + length + 1)
    assert list(frames_of(str(first)) or ()) == [first]


@pytest.mark.parametrize(
    "text", ["", "a-b", "1..5", "1-", "5-1", "1-5:0", "1-5:-1", "-3", "-3-5", "1.5", "1,2", f"0-{LAST_FRAME + 1}"]
)
def test_frames_that_make_no_sense_are_one_line(text: str) -> None:
    with pytest.raises(BakeError) as refused:
        frames_of(text)
    (problem,) = refused.value.problems
    assert problem.startswith(f"--frames {text}: ")


def test_a_huge_range_costs_nothing_to_name() -> None:
    assert len(frames_of(f"0-{LAST_FRAME}") or ()) == LAST_FRAME + 1


def test_picture_sizes() -> None:
    assert size_of("1280x720") == (1280, 720)
    assert size_of(None) is None
    for text in ("1280", "0x100", "100x99999", "axb", "-4x4"):
        with pytest.raises(BakeError, match="--resolution"):
            size_of(text)


def test_paths_are_taken_from_the_shell_s_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert path_of("maps") == tmp_path / "maps"
    assert path_of("/abs/maps") == Path("/abs/maps")
    assert path_of(None) is None
