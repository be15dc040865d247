# SPDX-License-Identifier: GPL-3.0-or-later
"""Kept gather rays: those of a frame's own trace to the last bit, none traced that no object touches, within memory."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.rooms import turned
from bench.sequences import moved
from rtgi_addon.backend.final_gather import link_gather
from rtgi_addon.backend.final_gather.bright import bright_targets
from rtgi_addon.backend.final_gather.gather import Beyond, GatherRays
from rtgi_addon.backend.final_gather.kept_gather import GatherWork
from rtgi_addon.backend.final_gather.link_store import LinkStore
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.scene import Atlas, Bool, Float32, FrameState, Scene
from rtgi_addon.backend.selection.changes import Change
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import SampleCounts
from tests.backend.acts import ACTS, random_story
from tests.backend.scenes import cornell, translation
from tests.backend.stories import BARE
from tests.backend.test_selection_hard import EXAMPLES

ALL = 1 << 30  # bytes: memory for all links of these scenes
SHORT = 5  # instance of cornell()
FEW = SampleCounts(8, 8)
#: Acts that change what links are, and those that must not.
MOVES = sorted(a for a in ACTS if a.endswith(("moves", "little", "goes", "bends")) and "lamp" not in a)
LIGHTS = ["lamp moves", "lamp changes", "no lamps", "paint", "glow"]


class Set:
    """A scene whose frames follow one another, and the gather rays of the frame it stands in."""

    def __init__(self, scene: Scene, atlas: Atlas, samples: SampleCounts = FEW) -> None:
        self.workers, self.samples = Workers(1), samples
        self.placed = PlacedScene(scene, atlas, scene.first_frame(), (), self.workers)
        self.texels = self.placed.texels
        # Aimed at a few texels of every surface, and at the sky.
        odds = np.random.default_rng(5).random(len(self.placed.emitted)) ** 8
        self.bright = bright_targets([odds], np.zeros(self.texels.count, np.int32))

    def rays(self) -> GatherRays:
        placed = self.placed
        return GatherRays(
            placed.texels, placed.frame, placed.geometry, placed.surfaces, placed.tracer, placed.sky, self.bright,
            self.samples, max_specular=3, seed=0,
        )  # fmt: skip

    def store(self, memory: int = ALL) -> LinkStore:
        """All links, traced now."""
        made = LinkStore(self.rays(), self.workers, memory=memory)
        made.renew(self.rays(), np.arange(self.texels.count, dtype=np.int32))
        return made

    def follow(self, store: LinkStore, state: FrameState) -> Change:
        """Go to ``state`` and mark what that disturbs."""
        change = self.placed.follow(state)
        store.disturb(self.rays(), change.sweep, self.placed.frame.reach)
        return change

    def renew(self, store: LinkStore) -> GatherWork:
        return store.renew(self.rays(), np.flatnonzero(store.pending).astype(np.int32))


def box_set(texels: int = 8, samples: SampleCounts = FEW) -> Set:
    return Set(*cornell(texels, moving=True), samples)


def differing(a: LinkStore, b: LinkStore) -> list[str]:
    """Which of all that is kept differs in any bit."""
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in ("target", "weight", "_distance", "total", "_cut")}
    pairs |= {f.name: (getattr(a.beyond.all, f.name), getattr(b.beyond.all, f.name)) for f in fields(Beyond)}
    pairs |= {name: (getattr(a.graph, name)(), getattr(b.graph, name)()) for name in ("labels", "coupled")}
    pairs["free"] = a.free, b.free
    return [name for name, (x, y) in pairs.items() if x.tobytes() != y.tobytes()]


@given(
    steps=st.lists(st.lists(st.sampled_from(MOVES), min_size=1, max_size=2), min_size=2, max_size=6),
    seed=st.integers(0, 2**16),
    share=st.sampled_from([1.0, 1.0, 0.5, 0.0]),
)
@settings(max_examples=2 * EXAMPLES, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_kept_links_are_those_of_a_fresh_trace(steps: list[list[str]], seed: int, share: float) -> None:
    story = random_story(steps, seed)
    stage = Set(story.scene, story.atlas)
    memory = int(share * stage.store().bytes)
    store = stage.store(memory)
    for state in story.states[1:]:
        if not stage.follow(store, state).rays_hold:
            store = stage.store(memory)
        stage.renew(store)
        assert not (found := differing(store, stage.store(memory))), f"frame {state.frame}: {found}"
        assert not store.pending.any()


@pytest.mark.parametrize("act", LIGHTS)
def test_light_alone_disturbs_no_link(act: str) -> None:
    story = random_story([[act]], 3)
    stage = Set(story.scene, story.atlas)
    store = stage.store()
    change = stage.follow(store, story.states[1])
    if act not in ("paint",):  # on a see-through surface albedo decides which ray goes on
        assert change.rays_hold
    assert not store.pending.any()
    assert stage.renew(store).traced == 0


# --- exactly those that an object touches -----------------------------------------------------------------------------


def meets(origins: Float32, ways: Float32, ends: Float32, triangles: Float32, slack: float) -> Bool:
    """(n,) does origin + [0, end] · way meet any of ``triangles`` (t, 3, 3)? Möller and Trumbore 1997, in float64, of
    triangles and segments longer by ``slack``."""
    o, d = origins.astype(np.float64)[:, None], ways.astype(np.float64)[:, None]
    a, b, c = triangles.astype(np.float64).transpose(1, 0, 2)
    ab, ac = b - a, c - a
    p = np.cross(d, ac)
    det = (p * ab).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((o - a) * p).sum(-1) / det
        q = np.cross(o - a, ab)
        v, t = (d * q).sum(-1) / det, (ac * q).sum(-1) / det
        reached = (t >= -slack) & (t <= ends.astype(np.float64)[:, None] * (1 + slack) + slack)
        return np.asarray((reached & (u >= -slack) & (v >= -slack) & (u + v <= 1 + slack)).any(axis=1))


@pytest.mark.parametrize(
    "first, then",
    [
        (turned(-0.3, 0.35, -0.35, 0.6), turned(0.1, 0.3, -0.3, 0.7)),
        (turned(0.0, 0.35, -0.35, 0.3), turned(0.0, 0.36, -0.35, 0.3)),  # slides on the floor
        (turned(0.2, -0.5, -0.5, 0.9), turned(0.2, 0.6, -0.5, 1.6)),
    ],
)
def test_links_marked_are_those_that_differ_or_meet_the_object(first: np.ndarray, then: np.ndarray) -> None:
    stage = box_set(9, SampleCounts(16, 16))
    scene = stage.placed.scene
    stage.placed.follow(moved(scene, 1, {"short": first}))
    before, store = stage.store(), stage.store()
    rows = stage.placed.geometry.triangles_of(SHORT)
    old = stage.placed.geometry.corners[rows].copy()
    stage.follow(store, moved(scene, 2, {"short": then}))
    new, after, marked, rays = stage.placed.geometry.corners[rows], stage.store(), store._pending.copy(), stage.rays()
    differ = (before.target != after.target) | (before.weight != after.weight)
    differ[:, store._cosine_slots] |= before._distance != after._distance
    assert not (differ & ~marked).any()

    own = stage.texels.instance == SHORT
    # A texel that another surface cuts through decides by all of its rays which part of it is open.
    free = np.flatnonzero(~own & ~before._cut & ~after._cut).astype(np.int32)
    assert len(free) > 300

    def touched(texel, origins, ways, ends) -> Bool:
        return meets(origins, ways, ends, old, 1e-3) | meets(origins, ways, ends, new, 1e-3)

    texel, number = (x.ravel().astype(np.int32) for x in np.meshgrid(free, np.arange(16), indexing="ij"))
    _, origins, ways = rays.cosine_segments(texel, number)
    by_cosine = touched(texel, origins, ways, before._distance[texel, number])
    chosen = marked[texel, store._cosine_slots[number]]
    assert chosen.any() and not (chosen & ~by_cosine).any()
    aim, _, origins, ways = rays.aimed_segments(texel, number)
    at_mover = own[rays.aims.target[aim]]
    by_aim = touched(texel, origins, ways, np.ones(len(texel), np.float32)) | at_mover
    chosen = marked[texel, store._aimed_slots[number]]
    assert chosen.any() and not (chosen & ~by_aim).any()


def test_only_marked_links_are_traced() -> None:
    stage = box_set(12)
    scene = stage.placed.scene
    stage.placed.follow(moved(scene, 1, {"short": turned(0.3, 0.4, -0.4, 0.9)}))
    store = stage.store()
    stage.follow(store, moved(scene, 2, {"short": turned(0.3, 0.41, -0.4, 0.9)}))
    marked, pending = int(np.count_nonzero(store._pending)), store.pending
    work = stage.renew(store)
    assert work.renewed == marked < store.target.size
    assert np.array_equal(work.changed, pending)
    assert work.traced <= marked
    assert 0.02 < marked / store.target.size < 0.35


def test_what_walls_hide_disturbs_nothing() -> None:
    """An object that goes on under the floor: the texels that lost it are traced once, then nobody's but its own."""
    stage = box_set()
    assert stage.bright.probability[:, stage.texels.count :].size == 0
    odds = np.where(stage.texels.instance == SHORT, 0.0, 1.0)  # aims at what moved are traced again wherever it went
    stage.bright = bright_targets([odds], np.zeros(stage.texels.count, np.int32))
    scene, store = stage.placed.scene, stage.store()
    others = stage.texels.instance < SHORT  # the tall block's bottom, in the floor's plane, looks down past it
    for depth, expected in ((-3.0, True), (-2.9, False), (-60.0, False)):
        stage.follow(store, moved(scene, 2, {"short": translation(0.3, -0.3, depth)}))
        assert store.pending[others].any() == expected
        stage.renew(store)
        assert not differing(store, stage.store())


# --- memory -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", [0, 1, 500, 20_000, 54_321, ALL])
def test_links_take_no_more_memory_than_allowed(memory: int) -> None:
    stage = box_set()
    whole, store = stage.store(), stage.store(memory)
    each = whole.bytes // whole.count
    assert each * whole.count == whole.bytes and each == 16 * 9 + 8 * 4
    assert store.bytes <= memory and store.kept == min(whole.count, memory // each)
    for name in ("target", "weight", "_distance"):
        assert getattr(store, name).tobytes() == getattr(whole, name)[: store.kept].tobytes()
    np.testing.assert_array_equal(store.total, whole.total)


def test_stores_of_all_numbers_of_rays_share_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame that tries several numbers of rays keeps the links of all."""
    made: list[LinkStore] = []

    def noted(*arguments, memory: int) -> LinkStore:
        made.append(LinkStore(*arguments, memory=memory))
        return made[-1]

    monkeypatch.setattr(link_gather, "LinkStore", noted)
    scene, atlas = cornell(12, moving=True)
    choice = replace(BARE, resolution=atlas.resolution, target_error=0.04, link_memory=1)
    with Session(scene, atlas, choice, scene.first_frame()) as session:
        session.advance(scene.first_frame())
    assert len(made) > 1 and made[0].kept == made[0].count and 0 < made[1].kept < made[1].count
    assert sum(s.bytes for s in made) <= 1 << 20
