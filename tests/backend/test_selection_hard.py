# SPDX-License-Identifier: GPL-3.0-or-later
"""The law of selection where it is hard: contact, flat and mirrored movers, denoising, a target error, links that are
not kept, threads, and random stories that mix everything."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench import sequences
from bench.rooms import turned
from bench.sequences import FrameSequence
from rtgi_addon.backend.final_gather import link_gather
from rtgi_addon.backend.final_gather.link_store import LinkStore
from rtgi_addon.backend.finish.oidn import find_oidn
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import FrameState, Instance, Material, Scene
from rtgi_addon.backend.settings import AimBounced, AimDirect, Quality
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.tracing import EmbreeTracer
from tests.backend.acts import ACTS, random_story
from tests.backend.scenes import WHITE, box, cornell, grid_atlas, point_light, quad, translation
from tests.backend.stories import (
    BARE,
    assert_lawful,
    bent,
    differences,
    frames,
    number_of,
    placed,
    play,
    settings_of,
    studio,
)
from tests.backend.test_denoise import bpy_libraries

EXAMPLES = int(os.environ.get("RTGI_EXAMPLES", "12"))
needs_oidn = pytest.mark.skipif(find_oidn(bpy_libraries()) is None, reason="no OIDN 2 library in bpy's folder")


def in_the_box(at: Callable[[float], np.ndarray], texels: int = 8, **changed) -> FrameSequence:
    """The box with the short block at ``at(t)``; ``changed`` values of its instance. It is 0.6 m wide and high."""
    scene, atlas = cornell(texels, moving=True)
    instances = tuple(replace(i, **changed) if i.name == "short" else i for i in scene.instances)
    scene = replace(scene, instances=instances)
    return FrameSequence("box", "", scene, atlas, placed(scene, lambda t: {"short": at(t)}))


def scaled(x: float, y: float, z: float, place: tuple[float, float, float] = (0.35, -0.35, 0.3)) -> np.ndarray:
    return translation(*place) @ np.diag([x, y, z, 1.0])


def twins(t: float = 0.0) -> FrameSequence:
    """Two instances of one deforming box, one of them turned, in the box with the tall block."""
    base, _ = cornell(6)
    meshes = (*base.meshes[:5], box("soft", (0.5, 0.5, 0.5), texels=3))
    matrices = [np.eye(4)] * 5 + [translation(-0.4, -0.3, 0.25), turned(0.7, 0.4, 0.3, 0.8)]
    instances = tuple(
        Instance(f"part {i}", min(i, 5), matrix, deforming=i > 4, moving=i == 6) for i, matrix in enumerate(matrices)
    )
    scene = Scene(meshes, instances, base.materials, base.lights)

    def state(frame: int, t: float) -> FrameState:
        vertices, normals = bent(meshes[5], float(np.sin(6 * t)))
        matrix = scene.first_frame().matrix_world
        matrix[6] = turned(0.7 + t, 0.4, 0.3, 0.8)
        return replace(
            scene.first_frame(frame), matrix_world=matrix, vertices={5: vertices}, corner_normals={5: normals}
        )

    return FrameSequence("twins", "", scene, grid_atlas(scene, [(6, 6)] * 5 + [(15, 10)] * 2), frames(state))


def crowd() -> FrameSequence:
    """All that can move in the studio moves at once, and the lamp too."""
    scene, atlas = studio()

    def state(frame: int, t: float) -> FrameState:
        matrices = scene.first_frame().matrix_world
        for name, way in {"short": (0, 1, 0), "glass": (1, 0, 0), "pane": (0, 0, 0.6), "glow": (-1, 0, 1)}.items():
            matrices[number_of(scene, name), :3, 3] += 0.6 * t * np.array(way)
        flap = number_of(scene, "flap")
        vertices, normals = bent(scene.meshes[flap], t)
        lamps = (point_light((0.3 * t, 0, 1.9 - t), 40.0), *scene.lights[1:])
        return replace(
            scene.first_frame(frame), matrix_world=matrices, lights=lamps,
            vertices={flap: vertices}, corner_normals={flap: normals},
        )  # fmt: skip

    return FrameSequence("crowd", "", scene, atlas, frames(state))


def guest() -> FrameSequence:
    """A black crumb close to the lamp, that no wall sees, leaves a closed room and comes back: the walls' links and
    direct light stay as they are, but they are no longer solved with the crumb."""
    meshes = (box("room", (2, 2, 2), texels=6, inward=True), box("crumb", (0.01, 0.01, 0.01), texels=2, material=1))
    instances = (Instance("room", 0, np.eye(4)), Instance("crumb", 1, translation(0, 0, 0.5), moving=True))
    black = Material("black", (0.0, 0.0, 0.0))
    lamp = replace(point_light((0, 0, 0.53), 50.0), casts_shadow=False)
    scene = Scene(meshes, instances, (WHITE, black), (lamp,))
    atlas = grid_atlas(scene, [(24, 16), (12, 8)])
    states = placed(scene, lambda t: {"crumb": translation(0, 0.02 * t, 90.0 if 0.3 < t < 0.6 else 0.5)})
    return FrameSequence("guest", "", scene, atlas, states)


HARD: dict[str, Callable[[], FrameSequence]] = {
    "slides on the floor": lambda: in_the_box(lambda t: turned(0.0, 0.5 - t, -0.6, 0.3), 11),
    "slides along texel borders and the wall": lambda: in_the_box(lambda t: turned(0.0, 0.7, 0.7 - t, 0.3), 10),
    "rests, lifts off and comes back": lambda: in_the_box(lambda t: turned(-0.3, 0.35, -0.35, 0.3 + 4 * t * (1 - t))),
    "sinks into the floor": lambda: in_the_box(lambda t: turned(0.4, 0.35, -0.35, 0.3 - 0.7 * t)),
    "slides along the tall block": lambda: in_the_box(lambda t: turned(0.3, -0.35 + t, 0.3 + 0.3 * t, 0.3)),
    "passes through a wall": lambda: in_the_box(lambda t: turned(0.2, 0.3 + 1.2 * t, 0.0, 0.6)),
    "leaves the scene": lambda: in_the_box(lambda t: turned(t, 0.3, -0.4 - 60 * t**3, 0.6 + 3 * t)),
    "shrinks to nothing": lambda: in_the_box(lambda t: scaled(*[max(0.0, 1 - 1.5 * t)] * 3)),
    "is flattened, and turned inside out": lambda: in_the_box(lambda t: scaled(1, 1, round(1 - 2 * t, 1))),
    "grows around everything": lambda: in_the_box(lambda t: scaled(*[1 + 8 * t] * 3, (0.1, 0.1, 0.8))),
    "swallows the lamp": lambda: in_the_box(lambda t: translation(0, 0.8 * t - 0.4, 1.75)),
    "blocks no light": lambda: in_the_box(lambda t: turned(t, t - 0.5, -0.5, 0.3), blocks_light=False),
    "has no texels": lambda: in_the_box(lambda t: turned(t, t - 0.5, -0.5, 0.3), receives_light=False),
    "twins that deform": twins,
    "a crowd": crowd,
    "a guest leaves": guest,
}


@pytest.mark.parametrize("name", HARD)
def test_hard_movers(name: str) -> None:
    story = HARD[name]()
    assert_lawful(story, settings_of(story))


@needs_oidn
@pytest.mark.parametrize("name", ["mover", "lamp", "door", "closed", "crowd"])
def test_denoised(name: str) -> None:
    size = {"mover": 6, "lamp": 6, "door": 3.0, "closed": 3.0}
    make = {"mover": sequences.rigid_mover, "lamp": sequences.moving_lamp, "door": sequences.door}
    make |= {"closed": sequences.closed_rooms}
    story = crowd() if name == "crowd" else make[name](size[name])
    assert_lawful(story, replace(settings_of(story), denoise=True), alone=(7,), oidn=bpy_libraries())


def test_a_target_error_asks_for_other_rays_in_other_frames() -> None:
    """The bare block hides the lamp from more and more of the box: noise, and with it the rays, differ."""
    story = in_the_box(lambda t: translation(0, 0, 0.4 + 1.2 * t), 4)
    results = assert_lawful(story, replace(settings_of(story), target_error=0.1), alone=(13,))
    assert len({r.stats.cosine_rays for r in results}) > 1
    assert all(r.stats.estimated_error <= 0.1 for r in results)


@pytest.mark.parametrize("share", [0.0, 0.4])
@pytest.mark.parametrize("name", ["box", "studio", "door"])
def test_links_that_are_not_kept(name: str, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """With memory for a ``share`` of the links frames obey the same law, and have the bits of those with memory for
    all: what is kept is a matter of time alone."""
    make = {"box": lambda: in_the_box(lambda t: turned(t, t - 0.5, -0.5, 0.3), 5), "studio": crowd}
    story = {**make, "door": lambda: sequences.door(2.0)}[name]()
    choice, order = settings_of(story), (0, 1, 12, 13, 23, 12, 12, 0)
    kept_all = play(story, choice, order)
    stores: list[LinkStore] = []

    def limited(rays, workers, *, memory: int) -> LinkStore:
        whole = LinkStore(rays, workers, memory=memory)
        stores.append(LinkStore(rays, workers, memory=int(share * whole.bytes)))
        return stores[-1]

    monkeypatch.setattr(link_gather, "LinkStore", limited)
    results = assert_lawful(story, choice, order=order, alone=(13,))
    assert stores and all(0 <= s.kept <= share * s.count for s in stores)
    for some, every in zip(results, kept_all, strict=True):
        assert not (found := differences(some.maps, every.maps)), found


@pytest.mark.parametrize("bounced", [AimBounced.FEEDBACK, AimBounced.PHOTONS])
def test_threads_change_no_bit(bounced: AimBounced) -> None:
    story, order = crowd(), (0, 1, 2, 12, 23, 3)
    one, two = (
        play(story, replace(settings_of(story), threads=n, aim_bounced=bounced), order) for n in (1, 2)
    )  # fmt: skip
    for a, b in zip(one, two, strict=True):
        assert not differences(a.maps, b.maps)
        assert replace(a.stats, seconds={}) == replace(b.stats, seconds={})


# --- random stories ---------------------------------------------------------------------------------------------------


@given(
    steps=st.lists(st.lists(st.sampled_from(sorted(ACTS)), min_size=1, max_size=3), min_size=2, max_size=7),
    seed=st.integers(0, 2**16),
    bounced=st.sampled_from([AimBounced.FEEDBACK, AimBounced.FEEDBACK, AimBounced.PHOTONS]),
    direct=st.sampled_from([AimDirect.SHADOW_RAYS, AimDirect.SHADOW_RAYS, AimDirect.PHOTONS]),
    quality=st.sampled_from([Quality.DRAFT, Quality.PREVIEW]),
    target=st.sampled_from([None, None, 0.2]),
    threads=st.sampled_from([1, 2]),
)
@settings(max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_random_stories(steps, seed, bounced, direct, quality, target, threads) -> None:
    story = random_story(steps, seed)
    choice = replace(
        BARE, resolution=max(16, story.atlas.resolution), aim_bounced=bounced, aim_direct=direct, quality=quality,
        target_error=target, threads=threads, seed=seed,
    )  # fmt: skip
    count = len(story.states)
    order = [*range(count), *np.random.default_rng(seed).integers(0, count, 4).tolist()]
    assert_lawful(story, choice, order=order, alone=(count - 1,))


def test_thousands_of_movers_are_no_crash() -> None:
    """Each has an Embree scene of its own."""
    chip, count = quad("chip", [(0, 0, 0), (0.5, 0, 0), (0.5, 0.5, 0), (0, 0.5, 0)]), 2500
    instances = tuple(Instance(f"chip {i}", 0, translation(i, 0, 0), moving=True) for i in range(count))
    scene = Scene((chip,), instances, (WHITE,))
    state, workers = scene.first_frame(), Workers(1)
    geometry = Geometry(scene, state)
    tracer = EmbreeTracer(scene, geometry, state, workers)
    chosen = np.array([0, 1100, 2499])
    origins = np.stack([chosen + 0.25, chosen * 0 + 0.25, chosen * 0 + 1.0], axis=1) - geometry.origin
    hits = tracer.intersect(origins.astype(np.float32), np.tile(np.float32([0, 0, -1]), (3, 1)))
    np.testing.assert_array_equal(hits.triangle // 2, chosen)
