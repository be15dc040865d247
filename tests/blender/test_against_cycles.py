# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked demos against converged references by Cycles (tests/reference): the whole way from .blend to EXR.

A reference is the mean irradiance over the visible part of each texel, of light that Eevee does not draw itself.
Remake one with ``python -m tests.reference.make_reference`` when its scene changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from bench.errors import Errors, compare
from bench.reference import Reference, TexelTable, load_reference, match
from rtgi_addon.cli import run
from rtgi_addon.exr import read_page

ROOT = Path(__file__).parents[2]
DEMOS = ("cornell", "larsen_box", "two_rooms", "interior")
#: What the project promises for a final bake: relative RMSE and bias.
FINAL_ERROR, FINAL_BIAS = 0.03, 0.01
#: The interior misses it at this resolution: its window's thin bars meet reveal and sill in edges with light from
#: outside on one side and none on the other, which texels of 6 cm do not resolve. The rest of the room is within 3 %.
INTERIOR_ERROR = 0.04
#: ... and for the default quality, a quarter of the rays.
PREVIEW_ERROR = 0.05
#: Of texels that another surface cuts: the reference is the mean over what shows on both its sides, a bake keeps the
#: one side that it takes for the visible one. In the interior that is the outside or the inside of the window.
CUT_ERROR = {"cornell": 0.15, "larsen_box": 0.15, "two_rooms": 0.15, "interior": 0.5}


@dataclass(frozen=True)
class Baked:
    """A bake read back from its files."""

    table: TexelTable
    irradiance: np.ndarray  # (n, 3) W/m²: IIM and caustics
    valid: np.ndarray  # (n,)


def bake(name: str, folder: Path, quality: str) -> Baked:
    reference = reference_of(name)
    blend, resolution = ROOT / "demo_blend" / f"{name}.blend", reference.made["resolution"]
    options = ["--frames", str(reference.made["frame"]), "--resolution", str(resolution), "--quality", quality]
    assert run(["bake", str(blend), "--out", str(folder), "--texels", *options]) == 0
    return read_bake(folder, reference.made["frame"])


def read_bake(folder: Path, frame: int) -> Baked:
    with np.load(folder / "texels.npz") as file:
        at = file["page"], file["row"], file["col"]
        columns = (file[name] for name in ("position", "normal", "area", "object"))
        table = TexelTable(*columns, tuple(file["names"].tolist()))
    pages = [read_page(folder / f"iim.p{page}.{frame:04d}.exr") for page in range(at[0].max() + 1)]
    total = np.stack([rgb for rgb, _ in pages])
    for page in range(len(pages)):
        caustics = folder / f"caustics.p{page}.{frame:04d}.exr"
        if caustics.exists():
            total[page] += read_page(caustics)[0]
    return Baked(table, total[at], np.stack([valid for _, valid in pages])[at])


def reference_of(name: str) -> Reference:
    return load_reference(ROOT / "tests" / "reference" / f"{name}.npz")


def errors_of(name: str, baked: Baked, *, cut: bool = False) -> Errors:
    """Over all texels that are wholly open, or over those ``cut`` by another surface. What lies under one is in
    neither: nobody sees it."""
    reference = reference_of(name)
    texel = match(reference, baked.table)
    rows = (reference.open > 0) & (reference.open < 1) & baked.valid[texel] if cut else reference.open == 1
    rows &= texel >= 0
    return compare(baked.irradiance[texel[rows]], reference.mean[rows], reference.standard_error[rows])


@pytest.fixture(scope="module", params=DEMOS)
def final(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Baked]:
    return request.param, bake(request.param, tmp_path_factory.mktemp(request.param), "final")


def test_final_quality_agrees_with_cycles(final: tuple[str, Baked]) -> None:
    name, baked = final
    errors = errors_of(name, baked)
    assert errors.relative_rmse <= (INTERIOR_ERROR if name == "interior" else FINAL_ERROR), errors
    assert abs(errors.bias) <= FINAL_BIAS, errors


def test_texels_cut_by_another_surface_show_one_of_its_sides(final: tuple[str, Baked]) -> None:
    name, baked = final
    errors = errors_of(name, baked, cut=True)
    assert errors.relative_rmse <= CUT_ERROR[name], errors


def test_nearly_every_texel_that_can_be_seen_is_valid(final: tuple[str, Baked]) -> None:
    """Those that are not take their neighbours' values; they lie in cracks that only a sliver of light finds."""
    name, baked = final
    reference = reference_of(name)
    texel = match(reference, baked.table)
    seen = (reference.open == 1) & (texel >= 0)
    assert (~baked.valid[texel][seen]).mean() < 0.002


@pytest.mark.parametrize("name", DEMOS)
def test_default_quality_agrees_with_cycles(name: str, tmp_path: Path) -> None:
    errors = errors_of(name, bake(name, tmp_path, "preview"))
    assert errors.relative_rmse <= PREVIEW_ERROR, errors
    assert abs(errors.bias) <= FINAL_BIAS, errors


@pytest.mark.parametrize("name", DEMOS)
def test_a_reference_is_less_noisy_than_what_it_judges(name: str) -> None:
    reference = reference_of(name)
    seen = reference.open > 0
    errors = compare(reference.mean[seen], reference.mean[seen], reference.standard_error[seen])
    assert errors.reference_noise < FINAL_ERROR
    assert len(reference.made["seeds"]) >= 12  # else the standard errors themselves are not known well
    assert reference.made["cycles"]["sample_clamp_indirect"] == 0


def test_a_reference_refuses_another_scene() -> None:
    reference = reference_of("cornell")
    table = reference.table
    assert np.array_equal(match(reference, table), np.arange(len(table.area)))
    block = table.object == table.names.index("Short block")
    moved = table.position + 0.05 * block[:, None]
    with pytest.raises(ValueError, match=r"Short block\) are not in the bake"):
        match(reference, replace(table, position=moved))
    with pytest.raises(ValueError, match="Floor: not in the bake"):
        match(reference, replace(table, names=tuple(name.lower() for name in table.names)))
    with pytest.raises(ValueError, match="make the reference anew"):
        match(reference, replace(table, area=table.area * 1.3))
