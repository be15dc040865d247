# SPDX-License-Identifier: GPL-3.0-or-later
"""Links and the light they bring, kept from frame to frame: the stages "links" and "aim".

Links follow what moves; where neither they nor anything they bring light from differs, the light stays as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..placed import PlacedScene
from ..scene import Bool, Float32, Int32
from ..selection.changes import Change
from ..selection.schedule import UpdateSchedule, within
from ..settings import BakeSettings, LiveSettings, SampleCounts
from ..stats import FrameStats
from ..surface.texels import surface_areas
from . import radiosity
from .kept_gather import Irradiance, KeptGather


@dataclass(frozen=True)
class Light:
    """n texels' light in one frame, not yet filtered."""

    aim: Float32  # (n, 3) W/m²
    iim: Float32  # (n, 3) W/m²
    half: Float32  # (n, 3) W/m², the IIM as half of the rays tell it
    stand_in: Int32  # (n,) see Links
    component: Int32  # (s,) surfaces with another number exchange no light
    updated: Bool  # (n,) texels whose light was computed anew


@dataclass(frozen=True)
class _Inputs:
    """All that a frame's light hangs on."""

    links: Irradiance
    component: Int32  # (s,)
    outside: Float32  # (n, 3) irradiance that does not come by links
    other: Float32  # (n, 3) irradiance that does not come from texels by links
    albedo: Float32  # (n, 3)
    emitted: Float32  # (m, 3)
    photon_aim: Float32 | None  # (n, 3)


@dataclass
class _Kept:
    """What one number of samples left of its last frame."""

    gather: KeptGather
    known: Irradiance | None = None
    renewed: Bool | None = None  # (n,) texels that see anything anew since the last frame
    inputs: _Inputs | None = None
    light: Light | None = None
    schedule: UpdateSchedule | None = None  # of live frames
    waiting: Bool | None = None  # (n,) texels that the last live frame left pending


#: Makes a gather of a frame's scene with so many samples, that may keep so many bytes.
MakeGather = Callable[[PlacedScene, SampleCounts, int], KeptGather]


class Lighting:
    """The gathers of one bake, one for each number of samples that its frames ask for."""

    def __init__(self, settings: BakeSettings, make_gather: MakeGather, live: LiveSettings | None = None) -> None:
        """``live``: after the first frame each one brings only some texels up to date."""
        self._settings, self._make_gather, self._live = settings, make_gather, live
        self._kept: dict[SampleCounts, _Kept] = {}
        self._used: set[SampleCounts] = set()

    def forget(self) -> None:
        """Keep nothing: the next frame starts from scratch."""
        self._keep(set())

    def _keep(self, wanted: set[SampleCounts]) -> None:
        for samples, kept in self._kept.items():
            if samples not in wanted:
                kept.gather.release()
        self._kept = {samples: kept for samples, kept in self._kept.items() if samples in wanted}

    def follow(self, placed: PlacedScene, change: Change, stats: FrameStats) -> None:
        """Mark what ``change`` disturbs, once a frame; gathers that the frame before did not use are dropped."""
        self._keep(self._used if change.rays_hold else set())
        self._used = set()
        for kept in self._kept.values():
            stats.links_tested += kept.gather.follow(placed, change)

    def gather(self, placed: PlacedScene, samples: SampleCounts, stats: FrameStats) -> Irradiance:
        """What all texels see by ``samples``, up to date."""
        kept = self._kept.get(samples)
        if kept is None:
            memory = (self._settings.link_memory << 20) - sum(k.gather.bytes for k in self._kept.values())
            kept = self._kept[samples] = _Kept(self._make_gather(placed, samples, max(memory, 0)))
        self._used.add(samples)
        gather = kept.gather
        kept.renewed, renewed = np.zeros(gather.count, np.bool_), 0
        pending = np.nonzero(gather.pending)[0].astype(np.int32)
        if kept.known is not None and not len(pending):
            stats.links_kept += gather.samples_kept
            return kept.known
        for texels in self._line(placed, kept, pending):
            work = gather.renew(texels)
            kept.renewed |= work.changed
            renewed += work.renewed
            stats.rays += work.traced
            stats.views_drawn += work.drawn
        stats.links_traced += renewed
        stats.links_kept += gather.samples_kept - renewed
        stats.texels_pending = int(np.count_nonzero(gather.pending))
        kept.known = gather.irradiance()
        return kept.known

    def _line(self, placed: PlacedScene, kept: _Kept, pending: Int32) -> Iterator[Int32]:
        """The ``pending`` texels to bring up to date now, in parts: all, or what a live frame's budget allows."""
        light, texels = kept.light, placed.texels
        if self._live is None or light is None:
            yield pending
            return
        area = surface_areas(texels, placed.frame)
        if kept.schedule is None:
            threshold, patience = self._live.threshold, self._live.patience
            kept.schedule = UpdateSchedule(texels.surface, area, threshold=threshold, patience=patience)
        kept.schedule.set_area(area)
        fresh = pending[pending < kept.gather.kept]
        fresh = fresh if kept.waiting is None else fresh[~kept.waiting[fresh]]
        sent = radiosity.sent_by_targets(light.aim, placed.albedo, placed.emitted).max(axis=1)
        flux = kept.gather.at_stake(sent, fresh) * placed.frame.area[fresh]
        of_surface = np.bincount(texels.surface[fresh], flux, minlength=texels.surface_count)
        kept.schedule.add(np.asarray(of_surface, np.float64))
        waits = np.zeros(texels.count, np.bool_)
        waits[pending] = True
        for part in within(self._live.budget, kept.schedule.order(waits, float(light.iim.mean(dtype=np.float64)))):
            yield part
            kept.schedule.updated(part)
            waits[part] = False
        kept.waiting = waits

    def light(
        self,
        placed: PlacedScene,
        links: Irradiance,
        samples: SampleCounts,
        outside: Float32,
        aim: Float32 | None = None,
    ) -> Light:
        """AIM and IIM; ``outside`` (n, 3) W/m² comes by other ways than links.

        ``aim`` (n, 3): all light as photons tell it; without it the AIM is radiosity's fixed point.
        """
        kept = self._kept[samples]
        component, coupled = kept.gather.components()
        other = self._with_emitted(kept, links, placed.emitted, outside)
        now = _Inputs(links, component, outside, other, placed.albedo, placed.emitted, aim)
        surface = placed.texels.surface
        stale = np.ones(placed.texels.count, np.bool_)
        if kept.inputs is not None and kept.renewed is not None:
            stale = _stale(kept.inputs, now, kept.renewed, surface)
        texels = np.nonzero(stale)[0]
        if len(texels) and kept.gather.kept < kept.gather.count:
            texels = np.arange(len(stale))  # links that are not kept are traced for all or none
        light = self._solved(now, kept.light, texels, np.where(coupled, component, -1)[surface])
        kept.inputs, kept.light = now, replace(light, updated=stale)
        return kept.light

    def _with_emitted(self, kept: _Kept, links: Irradiance, emitted: Float32, outside: Float32) -> Float32:
        """(n, 3) all irradiance but what texels send back; the array of the last frame where nothing differs."""
        before = kept.inputs
        if before is not None and before.links is links and before.emitted is emitted and before.outside is outside:
            return before.other
        return np.ascontiguousarray(outside + links.irradiance(emitted)) if emitted.any() else outside

    def _solved(self, now: _Inputs, before: Light | None, texels: NDArray[np.int64], group: Int32) -> Light:
        """The light of ``texels`` (r,) anew, all else as ``before``."""
        if before is None:
            none = np.zeros_like(now.other)
            before = Light(none, none, none, now.links.stand_in, now.component, np.zeros(len(none), np.bool_))
        if not len(texels):
            return before
        links = now.links if len(texels) == len(now.other) else now.links.only(texels)
        aim, iim, half = before.aim.copy(), before.iim.copy(), before.half.copy()
        if now.photon_aim is None:
            aim[texels] = radiosity.solve(
                links, texels, group[texels], now.other[texels], now.albedo[texels], len(now.emitted)
            )
        else:
            aim[texels] = now.photon_aim[texels]
        iim[texels], half[texels] = links.with_half(radiosity.sent_by_targets(aim, now.albedo, now.emitted))
        return replace(before, aim=aim, iim=iim, half=half, stand_in=now.links.stand_in, component=now.component)


def _stale(before: _Inputs, now: _Inputs, renewed: Bool, surface: Int32) -> Bool:
    """(n,) texels of components in which anything differs; renewed (n,): links do."""
    differ = renewed | (before.links.stand_in != now.links.stand_in)
    pairs = ((before.other, now.other), (before.albedo, now.albedo), (before.photon_aim, now.photon_aim))
    for old, new in pairs:
        if old is not new:
            differ |= True if old is None or new is None else np.any(old != new, axis=1)
    if before.emitted is not now.emitted:
        sent = np.any(before.emitted != now.emitted, axis=1)
        differ |= sent[: len(differ)]
    count = len(now.component)
    touched = np.bincount(surface[differ], minlength=count) > 0
    touched |= _regrouped(before.component, now.component)
    stale = np.bincount(now.component[touched], minlength=count) > 0
    return np.asarray(stale[now.component][surface])


def _regrouped(before: Int32, now: Int32) -> Bool:
    """(s,) surfaces whose component has lost or won some."""
    if np.array_equal(before, now):
        return np.zeros(len(now), np.bool_)
    lowest = [np.unique(labels, return_index=True)[1][labels] for labels in (before, now)]
    other = lowest[0] != lowest[1]
    return np.asarray(np.isin(before, before[other]) | np.isin(now, now[other]))
