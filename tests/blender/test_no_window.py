# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands in a context without a window, as in ``blender -b FILE --command rtgi``: Blender 4.2 may crash there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import pytest

from rtgi_addon.cli import run
from rtgi_addon.scenes import remove_scene


@pytest.fixture
def no_window(empty_file: bpy.types.Scene) -> Iterator[bpy.types.Scene]:
    """The open scene, in a context that has no window."""
    with bpy.context.temp_override(window=None):
        assert bpy.context.window is None
        yield empty_file


def test_a_removed_scene_leaves_what_it_shared(no_window: bpy.types.Scene, add_cube: Callable[..., object]) -> None:
    cube = add_cube("Cube")
    before = cube.users
    copy = no_window.copy()
    remove_scene(copy)
    assert list(bpy.data.scenes) == [no_window]
    assert no_window.objects[:] == [cube]
    if bpy.app.version >= (4, 5):  # 4.2 counts one too many whichever way a scene is removed
        assert cube.users == before


def test_bake_and_pictures(no_window: bpy.types.Scene, add_cube: Callable[..., object], tmp_path: Path) -> None:
    cube = add_cube("Cube")
    material = bpy.data.materials.new("Paint")
    cube.data.materials.append(material)
    for name, data in (("Lamp", bpy.data.lights.new("Lamp", "POINT")), ("Eye", bpy.data.cameras.new("Eye"))):
        thing = bpy.data.objects.new(name, data)
        thing.location = (0, 0, 6)
        no_window.collection.objects.link(thing)
    no_window.camera = bpy.data.objects["Eye"]
    bpy.data.lights["Lamp"].energy = 100
    no_window.eevee.use_shadows = False
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "cube.blend"))
    scenes = list(bpy.data.scenes)
    maps, lit = tmp_path / "maps", tmp_path / "lit.blend"
    options = ["--resolution", "32", "--quality", "draft", "--save-blend", str(lit), "--frames", "1-2"]
    assert run(["bake", "--out", str(maps), *options]) == 0
    assert lit.is_file() and (maps / "aim.p0.0002.exr").is_file()
    assert run(["render", "--maps", str(maps), "--resolution", "32x32", "--samples", "1"]) == 0
    assert {path.suffix for path in (maps / "preview").iterdir()} == {".png", ".mp4"}
    assert list(bpy.data.scenes) == scenes
