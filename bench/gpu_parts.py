# SPDX-License-Identifier: GPL-3.0-or-later
"""What all measurements of the gather by views are made of: scenes placed and lit, gathers whose drawing is timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtgi_addon.backend.final_gather.bright import bright_targets, bright_weight
from rtgi_addon.backend.final_gather.gather import GatherRays
from rtgi_addon.backend.final_gather.radiosity import sent_by_targets
from rtgi_addon.backend.final_gather.views.coarse import CoarseMesh
from rtgi_addon.backend.final_gather.views.target import Eyes, Target
from rtgi_addon.backend.final_gather.views.view import make_view
from rtgi_addon.backend.final_gather.views.view_gather import ViewGather, ViewSource
from rtgi_addon.backend.gpu.compute_tracer import ComputeTracer
from rtgi_addon.backend.gpu.context import Gpu
from rtgi_addon.backend.lamps.direct import direct_irradiance, make_shadows
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.scene import Atlas, Float32, FrameState, Int32, Scene
from rtgi_addon.backend.selection.changes import Change
from rtgi_addon.backend.selection.sweep import Sweep
from rtgi_addon.backend.settings import Gather, SampleCounts

#: In the order of the tables.
KINDS = (Gather.PLANE, Gather.HEMICUBE, Gather.RAYS)
#: Views may take so many bytes.
MEMORY = 4 << 30
#: Calls that are counted, at least.
REPEATS = 3


class Drawing:
    """What fills a gather's views, and how long that took."""

    def __init__(self, source: ViewSource, *, one_point: bool) -> None:
        self._source, self._one_point = source, one_point
        self.seconds = 0.0
        self.target: Target | None = None  # that was drawn first

    def follow(self, moved: NDArray[np.int64], state: FrameState) -> None:
        self._source.follow(moved, state)

    def draw(self, target: Target, tile: Int32, eyes: Eyes) -> None:
        if self._one_point:
            eyes = replace(eyes, parted=np.zeros(len(tile), np.bool_))
        start = time.perf_counter()
        self._source.draw(target, tile, eyes)  # waits for the device
        self.seconds += time.perf_counter() - start
        self.target = self.target or target

    def release(self) -> None:
        self._source.release()


def watch(gather: ViewGather, *, one_point: bool = False) -> Drawing:
    """Time the drawing of ``gather``, which else times nothing, apart from what the CPU does before it. ``one_point``:
    no view is from four points, whatever is near: each texel is one view, as in the paper."""
    gather._source = drawing = Drawing(gather._source, one_point=one_point)
    return drawing


def make_gather(
    gpu: Gpu, placed: PlacedScene, kind: Gather, size: int, *, memory: int = MEMORY,
    coarse: dict[int, CoarseMesh] | None = None,
) -> ViewGather:  # fmt: skip
    """Views of ``size`` pixels along a side; no mesh has a stand-in but those in ``coarse``."""
    view = make_view(kind, size)
    return ViewGather(placed, gpu, view, placed.workers, memory=memory, coarse=coarse or {}, seed=0)


def anew(placed: PlacedScene) -> Change:
    """As if every texel had moved to where it is."""
    moved = np.zeros(len(placed.scene.instances), np.bool_)
    moved[0] = True
    return Change(
        Sweep((), (), moved, placed.workers), np.ones(placed.texels.count, np.bool_), scattering=None, passing=False,
        emitted=False, everything=False,
    )  # fmt: skip


def trace_by(placed: PlacedScene, gpu: Gpu) -> None:
    """Rays by compute shaders from now on: what RAYS needs."""
    placed.trace_with(lambda scene, geometry, state: ComputeTracer(scene, geometry, state, gpu))


def placed_scene(scene: Scene, atlas: Atlas, workers: Workers) -> PlacedScene:
    return PlacedScene(scene, atlas, scene.first_frame(), (), workers)


def lit_by_lamps(placed: PlacedScene) -> Float32:
    """(m, 3) W/m² that targets send when only lamps shine on them."""
    shadows = make_shadows(placed.tracer, placed.geometry, placed.materials)
    direct = direct_irradiance(placed.state.lights, placed.frame, shadows, placed.workers, samples=8, seed=0)[0]
    return sent_by_targets(direct, placed.albedo, placed.emitted)


def link_rays(placed: PlacedScene, sent: Float32, samples: SampleCounts, *, seed: int) -> GatherRays:
    """Gather rays, aimed at what is bright by ``sent`` (m, 3); mirrors are surfaces to them, as they are to views."""
    weight = bright_weight(sent, placed.frame.area, placed.sky, placed.geometry.extent)
    return GatherRays(
        placed.texels, placed.frame, placed.geometry, placed.surfaces, placed.tracer, placed.sky,
        bright_targets([weight], np.zeros(placed.texels.count, np.int32)), samples, max_specular=0, seed=seed,
    )  # fmt: skip


def median_seconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Seconds, of ``repeats`` calls after one that is not counted."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[1:]))


def rms(values: Float32, reference: Float32) -> float:
    """RMS difference / mean."""
    square = ((values.astype(np.float64) - reference) ** 2).mean()
    return float(np.sqrt(square) / reference.mean(dtype=np.float64))
