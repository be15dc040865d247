# SPDX-License-Identifier: GPL-3.0-or-later
"""How much work one draw or dispatch is given: as much as ends well before a driver's watchdog would stop it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

#: Seconds that a piece of work may take before the next is made smaller, and below which it is made larger. Windows
#: resets a device after two seconds.
LONG, SHORT = 0.1, 0.03


class Pace:
    """``items`` is how many to do next; it doubles and halves between ``least`` and ``most``. No result hangs on it."""

    def __init__(self, least: int, most: int, start: int) -> None:
        self.items, self._least, self._most = min(max(start, least), most), least, most

    @contextmanager
    def timed(self, items: int) -> Iterator[None]:
        """Around a piece of ``items``, its waiting for the device included."""
        start = time.perf_counter()
        yield
        self.took(items, time.perf_counter() - start)

    def took(self, items: int, seconds: float) -> None:
        """A piece of ``items`` took ``seconds``. One that was not full says nothing about larger ones."""
        if seconds > LONG:
            self.items = max(self._least, self.items // 2)
        elif seconds < SHORT and items >= self.items:
            self.items = min(self._most, self.items * 2)
