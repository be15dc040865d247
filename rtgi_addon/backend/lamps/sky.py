# SPDX-License-Identifier: GPL-3.0-or-later
"""The sky as a row of patches that gather rays link to, exactly as they link to texels.

A patch is one pixel of the world's equirectangular map (``scene.World``), shrunk where the map is finer than a
light map can use. Its "radiosity" is π times its radiance, so links treat sky and surface alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..scene import Float32, Float64, Int32, World

#: Finer maps are averaged down to at most this many rows: 0.7° a patch, finer than a soft shadow in a light map.
MOST_ROWS = 256


@dataclass(frozen=True)
class Sky:
    """Patches of the sky, k = rows * columns of them, row-major from straight down to straight up."""

    rows: int
    columns: int
    radiance: Float32  # (k, 3) W/(m² sr)
    solid_angle: Float32  # (k,) sr

    @property
    def count(self) -> int:
        return self.rows * self.columns

    def of_directions(self, directions: Float32) -> Int32:
        """(n,) patch that unit ``directions`` (n, 3) point at."""
        if self.count == 1:
            return np.zeros(len(directions), np.int32)
        u = 0.5 - np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)
        v = 0.5 + np.arcsin(np.clip(directions[:, 2], -1, 1)) / np.pi
        column = np.clip((u * self.columns).astype(np.int32), 0, self.columns - 1)
        row = np.clip((v * self.rows).astype(np.int32), 0, self.rows - 1)
        return np.asarray(row * self.columns + column, np.int32)

    def directions(self, patch: Int32, across: Float32, up: Float32) -> Float32:
        """(n, 3) unit directions uniform over each patch's solid angle, by ``across``, ``up`` (n,) in [0, 1)."""
        u = (patch % self.columns + across) / self.columns
        row = patch // self.columns
        low, high = np.sin(np.pi * (row / self.rows - 0.5)), np.sin(np.pi * ((row + 1) / self.rows - 0.5))
        z = low + (high - low) * up
        ring = np.sqrt(np.maximum(1 - z * z, 0))
        angle = (0.5 - u) * 2 * np.pi
        return np.asarray(np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1), np.float32)


def make_sky(world: World | None, layout: tuple[int, int] | None = None) -> Sky | None:
    """The patches of ``world``; None for no world or a black one.

    ``layout`` (rows, columns) is that of other frames. Any world takes it, and none at all is black patches of it: what
    is linked to the sky stays so, and gather rays are aimed at the same patches in all frames.
    """
    dark = world is None or world.is_black
    if dark and layout is None:
        return None
    radiance = np.zeros((1, 1, 3), np.float32)
    if world is not None and not dark:
        radiance = _shrunk(np.asarray(world.radiance, np.float32))
    if layout is not None and radiance.shape[:2] != layout:
        radiance = _fitted(radiance, *layout)
    rows, columns = radiance.shape[:2]
    solid = np.repeat(np.diff(_heights(rows)) * (2 * np.pi / columns), columns)
    return Sky(rows, columns, radiance.reshape(-1, 3), solid.astype(np.float32))


def sky_layout(worlds: Iterable[World | None]) -> tuple[int, int] | None:
    """(rows, columns) of the finest of the ``worlds``; None where none of them shines."""
    skies = [sky for world in worlds if (sky := make_sky(world)) is not None]
    return max(((sky.rows, sky.columns) for sky in skies), default=None)


def _shrunk(image: Float32) -> Float32:
    """``image`` averaged over whole blocks until it has at most MOST_ROWS rows."""
    factor = -(-image.shape[0] // MOST_ROWS)
    while image.shape[0] % factor or image.shape[1] % factor:
        factor += 1  # ends at the latest with one row
        if factor > image.shape[0]:
            return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return np.asarray(image.reshape(height, factor, width, factor, 3).mean(axis=(1, 3)), np.float32)


def _heights(rows: int) -> Float64:
    """(rows + 1,) sines of the elevations between rows; equal steps of it are equal solid angles."""
    return np.asarray(np.sin(np.pi * (np.arange(rows + 1) / rows - 0.5)))


def _fitted(image: Float32, rows: int, columns: int) -> Float32:
    """``image`` as (rows, columns, 3), averaged by solid angle: what all of the sky sends is kept."""
    if image.shape[:2] == (1, 1):
        return np.broadcast_to(image, (rows, columns, 3))
    by_row = _averaged(image.astype(np.float64), _heights(image.shape[0]), _heights(rows))
    across = np.linspace(0, 1, image.shape[1] + 1), np.linspace(0, 1, columns + 1)
    return np.asarray(_averaged(by_row.swapaxes(0, 1), *across).swapaxes(0, 1), np.float32)


def _averaged(values: Float64, edges: Float64, wanted: Float64) -> Float64:
    """(w, ...) means between the ``wanted`` (w + 1,) of what is ``values`` (v, ...) between the ``edges`` (v + 1,)."""
    shape = (-1, *[1] * (values.ndim - 1))
    total = np.zeros((len(edges), *values.shape[1:]))
    np.cumsum(values * np.diff(edges).reshape(shape), axis=0, out=total[1:])
    at = np.clip(np.searchsorted(edges, wanted, side="right") - 1, 0, len(values) - 1)
    reached = total[at] + values[at] * (wanted - edges[at]).reshape(shape)
    return np.asarray(np.maximum(np.diff(reached, axis=0) / np.diff(wanted).reshape(shape), 0))
