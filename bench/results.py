# SPDX-License-Identifier: GPL-3.0-or-later
"""What workers send back. No bpy here: the parent must not load it, or processes that it starts cannot."""

from __future__ import annotations

from dataclasses import dataclass

from .errors import Errors
from .measure import Cost
from .table import Curve


@dataclass(frozen=True)
class Run:
    """One bake, compared with the reference."""

    curve: Curve
    label: str
    seed: int
    cost: Cost
    errors: Errors
    estimated_error: float | None = None  # RTGI's own


@dataclass(frozen=True)
class Machine:
    """What the runs were made on and with."""

    processor: str
    threads: int
    versions: dict[str, str]
    load: str  # average over the minute before
