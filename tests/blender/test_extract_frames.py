# SPDX-License-Identifier: GPL-3.0-or-later
"""Over the frames: movers, deformers, objects that come and go, lamps and skies that change, and what a frame costs."""

from __future__ import annotations

import time
from collections.abc import Callable

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.scene import FrameState
from rtgi_addon.extract import evaluate_materials, extract_source, frame_state
from rtgi_addon.source import Layout, SourceScene

AddObject = Callable[..., bpy.types.Object]


def silent(*_args: object) -> None:
    pass


def at(source: SourceScene, frame: int) -> FrameState:
    bpy.context.scene.frame_set(frame)
    return frame_state(source, frame)


def animate(owner: object, path: str, *values: tuple[int, object], index: int = -1) -> None:
    for frame, value in values:
        if index < 0:
            setattr(owner, path, value)
        else:
            getattr(owner, path)[index] = value
        owner.keyframe_insert(path, index=index, frame=frame)


def index_of(source: SourceScene, name: str) -> int:
    return [i.name for i in source.instances].index(name)


def test_movers_are_told_from_still_objects(add_cube: AddObject) -> None:
    add_cube("Still")
    animate(add_cube("Mover"), "location", (1, 0.0), (5, 4.0), index=0)
    source = extract_source(range(1, 6), silent)
    assert {i.name: (i.moving, i.deforming) for i in source.instances} == {
        "Still": (False, False),
        "Mover": (True, False),
    }
    mover = index_of(source, "Mover")
    assert source.instances[mover].matrix_world[0, 3] == pytest.approx(0)
    state = at(source, 5)
    assert state.frame == 5
    assert state.matrix_world[mover, 0, 3] == pytest.approx(4)
    assert np.array_equal(state.matrix_world[1 - mover], np.eye(4))
    assert state.visible.all()
    assert state.vertices == {}


def test_movement_after_the_last_frame_does_not_count(add_cube: AddObject) -> None:
    animate(add_cube(), "location", (10, 0.0), (20, 4.0), index=0)
    assert not extract_source(range(1, 6), silent).instances[0].moving


def test_parents_and_collection_instances_move_too(add_cube: AddObject) -> None:
    part = add_cube("Part")
    group = bpy.data.collections.new("Group")
    bpy.context.scene.collection.objects.unlink(part)
    group.objects.link(part)
    empty = bpy.data.objects.new("Cart", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", group
    bpy.context.scene.collection.objects.link(empty)
    animate(empty, "location", (1, 0.0), (3, 2.0), index=2)
    source = extract_source([1, 2, 3], silent)
    assert [(i.name, i.moving) for i in source.instances] == [("Cart/Part", True)]
    assert at(source, 3).matrix_world[0, 2, 3] == pytest.approx(2)


def test_deformers_give_vertices_and_normals(add_plane: AddObject) -> None:
    obj = add_plane("Flag")
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Lifted")
    key.data[2].co = (1, 1, 2)
    animate(key, "value", (1, 0.0), (3, 1.0))
    source = extract_source([1, 2, 3], silent)
    assert source.instances[0].deforming
    assert not source.instances[0].moving
    assert source.meshes[0].vertices[2, 2] == pytest.approx(0)
    state = at(source, 3)
    assert state.vertices[0][2] == pytest.approx([1, 1, 2])
    corners = state.vertices[0][source.meshes[0].triangles]
    assert state.corner_normals[0].shape == corners.shape
    geometric = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ikj->ik", geometric, state.corner_normals[0]) > 0).all()
    assert not np.allclose(state.corner_normals[0], (0, 0, 1), atol=0.1)


def test_linked_duplicates_deform_together(add_plane: AddObject) -> None:
    obj = add_plane("A")
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Lifted")
    key.data[0].co = (-1, -1, 1)
    twin = bpy.data.objects.new("B", obj.data)
    bpy.context.scene.collection.objects.link(twin)
    animate(key, "value", (1, 0.0), (2, 1.0))
    source = extract_source([1, 2], silent)
    assert [i.deforming for i in source.instances] == [True, True]
    # Shape keys are evaluated per object, so each has its own mesh; both must be read.
    state = at(source, 2)
    for instance in source.instances:
        assert state.vertices[instance.mesh][0, 2] == pytest.approx(1)


def test_a_deformer_with_nan_in_one_frame(add_plane: AddObject) -> None:
    obj = add_plane("Torn")
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Bad")
    key.data[1].co = (float("nan"), 0, 0)
    animate(key, "value", (1, 0.0), (2, 1.0))
    source = extract_source([1, 2], silent)
    (mesh,) = source.meshes
    assert len(mesh.triangles) in {0, 1}
    assert 1 not in mesh.triangles
    state = at(source, 2)
    assert all(np.isfinite(v).all() for v in state.vertices.values())
    assert all(np.isfinite(n).all() for n in state.corner_normals.values())


def test_objects_appear_and_vanish(add_cube: AddObject) -> None:
    add_cube("Always")
    animate(add_cube("Late", location=(3, 0, 0)), "hide_render", (1, True), (3, False))
    animate(add_cube("Early"), "hide_render", (1, False), (3, True))
    source = extract_source([1, 2, 3], silent)
    assert sorted(i.name for i in source.instances) == ["Always", "Early", "Late"]
    for frame, shown in ((1, {"Always", "Early"}), (3, {"Always", "Late"})):
        state = at(source, frame)
        assert {i.name for i, v in zip(source.instances, state.visible, strict=True) if v} == shown
        assert np.isfinite(state.matrix_world).all()
    late = index_of(source, "Late")
    assert source.instances[late].matrix_world[0, 3] == pytest.approx(3)
    assert source.first_frames[late] == 3


def test_instances_by_geometry_nodes_appear_and_vanish(add_mesh: AddObject) -> None:
    """As many quads in a row as the frame says."""
    tree = bpy.data.node_groups.new("Row", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    names = ("InputSceneTime", "MeshLine", "MeshGrid", "InstanceOnPoints")
    clock, line, grid, put = (tree.nodes.new(f"GeometryNode{name}") for name in names)
    end = tree.nodes.new("NodeGroupOutput")
    tree.links.new(clock.outputs["Frame"], line.inputs["Count"])
    tree.links.new(line.outputs[0], put.inputs["Points"])
    tree.links.new(grid.outputs[0], put.inputs["Instance"])
    tree.links.new(put.outputs[0], end.inputs[0])
    add_mesh("Row", [(0, 0, 0)], []).modifiers.new("Nodes", "NODES").node_group = tree
    source = extract_source([1, 3, 2], silent)
    assert [i.name for i in source.instances] == ["Row", "Row#2", "Row#3"]
    assert [i.moving for i in source.instances] == [False, True, True]
    assert [at(source, frame).visible.sum() for frame in (1, 2, 3)] == [1, 2, 3]
    assert at(source, 3).matrix_world[:, 2, 3] == pytest.approx([0, 1, 2])


def test_lamps_move_and_change(add_cube: AddObject) -> None:
    add_cube()
    data = bpy.data.lights.new("Lamp", "POINT")
    lamp = bpy.data.objects.new("Lamp", data)
    bpy.context.scene.collection.objects.link(lamp)
    animate(lamp, "location", (1, 0.0), (3, 2.0), index=2)
    animate(data, "energy", (1, 10.0), (3, 30.0))
    source = extract_source([1, 2, 3], silent)
    assert source.lights[0].power == pytest.approx((10, 10, 10))
    (light,) = at(source, 3).lights
    assert light.power == pytest.approx((30, 30, 30))
    assert light.matrix_world[2, 3] == pytest.approx(2)


def set_world(colour: tuple[float, float, float], strength: float) -> bpy.types.Node:
    world = bpy.data.worlds.new("Sky")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    bpy.context.scene.world = world
    background = next(n for n in world.node_tree.nodes if n.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (*colour, 1.0)
    background.inputs["Strength"].default_value = strength
    return background


def test_an_animated_sky_is_read_every_frame_and_a_still_one_once(add_cube: AddObject) -> None:
    add_cube()
    background = set_world((0.5, 1.0, 0.25), 2.0)
    source = extract_source([1, 2, 3], silent)
    assert np.allclose(source.world.radiance, [[[1.0, 2.0, 0.5]]])
    assert at(source, 2).world is source.world
    animate(background.inputs["Strength"], "default_value", (1, 0.0), (3, 4.0))
    source = extract_source([1, 2, 3], silent)
    assert source.world.is_black
    assert source.lit
    assert np.allclose(at(source, 3).world.radiance, [[[2.0, 4.0, 1.0]]])


def test_animated_material_constants(add_cube: AddObject) -> None:
    material = bpy.data.materials.new("Screen")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    emission, output = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(emission.outputs[0], output.inputs[0])
    animate(emission.inputs["Strength"], "default_value", (1, 0.0), (3, 6.0))
    obj = add_cube(material=material)
    source = extract_source([1, 2, 3], silent)
    layout = Layout(np.zeros((12, 3, 2), np.float32), np.zeros(12, np.int32), (1.0, 1.0))
    bpy.context.scene.frame_set(1)
    appearance = evaluate_materials(source, [layout], [(4, 4)], silent)
    assert appearance.materials[0].emission == (0, 0, 0)
    bpy.context.scene.frame_set(3)
    state = frame_state(source, 3, constants=appearance.materials)
    assert state.materials[0].emission == pytest.approx((6, 6, 6))
    assert frame_state(source, 3).materials is None
    obj.data.materials.clear()
    still = extract_source([3], silent)
    plain = evaluate_materials_of_grey(still, layout)
    assert frame_state(still, 3, constants=plain).materials is None


@pytest.mark.parametrize("in_viewport", [True, False])
@pytest.mark.parametrize(
    ("socket", "values", "read", "expected"),
    [
        ("Base Color", ((0, 0, 0, 1), (1, 1, 1, 1)), lambda m: m.albedo[0], (0.04, 0.52, 1.0)),
        ("Emission Strength", (0.0, 6.0), lambda m: m.emission[0], (0.0, 3.0, 6.0)),
        ("Metallic", (0.0, 1.0), lambda m: m.specular[0], (0.0, 0.4, 0.8)),
        ("Transmission Weight", (0.0, 1.0), lambda m: m.transmission[0], (0.0, 0.45, 0.9)),
        ("Alpha", (1.0, 0.25), lambda m: m.opacity, (1.0, 0.625, 0.25)),
    ],
)
def test_every_animated_input_arrives_in_every_frame(
    add_cube: AddObject,
    socket: str,
    values: tuple,
    read: Callable[..., float],
    expected: tuple[float, ...],
    in_viewport: bool,
) -> None:
    """Also of an object that only renders show, whose materials Blender does not animate in the open file."""
    material = bpy.data.materials.new("Changing")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    shader = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled")
    shader.inputs["Roughness"].default_value = 0.0
    shader.inputs["Emission Color"].default_value = (1, 1, 1, 1)
    animate(shader.inputs[socket], "default_value", (1, values[0]), (3, values[1]))
    add_cube(material=material).hide_viewport = not in_viewport
    set_world((1, 1, 1), 1.0)
    source = extract_source([1, 2, 3], silent)
    layout = Layout(np.zeros((12, 3, 2), np.float32), np.zeros(12, np.int32), (1.0, 1.0))
    bpy.context.scene.frame_set(1)
    constants = evaluate_materials(source, [layout], [(4, 4)], silent).materials
    assert read(constants[0]) == pytest.approx(expected[0], abs=0.01)
    for frame, value in zip((1, 2, 3), expected, strict=True):
        bpy.context.scene.frame_set(frame)
        assert read(frame_state(source, frame, constants=constants).materials[0]) == pytest.approx(value, abs=0.01)


def evaluate_materials_of_grey(source: SourceScene, layout: Layout) -> tuple:
    set_world((1, 1, 1), 1.0)
    lit = extract_source([bpy.context.scene.frame_current], silent)
    assert len(lit.meshes) == len(source.meshes)
    return evaluate_materials(lit, [layout], [(4, 4)], silent).materials


def test_the_frame_must_be_set_first(add_cube: AddObject) -> None:
    add_cube()
    source = extract_source([1, 2], silent)
    bpy.context.scene.frame_set(1)
    with pytest.raises(ValueError, match="set the frame first"):
        frame_state(source, 2)


def test_an_unknown_object_is_an_error(add_cube: AddObject) -> None:
    add_cube("Old")
    source = extract_source([1], silent)
    add_cube("New")
    bpy.context.scene.frame_set(1)
    with pytest.raises(BakeError, match="New: appears in frame 1"):
        frame_state(source, 1)


def test_130k_triangles_with_movers_cost_little_a_frame(add_cube: AddObject) -> None:
    side = 256
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    index = np.arange(side * side).reshape(side, side)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    mesh = bpy.data.meshes.new("Ground")
    mesh.from_pydata(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).tolist(), [], quads.tolist())
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Ground", mesh))
    for i in range(50):
        animate(add_cube(f"Mover{i}", location=(i, 0, 0)), "location", (1, 0.0), (20, 5.0), index=2)
    source = extract_source([1, 20], silent)
    assert sum(len(source.meshes[i.mesh].triangles) for i in source.instances) == 2 * 255**2 + 600
    times = []
    for frame in range(2, 12):
        start = time.perf_counter()
        at(source, frame)
        times.append(time.perf_counter() - start)
    print(f"frame_set and frame_state: {1e3 * np.median(times):.1f} ms")  # noqa: T201
    # 60 ms is the aim on a quiet machine; the best of ten is what other work on it does not hide.
    assert min(times) < 0.060
