# SPDX-License-Identifier: GPL-3.0-or-later
"""Fill a virtual environment with one pinned requirements file: ``setup.py FOLDER REQUIREMENTS``.

Called by tools/setup.sh with the Python to use; standard library only. Quick when nothing changed. Also sees to the
system libraries that bpy and OpenGL load: installs them as root on Debian, else names them in one line.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

# What bpy and EGL rendering load, with the Debian package of each.
SYSTEM_LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libXi.so.6": "libxi6",
    "libXfixes.so.3": "libxfixes3",
    "libSM.so.6": "libsm6",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
}
# libEGL needs one driver behind it: a vendor's or Mesa's.
EGL_DRIVERS = ("libEGL_nvidia.so.0", "libEGL_mesa.so.0")
EGL_DRIVER_PACKAGES = ("libegl-mesa0", "libgl1-mesa-dri")
# Blender's own package index: keeps the bpy versions that PyPI has no room for.
BLENDER_INDEX = "https://download.blender.org/pypi/"


def main(folder: Path, requirements: Path) -> None:
    check_system_libraries()
    python = folder / "bin" / "python"
    stamp = folder / "requirements.sha256"
    wanted = fingerprint(requirements)
    if starts(python) and stamp.is_file() and stamp.read_text() == wanted:
        return
    say(f"installing {requirements} into {folder} (once; about 400 MB to download)")
    make_environment(folder, python)
    install(python, requirements)
    stamp.write_text(wanted)


def fingerprint(requirements: Path) -> str:
    """Of all that decides the environment's content: the pins and this Python."""
    digest = hashlib.sha256(sys.version.encode())
    for file in (requirements, requirements.with_name("dev.txt")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def starts(python: Path) -> bool:
    return python.exists() and subprocess.run([python, "-c", ""], stdin=subprocess.DEVNULL, check=False).returncode == 0


def make_environment(folder: Path, python: Path) -> None:
    if folder.exists() and not starts(python):
        shutil.rmtree(folder)  # its Python is gone
    command = [sys.executable, "-m", "venv", str(folder)]
    if subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False).returncode == 0:
        return
    package = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"  # Debian splits ensurepip off
    apt_install([package], f"this Python cannot make a virtual environment; install {package}")
    subprocess.run(command, stdin=subprocess.DEVNULL, check=True)


def install(python: Path, requirements: Path) -> None:
    command = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary", ":all:"]
    command += ["-r", requirements]
    for extra in ([], ["--extra-index-url", BLENDER_INDEX]):
        if subprocess.run([*command, *extra], stdin=subprocess.DEVNULL, check=False).returncode == 0:
            return
    fail(f"pip could not install {requirements}; its reason is above")


def check_system_libraries() -> None:
    if sys.platform != "linux":
        return  # the wheels for Windows and macOS bring theirs
    missing = [package for name, package in SYSTEM_LIBRARIES.items() if not loads(name)]
    if not any(loads(name) for name in EGL_DRIVERS):
        missing += EGL_DRIVER_PACKAGES
    if missing:
        names = " ".join(missing)
        apt_install(missing, f"system libraries are missing; as root: apt-get install {names}")


def loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def apt_install(packages: list[str], remedy: str) -> None:
    """Install as root where there is apt; else end with the remedy."""
    if platform.system() != "Linux" or os.geteuid() != 0 or not shutil.which("apt-get"):
        fail(remedy)
    say(f"installing system packages: {' '.join(packages)}")
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", *packages]):
        done = subprocess.run(
            ["apt-get", *command], env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=False
        )
    if done.returncode != 0:
        fail(remedy)


def say(text: str) -> None:
    sys.stderr.write(f"setup: {text}\n")


def fail(text: str) -> None:
    sys.exit(f"setup: {text}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
