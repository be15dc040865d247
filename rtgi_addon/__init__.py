# SPDX-License-Identifier: GPL-3.0-or-later
"""RTGI for Blender. Free of bpy at import, so that the backend and the command line load without it."""

from __future__ import annotations
