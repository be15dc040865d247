# SPDX-License-Identifier: GPL-3.0-or-later
"""Taking scenes of our own out again, in every context that Blender runs Python in."""

from __future__ import annotations

import bpy


def remove_scene(scene: bpy.types.Scene) -> None:
    """Remove ``scene``, which no window shows; its objects and collections stay.

    Not by ``bpy.data.scenes.remove``: that of Blender 4.2 and 4.3 asks the context's window which scene it shows, and
    crashes where there is none, as in ``blender -b FILE --command`` and in timers.
    """
    bpy.data.batch_remove([scene])
