# SPDX-License-Identifier: GPL-3.0-or-later
"""Shaders as text: how their files are put together, and what both sides must agree on. No OpenGL is needed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rtgi_addon.backend.final_gather.views.entries import DOES_NOT_COUNT
from rtgi_addon.backend.gpu import programs
from rtgi_addon.backend.gpu.compute_tracer import DEFINES
from rtgi_addon.backend.gpu.context import COMPUTE_VERSION, LEAST_VERSION, GpuInfo, _info
from rtgi_addon.backend.gpu.programs import SHADERS, source
from rtgi_addon.backend.gpu.tables import TABLE_WIDTH

FILES = sorted(SHADERS.rglob("*.glsl"))
PASSES = sorted(SHADERS.glob("*.glsl"))
LICENCE = "// SPDX-License-Identifier: GPL-3.0-or-later"
REQUIRED = re.compile(r"^#ifndef (\w+)\n#error (.+)$", re.MULTILINE)

Write = Callable[[str, str], None]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Writes a file into a folder of shaders that stands in for ours."""
    monkeypatch.setattr(programs, "SHADERS", tmp_path)

    def file(name: str, text: str) -> None:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")

    return file


def numbered(text: str) -> Iterator[tuple[int, int, str]]:
    """(file, line, text) of each line as a compiler that obeys ``#line`` counts it."""
    file, line = 0, 1
    for words in text.splitlines():
        match = re.fullmatch(r"#line (\d+) (\d+)", words)
        if match:
            line, file = int(match[1]), int(match[2])
        else:
            yield file, line, words
            line += 1


# --- how files are put together ---------------------------------------------------------------------------------------


def test_defines_come_after_the_version_sorted_and_as_literals(write: Write) -> None:
    write("pass.glsl", "#version 330 core\nvoid main() {}\n")
    text = source("pass", {"WIDTH": 64, "ON": True, "OFF": False, "SHARE": 1e-4, "NEAR": 2.0})
    assert text.splitlines() == [
        "#version 330 core", "#define NEAR 2.0", "#define OFF 0", "#define ON 1", "#define SHARE 0.0001",
        "#define WIDTH 64", "#line 2 0", "void main() {}",
    ]  # fmt: skip
    assert source("pass", {}).endswith("}\n")


@pytest.mark.parametrize("value", [1e-18, 3e38, 0.1, -2.5, 1.0])
def test_numbers_keep_their_value_and_stay_floats(write: Write, value: float) -> None:
    write("pass.glsl", "#version 330 core\n")
    literal = source("pass", {"X": value}).splitlines()[1].removeprefix("#define X ")
    assert float(literal) == value and re.search(r"[.e]", literal)


def test_includes_are_read_at_any_depth_and_each_once(write: Write) -> None:
    write("pass.glsl", '#version 330 core\n#include "inc/a.glsl"\n#include "inc/b.glsl"\nlast\n')
    write("inc/a.glsl", 'first of a\n  #include "inc/b.glsl"\nlast of a\n')
    write("inc/b.glsl", '#include "inc/a.glsl"\nall of b\n#include "inc/b.glsl"\n')
    words = [w for _, _, w in numbered(source("pass", {})) if w and w[0] != "#"]
    assert words == ["first of a", "all of b", "last of a", "last"]


def test_lines_keep_the_numbers_of_their_files(write: Write) -> None:
    """Files are numbered as they are met; an include that is there already leaves an empty line."""
    texts = {
        "pass.glsl": '#version 330 core\n0:2\n#include "inc/a.glsl"\n0:4\n#include "inc/a.glsl"\n0:6\n'
        '#include "inc/c.glsl"\n0:8\n',
        "inc/a.glsl": '1:1\n#include "inc/b.glsl"\n1:3\n',
        "inc/b.glsl": "2:1\n\n2:3\n",
        "inc/c.glsl": '#include "inc/b.glsl"\n3:2\n',
    }
    for name, text in texts.items():
        write(name, text)
    found = [(f"{file}:{line}", words) for file, line, words in numbered(source("pass", {"A": 1})) if ":" in words]
    assert len(found) == 9 and all(place == words for place, words in found)


def test_our_own_files_keep_their_line_numbers() -> None:
    """Every line of every pass is the line of the file that it says it is."""
    for path in PASSES:
        text = source(path.stem, {"VERTEX_SHADER": 1})
        files: list[Path] = [path]
        for file, line, words in list(numbered(text))[2:]:  # after the version and the define
            if file == len(files):  # met first where the file before it includes it
                files.append(included_anew(files))
            if words:
                assert files[file].read_text(encoding="utf-8").splitlines()[line - 1] == words


def included_anew(files: list[Path]) -> Path:
    """The next file that a reader of ``files`` meets, depth first."""
    met: list[Path] = []

    def read(path: Path) -> None:
        met.append(path)
        for name in re.findall(r'^\s*#include "(.+)"', path.read_text(encoding="utf-8"), re.MULTILINE):
            if SHADERS / name not in met:
                read(SHADERS / name)

    read(files[0])
    assert met[: len(files)] == files
    return met[len(files)]


def test_missing_files_are_named(write: Write) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere.glsl"):
        source("nowhere", {})
    write("pass.glsl", '#version 330 core\n#include "inc/gone.glsl"\n')
    with pytest.raises(FileNotFoundError, match="gone.glsl"):
        source("pass", {})


@pytest.mark.parametrize("first", ["// a comment", "", " #version 330 core", "#version core", "#version 330 es"])
def test_the_first_line_must_be_the_version(write: Write, first: str) -> None:
    write("pass.glsl", f"{first}\n#version 330 core\n")
    with pytest.raises(ValueError, match=r"pass\.glsl"):
        source("pass", {})


# --- our files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(SHADERS).as_posix())
def test_every_file_names_its_licence(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    is_pass = path.parent == SHADERS
    assert lines[1 if is_pass else 0] == LICENCE
    assert lines[2 if is_pass else 1].startswith("// ")
    assert lines[0].startswith("#version") is is_pass
    assert sum(line.startswith("#version") for line in lines) == is_pass


@pytest.mark.parametrize("path", PASSES, ids=lambda p: p.stem)
def test_passes_ask_for_no_later_opengl_than_they_need(path: Path) -> None:
    """Drawing runs on OpenGL 3.3, which is all that macOS has; compute shaders, and they alone, on 4.3."""
    version = int(path.read_text(encoding="utf-8").split()[1])
    text = source(path.stem, {})
    computes = "local_size_x" in text
    assert version == (COMPUTE_VERSION if computes else LEAST_VERSION)
    assert computes or ("#if defined VERTEX_SHADER" in text and "void main()" in text)


@pytest.mark.parametrize("path", PASSES, ids=lambda p: p.stem)
def test_what_a_pass_is_configured_by_it_asks_for_first(path: Path) -> None:
    """``#ifndef X`` / ``#error`` stands before the first use of X; the message names it and says what it is."""
    text = re.sub(r"//.*", "", source(path.stem, {}))
    asked = {match[1]: match for match in REQUIRED.finditer(text)}
    for name, match in asked.items():
        assert name in match[2] and len(match[2]) > len(name) + 10
        assert name not in text[: match.start()]
    for name in re.findall(r"^#(?:el)?if !?([A-Z_]+)", text, re.MULTILINE):
        assert name in asked
    own = {"VERTEX_SHADER", "FRAGMENT_SHADER"} | set(re.findall(r"^\s*#define ([A-Z_]+)", text, re.MULTILINE))
    constants = set(re.findall(r"\bconst \w+ ([A-Z_]+)", text))
    used = set(re.findall(r"\b[A-Z][A-Z_]{3,}\b", re.sub(r"^#error.*", "", text, flags=re.MULTILINE)))
    assert used - own - constants == set(asked)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(SHADERS).as_posix())
def test_nothing_is_included_that_is_not_there(path: Path) -> None:
    for name in re.findall(r'#include\s+"(.+)"', path.read_text(encoding="utf-8")):
        assert (SHADERS / name).is_file()


def test_every_shared_file_is_used() -> None:
    used = {name for path in FILES for name in re.findall(r'^\s*#include\s+"(.+)"', path.read_text(), re.MULTILINE)}
    assert {p.relative_to(SHADERS).as_posix() for p in SHADERS.glob("inc/*.glsl")} == used


# --- what both sides must agree on ------------------------------------------------------------------------------------


def constant(file: str, name: str) -> float:
    match = re.search(rf"const \w+ {name} = ([-+.\de]+)u?;", (SHADERS / file).read_text(encoding="utf-8"))
    assert match
    return float(match[1])


def test_tables_are_as_wide_on_both_sides() -> None:
    assert constant("inc/table.glsl", "TABLE_WIDTH") == TABLE_WIDTH
    assert TABLE_WIDTH & (TABLE_WIDTH - 1) == 0


def test_what_does_not_count_is_told_from_all_light() -> None:
    """In float32, with room: no light is below zero, no solver's vector anywhere near."""
    least = np.float32(constant("inc/table.glsl", "LEAST_SENT"))
    sent = np.float32(DOES_NOT_COUNT[0])
    assert np.isfinite(sent) and sent < least < np.float32(-1e30)
    assert (SHADERS / "sum.glsl").read_text().count("brought.r < LEAST_SENT") == 1
    assert (SHADERS / "weigh.glsl").read_text().count("brought.r < LEAST_SENT") == 1


def test_the_tracer_defines_all_that_its_pass_asks_for() -> None:
    asked = {match[1] for match in REQUIRED.finditer(source("trace", {}))}
    assert asked <= {*DEFINES, "TRACE_RAYS", "TRACE_RESULTS", "TRACE_GROUP", "TRACE_ANY"}


# --- what a device says of itself -------------------------------------------------------------------------------------


def device(renderer: str = "Some Card", version: int = 330, **told: int) -> GpuInfo:
    """What is made of a context that says so."""
    known = {
        "GL_RENDERER": renderer, "GL_VERSION": "as worded by the driver", "GL_MAX_TEXTURE_SIZE": 16384,
        "GL_MAX_ARRAY_TEXTURE_LAYERS": 2048, "GL_MAX_UNIFORM_BLOCK_SIZE": 65536, **told,
    }  # fmt: skip
    return _info(SimpleNamespace(info=known, version_code=version))


@pytest.mark.parametrize("version, computes", [(330, False), (410, False), (420, False), (430, True), (460, True)])
def test_compute_shaders_are_there_from_4_3_on(version: int, computes: bool) -> None:
    info = device(version=version, GL_MAX_SHADER_STORAGE_BLOCK_SIZE=1 << 27)
    assert info.computes is computes
    assert info.max_storage == (1 << 27 if computes else 0)


@pytest.mark.parametrize(
    "renderer, software",
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("softpipe", True),
        ("ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (Subzero)), SwiftShader driver)", True),
        ("Microsoft Basic Render Driver", True),
        ("GDI Generic", True),
        ("Apple Software Renderer", True),
        ("NVIDIA GeForce RTX 4070/PCIe/SSE2", False),
        ("AMD Radeon RX 7800 XT (radeonsi, navi32, LLVM 17.0.6, DRM 3.57)", False),
        ("Mesa Intel(R) Arc(tm) A770 Graphics (DG2)", False),
        ("Apple M3 Max", False),
    ],
)
def test_what_draws_on_the_cpu_is_known_by_its_name(renderer: str, software: bool) -> None:
    assert device(renderer).software is software
