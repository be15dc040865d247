# SPDX-License-Identifier: GPL-3.0-or-later
"""The bench of animation: its sequences are what they are called, its arithmetic is right, its report says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench import larsen_tables
from bench.animation import KINDS, FramesResult, LarsenResult, ScalingResult
from bench.document import read_parts, write_part
from bench.errors import Errors
from bench.flicker import Flicker, excess_change
from bench.frames import Cost, Played, converge, difference, play
from bench.larsen_tables import FinalGather, LookUp, gathered
from bench.report_frames import write_frames, write_larsen, write_scaling
from bench.report_plots import short
from bench.results import Machine
from bench.rooms import bumpy_cornell, hall, two_rooms
from bench.scaling import Point, Sweep, slope
from bench.sequences import SEQUENCES, FrameSequence, closed_rooms, rigid_mover
from rtgi_addon.backend.final_gather.bright import bright_targets
from rtgi_addon.backend.final_gather.gather import GatherRays
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import BLACK, Float64, FrameState, Instance, Scene
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import BakeSettings, Quality, SampleCounts
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.texels import make_texels
from tests.backend.rig import make_rig
from tests.backend.scenes import WHITE, box, grid_atlas

#: What each sequence changes, of what a frame's state holds.
CHANGES = {
    "mover": {"matrix_world"},
    "slow": {"matrix_world"},
    "deforming": {"vertices"},
    "lamp": {"lights"},
    "off": {"lights"},
    "appears": {"visible"},
    "door": {"matrix_world"},
    "closed": {"matrix_world"},
    "still": set(),
    "larsen": {"matrix_world"},
}


def lamps_of(state: FrameState) -> list[tuple[str, tuple[float, float, float], list[float]]]:
    return [(lamp.name, lamp.power, lamp.matrix_world.ravel().tolist()) for lamp in state.lights]


def corners_of(sequence: FrameSequence, state: FrameState, instance: int) -> Float64:
    """(v, 3) m world."""
    number = sequence.scene.instances[instance].mesh
    vertices = state.vertices.get(number, sequence.scene.meshes[number].vertices)
    matrix = state.matrix_world[instance]
    return vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("name", SEQUENCES)
def test_a_sequence_changes_what_it_says_and_nothing_else(name):
    sequence = SEQUENCES[name]()
    assert [s.frame for s in sequence.states] == list(range(1, 25))
    first, changed = sequence.states[0], set()
    for state in sequence.states[1:]:
        changed |= {k for k in ("matrix_world", "visible") if not np.array_equal(getattr(state, k), getattr(first, k))}
        changed |= {"lights"} if lamps_of(state) != lamps_of(first) else set()
        if any(not np.array_equal(v, first.vertices[k]) for k, v in state.vertices.items()):
            changed |= {"vertices"}
        for i, instance in enumerate(sequence.scene.instances):
            assert instance.moving or np.array_equal(state.matrix_world[i], first.matrix_world[i]), instance.name
    assert changed == CHANGES[name]


@pytest.mark.parametrize("name", [n for n, what in CHANGES.items() if what & {"matrix_world", "vertices"}])
def test_movers_stay_in_their_room_and_out_of_other_objects(name):
    sequence = SEQUENCES[name]()
    movers = [i for i, x in enumerate(sequence.scene.instances) if x.moving or x.deforming]
    inside = {"door": ((-0.06, -9, -9), (0.06, 9, 9)), "closed": ((-2.06, -1, 0), (-0.06, 1, 2))}
    low, high = inside.get(name, ((-1, -1, 0), (1, 1, 2)))
    others = [i for i, m in enumerate(sequence.scene.instances) if i not in movers and m.name in {"tall", "B block"}]
    for state in sequence.states:
        boxes = [corners_of(sequence, state, i) for i in movers + others]
        for mover, points in zip(movers, boxes, strict=False):
            assert (points >= np.array(low) - 1e-6).all() and (points <= np.array(high) + 1e-6).all(), state.frame
            for other, its in zip(movers + others, boxes, strict=True):
                assert other == mover or apart(points, its), (state.frame, other)


def apart(one: Float64, other: Float64) -> bool:
    """Does some plane that holds an edge direction of either part the two point clouds? (x, y and all turns of it)."""
    turns = np.linspace(0, np.pi, 37)[:-1]
    axes = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)
    a, b = one @ axes.T, other @ axes.T
    return bool(((a.max(axis=0) < b.min(axis=0)) | (b.max(axis=0) < a.min(axis=0))).any())


def test_larsens_box_has_the_papers_numbers():
    sequence = SEQUENCES["larsen"]()
    texels = make_texels(sequence.scene, sequence.atlas, Geometry(sequence.scene, sequence.states[0]))
    assert texels.count == 140
    assert np.bincount(texels.instance).tolist() == [25] * 5 + [6, 9]
    assert sequence.options["photons"] == 77 * 40


def test_the_mover_has_twelve_thousand_texels():
    sequence = rigid_mover()
    texels = make_texels(sequence.scene, sequence.atlas, Geometry(sequence.scene, sequence.states[0]))
    assert 11_500 < texels.count < 12_500


def light_in_room_b(opened: int) -> Float64:
    """IIM of room B's walls with its own lamp out, at frame ``opened`` of the door's sequence."""
    sequence = SEQUENCES["door"]()
    scene, atlas = two_rooms(5.0, doorway=True)
    state = sequence.states[opened]
    state = replace(state, lights=(state.lights[0], replace(state.lights[1], power=BLACK)))
    settings = BakeSettings(quality=Quality.DRAFT, denoise=False, threads=1)
    with Session(scene, atlas, settings, state) as session:
        maps, t = session.advance(state).maps, session.texels
    room_b = np.isin(t.instance, [i for i, x in enumerate(scene.instances) if x.name.startswith("B")])
    return maps.iim[t.page[room_b], t.row[room_b], t.col[room_b]]


def test_no_light_passes_the_door_until_it_opens():
    assert not light_in_room_b(0).any()
    assert light_in_room_b(23).mean() > 0.05


@pytest.mark.parametrize("wanted", [34, 1_000, 13_000, 133_000])
def test_bumpy_walls_have_their_triangles_and_stay_shut(wanted):
    scene, _ = bumpy_cornell(wanted, 7)
    count = sum(scene.meshes[i.mesh].triangle_count for i in scene.instances)
    assert count == pytest.approx(wanted, rel=0.1)
    floor = scene.meshes[0].vertices
    border = (np.abs(floor[:, :2]) > 1 - 1e-6).any(axis=1)
    assert np.abs(floor[border, 2]).max() < 1e-6
    assert wanted < 100 or 0.004 < np.abs(floor[:, 2]).max() <= 0.01
    assert (scene.meshes[0].corner_normals[..., 2] > 0.3).all()


def test_the_hall_is_the_same_as_one_object_or_many():
    def triangles(joined: bool) -> Float64:
        scene, atlas = hall(5, joined=joined)
        geometry = Geometry(scene, scene.first_frame())
        assert make_texels(scene, atlas, geometry).count == 6 * 32**2 + 64 * 6 * 5**2
        rows = (geometry.corners + geometry.origin).reshape(-1, 9)
        return rows[np.lexsort(rows.round(4).T)]

    np.testing.assert_allclose(triangles(True), triangles(False), atol=1e-5)


@given(st.floats(-1.0, 2.0), st.floats(1e-3, 10), st.integers(4, 8))
def test_a_power_law_has_its_slope(exponent: float, scale: float, count: int) -> None:
    x = np.geomspace(10, 1e5, count)
    assert slope(x.tolist(), (scale * x**exponent).tolist()) == pytest.approx(exponent, abs=1e-9)


def test_what_every_frame_costs_anyway_does_not_hide_the_slope():
    x = np.geomspace(1, 1e6, 13)
    assert slope(x.tolist(), (100 + x).tolist()) == pytest.approx(1, abs=0.03)


def test_flicker_is_what_is_left_of_a_change_without_the_true_one():
    truth = np.array([[1.0, 2.0], [1.1, 2.0], [1.2, 2.0]])
    ours = truth + np.array([[0.3, 0.3], [0.3, 0.3], [0.3, 0.5]])  # a steady error is none; the last one jumps
    beyond, true = excess_change(ours, truth)
    np.testing.assert_allclose(beyond, [[0, 0], [0, 0.1]], atol=1e-12)
    np.testing.assert_allclose(true, [[0.1 / 1.1, 0], [0.1 / 1.2, 0]], atol=1e-12)


def test_differences_are_relative_but_for_the_darkest():
    maps = np.array([[1.0, 1.0, 1.0], [1e-6, 1.0, 1.0]], np.float32)
    other = maps.copy()
    other[1, 0] = 0
    assert difference(maps, maps) == 0
    assert difference(other, maps) == pytest.approx(1e-6 / (0.01 * maps.mean()), rel=1e-4)
    other[0, 1] = 1.5
    assert difference(other, maps) == pytest.approx(0.5)


def test_a_played_sequence_is_measured_and_compared():
    sequence = rigid_mover(7, frames=5)
    settings = BakeSettings(quality=Quality.DRAFT, denoise=False, threads=1)
    truth = converge(sequence, (2, 4), counts=SampleCounts(64, 64), seeds=(5, 6))
    played = play(sequence, settings, (), converged=truth)
    assert played.texels == truth.mean[2].shape[0] == truth.valid[4].shape[0]
    assert (played.selected.frames, played.scratch.frames) == (4, 3)  # 1, 4, and 2 for its comparison
    assert played.difference <= 1e-5
    assert played.ratio == played.scratch.seconds / played.selected.seconds
    assert played.selected.rate == pytest.approx(1 / played.selected.seconds)
    assert 0 < sum(played.scratch.stages.values()) <= 1.5 * played.scratch.seconds
    assert 0.02 < played.errors[1].relative_rmse < 0.5
    assert played.errors[0].relative_rmse == pytest.approx(played.errors[1].relative_rmse, rel=1e-3)
    assert abs(played.errors[1].bias) < 0.05
    assert played.scratch.counts["rays"] >= played.texels * 16


def test_a_mover_in_a_closed_room_updates_that_room_alone():
    settings = BakeSettings(quality=Quality.DRAFT, denoise=False, threads=1)
    played = play(closed_rooms(5.0, frames=4), settings, ())
    updated, kept = (played.selected.counts[k] for k in ("surfaces_updated", "surfaces_kept"))
    assert updated + kept == 24
    assert 1 <= updated <= 12
    assert played.difference <= 1e-5


def test_a_gather_in_a_furnace_brings_its_radiosity():
    mesh = box("room", (1, 1, 1), texels=4, inward=True)
    scene = Scene((mesh,), (Instance("room", 0, np.eye(4)),), (WHITE,))
    rig = make_rig(scene, grid_atlas(scene, [(18, 12)]))
    odds = bright_targets([np.ones(rig.texels.count)], np.zeros(rig.texels.count, np.int32))
    tracer = GatherRays(
        rig.texels, rig.frame, rig.geometry, rig.surfaces, rig.tracer, None, odds, SampleCounts(16, 16),
        max_specular=0, seed=0,
    )  # fmt: skip
    sent = np.tile(np.array([3.0, 2.0, 1.0], np.float32), (rig.texels.count, 1))
    texel = np.arange(rig.texels.count, dtype=np.int32)
    np.testing.assert_allclose(gathered(tracer, texel, sent), sent, rtol=1e-5)
    chunked = larsen_tables.gather_all(tracer, texel, sent, 1 << 15, Workers(2))
    np.testing.assert_array_equal(chunked, gathered(tracer, texel, sent))


# --- the report ----------------------------------------------------------------------------------------------------

MACHINE = Machine("A processor", 2, {"rtgi": "0.1.0"}, "0.3")
COUNTS = {
    "rays": 1000.0, "links_traced": 100.0, "links_kept": 900.0, "links_tested": 250.0, "photons_traced": 0.0,
    "photons_kept": 0.0,
    "texels_updated": 30.0, "texels_kept": 70.0, "surfaces_updated": 2.0, "surfaces_kept": 8.0,
}  # fmt: skip


def cost(ms: float, **counts: float) -> Cost:
    return Cost(23, ms / 1000, 2 * ms / 1000, {"links": 0.7 * ms / 1000, "aim": 0.2 * ms / 1000}, COUNTS | counts)


def played(name: str, label: str, ms: float, scratch: float, **counts: float) -> Played:
    errors = Errors(0.021, 0.022, 0.0, 0.04, 0.006, 100), Errors(0.020, 0.021, 0.0, 0.04, 0.006, 100)
    return Played(
        name, f"Sequence {name}", label, 12_000, 0.5, cost(ms, **counts), cost(scratch), scratch / ms, 3e-7,
        None if name == "slow" else errors,
    )  # fmt: skip


def result(ms: float) -> FramesResult:
    rows = []
    for label in KINDS:
        rows += [played(n, label, ms, 300.0) for n in SEQUENCES if n not in {"lamp", "still"}]
        rows += [played("lamp", label, 2 * ms, 300.0, links_traced=0), played("still", label, ms / 10, 300.0, rays=0)]
    return FramesResult(MACHINE, rows, [Flicker(label, 500, 0.004, 0.02, 0.001) for label in ("preview", "draft")])


def test_the_report_of_frames_states_cost_error_and_what_is_met(tmp_path: Path) -> None:
    write_frames(result(40.0), tmp_path)
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert "| Sequence mover | 12000 | 40.0 | 80.0 | 300.0 | 7.5 | 25.0 | 2.10% | 2.00% | 3e-07 |" in text
    assert "| Sequence slow | 12000 | 40.0 | 80.0 | 300.0 | 7.5 | 25.0 | - | - | 3e-07 |" in text
    assert "| Sequence mover | 1k | 1k | 100 | 250 | 90.0% | 0 | - | 30.0% | 2.0 of 10 |" in text
    assert "| a mover, 12k texels: at least 20 frames/s | 25.0 | 25.0 | 25.0 |" in text
    assert "| a moving lamp: at least 10 frames/s, no gather ray | 12.5, 0 rays | 12.5, 0 rays | 12.5, 0 rays |" in text
    assert "| nothing changed: less than 5 ms and no ray | 4.0 ms, 0 rays | 4.0 ms, 0 rays |" in text
    assert "| two closed rooms: no surface of the other room updated | 0.0 surfaces | 0.0 surfaces |" in text
    assert "| Larsen04's size, every texel in every frame: at most 10 ms | 40.0 ms **missed** |" in text
    assert "| flicker far from a slow mover: at most 1% | 0.40% | 0.40% | 0.40% |" in text
    for quality in ("preview", "draft", "live"):
        assert (tmp_path / "benchmarks" / f"frames_{quality}.png").stat().st_size > 10_000


def test_a_slow_run_is_reported_as_missed(tmp_path: Path) -> None:
    write_frames(result(100.0), tmp_path)
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert "| a mover, 12k texels: at least 20 frames/s | 10.0 **missed** |" in text
    assert "| ... at least 5 times cheaper than from scratch | 3.0 **missed** |" in text
    assert "| nothing changed: less than 5 ms and no ray | 10.0 ms, 0 rays **missed** |" in text


def test_the_report_of_scaling_gives_the_slopes(tmp_path: Path) -> None:
    points = tuple(Point(x, played("cornell", "", 0.001 * x, 0.01 * x**0.5)) for x in (1e3, 1e4, 1e5, 1e6))
    write_scaling(ScalingResult(MACHINE, [Sweep("texels", "texels", "a box", points)]), tmp_path)
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert "A box. Slope 1.00 with selection, 0.50 from scratch." in text
    assert "| 100k | 12k | 100.0 | 3.2 |" in text
    assert (tmp_path / "benchmarks" / "scaling.png").stat().st_size > 10_000


def test_larsens_tables_stand_beside_the_papers_numbers(tmp_path: Path) -> None:
    rows = [LookUp(300, 0.03, 0.02, 0.001, 0.10, 0.023)], [FinalGather(13_000, 12_984, 256, 0.4, 0.05, 0.91)]
    write_larsen(LarsenResult(MACHINE, *rows), tmp_path)
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert "| 300 | 0.10 | 0.030 | 0.023 | 0.020 | 0.0010 |" in text
    assert "| 256 | 13000 | 12984 | 0.91 | 0.40 | 0.0500 |" in text


def test_parts_of_the_document_do_not_disturb_one_another(tmp_path: Path) -> None:
    write_part(tmp_path, "larsen", "## Tables\n\ntext")
    write_part(tmp_path, "speed", "## Speed\n\n<!-- no part -->\nfirst")
    write_part(tmp_path, "speed", "## Speed\n\nsecond")
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert read_parts(text) == {"speed": "## Speed\n\nsecond", "larsen": "## Tables\n\ntext"}
    assert text.startswith("# Benchmarks\n") and text.index("## Speed") < text.index("## Tables")
    with pytest.raises(ValueError, match="nonsense"):
        write_part(tmp_path, "nonsense", "")


@pytest.mark.parametrize(
    "value, text", [(1e6, "1M"), (999_824, "1M"), (1037, "1.04k"), (100, "100"), (1 / 64, "0.0156")]
)
def test_short_numbers(value: float, text: str) -> None:
    assert short(value) == text
