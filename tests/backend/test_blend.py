# SPDX-License-Identifier: GPL-3.0-or-later
"""Maps that move over to new ones: linear, continuous, exact at the end, and nothing given is written to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.finish.blend import BlendedMaps
from rtgi_addon.backend.scene import LightMaps

SHAPE = (2, 5, 4, 3)
CHANNELS = ("iim", "aim", "caustics")


def maps(seed: int, *, caustics: bool = True, frame: int = 1, exponents=(-6, 6)) -> LightMaps:
    """Random irradiance over many orders of magnitude, some of it 0; not to be written to."""
    rng = np.random.default_rng(seed)

    def page():
        values = (10.0 ** rng.uniform(*exponents, SHAPE) * (rng.random(SHAPE) < 0.8)).astype(np.float32)
        values.flags.writeable = False
        return values

    valid = rng.random(SHAPE[:-1]) < 0.5
    valid.flags.writeable = False
    return LightMaps(frame, page(), page(), page() if caustics else None, valid)


def flat(value: float, frame: int = 1) -> LightMaps:
    page = np.full(SHAPE, value, np.float32)
    return LightMaps(frame, page, page * 2, page * 3, np.ones(SHAPE[:-1], np.bool_))


def page_of(shown: LightMaps, name: str) -> np.ndarray:
    page = getattr(shown, name)
    return np.zeros(SHAPE, np.float32) if page is None else page


def assert_equal(a: LightMaps, b: LightMaps) -> None:
    assert (a.caustics is None) == (b.caustics is None)
    for name in CHANNELS:
        np.testing.assert_array_equal(page_of(a, name), page_of(b, name))
    np.testing.assert_array_equal(a.valid, b.valid)
    assert a.frame == b.frame


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    began=st.floats(-1e6, 1e6),
    blend_time=st.floats(0.01, 100),
    some=st.tuples(st.booleans(), st.booleans()),
)
def test_linear_monotone_between_and_exact_at_both_ends(seed, began, blend_time, some):
    a, b = maps(seed, caustics=some[0]), maps(seed + 1, caustics=some[1], frame=2)
    shown = BlendedMaps(a, blend_time)
    shown.show(b, began)
    times = began + np.linspace(0, 1, 17) * blend_time
    before, last = None, float(np.nextafter(began + blend_time, -np.inf))  # where rounding would overshoot
    for time in [*times[:-1].tolist(), last]:
        share = (time - began) / blend_time
        now = shown.at(time)
        assert now.frame == 2 and (now.caustics is not None) == any(some)
        for name in CHANNELS:
            start, end, page = page_of(a, name), page_of(b, name), page_of(now, name)
            assert page.dtype == np.float32 and page.shape == SHAPE
            expected = start + (end.astype(np.float64) - start) * share
            # Clocks far from 0 tell a share less exactly; float32 does the rest.
            slack = 1e-6 + 4 * np.spacing(abs(began) + blend_time) / blend_time
            assert (np.abs(page - expected) <= slack * np.maximum(start, end)).all()
            assert (np.minimum(start, end) <= page).all() and (page <= np.maximum(start, end)).all()
            if before is not None:
                moved = (page - page_of(before, name)) * np.sign(end - start)
                assert (moved >= 0).all()
        before = now
    assert_equal(replace(shown.at(began), frame=1, valid=a.valid, caustics=page_of(shown.at(began), "caustics")),
                 replace(a, caustics=page_of(a, "caustics")))  # fmt: skip
    for time in (began + blend_time, began + blend_time * 1.5, began + 1e9):
        assert_equal(shown.at(time), b)
        assert shown.settled(time)
    assert not shown.settled(times[8]) and not shown.settled(last)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    arrivals=st.lists(st.floats(0.0, 0.7), min_size=1, max_size=8),
    blend_time=st.sampled_from([0.05, 0.25, 1.0]),
)
def test_no_step_in_time_even_where_new_maps_arrive(seed, arrivals, blend_time):
    """What is shown is Lipschitz in time with the widest range of the maps over the blend time; it does not jump."""
    rng = np.random.default_rng(seed)
    coming = np.cumsum(arrivals).tolist()
    times = sorted({*np.linspace(0, coming[-1] + blend_time, 60).tolist(), *coming, *(np.nextafter(coming, -1))})
    shown = BlendedMaps(maps(seed, exponents=(-2, 0)), blend_time)
    last, newest, before = 0.0, None, None
    for time in times:
        if before is not None and time >= 0:
            now = shown.at(time)
            for name in CHANNELS:  # all maps lie in [0, 1]
                change = np.abs(page_of(now, name) - page_of(before, name)).max()
                assert change <= (time - last) / blend_time * (1 + 1e-6) + 1e-6
        while coming and coming[0] <= time:
            newest = maps(int(rng.integers(2**31)), caustics=rng.random() < 0.5, exponents=(-2, 0))
            ahead = shown.at(time)
            shown.show(newest, coming.pop(0))
            for name in CHANNELS:  # at the moment itself nothing moves at all
                np.testing.assert_array_equal(page_of(shown.at(time), name), page_of(ahead, name))
        last, before = time, shown.at(time)
    assert not coming and newest is not None
    assert_equal(shown.at(times[-1] + blend_time), newest)


def test_a_blend_that_is_overtaken_starts_from_what_is_shown():
    shown = BlendedMaps(flat(0), 1.0)
    shown.show(flat(8, 2), 10.0)
    shown.show(flat(0, 3), 10.5)  # 4 is shown by then
    for time, value in ((10.5, 4), (10.75, 3), (11.0, 2), (11.5, 0), (12, 0)):
        now = shown.at(time)
        assert (now.iim == value).all() and (now.aim == 2 * value).all() and (now.caustics == 3 * value).all()
        assert now.frame == 3


def test_at_once_without_blend_time():
    a, b = maps(1), maps(2, caustics=False, frame=7)
    shown = BlendedMaps(a, 0.0)
    shown.show(b, 3.0)
    assert_equal(shown.at(3.0), b)
    assert shown.settled(3.0)
    before = shown.at(2.9)  # a clock read before the maps came in
    np.testing.assert_array_equal(before.iim, a.iim)


def test_first_maps_are_shown_at_once():
    a = maps(3)
    shown = BlendedMaps(a, 5.0)
    for time in (-1e9, 0.0, 1e9):
        assert shown.at(time) is a and shown.settled(time)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.floats(0, 1))
def test_what_does_not_change_keeps_its_bits(seed, share):
    """No flicker: texels alike in both maps are shown as they are, all the way through."""
    a = maps(seed)
    iim = a.iim.copy()
    iim[0, 0] += 5
    shown = BlendedMaps(a, 1.0)
    shown.show(replace(a, iim=iim, frame=2), 0.0)
    now = shown.at(share)
    np.testing.assert_array_equal(now.iim[:, 1:], a.iim[:, 1:])
    np.testing.assert_array_equal(now.iim[1], a.iim[1])
    np.testing.assert_array_equal(now.aim, a.aim)
    np.testing.assert_array_equal(now.caustics, a.caustics)


def test_maps_of_equal_values_do_not_hold_a_blend_up():
    """A scene at rest gives the same maps frame after frame: the blend still ends when it should have."""
    shown = BlendedMaps(flat(0), 1.0)
    shown.show(flat(8), 0.0)
    for frame in range(1, 12):
        time = frame / 8
        shown.show(flat(8, frame), time)
        assert (shown.at(time).iim == min(frame, 8)).all() and shown.at(time).frame == frame
    assert shown.settled(1.0)


@pytest.mark.parametrize("name", CHANNELS)
def test_a_change_of_one_channel_is_blended(name):
    shown = BlendedMaps(flat(1), 2.0)
    new = replace(flat(1, 2), **{name: np.full(SHAPE, 9, np.float32)})
    shown.show(new, 0.0)
    assert not shown.settled(1.0)
    assert (page_of(shown.at(1.0), name) == (page_of(flat(1), name) + 9) / 2).all()
    assert_equal(shown.at(2.0), new)


def test_validity_is_the_newest_even_if_it_alone_changes():
    a = flat(1)
    shown = BlendedMaps(a, 2.0)
    shown.show(replace(a, valid=~a.valid), 0.0)
    assert not shown.at(0.0).valid.any() and not shown.at(1.0).valid.any()


def test_caustics_appear_out_of_black_and_go_into_black():
    some, none = flat(1), replace(flat(1), caustics=None)
    for a, b, values in ((none, some, [0, 0.75, 2.25]), (some, none, [3, 2.25, 0.75])):
        shown = BlendedMaps(a, 4.0)
        shown.show(b, 0.0)
        for time, value in zip((0, 1, 3), values, strict=True):
            assert (shown.at(time).caustics == value).all()
        assert (shown.at(4.0).caustics is None) == (b is none)
    dark = BlendedMaps(none, 4.0)
    dark.show(replace(flat(2), caustics=None), 0.0)
    assert dark.at(1.0).caustics is None


def test_nothing_given_or_shown_is_written_to():
    """The maps of ``maps`` refuse writes; what is shown is kept, and still the same after all that follows."""
    shown, given_maps = BlendedMaps(maps(0), 1.0), [maps(n) for n in range(1, 6)]
    copies = [replace(m, iim=m.iim.copy(), aim=m.aim.copy(), caustics=m.caustics.copy()) for m in given_maps]
    seen = []
    for number, new in enumerate(given_maps):
        shown.show(new, number * 0.4)
        now = shown.at(number * 0.4 + 0.3)
        seen.append((now, now.iim.copy(), now.caustics.copy()))
    for new, copy in zip(given_maps, copies, strict=True):
        assert_equal(new, copy)
    for now, iim, caustic in seen:
        np.testing.assert_array_equal(now.iim, iim)
        np.testing.assert_array_equal(now.caustics, caustic)


@pytest.mark.parametrize("name", ["iim", "aim", "caustics", "valid"])
@pytest.mark.parametrize("pages", [False, True])
def test_maps_of_another_shape_are_refused(name, pages):
    a = maps(0)
    shown = BlendedMaps(a, 1.0)
    shape = list(getattr(a, name).shape)
    shape[0 if pages else 1] += 1
    bad = replace(a, **{name: np.zeros(shape, getattr(a, name).dtype)})
    with pytest.raises(ValueError, match=rf"frame 1 is .*{shape[1]}"):
        shown.show(bad, 0.0)
    assert shown.at(5.0) is a  # as it was
    if name != "iim":  # whose shape is the measure of the others
        with pytest.raises(ValueError, match=name):
            BlendedMaps(bad, 1.0)


def test_times_that_cannot_be_are_refused():
    shown = BlendedMaps(maps(0), 1.0)
    shown.show(maps(1), 5.0)
    for at in (4.9, np.nan, np.inf):
        with pytest.raises(ValueError, match="maps of"):
            shown.show(maps(2), at)
    for blend_time in (-0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match="a blend of"):
            BlendedMaps(maps(0), blend_time)
    assert_equal(shown.at(6.0), maps(1))
