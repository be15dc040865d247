# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m rtgi_addon bake SCENE.blend``: the command line without Blender's program, bpy as a module."""

from __future__ import annotations

import sys

from .cli import run

if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
