# SPDX-License-Identifier: GPL-3.0-or-later
"""`rtgi render` end to end: a bake taken up from its folder, drawn, and refused where it does not fit the scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.progress import silent
from rtgi_addon.cli import run
from rtgi_addon.exr import write_page
from rtgi_addon.extract import Appearance, extract_source
from rtgi_addon.frames import describe_atlas
from rtgi_addon.layouts import assemble
from rtgi_addon.output import map_name
from rtgi_addon.reopen import read_atlas, reopen
from tests.blender.pictures import read_picture

SIZE_PX = 48


@pytest.fixture
def scene_file(tmp_path: Path, add_plane: Callable[..., bpy.types.Object]) -> Path:
    """A floor that fills the camera's view, lit by a weak lamp, and a moving plane out of view."""
    scene = bpy.context.scene
    add_plane("Floor", size=4.0)
    mover = add_plane("Mover", size=1.0, location=(20, 0, 0))
    for frame in (1, 2):
        mover.location.y = frame
        mover.keyframe_insert("location", frame=frame)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.location, lamp.data.energy = (0, 0, 3), 1
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0, 0, 2)
    for obj in (lamp, camera):
        scene.collection.objects.link(obj)
    scene.camera = camera
    scene.eevee.use_shadows = False  # slow on software GL, and nothing here casts one
    scene.view_settings.view_transform = "Standard"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
    return tmp_path / "room.blend"


@pytest.fixture
def maps(scene_file: Path, tmp_path: Path) -> Path:
    flags = ["--resolution", str(SIZE_PX), "--quality", "draft", "--frames", "1-2"]
    assert run(["bake", str(scene_file), "--out", str(tmp_path / "maps"), *flags]) == 0
    return tmp_path / "maps"


def refused(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    capfd.readouterr()
    assert run(["render", *map(str, arguments)]) == 2
    (line,) = [text for text in capfd.readouterr().err.splitlines() if text.startswith("error: ")]
    return line


def test_pictures_show_the_maps_and_the_scene_stays_unlit(scene_file: Path, maps: Path, tmp_path: Path) -> None:
    flags = ["--maps", str(maps), "--resolution", "32x24", "--samples", "1"]
    dark, lit = tmp_path / "dark", tmp_path / "lit"
    for kind in ("iim",):
        for frame in (1, 2):
            write_page(maps / map_name(kind, 0, frame), *page(0.0))
    assert run(["render", str(scene_file), *flags, "--frames", "1", "--out", str(dark)]) == 0
    for frame in (1, 2):
        write_page(maps / map_name("iim", 0, frame), *page(np.pi * frame))
    assert run(["render", str(scene_file), *flags, "--out", str(lit)]) == 0
    assert {path.name for path in lit.iterdir()} == {"preview.0001.png", "preview.0002.png", "preview.mp4"}
    assert [path.name for path in dark.iterdir()] == ["preview.0001.png"]
    assert not any(group.get("rtgi") for group in bpy.data.node_groups)
    pictures = [read_picture(path).mean() for path in (dark / "preview.0001.png", lit / "preview.0001.png")]
    assert pictures[1] > pictures[0] + 0.3  # the floor's albedo is 0.8: irradiance π makes radiance 0.8


def page(irradiance: float) -> tuple[np.ndarray, np.ndarray]:
    return np.full((SIZE_PX, SIZE_PX, 3), irradiance, np.float32), np.ones((SIZE_PX, SIZE_PX), np.bool_)


def test_faces_that_change_show_the_maps_of_their_frames(scene_file: Path, tmp_path: Path) -> None:
    """A sheet over the floor of one square in frame 1 and of two in frame 2: each look has light of its own."""
    sheet = bpy.data.objects["Floor"].copy()
    sheet.data = sheet.data.copy()
    sheet.name, sheet.location.z = "Sheet", 0.5
    bpy.context.scene.collection.objects.link(sheet)
    array = sheet.modifiers.new("Array", "ARRAY")
    for frame in (1, 2):
        array.count = frame
        array.keyframe_insert("count", frame=frame)
    bpy.ops.wm.save_mainfile()
    maps, drawn = tmp_path / "maps", tmp_path / "drawn"
    bake = ["bake", str(scene_file), "--out", str(maps), "--resolution", str(SIZE_PX), "--quality", "draft"]
    assert run([*bake, "--frames", "1-2"]) == 0
    values = {"Sheet [frame 1]": 0.2, "Sheet [frame 2]": 0.6}
    pixels, valid = page(0.0)
    for entry in json.loads((maps / "bake.json").read_text())["atlas"]["objects"]:
        x, y, width, height = entry["rectangle"]
        pixels[y : y + height, x : x + width] = np.pi * values.get(entry["name"], 0.0)
    for frame in (1, 2):
        write_page(maps / map_name("iim", 0, frame), pixels, valid)
    flags = ["--maps", str(maps), "--resolution", "32x24", "--samples", "1", "--out", str(drawn)]
    assert run(["render", str(scene_file), *flags]) == 0
    first, second = (read_picture(drawn / f"preview.000{frame}.png")[12, 16, 0] for frame in (1, 2))
    # Albedo 0.8; the lamp gives both the same. In linear light, which the pictures do not hold.
    assert linear(second) - linear(first) == pytest.approx(0.8 * 0.4, abs=0.02)


def linear(srgb: float) -> float:
    return ((srgb + 0.055) / 1.055) ** 2.4


def test_a_reopened_bake_has_the_atlas_it_was_made_with(scene_file: Path, maps: Path) -> None:
    baked = reopen(maps, silent)
    assert baked.maps.frames == (1, 2)
    assert [state.frame for state in baked.states] == [1, 2]
    nothing = [None] * len(baked.layouts)
    scene = assemble(baked.source, baked.layouts, Appearance((), nothing, nothing))
    assert read_atlas(describe_atlas(scene, baked.atlas), scene) == baked.atlas
    assert any(place is not None for place in baked.atlas.front)


def test_a_folder_without_a_bake(scene_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "no bake.json" in refused(capfd, scene_file, "--maps", tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_scene_without_a_camera(scene_file: Path, maps: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bpy.context.scene.camera = None
    bpy.ops.wm.save_mainfile()
    assert "camera" in refused(capfd, scene_file, "--maps", maps)


def test_a_scene_that_changed_since_the_bake(scene_file: Path, maps: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bpy.data.objects["Floor"].data.vertices[0].co.x -= 1
    bpy.ops.wm.save_mainfile()
    assert "the geometry changed" in refused(capfd, scene_file, "--maps", maps)


def test_a_map_that_is_gone_is_named(scene_file: Path, maps: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (maps / map_name("iim", 0, 2)).unlink()
    assert map_name("iim", 0, 2) in refused(capfd, scene_file, "--maps", maps)
    assert not (maps / "preview").exists()


def test_a_bake_cut_short_is_shown_up_to_the_gap(scene_file: Path, maps: Path) -> None:
    text = (maps / "bake.json").read_text()
    (maps / "bake.json").write_text(text.replace('\n  "2": {', '\n  "7": {'))
    assert reopen(maps, silent).maps.frames == (1,)
    assert extract_source([1, 2], silent).instances[1].moving


def test_sizes_and_samples_are_checked(scene_file: Path, maps: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "--resolution wide" in refused(capfd, scene_file, "--maps", maps, "--resolution", "wide")
    assert "--samples 0" in refused(capfd, scene_file, "--maps", maps, "--samples", "0")
