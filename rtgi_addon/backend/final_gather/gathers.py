# SPDX-License-Identifier: GPL-3.0-or-later
"""The final gather of a bake: made for each number of samples, by links or by views on the GPU.

Where the GPU fails, :meth:`Gathers.give_up` goes over to links; their maps are those of a bake that never had a GPU.
"""

from __future__ import annotations

from ..gpu.compute_tracer import ComputeTracer
from ..gpu.context import COMPUTE_VERSION, LEAST_VERSION, Gpu, GpuFailed, GpuUnavailable, open_gpu
from ..parallel import Workers
from ..placed import PlacedScene
from ..scene import FrameState, Scene
from ..settings import GPU_GATHERS, BakeSettings, Device, Gather, SampleCounts
from ..surface.geometry import Geometry
from ..surface.tracing import EmbreeTracer, FollowingTracer
from .bright import BrightTargets
from .coarse import CoarseMesh, coarse_mesh
from .kept_gather import KeptGather
from .link_gather import LinkGather
from .view_gather import ViewGather, view_size
from .views import make_view


class Gathers:
    """Which gather a bake uses, and what traces its rays. Close it to give the GPU back.

    ``notes``: lines for the user about what was not to be had.
    """

    def __init__(self, settings: BakeSettings, workers: Workers) -> None:
        """Opens the GPU where ``settings`` ask for one; without any that serves, everything is done by the CPU."""
        self._settings, self._workers = settings, workers
        self._bright: BrightTargets | None = None
        self._coarse: dict[int, CoarseMesh] | None = None
        self._gpu: Gpu | None = None
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
        asked = self._settings.device is Device.GPU or self._settings.gather is Gather.RAYS
        if self._gpu is None or not asked or not self._gpu.info.computes:
            return EmbreeTracer(scene, geometry, state, self._workers)
        return ComputeTracer(scene, geometry, state, self._gpu)

    def choose(self, bright: BrightTargets) -> None:
        """Settle which gather is made; ``bright``: what its rays are aimed at, where they are aimed."""
        self._bright = bright
        asked = self._settings.gather
        if self._gpu is not None and asked is not Gather.AUTO:
            self.gather = asked
        self.reason = self.reason or "asked for"

    def make(self, placed: PlacedScene, samples: SampleCounts, memory: int) -> KeptGather:
        """A gather with ``samples``, or as many pixels as stand for them, that may keep ``memory`` bytes.

        Raises GpuFailed where the scene does not fit the GPU.
        """
        settings = self._settings
        if self.gather is Gather.LINKS or self._gpu is None:
            assert self._bright is not None
            return LinkGather(
                placed, self._bright, samples, self._workers,
                memory=memory, max_specular=settings.max_specular, seed=settings.seed,
            )  # fmt: skip
        view = make_view(self.gather, view_size(samples), settings.enlargement)
        if self._coarse is None:
            self._coarse = stand_ins_of_meshes(placed, settings.stand_in_triangles)
        return ViewGather(
            placed, self._gpu, view, self._workers, memory=memory, coarse=self._coarse, seed=settings.seed
        )

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
        used = {int(m) for m in placed.geometry.material_of_triangle}
        names = sorted(m.name for k, m in enumerate(placed.materials) if k in used and m.passes_rays)
        passing = [f"{', '.join(names)}: gather {self.gather} {_PASSING}"] if names else []
        return [*self.notes, *passing]

    def stand_ins(self, placed: PlacedScene) -> dict[str, dict[str, float]]:
        """By object: its triangles, those of its stand-in, and how far, m, its vertices moved (RMS and most)."""
        meshes, coarse = placed.scene.meshes, self._coarse or {}
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


_PASSING = "sees mirrors, glass and what lets light through as plain surfaces; --gather links follows them"


def stand_ins_of_meshes(placed: PlacedScene, most: int) -> dict[int, CoarseMesh]:
    """Stand-ins, by mesh, of those with more than ``most`` triangles; 0: of none."""
    if not most:
        return {}
    found = {number: coarse_mesh(mesh, most) for number, mesh in enumerate(placed.scene.meshes)}
    return {number: coarse for number, coarse in found.items() if coarse is not None}
