# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's lamps as backend lights: the one place where Blender's units become ``scene.Light``.

Formulas are Cycles' own (scene/light.cpp, kernel/light/*.h of Blender 4.5), each held to Cycles by
tests/blender/test_light_units.py. Settings that only Eevee knows are told, not followed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import bpy
import numpy as np

from ..backend.scene import BLACK, AreaShape, Float64, Light, LightKind
from . import nodes
from .placed import Key, placed_lights

Warn = Callable[[str], None]
RGB = tuple[float, float, float]

KINDS = {"POINT": LightKind.POINT, "SPOT": LightKind.SPOT, "SUN": LightKind.SUN, "AREA": LightKind.AREA}
#: The narrowest spread of an area lamp, rad. Cycles knows a beam of spread 0; its light is a Dirac in angle.
MIN_SPREAD = math.radians(1)


def lights_of(depsgraph: bpy.types.Depsgraph, warn: Warn) -> dict[Key, Light]:
    """Every lamp that a render would use, in the depsgraph's order; those that send nothing out too."""
    return {
        key: light_of(obj, name, matrix, warn)
        for key, name, obj, matrix in placed_lights(depsgraph)
        if not _is_portal(obj.data)
    }


def in_order(found: Mapping[Key, Light], keys: Sequence[Key], known: Sequence[Light]) -> tuple[Light, ...]:
    """The lamps of one frame as all frames have them: under the names and in the places of ``known``, by ``keys``.

    A lamp's place seeds its samples, so it never changes; one that is not ``found`` stands there as known, but dark.
    """
    return tuple(
        replace(found[key], name=light.name) if key in found else replace(light, power=BLACK)
        for key, light in zip(keys, known, strict=True)
    )


def light_of(obj: bpy.types.Object, name: str, matrix: Float64, warn: Warn) -> Light:
    """One lamp. ``matrix`` (4, 4) object to world, its scale counts for area lamps."""
    lamp = obj.data
    _tell_unfollowed(obj, name, warn)
    power = _colour_strength(lamp, name, warn)
    if not obj.visible_diffuse:
        power = np.zeros(3)
    common = {
        "name": name,
        "kind": KINDS[lamp.type],
        "matrix_world": matrix,
        "casts_shadow": bool(lamp.use_shadow),
    }
    if lamp.type == "SUN":
        return _sun(lamp, power, common)
    if lamp.type == "AREA":
        return _area(lamp, power, matrix, name, common, warn)
    return _point_or_spot(lamp, power, matrix, name, common, warn)


def _sun(lamp: bpy.types.Light, power: Float64, common: dict[str, object]) -> Light:
    half = lamp.angle / 2
    if not _normalized(lamp) and half > 0:
        power = power * math.pi * math.sin(half) ** 2  # the strength is radiance then
    return Light(power=_rgb(power), angle=half, **common)


def _area(
    lamp: bpy.types.Light, power: Float64, matrix: Float64, name: str, common: dict[str, object], warn: Warn
) -> Light:
    axes = matrix[:3, :2]
    lengths = np.sqrt((axes * axes).sum(axis=0))
    if abs(float(axes[:, 0] @ axes[:, 1])) > 1e-3 * float(lengths.prod()):
        warn(f"{name}: its transform is sheared, so the lamp is a parallelogram; it is taken as a rectangle")
    across = lamp.size if lamp.shape in {"SQUARE", "DISK"} else lamp.size_y
    width, height = float(lamp.size * lengths[0]), float(across * lengths[1])
    ellipse = lamp.shape in {"DISK", "ELLIPSE"}
    if not _normalized(lamp):
        power = power * width * height * (math.pi / 4 if ellipse else 1)
    if lamp.spread < MIN_SPREAD:
        warn(f"{name}: a spread of {math.degrees(lamp.spread):.2f} degrees is taken as 1 degree")
    return Light(
        power=_rgb(power),
        size=(width, height),
        shape=AreaShape.ELLIPSE if ellipse else AreaShape.RECTANGLE,
        spread=min(max(float(lamp.spread), MIN_SPREAD), math.pi),
        **common,
    )


def _point_or_spot(
    lamp: bpy.types.Light, power: Float64, matrix: Float64, name: str, common: dict[str, object], warn: Warn
) -> Light:
    radius = float(lamp.shadow_soft_size)
    if not _normalized(lamp):
        # The strength is π times the radiance then; a lamp without a radius gets 4 (measured, Cycles 4.5 to 5.2).
        power = power * (4 * math.pi * radius**2 if radius > 0 else 4)
    soft = bool(getattr(lamp, "use_soft_falloff", True))
    if lamp.type == "POINT":
        return Light(power=_rgb(power), radius=radius, soft_falloff=soft, **common)
    cone = _cone(lamp, matrix, name, warn)
    return Light(power=_rgb(power), radius=radius, soft_falloff=soft, cone=cone, blend=float(lamp.spot_blend), **common)


def _cone(lamp: bpy.types.Light, matrix: Float64, name: str, warn: Warn) -> float:
    """Half angle in the world: scale widens or narrows the cone, as its inverse transforms the ray in Cycles."""
    x, y, z = np.sqrt((matrix[:3, :3] ** 2).sum(axis=0))
    half = float(lamp.spot_size) / 2
    if z <= 0 or np.allclose([x, y], z, rtol=1e-4) or half >= math.pi / 2:
        return half
    if abs(x - y) > 1e-3 * max(x, y):
        warn(f"{name}: its scale makes the cone an ellipse; a round cone of the same solid angle is taken")
    return math.atan(math.tan(half) * math.sqrt(x * y) / z)


def _colour_strength(lamp: bpy.types.Light, name: str, warn: Warn) -> Float64:
    """(3,) colour times energy, exposure, temperature and what a plain node tree multiplies."""
    strength = np.array(lamp.color, np.float64) * lamp.energy
    strength = strength * 2.0 ** getattr(lamp, "exposure", 0.0)  # since Blender 4.5, as the two below
    if getattr(lamp, "use_temperature", False):
        strength = strength * np.array(lamp.temperature_color, np.float64)
    if nodes.uses_nodes(lamp):
        strength = strength * _node_factor(lamp, name, warn)
    if (strength < 0).any():
        warn(f"{name}: negative light is not baked; its negative channels count as zero")
    return np.maximum(strength, 0)


def _node_factor(lamp: bpy.types.Light, name: str, warn: Warn) -> Float64:
    """(3,) colour times strength of the Emission node at the output."""
    shader = nodes.output_link(lamp.node_tree, "ShaderNodeOutputLight", "Surface")
    if shader is None:
        return np.zeros(3)
    if shader.bl_idname == "ShaderNodeEmission":
        colour, strength = (nodes.constant_input(shader, key) for key in ("Color", "Strength"))
        if colour is not None and strength is not None:
            return np.array(colour[:3], np.float64) * strength[0]
    warn(f"{name}: its node tree is more than a plain Emission; the lamp is baked without the nodes")
    return np.ones(3)


def _tell_unfollowed(obj: bpy.types.Object, name: str, warn: Warn) -> None:
    lamp = obj.data
    if lamp.use_custom_distance:
        warn(f"{name}: its custom distance is Eevee's alone; the bake lets the light fall off as it does by nature")
    if not obj.visible_diffuse:
        warn(f"{name}: hidden from diffuse rays; it sends no light into the bake")
    linking = getattr(obj, "light_linking", None)
    if linking is not None and (linking.receiver_collection or linking.blocker_collection):
        warn(f"{name}: light linking is not followed; the lamp lights and is blocked by everything in the bake")


def _is_portal(lamp: bpy.types.Light) -> bool:
    return lamp.type == "AREA" and bool(getattr(lamp.cycles, "is_portal", False))


def _normalized(lamp: bpy.types.Light) -> bool:
    return bool(getattr(lamp, "normalize", True))


def _rgb(values: Float64) -> RGB:
    red, green, blue = (float(v) for v in values)
    return red, green, blue
