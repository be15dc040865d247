# SPDX-License-Identifier: GPL-3.0-or-later
"""``bake.json`` as a report reads it: checked once, typed, and no map left out that it lists.

Counts are taken as they are named, so that bakes of older versions, which count less, are read as well. No bpy here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .backend.errors import BakeError
from .output import read_record

#: So many missing maps are named one by one.
NAMED = 3


@dataclass(frozen=True)
class BakedFrame:
    """What a frame cost, counted and left behind."""

    number: int
    seconds: dict[str, float]  # by stage
    counts: dict[str, int]  # every whole number that the frame's record holds, by name
    error: float | None  # relative RMS error of the IIM
    warnings: tuple[str, ...]
    files: dict[str, int]  # bytes by name

    @property
    def total_seconds(self) -> float:
        return sum(self.seconds.values())


@dataclass(frozen=True)
class BakeRecord:
    """All of a bake that a report tells."""

    folder: Path
    status: str
    versions: dict[str, str]
    device: dict[str, Any]
    settings: dict[str, Any]
    frames_asked: tuple[int, ...]
    resolution: int  # side of a page in pixels
    pages: int
    object_count: int
    setup_seconds: dict[str, float]  # by stage, before the first frame
    warnings: tuple[str, ...]
    frames: tuple[BakedFrame, ...]  # ascending


def read_bake(folder: Path) -> BakeRecord:
    """The bake in ``folder``; a BakeError where there is none or it is not whole."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise BakeError(f"{folder}: {what}; name a folder that rtgi bake wrote")
    record = read_record(folder, remedy="bake the scene again")
    if record is None:
        raise BakeError(f"{folder}: holds no bake.json; bake a scene there first, with rtgi bake --out")
    try:
        baked = _parse(folder, record)
    except (AttributeError, KeyError, TypeError, ValueError) as fault:
        reason = f"{type(fault).__name__}: {fault}"
        raise BakeError(f"{folder / 'bake.json'}: is not whole ({reason}); bake the scene again") from fault
    _require_maps(baked)
    return baked


def _parse(folder: Path, record: dict[str, Any]) -> BakeRecord:
    return BakeRecord(
        folder=folder,
        status=str(record["status"]),
        versions={str(k): str(v) for k, v in record["versions"].items()},
        device=dict(record["device"]),
        settings=dict(record["settings"]),
        frames_asked=tuple(map(int, record["frames_asked"])),
        resolution=int(record["atlas"]["resolution"]),
        pages=int(record["atlas"]["pages"]),
        object_count=len({entry["name"] for entry in record["atlas"]["objects"]}),
        setup_seconds=_seconds(record["setup_seconds"]),
        warnings=tuple(map(str, record["warnings"])),
        frames=tuple(_parse_frame(int(key), frame) for key, frame in sorted(record["frames"].items(), key=_number)),
    )


def _number(entry: tuple[str, Any]) -> int:
    return int(entry[0])


def _parse_frame(number: int, frame: dict[str, Any]) -> BakedFrame:
    error = frame["estimated_error"]
    return BakedFrame(
        number=number,
        seconds=_seconds(frame["seconds"]),
        counts={k: v for k, v in frame.items() if isinstance(v, int) and not isinstance(v, bool)},
        error=None if error is None else _finite(error),
        warnings=tuple(map(str, frame["warnings"])),
        files={str(k): int(v) for k, v in frame["files"].items()},
    )


def _seconds(stages: dict[str, Any]) -> dict[str, float]:
    return {str(name): _finite(value) for name, value in stages.items()}


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} is no number to draw")
    return number


def _require_maps(baked: BakeRecord) -> None:
    """Every map that is listed is there in its full size."""
    listed = [(name, size) for frame in baked.frames for name, size in frame.files.items()]
    problems = []
    for name, size in listed:
        path = baked.folder / name
        if not path.is_file():
            problems.append(f"{path}: is missing; go on with rtgi bake --resume, which bakes that frame again")
        elif path.stat().st_size != size:
            problems.append(f"{path}: is not the file that was baked; go on with rtgi bake --resume")
    if len(problems) > NAMED:
        more = f"{baked.folder}: {len(problems) - NAMED} more maps are missing or changed, of {len(listed)}"
        problems[NAMED:] = [f"{more}; go on with rtgi bake --resume, or bake anew"]
    if problems:
        raise BakeError(*problems)
