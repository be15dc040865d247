# SPDX-License-Identifier: GPL-3.0-or-later
"""Views by rays in a compute shader: as many rays by the cosine as a view has pixels, none of which leaves the GPU.

A tile holds what its texel's rays meet, as :mod:`.raster` fills it with what the texel's pixels show; every ray
has the same weight. Needs OpenGL 4.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...gpu.compute_tracer import DEFINES, FIRST_FREE_BINDING, ComputeTracer
from ...gpu.context import Gpu, GpuFailed
from ...gpu.pace import Pace
from ...gpu.programs import compute_program, set_uniforms
from ...scene import FrameState, Int32
from ...surface.geometry import Geometry
from ...surface.rasterise import POINTS
from ...surface.texels import Texels
from .entries import Entries
from .target import Eyes, Target
from .view import View

#: As ``Texel``, ``Side`` of rays.glsl lie in std430.
TEXEL = np.dtype(
    [("points", "f4", (POINTS, 4)), ("tangent", "f4", 4), ("normal", "f4", 4), ("own", "f4", 4), ("tile", "i4", 4)]
)
SIDE = np.dtype([("corner", "f4", (3, 2)), ("first_pixel", "i4"), ("unused", "i4")])
BINDINGS = {
    "RAYS_TEXELS": FIRST_FREE_BINDING,
    "RAYS_SIDES": FIRST_FREE_BINDING + 1,
    "RAYS_NORMALS": FIRST_FREE_BINDING + 2,
}
#: Rays of a group; as in rays.glsl.
GROUP = 64
#: Texels of a dispatch.
LEAST_TEXELS, FIRST_TEXELS, MOST_TEXELS = 4, 64, 4096
#: Longer than any way through a scene; m.
FAR = 1e30


class ViewRays:
    """Traces views of one scene as ``tracer`` and ``geometry`` stand."""

    def __init__(
        self, gpu: Gpu, view: View, geometry: Geometry, texels: Texels, tracer: ComputeTracer, entries: Entries
    ) -> None:
        """Raises GpuFailed where the scene does not fit the device."""
        self._gpu, self._view, self._geometry, self._tracer, self._entries = gpu, view, geometry, tracer, entries
        self._resolution = texels.index.shape[1]
        self._program = compute_program(gpu, "rays", RAYS_SIZE=view.width, **BINDINGS, **DEFINES)
        self._pace = Pace(LEAST_TEXELS, MOST_TEXELS, FIRST_TEXELS)
        sides = _sides(texels)
        if sides.nbytes > gpu.info.max_storage:
            raise GpuFailed(f"{gpu.info.renderer}: the maps of {geometry.triangle_count} triangles do not fit a buffer")
        with gpu.current() as ctx:
            self._texels = ctx.buffer(reserve=MOST_TEXELS * TEXEL.itemsize)
            self._sides = ctx.buffer(sides.tobytes() or bytes(SIDE.itemsize))
            self._normals = ctx.buffer(reserve=max(16 * geometry.triangle_count, 16))
        self._write_normals(0, geometry.triangle_count)

    def follow(self, moved: NDArray[np.int64], state: FrameState) -> None:
        """Bring the instances ``moved`` to where ``geometry`` has them; the tracer follows by itself."""
        for instance in moved:
            rows = self._geometry.triangles_of(int(instance))
            self._write_normals(rows.start, rows.stop)

    def draw(self, target: Target, tile: Int32, eyes: Eyes) -> None:
        """Trace the views of ``eyes`` (k,) into the tiles (k,) of ``target``; all its others stay as they are."""
        corner = target.corners(tile)
        done = 0
        while done < len(tile):
            rows = slice(done, min(done + self._pace.items, len(tile)))
            texels = _texel_rows(eyes.take(np.arange(rows.start, rows.stop)), corner[rows].astype(np.int32))
            with self._pace.timed(len(texels)), self._tracer.bound() as ctx:
                self._dispatch(ctx, target, texels)
                ctx.finish()
            done = rows.stop

    def release(self) -> None:
        """Give memory back."""
        self._gpu.release(self._texels, self._sides, self._normals)

    def _dispatch(self, ctx: Any, target: Target, texels: NDArray[Any]) -> None:
        self._texels.write(texels.tobytes())
        for buffer, name in ((self._texels, "TEXELS"), (self._sides, "SIDES"), (self._normals, "NORMALS")):
            buffer.bind_to_storage_buffer(BINDINGS[f"RAYS_{name}"])
        target.texture.bind_to_image(0, read=False, write=True)
        entries = self._entries
        set_uniforms(
            self._program, resolution=self._resolution, triangles=self._geometry.triangle_count, none=entries.none,
            far=FAR, sky_size=entries.sky_size, sky_first=entries.sky_first, escaped=entries.escaped,
        )  # fmt: skip
        self._program.run(group_x=self._view.width * self._view.height // GROUP, group_y=len(texels))
        ctx.memory_barrier()

    def _write_normals(self, first: int, stop: int) -> None:
        if first < stop:
            normals = np.zeros((stop - first, 4), np.float32)
            normals[:, :3] = self._geometry.normals[first:stop]
            with self._gpu.current():
                self._normals.write(normals.tobytes(), offset=16 * first)


def _sides(texels: Texels) -> NDArray[Any]:
    """(2 t,) SIDE: all fronts, then all backs."""
    sides = np.zeros(len(texels.hit_page), SIDE)
    mapped = np.isfinite(texels.hit_affine).all(axis=(1, 2))
    sides["corner"] = np.where(mapped[:, None, None], texels.hit_affine, np.float32(0))
    sides["first_pixel"] = np.where(mapped, texels.hit_page, -1)
    return sides


def _texel_rows(eyes: Eyes, corner: Int32) -> NDArray[Any]:
    """(k,) TEXEL"""
    rows = np.zeros(len(corner), TEXEL)
    order = np.argsort(~eyes.opened, axis=1, kind="stable")
    rows["points"][:, :, :3] = np.take_along_axis(eyes.points, order[:, :, None], axis=1)
    for name, vectors, more in (
        ("tangent", eyes.tangent, np.maximum(eyes.opened.sum(axis=1), 1)),
        ("normal", eyes.normal, eyes.shift[:, 0]),
        ("own", eyes.own, eyes.shift[:, 1]),
    ):
        rows[name][:, :3], rows[name][:, 3] = vectors, more
    rows["tile"][:, :2] = corner
    return rows
