# SPDX-License-Identifier: GPL-3.0-or-later
"""The swept test: which stored segments does an object touch, where it was or where it is now?

Larsen04 §2 finds disturbed photons by probing one of each group a frame. Here every stored segment is tested against
the moved objects alone, at the old and the new place: what they touch is what a fresh trace could find otherwise, no
more and, but for the last ten-thousandth of a segment, no less (DESIGN §5).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..parallel import CHUNK_RAYS, Workers
from ..scene import Bool, Float32
from ..surface.tracing import Place

#: A segment that ends on an object is touched by it, whichever way its length was rounded.
END_MARGIN = 1e-4


@dataclass(frozen=True)
class Sweep:
    """All places that moved, deformed, appearing and vanishing objects left and took."""

    left: tuple[Place, ...]
    taken: tuple[Place, ...]
    moved: Bool  # (instances,)
    workers: Workers = field(repr=False)

    @property
    def any(self) -> bool:
        """False: no instance differs from the frame before."""
        return bool(self.moved.any())

    @property
    def places(self) -> tuple[Place, ...]:
        """Old and new ones."""
        return self.left + self.taken

    def touches(self, origins: Float32, directions: Float32, distances: Float32) -> Bool:
        """(n,) does origin + [0, distance] · direction meet an object at any of the places?

        origins, directions (n, 3) local space, directions of any length; distances (n,) in units of it, inf for rays
        that escaped.
        """
        return self._meet(self.places, origins, directions, distances)

    def enters(self, origins: Float32, directions: Float32, distances: Float32) -> Bool:
        """(n,) does it meet one where it is now? Enough for rays of which it is known what they hit: those that met
        an object where it was ended on it."""
        return self._meet(self.taken, origins, directions, distances)

    def _meet(self, places: tuple[Place, ...], origins: Float32, directions: Float32, distances: Float32) -> Bool:
        def part(rows: slice) -> Bool:
            return touched_by(places, origins[rows], directions[rows], distances[rows])

        parts = self.workers.map_slices(part, len(origins), CHUNK_RAYS) if places else []
        return np.concatenate(parts) if parts else np.zeros(len(origins), np.bool_)


def touched_by(places: tuple[Place, ...], origins: Float32, directions: Float32, distances: Float32) -> Bool:
    """(n,) does the segment meet an object at any of ``places``?"""
    touched = np.zeros(len(origins), np.bool_)
    for place in places:
        rows = place.near(origins, directions, distances * np.float32(1 + END_MARGIN))
        rows = rows[~touched[rows]]
        if len(rows):
            touched[rows] = meets(place, origins[rows], directions[rows], distances[rows])
    return touched


def meets(place: Place, origins: Float32, directions: Float32, distances: Float32) -> Bool:
    """(n,) does the segment meet the object itself?"""
    ends = np.asarray(distances, np.float32) * np.float32(1 + END_MARGIN)
    return place.part.occluded(origins, directions, ends)
