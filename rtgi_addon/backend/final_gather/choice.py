# SPDX-License-Identifier: GPL-3.0-or-later
"""Which final gather a bake uses when it is left to choose: the one that meets the error asked soonest, measured.

A few tiles of the scene's own texels are lit by links as the bake would, by views of growing size, and by so many rays
that they count as right. Measured is the error of a tile's mean: what a denoiser cannot take away. It is done once for
a machine and a class of scenes, and noted in a file, so that the next bake of the kind chooses alike and at once.
"""

from __future__ import annotations

import json
import math
import os
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..parallel import CHUNK_RAYS, Workers
from ..placed import PlacedScene
from ..scene import Float32, Int32
from ..settings import Gather, SampleCounts
from .gather import NO_TARGET, GatherRays
from .patterns import TILE
from .products import row_products
from .views.view import LEAST_SIZE, MOST_SIZE
from .views.view_gather import ViewGather, view_size

#: Tiles that are lit for a measurement; 384 texels tell times to a tenth and errors to a fifth.
TILES = 24
#: Rays that count as right: their own noise in a tile's mean is 0.2 % on the Cornell box.
RIGHT = SampleCounts(1024, 1024)
#: Products that a frame takes: radiosity's fixed point, and the irradiance itself.
PRODUCTS = 9
#: A view may err by so much more than links do and still be taken for as good: errors are only known to a fifth.
TOLERANCE = 1.2
#: Another gather than links must be so much faster: the GPU has work besides, and times are noisy.
ADVANTAGE = 1.25
#: Of the file of choices; one of another version is made anew.
VERSION = 1


@dataclass(frozen=True)
class Makers:
    """What makes the gathers that are tried."""

    rays: Callable[[SampleCounts, int], GatherRays]  # another seed for each number
    views: Callable[[Gather, int], AbstractContextManager[ViewGather]]  # of so many pixels along a view
    workers: Workers


@dataclass(frozen=True)
class Choice:
    """``scale``: pixels along a view over those that stand for the rays asked (``view_size``)."""

    gather: Gather
    reason: str
    scale: float = 1.0
    renderer: str = ""  # the GPU it was measured on; "" if there was none


@dataclass(frozen=True)
class Trial:
    """What one gather takes for a frame, and how far it is off."""

    gather: Gather
    size: int  # rays of links, pixels along a view
    microseconds: float  # a texel
    error: float  # relative RMS of the means of tiles

    def __str__(self) -> str:
        size = f"{self.size} rays" if self.gather is Gather.LINKS else f"{self.size} px"
        return f"{self.gather} {size} {self.microseconds:.0f} µs, {self.error:.1%}"


class ChoiceFile:
    """Choices noted in a file, by class of scene. A file that cannot be read is as one that is not there."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def get(self, key: str) -> Choice | None:
        """The choice noted for ``key``."""
        try:
            known = self._read()[key]
            return Choice(Gather(known["gather"]), known["reason"], float(known["scale"]), known["renderer"])
        except (KeyError, TypeError, ValueError):
            return None

    def note(self, key: str, choice: Choice) -> None:
        """Note ``choice``. Where the folder cannot be written nothing is, and it is measured again next time."""
        choices = {**self._read(), key: asdict(choice)}
        with suppress(OSError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=self.path.parent, delete=False, encoding="utf-8") as aside:
                json.dump({"version": VERSION, "choices": choices}, aside, indent=1)
            os.replace(aside.name, self.path)

    def _read(self) -> dict[str, Any]:
        try:
            known = json.loads(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        right = isinstance(known, dict) and known.get("version") == VERSION and isinstance(known.get("choices"), dict)
        return dict(known["choices"]) if right else {}


def scene_class(placed: PlacedScene, samples: SampleCounts) -> str:
    """What a choice hangs on, in words: the machine, and the scene's sizes to a factor of four. Not the threads: maps
    hang on the choice, and must not hang on those."""
    triangles, texels = (
        4 ** round(math.log(max(n, 1), 4)) for n in (placed.geometry.triangle_count, placed.texels.count)
    )
    sky = "open" if placed.sky is not None else "no sky"
    return f"{platform.node()}: {triangles} triangles, {texels} texels, {samples.total} rays, {sky}"


def choose(
    placed: PlacedScene, sent: Float32, samples: SampleCounts, makers: Makers, kinds: Sequence[Gather], renderer: str
) -> Choice:
    """Measure links and the views of ``kinds`` and choose; sent (m, 3): radiosity of all targets, W/m².

    Raises GpuFailed where the GPU does.
    """
    texel, tile = _tiles(placed)
    if not len(texel) or not sent.any():
        return Choice(Gather.LINKS, "nothing to measure: no light, or no texels", renderer=renderer)
    right = _means(_lit_by_links(makers.rays(RIGHT, 1), texel, sent, makers.workers)[0], tile)

    def trial(kind: Gather, size: int, lit: tuple[Float32, float]) -> Trial:
        return Trial(kind, size, 1e6 * lit[1] / len(texel), _error(_means(lit[0], tile), right))

    by_links = _lit_by_links(makers.rays(samples, 0), texel, sent, makers.workers)
    links = best = trial(Gather.LINKS, samples.total, by_links)
    tried = [links]
    for kind in kinds:
        size, done = max(LEAST_SIZE, view_size(samples) // 2), False
        # Each twice as wide as the last, until one is good enough or takes longer than links.
        while size <= MOST_SIZE and not done:
            with makers.views(kind, size) as views:
                tried.append(trial(kind, size, views.lit_once(texel, sent, PRODUCTS)))
            good = tried[-1].error <= links.error * TOLERANCE
            if good and tried[-1].microseconds * ADVANTAGE < best.microseconds:
                best = tried[-1]
            done, size = good or tried[-1].microseconds > links.microseconds, size * 2
    reason = "; ".join(str(trial) for trial in [best, *(t for t in tried if t is not best)])
    scale = 1.0 if best is links else best.size / view_size(samples)
    return Choice(best.gather, f"measured on {renderer}: {reason}", scale, renderer)


def _lit_by_links(rays: GatherRays, texel: Int32, sent: Float32, workers: Workers) -> tuple[Float32, float]:
    """((k, 3) irradiance of ``texel`` (k,), seconds that a frame would take for them)."""
    start = time.perf_counter()
    chunk = max(1, CHUNK_RAYS // (rays.n_cosine + rays.n_bright))
    traced = workers.map_slices(lambda rows: rays.trace(texel[rows]), len(texel), chunk)
    nothing = np.int32(rays.target_count)
    target = np.concatenate([np.where(t.target == NO_TARGET, nothing, t.target) for t in traced])
    weight = np.concatenate([np.where(t.usable, t.weight, np.float32(0)) for t in traced])
    seconds = time.perf_counter() - start
    product = row_products(target, weight, rays.target_count + 1, workers)
    seen = np.append(sent, np.zeros((1, 3), np.float32), axis=0)
    start = time.perf_counter()
    brought = product(seen)
    seconds += PRODUCTS * (time.perf_counter() - start)
    return brought / np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny), seconds


def _tiles(placed: PlacedScene) -> tuple[Int32, Int32]:
    """((k,) texels, (k,) which tile each is of): whole tiles of one surface, spread over all there are."""
    texels = placed.texels
    key = np.stack([texels.surface, texels.page, texels.row // TILE, texels.col // TILE])
    _, of, count = np.unique(key, axis=1, return_inverse=True, return_counts=True)
    whole = np.flatnonzero(count == TILE * TILE)
    chosen = whole[np.linspace(0, len(whole) - 1, min(TILES, len(whole))).astype(np.int64)] if len(whole) else whole
    number = np.full(len(count), -1, np.int32)
    number[chosen] = np.arange(len(chosen), dtype=np.int32)
    tile = number[of.reshape(-1)]
    texel = np.flatnonzero(tile >= 0)
    return texel.astype(np.int32), tile[texel]


def _means(irradiance: Float32, tile: Int32) -> Float32:
    """(t, 3) of each tile."""
    count = np.bincount(tile)
    sums = [np.bincount(tile, channel) for channel in irradiance.T.astype(np.float64)]
    return np.asarray(np.stack(sums, axis=1) / count[:, None], np.float32)


def _error(means: Float32, right: Float32) -> float:
    mean = float(right.mean(dtype=np.float64))
    return float(np.sqrt(np.mean((means - right) ** 2, dtype=np.float64))) / mean if mean > 0 else 0.0
