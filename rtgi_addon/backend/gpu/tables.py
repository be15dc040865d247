# SPDX-License-Identifier: GPL-3.0-or-later
"""Long arrays as textures, for OpenGL 3.3, whose shaders read no buffers. ``inc/table.glsl`` reads them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..scene import Float32
from .context import Gpu, GpuFailed

#: Entries of one row; a power of two, and no driver has less. Must match inc/table.glsl.
TABLE_WIDTH = 4096
#: An entry: R, G, B and A.
ENTRY = 4


class Table:
    """``count`` entries of four float32 on the GPU."""

    def __init__(self, gpu: Gpu, count: int) -> None:
        """Raises GpuFailed where it does not fit."""
        rows = max(1, -(-count // TABLE_WIDTH))
        if rows > gpu.info.max_texture:
            raise GpuFailed(f"{gpu.info.renderer}: {count} entries do not fit a texture")
        self.count, self._gpu = count, gpu
        self._padded = np.zeros((rows * TABLE_WIDTH, ENTRY), np.float32)
        with gpu.current() as ctx:
            self.texture: Any = ctx.texture((TABLE_WIDTH, rows), ENTRY, dtype="f4")
            self.texture.filter = (ctx.NEAREST, ctx.NEAREST)

    def write(self, values: Float32) -> None:
        """All entries (count, 4)."""
        if values.shape != (self.count, ENTRY):
            raise ValueError(f"values {values.shape} are not ({self.count}, {ENTRY})")
        self._padded[: self.count] = values
        with self._gpu.current():
            self.texture.write(self._padded)

    def release(self) -> None:
        """Give its memory back."""
        self._gpu.release(self.texture)
