# SPDX-License-Identifier: GPL-3.0-or-later
"""Run by test_install.py in a process of its own: install the zip into empty user resources, use it, take it out.

Writes what it saw as JSON into the file named last. BLENDER_USER_RESOURCES says where Blender installs to.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import bpy


def main(zip_file: str, module: str, scene_file: str, result: Path) -> None:
    import addon_utils  # bpy puts it on the path

    bpy.ops.wm.read_factory_settings(use_empty=True)
    save_scene(scene_file)
    bpy.ops.extensions.package_install_files(filepath=zip_file, repo="user_default", enable_on_install=True)
    seen: dict[str, object] = {"enabled": addon_utils.check(module)[1]}
    package = importlib.import_module(f"{module}.rtgi_addon")
    backend = importlib.import_module(f"{module}.rtgi_addon.backend.surface.tracing")
    seen["backend"] = backend.__file__
    seen["commands"] = len(package._commands)
    for name in ("embreex", "glcontext", "moderngl", "scipy", "tqdm", "xatlas", "numpy"):
        seen[name] = importlib.import_module(name).__file__
    maps = str(result.parent / "maps")
    arguments = ["bake", scene_file, "--out", maps, "--resolution", "64", "--quality", "draft"]
    seen["exit_code"] = importlib.import_module(f"{module}.rtgi_addon.cli").run(arguments)
    seen["maps"] = sorted(path.name for path in Path(maps).iterdir())
    addon_utils.disable(module, default_set=True)
    seen["commands_after"] = len(package._commands)
    result.write_text(json.dumps(seen))


def save_scene(path: str) -> None:
    """A floor, a cube on it and a lamp."""
    bpy.ops.mesh.primitive_plane_add(size=4)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 0.5))
    bpy.ops.object.light_add(type="POINT", location=(1, 1, 2))
    bpy.context.object.data.energy = 100
    bpy.ops.wm.save_as_mainfile(filepath=path)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], Path(sys.argv[4]))
