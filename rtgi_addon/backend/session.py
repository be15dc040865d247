# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake: the state that lives between frames, and the stages of a frame in their order.

``Session.advance`` is the page that lists them: place → direct → caustics → links → aim → denoise → seams → pages.
Only the session keeps state; every stage is a function of arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from .final_gather import radiosity
from .final_gather.bright import bright_targets
from .final_gather.gather import GatherRays
from .final_gather.links import Links, trace_links
from .final_gather.radiosity import Illumination
from .finish.finisher import Finisher, OidnOpening, fill
from .lamps import emission
from .lamps.direct import direct_irradiance, make_shadows
from .lamps.sky import Sky, make_sky
from .limits import bounded_scene, bounded_state
from .parallel import Workers
from .photon import caustics, photon_map, photons
from .photon.scatter import Surfaces, diffuse_shares, make_surfaces
from .progress import Report, silent
from .scene import Atlas, Bool, Float32, FrameState, Int32, LightMaps, Scene
from .settings import AimBounced, AimDirect, BakeSettings, Caustics, SampleCounts
from .stats import FrameStats
from .surface.geometry import Geometry
from .surface.texels import TexelFrame, make_texels, place_texels, texel_colours
from .surface.tracing import EmbreeTracer

#: Each frame has so many stages to report.
STAGE_COUNT = 6
#: Rays of the first try when a target error is set.
PILOT = SampleCounts(16, 16)
#: A frame that does not meet its target with so many rays a texel is given as it is, with a warning.
MOST_RAYS = 4096
#: Denoised error falls about with the cube root of the rays (measured: 3.0 % at 32, 1.5 % at 256).
ERROR_EXPONENT = 3.0
#: Least and most that one more try multiplies the rays by.
GROWTH = (1.5, 8.0)


@dataclass(frozen=True)
class FrameResult:
    maps: LightMaps
    stats: FrameStats


@dataclass(frozen=True)
class _Placed:
    """One frame's scene, ready to be lit; n texels, m targets (texels and sky patches)."""

    state: FrameState
    frame: TexelFrame
    surfaces: Surfaces
    albedo: Float32  # (n, 3) share of the light arriving that leaves diffusely: albedo × opacity
    emitted: Float32  # (m, 3) radiosity that targets send of themselves, W/m²
    sky: Sky | None


@dataclass(frozen=True)
class _Lit:
    """One frame's light on the texels, before seams are closed."""

    frame: int
    samples: SampleCounts
    aim: Float32  # (n, 3) W/m²
    iim: Float32  # (n, 3) W/m², denoised
    stand_in: Int32  # (n,) see Links
    estimated_error: float | None


class Session:
    """A bake of one scene into one atlas. Close it, or use it in a ``with``, to give its threads back."""

    def __init__(
        self,
        scene: Scene,
        atlas: Atlas,
        settings: BakeSettings,
        state: FrameState,
        *,
        oidn_paths: Sequence[Path] = (),
        report: Report = silent,
    ) -> None:
        """``state`` is the first frame to bake. ``oidn_paths``: where Open Image Denoise's library may lie.

        Raises BakeError when the settings ask for what this machine does not have.
        """
        scene, self._bounded = bounded_scene(scene)
        state, _ = bounded_state(state, scene)
        self.scene, self.atlas, self.settings = scene, atlas, settings
        self._report = report
        oidn = OidnOpening(settings, oidn_paths)
        self._workers = Workers(settings.threads)
        self.geometry = Geometry(scene, state)
        self._tracer = EmbreeTracer(scene, self.geometry, state, self._workers)
        self.texels = make_texels(scene, atlas, self.geometry)
        self._bounds = emission.make_bounds(self.geometry)
        self._sides = sending_sides(scene, atlas)
        self._finisher = Finisher(scene, atlas, self.texels, settings, oidn)

    def close(self) -> None:
        """Give threads and the denoiser back."""
        self._workers.close()
        self._finisher.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def advance(self, state: FrameState) -> FrameResult:
        """Light the frame ``state``."""
        stats = FrameStats(texels_updated=self.texels.count, surfaces_updated=self.texels.surface_count)
        state, changed = bounded_state(state, self.scene)
        stats.warnings += dict.fromkeys([*self._bounded, *changed])
        with stats.stage("place"):
            placed = self._place(state)
        self._report("place", 1, STAGE_COUNT)
        with stats.stage("direct"):
            direct = self._direct(placed, stats)
        self._report("direct", 2, STAGE_COUNT)
        with stats.stage("caustics"):
            caustic = self._caustics(placed, stats)
        self._report("caustics", 3, STAGE_COUNT)
        outside = direct if caustic is None else direct + caustic
        lit = self._illuminate(placed, outside, self._first_samples(), stats)
        while (more := self._more_samples(lit, stats)) is not None:
            lit = self._illuminate(placed, outside, more, stats)
        with stats.stage("seams"):
            iim = self._finisher.close_seams(lit.iim)
        with stats.stage("pages"):
            maps = self._pages(placed, lit, iim, caustic)
        self._report("pages", STAGE_COUNT, STAGE_COUNT)
        stats.estimated_error = lit.estimated_error
        stats.warnings += self._finisher.warnings
        return FrameResult(maps, stats)

    def _first_samples(self) -> SampleCounts:
        return PILOT if self.settings.target_error is not None else self.settings.samples

    def _more_samples(self, lit: _Lit, stats: FrameStats) -> SampleCounts | None:
        """Rays for another try when the target error is not met; None when it is, or none was asked for."""
        target, error = self.settings.target_error, lit.estimated_error
        if target is None or error is None or error <= target:
            return None
        if lit.samples.total >= MOST_RAYS:
            stats.warnings.append(
                f"frame {lit.frame}: estimated error {error:.2%} with {MOST_RAYS} rays a texel, "
                f"above the target of {target:.2%}; raise the target or the map's resolution"
            )
            return None
        growth = np.clip((error / target) ** ERROR_EXPONENT, *GROWTH)
        each = min(MOST_RAYS // 2, int(np.ceil(lit.samples.cosine * growth / 8)) * 8)
        return SampleCounts(each, each)

    def _illuminate(self, placed: _Placed, outside: Float32, samples: SampleCounts, stats: FrameStats) -> _Lit:
        """Links with ``samples``, the light they bring, and how far it may be off."""
        with stats.stage("links"):
            links = self._links(placed, outside, samples, stats)
        self._report("links", 4, STAGE_COUNT)
        with stats.stage("aim"):
            light = self._light(placed, outside, links, stats)
        self._report("aim", 5, STAGE_COUNT)
        with stats.stage("denoise"):
            end = self._finisher
            half = radiosity.gather(links, light.aim, placed.albedo, placed.emitted, from_half=True)
            iim = end.denoise(light.iim, links.stand_in)
            estimate = noise_estimate(iim, end.denoise(half, links.stand_in))
        return _Lit(placed.state.frame, samples, light.aim, iim, links.stand_in, estimate)

    # --- stages ---------------------------------------------------------------------------------------------------

    def _place(self, state: FrameState) -> _Placed:
        changed = self.geometry.update(state)
        self._tracer.update(state, changed)
        self._bounds = emission.grown_bounds(self._bounds, self.geometry)
        frame = place_texels(self.texels, self.geometry)
        materials = state.materials or self.scene.materials
        albedo, glow = texel_colours(self.texels, self.scene, self.geometry, materials)
        surfaces = make_surfaces(self.geometry, self.texels, albedo, materials)
        sky = make_sky(state.world)
        emitted = glow * np.float32(np.pi)
        if sky is not None:
            emitted = np.concatenate([emitted, sky.radiance * np.float32(np.pi)])
        return _Placed(state, frame, surfaces, diffuse_shares(surfaces, self.texels.triangle), emitted, sky)

    def _direct(self, placed: _Placed, stats: FrameStats) -> Float32:
        """(n, 3) from lamps, by shadow rays; by photons when the settings say so."""
        if self.settings.aim_direct is AimDirect.PHOTONS:
            paths = self._photons(placed, stats)
            hits = photon_map.direct_hits(paths) & photon_map.lamp_hits(paths)
            return self._density(paths, hits, placed)
        materials = placed.state.materials or self.scene.materials
        shadows = make_shadows(self._tracer, self.geometry, materials)
        direct, rays = direct_irradiance(
            placed.state.lights, placed.frame, shadows, self._workers,
            samples=self.settings.direct_samples, seed=self.settings.seed,
        )  # fmt: skip
        stats.rays += rays
        return direct

    def _caustics(self, placed: _Placed, stats: FrameStats) -> Float32 | None:
        """(n, 3) from lamps by way of mirrors and glass; None where the scene has none, or they are not asked for."""
        if self.settings.caustics is Caustics.OFF:
            return None
        materials = placed.state.materials or self.scene.materials
        generators = caustics.find_generators(self.scene, placed.state, self.geometry, materials)
        sources = caustics.caustic_sources(placed.state, self.geometry, self._bounds, generators)
        if not sources:
            return np.zeros_like(placed.albedo) if self.settings.caustics is Caustics.ON else None
        paths, book = caustics.trace_caustics(
            sources, photons=self.settings.photons, surfaces=placed.surfaces, tracer=self._tracer,
            workers=self._workers, max_bounces=self.settings.max_specular + 1, seed=self.settings.seed,
        )  # fmt: skip
        stats.rays += book.rays
        stats.photons_traced += len(paths.light)
        k = self.settings.nearest_photons
        return caustics.caustic_irradiance(paths, self.texels, placed.frame, self._workers, k=k)

    def _links(self, placed: _Placed, outside: Float32, samples: SampleCounts, stats: FrameStats) -> Links:
        known = radiosity.sent_by_targets(outside, placed.albedo, placed.emitted)
        bright = bright_targets(known, placed.frame.area, placed.sky, self.geometry.extent)
        tracer = GatherRays(
            self.texels, placed.frame, self.geometry, placed.surfaces, self._tracer, placed.sky, bright, samples,
            max_specular=self.settings.max_specular, seed=self.settings.seed,
        )  # fmt: skip
        links = trace_links(tracer, self.texels, len(placed.emitted), samples, self._workers)
        stats.rays += links.rays
        stats.links_traced += links.rays
        stats.cosine_rays, stats.bright_rays = samples.cosine, samples.bright
        return links

    def _light(self, placed: _Placed, outside: Float32, links: Links, stats: FrameStats) -> Illumination:
        if self.settings.aim_bounced is not AimBounced.PHOTONS:
            return radiosity.solve(links, outside, placed.albedo, placed.emitted)
        paths = self._photons(placed, stats)
        # Lamps' light is in `outside` until it has bounced diffusely; all of sky's and emissive meshes' is here.
        hits = photon_map.bounced_hits(paths) | ~photon_map.lamp_hits(paths)
        aim = outside + self._density(paths, hits, placed)
        return Illumination(aim, radiosity.gather(links, aim, placed.albedo, placed.emitted), 1, 0.0)

    def _photons(self, placed: _Placed, stats: FrameStats) -> photons.PhotonPaths:
        sources = emission.make_sources(self.scene, placed.state, self.geometry, self._bounds, sides=self._sides)
        counts = emission.photon_counts(sources, self.settings.photons)
        light, index = emission.all_photons(counts)
        paths, book = photons.trace_photons(
            sources, counts, light, index, surfaces=placed.surfaces, tracer=self._tracer, workers=self._workers,
            max_bounces=self.settings.max_bounces, seed=self.settings.seed,
        )  # fmt: skip
        stats.rays += book.rays
        stats.photons_traced += len(paths.light)
        return paths

    def _density(self, paths: photons.PhotonPaths, hits: Bool, placed: _Placed) -> Float32:
        found = photon_map.make_photon_map(paths, hits)
        k = self.settings.nearest_photons
        return photon_map.photon_irradiance(found, self.texels, placed.frame, self._workers, k=k)

    def _pages(self, placed: _Placed, lit: _Lit, iim: Float32, caustic: Float32 | None) -> LightMaps:
        end = self._finisher
        return LightMaps(
            frame=placed.state.frame,
            iim=end.to_pages(iim),
            aim=end.to_pages(fill(lit.aim, lit.stand_in)),
            caustics=None if caustic is None else end.to_pages(fill(caustic, lit.stand_in)),
            valid=end.valid_pages(lit.stand_in == np.arange(self.texels.count)),
        )


def sending_sides(scene: Scene, atlas: Atlas) -> Bool:
    """(instances, 2) which sides send light: those with a map, and both of an object that has no map by choice."""
    mapped = [[p is not None for p in pair] for pair in zip(atlas.front, atlas.back, strict=True)]
    unmapped = np.array([not i.receives_light for i in scene.instances], np.bool_)
    return np.array(mapped, np.bool_).reshape(-1, 2) | unmapped[:, None]


def noise_estimate(full: Float32, half: Float32) -> float | None:
    """Relative RMS noise of ``full`` (n, 3) from how far ``half`` (n, 3), made of half its rays, lies from it.

    With σ² the variance of ``full``, that of ``half`` is 2σ² and their covariance σ², so their difference has σ².
    None where ``full`` is black.
    """
    mean = float(full.mean(dtype=np.float64)) if full.size else 0.0
    if not mean > 0:
        return None
    return float(np.sqrt(np.mean((full - half) ** 2, dtype=np.float64))) / mean
