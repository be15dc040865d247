# SPDX-License-Identifier: GPL-3.0-or-later
"""One page about a baked folder, for looking at: :func:`report`. The counterpart of ``bake`` for ``rtgi report``.

Maps are read by Blender's own EXR code; nothing of the open scene is touched and nothing but the page is written.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .backend.errors import BakeError
from .backend.scene import Bool, Float32
from .exr import read_page
from .output import FrameFailed, folder_problems, map_name, whole_file
from .report_maps import PAGES, Row, Sheet, Tile, change_note, columns, spread
from .report_page import make_page
from .report_pictures import (
    Small,
    block_side,
    change_uri,
    exposure,
    largest_change,
    luminance,
    map_uri,
    shrink,
)
from .report_record import BakedFrame, BakeRecord, read_bake
from .terminal import Listener

NAME = "report.html"
#: Kinds of maps in the order of their rows, and what each holds.
KINDS = {
    "iim": ("IIM", "bounced, sky, emissive"),
    "aim": ("AIM", "all light"),
    "caustics": ("Caustics", "by mirrors, glass"),
}


@dataclass(frozen=True)
class ReportSummary:
    """What was written."""

    out: Path
    frames: int
    thumbnails: int
    bytes: int
    seconds: float

    def in_words(self) -> list[str]:
        return [f"{self.out}: {self.frames} frame{'s' * (self.frames != 1)}, {self.bytes / 2**20:.1f} MiB"]


def report(folder: Path, out: Path | None = None, listener: Listener | None = None) -> ReportSummary:
    """Write the page of the bake in ``folder`` to ``out``; None: report.html in it.

    Raises BakeError before anything is written, FrameFailed where it cannot be written, or Cancelled.
    """
    listener = Listener() if listener is None else listener
    start = time.perf_counter()
    out = folder / NAME if out is None else out
    baked = read_bake(folder)
    if problems := [f"{out}: is a folder; name a file"] if out.is_dir() else folder_problems(out.parent):
        raise BakeError(*problems)
    sheet = _sheet(baked, listener) if baked.frames else None
    page = make_page(baked, sheet).encode()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(out) as part:
            part.write_bytes(page)
    except OSError as fault:
        raise FrameFailed(
            f"{out}: cannot be written ({fault.strerror}); free some space or choose another --out"
        ) from fault
    thumbnails = (
        0 if sheet is None else sum(bool(tile.uri) for rows in sheet.pages for row in rows for tile in row.tiles)
    )
    return ReportSummary(out, len(baked.frames), thumbnails, len(page), time.perf_counter() - start)


@dataclass(frozen=True)
class _Change:
    """One page of the IIM against that of the frame before."""

    before: int  # the frame
    small: Small
    share: float  # of the texels valid in both that differ at all
    largest: float  # W/m², of luminance


@dataclass(frozen=True)
class _Shown:
    """What is drawn of one page at one frame."""

    maps: dict[str, Small] = field(default_factory=dict)  # by kind
    change: _Change | None = None  # None: no frame before


def _sheet(baked: BakeRecord, listener: Listener) -> Sheet:
    """All pictures of ``baked``, exposed alike."""
    kinds = [kind for kind in KINDS if any(map_name(kind, 0, frame.number) in frame.files for frame in baked.frames)]
    pages = range(min(baked.pages, PAGES))
    chosen = spread(len(baked.frames), columns(baked.pages, len(kinds) + 1))
    total, shown = len(pages) * len(chosen), []
    for page in pages:
        for index in chosen:
            listener.report("maps", len(shown), total)
            shown.append(_look(baked, page, index, kinds))
    listener.report("maps", total, total)
    exposed = exposure([look.maps["iim"] for look in shown if "iim" in look.maps])
    scale = largest_change([look.change.small for look in shown if look.change is not None])
    frames = [baked.frames[index] for index in chosen]
    looks = [shown[i * len(chosen) : (i + 1) * len(chosen)] for i in range(len(pages))]
    return Sheet(
        frames=tuple(frame.number for frame in frames),
        frame_count=len(baked.frames),
        pages=tuple(tuple(_rows(p, frames, looks[p], kinds, exposed, scale)) for p in pages),
        page_count=baked.pages,
        block=block_side(baked.resolution, baked.resolution),
        exposed=exposed,
        change=scale,
    )


def _look(baked: BakeRecord, page: int, index: int, kinds: list[str]) -> _Shown:
    """Page ``page`` of the frame at ``index``, and how its IIM changed since the frame before."""
    frame = baked.frames[index]
    maps, change = {}, None
    for kind in kinds:
        name = map_name(kind, page, frame.number)
        if name not in frame.files:
            continue
        rgb, valid = _read(baked, name)
        maps[kind] = shrink(rgb, valid)
        if kind == "iim" and index > 0:
            change = _change(baked, page, baked.frames[index - 1], rgb, valid)
    return _Shown(maps, change)


def _read(baked: BakeRecord, name: str) -> tuple[Float32, Bool]:
    rgb, valid = read_page(baked.folder / name)
    if valid.shape != (baked.resolution, baked.resolution):
        size = "{1} × {0}".format(*valid.shape)
        raise BakeError(f"{baked.folder / name}: is {size} pixels, not as bake.json has it; bake that frame again")
    return rgb, valid


def _change(baked: BakeRecord, page: int, before: BakedFrame, rgb: Float32, valid: Bool) -> _Change | None:
    name = map_name("iim", page, before.number)
    if name not in before.files:
        return None
    old, old_valid = _read(baked, name)
    valid = valid & old_valid
    differs = valid & np.any(rgb != old, axis=-1)
    change = luminance(rgb - old)
    return _Change(
        before=before.number,
        small=shrink(change, valid),
        share=float(differs.sum() / max(valid.sum(), 1)),
        largest=float(np.abs(change[valid]).max(initial=0)),
    )


def _rows(
    page: int, frames: list[BakedFrame], looks: list[_Shown], kinds: list[str], exposed: float, scale: float
) -> Iterator[Row]:
    """The rows of one page; change stands under what changed."""
    for kind in kinds:
        tiles = []
        for frame, look in zip(frames, looks, strict=True):
            small, name = look.maps.get(kind), map_name(kind, page, frame.number)
            uri = None if small is None else map_uri(small, exposed)
            tiles.append(Tile(frame.number, uri, name, "" if uri else "none"))
        yield Row(*KINDS[kind], tuple(tiles))
        if kind == "iim" and len(frames) > 1:
            changes = tuple(_change_tile(frame, look.change, scale) for frame, look in zip(frames, looks, strict=True))
            yield Row("Change", "of the IIM, W/m²", changes)


def _change_tile(frame: BakedFrame, change: _Change | None, scale: float) -> Tile:
    if change is None:
        return Tile(frame.number, None, "", "nothing before")
    title = f"IIM of frame {frame.number} less that of frame {change.before}"
    return Tile(frame.number, change_uri(change.small, scale), title, change_note(change.share, change.largest))
