# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line against real .blend files: what it refuses, in words and exit codes, and how it is registered."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import pytest

import rtgi_addon
from rtgi_addon.cli import run
from rtgi_addon.scene_file import default_frames, is_animated, scene_problems

ROOT = Path(__file__).parents[2]


@pytest.fixture
def room(add_plane: Callable[..., bpy.types.Object]) -> bpy.types.Object:
    """A floor with a material, under a lamp."""
    material = bpy.data.materials.new("Paint")
    if bpy.app.version < (5, 0):  # from then on always, and asking is deprecated
        material.use_nodes = True
    floor = add_plane("Floor", material=material)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.location = (0, 0, 2)
    lamp.data.energy = 100
    bpy.context.scene.collection.objects.link(lamp)
    return floor


def save(folder: Path, name: str = "room.blend") -> Path:
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / name))
    return folder / name


def refused(capfd: pytest.CaptureFixture[str], *arguments: object) -> list[str]:
    """The problem lines of a command that must end with exit code 2 and an empty stdout."""
    capfd.readouterr()
    assert run(["bake", *map(str, arguments)]) == 2
    said = capfd.readouterr()
    assert said.out == ""
    return [line.removeprefix("error: ") for line in said.err.splitlines() if line.startswith("error: ")]


def add_image(room: bpy.types.Object, path: str) -> bpy.types.Image:
    image = bpy.data.images.new("Wood", 4, 4)
    image.source = "FILE"
    image.filepath = path
    connect(room.active_material.node_tree, image)
    return image


def connect(tree: bpy.types.NodeTree, image: bpy.types.Image) -> bpy.types.Node:
    """Show ``image`` as the base colour."""
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    tree.links.new(texture.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return texture


def test_a_file_that_does_not_exist(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (line,) = refused(capfd, tmp_path / "none.blend", "--out", tmp_path / "out")
    assert str(tmp_path / "none.blend") in line
    assert not (tmp_path / "out").exists()


def test_a_folder_in_place_of_a_file(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (line,) = refused(capfd, tmp_path)
    assert "folder" in line


@pytest.mark.parametrize("content", [b"", b"BLENDER-v405" + bytes(100), b"GIF89a"])
def test_a_file_that_blender_cannot_open(tmp_path: Path, capfd: pytest.CaptureFixture[str], content: bytes) -> None:
    (tmp_path / "broken.blend").write_bytes(content)
    (line,) = refused(capfd, tmp_path / "broken.blend")
    assert str(tmp_path / "broken.blend") in line


def test_a_file_cut_short(room: object, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    (line,) = refused(capfd, path)
    assert str(path) in line


def test_no_file_named_and_none_open(capfd: pytest.CaptureFixture[str]) -> None:
    (line,) = refused(capfd)
    assert line.startswith("no scene")


def test_a_scene_without_a_mesh(tmp_path: Path, capfd: pytest.CaptureFixture[str], room: bpy.types.Object) -> None:
    bpy.data.objects.remove(room)
    (line,) = refused(capfd, save(tmp_path), "--out", tmp_path / "out")
    assert "mesh" in line
    assert not (tmp_path / "out").exists()


def test_a_scene_without_light(tmp_path: Path, capfd: pytest.CaptureFixture[str], room: object) -> None:
    bpy.data.objects.remove(bpy.data.objects["Lamp"])
    (line,) = refused(capfd, save(tmp_path), "--out", tmp_path / "out")
    assert "light" in line
    assert not (tmp_path / "out").exists()


def test_missing_images_are_named_with_their_users(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], room: bpy.types.Object
) -> None:
    add_image(room, "//textures/wood.png")
    (line,) = refused(capfd, save(tmp_path), "--out", tmp_path / "out")
    for part in ("Wood", "Paint", str(tmp_path / "textures" / "wood.png")):
        assert part in line
    assert not (tmp_path / "out").exists()


def test_images_that_are_there_packed_or_not_used_are_fine(tmp_path: Path, room: bpy.types.Object) -> None:
    image = add_image(room, str(tmp_path / "wood.png"))
    assert len(scene_problems()) == 1
    image.pack(data=b"x", data_len=1)
    assert scene_problems() == []
    there = bpy.data.images.new("There", 4, 4)
    there.filepath_raw, there.file_format = str(tmp_path / "there.png"), "PNG"
    there.save()
    add_image(room, str(tmp_path / "there.png"))
    unused = bpy.data.images.new("Unused", 4, 4)
    unused.source, unused.filepath = "FILE", str(tmp_path / "nowhere.png")
    assert scene_problems() == []
    add_image(room, str(tmp_path / "nowhere.png"))
    assert len(scene_problems()) == 1
    room.active_material.node_tree.nodes[-1].mute = True
    assert scene_problems() == []
    room.active_material.node_tree.nodes[-1].mute = False
    room.active_material.node_tree.links.clear()
    assert scene_problems() == []


def test_each_tile_of_a_udim_image_must_be_there(tmp_path: Path, room: bpy.types.Object) -> None:
    image = add_image(room, str(tmp_path / "skin.<UDIM>.png"))
    image.source = "TILED"
    image.tiles.new(1012)
    (tmp_path / "skin.1001.png").touch()
    (problem,) = scene_problems()
    assert str(tmp_path / "skin.1012.png") in problem
    (tmp_path / "skin.1012.png").touch()
    assert scene_problems() == []


def test_images_inside_groups_and_the_world_are_found(tmp_path: Path, room: bpy.types.Object) -> None:
    inner, outer = (bpy.data.node_groups.new(name, "ShaderNodeTree") for name in ("Inner", "Outer"))
    for tree in (inner, outer):
        tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
        tree.nodes.new("NodeGroupOutput")
    world = bpy.data.worlds.new("Sky")
    bpy.context.scene.world = world
    tree = room.active_material.node_tree
    for block in (world, room.active_material):
        if bpy.app.version < (5, 0):
            block.use_nodes = True
    picture = inner.nodes.new("ShaderNodeTexImage")
    inner.links.new(picture.outputs[0], inner.nodes[0].inputs[0])
    for holder, group, target in (
        (outer, inner, outer.nodes[0].inputs[0]),
        (tree, outer, tree.nodes["Principled BSDF"].inputs["Base Color"]),
    ):
        node = holder.nodes.new("ShaderNodeGroup")
        node.node_tree = group
        holder.links.new(node.outputs[0], target)
    sky = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    world.node_tree.links.new(sky.outputs[0], world.node_tree.nodes["Background"].inputs["Color"])
    for node in (picture, sky):
        node.image = bpy.data.images.new("Gone", 4, 4)
        node.image.source, node.image.filepath = "FILE", str(tmp_path / "gone.exr")
    problems = scene_problems()
    assert len(problems) == 2
    assert any("material Paint" in p for p in problems)
    assert any("world Sky" in p for p in problems)


def test_a_missing_library_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str], room: object) -> None:
    library = save(tmp_path, "library.blend")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(library), link=True) as (_, into):
        into.objects = ["Floor"]
    bpy.context.scene.collection.objects.link(into.objects[0])
    scene = save(tmp_path, "scene.blend")
    library.unlink()
    (line,) = refused(capfd, scene, "--out", tmp_path / "out")
    assert str(library) in line


def test_an_output_that_cannot_be_written(tmp_path: Path, capfd: pytest.CaptureFixture[str], room: object) -> None:
    scene = save(tmp_path)
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper", Path("/proc/rtgi")):
        (line,) = refused(capfd, scene, "--out", out)
        assert str(out) in line
    assert (tmp_path / "file").read_text() == "mine"


def test_all_problems_are_told_at_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], room: bpy.types.Object
) -> None:
    add_image(room, str(tmp_path / "gone.png"))
    lines = refused(capfd, save(tmp_path), "--out", "/proc/rtgi")
    assert len(lines) == 2
    lines = refused(capfd, "--frames", "9-1", "--resolution", "1", "--seed", "-1")
    assert [line.split()[0] for line in lines] == ["--resolution", "--seed", "--frames"]


def test_a_refusal_in_json_is_one_line_on_stdout(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    capfd.readouterr()
    assert run(["bake", str(tmp_path / "none.blend"), "--json"]) == 2
    out = capfd.readouterr().out
    event = json.loads(out)  # exactly one line
    assert event["event"] == "refused"
    assert "none.blend" in event["problems"][0]


def test_usage_errors_and_help(capfd: pytest.CaptureFixture[str]) -> None:
    (line,) = refused(capfd, "a.blend", "--gather", "lightcuts")
    assert "--gather" in line
    (line,) = refused(capfd, "a.blend", "--gather", "plane", "--device", "cpu")
    assert "plane" in line and "GPU" in line
    assert run(["bake", "--help"]) == 0
    assert "--target-error" in capfd.readouterr().out


def test_frames_default_to_the_scene_s_range_where_something_can_move(room: bpy.types.Object) -> None:
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.frame_step = 3, 11, 4
    scene.frame_set(7)
    assert not is_animated()
    assert list(default_frames(scene)) == [7]
    room.keyframe_insert("location", frame=3)
    assert is_animated()
    assert list(default_frames(scene)) == [3, 7, 11]


def test_what_moves_without_keys_counts_as_animated(room: bpy.types.Object) -> None:
    modifier = room.modifiers.new("Wave", "WAVE")
    assert is_animated()
    room.modifiers.remove(modifier)
    assert not is_animated()
    tree = bpy.data.node_groups.new("Clock", "GeometryNodeTree")
    tree.nodes.new("GeometryNodeInputSceneTime")
    assert is_animated()


def test_the_command_is_registered_and_taken_back() -> None:
    rtgi_addon.register()
    assert len(rtgi_addon._commands) == 1
    rtgi_addon.unregister()
    assert rtgi_addon._commands == []
    rtgi_addon.register()  # enabling again after disabling
    rtgi_addon.unregister()


def test_the_module_starts_from_a_shell_and_ends_by_itself(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "rtgi_addon", "bake", "none.blend"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == f"error: {tmp_path / 'none.blend'}: does not exist; name an existing .blend file\n"
    assert list(tmp_path.iterdir()) == []
