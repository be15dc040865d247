# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects whose faces, materials or visibility to light change over the frames: an instance for each of their looks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.progress import silent
from rtgi_addon.backend.scene import FrameState
from rtgi_addon.extract import evaluate_materials, extract_source, frame_state, variants
from rtgi_addon.scene_file import default_frames
from rtgi_addon.source import Layout, SourceScene

AddObject = Callable[..., bpy.types.Object]
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def at(source: SourceScene, frame: int) -> FrameState:
    bpy.context.scene.frame_set(frame)
    return frame_state(source, frame)


def shown(source: SourceScene, frame: int) -> list[str]:
    state = at(source, frame)
    return [i.name for i, visible in zip(source.instances, state.visible, strict=True) if visible]


def keyed(owner: bpy.types.bpy_struct, path: str, *values: tuple[int, object]) -> None:
    for frame, value in values:
        setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)


@contextmanager
def each_frame(act: Callable[[int], None]) -> Iterator[None]:
    """``act(frame)`` at every change of the frame, as a handler of the user's."""

    def handler(scene: bpy.types.Scene, *_args: object) -> None:
        act(scene.frame_current)

    bpy.app.handlers.frame_change_pre.append(handler)
    try:
        yield
    finally:
        bpy.app.handlers.frame_change_pre.remove(handler)


def mesh_of(name: str, faces: list[tuple[int, ...]]) -> bpy.types.Mesh:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(CORNERS, [], faces)
    return mesh


def test_each_set_of_faces_is_an_instance_that_is_there_in_its_frames(add_plane: AddObject) -> None:
    """An array that grows and shrinks: 1, 2, 3, 3, 2, 1 squares."""
    add_plane("Floor")
    array = add_plane("Grower").modifiers.new("Array", "ARRAY")
    keyed(array, "count", (1, 1), (2, 2), (3, 3), (4, 3), (5, 2), (6, 1))
    source = extract_source(range(1, 7), silent)
    names = [i.name for i in source.instances]
    assert names == ["Floor", "Grower [frames 1, 6]", "Grower [frames 2, 5]", "Grower [frames 3 to 4]"]
    assert [len(source.meshes[i.mesh].triangles) for i in source.instances] == [2, 2, 4, 6]
    assert [i.moving for i in source.instances] == [False, True, True, True]
    assert not any(i.deforming for i in source.instances)
    for frame, variant in ((1, 1), (2, 2), (3, 3), (4, 3), (5, 2), (6, 1)):
        assert shown(source, frame) == ["Floor", names[variant]]
    assert source.first_frames == (1, 1, 2, 3)


def test_a_variant_moves_and_deforms(add_plane: AddObject) -> None:
    """Two squares in frames 2 to 4 that lift and slide, one before and after."""
    obj = add_plane("Melt")
    array = obj.modifiers.new("Array", "ARRAY")
    keyed(array, "count", (1, 1), (2, 2), (4, 2), (5, 1))
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Lifted")
    key.data[0].co.z = 3
    keyed(key, "value", (2, 0.0), (4, 1.0))
    for frame, x in ((2, 0.0), (4, 6.0)):
        obj.location.x = x
        obj.keyframe_insert("location", frame=frame)
    source = extract_source(range(1, 6), silent)
    one, two = source.instances
    assert (one.name, one.deforming) == ("Melt [frames 1, 5]", True)  # lifted at the end, not at the start
    assert (two.name, two.moving, two.deforming) == ("Melt [frames 2 to 4]", True, True)
    first, last = at(source, 2), at(source, 4)
    assert [first.matrix_world[1, 0, 3], last.matrix_world[1, 0, 3]] == pytest.approx([0, 6])
    assert [s.vertices[two.mesh][0, 2] for s in (first, last)] == pytest.approx([0, 3])
    assert last.corner_normals[two.mesh].shape == (4, 3, 3)
    assert set(last.vertices) == {two.mesh}  # what is not there is not read
    assert at(source, 5).vertices[one.mesh][0, 2] == pytest.approx(3)


def test_same_counts_but_other_faces_are_told_apart(add_mesh: AddObject) -> None:
    """A flipped diagonal keeps all counts; only the faces themselves tell."""
    obj = add_mesh("Flip", CORNERS, [(0, 1, 2), (0, 2, 3)])
    datas = [obj.data, mesh_of("Other", [(0, 1, 3), (1, 2, 3)])]

    def swap(frame: int) -> None:
        obj.data = datas[frame > 1]

    with each_frame(swap):
        source = extract_source([1, 2], silent)
        assert [i.name for i in source.instances] == ["Flip [frame 1]", "Flip [frame 2]"]
        assert source.meshes[1].triangles.tolist() == [[0, 1, 3], [1, 2, 3]]
        assert shown(source, 2) == ["Flip [frame 2]"]


def test_linked_duplicates_share_the_meshes_of_their_variants(add_mesh: AddObject) -> None:
    obj = add_mesh("A", CORNERS, [(0, 1, 2), (0, 2, 3)])
    twin = bpy.data.objects.new("B", obj.data)
    bpy.context.scene.collection.objects.link(twin)
    datas = [obj.data, mesh_of("Other", [(0, 1, 2, 3)])]

    def swap(frame: int) -> None:
        obj.data = twin.data = datas[frame > 1]

    with each_frame(swap):
        source = extract_source([1, 2], silent)
    names = ["A [frame 1]", "A [frame 2]", "B [frame 1]", "B [frame 2]"]
    assert [(i.name, i.mesh) for i in source.instances] == list(zip(names, (0, 1, 0, 1), strict=True))


def test_names_stay_unique_whatever_objects_are_called(add_plane: AddObject) -> None:
    group = bpy.data.collections.new("Group")
    part = add_plane("Part")
    bpy.context.scene.collection.objects.unlink(part)
    group.objects.link(part)
    for name in ("Cart", "Cart.001"):
        empty = bpy.data.objects.new(name, None)
        empty.instance_type, empty.instance_collection = "COLLECTION", group
        bpy.context.scene.collection.objects.link(empty)
    keyed(part.modifiers.new("Array", "ARRAY"), "count", (1, 1), (2, 2))
    add_plane("Cart/Part [frame 1]")
    source = extract_source([1, 2], silent)
    names = [i.name for i in source.instances]
    assert len(set(names)) == len(names) == 5
    assert {"Cart/Part [frame 2]", "Cart.001/Part [frame 1]", "Cart/Part [frame 1]"} <= set(names)


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ([3], "X [frame 3]"),
        ([1, 3, 5], "X [frames 1 to 5]"),
        ([1, 5, 9], "X [frames 1, 5, 9]"),
        ([1, 3, 7, 11, 15], "X [frames 1 to 3, 7, 11, ...]"),
        ([-1], "X [frame -1]"),
    ],
)
def test_names_list_runs_of_baked_frames(frames: list[int], said: str) -> None:
    assert variants.variant_name("X", frames, range(-1, 16, 2)) == said
    assert variants.variant_name("X", frames[::-1], range(15, -3, -2)) == said


def test_other_materials_are_other_variants(add_cube: AddObject) -> None:
    """Albedo and emission that change because a face's slot or the material in it does."""
    red, green = bpy.data.materials.new("Red"), bpy.data.materials.new("Green")
    swapped, painted = add_cube("Swapped", material=red), add_cube("Painted", material=red)
    painted.data.materials.append(green)
    spare = add_cube("Spare", material=red)
    spare.data.materials.append(red)

    def paint(frame: int) -> None:
        swapped.data.materials[0] = green if frame == 2 else red
        painted.data.polygons[0].material_index = int(frame == 2)
        spare.data.materials[1] = green if frame == 2 else red  # of no face

    with each_frame(paint):
        source = extract_source([1, 2, 3], silent)
        names = [i.name for i in source.instances]
        assert names == [*(f"{n} [{f}]" for n in ("Swapped", "Painted") for f in ("frames 1, 3", "frame 2")), "Spare"]
        used = [
            {source.material_names[m] for m in source.meshes[i.mesh].material_of_triangle} for i in source.instances
        ]
        assert used == [{"Red"}, {"Green"}, {"Red"}, {"Red", "Green"}, {"Red"}]
        assert shown(source, 2) == ["Swapped [frame 2]", "Painted [frame 2]", "Spare"]


def test_textures_are_those_of_the_look(add_mesh: AddObject) -> None:
    """A material that shows an attribute, which each mesh has another value of; the second is first met in frame 3."""
    material = bpy.data.materials.new("Tinted")
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    tint, paint, end = (nodes.new(f"ShaderNode{kind}") for kind in ("Attribute", "BsdfDiffuse", "OutputMaterial"))
    tint.attribute_name = "tint"
    links.new(tint.outputs["Fac"], paint.inputs["Color"])
    links.new(paint.outputs[0], end.inputs["Surface"])
    obj = add_mesh("Skin", CORNERS, [(0, 1, 2), (0, 2, 3)], material=material)
    datas = [obj.data, mesh_of("Other", [(0, 1, 2, 3)])]
    datas[1].materials.append(material)
    for data, value in zip(datas, (0.25, 0.75), strict=True):
        data.attributes.new("tint", "FLOAT", "POINT").data.foreach_set("value", [value] * 4)

    def swap(frame: int) -> None:
        obj.data = datas[frame > 2]

    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    bpy.context.scene.collection.objects.link(lamp)
    with each_frame(swap):
        source = extract_source([1, 2, 3], silent)
        bpy.context.scene.frame_set(1)
        uv = np.array(CORNERS, np.float32)[..., :2]
        layouts = [Layout(uv[m.triangles], np.zeros(2, np.int32), (1.0, 1.0)) for m in source.meshes]
        appearance = evaluate_materials(source, layouts, [(8, 8)] * 2, silent)
        assert bpy.context.scene.frame_current == 1
    for albedo, value in zip(appearance.albedo_maps, (0.25, 0.75), strict=True):
        np.testing.assert_allclose(albedo, value, atol=0.01)


def test_visibility_to_light_that_changes(add_cube: AddObject) -> None:
    ghost = add_cube("Ghost")
    for path in ("visible_diffuse", "visible_shadow"):
        keyed(ghost, path, (1, True), (2, False), (3, True))
    source = extract_source([1, 2, 3], silent)
    assert [(i.name, i.blocks_light) for i in source.instances] == [
        ("Ghost [frames 1, 3]", True),
        ("Ghost [frame 2]", False),
    ]
    assert shown(source, 2) == ["Ghost [frame 2]"]


def test_shading_normals_that_change_are_followed(add_plane: AddObject) -> None:
    """The vertices stand still; a modifier bends the normals."""
    plane = add_plane("Bent")
    plane.data.normals_split_custom_set([(0, 0, 1)] * 4)
    modifier = plane.modifiers.new("Bend", "NORMAL_EDIT")
    modifier.mode = "DIRECTIONAL"
    target = bpy.data.objects.new("Target", None)
    target.location = (9, 0, 1)
    bpy.context.scene.collection.objects.link(target)
    modifier.target, modifier.use_direction_parallel = target, True
    keyed(modifier, "mix_factor", (1, 0.0), (2, 1.0))
    source = extract_source([1, 2], silent)
    assert source.instances[0].deforming
    normals = at(source, 2).corner_normals[0]
    assert not np.allclose(normals, source.meshes[0].corner_normals, atol=0.1)


def test_edges_that_turn_sharp_are_followed(add_cube: AddObject) -> None:
    """The vertices stand still and no normals are custom."""
    cube = add_cube("Edgy")
    cube.data.shade_smooth()
    cube.data.attributes.new("sharp_edge", "BOOLEAN", "EDGE")

    def sharpen(frame: int) -> None:
        cube.data.attributes["sharp_edge"].data.foreach_set("value", [frame == 2] * 12)
        cube.data.update()

    with each_frame(sharpen):
        source = extract_source([1, 2], silent)
        assert source.instances[0].deforming
        assert abs(source.meshes[0].corner_normals).max() == pytest.approx(3**-0.5, abs=1e-3)  # along the diagonals
        assert abs(at(source, 2).corner_normals[0]).max() == pytest.approx(1.0)
        assert not extract_source([1, 3], silent).instances[0].deforming


def test_what_vanishes_altogether_is_no_variant(add_plane: AddObject) -> None:
    """A build modifier that has not begun has no faces at all."""
    plane = add_plane("Built")
    build = plane.modifiers.new("Build", "BUILD")
    build.frame_start, build.frame_duration = 2, 1
    bpy.context.scene.frame_end = 3
    assert default_frames(bpy.context.scene) == range(1, 4)  # though nothing has a curve
    source = extract_source([1, 2, 3], silent)
    assert [i.name for i in source.instances] == ["Built"]
    assert [at(source, frame).visible.tolist() for frame in (1, 2, 3)] == [[False], [False], [True]]


def test_a_simulation_that_never_repeats_is_named(add_mesh: AddObject) -> None:
    obj = add_mesh("Foam", CORNERS, [(0, 1, 2), (0, 2, 3)])
    datas, turn = [obj.data, mesh_of("B", [(0, 1, 2, 3)]), mesh_of("C", [(0, 1, 3)])], 0

    def swap(frame: int) -> None:
        obj.data = datas[0 if frame == 1 else 1 + turn]

    with each_frame(swap):
        source = extract_source([1, 2], silent)
        assert shown(source, 2) == ["Foam [frame 2]"]
        turn = 1
        with pytest.raises(BakeError, match=r"Foam: has other faces .* in frame 2 .* bake its simulation to disk"):
            at(source, 2)


def test_many_looks_are_told_with_what_they_cost(add_plane: AddObject) -> None:
    """1 to 5 squares one upon another: 15 squares of texels where 5 would do for all of them at once."""
    array = add_plane("Fluid").modifiers.new("Array", "ARRAY")
    array.relative_offset_displace = (0, 0, 0.1)
    keyed(array, "count", (1, 1), (5, 5))
    source = extract_source(range(1, 6), silent)
    (line,) = source.warnings
    assert line.startswith("Fluid: ")
    assert f"takes 5 sets of light maps, and all maps get {(15 / 5) ** 0.5:.1f} times coarser; " in line
    assert line.endswith("bake fewer frames at a time, or raise --resolution")


def test_few_looks_are_not_worth_a_word(add_plane: AddObject) -> None:
    add_plane("Room", size=20)
    keyed(add_plane("Fluid").modifiers.new("Array", "ARRAY"), "count", (1, 1), (3, 3))
    source = extract_source([1, 2, 3], silent)
    assert len(source.instances) == 4
    assert source.warnings == ()


def test_too_many_looks_are_refused_with_a_remedy(add_plane: AddObject, monkeypatch: pytest.MonkeyPatch) -> None:
    keyed(add_plane("Fluid").modifiers.new("Array", "ARRAY"), "count", (1, 1), (9, 9))
    monkeypatch.setattr("rtgi_addon.extract.source_scene.MAX_VARIANTS", 4)
    assert len(extract_source(range(1, 5), silent).instances) == 4
    with pytest.raises(BakeError, match=r"^Fluid: .* 5 times up to frame 5, .* bake fewer frames"):
        extract_source(range(1, 10), silent)


def test_too_many_faces_over_all_looks_are_refused(add_plane: AddObject, monkeypatch: pytest.MonkeyPatch) -> None:
    keyed(add_plane("Fluid").modifiers.new("Array", "ARRAY"), "count", (1, 1), (9, 9))
    monkeypatch.setattr("rtgi_addon.extract.source_scene.MAX_EXTRA_TRIANGLES", 4 + 6)
    assert len(extract_source(range(1, 4), silent).instances) == 3
    with pytest.raises(BakeError, match=r"^Fluid: .* up to frame 4, .* fewer faces"):
        extract_source(range(1, 10), silent)
