# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials and pictures of the interior: Principled BSDF without specular, procedural wood, small packed images."""

from __future__ import annotations

import bpy
import numpy as np
from kit import Colour


def paint(name: str, colour: Colour) -> bpy.types.Material:
    """A Principled BSDF of one colour that only scatters diffusely."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.diffuse_color = (*colour, 1.0)
    bsdf = principled(material)
    bsdf.inputs["Base Color"].default_value = (*colour, 1.0)
    bsdf.inputs["Roughness"].default_value = 1.0
    bsdf.inputs["Specular IOR Level"].default_value = 0.0
    return material


def principled(material: bpy.types.Material) -> bpy.types.Node:
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def planks(name: str, light: Colour, dark: Colour) -> bpy.types.Material:
    """Floor boards in object space: bricks of 1.4 m × 16 cm, with noise drawn out along them for the grain."""
    material = paint(name, tuple((a + b) / 2 for a, b in zip(light, dark, strict=True)))
    nodes, links = material.node_tree.nodes, material.node_tree.links
    place, brick = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeTexBrick")
    brick.offset = 0.37
    for socket, value in (("Scale", 1.0), ("Brick Width", 1.4), ("Row Height", 0.16), ("Mortar Size", 0.003)):
        brick.inputs[socket].default_value = value
    for socket, colour in (("Color1", light), ("Color2", dark), ("Mortar", (0.03, 0.02, 0.012))):
        brick.inputs[socket].default_value = (*colour, 1.0)
    stretch, noise, mix = (nodes.new(f"ShaderNode{kind}") for kind in ("Mapping", "TexNoise", "MixRGB"))
    stretch.inputs["Scale"].default_value = (1.2, 22.0, 1.0)
    noise.inputs["Scale"].default_value = 2.0
    mix.blend_type = "MULTIPLY"
    mix.inputs["Fac"].default_value = 0.55
    links.new(place.outputs["Object"], brick.inputs["Vector"])
    links.new(place.outputs["Object"], stretch.inputs["Vector"])
    links.new(stretch.outputs["Vector"], noise.inputs["Vector"])
    links.new(brick.outputs["Color"], mix.inputs["Color1"])
    links.new(noise.outputs["Fac"], mix.inputs["Color2"])
    links.new(mix.outputs["Color"], principled(material).inputs["Base Color"])
    return material


def picture(name: str, pixels: np.ndarray) -> bpy.types.Material:
    """Paint with an image, laid on by the object's UV map. ``pixels`` (h, w, 3), sRGB-encoded, row 0 at the bottom."""
    material = paint(name, (0.5, 0.5, 0.5))
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = packed_image(name, pixels)
    material.node_tree.links.new(texture.outputs["Color"], principled(material).inputs["Base Color"])
    return material


def screen(name: str, pixels: np.ndarray, strength: float) -> bpy.types.Material:
    """A screen that shows ``pixels``: black for light from outside, ``strength`` W/(m² sr) where it is white."""
    material = paint(name, (0.01, 0.01, 0.01))
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = packed_image(name, pixels)
    bsdf = principled(material)
    material.node_tree.links.new(texture.outputs["Color"], bsdf.inputs["Emission Color"])
    bsdf.inputs["Emission Strength"].default_value = strength
    return material


def packed_image(name: str, pixels: np.ndarray, *, linear: bool = False) -> bpy.types.Image:
    """An image inside the .blend: 8 bits, or float for linear radiance."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=linear)
    rgba = np.concatenate([pixels, np.ones((height, width, 1))], -1).astype(np.float32)
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    image.pack()
    return image


def _grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel centres as x from 0 to width / height and y from 0 to 1, upward."""
    y, x = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / height, indexing="ij")
    return x, y


def landscape_pixels() -> np.ndarray:
    """A painting: a pale sun over four ranges of hills, in flat colours."""
    x, y = _grid(192, 128)
    image = np.array([0.93, 0.82, 0.68]) * np.ones((128, 192, 1))
    image[np.hypot(x - 1.02, y - 0.68) < 0.17] = (0.95, 0.55, 0.32)
    hills = ((0.58, 0.10, 3.1, 0.4, (0.80, 0.60, 0.52)), (0.42, 0.08, 4.3, 2.0, (0.55, 0.45, 0.48)))
    hills += ((0.28, 0.07, 5.2, 4.1, (0.27, 0.36, 0.42)), (0.13, 0.05, 6.7, 1.2, (0.12, 0.22, 0.28)))
    for base, swing, waves, phase, colour in hills:
        image[y < base + swing * np.sin(waves * x + phase)] = colour
    return image


def rug_pixels() -> np.ndarray:
    """Rows of diamonds inside a border, in four wools."""
    x, y = _grid(208, 144)
    wide = 208 / 144
    cream, red, blue, ochre = (0.86, 0.80, 0.70), (0.62, 0.24, 0.18), (0.18, 0.27, 0.40), (0.80, 0.58, 0.28)
    image = np.array(cream) * np.ones((144, 208, 1))
    u, v = np.abs((x * 7.2) % 1 - 0.5), np.abs((y * 5) % 1 - 0.5)
    image[u + v < 0.42] = red
    image[u + v < 0.26] = ochre
    image[u + v < 0.12] = blue
    edge = np.minimum(np.minimum(x, wide - x), np.minimum(y, 1 - y))
    for limit, colour in ((0.09, blue), (0.065, cream), (0.05, red)):
        image[edge < limit] = colour
    return image


def broadcast_pixels() -> np.ndarray:
    """What is on television: dusk over the sea."""
    x, y = _grid(96, 54)
    sky = np.array([0.95, 0.45, 0.25]) * (1 - y[..., None]) + np.array([0.15, 0.25, 0.7]) * y[..., None]
    sky += 0.5 * np.exp(-6 * np.hypot(x - 0.9, y - 0.45))[..., None] * np.array([1.0, 0.8, 0.4])
    sea = np.array([0.1, 0.3, 0.5]) + 0.25 * (np.sin(70 * y + 4 * np.sin(9 * x)) > 0.4)[..., None]
    return np.clip(np.where((y < 0.4)[..., None], sea, sky), 0, 1)


def sky_pixels() -> np.ndarray:
    """Radiance of a clear sky, W/(m² sr), latitude by longitude: bright at the horizon, deep above, earth below."""
    height = (np.arange(32) + 0.5) / 16 - 1  # from the nadir to the zenith
    zenith, horizon, earth = np.array([0.6, 1.25, 2.8]), np.array([2.6, 2.9, 3.2]), np.array([0.55, 0.62, 0.42])
    above = horizon + (zenith - horizon) * np.sqrt(np.clip(height, 0, 1))[:, None]
    haze = np.clip(height * 4 + 1, 0, 1)[:, None]  # the lowest quarter below the horizon
    return np.broadcast_to((earth + (above - earth) * haze)[:, None], (32, 64, 3))


def set_sky(world: bpy.types.World, pixels: np.ndarray) -> None:
    """Light ``world`` by an equirectangular image of radiance."""
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = packed_image("Sky", pixels, linear=True)
    background = next(node for node in nodes if node.type == "BACKGROUND")
    links.new(texture.outputs["Color"], background.inputs["Color"])
