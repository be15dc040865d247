# SPDX-License-Identifier: GPL-3.0-or-later
"""Seconds and memory of one call."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Cost:
    seconds: float  # wall clock
    peak_bytes: int | None  # most memory above the meter's zero; None where the system does not say


class Meter:
    """Memory is counted from what the process holds when the meter is made."""

    def __init__(self) -> None:
        self._zero = _start_peak()

    def measured(self, work: Callable[[], Result]) -> tuple[Result, Cost]:
        """Do ``work``; what it gave and what it cost."""
        _start_peak()
        start = time.perf_counter()
        result = work()
        seconds = time.perf_counter() - start
        return result, Cost(seconds, None if self._zero is None else max(_status("VmHWM") - self._zero, 0))


def _start_peak() -> int | None:
    """Bytes in use, and the system's mark of the peak set back to it; None where there is no such mark."""
    try:
        _CLEAR.write_text("5", encoding="ascii")  # see proc(5)
        return _status("VmRSS")
    except OSError:
        return None


def _status(field: str) -> int:
    line = next(line for line in _STATUS.read_text(encoding="ascii").splitlines() if line.startswith(field + ":"))
    return int(line.split()[1]) * 1024
