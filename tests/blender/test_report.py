# SPDX-License-Identifier: GPL-3.0-or-later
"""Reports of folders with real EXR maps: the pictures in the page, what is refused, and what is left alone."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError, Cancelled
from rtgi_addon.backend.settings import BakeSettings
from rtgi_addon.backend.stats import FrameStats
from rtgi_addon.cli import run
from rtgi_addon.exr import write_page
from rtgi_addon.output import BakeFolder, map_name
from rtgi_addon.report import report
from rtgi_addon.report_maps import FRAMES, PAGES, PICTURES
from rtgi_addon.report_pictures import SHOWN, SIDE
from rtgi_addon.terminal import Listener

SIZE = 16  # of a page, texels
TILE = re.compile(r'data-row="(\d+) (\w+)" title="([^"]*)"><img src="data:image/png;base64,([^"]+)"')

Light = Callable[[str, int, int], float]


def steady(kind: str, page: int, frame: int) -> float:
    return 1.0 + page


def bake_folder(
    folder: Path,
    *,
    frames: int = 1,
    pages: int = 1,
    kinds: tuple[str, ...] = ("iim", "aim"),
    light: Light = steady,
    size: int = SIZE,
    asked: int = 0,
    status: str = "done",
) -> Path:
    """A folder as ``rtgi bake`` leaves it. The left half of each page has texels, all with the irradiance ``light``."""
    header = {
        "format": 1,
        "versions": {"rtgi": "0.1.0"},
        "device": {"name": "A processor", "threads": 2},
        "settings": asdict(BakeSettings()),
        "first_frame": 1,
        "frames_asked": list(range(1, max(frames, asked) + 1)),
        "atlas": {"resolution": size, "pages": pages, "objects": [{"name": "Floor"}]},
        "setup_seconds": {},
        "warnings": [],
        "fingerprint": {},
    }
    baked = BakeFolder(folder, header)
    valid = np.zeros((size, size), bool)
    valid[:, : size // 2] = True
    for frame in range(1, frames + 1):
        names = []
        for kind in kinds:
            for page in range(pages):
                names.append(map_name(kind, page, frame))
                rgb = np.full((size, size, 3), light(kind, page, frame), np.float32)
                write_page(folder / names[-1], rgb, valid)
        stats = FrameStats(seconds={"links": 0.5}, links_traced=10, estimated_error=0.02)
        baked.commit(frame, {**asdict(stats), "state": "s", "files": names})
    baked.close(status)
    return folder


def pictures(page: Path, folder: Path) -> dict[tuple[int, str, str], np.ndarray]:
    """(height, width, 4) of every picture in ``page`` in [0, 1], by page, row and title; read by Blender."""
    found = {}
    for number, row, title, data in TILE.findall(page.read_text(encoding="utf-8")):
        file = folder / "picture.png"
        file.write_bytes(base64.b64decode(data))
        image = bpy.data.images.load(str(file), check_existing=False)
        image.alpha_mode = "CHANNEL_PACKED"
        width, height = image.size
        found[int(number), row, title] = np.array(image.pixels[:]).reshape(height, width, 4)
        bpy.data.images.remove(image)
        file.unlink()
    return found


def linear(srgb: np.ndarray) -> np.ndarray:
    return ((srgb + 0.055) / 1.055) ** 2.4


def test_pictures_show_the_maps_in_place_and_exposed_alike(tmp_path: Path) -> None:
    folder = bake_folder(tmp_path / "maps", frames=2, light=lambda kind, page, frame: 3.0 if kind == "aim" else 1.0)
    report(folder)
    found = pictures(folder / "report.html", tmp_path)
    assert {key[1] for key in found} == {"IIM", "AIM", "Change"}
    for frame in (1, 2):
        iim, aim = found[0, "IIM", f"iim.p0.000{frame}.exr"], found[0, "AIM", f"aim.p0.000{frame}.exr"]
        assert iim.shape == (SIZE, SIZE, 4)
        assert np.all(iim[:, : SIZE // 2, 3] == 1) and np.all(iim[:, SIZE // 2 :, 3] == 0)
        assert linear(iim[0, 0, :3]) == pytest.approx(SHOWN, abs=0.005)
        assert linear(aim[0, 0, :3]) == pytest.approx(1 - (1 - SHOWN) ** 3, abs=0.005)  # three times the light


def test_the_bottom_row_of_a_map_is_the_bottom_row_of_its_picture(tmp_path: Path) -> None:
    folder = bake_folder(tmp_path / "maps", kinds=("iim",))
    rgb = np.zeros((SIZE, SIZE, 3), np.float32)
    rgb[0, :] = (1, 0, 0)
    write_page(folder / "iim.p0.0001.exr", rgb, np.ones((SIZE, SIZE), bool))
    record = json.loads((folder / "bake.json").read_text())
    record["frames"]["1"]["files"]["iim.p0.0001.exr"] = (folder / "iim.p0.0001.exr").stat().st_size
    (folder / "bake.json").write_text(json.dumps(record))
    report(folder)
    (picture,) = pictures(folder / "report.html", tmp_path).values()
    assert np.all(picture[0, :, 0] > 0.5) and np.all(picture[1:, :, 0] == 0)  # Blender's row 0 is the bottom one
    assert not picture[..., 1].any()


def test_change_is_told_against_the_frame_before_though_that_is_not_shown(tmp_path: Path) -> None:
    folder = bake_folder(tmp_path / "maps", frames=40, kinds=("iim",), light=lambda k, p, frame: 2.0 - (frame == 40))
    report(folder)
    text = (folder / "report.html").read_text(encoding="utf-8")
    changes = {k[2]: v for k, v in pictures(folder / "report.html", tmp_path).items() if k[1] == "Change"}
    last = changes.pop("IIM of frame 40 less that of frame 39")
    assert last[0, 0, 2] > last[0, 0, 0] and last[0, 0, 3] == 1  # darker: blue
    assert len(changes) == FRAMES - 2  # the first has none before it
    assert all(c[0, 0, 3] < 0.5 for c in changes.values())
    assert text.count("no change") == FRAMES - 2
    assert "100 % of texels, up to 1<" in text
    assert f"{FRAMES} of 40 frames, evenly chosen" in text


@pytest.mark.parametrize(("frames", "pages", "kinds"), [(1, 1, 1), (1, 3, 3), (3, 2, 3), (30, 1, 3), (5, 14, 2)])
def test_long_bakes_and_many_pages_give_a_bounded_page(tmp_path: Path, frames: int, pages: int, kinds: int) -> None:
    folder = bake_folder(
        tmp_path / "maps", frames=frames, pages=pages, kinds=("iim", "aim", "caustics")[:kinds], size=4
    )
    summary = report(folder)
    found = pictures(summary.out, tmp_path)
    assert len(found) == summary.thumbnails <= PICTURES
    assert {key[0] for key in found} == set(range(min(pages, PAGES)))
    assert {key[1] for key in found} == {*("IIM", "AIM", "Caustics")[:kinds], *["Change"] * (frames > 1)}
    assert ("of 14 pages" in summary.out.read_text(encoding="utf-8")) == (pages == 14)


def test_large_pages_are_shrunk(tmp_path: Path) -> None:
    folder = bake_folder(tmp_path / "maps", kinds=("iim",), size=2 * SIDE + 6)
    report(folder)
    (picture,) = pictures(folder / "report.html", tmp_path).values()
    assert picture.shape[:2] == ((2 * SIDE + 6) // 3 + 1,) * 2
    assert "the mean of 3 × 3 texels" in (folder / "report.html").read_text(encoding="utf-8")


def test_black_maps_are_black(tmp_path: Path) -> None:
    folder = bake_folder(tmp_path / "maps", frames=2, light=lambda *_: 0.0)
    report(folder)
    for (_, row, _), picture in pictures(folder / "report.html", tmp_path).items():
        assert row == "Change" or not picture[..., :3].any()


@pytest.mark.parametrize("status", ["cancelled", "failed", "running"])
def test_bakes_cut_short_are_shown_as_far_as_they_came(tmp_path: Path, status: str) -> None:
    for name, frames in (("none", 0), ("some", 2)):
        folder = bake_folder(tmp_path / name, frames=frames, asked=4, status=status)
        assert report(folder).frames == frames
        text = (folder / "report.html").read_text(encoding="utf-8")
        assert ("2 of 4 frames" if frames else "No frame is finished, of 4 asked for") in text
        assert len(TILE.findall(text)) == (2 * frames + 1 if frames else 0)


def test_the_command_writes_one_file_and_says_where(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = bake_folder(tmp_path / "maps", frames=2)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert run(["report", str(folder)]) == 0
    assert capfd.readouterr().out.startswith(f"{folder / 'report.html'}: 2 frames, ")
    first = (folder / "report.html").read_bytes()
    assert {path: path.read_bytes() for path in folder.iterdir() if path.suffix != ".html"} == before
    assert run(["report", str(folder), "--out", str(tmp_path / "a" / "b.html"), "--json"]) == 0
    events = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert events[0]["stage"] == "maps"
    assert (events[-1]["event"], events[-1]["out"]) == ("done", str(tmp_path / "a" / "b.html"))
    assert (tmp_path / "a" / "b.html").read_bytes() == first  # the same bake, the same page
    assert events[-1]["bytes"] == len(first)


def test_a_real_bake_is_reported(tmp_path: Path, add_cube: Callable[..., bpy.types.Object]) -> None:
    room = add_cube("Room", size=4.0)
    room.data.flip_normals()
    block = add_cube("Block", location=(0.5, 0.0, -1.0))
    for frame in (1, 2):
        block.location.x = 0.5 * frame
        block.keyframe_insert("location", frame=frame)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.location, lamp.data.energy = (0, 0, 1.5), 100
    bpy.context.scene.collection.objects.link(lamp)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    maps = tmp_path / "maps"
    flags = ("--frames", "1-2", "--resolution", "48", "--quality", "draft")
    assert run(["bake", str(tmp_path / "room.blend"), "--out", str(maps), *flags]) == 0
    summary = report(maps)
    text = summary.out.read_text(encoding="utf-8")
    assert summary.frames == 2
    assert "resolution 48, quality draft" in text and "2 objects" in text
    assert all(f"<b>{title}</b>" in text for title in ("Time by stage", "Estimated error", "Rays", "Links", "Texels"))
    found = pictures(summary.out, tmp_path)
    assert {key[1] for key in found} == {"IIM", "AIM", "Change"}
    assert found[0, "IIM", "iim.p0.0001.exr"][..., :3].max() > 0.5
    (change,) = [picture for key, picture in found.items() if key[1] == "Change"]
    assert change[..., 3].max() > 0.9  # the block moved, and took its shadow along


def test_the_open_scene_stays_as_it_is(tmp_path: Path, add_cube: Callable[..., bpy.types.Object]) -> None:
    add_cube()
    folder = bake_folder(tmp_path / "maps")
    before = {name: [block.name for block in getattr(bpy.data, name)] for name in ("images", "objects", "scenes")}
    report(folder)
    assert {name: [block.name for block in getattr(bpy.data, name)] for name in before} == before


def refused(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The only problem line of a report that must end with exit code 2."""
    capfd.readouterr()
    assert run(["report", *map(str, arguments)]) == 2
    said = capfd.readouterr()
    assert said.out == ""
    (line,) = [line.removeprefix("error: ") for line in said.err.splitlines() if line.startswith("error: ")]
    return line


def test_what_cannot_be_reported_is_one_line_and_writes_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert refused(capfd, tmp_path / "none").startswith(f"{tmp_path / 'none'}: does not exist; ")
    assert "holds no bake.json" in refused(capfd, tmp_path)
    folder = bake_folder(tmp_path / "maps", frames=2)
    assert "is a folder" in refused(capfd, folder, "--out", tmp_path)
    assert "/proc" in refused(capfd, folder, "--out", "/proc/none/page.html")
    (folder / "aim.p0.0002.exr").rename(tmp_path / "moved.exr")
    assert "aim.p0.0002.exr: is missing" in refused(capfd, folder)
    (tmp_path / "moved.exr").rename(folder / "aim.p0.0002.exr")
    (folder / "aim.p0.0002.exr").write_bytes(bytes((folder / "aim.p0.0002.exr").stat().st_size))
    assert "aim.p0.0002.exr: " in (line := refused(capfd, folder)) and "bake that frame again" in line
    (folder / "bake.json").write_text("{")
    assert f"{folder / 'bake.json'}: cannot be read" in refused(capfd, folder)
    assert not list(tmp_path.rglob("*.html")) and not list(tmp_path.rglob("*.part"))


def test_a_report_can_be_cancelled_and_the_old_page_stays(tmp_path: Path) -> None:
    folder = bake_folder(tmp_path / "maps")
    (folder / "report.html").write_text("old")
    listener = Listener()
    listener.cancelled = True
    with pytest.raises(Cancelled):
        report(folder, listener=listener)
    assert (folder / "report.html").read_text() == "old"


def test_a_map_of_another_size_is_not_compared(tmp_path: Path) -> None:
    folder = bake_folder(tmp_path / "maps", frames=2, kinds=("iim",))
    path = folder / "iim.p0.0001.exr"
    write_page(path, np.ones((8, 8, 3), np.float32), np.ones((8, 8), bool))
    record = json.loads((folder / "bake.json").read_text())
    record["frames"]["1"]["files"][path.name] = path.stat().st_size
    (folder / "bake.json").write_text(json.dumps(record))
    with pytest.raises(BakeError, match="iim.p0.0001.exr"):
        report(folder)
