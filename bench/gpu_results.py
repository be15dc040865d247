# SPDX-License-Identifier: GPL-3.0-or-later
"""What the bench of the gather by views finds: times, errors, and what they were measured on."""

from __future__ import annotations

from dataclasses import dataclass

from rtgi_addon.backend.gpu.context import GpuInfo
from rtgi_addon.backend.settings import Gather

from .errors import Errors
from .results import Machine

#: What a view is made, or summed, by: triangles and fragments, or compute shaders.
RASTER, COMPUTE = "raster", "compute"


def path_of(kind: Gather) -> str:
    """What a gather of this kind does its work by."""
    return {Gather.LINKS: "CPU", Gather.RAYS: COMPUTE}.get(kind, RASTER)


@dataclass(frozen=True)
class GatherTime:
    """One final gather of a batch, µs a texel."""

    kind: Gather
    size: int  # pixels along a view; its square is the rays of RAYS and LINKS
    polygons: int  # as in the paper
    triangles: int  # ours
    paper: float  # µs
    path: str  # RASTER, COMPUTE, or CPU's rays
    texels: int  # of a batch
    view: float = 0.0  # drawing or tracing
    sums: float = 0.0  # what is in the view, from radiosity in main memory to irradiance there; 0 for LINKS
    skipped: str = ""  # why there are no figures

    @property
    def both(self) -> float:
        return self.view + self.sums


@dataclass(frozen=True)
class Accuracy:
    """Views of one kind and size against links, given the same radiosity."""

    scene: str
    kind: Gather
    path: str
    size: int
    errors: Errors  # over valid texels
    whole: Errors  # over those of them that are mostly surface


@dataclass(frozen=True)
class SumTime:
    kind: Gather
    size: int
    way: str  # "exact" or "mip-map"
    path: str
    microseconds: float  # a view
    difference: float  # RMS from the first way, / mean


@dataclass(frozen=True)
class StandIn:
    """Hemicubes of a room with a dense object, drawn as it is or as its stand-in."""

    triangles: int  # of the object as it is drawn
    microseconds: float  # a view
    deviation: tuple[float, float]  # m, RMS and largest
    errors: Errors  # against links to the object as it is
    difference: float  # RMS from the views of the object as it is, / mean


@dataclass(frozen=True)
class FrameTime:
    """All texels of one frame; ms."""

    kind: Gather
    path: str
    size: int
    texels: int
    renewed: float = 0.0  # all views anew: what lies open by rays, eyes, drawing
    drawn: float = 0.0  # of it drawing
    product: float = 0.0  # other light
    skipped: str = ""  # why there are no figures

    @property
    def frame(self) -> float:
        return self.renewed + self.product


@dataclass(frozen=True)
class GpuResult:
    """``device`` None: there is no OpenGL, ``absent`` says why, and nothing else is told."""

    machine: Machine
    device: GpuInfo | None
    absent: str = ""
    sum_path: str = ""  # of views' exact sums in a bake
    times: tuple[GatherTime, ...] = ()
    accuracies: tuple[Accuracy, ...] = ()
    sums: tuple[SumTime, ...] = ()
    stand_ins: tuple[StandIn, ...] = ()
    frames: tuple[FrameTime, ...] = ()
