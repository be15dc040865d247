# SPDX-License-Identifier: GPL-3.0-or-later
"""What happens to light where it lands: diffuse reflection, mirror, glass, straight on, or absorption.

One event per photon, drawn in proportion to what each would carry on (Russian roulette and choice of lobe in one), so
that the brightest channel of a photon keeps its flux all along its path (Jensen 2001, §5.2, per channel).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..sampling import Floats, dot, sample_cosine_about
from ..scene import Bool, Float32, Int32, Material
from .geometry import Geometry
from .texels import Texels
from .tracing import Hits

#: Kinds of event.
DIFFUSE, MIRROR, REFRACT, THROUGH, ABSORBED = (np.uint8(k) for k in range(5))

TexelOfHits = Callable[[Int32, Float32, Float32, Bool], Int32]


@dataclass(frozen=True)
class Surfaces:
    """What light meets: t triangles, m materials, n texels."""

    normals: Float32  # (t, 3) unit geometric
    corner_normals: Float32  # (t, 3, 3) unit shading
    material_of_triangle: Int32  # (t,)
    albedo: Float32  # (n, 3) of texels, within [0, 1]
    specular: Float32  # (m, 3)
    transmission: Float32  # (m, 3)
    ior: Float32  # (m,)
    opacity: Float32  # (m,)
    passes: Bool  # (m,) Material.passes_rays
    texel_of_hits: TexelOfHits
    offset_length: Callable[[Float32], Float32]


@dataclass(frozen=True)
class Scattered:
    """n photons after their event; of absorbed ones only ``kind`` and ``flux`` (zero) mean anything."""

    kind: NDArray[np.uint8]  # (n,)
    origin: Float32  # (n, 3) local, lifted off the surface
    direction: Float32  # (n, 3) unit
    flux: Float32  # (n, 3) W


def make_surfaces(geometry: Geometry, texels: Texels, albedo: Float32, materials: Sequence[Material]) -> Surfaces:
    """``albedo`` (n, 3) as ``texels.texel_colours`` gives it. Shares are cut to [0, 1], so energy is bounded."""

    def shares(rows: list[tuple[float, float, float]]) -> Float32:
        return np.clip(np.array(rows, np.float32).reshape(-1, 3), 0, 1)

    return Surfaces(
        normals=geometry.normals,
        corner_normals=geometry.corner_normals,
        material_of_triangle=geometry.material_of_triangle,
        albedo=np.clip(albedo, 0, 1).astype(np.float32) if len(albedo) else np.zeros((1, 3), np.float32),
        specular=shares([m.specular for m in materials]),
        transmission=shares([m.transmission for m in materials]),
        ior=np.array([m.ior for m in materials], np.float32),
        opacity=np.clip(np.array([m.opacity for m in materials], np.float32), 0, 1),
        passes=np.array([m.passes_rays for m in materials], np.bool_),
        texel_of_hits=texels.of_hits,
        offset_length=geometry.offset_length,
    )


def diffuse_shares(surfaces: Surfaces, triangle: Int32) -> Float32:
    """(n, 3) share of the light arriving at each texel that leaves diffusely, as :func:`scatter` has it.

    ``triangle`` (n,) of the texels.
    """
    material = surfaces.material_of_triangle[triangle]
    albedo = surfaces.albedo[: len(triangle)]
    others = surfaces.specular[material] + surfaces.transmission[material]
    return np.asarray(albedo * (surfaces.opacity[material][:, None] / np.maximum(albedo + others, 1)), np.float32)


def scatter(
    surfaces: Surfaces,
    hits: Hits,
    texel: Int32,
    position: Float32,
    direction: Float32,
    flux: Float32,
    numbers: list[Float32],
    *,
    diffuse: bool = True,
) -> Scattered:
    """The event of n photons of ``flux`` travelling along ``direction`` that landed at ``position``.

    ``numbers`` (3 arrays (n,) in [0, 1)): two for the direction, one for the event. Without ``diffuse`` what would
    be reflected diffusely is absorbed.
    """
    facing = np.where(hits.back, np.float32(-1), np.float32(1))[:, None]
    normal = surfaces.normals.take(hits.triangle, axis=0) * facing
    reflected = surfaces.albedo.take(texel, axis=0, mode="clip")
    reflected *= (texel >= 0)[:, None]
    special = np.zeros(0, np.int64)
    if surfaces.passes.any():
        special = np.nonzero(surfaces.passes[surfaces.material_of_triangle.take(hits.triangle)])[0]
    carried = np.float32(diffuse)
    kind, after = choose([reflected * carried], flux, numbers[2])
    kind[kind == 1] = ABSORBED
    out = np.zeros_like(direction)
    if len(special):
        sub = hits.take(special)
        shares, turned = _special_lobes(surfaces, sub, normal[special], direction[special], reflected[special])
        shares[0] = shares[0] * carried
        kind[special], after[special] = choose(shares, flux[special], numbers[2][special])
        for lobe, vectors in turned.items():
            rows = np.nonzero(kind[special] == lobe)[0]
            out[special[rows]] = vectors[rows]
    rows = np.nonzero(kind == DIFFUSE)[0]
    out[rows] = sample_cosine_about(normal[rows], numbers[0][rows], numbers[1][rows])
    lift = surfaces.offset_length(position) * np.where(dot(out, normal) < 0, np.float32(-1), np.float32(1))
    return Scattered(kind, position + normal * lift[:, None], out, after)


def choose(shares: Sequence[Float32], flux: Float32, number: Float32) -> tuple[NDArray[np.uint8], Float32]:
    """((n,), (n, 3)) which of ``shares`` (k arrays (n, 3)) each photon follows, k for none, and its flux after it.

    The odds of a share are what the photon's brightest channel then is, over what it is now.
    """
    brightest = _largest(flux)
    carried = [flux * share for share in shares]
    odds = [_largest(c) / brightest for c in carried]
    total = odds[0]
    for o in odds[1:]:
        total = total + o
    scale = 1 / np.maximum(total, 1)
    kind = np.full(len(flux), len(shares), np.uint8)
    after = np.zeros_like(flux)
    edge = np.zeros_like(number)
    for k, (c, o) in enumerate(zip(carried, odds, strict=True)):
        probability = o * scale
        upper = edge + probability
        rows = np.nonzero((number >= edge) & (number < upper))[0]
        kind[rows] = k
        after[rows] = c[rows] / probability[rows, None]
        edge = upper
    return kind, after


def _special_lobes(
    surfaces: Surfaces, hits: Hits, normal: Float32, direction: Float32, reflected: Float32
) -> tuple[list[Float32], dict[np.uint8, Float32]]:
    """Shares of the four lobes and the directions of the three sharp ones, where a material passes rays."""
    material = surfaces.material_of_triangle[hits.triangle]
    opaque = surfaces.opacity[material][:, None]
    specular, glass = surfaces.specular[material], surfaces.transmission[material]
    # Shares that add to more than one would make light: scaled down together, per channel.
    scale = opaque / np.maximum(reflected + specular + glass, 1)
    shading = shading_normals(surfaces, hits, normal, direction)
    ratio = np.where(hits.back, surfaces.ior[material], 1 / surfaces.ior[material]).astype(np.float32)
    refracted, fresnel = refract(direction, shading, ratio)
    mirrored = reflect(direction, shading, normal)
    # A refracted ray must leave by the other side of the triangle itself; smooth normals may say otherwise.
    astray = dot(refracted, normal) >= 0
    refracted[astray] = direction[astray]
    shares = [
        reflected * scale,
        (specular + glass * fresnel[:, None]) * scale,
        glass * (1 - fresnel[:, None]) * scale,
        np.broadcast_to(1 - opaque, reflected.shape),
    ]
    return shares, {MIRROR: mirrored, REFRACT: refracted, THROUGH: direction}


def shading_normals(surfaces: Surfaces, hits: Hits, normal: Float32, direction: Float32) -> Float32:
    """(n, 3) unit interpolated normals, towards where the ray came from; the geometric ``normal`` where they fail."""
    corner = surfaces.corner_normals[hits.triangle]
    turned = np.where(hits.back, np.float32(-1), np.float32(1))
    weights = np.stack([(1 - hits.u - hits.v) * turned, hits.u * turned, hits.v * turned], axis=1)[:, :, None]
    weighted = corner * weights
    smooth: Floats = np.asarray(weighted[:, 0] + weighted[:, 1] + weighted[:, 2], np.float32)
    length = np.sqrt(dot(smooth, smooth))
    good = (length > 1e-6) & (dot(smooth, direction) < 0)
    out: Float32 = np.where(good[:, None], smooth / np.maximum(length, np.float32(1e-6))[:, None], normal)
    return out


def reflect(direction: Float32, shading: Float32, normal: Float32) -> Float32:
    """(n, 3) mirror directions about ``shading``; about ``normal`` where that would go through the surface."""
    out = np.asarray(direction - shading * (2 * dot(direction, shading))[:, None], np.float32)
    plain = np.asarray(direction - normal * (2 * dot(direction, normal))[:, None], np.float32)
    return np.where((dot(out, normal) > 0)[:, None], out, plain)


def refract(direction: Float32, shading: Float32, ratio: Float32) -> tuple[Float32, Float32]:
    """((n, 3), (n,)) refracted directions and the unpolarised Fresnel reflectance, 1 on total internal reflection.

    ``ratio`` (n,) is the index of refraction on the incoming side over the one beyond.
    """
    cosine = np.clip(-dot(direction, shading), 0, 1)
    beyond_squared = 1 - ratio * ratio * (1 - cosine * cosine)
    total = beyond_squared <= 0
    beyond = np.sqrt(np.maximum(beyond_squared, 0))
    parallel = (cosine - ratio * beyond) / (cosine + ratio * beyond + np.float32(1e-12))
    perpendicular = (ratio * cosine - beyond) / (ratio * cosine + beyond + np.float32(1e-12))
    fresnel = np.where(total, np.float32(1), (parallel * parallel + perpendicular * perpendicular) / 2)
    out = np.asarray(direction * ratio[:, None] + shading * (ratio * cosine - beyond)[:, None], np.float32)
    out /= np.sqrt(np.maximum(dot(out, out), np.float32(1e-20)))[:, None]
    return out, fresnel.astype(np.float32)


def _largest(rgb: Float32) -> Float32:
    """(n,) the largest channel."""
    return np.maximum(np.maximum(rgb[:, 0], rgb[:, 1]), rgb[:, 2])
