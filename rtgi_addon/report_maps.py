# SPDX-License-Identifier: GPL-3.0-or-later
"""The maps of a report as rows of pictures, one column a frame, with the scales their colours follow.

How many are shown is bounded, so that the page of a long bake is no larger than that of a short one. No bpy here.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from .report_charts import brief, scale_of
from .report_figures import whole
from .report_pictures import change_colours, develop

#: Of one report: columns, pages, and pictures altogether.
FRAMES, PAGES, PICTURES = 8, 12, 96


@dataclass(frozen=True)
class Tile:
    """One picture; no ``uri``: there is nothing to show, and ``note`` says why."""

    frame: int
    uri: str | None
    title: str
    note: str = ""


@dataclass(frozen=True)
class Row:
    name: str
    what: str
    tiles: tuple[Tile, ...]  # of the frames shown


@dataclass(frozen=True)
class Sheet:
    """All pictures of a report."""

    frames: tuple[int, ...]  # shown
    frame_count: int  # baked
    pages: tuple[tuple[Row, ...], ...]  # shown
    page_count: int  # baked
    block: int  # texels a side of a picture's pixel
    exposed: float  # per W/m²
    change: float  # W/m² at the end of the scale of change


def spread(count: int, room: int) -> list[int]:
    """Up to ``room`` of ``count`` indices, evenly, the first and the last among them."""
    if count <= room:
        return list(range(count))
    return [round(i * (count - 1) / (room - 1)) for i in range(room)] if room > 1 else [0]


def columns(pages: int, rows: int) -> int:
    """Frames that may be shown of so many pages, each with so many rows."""
    return max(2, min(FRAMES, PICTURES // (min(pages, PAGES) * rows)))


def strips(sheet: Sheet) -> str:
    """The section of maps."""
    parts = ["<h2>Maps</h2>", f"<p>{escape(' '.join(_words(sheet)))}</p>", _scales(sheet)]
    for number, rows in enumerate(sheet.pages):
        if sheet.page_count > 1:
            parts.append(f"<h3>Page {number}</h3>")
        parts.append(_strip(number, rows, sheet.frames))
    return "\n".join(parts)


def _words(sheet: Sheet) -> list[str]:
    """What of the maps is shown, and how."""
    words = []
    if len(sheet.frames) < sheet.frame_count:
        words.append(f"{len(sheet.frames)} of {sheet.frame_count} frames, evenly chosen.")
    if len(sheet.pages) < sheet.page_count:
        words.append(f"The first {len(sheet.pages)} of {sheet.page_count} pages.")
    if sheet.block > 1:
        words.append(f"A pixel here is the mean of {sheet.block} × {sheet.block} texels.")
    steps = "; the arrow keys then step through the frames" if len(sheet.frames) > 1 else ""
    return [*words, f"All have the same exposure. Click one to see it large{steps}."]


def _strip(page: int, rows: tuple[Row, ...], frames: tuple[int, ...]) -> str:
    grid = f"grid-template-columns: 96px repeat({len(frames)}, minmax(76px, 256px))"
    cells = ["<div></div>", *(f'<div class="head">{frame}</div>' for frame in frames)]
    for row in rows:
        cells.append(f'<div class="name">{escape(row.name)}<br><span class="soft">{escape(row.what)}</span></div>')
        cells += [_tile(f"{page} {row.name}", tile) for tile in row.tiles]
    return f'<div class="strip" style="{grid}">{"".join(cells)}</div>'


def _tile(row: str, tile: Tile) -> str:
    note = f'<div class="note">{escape(tile.note)}</div>' if tile.note else ""
    if tile.uri is None:
        return f"<div>{note}</div>"
    title = escape(tile.title)
    picture = f'<img src="{tile.uri}" alt="{title}">'
    return f'<div><button class="tile" data-row="{escape(row)}" title="{title}">{picture}</button>{note}</div>'


def _scales(sheet: Sheet) -> str:
    """The colour scales as pictures."""
    ramps = []
    if sheet.exposed:
        top, step = scale_of(2 / sheet.exposed)  # exp(-2): 14 % below white
        greys = develop(np.linspace(0, top, 33), sheet.exposed)
        stops = np.concatenate([np.repeat(greys[:, None], 3, axis=1), np.ones((33, 1))], axis=1)
        ticks = [(i * step / top, brief(i * step)) for i in range(round(top / step) + 1)]
        ramps.append(_ramp("light", "Irradiance of each colour channel, W/m²", stops, ticks))
    if sheet.change:
        # Even steps of colour; the numbers beside them grow as the square.
        place = np.linspace(-1, 1, 33)[:, None]
        stops = change_colours(np.sign(place) * place**2 * sheet.change, sheet.change)
        end, part = (f"{sheet.change * share:.2g}" for share in (1, 0.25))
        ticks = [(0.0, f"≤ −{end}"), (0.25, f"−{part}"), (0.5, "0"), (0.75, f"+{part}"), (1.0, f"≥ +{end}")]
        ramps.append(_ramp("change", "Change of the IIM's luminance since the frame before, W/m²", stops, ticks))
    return f'<div class="ramps">{"".join(ramps)}</div>'


def _ramp(name: str, title: str, colours: np.ndarray, ticks: list[tuple[float, str]]) -> str:
    """``colours`` (n, 4) in [0, 1] from left to right, with ``ticks`` at shares of the width."""
    last = len(colours) - 1
    stops = "".join(
        f'<stop offset="{i / last:.4f}" stop-color="rgb({r:.0f} {g:.0f} {b:.0f})" stop-opacity="{a:.3f}"/>'
        for i, (r, g, b, a) in enumerate(colours * (255, 255, 255, 1))
    )
    anchors = {0.0: "start", 1.0: "end"}
    texts = "".join(
        f'<text x="{400 * at:.1f}" y="30" text-anchor="{anchors.get(round(at, 6), "middle")}">{escape(text)}</text>'
        for at, text in ticks
    )
    return (
        f'<figure><figcaption>{escape(title)}</figcaption><svg viewBox="0 0 400 34" role="img"'
        f' aria-label="{escape(title)}"><linearGradient id="{name}">{stops}</linearGradient>'
        f'<rect width="400" height="14" rx="2" class="ramp" fill="url(#{name})"/>{texts}</svg></figure>'
    )


def change_note(share: float, largest: float) -> str:
    """In words how much a page differs from the frame before."""
    if share == 0:
        return "no change"
    return f"{'< 1' if share < 0.01 else whole(100 * share)} % of texels, up to {largest:.2g}"
