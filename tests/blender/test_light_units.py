# SPDX-License-Identifier: GPL-3.0-or-later
"""Each lamp setting against Cycles: the backend Light that extraction makes must light a plane as Cycles does.

Cycles' direct diffuse bake without colour is E/π. The expected irradiance is computed here, by closed form or dense
quadrature, from what ``backend.scene.Light`` documents; the backend's own sampling is not involved.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from rtgi_addon.backend.scene import AreaShape, Light, LightKind
from rtgi_addon.extract import extract_source

SIZE = 16  # texels a side of the receiver
RECEIVER = 2.0  # m


def silent(*_args: object) -> None:
    pass


# --- what the docstring of Light promises ---------------------------------------------------------------------------


def expected_irradiance(light: Light, points: np.ndarray) -> np.ndarray:
    """(n, 3) W/m² on surfaces at ``points`` (n, 3) that face +z, nothing in between."""
    matrix = np.asarray(light.matrix_world)
    position, columns = matrix[:3, 3], matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    axis = -columns[:, 2]
    if light.kind == LightKind.SUN:
        # Uniform radiance in a cone that lies above the horizon: as if all came from its axis.
        factor = np.full(len(points), max(-axis[2], 0.0))
    elif light.kind == LightKind.AREA:
        factor = _area_factor(light, points, position, columns, axis)
    else:
        factor = np.array([_point_factor(light, p, position, axis) for p in points])
    return factor[:, None] * np.asarray(light.power)


def _point_factor(light: Light, point: np.ndarray, position: np.ndarray, axis: np.ndarray) -> float:
    towards = position - point
    squared = float(towards @ towards)
    distance = math.sqrt(squared)
    if light.radius == 0:
        direction = towards / distance
        return _spot(light, -direction @ axis) * direction[2] / (4 * np.pi * squared)
    # Uniform radiance 1 / (4π² r²) in the cone that the lamp fills: a disk across the line of sight, or a sphere.
    r = light.radius
    outer = math.atan2(r, distance) if light.soft_falloff else math.asin(r / distance)
    cos_theta, phi = np.meshgrid(
        math.cos(outer) + (1 - math.cos(outer)) * (np.arange(64) + 0.5) / 64,
        2 * np.pi * (np.arange(64) + 0.5) / 64,
        indexing="ij",
    )
    z = towards / distance
    x = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    sin_theta = np.sqrt(1 - cos_theta**2)
    rays = (
        (sin_theta * np.cos(phi))[..., None] * x
        + (sin_theta * np.sin(phi))[..., None] * np.cross(z, x)
        + cos_theta[..., None] * z
    )
    solid_angle = 2 * np.pi * (1 - math.cos(outer))
    seen = _spot(light, -rays @ axis) * np.maximum(rays[..., 2], 0)
    return float(seen.mean() * solid_angle / (4 * np.pi**2 * r**2))


def _spot(light: Light, cosine: np.ndarray) -> np.ndarray:
    if light.kind == LightKind.POINT:
        return np.ones_like(cosine)
    edge = math.cos(light.cone)
    width = (1 - edge) * light.blend
    t = np.clip((cosine - edge) / width, 0, 1) if width > 0 else (cosine >= edge).astype(float)
    return t * t * (3 - 2 * t)


def _area_factor(
    light: Light, points: np.ndarray, position: np.ndarray, columns: np.ndarray, axis: np.ndarray
) -> np.ndarray:
    n = 96
    grid = (np.arange(n) + 0.5) / n
    if light.shape == AreaShape.ELLIPSE:
        radius, phi = np.meshgrid(np.sqrt(grid) / 2, 2 * np.pi * grid, indexing="ij")
        across, along = radius * np.cos(phi), radius * np.sin(phi)
    else:
        across, along = np.meshgrid(grid - 0.5, grid - 0.5, indexing="ij")
    on_lamp = (
        position
        + (across.ravel() * light.size[0])[:, None] * columns[:, 0]
        + (along.ravel() * light.size[1])[:, None] * columns[:, 1]
    )
    out = np.zeros(len(points))
    for i, point in enumerate(points):
        towards = on_lamp - point
        squared = (towards**2).sum(axis=1)
        direction = towards / np.sqrt(squared)[:, None]
        emitted = np.maximum(-direction @ axis, 0)
        profile = np.ones_like(emitted)
        if light.spread < np.pi - 1e-6:
            half = light.spread / 2
            angle = np.arccos(np.clip(emitted, 0, 1))
            profile = np.maximum(math.tan(half) - np.tan(angle), 0) / (math.tan(half) - half) * (emitted > 0)
        out[i] = (profile * emitted * np.maximum(direction[:, 2], 0) / squared).mean() / np.pi
    return out


# --- what Cycles says ----------------------------------------------------------------------------------------------


def cycles_irradiance(scene: bpy.types.Scene, plane: bpy.types.Object, samples: int) -> np.ndarray:
    """(SIZE * SIZE, 3) W/m², row by row from the bottom."""
    image = bpy.data.images.new("bake", SIZE, SIZE, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    material = bpy.data.materials.new("white")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    diffuse, output = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(diffuse.outputs[0], output.inputs[0])
    target = tree.nodes.new("ShaderNodeTexImage")
    target.image = image
    tree.nodes.active = target
    plane.data.materials.append(material)
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    bpy.context.view_layer.objects.active = plane
    plane.select_set(True)
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, margin=0, use_clear=True)
    pixels = np.zeros(SIZE * SIZE * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(-1, 4)[:, :3].astype(np.float64) * np.pi


@pytest.fixture
def receiver(add_plane: Callable[..., bpy.types.Object]) -> bpy.types.Object:
    """A square facing +z at the origin, with UVs."""
    plane = add_plane("Receiver", size=RECEIVER)
    layer = plane.data.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    return plane


def receiver_points(side: int) -> np.ndarray:
    """(side * side, 3) row by row from the bottom."""
    at = ((np.arange(side) + 0.5) / side - 0.5) * RECEIVER
    x, y = np.meshgrid(at, at)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def add_lamp(kind: str, matrix: Matrix, settings: dict[str, object]) -> bpy.types.Object:
    data = bpy.data.lights.new("Lamp", kind)
    data.energy = 100.0
    for key, value in settings.items():
        setattr(data, key, value)
    lamp = bpy.data.objects.new("Lamp", data)
    lamp.matrix_world = matrix
    bpy.context.scene.collection.objects.link(lamp)
    bpy.context.view_layer.update()
    return lamp


def use_nodes(lamp: bpy.types.Light) -> None:
    if bpy.app.version < (5, 2, 0):
        lamp.use_nodes = True


def compare(scene: bpy.types.Scene, receiver: bpy.types.Object, samples: int, tolerance: float = 0.01) -> Light:
    """The extracted lamp, after its irradiance was held to Cycles'."""
    (light,) = extract_source([1], silent).lights
    # The hard edge of a cone crosses texels, so those are averaged; quadrature over a lamp blurs its own edges.
    split = 8 if light.kind == LightKind.SPOT and light.radius == 0 else 1
    expected = expected_irradiance(light, receiver_points(SIZE * split))
    expected = expected.reshape(SIZE, split, SIZE, split, 3).mean(axis=(1, 3)).reshape(-1, 3)
    measured = cycles_irradiance(scene, receiver, samples)
    bright = expected.max(axis=1) > 0.02 * expected.max()
    assert bright.sum() >= SIZE, "the lamp misses the receiver: the test says nothing"
    ratio = measured[bright] / np.where(expected[bright] > 0, expected[bright], np.nan)
    assert np.nanmedian(np.abs(ratio - 1)) < tolerance
    assert measured[bright].sum() == pytest.approx(expected[bright].sum(), rel=tolerance)
    # Dark where it should be: the edge of a cone may cross a texel, no more.
    assert np.median(measured[~bright]) <= 0.03 * expected.max() if (~bright).any() else True
    return light


TILTED = Matrix.Translation((0.4, -0.3, 1.5)) @ Matrix.Rotation(0.5, 4, (1.0, 0.4, 0.2))
STRAIGHT = Matrix.Translation((0.3, 0.1, 1.5))
SCALED = TILTED @ Matrix.Diagonal((1.5, 0.6, 2.0, 1.0))

CASES = {
    "point": ("POINT", STRAIGHT, {}),
    "point_soft": ("POINT", STRAIGHT, {"shadow_soft_size": 0.5}),
    "point_sphere": ("POINT", STRAIGHT, {"shadow_soft_size": 0.5, "use_soft_falloff": False}),
    "point_scaled": ("POINT", SCALED, {"shadow_soft_size": 0.3}),
    "spot": ("SPOT", TILTED, {"spot_size": 1.4, "spot_blend": 0.0}),
    "spot_blend": ("SPOT", TILTED, {"spot_size": 1.2, "spot_blend": 0.7}),
    "spot_full_blend": ("SPOT", TILTED, {"spot_size": 1.8, "spot_blend": 1.0}),
    "spot_wide": ("SPOT", STRAIGHT, {"spot_size": math.pi, "spot_blend": 0.3}),
    "spot_soft": ("SPOT", TILTED, {"spot_size": 1.2, "spot_blend": 0.5, "shadow_soft_size": 0.3}),
    "spot_sphere": (
        "SPOT", TILTED, {"spot_size": 1.2, "spot_blend": 0.5, "shadow_soft_size": 0.3, "use_soft_falloff": False}
    ),
    "spot_stretched": (
        "SPOT", TILTED @ Matrix.Diagonal((1.5, 1.5, 1.0, 1.0)), {"spot_size": 0.9, "spot_blend": 0.0}
    ),
    "sun": ("SUN", TILTED, {"angle": 0.0}),
    "sun_wide": ("SUN", TILTED, {"angle": 0.6}),
    "area_square": ("AREA", TILTED, {"shape": "SQUARE", "size": 0.8}),
    "area_rectangle": ("AREA", TILTED, {"shape": "RECTANGLE", "size": 1.2, "size_y": 0.4}),
    "area_disk": ("AREA", TILTED, {"shape": "DISK", "size": 0.8}),
    "area_ellipse": ("AREA", TILTED, {"shape": "ELLIPSE", "size": 1.2, "size_y": 0.5}),
    "area_scaled": ("AREA", SCALED, {"shape": "RECTANGLE", "size": 0.8, "size_y": 0.7}),
    "area_ellipse_scaled": ("AREA", SCALED, {"shape": "ELLIPSE", "size": 0.8, "size_y": 0.7}),
    "area_spread": ("AREA", TILTED, {"shape": "RECTANGLE", "size": 1.0, "size_y": 0.7, "spread": 1.2}),
    "area_narrow": ("AREA", TILTED, {"shape": "SQUARE", "size": 1.5, "spread": 0.5}),
    "colour": ("POINT", STRAIGHT, {"color": (0.9, 0.5, 0.1)}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_lamp_lights_a_plane_as_cycles_does(name: str, empty_file: bpy.types.Scene, receiver: bpy.types.Object) -> None:
    kind, matrix, settings = CASES[name]
    add_lamp(kind, matrix, settings)
    plain = kind in {"POINT", "SPOT"} and not settings.get("shadow_soft_size")
    light = compare(empty_file, receiver, 64 if plain else 1024)
    if kind == "AREA":
        width, height = settings["size"], settings.get("size_y", settings["size"])
        scale = (1.5, 0.6) if matrix is SCALED else (1, 1)
        assert light.size == pytest.approx((width * scale[0], height * scale[1]), rel=1e-5)


SINCE_4_5 = pytest.mark.skipif(bpy.app.version < (4, 5, 0), reason="the setting came with Blender 4.5")
NEW_SETTINGS = {
    "exposure": ("POINT", {"exposure": 1.5}),
    "temperature": ("POINT", {"use_temperature": True, "temperature": 3000.0, "color": (1.0, 0.8, 0.9)}),
    "point_not_normalized": ("POINT", {"normalize": False, "shadow_soft_size": 0.3}),
    "point_no_radius_not_normalized": ("POINT", {"normalize": False}),
    "spot_not_normalized": ("SPOT", {"normalize": False, "shadow_soft_size": 0.2, "spot_size": 1.5}),
    "area_not_normalized": ("AREA", {"normalize": False, "shape": "RECTANGLE", "size": 0.8, "size_y": 0.5}),
    "ellipse_not_normalized": ("AREA", {"normalize": False, "shape": "ELLIPSE", "size": 0.8, "size_y": 0.5}),
    "sun_not_normalized": ("SUN", {"normalize": False, "angle": 0.4}),
    "sun_point_not_normalized": ("SUN", {"normalize": False, "angle": 0.0}),
}


@SINCE_4_5
@pytest.mark.parametrize("name", NEW_SETTINGS)
def test_newer_lamp_settings(name: str, empty_file: bpy.types.Scene, receiver: bpy.types.Object) -> None:
    kind, settings = NEW_SETTINGS[name]
    add_lamp(kind, TILTED, settings)
    compare(empty_file, receiver, 512)


def test_emission_nodes_of_a_lamp_multiply_its_light(empty_file: bpy.types.Scene, receiver: bpy.types.Object) -> None:
    lamp = add_lamp("POINT", STRAIGHT, {"color": (1.0, 0.5, 0.25)})
    use_nodes(lamp.data)
    emission = next(n for n in lamp.data.node_tree.nodes if n.bl_idname == "ShaderNodeEmission")
    emission.inputs["Strength"].default_value = 2.5
    emission.inputs["Color"].default_value = (0.5, 0.7, 1.0, 1.0)
    light = compare(empty_file, receiver, 64)
    assert light.power == pytest.approx((125.0, 87.5, 62.5), rel=1e-5)


def test_what_only_eevee_knows_is_told(empty_file: bpy.types.Scene, receiver: bpy.types.Object) -> None:
    add_lamp("POINT", STRAIGHT, {"use_custom_distance": True, "cutoff_distance": 0.5})
    compare(empty_file, receiver, 64)
    (warning,) = extract_source([1], silent).warnings
    assert warning.startswith("Lamp: its custom distance is Eevee's alone")


def test_an_odd_node_tree_is_told_and_left_out(empty_file: bpy.types.Scene, receiver: bpy.types.Object) -> None:
    lamp = add_lamp("POINT", STRAIGHT, {})
    use_nodes(lamp.data)
    tree = lamp.data.node_tree
    emission = next(n for n in tree.nodes if n.bl_idname == "ShaderNodeEmission")
    tree.links.new(tree.nodes.new("ShaderNodeTexNoise").outputs["Fac"], emission.inputs["Strength"])
    source = extract_source([1], silent)
    assert source.lights[0].power == (100.0, 100.0, 100.0)
    assert "node tree is more than a plain Emission" in source.warnings[0]


def test_hidden_lamps_give_no_light(empty_file: bpy.types.Scene, receiver: bpy.types.Object) -> None:
    add_lamp("POINT", STRAIGHT, {}).hide_render = True
    assert extract_source([1], silent).lights == ()


def test_shadow_casting_is_noted(empty_file: bpy.types.Scene, receiver: bpy.types.Object) -> None:
    add_lamp("POINT", STRAIGHT, {"use_shadow": False})
    assert not extract_source([1], silent).lights[0].casts_shadow
