# SPDX-License-Identifier: GPL-3.0-or-later
"""Groups of photons: each a cell of the Halton sequence, of equal size, every member probed in its turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtgi_addon.backend.lamps.emission import all_photons
from rtgi_addon.backend.photon.groups import cells, make_groups
from rtgi_addon.backend.sampling import halton, photon_numbers, sample_sphere, unit_float64

COUNTS = st.dictionaries(st.integers(-2, 8), st.integers(1, 3000), max_size=4)


@given(st.integers(1, 200_000), st.integers(1, 200))
def test_cells_make_groups_of_about_the_size_asked_for(count: int, size: int) -> None:
    halves, thirds = cells(count, size)
    assert np.log2(halves) % 1 == 0 and 3 ** round(np.log(thirds) / np.log(3)) == thirds
    assert halves * thirds <= count and max(halves, thirds) <= 4 * min(halves, thirds)
    if count >= 12 * size:
        assert 1 / 2 < count / (halves * thirds) / size < 2


@pytest.mark.parametrize("seed", [0, 7])
def test_a_group_is_one_cell_of_the_sequence(seed: int) -> None:
    groups = make_groups({0: 4000})
    halves, thirds = cells(4000, 40)
    index = np.arange(4000, dtype=np.uint32)
    cell = [
        (unit_float64(halton(index, dimension, seed=seed)) * count + 1e-6).astype(int)
        for dimension, count in ((0, halves), (1, thirds))
    ]
    number = cell[0] * thirds + cell[1]
    pairs = np.unique(np.stack([groups.of_photon, number], axis=1), axis=0)
    assert len(pairs) == groups.count == halves * thirds == len(np.unique(number))


@given(COUNTS, st.integers(1, 60))
def test_groups_part_the_photons_evenly(counts: dict[int, int], size: int) -> None:
    groups = make_groups(counts, size=size)
    light, _ = all_photons(counts)
    assert np.array_equal(np.sort(groups.member), np.arange(len(light)))
    sizes = np.diff(groups.first_member)
    of_member = np.repeat(np.arange(groups.count), sizes)
    assert np.array_equal(groups.of_photon[groups.member], of_member)
    assert (sizes > 0).all()
    for number in counts:
        own = np.unique(groups.of_photon[light == number])
        assert np.ptp(sizes[own]) <= 1  # of one light all groups are as large, but for a remainder
        assert (np.isin(groups.of_photon, own) == (light == number)).all()


@given(COUNTS, st.integers(1, 60), st.integers(0, 1000))
def test_every_photon_is_probed_in_its_turn(counts: dict[int, int], size: int, start: int) -> None:
    groups = make_groups(counts, size=size)
    longest = int(np.diff(groups.first_member).max(initial=0))
    seen = np.zeros(len(groups.member), int)
    for turn in range(start, start + longest):
        probes = groups.probes(turn)
        assert np.array_equal(groups.of_photon[probes], np.arange(groups.count))
        seen[probes] += 1
    of_own = longest / np.diff(groups.first_member)[groups.of_photon]
    assert (seen >= 1).all() and (np.abs(seen - of_own) < 1).all()


def test_directions_of_a_group_are_alike() -> None:
    """Larsen04's 77 groups of 40: most lie within a cone of the solid angle of a few groups."""
    counts = {0: 77 * 40}
    groups = make_groups(counts)
    light, index = all_photons(counts)
    numbers = photon_numbers(light, index.astype(np.uint32), 0)
    direction = sample_sphere(unit_float64(numbers[0]), unit_float64(numbers[1]))
    mean = np.stack([np.bincount(groups.of_photon, direction[:, c]) for c in range(3)], axis=1)
    length = np.sqrt((mean**2).sum(axis=1)) / np.bincount(groups.of_photon)
    assert 60 <= groups.count <= 90
    # 1 is one direction, 0 all of them; a cell of a 72nd of the sphere, as long as it is wide, has 0.97.
    assert np.median(length) > 0.9 and (length > 0.7).mean() > 0.8
