# SPDX-License-Identifier: GPL-3.0-or-later
"""The arguments of ``rtgi bake``, ``render`` and ``report``, the same for ``blender --command`` and ``python -m``.

Options of a bake are made from the ``BakeSettings`` table, so that names, ranges and defaults have one owner.
No bpy here, and nothing is done here: text in, plain values or a :class:`BakeError` out.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from dataclasses import Field, fields
from enum import EnumType
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

from .backend.errors import BakeError
from .backend.settings import BakeSettings, Selection

#: Blender's own last frame (MAXFRAME).
LAST_FRAME = 1_048_574
#: Two of one group at once would contradict each other.
EXCLUSIVE = {
    "resolution": "size",
    "density": "size",
    "quality": "effort",
    "target_error": "effort",
    "selection": "selection",
}

_FRAMES = re.compile(r"(-?\d+)(?:-(-?\d+)(?::(-?\d+))?)?")
_SIZE = re.compile(r"(\d+)x(\d+)")


class _Parser(argparse.ArgumentParser):
    """Raises instead of leaving the process, so that a usage error is one line like any other bad input."""

    def error(self, message: str) -> NoReturn:
        raise BakeError(f"{self.prog}: {message}; {self.prog} --help lists what there is")


def make_parser() -> argparse.ArgumentParser:
    """The parser of the whole command; ``command`` is bake, render or report."""
    parser = _Parser(
        prog="rtgi",
        description="Bake animated global illumination into light maps.",
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="bake|render|report")
    _add_bake(commands)
    _add_render(commands)
    _add_report(commands)
    return parser


def _add_bake(commands: Any) -> None:
    bake = commands.add_parser("bake", help="write the light maps of a .blend", allow_abbrev=False)
    _add_common(bake, "folder for the maps; default: SCENE_rtgi beside the .blend")
    bake.add_argument(
        "--resume",
        action="store_true",
        help="keep the finished frames of an interrupted bake",
    )
    bake.add_argument(
        "--texels",
        action="store_true",
        help="also write texels.npz: place, normal, area of every texel",
    )
    bake.add_argument(
        "--save-blend",
        metavar="FILE",
        help="also save a copy of the scene that shows the maps",
    )
    settings = bake.add_argument_group("settings")
    groups = {name: settings.add_mutually_exclusive_group() for name in dict.fromkeys(EXCLUSIVE.values())}
    hints = get_type_hints(BakeSettings)
    for f in fields(BakeSettings):
        _add_setting(
            groups[EXCLUSIVE[f.name]] if f.name in EXCLUSIVE else settings,
            f,
            hints[f.name],
        )
    groups["selection"].add_argument(
        "--no-selective",
        dest="selection",
        action="store_const",
        const=Selection.OFF,
        help="every frame from scratch: --selection off",
    )


def _add_render(commands: Any) -> None:
    render = commands.add_parser("render", help="draw Eevee frames with the maps applied", allow_abbrev=False)
    _add_common(render, "folder for the pictures; default: preview in the folder of the maps")
    render.add_argument("--maps", metavar="DIR", required=True, help="folder that rtgi bake wrote")
    render.add_argument(
        "--resolution",
        metavar="WxH",
        help="picture size in pixels; default: the scene's own",
    )
    render.add_argument(
        "--samples",
        metavar="N",
        type=int,
        help="Eevee samples per pixel; default: the scene's own",
    )


def _add_report(commands: Any) -> None:
    report = commands.add_parser("report", help="write a page of plots and pictures of a bake", allow_abbrev=False)
    report.add_argument("maps", metavar="DIR", help="folder that rtgi bake wrote")
    report.add_argument("--out", metavar="FILE", help="the HTML file; default: report.html in the folder of the maps")
    _add_json(report)


def _add_common(parser: argparse.ArgumentParser, out_help: str) -> None:
    parser.add_argument("scene", nargs="?", metavar="SCENE.blend", help="default: the file that is open")
    parser.add_argument(
        "--frames",
        metavar="A[-B[:STEP]]",
        help="default: the scene's range, one frame if it is static",
    )
    parser.add_argument("--out", metavar="DIR", help=out_help)
    _add_json(parser)


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--json",
        action="store_true",
        help="one JSON line per step on stdout, nothing else there",
    )


def _add_setting(group: Any, f: Field[Any], hint: Any) -> None:
    """One option for one field; ranges are left to :func:`settings_of`, which reports all at once."""
    help_text, flag = f.metadata["help"].replace("%", "%%"), f.name.replace("_", "-")
    if hint is bool and f.default:
        group.add_argument(
            f"--no-{flag}",
            dest=f.name,
            action="store_false",
            help=f"without: {help_text}",
        )
    elif hint is bool:
        group.add_argument(f"--{flag}", dest=f.name, action="store_true", help=help_text)
    elif choices := _choices(hint):
        what = f"{help_text}; default: {f.default.value}"
        group.add_argument(
            f"--{flag}",
            default=f.default,
            choices=choices,
            metavar="|".join(choices),
            help=what,
        )
    else:
        what = help_text if f.default is None else f"{help_text}; default: {f.default}"
        number, metavar = (int, "N") if hint is int else (float, "X")
        group.add_argument(f"--{flag}", type=number, default=f.default, metavar=metavar, help=what)


def _choices(hint: Any) -> list[str]:
    """The words an enumerated setting takes; none for numbers."""
    return list(map(str, hint.__members__.values())) if isinstance(hint, EnumType) else []


def settings_of(arguments: argparse.Namespace) -> BakeSettings:
    """The settings that the parsed arguments ask for; every value out of its range is one problem line."""
    problems = []
    for f in fields(BakeSettings):
        value, low, high = getattr(arguments, f.name), f.metadata["low"], f.metadata["high"]
        if value is not None and low is not None and not low <= value <= high:
            problems.append(f"--{f.name.replace('_', '-')} {value}: out of range; give a value in [{low}, {high}]")
    if problems:
        raise BakeError(*problems)
    return typed_settings(vars(arguments))


def typed_settings(values: Mapping[str, Any]) -> BakeSettings:
    """Settings from ``values`` by field name, words for the enumerated ones; other keys are ignored."""
    try:
        return BakeSettings(**{f.name: values[f.name] for f in fields(BakeSettings)})
    except ValueError as fault:  # each is in its range, but not all go together
        raise BakeError(str(fault)) from None


def frames_of(text: str | None) -> Sequence[int] | None:
    """The frames that ``A``, ``A-B`` or ``A-B:STEP`` names, ascending; None stays None."""
    if text is None:
        return None
    match = _FRAMES.fullmatch(text.strip())
    if match is None:
        raise BakeError(f"--frames {text}: not a range; write it as 12, 1-24 or 1-24:2")
    first, last, step = (int(group) if group else None for group in match.groups())
    assert first is not None
    last, step = first if last is None else last, 1 if step is None else step
    if first < 0 or last < 0:
        raise BakeError(f"--frames {text}: negative frames have no file name; move the animation to frame 0 or later")
    if last > LAST_FRAME:
        raise BakeError(f"--frames {text}: Blender's last frame is {LAST_FRAME}; give a lower one")
    if last < first or step < 1:
        raise BakeError(f"--frames {text}: holds no frame; write the lower number first and a step of 1 or more")
    return range(first, last + 1, step)


def size_of(text: str | None) -> tuple[int, int] | None:
    """(width, height) in pixels of ``WxH``; None stays None."""
    if text is None:
        return None
    match = _SIZE.fullmatch(text.strip().lower())
    if match is None or not all(4 <= int(side) <= 16384 for side in match.groups()):
        raise BakeError(f"--resolution {text}: not a picture size; write it as 1280x720, sides from 4 to 16384")
    return int(match[1]), int(match[2])


def path_of(text: str | None) -> Path | None:
    """An absolute path from the shell's own folder; None stays None."""
    return None if text is None else Path(text).expanduser().absolute()
