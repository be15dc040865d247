# SPDX-License-Identifier: GPL-3.0-or-later
"""Every choice a bake has, with defaults, units and ranges. The command line and Blender's panel read this table."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any


class Quality(StrEnum):
    """Named sample counts; ``target_error`` overrides them."""

    DRAFT = "draft"
    PREVIEW = "preview"
    FINAL = "final"


class Gather(StrEnum):
    """Which final gather computes the IIM."""

    AUTO = "auto"  # what meets the error asked soonest on this machine
    LINKS = "links"  # rays by the cosine and at what is bright, kept as a sparse matrix
    PLANE = "plane"  # the scene drawn on one plane before each texel (Larsen04 §4); leaves out grazing light
    HEMICUBE = "hemicube"  # the scene drawn on half a cube about each texel (Cohen and Greenberg 1985)
    RAYS = "rays"  # rays by the cosine, traced and summed on the GPU; needs OpenGL 4.3


class Device(StrEnum):
    """What traces and draws. Without OpenGL that serves, GPU goes on with the CPU, and says so."""

    AUTO = "auto"
    CPU = "cpu"
    GPU = "gpu"


class Caustics(StrEnum):
    """AUTO: trace them when the scene has a mirror or glass."""

    AUTO = "auto"
    ON = "on"
    OFF = "off"


class AimDirect(StrEnum):
    """Where the direct part of the AIM comes from."""

    SHADOW_RAYS = "shadow_rays"
    PHOTONS = "photons"  # Larsen04 §3 as written


class AimBounced(StrEnum):
    """Where the bounced part of the AIM comes from."""

    AUTO = "auto"
    FEEDBACK = "feedback"  # AIM = direct + caustics + last IIM, to the fixed point of radiosity
    PHOTONS = "photons"  # k nearest photons (Larsen04 §3)


class Selection(StrEnum):
    """How a frame finds what of the one before still holds (DESIGN §5). Maps are the same, but for PROBE's lag."""

    SWEPT = "swept"  # stored photons and gather rays are tested against what moved
    PROBE = "probe"  # one photon of each group tells for all of it (Larsen04 §2); gather rays as SWEPT
    OFF = "off"  # every frame from scratch


@dataclass(frozen=True)
class SampleCounts:
    """Gather rays of one texel: ``cosine`` follow the cosine, ``bright`` are aimed at bright texels and sky."""

    cosine: int
    bright: int

    def __post_init__(self) -> None:
        if self.cosine < 2 or self.bright < 0 or self.cosine % 2 or self.bright % 2:
            raise ValueError(f"{self}: both must be even, since half of the rays tell the noise of all")

    @property
    def total(self) -> int:
        return self.cosine + self.bright


#: Rays per texel by quality: about 4 %, 2 % and 1 % error on the Cornell box at 128² (docs/benchmarks.md).
SAMPLES_OF_QUALITY = {
    Quality.DRAFT: SampleCounts(8, 8),
    Quality.PREVIEW: SampleCounts(32, 32),
    Quality.FINAL: SampleCounts(128, 128),
}


def _setting(default: Any, help_text: str, low: float | None = None, high: float | None = None) -> Any:
    return field(default=default, metadata={"help": help_text, "low": low, "high": high})


#: Gathers that need OpenGL.
GPU_GATHERS = (Gather.PLANE, Gather.HEMICUBE, Gather.RAYS)


@dataclass(frozen=True)
class BakeSettings:
    """All settings of a bake. Immutable; ``dataclasses.replace`` makes variants."""

    resolution: int = _setting(1024, "side of an atlas page in pixels", 16, 16384)
    density: float | None = _setting(None, "texels per metre; none: fill one page", 1e-6, 1e6)
    quality: Quality = _setting(Quality.PREVIEW, "sample counts by name")
    target_error: float | None = _setting(None, "stop at this relative RMS error of the IIM, 0.04 is 4 %", 0.002, 1.0)
    gather: Gather = _setting(Gather.AUTO, "final gather method")
    device: Device = _setting(Device.AUTO, "where to compute")
    enlargement: float = _setting(2.0, "gather plane: its half side, in distances from the texel", 1.0, 16.0)
    stand_in_triangles: int = _setting(
        4096, "gather plane and hemicube: meshes of more triangles are seen as simplified ones; 0: never", 0, 2**30
    )
    caustics: Caustics = _setting(Caustics.AUTO, "light that reaches a wall by mirror or glass")
    aim_direct: AimDirect = _setting(AimDirect.SHADOW_RAYS, "direct part of the AIM")
    aim_bounced: AimBounced = _setting(AimBounced.AUTO, "bounced part of the AIM")
    selection: Selection = _setting(Selection.SWEPT, "how a frame finds what still holds of the one before")
    link_memory: int = _setting(
        4096,
        "MiB for kept gather rays, 11 bytes each; what does not fit is traced anew for every bounce",
        1,
        2**20,
    )
    direct_samples: int = _setting(8, "shadow rays per texel and lamp; 8 use each of a texel's points once", 1, 4096)
    photons: int = _setting(100_000, "photons emitted per frame, shared by the lights by their flux", 1, 100_000_000)
    nearest_photons: int = _setting(64, "photons in one irradiance estimate (k)", 4, 1024)
    max_bounces: int = _setting(64, "longest photon path", 1, 1024)
    max_specular: int = _setting(16, "mirrors and glass one ray may pass", 0, 256)
    estimate: bool = _setting(True, "estimated error of each frame; costs a second denoise")
    denoise: bool = _setting(True, "Open Image Denoise on the IIM")
    seams: bool = _setting(True, "match the borders of islands of one smooth surface")
    threads: int = _setting(0, "threads for tracing; 0: one per core", 0, 1024)
    seed: int = _setting(0, "another seed gives other noise, same expectation", 0, 2**31 - 1)

    def __post_init__(self) -> None:
        for f in fields(self):
            if isinstance(f.default, StrEnum):  # a word does as well
                object.__setattr__(self, f.name, type(f.default)(getattr(self, f.name)))
            value, low, high = getattr(self, f.name), f.metadata["low"], f.metadata["high"]
            if value is not None and low is not None and not low <= value <= high:
                raise ValueError(f"{f.name} = {value}: must lie in [{low}, {high}]")
        if self.device is Device.CPU and self.gather in GPU_GATHERS:
            raise ValueError(f"gather = {self.gather}: is done by a GPU; leave the device to auto, or choose links")

    @property
    def samples(self) -> SampleCounts:
        """Gather rays per texel when no target error is set."""
        return SAMPLES_OF_QUALITY[self.quality]


@dataclass(frozen=True)
class Budget:
    """What the updates of one live frame may cost. With neither limit everything is done, as in a batch frame."""

    texels: int | None = None
    milliseconds: float | None = None

    def __post_init__(self) -> None:
        if self.texels is not None and self.texels < 1:
            raise ValueError(f"a budget of {self.texels} texels updates nothing")
        if self.milliseconds is not None and not self.milliseconds >= 0:
            raise ValueError(f"a budget of {self.milliseconds} ms")


@dataclass(frozen=True)
class LiveSettings:
    """How a session that must not stop for long follows the scene (Larsen04 §3, §4)."""

    budget: Budget = field(default_factory=Budget)
    photons: int | None = None  # re-traced in a frame; None: all that are disturbed
    threshold: float = 1e-3  # a surface waits while its Δ per area is below this share of the mean irradiance
    patience: int = 30  # but no texel longer than so many frames, and those it then waits in line
    blend_time: float = 0.2  # seconds over which new maps take the place of those shown

    def __post_init__(self) -> None:
        if self.photons is not None and self.photons < 1:
            raise ValueError(f"a budget of {self.photons} photons updates nothing")
        if not (self.threshold >= 0 and self.patience >= 0 and self.blend_time >= 0):
            raise ValueError(f"{self}: threshold, patience and blend time must not be negative")
