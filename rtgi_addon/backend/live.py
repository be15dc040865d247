# SPDX-License-Identifier: GPL-3.0-or-later
"""A session to look at while the scene moves: bounded work a frame, and maps that blend instead of popping.

Direct light, which Eevee draws too, follows at once; the links that a mover touches follow in the order of how much
light hangs on them (Larsen04 §3, §4). When the scene rests the maps become those of a batch frame, to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from .finish.blend import BlendedMaps
from .scene import Atlas, FrameState, LightMaps, Scene
from .session import FrameResult, Session
from .settings import BakeSettings, LiveSettings


class LiveSession:
    """A :class:`~.session.Session` with a budget, and the maps to show at any time. Times are seconds of any clock."""

    def __init__(
        self, scene: Scene, atlas: Atlas, settings: BakeSettings, live: LiveSettings, state: FrameState,
        *, guide: Sequence[FrameState] = (), oidn_paths: Sequence[Path] = (),
    ) -> None:  # fmt: skip
        """See :class:`~.session.Session`."""
        self.session = Session(scene, atlas, settings, state, guide=guide, live=live, oidn_paths=oidn_paths)
        self._blend_time = live.blend_time
        self._shown: BlendedMaps | None = None

    def close(self) -> None:
        """Give threads and the denoiser back."""
        self.session.close()

    def __enter__(self) -> LiveSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def advance(self, state: FrameState, time: float) -> FrameResult:
        """Light ``state`` within the budget; its maps take the place of those shown from ``time`` on."""
        result = self.session.advance(state)
        if self._shown is None:
            self._shown = BlendedMaps(result.maps, self._blend_time)
        else:
            self._shown.show(result.maps, time)
        return result

    def maps(self, time: float) -> LightMaps:
        """What to show at ``time``. Raises ValueError before the first :meth:`advance`."""
        if self._shown is None:
            raise ValueError("nothing is lit yet: advance first")
        return self._shown.at(time)
