# SPDX-License-Identifier: GPL-3.0-or-later
"""What of the scene differs between a frame and the one before it."""

from __future__ import annotations

from dataclasses import dataclass

from ..scene import Bool
from .sweep import Sweep


@dataclass(frozen=True)
class Change:
    """From one frame to the next; n texels."""

    sweep: Sweep  # where objects moved, appeared and vanished
    texels: Bool  # (n,) texels of those objects
    scattering: Bool | None  # (n,) texels whose albedo differs; None: none
    passing: bool  # mirrors, glass or opacity differ: light takes other ways
    emitted: bool  # what surfaces or sky send of themselves differs
    everything: bool  # no ray of the frame before can be relied on

    @property
    def rays_hold(self) -> bool:
        """Does light still go every way it went, objects in ``sweep`` aside?"""
        return not (self.passing or self.everything)

    @property
    def any(self) -> bool:
        """False: apart from lamps nothing differs."""
        return self.sweep.any or self.scattering is not None or self.emitted or not self.rays_hold
