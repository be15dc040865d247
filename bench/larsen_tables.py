# SPDX-License-Identifier: GPL-3.0-or-later
"""Larsen04's tables 1 and 2, measured again with this backend: photon look-ups, and one texel's final gather."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from rtgi_addon.backend.final_gather.bright import bright_targets, bright_weight
from rtgi_addon.backend.final_gather.gather import GatherRays
from rtgi_addon.backend.final_gather.radiosity import sent_by_targets
from rtgi_addon.backend.parallel import CHUNK_RAYS, Workers
from rtgi_addon.backend.photon.photon_map import PhotonMap, photon_irradiance
from rtgi_addon.backend.scene import Float32, Instance, Int32, Scene
from rtgi_addon.backend.settings import SampleCounts
from rtgi_addon.backend.surface.scatter import diffuse_shares
from tests.backend.rig import Rig, make_rig
from tests.backend.scenes import WHITE, grid_atlas, point_light, quad

from .rooms import bumpy_cornell

#: Table 1: photons -> (ms to balance the tree, ms for one irradiance look-up), of a 2.4 GHz Pentium 4.
PAPER_PHOTONS = {300: (0.10, 0.023), 500: (0.18, 0.027), 1000: (0.39, 0.029), 2000: (0.84, 0.034)}
NEAREST = 100
#: Table 2: (polygons, rays) -> ms for one final gather, of a GeForce FX 5950.
PAPER_GATHER = {
    (34, 64): 0.75, (34, 256): 0.76, (34, 1024): 0.78,
    (13_000, 64): 0.90, (13_000, 256): 0.91, (13_000, 1024): 0.97,
    (133_000, 64): 1.55, (133_000, 256): 1.57, (133_000, 1024): 1.59,
}  # fmt: skip
#: Texels along a wall of the box that is gathered in: 3k in all; and how many of them one batch gathers.
TEXELS, BATCH = 22, 2048
ALONE = 100
REPEATS = 3


@dataclass(frozen=True)
class LookUp:
    """Milliseconds, medians."""

    photons: int
    build: float
    alone: float  # one look-up by itself
    together: float  # each of 4096 look-ups, the tree's building and the borders' correction included
    paper_build: float
    paper_lookup: float


@dataclass(frozen=True)
class FinalGather:
    """Milliseconds, medians."""

    polygons: int  # as in the paper
    triangles: int  # ours
    rays: int
    alone: float  # one texel by itself
    together: float  # each of a batch
    paper: float


def look_ups() -> list[LookUp]:
    """Photons at random on one square surface."""
    scene = Scene((quad("p", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]),), (Instance("p", 0, np.eye(4)),), (WHITE,),
                  (point_light((0, 0, 1)),))  # fmt: skip
    rig = make_rig(scene, grid_atlas(scene, [(64, 64)]), threads=0)
    return [_look_up(rig, n) for n in PAPER_PHOTONS]


def _look_up(rig: Rig, count: int) -> LookUp:
    rng = np.random.default_rng(count)
    position = np.zeros((count, 4))  # the fourth is the surface's, as in the photon map
    position[:, :2] = rng.random((count, 2)) - 0.5
    position[:, 2] = rig.frame.position[0, 2]
    flux = np.ones((count, 3), np.float32)
    tree = cKDTree(position)
    places = np.concatenate([rig.frame.position[:ALONE], np.zeros((ALONE, 1))], axis=1).astype(np.float64)
    at = iter(np.tile(np.arange(ALONE), 4))

    def one() -> Float32:
        distance, nearest = tree.query(places[next(at)], k=NEAREST)
        return flux[nearest[:-1]].sum(axis=0) / (np.pi * distance[-1] ** 2)

    photons = PhotonMap(position[:, :3].astype(np.float32), flux, np.zeros(count, np.int32))
    together = _milliseconds(lambda: photon_irradiance(photons, rig.texels, rig.frame, rig.workers, k=NEAREST), REPEATS)
    build, lookup = PAPER_PHOTONS[count]
    return LookUp(
        count, _milliseconds(lambda: cKDTree(position), ALONE), _milliseconds(one, ALONE),
        together / rig.texels.count, build, lookup,
    )  # fmt: skip


def final_gathers() -> list[FinalGather]:
    """The Cornell box with its walls cut into triangles and made bumpy."""
    out = []
    for polygons in dict.fromkeys(p for p, _ in PAPER_GATHER):
        rig = make_rig(*bumpy_cornell(polygons, TEXELS, moving=False), threads=0)
        for rays in (r for p, r in PAPER_GATHER if p == polygons):
            alone, together = _gather_times(rig, rays)
            out.append(
                FinalGather(polygons, rig.geometry.triangle_count, rays, alone, together, PAPER_GATHER[polygons, rays])
            )
    return out


def _gather_times(rig: Rig, rays: int) -> tuple[float, float]:
    """Milliseconds a texel: by itself, in a batch."""
    albedo = diffuse_shares(rig.surfaces, rig.texels.triangle)
    sent = sent_by_targets(rig.direct(1), albedo, np.zeros((rig.texels.count, 3), np.float32))
    one_room = np.zeros(rig.texels.count, np.int32)
    odds = bright_targets([bright_weight(sent, rig.frame.area, None, rig.geometry.extent)], one_room)
    tracer = GatherRays(
        rig.texels, rig.frame, rig.geometry, rig.surfaces, rig.tracer, None, odds, SampleCounts(rays // 2, rays // 2),
        max_specular=0, seed=0,
    )  # fmt: skip
    chosen = np.random.default_rng(1).permutation(rig.texels.count)[:BATCH].astype(np.int32)
    one = iter(np.tile(chosen[:ALONE], 4))
    alone = _milliseconds(lambda: gathered(tracer, np.array([next(one)], np.int32), sent), ALONE)
    together = _milliseconds(lambda: gather_all(tracer, chosen, sent, rays, rig.workers), REPEATS)
    return alone, together / len(chosen)


def gathered(tracer: GatherRays, texel: Int32, sent: Float32) -> Float32:
    """(m, 3) W/m² that rays bring to ``texel`` (m,) from the radiosity ``sent`` (n, 3) of all."""
    traced = tracer.trace(texel)
    weight = traced.weight * traced.usable
    light = sent.take(traced.target, axis=0, mode="clip")
    light[traced.target < 0] = 0
    total = np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return np.asarray((weight[:, :, None] * light).sum(axis=1) / total, np.float32)


def gather_all(tracer: GatherRays, texel: Int32, sent: Float32, rays: int, workers: Workers) -> Float32:
    """:func:`gathered` in chunks on all threads, as a bake does it."""
    parts = workers.map_slices(lambda s: gathered(tracer, texel[s], sent), len(texel), max(1, CHUNK_RAYS // rays))
    return np.concatenate(parts)


def _milliseconds(work: Callable[[], object], repeats: int) -> float:
    """Median of ``repeats`` calls after one that is not counted."""
    work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1000 * float(np.median(seconds))
