# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays against the scene: nearest hit and shadow test, by Embree. Local space (see ``geometry``).

Instances that stay put share one Embree scene, built once. Each rigid mover has a scene of its own in its object
space and the rays are transformed into it (Larsen04 §8), so moving costs no rebuilding. Deforming instances are
rebuilt in every frame (Embree and embreex: 2.7 µs a triangle). A part that an object has left behind can still be
tested, which is how the swept test finds what it uncovers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from ..parallel import Workers
from ..sampling import dot
from ..scene import Bool, Float32, Float64, FrameState, Int32, Scene
from .geometry import Geometry

UInt8 = NDArray[np.uint8]

#: Share by which a place's sphere is taken wider: float32 loses that much of the distance between line and centre.
CULL_MARGIN = np.float32(1e-4)

FREE, MOVER, WALL = np.uint8(0), np.uint8(1), np.uint8(2)


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

    def blocked(self, origins: Float32, directions: Float32, distances: Float32) -> UInt8:
        """(n,) FREE, or what is hit before ``distances``: a MOVER, or a WALL, which stays put whatever moves."""
        ...


@dataclass(frozen=True)
class Part:
    """One Embree scene: the still instances together, in local space; or a mover where it stood when this was made."""

    embree: Any
    triangle_of_primitive: Int32  # scene-wide
    to_object: Float64 | None = None  # (3, 4) from local to the mover's own space; None: rays are taken as they are
    centre: Float64 | None = None  # (3,) in the mover's object space: the origin of its own space

    def rays(self, origins: Float32, directions: Float32) -> tuple[Float32, Float32]:
        """Rays in the part's own space; a direction keeps its parametrisation, so distances stay comparable."""
        if self.to_object is None:
            return _float32(origins), _float32(directions)
        # Sums written out: a matrix product's rounding may hang on how many rays there are.
        x, y, z = (origins[:, k].astype(np.float64) for k in range(3))
        dx, dy, dz = directions[:, 0], directions[:, 1], directions[:, 2]
        moved, turned = np.empty_like(origins, np.float32), np.empty_like(directions, np.float32)
        for k, (a, b, c, shift) in enumerate(self.to_object):
            moved[:, k] = x * a + y * b + z * c + shift
            turned[:, k] = dx * np.float32(a) + dy * np.float32(b) + dz * np.float32(c)
        return moved, turned

    def occluded(self, origins: Float32, directions: Float32, distances: Float32) -> Bool:
        """(n,) is this part hit before ``distances``?"""
        o, d = self.rays(origins, directions)
        return np.asarray(self.embree.run(o, d, dists=_float32(distances), query="OCCLUDED") != -1)


@dataclass(frozen=True)
class Place:
    """Where an object that rays can hit stood, or stands now."""

    instance: int
    part: Part
    centre: Float64  # (3,) of a sphere around it, local
    radius: float  # m

    def near(self, origins: Float32, directions: Float32, distances: Float32) -> NDArray[np.int64]:
        """(k,) of n rays those that may meet the sphere before ``distances``: a tenth of the cost of tracing them."""
        x, y, z = (np.float32(c) - origins[:, k] for k, c in enumerate(self.centre))
        dx, dy, dz = directions[:, 0], directions[:, 1], directions[:, 2]
        along, length, apart = x * dx + y * dy + z * dz, dx * dx + dy * dy + dz * dz, x * x + y * y + z * z
        radius = np.float32(self.radius)
        square = radius * radius
        # Squared distance of the line from the centre, times the direction's squared length.
        beside = apart * length - along * along <= (square + CULL_MARGIN * apart) * length
        reached = along - radius * np.sqrt(length) <= distances * length
        return np.flatnonzero((apart <= square) | (beside & reached & (along > 0)))


@dataclass(frozen=True)
class Movement:
    """How the tracer's world changed from one frame to the next."""

    left: tuple[Place, ...] = ()  # where objects were that moved on or vanished
    taken: tuple[Place, ...] = ()  # where objects are that moved or appeared
    rebuilt: bool = False  # what was said to stay put did not: nothing known about any ray holds


class FollowingTracer(Tracer, Protocol):
    """A :class:`Tracer` that follows a geometry from frame to frame."""

    def update(self, state: FrameState, changed: list[int]) -> Movement:
        """Follow the geometry after its own update, which returned ``changed``."""
        ...


class Movers:
    """Which instances rays can hit, and where those that move stand; follows a :class:`Geometry` frame by frame."""

    def __init__(self, scene: Scene, geometry: Geometry, state: FrameState) -> None:
        self._scene = scene
        self._geometry = geometry
        # One for all parts: each takes a slot of the process, of which Linux has 1024, and then crashes.
        self.device = EmbreeDevice()
        self._visible: Bool = state.visible.copy()
        self.places: dict[int, Place] = {i: self._place(i, state, None) for i in self._present(moving=True)}

    def update(self, state: FrameState, changed: list[int]) -> Movement:
        """Follow ``geometry`` after its own update, which returned ``changed``."""
        switched = np.nonzero(state.visible != self._visible)[0].tolist()
        self._visible = state.visible.copy()
        rebuilt = any(not self._moves(i) for i in [*changed, *switched])
        before, moved = self.places, set(changed)
        self.places = {
            i: before[i] if i in before and i not in moved else self._place(i, state, before.get(i))
            for i in self._present(moving=True)
        }
        other = [i for i in sorted(before.keys() | self.places.keys()) if before.get(i) is not self.places.get(i)]
        left, taken = (tuple(places[i] for i in other if i in places) for places in (before, self.places))
        return Movement(left, taken, rebuilt)

    def still_triangles(self) -> Int32:
        """(k,) those of the instances that stay put."""
        rows = [np.arange(s.start, s.stop) for s in map(self._geometry.triangles_of, self._present(moving=False))]
        return np.concatenate(rows or [np.zeros(0)]).astype(np.int32)

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

    def _place(self, index: int, state: FrameState, before: Place | None) -> Place:
        """Where a mover stands; its triangles are built anew only where they deform."""
        matrix = self._geometry.matrix_world[index]
        inverse = np.linalg.pinv(matrix[:3, :3])  # a flat transform still gets an answer
        shift = inverse @ (self._geometry.origin - matrix[:3, 3])
        rows = self._geometry.triangles_of(index)
        if before is not None and not self._scene.instances[index].deforming:
            part = before.part
        else:
            corners = object_corners(self._scene, index, state)
            # Float32 is finest about the middle; a mesh may lie a kilometre from its object's origin.
            centre = _middle(_finite(corners))
            part = replace(_part(self.device, corners - centre, np.arange(rows.start, rows.stop)), centre=centre)
        part = replace(part, to_object=np.concatenate([inverse, (shift - part.centre)[:, None]], axis=1))
        return Place(index, part, *_sphere(self._geometry.corners[rows], self._geometry))


class EmbreeTracer:
    """The :class:`Tracer` by Embree over a :class:`Geometry`, which it follows from frame to frame."""

    def __init__(self, scene: Scene, geometry: Geometry, state: FrameState, workers: Workers) -> None:
        self._geometry = geometry
        self._workers = workers
        self._movers = Movers(scene, geometry, state)
        self._still = self._build_still()

    def update(self, state: FrameState, changed: list[int]) -> Movement:
        """Follow ``geometry`` after its own update, which returned ``changed``."""
        movement = self._movers.update(state, changed)
        if movement.rebuilt:
            self._still = self._build_still()
        return movement

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
        return np.asarray(self.blocked(origins, directions, distances) != FREE)

    def blocked(self, origins: Float32, directions: Float32, distances: Float32) -> UInt8:
        chunks = self._workers.map_slices(
            lambda s: self._blocked(origins[s], directions[s], distances[s]), len(origins)
        )
        return np.concatenate(chunks) if chunks else np.zeros(0, np.uint8)

    def _build_still(self) -> Part | None:
        rows = self._movers.still_triangles()
        return _part(self._movers.device, self._geometry.corners[rows], rows) if len(rows) else None

    def _intersect(self, origins: Float32, directions: Float32) -> Hits:
        count = len(origins)
        triangle = np.full(count, -1, np.int32)
        u, v = np.zeros(count, np.float32), np.zeros(count, np.float32)
        distance = np.full(count, np.inf, np.float32)
        if self._still is not None:
            found = self._still.embree.run(*self._still.rays(origins, directions), dists=distance, output=True)
            triangle = self._still.triangle_of_primitive.take(found["primID"], mode="clip")
            triangle[found["primID"] < 0] = -1
            u, v, distance = found["u"], found["v"], found["tfar"]
        for place in self._movers.places.values():
            near = place.near(origins, directions, distance)
            o, d = place.part.rays(origins[near], directions[near])
            found = place.part.embree.run(o, d, dists=distance[near], output=True)
            met = found["primID"] >= 0
            rows = near[met]
            triangle[rows] = place.part.triangle_of_primitive[found["primID"][met]]
            u[rows], v[rows], distance[rows] = found["u"][met], found["v"][met], found["tfar"][met]
        return Hits(triangle, u, v, distance, cosines(self._geometry, triangle, directions))

    def _blocked(self, origins: Float32, directions: Float32, distances: Float32) -> UInt8:
        blocked = np.zeros(len(origins), np.uint8)
        if self._still is not None:
            blocked[self._still.occluded(origins, directions, distances)] = WALL
        if not self._movers.places:
            return blocked
        free = np.flatnonzero(blocked == FREE)
        origins, directions, distances = origins[free], directions[free], distances[free]
        for place in self._movers.places.values():
            near = place.near(origins, directions, distances)
            near = near[blocked[free[near]] == FREE]
            met = place.part.occluded(origins[near], directions[near], distances[near])
            blocked[free[near[met]]] = MOVER
        return blocked


def cosines(geometry: Geometry, triangle: Int32, directions: Float32) -> Float32:
    """(n,) what :attr:`Hits.cosine` holds of rays that hit ``triangle`` (n,), -1 where they escaped."""
    if not geometry.triangle_count:
        return np.zeros(len(triangle), np.float32)
    return dot(geometry.normals.take(triangle, axis=0, mode="clip"), directions)


def object_corners(scene: Scene, index: int, state: FrameState) -> Float32:
    """(t, 3, 3) corners of an instance's triangles, object space."""
    number = scene.instances[index].mesh
    mesh = scene.meshes[number]
    return np.asarray(state.vertices.get(number, mesh.vertices)[mesh.triangles])


def _part(device: Any, corners: Float32 | Float64, rows: Any) -> Part:
    embree = EmbreeScene(device)
    # Embree ignores a triangle with a non-finite corner; a degenerate one is never hit.
    TriangleMesh(embree, np.ascontiguousarray(corners, np.float32))
    return Part(embree, rows.astype(np.int32))


def _middle(points: Float64) -> Float64:
    """(3,) of the bounding box of ``points`` (p, 3); zeros without any."""
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else np.zeros(3))


def _finite(corners: Float32) -> Float64:
    """(p, 3) the finite ones of ``corners`` (t, 3, 3)."""
    points = corners.reshape(-1, 3).astype(np.float64)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _sphere(corners: Float32, geometry: Geometry) -> tuple[Float64, float]:
    """((3,), m) a sphere around the finite ones of ``corners`` (t, 3, 3), wider by more than rays are lifted."""
    points = _finite(corners)
    if not len(points):
        return np.zeros(3), 0.0
    centre = _middle(points)
    radius = float(np.sqrt(((points - centre) ** 2).sum(axis=1).max()))
    return centre, radius * (1 + 1e-4) + 4 * float(geometry.offset_length(_float32(centre[None]) + radius)[0])


def _float32(array: Any) -> Float32:
    return np.ascontiguousarray(array, np.float32)
