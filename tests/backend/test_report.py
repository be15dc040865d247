# SPDX-License-Identifier: GPL-3.0-or-later
"""Reports without Blender: what is read of bake.json, the geometry of charts, colours of pictures, and the page."""

from __future__ import annotations

import json
import re
import struct
import xml.etree.ElementTree as ElementTree
import zlib
from dataclasses import asdict
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.settings import BakeSettings
from rtgi_addon.backend.stats import FrameStats
from rtgi_addon.report_charts import BOTTOM, HEIGHT, LEFT, NARROW, RIGHT, TOP, Chart, Series, draw, scale_of
from rtgi_addon.report_figures import duration, whole
from rtgi_addon.report_maps import PAGES, PICTURES, columns, spread
from rtgi_addon.report_page import make_page, name_frames
from rtgi_addon.report_pictures import (
    EXPOSED,
    SHOWN,
    SIDE,
    Small,
    change_colours,
    develop,
    exposure,
    largest_change,
    png,
    shrink,
)
from rtgi_addon.report_record import NAMED, read_bake

SVG = {"s": "http://www.w3.org/2000/svg"}
VOID = {"meta", "img", "br", "link", "hr", "input"}


def a_frame(folder: Path, number: int, **values: Any) -> dict[str, Any]:
    """The record of a frame whose one map is in ``folder``."""
    name = f"iim.p0.{number:04d}.exr"
    (folder / name).write_bytes(b"map")
    stats = FrameStats(seconds={"direct": 0.25, "links": 0.5}, rays=100, texels_updated=60, texels_kept=40)
    return {**asdict(stats), "estimated_error": 0.02, "state": "s", "files": {name: 3}, **values}


def a_bake(folder: Path, count: int = 3, **values: Any) -> dict[str, Any]:
    """A bake.json in ``folder``."""
    record = {
        "format": 1,
        "versions": {"rtgi": "0.1.0", "blender": "5.0.1"},
        "device": {"kind": "cpu", "name": "A processor", "threads": 2, "system": "Linux"},
        "settings": asdict(BakeSettings(resolution=64)),
        "first_frame": 1,
        "frames_asked": list(range(1, count + 1)),
        "atlas": {"resolution": 64, "pages": 1, "objects": [{"name": "Floor"}, {"name": "Floor"}, {"name": "Wall"}]},
        "setup_seconds": {"open": 1.0},
        "warnings": [],
        "fingerprint": {},
        "status": "done",
        "frames": {str(n): a_frame(folder, n) for n in range(1, count + 1)},
        **values,
    }
    (folder / "bake.json").write_text(json.dumps(record))
    return record


class Tags(HTMLParser):
    """Checks that tags close in order; collects every attribute that could fetch something, and the text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.text = ""
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data


def page_of(folder: Path) -> Tags:
    return Tags(make_page(read_bake(folder), None))


# What is read


def test_a_record_comes_back_with_frames_in_order(tmp_path: Path) -> None:
    frames = {str(n): a_frame(tmp_path, n) for n in (10, 2, 1)}
    a_bake(tmp_path, frames=frames, frames_asked=[1, 2, 10, 11])
    baked = read_bake(tmp_path)
    assert [frame.number for frame in baked.frames] == [1, 2, 10]
    assert baked.frames[0].total_seconds == 0.75
    assert baked.frames[0].counts["texels_kept"] == 40
    assert baked.object_count == 2  # two sides of one object are one object


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": 99}', '{"format": 1}'])
def test_a_broken_record_is_named_with_a_remedy(tmp_path: Path, content: str) -> None:
    (tmp_path / "bake.json").write_text(content)
    with pytest.raises(BakeError) as refused:
        read_bake(tmp_path)
    (problem,) = refused.value.problems
    assert problem.startswith(str(tmp_path / "bake.json"))
    assert problem.endswith("bake the scene again")


@pytest.mark.parametrize("key", ["status", "versions", "device", "settings", "frames_asked", "atlas", "frames"])
def test_every_part_of_a_record_is_needed_and_of_its_kind(tmp_path: Path, key: str) -> None:
    record = a_bake(tmp_path)
    for broken in ({k: v for k, v in record.items() if k != key}, {**record, key: None} if key != "status" else {}):
        (tmp_path / "bake.json").write_text(json.dumps(broken))
        with pytest.raises(BakeError, match=r"bake\.json"):
            read_bake(tmp_path)


def test_no_folder_a_file_and_a_folder_without_a_bake(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder, said in ((tmp_path / "none", "not exist"), (tmp_path / "file", "is a file"), (tmp_path, "no bake")):
        with pytest.raises(BakeError, match=said) as refused:
            read_bake(folder)
        assert str(folder) in refused.value.problems[0]


def test_missing_and_changed_maps_are_named_and_many_are_counted(tmp_path: Path) -> None:
    a_bake(tmp_path, 9)
    (tmp_path / "iim.p0.0002.exr").unlink()
    (tmp_path / "iim.p0.0003.exr").write_bytes(b"cut")
    (tmp_path / "iim.p0.0003.exr").write_bytes(b"cu")
    with pytest.raises(BakeError) as refused:
        read_bake(tmp_path)
    missing, changed = refused.value.problems
    assert "iim.p0.0002.exr: is missing" in missing and "--resume" in missing
    assert "iim.p0.0003.exr" in changed and "--resume" in changed
    for path in tmp_path.glob("*.exr"):
        path.unlink()
    with pytest.raises(BakeError) as refused:
        read_bake(tmp_path)
    assert len(refused.value.problems) == NAMED + 1
    assert f"{9 - NAMED} more" in refused.value.problems[-1]


# Charts


def drawn(**values: Any) -> ElementTree.Element:
    """The figure of a chart, as XML."""
    figure = draw(Chart("Title", "unit", tell=whole, **values))
    return ElementTree.fromstring(figure.replace("<svg ", f'<svg xmlns="{SVG["s"]}" '))


def boxes(figure: ElementTree.Element, colour: str) -> list[tuple[float, float, float, float]]:
    """(x, bottom, height, width) of each bar of one colour."""
    (path,) = figure.findall(f".//s:path[@class='{colour}']", SVG)
    found = re.findall(r"M([\d.]+) ([\d.]+)v-([\d.]+)h([\d.]+)v[\d.]+z", path.get("d", ""))
    assert "".join(f"M{x} {y}v-{h}h{w}v{h}z" for x, y, h, w in found) == path.get("d")
    return [tuple(map(float, box)) for box in found]  # type: ignore[misc]


def test_bars_stand_on_each_other_and_are_as_high_as_their_numbers() -> None:
    low, high = Series("low", (4.0, 0.0, 2.0), "c0"), Series("high", (6.0, 8.0, None), "c1")
    figure = drawn(frames=(1, 2, 3), bars=(low, high))
    ground = {tick.text: float(tick.get("y", 0)) - 4 for tick in figure.findall(".//s:text[@text-anchor='end']", SVG)}
    unit = (ground["0"] - ground["10"]) / 10
    below, above = boxes(figure, "c0"), boxes(figure, "c1")
    assert [box[2] for box in below] == pytest.approx([4 * unit, 2 * unit], abs=0.01)
    assert [box[2] for box in above] == pytest.approx([6 * unit, 8 * unit], abs=0.01)
    assert [box[1] for box in below] == pytest.approx([ground["0"]] * 2, abs=0.05)
    assert [box[1] for box in above] == pytest.approx([ground["0"] - 4 * unit, ground["0"]], abs=0.05)
    assert below[0][0] == above[0][0]


@given(st.lists(st.just(0.0) | st.floats(1e-9, 1e9), min_size=1, max_size=400))
def test_all_that_is_drawn_lies_inside_and_is_told(values: list[float]) -> None:
    count = len(values)
    series, line = Series("bars", tuple(values), "c0"), Series("line", tuple(values), "c1")
    figure = drawn(frames=tuple(range(count)), bars=(series,), lines=(line,))
    for x, bottom, height, width in boxes(figure, "c0"):
        assert LEFT - 0.01 <= x and x + width <= NARROW - RIGHT + 0.02
        assert 0 <= bottom - height + 0.02 and bottom <= HEIGHT
    told = [output.get("data-told", "").split("|") for output in figure.iter("output")]
    assert told == [[whole(v) for v in values]] * 2


def test_a_first_frame_that_would_flatten_the_rest_is_cut_and_told() -> None:
    low = Series("low", (30.0, *[1.0] * 9), "c0")
    figure = drawn(frames=tuple(range(10)), bars=(low, Series("high", (900.0, *[1.0] * 9), "c1")))
    plot = HEIGHT - TOP - BOTTOM
    assert [box[2] for box in boxes(figure, "c0")] == pytest.approx([plot * 30 / 930, *[plot / 2] * 9], abs=0.01)
    assert [box[2] for box in boxes(figure, "c1")] == pytest.approx([plot * 900 / 930, *[plot / 2] * 9], abs=0.01)
    told = [text.text for text in figure.findall(".//s:text", SVG) if "↑" in (text.text or "")]
    assert told == ["↑ 930"]
    several = drawn(frames=tuple(range(10)), bars=(Series("a door opens", (*[1.0] * 6, *[9.0] * 4), "c0"),))
    assert "↑" not in "".join(several.itertext())


@given(st.floats(1e-9, 1e12))
def test_axes_hold_their_values_in_few_round_steps(highest: float) -> None:
    top, step = scale_of(highest)
    assert top >= highest * (1 - 1e-9)
    assert top - step < highest
    assert 1 <= round(top / step) <= 5
    assert f"{step:.0e}"[0] in "125"


def test_a_line_breaks_where_a_frame_has_no_value() -> None:
    figure = drawn(frames=(1, 2, 3, 4), lines=(Series("error", (1.0, None, 2.0, 3.0), "c5"),), level=("asked for", 5.0))
    (line,) = figure.findall(".//s:path[@class='line c5']", SVG)
    assert re.sub(r"[\d. ]", "", line.get("d", "")) == "MhMhLh"
    assert len(figure.findall(".//s:path[@class='level']", SVG)) == 1


# Pictures


@given(st.integers(1, 3 * SIDE), st.integers(1, 600), st.integers(0, 2**32 - 1))
def test_shrinking_keeps_the_sum_of_what_is_valid(height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    valid = rng.random((height, width)) < 0.5
    values = np.where(valid[..., None], 3.0, np.nan).astype(np.float32)  # what is not valid has no say
    small = shrink(values, valid)
    assert max(small.valid.shape) <= SIDE
    assert np.all(small.values[small.valid] == 3)
    assert np.all(small.values[~small.valid] == 0)
    assert small.valid.any() == valid.any()


def test_small_pages_stay_as_they_are() -> None:
    values = np.random.default_rng(1).random((SIDE, 7, 3), np.float32)
    assert np.array_equal(shrink(values, np.ones((SIDE, 7), bool)).values, values)


def test_one_exposure_shows_most_of_the_light_and_never_clips() -> None:
    rng = np.random.default_rng(2)
    values = np.repeat(rng.lognormal(3, 2, (64, 64, 1)), 3, axis=2).astype(np.float32)
    exposed = exposure([Small(values, np.ones((64, 64), bool))])
    level = np.quantile(values[..., 0], EXPOSED)
    shown = ((develop(level, exposed) + 0.055) / 1.055) ** 2.4
    assert shown == pytest.approx(SHOWN, rel=1e-3)
    light = np.linspace(0, 3 * level, 500)
    assert np.all(np.diff(develop(light, exposed)) > 0)
    assert develop(np.array([-1.0]), exposed) == 0
    assert develop(light, exposed).max() < 1


def test_black_and_empty_maps_have_an_exposure_too() -> None:
    black = Small(np.zeros((4, 4, 3), np.float32), np.ones((4, 4), bool))
    assert exposure([black]) == exposure([]) == largest_change([black]) == largest_change([]) == 0
    assert not develop(black.values, 0.0).any()


def test_more_light_is_warm_less_is_cold_and_none_is_faint_grey() -> None:
    less, none, more, beyond = change_colours(np.array([[-2.0], [0.0], [2.0], [9.0]]), 2.0)
    assert less[2] > less[0] and more[0] > more[2]
    assert none[0] == none[1] == none[2] and none[3] < 0.5
    assert less[3] == more[3] == 1
    assert np.array_equal(more, beyond)
    assert np.array_equal(change_colours(np.zeros((1, 1)), 0.0)[0], none)


def test_png_files_hold_the_pixels_top_row_first() -> None:
    rgba = np.random.default_rng(3).integers(0, 256, (5, 9, 4), dtype=np.uint8)
    file = png(rgba)
    assert file.startswith(b"\x89PNG\r\n\x1a\n")
    chunks, at = {}, 8
    while at < len(file):
        size, kind = struct.unpack_from(">I4s", file, at)
        data = file[at + 8 : at + 8 + size]
        assert struct.unpack_from(">I", file, at + 8 + size)[0] == zlib.crc32(kind + data)
        chunks[kind], at = data, at + 12 + size
    assert struct.unpack(">IIBBBBB", chunks[b"IHDR"]) == (9, 5, 8, 6, 0, 0, 0)
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(5, 1 + 9 * 4)
    assert np.all(rows[:, 0] == 2)
    pixels = np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8).reshape(5, 9, 4)
    assert np.array_equal(pixels, rgba[::-1])


@given(st.integers(1, 5000), st.integers(2, 50))
def test_frames_are_chosen_evenly_from_first_to_last(count: int, room: int) -> None:
    chosen = spread(count, room)
    assert len(chosen) == len(set(chosen)) == min(count, room)
    assert (chosen[0], chosen[-1]) == (0, count - 1)
    gaps = np.diff(chosen)
    assert gaps.size == 0 or gaps.max() - gaps.min() <= 1


@given(st.integers(1, 1000), st.integers(2, 4))
def test_pictures_are_bounded_whatever_is_baked(pages: int, rows: int) -> None:
    shown = columns(pages, rows)
    assert shown >= 2
    assert shown * min(pages, PAGES) * rows <= PICTURES


# The page


def test_the_page_is_well_formed_and_fetches_nothing(tmp_path: Path) -> None:
    a_bake(tmp_path, frames={}, status="failed")
    page = page_of(tmp_path)
    assert all(source.startswith("data:") or not source for source in page.sources)
    assert "No frame is finished, of 3 asked for." in page.text
    assert "The bake failed" in page.text


def test_what_people_named_is_text_and_never_markup(tmp_path: Path) -> None:
    folder = tmp_path / "<b>$title&amp;"
    folder.mkdir()
    a_bake(folder, warnings=['<script>alert("1")</script>'], settings={"new": "<i>"}, status="<u>")
    page = page_of(folder)
    for text in ("<b>$title&amp;", '<script>alert("1")</script>', "new <i>", "ended as: <u>"):
        assert text in page.text


@pytest.mark.parametrize(
    ("status", "said"),
    [("cancelled", "was cancelled"), ("failed", "failed"), ("running", "still running, or was killed")],
)
def test_a_bake_cut_short_says_so(tmp_path: Path, status: str, said: str) -> None:
    a_bake(tmp_path, frames_asked=[1, 2, 3, 4], status=status)
    text = page_of(tmp_path).text
    assert "3 of 4 frames" in text
    assert said in text and "--resume" in text


def test_each_warning_is_told_once_with_its_frames(tmp_path: Path) -> None:
    frames = {str(n): a_frame(tmp_path, n, warnings=["Lamp: too small"] if n != 3 else []) for n in range(1, 6)}
    a_bake(tmp_path, frames=frames, warnings=["Floor: no UVs"])
    text = page_of(tmp_path).text
    assert text.count("Lamp: too small") == text.count("Floor: no UVs") == 1
    assert "frames 1–2, 4–5" in text


def test_settings_that_were_chosen_stand_first(tmp_path: Path) -> None:
    a_bake(tmp_path, settings={**asdict(BakeSettings(resolution=64, denoise=False)), "of another version": 7})
    text = page_of(tmp_path).text
    chosen, others = text.split("the others, as by default")
    for words in ("resolution 64", "denoise off", "of another version 7"):
        assert words in chosen and words not in others
    assert "target error none" in others


def test_frame_numbers_in_words() -> None:
    assert name_frames([7]) == "7"
    assert name_frames([7, 8]) == "7–8"
    assert name_frames(range(1, 25)) == "1–24"
    assert name_frames(range(1, 25, 2)) == "1–23 in steps of 2"
    assert name_frames([1, 2, 3, 7, 9, 10]) == "1–3, 7, 9–10"
    assert name_frames([]) == ""


def test_durations_in_words() -> None:
    told = [duration(s) for s in (0, 0.0012, 0.0994, 0.0996, 0.25, 9.996, 59.94, 59.96, 3599.4, 3599.6, 7500)]
    assert told == [
        "0 ms", "1.2 ms", "99 ms", "0.0996 s", "0.25 s", "10 s", "59.9 s", "1 min 00 s", "59 min 59 s", "1 h 00 min",
        "2 h 05 min",
    ]  # fmt: skip
