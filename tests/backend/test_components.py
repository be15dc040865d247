# SPDX-License-Identifier: GPL-3.0-or-later
"""Components of surfaces that exchange light, against a plain union-find over a list of links."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.final_gather import components
from rtgi_addon.backend.final_gather.components import SurfaceGraph


def expected_labels(count: int, pairs) -> list[int]:
    parent = list(range(count))

    def root(s: int) -> int:
        while parent[s] != s:
            s = parent[s]
        return s

    for a, b in pairs:
        low, high = sorted((root(a), root(b)))
        parent[high] = low
    roots = [root(s) for s in range(count)]
    numbers = {r: i for i, r in enumerate(sorted(set(roots)))}
    return [numbers[r] for r in roots]


def as_arrays(pairs):
    pairs = np.array(pairs, np.int32).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


@pytest.fixture(params=["dense", "sparse", "sparse, in chunks"])
def kind(request, monkeypatch):
    if request.param != "dense":
        monkeypatch.setattr(components, "DENSE_SURFACES", 0)
    if request.param == "sparse, in chunks":
        monkeypatch.setattr(components, "CHUNK_PAIRS", 3)
    return request.param


COUNT = 9
PAIRS = st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(-1, COUNT - 1)), max_size=25)


@settings(max_examples=60, deadline=None)
@given(steps=st.lists(st.tuples(PAIRS, st.randoms(use_true_random=False)), min_size=1, max_size=5))
@pytest.mark.parametrize("dense, chunk", [(1000, 1 << 21), (0, 1 << 21), (0, 3)])
def test_any_changes(dense, chunk, steps):
    """After any adding and removing: the labels, counts and couplings of the links that are left."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(components, "DENSE_SURFACES", dense)
        patch.setattr(components, "CHUNK_PAIRS", chunk)
        graph, held = SurfaceGraph(COUNT), []
        for added, random in steps:
            graph.add(*as_arrays(added))
            held += added
            random.shuffle(held)
            cut = random.randint(0, len(held))
            graph.remove(*as_arrays(held[:cut]))
            held = held[cut:]
            real = [p for p in held if p[1] >= 0]
            assert graph.labels().tolist() == expected_labels(COUNT, real)
            assert graph.labels().dtype == np.int32
            lit = {graph.labels()[a] for a, _ in real}
            assert graph.coupled().tolist() == [label in lit for label in graph.labels()]
            counts = Counter(real)
            assert all(graph.count(a, b) == counts[a, b] for a in range(COUNT) for b in range(COUNT))


def test_two_rooms_and_a_door(kind):
    """Surfaces 0, 2, 4 in one room, 1, 3 in the other; 5 sees the sky alone."""
    graph = SurfaceGraph(6)
    graph.add(*as_arrays([(0, 2), (2, 4), (4, 0), (1, 3), (3, 1), (5, -1)]))
    assert graph.labels().tolist() == [0, 1, 0, 1, 0, 2]
    assert graph.coupled().tolist() == [True] * 5 + [False]
    graph.add(*as_arrays([(3, 4), (3, 4)]))
    assert graph.labels().tolist() == [0, 0, 0, 0, 0, 1]
    graph.remove(*as_arrays([(3, 4)]))
    assert graph.labels().tolist() == [0, 0, 0, 0, 0, 1]
    graph.remove(*as_arrays([(3, 4)]))
    assert graph.labels().tolist() == [0, 1, 0, 1, 0, 2]


def test_surface_that_sees_only_itself_is_coupled_and_alone(kind):
    graph = SurfaceGraph(3)
    graph.add(*as_arrays([(1, 1)]))
    assert graph.labels().tolist() == [0, 1, 2] and graph.coupled().tolist() == [False, True, False]


def test_labels_are_kept_while_no_pair_appears_or_vanishes(kind, monkeypatch):
    graph = SurfaceGraph(5)
    graph.add(*as_arrays([(0, 1), (0, 1), (2, 3), (4, -1)]))
    first = graph.labels()

    def refuse(*_args, **_kwargs):
        raise AssertionError("nothing to find")

    monkeypatch.setattr(components, "connected_components", refuse)
    graph.add(*as_arrays([(0, 1), (2, 3), (1, -1)]))
    graph.remove(*as_arrays([(0, 1), (2, 3), (4, -1)]))
    graph.remove(*as_arrays([(2, 3)]))  # gone, and back again
    graph.add(*as_arrays([(2, 3)]))
    assert graph.labels() is first
    graph.remove(*as_arrays([(2, 3)]))
    with pytest.raises(AssertionError, match="nothing to find"):
        graph.labels()


def test_rows_against_many_targets(kind):
    """(n, 1) against (n, K), as links are kept."""
    rng = np.random.default_rng(1)
    row = rng.integers(0, 40, (50, 1)).astype(np.int32)
    target = rng.integers(-1, 40, (50, 6)).astype(np.int32)
    graph, flat = SurfaceGraph(40), SurfaceGraph(40)
    graph.add(row, target)
    flat.add(np.repeat(row, 6), target.reshape(-1))
    pairs = [(int(a), int(b)) for a, b in zip(np.repeat(row, 6), target.reshape(-1), strict=True) if b >= 0]
    assert graph.labels().tolist() == flat.labels().tolist() == expected_labels(40, pairs)
    assert all(graph.count(a, b) == flat.count(a, b) == n for (a, b), n in Counter(pairs).items())


def test_removing_what_is_not_there_is_refused_and_changes_nothing(kind):
    graph = SurfaceGraph(4)
    graph.add(*as_arrays([(0, 1), (0, 1), (2, 3)]))
    for wrong in ([(0, 1), (2, 3), (2, 3)], [(0, 1), (1, 0)]):
        with pytest.raises(ValueError, match="more links from surface . to . removed than added"):
            graph.remove(*as_arrays(wrong))
        assert graph.count(0, 1) == 2 and graph.count(2, 3) == 1 and graph.labels().tolist() == [0, 0, 1, 1]
    for row, target in ((4, 0), (-1, 0), (0, 4), (0, -2)):
        with pytest.raises(ValueError, match="are not all within"):
            graph.add(*as_arrays([(row, target)]))


def test_pairs_that_are_gone_take_no_memory(monkeypatch):
    """An object that wanders past ever other surfaces: only the pairs it has are held."""
    monkeypatch.setattr(components, "DENSE_SURFACES", 0)
    graph = SurfaceGraph(1000)
    graph.add(np.zeros(20, np.int32), np.arange(20, dtype=np.int32))
    for first in range(0, 980, 20):
        now = np.arange(first, first + 20, dtype=np.int32)
        graph.remove(np.zeros(20, np.int32), now)
        graph.add(np.zeros(20, np.int32), now + 20)
        assert np.flatnonzero(graph.labels() == 0).tolist() == [0, *(now + 20)]
        assert len(graph._keys) <= 60 and graph.count(0, first + 39) == 1 and graph.count(0, first + 19) == 0


def test_no_surfaces(kind):
    graph = SurfaceGraph(0)
    graph.add(*as_arrays([]))
    assert graph.labels().shape == (0,) and graph.coupled().shape == (0,)


def test_keys_beyond_32_bits():
    """100,000 surfaces: a pair's key needs 34 bits."""
    graph = SurfaceGraph(100_000)
    graph.add(*as_arrays([(99_999, 99_998), (5, 99_998), (99_997, 0)]))
    labels = graph.labels()
    assert labels[99_999] == labels[99_998] == labels[5] == 5 and labels[99_997] == labels[0] == 0
    assert labels.max() == 100_000 - 3 - 1
