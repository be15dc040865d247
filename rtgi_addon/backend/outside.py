# SPDX-License-Identifier: GPL-3.0-or-later
"""All light that does not come by links, kept from frame to frame: the stages "photons", "direct" and "caustics".

Lamps straight, by shadow rays; lamps by way of mirrors and glass, by photons; and photons of everything, where the
settings ask for the paper's own AIM.
"""

from __future__ import annotations

import numpy as np

from .lamps import emission
from .lamps.direct import make_shadows
from .lamps.direct_store import DirectStore
from .photon import caustics
from .photon.photon_light import Hits, PhotonLight
from .photon.photon_store import PhotonStore
from .placed import PlacedScene
from .progress import Report
from .scene import Atlas, Bool, Float32, Scene
from .selection.changes import Change
from .settings import AimBounced, AimDirect, BakeSettings, Caustics, LiveSettings
from .stats import FrameStats


class OutsideLight:
    """The light of lamps, and of photons, on the n texels of one bake."""

    def __init__(self, placed: PlacedScene, atlas: Atlas, settings: BakeSettings) -> None:
        self._placed, self._settings = placed, settings
        self._bounds = emission.make_bounds(placed.geometry)  # of the first frame; see emission.grown_bounds
        self._sides = sending_sides(placed.scene, atlas)
        self._direct_store = DirectStore()
        self._photons = self._photon_light(diffuse=True)
        self._caustic_photons = self._photon_light(diffuse=False)

    def forget(self) -> None:
        """Keep nothing: the next frame starts from scratch."""
        self._direct_store.clear()
        self.forget_photons()

    def forget_photons(self) -> None:
        """Keep no photon."""
        self._photons.forget()
        self._caustic_photons.forget()

    def limit(self, live: LiveSettings) -> None:
        """From now on frames have a budget."""
        self._photons.limit(live)
        self._caustic_photons.limit(live)

    def light(self, change: Change, stats: FrameStats, report: Report, stages: int) -> tuple[Float32, Float32 | None]:
        """((n, 3) W/m² in all, (n, 3) of it caustics or None); ``change`` since the last call."""
        if AimDirect.PHOTONS is self._settings.aim_direct or AimBounced.PHOTONS is self._settings.aim_bounced:
            with stats.stage("photons"):
                self._follow_photons(change, stats)
        with stats.stage("direct"):
            direct = self._direct(change, stats)
        report("direct", 2, stages)
        with stats.stage("caustics"):
            caustic = self._caustics(change, stats)
        report("caustics", 3, stages)
        return (direct if caustic is None else direct + caustic), caustic

    def photon_aim(self, outside: Float32) -> Float32 | None:
        """(n, 3) all light as photons tell it; None where radiosity's fixed point does."""
        if self._settings.aim_bounced is not AimBounced.PHOTONS:
            return None
        # Lamps' light is in `outside` until it has bounced diffusely; all of sky's and emissive meshes' is here.
        return outside + self._photons.irradiance(self._placed, Hits.BOUNCED)

    def _photon_light(self, *, diffuse: bool) -> PhotonLight:
        settings = self._settings
        most = settings.max_bounces if diffuse else settings.max_specular + 1
        store = PhotonStore(
            self._placed.texels, selection=settings.selection, max_bounces=most, seed=settings.seed, diffuse=diffuse
        )
        return PhotonLight(store, nearest=settings.nearest_photons)

    def _follow_photons(self, change: Change, stats: FrameStats) -> None:
        placed = self._placed
        bounds = emission.grown_bounds(self._bounds, placed.geometry)
        sources = emission.make_sources(placed.scene, placed.state, placed.geometry, bounds, sides=self._sides)
        counts = emission.photon_counts(sources, self._settings.photons)
        self._photons.follow(placed, change, sources, counts, stats)

    def _direct(self, change: Change, stats: FrameStats) -> Float32:
        """(n, 3) from lamps, by shadow rays; by photons when the settings say so."""
        placed = self._placed
        if self._settings.aim_direct is AimDirect.PHOTONS:
            return self._photons.irradiance(placed, Hits.DIRECT)
        done = self._direct_store.update(
            placed.state.lights, placed.frame, make_shadows(placed.tracer, placed.geometry, placed.materials),
            placed.workers, sweep=None if change.everything else change.sweep, changed_texels=change.texels,
            samples=self._settings.direct_samples, seed=self._settings.seed,
        )  # fmt: skip
        stats.rays += done.rays
        return done.direct

    def _caustics(self, change: Change, stats: FrameStats) -> Float32 | None:
        """(n, 3) from lamps by way of mirrors and glass; None where the scene has none, or they are not asked for."""
        if self._settings.caustics is Caustics.OFF:
            return None
        placed = self._placed
        generators = caustics.find_generators(placed.scene, placed.state, placed.geometry, placed.materials)
        sources: list[emission.PhotonSource] = []
        if len(generators.radius):
            bounds = emission.grown_bounds(self._bounds, placed.geometry)
            sources = caustics.caustic_sources(placed.state, placed.geometry, bounds, generators)
        counts = emission.photon_counts(sources, self._settings.photons)
        self._caustic_photons.follow(placed, change, sources, counts, stats)
        if not sources and self._settings.caustics is not Caustics.ON:
            return None
        return self._caustic_photons.irradiance(placed, Hits.CAUSTIC)


def sending_sides(scene: Scene, atlas: Atlas) -> Bool:
    """(instances, 2) which sides send light: those with a map, and both of an object that has no map by choice."""
    mapped = [[p is not None for p in pair] for pair in zip(atlas.front, atlas.back, strict=True)]
    unmapped = np.array([not i.receives_light for i in scene.instances], np.bool_)
    return np.array(mapped, np.bool_).reshape(-1, 2) | unmapped[:, None]
