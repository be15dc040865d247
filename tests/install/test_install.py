# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's zip, as a user gets it: built, validated by Blender's own tool, installed, used and taken out again.

`make wheels` (part of `make test`) fetches the wheels; building needs no network then.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MANIFEST = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
MODULE = f"bl_ext.user_default.{MANIFEST['id']}"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The zip for this machine's platform."""
    folder = tmp_path_factory.mktemp("zip")
    run(sys.executable, ROOT / "tools/build_zip.py", "--output", folder)
    (built,) = folder.glob("*.zip")
    return built


def run(*command: object, **options: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(part) for part in command],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
        **options,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def test_blender_finds_the_package_valid(built: Path) -> None:
    origin = importlib.util.find_spec("bpy").origin
    (script,) = Path(origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    done = run(sys.executable, script, "validate", built)
    assert "Success" in done.stdout
    assert "warning" not in (done.stdout + done.stderr).lower()


def test_the_zip_holds_the_package_the_licences_and_nothing_else(built: Path) -> None:
    names = set(zipfile.ZipFile(built).namelist())
    wheels = {name for name in names if name.startswith("wheels/")}
    package = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "rtgi_addon").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    top = {"blender_manifest.toml", "__init__.py", "LICENSE", "THIRD_PARTY.md", "README.md"}
    assert names - wheels - package - top == set()
    assert package | (top - {"README.md"}) <= names
    inside = tomllib.loads(zipfile.ZipFile(built).read("blender_manifest.toml").decode())
    assert {f"./{name}" for name in wheels} == set(inside["wheels"]) <= set(MANIFEST["wheels"])
    assert len(inside["platforms"]) == 1


@pytest.mark.parametrize("platform", ["manylinux", "win_amd64", "macosx.*x86_64", "macosx.*arm64"])
def test_every_platform_has_the_same_wheels_for_both_pythons(platform: str) -> None:
    """Except that of glcontext 3.1.0 and moderngl 5.13.0 there are none for macos-x64."""
    projects = {"embreex", "scipy", "xatlas"}
    if platform != "macosx.*x86_64":
        projects |= {"glcontext", "moderngl"}
    have = [
        tuple(Path(wheel).name.split("-")[:3]) for wheel in MANIFEST["wheels"] if re.search(platform, Path(wheel).name)
    ]
    assert len(have) == len(set(have))
    assert {(project, python) for project, _, python in have} == {
        (project, python) for project in projects for python in ("cp311", "cp313")
    }


def test_every_wheel_has_a_checksum() -> None:
    sums = [line.split() for line in (ROOT / "requirements/wheels.sha256").read_text().splitlines()]
    assert {name for _, name in sums} == {Path(wheel).name for wheel in MANIFEST["wheels"]}
    assert all(len(digest) == 64 for digest, _ in sums)


def test_tests_run_the_versions_that_are_shipped() -> None:
    """The virtual environment's own embreex, glcontext, moderngl, scipy, tqdm and xatlas are the extension's."""
    from importlib.metadata import version

    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    for wheel in MANIFEST["wheels"]:
        project, pinned, tag = Path(wheel).name.split("-")[:3]
        if tag in (python, "py3"):
            assert version(project) == pinned


def packages_of_blender(folder: Path) -> Path:
    """What Blender brings to Python: this environment's packages without those that the extension ships."""
    folder.mkdir()
    shipped = {Path(wheel).name.split("-")[0] for wheel in MANIFEST["wheels"]}
    for entry in Path(importlib.util.find_spec("bpy").origin).parents[1].iterdir():
        if re.split(r"[-.]", entry.name.lstrip("_"))[0] not in shipped:  # moderngl brings _moderngl.py
            (folder / entry.name).symlink_to(entry)
    return folder


def test_installed_extension_bakes_and_leaves_nothing_behind(built: Path, tmp_path: Path) -> None:
    result, user = tmp_path / "seen.json", tmp_path / "user"
    user.mkdir()
    packages = packages_of_blender(tmp_path / "packages")
    done = run(
        sys.executable,
        "-S",  # not the environment's packages, but those of PYTHONPATH
        Path(__file__).with_name("child.py"),
        built,
        MODULE,
        tmp_path / "scene.blend",
        result,
        cwd=tmp_path,
        env=os.environ | {"BLENDER_USER_RESOURCES": str(user), "PYTHONPATH": str(packages)},
    )
    seen = json.loads(result.read_text())
    output = done.stdout + done.stderr
    assert "Policy violation" not in output
    assert "Traceback" not in output
    assert seen["enabled"]
    assert seen["commands"] == 1 and seen["commands_after"] == 0
    for name in ("backend", "embreex", "glcontext", "moderngl", "scipy", "tqdm", "xatlas"):
        assert Path(seen[name]).is_relative_to(user), f"{name} did not come with the extension"
    assert not Path(seen["numpy"]).is_relative_to(user), "NumPy is Blender's own"
    assert seen["exit_code"] == 0, output
    assert {"bake.json", "iim.p0.0001.exr", "aim.p0.0001.exr"} <= set(seen["maps"])
