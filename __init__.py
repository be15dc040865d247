# SPDX-License-Identifier: GPL-3.0-or-later
"""Root of the Blender extension: Blender imports this folder as one package and calls these two."""

from .rtgi_addon import register, unregister

__all__ = ["register", "unregister"]
