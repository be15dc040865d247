# SPDX-License-Identifier: GPL-3.0-or-later
"""Live sessions: bounded work a frame, nobody starves, nothing pops, and at rest the bits of a batch frame."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench import sequences
from bench.rooms import turned
from bench.sequences import FrameSequence
from rtgi_addon.backend.final_gather import lighting
from rtgi_addon.backend.final_gather.link_store import LinkStore
from rtgi_addon.backend.live import LiveSession
from rtgi_addon.backend.scene import FrameState
from rtgi_addon.backend.selection.schedule import within
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import AimBounced, AimDirect, BakeSettings, Budget, Caustics, LiveSettings, Selection
from tests.backend.acts import ACTS, random_story
from tests.backend.scenes import cornell, point_light, translation
from tests.backend.stories import BARE, differences, lit, placed, play, settings_of, studio
from tests.backend.test_selection_hard import crowd

STILL = 40  # frames of rest at most


def sliding(texels: int = 8) -> FrameSequence:
    scene, atlas = cornell(texels, moving=True)
    return FrameSequence(
        "slides", "", scene, atlas, placed(scene, lambda t: {"short": turned(t, 0.5 - t, -0.4, 0.3 + t)})
    )


@contextmanager
def live_session(
    story: FrameSequence, choice: BakeSettings, live: LiveSettings
) -> Iterator[Callable[[FrameState], object]]:
    with Session(story.scene, story.atlas, choice, story.states[0], guide=story.guide[::4], live=live) as session:
        yield session.advance


def assert_rests(
    story: FrameSequence, choice: BakeSettings, live: LiveSettings, moves: range, frames: int = STILL
) -> None:
    """After the frames ``moves`` and ``frames`` of rest a live session shows what a batch session does, and stays."""
    wanted = play(story, choice, [moves[-1]])[0].maps
    with live_session(story, choice, live) as advance:
        for n in moves:
            lagging = advance(story.states[n])
        assert differences(lagging.maps, wanted), "the budget was no limit, so that this shows nothing"
        for _ in range(frames):
            resting = advance(story.states[moves[-1]])
        assert resting.stats.texels_pending == 0
        assert not (found := differences(resting.maps, wanted)), found
        after = advance(story.states[moves[-1]])
    assert after.stats.rays == 0 and after.stats.texels_updated == 0 and not differences(after.maps, wanted)


STORIES: dict[str, Callable[[], FrameSequence]] = {
    "slides": sliding,
    "crowd": crowd,
    "door": lambda: sequences.door(3.0),
    "deforming": lambda: sequences.deforming(6),
    "appears": lambda: sequences.appearing(8),
}


@pytest.mark.parametrize("threshold", [1e-3, 10.0])
@pytest.mark.parametrize("name", STORIES)
def test_at_rest_links_become_those_of_a_batch_frame(name: str, threshold: float) -> None:
    story = STORIES[name]()
    live = LiveSettings(Budget(texels=40), threshold=threshold, patience=3)
    moves = range(6, 9) if name == "appears" else range(6, 14)
    assert_rests(story, settings_of(story), live, moves)


@pytest.mark.parametrize("name", ["slides", "crowd"])
@pytest.mark.parametrize("direct", [AimDirect.SHADOW_RAYS, AimDirect.PHOTONS])
def test_at_rest_photons_become_those_of_a_batch_frame(name: str, direct: AimDirect) -> None:
    story = STORIES[name]()
    choice = replace(settings_of(story), aim_bounced=AimBounced.PHOTONS, aim_direct=direct)
    assert_rests(story, choice, LiveSettings(Budget(texels=60), photons=60, patience=3), range(6, 14))


@given(
    steps=st.lists(st.lists(st.sampled_from(sorted(ACTS)), min_size=1, max_size=2), min_size=2, max_size=6),
    seed=st.integers(0, 2**16),
    texels=st.sampled_from([30, 100, None]),
    photons=st.sampled_from([40, None]),
    bounced=st.sampled_from([AimBounced.FEEDBACK, AimBounced.PHOTONS]),
    patience=st.sampled_from([0, 2, 9]),
)
@settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_at_rest_after_any_story(steps, seed, texels, photons, bounced, patience) -> None:
    story = random_story(steps, seed)
    choice = replace(BARE, resolution=max(16, story.atlas.resolution), aim_bounced=bounced)
    live = LiveSettings(Budget(texels=texels), photons=photons, patience=patience)
    last = len(story.states) - 1
    wanted = play(story, choice, [last])[0].maps
    with live_session(story, choice, live) as advance:
        for state in (*story.states, *[story.states[last]] * STILL):
            result = advance(state)
    assert result.stats.texels_pending == 0
    assert not (found := differences(result.maps, wanted)), found


@pytest.mark.parametrize("name", ["slides", "crowd"])
def test_probing_lags_and_ends_at_the_same_bits(name: str) -> None:
    """Each photon of a group is a probe once in as many frames as the group has photons."""
    story = STORIES[name]()
    choice = replace(settings_of(story), aim_bounced=AimBounced.PHOTONS)
    wanted = play(story, choice, [7])[0].maps
    lagging = play(story, replace(choice, selection=Selection.PROBE), [0, *range(1, 8), *[7] * 45])
    assert differences(lagging[7].maps, wanted)
    assert not (found := differences(lagging[-1].maps, wanted)), found


# --- budgets ----------------------------------------------------------------------------------------------------------


@dataclass
class Line:
    """What one live session's links wait for, frame by frame."""

    pending: np.ndarray | None = None  # (n,) once the frame's movement is known
    parts: list[np.ndarray] = field(default_factory=list)  # of texels brought up to date in it

    def watch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        disturb, renew = LinkStore.disturb, LinkStore.renew

        def disturbed(store, *args):
            tested = disturb(store, *args)
            self.pending = store.pending
            return tested

        def renewing(store, rays, texel):
            self.parts.append(texel)
            return renew(store, rays, texel)

        monkeypatch.setattr(LinkStore, "disturb", disturbed)
        monkeypatch.setattr(LinkStore, "renew", renewing)

    def read(self) -> tuple[np.ndarray | None, list[np.ndarray]]:
        """(pending, parts) of the frame since the last call."""
        read = self.pending, self.parts
        self.pending, self.parts = None, []
        return read


@pytest.mark.parametrize("budget, patience", [(25, 4), (60, 0), (150, 30)])
def test_no_frame_exceeds_its_texels_and_none_starves(budget: int, patience: int, monkeypatch) -> None:
    """A texel first pending in frame f with W pending is updated by frame f + patience + ⌈W / B⌉ - 1, although the
    block moves on in every frame (see ``UpdateSchedule``)."""
    story, line = sliding(10), Line()
    line.watch(monkeypatch)
    live = LiveSettings(Budget(texels=budget), threshold=0.3, patience=patience)
    ends, since, updated = {}, {}, 0
    with live_session(story, settings_of(story), live) as advance:
        for f, state in enumerate((*story.states, *story.states[-2::-1], *story.states[1:])):
            result = advance(state)
            pending, parts = line.read()
            if f == 0:
                assert pending is None  # the first frame is lit whole
                continue
            renewed = np.concatenate([np.zeros(0, np.int32), *parts])
            assert len(renewed) == len(set(renewed.tolist())) <= budget
            assert result.stats.texels_pending == np.count_nonzero(pending) - len(renewed)
            for t in np.flatnonzero(pending).tolist():
                since.setdefault(t, f)
                ends.setdefault(t, f + patience + math.ceil(np.count_nonzero(pending) / budget) - 1)
            for t in renewed.tolist():
                since.pop(t), ends.pop(t)
                updated += 1
            late = {t: (since[t], f) for t, end in ends.items() if f >= end}
            assert not late
    assert updated > 20 * min(budget, 25)


def test_no_frame_traces_more_photons_than_allowed() -> None:
    story = crowd()
    choice = replace(settings_of(story), aim_bounced=AimBounced.PHOTONS, photons=3000)
    with live_session(story, choice, LiveSettings(photons=100)) as advance:
        first, *others = [advance(state).stats for state in story.states[:12]]
    assert first.photons_traced >= 3000
    # Photons for the AIM and for caustics are two sets, each with the budget.
    assert all(100 <= s.photons_traced <= 200 for s in others)


def test_time_for_nothing_still_brings_one_part_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    story, line = sliding(), Line()
    line.watch(monkeypatch)
    monkeypatch.setattr(lighting, "within", functools.partial(within, chunk=32))
    live = LiveSettings(Budget(milliseconds=0.0), patience=2)
    assert_rests(story, settings_of(story), live, range(6, 14))
    with live_session(story, settings_of(story), live) as advance:
        advance(story.states[0])
        for state in story.states[1:]:
            line.read()
            advance(state)
            _, parts = line.read()
            assert len(parts) == 1 and len(parts[0]) == 32


# --- what follows at once ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["box", "studio"])
def test_moved_lamps_over_still_geometry_follow_at_once(name: str) -> None:
    """With the smallest budget every frame is the batch frame: no gather ray is to be traced."""
    scene, atlas = studio() if name == "studio" else cornell(7, moving=True)
    story = FrameSequence(
        name, "", scene, atlas, lit(scene, lambda t: (point_light((0.9 * t - 0.4, 0.3, 1.7), 30 + 9 * t),))
    )  # fmt: skip
    choice = replace(settings_of(story), caustics=Caustics.OFF)  # photons have a budget of their own
    chosen = (0, 5, 6, 20, 1)
    with live_session(story, choice, LiveSettings(Budget(texels=1))) as advance:
        for n, batch in zip(chosen, play(story, choice, chosen), strict=True):
            result = advance(story.states[n])
            assert not (found := differences(result.maps, batch.maps)), found
            assert result.stats.links_traced == 0 or n == 0


def test_direct_light_of_a_mover_follows_at_once() -> None:
    """Lamps' light, AIM less IIM, is that of the frame; only the bounced light lags."""
    story = sliding()
    choice, live = settings_of(story), LiveSettings(Budget(texels=5), patience=9)
    with live_session(story, choice, live) as advance:
        for n, batch in enumerate(play(story, choice, range(6))):
            now = advance(story.states[n]).maps
            both = now.valid & batch.maps.valid
            direct, wanted = (m.aim[both] - m.iim[both] for m in (now, batch.maps))
            # The solver's last digits are in both maps.
            np.testing.assert_allclose(direct, wanted, atol=2e-3 * float(batch.maps.aim.max()))


# --- blending ---------------------------------------------------------------------------------------------------------


def test_what_is_shown_never_steps() -> None:
    """Maps shown move by no more than dt / blend time of what separates the sets they lie between."""
    story, blend, step = sliding(), 0.2, 0.004
    live = LiveSettings(Budget(texels=100), patience=2, blend_time=blend)
    with LiveSession(
        story.scene, story.atlas, settings_of(story), live, story.states[0], guide=story.guide
    ) as session:  # fmt: skip
        with pytest.raises(ValueError, match="advance first"):
            session.maps(0.0)
        made = [session.advance(story.states[0], 0.0).maps]
        assert not differences(session.maps(0.0), made[0])
        shown, moved = session.maps(0.0), 0.0
        for n in range(1, 60):
            time = n * step
            if n % 12 == 0:
                made.append(session.advance(story.states[n // 12 + 3], time).maps)
            now = session.maps(time)
            for name in ("iim", "aim"):
                pages = np.stack([getattr(m, name) for m in made])
                apart = pages.max(axis=0) - pages.min(axis=0)
                change = np.abs(getattr(now, name) - getattr(shown, name))
                assert (change <= apart * (step / blend) * (1 + 1e-3) + 1e-5 * pages.max()).all()
                moved += float(change.sum())
            shown = now
        assert moved > 0
        assert not differences(session.maps(60 * step + blend), made[-1])


def test_a_block_that_vanishes_and_comes_back_between_two_frames_leaves_no_trace() -> None:
    """Interrupted updates: where the scene is as it was before, the maps are as well, once all is up to date."""
    story = sliding()
    far = replace(story.states[0], visible=np.arange(7) != 5)
    shifted = replace(story.states[0], matrix_world=story.states[0].matrix_world.copy())
    shifted.matrix_world[5] = translation(-0.5, -0.5, 1.0)
    with live_session(story, settings_of(story), LiveSettings(Budget(texels=20), patience=1)) as advance:
        first = advance(story.states[0]).maps
        for state in (far, shifted, far, shifted, far):
            advance(state)
        for _ in range(STILL):
            last = advance(story.states[0])
    assert not differences(last.maps, first)
