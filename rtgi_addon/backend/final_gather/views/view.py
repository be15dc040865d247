# SPDX-License-Identifier: GPL-3.0-or-later
"""What a texel's view is: the plane or hemicube that a GPU gather draws, pixel by pixel. No OpenGL here.

Larsen04 §4 draws the scene as it is seen from a texel, on one plane in front of it (Sillion and Puech 1989) or on the
five sides of half a cube (Cohen and Greenberg 1985), and sums what the pixels show. A pixel's weight is the share of
the cosine-weighted hemisphere that it spans: Larsen04's equation 2 is its value at the pixel's middle, here it is
integrated over the pixel, so that the weights of any number of pixels sum to what the view covers.

Tangent space: x along the texel's tangent, y its bitangent, z its normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...scene import Bool, Float32, Float64
from ...settings import Gather

#: Pixels along a side of a view: fewer cannot be halved, more than that is finer than any light map.
LEAST_SIZE, MOST_SIZE = 8, 256


@dataclass(frozen=True)
class Face:
    """One picture of a view.

    A point p of tangent space lies at (x, y, w) = axes @ p: it is drawn at (x / w, y / w), within [-1, 1] across and
    [low, 1] up.
    """

    axes: Float64  # (3, 3)
    low: float  # -1; 0 for the sides of a hemicube, of which the lower half is under the surface
    rectangle: tuple[int, int, int, int]  # left, bottom, width, height: its pixels within the view's


@dataclass(frozen=True)
class View:
    """H × W pixels, those of all faces; row 0 is the bottom row."""

    kind: Gather
    faces: tuple[Face, ...]  # none for rays
    directions: Float32  # (H, W, 3) unit, tangent space: through the middle of each pixel
    weights: Float32  # (H, W) share of the cosine-weighted hemisphere
    second: Bool  # (H, W) which pixels are of the second half; each half is a view by itself

    @property
    def height(self) -> int:
        return len(self.weights)

    @property
    def width(self) -> int:
        return self.weights.shape[1]


def make_view(kind: Gather, size: int, enlargement: float = 2.0) -> View:
    """The view of ``size`` pixels along a side.

    PLANE: its half side is ``enlargement`` times its distance. HEMICUBE: the top, and above it in the picture the upper
    halves of the four sides. RAYS: size² rays, whose directions are not its pixels'.

    Raises ValueError for another kind, and for a size that is no multiple of four.
    """
    if size < 4 or size % 4:
        raise ValueError(f"{size} pixels along a view: must be a multiple of four")
    if kind is Gather.PLANE:
        faces: tuple[Face, ...] = (Face(_plane_axes(enlargement), -1.0, (0, 0, size, size)),)
        parts = [front_weights(size, enlargement)]
    elif kind is Gather.HEMICUBE:
        half = size // 2
        sides = [Face(axes, 0.0, (0, size + k * half, size, half)) for k, axes in enumerate(_side_axes())]
        faces = (Face(_plane_axes(1.0), -1.0, (0, 0, size, size)), *sides)
        parts = [front_weights(size, 1.0), *[side_weights(size)] * 4]
    elif kind is Gather.RAYS:
        return _rays_view(size)
    else:
        raise ValueError(f"{kind}: not a view")
    weights = np.concatenate(parts, axis=0)
    directions = np.concatenate([_directions(face) for face in faces], axis=0)
    return View(kind, faces, directions.astype(np.float32), weights.astype(np.float32), _second(weights))


def _rays_view(size: int) -> View:
    """Pixels that are rays by the cosine: all weigh alike. Which is which hangs on the texel, see rays.glsl."""
    weights = np.full((size, size), 1 / size**2, np.float32)
    return View(Gather.RAYS, (), np.zeros((size, size, 3), np.float32), weights, _second(weights))


def _second(weights: Float64 | Float32) -> Bool:
    """(h, w) fields of one colour of a chessboard of 2 × 2 pixels."""
    row, col = np.indices(weights.shape)
    return np.asarray((row // 2 + col // 2) % 2 == 1)


def coverage(kind: Gather, enlargement: float = 2.0) -> float:
    """Share of the cosine-weighted hemisphere that a view of any number of pixels spans.

    A plane of half side 1 covers 55.4 %, one of half side 2 83.1 % (Larsen04 §4 says about 56 and 86).
    """
    if kind is Gather.PLANE:
        return float(4 * _front_integral(np.array(enlargement), np.array(enlargement)))
    return 1.0


def equation_2(x: Float64, y: Float64, area: float) -> Float64:
    """Larsen04's equation 2: the weight of a pixel of ``area`` at (x, y) on the plane at distance 1."""
    return np.asarray(area / (np.pi * (x * x + y * y + 1) ** 2))


def front_weights(size: int, enlargement: float) -> Float64:
    """(size, size) shares of the pixels of a plane in front of the texel, of half side ``enlargement``."""
    edge = np.linspace(-enlargement, enlargement, size + 1)
    return _differences(_front_integral(edge[None, :], edge[:, None]))


def side_weights(size: int) -> Float64:
    """(size / 2, size) shares of the pixels of a hemicube's side, from the surface up."""
    across, up = np.linspace(-1, 1, size + 1), np.linspace(0, 1, size // 2 + 1)
    return _differences(_side_integral(across[None, :], up[:, None]))


def _differences(integral: Float64) -> Float64:
    """(h, w) what an integral from a corner grows by over each cell of its grid (h + 1, w + 1)."""
    return np.diff(np.diff(integral, axis=0), axis=1)


def _front_integral(x: Float64, y: Float64) -> Float64:
    """∫∫ 1 / (π (x² + y² + 1)²) from (0, 0) to (x, y)."""
    a, b = np.sqrt(1 + x * x), np.sqrt(1 + y * y)
    return np.asarray((x / a * np.arctan(y / a) + y / b * np.arctan(x / b)) / (2 * np.pi))


def _side_integral(y: Float64, z: Float64) -> Float64:
    """∫∫ z / (π (y² + z² + 1)²), up to a function of y or z alone; z is the height above the surface."""
    a = np.sqrt(1 + z * z)
    return np.asarray(-np.arctan(y / a) / a / (2 * np.pi))


def _plane_axes(enlargement: float) -> Float64:
    return np.diag([1 / enlargement, 1 / enlargement, 1.0])


def _side_axes() -> list[Float64]:
    """Of the sides towards +x, +y, -x and -y: right, up, forward; all turned the way the front is."""
    axes = []
    for quarter in range(4):
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        forward, up = np.array([cos, sin, 0.0]), np.array([0.0, 0.0, 1.0])
        axes.append(np.stack([np.cross(up, forward), up, forward]))
    return axes


def _directions(face: Face) -> Float64:
    """(h, w, 3) unit, through the middles of a face's pixels."""
    _, _, width, height = face.rectangle
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = face.low + (np.arange(height) + 0.5) / height * (1 - face.low)
    drawn = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((height, width))], axis=-1)
    points = drawn @ np.linalg.inv(face.axes).T
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))
