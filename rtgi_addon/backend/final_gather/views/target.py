# SPDX-License-Identifier: GPL-3.0-or-later
"""Where views are taken from, and the images that hold them, a tile a texel."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...gpu.context import Gpu
from ...scene import Bool, Float32, Int32
from .view import View


@dataclass(frozen=True)
class Eyes:
    """Where m views are taken from; local space."""

    eye: Float32  # (m, 3)
    tangent: Float32  # (m, 3) unit
    normal: Float32  # (m, 3) unit
    own: Float32  # (m, 3) unit, of the texel's own triangle
    instance: Int32  # (m,) on which the texel lies
    points: Float32  # (m, POINTS, 3) of the texel
    opened: Bool  # (m, POINTS) which of them lie in the open
    shift: Float32  # (m, 2) in [0, 1): what tells its rays from those of its neighbours
    parted: Bool  # (m,) seen from PARTS of its points, each in every so many pixels: one does not stand for all

    def take(self, rows: NDArray[np.integer[Any]]) -> Eyes:
        return Eyes(*(getattr(self, field.name)[rows] for field in fields(self)))

    def from_point(self, number: int) -> Eyes:
        """The same from point ``number`` of those in the open, in their order, which is spread."""
        opened_first = np.argsort(~self.opened, axis=1, kind="stable")
        turn = number % np.maximum(self.opened.sum(axis=1), 1)
        rows = np.arange(len(turn))
        return replace(self, eye=self.points[rows, opened_first[rows, turn]])


class Target:
    """An image of ``across`` × ``down`` tiles, each a view's pixels, each pixel an entry."""

    def __init__(self, gpu: Gpu, view: View, across: int, down: int) -> None:
        self._gpu, self.view, self.across, self.down = gpu, view, across, down
        self.size = (across * view.width, down * view.height)
        with gpu.current() as ctx:
            self.texture: Any = ctx.texture(self.size, 1, dtype="u4")
            self.texture.filter = (ctx.NEAREST, ctx.NEAREST)
            self.depth: Any = None
            self.framebuffer: Any = None

    @property
    def tiles(self) -> int:
        return self.across * self.down

    @property
    def bytes(self) -> int:
        """Of its entries, on the GPU."""
        return 4 * self.size[0] * self.size[1]

    def corners(self, tile: NDArray[np.integer[Any]]) -> Float32:
        """(k, 2) left and bottom of the tiles (k,), pixels."""
        row, column = np.divmod(tile, self.across)
        return np.asarray(np.stack([column * self.view.width, row * self.view.height], axis=1), np.float32)

    def release(self) -> None:
        """Give its memory back."""
        self._gpu.release(self.framebuffer, self.texture)


def nearest_texture(ctx: Any, values: Float32) -> Any:
    """A texture of ``values`` (h, w, 4), to be fetched pixel by pixel."""
    texture = ctx.texture(values.shape[1::-1], 4, np.ascontiguousarray(values, np.float32).tobytes(), dtype="f4")
    texture.filter = (ctx.NEAREST, ctx.NEAREST)
    return texture


def padded(vectors: Float32) -> Float32:
    """(..., 4) ``vectors`` (..., 3) and 0."""
    return np.concatenate([vectors, np.zeros((*vectors.shape[:-1], 1), np.float32)], axis=-1)
