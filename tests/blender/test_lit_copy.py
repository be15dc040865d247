# SPDX-License-Identifier: GPL-3.0-or-later
"""The saved copy as an artist opens it: Eevee shows the maps' light once, and the copy bakes as the scene did."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from rtgi_addon.cli import run
from rtgi_addon.exr import read_page
from rtgi_addon.preview import eevee_engine
from tests.blender.pictures import eevee_from_above

ALBEDO, SKY_W_M2_SR = 0.8, 0.5


@pytest.fixture
def under_sky(tmp_path: Path, add_plane: Callable[..., bpy.types.Object]) -> Path:
    """A floor under a uniform sky; the scene is set to Cycles."""
    world = bpy.data.worlds.new("Sky")
    material = bpy.data.materials.new("Paint")
    for block in (world, material):
        if bpy.app.version < (5, 0):  # from then on always, and asking is deprecated
            block.use_nodes = True
    nodes = world.node_tree.nodes
    nodes.clear()
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (SKY_W_M2_SR, SKY_W_M2_SR, SKY_W_M2_SR, 1)
    world.node_tree.links.new(background.outputs[0], output.inputs["Surface"])
    bpy.context.scene.world = world
    nodes = material.node_tree.nodes
    nodes.clear()
    paint, end = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    paint.inputs["Color"].default_value = (ALBEDO, ALBEDO, ALBEDO, 1)
    material.node_tree.links.new(paint.outputs[0], end.inputs["Surface"])
    add_plane("Floor", size=4.0, material=material)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "sky.blend"))
    return tmp_path / "sky.blend"


def bake(scene: Path, out: Path, *flags: str) -> None:
    assert run(["bake", str(scene), "--out", str(out), "--resolution", "32", "--quality", "draft", *flags]) == 0


def test_sky_lights_the_copy_once(under_sky: Path, tmp_path: Path) -> None:
    lit = tmp_path / "lit.blend"
    bake(under_sky, tmp_path / "maps", "--save-blend", str(lit))
    assert bpy.context.scene.world.name == "Sky" and len(bpy.data.worlds) == 1  # the open scene's stays
    assert bpy.context.scene.render.engine == "CYCLES"
    bpy.ops.wm.open_mainfile(filepath=str(lit))
    assert bpy.context.scene.render.engine == eevee_engine()
    floor = eevee_from_above(bpy.context.scene, tmp_path)()
    np.testing.assert_allclose(floor, ALBEDO * SKY_W_M2_SR, rtol=0.03)


def test_the_copy_s_sky_is_baked_again(under_sky: Path, tmp_path: Path) -> None:
    lit = tmp_path / "lit.blend"
    bake(under_sky, tmp_path / "maps", "--save-blend", str(lit))
    bake(lit, tmp_path / "again")
    assert [world.name for world in bpy.data.worlds] == ["Sky"]
    first, again = (read_page(tmp_path / folder / "iim.p0.0001.exr")[0] for folder in ("maps", "again"))
    assert first.max() == pytest.approx(np.pi * SKY_W_M2_SR, rel=0.03)
    np.testing.assert_array_equal(first, again)


def test_the_copy_plays_an_object_whose_faces_change(under_sky: Path, tmp_path: Path) -> None:
    """Tiles on bare ground, one more in each frame: all that is there shows the sky's light, the rest nothing.

    Nothing of the extension runs when it is opened. Baked again it gives the same maps.
    """
    floor = bpy.data.objects["Floor"]
    floor.scale, floor.location = (0.2, 0.2, 1), (-0.75, 0, 0)  # tiles of 0.8 m along x
    tiles = floor.modifiers.new("Tiles", "ARRAY")
    tiles.relative_offset_displace = (1, 0, 0)
    for frame in (1, 3):
        tiles.count = frame
        tiles.keyframe_insert("count", frame=frame)
    bpy.ops.wm.save_mainfile()
    lit, out = tmp_path / "lit.blend", tmp_path / "maps"
    bake(under_sky, out, "--frames", "1-3", "--save-blend", str(lit))
    bpy.ops.wm.open_mainfile(filepath=str(lit))
    scene = bpy.context.scene
    draw = eevee_from_above(scene, tmp_path)
    right = {frame: -0.75 + 0.4 + 0.8 * (frame - 1) for frame in (1, 2, 3)}  # edge of the last tile
    for frame in (3, 1, 2):
        scene.frame_set(frame)
        row = draw(width=16, height=16, span=3.2)[8]
        x = (np.arange(16) + 0.5) * 0.2 - 1.6
        there = (x > -1.15) & (x < right[frame])
        np.testing.assert_allclose(row[there], ALBEDO * SKY_W_M2_SR, rtol=0.04, err_msg=str(frame))
        np.testing.assert_allclose(row[~there], SKY_W_M2_SR, rtol=1e-3, err_msg=str(frame))  # the sky below
    bake(lit, tmp_path / "again", "--frames", "1-3")
    for frame in (1, 2, 3):
        first, again = (read_page(folder / f"iim.p0.{frame:04d}.exr")[0] for folder in (out, tmp_path / "again"))
        np.testing.assert_array_equal(first, again)
