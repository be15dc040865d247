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
