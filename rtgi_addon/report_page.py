# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of a report, from a bake's record and the pictures of its maps: values in, the text of one HTML file out.

Everything is inline and nothing is fetched; report_page.html holds type, colours and a little script. No bpy here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from statistics import median
from string import Template
from typing import Any

from .backend.settings import BakeSettings
from .report_charts import CUT
from .report_figures import charts, duration, percent, whole
from .report_maps import Sheet, strips
from .report_record import BakeRecord

TEMPLATE = Path(__file__).with_name("report_page.html")
#: What to say of a bake that is not done.
ENDED = {
    "cancelled": "The bake was cancelled; rtgi bake --resume goes on.",
    "failed": "The bake failed; rtgi bake --resume goes on.",
    "running": "The bake is still running, or was killed; rtgi bake --resume goes on.",
}
PACKAGES = {"rtgi": "RTGI", "blender": "Blender", "python": "Python"}


def make_page(baked: BakeRecord, sheet: Sheet | None) -> str:
    """The whole page; without ``sheet`` no frame is finished, and there is nothing to draw."""
    parts = [_head(baked), _warnings(baked)]
    if sheet is not None:
        parts += [charts(baked), strips(sheet)]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=escape(f"{baked.folder.name}: light maps"),
        version=escape(baked.versions.get("rtgi", "")),
        frames=" ".join(str(frame.number) for frame in baked.frames),
        body="\n".join(parts),
    )


def name_frames(numbers: Sequence[int]) -> str:
    """Ascending frame numbers in words: 7; 1–24; 1–23 in steps of 2; 1–3, 7."""
    steps = {b - a for a, b in zip(numbers, numbers[1:], strict=False)}
    if len(numbers) > 2 and len(steps) == 1 and steps != {1}:
        return f"{numbers[0]}–{numbers[-1]} in steps of {steps.pop()}"
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(first) if first == last else f"{first}–{last}" for first, last in runs)


def _head(baked: BakeRecord) -> str:
    facts = {name: text for name, text in _facts(baked).items() if text}
    listed = "".join(f"<dt>{escape(name)}</dt><dd>{text}</dd>" for name, text in facts.items())
    ended = "" if baked.status == "done" else f' <span class="alarm">{escape(_ended(baked))}</span>'
    return (
        f"<header><h1>{escape(baked.folder.name)}</h1>"
        f'<p class="lead">{escape(_summary(baked))}{ended}</p><dl>{listed}</dl></header>'
    )


def _ended(baked: BakeRecord) -> str:
    return ENDED.get(baked.status, f"The bake ended as: {baked.status}.")


def _summary(baked: BakeRecord) -> str:
    """The bake in one or two sentences."""
    done, asked = len(baked.frames), len({*baked.frames_asked, *(frame.number for frame in baked.frames)})
    count = f"{done} frame{'s' * (done != 1)}" if done == asked else f"{done} of {asked} frames"
    if not done:
        return f"No frame is finished, of {asked} asked for."
    seconds = [frame.total_seconds for frame in baked.frames]
    usual = duration(median(seconds))
    if seconds[0] > CUT * median(seconds):
        text = f"{count}: the first in {duration(seconds[0])}, then {usual} each"
    else:
        text = f"{count}, {usual}{' each' if done > 1 else ''}"
    errors = sorted(frame.error for frame in baked.frames if frame.error is not None)
    return f"{text}; estimated error {_range(errors)}." if errors else f"{text}."


def _range(ascending: Sequence[float]) -> str:
    low, high = percent(ascending[0]), percent(ascending[-1])
    return low if low == high else f"{low} to {high}"


def _facts(baked: BakeRecord) -> dict[str, str]:
    """HTML by name."""
    setup = sorted(baked.setup_seconds.items(), key=lambda stage: -stage[1])
    stages = ", ".join(f"{name} {duration(seconds)}" for name, seconds in setup if seconds >= 0.05)
    before, frames = sum(baked.setup_seconds.values()), sum(frame.total_seconds for frame in baked.frames)
    machine = [str(baked.device.get("name", "")), f"{baked.device.get('threads', '?')} threads"]
    names = [f"{PACKAGES.get(name, name)} {version}" for name, version in baked.versions.items()]
    return {
        "Frames": escape(name_frames([frame.number for frame in baked.frames])),
        "Time": escape(f"{duration(frames)} for frames; {duration(before)} before" + f" ({stages})" * bool(stages)),
        "Maps": escape(_maps(baked)),
        "Settings": _settings(baked.settings),
        "Warnings": "" if _warnings(baked) else "none",
        "Machine": escape(", ".join([*machine, str(baked.device.get("system", ""))])),
        "Versions": escape(", ".join(names)),
    }


def _maps(baked: BakeRecord) -> str:
    pages = f"{baked.pages} page{'s' * (baked.pages != 1)} of {baked.resolution} × {baked.resolution}"
    objects = f"{baked.object_count} object{'s' * (baked.object_count != 1)}"
    if not baked.frames:
        return f"{pages}, {objects}"
    counts = baked.frames[-1].counts
    texels = whole(counts.get("texels_updated", 0) + counts.get("texels_kept", 0))
    size = sum(sum(frame.files.values()) for frame in baked.frames) / 2**20
    return f"{pages}, {objects}, {texels} texels; {size:.3g} MiB on disk"


def _settings(settings: dict[str, Any]) -> str:
    """What was chosen, and the rest on a click."""
    usual = {f.name: f.default for f in fields(BakeSettings)}
    chosen = {k: v for k, v in settings.items() if k not in usual or v != usual[k]}
    first = ", ".join(_setting(*item) for item in chosen.items())
    rest = ", ".join(_setting(*item) for item in settings.items() if item[0] not in chosen)
    if not rest:
        return escape(first)
    others = "the others, as by default" if first else "all as by default"
    return f"{escape(first)}<details><summary>{others}</summary>{escape(rest)}</details>"


def _setting(name: str, value: Any) -> str:
    words = {None: "none", True: "on", False: "off"}
    # 0 == False: only true words are looked up.
    told = words[value] if value is None or isinstance(value, bool) else str(value)
    return f"{name.replace('_', ' ')} {told}"


def _warnings(baked: BakeRecord) -> str:
    """Each text once, with its frames; nothing where there is none."""
    said: dict[str, list[int]] = {text: [] for text in baked.warnings}
    for frame in baked.frames:
        for text in frame.warnings:
            said.setdefault(text, []).append(frame.number)
    if not said:
        return ""
    lines = [
        f"<li>{escape(text)}" + (f' <span class="soft">({_frames_told(numbers)})</span>' if numbers else "") + "</li>"
        for text, numbers in said.items()
    ]
    return f'<h2>Warnings</h2><ul class="warnings">{"".join(lines)}</ul>'


def _frames_told(numbers: Sequence[int]) -> str:
    return f"frame{'s' * (len(numbers) > 1)} {name_frames(numbers)}"
