# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake ran on and with: written into bake.json, and compared before a bake is taken up again."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
import tomllib
from pathlib import Path

import bpy

from .backend.parallel import thread_count

#: Whose version may change the last bits of a map.
PACKAGES = ("numpy", "scipy", "embreex", "xatlas")
CHOICES = "gathers.json"


def versions() -> dict[str, str]:
    """Versions by name: rtgi, blender, python, and the packages that compute."""
    manifest = Path(__file__).parents[1] / "blender_manifest.toml"
    return {
        "rtgi": tomllib.loads(manifest.read_text(encoding="utf-8"))["version"],
        "blender": bpy.app.version_string,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }


def device(threads: int) -> dict[str, str | int]:
    """The machine part that computes. ``threads`` as in the settings."""
    return {"kind": "cpu", "name": _processor(), "threads": thread_count(threads), "system": platform.platform()}


def choices_file() -> Path:
    """Where gather AUTO notes what it measured on this machine: in the extension's own folder, or, when the add-on is
    run as a module, in the user's folder of caches."""
    package = (__package__ or "").removesuffix(".rtgi_addon")
    if package.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(package)) / CHOICES
    home = Path.home()
    caches = {"win32": home / "AppData" / "Local", "darwin": home / "Library" / "Caches"}.get(sys.platform)
    return (caches or Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")) / "rtgi" / CHOICES


def library_folders() -> list[Path]:
    """Where Blender keeps the shared libraries it ships, as a program and as a Python module, by system."""
    homes = [Path(bpy.app.binary_path).parent] if bpy.app.binary_path else []
    # Not bpy.__file__: that is a file of the scripts once the module is loaded.
    homes.append(Path(bpy.utils.resource_path("LOCAL")).parent)
    return [home / place for home in homes for place in ("lib", "blender.shared", "../Resources/lib", ".")]


def _processor() -> str:
    """The processor's name; Python itself knows none on Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
