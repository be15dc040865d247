# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes that break renderers, through the whole bake from .blend to folder: what is promised in docs/robustness.md.

Tiny maps, draft quality, one frame unless time matters. Cases that other files hold to their promise are not repeated.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.settings import BakeSettings, Quality, Selection
from rtgi_addon.bake import BakeSummary, bake
from rtgi_addon.cli import run
from rtgi_addon.exr import read_page
from rtgi_addon.job import BakeJob
from rtgi_addon.output import map_name
from rtgi_addon.terminal import Listener

AddObject = Callable[..., bpy.types.Object]
DRAFT = BakeSettings(resolution=48, quality=Quality.DRAFT)


@dataclass
class Maps:
    """What a bake left on disk, every map finite and not negative."""

    summary: BakeSummary
    frames: dict[int, dict[str, Any]]  # kind -> (H, W, 3)
    valid: np.ndarray  # (H, W) of the last frame
    record: dict[str, Any]
    rectangle: dict[tuple[str, str], tuple[int, int, int, int]]

    @property
    def said(self) -> list[str]:
        """All warnings, of the bake and of its frames."""
        return [*self.summary.warnings, *(w for f in self.record["frames"].values() for w in f["warnings"])]

    def mean(self, name: str, kind: str = "aim", *, side: str = "front", frame: int = 1) -> float:
        x, y, width, height = self.rectangle[name, side]
        return float(self.frames[frame][kind][y : y + height, x : x + width].mean())


@pytest.fixture
def baked(tmp_path: Path) -> Callable[..., Maps]:
    """``baked(frames=[1], settings=...)``: the open scene's maps."""

    def go(frames: tuple[int, ...] = (1,), settings: BakeSettings = DRAFT) -> Maps:
        summary = bake(BakeJob(frames=list(frames), out=tmp_path / "out", settings=settings), Listener())
        record = json.loads((tmp_path / "out" / "bake.json").read_text())
        pictures: dict[int, dict[str, Any]] = {}
        valid = np.zeros(0)
        for frame in frames:
            pictures[frame] = {}
            for kind in ("iim", "aim", "caustics"):
                path = tmp_path / "out" / map_name(kind, 0, frame)
                if kind != "caustics" or path.exists():
                    pictures[frame][kind], valid = read_page(path)
                    assert np.isfinite(pictures[frame][kind]).all()
                    assert (pictures[frame][kind] >= 0).all()
        assert record["status"] == "done"
        rectangle = {(o["name"], o["side"]): tuple(o["rectangle"]) for o in record["atlas"]["objects"]}
        return Maps(summary, pictures, valid, record, rectangle)

    return go


def add_lamp(
    location: tuple[float, float, float] = (0, 0, 2), power: float = 100.0, kind: str = "POINT"
) -> bpy.types.Object:
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", kind))
    lamp.location, lamp.data.energy = location, power
    bpy.context.scene.collection.objects.link(lamp)
    return lamp


def paint(name: str, *, colour: float = 0.8, glow: float = 0.0, node: str = "") -> bpy.types.Material:
    """A diffuse material, or one of another shader ``node``; ``glow`` is its radiance."""
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    shader = tree.nodes.new("ShaderNodeEmission" if glow else node or "ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (colour, colour, colour, 1)
    if glow:
        shader.inputs["Strength"].default_value = glow / colour
    if "Roughness" in shader.inputs and node:
        shader.inputs["Roughness"].default_value = 0.0
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    return material


# --- where and how large ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale, shift", [(1e-3, 0.0), (1e3, 0.0), (1.0, 1e6)])
def test_any_scale_and_place_is_lit_alike(
    baked: Callable[..., Maps], add_plane: AddObject, add_cube: AddObject, scale: float, shift: float
) -> None:
    """A millimetre, a kilometre, a million metres out. The lamp's power grows with the area: E stays."""
    add_plane("Floor", size=4 * scale, location=(shift, -shift, 0))
    add_cube("Block", size=scale, location=(shift, -shift, 1 * scale))
    add_lamp((shift + scale, -shift, 3 * scale), 200 * scale**2)
    maps = baked()
    direct = 200 * 3 / (4 * np.pi * (1 + 9) ** 1.5)  # beneath the lamp's side, without the block's shadow
    assert 0.3 * direct < maps.mean("Floor") < direct
    assert maps.mean("Block", "iim") > 0.02 * direct
    assert maps.valid.mean() > 0.2


def test_mirrored_sheared_stretched_and_flattened(
    baked: Callable[..., Maps], add_plane: AddObject, add_cube: AddObject
) -> None:
    add_plane("Floor", size=8)
    shear = Matrix(((1, 0.8, 0, 0), (0, 1, 0.5, 0), (0, 0, 1, 1), (0, 0, 0, 1)))
    made = {
        "Plain": Matrix.Translation((-3, 0, 1)),
        "Mirrored": Matrix.Translation((3, 0, 1)) @ Matrix.Diagonal((-1, 1, 1, 1)),
        "Sheared": Matrix.Translation((0, -2, 0)) @ shear,
        "Stretched": Matrix.Translation((0, 3, 1)) @ Matrix.Diagonal((3, 0.01, 1, 1)),
        "Flat": Matrix.Translation((0, 0, 0.5)) @ Matrix.Diagonal((1, 1, 0, 1)),
        "Gone": Matrix.Translation((1, 1, 1)) @ Matrix.Diagonal((0, 0, 0, 1)),
    }
    for name, matrix in made.items():
        add_cube(name, size=1).matrix_world = matrix
    add_lamp((0, 0, 4), 500)
    maps = baked()
    assert maps.mean("Mirrored") == pytest.approx(maps.mean("Plain"), rel=0.15)
    for name in ("Plain", "Mirrored", "Sheared", "Stretched"):
        assert maps.mean(name) > 0
        assert (name, "back") not in maps.rectangle  # their insides stay dark


def test_a_transform_that_is_not_finite(baked: Callable[..., Maps], add_plane: AddObject, add_cube: AddObject) -> None:
    """A driver that divides by zero, a broken import: left out and told, and the rest is baked."""
    add_plane("Floor")
    lost = add_cube("Lost")
    lost.location.x = float("nan")
    add_lamp()
    add_lamp((float("nan"), 0, 1)).name = "Lost lamp"
    maps = baked()
    assert any("Lost lamp" in line for line in maps.said)
    assert maps.mean("Floor") > 0
    assert any("Lost" in line for line in maps.said)
    assert ("Lost", "front") not in maps.rectangle


# --- broken meshes and layouts ------------------------------------------------------------------------------------


def test_broken_meshes_beside_a_sound_one(
    baked: Callable[..., Maps], add_plane: AddObject, add_mesh: AddObject
) -> None:
    add_plane("Floor", size=4)
    corners = [(0, 0, 1), (1, 0, 1), (0, 1, 1), (0.5, 0, 1), (0, 0, 1)]
    add_mesh("Twice", corners, [(0, 1, 2), (4, 1, 2)])
    add_mesh("Flat", corners, [(0, 3, 1), (0, 1, 2)])
    add_mesh("Nan", [*corners[:3], (float("nan"), 1, 1)], [(0, 1, 2), (1, 3, 2)])
    add_mesh("Point", [(1, 1, 1)] * 3, [(0, 1, 2)])
    add_mesh("Empty", [], [])
    add_lamp()
    maps = baked()
    assert any(line.startswith("Nan: 1 of its vertices are not finite; the 1 triangles") for line in maps.said)
    assert maps.mean("Floor") > 0
    for name in ("Twice", "Flat", "Nan"):
        side = "back" if (name, "back") in maps.rectangle else "front"
        assert maps.mean(name, side=side) > 0


@pytest.mark.parametrize(
    "uv, fault", [([(0.0, 0.0)] * 8, "no area"), ([(0, 0), (1, 0), (1, 1), (0, 1)] * 2, "overlap")]
)
def test_a_user_s_broken_layout_is_made_anew_and_told(
    baked: Callable[..., Maps], add_mesh: AddObject, uv: list[tuple[float, float]], fault: str
) -> None:
    corners = [(x, y, z) for z in (0, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    shelf = add_mesh("Shelf", corners, [(0, 1, 2, 3), (4, 5, 6, 7)])
    layer = shelf.data.uv_layers.new(name="RTGI")
    layer.uv.foreach_set("vector", np.array(uv, np.float32).ravel())
    add_lamp((0, 0, 3))
    maps = baked()
    (line,) = [line for line in maps.said if "RTGI" in line]
    assert "Shelf" in line and fault in line
    assert maps.mean("Shelf") > 0
    kept = np.zeros(16, np.float32)
    shelf.data.uv_layers["RTGI"].uv.foreach_get("vector", kept)
    np.testing.assert_array_equal(kept, np.array(uv, np.float32).ravel())  # the user's own stays


def test_one_triangle_without_a_camera(baked: Callable[..., Maps], add_mesh: AddObject) -> None:
    assert bpy.context.scene.camera is None
    add_mesh("One", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    add_lamp()
    maps = baked()
    assert maps.mean("One") > 0
    assert not maps.frames[1]["iim"].any()  # nothing to bounce off


def test_many_objects_of_a_texel_each(baked: Callable[..., Maps], add_plane: AddObject) -> None:
    """A hundred tiles on a page of 16²: fewer pixels than they want. What has no room is told."""
    for number in range(100):
        add_plane(f"Tile {number}", size=0.5, location=(number % 10, number // 10, 0))
    add_lamp((5, 5, 3), 1000)
    maps = baked(settings=BakeSettings(resolution=64, quality=Quality.DRAFT))
    assert maps.valid.sum() >= 100
    assert len(maps.rectangle) == 100


def test_60_000_triangles_in_time(baked: Callable[..., Maps], add_plane: AddObject) -> None:
    ground = add_plane("Ground", size=10)
    subdivide = ground.modifiers.new("Fine", "SUBSURF")
    subdivide.subdivision_type = "SIMPLE"
    subdivide.levels = subdivide.render_levels = 7
    waves = ground.modifiers.new("Waves", "WAVE")
    waves.height = 0.3
    add_lamp((0, 0, 3), 1000)
    maps = baked()
    assert maps.mean("Ground") > 0
    assert maps.summary.seconds < 30


# --- light and material -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("colour", [0.0, 1.0, 1.5])
def test_a_closed_room_of_any_albedo(baked: Callable[..., Maps], add_cube: AddObject, colour: float) -> None:
    """Black: no light comes back. White and whiter: bounded, and the user hears of it."""
    add_cube("Room", material=paint("Wall", colour=colour))
    add_lamp((0, 0, 0), 100)
    maps = baked()
    side = "back"  # the cube's faces look outwards
    direct, bounced = 100 / 24, maps.mean("Room", "iim", side=side)
    if colour == 0:
        assert bounced == 0
        return
    assert 100 * direct < bounced < 1000 * direct * 1.1
    assert any("Wall" in line and ("clamped" in line or "no limit" in line) for line in maps.said)


def test_emission_of_a_million(baked: Callable[..., Maps], add_plane: AddObject) -> None:
    add_plane("Floor", size=4, material=paint("Grey", colour=0.5))
    add_plane("Glow", size=0.5, location=(0, 0, 1), material=paint("Glow", colour=1.0, glow=1e6))
    maps = baked()
    # No more arrives than leaves: π L A, from both sides.
    assert 0.1 * np.pi * 1e6 * 0.25 < maps.mean("Floor", "iim") * 16 < 2 * np.pi * 1e6 * 0.25


def test_light_beyond_all_measure(baked: Callable[..., Maps], add_plane: AddObject) -> None:
    add_plane("Floor", size=4, material=paint("Grey", colour=0.5))
    add_plane("Glow", size=0.5, location=(0, 0, 1), material=paint("Glow", colour=1.0, glow=1e30))
    add_lamp(power=1e37)
    maps = baked()
    for name in ("Glow", "Lamp"):
        assert any(f"{name}: light above" in line for line in maps.said)


def test_lamps_in_walls_on_surfaces_in_closed_boxes_and_black_ones(
    baked: Callable[..., Maps], add_plane: AddObject, add_cube: AddObject
) -> None:
    add_plane("Floor", size=4)
    add_cube("Wall", size=1, location=(-1, -1, 1.5)).scale = (1, 0.1, 1)
    add_cube("Box", size=1, location=(1, 1, 1.5))
    add_lamp((-1, -1, 1.5), 1e6)
    add_lamp((1, 1, 1.5), 1e6)
    add_lamp((0, 0, 2), 1e6).data.color = (0, 0, 0)
    add_lamp((1.5, -1.5, 0), 20, "AREA")  # in the floor, looking down
    maps = baked()
    assert maps.frames[1]["aim"].max() > 1e4  # the insides are lit, and have maps of their own
    assert {("Wall", "back"), ("Box", "back")} <= set(maps.rectangle)
    assert maps.mean("Floor") < 1e-3 * maps.mean("Box", side="back")


def test_no_light_is_refused(baked: Callable[..., Maps], add_plane: AddObject) -> None:
    add_plane("Floor")
    add_lamp().data.color = (0, 0, 0)
    with pytest.raises(BakeError, match="light"):
        baked()


def test_mirrors_that_face_each_other_and_glass_in_glass(
    baked: Callable[..., Maps], add_plane: AddObject, add_cube: AddObject
) -> None:
    add_plane("Floor", size=4)
    mirror = paint("Mirror", colour=1.0, node="ShaderNodeBsdfGlossy")
    for side in (-1, 1):
        add_plane(f"Mirror {side}", size=4, location=(2 * side, 0, 2), material=mirror).rotation_euler.y = np.pi / 2
    glass = paint("Glass", colour=1.0, node="ShaderNodeBsdfGlass")
    for size in (1.0, 0.6, 0.3):
        add_cube(f"Glass {size}", size=size, location=(0, 0, 1), material=glass)
    add_lamp((0, 0, 1), 100)  # inside of all three: much of it meets total internal reflection
    maps = baked()
    assert maps.frames[1]["caustics"].any()
    assert maps.mean("Floor") * 16 < 100 / (1 - 0.8)


# --- what takes part, over time -----------------------------------------------------------------------------------


def test_hidden_disabled_and_excluded_objects_cast_no_shadow(
    baked: Callable[..., Maps], add_plane: AddObject, add_cube: AddObject
) -> None:
    add_plane("Floor", size=4)
    add_cube("Hidden", location=(0, 0, 1), size=1).hide_render = True
    away = bpy.data.collections.new("Away")
    bpy.context.scene.collection.children.link(away)
    excluded = add_cube("Excluded", location=(0, 0, 1), size=1)
    bpy.context.scene.collection.objects.unlink(excluded)
    away.objects.link(excluded)
    bpy.context.view_layer.layer_collection.children["Away"].exclude = True
    add_lamp((0, 0, 2))
    maps = baked()
    assert set(maps.rectangle) == {("Floor", "front")}
    x, y, width, height = maps.rectangle["Floor", "front"]
    middle = maps.frames[1]["aim"][y + height // 2, x + width // 2, 0]
    assert middle == pytest.approx(100 / (4 * np.pi * 4), rel=0.05)


def test_linked_duplicates_and_modifiers(baked: Callable[..., Maps], add_plane: AddObject) -> None:
    near = add_plane("Near")
    far = bpy.data.objects.new("Far", near.data)
    far.location = (6, 0, 0)
    bpy.context.scene.collection.objects.link(far)
    array = near.modifiers.new("Rows", "ARRAY")
    array.count, array.relative_offset_displace = 2, (0, 1.5, 0)
    add_lamp((0, 0, 2))
    maps = baked()
    assert maps.mean("Near") > 5 * maps.mean("Far") > 0


def test_an_object_that_appears_and_vanishes(
    baked: Callable[..., Maps], add_plane: AddObject, add_cube: AddObject
) -> None:
    add_plane("Floor", size=4)
    block = add_cube("Block", size=1, location=(0, 0, 1))
    for frame, hidden in ((1, True), (2, False), (3, True)):
        block.hide_render = hidden
        block.keyframe_insert("hide_render", frame=frame)
    add_lamp((0, 0, 3))
    maps = baked(frames=(1, 2, 3))
    assert maps.mean("Floor", frame=2) < 0.8 * maps.mean("Floor", frame=1)
    np.testing.assert_array_equal(maps.frames[1]["aim"], maps.frames[3]["aim"])


def test_faces_that_change_are_lit_in_their_frames(
    tmp_path: Path, add_plane: AddObject, capfd: pytest.CaptureFixture[str]
) -> None:
    """A lid over a floor, built up face by face: the more of it is there, the less light the floor gets."""
    add_plane("Floor", size=4)
    lid = add_plane("Lid", size=4, location=(0, 0, 1))
    cut = lid.modifiers.new("Cut", "SUBSURF")
    cut.subdivision_type = "SIMPLE"
    cut.levels = cut.render_levels = 2
    build = lid.modifiers.new("Build", "BUILD")
    build.frame_start, build.frame_duration = 1, 4
    add_lamp((0, 0, 3))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    flags = ["--out", str(tmp_path / "out"), "--resolution", "64", "--quality", "draft", "--texels"]
    assert run(["bake", str(tmp_path / "a.blend"), *flags, "--frames", "1-6"]) == 0
    record = json.loads((tmp_path / "out" / "bake.json").read_text())
    names = ["Floor", "Lid [frame 2]", "Lid [frame 3]", "Lid [frame 4]", "Lid [frames 5 to 6]"]
    assert list(dict.fromkeys(o["name"] for o in record["atlas"]["objects"])) == names
    rectangle = {o["name"]: o["rectangle"] for o in record["atlas"]["objects"] if o["side"] == "front"}
    floor = []
    for frame in range(1, 7):
        aim = read_page(tmp_path / "out" / map_name("aim", 0, frame))[0]
        assert np.isfinite(aim).all() and (aim >= 0).all()
        x, y, width, height = rectangle["Floor"]
        floor.append(aim[y : y + height, x : x + width].mean())
        for name, first, last in zip(names[1:], (2, 3, 4, 5), (2, 3, 4, 6), strict=True):
            x, y, width, height = rectangle[name]
            assert (aim[y : y + height, x : x + width].max() > 0) or not first <= frame <= last, (name, frame)
    assert floor == sorted(floor, reverse=True) and floor[4] < 0.2 * floor[0]
    texels = np.load(tmp_path / "out" / "texels.npz")
    assert texels["names"].tolist() == names and set(texels["object"]) == set(range(5))
    assert texels["position_0006"].shape == texels["position"].shape
    capfd.readouterr()
    maps = {path.name: path.read_bytes() for path in (tmp_path / "out").glob("*.exr")}
    (tmp_path / "out" / map_name("aim", 0, 4)).unlink()
    assert run(["bake", str(tmp_path / "a.blend"), *flags, "--frames", "1-6", "--resume"]) == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").glob("*.exr")} == maps


def test_faces_that_change_end_at_the_bits_of_a_bake_from_scratch(
    baked: Callable[..., Maps], add_plane: AddObject
) -> None:
    """Of a lid that grows, shrinks to what it was and moves, over frames that go back and forth."""
    add_plane("Floor", size=4)
    lid = add_plane("Lid", size=1, location=(0, 0, 1))
    array = lid.modifiers.new("Array", "ARRAY")
    for frame, count in ((1, 1), (2, 2), (4, 1)):
        array.count, lid.location.y = count, 0.2 * frame
        array.keyframe_insert("count", frame=frame)
        lid.keyframe_insert("location", frame=frame)
    add_lamp((0, 0, 3))
    order = (1, 4, 2, 3)
    swept = baked(frames=order)
    scratch = baked(frames=order, settings=replace(DRAFT, selection=Selection.OFF))
    assert {name for name, _ in swept.rectangle} == {"Floor", "Lid [frames 1, 4]", "Lid [frames 2 to 3]"}
    for frame in order:
        for kind in ("iim", "aim"):
            np.testing.assert_array_equal(swept.frames[frame][kind], scratch.frames[frame][kind], err_msg=str(frame))
    assert swept.mean("Floor", frame=2) < 0.95 * swept.mean("Floor", frame=1)


def test_faces_that_change_too_often_end_with_one_line(
    tmp_path: Path, add_plane: AddObject, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtgi_addon.extract.source_scene.MAX_VARIANTS", 3)
    array = add_plane("Melting").modifiers.new("Array", "ARRAY")
    for frame in (1, 9):
        array.count = frame
        array.keyframe_insert("count", frame=frame)
    add_lamp()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    capfd.readouterr()
    assert run(["bake", str(tmp_path / "a.blend"), "--out", str(tmp_path / "out")]) == 2
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("error: ")]
    assert line.startswith("error: Melting: its faces or materials change too often, 4 times up to frame 4, ")
    assert not (tmp_path / "out").exists()


# --- the disk -----------------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MiB."""
    at = tmp_path / "disk"
    at.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(at)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command here")
    if done.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {done.stderr.strip()}")
    yield at
    subprocess.run(["umount", str(at)], check=True)


def test_a_disk_that_fills_keeps_finished_frames(
    small_disk: Path, tmp_path: Path, add_plane: AddObject, capfd: pytest.CaptureFixture[str]
) -> None:
    """Too small from the start: exit 2. Full between frames: exit 3, one line; with room again --resume ends it."""
    add_plane("Floor", size=4)
    mover = add_plane("Mover", location=(0, 0, 1))
    for frame in (1, 5):
        mover.location.x = frame / 5
        mover.keyframe_insert("location", frame=frame)
    add_lamp()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    flags = ["--frames", "1-5", "--resolution", "64", "--quality", "draft"]

    def go(out: Path, *more: str) -> tuple[int, list[str]]:
        capfd.readouterr()
        code = run(["bake", str(tmp_path / "a.blend"), "--out", str(out), *flags, *more])
        return code, [line for line in capfd.readouterr().err.splitlines() if line.startswith("error: ")]

    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(1024 * 1024 - 2 * 4096))
    code, lines = go(small_disk / "out")  # far too little: refused before anything is computed
    assert code == 2 and "MiB free" in lines[0]
    assert not (small_disk / "out").exists()
    ballast.write_bytes(bytes(1024 * 1024 - 96 * 1024))
    code, lines = go(small_disk / "out", "--resume")  # a resumed bake may need less, so it starts
    assert code == 3
    (line,) = lines
    assert str(small_disk / "out") in line
    kept = sorted(p.name for p in (small_disk / "out").glob("*.exr"))
    assert 0 < len(kept) < 10
    assert not list((small_disk / "out").glob(".*.part"))
    ballast.unlink()
    assert go(small_disk / "out", "--resume")[0] == 0
    assert go(tmp_path / "whole")[0] == 0
    for path in (tmp_path / "whole").glob("*.exr"):
        assert (small_disk / "out" / path.name).read_bytes() == path.read_bytes()
