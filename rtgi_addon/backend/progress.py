# SPDX-License-Identifier: GPL-3.0-or-later
"""How long work tells the outside where it is: one callback, no terminal, no Blender, no JSON here."""

from __future__ import annotations

from collections.abc import Callable

#: ``report(stage, done, total)``; ``stage`` is a name from docs/pipeline.md, counts are in that stage's own unit.
#: The callback may raise :class:`~rtgi_addon.backend.errors.Cancelled` to stop the work.
Report = Callable[[str, int, int], None]


def silent(stage: str, done: int, total: int) -> None:
    """The report of callers who do not listen."""
