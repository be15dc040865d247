# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene with all that photons and shadow rays need, ready to trace: what the light transport tests share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgi_addon.backend.lamps.direct import direct_irradiance, make_shadows
from rtgi_addon.backend.lamps.emission import PhotonSource, all_photons, make_bounds, make_sources, photon_counts
from rtgi_addon.backend.lamps.lights import Bounds
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.photon.paths import EnergyBook, PhotonPaths
from rtgi_addon.backend.photon.photons import trace_photons
from rtgi_addon.backend.scene import Atlas, FrameState, Scene
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.scatter import Surfaces, make_surfaces
from rtgi_addon.backend.surface.texels import TexelFrame, Texels, make_texels, place_texels, texel_colours
from rtgi_addon.backend.surface.tracing import EmbreeTracer


@dataclass(frozen=True)
class Rig:
    scene: Scene
    state: FrameState
    geometry: Geometry
    workers: Workers
    tracer: EmbreeTracer
    texels: Texels
    frame: TexelFrame
    surfaces: Surfaces
    bounds: Bounds
    sources: list[PhotonSource]

    def photons(
        self, count: int, *, seed: int = 0, max_bounces: int = 256, light=None, index=None
    ) -> tuple[PhotonPaths, EnergyBook]:
        """All photons of a budget, or those given."""
        counts = photon_counts(self.sources, count)
        if light is None:
            light, index = all_photons(counts)
        return trace_photons(
            self.sources,
            counts,
            light,
            index,
            surfaces=self.surfaces,
            tracer=self.tracer,
            workers=self.workers,
            max_bounces=max_bounces,
            seed=seed,
        )

    def direct(self, samples: int, *, seed: int = 0) -> np.ndarray:
        """(n, 3) W/m²."""
        shadows = make_shadows(self.tracer, self.geometry, self.scene.materials)
        return direct_irradiance(self.state.lights, self.frame, shadows, self.workers, samples=samples, seed=seed)[0]


def make_rig(scene: Scene, atlas: Atlas, *, threads: int = 1) -> Rig:
    state = scene.first_frame()
    geometry, workers = Geometry(scene, state), Workers(threads)
    texels = make_texels(scene, atlas, geometry)
    albedo, _ = texel_colours(texels, scene, geometry, scene.materials)
    bounds = make_bounds(geometry)
    return Rig(
        scene=scene,
        state=state,
        geometry=geometry,
        workers=workers,
        tracer=EmbreeTracer(scene, geometry, state, workers),
        texels=texels,
        frame=place_texels(texels, geometry),
        surfaces=make_surfaces(geometry, texels, albedo, scene.materials),
        bounds=bounds,
        sources=make_sources(scene, state, geometry, bounds),
    )
