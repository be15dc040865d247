# SPDX-License-Identifier: GPL-3.0-or-later
"""The seam where final gathers plug in: what ``lighting`` asks of one, whatever way it finds what texels see.

A gather keeps what each texel sees from frame to frame, is told what moved, and does again what that touches. What it
knows is a linear map from the radiosity of all targets to the irradiance of all texels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..placed import PlacedScene
from ..scene import Bool, Float32, Int32
from ..selection.changes import Change


@dataclass
class GatherWork:
    """What one frame's update took."""

    changed: Bool  # (n,) texels of which something is seen anew
    traced: int = 0  # rays
    renewed: int = 0  # links
    drawn: int = 0  # views


class Irradiance(Protocol):
    """What r texels get from m targets (texels first, then patches of sky), of n texels in all."""

    @property
    def stand_in(self) -> Int32:
        """(n,) of all texels: whose light stands for each; itself unless under other geometry; -1: none."""
        ...

    def irradiance(self, radiosity: Float32) -> Float32:
        """(r, 3) W/m² from the radiosity (m, 3) of all targets."""
        ...

    def with_half(self, radiosity: Float32) -> tuple[Float32, Float32]:
        """:meth:`irradiance`, and the same as half of the samples estimate it."""
        ...

    def only(self, texels: NDArray[np.int64]) -> Irradiance:
        """That of ``texels`` (r,), of the irradiance of all."""
        ...


class KeptGather(Protocol):
    """What n texels see by one number of samples each; of the first ``kept`` it is kept."""

    @property
    def count(self) -> int: ...

    @property
    def kept(self) -> int: ...

    @property
    def samples_kept(self) -> int:
        """Links, or pixels of views."""
        ...

    @property
    def bytes(self) -> int:
        """Memory that they take."""
        ...

    @property
    def pending(self) -> Bool:
        """(n,) texels of which something is not up to date."""
        ...

    def follow(self, placed: PlacedScene, change: Change) -> int:
        """Mark what ``change`` touches as pending; how many samples were looked at one by one."""
        ...

    def renew(self, texel: Int32) -> GatherWork:
        """Bring ``texel`` (m,) up to date."""
        ...

    def at_stake(self, brightness: Float32, texel: Int32) -> Float32:
        """(k,) W/m² that what is pending of ``texel`` (k,), all of them kept, brings where each target sends
        ``brightness`` (m,) W/m²: about what their irradiance may change by."""
        ...

    def components(self) -> tuple[Int32, Bool]:
        """((s,) which surfaces exchange light, numbered; (s,) whether they exchange any)."""
        ...

    def irradiance(self) -> Irradiance:
        """What all texels see, as it is known now."""
        ...

    def release(self) -> None:
        """Give memory back that is not NumPy's."""
        ...
