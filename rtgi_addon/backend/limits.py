# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene may hold. Values that no light transport can follow are bounded here, before any stage, and told.

First step of a session and of each of its frames: arrays in, arrays and lines for the user out. What is within the
limits is passed on as it is, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np

from .errors import BakeError
from .scene import BLACK, Float32, FrameState, Light, Material, Mesh, Scene, World

#: A closed room that absorbs nothing has no solution. At 0.999 any room has one, at most a thousand times its direct
#: light, and no single reflection changes by more than 0.1 %.
MOST_ALBEDO = 0.999
DEFAULT_IOR = 1.45
#: The brightest light, W or W/(m² sr): the sun's surface has 2e7. Squares and sums of it stay within float32.
MOST_LIGHT = 1e15

Warn = Callable[[str], None]
RGB = tuple[float, float, float]


def bounded_scene(scene: Scene) -> tuple[Scene, list[str]]:
    """``scene`` within the limits, and a line for each thing that was changed; its lights are the frames' concern."""
    lines: list[str] = []
    meshes = tuple(_mesh(mesh, lines.append) for mesh in scene.meshes)
    return replace(scene, meshes=meshes, materials=_materials(scene.materials, lines.append)), lines


def bounded_state(state: FrameState, scene: Scene) -> tuple[FrameState, list[str]]:
    """The same for one frame. Raises BakeError where a transform is not finite."""
    lines: list[str] = []
    nowhere = np.nonzero(~np.isfinite(state.matrix_world).all(axis=(1, 2)))[0]
    if len(nowhere):
        remedy = "clear it, or mend the driver or constraint that makes it"
        raise BakeError(*(f"{scene.instances[i].name}: its transform is not finite; {remedy}" for i in nowhere))
    for index, vertices in state.vertices.items():
        if lost := int((~np.isfinite(vertices).all(axis=1)).sum()):
            where = f"frame {state.frame}: {lost} of its vertices are not finite; they are put at its origin"
            lines.append(f"{scene.meshes[index].name}: {where}")
    bounded = replace(
        state,
        lights=tuple(_light(light, lines.append) for light in state.lights),
        world=None if state.world is None else _world(state.world, lines.append),
        vertices={i: _finite(v) for i, v in state.vertices.items()},
        corner_normals={i: _finite(n) for i, n in state.corner_normals.items()},
        materials=None if state.materials is None else _materials(state.materials, lines.append),
    )
    return bounded, lines


def _materials(materials: Sequence[Material], warn: Warn) -> tuple[Material, ...]:
    return tuple(_material(material, warn) for material in materials)


def _material(material: Material, warn: Warn) -> Material:
    name = f"material {material.name}"
    albedo, specular, transmission = (
        _share(getattr(material, key), f"{name}: {key}", warn) for key in ("albedo", "specular", "transmission")
    )
    total = max(sum(parts) for parts in zip(albedo, specular, transmission, strict=True))
    if max(albedo) == 1 == max(material.albedo):
        warn(f"{name}: albedo 1 gives back all light; {MOST_ALBEDO} is used, since a closed room would have no limit")
    if total > 1 + 1e-5:
        warn(f"{name}: what it reflects and lets through adds up to {total:.3g} of the light; scaled to 1")
    ior, opacity = material.ior, material.opacity
    if not (np.isfinite(ior) and ior > 0):
        warn(f"{name}: an index of refraction of {ior} is taken as {DEFAULT_IOR}")
        ior = DEFAULT_IOR
    if not 0 <= opacity <= 1:
        warn(f"{name}: an opacity of {opacity} is taken as {0.0 if opacity < 0 else 1.0}")
        opacity = 0.0 if opacity < 0 else 1.0
    emission = _radiance(material.emission, name, warn)
    bounded = replace(
        material,
        albedo=_least(albedo),
        emission=emission,
        specular=specular,
        transmission=transmission,
        ior=ior,
        opacity=opacity,
    )
    return material if bounded == material else bounded


def _share(values: RGB, name: str, warn: Warn) -> RGB:
    """``values`` within [0, 1]."""
    bounded = np.clip(_finite(values), 0, 1)
    if not np.array_equal(bounded, values):
        text = ", ".join(f"{v:.3g}" for v in values)
        warn(f"{name} ({text}) does not lie between 0 and 1; clamped")
    return _rgb(bounded)


def _least(albedo: RGB) -> RGB:
    red, green, blue = (min(value, MOST_ALBEDO) for value in albedo)
    return red, green, blue


def _radiance(values: RGB, name: str, warn: Warn) -> RGB:
    bounded = _bounded_light(np.asarray(values), name, warn)
    return values if np.array_equal(bounded, values) else _rgb(bounded)


def _bounded_light(values: Float32, name: str, warn: Warn) -> Float32:
    finite = _finite(values)
    if not np.array_equal(np.maximum(finite, 0), values):
        warn(f"{name}: light that is negative or not finite counts as zero")
    if finite.max(initial=0) > MOST_LIGHT:
        warn(f"{name}: light above {MOST_LIGHT:g} counts as that much")
    return np.clip(finite, 0, MOST_LIGHT)


def _light(light: Light, warn: Warn) -> Light:
    """``light``, dark where any of its numbers is not finite."""
    numbers = [np.ravel(getattr(light, f.name)) for f in fields(Light) if f.name not in ("name", "kind", "shape")]
    if not np.isfinite(np.concatenate(numbers).astype(np.float64)).all():
        warn(f"{light.name}: a lamp with settings or a transform that are not finite gives no light")
        return Light(light.name, light.kind, np.eye(4), BLACK)
    power = _radiance(light.power, light.name, warn)
    return light if power == light.power else replace(light, power=power)


def _world(world: World, warn: Warn) -> World:
    bounded = _bounded_light(world.radiance, "world", warn)
    return world if np.array_equal(bounded, world.radiance) else World(bounded.astype(np.float32))


def _mesh(mesh: Mesh, warn: Warn) -> Mesh:
    bad = ~np.isfinite(mesh.vertices).all(axis=1)
    lost = bad[mesh.triangles].any(axis=1)
    vertices, triangles = mesh.vertices, mesh.triangles
    if bad.any():
        warn(f"{mesh.name}: {int(bad.sum())} of its vertices are not finite; {int(lost.sum())} triangles are left out")
        # The number of triangles stays: those left out shrink to a point, which no ray hits, on a vertex that is used.
        good = triangles[~lost]
        rest = vertices[good[0, 0]] if len(good) else np.zeros(3, np.float32)
        vertices = np.where(bad[:, None], rest, vertices).astype(np.float32)
        triangles = np.where(lost[:, None], triangles[:, :1], triangles)
    bounded = replace(
        mesh,
        vertices=vertices,
        triangles=triangles,
        corner_normals=_finite(mesh.corner_normals),
        corner_uv=_finite(mesh.corner_uv),
        albedo_map=None if mesh.albedo_map is None else _albedo_map(mesh.albedo_map, mesh.name, warn),
        emission_map=None if mesh.emission_map is None else _bounded_light(mesh.emission_map, mesh.name, warn),
    )
    return bounded


def _albedo_map(image: Float32, name: str, warn: Warn) -> Float32:
    bounded = np.clip(_finite(image), 0, MOST_ALBEDO).astype(np.float32)
    if not np.allclose(bounded, image, rtol=0, atol=1.1 * (1 - MOST_ALBEDO)):
        warn(f"{name}: its texture's albedo does not lie between 0 and 1 everywhere; clamped")
    elif image.size and bounded.min() >= np.float32(MOST_ALBEDO):
        warn(f"{name}: albedo 1 gives back all light; {MOST_ALBEDO} is used, since a closed room would have no limit")
    return bounded


def _finite(values: object) -> Float32:
    """``values`` with zero for what is not finite; the array itself where all is."""
    array = np.asarray(values)
    bad = ~np.isfinite(array)
    return np.where(bad, array.dtype.type(0), array) if bad.any() else array


def _rgb(values: Float32) -> RGB:
    red, green, blue = (float(v) for v in values)
    return red, green, blue
