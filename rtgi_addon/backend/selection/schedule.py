# SPDX-License-Identifier: GPL-3.0-or-later
"""What to update first when not everything can be: Δ of each surface and the line of its waiting texels.

Larsen04 §3-4: each surface sums the change of its flux since its map was last updated; the highest Δ per area comes
first and only so much is done in a frame. Here every texel also has a longest time to wait, whatever the Δs.
One schedule serves one map: Δ_f the AIM, Δ_i the IIM.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from ..scene import Bool, Float32, Float64, Int32
from ..settings import Budget

#: A surface without area is divided by this instead, m².
LEAST_AREA = float(np.finfo(np.float32).tiny)
#: A few ms of gathering on two cores (9 µs a texel at 32 + 32 rays): how far a time budget may be overrun.
CHUNK = 512
#: In ``since``: the texel does not wait.
NEVER = -1


class UpdateSchedule:
    """The line in which waiting texels are updated. Once a frame: ``add``, then ``order``, then ``updated``.

    Longest wait: say that B texels from the front of the line are updated in each frame (all, if there are fewer). A
    texel that is pending for the first time in frame f, when W texels are pending with it, is updated by frame
    f + patience + ⌈W / B⌉ - 1, whatever happens after f. For by frame f + patience only texels that have waited as
    long, or longer, stand before it; these are among the W, none can join them, and B of them leave in each frame.
    """

    def __init__(self, surface: Int32, area: Float32, *, threshold: float, patience: int) -> None:
        """``surface`` (n,) of each texel; ``area`` (s,) m² of each surface.

        A surface waits while its Δ per area is below ``threshold`` × the mean irradiance, but no texel of it longer
        than ``patience`` frames. Where patience is short against the frames that all pending texels take, the line is
        first come, first served, and Δ decides among those that came together.
        """
        if not threshold >= 0 or patience < 0:
            raise ValueError(f"threshold {threshold} and patience {patience} must not be negative")
        self._surface = surface
        self._threshold, self._patience = threshold, patience
        self._frame = 0
        self._since = np.full(len(surface), NEVER)  # (n,) frame in which the texel came into the line
        self._delta: Float64 = np.zeros(len(area))  # (s,) W
        self._left = np.zeros(len(area), np.intp)  # (s,) texels in the line
        self.set_area(area)
        if surface.size and not (0 <= surface.min() and surface.max() < len(area)):
            raise ValueError(f"texels on surfaces {surface.min()} to {surface.max()}, areas of {len(area)}")

    @property
    def delta(self) -> Float64:
        """(s,) Δ, W: change of flux that the map does not show yet."""
        return self._delta.copy()

    def set_area(self, area: Float32) -> None:
        """``area`` (s,) m², of surfaces that have deformed."""
        self._area = _checked(area, self._delta, "area")

    def add(self, delta: Float32 | Float64) -> None:
        """``delta`` (s,) W, not negative: by how much each surface's flux has changed, photons that left it and
        photons that came counted alike. May be called for each cause of a change."""
        self._delta += _checked(delta, self._delta, "Δ")

    def order(self, pending: Bool, irradiance: float) -> Int32:
        """Texels to update now, most urgent first; one call is one frame.

        ``pending`` (n,): the texel is out of date. A surface with none is up to date: its Δ ends.
        ``irradiance``: mean of the map, W/m², to which the threshold is relative.
        First come those whose patience is over, longest wait first; then the surfaces with the highest Δ per area, one
        after the other. Equal ones go by surface, then by waiting time, then by texel.
        """
        if pending.shape != self._since.shape:
            raise ValueError(f"pending is {pending.shape}, texels are {self._since.shape}")
        if not 0 <= irradiance < np.inf:
            raise ValueError(f"irradiance {irradiance} W/m²")
        waiting = self._line_up(pending)
        surface = self._surface[waiting]
        self._left = np.bincount(surface, minlength=len(self._delta))
        self._delta[self._left == 0] = 0
        density = self._delta / np.maximum(self._area, LEAST_AREA)
        place = np.empty(len(density), np.intp)
        place[np.argsort(-density, kind="stable")] = np.arange(len(density))
        late = np.maximum(self._frame - self._since[waiting] - self._patience + 1, 0)  # 0: still patient
        due = (late > 0) | (density >= self._threshold * irradiance)[surface]
        waiting, surface, late = waiting[due], surface[due], late[due]
        line: Int32 = waiting[np.lexsort((self._since[waiting], place[surface], -late))].astype(np.int32)
        return line

    def _line_up(self, pending: Bool) -> Int32:
        """Indices of ``pending``, each marked with the frame in which it came; the others leave the line."""
        self._frame += 1
        self._since[~pending] = NEVER
        self._since[pending & (self._since == NEVER)] = self._frame
        waiting: Int32 = np.flatnonzero(pending).astype(np.int32)
        return waiting

    def updated(self, texels: Int32) -> None:
        """``texels``, each once, of the last ``order`` are up to date: Δ falls by their share of what was pending.

        May be called for each part of a frame's work.
        """
        if (self._since[texels] == NEVER).any():
            raise ValueError("texels that were not pending, or twice the same")
        self._since[texels] = NEVER
        before = self._left
        self._left = before - np.bincount(self._surface[texels], minlength=len(before))
        self._delta *= self._left / np.maximum(before, 1)


def _checked(values: Float32 | Float64, like: Float64, name: str) -> Float64:
    """A float64 copy of ``values``; ValueError where they cannot be ``name`` of the surfaces of ``like``."""
    if values.shape != like.shape:
        raise ValueError(f"{name} is {values.shape}, surfaces are {like.shape}")
    if not ((values >= 0) & np.isfinite(values)).all():
        raise ValueError(f"{name} is negative or not finite")
    return values.astype(np.float64)


def within(
    budget: Budget, line: Int32, *, chunk: int = CHUNK, clock: Callable[[], float] = time.perf_counter
) -> Iterator[Int32]:
    """The front of ``line`` that ``budget`` allows, in order and in parts: each is to be done before the next is asked.

    Time counts from this call, by ``clock`` in seconds. The first ``chunk`` texels always come, however late it is, so
    a time budget updates at least that many in a frame; no part is begun once the time is up.
    """
    if chunk < 1:
        raise ValueError(f"chunks of {chunk} texels")
    allowed = line[: budget.texels]
    if budget.milliseconds is None:
        return iter([allowed] if len(allowed) else [])
    return _until(clock() + budget.milliseconds / 1000, allowed, chunk, clock)


def _until(end: float, line: Int32, chunk: int, clock: Callable[[], float]) -> Iterator[Int32]:
    for start in range(0, len(line), chunk):
        if start and clock() >= end:
            return
        yield line[start : start + chunk]
