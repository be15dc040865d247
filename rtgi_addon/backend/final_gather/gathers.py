# SPDX-License-Identifier: GPL-3.0-or-later
"""The final gather of a bake: made for each number of samples, by links or by views on the GPU.

Where the GPU fails, :meth:`Gathers.give_up` goes over to links; their maps are those of a bake that never had a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np

from ..gpu.compute_tracer import ComputeTracer
from ..gpu.context import COMPUTE_VERSION, LEAST_VERSION, Gpu, GpuFailed, GpuUnavailable, open_gpu
from ..parallel import Workers
from ..placed import PlacedScene
from ..scene import Float32, FrameState, Scene
from ..settings import GPU_GATHERS, BakeSettings, Device, Gather, SampleCounts
from ..surface.geometry import Geometry
from ..surface.tracing import EmbreeTracer, FollowingTracer
from .bright import BrightTargets
from .choice import Choice, ChoiceFile, Makers, choose, scene_class
from .gather import GatherRays
from .kept_gather import KeptGather
from .link_gather import LinkGather
from .views.coarse import CoarseMesh, coarse_mesh
from .views.view import LEAST_SIZE, MOST_SIZE, make_view
from .views.view_gather import ViewGather, view_size


class Gathers:
    """Which gather a bake uses, and what traces its rays. Close it to give the GPU back.

    ``notes``: lines for the user about what was not to be had.
    """

    def __init__(self, settings: BakeSettings, workers: Workers, choices: ChoiceFile | None = None) -> None:
        """Opens the GPU where ``settings`` ask for one; without any that serves, everything is done by the CPU.

        ``choices``: where the choice that AUTO makes is noted; without it AUTO is links, unless the device asked for is
        a GPU.
        """
        self._settings, self._workers = settings, workers
        self._bright: BrightTargets | None = None
        self._coarse: dict[int, CoarseMesh] | None = None
        self._gpu: Gpu | None = None
        self._choices, self._scale = choices, 1.0
        self.notes: list[str] = []
        self.gather, self.reason = Gather.LINKS, ""
        if settings.device is not Device.GPU and settings.gather not in GPU_GATHERS:
            return
        try:
            self._gpu = open_gpu(least=COMPUTE_VERSION if _computes(settings) else LEAST_VERSION)
        except GpuUnavailable as fault:
            self._go_on_without(str(fault))

    def make_tracer(self, scene: Scene, geometry: Geometry, state: FrameState) -> FollowingTracer:
        """What traces rays, in the frame that ``geometry`` and ``state`` stand in."""
        asked = self._settings.device is Device.GPU or Gather.RAYS in (self._settings.gather, self.gather)
        if self._gpu is None or not asked or not self._gpu.info.computes:
            return EmbreeTracer(scene, geometry, state, self._workers)
        return ComputeTracer(scene, geometry, state, self._gpu)

    def choose(self, placed: PlacedScene, bright: BrightTargets, sent: Float32, samples: SampleCounts) -> None:
        """Settle which gather is made.

        bright: what links' rays are aimed at · sent (m, 3): radiosity of all targets in the frame of ``placed`` ·
        samples: that frames will first ask for.
        """
        self._bright = bright
        asked = self._settings.gather
        if self.notes:  # no GPU, or one that failed and is not asked again: by links, for the reason known
            return
        if asked is not Gather.AUTO:
            self.gather, self.reason = asked, "asked for"
        elif self._settings.device is Device.CPU:
            self.reason = "the device asked for is the CPU"
        elif self._choices is None and self._settings.device is not Device.GPU:
            self.reason = "nothing was measured: no file of choices was given"
        elif names := passing_materials(placed):
            self.reason = f"{names}: only links follow rays through mirrors, glass and what is not opaque"
        else:
            self._measure(placed, sent, samples)

    def _measure(self, placed: PlacedScene, sent: Float32, samples: SampleCounts) -> None:
        """Take the choice that is noted for scenes like this, or measure and note one."""
        key = scene_class(placed, samples)
        known = self._choices.get(key) if self._choices is not None else None
        choice = known if known is not None and known.gather is Gather.LINKS else None
        if choice is None or self._settings.device is Device.GPU:
            try:
                self._gpu = self._gpu or open_gpu()
            except GpuUnavailable as fault:
                self.reason = f"no GPU: {fault}"
                return
            renderer = self._gpu.info.renderer
            choice = known if known is not None and known.renderer == renderer else None
        if choice is None:
            assert self._gpu is not None
            choice = self._measured(placed, sent, samples, self._gpu)
            if self._choices is not None:
                self._choices.note(key, choice)
        self.gather, self.reason, self._scale = choice.gather, choice.reason, choice.scale
        if self.gather is Gather.LINKS and self._settings.device is not Device.GPU:
            self.close()

    def _measured(self, placed: PlacedScene, sent: Float32, samples: SampleCounts, gpu: Gpu) -> Choice:
        rays = [Gather.RAYS] if gpu.info.computes else []
        try:
            makers = Makers(self._gather_rays(placed), self._tried_views(placed, gpu), self._workers)
            return choose(placed, sent, samples, makers, [*rays, Gather.HEMICUBE, Gather.PLANE], gpu.info.renderer)
        except GpuFailed as fault:
            return Choice(Gather.LINKS, f"the GPU failed: {fault}", renderer=gpu.info.renderer)

    def _gather_rays(self, placed: PlacedScene) -> Callable[[SampleCounts, int], GatherRays]:
        assert self._bright is not None
        bright, settings = self._bright, self._settings
        return lambda samples, seed: GatherRays(
            placed.texels, placed.frame, placed.geometry, placed.surfaces, placed.tracer, placed.sky, bright, samples,
            max_specular=settings.max_specular, seed=settings.seed + seed,
        )  # fmt: skip

    def _tried_views(
        self, placed: PlacedScene, gpu: Gpu
    ) -> Callable[[Gather, int], AbstractContextManager[ViewGather]]:
        @contextmanager
        def views(kind: Gather, size: int) -> Iterator[ViewGather]:
            before = placed.tracer
            if kind is Gather.RAYS and not isinstance(before, ComputeTracer):
                placed.tracer = ComputeTracer(placed.scene, placed.geometry, placed.state, gpu)
            try:
                gather = self._view_gather(kind, size, placed, gpu, memory=0)
                yield gather
                gather.release()
            finally:
                if isinstance(placed.tracer, ComputeTracer) and placed.tracer is not before:
                    placed.tracer.close()
                placed.tracer = before

        return views

    def make(self, placed: PlacedScene, samples: SampleCounts, memory: int) -> KeptGather:
        """A gather with ``samples``, or as many pixels as stand for them, that may keep ``memory`` bytes.

        Raises GpuFailed where the scene does not fit the GPU.
        """
        settings = self._settings
        if self.gather is not Gather.LINKS and self._gpu is not None:
            return self._view_gather(self.gather, self.pixels(samples), placed, self._gpu, memory=memory)
        assert self._bright is not None
        return LinkGather(
            placed, self._bright, samples, self._workers,
            memory=memory, max_specular=settings.max_specular, seed=settings.seed,
        )  # fmt: skip

    @property
    def device(self) -> str:
        """What traces and gathers: cpu, or the GPU's name."""
        uses_gpu = self.gather is not Gather.LINKS or self._settings.device is Device.GPU
        return self._gpu.info.renderer if self._gpu is not None and uses_gpu else "cpu"

    def pixels(self, samples: SampleCounts) -> int:
        """Along a view that stands for ``samples``; 0: gathered by links."""
        if self.gather is Gather.LINKS:
            return 0
        return int(min(max(view_size(samples) * self._scale, LEAST_SIZE), MOST_SIZE))

    def _view_gather(self, kind: Gather, size: int, placed: PlacedScene, gpu: Gpu, *, memory: int) -> ViewGather:
        settings = self._settings
        if self._coarse is None:
            self._coarse = stand_ins_of_meshes(placed, settings.stand_in_triangles)
        view = make_view(kind, size, settings.enlargement)
        return ViewGather(placed, gpu, view, self._workers, memory=memory, coarse=self._coarse, seed=settings.seed)

    def give_up(self, fault: GpuFailed) -> None:
        """The GPU failed: from now on everything is done by the CPU."""
        self.close()
        self._go_on_without(str(fault))

    def close(self) -> None:
        """Give the GPU back."""
        if self._gpu is not None:
            self._gpu.close()
        self._gpu = None

    def _go_on_without(self, why: str) -> None:
        self.gather, self.reason = Gather.LINKS, why
        self.notes.append(f"{why}; the CPU does it: same light, by links")

    def warnings(self, placed: PlacedScene) -> list[str]:
        """What was not to be had, and what views leave out of the scene, a line each."""
        if self.gather is Gather.LINKS:
            return list(self.notes)
        names = passing_materials(placed)
        left_out = [f"{names}: gather {self.gather} {_PASSING}"] if names else []
        left_out += [_GRAZING] if self.gather is Gather.PLANE else []
        if self._gpu is not None and self._settings.device is Device.GPU and not self._gpu.info.computes:
            left_out.append(f"{self._gpu.info.renderer}: has no compute shaders; the CPU traces what rays there are")
        return [*self.notes, *left_out]

    def stand_ins(self, placed: PlacedScene) -> dict[str, dict[str, float]]:
        """By object: its triangles, those of its stand-in, and how far, m, its vertices moved (RMS and most)."""
        meshes, coarse = placed.scene.meshes, (self._coarse or {}) if self.gather in DRAWN else {}
        return {
            instance.name: {
                "triangles": meshes[instance.mesh].triangle_count,
                "stand_in": len(coarse[instance.mesh].source),
                "deviation_rms": coarse[instance.mesh].deviation_rms,
                "deviation_max": coarse[instance.mesh].deviation_max,
            }
            for instance in placed.scene.instances
            if instance.mesh in coarse
        }


def _computes(settings: BakeSettings) -> bool:
    """Do ``settings`` ask for what compute shaders do?"""
    return settings.gather is Gather.RAYS or (settings.device is Device.GPU and settings.gather not in GPU_GATHERS)


#: Gathers that see stand-ins.
DRAWN = (Gather.PLANE, Gather.HEMICUBE)
_GRAZING = (
    "gather plane leaves out grazing light: rooms come out 5 to 10 % too bright, which no estimated error shows; "
    "--gather hemicube sees all round"
)
_PASSING = "sees mirrors, glass and what lets light through as plain surfaces; --gather links follows them"


def passing_materials(placed: PlacedScene) -> str:
    """Names of the materials in use that rays go on from undiffused; "": there are none."""
    used = set(np.unique(placed.geometry.material_of_triangle).tolist())
    return ", ".join(sorted(m.name for k, m in enumerate(placed.materials) if k in used and m.passes_rays))


def stand_ins_of_meshes(placed: PlacedScene, most: int) -> dict[int, CoarseMesh]:
    """Stand-ins, by mesh, of those with more than ``most`` triangles; 0: of none."""
    if not most:
        return {}
    found = {number: coarse_mesh(mesh, most) for number, mesh in enumerate(placed.scene.meshes)}
    return {number: coarse for number, coarse in found.items() if coarse is not None}
