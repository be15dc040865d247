# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays against the scene: nearest hit and shadow test, by Embree. Local space (see ``geometry``).

Instances that stay put share one Embree scene, built once. Each rigid mover has a scene of its own in its object
space and the rays are transformed into it (Larsen04 §8), so moving costs no rebuilding. Deforming instances are
rebuilt in every frame (Embree and embreex: 2.7 µs a triangle).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from ..parallel import Workers
from ..scene import Bool, Float32, FrameState, Int32, Scene
from .geometry import Geometry


@dataclass(frozen=True)
class Hits:
    """Nearest hits of n rays; where ``triangle`` is -1 the ray escaped and the rest means nothing."""

    triangle: Int32  # (n,) scene-wide triangle
    u: Float32  # (n,) barycentric weight of the second corner
    v: Float32  # (n,) barycentric weight of the third corner
    distance: Float32  # (n,) in units of the direction's length
    cosine: Float32  # (n,) geometric normal · direction; negative where the ray came from the front

    @property
    def back(self) -> Bool:
        """(n,) the ray came from behind the surface."""
        return self.cosine > 0

    def take(self, rows: NDArray[np.integer[Any]]) -> Hits:
        """The hits of ``rows`` (k,), in that order."""
        return Hits(*(column[rows] for column in (self.triangle, self.u, self.v, self.distance, self.cosine)))


class Tracer(Protocol):
    """What stages need of a ray engine. Origins and directions are (n, 3) float32, local space."""

    def intersect(self, origins: Float32, directions: Float32) -> Hits:
        """Nearest hit of each ray. Directions need not be of unit length."""
        ...

    def occluded(self, origins: Float32, directions: Float32, distances: Float32) -> Bool:
        """(n,) is anything hit before ``distances`` (in units of the direction's length)?"""
        ...


@dataclass(frozen=True)
class _Part:
    """One Embree scene: the still instances together (``mover`` is None), or one mover in its object space."""

    embree: Any
    triangle_of_primitive: Int32  # scene-wide
    mover: int | None


class EmbreeTracer:
    """The :class:`Tracer` by Embree over a :class:`Geometry`, which it follows from frame to frame."""

    def __init__(self, scene: Scene, geometry: Geometry, state: FrameState, workers: Workers) -> None:
        self._scene = scene
        self._geometry = geometry
        self._workers = workers
        self._visible: Bool = state.visible.copy()
        self._still = self._build_still()
        self._movers = {i: self._build_mover(i, state) for i in self._present(moving=True)}

    def update(self, state: FrameState, changed: list[int]) -> None:
        """Follow ``geometry`` after its own update, which returned ``changed``."""
        switched = np.nonzero(state.visible != self._visible)[0].tolist()
        self._visible = state.visible.copy()
        if any(not self._moves(i) for i in [*changed, *switched]):
            self._still = self._build_still()
        keep = {}
        for index in self._present(moving=True):
            stale = index not in self._movers or (index in changed and self._scene.instances[index].deforming)
            keep[index] = self._build_mover(index, state) if stale else self._movers[index]
        self._movers = keep

    def intersect(self, origins: Float32, directions: Float32) -> Hits:
        chunks = self._workers.map_slices(lambda s: self._intersect(origins[s], directions[s]), len(origins))
        if len(chunks) == 1:
            return chunks[0]
        if not chunks:
            none = np.zeros(0, np.float32)
            return Hits(np.zeros(0, np.int32), none, none, none, none)
        return Hits(
            np.concatenate([c.triangle for c in chunks]),
            np.concatenate([c.u for c in chunks]),
            np.concatenate([c.v for c in chunks]),
            np.concatenate([c.distance for c in chunks]),
            np.concatenate([c.cosine for c in chunks]),
        )

    def occluded(self, origins: Float32, directions: Float32, distances: Float32) -> Bool:
        chunks = self._workers.map_slices(
            lambda s: self._occluded(origins[s], directions[s], distances[s]), len(origins)
        )
        return np.concatenate(chunks) if chunks else np.zeros(0, np.bool_)

    def _moves(self, index: int) -> bool:
        instance = self._scene.instances[index]
        return instance.moving or instance.deforming

    def _present(self, *, moving: bool) -> list[int]:
        """Instances that rays can hit and that have triangles."""
        return [
            i
            for i, instance in enumerate(self._scene.instances)
            if instance.blocks_light
            and self._visible[i]
            and self._moves(i) == moving
            and self._geometry.triangles_of(i).start < self._geometry.triangles_of(i).stop
        ]

    def _build_still(self) -> _Part | None:
        indices = self._present(moving=False)
        if not indices:
            return None
        rows = np.concatenate([np.arange(s.start, s.stop) for s in map(self._geometry.triangles_of, indices)])
        return _part(self._geometry.corners[rows], rows, None)

    def _build_mover(self, index: int, state: FrameState) -> _Part:
        mesh_index = self._scene.instances[index].mesh
        mesh = self._scene.meshes[mesh_index]
        vertices = state.vertices.get(mesh_index, mesh.vertices)
        rows = self._geometry.triangles_of(index)
        return _part(vertices[mesh.triangles], np.arange(rows.start, rows.stop), index)

    def _rays_of(self, part: _Part, origins: Float32, directions: Float32) -> tuple[Float32, Float32]:
        """Rays in the part's own space; a direction keeps its parametrisation, so distances stay comparable."""
        if part.mover is None:
            return origins, directions
        matrix = self._geometry.matrix_world[part.mover]
        inverse = np.linalg.pinv(matrix[:3, :3])  # a flat transform still gets an answer
        shift = self._geometry.origin - matrix[:3, 3]
        linear = inverse.T.astype(np.float32)
        return (origins.astype(np.float64) + shift) @ inverse.T, directions @ linear

    def _intersect(self, origins: Float32, directions: Float32) -> Hits:
        count = len(origins)
        triangle = np.full(count, -1, np.int32)
        u, v = np.zeros(count, np.float32), np.zeros(count, np.float32)
        distance = np.full(count, np.inf, np.float32)
        for part in [p for p in (self._still, *self._movers.values()) if p is not None]:
            o, d = self._rays_of(part, origins, directions)
            found = part.embree.run(_float32(o), _float32(d), dists=distance, output=True)
            new = found["primID"] >= 0
            if part.mover is None and new.all():
                triangle, u, v = part.triangle_of_primitive[found["primID"]], found["u"], found["v"]
                distance = found["tfar"]
                continue
            triangle[new] = part.triangle_of_primitive[found["primID"][new]]
            u[new], v[new], distance[new] = found["u"][new], found["v"][new], found["tfar"][new]
        if not self._geometry.triangle_count:
            return Hits(triangle, u, v, distance, np.zeros(count, np.float32))
        normals = self._geometry.normals.take(triangle, axis=0, mode="clip")
        return Hits(triangle, u, v, distance, np.einsum("ij,ij->i", normals, directions))

    def _occluded(self, origins: Float32, directions: Float32, distances: Float32) -> Bool:
        blocked = np.zeros(len(origins), np.bool_)
        for part in [p for p in (self._still, *self._movers.values()) if p is not None]:
            o, d = self._rays_of(part, origins, directions)
            blocked |= part.embree.run(_float32(o), _float32(d), dists=distances, query="OCCLUDED") != -1
        return blocked


def _part(corners: Float32, rows: Any, mover: int | None) -> _Part:
    embree = EmbreeScene()
    # Embree ignores a triangle with a non-finite corner; a degenerate one is never hit.
    TriangleMesh(embree, np.ascontiguousarray(corners, np.float32))
    return _Part(embree, rows.astype(np.int32), mover)


def _float32(array: Any) -> Float32:
    return np.ascontiguousarray(array, np.float32)
