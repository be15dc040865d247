# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene as plain arrays: all that the compute side knows of the world.

Filled by ``rtgi_addon.extract`` (from Blender) or by hand (from NumPy); read by every stage after it.
Units: metres, watts, radians. Axes: right-handed, z up. "object" space is a mesh's own, "world" is common.
Light-map UVs have (0, 0) at the bottom left; image row 0 is the bottom row, as in Blender's pixels.
RGB is linear Rec.709.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Bool = NDArray[np.bool_]

BLACK = (0.0, 0.0, 0.0)
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Material:
    """How a surface scatters. Shares need not add to one; what is left is absorbed.

    A mesh with an ``albedo_map`` or ``emission_map`` overrides ``albedo`` and ``emission`` per texel.
    """

    name: str
    albedo: tuple[float, float, float] = WHITE  # diffuse reflectance
    emission: tuple[float, float, float] = BLACK  # radiance, W/(m² sr), leaves both sides
    specular: tuple[float, float, float] = BLACK  # reflectance of a perfect mirror
    transmission: tuple[float, float, float] = BLACK  # share that passes by refraction (glass)
    ior: float = 1.45  # index of refraction inside
    opacity: float = 1.0  # 1 - opacity of the light goes straight through

    @property
    def is_specular(self) -> bool:
        """Does a ray go on by mirror or refraction?"""
        return max(self.specular) > 0.0 or max(self.transmission) > 0.0

    @property
    def passes_rays(self) -> bool:
        """Does a ray that lands here ever go on undiffused?"""
        return self.is_specular or self.opacity < 1.0


@dataclass(frozen=True)
class Mesh:
    """Geometry and light-map layout shared by all instances of it; t triangles, v vertices."""

    name: str
    vertices: Float32  # (v, 3) object
    triangles: Int32  # (t, 3) vertex indices
    corner_normals: Float32  # (t, 3, 3) shading normals, object, unit
    corner_uv: Float32  # (t, 3, 2) light-map UV in [0, 1]
    island_of_triangle: Int32  # (t,) UV island, 0..islands-1
    material_of_triangle: Int32  # (t,) index into Scene.materials
    albedo_map: Float32 | None = None  # (h, w, 3) over the light-map UV
    emission_map: Float32 | None = None  # (h, w, 3) radiance, W/(m² sr)

    @property
    def triangle_count(self) -> int:
        return len(self.triangles)

    @property
    def island_count(self) -> int:
        return int(self.island_of_triangle.max(initial=-1)) + 1


@dataclass(frozen=True)
class Instance:
    """One placed object. ``moving`` says that its matrix may change between frames of this bake."""

    name: str  # unique within the scene, as the user knows the object
    mesh: int  # index into Scene.meshes
    matrix_world: Float64  # (4, 4) object to world at the first frame
    moving: bool = False
    deforming: bool = False
    blocks_light: bool = True  # False: lit, but rays pass (Cycles' diffuse and shadow visibility off)
    receives_light: bool = True  # False: blocks and emits, but has no texels (holdout)


class LightKind(StrEnum):
    POINT = "point"
    SPOT = "spot"
    SUN = "sun"
    AREA = "area"


class AreaShape(StrEnum):
    RECTANGLE = "rectangle"
    ELLIPSE = "ellipse"


@dataclass(frozen=True)
class Light:
    """One lamp, drawn by Eevee itself; looks down its own -z axis. RGB everywhere.

    ``power`` means, by kind:
      POINT, SPOT: W; radiant intensity is power / 4π, within the cone for spots (Blender: the cone only cuts)
      AREA: W, emitted by the front (-z) side alone; radiance is power / (π area) for spread = π
      SUN: W/m², irradiance on a surface facing it
    """

    name: str
    kind: LightKind
    matrix_world: Float64  # (4, 4), scale is ignored but for AREA, whose sizes below already hold it
    power: tuple[float, float, float]
    radius: float = 0.0  # POINT, SPOT: m
    soft_falloff: bool = True  # POINT, SPOT with a radius: seen as a disk that faces the point, else as a sphere
    angle: float = 0.0  # SUN: half the apparent angle, rad
    cone: float = np.pi / 4  # SPOT: half the cone's angle, rad
    blend: float = 0.0  # SPOT: Blender's spot_blend, 0 hard, 1 smooth
    size: tuple[float, float] = (1.0, 1.0)  # AREA: full width and height (ellipse: diameters), world m
    shape: AreaShape = AreaShape.RECTANGLE
    spread: float = np.pi  # AREA: Blender's spread, rad
    casts_shadow: bool = True


@dataclass(frozen=True)
class World:
    """Light from infinitely far: an equirectangular radiance map.

    ``radiance`` (h, w, 3) float32, W/(m² sr). Row 0 looks straight down, the last row up. For a direction d
    towards the sky: u = 1/2 - atan2(d.y, d.x) / 2π, v = 1/2 + asin(d.z) / π (Blender's own mapping).
    A constant sky is a (1, 1, 3) map.
    """

    radiance: Float32

    @property
    def is_black(self) -> bool:
        return not bool(np.any(self.radiance > 0))


@dataclass(frozen=True)
class FrameState:
    """What of the scene may differ from frame to frame. n instances, in Scene.instances' order."""

    frame: int
    matrix_world: Float64  # (n, 4, 4)
    visible: Bool  # (n,)
    lights: tuple[Light, ...]
    world: World | None
    vertices: dict[int, Float32] = field(default_factory=dict)  # mesh -> (v, 3) object, deforming meshes only
    corner_normals: dict[int, Float32] = field(default_factory=dict)  # mesh -> (t, 3, 3) object
    materials: tuple[Material, ...] | None = None  # all of them, where one is animated


@dataclass(frozen=True)
class Scene:
    """Everything that is fixed over a bake, plus the first frame's state of what is not."""

    meshes: tuple[Mesh, ...]
    instances: tuple[Instance, ...]
    materials: tuple[Material, ...]
    lights: tuple[Light, ...] = ()
    world: World | None = None

    def first_frame(self, frame: int = 1) -> FrameState:
        """The state held in the scene itself, for scenes that do not move."""
        matrices = [i.matrix_world for i in self.instances]
        return FrameState(
            frame=frame,
            matrix_world=np.array(matrices, np.float64).reshape(-1, 4, 4),
            visible=np.ones(len(self.instances), np.bool_),
            lights=self.lights,
            world=self.world,
        )


@dataclass(frozen=True)
class Placement:
    """Where one side of one instance lies in the atlas: page UV = mesh UV * scale + offset."""

    page: int
    scale: tuple[float, float]
    offset: tuple[float, float]


@dataclass(frozen=True)
class Atlas:
    """Square pages of ``resolution`` pixels; a side without a placement has no texels and sends no light back.

    ``front`` and ``back`` follow Scene.instances. The back side is the one whose geometric normal
    (counter-clockwise triangles) points away from the viewer.
    """

    resolution: int
    page_count: int
    front: tuple[Placement | None, ...]
    back: tuple[Placement | None, ...]

    @property
    def size_px(self) -> int:
        """Pixels over all pages."""
        return self.page_count * self.resolution * self.resolution


@dataclass(frozen=True)
class LightMaps:
    """One frame's output. Maps are (pages, H, W, 3) float32 irradiance, W/m²; ``valid`` (pages, H, W) bool."""

    frame: int
    iim: Float32
    aim: Float32
    caustics: Float32 | None
    valid: Bool
