# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene whose frames follow one another as in a session, and its photons."""

from __future__ import annotations

from dataclasses import dataclass

from rtgi_addon.backend.lamps.emission import PhotonSource, grown_bounds, make_bounds, make_sources, photon_counts
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.photon.caustics import caustic_sources, find_generators
from rtgi_addon.backend.photon.photon_light import PhotonLight
from rtgi_addon.backend.photon.photon_store import PhotonStore, PhotonUpdate
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.scene import Atlas, FrameState, Scene
from rtgi_addon.backend.selection.changes import Change
from rtgi_addon.backend.settings import Selection
from rtgi_addon.backend.stats import FrameStats
from rtgi_addon.backend.surface.tracing import EmbreeTracer


@dataclass(frozen=True)
class Shot:
    """One frame, ready for photons."""

    sources: list[PhotonSource]
    counts: dict[int, int]
    change: Change


class Movie:
    def __init__(self, scene: Scene, atlas: Atlas, *, photons: int, caustics: bool = False, threads: int = 1) -> None:
        self.scene, self.photons, self.caustics = scene, photons, caustics
        self.workers = Workers(threads)
        self.first = scene.first_frame()
        self.placed = PlacedScene(scene, atlas, self.first, (), self.workers)
        self.texels = self.placed.texels
        self.base = make_bounds(self.placed.geometry)

    def shot(self, state: FrameState) -> Shot:
        """Go to ``state``."""
        placed = self.placed
        change = placed.follow(state)
        bounds = grown_bounds(self.base, placed.geometry)
        if self.caustics:
            generators = find_generators(self.scene, state, placed.geometry, placed.materials)
            sources = caustic_sources(state, placed.geometry, bounds, generators)
        else:
            sources = make_sources(self.scene, state, placed.geometry, bounds)
        return Shot(sources, photon_counts(sources, self.photons), change)

    def store(self, selection: Selection, *, max_bounces: int = 24, group_size: int = 40) -> PhotonStore:
        return PhotonStore(
            self.texels,
            selection=selection,
            max_bounces=max_bounces,
            seed=3,
            diffuse=not self.caustics,
            group_size=group_size,
        )

    def update(self, store: PhotonStore, shot: Shot, *, budget: int | None = None, tracer=None) -> PhotonUpdate:
        return store.update(
            shot.sources,
            shot.counts,
            surfaces=self.placed.surfaces,
            tracer=tracer or self.placed.tracer,
            workers=self.workers,
            sweep=shot.change.sweep,
            instance_of_triangle=self.placed.geometry.instance_of_triangle,
            rebuilt=shot.change.everything,
            budget=budget,
        )

    def follow(self, light: PhotonLight, shot: Shot) -> PhotonUpdate:
        return light.follow(self.placed, shot.change, shot.sources, shot.counts, FrameStats())

    def scratch(self, shot: Shot) -> PhotonStore:
        """A store that knows nothing of other frames, traced against an Embree scene built anew."""
        store = self.store(Selection.OFF)
        tracer = EmbreeTracer(self.scene, self.placed.geometry, self.placed.state, self.workers)
        self.update(store, shot, tracer=tracer)
        return store
