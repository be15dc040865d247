# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole bakes of a small room with a moving block: the files and records they leave, again and interrupted."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.progress import silent
from rtgi_addon.backend.scene import FrameState, Light, LightKind
from rtgi_addon.backend.settings import BakeSettings, Quality
from rtgi_addon.bake import bake
from rtgi_addon.cli import run
from rtgi_addon.exr import read_page
from rtgi_addon.frames import SIDES_TESTED, telling_states
from rtgi_addon.job import BakeJob
from rtgi_addon.output import map_name

ROOT = Path(__file__).parents[2]
FRAMES = range(1, 4)
FLAGS = ("--resolution", "48", "--quality", "draft", "--frames", "1-3")
FLOOR_M, BLOCK_M, STEP_M = 4.0, 1.0, 0.5


def make_scene(add_plane: Callable[..., bpy.types.Object], add_cube: Callable[..., bpy.types.Object]) -> None:
    """A floor, a wall, a block that slides along x by STEP_M a frame, and a lamp."""
    add_plane("Floor", size=FLOOR_M)
    wall = add_plane("Wall", size=FLOOR_M, location=(0, 2, 2))
    wall.rotation_euler.x = np.pi / 2
    block = add_cube("Block", size=BLOCK_M, location=(-1, 0, 0.75))
    for frame in FRAMES:
        block.location.x = -1 + STEP_M * (frame - 1)
        block.keyframe_insert("location", frame=frame)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.location = (0, -1, 3)
    lamp.data.energy = 200
    bpy.context.scene.collection.objects.link(lamp)
    bpy.context.scene.frame_set(2)


@pytest.fixture
def scene_file(
    tmp_path: Path, add_plane: Callable[..., bpy.types.Object], add_cube: Callable[..., bpy.types.Object]
) -> Path:
    make_scene(add_plane, add_cube)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    return tmp_path / "room.blend"


@pytest.fixture
def start(scene_file: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """``start(out, *flags)``: a bake in a process of its own, as from a shell."""
    running: list[subprocess.Popen[str]] = []

    def begin(out: Path, *flags: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "rtgi_addon", "bake", str(scene_file), "--out", str(out), *FLAGS, *flags]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        running.append(
            subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                text=True, cwd=out.parent,
            )
        )  # fmt: skip
        return running[-1]

    yield begin
    for process in running:
        if process.poll() is None:
            process.kill()
        process.communicate()


def maps_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.exr"))}


def record_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "bake.json").read_text())


def bake_to(out: Path, scene: Path, *flags: str) -> int:
    return run(["bake", str(scene), "--out", str(out), *FLAGS, *flags])


def test_a_bake_leaves_what_the_contract_lists(scene_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    assert bake_to(out, scene_file, "--texels") == 0
    names = {map_name(kind, 0, frame) for kind in ("iim", "aim") for frame in FRAMES}
    assert {path.name for path in out.iterdir()} - {p.name for p in out.glob("caustics.*")} == {
        *names, "bake.json", "texels.npz",
    }  # fmt: skip
    record = record_of(out)
    assert record["status"] == "done"
    assert record["settings"]["resolution"] == 48
    assert record["settings"]["quality"] == "draft"
    assert record["versions"]["blender"] == bpy.app.version_string
    assert {"rtgi", "python", "numpy", "embreex"} <= set(record["versions"])
    assert record["device"]["kind"] == "cpu"
    assert [o["name"] for o in record["atlas"]["objects"] if o["side"] == "front"] == ["Floor", "Wall", "Block"]
    assert list(record["frames"]) == ["1", "2", "3"]
    for frame, entry in record["frames"].items():
        assert all(seconds >= 0 for seconds in entry["seconds"].values())
        assert entry["rays"] > 0
        assert entry["texels_updated"] + entry["texels_kept"] > 0
        assert entry["surfaces_updated"] + entry["surfaces_kept"] > 0
        assert {"photons_traced", "photons_kept", "estimated_error", "warnings"} <= set(entry)
        assert entry["files"] == {
            path.name: path.stat().st_size for path in sorted(out.glob(f"*.{int(frame):04d}.exr"))
        } or set(entry["files"]) == {path.name for path in out.glob(f"*.{int(frame):04d}.exr")}


def test_maps_are_finite_lit_and_valid_inside_the_listed_rectangles(scene_file: Path, tmp_path: Path) -> None:
    assert bake_to(tmp_path / "out", scene_file) == 0
    rectangles = [o["rectangle"] for o in record_of(tmp_path / "out")["atlas"]["objects"]]
    inside = np.zeros((48, 48), bool)
    for x, y, width, height in rectangles:
        assert not inside[y : y + height, x : x + width].any()
        inside[y : y + height, x : x + width] = True
    light = {}
    for kind in ("iim", "aim"):
        light[kind], valid = read_page(tmp_path / "out" / map_name(kind, 0, 2))
        assert np.isfinite(light[kind]).all()
        assert (light[kind] >= 0).all()
        assert valid.any()
        assert not valid[~inside].any()
    assert light["iim"][valid].mean() > 0
    # All light is more than the light that bounced.
    assert light["aim"][valid].mean() > light["iim"][valid].mean()


def test_the_same_command_gives_the_same_bytes_on_any_number_of_threads(scene_file: Path, tmp_path: Path) -> None:
    for name, threads in (("a", "1"), ("b", "2"), ("c", "2")):
        assert bake_to(tmp_path / name, scene_file, "--threads", threads, "--texels") == 0
    maps = maps_of(tmp_path / "a")
    assert len(maps) >= 6
    assert maps == maps_of(tmp_path / "b") == maps_of(tmp_path / "c")
    texels = [(tmp_path / name / "texels.npz").read_bytes() for name in "abc"]
    assert texels[0] == texels[1] == texels[2]


def test_without_a_denoiser_the_bake_goes_on_and_says_so_once(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """As in Debian's Blender, which is built without Open Image Denoise."""
    plain, bare = tmp_path / "plain", tmp_path / "bare"
    assert bake_to(plain, scene_file, "--no-denoise") == 0
    monkeypatch.setattr("rtgi_addon.frames.library_folders", lambda: [tmp_path])
    capfd.readouterr()
    assert bake_to(bare, scene_file) == 0
    said = [line for line in capfd.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(said) == 1 and "Open Image Denoise" in said[0] and "not denoised" in said[0]
    assert maps_of(bare) == maps_of(plain)
    assert bake_to(bare, scene_file, "--resume", "--json") == 0
    done = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert done["kept"] == len(FRAMES) and done["warnings"] == [said[0].removeprefix("warning: ")]


def test_another_seed_gives_other_noise(scene_file: Path, tmp_path: Path) -> None:
    assert bake_to(tmp_path / "a", scene_file, "--seed", "0", "--frames", "1") == 0
    assert bake_to(tmp_path / "b", scene_file, "--seed", "1", "--frames", "1") == 0
    name = map_name("iim", 0, 1)
    assert maps_of(tmp_path / "a")[name] != maps_of(tmp_path / "b")[name]


def test_texels_say_where_each_valid_pixel_lies(scene_file: Path, tmp_path: Path) -> None:
    assert bake_to(tmp_path / "out", scene_file, "--texels") == 0
    with np.load(tmp_path / "out" / "texels.npz", allow_pickle=False) as loaded:
        texels = {name: loaded[name] for name in loaded.files}
    count = len(texels["page"])
    for name, shape in {"row": (), "col": (), "object": (), "surface": (), "area": (), "position": (3,)}.items():
        assert texels[name].shape == (count, *shape)
    _, valid = read_page(tmp_path / "out" / map_name("iim", 0, 1))
    listed = np.zeros_like(valid)
    listed[texels["row"], texels["col"]] = True
    assert (listed >= valid).all()  # row 0 is the bottom row in both
    np.testing.assert_allclose(np.sqrt((texels["normal"].astype(float) ** 2).sum(axis=1)), 1, atol=1e-5)
    names = list(texels["names"])
    floor = (texels["object"] == names.index("Floor")) & (texels["side"] == 0)
    block = (texels["object"] == names.index("Block")) & (texels["side"] == 0)
    np.testing.assert_allclose(texels["position"][floor, 2], 0, atol=1e-5)
    np.testing.assert_allclose(texels["normal"][floor], np.tile([0, 0, 1], (floor.sum(), 1)), atol=1e-5)
    assert texels["area"][floor].sum() == pytest.approx(FLOOR_M**2, rel=1e-3)
    assert texels["area"][block].sum() == pytest.approx(6 * BLOCK_M**2, rel=0.02)  # islands share pixels
    moved = texels["position_0003"] - texels["position"]
    np.testing.assert_allclose(moved[block], np.tile([2 * STEP_M, 0, 0], (block.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(moved[floor], 0, atol=1e-6)
    assert "position_0002" in texels


def test_a_bake_leaves_the_open_scene_as_it_was(scene_file: Path, tmp_path: Path) -> None:
    def state() -> dict[str, Any]:
        blocks = {kind: sorted(b.name for b in getattr(bpy.data, kind)) for kind in ("objects", "meshes", "materials",
                  "scenes", "worlds", "lights", "cameras", "node_groups", "collections")}  # fmt: skip
        images = [image.name for image in bpy.data.images if image.type != "RENDER_RESULT"]  # Blender's own slot
        layers = {mesh.name: [layer.name for layer in mesh.uv_layers] for mesh in bpy.data.meshes}
        scene = bpy.context.scene
        look = (scene.frame_current, scene.render.engine, scene.cycles.samples, scene.render.resolution_x)
        return {
            **blocks,
            "images": images,
            "layers": layers,
            "look": look,
            "selected": [o.name for o in bpy.context.selected_objects],
        }

    before = state()
    settings = BakeSettings(resolution=48, quality=Quality.DRAFT)
    summary = bake(BakeJob(frames=[1, 3], out=tmp_path / "out", settings=settings))
    assert (summary.frames, summary.kept, summary.out) == (2, 0, tmp_path / "out")
    assert state() == before


def test_the_scene_s_own_range_and_folder_are_the_defaults(scene_file: Path) -> None:
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 2, 3
    bpy.ops.wm.save_mainfile()
    assert run(["bake", "--resolution", "48", "--quality", "draft"]) == 0
    out = scene_file.with_name("room_rtgi")
    assert list(record_of(out)["frames"]) == ["2", "3"]


def test_a_resumed_bake_equals_an_uninterrupted_one(scene_file: Path, tmp_path: Path) -> None:
    assert bake_to(tmp_path / "whole", scene_file) == 0
    shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    (tmp_path / "cut" / map_name("aim", 0, 2)).unlink()
    (tmp_path / "cut" / ".iim.p0.0003.exr.part").write_bytes(b"half")
    untouched = tmp_path / "cut" / map_name("iim", 0, 1)
    os.utime(untouched, (1, 1))
    assert bake_to(tmp_path / "cut", scene_file, "--resume", "--threads", "1") == 0
    assert maps_of(tmp_path / "cut") == maps_of(tmp_path / "whole")
    assert untouched.stat().st_mtime == 1  # kept, not made again
    assert not list((tmp_path / "cut").glob(".*"))
    assert record_of(tmp_path / "cut")["status"] == "done"
    assert list(record_of(tmp_path / "cut")["frames"]) == ["1", "2", "3"]


def test_resuming_with_another_scene_or_setting_says_what_differs(
    scene_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert bake_to(out, scene_file) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def refusal(*flags: str) -> str:
        capfd.readouterr()
        assert bake_to(out, scene_file, "--resume", *flags) == 2
        (line,) = [text for text in capfd.readouterr().err.splitlines() if text.startswith("error: ")]
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before
        return line

    assert "seed was 0, is 5 now" in refusal("--seed", "5")
    bpy.data.objects["Lamp"].data.energy = 50
    bpy.ops.wm.save_mainfile()
    assert "the lamps changed" in refusal()


def test_a_resumed_bake_does_not_change_its_gather_midway(
    scene_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Gather auto takes what is fastest here; frames kept of another choice, made elsewhere, would not go with it."""
    out = tmp_path / "out"
    assert bake_to(out, scene_file) == 0
    record = record_of(out)
    assert {frame["gather"] for frame in record["frames"].values()} == {"links"}
    del record["frames"]["3"]
    for frame in record["frames"].values():
        frame["gather"], frame["view_pixels"] = "rays", 32
    (out / "bake.json").write_text(json.dumps(record))
    capfd.readouterr()
    assert bake_to(out, scene_file, "--resume") == 3
    (line,) = [text for text in capfd.readouterr().err.splitlines() if text.startswith("error: ")]
    assert "gathered by links, the frames kept by rays" in line and "--gather" in line
    assert list(record_of(out)["frames"]) == ["1", "2"]


def test_a_frame_that_cannot_be_written_fails_the_bake_and_keeps_those_before(
    scene_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    (out / map_name("iim", 0, 2)).mkdir(parents=True)  # a folder where a file should go
    capfd.readouterr()
    assert bake_to(out, scene_file) == 3
    said = capfd.readouterr()
    assert said.out == ""
    (line,) = [text for text in said.err.splitlines() if text.startswith("error: ")]
    assert map_name("iim", 0, 2) in line
    record = record_of(out)
    assert record["status"] == "failed"
    assert list(record["frames"]) == ["1"]
    assert set(record["frames"]["1"]["files"]) <= set(maps_of_files(out))
    (out / map_name("iim", 0, 2)).rmdir()
    assert bake_to(out, scene_file, "--resume") == 0
    assert list(record_of(out)["frames"]) == ["1", "2", "3"]


def maps_of_files(folder: Path) -> list[str]:
    return [path.name for path in folder.glob("*.exr") if path.is_file()]


def test_json_lines_are_all_there_is_on_stdout(start: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> None:
    process = start(tmp_path / "out", "--json")
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    events = [json.loads(line) for line in out.splitlines()]
    frames = [event["frame"] for event in events if event["event"] == "frame"]
    assert frames == [1, 2, 3]
    assert events[-1]["event"] == "done"
    assert events[-1]["frames"] == 3
    assert Path(events[-1]["out"]) == tmp_path / "out"
    assert {"open", "extract"} <= {event.get("stage") for event in events}


def test_a_summary_is_all_there_is_on_stdout_otherwise(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    process = start(tmp_path / "out")
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    (line,) = out.splitlines()
    assert line.startswith("3 frames in ")
    assert line.endswith(f": {tmp_path / 'out'}")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_cancelled_bake_keeps_its_finished_frames(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "out"
    process = start(out, "--json", "--frames", "1-200")
    assert process.stdout is not None
    for line in process.stdout:
        if json.loads(line)["event"] == "frame":
            process.send_signal(number)
            break
    rest, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert json.loads(rest.splitlines()[-1])["event"] == "cancelled"
    record = record_of(out)
    assert record["status"] == "cancelled"
    assert 1 <= len(record["frames"]) < 200
    for entry in record["frames"].values():
        for name, size in entry["files"].items():
            assert (out / name).stat().st_size == size
    assert not list(out.glob(".*"))


def test_a_killed_bake_goes_on_and_ends_as_if_it_had_not_been(
    start: Callable[..., subprocess.Popen[str]], scene_file: Path, tmp_path: Path
) -> None:
    assert bake_to(tmp_path / "whole", scene_file) == 0
    process = start(tmp_path / "out", "--json")
    assert process.stdout is not None
    for line in process.stdout:
        if json.loads(line)["event"] == "frame":
            process.kill()
            break
    process.communicate()
    time.sleep(0.1)
    kept = list(record_of(tmp_path / "out")["frames"])
    assert kept[:1] == ["1"]
    assert bake_to(tmp_path / "out", scene_file, "--resume") == 0
    assert maps_of(tmp_path / "out") == maps_of(tmp_path / "whole")
    assert not list((tmp_path / "out").glob(".*"))


def test_a_saved_copy_shows_the_maps_and_bakes_to_the_same_ones(scene_file: Path, tmp_path: Path) -> None:
    lit = tmp_path / "elsewhere" / "lit.blend"
    lit.parent.mkdir()
    assert bake_to(tmp_path / "out", scene_file, "--save-blend", str(lit)) == 0
    assert bpy.data.filepath == str(scene_file)
    assert not any(group.get("rtgi") for group in bpy.data.node_groups)  # the open scene stays unlit
    assert [path.name for path in lit.parent.iterdir()] == ["lit.blend"]
    bpy.ops.wm.open_mainfile(filepath=str(lit))
    assert bpy.context.scene.frame_current == 2  # as in the scene, not the last one baked
    paths = [Path(bpy.path.abspath(image.filepath)).resolve() for image in bpy.data.images if image.get("rtgi")]
    assert paths == [tmp_path / "out" / map_name("iim", 0, 1)]
    assert "RTGI" in bpy.data.objects["Floor"].data.uv_layers
    assert bake_to(tmp_path / "again", lit) == 0
    assert maps_of(tmp_path / "again") == maps_of(tmp_path / "out")


def test_a_lit_scene_that_is_merely_open_is_not_baked(scene_file: Path, tmp_path: Path) -> None:
    group = bpy.data.node_groups.new("RTGI Light", "ShaderNodeTree")
    group["rtgi"] = True
    with pytest.raises(BakeError, match="remove_lightmaps"):
        bake(BakeJob(frames=[1], out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_sides_are_searched_in_each_frame_that_shows_or_lights_something_new() -> None:
    lamp = Light("Lamp", LightKind.POINT, np.eye(4), (1.0, 1.0, 1.0))
    off = replace(lamp, power=(0.0, 0.0, 0.0))
    still = FrameState(0, np.eye(4)[None], np.ones(1, np.bool_), (off,), None)
    states = [replace(still, frame=frame, lights=(lamp if frame == 33 else off,)) for frame in range(100)]
    told = [state.frame for state in telling_states(states, silent)]
    assert 33 in told  # lit for a single frame, between those evenly spaced
    assert told[0] == 0
    assert told[-1] == 99
    assert len(told) == SIDES_TESTED + 1
    assert [state.frame for state in telling_states(states[:1], silent)] == [0]
