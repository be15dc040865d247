# SPDX-License-Identifier: GPL-3.0-or-later
"""docs/benchmarks.md is made of parts, each written by its own run: the others stay as they are."""

from __future__ import annotations

import platform
import re
from pathlib import Path

from .results import Machine

#: In the document's order.
PARTS = ("speed", "frames", "scaling", "larsen", "gpu")
PLOTS = "benchmarks"
_TITLE = "# Benchmarks\n\nWritten by `python -m bench`, each part in one run; `--only` runs some of them.\n"


def write_part(docs: Path, name: str, text: str) -> None:
    """Put ``text`` in place of the part ``name`` of ``docs``/benchmarks.md."""
    if name not in PARTS:
        raise ValueError(f"{name}: not one of {', '.join(PARTS)}")
    path = docs / "benchmarks.md"
    docs.mkdir(parents=True, exist_ok=True)
    parts = read_parts(path.read_text(encoding="utf-8")) if path.exists() else {}
    parts[name] = text.strip()
    body = [f"<!-- part: {key} -->\n{parts[key]}\n" for key in PARTS if key in parts]
    path.write_text("\n".join([_TITLE, *body]), encoding="utf-8")


def read_parts(text: str) -> dict[str, str]:
    """The parts of a document by name."""
    pieces = re.split(r"^<!-- part: (\w+) -->$", text, flags=re.MULTILINE)
    return {name: body.strip() for name, body in zip(pieces[1::2], pieces[2::2], strict=True)}


def machine_lines(machine: Machine, gpu: str = "no GPU used") -> str:
    """Two items of a list: what a part was measured on and with; ``gpu``: which one, in words."""
    versions = ", ".join(f"{name} {version}" for name, version in machine.versions.items())
    return (
        f"- **Machine:** {machine.processor}, {machine.threads} threads, {gpu}, {platform.system()}.\n"
        f"- **Versions:** {versions}."
    )
