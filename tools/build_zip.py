# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the extension's zip for one platform or all, with the wheels that blender_manifest.toml lists.

Run in a virtual environment that has bpy: Blender's own builder inside it does the work. Wheels are fetched from PyPI
into wheels/ and kept there; requirements/wheels.sha256 says what each must hold.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MANIFEST = ROOT / "blender_manifest.toml"
# What a wheel's file name says of each platform of the manifest.
WHEEL_TAGS = {
    "linux-x64": "manylinux.*_x86_64",
    "windows-x64": "win_amd64",
    "macos-x64": "macosx_.*_x86_64",
    "macos-arm64": "macosx_.*_arm64",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--platform", choices=[*WHEEL_TAGS, "all"], default=this_platform())
    parser.add_argument("--output", type=Path, default=ROOT / "dist")
    parser.add_argument("--only-wheels", action="store_true", help="fetch the wheels, build nothing")
    options = parser.parse_args()
    manifest = tomllib.loads(MANIFEST.read_text())
    for name in manifest["platforms"] if options.platform == "all" else [options.platform]:
        wheels = [path for path in manifest["wheels"] if re.search(rf"-({WHEEL_TAGS[name]}|any)\.whl$", path)]
        fetch(wheels)
        if not options.only_wheels:
            say(f"built {build(name, wheels, options.output, manifest)}")


def this_platform() -> str:
    machine = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}.get(platform.machine().lower(), platform.machine())
    return {"linux": "linux", "win32": "windows", "darwin": "macos"}.get(sys.platform, sys.platform) + "-" + machine


def fetch(wheels: list[str]) -> None:
    """Make sure that each wheel is in wheels/ and is the very file that was reviewed."""
    sums = dict(reversed(line.split()) for line in (ROOT / "requirements/wheels.sha256").read_text().splitlines())
    for wheel in (ROOT / path for path in wheels):
        if not wheel.is_file():
            download(wheel)
        if hashlib.sha256(wheel.read_bytes()).hexdigest() != sums[wheel.name]:
            wheel.unlink()
            fail(f"{wheel.name} is not the file that requirements/wheels.sha256 describes; it was removed, run again")


def download(wheel: Path) -> None:
    project, version, python, _abi, tags = wheel.stem.split("-")
    say(f"fetching {wheel.name}")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary", ":all:"]
    if tags != "any":
        command += ["--implementation", "cp", "--python-version", python.removeprefix("cp")]
        command += [option for tag in tags.split(".") for option in ("--platform", tag)]
    with tempfile.TemporaryDirectory() as folder:
        command += ["--dest", folder, f"{project}=={version}"]
        if subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode != 0:
            fail(f"pip could not fetch {wheel.name}; its reason is above")
        wheel.parent.mkdir(exist_ok=True)
        shutil.move(Path(folder) / wheel.name, wheel)


def build(platform_name: str, wheels: list[str], output: Path, manifest: dict) -> Path:
    """Build in a copy of the tree whose manifest has this platform alone: the other wheels need not be here."""
    output.mkdir(parents=True, exist_ok=True)
    target = output / f"{manifest['id']}-{manifest['version']}-{platform_name}.zip"
    with tempfile.TemporaryDirectory() as folder:
        stage = Path(folder) / "stage"
        shutil.copytree(ROOT, stage, ignore=shutil.ignore_patterns(".*", "__pycache__", "wheels", "out", "dist"))
        (stage / "wheels").mkdir()
        for path in wheels:
            shutil.copy(ROOT / path, stage / path)
        (stage / MANIFEST.name).write_text(manifest_for(platform_name, wheels))
        blender_ext("validate", str(stage))
        blender_ext("build", "--source-dir", str(stage), "--output-filepath", str(Path(folder) / target.name))
        shutil.move(Path(folder) / target.name, target)
    return target


def manifest_for(platform_name: str, wheels: list[str]) -> str:
    lines = "".join(f'  "{path}",\n' for path in wheels)
    text = re.sub(r"^platforms = .*$", f'platforms = ["{platform_name}"]', MANIFEST.read_text(), flags=re.MULTILINE)
    return re.sub(r"^wheels = \[.*?^\]", f"wheels = [\n{lines}]", text, flags=re.MULTILINE | re.DOTALL)


def blender_ext(*arguments: str) -> None:
    """Blender's own command for extensions, which runs in plain Python."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        fail("no bpy in this Python; run: make zip")
    (script,) = Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    command = [sys.executable, script, *arguments]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        fail(f"{' '.join(arguments[:1])}: {done.stdout}{done.stderr}".strip())


def say(text: str) -> None:
    sys.stderr.write(f"zip: {text}\n")


def fail(text: str) -> None:
    sys.exit(f"zip: {text}")


if __name__ == "__main__":
    main()
