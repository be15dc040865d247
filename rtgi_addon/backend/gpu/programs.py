# SPDX-License-Identifier: GPL-3.0-or-later
"""Shaders by name: a file of ``rtgi_addon/shaders/``, its includes and defines, compiled once a context.

A file holds one pass. ``#version`` is its first line; ``#include "inc/NAME.glsl"`` works at any depth, each file once;
a pass that needs a number asks for it by ``#ifndef NAME`` / ``#error``. A pass that draws has its stages in one file,
between ``#if defined VERTEX_SHADER`` and ``#if defined FRAGMENT_SHADER``. Reading needs no OpenGL.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .context import Gpu, GpuFailed

SHADERS = Path(__file__).resolve().parents[2] / "shaders"

Value = int | float | bool
_INCLUDE = re.compile(r'^\s*#include\s+"([\w./]+)"\s*$')
_VERSION = re.compile(r"^#version \d+( core)?\s*$")


def draw_program(gpu: Gpu, name: str, *, outputs: Sequence[str] = (), **defines: Value) -> Any:
    """The pass ``name`` as a moderngl.Program; ``outputs``: what its vertex stage writes to a buffer, drawing nothing.

    Raises GpuFailed when the driver refuses it.
    """
    return _compiled(gpu, name, tuple(outputs), defines, compute=False)


def compute_program(gpu: Gpu, name: str, **defines: Value) -> Any:
    """The pass ``name`` as a moderngl.ComputeShader. Raises GpuFailed when the driver refuses it."""
    return _compiled(gpu, name, (), defines, compute=True)


def source(name: str, defines: Mapping[str, Value]) -> str:
    """The text of ``shaders/NAME.glsl`` with its includes, after the ``defines``.

    Lines keep their numbers: ``#line N F`` counts within file F, numbered in the order in which files are met.
    Raises FileNotFoundError, and ValueError where ``#version`` is not the first line.
    """
    files: list[str] = []
    lines = _read(f"{name}.glsl", files)
    version, rest = lines[0], lines[1:]
    if not _VERSION.match(version):
        raise ValueError(f"{name}.glsl: its first line is {version!r}, not #version")
    given = [f"#define {key} {_literal(value)}" for key, value in sorted(defines.items())]
    return "\n".join([version, *given, "#line 2 0", *rest, ""])


def _read(file: str, files: list[str]) -> list[str]:
    """The lines of ``file`` with its includes; ``files`` are those met so far."""
    number = len(files)
    files.append(file)
    out: list[str] = []
    for at, line in enumerate((SHADERS / file).read_text(encoding="utf-8").splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            out.append(line)
        elif match[1] not in files:
            inside = _read(match[1], files)
            out += [f"#line 1 {files.index(match[1])}", *inside, f"#line {at + 1} {number}"]
        else:
            out.append("")
    return out


def _literal(value: Value) -> str:
    return str(int(value)) if isinstance(value, int) else repr(float(value))


def _compiled(gpu: Gpu, name: str, outputs: tuple[str, ...], defines: Mapping[str, Value], *, compute: bool) -> Any:
    key = (name, outputs, tuple(sorted(defines.items())), compute)
    if key not in gpu.programs:
        try:
            with gpu.current() as ctx:
                if compute:
                    made = ctx.compute_shader(source(name, defines))
                else:
                    stages = {"vertex_shader": source(name, {**defines, "VERTEX_SHADER": 1})}
                    if not outputs:
                        stages["fragment_shader"] = source(name, {**defines, "FRAGMENT_SHADER": 1})
                    made = ctx.program(**stages, varyings=outputs)
        except GpuFailed as fault:
            raise GpuFailed(f"shaders/{name}.glsl: {fault}") from fault
        gpu.programs[key] = made
    return gpu.programs[key]


def set_uniforms(program: Any, **values: Any) -> None:
    """Set the uniforms that the compiler kept; those that it found unused are passed over."""
    for name, value in values.items():
        if name in program:
            program[name].value = value
