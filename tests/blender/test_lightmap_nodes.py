# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group in materials: the light it draws in Eevee, and every material restored.

Pictures are rendered raw and in floats, so that closed forms hold: a diffuse surface of albedo a under irradiance E
has radiance a E / π.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from rtgi_addon.exr import write_page
from rtgi_addon.lightmap_nodes import GROUP_NAME, MapFiles, make_group, remove_group
from rtgi_addon.lightmap_slots import light_materials, unlight_materials
from tests.blender.dumps import dump_file
from tests.blender.pictures import eevee_from_above

SIZE = 4  # pixels of a test page


def constant_pages(folder: Path, values: dict[tuple[str, int, int], float | tuple[float, float, float]]) -> None:
    """Pages of one irradiance each; keys are (kind, page, frame)."""
    for (kind, page, frame), value in values.items():
        rgb = np.broadcast_to(np.asarray(value, np.float32), (SIZE, SIZE, 3))
        write_page(folder / f"{kind}.p{page}.{frame:04d}.exr", rgb, np.ones((SIZE, SIZE), np.bool_))


def place(obj: bpy.types.Object, *, front=(1.0, 1.0, 1.0), back=(0.0, 0.0, 0.0), offset=(0.0, 0.0, 0.0)) -> None:
    obj["rtgi_front_scale"], obj["rtgi_front_offset"] = front, offset
    obj["rtgi_back_scale"], obj["rtgi_back_offset"] = back, offset
    if "RTGI" not in obj.data.uv_layers:
        layer = obj.data.uv_layers.new(name="RTGI")
        layer.uv.foreach_set("vector", np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32).ravel())


def diffuse(name: str, albedo: float) -> bpy.types.Material:
    material = new_material(name)
    tree = material.node_tree
    closure, output = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
    closure.inputs["Color"].default_value = (albedo, albedo, albedo, 1.0)
    tree.links.new(closure.outputs[0], output.inputs["Surface"])
    return material


def new_material(name: str) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material


@pytest.fixture
def picture(empty_file, tmp_path) -> Callable[..., np.ndarray]:
    """``picture(width=w, height=h)``: Eevee from straight above, (rows, columns, 3), row 0 at the bottom."""
    return eevee_from_above(empty_file, tmp_path)


def test_constant_irradiance_gives_albedo_e_over_pi(picture, add_plane, tmp_path):
    plane = add_plane(material=diffuse("Wall", 0.6))
    place(plane)
    constant_pages(tmp_path, {("iim", 0, 1): (2.0, 5.0, 11.0), ("caustics", 0, 1): (1.0, 0.0, 3.0)})
    light_materials([plane], make_group(MapFiles(tmp_path, ("iim", "caustics"), 1, (1,))))
    expected = 0.6 * np.array([3.0, 5.0, 14.0]) / math.pi
    np.testing.assert_allclose(picture()[4, 4], expected, rtol=0.002)


def test_values_beyond_half_floats_survive_and_do_not_spread(picture, add_plane, tmp_path):
    plane = add_plane(material=diffuse("Wall", 1e-4))
    place(plane)
    constant_pages(tmp_path, {("iim", 0, 1): 1e6, ("iim", 1, 1): 1e30})
    light_materials([plane], make_group(MapFiles(tmp_path, ("iim",), 2, (1,))))
    shown = 1e6 if bpy.app.version >= (5, 0) else 65504.0  # Blender 4 clamps any texture to half floats on upload
    np.testing.assert_allclose(picture()[4, 4], shown * 1e-4 / math.pi, rtol=0.002)


def test_every_pixel_is_the_bilinear_value_of_the_page(picture, add_plane, tmp_path):
    """Page pixel (row, column) lies at ((column + 1/2) / width, (row + 1/2) / height) of the UV square."""
    plane = add_plane(material=diffuse("Wall", 1.0))
    place(plane)
    page = np.random.default_rng(5).random((SIZE, SIZE), np.float32) + 0.2
    rgb = page[..., None].repeat(3, axis=2) * np.float32(math.pi)
    write_page(tmp_path / "iim.p0.0001.exr", rgb, np.ones((SIZE, SIZE), np.bool_))
    light_materials([plane], make_group(MapFiles(tmp_path, ("iim",), 1, (1,))))
    drawn = picture(width=20, height=20)[..., 0]
    texel = np.clip((np.arange(20) + 0.5) / 20 * SIZE - 0.5, 0, SIZE - 1)  # the border holds
    low = np.minimum(texel.astype(int), SIZE - 2)
    along = np.zeros((20, SIZE))
    along[np.arange(20), low] = 1 - (texel - low)
    along[np.arange(20), low + 1] = texel - low
    np.testing.assert_allclose(drawn, along @ page @ along.T, rtol=0.002)


def test_linked_duplicates_and_mirrored_objects_read_their_own_rectangles(picture, add_plane, tmp_path):
    """One mesh, one material, four objects: page 0, page 1, mirrored, turned over; a fifth has no place."""
    first = add_plane("A", material=diffuse("Wall", 1.0))
    place(first, front=(0.5, 0.5, 1.0))
    objects = [first]
    for name in "BCDE":
        copy = bpy.data.objects.new(name, first.data)
        bpy.context.scene.collection.objects.link(copy)
        objects.append(copy)
    for index, obj in enumerate(objects):
        obj.location.x = 2.0 * index - 4.0
    place(objects[1], front=(0.5, 0.5, 2.0))
    place(objects[2], front=(0.5, 0.5, 2.0), back=(0.5, 0.5, 1.0))
    objects[2].scale.x = -1.0  # mirrored: its front still faces up
    place(objects[3], front=(0.5, 0.5, 1.0), back=(0.5, 0.5, 2.0))
    objects[3].rotation_euler.x = math.pi  # its back faces up
    constant_pages(tmp_path, {("iim", 0, 1): math.pi, ("iim", 1, 1): 2 * math.pi})
    light_materials(objects[:4], make_group(MapFiles(tmp_path, ("iim",), 2, (1,))))
    row = picture(width=40, height=8, span=10.0)[4, 4::8, 0]
    np.testing.assert_allclose(row, [1.0, 2.0, 2.0, 2.0, 0.0], atol=0.004)


@pytest.mark.parametrize("step", [1, 3])
def test_sequence_follows_the_frame_and_holds_its_ends(picture, add_plane, tmp_path, step):
    plane = add_plane(material=diffuse("Wall", 1.0))
    place(plane)
    frames = (4, 4 + step, 4 + 2 * step)
    constant_pages(tmp_path, {("iim", 0, frame): frame * math.pi for frame in frames})
    light_materials([plane], make_group(MapFiles(tmp_path, ("iim",), 1, frames)))
    for frame in dict.fromkeys((1, frames[0], frames[1], frames[1] + 1, frames[2] + 1)):
        bpy.context.scene.frame_set(frame)
        held = max([f for f in frames if f <= frame], default=frames[0])
        assert picture()[4, 4, 0] == pytest.approx(held, rel=0.002), frame


def test_principled_shares_and_mix_weights(picture, add_plane, tmp_path):
    """Metal and glass take no diffuse light; what a mix shows of a closure, it shows of its light."""
    material = new_material("Mixed")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    principled, dark = nodes.new("ShaderNodeBsdfPrincipled"), nodes.new("ShaderNodeEmission")
    mix, output = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeOutputMaterial")
    for name, value in (
        ("Base Color", (0.5, 1.0, 0.25, 1.0)),
        ("Metallic", 0.25),
        ("Transmission Weight", 0.2),
    ):
        principled.inputs[name].default_value = value
    dark.inputs["Strength"].default_value = 0.0
    mix.inputs[0].default_value = 0.3
    links.new(dark.outputs[0], mix.inputs[1])
    links.new(principled.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], output.inputs["Surface"])
    plane = add_plane(material=material)
    place(plane)
    constant_pages(tmp_path, {("iim", 0, 1): 10.0})
    light_materials([plane], make_group(MapFiles(tmp_path, ("iim",), 1, (1,))))
    expected = 0.3 * 0.75 * 0.8 * np.array([0.5, 1.0, 0.25]) * 10.0 / math.pi
    np.testing.assert_allclose(picture()[4, 4], expected, rtol=0.003)


def test_closures_in_node_groups_and_animated_colours(picture, add_plane, tmp_path):
    inner = bpy.data.node_groups.new("Paint", "ShaderNodeTree")
    inner.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    closure, exit_node = inner.nodes.new("ShaderNodeBsdfDiffuse"), inner.nodes.new("NodeGroupOutput")
    inner.links.new(closure.outputs[0], exit_node.inputs[0])
    for frame, value in ((1, 0.25), (5, 0.75)):
        closure.inputs["Color"].default_value = (value, value, value, 1.0)
        closure.inputs["Color"].keyframe_insert("default_value", frame=frame)
    material = new_material("Grouped")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    group, output = nodes.new("ShaderNodeGroup"), nodes.new("ShaderNodeOutputMaterial")
    group.node_tree = inner
    links.new(group.outputs[0], output.inputs["Surface"])
    plane = add_plane(material=material)
    place(plane)
    constant_pages(tmp_path, {("iim", 0, 1): math.pi})
    before = dump_file()
    light_materials([plane], make_group(MapFiles(tmp_path, ("iim",), 1, (1,))))
    for frame, albedo in ((1, 0.25), (5, 0.75)):
        bpy.context.scene.frame_set(frame)
        assert picture()[4, 4, 0] == pytest.approx(albedo, rel=0.003)
    bpy.context.scene.frame_set(5)
    unlight_materials()
    remove_group()
    assert dump_file() == before


def test_translucent_closures_are_named_in_a_warning(add_plane, tmp_path):
    material = diffuse("Leaf", 0.5)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    leaf, add = nodes.new("ShaderNodeBsdfTranslucent"), nodes.new("ShaderNodeAddShader")
    links.new(nodes["Diffuse BSDF"].outputs[0], add.inputs[0])
    links.new(leaf.outputs[0], add.inputs[1])
    links.new(add.outputs[0], nodes["Material Output"].inputs["Surface"])
    plane = add_plane(material=material)
    constant_pages(tmp_path, {("iim", 0, 1): 1.0})
    warnings = light_materials([plane], make_group(MapFiles(tmp_path, ("iim",), 1, (1,))))
    assert warnings == ('material "Leaf": its Translucent BSDF shows no light-map light in Eevee',)


# --- what removal restores


def varied_objects(add_plane: Callable[..., bpy.types.Object], folder: Path) -> list[bpy.types.Object]:
    """Planes with every kind of material there is to restore."""
    plain = bpy.data.materials.new("NoNodes")
    if bpy.app.version < (5, 0):
        assert not plain.use_nodes
    empty = new_material("Empty")
    no_output = new_material("NoOutput")
    no_output.node_tree.nodes.new("ShaderNodeBsdfPrincipled")

    two_outputs = diffuse("TwoOutputs", 0.4)
    nodes, links = two_outputs.node_tree.nodes, two_outputs.node_tree.links
    second = nodes.new("ShaderNodeOutputMaterial")
    second.target = "EEVEE"
    frame, reroute, glossy = nodes.new("NodeFrame"), nodes.new("NodeReroute"), nodes.new("ShaderNodeBsdfGlossy")
    nodes["Diffuse BSDF"].parent = frame
    nodes["Diffuse BSDF"].location = (-321.0, 77.0)
    links.new(nodes["Diffuse BSDF"].outputs[0], reroute.inputs[0])
    links.new(reroute.outputs[0], second.inputs["Surface"])
    second.is_active_output = True
    nodes.active = glossy

    textured = new_material("Textured")
    nodes, links = textured.node_tree.nodes, textured.node_tree.links
    noise, principled = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeBsdfPrincipled")
    mix, output = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeOutputMaterial")
    links.new(noise.outputs["Color"], principled.inputs["Base Color"])
    links.new(noise.outputs[0], mix.inputs[0])
    links.new(principled.outputs[0], mix.inputs[1])
    links.new(principled.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], output.inputs["Surface"])
    principled.inputs["Metallic"].default_value = 0.1
    principled.inputs["Metallic"].keyframe_insert("default_value", frame=1)
    textured["note"] = "the user's own"

    linked = link_material(folder)
    objects = [
        add_plane(m.name, material=m) for m in (plain, empty, no_output, two_outputs, textured, linked) if m is not None
    ]
    bare = add_plane("Bare")
    bare.data.polygons[0].material_index = 5
    hole = add_plane("EmptySlot")
    hole.data.materials.append(None)
    own = add_plane("ObjectSlot", material=plain)
    own.material_slots[0].link = "OBJECT"
    own.material_slots[0].material = textured
    shared = bpy.data.objects.new("Shared", objects[0].data)
    bpy.context.scene.collection.objects.link(shared)
    return [*objects, bare, hole, own, shared]


def link_material(folder: Path) -> bpy.types.Material:
    """A material from a library, its shader in a group of that library."""
    inner = bpy.data.node_groups.new("LibraryPaint", "ShaderNodeTree")
    inner.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    closure, exit_node = inner.nodes.new("ShaderNodeBsdfDiffuse"), inner.nodes.new("NodeGroupOutput")
    inner.links.new(closure.outputs[0], exit_node.inputs[0])
    material = new_material("FromLibrary")
    group, output = (
        material.node_tree.nodes.new("ShaderNodeGroup"),
        material.node_tree.nodes.new("ShaderNodeOutputMaterial"),
    )
    group.node_tree = inner
    material.node_tree.links.new(group.outputs[0], output.inputs["Surface"])
    bpy.data.libraries.write(str(folder / "library.blend"), {material})
    bpy.data.materials.remove(material)
    bpy.data.node_groups.remove(inner)
    with bpy.data.libraries.load(str(folder / "library.blend"), link=True) as (_, wanted):
        wanted.materials = ["FromLibrary"]
    assert wanted.materials[0].library is not None
    return wanted.materials[0]


def test_removal_restores_every_material(add_plane, tmp_path):
    objects = varied_objects(add_plane, tmp_path)
    constant_pages(tmp_path, {("iim", 0, 1): 1.0})
    before = dump_file()
    light_materials(objects, make_group(MapFiles(tmp_path, ("iim",), 1, (1,))))
    lit = dump_file()
    for name in ("Textured", "TwoOutputs"):
        nodes = lit["trees"][f"material {name}"][1]
        assert any(GROUP_NAME in (values["label"], values.get("node_tree")) for values, *_ in nodes.values()), name
    assert all(slot.material is not None for obj in objects for slot in obj.material_slots)
    assert all(obj.material_slots for obj in objects)
    unlight_materials()
    remove_group()
    after = dump_file()
    for part in before:
        assert after[part] == before[part], part


def test_lighting_twice_changes_nothing_more(add_plane, tmp_path):
    objects = varied_objects(add_plane, tmp_path)
    constant_pages(tmp_path, {("iim", 0, 1): 1.0})
    group = make_group(MapFiles(tmp_path, ("iim",), 1, (1,)))
    light_materials(objects, group)
    once = dump_file()
    light_materials(objects, group)
    assert dump_file() == once


def test_removal_works_on_a_saved_file(add_plane, tmp_path):
    objects = varied_objects(add_plane, tmp_path)
    constant_pages(tmp_path, {("iim", 0, 1): 1.0})
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "before.blend"))
    before = dump_file()
    light_materials(objects, make_group(MapFiles(tmp_path, ("iim",), 1, (1,))))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "lit.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "lit.blend"))
    unlight_materials()
    remove_group()
    after = dump_file()
    for part in before:
        assert after[part] == before[part], part
