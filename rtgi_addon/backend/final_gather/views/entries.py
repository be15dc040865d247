# SPDX-License-Identifier: GPL-3.0-or-later
"""What a view's pixel can show, numbered: atlas pixels, patches of sky, nothing, and what has no light of its own.

A pixel of a view holds such a number, an entry. What the entries send is a table on the GPU, renewed for each product;
what pixels see stays. An atlas pixel stands for its texel as a ray's end does (``Texels.lookup``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...lamps.sky import Sky
from ...scene import Float32, Int32
from ...surface.texels import Texels

#: A target's number where there is none: black, but seen.
NOTHING = -1
#: What an entry sends that is to be passed over: farther below zero than any light is above, and than the vectors that
#: solvers put in its place. Must be below LEAST_SENT of inc/table.glsl.
DOES_NOT_COUNT = (-2e38, 0.0, 0.0)


@dataclass(frozen=True)
class Entries:
    """e entries: those of all atlas pixels, of k patches of sky, ``escaped``, ``none``."""

    target: Int32  # (e,) texel, or texels' count + patch; NOTHING for the last two and for pixels without a texel
    sky_first: int  # of the first patch
    sky_size: tuple[int, int]  # rows and columns; zeros without a sky

    @property
    def count(self) -> int:
        return len(self.target)

    @property
    def escaped(self) -> int:
        """What lies beyond everything where there is no sky."""
        return self.count - 2

    @property
    def plain_sky(self) -> bool:
        """Does every pixel that shows no surface show the same, whichever way it looks?"""
        return self.sky_size[0] * self.sky_size[1] < 2

    @property
    def none(self) -> int:
        """A side without a map: what sees it is under other geometry, and the rest of the view makes up for it."""
        return self.count - 1

    def sent(self, radiosity: Float32, seen_as: Int32 | None) -> Float32:
        """(e, 4) radiosity, W/m², of all entries; DOES_NOT_COUNT where it does not. The fourth number means nothing.

        radiosity (m, 3) of all targets · seen_as (m,): the target that each is seen as, NOTHING: it does not count.
        """
        target = self.target if seen_as is None else np.append(seen_as, np.int32(NOTHING))[self.target]
        out = np.zeros((self.count, 4), np.float32)
        out[:, :3] = radiosity.take(target, axis=0, mode="clip") if len(radiosity) else 0
        out[target < 0, :3] = DOES_NOT_COUNT
        out[self.escaped] = 0
        return out


def make_entries(texels: Texels, sky: Sky | None) -> Entries:
    """The entries of ``texels``' atlas under ``sky``."""
    patches = np.arange(sky.count if sky else 0, dtype=np.int32) + np.int32(texels.count)
    ends = np.array([NOTHING, NOTHING], np.int32)
    return Entries(
        target=np.concatenate([texels.lookup, patches, ends]),
        sky_first=len(texels.lookup),
        sky_size=(sky.rows, sky.columns) if sky else (0, 0),
    )
