# SPDX-License-Identifier: GPL-3.0-or-later
"""RTGI for Blender. Free of bpy at import, so that the backend and the command line load without it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

#: What Blender gave for each registered command; it wants the same thing back.
_commands: list[Any] = []


def _rtgi(argv: Sequence[str]) -> int:
    """``blender --command rtgi …``; what it needs is loaded when it is used, not when Blender starts."""
    from .cli import run

    return run(argv)


def register() -> None:
    """Called by Blender when the extension is enabled."""
    import bpy

    _commands.append(bpy.utils.register_cli_command("rtgi", _rtgi))


def unregister() -> None:
    """Called by Blender when the extension is disabled, and at exit."""
    import bpy

    while _commands:
        bpy.utils.unregister_cli_command(_commands.pop())
