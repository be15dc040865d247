# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams: where one smooth surface is cut into UV islands, both sides of the cut are made to show the same light.

Least squares over the texels near a cut, after Iwanicki, "Lighting technology of The Last of Us" (SIGGRAPH 2013):
samples along each cut ask for equal bilinear lookups on both sides, as little change as possible, and changes that
fade into the island instead of ending in a line. The system follows from meshes and atlas; a frame is one solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from ..final_gather.solvers import conjugate_gradients
from ..scene import Atlas, Bool, Float32, Float64, Int32, Mesh, Placement, Scene
from ..surface.geometry import triangle_normals
from .dilate import DilationMap

#: Shading normals further apart than this mark an edge the artist wants to see.
SMOOTH_DEGREES = 5.0
#: Faces further apart than this are not one surface, however they are shaded: light differs round such an edge, as on
#: the rim of a smooth-shaded lampshade.
BEND_DEGREES = 30.0
#: UVs closer than this are the same point: a thousandth of a pixel on a page of 16k.
SAME_UV = 1e-7
SAMPLES_PER_PX = 2.0
#: Weights of the least squares: a sample's jump, a change, the difference of two neighbours' changes. A change fades
#: over (FADE / KEEP) ** 0.5 = 2 pixels.
MATCH, KEEP, FADE = 4.0, 0.05, 0.2
#: Islands of fewer texels are left alone: what differs across their cuts is the width of a texel, and closing that
#: would move all their light (a ball of six islands of 20 texels: by 10 %).
LEAST_TEXELS = 64
#: Texels this far from a cut may change; further in less than 10 % of a change would be left.
BAND_PX = 5
#: Relative residual of the solve: 1e-2 and 1e-3 leave the same jumps, a thirtieth of what they were.
TOLERANCE = 5e-3


@dataclass(frozen=True)
class Seams:
    """s cut edges of one mesh: the UVs of both ends, (s, 2, 2), on the one and on the other side, ends in one order."""

    uv_a: Float32
    uv_b: Float32


def find_seams(
    triangles: Int32,
    corner_uv: Float32,
    corner_normals: Float32,
    *,
    face_normals: Float32 | None = None,
    smooth_degrees: float = SMOOTH_DEGREES,
) -> Seams:
    """Edges between two triangles (t, 3) with other UVs (t, 3, 2) but the same shading normals (t, 3, 3) at both ends.

    With ``face_normals`` (t, 3) edges that bend by more than BEND_DEGREES are left out too; zero normals bend nothing.
    Edges of more than two triangles are left out: which of them belong together is not known.
    """
    corners = np.array([[0, 1], [1, 2], [2, 0]])
    ends = triangles[:, corners].reshape(-1, 2)  # (3t, 2) vertices
    turned = np.where((ends[:, 0] > ends[:, 1])[:, None], [1, 0], [0, 1])
    ends = np.take_along_axis(ends, turned, axis=1)
    uv = np.take_along_axis(corner_uv[:, corners].reshape(-1, 2, 2), turned[:, :, None], axis=1)
    normals = np.take_along_axis(corner_normals[:, corners].reshape(-1, 2, 3), turned[:, :, None], axis=1)
    key = ends[:, 0].astype(np.int64) * (int(triangles.max(initial=0)) + 1) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    a, b = order[first[count == 2]], order[first[count == 2] + 1]
    smooth = np.einsum("sij,sij->si", normals[a], normals[b]).min(axis=1, initial=1) >= np.cos(
        np.radians(smooth_degrees)
    )
    cut = np.abs(uv[a] - uv[b]).max(axis=(1, 2), initial=0) > SAME_UV
    mapped = (_lengths(uv[a]) > SAME_UV) & (_lengths(uv[b]) > SAME_UV)
    found = smooth & cut & mapped & (ends[a, 0] != ends[a, 1])
    if face_normals is not None:
        face_a, face_b = face_normals[a // 3], face_normals[b // 3]
        straight = np.einsum("si,si->s", face_a, face_b) >= np.cos(np.radians(BEND_DEGREES))
        found &= straight | ~face_a.any(axis=1) | ~face_b.any(axis=1)
    return Seams(uv[a[found]], uv[b[found]])


class SeamMatcher:
    """Matches per-texel values across the seams of each object; built once for an atlas. Objects never mix.

    ``texel_count``: texels that may change, 0 where no surface is cut · ``sample_count`` along all seams.
    """

    def __init__(self, scene: Scene, atlas: Atlas, dilation: DilationMap, surface: Int32) -> None:
        """``dilation`` of the atlas: what lookups at a border see; ``surface`` (n,) of each texel."""
        texels, weights = _samples(scene, atlas, dilation, surface)
        self.sample_count = len(texels)
        touched = np.zeros(len(surface), np.bool_)
        touched[texels[weights != 0]] = True
        left, right = _neighbours(dilation, surface)
        self._active = np.flatnonzero(_grown(touched, left, right))
        self.texel_count = len(self._active)
        if not self.texel_count:
            return
        number = np.full(len(surface), -1, np.int64)
        number[self._active] = np.arange(self.texel_count)
        self._jump = _rows(np.maximum(number[texels], 0), weights, self.texel_count)
        inside = (number[left] >= 0) & (number[right] >= 0)
        pairs = np.stack([number[left[inside]], number[right[inside]]], axis=1)
        fade = _rows(pairs, np.broadcast_to([1.0, -1.0], pairs.shape), self.texel_count)
        system = MATCH * (self._jump.T @ self._jump) + FADE * (fade.T @ fade)
        self._system = (system + KEEP * scipy.sparse.identity(self.texel_count)).tocsr().astype(np.float32)
        self._jump = self._jump.astype(np.float32)
        self._back = (MATCH * self._jump.T).tocsr().astype(np.float32)
        #: Texels of different groups do not hang together: each is solved by itself, and only when it changed.
        self._group = scipy.sparse.csgraph.connected_components(self._system, directed=False)[1].astype(np.int32)
        self._kept: tuple[Float32, Float32] | None = None  # last values of the texels, and their changes

    def jumps(self, values: Float32) -> Float32:
        """(samples, c) difference that is seen across the seams; ``values`` (n, c)."""
        if not self.texel_count:
            return np.zeros((0, values.shape[1]), np.float32)
        return np.asarray(self._jump @ values[self._active], np.float32)

    def match(self, values: Float32) -> Float32:
        """``values`` (n, c) >= 0 with seams closed; constants stay, and so does the sum (but for clipping at 0)."""
        if not self.texel_count:
            return values
        here = values[self._active]
        change = self._changes(here)
        self._kept = here, change
        matched = values.copy()
        matched[self._active] = np.maximum(here + change, 0)
        return matched

    def _changes(self, here: Float32) -> Float32:
        """(a, c) what is to be added to ``here`` (a, c), the values of the texels that may change.

        Groups that are as they were last time keep their changes: the solver would find the same bits.
        """
        group, kept = self._group, np.zeros_like(here)
        if self._kept is not None and self._kept[0].shape == here.shape:
            before, kept = self._kept
            differs = (here.view(np.uint32) != before.view(np.uint32)).any(axis=1)
            group = np.where(np.bincount(group, weights=differs)[group] > 0, group, np.int32(-1))
            if (group < 0).all():
                return kept
        wanted = np.asarray(-(self._back @ (self._jump @ here)), np.float32)
        solution = conjugate_gradients(
            lambda x: np.asarray(self._system @ x, np.float32), wanted, group=group, tolerance=TOLERANCE
        )
        return np.where((group < 0)[:, None], kept, solution.x)


def _samples(scene: Scene, atlas: Atlas, dilation: DilationMap, surface: Int32) -> tuple[Int32, Float64]:
    """Texels (m, 8) and weights (m, 8) of all samples: bilinear lookup on one side minus that on the other."""
    seams_of_mesh = {i: _seams_of(scene.meshes[i]) for i in sorted({x.mesh for x in scene.instances})}
    texels, weights = [np.zeros((0, 8), np.int32)], [np.zeros((0, 8))]
    large = np.bincount(surface)[surface] >= LEAST_TEXELS  # (n,)
    for number, instance in enumerate(scene.instances):
        seams = seams_of_mesh[instance.mesh]
        for placement in (atlas.front[number], atlas.back[number]):
            if placement is None or not instance.receives_light or not len(seams.uv_a):
                continue
            points_a, points_b = _along(seams, placement, atlas.resolution)
            texel_a, weight_a, good_a = _lookup(points_a, placement.page, dilation, surface)
            texel_b, weight_b, good_b = _lookup(points_b, placement.page, dilation, surface)
            good = good_a & good_b & large[texel_a[:, 0]] & large[texel_b[:, 0]]
            texels.append(np.concatenate([texel_a, texel_b], axis=1)[good])
            weights.append(np.concatenate([weight_a, -weight_b], axis=1)[good])
    return np.concatenate(texels), np.concatenate(weights)


def _seams_of(mesh: Mesh) -> Seams:
    faces = triangle_normals(mesh.vertices[mesh.triangles].astype(np.float64)).astype(np.float32)
    return find_seams(mesh.triangles, mesh.corner_uv, mesh.corner_normals, face_normals=faces)


def _along(seams: Seams, placement: Placement, resolution: int) -> tuple[Float64, Float64]:
    """(m, 2), (m, 2) the same points of the cut edges on both sides, in page pixels (col, row)."""
    ends_a, ends_b = (
        (uv.astype(np.float64) * placement.scale + placement.offset) * resolution for uv in (seams.uv_a, seams.uv_b)
    )
    longest = np.maximum(_lengths(ends_a), _lengths(ends_b))
    count = np.maximum(np.ceil(longest * SAMPLES_PER_PX), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    t = ((place + 0.5) / count[edge])[:, None]
    a, b = ((1 - t) * ends[edge, 0] + t * ends[edge, 1] for ends in (ends_a, ends_b))
    return a, b


def _lookup(points: Float64, page: int, dilation: DilationMap, surface: Int32) -> tuple[Int32, Float64, Bool]:
    """Texels (m, 4) and weights (m, 4) of bilinear lookups at pixel coordinates ``points`` (m, 2).

    (m,) False where a lookup sees no texel or two islands: there the page itself is at fault, not the seam.
    """
    shown = dilation.texel[page]
    low = np.floor(points - 0.5)
    share = points - 0.5 - low
    corner = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    pixel = np.clip(low[:, None].astype(np.int64) + corner, 0, np.array(shown.shape[::-1]) - 1)
    weight = np.where(corner == 1, share[:, None], 1 - share[:, None]).prod(axis=2)
    texel = shown[pixel[:, :, 1], pixel[:, :, 0]]
    main = np.take_along_axis(texel, weight.argmax(axis=1)[:, None], axis=1)
    alike = (texel >= 0) & (surface[texel] == surface[main])
    return np.maximum(texel, 0), weight, (alike | (weight < 1e-6)).all(axis=1)


def _neighbours(dilation: DilationMap, surface: Int32) -> tuple[Int32, Int32]:
    """(p,), (p,) texels side by side on one surface."""
    index = np.where(dilation.filled, np.int32(-1), dilation.texel)
    a = np.concatenate([index[:, :, :-1].ravel(), index[:, :-1].ravel()])
    b = np.concatenate([index[:, :, 1:].ravel(), index[:, 1:].ravel()])
    both = (a >= 0) & (b >= 0)
    a, b = a[both], b[both]
    same = surface[a] == surface[b]
    return a[same], b[same]


def _grown(touched: Bool, left: Int32, right: Int32) -> Bool:
    """``touched`` (n,) widened by BAND_PX steps from neighbour to neighbour."""
    for _ in range(BAND_PX if touched.any() else 0):
        reached = touched.copy()
        reached[left[touched[right]]] = True
        reached[right[touched[left]]] = True
        touched = reached
    return touched


def _rows(columns: Int32, weights: Float64, width: int) -> scipy.sparse.csr_matrix:
    """A sparse matrix with the same number of entries in each row."""
    starts = np.arange(len(columns) + 1) * columns.shape[1]
    rows = scipy.sparse.csr_matrix((weights.ravel().copy(), columns.ravel(), starts), (len(columns), width))
    rows.sum_duplicates()
    return rows


def _lengths(ends: Float32 | Float64) -> Float64:
    """(s,) of segments (s, 2, 2)."""
    return np.asarray(np.hypot(*(ends[:, 1] - ends[:, 0]).astype(np.float64).T), np.float64)
