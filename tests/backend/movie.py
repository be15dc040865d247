# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene whose frames follow one another as in a session: what tests of kept state share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgi_addon.backend.lamps.emission import PhotonSource, grown_bounds, make_bounds, make_sources, photon_counts
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.photon.caustics import caustic_sources, find_generators
from rtgi_addon.backend.photon.photon_store import PhotonStore, PhotonUpdate
from rtgi_addon.backend.photon.scatter import Surfaces, make_surfaces
from rtgi_addon.backend.scene import Atlas, FrameState, Scene
from rtgi_addon.backend.selection.sweep import Sweep
from rtgi_addon.backend.settings import Selection
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.texels import make_texels, place_texels, texel_colours
from rtgi_addon.backend.surface.tracing import EmbreeTracer, Movement


@dataclass(frozen=True)
class Shot:
    """One frame, ready for photons."""

    sources: list[PhotonSource]
    counts: dict[int, int]
    surfaces: Surfaces
    movement: Movement
    moved: np.ndarray


class Movie:
    def __init__(self, scene: Scene, atlas: Atlas, *, photons: int, caustics: bool = False, threads: int = 1) -> None:
        state = scene.first_frame()
        self.scene, self.photons, self.caustics = scene, photons, caustics
        self.workers = Workers(threads)
        self.geometry = Geometry(scene, state)
        self.base = make_bounds(self.geometry)
        self.tracer = EmbreeTracer(scene, self.geometry, state, self.workers)
        self.texels = make_texels(scene, atlas, self.geometry)
        self._visible = state.visible
        self.state = state

    def shot(self, state: FrameState) -> Shot:
        """Go to ``state``."""
        changed = self.geometry.update(state)
        moved = state.visible != self._visible
        moved[changed] = True
        movement = self.tracer.update(state, changed)
        self._visible, self.state = state.visible.copy(), state
        materials = state.materials or self.scene.materials
        albedo, _ = texel_colours(self.texels, self.scene, self.geometry, materials)
        bounds = grown_bounds(self.base, self.geometry)
        if self.caustics:
            generators = find_generators(self.scene, state, self.geometry, materials)
            sources = caustic_sources(state, self.geometry, bounds, generators)
        else:
            sources = make_sources(self.scene, state, self.geometry, bounds)
        surfaces = make_surfaces(self.geometry, self.texels, albedo, materials)
        return Shot(sources, photon_counts(sources, self.photons), surfaces, movement, moved)

    def store(self, selection: Selection, *, seed: int = 3, max_bounces: int = 24, group_size: int = 40) -> PhotonStore:
        return PhotonStore(
            self.texels,
            selection=selection,
            max_bounces=max_bounces,
            seed=seed,
            diffuse=not self.caustics,
            group_size=group_size,
        )

    def update(self, store: PhotonStore, shot: Shot, *, budget: int | None = None, tracer=None) -> PhotonUpdate:
        return store.update(
            shot.sources,
            shot.counts,
            surfaces=shot.surfaces,
            tracer=tracer or self.tracer,
            workers=self.workers,
            sweep=Sweep(shot.movement.places, shot.moved, self.workers),
            instance_of_triangle=self.geometry.instance_of_triangle,
            rebuilt=shot.movement.rebuilt,
            budget=budget,
        )

    def scratch(self, shot: Shot, *, seed: int = 3, max_bounces: int = 24) -> PhotonStore:
        """A store that knows nothing of other frames, traced against an Embree scene built anew."""
        store = self.store(Selection.OFF, seed=seed, max_bounces=max_bounces)
        tracer = EmbreeTracer(self.scene, self.geometry, self.state, self.workers)
        self.update(store, shot, tracer=tracer)
        return store

    def frame(self):
        return place_texels(self.texels, self.geometry)
