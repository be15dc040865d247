# SPDX-License-Identifier: GPL-3.0-or-later
"""Links and the light they bring, kept from frame to frame: the stages "links" and "aim".

Links follow what moves; where neither they nor anything they bring light from differs, the light stays as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..parallel import Workers
from ..placed import PlacedScene
from ..scene import Bool, Float32, Int32
from ..selection.changes import Change
from ..settings import BakeSettings, SampleCounts
from ..stats import FrameStats
from . import radiosity
from .bright import BrightTargets
from .gather import GatherRays
from .link_store import LinkStore
from .links import Links


@dataclass(frozen=True)
class Light:
    """n texels' light in one frame, not yet filtered."""

    aim: Float32  # (n, 3) W/m²
    iim: Float32  # (n, 3) W/m²
    half: Float32  # (n, 3) W/m², the IIM as half of the rays tell it
    stand_in: Int32  # (n,) see Links
    updated: Bool  # (n,) texels whose light was computed anew


@dataclass
class _Kept:
    """What one number of rays left of its last frame."""

    store: LinkStore
    links: Links | None = None
    light: Light | None = None
    inputs: tuple[object, ...] = ()  # what the light was made of


class Lighting:
    """The links of one bake, for each number of rays that its frames ask for."""

    def __init__(self, settings: BakeSettings, bright: BrightTargets, workers: Workers) -> None:
        self._settings, self._bright, self._workers = settings, bright, workers
        self._kept: dict[SampleCounts, _Kept] = {}
        self._used: set[SampleCounts] = set()
        self._rays: dict[SampleCounts, GatherRays] = {}  # of this frame

    def forget(self) -> None:
        """Keep nothing: the next frame starts from scratch."""
        self._kept.clear()

    def follow(self, placed: PlacedScene, change: Change, stats: FrameStats) -> None:
        """Mark the links that ``change`` disturbs, once a frame; those that the frame before did not use are dropped."""
        self._kept = {samples: kept for samples, kept in self._kept.items() if samples in self._used}
        self._used = set()
        self._rays = {}
        if not change.rays_hold:
            self._kept.clear()
        for samples, kept in self._kept.items():
            stats.links_tested += kept.store.disturb(
                self._gather_rays(placed, samples), change.sweep, placed.frame.reach
            )

    def links(self, placed: PlacedScene, samples: SampleCounts, stats: FrameStats) -> Links:
        """The links of ``samples`` rays a texel, up to date."""
        rays = self._gather_rays(placed, samples)
        kept = self._kept.get(samples)
        if kept is None:
            memory = (self._settings.link_memory << 20) - sum(k.store.bytes for k in self._kept.values())
            kept = self._kept[samples] = _Kept(LinkStore(rays, self._workers, memory=max(memory, 0)))
        self._used.add(samples)
        work = kept.store.renew(rays, np.nonzero(kept.store.pending)[0].astype(np.int32))
        stats.rays += work.traced
        stats.links_traced += work.renewed
        stats.links_kept += work.kept
        stats.cosine_rays, stats.bright_rays = samples.cosine, samples.bright
        if kept.links is None or work.changed.any():
            kept.links = Links(kept.store, rays, self._workers)
        return kept.links

    def light(
        self, placed: PlacedScene, links: Links, samples: SampleCounts, outside: Float32, aim: Float32 | None = None
    ) -> Light:
        """AIM and IIM; ``outside`` (n, 3) W/m² comes by other ways than links.

        ``aim`` (n, 3): all light as photons tell it; without it the AIM is radiosity's fixed point.
        """
        kept = self._kept[samples]
        inputs = (links, outside, placed.albedo, placed.emitted, aim)
        if kept.light is not None and all(_same(a, b) for a, b in zip(inputs, kept.inputs, strict=True)):
            kept.light = replace(kept.light, updated=np.zeros(placed.texels.count, np.bool_))
            return kept.light
        if aim is None:
            aim = radiosity.solve(links, outside, placed.albedo, placed.emitted)
        iim, half = links.with_half(radiosity.sent_by_targets(aim, placed.albedo, placed.emitted))
        kept.inputs = inputs
        kept.light = Light(aim, iim, half, links.stand_in, np.ones(placed.texels.count, np.bool_))
        return kept.light

    def _gather_rays(self, placed: PlacedScene, samples: SampleCounts) -> GatherRays:
        if samples not in self._rays:
            self._rays[samples] = GatherRays(
                placed.texels, placed.frame, placed.geometry, placed.surfaces, placed.tracer, placed.sky,
                self._bright, samples, max_specular=self._settings.max_specular, seed=self._settings.seed,
            )  # fmt: skip
        return self._rays[samples]


def _same(a: object, b: object) -> bool:
    """One and the same, or arrays of the same bits."""
    return a is b or (isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and np.array_equal(a, b))
