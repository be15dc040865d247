# SPDX-License-Identifier: GPL-3.0-or-later
"""All triangles of a frame in one set of arrays, in local space; follows moved and deformed instances.

"Local" space is world minus ``Geometry.origin``, float32. The origin is chosen once per session in float64, so a
scene a million metres out keeps its precision. Triangles have one number over the whole scene: instance i
owns ``first_triangle[i]`` up to ``first_triangle[i + 1]``, visible or not.
"""

from __future__ import annotations

import numpy as np

from ..scene import Float32, Float64, FrameState, Int32, Scene

#: Ray origins leave their surface by this share of the largest coordinate: about 8 float32 steps, twice the
#: error of a transformed vertex.
OFFSET_OF_COORDINATE = 1e-6
#: ... and by this share of the scene's size, so that a point near the local origin is lifted too.
OFFSET_OF_EXTENT = 1e-6


class Geometry:
    """Triangles (t) of all instances (n) as they stand in the frame last given to :meth:`update`.

    origin (3,) float64 world · extent: diagonal of the first frame's bounds, m · corners (t, 3, 3) float32 local ·
    normals (t, 3) unit geometric normals, zero for degenerate triangles · areas (t,) m² · corner_normals (t, 3, 3)
    unit shading normals · instance_of_triangle, material_of_triangle (t,) · first_triangle (n + 1,) · mirrored (n,)
    bool: the transform is a reflection. Normals point to the side that the object's own front faces, mirrored or not,
    as in Blender.
    """

    def __init__(self, scene: Scene, state: FrameState) -> None:
        counts = np.array([scene.meshes[i.mesh].triangle_count for i in scene.instances], np.int64)
        self.scene = scene
        self.first_triangle: Int32 = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        total = int(self.first_triangle[-1])
        self.instance_of_triangle: Int32 = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        self.material_of_triangle: Int32 = np.concatenate(
            [scene.meshes[i.mesh].material_of_triangle for i in scene.instances] or [np.zeros(0, np.int32)]
        ).astype(np.int32)
        low, high = world_bounds(scene, state)
        self.origin: Float64 = (low + high) / 2
        self.extent = float(np.linalg.norm(high - low))
        self.corners: Float32 = np.zeros((total, 3, 3), np.float32)
        self.normals: Float32 = np.zeros((total, 3), np.float32)
        self.areas: Float32 = np.zeros(total, np.float32)
        self.corner_normals: Float32 = np.zeros((total, 3, 3), np.float32)
        self.mirrored = np.zeros(len(counts), np.bool_)
        self.matrix_world = np.zeros((len(counts), 4, 4), np.float64)
        self._shapes = {m: self._shape(m, state) for m in {i.mesh for i in scene.instances}}
        for index in range(len(counts)):
            self._place(index, state)

    @property
    def triangle_count(self) -> int:
        return len(self.corners)

    def triangles_of(self, instance: int) -> slice:
        """The scene-wide triangle numbers of one instance."""
        return slice(int(self.first_triangle[instance]), int(self.first_triangle[instance + 1]))

    def update(self, state: FrameState) -> list[int]:
        """Follow ``state``; the instances whose triangles changed, in order."""
        shapes = {m: self._shape(m, state) for m in self._shapes}
        deformed = {m for m, shape in shapes.items() if not _same(shape, self._shapes[m])}
        self._shapes = shapes
        moved = np.any(state.matrix_world != self.matrix_world, axis=(1, 2))
        changed = [i for i, instance in enumerate(self.scene.instances) if moved[i] or instance.mesh in deformed]
        for index in changed:
            self._place(index, state)
        return changed

    def _shape(self, mesh: int, state: FrameState) -> tuple[Float32, Float32]:
        """Vertices and corner normals of a mesh."""
        known = self.scene.meshes[mesh]
        return state.vertices.get(mesh, known.vertices), state.corner_normals.get(mesh, known.corner_normals)

    def points(self, triangle: Int32, u: Float32, v: Float32) -> Float32:
        """(n, 3) local points at barycentric weights u, v of ``triangle``'s second and third corner."""
        corners = self.corners.take(triangle, axis=0)
        a = corners[:, 0]
        return np.asarray(a + (corners[:, 1] - a) * u[:, None] + (corners[:, 2] - a) * v[:, None], np.float32)

    def offset_length(self, positions: Float32) -> Float32:
        """(n,) m: how far a ray's origin is lifted off its surface at ``positions`` (n, 3)."""
        largest = np.abs(positions).max(axis=1, initial=0.0)
        return np.asarray(largest * OFFSET_OF_COORDINATE + self.extent * OFFSET_OF_EXTENT, np.float32)

    def _place(self, index: int, state: FrameState) -> None:
        mesh_index = self.scene.instances[index].mesh
        mesh = self.scene.meshes[mesh_index]
        vertices, shading = self._shapes[mesh_index]
        matrix = np.asarray(state.matrix_world[index], np.float64)
        linear = matrix[:3, :3]
        mirrored = np.linalg.det(linear) < 0
        local = vertices.astype(np.float64) @ linear.T + (matrix[:3, 3] - self.origin)
        corners = local[mesh.triangles]
        rows = self.triangles_of(index)
        sign = -1.0 if mirrored else 1.0
        self.corners[rows] = corners
        self.normals[rows] = sign * triangle_normals(corners)
        self.areas[rows] = triangle_areas(self.corners[rows])
        # Cofactors carry normals through any transform, also a flat one; a reflection turns them round.
        self.corner_normals[rows] = unit(shading.astype(np.float64) @ (sign * cofactors(linear)).T)
        self.mirrored[index] = mirrored
        self.matrix_world[index] = matrix


def _same(a: tuple[Float32, Float32], b: tuple[Float32, Float32]) -> bool:
    """The same arrays, or the same bits (NaN included)."""
    return all(x is y or (x.shape == y.shape and x.tobytes() == y.tobytes()) for x, y in zip(a, b, strict=True))


def world_bounds(scene: Scene, state: FrameState) -> tuple[Float64, Float64]:
    """(3,), (3,) lowest and highest corner over the bounding boxes of all instances; zeros without any vertex."""
    lows, highs = [], []
    for instance, matrix in zip(scene.instances, state.matrix_world, strict=True):
        vertices = state.vertices.get(instance.mesh, scene.meshes[instance.mesh].vertices)
        if len(vertices):
            low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
            box = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)  # (8, 3)
            world = box @ matrix[:3, :3].T + matrix[:3, 3]
            lows.append(world.min(axis=0))
            highs.append(world.max(axis=0))
    if not lows:
        return np.zeros(3), np.zeros(3)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def cofactors(linear: Float64) -> Float64:
    """(3, 3) matrix C with C n normal to ``linear``'s image of the plane n is normal to: det · inverse transpose."""
    a, b, c = linear
    return np.array([np.cross(b, c), np.cross(c, a), np.cross(a, b)])


def unit(vectors: Float64) -> Float64:
    """``vectors`` (..., 3) at length 1; zero stays zero."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def triangle_normals(corners: Float64) -> Float64:
    """(t, 3) unit normals of (t, 3, 3) corners, counter-clockwise front; zero where the triangle is degenerate.

    In float64, since the cross product of a float32 triangle of micrometres would vanish.
    """
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(a, b)
    area = np.sqrt(np.einsum("ij,ij->i", cross, cross))
    longest = np.maximum(np.einsum("ij,ij->i", a, a), np.einsum("ij,ij->i", b, b))
    # Below this ratio of height to length the float32 corners no longer define a direction.
    good = area > longest * 1e-7
    return np.divide(cross, area[:, None], out=np.zeros_like(cross), where=good[:, None])


def triangle_areas(corners: Float32) -> Float32:
    """(t,) m² of ``corners`` (t, 3, 3); summed in float64, as micrometre triangles would vanish in float32."""
    wide = corners.astype(np.float64)
    cross = np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
    return np.asarray(0.5 * np.sqrt(np.einsum("ij,ij->i", cross, cross)), np.float32)
