# SPDX-License-Identifier: GPL-3.0-or-later
"""The line of waiting texels: its order, what happens to Δ, and that nobody waits longer than the stated bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.selection.schedule import Budget, UpdateSchedule, within

NONE = np.zeros(0, np.int32)


def schedule(texels_of_surface, *, area=None, threshold=0.0, patience=1000) -> UpdateSchedule:
    surface = np.repeat(np.arange(len(texels_of_surface), dtype=np.int32), texels_of_surface)
    area = np.ones(len(texels_of_surface)) if area is None else np.asarray(area)
    return UpdateSchedule(surface, area.astype(np.float32), threshold=threshold, patience=patience)


def mask(count: int, *texels: int) -> np.ndarray:
    pending = np.zeros(count, np.bool_)
    pending[list(texels)] = True
    return pending


def watts(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


# --- order -------------------------------------------------------------------------------------------------------


def test_highest_delta_per_area_first_and_surfaces_stay_whole():
    line = schedule([2, 3, 2], area=[1, 10, 1])
    line.add(watts(1, 20, 3))  # 1, 2 and 3 W/m²
    np.testing.assert_array_equal(line.order(np.ones(7, np.bool_), 1.0), [5, 6, 2, 3, 4, 0, 1])


def test_ties_go_by_surface_number():
    line = schedule([1, 1, 1, 1], area=[1, 2, 4, 1])
    line.add(watts(2, 4, 8, 5))
    np.testing.assert_array_equal(line.order(np.ones(4, np.bool_), 1.0), [3, 0, 1, 2])


def test_an_area_that_shrinks_brings_its_surface_forward():
    line = schedule([1, 1])
    line.add(watts(2, 3))
    everything = np.ones(2, np.bool_)
    np.testing.assert_array_equal(line.order(everything, 1.0), [1, 0])
    line.set_area(watts(0.5, 1))  # the same watts on half the area
    np.testing.assert_array_equal(line.order(everything, 1.0), [0, 1])


@settings(max_examples=100, deadline=None)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1), patience=st.integers(0, 6))
def test_order_is_the_sorted_list_of_a_plain_loop(data, seed, patience):
    """Against Python's own sort with the rule spelled out, over some frames of partial updates."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, 5, rng.integers(1, 7))
    area = rng.choice([0.25, 1, 4], len(sizes))
    surface = np.repeat(np.arange(len(sizes)), sizes)
    threshold = data.draw(st.sampled_from([0.0, 1.0, 1e3]))
    line = schedule(sizes, area=area, threshold=threshold, patience=patience)
    since: dict[int, int] = {}
    for frame in range(8):
        delta = rng.choice([0.0, 1, 1, 2, 5], len(sizes))
        line.add(delta)
        pending = rng.random(len(surface)) < 0.6
        pending[list(since)] |= rng.random(len(since)) < 0.8  # some texels need no update any more
        since = {t: since.get(t, frame) for t in np.flatnonzero(pending).tolist()}
        got = line.order(pending, 2.0)
        density = line.delta / area

        def key(t, frame=frame, density=density, since=since):
            waited = frame - since[t]
            overdue = waited if waited >= patience else -1
            return (-overdue, -density[surface[t]], surface[t], -waited, t)

        due = [t for t in since if frame - since[t] >= patience or density[surface[t]] >= threshold * 2]
        assert got.tolist() == sorted(due, key=key) and got.dtype == np.int32
        done = got[: rng.integers(0, len(surface) + 1)]
        line.updated(done)
        since = {t: f for t, f in since.items() if t not in set(done.tolist())}


# --- Δ -----------------------------------------------------------------------------------------------------------


def test_small_changes_add_up_until_they_pass_the_threshold():
    line = schedule([2], threshold=0.1, patience=100)
    everything = np.ones(2, np.bool_)
    for _ in range(3):
        line.add(watts(0.125))
        assert not line.order(everything, 5.0).size  # 0.125, 0.25, 0.375 W/m² of 5: below 0.5
    line.add(watts(0.125))
    np.testing.assert_array_equal(line.order(everything, 5.0), [0, 1])  # at it
    line.updated(np.array([0, 1], np.int32))
    assert line.delta[0] == 0


def test_threshold_is_relative():
    def chosen(light):
        line = schedule([3, 3, 3], area=[1, 2, 3], threshold=0.05)
        line.add(watts(0.04, 0.2, 1) * np.float32(light))
        return line.order(np.ones(9, np.bool_), light)

    np.testing.assert_array_equal(chosen(1.0), [6, 7, 8, 3, 4, 5])
    for light in (2.0**-40, 2.0**40):
        np.testing.assert_array_equal(chosen(light), chosen(1.0))


def test_delta_falls_by_the_share_done_and_parts_add_up():
    line = schedule([5, 2])
    line.add(watts(8, 1))
    pending = mask(7, 0, 1, 2, 3, 6)  # four of the first surface's five texels
    np.testing.assert_array_equal(line.order(pending, 1.0), [0, 1, 2, 3, 6])
    line.updated(np.array([0], np.int32))
    np.testing.assert_allclose(line.delta, [6, 1], rtol=1e-15)
    line.updated(np.array([1, 2], np.int32))
    np.testing.assert_allclose(line.delta, [2, 1], rtol=1e-15)
    line.updated(np.array([3, 6], np.int32))
    assert line.delta.tolist() == [0, 0]


def test_a_surface_larger_than_the_budget_is_done_in_parts():
    line = schedule([10, 4])
    line.add(watts(100, 3))
    pending, parts = np.ones(14, np.bool_), []
    while pending.any():
        part = line.order(pending, 1.0)[:4]
        line.updated(part)
        pending[part] = False
        parts.append(part.tolist())
    # 100, 60 and then 20 W/m² are left of the first; what it leaves of the last budget goes to the second.
    assert parts == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11], [12, 13]]


def test_a_surface_with_nothing_pending_is_up_to_date():
    line = schedule([2, 2])
    line.add(watts(7, 7))
    line.order(mask(4, 2), 1.0)
    assert line.delta.tolist() == [0, 7]


def test_without_limits_everything_pending_is_chosen():
    """Batch: threshold 0, no budget, no Δ known; nothing pending, nothing chosen."""
    line = schedule([3, 0, 4])
    pending = mask(7, 0, 2, 5, 6)
    (part,) = within(Budget(), line.order(pending, 1.0))
    np.testing.assert_array_equal(part, [0, 2, 5, 6])
    line.updated(part)
    assert not line.order(np.zeros(7, np.bool_), 1.0).size and not list(within(Budget(), NONE))


# --- nobody starves ----------------------------------------------------------------------------------------------


def bound(patience: int, waiting: int, budget: int) -> int:
    """Frames after the one in which a texel comes into the line, by which it is updated: the class's promise."""
    return patience + math.ceil(waiting / budget) - 1


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    budget=st.integers(1, 12),
    patience=st.integers(0, 9),
    threshold=st.sampled_from([0.0, 0.1, 1e30]),
    adversary=st.sampled_from(["random", "starve the oldest", "starve one surface"]),
)
def test_every_texel_is_updated_within_the_bound(seed, budget, patience, threshold, adversary):
    """The adversary makes all he likes pending again at once and gives every surface but his victim's a huge Δ."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, 8, rng.integers(1, 6))
    surface = np.repeat(np.arange(len(sizes)), sizes)
    line = schedule(sizes, area=10.0 ** rng.integers(-6, 6, len(sizes)), threshold=threshold, patience=patience)
    count, pending = len(surface), np.zeros(len(surface), np.bool_)
    since, deadline = np.zeros(count, int), np.zeros(count, int)
    for frame in range(4 * (patience + count) + 8):
        if adversary == "random":
            delta, again = 10.0 ** rng.uniform(-20, 20, len(sizes)), rng.random(count) < rng.random()
        else:
            delta, again = np.full(len(sizes), 1e20), np.ones(count, np.bool_)
            if adversary == "starve one surface":
                delta[0] = 0
            elif pending.any():
                delta[surface[np.flatnonzero(pending)[np.argmin(since[pending])]]] = 0
        came = again & ~pending
        pending |= again
        since[came] = frame
        deadline[came] = frame + bound(patience, int(pending.sum()), budget)
        line.add(delta)
        done = line.order(pending, 1.0)[:budget]
        assert (deadline[pending] >= frame).all()
        line.updated(done)
        pending[done] = False


@pytest.mark.parametrize(("patience", "count", "budget"), [(0, 7, 1), (3, 1, 1), (5, 12, 4), (2, 13, 4), (4, 3, 10)])
def test_the_bound_is_reached(patience, count, budget):
    """Below the threshold all wait until their patience ends; then they leave, ``budget`` a frame, the last in time."""
    line = schedule([count], threshold=1.0, patience=patience)
    pending, frame = np.ones(count, np.bool_), 0
    while True:
        done = line.order(pending, 1.0)[:budget]
        assert len(done) == (0 if frame < patience else min(budget, pending.sum()))
        line.updated(done)
        pending[done] = False
        if not pending.any():
            break
        frame += 1
    assert frame == bound(patience, count, budget)


@settings(max_examples=50, deadline=None)
@given(patience=st.integers(0, 12), loud=st.integers(1, 5))
def test_a_quiet_surface_is_first_when_its_patience_ends(patience, loud):
    line = schedule([4] * loud + [2], patience=patience)
    count = 4 * loud + 2
    pending = mask(count, count - 2, count - 1)  # the quiet one came a frame before all others
    line.order(pending, 1.0)
    for frame in range(1, patience + 1):
        line.add(np.array([1e9] * loud + [0.0]))
        pending[:] = True
        first = line.order(pending, 1.0)[:2]
        quiet = first.tolist() == [count - 2, count - 1]
        assert quiet == (frame == patience)
        if not quiet:
            line.updated(first)


def test_a_texel_that_no_longer_waits_loses_its_place():
    line = schedule([1, 1], patience=2)
    for _ in range(2):
        line.order(mask(2, 0), 1.0)
    line.order(mask(2), 1.0)
    line.add(watts(0, 1))
    np.testing.assert_array_equal(line.order(mask(2, 0, 1), 1.0), [1, 0])


# --- budgets and refusals ----------------------------------------------------------------------------------------


class Clock:
    """Time passes when work is done, in whole milliseconds; read in seconds."""

    def __init__(self) -> None:
        self.milliseconds = 0

    def __call__(self) -> float:
        return self.milliseconds / 1000


@settings(max_examples=100, deadline=None)
@given(
    count=st.integers(0, 60),
    chunk=st.integers(1, 20),
    limit=st.one_of(st.none(), st.integers(1, 70)),
    milliseconds=st.one_of(st.none(), st.integers(0, 40)),
    cost=st.integers(1, 9),
)
def test_parts_are_the_front_of_the_line_until_the_time_is_up(count, chunk, limit, milliseconds, cost):
    line, clock = np.arange(count, dtype=np.int32)[::-1] * 3, Clock()
    begun, parts = [], []
    for part in within(Budget(limit, milliseconds), line, chunk=chunk, clock=clock):
        begun.append(clock.milliseconds)
        parts.append(part)
        clock.milliseconds += cost
    done = np.concatenate([*parts, NONE])
    np.testing.assert_array_equal(done, line[: len(done)])
    allowed = count if limit is None else min(count, limit)
    if milliseconds is None:
        assert len(done) == allowed
    else:
        chunks = max(1, math.ceil(milliseconds / cost))  # each began before the time was up, or was the first
        assert len(done) == min(allowed, chunks * chunk)
        assert all(len(part) <= chunk for part in parts)
        assert all(start < milliseconds for start in begun[1:])


def test_time_counts_from_the_call():
    clock = Clock()
    parts = within(Budget(milliseconds=5), np.arange(9, dtype=np.int32), chunk=3, clock=clock)
    clock.milliseconds += 1000  # late before the first part is asked for: that one comes all the same
    np.testing.assert_array_equal(np.concatenate(list(parts)), [0, 1, 2])


def test_a_surface_without_area_and_no_light_are_no_trouble():
    line = schedule([1, 1, 1], area=[0, 0, 1], threshold=0.5)
    line.add(watts(0, 1, 1))
    with np.errstate(all="raise"):
        assert line.order(np.ones(3, np.bool_), 1.0).tolist() == [1, 2]
        assert line.order(np.ones(3, np.bool_), 0.0).tolist() == [1, 2, 0]


@pytest.mark.parametrize("bad", [watts(1), watts(1, -1), watts(1, np.nan), watts(np.inf, 1)])
def test_deltas_and_areas_that_cannot_be_are_refused_and_change_nothing(bad):
    line = schedule([1, 1])
    line.add(watts(1, 2))
    with pytest.raises(ValueError, match="Δ is"):
        line.add(bad)
    with pytest.raises(ValueError, match="area is"):
        line.set_area(bad)
    assert line.delta.tolist() == [1, 2]
    assert line.order(np.ones(2, np.bool_), 1.0).tolist() == [1, 0]


def test_other_misuse_is_refused():
    line = schedule([2, 1])
    line.order(mask(3, 0, 1), 1.0)
    with pytest.raises(ValueError, match="not pending"):
        line.updated(np.array([2], np.int32))
    line.updated(np.array([1], np.int32))
    with pytest.raises(ValueError, match="twice"):
        line.updated(np.array([1], np.int32))
    with pytest.raises(ValueError, match=r"\(2,\).*\(3,\)"):
        line.order(np.ones(2, np.bool_), 1.0)
    for irradiance in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="irradiance"):
            line.order(np.ones(3, np.bool_), irradiance)
    with pytest.raises(ValueError, match="surfaces 0 to 1, areas of 1"):
        UpdateSchedule(np.array([0, 1], np.int32), watts(1), threshold=0, patience=1)
    for threshold, patience in ((-1.0, 1), (math.nan, 1), (0.0, -1)):
        with pytest.raises(ValueError, match="must not be negative"):
            schedule([1], threshold=threshold, patience=patience)
    for texels, milliseconds in ((0, None), (None, -1.0), (None, math.nan)):
        with pytest.raises(ValueError, match="budget"):
            Budget(texels, milliseconds)
    with pytest.raises(ValueError, match="chunks of 0"):
        within(Budget(), NONE, chunk=0)


def test_same_stream_same_line_whoever_asks():
    rng = np.random.default_rng(9)
    sizes = rng.integers(1, 40, 50)
    frames = [(rng.random(50), rng.random(sizes.sum()) < 0.3) for _ in range(12)]

    def lines():
        line = schedule(sizes, threshold=0.3, patience=3)
        for delta, pending in frames:
            line.add(delta)
            chosen = line.order(pending, 1.0)
            line.updated(chosen[:100])
            yield chosen.tobytes()

    assert list(lines()) == list(lines())
