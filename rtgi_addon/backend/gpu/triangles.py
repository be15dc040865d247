# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's triangles on the GPU, for drawing: vertices in object space, put in their place by a matrix an object.

What did not move is not sent again: a rigid mover costs a matrix and one run of the pass "place" over its vertices, a
deforming one its vertices. Each corner knows the atlas pixel it lies at, on the front and on the back of its side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Float64, FrameState, Int32
from ..surface.geometry import Geometry
from ..surface.texels import Texels
from .context import Gpu
from .programs import draw_program, set_uniforms

#: What a corner is told apart by, beside its vertex: pixels on both sides and the pages' first pixels.
CORNER = np.dtype([("pixel", np.float32, 4), ("first", np.int32, 2)])
#: How the pass "view" reads it, without backs and with.
CORNER_FORMAT = {
    False: ("2f 8x 1i 4x", "in_pixel", "in_first"),
    True: ("4f 2i", "in_pixel", "in_first"),
}
#: A side without a map.
NO_PAGE = -1


@dataclass(frozen=True)
class Corners:
    """The corners (c, 3) of c triangles to draw, in any order."""

    instance: Int32  # (c,)
    source: Int32  # (c,) scene-wide triangle, whose map the corners lie on
    vertex: Int32  # (c, 3) of the instance's mesh


def corners_of_scene(geometry: Geometry) -> Corners:
    """All triangles as they are."""
    scene = geometry.scene
    vertices = [scene.meshes[i.mesh].triangles for i in scene.instances]
    return Corners(
        geometry.instance_of_triangle,
        np.arange(geometry.triangle_count, dtype=np.int32),
        np.concatenate([np.zeros((0, 3), np.int32), *vertices]).astype(np.int32),
    )


class SceneTriangles:
    """The vertices of some triangles of a scene in one buffer, those of an instance one after the other."""

    def __init__(self, gpu: Gpu, geometry: Geometry, texels: Texels, state: FrameState, corners: Corners) -> None:
        """Placed in the frame that ``geometry`` and ``state`` stand in."""
        self._gpu, self._geometry = gpu, geometry
        rows = _corner_rows(texels, geometry, corners)
        kept, self._corner = _each_once(corners, rows)
        self._instance = np.repeat(corners.instance, 3)[kept]
        self._vertex = corners.vertex.reshape(-1)[kept]
        self._triangle_instance = corners.instance
        self._first = np.searchsorted(self._instance, np.arange(len(geometry.scene.instances) + 1))
        #: Does any back have a map? If none does, backs are not told apart.
        self.two_sided = bool((rows["first"][:, :, 1] != NO_PAGE).any())
        self._middle: dict[int, Float64] = {}
        self.count = len(corners.instance)
        with gpu.current() as ctx:
            size = max(len(kept), 1) * 12
            self._object, self.placed = ctx.buffer(reserve=size), ctx.buffer(reserve=size)
            self.corner_rows: Any = ctx.buffer(rows.reshape(-1)[kept].tobytes() or bytes(CORNER.itemsize))
            self._place = draw_program(gpu, "place", outputs=("out_position",))
            self._source = ctx.vertex_array(self._place, [(self._object, "3f", "in_position")])
        everything = [i for i in range(len(self._first) - 1) if self._first[i] < self._first[i + 1]]
        self._send(everything, state)
        self._put(everything)

    def follow(self, moved: NDArray[np.int64], state: FrameState) -> None:
        """Bring the instances ``moved`` to where ``geometry`` has them."""
        some = [int(i) for i in moved if self._first[i] < self._first[i + 1]]
        self._send([i for i in some if self._geometry.scene.instances[i].deforming], state)
        self._put(some)

    def indices(self, order: Int32) -> NDArray[np.uint32]:
        """(o, 3) the vertices of the triangles ``order`` (o,), turned so that an object's own front is wound alike,
        mirrored or not."""
        corner = self._corner[order].astype(np.uint32)
        mirrored = self._geometry.mirrored[self._triangle_instance[order]]
        corner[mirrored] = corner[mirrored][:, ::-1]
        return corner

    def release(self) -> None:
        """Give its memory back."""
        self._gpu.release(self._source, self._object, self.placed, self.corner_rows)

    def _send(self, instances: list[int], state: FrameState) -> None:
        """The vertices of ``instances``, object space."""
        if not instances:
            return
        scene = self._geometry.scene
        rows = np.concatenate([np.arange(self._first[i], self._first[i + 1]) for i in instances])
        positions = np.zeros((len(rows), 3), np.float32)
        at = 0
        for i in instances:
            mesh = scene.instances[i].mesh
            vertices = state.vertices.get(mesh, scene.meshes[mesh].vertices).astype(np.float64)
            mine = vertices[self._vertex[self._first[i] : self._first[i + 1]]]
            # Float32 is finest about the middle; a mesh may lie a kilometre from its object's origin.
            self._middle[i] = _middle(mine)
            positions[at : at + len(mine)] = mine - self._middle[i]
            at += len(mine)
        with self._gpu.current():
            for run in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(rows) != 1) + 1):
                self._object.write(positions[run].tobytes(), offset=12 * int(rows[run[0]]))

    def _put(self, instances: list[int]) -> None:
        with self._gpu.current():
            self._gpu.nowhere.use()
            for i in instances:
                first, stop = (int(n) for n in self._first[i : i + 2])
                matrix = self._geometry.matrix_world[i]
                shift = matrix[:3, :3] @ self._middle[i] + matrix[:3, 3] - self._geometry.origin
                x, y, z = np.concatenate([matrix[:3, :3], shift[:, None]], axis=1)
                set_uniforms(self._place, row_x=tuple(x), row_y=tuple(y), row_z=tuple(z))
                self._source.transform(self.placed, vertices=stop - first, first=first, buffer_offset=12 * first)


def _corner_rows(texels: Texels, geometry: Geometry, corners: Corners) -> NDArray[Any]:
    """(c, 3) CORNER"""
    rows = np.zeros((len(corners.source), 3), CORNER)
    for side in range(2):
        row = corners.source + side * geometry.triangle_count
        affine = texels.hit_affine[row]  # (c, 3, 2)
        at = np.stack([affine[:, 0], affine[:, 0] + affine[:, 1], affine[:, 0] + affine[:, 2]], axis=1)
        mapped = np.isfinite(at).all(axis=(1, 2))
        rows["pixel"][:, :, 2 * side : 2 * side + 2] = np.where(mapped[:, None, None], at, 0)
        rows["first"][:, :, side] = np.where(mapped, texels.hit_page[row], NO_PAGE)[:, None]
    return rows


def _each_once(corners: Corners, rows: NDArray[Any]) -> tuple[NDArray[np.int64], Int32]:
    """((k,) corners of 3 c, each different one once, by instance; (c, 3) which of the k each corner is)."""
    # One number a corner: what it is told apart by, hashed; corners that differ in spite of it are all kept.
    words = np.ascontiguousarray(rows).view(np.uint32).reshape(3 * len(rows), CORNER.itemsize // 4).astype(np.uint64)
    instance = np.repeat(corners.instance, 3)
    vertex, key = corners.vertex.reshape(-1), instance.astype(np.uint64)
    for column in (vertex.astype(np.uint64), *words.T):
        key = (key ^ column) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    _, kept, corner = np.unique(key, return_index=True, return_inverse=True)
    corner, flat = corner.reshape(-1), rows.reshape(-1)
    same = kept[corner]
    if not ((flat[same] == flat) & (vertex[same] == vertex) & (instance[same] == instance)).all():
        kept = corner = np.arange(len(flat))
    by_instance = np.argsort(instance[kept], kind="stable")
    place = np.empty(len(kept), np.int32)
    place[by_instance] = np.arange(len(kept), dtype=np.int32)
    return kept[by_instance], place[corner].reshape(-1, 3)


def _middle(points: Float64) -> Float64:
    """(3,) of the bounding box of the finite ones of ``points`` (p, 3)."""
    points = points[np.isfinite(points).all(axis=1)]
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else np.zeros(3))


def farthest(geometry: Geometry) -> float:
    """m: no two finite corners are farther apart."""
    largest = np.abs(np.where(np.isfinite(geometry.corners), geometry.corners, np.float32(0))).max(initial=0)
    return 2 * float(np.sqrt(3.0)) * float(largest)
