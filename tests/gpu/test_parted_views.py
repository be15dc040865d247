# SPDX-License-Identifier: GPL-3.0-or-later
"""Views of texels that one point does not stand for: each of 2 × 2 pixels is seen from another point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.final_gather.gather import GatherRays
from rtgi_addon.backend.final_gather.views.raster import PARTS
from rtgi_addon.backend.final_gather.views.view import make_view
from rtgi_addon.backend.final_gather.views.view_gather import ViewGather, nothing_bright
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.settings import Gather, SampleCounts
from tests.backend import scenes
from tests.gpu.looks import Look, lifted_box


@pytest.mark.parametrize("kind", [Gather.PLANE, Gather.HEMICUBE])
def test_each_of_four_pixels_is_that_of_a_whole_view_from_its_point(gpu, kind: Gather) -> None:
    look = Look(gpu, *lifted_box(), kind)
    whole = look.eyes(np.arange(0, look.texels.count, 23))
    rng = np.random.default_rng(2)
    opened = rng.random(whole.opened.shape) < 0.6  # some of the points, of some texels none
    whole = replace(whole, opened=opened)
    shown = look.drawn(replace(whole, parted=np.ones(len(opened), np.bool_)))
    row, col = np.indices(shown.shape[1:]) % 2
    for part in range(PARTS):
        mine = (col + 2 * row) == part
        assert np.array_equal(shown[:, mine], look.drawn(whole.from_point(part))[:, mine])


def test_parts_are_seen_from_points_in_the_open_each_in_turn(gpu) -> None:
    look = Look(gpu, *lifted_box())
    eyes = look.eyes(np.arange(3))
    opened = np.zeros((3, 8), np.bool_)
    opened[0, [1, 4, 6]] = True
    opened[1] = True
    eyes = replace(eyes, opened=opened)
    from_points = [eyes.from_point(part).eye for part in range(PARTS)]
    assert np.array_equal([e[0] for e in from_points], eyes.points[0][[1, 4, 6, 1]])
    assert np.array_equal([e[1] for e in from_points], eyes.points[1][:PARTS])


def test_texels_beside_other_geometry_are_parted_and_as_right_as_others(gpu) -> None:
    """At the foot of the blocks light changes within a texel: seen from its middle it would be off by much more."""
    scene, atlas = scenes.cornell(16)
    workers = Workers(2)
    placed = PlacedScene(scene, atlas, scene.first_frame(), (), workers)
    view = make_view(Gather.HEMICUBE, 32)
    gather = ViewGather(placed, gpu, view, workers, memory=1 << 30, coarse={}, seed=0)
    everything = np.arange(gather.count, dtype=np.int32)
    gather.renew(everything)
    known = gather.irradiance()
    parted = gather._eyes(everything).parted
    assert 0.05 < parted.mean() < 0.4
    valid = known.stand_in == everything
    sent = np.random.default_rng(1).random((gather.count, 3)).astype(np.float32)
    lost = known.stand_in < 0
    sent = np.where(lost[:, None], np.float32(0), sent[known.stand_in])  # covered texels show what stands for them
    chosen = np.flatnonzero(valid)[::5]
    rays = GatherRays(
        placed.texels, placed.frame, placed.geometry, placed.surfaces, placed.tracer, None, nothing_bright(placed),
        SampleCounts(2048, 0), max_specular=0, seed=3,
    )  # fmt: skip
    traced = rays.trace(chosen.astype(np.int32))
    weight = traced.weight * traced.usable
    light = sent.take(traced.target, axis=0, mode="clip")
    light[traced.target < 0] = 0
    weight[(traced.target >= 0) & lost.take(traced.target, mode="clip")] = 0
    right = (weight[:, :, None] * light).sum(axis=1) / weight.sum(axis=1, keepdims=True)
    wrong = np.sqrt(((known.irradiance(sent)[chosen] - right) ** 2).mean(axis=1)) / right.mean()
    gather.release()
    assert np.sqrt((wrong[parted[chosen]] ** 2).mean()) < 2 * np.sqrt((wrong[~parted[chosen]] ** 2).mean()) + 0.01
    assert np.sqrt((wrong**2).mean()) < 0.05
