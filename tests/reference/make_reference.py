# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a stored reference: ``python -m tests.reference.make_reference SCENE.blend --resolution R --spp N --passes K``.

Cycles computes what the IIM and the caustic map should hold together, at some texels chosen at random over the whole
atlas, in passes of different seeds; their spread is the reference's own noise. The file is written anew after each
pass, so a run may be cut short. Run it in the oldest Python and Blender that the tests use.
"""

from __future__ import annotations

import argparse
import logging
import platform
import time
from pathlib import Path

import bpy
import numpy as np

from bench.prepare import Prepared, prepare, texel_table
from bench.reference import Reference, TexelTable
from rtgi_addon.backend.scene import Bool, Float64, Int32
from rtgi_addon.backend.surface.geometry import world_bounds

from .cycles_irradiance import CYCLES, LIFT, PointBaker, configure_cycles, undrawn_light
from .surface_points import GRID, SurfacePoints, surface_points

FOLDER = Path(__file__).parent
#: Which texels are chosen.
SEED = 20261122
log = logging.getLogger("reference")


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    arguments = _arguments()
    prepared = prepare(arguments.scene, arguments.resolution)
    texels, table = texel_table(prepared)
    wanted = min(arguments.texels, texels.count)
    chosen = np.sort(np.random.default_rng(SEED).choice(texels.count, wanted, replace=False)).astype(np.int32)
    # Slivers that miss the whole grid have no surface worth the name.
    chosen = chosen[np.unique(surface_points(prepared.scene, prepared.first, texels, chosen).texel)]
    points = surface_points(prepared.scene, prepared.first, texels, chosen)
    in_texel = np.bincount(points.texel)
    log.info("%s: %d of %d texels, %d points", arguments.scene.stem, len(chosen), wanted, len(points.texel))
    part = TexelTable(
        table.position[chosen], table.normal[chosen], table.area[chosen], table.object[chosen], table.names
    )
    out = arguments.out or FOLDER / f"{arguments.scene.stem}.npz"
    whole = in_texel / GRID**2
    _bake(arguments, prepared, points, part, whole, out)


def _means(group: Int32, values: Float64, count: Int32) -> Float64:
    """(g, 3) means of ``values`` (p, 3) by ``group`` (p,), of which there are ``count`` (g,)."""
    return np.stack([np.bincount(group, channel) / count for channel in values.T], axis=1)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--resolution", type=int, default=128, help="side of the atlas page")
    parser.add_argument("--texels", type=int, default=2000, help="texels at most")
    parser.add_argument("--spp", type=int, default=64, help="samples per point and pass; a texel has up to 16 points")
    parser.add_argument("--passes", type=int, default=24)
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--out", type=Path, help="default: beside this script")
    return parser.parse_args()


def _bake(
    arguments: argparse.Namespace,
    prepared: Prepared,
    points: SurfacePoints,
    part: TexelTable,
    whole: Float64,
    out: Path,
) -> None:
    scene = bpy.context.scene
    scene.frame_set(prepared.first.frame)
    configure_cycles(scene)
    if arguments.threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", arguments.threads
    low, high = world_bounds(prepared.scene, prepared.first)
    baker = PointBaker(points, float(np.linalg.norm(high - low)))
    start, passes = time.perf_counter(), []
    for seed in range(arguments.passes):
        passes.append(undrawn_light(baker, scene, samples=arguments.spp, seed=seed))
        if len(passes) < 2:
            continue
        made = _how_made(arguments, len(passes), time.perf_counter() - start)
        reference = _reference(np.array(passes, np.float64), points, part, whole, made)
        reference.save(out)
        noise = np.sqrt((reference.standard_error.astype(np.float64) ** 2).mean()) / reference.mean.mean()
        log.info("pass %d of %d, noise %.2f %%", seed + 1, arguments.passes, 100 * noise)


def _reference(
    passes: Float64, points: SurfacePoints, part: TexelTable, whole: Float64, made: dict[str, object]
) -> Reference:
    """Means of ``passes`` (k, p, 3) over each texel's open points.

    A point that no path ever reached in any pass lies under other geometry and is not part of what one sees.
    """
    reached: Bool = (passes > 0).any(axis=(0, 2))
    share = np.bincount(points.texel, reached) / np.bincount(points.texel)
    opened = np.maximum(np.bincount(points.texel, reached), 1)
    of_texel = np.stack([_means(points.texel, values, opened) for values in passes])  # (k, n, 3)
    return Reference(
        table=part,
        mean=of_texel.mean(axis=0).astype(np.float32),
        standard_error=(of_texel.std(axis=0, ddof=1) / np.sqrt(len(passes))).astype(np.float32),
        whole=whole.astype(np.float32),
        open=share.astype(np.float32),
        made=made,
    )


def _how_made(arguments: argparse.Namespace, passes: int, seconds: float) -> dict[str, object]:
    return {
        "scene": arguments.scene.name,
        "frame": 1,
        "resolution": arguments.resolution,
        "texel_seed": SEED,
        "points_per_texel": GRID**2,
        "lift_of_diagonal": LIFT,
        "samples_per_point_and_pass": arguments.spp,
        "seeds": list(range(passes)),
        "seconds": round(seconds, 1),
        "blender": bpy.app.version_string,
        "python": platform.python_version(),
        "cycles": CYCLES,
        "light": "all indirect, and direct of sky and emissive meshes; DIFFUSE baked without colour, times pi",
    }


if __name__ == "__main__":
    main()
