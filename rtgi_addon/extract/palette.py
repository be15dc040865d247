# SPDX-License-Identifier: GPL-3.0-or-later
"""One value per material: all of them baked together on a palette of one quad each.

What Cycles bakes is split here into what diffuses and what goes on as a ray (see ``lobes``).
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ..backend.scene import Bool, Float32, Float64, Material
from .lobes import Lobes
from .meshes import UV_LAYER
from .texture_bake import Evaluated, bake_over_uv

#: Pixels of one material's cell of the palette; the inner ones are read.
CELL = 4
DEFAULT_NAME = "(no material)"


def evaluate_constants(
    names: Sequence[str | None],
    materials: Sequence[bpy.types.Material | None],
    lobes: Sequence[Lobes],
    varies: Bool,
    warnings: dict[str, None],
) -> tuple[Material, ...]:
    """Follows ``materials``. Those that vary get one point's value, which may be anything."""
    if not materials:
        return ()
    cells = bake_over_uv(_palette(len(materials)), materials, (CELL * len(materials), CELL), margin=0)
    out = []
    for index, (name, lobe) in enumerate(zip(names, lobes, strict=True)):
        inner = (slice(1, CELL - 1), slice(index * CELL + 1, (index + 1) * CELL - 1))
        cell = Evaluated(*(getattr(cells, field)[inner] for field in ("diffuse", "glossy", "emission")))
        albedo = reflectance(cell, lobe).mean(axis=(0, 1))
        if not varies[index]:
            albedo = _clamped(albedo, name, warnings)
        opacity = 1 - float(np.clip(lobe.transparent.mean(), 0, 1))
        out.append(
            Material(
                name=name or DEFAULT_NAME,
                albedo=to_rgb(albedo),
                emission=to_rgb(np.maximum(cell.emission.mean(axis=(0, 1)), 0)),
                specular=to_rgb(_unmixed(lobe.specular, opacity)),
                transmission=to_rgb(_unmixed(lobe.transmission, opacity)),
                ior=lobe.ior,
                opacity=opacity,
            )
        )
    return tuple(out)


def reflectance(cell: Evaluated, lobe: Lobes) -> Float32:
    """(h, w, 3) what is neither mirror nor glass, of the light that the surface does not let straight through."""
    opacity = 1 - float(np.clip(lobe.transparent.mean(), 0, 1))
    rough = cell.glossy - lobe.specular.astype(np.float32)
    if lobe.transmission.max() > 0:
        # Glass reflects by Fresnel's law, which the tracer follows from the index of refraction.
        rough = np.zeros_like(rough)
    return np.asarray(_unmixed(cell.diffuse + np.maximum(rough, 0), opacity), np.float32)


def _unmixed(share: Float32 | Float64, opacity: float) -> Float64:
    """Cycles weighs what it gives by opacity; backend materials hold it for the opaque part."""
    return np.asarray(share / opacity if opacity > 1e-6 else np.zeros_like(share), np.float64)


def _clamped(albedo: Float64, name: str | None, warnings: dict[str, None]) -> Float64:
    if albedo.max(initial=0.0) > 1 + 1e-5:
        warnings[
            f"material {name}: reflects more light than it gets ({albedo.max():.3g}); its albedo is clamped to 1"
        ] = None
    return np.clip(albedo, 0, 1)


def _palette(count: int) -> bpy.types.Mesh:
    """One quad per material, each over its own square of the UV layer RTGI."""
    mesh = bpy.data.meshes.new("rtgi_palette")
    left = np.arange(count, dtype=np.float64)
    x = np.stack([left, left + 1, left + 1, left], axis=1)
    y = np.broadcast_to([0.0, 0.0, 1.0, 1.0], x.shape)
    faces = np.arange(4 * count).reshape(-1, 4)
    mesh.from_pydata(np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).tolist(), [], faces.tolist())
    layer = mesh.uv_layers.new(name=UV_LAYER)
    layer.uv.foreach_set("vector", np.stack([x / count, y], axis=-1).astype(np.float32).ravel())
    index = mesh.attributes.new("material_index", "INT", "FACE")
    index.data.foreach_set("value", np.arange(count, dtype=np.int32))
    return mesh


def to_rgb(values: Float64) -> tuple[float, float, float]:
    red, green, blue = (float(v) for v in values)
    return red, green, blue
