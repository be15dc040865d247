# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays against the scene by compute shaders: the other :class:`Tracer`, beside Embree's. Needs OpenGL 4.3.

Instances that stay put share one hierarchy in local space, built once. Each rigid mover has one in its own space, about
the middle of its mesh; the shader transforms rays into it, so a move uploads a matrix. Deforming ones are built anew.
All hierarchies lie in one buffer of nodes and one of triangles, which other compute passes may use: see ``bound``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Bool, Float32, FrameState, Int32, Scene
from ..surface.geometry import Geometry
from ..surface.tracing import (
    CULL_MARGIN,
    FREE,
    MOVER,
    WALL,
    Hits,
    Movement,
    Movers,
    Place,
    UInt8,
    cosines,
    object_corners,
)
from .bvh import MAX_DEPTH, MAX_TRIANGLES, NODE, TRIANGLE, Bvh, build_bvh, pack_nodes, pack_triangles
from .context import Gpu, GpuFailed
from .pace import Pace
from .programs import compute_program

#: What a pass that includes ``inc/bvh.glsl`` is compiled with. Bindings from ``FIRST_FREE_BINDING`` on are its own.
DEFINES: Mapping[str, int | float] = {
    "BVH_NODES": 0,
    "BVH_TRIANGLES": 1,
    "BVH_PARTS": 2,
    "BVH_STACK": MAX_DEPTH,
    "BVH_CULL_MARGIN": float(CULL_MARGIN),
}
FIRST_FREE_BINDING = 3

#: Rays of a group: two of the widest hardware's waves.
GROUP = 128
#: Rays of a dispatch: the fewest that fill a device, and the most, 2^15 groups of the 65535 that OpenGL promises.
FEWEST_RAYS, FIRST_RAYS, MOST_RAYS = 1 << 12, 1 << 15, 1 << 22

#: As ``Part`` of ``inc/bvh.glsl`` lies in std430, after a header of four integers.
PART = np.dtype(
    [
        ("turn", "<f4", (3, 4)),
        ("centre", "<f4", 3),
        ("root", "<i4"),
        ("low", "<f4", 3),
        ("kind", "<u4"),
        ("high", "<f4", 3),
        ("radius", "<f4"),
    ]
)
#: As ``Ray`` and ``Hit`` of ``trace.glsl``.
RAY = np.dtype([("origin", "<f4", 3), ("limit", "<f4"), ("direction", "<f4", 3), ("unused", "<f4")])
HIT = np.dtype([("triangle", "<i4"), ("u", "<f4"), ("v", "<f4"), ("distance", "<f4")])
BLOCKER = np.dtype("<u4")

#: m: a sphere that everything is in.
EVERYWHERE = 1e18
#: The key of what stays put among hierarchies; movers have their instance's number.
STILL = -1


class ComputeTracer:
    """The :class:`Tracer` by OpenGL over a :class:`Geometry`, which it follows from frame to frame.

    May be called from any thread; they take turns, so one that holds ``gpu.current()`` must not wait for rays of
    another. All methods raise GpuFailed when OpenGL fails or the scene does not fit; then only ``close`` is left.
    """

    def __init__(self, scene: Scene, geometry: Geometry, state: FrameState, gpu: Gpu) -> None:
        if not gpu.info.computes:
            raise GpuFailed(f"{gpu.info.renderer}: OpenGL {gpu.info.version} has no compute shaders")
        self._scene = scene
        self._geometry = geometry
        self._gpu = gpu
        rays = {"TRACE_RAYS": FIRST_FREE_BINDING, "TRACE_RESULTS": FIRST_FREE_BINDING + 1, "TRACE_GROUP": GROUP}
        self._nearest = compute_program(gpu, "trace", TRACE_ANY=0, **rays, **DEFINES)
        self._any = compute_program(gpu, "trace", TRACE_ANY=1, **rays, **DEFINES)
        self._movers = Movers(scene, geometry, state)
        self._hierarchies: dict[int, _Hierarchy] = {}
        self._buffers = _SceneBuffers(gpu, part_count=len(scene.instances) + 1)
        self._rays = _RayBuffers(gpu)
        self._upload(state, rebuilt=True)

    def update(self, state: FrameState, changed: list[int]) -> Movement:
        """Follow ``geometry`` after its own update, which returned ``changed``."""
        movement = self._movers.update(state, changed)
        self._upload(state, rebuilt=movement.rebuilt)
        return movement

    def intersect(self, origins: Float32, directions: Float32) -> Hits:
        found = self._trace(self._nearest, HIT, origins, directions, np.full(len(origins), np.inf, np.float32))
        triangle, u, v, distance = (np.ascontiguousarray(found[name]) for name in ("triangle", "u", "v", "distance"))
        return Hits(triangle, u, v, distance, cosines(self._geometry, triangle, directions))

    def occluded(self, origins: Float32, directions: Float32, distances: Float32) -> Bool:
        return np.asarray(self.blocked(origins, directions, distances) != FREE)

    def blocked(self, origins: Float32, directions: Float32, distances: Float32) -> UInt8:
        return self._trace(self._any, BLOCKER, origins, directions, distances).astype(np.uint8)

    @contextmanager
    def bound(self) -> Iterator[Any]:
        """The moderngl context, current on this thread, with the scene where ``DEFINES`` say: for other passes."""
        with self._gpu.current() as ctx:
            self._buffers.bind()
            yield ctx

    def close(self) -> None:
        """Give the device's memory back. A second call does nothing."""
        self._buffers.release()
        self._rays.release()

    def _upload(self, state: FrameState, *, rebuilt: bool) -> None:
        """Bring hierarchies and the device to where the movers are; ``rebuilt``: also what stays put."""
        before = self._hierarchies
        now: dict[int, _Hierarchy] = {}
        if rebuilt:
            rows = self._movers.still_triangles()
            if len(rows):
                now[STILL] = _Hierarchy.of(self._geometry.corners[rows], rows)
        elif STILL in before:
            now[STILL] = before[STILL]
        for index, place in self._movers.places.items():
            known = before.get(index)
            now[index] = known if known is not None and known.source is place.part.embree else self._own(place, state)
        parts = [_part(now[STILL], WALL, None)] if STILL in now else []
        parts += [_part(now[i], MOVER, place) for i, place in self._movers.places.items()]
        fresh = {key: hierarchy for key, hierarchy in now.items() if hierarchy is not before.get(key)}
        with self._gpu.current():
            if not self._buffers.replace(fresh):
                self._buffers.fill(now)
            self._buffers.set_parts(list(now), parts)
        self._hierarchies = now

    def _own(self, place: Place, state: FrameState) -> _Hierarchy:
        """Of one mover, about its mesh's middle."""
        part = place.part
        assert part.centre is not None, "a mover's part has a space of its own"
        corners = np.asarray(object_corners(self._scene, place.instance, state) - part.centre, np.float32)
        deforming = self._scene.instances[place.instance].deforming
        return _Hierarchy.of(corners, part.triangle_of_primitive, source=part.embree, varies=deforming)

    def _trace(
        self, program: Any, result: np.dtype[Any], origins: Float32, directions: Float32, limits: Float32
    ) -> NDArray[Any]:
        """(n,) ``result`` of rays with origins and directions (n, 3), limits (n,)."""
        count = len(origins)
        if origins.shape != (count, 3) or directions.shape != (count, 3) or limits.shape != (count,):
            raise ValueError(f"origins {origins.shape}, directions {directions.shape}, limits {limits.shape}")
        rays, out = np.zeros(count, RAY), np.zeros(count, result)
        rays["origin"], rays["direction"], rays["limit"] = origins, directions, limits
        if count:
            with self.bound() as ctx:
                self._rays.trace(ctx, program, rays, out)
        return out


@dataclass(frozen=True)
class _Hierarchy:
    """One hierarchy with its triangles as the device takes them."""

    bvh: Bvh
    triangles: NDArray[np.void]  # (k,) TRIANGLE
    node_room: int  # nodes that it may come to have
    triangle_room: int
    source: Any = None  # of a mover: the Embree scene made of the same triangles

    @staticmethod
    def of(corners: Float32, number: Int32, *, source: Any = None, varies: bool = False) -> _Hierarchy:
        """Over ``corners`` (t, 3, 3), whose scene-wide triangles are ``number`` (t,); ``varies``: deforming ones."""
        bvh = build_bvh(corners)
        nodes, triangles = (max(len(corners), 1), len(corners)) if varies else (len(bvh.link), len(bvh.order))
        return _Hierarchy(bvh, pack_triangles(bvh, corners, number), nodes, triangles, source)


@dataclass(frozen=True)
class _Slot:
    """Rows of the buffers that a hierarchy has for itself."""

    node: int
    triangle: int
    node_room: int
    triangle_room: int

    def holds(self, hierarchy: _Hierarchy) -> bool:
        return len(hierarchy.bvh.link) <= self.node_room and len(hierarchy.triangles) <= self.triangle_room


class _SceneBuffers:
    """Nodes, triangles and parts on the device. Its methods are called while the context is current."""

    def __init__(self, gpu: Gpu, *, part_count: int) -> None:
        self._gpu = gpu
        self._part_count = part_count
        self._slots: dict[int, _Slot] = {}
        self._nodes: Any = None
        self._triangles: Any = None
        self._parts: Any = None

    def replace(self, fresh: Mapping[int, _Hierarchy]) -> bool:
        """Write ``fresh`` over what had the same keys; False, with nothing done, where that has no room."""
        fits = all(key in self._slots and self._slots[key].holds(h) for key, h in fresh.items())
        if not fits or self._nodes is None:
            return False
        for key, hierarchy in fresh.items():
            self._write(self._slots[key], hierarchy)
        return True

    def fill(self, hierarchies: Mapping[int, _Hierarchy]) -> None:
        """Lay everything out anew."""
        self._slots, node, triangle = {}, 0, 0
        for key, h in hierarchies.items():
            self._slots[key] = _Slot(node, triangle, h.node_room, h.triangle_room)
            node, triangle = node + h.node_room, triangle + h.triangle_room
        if triangle >= MAX_TRIANGLES:
            raise GpuFailed(f"{triangle} triangles: compute shaders are given fewer than {MAX_TRIANGLES}")
        self.release()
        self._nodes = _storage(self._gpu, node * NODE.itemsize, "nodes")
        self._triangles = _storage(self._gpu, triangle * TRIANGLE.itemsize, "triangles")
        self._parts = _storage(self._gpu, 16 + self._part_count * PART.itemsize, "movers")
        for key, hierarchy in hierarchies.items():
            self._write(self._slots[key], hierarchy)

    def set_parts(self, keys: list[int], parts: list[NDArray[np.void]]) -> None:
        """The hierarchies ``keys`` with what :func:`_part` made of them, in the order in which rays meet them."""
        table = np.zeros(len(parts), PART)
        for row, (key, part) in enumerate(zip(keys, parts, strict=True)):
            table[row] = part
            table[row]["root"] = self._slots[key].node
        self._parts.write(np.array([len(parts), 0, 0, 0], "<u4").tobytes() + table.tobytes())

    def bind(self) -> None:
        if self._nodes is None:
            raise GpuFailed(f"{self._gpu.info.renderer}: the tracer is closed")
        self._nodes.bind_to_storage_buffer(DEFINES["BVH_NODES"])
        self._triangles.bind_to_storage_buffer(DEFINES["BVH_TRIANGLES"])
        self._parts.bind_to_storage_buffer(DEFINES["BVH_PARTS"])

    def release(self) -> None:
        self._gpu.release(self._nodes, self._triangles, self._parts)
        self._nodes = self._triangles = self._parts = None

    def _write(self, slot: _Slot, hierarchy: _Hierarchy) -> None:
        nodes = pack_nodes(hierarchy.bvh, slot.node, slot.triangle)
        self._nodes.write(nodes, offset=slot.node * NODE.itemsize)
        if len(hierarchy.triangles):
            self._triangles.write(hierarchy.triangles, offset=slot.triangle * TRIANGLE.itemsize)


class _RayBuffers:
    """Rays to the device and results back, a batch at a time. A ray's result does not hang on where batches are cut."""

    def __init__(self, gpu: Gpu) -> None:
        self._gpu = gpu
        most = min(MOST_RAYS, gpu.info.max_storage // RAY.itemsize)
        self._most = 1 << (most.bit_length() - 1)
        self.pace = Pace(min(FEWEST_RAYS, self._most), self._most, FIRST_RAYS)
        self._size = 0
        self._rays: Any = None
        self._results: Any = None

    def trace(self, ctx: Any, program: Any, rays: NDArray[np.void], out: NDArray[Any]) -> None:
        """Fill ``out`` (n,) by the results of ``rays`` (n,) RAY."""
        done = 0
        while done < len(rays):
            rows = slice(done, min(done + self.pace.items, len(rays)))
            with self.pace.timed(rows.stop - rows.start):
                self._dispatch(ctx, program, rays[rows], out[rows])
            done = rows.stop

    def release(self) -> None:
        self._gpu.release(self._rays, self._results)
        self._rays = self._results = None
        self._size = 0

    def _dispatch(self, ctx: Any, program: Any, rays: NDArray[np.void], out: NDArray[Any]) -> None:
        self._reserve(len(rays))
        self._rays.write(rays)
        self._rays.bind_to_storage_buffer(FIRST_FREE_BINDING)
        self._results.bind_to_storage_buffer(FIRST_FREE_BINDING + 1)
        program["ray_count"].value = len(rays)
        program.run(group_x=-(-len(rays) // GROUP))
        ctx.memory_barrier()
        out[:] = np.frombuffer(self._results.read(size=out.nbytes), out.dtype)

    def _reserve(self, count: int) -> None:
        if count <= self._size:
            return
        self.release()
        size = min(max(FEWEST_RAYS, 1 << (count - 1).bit_length()), self._most)
        self._rays = _storage(self._gpu, size * RAY.itemsize, "rays")
        self._results = _storage(self._gpu, size * HIT.itemsize, "hits")
        self._size = size


def _part(hierarchy: _Hierarchy, kind: np.uint8, place: Place | None) -> NDArray[np.void]:
    """() PART without its root; ``place`` of a mover."""
    part = np.zeros((), PART)
    part["low"], part["high"] = hierarchy.bvh.bounds
    part["kind"] = kind
    part["turn"], part["radius"] = np.eye(3, 4), EVERYWHERE
    if place is not None and place.part.to_object is not None:
        # About a point near the mover: what float32 loses is a share of the distance to it, not to the local origin.
        centre = place.centre.astype(np.float32)
        to_own = place.part.to_object.copy()
        to_own[:, 3] += to_own[:, :3] @ centre.astype(np.float64)
        part["turn"], part["centre"], part["radius"] = to_own, centre, place.radius
    return part


def _storage(gpu: Gpu, size: int, what: str) -> Any:
    """A buffer of ``size`` bytes."""
    if size > gpu.info.max_storage:
        least, most = (f"{n / 2**20:.0f} MiB" for n in (size, gpu.info.max_storage))
        raise GpuFailed(f"{gpu.info.renderer}: {what} need {least} in one storage buffer, which may have {most}")
    return gpu.ctx.buffer(reserve=max(size, 64), dynamic=True)
