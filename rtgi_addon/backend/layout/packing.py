# SPDX-License-Identifier: GPL-3.0-or-later
"""The atlas: one rectangle for each wanted side of each instance, on whole pixels, at one texel density in the world.

A rectangle shows its mesh's whole light-map layout, so the instances of a mesh share one set of UVs, and those of
one size share one texel grid. After the layouts are known, before texels are made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene import Atlas, Bool, Float64, Int32, Placement, Scene
from .islands import Stretch, stretch
from .skyline import orders, place

#: A density has been found when less than this share can be gained.
DENSITY_TOLERANCE = 0.003
#: Up to so many rectangles are packed in several orders and more often, and stretched along one axis to fill the page.
FEW_RECTANGLES = 64
#: Packings tried for one page, with few rectangles and with many.
TRIALS = (16, 4)
#: To fill a page, texels may become this much longer than wide.
LONGEST_TEXEL = 1.2


@dataclass(frozen=True)
class Packing:
    """The atlas, the texels per metre it came to (geometric mean of the two axes), and warnings for the user."""

    atlas: Atlas
    texels_per_metre: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Page:
    """A square page; rectangles keep ``padding`` pixels between them, none at the page's own border."""

    resolution: int
    padding: int

    @property
    def limit(self) -> int:
        """Side of the area for padded rectangles: the last one's padding may hang over."""
        return self.resolution + self.padding


def pack(
    scene: Scene, *, resolution: int, density: float | None, front: Bool, back: Bool, padding_px: int = 2
) -> Packing:
    """Place the sides that ``front``, ``back`` (n,) want. ``density`` in texels per metre; None fills one page.

    Sides of instances without triangles, or that do not receive light, get no rectangle.
    """
    page = _Page(resolution, padding_px)
    wanted = [
        (i, side)
        for i, instance in enumerate(scene.instances)
        for side, wants in enumerate((front, back))
        if wants[i] and instance.receives_light and scene.meshes[instance.mesh].triangle_count
    ]
    metres = instance_sizes(scene)[[i for i, _ in wanted]]  # (r, 2)
    texels = np.full(2, float(density)) if density is not None else _densest(metres, page)
    sizes = _pixels(metres * texels, page)
    spots = _spread_over_pages(sizes, page)
    warnings = _size_warnings(metres * texels, [scene.instances[i].name for i, _ in wanted], page)
    if density is None and spots[:, 0].max(initial=0) > 0:
        warnings.append(
            f"atlas: {len(wanted)} surfaces do not fit one page of {resolution} x {resolution} pixels even at a texel "
            "each; more pages were made. Use a larger resolution"
        )
    atlas = _atlas(len(scene.instances), wanted, sizes, spots, page)
    return Packing(atlas, float(np.sqrt(texels[0] * texels[1])), tuple(warnings))


def instance_sizes(scene: Scene) -> Float64:
    """(n, 2) world metres that the light-map unit of each instance spans along u and v, in the first frame.

    Means over the layout by axis, under the instance's whole transform: a plane scaled along x alone gets a longer
    rectangle. 0 where nothing finite can be said.
    """
    layouts: dict[int, Stretch] = {}
    sizes = np.zeros((len(scene.instances), 2))
    for index, instance in enumerate(scene.instances):
        if instance.mesh not in layouts:
            mesh = scene.meshes[instance.mesh]
            corners = mesh.vertices[mesh.triangles]
            finite = np.isfinite(corners).all(axis=(1, 2))
            layouts[instance.mesh] = stretch(corners[finite], mesh.corner_uv[finite])
        linear = np.asarray(instance.matrix_world, np.float64)[:3, :3]
        if np.isfinite(linear).all():
            sizes[index] = layouts[instance.mesh].size(linear)[0]
    return sizes


def _pixels(sizes_px: Float64, page: _Page) -> Int32:
    """(r, 2) whole pixels for rectangles of real-valued ``sizes_px``: at least one; the page at most, in proportion."""
    largest = np.maximum(sizes_px.max(axis=1, initial=0.0), 1e-300)
    shrunk = sizes_px * np.minimum(1.0, page.resolution / largest)[:, None]
    pixels: Int32 = np.clip(np.rint(shrunk), 1, page.resolution).astype(np.int32)
    return pixels


def _size_warnings(sizes_px: Float64, names: list[str], page: _Page) -> list[str]:
    over = np.nonzero(sizes_px.max(axis=1, initial=0.0) >= page.resolution + 0.5)[0]
    return [
        f"{names[i]}: takes {sizes_px[i].max():.0f} texels at this density where a page has {page.resolution}; it gets "
        "larger texels. Use a larger resolution or split the object"
        for i in over
    ]


def _densest(metres: Float64, page: _Page) -> Float64:
    """(2,) texels per metre by axis: the largest found at which all rectangles fit one page."""
    longest = metres.max(initial=0.0)
    if longest <= 0:
        return np.ones(2)
    few = len(metres) <= FEW_RECTANGLES
    # At most the density at which areas alone fill the page, or the longest rectangle does.
    area = float((metres[:, 0] * metres[:, 1]).sum())
    high = min(page.limit / max(area, 1e-300) ** 0.5, page.resolution / longest)
    low, scale = 0.0, 0.95 * high if len(metres) > 1 else high
    for _ in range(TRIALS[0] if few else TRIALS[1]):
        height = _height(metres * scale, page)
        low, high = (scale, high) if height <= page.limit else (low, scale)
        if low > 0 and high < low * (1 + DENSITY_TOLERANCE):
            break
        # Height grows with the square of the scale, more or less; what it points to must bring news.
        guess = scale * float(np.sqrt(page.limit / height)) * 0.998
        middle = (low + high) / 2 if low > 0 else 0.8 * high
        scale = guess if low * (1 + DENSITY_TOLERANCE) < guess < high / (1 + DENSITY_TOLERANCE) else middle
    while low == 0 and (metres * high).max() > 0.5:
        high *= 0.8
        low = high if _height(metres * high, page) <= page.limit else 0.0
    texels = np.full(2, low if low > 0 else high)
    return _stretched(metres, texels, page) if few else texels


def _stretched(metres: Float64, texels: Float64, page: _Page) -> Float64:
    """``texels`` with v and then u raised as far as everything still fits and no texel gets too long."""
    for axis in (1, 0):
        low, high = 1.0, LONGEST_TEXEL * texels[1 - axis] / texels[axis]
        for _ in range(7):
            middle = (low + high) / 2
            factor = np.where(np.arange(2) == axis, middle, 1.0)
            fits = (metres * texels * factor).max() <= page.resolution
            fits = fits and _height(metres * texels * factor, page) <= page.limit
            low, high = (middle, high) if fits else (low, middle)
        texels = np.where(np.arange(2) == axis, texels * low, texels)
    return texels


def _height(sizes_px: Float64, page: _Page) -> int:
    """What a page as wide as ours, with no upper end, is filled up to."""
    padded = _pixels(sizes_px, page) + page.padding
    return min(_place(padded, order, page, height=np.iinfo(np.int32).max)[1] for order in _orders(padded))


def _place(padded: Int32, order: Int32, page: _Page, *, height: int) -> tuple[Int32, int]:
    return place(padded, order, width=page.limit, height=height)


def _orders(padded: Int32) -> list[Int32]:
    return orders(padded, several=len(padded) <= FEW_RECTANGLES)


def _spread_over_pages(sizes: Int32, page: _Page) -> Int32:
    """(r, 3) page, x, y in pixels; pages are filled one after another."""
    spots = np.full((len(sizes), 3), -1, np.int32)
    left = np.arange(len(sizes))
    number = 0
    while len(left):
        padded = sizes[left] + page.padding
        tries = [_place(padded, order, page, height=page.limit)[0] for order in _orders(padded)]
        # The order that places most pixels on this page, the first such one.
        filled = [(padded[corners[:, 0] >= 0].astype(np.int64).prod(axis=1)).sum() for corners in tries]
        corners = tries[int(np.argmax(filled))]
        placed = corners[:, 0] >= 0
        spots[left[placed], 0] = number
        spots[left[placed], 1:] = corners[placed]
        left = left[~placed]
        number += 1
    return spots


def _atlas(count: int, wanted: list[tuple[int, int]], sizes: Int32, spots: Int32, page: _Page) -> Atlas:
    sides: tuple[list[Placement | None], list[Placement | None]] = ([None] * count, [None] * count)
    side_px = page.resolution
    for (instance, side), (w, h), (number, x, y) in zip(wanted, sizes.tolist(), spots.tolist(), strict=True):
        sides[side][instance] = Placement(number, (w / side_px, h / side_px), (x / side_px, y / side_px))
    pages = int(spots[:, 0].max(initial=0)) + 1
    return Atlas(side_px, pages, tuple(sides[0]), tuple(sides[1]))
