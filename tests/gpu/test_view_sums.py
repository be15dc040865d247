# SPDX-License-Identifier: GPL-3.0-or-later
"""Passes "sum", "sum_groups" and "weigh": every view's pixels times what they see, as NumPy sums them in float64."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.final_gather.views.entries import DOES_NOT_COUNT
from rtgi_addon.backend.final_gather.views.sums import ViewSums
from rtgi_addon.backend.final_gather.views.target import Target
from rtgi_addon.backend.final_gather.views.view import View, make_view
from rtgi_addon.backend.gpu.context import Gpu, GpuFailed
from rtgi_addon.backend.gpu.tables import TABLE_WIDTH, Table
from rtgi_addon.backend.settings import Gather
from tests.gpu.looks import tiles

ENTRIES = 3 * TABLE_WIDTH + 17
VIEWS = [(Gather.PLANE, 8), (Gather.HEMICUBE, 16), (Gather.HEMICUBE, 64), (Gather.RAYS, 32)]


class Sums:
    """Tiles of random entries that send random light, a third of which does not count."""

    def __init__(self, gpu: Gpu, view: View, *, across: int = 3, down: int = 2, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.gpu, self.view = gpu, view
        self.target = Target(gpu, view, across, down)
        entries = rng.integers(0, ENTRIES, self.target.size[::-1], dtype=np.uint32)
        self.sent = np.zeros((ENTRIES, 4), np.float32)
        self.sent[:, :3] = rng.lognormal(sigma=3, size=(ENTRIES, 3))
        self.sent[rng.random(ENTRIES) < 1 / 3, :3] = DOES_NOT_COUNT
        self.sent[:, 3] = np.nan  # means nothing
        up = rng.normal(size=(self.target.tiles, 3)) + (0, 0, 3)
        self.up = (up / np.linalg.norm(up, axis=1, keepdims=True)).astype(np.float32)
        with gpu.current() as ctx:
            self.target.texture.write(entries.tobytes())
            padded = np.concatenate([self.up, np.zeros((len(self.up), 1), np.float32)], axis=1)
            self.triangle = ctx.texture((across, down), 4, padded.tobytes(), dtype="f4")
            self.triangle.filter = (ctx.NEAREST, ctx.NEAREST)

    def make(self, gpu: Gpu | None = None, *, by_groups: bool = False) -> ViewSums:
        sums = ViewSums(gpu or self.gpu, self.view, ENTRIES, by_groups=by_groups)
        sums.send(self.sent)
        return sums

    def twin(self, *, tilted: bool = False) -> np.ndarray:
        """(2, t, 4) in float64."""
        sent = self.sent[tiles(self.target)].astype(np.float64)  # (t, H, W, 4)
        counts = sent[..., 0] >= -1e38
        if tilted:
            counts &= np.einsum("hwk,tk->thw", self.view.directions, self.up) > 0
        weight = np.where(counts, self.view.weights.astype(np.float64), 0)
        brought = np.where(counts[..., None], sent[..., :3], 0) * weight[..., None]
        values = np.concatenate([brought, weight[..., None]], axis=-1)
        return np.stack([(values * half[..., None]).sum(axis=(1, 2)) for half in (~self.view.second, self.view.second)])

    def release(self) -> None:
        self.target.release()
        self.gpu.release(self.triangle)


@pytest.fixture(params=VIEWS, ids=lambda p: f"{p[0]}-{p[1]}")
def case(gpu: Gpu, request: pytest.FixtureRequest) -> Iterator[Sums]:
    made = Sums(gpu, make_view(*request.param))
    yield made
    made.release()


def with_small_blocks(gpu: Gpu) -> Gpu:
    """The same context on a device whose uniform blocks hold next to nothing."""
    return replace(gpu, info=replace(gpu.info, max_uniform_block=16))


@pytest.mark.parametrize("tilted", [False, True])
def test_sums_are_those_of_float64(case: Sums, tilted: bool) -> None:
    """Of either half. A sum of n float32 numbers of one sign that are added row by row errs by about (√n + 1) half
    steps, 1e-6 for the largest view here."""
    sums = case.make()
    found = np.stack(sums.sums(case.target, case.triangle if tilted else None))
    expected = case.twin(tilted=tilted)
    np.testing.assert_allclose(found, expected, rtol=1e-6 if case.view.height < 100 else 2e-6)
    if case.view.kind is not Gather.RAYS or not tilted:  # rays have no directions of their own
        assert (found[..., 3] > 0).all() and (found[..., 3].sum(axis=0) < 1).all()
    sums.release()


@pytest.mark.parametrize("tilted", [False, True])
def test_weights_in_a_texture_give_the_bits_of_weights_in_a_block(case: Sums, tilted: bool) -> None:
    in_block, in_texture = case.make(), case.make(with_small_blocks(case.gpu))
    triangle = case.triangle if tilted else None
    for a, b in zip(in_block.sums(case.target, triangle), in_texture.sums(case.target, triangle), strict=True):
        np.testing.assert_array_equal(a, b)
    in_block.release()
    in_texture.release()


@pytest.mark.parametrize("tilted", [False, True])
def test_sums_by_groups_are_those_by_drawing_but_for_rounding(compute_gpu: Gpu, case: Sums, tilted: bool) -> None:
    triangle = case.triangle if tilted else None
    for gpu in (compute_gpu, with_small_blocks(compute_gpu)):
        sums = case.make(gpu, by_groups=True)
        found = np.stack(sums.sums(case.target, triangle))
        np.testing.assert_allclose(found, case.twin(tilted=tilted), rtol=2e-6)
        np.testing.assert_array_equal(np.stack(sums.sums(case.target, triangle)), found)
        sums.release()


def test_a_sum_hangs_on_its_own_tile_alone(gpu: Gpu) -> None:
    """Targets of other shapes, one after the other; back to the first."""
    view = make_view(Gather.HEMICUBE, 16)
    small, large = Sums(gpu, view), Sums(gpu, view, across=5, down=3, seed=1)
    sums = small.make()
    for case in (small, large, small):
        sums.send(case.sent)
        np.testing.assert_allclose(np.stack(sums.sums(case.target, None)), case.twin(), rtol=1e-6)
    for case in (small, large):
        case.release()
    sums.release()


def test_sums_are_linear_in_what_is_sent(gpu: Gpu) -> None:
    """Also below zero, as solvers ask for; what does not count stays out of it."""
    case = Sums(gpu, make_view(Gather.HEMICUBE, 16))
    sums, sent = case.make(), case.sent.copy()
    whole = sum(np.stack(sums.sums(case.target, None)))
    counts = sent[:, 0] >= 0
    for factor in (-1.0, 2.0**20, -(2.0**-30)):
        scaled = sent.copy()
        scaled[counts, :3] *= np.float32(factor)
        sums.send(scaled)
        again = sum(np.stack(sums.sums(case.target, None)))
        np.testing.assert_array_equal(again[:, :3], whole[:, :3] * np.float32(factor))
        np.testing.assert_array_equal(again[:, 3], whole[:, 3])
    case.release()
    sums.release()


def test_a_white_hemisphere_brings_what_it_sends(gpu: Gpu) -> None:
    """All pixels count and send 1: the sum is the coverage, of either half alike."""
    for kind, size in VIEWS:
        case = Sums(gpu, make_view(kind, size))
        case.sent[:] = 1
        sums = case.make()
        first, second = sums.sums(case.target, None)
        np.testing.assert_allclose(first + second, case.view.weights.sum(dtype=np.float64), rtol=1e-6)
        np.testing.assert_allclose(first, second, rtol=2e-6)
        case.release()
        sums.release()


def test_the_mean_by_mip_maps_is_the_sum(case: Sums) -> None:
    """Larsen04 §4's way, in float32 mip-maps. The largest difference with llvmpipe is 1.5e-5: filters weigh with fewer
    digits than numbers have."""
    sums = case.make()
    found = sums.mip_map_sums(case.target)
    np.testing.assert_allclose(found, case.twin().sum(axis=0), rtol=1e-4)
    in_texture = case.make(with_small_blocks(case.gpu))
    np.testing.assert_array_equal(in_texture.mip_map_sums(case.target), found)
    sums.release()
    in_texture.release()


def test_a_view_of_no_power_of_two_has_no_mip_map(gpu: Gpu) -> None:
    case = Sums(gpu, make_view(Gather.PLANE, 12))
    sums = case.make()
    with pytest.raises(ValueError, match="12 pixels"):
        sums.mip_map_sums(case.target)
    np.testing.assert_allclose(np.stack(sums.sums(case.target, None)), case.twin(), rtol=1e-6)
    case.release()
    sums.release()


# --- what does not fit ------------------------------------------------------------------------------------------------


def test_a_table_holds_what_it_is_given_and_no_other_number_of_entries(gpu: Gpu) -> None:
    for count in (0, 1, TABLE_WIDTH, TABLE_WIDTH + 1):
        table = Table(gpu, count)
        values = np.arange(4 * count, dtype=np.float32).reshape(count, 4)
        table.write(values)
        with gpu.current():
            stored = np.frombuffer(table.texture.read(), np.float32).reshape(-1, 4)
        np.testing.assert_array_equal(stored[:count], values)
        with pytest.raises(ValueError, match=str(count + 1)):
            table.write(np.zeros((count + 1, 4), np.float32))
        table.release()


def test_a_table_larger_than_a_texture_fails_in_one_line(gpu: Gpu) -> None:
    small = replace(gpu, info=replace(gpu.info, max_texture=2))
    Table(small, 2 * TABLE_WIDTH).release()
    with pytest.raises(GpuFailed, match=f"{2 * TABLE_WIDTH + 1} entries"):
        Table(small, 2 * TABLE_WIDTH + 1)
    with pytest.raises(GpuFailed, match=f"{2 * TABLE_WIDTH + 1} entries"):
        ViewSums(small, make_view(Gather.PLANE, 8), 2 * TABLE_WIDTH + 1)


def test_a_target_larger_than_a_texture_fails_and_leaves_no_error_behind(gpu: Gpu) -> None:
    view = make_view(Gather.PLANE, 16)
    with pytest.raises(GpuFailed):
        Target(gpu, view, 2 * gpu.info.max_texture // 16, 1)
    target = Target(gpu, view, 2, 2)
    assert (target.tiles, target.bytes) == (4, 4 * 32 * 32)
    target.release()
