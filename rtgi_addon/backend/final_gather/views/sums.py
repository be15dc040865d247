# SPDX-License-Identifier: GPL-3.0-or-later
"""What views bring: each pixel's weight times what its entry sends, summed on the GPU (Larsen04 §4, equation 3).

Only the sums are read back, once a target. Two ways: exact sums, which a bake uses, and the mean by the mip-map
hardware, which is the paper's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...gpu.context import Gpu
from ...gpu.programs import compute_program, draw_program, set_uniforms
from ...gpu.tables import Table
from ...scene import Float32
from .target import Target, nearest_texture, padded
from .view import View

#: Texture units of the passes "sum" and "weigh".
UNITS = {"entries": 0, "sent": 1, "weights": 2, "directions": 3, "triangle": 4}


class ViewSums:
    """Sums over the views of one kind and size; ``entries`` can be seen."""

    def __init__(self, gpu: Gpu, view: View, entries: int, *, by_groups: bool = False) -> None:
        """``by_groups``: by compute shaders instead of drawing; the same sums but for rounding.

        Raises GpuFailed where the table of what entries send does not fit the device."""
        self._gpu, self._view, self._by_groups = gpu, view, by_groups
        self._sent = Table(gpu, entries)
        self._defines = {
            "VIEW_WIDTH": view.width,
            "VIEW_HEIGHT": view.height,
            "WEIGHTS_IN_BLOCK": view.weights.nbytes <= gpu.info.max_uniform_block,
        }
        with gpu.current() as ctx:
            self._directions = nearest_texture(ctx, padded(view.directions))
            if self._defines["WEIGHTS_IN_BLOCK"]:
                self._weights: Any = ctx.buffer(view.weights.tobytes())
            else:
                self._weights = nearest_texture(ctx, view.weights.reshape(view.height, -1, 4))
        self._group_output: Any = None
        self._outputs: dict[tuple[int, ...], Any] = {}

    def send(self, sent: Float32) -> None:
        """From now on entries send ``sent`` (e, 4), see ``Entries.sent``."""
        self._sent.write(sent)

    def sums(self, target: Target, triangle: Any | None) -> tuple[Float32, Float32]:
        """((t, 4), (t, 4)) of all tiles of ``target``, for each half of the pixels: the irradiance that they bring,
        W/m², and the weight of those that count.

        ``triangle``: a texture (across, down) of the normals of the texels' own triangles, tangent space; pixels below
        them do not count. None: all texels' normals are those of their triangles.
        """
        if self._by_groups:
            return self._group_sums(target, triangle)
        program = draw_program(self._gpu, "sum", outputs=(), TILTED=triangle is not None, **self._defines)
        with self._gpu.current() as ctx:
            array, first, second, framebuffer = self._output(ctx, program, (target.across, target.down))
            self._bind(program, target, triangle)
            framebuffer.use()
            array.render(ctx.TRIANGLES, vertices=3)
            halves = [np.frombuffer(image.read(), np.float32).reshape(-1, 4) for image in (first, second)]
        return halves[0], halves[1]

    def mip_map_sums(self, target: Target) -> Float32:
        """(t, 4) of all tiles as Larsen04 §4 has it: each pixel times its weight and a view's pixels, and the mean by
        mip-maps. Both halves together. Raises ValueError where a view's width is no power of two."""
        width, height = self._view.width, self._view.height
        if width & (width - 1):
            raise ValueError(f"a view of {width} pixels has no mip-map of one pixel")
        program = draw_program(self._gpu, "weigh", outputs=(), **self._defines)
        level = width.bit_length() - 1
        with self._gpu.current() as ctx:
            weighed = ctx.texture(target.size, 4, dtype="f4")
            framebuffer, array = ctx.framebuffer([weighed]), ctx.vertex_array(program, [])
            self._bind(program, target, None)
            framebuffer.use()
            array.render(ctx.TRIANGLES, vertices=3)
            weighed.build_mipmaps(0, level)
            # A view is as many squares high as its pixels have: the mean of each is one pixel of the level.
            means = np.frombuffer(weighed.read(level=level), np.float32)
            self._gpu.release(array, framebuffer, weighed)
        squares = means.reshape(target.down, height // width, target.across, 4)
        return np.asarray(squares.sum(axis=1).reshape(-1, 4), np.float32)

    def release(self) -> None:
        """Give memory back."""
        self._sent.release()
        self._gpu.release(
            self._directions,
            self._weights,
            self._group_output,
            *(t for output in self._outputs.values() for t in output),
        )

    def _group_sums(self, target: Target, triangle: Any | None) -> tuple[Float32, Float32]:
        program = compute_program(self._gpu, "sum_groups", TILTED=triangle is not None, SUMS=0, **self._defines)
        with self._gpu.current() as ctx:
            if self._group_output is None or self._group_output.size != 32 * target.tiles:
                self._gpu.release(self._group_output)
                self._group_output = ctx.buffer(reserve=32 * target.tiles)
            self._bind(program, target, triangle)
            set_uniforms(program, across=target.across)
            self._group_output.bind_to_storage_buffer(0)
            program.run(group_x=target.tiles)
            ctx.memory_barrier()
            halves = np.frombuffer(self._group_output.read(), np.float32).reshape(-1, 2, 4)
        return halves[:, 0], halves[:, 1]

    def _bind(self, program: Any, target: Target, triangle: Any | None) -> None:
        """What ``program`` reads."""
        set_uniforms(program, **{name: unit for name, unit in UNITS.items() if name != "weights"})
        target.texture.use(UNITS["entries"])
        if triangle is not None:
            self._directions.use(UNITS["directions"])
            triangle.use(UNITS["triangle"])
        self._sent.texture.use(UNITS["sent"])
        if self._defines["WEIGHTS_IN_BLOCK"]:
            program["Weights"].binding = 0
            self._weights.bind_to_uniform_block(0)
        else:
            set_uniforms(program, weights=UNITS["weights"])
            self._weights.use(UNITS["weights"])

    def _output(self, ctx: Any, program: Any, size: tuple[int, int]) -> Any:
        """What draws ``program``, two images of ``size`` and what draws into them."""
        key = (program.glo, *size)
        if key not in self._outputs:
            images = [ctx.texture(size, 4, dtype="f4") for _ in range(2)]
            self._outputs[key] = (ctx.vertex_array(program, []), *images, ctx.framebuffer(images))
        return self._outputs[key]
