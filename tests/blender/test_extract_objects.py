# SPDX-License-Identifier: GPL-3.0-or-later
"""What extraction finds: each mesh-like object that a render shows, its true geometry, the user's scene unchanged."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.extract import extract_source, source_scene
from rtgi_addon.source import SourceScene

AddObject = Callable[..., bpy.types.Object]


def silent(*_args: object) -> None:
    pass


def extract(*frames: int) -> SourceScene:
    return extract_source(frames or (1,), silent)


def names(source: SourceScene) -> list[str]:
    return sorted(i.name for i in source.instances)


def world_triangles(source: SourceScene, name: str) -> np.ndarray:
    """(t, 3, 3) world positions of the instance's corners."""
    (instance,) = (i for i in source.instances if i.name == name)
    mesh = source.meshes[instance.mesh]
    at = mesh.vertices[mesh.triangles].astype(np.float64)
    return at @ instance.matrix_world[:3, :3].T + instance.matrix_world[:3, 3]


def area(triangles: np.ndarray) -> float:
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return float(np.linalg.norm(cross, axis=1).sum() / 2)


def collection(name: str, *objects: bpy.types.Object) -> bpy.types.Collection:
    new = bpy.data.collections.new(name)
    for obj in objects:
        for old in list(obj.users_collection):
            old.objects.unlink(obj)
        new.objects.link(obj)
    return new


def layer_collection(name: str) -> bpy.types.LayerCollection:
    return bpy.context.view_layer.layer_collection.children[name]


# --- geometry -------------------------------------------------------------------------------------------------------


def test_a_cube_is_twelve_triangles_with_outward_unit_normals(add_cube: AddObject) -> None:
    add_cube("Box", location=(1, 2, 3))
    source = extract()
    (mesh,), (instance,) = source.meshes, source.instances
    assert (instance.name, len(mesh.vertices), len(mesh.triangles)) == ("Box", 8, 12)
    assert instance.matrix_world[:3, 3] == pytest.approx([1, 2, 3])
    corners = mesh.vertices[mesh.triangles]
    geometric = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
    assert np.allclose(mesh.corner_normals, geometric[:, None], atol=1e-5)
    assert (np.einsum("ij,ij->i", geometric, corners.mean(axis=1)) > 0).all()
    assert area(corners) == pytest.approx(24)
    assert sorted(np.unique(mesh.loop_of_corner)) == list(range(24))
    assert sorted(np.bincount(mesh.polygon_of_triangle)) == [2] * 6
    assert source.material_names == (None,)


def test_loops_point_at_the_vertices_of_the_triangles(add_cube: AddObject) -> None:
    obj = add_cube()
    (mesh,) = extract().meshes
    vertex_of_loop = np.array([loop.vertex_index for loop in obj.data.loops])
    assert np.array_equal(vertex_of_loop[mesh.loop_of_corner], mesh.triangles)


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (Matrix.Translation((1e6, -1e6, 5e5)), 24.0),
        (Matrix.Diagonal((-1, 1, 1, 1)), 24.0),
        (Matrix.Diagonal((2, 3, 0.5, 1)), 4 * 2 * (2 * 3 + 2 * 0.5 + 3 * 0.5)),
        (Matrix.Shear("XY", 4, (0.7, 0.2)), None),
    ],
    ids=["far", "mirrored", "stretched", "sheared"],
)
def test_transforms_are_kept_as_matrices(add_cube: AddObject, matrix: Matrix, expected: float | None) -> None:
    obj = add_cube("Box")
    obj.matrix_world = matrix
    if expected is None:  # an object's own channels cannot hold shear; a parent's can make it
        parent = bpy.data.objects.new("Parent", None)
        bpy.context.scene.collection.objects.link(parent)
        obj.matrix_world = Matrix.Identity(4)
        obj.parent, obj.matrix_parent_inverse = parent, matrix
    bpy.context.view_layer.update()
    (instance,) = extract().instances
    assert np.allclose(instance.matrix_world, np.array(matrix), rtol=1e-6, atol=1e-6)
    if expected is not None:
        # float64 from here on: 1e6 m out the shape is still a cube.
        assert area(world_triangles(extract(), "Box")) == pytest.approx(expected, rel=1e-6)


def test_one_triangle(add_mesh: AddObject) -> None:
    add_mesh("One", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    (mesh,) = extract().meshes
    assert mesh.triangles.shape == (1, 3)
    assert np.allclose(mesh.corner_normals, (0, 0, 1))


def test_objects_without_faces_are_skipped(add_mesh: AddObject, add_cube: AddObject) -> None:
    add_mesh("Points", [(0, 0, 0), (1, 0, 0)], [])
    add_cube("Box")
    assert names(extract()) == ["Box"]


def test_triangles_at_nan_vertices_are_dropped_and_told(add_plane: AddObject, add_cube: AddObject) -> None:
    obj = add_cube("Broken")
    obj.data.vertices[0].co = (float("nan"), 0, 0)
    source = extract()
    (mesh,) = source.meshes
    assert np.isfinite(mesh.vertices).all()
    assert np.isfinite(mesh.corner_normals).all()
    assert 0 not in mesh.triangles
    assert 0 < len(mesh.triangles) < 12
    assert len(mesh.loop_of_corner) == len(mesh.polygon_of_triangle) == len(mesh.material_of_triangle)
    assert len(source.warnings) == 1
    assert source.warnings[0].startswith("Broken: 1 of its vertices are not finite")


def test_only_broken_faces_is_an_error(add_mesh: AddObject) -> None:
    add_mesh("Bad", [(0, 0, float("inf")), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    with pytest.raises(BakeError, match="no face of any object has finite vertices"):
        extract()


def test_materials_by_face_and_by_object(add_mesh: AddObject) -> None:
    red, blue, green = (bpy.data.materials.new(n) for n in ("Red", "Blue", "Green"))
    faces = [(0, 1, 2), (2, 1, 3)]
    a = add_mesh("A", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], faces)
    a.data.materials.append(red)
    a.data.materials.append(blue)
    a.data.polygons[1].material_index = 1
    b = bpy.data.objects.new("B", a.data)
    bpy.context.scene.collection.objects.link(b)
    b.material_slots[0].link = "OBJECT"
    b.material_slots[0].material = green
    source = extract()
    shown = {
        i.name: [source.material_names[m] for m in source.meshes[i.mesh].material_of_triangle] for i in source.instances
    }
    assert shown == {"A": ["Red", "Blue"], "B": ["Green", "Blue"]}


# --- kinds of objects -----------------------------------------------------------------------------------------------


def test_curves_text_metaballs_and_surfaces_become_meshes(empty_file: bpy.types.Scene) -> None:
    bpy.ops.curve.primitive_bezier_circle_add(radius=1)
    bpy.context.object.name = "Ring"
    bpy.context.object.data.bevel_depth = 0.1
    bpy.ops.object.text_add()
    bpy.context.object.name = "Label"
    bpy.ops.object.metaball_add(type="BALL")
    bpy.context.object.name = "Blob"
    bpy.ops.surface.primitive_nurbs_surface_sphere_add(radius=1)
    bpy.context.object.name = "Nurbs"
    bpy.ops.object.empty_add()
    source = extract()
    assert names(source) == ["Blob", "Label", "Nurbs", "Ring"]
    # A torus of radii 1 and 0.1.
    assert area(world_triangles(source, "Ring")) == pytest.approx(4 * np.pi**2 * 0.1, rel=0.1)
    assert area(world_triangles(source, "Nurbs")) == pytest.approx(4 * np.pi, rel=0.1)


def test_linked_duplicates_share_a_mesh_and_modifiers_split_it(add_cube: AddObject) -> None:
    first = add_cube("First")
    for name in ("Second", "Third"):
        obj = bpy.data.objects.new(name, first.data)
        bpy.context.scene.collection.objects.link(obj)
    obj.modifiers.new("Bevel", "BEVEL")
    source = extract()
    mesh_of = {i.name: i.mesh for i in source.instances}
    assert mesh_of["First"] == mesh_of["Second"] != mesh_of["Third"]
    assert len(source.meshes) == 2
    assert len(source.meshes[mesh_of["Third"]].triangles) > 12


def test_modifiers_count_as_in_a_render(add_plane: AddObject) -> None:
    obj = add_plane("Fine")
    subdivide = obj.modifiers.new("Subdivision", "SUBSURF")
    subdivide.subdivision_type = "SIMPLE"
    subdivide.levels, subdivide.render_levels = 0, 3
    off = obj.modifiers.new("Array", "ARRAY")
    off.show_render = False
    (mesh,) = extract().meshes
    assert len(mesh.triangles) == 2 * 64
    assert subdivide.levels == 0


def test_collection_instances_are_named_by_their_path(add_cube: AddObject, add_plane: AddObject) -> None:
    add_plane("Floor")
    chairs = collection("Chairs", add_cube("Seat"), add_cube("Back", location=(0, 0, 2)))
    for x, name in ((0, "Left"), (5, "Right")):
        empty = bpy.data.objects.new(name, None)
        empty.instance_type, empty.instance_collection = "COLLECTION", chairs
        empty.location.x = x
        bpy.context.scene.collection.objects.link(empty)
    source = extract()
    assert names(source) == ["Floor", "Left/Back", "Left/Seat", "Right/Back", "Right/Seat"]
    assert world_triangles(source, "Right/Back").mean(axis=(0, 1)) == pytest.approx([5, 0, 2], abs=1e-5)
    assert len(source.meshes) == 3


def geometry_nodes(name: str) -> bpy.types.NodeTree:
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    return tree


def test_geometry_nodes_instances(add_plane: AddObject, add_cube: AddObject) -> None:
    part = add_cube("Part", size=0.1)
    part.hide_render = True
    carrier = add_plane("Carrier")
    tree = geometry_nodes("Scatter")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    scatter, info = tree.nodes.new("GeometryNodeInstanceOnPoints"), tree.nodes.new("GeometryNodeObjectInfo")
    info.inputs["Object"].default_value = part
    info.inputs["As Instance"].default_value = True
    tree.links.new(start.outputs[0], scatter.inputs["Points"])
    tree.links.new(info.outputs["Geometry"], scatter.inputs["Instance"])
    tree.links.new(scatter.outputs[0], end.inputs[0])
    carrier.modifiers.new("Nodes", "NODES").node_group = tree
    source = extract()
    assert len(source.instances) == 4
    assert len({i.name for i in source.instances}) == 4
    assert all(i.name.startswith("Carrier/Part") for i in source.instances)
    assert len(source.meshes) == 1
    places = sorted(tuple(np.round(i.matrix_world[:2, 3], 4)) for i in source.instances)
    assert places == [(-1, -1), (-1, 1), (1, -1), (1, 1)]


def test_geometry_nodes_primitive_replaces_the_mesh(add_plane: AddObject) -> None:
    carrier = add_plane("Carrier")
    tree = geometry_nodes("Cone")
    end, cone = tree.nodes.new("NodeGroupOutput"), tree.nodes.new("GeometryNodeMeshIcoSphere")
    cone.inputs["Subdivisions"].default_value = 3
    tree.links.new(cone.outputs[0], end.inputs[0])
    carrier.modifiers.new("Nodes", "NODES").node_group = tree
    (mesh,) = extract().meshes
    assert len(mesh.triangles) == 320
    assert mesh.corner_normals.shape == (320, 3, 3)


# --- visibility -----------------------------------------------------------------------------------------------------


def test_only_what_a_render_shows(add_cube: AddObject) -> None:
    add_cube("Shown")
    add_cube("NoRender").hide_render = True
    add_cube("NoViewport").hide_viewport = True
    eye = add_cube("Eye")
    eye.hide_set(True)
    scene = bpy.context.scene
    for kind in ("Excluded", "Off", "OffInViewport"):
        scene.collection.children.link(collection(kind, add_cube(f"In{kind}")))
    layer_collection("Excluded").exclude = True
    bpy.data.collections["Off"].hide_render = True
    bpy.data.collections["OffInViewport"].hide_viewport = True
    assert names(extract()) == ["Eye", "InOffInViewport", "NoViewport", "Shown"]


def test_holdouts_block_but_have_no_maps(add_cube: AddObject) -> None:
    add_cube("Plain")
    add_cube("Own").is_holdout = True
    bpy.context.scene.collection.children.link(collection("Out", add_cube("ByCollection")))
    layer_collection("Out").holdout = True
    source = extract()
    assert {i.name: i.receives_light for i in source.instances} == {"Plain": True, "Own": False, "ByCollection": False}
    assert all(i.blocks_light for i in source.instances)


def test_indirect_only_collections_take_part(add_cube: AddObject) -> None:
    bpy.context.scene.collection.children.link(collection("Only", add_cube("Box")))
    layer_collection("Only").indirect_only = True
    (instance,) = extract().instances
    assert instance.blocks_light
    assert instance.receives_light


def test_ray_visibility(add_cube: AddObject) -> None:
    def hidden(name: str, **flags: bool) -> None:
        obj = add_cube(name)
        for flag, value in flags.items():
            setattr(obj, flag, value)

    hidden("Ghost", visible_diffuse=False, visible_shadow=False)
    hidden("NoCamera", visible_camera=False)
    hidden("HalfA", visible_diffuse=False)
    hidden("HalfB", visible_shadow=False)
    source = extract()
    blocks = {i.name: i.blocks_light for i in source.instances}
    assert blocks == {"Ghost": False, "NoCamera": True, "HalfA": True, "HalfB": True}
    assert [w.split(":")[0] for w in source.warnings] == ["HalfA", "HalfB"]


def test_several_scenes_and_view_layers(add_cube: AddObject) -> None:
    add_cube("Here")
    other = bpy.data.scenes.new("Other")
    there = bpy.data.objects.new("There", bpy.data.objects["Here"].data)
    other.collection.objects.link(there)
    bpy.context.scene.view_layers.new("Second")
    assert names(extract()) == ["Here"]


# --- light-map layers of the user's own -----------------------------------------------------------------------------


def rtgi_layer(obj: bpy.types.Object, uv: list[tuple[float, float]]) -> None:
    layer = obj.data.uv_layers.new(name="RTGI")
    layer.uv.foreach_set("vector", np.array(uv, np.float32).ravel())


def test_a_valid_own_layer_is_kept(add_plane: AddObject) -> None:
    obj = add_plane()
    rtgi_layer(obj, [(0.1, 0.1), (0.9, 0.1), (0.9, 0.8), (0.1, 0.8)])
    source = extract()
    (mesh,) = source.meshes
    assert mesh.rtgi_uv is not None
    assert mesh.rtgi_uv.shape == (2, 3, 2)
    by_vertex = np.array([(0.1, 0.1), (0.9, 0.1), (0.9, 0.8), (0.1, 0.8)])
    assert np.allclose(mesh.rtgi_uv, by_vertex[mesh.triangles])
    assert source.warnings == ()


@pytest.mark.parametrize(
    ("uv", "fault"),
    [
        ([(0, 0), (0, 0), (0, 0), (0, 0)], "no area"),
        ([(0, 0), (2, 0), (2, 1), (0, 1)], "outside"),
        ([(0, 0), (float("nan"), 0), (1, 1), (0, 1)], "not finite"),
    ],
)
def test_an_invalid_own_layer_is_told(add_plane: AddObject, uv: list[tuple[float, float]], fault: str) -> None:
    rtgi_layer(add_plane("Floor"), uv)
    source = extract()
    assert source.meshes[0].rtgi_uv is None
    (warning,) = source.warnings
    assert warning.startswith("Floor: its UV map RTGI")
    assert fault in warning


def test_a_degenerate_triangle_needs_no_uv_area(add_mesh: AddObject) -> None:
    obj = add_mesh("Sliver", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0)], [(0, 1, 2), (3, 4, 5)])
    rtgi_layer(obj, [(0, 0), (1, 0), (0, 1), (0, 0), (0, 0), (0, 0)])
    assert extract().meshes[0].rtgi_uv is not None


# --- errors and manners ---------------------------------------------------------------------------------------------


def test_nothing_to_bake_is_an_error(empty_file: bpy.types.Scene) -> None:
    with pytest.raises(BakeError, match="nothing to bake"):
        extract()


def test_hair_is_told(add_cube: AddObject) -> None:
    add_cube()
    hair = bpy.data.objects.new("Hair", bpy.data.hair_curves.new("Hair"))
    bpy.context.scene.collection.objects.link(hair)
    assert [w.split(":")[0] for w in extract().warnings] == ["Hair"]


def snapshot() -> dict[str, object]:
    """All data-block names, and every plain render and cycles setting of every scene."""
    kinds = ("scenes", "objects", "meshes", "cameras", "materials", "images", "worlds", "collections", "node_groups")
    out: dict[str, object] = {k: sorted(b.name for b in getattr(bpy.data, k)) for k in kinds}
    out["images"] = [n for n in out["images"] if n != "Render Result"]  # Blender's own
    for scene in bpy.data.scenes:
        for owner in (scene, scene.render, scene.cycles):
            for prop in owner.bl_rna.properties:
                if (
                    prop.identifier != "use_nodes"
                    and prop.type in {"BOOLEAN", "INT", "FLOAT", "ENUM", "STRING"}
                    and not getattr(prop, "is_array", False)
                ):
                    out[f"{scene.name}.{owner.bl_rna.identifier}.{prop.identifier}"] = getattr(owner, prop.identifier)
        out[f"{scene.name}.camera"] = scene.camera
    out["handlers"] = {
        n: list(getattr(bpy.app.handlers, n)) for n in ("render_pre", "render_post", "render_complete", "render_init")
    }
    return out


def test_the_users_scene_is_unchanged_and_no_handler_hears_of_it(add_cube: AddObject) -> None:
    add_cube()
    scene = bpy.context.scene
    scene.timeline_markers.new("Cut", frame=3)
    scene.frame_set(7)
    heard = []

    def listen(*_args: object) -> None:
        heard.append(True)

    bpy.app.handlers.render_pre.append(listen)
    bpy.app.handlers.render_complete.append(listen)
    try:
        before = snapshot()
        extract(1, 2, 3)
        assert snapshot() == before
    finally:
        bpy.app.handlers.render_pre.remove(listen)
        bpy.app.handlers.render_complete.remove(listen)
    assert not heard
    assert scene.frame_current == 7
    assert [m.name for m in scene.timeline_markers] == ["Cut"]


def test_a_fault_while_reading_reaches_the_caller_and_leaves_nothing_behind(
    add_cube: AddObject, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fault(*_args: object) -> None:
        raise ZeroDivisionError("on purpose")

    add_cube()
    before = snapshot()
    monkeypatch.setattr(source_scene, "_visit", fault)
    with pytest.raises(ZeroDivisionError, match="on purpose"):
        extract()
    assert snapshot() == before
    monkeypatch.undo()
    assert names(extract()) == ["Cube"]


def test_progress_is_reported(add_cube: AddObject) -> None:
    add_cube()
    steps: list[tuple[str, int, int]] = []
    extract_source([1, 2], lambda *step: steps.append(step))
    assert steps == [("extract", 0, 2), ("extract", 1, 2), ("extract", 2, 2)]
