# SPDX-License-Identifier: GPL-3.0-or-later
"""The gather by links: rays, what is kept of them, and the sparse matrix they are."""

from __future__ import annotations

from ..parallel import Workers
from ..placed import PlacedScene
from ..scene import Bool, Float32, Int32
from ..selection.changes import Change
from ..settings import SampleCounts
from .bright import BrightTargets
from .gather import GatherRays
from .kept_gather import GatherWork
from .link_store import LinkStore
from .links import Links, make_links


class LinkGather:
    """The :class:`~.kept_gather.KeptGather` by links."""

    def __init__(
        self, placed: PlacedScene, bright: BrightTargets, samples: SampleCounts, workers: Workers,
        *, memory: int, max_specular: int, seed: int,
    ) -> None:  # fmt: skip
        """Nothing is traced yet. ``memory``: bytes that links may take."""
        self._rays = GatherRays(
            placed.texels, placed.frame, placed.geometry, placed.surfaces, placed.tracer, placed.sky, bright, samples,
            max_specular=max_specular, seed=seed,
        )  # fmt: skip
        self._workers = workers
        self.store = LinkStore(self._rays, workers, memory=memory)

    @property
    def count(self) -> int:
        return self.store.count

    @property
    def kept(self) -> int:
        return self.store.kept

    @property
    def samples_kept(self) -> int:
        return self.store.target.size

    @property
    def bytes(self) -> int:
        return self.store.bytes

    @property
    def pending(self) -> Bool:
        return self.store.pending

    def follow(self, placed: PlacedScene, change: Change) -> int:
        self._rays.follow(change.texels, placed.surfaces)
        return self.store.disturb(self._rays, change.sweep, placed.frame.reach)

    def renew(self, texel: Int32) -> GatherWork:
        return self.store.renew(self._rays, texel)

    def at_stake(self, brightness: Float32, texel: Int32) -> Float32:
        return self.store.at_stake(brightness, texel)

    def components(self) -> tuple[Int32, Bool]:
        return self.store.components()

    def irradiance(self) -> Links:
        return make_links(self.store, self._rays, self._workers)

    def release(self) -> None:
        """Nothing: all is NumPy's."""
