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
from .final_gather.bright import BrightTargets, bright_targets, bright_weight
from .final_gather.choice import ChoiceFile
from .final_gather.components import SurfaceGraph
from .final_gather.gathers import Gathers
from .final_gather.lighting import Light, Lighting
from .final_gather.rooms import look_around, rooms_of
from .finish.finisher import Finisher, OidnOpening, fill
from .gpu.context import GpuFailed
from .limits import bounded_scene, bounded_state
from .outside import OutsideLight
from .parallel import Workers
from .placed import PlacedScene
from .progress import Report, silent
from .scene import Atlas, Bool, Float32, FrameState, LightMaps, Scene
from .settings import BakeSettings, Gather, LiveSettings, SampleCounts, Selection
from .stats import FrameStats
from .surface.geometry import Geometry
from .surface.texels import Texels

#: Each frame has so many stages to report.
STAGE_COUNT = 6
#: Rays of the first try when a target error is set.
PILOT = SampleCounts(16, 16)
#: A frame that does not meet its target with so many rays a texel is given as it is, with a warning.
MOST_RAYS = 4096
#: Rays of either kind that a try may have: each half again, or a third, more than the last.
STEPS = tuple(n << k for k in range(3, 10) for n in (2, 3)) + (MOST_RAYS // 2,)
#: Denoised error falls about with the cube root of the rays (measured: 3.0 % at 32, 1.5 % at 256).
ERROR_EXPONENT = 3.0
#: Least and most that one more try multiplies the rays by.
GROWTH = (1.5, 8.0)


@dataclass(frozen=True)
class FrameResult:
    maps: LightMaps
    stats: FrameStats


@dataclass(frozen=True)
class _Lit:
    """One frame's light on the texels, before seams are closed."""

    frame: int
    samples: SampleCounts
    light: Light
    iim: Float32  # (n, 3) W/m², denoised
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
        guide: Sequence[FrameState] = (),
        live: LiveSettings | None = None,
        oidn_paths: Sequence[Path] = (),
        choices: ChoiceFile | None = None,
        report: Report = silent,
    ) -> None:
        """``state`` is the first frame to bake. ``guide``: frames spread over the animation, whose light tells where
        gather rays are aimed in all of them; default: the first alone. ``live``: frames after the first update no more
        than its budget allows; without it every frame's maps are converged, and hang on these arguments and the frame's
        own state, never on which frames were lit before it. ``oidn_paths``: where Open Image Denoise's library may lie.
        ``choices``: where gather AUTO notes what it measured; without it, it is links.

        Raises BakeError when the settings ask for what this machine does not have.
        """
        scene, self._bounded = bounded_scene(scene)
        self._states = [bounded_state(s, scene)[0] for s in (state, *guide)]
        self.scene, self.atlas, self.settings = scene, atlas, settings
        self._report = report
        oidn = OidnOpening(settings, oidn_paths)
        self._workers = Workers(settings.threads)
        self._gathers = Gathers(settings, self._workers, choices)
        self._live = live
        self._broken = False  # a frame was cut short: what is kept may be of two frames
        try:
            self._set_up(self._states)
        except GpuFailed as fault:
            self._gathers.give_up(fault)
            self._set_up(self._states)
        self._finisher = Finisher(scene, atlas, self.texels, settings, oidn)

    def _set_up(self, states: Sequence[FrameState]) -> None:
        """Place the scene and settle what gather rays are aimed at."""
        self._placed = PlacedScene(
            self.scene, self.atlas, states[0], states[1:], self._workers, self._gathers.make_tracer
        )
        self._outside = OutsideLight(self._placed, self.atlas, self.settings)
        self._setup: FrameStats | None = FrameStats()  # what the guide took: counted with the first frame
        # The first frame's state comes last, so that it need not be placed again.
        bright, sent = self._guide(states[1:] or states)
        with self._setup.stage("choose"):
            self._gathers.choose(self._placed, bright, sent, self._first_samples())
        if self._gathers.gather is Gather.RAYS and self.settings.gather is Gather.AUTO:
            self._placed.trace_with(self._gathers.make_tracer)
            self._outside.forget()
        self._lighting = Lighting(self.settings, self._gathers.make, self._live)

    @property
    def texels(self) -> Texels:
        """The atlas pixels that are surface; the same in all frames."""
        return self._placed.texels

    @property
    def geometry(self) -> Geometry:
        """All triangles as they stand in the frame last lit."""
        return self._placed.geometry

    def close(self) -> None:
        """Give threads, the GPU and the denoiser back."""
        self._workers.close()
        self._gathers.close()
        self._finisher.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def advance(self, state: FrameState) -> FrameResult:
        """Light the frame ``state``. Where the GPU fails meanwhile, it is lit once more, by the CPU."""
        try:
            return self._advance(state)
        except GpuFailed as fault:
            self._gathers.give_up(fault)
            self._set_up(self._states)  # all anew: what links are aimed at may have been found by the GPU
            self._broken = False
            return self._advance(state)

    def _advance(self, state: FrameState) -> FrameResult:
        if self._broken:
            self._forget()
            self._placed.place_again()
        self._broken = True
        stats, self._setup = self._setup or FrameStats(), None
        traced_in_setup, stats.photons_kept = stats.photons_traced, 0
        state, bounded = bounded_state(state, self.scene)
        stats.warnings += dict.fromkeys([*self._gathers.warnings(self._placed), *self._bounded, *bounded])
        gathers = self._gathers
        stats.gather, stats.gather_reason, stats.device = gathers.gather, gathers.reason, gathers.device
        with stats.stage("place"):
            change = self._placed.follow(state)
            if self.settings.selection is Selection.OFF:
                self._forget()
            self._lighting.follow(self._placed, change, stats)
        self._report("place", 1, STAGE_COUNT)
        outside, caustic = self._outside.light(change, stats, self._report, STAGE_COUNT)
        lit = self._illuminate(outside, self._first_samples(), stats)
        while (more := self._more_samples(lit, stats)) is not None:
            lit = self._illuminate(outside, more, stats)
        with stats.stage("seams"):
            iim = self._finisher.close_seams(lit.iim)
        with stats.stage("pages"):
            maps = self._pages(lit, iim, caustic)
        self._report("pages", STAGE_COUNT, STAGE_COUNT)
        self._count(lit.light.updated, stats)
        stats.stand_ins = gathers.stand_ins(self._placed)  # made with the first gather
        stats.photons_kept = max(stats.photons_kept - traced_in_setup, 0)
        stats.estimated_error = lit.estimated_error
        stats.warnings += self._finisher.warnings
        self._broken = False
        if self._live is not None:  # guide and first frame are lit whole
            self._outside.limit(self._live)
        return FrameResult(maps, stats)

    def _forget(self) -> None:
        """Keep no ray of the frames before."""
        self._lighting.forget()
        self._outside.forget()

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
        # In steps, so that the next frame most likely asks for the same rays and finds them traced.
        each = next(step for step in STEPS if step >= min(lit.samples.cosine * growth, STEPS[-1]))
        return SampleCounts(each, each)

    def _illuminate(self, outside: Float32, samples: SampleCounts, stats: FrameStats) -> _Lit:
        """Links with ``samples``, the light they bring, and how far it may be off."""
        placed, lighting = self._placed, self._lighting
        if self._gathers.gather is Gather.LINKS:
            stats.cosine_rays, stats.bright_rays = samples.cosine, samples.bright
        else:
            stats.view_pixels = self._gathers.pixels(samples)
        with stats.stage("links"):
            links = lighting.gather(placed, samples, stats)
        self._report("links", 4, STAGE_COUNT)
        with stats.stage("aim"):
            light = lighting.light(placed, links, samples, outside, self._outside.photon_aim(outside))
        self._report("aim", 5, STAGE_COUNT)
        with stats.stage("denoise"):
            end, apart = self._finisher, light.component
            iim = end.denoise(light.iim, light.stand_in, component=apart)
            estimate = None
            if self.settings.estimate or self.settings.target_error is not None:
                half = end.denoise(light.half, light.stand_in, component=apart, half=True)
                estimate = noise_estimate(iim, half)
        return _Lit(placed.state.frame, samples, light, iim, estimate)

    def _count(self, updated: Bool, stats: FrameStats) -> None:
        """How many texels and surfaces got their light anew; ``updated`` (n,)."""
        texels = self.texels
        stats.texels_updated = int(np.count_nonzero(updated))
        stats.texels_kept = texels.count - stats.texels_updated
        stats.surfaces_updated = len(np.unique(texels.surface[updated]))
        stats.surfaces_kept = texels.surface_count - stats.surfaces_updated

    # --- stages ---------------------------------------------------------------------------------------------------

    def _guide(self, states: Sequence[FrameState]) -> tuple[BrightTargets, Float32]:
        """(where gather rays are aimed: at what shines in any of ``states``; (m, 3) what all targets send in the first,
        before light has bounced)."""
        assert self._setup is not None
        placed, weights, setup = self._placed, [], self._setup
        seen = SurfaceGraph(self.texels.surface_count)
        for state in reversed(states):
            change = placed.follow(state)
            if self.settings.selection is Selection.PROBE:  # what is aimed at must not hang on what probes have found
                self._outside.forget_photons()
            setup.rays += look_around(placed, seen, self.settings.seed)
            outside, _ = self._outside.light(change, setup, self._report, STAGE_COUNT)
            known = radiosity.sent_by_targets(outside, placed.albedo, placed.emitted)
            weights.append(bright_weight(known, placed.frame.area, placed.sky, placed.geometry.extent))
        return bright_targets(weights, rooms_of(seen, self.texels.surface)), known

    def _pages(self, lit: _Lit, iim: Float32, caustic: Float32 | None) -> LightMaps:
        end, stand_in = self._finisher, lit.light.stand_in
        return LightMaps(
            frame=lit.frame,
            iim=end.to_pages(iim, stand_in),
            aim=end.to_pages(fill(lit.light.aim, stand_in), stand_in),
            caustics=None if caustic is None else end.to_pages(fill(caustic, stand_in), stand_in),
            valid=end.valid_pages(stand_in == np.arange(self.texels.count)),
        )


def noise_estimate(full: Float32, half: Float32) -> float | None:
    """Relative RMS noise of ``full`` (n, 3) from how far ``half`` (n, 3), made of half its rays, lies from it.

    With σ² the variance of ``full``, that of ``half`` is 2σ² and their covariance σ², so their difference has σ².
    None where ``full`` is black.
    """
    mean = float(full.mean(dtype=np.float64)) if full.size else 0.0
    if not mean > 0:
        return None
    return float(np.sqrt(np.mean((full - half) ** 2, dtype=np.float64))) / mean
