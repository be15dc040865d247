# SPDX-License-Identifier: GPL-3.0-or-later
"""From the extracted scene to the one that is baked: a light-map layout for each mesh, then everything put together.

Between ``extract`` and ``sides``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .backend.progress import Report
from .backend.scene import Mesh, Scene
from .backend.settings import BakeSettings
from .extract import Appearance
from .source import Layout, SourceScene, world_area
from .unwrap import unwrap

#: Share of a page that charts cover, roughly (38-56 % measured); only margins between islands depend on it.
COVERAGE = 0.5
#: Least side of a mesh's colour maps.
LEAST_PX = 4


def lay_out(source: SourceScene, densities: Sequence[float], report: Report) -> tuple[list[Layout], list[str]]:
    """The layout of each mesh of ``source``, made for ``densities`` (:func:`expected_densities`), and warnings."""
    layouts, warnings = [], []
    for index, (mesh, density) in enumerate(zip(source.meshes, densities, strict=True)):
        report("unwrap", index, len(source.meshes))
        layout, said = unwrap(mesh, texels_per_metre=density)
        layouts.append(layout)
        warnings += said
    report("unwrap", len(source.meshes), len(source.meshes))
    return layouts, warnings


def map_sizes(layouts: Sequence[Layout], densities: Sequence[float], resolution: int) -> list[tuple[int, int]]:
    """(width, height) in pixels at which each mesh's colours are evaluated: about a pixel for each of its texels."""
    return [
        tuple(int(np.clip(np.ceil(metres * density), LEAST_PX, resolution)) for metres in layout.size)
        for layout, density in zip(layouts, densities, strict=True)
    ]


def assemble(source: SourceScene, layouts: Sequence[Layout], appearance: Appearance) -> Scene:
    """The scene to bake."""
    meshes = [
        Mesh(
            name=mesh.name,
            vertices=mesh.vertices,
            triangles=mesh.triangles,
            corner_normals=mesh.corner_normals,
            corner_uv=layout.corner_uv,
            island_of_triangle=layout.island_of_triangle,
            material_of_triangle=mesh.material_of_triangle,
            albedo_map=albedo,
            emission_map=emission,
        )
        for mesh, layout, albedo, emission in zip(
            source.meshes, layouts, appearance.albedo_maps, appearance.emission_maps, strict=True
        )
    ]
    return Scene(tuple(meshes), source.instances, appearance.materials, source.lights, source.world)


def expected_densities(source: SourceScene, settings: BakeSettings) -> list[float]:
    """About how many texels an object-space metre of each mesh will get, in its largest instance."""
    own = [world_area(mesh, np.eye(3)) for mesh in source.meshes]
    in_world = [world_area(source.meshes[i.mesh], i.matrix_world[:3, :3]) for i in source.instances]
    scale = np.zeros(len(own))  # world metres per object metre
    for instance, area in zip(source.instances, in_world, strict=True):
        if own[instance.mesh] > 0:
            scale[instance.mesh] = max(scale[instance.mesh], float(np.sqrt(area / own[instance.mesh])))
    density = settings.density
    if density is None:
        total = sum(in_world)
        density = settings.resolution * float(np.sqrt(COVERAGE / total)) if total > 0 else 1.0
    return [density * float(s) if s > 0 else density for s in scale]
