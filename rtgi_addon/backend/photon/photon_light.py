# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance from kept photons, itself kept: only surfaces whose photons changed are computed again (Larsen04 §3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum

import numpy as np

from ..lamps.emission import PhotonSource
from ..placed import PlacedScene
from ..scene import Bool, Float32
from ..selection.changes import Change
from ..selection.schedule import UpdateSchedule
from ..settings import LiveSettings
from ..stats import FrameStats
from ..surface.texels import surface_areas
from .paths import PhotonPaths
from .photon_map import bounced_hits, caustic_hits, direct_hits, lamp_hits, make_photon_map, photon_irradiance
from .photon_store import PhotonStore, PhotonUpdate


class Hits(StrEnum):
    """Which photons' light a map holds."""

    DIRECT = "direct"  # lamps', straight
    BOUNCED = "bounced"  # what shadow rays to lamps do not bring: after a diffuse reflection, or not a lamp's
    CAUSTIC = "caustic"  # by mirrors and glass alone


_CHOOSE: dict[Hits, Callable[[PhotonPaths], Bool]] = {
    Hits.DIRECT: lambda paths: direct_hits(paths) & lamp_hits(paths),
    Hits.BOUNCED: lambda paths: bounced_hits(paths) | ~lamp_hits(paths),
    Hits.CAUSTIC: caustic_hits,
}


class PhotonLight:
    """A store of photons and the maps made from it. A map's bits do not depend on when its surfaces were computed."""

    def __init__(self, store: PhotonStore, *, nearest: int) -> None:
        """Maps look for the ``nearest`` photons of each texel."""
        self.store = store
        self._nearest = nearest
        self._live: LiveSettings | None = None
        self._schedules: dict[Hits, UpdateSchedule] = {}
        self._maps: dict[Hits, Float32] = {}
        self._stale: dict[Hits, Bool] = {}
        self._lost = False

    def limit(self, live: LiveSettings) -> None:
        """From the next frame on do no more in one than its budget allows."""
        self._live = live

    def forget(self) -> None:
        """Rely on no photon: the next frame traces all."""
        self._lost = True
        self._schedules, self._maps, self._stale = {}, {}, {}

    def follow(
        self,
        placed: PlacedScene,
        change: Change,
        sources: Sequence[PhotonSource],
        counts: dict[int, int],
        stats: FrameStats,
    ) -> PhotonUpdate:
        """Bring the photons to the frame that ``placed`` stands in; see :meth:`PhotonStore.update`.

        To be called in every frame, also without sources: ``change`` tells what moved once only.
        """
        update = self.store.update(
            sources, counts, surfaces=placed.surfaces, tracer=placed.tracer, workers=placed.workers,
            sweep=change.sweep, instance_of_triangle=placed.geometry.instance_of_triangle,
            rebuilt=change.everything or self._lost,
            budget=self._live.photons if self._live is not None and self._maps else None,
        )  # fmt: skip
        self._lost = False
        for hits, stale in self._stale.items():
            delta = update.delta_aim if hits is Hits.BOUNCED else update.delta_f
            stale |= delta > 0
            if hits in self._schedules:
                self._schedules[hits].add(delta)
            # Photons may lie as before on a surface that slid along under them.
            stale[placed.texels.surface[change.texels]] = True
        stats.rays += update.rays
        stats.photons_probed += update.probed
        stats.photons_invalidated += update.invalidated
        stats.photons_traced += update.traced
        stats.photons_kept += update.kept
        return update

    def stale(self, placed: PlacedScene, hits: Hits) -> Bool:
        """(surface_count,) surfaces whose light in the map of ``hits`` is no longer that of the photons."""
        if hits not in self._stale:
            self._maps[hits] = np.zeros((placed.texels.count, 3), np.float32)
            self._stale[hits] = np.ones(placed.texels.surface_count, np.bool_)
        return self._stale[hits].copy()

    def irradiance(self, placed: PlacedScene, hits: Hits) -> Float32:
        """(n, 3) W/m² from ``hits``. Stale surfaces are computed first; in live frames those that the budget allows.

        The same array as before where nothing was computed; an array that was given out is never written to.
        """
        first = hits not in self._stale
        todo = self.stale(placed, hits)
        if self._live is not None and not first:
            todo = self._due(placed, hits, todo, self._live)
        if todo.any():
            paths = self.store.paths_on(todo)
            found = make_photon_map(paths, _CHOOSE[hits](paths))
            now = photon_irradiance(
                found, placed.texels, placed.frame, placed.workers, k=self._nearest, surfaces=todo
            )  # fmt: skip
            self._maps[hits] = np.where(todo[placed.texels.surface][:, None], now, self._maps[hits])
            self._stale[hits] &= ~todo
        return self._maps[hits]

    def _due(self, placed: PlacedScene, hits: Hits, stale: Bool, live: LiveSettings) -> Bool:
        """(surface_count,) of the ``stale`` surfaces those to compute now, by Δ_f (Larsen04 §3)."""
        surface = placed.texels.surface
        area = surface_areas(placed.texels, placed.frame)
        if hits not in self._schedules:
            self._schedules[hits] = UpdateSchedule(
                surface, area, threshold=live.threshold, patience=live.patience
            )  # fmt: skip
        schedule = self._schedules[hits]
        schedule.set_area(area)
        pending = stale[surface]
        line = schedule.order(pending, float(self._maps[hits].mean(dtype=np.float64)))
        due = np.zeros(len(stale), np.bool_)
        due[surface[line[: live.budget.texels]]] = True
        # A surface is computed whole: its nearest photons are found in a tree of its own.
        schedule.updated(np.nonzero(due[surface] & pending)[0].astype(np.int32))
        return due
