# SPDX-License-Identifier: GPL-3.0-or-later
"""OIDN by ctypes, and the light-map use of it: what it removes, what it must keep, what may not touch what."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.finish.denoise import MOST_GAIN, MapDenoiser
from rtgi_addon.backend.finish.oidn import Denoiser, FilterKind, ImageFilter, OidnError, find_oidn


def bpy_libraries() -> list[Path]:
    """bpy's folder of shared libraries, without importing bpy."""
    spec = importlib.util.find_spec("bpy")
    return [Path(spec.origin).parent / "lib"] if spec and spec.origin else []


LIBRARY = find_oidn(bpy_libraries())
needs_oidn = pytest.mark.skipif(LIBRARY is None, reason="no OIDN 2 library in bpy's folder")


@pytest.fixture(scope="module")
def denoiser():
    with Denoiser(LIBRARY) as opened:
        yield opened


def layout(*boxes: tuple[int, int, int, int], size: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """One page with boxes (row, col, height, width): (1, size, size) texel index, (n,) surface of each texel."""
    island = np.full((1, size, size), -1)
    for number, (row, col, height, width) in enumerate(boxes):
        island[0, row : row + height, col : col + width] = number
    index = np.full(island.shape, -1, np.int32)
    index[island >= 0] = np.arange((island >= 0).sum())
    return index, island[island >= 0].astype(np.int32)


FOUR = layout((3, 3, 40, 40), (3, 47, 40, 40), (47, 3, 40, 40), (47, 47, 11, 23))


def stand_ins(index: np.ndarray, surface: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(n,) nearest valid texel of the same surface, -1 where there is none; by looking at all."""
    place = np.zeros((len(surface), 3))
    place[index[index >= 0]] = np.argwhere(index >= 0)
    found = np.arange(len(surface), dtype=np.int32)
    for lost in np.flatnonzero(~valid):
        near = np.flatnonzero(valid & (surface == surface[lost]))
        found[lost] = near[((place[near] - place[lost]) ** 2).sum(axis=1).argmin()] if len(near) else -1
    return found


def noise(count: int, seed: int = 0, shape: float = 8.0) -> np.ndarray:
    """(count, 3) of mean 1, like a path tracer's: relative deviation shape**-0.5, long tail."""
    return np.random.default_rng(seed).gamma(shape, 1 / shape, (count, 3)).astype(np.float32)


def test_find_looks_in_order_and_takes_files_only(tmp_path):
    name = LIBRARY.name if LIBRARY else "libOpenImageDenoise.so.2"
    first, second, third = (tmp_path / n for n in "abc")
    for folder in (second, third):
        folder.mkdir()
        (folder / name).write_bytes(b"")
    assert find_oidn([first, third, second]) == third / name
    (first / name).mkdir(parents=True)
    assert find_oidn([first]) is None and find_oidn([]) is None


def test_what_is_no_library_says_so(tmp_path):
    broken = tmp_path / "libOpenImageDenoise.so.2"
    broken.write_bytes(b"not a library")
    with pytest.raises(OidnError, match="cannot be loaded"):
        Denoiser(broken)
    with pytest.raises(OidnError, match=r"missing\.so"):
        Denoiser(tmp_path / "missing.so")


@needs_oidn
def test_a_missing_filter_is_named():
    """Blender's build may or may not have the light-map filter: it works, or the error tells version and filter."""
    try:
        opened = Denoiser(LIBRARY, kind=FilterKind.RT_LIGHTMAP)
    except OidnError as error:
        assert "has no RTLightmap filter" in str(error) and "Open Image Denoise:" in str(error)
    else:
        with opened:
            flat = opened.denoise(np.full((64, 64, 3), 2, np.float32))
        np.testing.assert_allclose(flat[20:-20, 20:-20], 2, rtol=0.01)


@needs_oidn
def test_not_finite_is_refused_with_a_count(denoiser):
    image = np.ones((8, 8, 3), np.float32)
    image[2, 3, 1], image[4, 4], image[7, 7, 0] = np.nan, np.inf, -np.inf
    with pytest.raises(ValueError, match="3 of 64 texels are not finite"):
        denoiser.denoise(image)
    values = noise(len(FOUR[1]))
    values[5, 2] = np.nan
    with pytest.raises(ValueError, match="1 of 5053 texels are not finite"):
        MapDenoiser(denoiser, *FOUR).denoise(values)
    values[5, 2] = -1
    with pytest.raises(ValueError, match="1 texels are negative"):
        MapDenoiser(denoiser, *FOUR).denoise(values)


@needs_oidn
@pytest.mark.parametrize("shape", [(8, 8), (8, 8, 4), (0, 8, 3)])
def test_wrong_shapes_are_refused(denoiser, shape):
    with pytest.raises(ValueError, match="shape"):
        denoiser.denoise(np.zeros(shape, np.float32))


@needs_oidn
def test_closed_denoiser_is_refused():
    opened = Denoiser(LIBRARY)
    opened.close()
    opened.close()
    with pytest.raises(ValueError, match="closed"):
        opened.denoise(np.ones((8, 8, 3), np.float32))


@needs_oidn
def test_same_bits_for_any_thread_count():
    image = noise(100 * 75).reshape(100, 75, 3)
    results = []
    for threads in (1, 2, 3, 0):
        with Denoiser(LIBRARY, threads=threads) as opened:
            results.append(opened.denoise(image))
            np.testing.assert_array_equal(opened.denoise(image), results[0])
    for other in results:
        np.testing.assert_array_equal(other, results[0])


@needs_oidn
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (5, 3), (17, 31)])
def test_odd_sizes_and_views(denoiser, size):
    image = noise(size[0] * size[1]).reshape(*size, 3)
    result = denoiser.denoise(image)
    assert result.shape == image.shape and np.isfinite(result).all() and (result >= 0).all()
    # Rows reversed and float64: same pixels, other memory layout.
    np.testing.assert_array_equal(denoiser.denoise(image[::-1].copy()[::-1].astype(np.float64)), result)


@needs_oidn
def test_noise_goes_and_structure_stays(denoiser):
    """A soft shadow edge and a gradient under 35 % noise: at most a quarter of the noise is left."""
    index, surface = FOUR
    _, row, col = np.nonzero(index >= 0)
    truth = 1 + row / 40 + 1.5 / (1 + np.exp(-(col % 44 - 22) / 1.5))
    truth = np.repeat(truth[:, None], 3, axis=1).astype(np.float32)
    noisy = truth * noise(len(surface))
    result = MapDenoiser(denoiser, index, surface).denoise(noisy)

    def rms(values):
        return np.sqrt(np.mean((values - truth) ** 2)) / truth.mean()

    assert rms(noisy) > 0.3 and rms(result) < rms(noisy) / 4
    edge = np.isin(row, [3, 4, 41, 42]) | np.isin(col, [3, 4, 41, 42])
    # A border texel has neighbours on one side only, twice the variance; darkening would add to that.
    assert np.sqrt(np.mean((result - truth)[edge] ** 2)) < 1.7 * np.sqrt(np.mean((result - truth) ** 2))


def test_the_fast_network_is_nearly_as_good(denoiser):
    index, surface = layout((8, 8, 64, 64))
    row, _ = np.nonzero(index[0] >= 0)
    truth = np.repeat((1 + np.sin(row / 20))[:, None], 3, axis=1).astype(np.float32)
    noisy = truth * noise(len(surface))
    errors = {}
    with Denoiser(denoiser.library, fast=True) as fast:
        for name, engine in (("full", denoiser), ("fast", fast)):
            errors[name] = np.sqrt(np.mean((MapDenoiser(engine, index, surface).denoise(noisy) - truth) ** 2))
    assert errors["fast"] != errors["full"]  # another network
    assert errors["fast"] < 1.5 * errors["full"] < 0.3 * np.sqrt(np.mean((noisy - truth) ** 2))


@needs_oidn
@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    exponents=st.lists(st.integers(-30, 30), min_size=4, max_size=4),
)
def test_each_surface_scales_by_itself(denoiser, seed, exponents):
    """A surface 2^60 times brighter than its neighbour does not change it: same bits, times a power of two."""
    index, surface = FOUR
    maps = MapDenoiser(denoiser, index, surface)
    values = noise(len(surface), seed)
    factor = np.ldexp(1.0, exponents).astype(np.float32)[surface][:, None]
    np.testing.assert_allclose(maps.denoise(values * factor), maps.denoise(values) * factor, rtol=1e-5)


@needs_oidn
@pytest.mark.parametrize("factor", [1e-6, 0.3, 1e6])
def test_scale_of_the_whole(denoiser, factor):
    values = noise(len(FOUR[1]))
    maps = MapDenoiser(denoiser, *FOUR)
    np.testing.assert_allclose(maps.denoise(values * np.float32(factor)), maps.denoise(values) * factor, rtol=1e-3)


@needs_oidn
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), shape=st.floats(0.5, 20))
def test_each_surface_keeps_its_mean(denoiser, seed, shape):
    index, surface = FOUR
    values = noise(len(surface), seed, shape) * np.array([1, 10, 0.1], np.float32)
    result = MapDenoiser(denoiser, index, surface).denoise(values)
    assert np.isfinite(result).all() and (result >= 0).all()
    for number in range(4):
        before, after = (v[surface == number].mean(axis=0, dtype=np.float64) for v in (values, result))
        np.testing.assert_allclose(after, before, rtol=1e-5)


@needs_oidn
def test_one_firefly_is_not_amplified(denoiser):
    """All the light of a surface in one texel: the result is finite and holds at most that light."""
    index, surface = FOUR
    values = np.zeros((len(surface), 3), np.float32)
    values[100] = 1e6
    result = MapDenoiser(denoiser, index, surface).denoise(values)
    assert np.isfinite(result).all() and result.sum(dtype=np.float64) <= 3.03e6
    assert result.max() <= MOST_GAIN * 1e6 and not result[surface != surface[100]].any()


@needs_oidn
@pytest.mark.parametrize("colour", [(1, 1, 1), (5, 0.2, 0.01), (1e6, 1, 1e-6)])
def test_constants_stay(denoiser, colour):
    """OIDN's own ripple on flat grey is nearly taken out; colours add nothing, since each channel is divided out."""
    index, surface = FOUR
    flat = np.broadcast_to(np.float32(colour), (len(surface), 3))
    result = MapDenoiser(denoiser, index, surface).denoise(flat)
    np.testing.assert_allclose(result, flat, rtol=0.01)
    assert np.sqrt(np.mean((result / flat - 1) ** 2)) < 0.001


@needs_oidn
def test_black_channels_and_surfaces_stay_black(denoiser):
    index, surface = FOUR
    values = noise(len(surface))
    values[surface == 1] = 0
    values[surface == 2, 1] = 0
    result = MapDenoiser(denoiser, index, surface).denoise(values)
    assert not result[surface == 1].any() and not result[surface == 2, 1].any()
    np.testing.assert_allclose(result[surface == 2][:, [0, 2]], 1, atol=0.25)  # 0.35 before


@needs_oidn
def test_neighbours_do_not_bleed(denoiser):
    """A gap of 4 texels: what a dark surface becomes hardly depends on its neighbour's structure."""
    index, surface = FOUR
    values = noise(len(surface))
    other = values.copy()
    other[surface == 1] *= np.where(np.arange((surface == 1).sum()) % 40 < 5, 1000, 1)[:, None].astype(np.float32)
    maps = MapDenoiser(denoiser, index, surface)
    before, after = maps.denoise(values), maps.denoise(other)
    dark = (after - before)[surface == 0].reshape(40, 40, 3)
    assert np.abs(dark.mean()) < 0.01 and np.sqrt((dark[:, -2:] ** 2).mean()) < 0.05
    np.testing.assert_allclose(after[surface == 0].mean(), values[surface == 0].mean(), rtol=1e-5)


@needs_oidn
def test_tiny_surfaces(denoiser):
    """One texel is its own mean: unchanged. Slivers stay finite and keep theirs."""
    index, surface = layout((0, 0, 1, 1), (0, 5, 1, 30), (4, 0, 2, 2), (95, 95, 1, 1), (10, 10, 40, 1))
    values = noise(len(surface), shape=2)
    result = MapDenoiser(denoiser, index, surface).denoise(values)
    single = np.isin(surface, [0, 3])
    np.testing.assert_allclose(result[single], values[single], rtol=1e-5)
    for number in range(5):
        np.testing.assert_allclose(
            result[surface == number].mean(axis=0), values[surface == number].mean(axis=0), rtol=1e-4
        )


@needs_oidn
def test_texels_that_are_not_valid_are_not_looked_at(denoiser):
    """Whatever is under the block that stands on the floor, NaN too, the floor around it is the same to the bit."""
    index, surface = FOUR
    values = noise(len(surface))
    valid = np.ones(len(surface), np.bool_)
    valid[index[0, 15:25, 15:30]] = False
    valid[surface == 3] = False
    maps = MapDenoiser(denoiser, index, surface)
    stand_in = stand_ins(index, surface, valid)
    results = []
    for rubbish in (0, 1e9, -1, np.nan):
        results.append(maps.denoise(np.where(valid[:, None], values, np.float32(rubbish)), stand_in=stand_in))
        np.testing.assert_array_equal(results[-1], results[0])
    assert not results[0][surface == 3].any()
    hidden = results[0][~valid & (surface == 0)]
    np.testing.assert_allclose(hidden, 1, atol=0.3)
    for number in range(3):
        here = valid & (surface == number)
        np.testing.assert_allclose(results[0][here].mean(axis=0), values[here].mean(axis=0), rtol=1e-4)
    np.testing.assert_array_equal(maps.denoise(values), MapDenoiser(denoiser, index, surface).denoise(values))


@needs_oidn
def test_no_streaks_around_invalid_texels(denoiser):
    """82 % noise comes down to 5 %, beside the hidden texels too; repeated border texels would leave 34 % there."""
    index, surface = layout((3, 3, 60, 60))
    valid = np.ones(len(surface), np.bool_)
    valid[index[0, 23:43, 23:43]] = False
    near = np.zeros_like(valid)
    near[index[0, 21:45, 21:45]] = True
    near &= valid
    maps = MapDenoiser(denoiser, index, surface)
    stand_in = stand_ins(index, surface, valid)
    errors = []
    for seed in range(4):
        error = maps.denoise(noise(len(surface), seed, shape=1.5), stand_in=stand_in) - 1
        errors.append([np.mean(error[near] ** 2), np.mean(error[valid] ** 2)])
    near_error, error = np.sqrt(np.mean(errors, axis=0))
    assert near_error < 0.1 and error < 0.1


@needs_oidn
def test_no_texels_at_all(denoiser):
    empty = MapDenoiser(denoiser, np.full((2, 32, 32), -1, np.int32), np.zeros(0, np.int32))
    assert empty.denoise(np.zeros((0, 3), np.float32)).shape == (0, 3)


def scattered(seed: int, *, pages: int = 2, size: int = 64, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Boxes of all sizes, slivers and single texels, wherever they fall; later ones do not cover earlier ones."""
    rng = np.random.default_rng(seed)
    island = np.full((pages, size, size), -1)
    for number in range(count):
        page, row, col = rng.integers(pages), *rng.integers(0, size, 2)
        box = island[page, row : row + rng.choice([1, 2, 7, 30]), col : col + rng.choice([1, 3, 9, 25])]
        box[box < 0] = number
    index = np.full(island.shape, -1, np.int32)
    index[island >= 0] = np.arange((island >= 0).sum())
    return index, np.unique(island[island >= 0], return_inverse=True)[1].astype(np.int32)


def rooms(count: int, texels: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """``count`` squares side by side on one page."""
    return layout(*((2, 2 + (texels + 2) * k, texels, texels) for k in range(count)), size=(texels + 2) * count + 4)


@needs_oidn
def test_the_same_room_twice(denoiser):
    """Two rooms alike but for their light, on two pages: the same bits, times a power of two."""
    index, surface = layout((3, 3, 40, 40))
    values = noise(len(surface))
    alone = MapDenoiser(denoiser, index, surface).denoise(values)
    two = np.concatenate([np.where(index >= 0, index + 1600, -1), np.full_like(index, -1), index])
    maps = MapDenoiser(denoiser, two, np.repeat(np.int32([0, 1]), 1600))
    both = maps.denoise(np.concatenate([values, values * 2]), component=np.int32([7, 3]))
    np.testing.assert_array_equal(both[:1600], alone)
    np.testing.assert_array_equal(both[1600:], alone * 2)


@needs_oidn
def test_a_change_in_one_room_is_none_in_another(denoiser):
    index, surface = rooms(3)
    maps = MapDenoiser(denoiser, index, surface)
    component = np.int32([5, 9, 5])
    values = noise(len(surface))
    before = maps.denoise(values, component=component)
    assert maps.filtered == len(values)
    np.testing.assert_array_equal(maps.denoise(values.copy(), component=component), before)
    assert maps.filtered == 0
    changed = values.copy()
    changed[np.flatnonzero(surface == 1)[17]] *= 1.5
    after = maps.denoise(changed, component=component)
    assert maps.filtered == 1600
    np.testing.assert_array_equal(after[surface != 1], before[surface != 1])
    assert (after != before)[surface == 1].any()
    # The door opens: all is one room, and its light is felt everywhere in it.
    maps.denoise(changed)
    assert maps.filtered == len(values)


@needs_oidn
def test_a_door_elsewhere_leaves_a_room_alone(denoiser):
    """What is known of a room stays while its own surfaces are the same, whatever it is called."""
    index, surface = rooms(3)
    maps = MapDenoiser(denoiser, index, surface)
    values = noise(len(surface))
    apart = maps.denoise(values, component=np.int32([0, 1, 2]))
    opened = maps.denoise(values, component=np.int32([4, 4, 0]))
    assert maps.filtered == 3200
    np.testing.assert_array_equal(opened[surface == 2], apart[surface == 2])
    np.testing.assert_array_equal(maps.denoise(values, component=np.int32([0, 1, 2])), apart)


@needs_oidn
def test_two_memories(denoiser):
    index, surface = rooms(2)
    maps = MapDenoiser(denoiser, index, surface)
    full, half = noise(len(surface), 1), noise(len(surface), 2, 4.0)
    results = [maps.denoise(full, key="full"), maps.denoise(half, key="half")]
    for values, key, result in zip((full, half), ("full", "half"), results, strict=True):
        np.testing.assert_array_equal(maps.denoise(values, key=key), result)
        assert maps.filtered == 0


@needs_oidn
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_was_done_before_does_not_matter(denoiser, seed):
    """Random calls, some repeated and some changed a little, each as a denoiser that never saw another."""
    rng = np.random.default_rng(seed)
    index, surface = scattered(seed)
    maps = MapDenoiser(denoiser, index, surface)
    surfaces = surface.max() + 1
    values, valid = noise(len(surface), seed), np.ones(len(surface), np.bool_)
    component = np.zeros(surfaces, np.int32)
    for _ in range(6):
        match rng.integers(4):
            case 0:
                values = values.copy()
                values[surface == rng.integers(surfaces)] *= np.float32(rng.random() + 0.5)
            case 1:
                valid = rng.random(len(surface)) < rng.choice([0.5, 0.9, 1.0])
            case 2:
                component = rng.integers(0, 3, surfaces).astype(np.int32)
        stand_in, key = stand_ins(index, surface, valid), str(rng.choice(["full", "half"]))
        result = maps.denoise(values, stand_in=stand_in, component=component, key=key)
        fresh = MapDenoiser(denoiser, index, surface)
        np.testing.assert_array_equal(result, fresh.denoise(values, stand_in=stand_in, component=component))


@needs_oidn
def test_a_result_is_the_callers_own(denoiser):
    """Writing into what was given and what came back changes nothing that is kept."""
    index, surface = rooms(2)
    maps = MapDenoiser(denoiser, index, surface)
    values, stand_in = noise(len(surface)), np.arange(len(surface), dtype=np.int32)
    component = np.int32([0, 1])
    first = maps.denoise(values, stand_in=stand_in, component=component)
    right = first.copy()
    first[:] = 0
    again = values.copy()
    values[:] = 0
    stand_in[:] = 0
    component[:] = 0
    np.testing.assert_array_equal(maps.denoise(again, component=np.int32([0, 1])), right)
    assert maps.filtered == 0


@needs_oidn
def test_a_broken_call_leaves_the_memory_right(denoiser):
    index, surface = rooms(1)
    maps = MapDenoiser(denoiser, index, surface)
    values = noise(len(surface))
    before = maps.denoise(values)
    broken = values.copy()
    broken[0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        maps.denoise(broken)
    np.testing.assert_array_equal(maps.denoise(values), before)


@needs_oidn
def test_maps_are_the_same_for_any_thread_count(denoiser):
    index, surface = scattered(3)
    values = noise(len(surface))
    whole = MapDenoiser(denoiser, index, surface).denoise(values)
    for threads in (1, 2, 3):
        with Denoiser(LIBRARY, threads=threads) as opened:
            maps = MapDenoiser(opened, index, surface)
            np.testing.assert_array_equal(maps.denoise(values), whole)
            # The filter is kept open: what it did before leaves no trace.
            maps.denoise(values * values)
            np.testing.assert_array_equal(maps.denoise(values), whole)


@needs_oidn
def test_hundreds_of_closets_are_few_images(denoiser, monkeypatch):
    """225 closed boxes of 9 texels beside a hall: two images; what changes in a closet leaves the hall's bits."""
    boxes = [(4 + 5 * (k // 15), 4 + 5 * (k % 15), 3, 3) for k in range(225)]
    index, surface = layout((90, 4, 40, 40), *boxes, size=140)
    maps = MapDenoiser(denoiser, index, surface)
    runs = []
    plain = ImageFilter.run

    def spied(self):
        runs.append(self.color.shape)
        plain(self)

    monkeypatch.setattr(ImageFilter, "run", spied)
    values = noise(len(surface))
    before = maps.denoise(values, component=np.arange(226, dtype=np.int32))
    assert len(runs) == 2 and maps.filtered == 1600 + 225 * 9
    values[surface == 100] *= 3
    after = maps.denoise(values, component=np.arange(226, dtype=np.int32))
    assert len(runs) == 3 and maps.filtered == 225 * 9
    np.testing.assert_array_equal(after[surface == 0], before[surface == 0])


@needs_oidn
def test_filters_end_with_their_denoiser():
    with Denoiser(LIBRARY) as opened:
        kept = opened.filter_of(32, 48, input_scale=0.3)
        kept.color[:] = 1
        kept.run()
        assert np.abs(kept.output[8:-8, 8:-8] - 1).max() < 0.01
    with pytest.raises(ValueError, match="closed"):
        kept.run()
    kept.close()
    with pytest.raises(ValueError, match="closed"):
        opened.filter_of(32, 32)
