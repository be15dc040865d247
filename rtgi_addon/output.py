# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder a bake leaves behind: which files, written whole or not at all, and how a bake is taken up again.

``bake.json`` is rewritten after each frame, once the frame's maps are on disk, so that what it lists is there.
No bpy here: whoever writes the images passes a function.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .backend.errors import BakeError

#: Raised when a reader of the old bake.json could no longer understand the new one.
FORMAT = 1
#: A file being written, in the same folder, where renaming is atomic; what a killed bake may leave.
PART = re.compile(r"\.((iim|aim|caustics)\.p\d+\.\d+\.exr|bake\.json|texels\.npz|probe\.\d+)\.part")
#: Settings that change the speed of a bake and not one bit of its maps.
WITHOUT_EFFECT = ("threads", "link_memory", "estimate")
#: Of a compressed RGBA float32 pixel: 8.7 measured on a page that is nearly full.
BYTES_PER_PIXEL = 9


def map_name(kind: str, page: int, frame: int) -> str:
    """``iim.p0.0001.exr``."""
    return f"{kind}.p{page}.{frame:04d}.exr"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A name beside ``path`` to write to; becomes ``path`` if the block succeeds, vanishes otherwise."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """``value`` at ``path``, whole or not at all."""
    with whole_file(path) as part:
        part.write_text(
            json.dumps(value, indent=1, allow_nan=False, default=_plain) + "\n",
            encoding="utf-8",
        )


def write_arrays(path: Path, arrays: Iterable[tuple[str, NDArray[Any]]]) -> None:
    """An ``.npz`` written one array at a time, so that no more than one need be in memory."""
    with (
        whole_file(path) as part,
        zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, allowZip64=True) as archive,
    ):
        for name, array in arrays:
            # A ZipInfo made from a name alone carries the date 1980-01-01: same arrays, same bytes.
            info = zipfile.ZipInfo(f"{name}.npy")
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as member:
                np.save(member, array, allow_pickle=False)


def digest(value: Any) -> str:
    """SHA-256 over plain values, arrays and dataclasses of them: equal if and only if the content is."""
    hasher = hashlib.sha256()
    _feed(hasher, value)
    return hasher.hexdigest()


def _feed(hasher: Any, value: Any) -> None:
    if is_dataclass(value) and not isinstance(value, type):
        _feed(hasher, {f.name: getattr(value, f.name) for f in fields(value)})
    elif isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        hasher.update(f"array {array.dtype.str} {array.shape};".encode())
        hasher.update(array.data)
    elif isinstance(value, Mapping):
        hasher.update(f"map {len(value)};".encode())
        for key, entry in value.items():
            _feed(hasher, key)
            _feed(hasher, entry)
    elif isinstance(value, tuple | list):
        hasher.update(f"list {len(value)};".encode())
        for entry in value:
            _feed(hasher, entry)
    elif isinstance(value, np.generic):
        _feed(hasher, value.item())
    elif value is None or isinstance(value, str | bytes | bool | int | float):
        text = repr(str(value) if isinstance(value, str) else value)
        hasher.update(f"{len(text)} {text};".encode())
    else:
        raise TypeError(f"{type(value).__name__}: no digest for this type")


def _plain(value: Any) -> Any:
    """JSON's view of NumPy scalars, arrays and paths."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__}: not for JSON")


def folder_problems(folder: Path, bytes_needed: int = 0) -> list[str]:
    """Why ``folder`` cannot take ``bytes_needed`` of files; found by writing an empty file, of which nothing stays."""
    parent = folder
    while not parent.exists() and parent != parent.parent:
        parent = parent.parent
    if not parent.is_dir():
        return [f"{parent}: is a file where --out {folder} needs a folder; give another folder"]
    probe = parent / f".probe.{os.getpid()}.part"
    try:
        probe.touch()
        probe.unlink()
    except OSError as fault:
        return [f"{folder}: cannot write here ({fault.strerror}); give a writable folder with --out"]
    free = shutil.disk_usage(parent).free
    if free < bytes_needed:
        has, needs = f"{free / 2**20:.0f} MiB free", f"about {bytes_needed / 2**20:.0f} MiB needed"
        return [f"{folder}: {has}, {needs}; free some space, or choose fewer frames or a lower --resolution"]
    return []


def map_bytes(*, frames: int, resolution: int, pages: int, kinds: int) -> int:
    """About what the maps of a bake take on disk."""
    return frames * pages * kinds * resolution * resolution * BYTES_PER_PIXEL


class FrameFailed(Exception):
    """A frame could not be made or written; those before it stay. ``problems`` are lines as in BakeError."""

    def __init__(self, *problems: str) -> None:
        self.problems = problems
        super().__init__("\n".join(problems))


#: The part of the input that tells where gather rays are aimed in every frame.
GUIDE = "range of frames, or what some of them show,"


class BakeFolder:
    """``bake.json`` and the maps it lists. ``header`` is all of bake.json but its frames and its status.

    ``header["fingerprint"]`` maps the name of a part of the input to its digest, in an artist's words: these names
    are what a user reads when a bake cannot be resumed.
    """

    def __init__(self, path: Path, header: dict[str, Any], *, resume: bool = False) -> None:
        old = read_record(path) if resume else None
        if old is not None and (problems := differences(old, header)):
            raise BakeError(
                *(
                    f"{path / 'bake.json'}: cannot resume, {problem}; "
                    "bake with what it was made with, or leave out --resume to bake anew"
                    for problem in problems
                )
            )
        self.path = path
        self.record: dict[str, Any] = {**header, "status": "running", "frames": {}}
        self._finished: dict[str, Any] = {} if old is None else old["frames"]
        path.mkdir(parents=True, exist_ok=True)
        for part in path.iterdir():
            if PART.fullmatch(part.name):
                part.unlink()
        self._save()

    def finished_or_none(self, frame: int, state: str) -> dict[str, Any] | None:
        """The earlier run's record of ``frame``, if made from the same ``state`` and its files are all there."""
        record = self._finished.get(str(frame))
        if record is None or record["state"] != state:
            return None
        sizes_on_disk = {name: _size_or_none(self.path / name) for name in record["files"]}
        return record if sizes_on_disk == record["files"] else None

    def commit(self, frame: int, record: dict[str, Any]) -> dict[str, Any]:
        """Note ``frame`` as finished, its files being in place; ``record`` completed by their sizes."""
        sizes = {name: (self.path / name).stat().st_size for name in record["files"]}
        self.record["frames"][str(frame)] = {**record, "files": sizes}
        self._save()
        return dict(self.record["frames"][str(frame)])

    def close(self, status: str) -> None:
        """``status``: done, cancelled or failed."""
        self.record["status"] = status
        self._save()

    def _save(self) -> None:
        # Frames of the earlier run not reached yet stay listed: a second interruption must not lose them.
        frames = {**self._finished, **self.record["frames"]}
        ordered = {key: frames[key] for key in sorted(frames, key=int)}
        write_json(self.path / "bake.json", {**self.record, "frames": ordered})


def read_record(path: Path, remedy: str = "delete it, or leave out --resume") -> dict[str, Any] | None:
    """The ``bake.json`` in ``path``; None if there is none yet. ``remedy`` is told where it is not one."""
    file = path / "bake.json"
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as fault:
        raise BakeError(f"{file}: cannot be read ({fault}); {remedy}") from fault
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise BakeError(f"{file}: not written by this version of RTGI; {remedy}")
    return record


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Each way in which the bake that wrote ``old`` is not the bake that ``new`` describes."""
    first = ("first frame", old.get("first_frame"), new.get("first_frame"))
    if first[1] != first[2]:  # everything that moves differs then, too
        return ["{} was {}, is {} now".format(*first)]
    parts = [name for name, _, _ in _changed(old["fingerprint"], new["fingerprint"])]
    return (
        [f"{name} was {then}, is {now} now" for name, then, now in _changed(old["settings"], new["settings"])]
        + [f"{name} was {then}, is {now} now" for name, then, now in _changed(old["versions"], new["versions"])]
        # What the frames show differs with any other part, too: that says more.
        + [f"the {name} changed" for name in parts if name != GUIDE or len(parts) == 1]
    )


def _changed(old: dict[str, Any], new: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    for name in dict.fromkeys((*old, *new)):
        if name not in WITHOUT_EFFECT and old.get(name) != new.get(name):
            yield name, old.get(name), new.get(name)


def _size_or_none(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None
