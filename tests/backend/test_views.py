# SPDX-License-Identifier: GPL-3.0-or-later
"""What a view is: its pixels' weights and directions, how it is turned, and what of the scene is drawn into it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from rtgi_addon.backend.final_gather.patterns import SETS, TILE
from rtgi_addon.backend.final_gather.views.entries import DOES_NOT_COUNT, NOTHING, Entries
from rtgi_addon.backend.final_gather.views.raster import MOST_RANGES, merged
from rtgi_addon.backend.final_gather.views.view import (
    LEAST_SIZE,
    MOST_SIZE,
    Face,
    View,
    coverage,
    equation_2,
    front_weights,
    make_view,
    side_weights,
)
from rtgi_addon.backend.final_gather.views.view_gather import _shifts, view_size
from rtgi_addon.backend.settings import SAMPLES_OF_QUALITY, Gather, Quality, SampleCounts

TRY = settings(max_examples=60, deadline=None, derandomize=True)
SIZES = st.integers(1, 32).map(lambda n: 4 * n)
ENLARGEMENTS = st.floats(1.0, 16.0)
COUNTS = st.integers(0, 1024).map(lambda n: 2 * n)
DRAWN = [Gather.PLANE, Gather.HEMICUBE]


def square_form_factor(half: float) -> float:
    """From a point to a square of half side ``half`` that faces it at distance 1 (Howell, B-4 four times)."""
    a = half / np.sqrt(1 + half**2)
    return float(4 / np.pi * a * np.arctan(a))


def see_the_ceiling(view: View, half: float) -> np.ndarray:
    """(H, W) do the middles of the pixels see a square of half side ``half`` at height 1?"""
    x, y, z = np.moveaxis(view.directions.astype(np.float64), -1, 0)
    return np.maximum(np.abs(x), np.abs(y)) < half * z


# --- weights ----------------------------------------------------------------------------------------------------------


@given(size=SIZES, enlargement=ENLARGEMENTS)
@TRY
def test_weights_of_a_plane_sum_to_what_it_covers(size: int, enlargement: float) -> None:
    view = make_view(Gather.PLANE, size, enlargement)
    assert (view.weights > 0).all() and view.weights.shape == (size, size)
    expected = square_form_factor(enlargement)
    assert view.weights.sum(dtype=np.float64) == pytest.approx(expected, abs=1e-6)
    assert coverage(Gather.PLANE, enlargement) == pytest.approx(expected, abs=1e-12)


@given(size=SIZES)
@TRY
def test_weights_of_a_hemicube_sum_to_one_and_its_sides_are_alike(size: int) -> None:
    view = make_view(Gather.HEMICUBE, size)
    assert (view.weights > 0).all() and view.weights.shape == (3 * size, size)
    assert coverage(Gather.HEMICUBE) == 1
    assert view.weights.sum(dtype=np.float64) == pytest.approx(1, abs=1e-6)
    np.testing.assert_array_equal(view.weights[:size], make_view(Gather.PLANE, size, 1.0).weights)
    sides = view.weights[size:].reshape(4, size // 2, size)
    for side in sides:
        np.testing.assert_array_equal(side, sides[0])
    assert sides[0].sum(dtype=np.float64) == pytest.approx((1 - square_form_factor(1.0)) / 4, abs=1e-6)


def test_coverage_is_what_larsen_says_about_it() -> None:
    """Larsen04 §4: about 56 % for the front, 11 % for each side, 86 % for a plane of twice the side; the last is 83 %,
    and both roundings are upwards."""
    assert coverage(Gather.PLANE, 1.0) == pytest.approx(0.554, abs=5e-4)
    assert (1 - coverage(Gather.PLANE, 1.0)) / 4 == pytest.approx(0.111, abs=5e-4)
    assert coverage(Gather.PLANE, 2.0) == pytest.approx(0.831, abs=5e-4)


@pytest.mark.parametrize("enlargement", [1.0, 2.0, 5.0])
def test_weights_of_the_front_are_the_integral_of_equation_2(enlargement: float) -> None:
    size = 8
    weights, edge = front_weights(size, enlargement), np.linspace(-enlargement, enlargement, size + 1)
    for row, col in [(0, 0), (3, 4), (2, 7), (7, 3)]:
        y0, y1, x0, x1 = edge[row], edge[row + 1], edge[col], edge[col + 1]
        found, _ = dblquad(lambda y, x: float(equation_2(np.array(x), np.array(y), 1.0)), x0, x1, y0, y1)
        assert weights[row, col] == pytest.approx(found, rel=1e-9)


def test_weights_of_a_side_are_the_integral_of_the_cosine() -> None:
    """Cohen and Greenberg 1985: z / (π (y² + z² + 1)²) on a side at distance 1."""
    weights, across, up = side_weights(8), np.linspace(-1, 1, 9), np.linspace(0, 1, 5)
    for row, col in [(0, 0), (0, 4), (3, 7), (2, 3)]:
        y0, y1, z0, z1 = across[col], across[col + 1], up[row], up[row + 1]
        found, _ = dblquad(lambda z, y: z / (np.pi * (y * y + z * z + 1) ** 2), y0, y1, z0, z1)
        assert weights[row, col] == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize("size, enlargement", [(32, 1.0), (64, 1.0), (64, 2.0), (128, 4.0)])
def test_equation_2_is_the_limit_of_the_integral(size: int, enlargement: float) -> None:
    """Within half a per cent from 32 pixels on: farthest off in the middle, by its Laplacian -8 f times side² / 24."""
    side = 2 * enlargement / size
    at = (np.arange(size) + 0.5) * side - enlargement
    error = np.abs(equation_2(at[None, :], at[:, None], side * side) / front_weights(size, enlargement) - 1)
    assert error.max() < 0.005
    assert error.max() == pytest.approx(side**2 / 3, rel=0.05)


@given(size=SIZES, enlargement=ENLARGEMENTS, kind=st.sampled_from(DRAWN))
@TRY
def test_either_half_of_the_pixels_is_a_view_by_itself(size: int, enlargement: float, kind: Gather) -> None:
    view = make_view(kind, size, enlargement)
    assert view.second.sum() * 2 == view.second.size
    of_second = view.weights[view.second].sum(dtype=np.float64)
    assert of_second == pytest.approx(view.weights.sum(dtype=np.float64) / 2, rel=1e-6)
    # Blocks of 2 × 2 pixels are of one half, and none beside another of the same, within a face.
    for face in view.faces:
        left, bottom, width, height = face.rectangle
        part = view.second[bottom : bottom + height, left : left + width]
        blocks = part[::2, ::2]
        assert (part == blocks.repeat(2, axis=0).repeat(2, axis=1)).all()
        assert (blocks[1:] != blocks[:-1]).all() and (blocks[:, 1:] != blocks[:, :-1]).all()


@given(kind=st.sampled_from(DRAWN), size=SIZES.filter(lambda n: n <= 64), step=st.integers(1, 32))
@TRY
def test_weights_of_the_pixels_that_see_a_square_are_its_form_factor(kind: Gather, size: int, step: int) -> None:
    """The square's border runs along the pixels' borders, wherever it ends: on the front, or as rows of the sides."""
    half = size // 2
    step = min(step, half)
    inside = step / half  # of the front; the square of half side 1 / inside reaches that row of the sides
    for side, on in ((inside, DRAWN), (1 / inside, [Gather.HEMICUBE])):
        if kind in on:
            view = make_view(kind, size, 1.0)
            found = view.weights[see_the_ceiling(view, side)].sum(dtype=np.float64)
            assert found == pytest.approx(square_form_factor(side), abs=1e-6)


# --- directions -------------------------------------------------------------------------------------------------------


@given(size=SIZES, enlargement=ENLARGEMENTS, kind=st.sampled_from(DRAWN))
@TRY
def test_directions_are_unit_above_the_surface_and_land_on_their_pixel(size, enlargement, kind) -> None:
    view = make_view(kind, size, enlargement)
    assert (view.height, view.width) == view.directions.shape[:2] == view.weights.shape
    directions = view.directions.astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    assert (directions[..., 2] > 0).all()
    taken = np.zeros(view.weights.shape, np.int64)
    for face in view.faces:
        left, bottom, width, height = face.rectangle
        rows, cols = slice(bottom, bottom + height), slice(left, left + width)
        row, col = pixel_of(face, directions[rows, cols])
        expected = np.indices((height, width))
        np.testing.assert_allclose(row, expected[0] + 0.5, atol=1e-4)
        np.testing.assert_allclose(col, expected[1] + 0.5, atol=1e-4)
        taken[rows, cols] += 1
    assert (taken == 1).all()


def pixel_of(face: Face, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column, in pixels of the face, at which ``points`` (..., 3) of tangent space are drawn."""
    x, y, w = np.moveaxis(points @ face.axes.T, -1, 0)
    assert (w > 0).all()
    _, _, width, height = face.rectangle
    return (y / w - face.low) / (1 - face.low) * height, (x / w + 1) / 2 * width


def test_each_direction_above_the_surface_lies_on_one_face_of_a_hemicube() -> None:
    view = make_view(Gather.HEMICUBE, 16)
    points = np.random.default_rng(0).normal(size=(1000, 3))
    points[:, 2] = np.abs(points[:, 2])
    inside = np.zeros(len(points), np.int64)
    for face in view.faces:
        x, y, w = (points @ face.axes.T).T
        inside += (w > 0) & (np.abs(x) <= w) & (y <= w) & (y >= face.low * w)
    assert (inside == 1).all()


def test_faces_are_drawn_the_way_they_are_seen_from_within() -> None:
    """Right, up and forward of all sides are left-handed together, as those of the front are: one winding serves."""
    for face in make_view(Gather.HEMICUBE, 8).faces[1:]:
        assert np.linalg.det(face.axes) == pytest.approx(np.linalg.det(make_view(Gather.PLANE, 8, 1.0).faces[0].axes))


@pytest.mark.parametrize("size", [-4, 0, 2, 3, 6, 33])
@pytest.mark.parametrize("kind", DRAWN)
def test_sizes_that_are_no_multiple_of_four_are_refused(kind: Gather, size: int) -> None:
    with pytest.raises(ValueError, match="multiple of four"):
        make_view(kind, size)


def test_links_are_no_view() -> None:
    with pytest.raises(ValueError, match="links"):
        make_view(Gather.LINKS, 16)


# --- sizes and turns --------------------------------------------------------------------------------------------------


def test_qualities_have_views_of_16_32_and_64_pixels() -> None:
    sizes = {q: view_size(SAMPLES_OF_QUALITY[q]) for q in Quality}
    assert sizes == {Quality.DRAFT: 16, Quality.PREVIEW: 32, Quality.FINAL: 64}


@given(cosine=COUNTS.filter(bool), bright=COUNTS)
@TRY
def test_any_number_of_rays_has_a_view_and_more_rays_no_smaller_one(cosine: int, bright: int) -> None:
    size = view_size(SampleCounts(cosine, bright))
    assert LEAST_SIZE <= size <= MOST_SIZE and size & (size - 1) == 0
    assert make_view(Gather.PLANE, size).width == size
    assert view_size(SampleCounts(cosine + 2, bright)) >= size
    # Pixels are cheap: a view has at least as many as it has rays to stand for, up to the largest.
    assert size * size >= min(cosine + bright, MOST_SIZE**2)


@given(seed=st.integers(0, 2**31 - 1))
@TRY
def test_texels_of_a_tile_divide_the_shifts_evenly(seed: int) -> None:
    count = TILE * TILE
    shifts = _shifts(np.arange(SETS * count, dtype=np.int32), seed)
    assert shifts.shape == (SETS * count, 2) and (shifts >= 0).all() and (shifts < 1).all()
    for column in shifts.reshape(SETS, count, 2).transpose(2, 0, 1):
        steps = np.diff(np.sort(column, axis=1), axis=1)
        np.testing.assert_allclose(steps, 1 / count, atol=1e-6)


# --- what is drawn ----------------------------------------------------------------------------------------------------


@given(data=st.data(), count=st.integers(0, 200), hidden=st.sampled_from([0, 0.02, 0.3]))
@TRY
def test_merged_ranges_hold_everything_and_nothing_that_is_hidden(data: st.DataObject, count: int, hidden: float):
    """Of what lies behind they hold no more than it takes to be few."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    edges = np.concatenate([[0], np.cumsum(rng.integers(1, 257, count))]).astype(np.int32)
    shown = rng.random(count) >= hidden
    rows = np.flatnonzero(shown & (rng.random(count) < rng.choice([0.1, 0.5, 0.95])))
    ranges = merged(edges[rows], edges[rows + 1], np.cumsum(~shown)[rows])
    sections = np.unique(np.cumsum(~shown)[rows], return_counts=True)[1]
    assert len(ranges) <= max(MOST_RANGES, len(sections)) and (len(ranges) > 0) == (len(rows) > 0)
    held, wanted, barred = (np.zeros(edges[-1], np.bool_) for _ in range(3))
    for first, number in ranges:
        assert number > 0 and not held[: first + number][first:].any() and not held[first:].any()
        held[first : first + number] = True
    for row in range(count):
        wanted[edges[row] : edges[row + 1]] = row in rows
        barred[edges[row] : edges[row + 1]] = not shown[row]
    assert held[wanted].all() and not held[barred].any()
    if shown.all():
        gaps = edges[rows[1:]] - edges[rows[:-1] + 1]
        assert held.sum() == wanted.sum() + np.sort(gaps)[::-1][MOST_RANGES - 1 :].sum()


def test_entries_send_what_their_targets_do() -> None:
    """Three texels on five atlas pixels, two patches of sky; the last two entries are beyond everything, and no map."""
    target = np.array([0, 1, NOTHING, 2, 2, 3, 4, NOTHING, NOTHING], np.int32)
    entries = Entries(target, sky_first=5, sky_size=(2, 1))
    assert (entries.count, entries.escaped, entries.none) == (9, 7, 8) and not entries.plain_sky
    radiosity = np.arange(15, dtype=np.float32).reshape(5, 3)
    sent = entries.sent(radiosity, None)
    assert sent.shape == (9, 4) and sent.dtype == np.float32
    np.testing.assert_array_equal(sent[[0, 1, 3, 4, 5, 6], :3], radiosity[[0, 1, 2, 2, 3, 4]])
    np.testing.assert_array_equal(sent[[2, entries.none], :3], np.float32([DOES_NOT_COUNT] * 2))
    np.testing.assert_array_equal(sent[entries.escaped], 0)


def test_texels_under_geometry_are_seen_as_those_that_stand_for_them() -> None:
    entries = Entries(np.array([0, 1, 2, NOTHING, NOTHING], np.int32), sky_first=3, sky_size=(0, 0))
    radiosity = np.float32([[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    sent = entries.sent(radiosity, np.array([1, 1, NOTHING], np.int32))
    np.testing.assert_array_equal(sent[:2, :3], radiosity[[1, 1]])
    np.testing.assert_array_equal(sent[2:, :3], np.float32([DOES_NOT_COUNT, (0, 0, 0), DOES_NOT_COUNT]))


@pytest.mark.parametrize("sky, plain", [((0, 0), True), ((1, 1), True), ((2, 1), False), ((1, 3), False)])
def test_a_sky_of_one_patch_or_none_looks_alike_everywhere(sky: tuple[int, int], plain: bool) -> None:
    count = sky[0] * sky[1]
    target = np.concatenate([np.arange(count), [NOTHING, NOTHING]]).astype(np.int32)
    assert Entries(target, 0, sky).plain_sky is plain


def test_without_any_texel_nothing_but_the_ends_is_sent() -> None:
    sent = Entries(np.array([NOTHING, NOTHING], np.int32), 0, (0, 0)).sent(np.zeros((0, 3), np.float32), None)
    np.testing.assert_array_equal(sent[:, :3], np.float32([(0, 0, 0), DOES_NOT_COUNT]))
