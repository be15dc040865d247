# SPDX-License-Identifier: GPL-3.0-or-later
"""Gather AUTO: what it measures, what it takes, where it notes it. Views are made up here, so no OpenGL is needed."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from rtgi_addon.backend.final_gather import gathers
from rtgi_addon.backend.final_gather.bright import bright_targets, bright_weight
from rtgi_addon.backend.final_gather.choice import Choice, ChoiceFile, Makers, choose, scene_class
from rtgi_addon.backend.final_gather.gather import GatherRays
from rtgi_addon.backend.final_gather.radiosity import sent_by_targets
from rtgi_addon.backend.final_gather.views.view_gather import view_size
from rtgi_addon.backend.gpu.context import GpuUnavailable
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.scene import Material
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import BakeSettings, Gather, SampleCounts
from tests.backend.scenes import cornell
from tests.backend.test_session import sphere_room

SAMPLES = SampleCounts(8, 8)


class Trials:
    """A lit scene, and views of it that take ``microseconds`` a texel and err by ``error`` at 16 pixels."""

    def __init__(self, microseconds: float, error: float) -> None:
        scene, atlas = cornell(24)
        self.placed = PlacedScene(scene, atlas, scene.first_frame(), (), Workers(1))
        rng = np.random.default_rng(5)
        light = rng.random((self.placed.texels.count, 3), np.float32)
        self.sent = sent_by_targets(light, self.placed.albedo, self.placed.emitted)
        placed = self.placed
        weight = bright_weight(self.sent, placed.frame.area, None, placed.geometry.extent)
        self.bright = bright_targets([weight], np.zeros(placed.texels.count, np.int32))
        self.microseconds, self.error = microseconds, error
        self.sizes: list[tuple[Gather, int]] = []

    def rays(self, samples: SampleCounts, seed: int) -> GatherRays:
        p = self.placed
        return GatherRays(
            p.texels, p.frame, p.geometry, p.surfaces, p.tracer, None, self.bright, samples, max_specular=0, seed=seed
        )

    @contextmanager
    def views(self, kind: Gather, size: int) -> Iterator[Trials]:
        self.sizes.append((kind, size))
        self.size = size
        yield self

    def lit_once(self, texel, sent, products):
        """The right irradiance, off by an error that halves with each doubling of the size."""
        from rtgi_addon.backend.final_gather.choice import RIGHT, _lit_by_links

        right, _ = _lit_by_links(self.rays(RIGHT, 1), texel, sent, Workers(1))
        off = 1 + self.error * 16 / self.size
        return right * np.float32(off), self.microseconds * 1e-6 * len(texel) * (self.size / 16) ** 2

    def choose(self, *kinds: Gather) -> Choice:
        return choose(self.placed, self.sent, SAMPLES, Makers(self.rays, self.views, Workers(1)), kinds, "a card")


def test_fast_and_right_views_are_taken_and_the_reason_tells_the_figures() -> None:
    trials = Trials(microseconds=0.001, error=0.0)
    choice = trials.choose(Gather.HEMICUBE)
    assert choice.gather is Gather.HEMICUBE and choice.renderer == "a card"
    assert choice.scale * view_size(SAMPLES) == trials.sizes[0][1]
    for word in ("a card", "hemicube", "links 16 rays", "µs", "%"):
        assert word in choice.reason


def test_a_view_grows_until_it_is_as_right_as_links() -> None:
    trials = Trials(microseconds=0.0001, error=0.5)
    choice = trials.choose(Gather.HEMICUBE)
    sizes = [size for _, size in trials.sizes]
    assert sizes == [8 << k for k in range(len(sizes))] and len(sizes) > 2
    assert choice.gather is Gather.HEMICUBE and choice.scale * view_size(SAMPLES) == sizes[-1]


def test_slow_views_are_tried_once_and_links_taken() -> None:
    trials = Trials(microseconds=1e6, error=0.0)
    choice = trials.choose(Gather.RAYS, Gather.HEMICUBE, Gather.PLANE)
    assert choice.gather is Gather.LINKS and choice.scale == 1.0
    assert [kind for kind, _ in trials.sizes] == [Gather.RAYS, Gather.HEMICUBE, Gather.PLANE]


def test_fast_but_wrong_views_are_not_taken() -> None:
    assert Trials(microseconds=0.0001, error=100.0).choose(Gather.PLANE).gather is Gather.LINKS


def test_without_light_nothing_is_measured() -> None:
    trials = Trials(1.0, 0.0)
    trials.sent = np.zeros_like(trials.sent)
    assert trials.choose(Gather.PLANE).gather is Gather.LINKS and not trials.sizes


def test_scenes_of_a_size_are_one_class_and_others_are_not() -> None:
    def key(texels: int, samples: SampleCounts = SAMPLES) -> str:
        scene, atlas = cornell(texels)
        return scene_class(PlacedScene(scene, atlas, scene.first_frame(), (), Workers(1)), samples)

    assert key(24) == key(25) != key(48)
    assert key(24) != key(24, SampleCounts(32, 32))


# --- the file ---------------------------------------------------------------------------------------------------------


def test_what_is_noted_is_read_again_and_nothing_else_is_left(tmp_path: Path) -> None:
    file = ChoiceFile(tmp_path / "new folder" / "gathers.json")
    first, second = Choice(Gather.RAYS, "why", 2.0, "a card"), Choice(Gather.LINKS, "µs")
    file.note("a", first)
    file.note("b", second)
    assert file.get("a") == first and file.get("b") == second and file.get("c") is None
    assert os.listdir(file.path.parent) == ["gathers.json"]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"version": 0, "choices": {"a": {}}}', '{"version": 1, "choices": {"a": {"gather": "x"}}}']
)
def test_a_file_that_makes_no_sense_is_as_none_and_is_made_anew(tmp_path: Path, text: str) -> None:
    file = ChoiceFile(tmp_path / "gathers.json")
    file.path.write_text(text)
    assert file.get("a") is None
    file.note("a", Choice(Gather.LINKS, "why"))
    assert file.get("a") == Choice(Gather.LINKS, "why")


def test_a_folder_that_cannot_be_made_is_no_fault(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    file = ChoiceFile(tmp_path / "file" / "gathers.json")
    file.note("a", Choice(Gather.LINKS, "why"))
    assert file.get("a") is None


# --- in a session -----------------------------------------------------------------------------------------------------


def frame_of(choices: ChoiceFile | None, room=None, **options):
    scene, atlas = room or cornell(12)
    settings = BakeSettings(resolution=max(atlas.resolution, 16), quality="draft", denoise=False, **options)
    with Session(scene, atlas, settings, scene.first_frame(), choices=choices) as session:
        return session.advance(scene.first_frame())


def no_gpu(**options: object) -> None:
    raise GpuUnavailable("no driver here")


def test_without_a_gpu_links_are_taken_without_a_word_but_the_reason(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(gathers, "open_gpu", no_gpu)
    file = ChoiceFile(tmp_path / "gathers.json")
    stats = frame_of(file).stats
    assert stats.gather == "links" and stats.gather_reason == "no GPU: no driver here" and stats.device == "cpu"
    assert not stats.warnings
    assert not file.path.exists()  # a GPU may come


def test_links_that_are_noted_open_no_gpu(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(gathers, "open_gpu", no_gpu)
    file = ChoiceFile(tmp_path / "gathers.json")
    scene, atlas = cornell(12)
    placed = PlacedScene(scene, atlas, scene.first_frame(), (), Workers(0))
    file.note(scene_class(placed, SampleCounts(8, 8)), Choice(Gather.LINKS, "measured before"))
    assert frame_of(file).stats.gather_reason == "measured before"


def test_links_are_taken_unmeasured_where_views_would_leave_light_out(tmp_path: Path) -> None:
    scene, atlas = sphere_room(0.5)
    mirror = type(scene)(scene.meshes, scene.instances, (Material("Mirror", specular=(0.5,) * 3),), scene.lights)
    reason = frame_of(ChoiceFile(tmp_path / "gathers.json"), (mirror, atlas)).stats.gather_reason
    assert reason.startswith("Mirror: only links")


@pytest.mark.parametrize("options, reason", [({}, "no file of choices"), ({"device": "cpu"}, "the CPU")])
def test_the_library_measures_nothing_unasked(options: dict, reason: str) -> None:
    stats = frame_of(None, **options).stats
    assert stats.gather == "links" and reason in stats.gather_reason


def test_the_file_is_json_that_a_person_can_read(tmp_path: Path) -> None:
    file = ChoiceFile(tmp_path / "gathers.json")
    file.note("2 threads: 64 triangles", Choice(Gather.LINKS, "measured"))
    known = json.loads(file.path.read_text())
    assert known["choices"]["2 threads: 64 triangles"]["gather"] == "links"
