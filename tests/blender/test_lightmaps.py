# SPDX-License-Identifier: GPL-3.0-or-later
"""Light maps on whole scenes: every kind of object shows its own rectangle, in every frame, and removal leaves nothing.

Each instance gets a rectangle of its own irradiance, so a pixel's value says whose texels it shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.scene import Atlas, Placement
from rtgi_addon.exr import write_page
from rtgi_addon.extract import extract_source, frame_state
from rtgi_addon.lightmap_nodes import MapFiles
from rtgi_addon.lightmaps import apply_lightmaps, remove_lightmaps
from rtgi_addon.source import Layout
from tests.blender.dumps import dump_file
from tests.blender.pictures import eevee_from_above

SQUARE = [(-0.8, -0.8, 0), (0.8, -0.8, 0), (0.8, 0.8, 0), (-0.8, 0.8, 0)]
CELLS = 4  # rectangles along a side of the page
CELL = 16  # pixels of a rectangle's side: coarse texture levels must not reach the neighbours


@pytest.fixture
def picture(empty_file, tmp_path) -> Callable[..., np.ndarray]:
    return eevee_from_above(empty_file, tmp_path)


def white() -> bpy.types.Material:
    material = bpy.data.materials.new("White")
    if material.node_tree is None:
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    closure, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    closure.inputs["Color"].default_value = (1, 1, 1, 1)
    links.new(closure.outputs[0], output.inputs["Surface"])
    return material


class States:
    """The scene's states, each read when asked for, as a bake does."""

    def __init__(self, source, frames):
        self._source, self._frames = source, frames

    def __len__(self):
        return len(self._frames)

    def __getitem__(self, index):
        bpy.context.scene.frame_set(self._frames[index])
        return frame_state(self._source, self._frames[index])


def light(folder: Path, frames: tuple[int, ...] = (1,)):
    """Apply maps in which instance i has irradiance π (i + 1) on both sides; the source and what was applied."""
    source = extract_source(frames, lambda *_: None)
    assert len(source.instances) <= CELLS * CELLS
    layouts = []
    for mesh in source.meshes:  # one island: the mesh seen from above
        flat = mesh.vertices[mesh.triangles][..., :2]
        low, high = flat.min(axis=(0, 1)), flat.max(axis=(0, 1))
        uv = ((flat - low) / (high - low)).astype(np.float32)
        layouts.append(Layout(uv, np.zeros(len(uv), np.int32), (1.0, 1.0)))
    places = []
    for index in range(len(source.instances)):
        row, column = divmod(index, CELLS)
        edge = 0.25 / CELLS
        size = 1 / CELLS - 2 * edge
        places.append(Placement(0, (size, size), (column / CELLS + edge, row / CELLS + edge)))
    side = CELLS * CELL
    values = np.arange(1, CELLS * CELLS + 1, dtype=np.float32).reshape(CELLS, CELLS)
    page = np.kron(values, np.ones((CELL, CELL), np.float32))[..., None].repeat(3, axis=2) * np.float32(math.pi)
    for frame in frames:
        write_page(folder / f"iim.p0.{frame:04d}.exr", page, np.ones((side, side), np.bool_))
    atlas = Atlas(side, 1, tuple(places), tuple(places))
    maps = MapFiles(folder, ("iim",), 1, frames)
    return source, apply_lightmaps(source, layouts, atlas, maps, States(source, frames))


def pixel_of(x: float, y: float, *, size: int = 192, span: float = 16.0) -> tuple[int, int]:
    return int((y / span + 0.5) * size), int((x / span + 0.5) * size)


def expect(drawn: np.ndarray, source, where: dict[str, tuple[float, float]]) -> None:
    """Each named instance shows its own number near its place (x, y), off its diagonal edge."""
    names = [instance.name for instance in source.instances]
    for name, (x, y) in where.items():
        assert drawn[*pixel_of(x + 0.2, y), 0] == pytest.approx(names.index(name) + 1, abs=0.05), name


def place(
    obj: bpy.types.Object, x: float, y: float, collection: bpy.types.Collection | None = None
) -> bpy.types.Object:
    obj.location = (x, y, 0)
    if collection is not None:
        bpy.context.scene.collection.objects.unlink(obj)
        collection.objects.link(obj)
    return obj


def array_modifier(obj: bpy.types.Object) -> None:
    modifier = obj.modifiers.new("Array", "ARRAY")
    modifier.count, modifier.relative_offset_displace = 2, (1.0, 0.0, 0.0)


def test_every_kind_of_object_shows_its_own_rectangle(picture, add_mesh, tmp_path):
    scene, material = bpy.context.scene, white()
    plain = place(add_mesh("Plain", SQUARE, [(0, 1, 2, 3)], material=material), -6, -6)
    plain.data.uv_layers.new(name="Own").active_render = True
    duplicate = bpy.data.objects.new("Duplicate", plain.data)
    scene.collection.objects.link(duplicate)
    duplicate.location = (-4, -6, 0)
    mirrored = bpy.data.objects.new("Mirrored", plain.data)
    scene.collection.objects.link(mirrored)
    mirrored.location, mirrored.scale = (-2, -6, 0), (-1, 1, 1)

    arrayed = place(add_mesh("Arrayed", np.array(SQUARE) * 0.5, [(0, 1, 2, 3)], material=material), -6, -2)
    array_modifier(arrayed)

    chairs = bpy.data.collections.new("Chairs")
    place(add_mesh("Chair", SQUARE, [(0, 1, 2, 3)], material=material), 0, 0, chairs)
    for name, x in (("First", -6.0), ("Second", -3.0)):
        empty = bpy.data.objects.new(name, None)
        empty.instance_type, empty.instance_collection = "COLLECTION", chairs
        empty.location = (x, 2, 0)
        scene.collection.objects.link(empty)

    text = bpy.data.objects.new("Text", bpy.data.curves.new("Text", "FONT"))
    text.data.body, text.data.size = "\u2588", 2.0  # a full block
    text.data.materials.append(material)
    scene.collection.objects.link(text)
    bpy.context.view_layer.update()
    low, high = (np.array(text.bound_box).min(axis=0), np.array(text.bound_box).max(axis=0))
    text.location = (5 - (low[0] + high[0]) / 2, 2 - (low[1] + high[1]) / 2, 0)

    parent = bpy.data.objects.new("Parent", None)
    scene.collection.objects.link(parent)
    parent.scale, parent.location = (2.0, 0.7, 1.0), (5, -6, 0)
    sheared = add_mesh("Sheared", np.array(SQUARE) * 0.6, [(0, 1, 2, 3)], material=material)
    sheared.parent, sheared.rotation_euler.z = parent, 0.7
    array_modifier(sheared)  # so that it needs a stand-in
    sheared.modifiers["Array"].relative_offset_displace = (0.0, 0.0, -0.1)
    bare = place(add_mesh("Bare", SQUARE, [(0, 1, 2, 3)]), 6, 6)

    before = dump_file()
    source, applied = light(tmp_path)
    drawn = picture(width=192, height=192, span=16.0)
    expect(
        drawn,
        source,
        {
            "Plain": (-6, -6),
            "Duplicate": (-4, -6),
            "Mirrored": (-2, -6),
            "Arrayed": (-6, -2),
            "First/Chair": (-6, 2),
            "Second/Chair": (-3, 2),
            "Text": (5, 2),
            "Sheared": (5, -6),
        },
    )
    names = [instance.name for instance in source.instances]
    assert drawn[*pixel_of(-5, -2), 0] == pytest.approx(names.index("Arrayed") + 1, abs=0.05)  # the generated half
    assert drawn[*pixel_of(6.3, 6), 0] == pytest.approx(0.8 * (names.index("Bare") + 1), abs=0.05)  # the default grey
    assert applied.standins == 5
    assert {"Plain", "Duplicate", "Mirrored", "Bare"} < set(applied.objects)
    assert [layer.name for layer in plain.data.uv_layers if layer.active_render] == ["Own"]
    remove_lightmaps()
    after = dump_file()
    for part in before:
        assert after[part] == before[part], part
    assert bare.material_slots.keys() == []
    assert not picture(width=192, height=192, span=16.0).any()  # no lamp: unlit again, and the originals are back


def scatter_nodes(material: bpy.types.Material) -> bpy.types.NodeTree:
    """Two grids, three metres apart along x, as instances of plain geometry."""
    tree = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    line, grid = tree.nodes.new("GeometryNodeMeshLine"), tree.nodes.new("GeometryNodeMeshGrid")
    line.inputs["Count"].default_value, line.inputs["Offset"].default_value = 2, (3.0, 0.0, 0.0)
    for side in ("Size X", "Size Y"):
        grid.inputs[side].default_value = 1.6
    for count in ("Vertices X", "Vertices Y"):
        grid.inputs[count].default_value = 2
    paint, instances = tree.nodes.new("GeometryNodeSetMaterial"), tree.nodes.new("GeometryNodeInstanceOnPoints")
    paint.inputs["Material"].default_value = material
    end = tree.nodes.new("NodeGroupOutput")
    tree.links.new(grid.outputs[0], paint.inputs["Geometry"])
    tree.links.new(line.outputs[0], instances.inputs["Points"])
    tree.links.new(paint.outputs[0], instances.inputs["Instance"])
    tree.links.new(instances.outputs[0], end.inputs[0])
    return tree


def test_instances_by_geometry_nodes_and_objects_of_a_library(picture, add_mesh, tmp_path):
    scene, material = bpy.context.scene, white()
    add_mesh("Linked", SQUARE, [(0, 1, 2, 3)], material=material, location=(4, 4, 0))
    bpy.data.libraries.write(str(tmp_path / "library.blend"), {bpy.data.objects["Linked"]})
    bpy.data.objects.remove(bpy.data.objects["Linked"])
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["Linked"]
    linked = wanted.objects[0]
    scene.collection.objects.link(linked)
    scatter = add_mesh("Scatter", [(0, 0, 0)], [], location=(-6, -4, 0))
    scatter.modifiers.new("Nodes", "NODES").node_group = scatter_nodes(material)
    bpy.context.view_layer.update()
    before = dump_file()
    source, applied = light(tmp_path)
    drawn = picture(width=192, height=192, span=16.0)
    values = sorted(drawn[*pixel_of(x + 0.2, -4), 0] for x in (-6, -3))
    numbers = [i + 1 for i, instance in enumerate(source.instances) if instance.name.startswith("Scatter")]
    assert len(numbers) == 2, [instance.name for instance in source.instances]
    assert values == pytest.approx(numbers, abs=0.05)
    expect(drawn, source, {source.instances[source.keys.index(("", linked.name_full, 0))].name: (4, 4)})
    assert applied.standins == 3
    remove_lightmaps()
    after = dump_file()
    for part in before:
        assert after[part] == before[part], part


def test_standins_follow_the_frames(picture, add_mesh, tmp_path):
    """A moving instance, a deforming generated mesh, one that is hidden for a while, and a frame in between."""
    scene, material = bpy.context.scene, white()
    chairs = bpy.data.collections.new("Chairs")
    place(add_mesh("Chair", SQUARE, [(0, 1, 2, 3)], material=material), 0, 0, chairs)
    empty = bpy.data.objects.new("Mover", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", chairs
    scene.collection.objects.link(empty)
    for frame, x in ((1, -6.0), (5, 2.0)):
        empty.location = (x, 4, 0)
        empty.keyframe_insert("location", frame=frame)
    for curve in curves_of(empty):
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"

    bending = add_mesh("Bending", np.array(SQUARE) * 0.5, [(0, 1, 2, 3)], material=material)
    bending.location = (-6, -4, 0)
    array_modifier(bending)
    bending.shape_key_add(name="Basis")
    key = bending.shape_key_add(name="Aside")
    key.data.foreach_set("co", (np.array(SQUARE) * 0.5 + [8, 0, 0]).ravel())
    for frame, value in ((1, 0.0), (5, 1.0)):
        key.value = value
        key.keyframe_insert("value", frame=frame)
    for curve in curves_of(bending.data.shape_keys):
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"

    blinking = bpy.data.objects.new("Blinker", None)
    blinking.instance_type, blinking.instance_collection = "COLLECTION", chairs
    blinking.location = (6, 0, 0)
    scene.collection.objects.link(blinking)
    for frame, hidden in ((1, True), (3, False), (5, True)):
        blinking.hide_render = hidden
        blinking.keyframe_insert("hide_render", frame=frame)

    scene.frame_set(2)
    before = dump_file()
    source, _applied = light(tmp_path, (1, 3, 5))
    assert scene.frame_current == 2
    for frame, x, shown in ((1, -6.0, 0.0), (3, -2.0, 1.0), (4, 0.0, 1.0), (5, 2.0, 0.0)):
        scene.frame_set(frame)
        drawn = picture(width=192, height=192, span=16.0)
        expect(drawn, source, {"Mover/Chair": (x, 4), "Bending": (x, -4)})
        names = [instance.name for instance in source.instances]
        value = shown * (names.index("Blinker/Chair") + 1)
        assert drawn[*pixel_of(6.3, 0), 0] == pytest.approx(value, abs=0.05), frame
    scene.frame_set(2)
    remove_lightmaps()
    after = dump_file()
    for part in before:
        assert after[part] == before[part], part
    scene.frame_set(3)
    assert not blinking.hide_render  # its animation is back in force
    scene.frame_set(5)
    assert blinking.hide_render


def test_variants_show_their_own_rectangles_in_their_frames(picture, add_mesh, tmp_path):
    """An array that grows from one square to two and back, while it moves; and frames between those that are baked."""
    scene, material = bpy.context.scene, white()
    growing = place(add_mesh("Growing", SQUARE, [(0, 1, 2, 3)], material=material), -4, 4)
    array_modifier(growing)
    for frame, count in ((1, 1), (3, 2), (7, 1)):
        growing.modifiers["Array"].count = count
        growing.modifiers["Array"].keyframe_insert("count", frame=frame)
    for frame, y in ((1, 4.0), (7, -2.0)):
        growing.location.y = y
        growing.keyframe_insert("location", frame=frame)
    for curve in curves_of(growing):
        for key in curve.keyframe_points:
            key.interpolation = "CONSTANT" if "modifiers" in curve.data_path else "LINEAR"
    bending = place(add_mesh("Bending", np.array(SQUARE) * 0.5, [(0, 1, 2, 3)], material=material), -6, -4)
    bending.shape_key_add(name="Basis")
    key = bending.shape_key_add(name="Aside")
    key.data.foreach_set("co", (np.array(SQUARE) * 0.5 + [8, 0, 0]).ravel())
    array_modifier(bending)
    for frame, value, count in ((1, 0.0, 1), (3, 0.25, 2), (7, 0.75, 1)):
        key.value, bending.modifiers["Array"].count = value, count
        key.keyframe_insert("value", frame=frame)
        bending.modifiers["Array"].keyframe_insert("count", frame=frame)
    for curve in [*curves_of(bending), *curves_of(bending.data.shape_keys)]:
        for point in curve.keyframe_points:
            point.interpolation = "CONSTANT" if "modifiers" in curve.data_path else "LINEAR"

    before = dump_file()
    source, applied = light(tmp_path, (1, 3, 5, 7))
    assert [i.name for i in source.instances] == [
        *(f"{name} [frames {frames}]" for name in ("Growing", "Bending") for frames in ("1, 7", "3 to 5"))
    ]
    assert applied.standins == 4
    for frame, variant, y, x in (
        (1, "1, 7", 4.0, -6.0),
        (2, "1, 7", 4.0, -6.0),  # between two looks the earlier holds, where it was
        (3, "3 to 5", 2.0, -4.0),
        (4, "3 to 5", 1.0, -3.0),  # within one look it moves on
        (5, "3 to 5", 0.0, -2.0),
        (6, "3 to 5", 0.0, -2.0),
        (7, "1, 7", -2.0, 0.0),
        (9, "1, 7", -2.0, 0.0),
    ):
        scene.frame_set(frame)
        drawn = picture(width=192, height=192, span=16.0)
        expect(drawn, source, {f"Growing [frames {variant}]": (-4, y), f"Bending [frames {variant}]": (x, -4)})
        second = drawn[*pixel_of(-4 + 1.6 + 0.2, y), 0]  # of the array's squares
        assert (second > 0) == (variant == "3 to 5"), frame
        in_viewport = {i.object.name for i in bpy.context.evaluated_depsgraph_get().object_instances}
        shown = {f"RTGI {name} [frames {variant}]" for name in ("Growing", "Bending")}
        assert {name for name in in_viewport if name.startswith(("RTGI", "Growing", "Bending"))} == shown
    scene.frame_set(1)
    remove_lightmaps()
    after = dump_file()
    for part in before:
        assert after[part] == before[part], part
    assert not any(obj.hide_viewport or obj.hide_render for obj in (growing, bending))
    assert list(bpy.data.collections) == []


def test_files_of_variants_hold_their_own_frames_alone(add_mesh, tmp_path):
    """Vertices of a look are on disk once for each frame from its first to its last, not for all frames."""
    obj = add_mesh("Melt", SQUARE, [(0, 1, 2, 3)], material=white())
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Up")
    key.data[0].co.z = 1
    array_modifier(obj)
    for frame, value in ((1, 0.0), (8, 1.0)):
        key.value = value
        key.keyframe_insert("value", frame=frame)
    for frame, count in ((1, 1), (5, 2), (6, 1)):
        obj.modifiers["Array"].count = count
        obj.modifiers["Array"].keyframe_insert("count", frame=frame)
    for curve in curves_of(obj):
        for point in curve.keyframe_points:
            point.interpolation = "CONSTANT"
    source, _applied = light(tmp_path, tuple(range(1, 9)))
    assert [(i.name, i.deforming) for i in source.instances] == [
        ("Melt [frames 1 to 4, 6 to 8]", True),
        ("Melt [frame 5]", False),
    ]
    assert [path.stat().st_size for path in sorted(tmp_path.glob("*.pc2"))] == [32 + 8 * 4 * 12]
    remove_lightmaps()


def curves_of(block: bpy.types.ID):
    from rtgi_addon.lightmap_nodes import animation_curves

    return animation_curves(block.animation_data)


def test_lamps_of_hidden_instancers_keep_shining(picture, add_mesh, tmp_path):
    scene, material = bpy.context.scene, white()
    floor = add_mesh("Floor", np.array(SQUARE) * 10, [(0, 1, 2, 3)], material=material)
    floor.location.z = -1
    chandelier = bpy.data.collections.new("Chandelier")
    place(add_mesh("Shade", np.array(SQUARE) * 0.1, [(0, 1, 2, 3)], material=material), 4, 4, chandelier)
    lamp = bpy.data.objects.new("Bulb", bpy.data.lights.new("Bulb", "POINT"))
    lamp.data.energy, lamp.data.shadow_soft_size = 400.0, 0.1
    chandelier.objects.link(lamp)
    empty = bpy.data.objects.new("Hook", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", chandelier
    empty.matrix_world = Matrix.Translation((1, 0, 2))
    scene.collection.objects.link(empty)
    unlit = picture(width=192, height=192, span=16.0)
    source, _applied = light(tmp_path)
    lit = picture(width=192, height=192, span=16.0)
    at = pixel_of(1, 0)
    assert unlit[*at, 0] > 1.0
    floor_light = [instance.name for instance in source.instances].index("Floor") + 1
    assert lit[*at, 0] == pytest.approx(unlit[*at, 0] + floor_light, rel=0.01)


def test_lamps_of_hidden_instancers_come_and_go_with_them(add_mesh, tmp_path):
    """One that is hidden for a frame, one that is there at last alone, and a portal, which shows nothing."""
    scene, chandelier = bpy.context.scene, bpy.data.collections.new("Chandelier")
    place(add_mesh("Shade", np.array(SQUARE) * 0.1, [(0, 1, 2, 3)], material=white()), 4, 4, chandelier)
    for name, kind, hidden in (
        ("Bulb", "POINT", (False, True, False)),
        ("Late", "POINT", (True, True, False)),
        ("Portal", "AREA", (False, False, False)),
    ):
        lamp = bpy.data.objects.new(name, bpy.data.lights.new(name, kind))
        lamp.data.cycles.is_portal = name == "Portal"
        chandelier.objects.link(lamp)
        for frame, value in enumerate(hidden, start=1):
            lamp.hide_render = value
            lamp.keyframe_insert("hide_render", frame=frame)
    empty = bpy.data.objects.new("Hook", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", chandelier
    scene.collection.objects.link(empty)
    source, _applied = light(tmp_path, (1, 2, 3))
    assert [lamp.name for lamp in source.lights] == ["Hook/Bulb", "Hook/Late"]
    shown = {name: [] for name in ("Bulb", "Late")}
    for frame in (1, 2, 3):
        scene.frame_set(frame)
        for name, states in shown.items():
            states.append(not bpy.data.objects[f"RTGI Hook/{name}"].hide_render)
    assert shown == {"Bulb": [True, False, True], "Late": [False, False, True]}
    assert "RTGI Hook/Portal" not in bpy.data.objects


def test_missing_maps_are_named_before_anything_is_touched(add_mesh, tmp_path):
    add_mesh("Plain", SQUARE, [(0, 1, 2, 3)], material=white())
    source = extract_source((1,), lambda *_: None)
    before = dump_file()
    with pytest.raises(BakeError, match=r"iim\.p1\.0001\.exr"):
        apply_lightmaps(source, [], Atlas(16, 2, (None,), (None,)), MapFiles(tmp_path, ("iim",), 2, (1,)), [])
    assert dump_file() == before
