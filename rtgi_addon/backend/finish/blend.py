# SPDX-License-Identifier: GPL-3.0-or-later
"""Live maps that do not pop: what is shown moves over to each new set of maps in a short time (Larsen04 §4).

Two sets are held: what was shown when the newest maps came, and the newest. A longer blend is smoother and lags more.
Batch bakes write converged maps and do not come here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..scene import Bool, Float32, LightMaps


class BlendedMaps:
    """Maps to show at a time. Arrays that come in are kept and may be handed out again: nobody writes to them."""

    def __init__(self, first: LightMaps, blend_time: float) -> None:
        """``first`` is shown at once; later maps over ``blend_time`` seconds, 0 for at once."""
        if not 0 <= blend_time < np.inf:
            raise ValueError(f"a blend of {blend_time} s")
        _check_shapes(first, first)
        self._blend_time = blend_time
        self._start = self._newest = first
        self._began = self._ends = -np.inf

    def show(self, maps: LightMaps, at: float) -> None:
        """``maps`` were finished at ``at`` seconds: what is shown then becomes the start of a blend to them.

        Maps with the values of the newest ones only bring their frame number: a blend under way goes on.
        """
        if not self._began <= at < np.inf:
            raise ValueError(f"maps of {at} s come after those of {self._began} s")
        _check_shapes(maps, self._newest)
        if not _equal(maps, self._newest):
            self._start = self.at(at)
            self._began, self._ends = at, at + self._blend_time
        self._newest = maps

    def settled(self, time: float) -> bool:
        """Is the blend over at ``time`` seconds, so that the picture stands still until maps come?"""
        return time >= self._ends

    def at(self, time: float) -> LightMaps:
        """What to show at ``time`` seconds: linear in time, the newest maps themselves once the blend is over.

        ``frame`` and ``valid`` are the newest. Without caustics counts as black.
        """
        if self.settled(time):
            return self._newest
        share = (time - self._began) / (self._ends - self._began) if time > self._began else 0.0
        start, newest = self._start, self._newest
        return replace(
            newest,
            iim=_between(start.iim, newest.iim, share),
            aim=_between(start.aim, newest.aim, share),
            caustics=_between_or_none(start.caustics, newest.caustics, share),
        )


def _between(a: Float32, b: Float32, share: float) -> Float32:
    """``a`` + (``b`` - ``a``) × ``share``: rounding neither turns it back on its way nor takes it past ``b``."""
    if a is b:
        return b
    mixed = b - a
    mixed *= np.float32(share)
    mixed += a
    return np.clip(mixed, np.minimum(a, b), np.maximum(a, b), out=mixed)


def _between_or_none(a: Float32 | None, b: Float32 | None, share: float) -> Float32 | None:
    some = b if a is None else a
    if some is None:
        return None
    black = np.zeros_like(some)
    return _between(black if a is None else a, black if b is None else b, share)


def _check_shapes(maps: LightMaps, like: LightMaps) -> None:
    """ValueError where ``maps`` are not of one shape, that of ``like``."""
    for name in ("iim", "aim", "caustics"):
        page = getattr(maps, name)
        if page is not None and page.shape != like.iim.shape:
            raise ValueError(f"{name} of frame {maps.frame} is {page.shape}, maps so far are {like.iim.shape}")
    if maps.valid.shape != like.iim.shape[:-1]:
        raise ValueError(f"valid of frame {maps.frame} is {maps.valid.shape}, maps so far are {like.iim.shape}")


def _equal(a: LightMaps, b: LightMaps) -> bool:
    return _same(a.iim, b.iim) and _same(a.aim, b.aim) and _same(a.caustics, b.caustics) and _same(a.valid, b.valid)


def _same(a: Float32 | Bool | None, b: Float32 | Bool | None) -> bool:
    if a is None or b is None:
        return a is b
    return a is b or np.array_equal(a, b)
