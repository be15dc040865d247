# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials: as Cycles evaluates them, maps over the layout, rays by mirror and glass, and what users must mend."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.scene import Material
from rtgi_addon.extract import Appearance, evaluate_materials, extract_source
from rtgi_addon.source import Layout, SourceScene

AddObject = Callable[..., bpy.types.Object]
RGBA = (0.8, 0.4, 0.2, 1.0)
SIZE = 16


def silent(*_args: object) -> None:
    pass


@pytest.fixture(autouse=True)
def lamp(empty_file: bpy.types.Scene) -> bpy.types.Object:
    obj = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    empty_file.collection.objects.link(obj)
    return obj


def new_material(name: str, kind: str = "ShaderNodeBsdfPrincipled", **inputs: object) -> bpy.types.Material:
    """A material whose surface is one node; underscores stand for spaces in the names of its inputs."""
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(add_node(material, kind, **inputs).outputs[0], output.inputs["Surface"])
    return material


def add_node(material: bpy.types.Material, kind: str, **inputs: object) -> bpy.types.Node:
    node = material.node_tree.nodes.new(kind)
    for key, value in inputs.items():
        node.inputs[key.replace("_", " ")].default_value = value
    return node


def surface(material: bpy.types.Material) -> bpy.types.Node:
    return (
        next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeOutputMaterial")
        .inputs[0]
        .links[0]
        .from_node
    )


def link(material: bpy.types.Material, source: bpy.types.Node, socket: str | int, target: str) -> None:
    material.node_tree.links.new(source.outputs[socket], surface(material).inputs[target])


def set_surface(material: bpy.types.Material, node: bpy.types.Node) -> None:
    output = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeOutputMaterial")
    material.node_tree.links.new(node.outputs[0], output.inputs["Surface"])


def flat_layouts(source: SourceScene) -> list[Layout]:
    """Each mesh's own x and y, from -1..1 to the unit square."""
    out = []
    for mesh in source.meshes:
        uv = (mesh.vertices[mesh.triangles][..., :2] + 1) / 2
        out.append(Layout(uv.astype(np.float32), np.zeros(len(uv), np.int32), (2.0, 2.0)))
    return out


def evaluate(size: int = SIZE) -> tuple[SourceScene, Appearance]:
    source = extract_source([1], silent)
    return source, evaluate_materials(source, flat_layouts(source), [(size, size)] * len(source.meshes), silent)


def only(appearance: Appearance) -> Material:
    (material,) = appearance.materials
    return material


def checker(name: str = "checker") -> bpy.types.Image:
    """2 x 2 pixels: red, green below; blue, white above."""
    image = bpy.data.images.new(name, 2, 2, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    image.pixels.foreach_set(np.array([1, 0, 0, 1, 0, 1, 0, 1, 0, 0, 1, 1, 1, 1, 1, 1], np.float32))
    image.update()
    image.pack()
    return image


def add_image(material: bpy.types.Material, image: bpy.types.Image) -> bpy.types.Node:
    node = add_node(material, "ShaderNodeTexImage")
    node.image, node.interpolation = image, "Closest"
    return node


def add_uv(obj: bpy.types.Object, name: str = "UVMap", scale: float = 1.0) -> None:
    layer = obj.data.uv_layers.new(name=name)
    positions = np.array([obj.data.vertices[loop.vertex_index].co[:2] for loop in obj.data.loops])
    layer.uv.foreach_set("vector", (((positions + 1) / 2) * scale).astype(np.float32).ravel())


# --- constants ------------------------------------------------------------------------------------------------------

DIFFUSE_CASES = {
    "diffuse": (("ShaderNodeBsdfDiffuse", {"Color": RGBA}), (0.8, 0.4, 0.2)),
    "principled_matte": (("ShaderNodeBsdfPrincipled", {"Base_Color": RGBA, "Specular_IOR_Level": 0.0}),
                         (0.8, 0.4, 0.2)),
    "translucent": (("ShaderNodeBsdfTranslucent", {"Color": RGBA}), (0.8, 0.4, 0.2)),
    "white": (("ShaderNodeBsdfDiffuse", {"Color": (1, 1, 1, 1)}), (1, 1, 1)),
    "black": (("ShaderNodeBsdfDiffuse", {"Color": (0, 0, 0, 1)}), (0, 0, 0)),
    "half_transparent": (("ShaderNodeBsdfPrincipled", {"Base_Color": RGBA, "Specular_IOR_Level": 0.0, "Alpha": 0.5}),
                         (0.8, 0.4, 0.2)),
}  # fmt: skip


@pytest.mark.parametrize("name", DIFFUSE_CASES)
def test_diffuse_constants(name: str, add_plane: AddObject) -> None:
    (kind, inputs), expected = DIFFUSE_CASES[name]
    add_plane(material=new_material("M", kind, **inputs))
    _, appearance = evaluate()
    material = only(appearance)
    assert material.albedo == pytest.approx(expected, abs=2e-3)
    assert material.opacity == pytest.approx(0.5 if name == "half_transparent" else 1)
    assert appearance.albedo_maps == [None]
    assert appearance.emission_maps == [None]
    assert appearance.warnings == ()


def test_rough_metal_and_gloss_keep_their_energy_as_diffuse(add_plane: AddObject) -> None:
    metal = new_material("Metal", Base_Color=RGBA, Metallic=1.0, Roughness=0.5)
    paint = new_material("Paint", Base_Color=RGBA, Roughness=0.5)
    add_plane("A", material=metal)
    add_plane("B", material=paint)
    _, appearance = evaluate()
    by_name = {m.name: m for m in appearance.materials}
    assert by_name["Metal"].albedo == pytest.approx((0.79, 0.385, 0.19), abs=0.02)
    assert not by_name["Metal"].is_specular
    # A coat of gloss reflects some 4 % and takes as much from below.
    assert by_name["Paint"].albedo == pytest.approx((0.8 * 0.96 + 0.04, 0.4 * 0.96 + 0.04, 0.2 * 0.96 + 0.04), abs=0.01)


def test_mirrors_and_glass(add_plane: AddObject) -> None:
    looks = {
        "Mirror": new_material("Mirror", Base_Color=RGBA, Metallic=1.0, Roughness=0.0),
        "Gloss": new_material("Gloss", "ShaderNodeBsdfAnisotropic", Color=RGBA, Roughness=0.05),
        "Glass": new_material("Glass", "ShaderNodeBsdfGlass", Color=RGBA, Roughness=0.0, IOR=1.33),
        "Window": new_material("Window", Base_Color=(1, 1, 1, 1), Transmission_Weight=1.0, Roughness=0.0, IOR=1.5),
        "Veil": new_material("Veil", "ShaderNodeBsdfTransparent", Color=(0.6, 0.6, 0.6, 1)),
    }
    for name, material in looks.items():
        add_plane(name, material=material)
    _, appearance = evaluate()
    m = {x.name: x for x in appearance.materials}
    for name in ("Mirror", "Gloss"):
        assert m[name].specular == pytest.approx((0.8, 0.4, 0.2), abs=1e-5)
        assert max(m[name].albedo) < 0.01
    assert m["Glass"].transmission == pytest.approx((0.8, 0.4, 0.2), abs=1e-5)
    assert m["Glass"].ior == pytest.approx(1.33)
    assert m["Window"].transmission == pytest.approx((1, 1, 1))
    assert max(m["Glass"].albedo + m["Window"].albedo + m["Veil"].albedo) < 0.01
    assert m["Veil"].opacity == pytest.approx(0.4)


def test_rough_glass_passes_light_and_is_told(add_plane: AddObject) -> None:
    add_plane("A", material=new_material("Frost", Base_Color=(0.25, 1, 1, 1), Transmission_Weight=1.0, Roughness=0.5))
    add_plane("B", material=new_material("Milk", "ShaderNodeBsdfGlass", Color=RGBA, Roughness=0.5))
    _, appearance = evaluate()
    m = {x.name: x for x in appearance.materials}
    assert m["Frost"].transmission == pytest.approx((0.5, 1, 1))
    assert m["Milk"].transmission == pytest.approx((0.8, 0.4, 0.2), abs=1e-5)
    assert sorted(w.split(":")[0] for w in appearance.warnings) == ["material Frost", "material Milk"]
    assert all("is rough; light passes it as if it were clear" in w for w in appearance.warnings)


def test_mixed_shaders(add_plane: AddObject) -> None:
    material = new_material("Mix", "ShaderNodeMixShader", Fac=0.25)
    mix = surface(material)
    diffuse = add_node(material, "ShaderNodeBsdfDiffuse", Color=RGBA)
    mirror = add_node(material, "ShaderNodeBsdfAnisotropic", Color=(1, 1, 1, 1), Roughness=0.0)
    material.node_tree.links.new(diffuse.outputs[0], mix.inputs[1])
    material.node_tree.links.new(mirror.outputs[0], mix.inputs[2])
    add_plane(material=material)
    _, appearance = evaluate()
    assert only(appearance).specular == pytest.approx((0.25, 0.25, 0.25))
    assert only(appearance).albedo == pytest.approx((0.6, 0.3, 0.15), abs=3e-3)


def test_a_tree_of_plain_nodes_is_evaluated_by_cycles(add_plane: AddObject) -> None:
    """Gamma of a mixed colour inside a group: nothing that reading sockets would tell."""
    material = new_material("Tree", "ShaderNodeBsdfDiffuse")
    group = bpy.data.node_groups.new("Group", "ShaderNodeTree")
    group.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    rgb, gamma, end = (group.nodes.new(k) for k in ("ShaderNodeRGB", "ShaderNodeGamma", "NodeGroupOutput"))
    rgb.outputs[0].default_value = (0.25, 0.5, 0.75, 1)
    gamma.inputs["Gamma"].default_value = 2.0
    group.links.new(rgb.outputs[0], gamma.inputs["Color"])
    group.links.new(gamma.outputs[0], end.inputs[0])
    node = add_node(material, "ShaderNodeGroup")
    node.node_tree = group
    link(material, node, 0, "Color")
    add_plane(material=material)
    _, appearance = evaluate()
    assert only(appearance).albedo == pytest.approx((0.0625, 0.25, 0.5625), abs=1e-4)
    assert appearance.albedo_maps == [None]


def test_emission_is_strength_times_colour(add_plane: AddObject) -> None:
    add_plane(material=new_material("Lamp", "ShaderNodeEmission", Color=RGBA, Strength=1e6))
    _, appearance = evaluate()
    assert only(appearance).emission == pytest.approx((8e5, 4e5, 2e5), rel=1e-5)
    assert only(appearance).albedo == (0, 0, 0)


def test_emission_is_radiance_as_cycles_sees_it(add_plane: AddObject, lamp: bpy.types.Object) -> None:
    """A wide ceiling of radiance L gives a small floor nearly π L; here 2 m above a 20 m ceiling, by form factor."""
    bpy.data.objects.remove(lamp)
    add_plane(
        "Ceiling", size=20.0, location=(0, 0, 2), material=new_material("Glow", "ShaderNodeEmission", Strength=3.0)
    )
    source = extract_source([1], silent)
    appearance = evaluate_materials(source, flat_layouts(source), [(4, 4)], silent)
    radiance = only(appearance).emission[0]
    floor = add_plane("Floor", size=0.1)
    layer = floor.data.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    image = bpy.data.images.new("bake", 4, 4, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    white = new_material("White", "ShaderNodeBsdfDiffuse")
    white.node_tree.nodes.active = add_image(white, image)
    floor.data.materials.append(white)
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.use_adaptive_sampling = 1024, False
    bpy.context.view_layer.objects.active = floor
    floor.select_set(True)
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, margin=0)
    pixels = np.zeros(64, np.float32)
    image.pixels.foreach_get(pixels)
    half, height = 10.0, 2.0
    side = half / np.hypot(half, height)
    form_factor = 4 * side / np.pi * np.arctan(half / np.hypot(half, height))  # a point below the middle of a square
    assert pixels.reshape(-1, 4)[:, 0].mean() * np.pi == pytest.approx(np.pi * radiance * form_factor, rel=0.01)


def test_albedo_above_one_is_clamped_and_told(add_plane: AddObject) -> None:
    add_plane(material=new_material("Hot", "ShaderNodeBsdfDiffuse", Color=(1.5, 0.5, 1.0, 1)))
    _, appearance = evaluate()
    assert only(appearance).albedo == pytest.approx((1, 0.5, 1), abs=1e-5)
    (warning,) = appearance.warnings
    assert warning.startswith("material Hot: reflects more light than it gets (1.5)")


def test_faces_without_material_are_blenders_grey(add_plane: AddObject) -> None:
    add_plane()
    _, appearance = evaluate()
    assert only(appearance).albedo == pytest.approx((0.8, 0.8, 0.8))


def test_an_eevee_output_does_not_count(add_plane: AddObject) -> None:
    material = new_material("Two", "ShaderNodeBsdfDiffuse", Color=RGBA)
    output = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeOutputMaterial")
    output.target = "CYCLES"
    eevee = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
    eevee.target = "EEVEE"
    glow = add_node(material, "ShaderNodeEmission", Strength=100.0)
    material.node_tree.links.new(glow.outputs[0], eevee.inputs["Surface"])
    add_plane(material=material)
    _, appearance = evaluate()
    assert only(appearance).emission == (0, 0, 0)
    assert only(appearance).albedo == pytest.approx((0.8, 0.4, 0.2), abs=1e-5)


# --- maps -----------------------------------------------------------------------------------------------------------


def quadrants(picture: np.ndarray) -> np.ndarray:
    """(4, 3) lower left, lower right, upper left, upper right, well inside each."""
    n = len(picture)
    a, b = n // 4, 3 * n // 4
    return np.array([picture[a, a], picture[a, b], picture[b, a], picture[b, b]])


CHECKER = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], float)


def test_textures_land_where_the_layout_says(add_plane: AddObject) -> None:
    material = new_material("Tiles", "ShaderNodeBsdfDiffuse")
    link(material, add_image(material, checker()), "Color", "Color")
    obj = add_plane(material=material)
    add_uv(obj)
    _, appearance = evaluate()
    assert appearance.albedo_maps[0].shape == (SIZE, SIZE, 3)
    assert np.allclose(quadrants(appearance.albedo_maps[0]), CHECKER, atol=1e-3)
    assert appearance.emission_maps == [None]
    assert only(appearance).albedo == pytest.approx((0.5, 0.5, 0.5), abs=0.02)


def test_a_layout_that_cuts_polygons_turns_the_picture(add_plane: AddObject) -> None:
    """Each triangle of the quad has an island of its own, half the size; the shader still reads the user's UV map."""
    material = new_material("Tiles", "ShaderNodeBsdfDiffuse")
    link(material, add_image(material, checker()), "Color", "Color")
    obj = add_plane(material=material)
    add_uv(obj)
    source = extract_source([1], silent)
    (mesh,) = source.meshes
    uv = (mesh.vertices[mesh.triangles][..., :2] + 1) / 2 * 0.5
    uv[1] += 0.5
    layout = Layout(uv.astype(np.float32), np.array([0, 1], np.int32), (4.0, 4.0))
    appearance = evaluate_materials(source, [layout], [(32, 32)], silent)
    picture = appearance.albedo_maps[0]
    user = (mesh.vertices[mesh.triangles][..., :2] + 1) / 2
    for triangle in range(2):
        for weights in ((0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8)):
            u, v = np.asarray(weights) @ uv[triangle]
            s, t = np.asarray(weights) @ user[triangle]
            expected = CHECKER[int(t > 0.5) * 2 + int(s > 0.5)]
            assert np.allclose(picture[int(v * 32), int(u * 32)], expected, atol=1e-3)


def test_the_render_uv_map_is_the_one_a_texture_uses(add_plane: AddObject) -> None:
    material = new_material("Tiles", "ShaderNodeBsdfDiffuse")
    link(material, add_image(material, checker()), "Color", "Color")
    obj = add_plane(material=material)
    add_uv(obj, "Other", scale=0.0)
    add_uv(obj, "Real")
    obj.data.uv_layers["Real"].active_render = True
    obj.data.uv_layers.active = obj.data.uv_layers["Other"]
    _, appearance = evaluate()
    assert np.allclose(quadrants(appearance.albedo_maps[0]), CHECKER, atol=1e-3)


def test_colour_attributes(add_plane: AddObject) -> None:
    material = new_material("Painted", "ShaderNodeBsdfDiffuse")
    node = add_node(material, "ShaderNodeVertexColor")
    node.layer_name = "Paint"
    link(material, node, "Color", "Color")
    obj = add_plane(material=material)
    paint = obj.data.color_attributes.new("Paint", "FLOAT_COLOR", "CORNER")
    paint.data.foreach_set("color", np.tile([0.2, 0.4, 0.6, 1.0], 4).astype(np.float32))
    _, appearance = evaluate()
    assert np.allclose(appearance.albedo_maps[0], (0.2, 0.4, 0.6), atol=2e-3)


def test_world_positions_are_those_of_the_object(add_plane: AddObject) -> None:
    material = new_material("Where", "ShaderNodeBsdfDiffuse")
    link(material, add_node(material, "ShaderNodeNewGeometry"), "Position", "Color")
    add_plane(material=material, location=(1.0, 1.0, 0.5))
    _, appearance = evaluate()
    picture = appearance.albedo_maps[0]
    at = (np.arange(SIZE) + 0.5) / SIZE * 2
    # Positions run from 0 to 2; what is above 1 is clamped, and told.
    assert np.allclose(picture[:, :, 0], np.minimum(at, 1)[None, :], atol=0.08)
    assert np.allclose(picture[:, :, 1], np.minimum(at, 1)[:, None], atol=0.08)
    assert np.allclose(picture[:, :, 2], 0.5, atol=2e-3)
    assert "clamped to 1" in appearance.warnings[0]


def test_object_info_is_that_of_the_first_instance_and_told(add_plane: AddObject) -> None:
    material = new_material("Tinted", "ShaderNodeBsdfDiffuse")
    link(material, add_node(material, "ShaderNodeObjectInfo"), "Color", "Color")
    first = add_plane("First", material=material)
    first.color = (0.1, 0.2, 0.3, 1.0)
    _, alone = evaluate()
    assert np.allclose(alone.albedo_maps[0], (0.1, 0.2, 0.3), atol=2e-3)
    assert alone.warnings == ()
    second = bpy.data.objects.new("Second", first.data)
    second.color = (0.9, 0.9, 0.9, 1.0)
    bpy.context.scene.collection.objects.link(second)
    _, shared = evaluate()
    assert np.allclose(shared.albedo_maps[0], (0.1, 0.2, 0.3), atol=2e-3)
    (warning,) = shared.warnings
    assert "all 2 instances of First are baked with the look of First" in warning


def test_textured_emission(add_plane: AddObject) -> None:
    material = new_material("Screen", "ShaderNodeEmission", Strength=7.0)
    link(material, add_image(material, checker()), "Color", "Color")
    obj = add_plane(material=material)
    add_uv(obj)
    _, appearance = evaluate()
    assert np.allclose(quadrants(appearance.emission_maps[0]), 7 * CHECKER, atol=1e-2)
    assert appearance.albedo_maps[0].max() == 0


def test_a_textured_part_beside_a_mirror(add_mesh: AddObject) -> None:
    """Two faces, two materials, one map: the mirror's own share must not become diffuse, nor the tiles' be lost."""
    tiles = new_material("Tiles", "ShaderNodeBsdfPrincipled", Specular_IOR_Level=0.0)
    link(tiles, add_image(tiles, checker()), "Color", "Base Color")
    mirror = new_material("Mirror", Base_Color=RGBA, Metallic=1.0, Roughness=0.0)
    obj = add_mesh(
        "Both", [(-1, -1, 0), (0, -1, 0), (0, 1, 0), (-1, 1, 0), (1, -1, 0), (1, 1, 0)], [(0, 1, 2, 3), (1, 4, 5, 2)]
    )
    add_uv(obj)
    obj.data.materials.append(tiles)
    obj.data.materials.append(mirror)
    obj.data.polygons[1].material_index = 1
    _, appearance = evaluate()
    assert np.allclose(quadrants(appearance.albedo_maps[0]), CHECKER * [[1], [0], [1], [0]], atol=1e-2)
    assert {m.name: m.specular for m in appearance.materials}["Mirror"] == pytest.approx((0.8, 0.4, 0.2), abs=1e-5)


def test_only_textured_meshes_get_maps(add_plane: AddObject) -> None:
    tiles = new_material("Tiles", "ShaderNodeBsdfDiffuse")
    link(tiles, add_image(tiles, checker()), "Color", "Color")
    add_uv(add_plane("Tiled", material=tiles))
    add_plane("Plain", material=new_material("Plain", "ShaderNodeBsdfDiffuse", Color=RGBA))
    source, appearance = evaluate()
    has = {source.meshes[i.mesh].name: appearance.albedo_maps[i.mesh] is not None for i in source.instances}
    assert has == {"Tiled": True, "Plain": False}


def test_a_textured_mesh_that_appears_late(add_plane: AddObject) -> None:
    tiles = new_material("Tiles", "ShaderNodeBsdfDiffuse")
    link(tiles, add_image(tiles, checker()), "Color", "Color")
    obj = add_plane("Late", material=tiles)
    add_uv(obj)
    for frame, hidden in ((1, True), (4, False)):
        obj.hide_render = hidden
        obj.keyframe_insert("hide_render", frame=frame)
    add_plane("Always")
    bpy.context.scene.frame_set(1)
    source = extract_source([1, 4], silent)
    appearance = evaluate_materials(source, flat_layouts(source), [(SIZE, SIZE)] * 2, silent)
    late = next(i.mesh for i in source.instances if i.name == "Late")
    assert np.allclose(quadrants(appearance.albedo_maps[late]), CHECKER, atol=1e-3)
    assert bpy.context.scene.frame_current == 1


# --- limits and errors ----------------------------------------------------------------------------------------------


def test_varying_shares_are_told(add_plane: AddObject) -> None:
    material = new_material("Leaf", Base_Color=RGBA)
    link(material, add_image(material, checker()), "Alpha", "Alpha")
    add_uv(add_plane(material=material))
    _, appearance = evaluate()
    assert only(appearance).opacity == 1
    assert any(w.startswith("material Leaf: the alpha of") for w in appearance.warnings)


def test_volumes_and_displacement_are_told(add_plane: AddObject) -> None:
    material = new_material("Deep", "ShaderNodeBsdfDiffuse")
    output = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeOutputMaterial")
    tree = material.node_tree
    tree.links.new(add_node(material, "ShaderNodeVolumeScatter").outputs[0], output.inputs["Volume"])
    tree.links.new(add_node(material, "ShaderNodeDisplacement").outputs[0], output.inputs["Displacement"])
    material.displacement_method = "BUMP"
    add_plane(material=material)
    assert [w.split(";")[0] for w in evaluate()[1].warnings] == ["material Deep: its volume is not baked"]
    material.displacement_method = "DISPLACEMENT"
    assert [w.split(";")[0] for w in evaluate()[1].warnings] == [
        "material Deep: its volume is not baked",
        "material Deep: its displacement does not move the baked surface",
    ]


def test_an_animated_texture_is_told(add_plane: AddObject) -> None:
    material = new_material("Film", "ShaderNodeEmission")
    link(material, add_image(material, checker()), "Color", "Color")
    strength = surface(material).inputs["Strength"]
    for frame, value in ((1, 1.0), (5, 9.0)):
        strength.default_value = value
        strength.keyframe_insert("default_value", frame=frame)
    add_uv(add_plane("Screen", material=material))
    bpy.context.scene.frame_set(1)
    _, appearance = evaluate()
    assert np.allclose(quadrants(appearance.emission_maps[0]), CHECKER, atol=1e-2)
    assert appearance.warnings == (
        "material Film: is animated and Screen is textured; it keeps its look of the first frame",
    )


def test_a_missing_image_file_names_material_and_file(add_plane: AddObject, tmp_path: Path) -> None:
    material = new_material("Wall", "ShaderNodeBsdfDiffuse")
    image = bpy.data.images.new("gone", 4, 4)
    image.source, image.filepath = "FILE", str(tmp_path / "bricks.png")
    link(material, add_image(material, image), "Color", "Color")
    add_plane(material=material)
    with pytest.raises(BakeError, match=r"material Wall: image file .*bricks.png is missing; restore"):
        evaluate()


def test_an_unused_missing_image_does_not_matter(add_plane: AddObject, tmp_path: Path) -> None:
    material = new_material("Wall", "ShaderNodeBsdfDiffuse", Color=RGBA)
    image = bpy.data.images.new("gone", 4, 4)
    image.source, image.filepath = "FILE", str(tmp_path / "bricks.png")
    add_image(material, image)
    add_plane(material=material)
    assert evaluate()[1].albedo_maps == [None]


def test_no_light_at_all_is_an_error(add_plane: AddObject, lamp: bpy.types.Object) -> None:
    add_plane()
    lamp.data.energy = 0
    with pytest.raises(BakeError, match="the scene has no light") as fault:
        evaluate()
    assert "add a lamp" in fault.value.problems[0]
    bpy.data.objects["Plane"].data.materials.append(new_material("Glow", "ShaderNodeEmission"))
    assert evaluate()[1].materials[0].emission == (1, 1, 1)


def test_users_materials_are_unchanged_and_nothing_is_left(add_plane: AddObject) -> None:
    tiles = new_material("Tiles", "ShaderNodeBsdfDiffuse")
    link(tiles, add_image(tiles, checker()), "Color", "Color")
    obj = add_plane(material=tiles)
    add_uv(obj)
    active = tiles.node_tree.nodes.active

    def state() -> list[object]:
        kinds = ("scenes", "objects", "meshes", "materials", "node_groups", "cameras", "worlds")
        blocks = [[b.name for b in getattr(bpy.data, kind)] for kind in kinds]
        images = [i.name for i in bpy.data.images if i.name != "Render Result"]
        nodes = [(n.name, n.select) for n in tiles.node_tree.nodes]
        return [blocks, images, nodes, [layer.name for layer in obj.data.uv_layers], len(tiles.node_tree.links)]

    before = state()
    evaluate()
    assert state() == before
    assert tiles.node_tree.nodes.active == active


def test_same_input_same_bits(add_plane: AddObject) -> None:
    material = new_material("Noise", "ShaderNodeBsdfDiffuse")
    link(material, add_node(material, "ShaderNodeTexNoise", Scale=9.0), "Color", "Color")
    add_plane(material=material)
    first, second = (evaluate()[1].albedo_maps[0] for _ in range(2))
    assert np.array_equal(first, second)
    assert first.std() > 0.01
