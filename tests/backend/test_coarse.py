# SPDX-License-Identifier: GPL-3.0-or-later
"""Stand-ins of large meshes: how many triangles, how near to the mesh, and that they stop the same light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.final_gather.views.coarse import CoarseMesh, coarse_mesh
from rtgi_addon.backend.scene import Mesh
from tests.backend import scenes


def indexed(vertices: np.ndarray, triangles: np.ndarray) -> Mesh:
    """A mesh with shared vertices; every corner has a UV of its own."""
    triangles = np.asarray(triangles, np.int32).reshape(-1, 3)
    count = len(triangles)
    return Mesh(
        name="mesh",
        vertices=np.asarray(vertices, np.float32).reshape(-1, 3),
        triangles=triangles,
        corner_normals=np.zeros((count, 3, 3), np.float32),
        corner_uv=(np.arange(count * 6, dtype=np.float32) / max(count * 6, 1)).reshape(-1, 3, 2),
        island_of_triangle=np.zeros(count, np.int32),
        material_of_triangle=np.zeros(count, np.int32),
    )


def sheet(count: int, to_position: Callable[[np.ndarray, np.ndarray], list[np.ndarray]]) -> Mesh:
    """2 count² triangles over u, v in [0, 1]."""
    line = np.linspace(0, 1, count + 1)
    vertices = np.stack(to_position(*np.meshgrid(line, line, indexing="ij")), axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    a = i * (count + 1) + j
    b = a + count + 1
    split = [np.stack([a, b, b + 1], axis=-1), np.stack([a, b + 1, a + 1], axis=-1)]
    return indexed(vertices, np.concatenate(split).reshape(-1, 3))


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    triangles = [m.triangles + s for m, s in zip(meshes, starts, strict=False)]
    return indexed(np.concatenate([m.vertices for m in meshes]), np.concatenate(triangles))


def fine_box(size: tuple[float, float, float], count: int) -> Mesh:
    """A closed box around the origin of 12 count² triangles, normals outward."""
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):

            def face(u, v, axis=axis, sign=sign):
                parts = {axis: np.full_like(u, sign), (axis + 1) % 3: 2 * u - 1, (axis + 2) % 3: (2 * v - 1) * sign}
                return [parts[k] * size[k] / 2 for k in range(3)]

            faces.append(sheet(count, face))
    return joined(*faces)


def crosses(mesh: Mesh, triangles: np.ndarray) -> np.ndarray:
    p = mesh.vertices[triangles].astype(np.float64)
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def area(mesh: Mesh, triangles: np.ndarray) -> float:
    return float(np.linalg.norm(crosses(mesh, triangles), axis=1).sum() / 2)


def volume(mesh: Mesh, triangles: np.ndarray) -> float:
    return float((mesh.vertices[triangles[:, 0]] * crosses(mesh, triangles)).sum() / 6)


def first_hits(mesh: Mesh, triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n,) row of ``triangles`` each ray meets first, -1 where none."""
    embree = EmbreeScene()
    TriangleMesh(embree, np.ascontiguousarray(mesh.vertices[triangles], np.float32))
    return embree.run(origins.astype(np.float32), directions.astype(np.float32), output=True)["primID"]


def directions(count: int) -> np.ndarray:
    d = np.random.default_rng(5).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def check(mesh: Mesh, coarse: CoarseMesh, most: int) -> None:
    """All that holds for the stand-in of any mesh."""
    count = len(coarse.source)
    assert 0 < count <= most
    assert coarse.triangles.shape == (count, 3)
    assert {coarse.triangles.dtype, coarse.source.dtype, coarse.representative.dtype} == {np.dtype(np.int32)}
    assert (np.diff(coarse.source) > 0).all() and coarse.source[0] >= 0 and coarse.source[-1] < mesh.triangle_count
    assert np.array_equal(np.unique(coarse.triangles), coarse.representative)
    assert coarse.representative[0] >= 0 and coarse.representative[-1] < len(mesh.vertices)
    after = mesh.vertices[coarse.triangles].astype(np.float64)
    before = mesh.vertices[mesh.triangles[coarse.source]].astype(np.float64)
    assert np.isfinite(after).all() and np.isfinite(before).all()
    moved = np.linalg.norm(after - before, axis=2)
    assert moved.max() <= coarse.deviation_max * (1 + 1e-6)
    assert 0 <= coarse.deviation_rms <= coarse.deviation_max
    assert (np.linalg.norm(crosses(mesh, coarse.triangles), axis=1) > 0).all()
    turns = np.array([np.roll(t, -int(t.argmin())) for t in coarse.triangles])
    assert len(np.unique(turns, axis=0)) == count


BALL = scenes.sphere("ball", 1.0, rings=71, inward=False)  # 19880 triangles that share no vertex
WAVES = sheet(60, lambda u, v: [10 * u, 10 * v, np.sin(9 * u) * np.cos(7 * v)])


@pytest.mark.parametrize("most", [300, 2000, 8000])
def test_a_sphere_stays_closed(most: int) -> None:
    coarse = coarse_mesh(BALL, most)
    assert coarse is not None
    check(BALL, coarse, most)
    assert len(coarse.source) > 0.85 * most
    origins = np.random.default_rng(1).uniform(-0.4, 0.4, (20000, 3))
    assert (first_hits(BALL, coarse.triangles, origins, directions(20000)) >= 0).mean() >= 0.999
    tolerance = 0.02 if most >= 2000 else 0.07
    assert area(BALL, coarse.triangles) == pytest.approx(area(BALL, BALL.triangles), rel=tolerance)
    assert volume(BALL, coarse.triangles) == pytest.approx(volume(BALL, BALL.triangles), rel=tolerance)


def test_an_open_sheet_keeps_its_border_and_a_box_its_corners() -> None:
    plane = sheet(100, lambda u, v: [10 * u, 10 * v, 0 * u])
    box = fine_box((2.0, 1.0, 3.0), 40)
    for mesh, most in ((plane, 1000), (box, 2000)):
        coarse = coarse_mesh(mesh, most)
        assert coarse is not None
        check(mesh, coarse, most)
        assert area(mesh, coarse.triangles) == pytest.approx(area(mesh, mesh.triangles), rel=2e-3)
        assert np.array_equal(np.ptp(mesh.vertices[coarse.representative], axis=0), np.ptp(mesh.vertices, axis=0))


@pytest.mark.parametrize("turned", [False, True])
def test_a_wall_thinner_than_a_cell_keeps_both_sides(turned: bool) -> None:
    wall = fine_box((4.0, 0.02, 3.0), 50)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0] if turned else np.eye(3)
    turn *= np.linalg.det(turn)
    wall = replace(wall, vertices=(wall.vertices @ turn.T).astype(np.float32))
    coarse = coarse_mesh(wall, 2000)
    assert coarse is not None
    check(wall, coarse, 2000)
    assert coarse.deviation_rms > 0.02
    for side in (-1.0, 1.0):
        origins = np.random.default_rng(7).uniform(-1, 1, (5000, 3)) * [1.9, 0, 1.4] + [0, side, 0]
        towards = np.tile(turn @ [0, -side, 0], (5000, 1))
        hit = first_hits(wall, coarse.triangles, origins @ turn.T, towards)
        assert (hit >= 0).all()
        assert ((crosses(wall, coarse.triangles)[hit] * towards).sum(axis=1) < 0).mean() > 0.999
        assert ((crosses(wall, wall.triangles)[coarse.source[hit]] * towards).sum(axis=1) < 0).mean() > 0.99


def test_two_sheets_at_one_place_keep_both() -> None:
    front = sheet(40, lambda u, v: [u, v, 0 * u])
    coarse = coarse_mesh(joined(front, replace(front, triangles=front.triangles[:, ::-1])), 800)
    assert coarse is not None
    front_count = (coarse.source < front.triangle_count).sum()
    assert front_count == len(coarse.source) / 2


def test_parts_are_not_joined() -> None:
    tiles = [sheet(20, lambda u, v, k=k: [u + 1.001 * k, v, 0 * u]) for k in range(4)]
    mesh = joined(*tiles)
    coarse = coarse_mesh(mesh, 800)
    assert coarse is not None
    part = coarse.triangles // len(tiles[0].vertices)
    assert (part == part[:, :1]).all()
    assert np.array_equal(part[:, 0], coarse.source // tiles[0].triangle_count)


def test_many_small_parts_give_way_to_the_grid() -> None:
    rng = np.random.default_rng(2)
    pebble = fine_box((0.1, 0.1, 0.1), 2)
    gravel = joined(*[replace(pebble, vertices=pebble.vertices + rng.random(3, np.float32)) for _ in range(300)])
    coarse = coarse_mesh(gravel, 1000)
    assert coarse is not None
    check(gravel, coarse, 1000)


def test_a_uv_stays_within_the_deviation_of_its_place() -> None:
    """The sheet's UVs are its x and y: what a fragment interpolates is where it lies, to the deviation."""
    mesh = replace(WAVES, corner_uv=WAVES.vertices[WAVES.triangles][..., :2] / 10)
    coarse = coarse_mesh(mesh, 1500)
    assert coarse is not None
    uv = mesh.corner_uv[coarse.source]
    weights = np.random.default_rng(4).dirichlet((1, 1, 1), len(uv))[:, :, None]
    at = (mesh.vertices[coarse.triangles] * weights).sum(axis=1)
    off = np.linalg.norm(at[:, :2] - 10 * (uv * weights).sum(axis=1), axis=1)
    assert off.max() <= coarse.deviation_max * (1 + 1e-5)
    assert off.mean() < coarse.deviation_rms
    facing = (crosses(mesh, coarse.triangles) * crosses(mesh, mesh.triangles)[coarse.source]).sum(axis=1)
    assert (facing > 0).mean() > 0.97


def test_small_meshes_have_none() -> None:
    one = scenes.mesh_of_triangles("one", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0], [1, 0], [0, 1]], [0])
    nothing = indexed(np.zeros((0, 3)), np.zeros((0, 3)))
    assert coarse_mesh(one, 1) is None
    assert coarse_mesh(nothing, 1) is None
    assert coarse_mesh(BALL, BALL.triangle_count) is None
    with pytest.raises(ValueError, match="at least one"):
        coarse_mesh(one, 0)


def test_nothing_sensible_is_none() -> None:
    point = indexed(np.ones((4, 3)), [[0, 1, 2], [1, 2, 3]] * 5)
    line = indexed(np.arange(6)[:, None] * np.ones(3), [[0, 1, 2], [3, 4, 5]] * 5)
    lost = indexed(np.full((4, 3), np.nan), [[0, 1, 2], [1, 2, 3]] * 5)
    assert all(coarse_mesh(mesh, 4) is None for mesh in (point, line, lost))
    assert coarse_mesh(BALL, 1) is None


def test_copies_of_one_triangle_are_one() -> None:
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    for triangles, left in (([[0, 1, 2], [1, 2, 0], [0, 0, 1]], [0]), ([[0, 1, 2], [0, 2, 1], [1, 2, 0]], [0, 1])):
        coarse = coarse_mesh(indexed(vertices, triangles), 2)
        assert coarse is not None
        assert coarse.source.tolist() == left


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_lost_vertices_are_left_out(bad: float) -> None:
    vertices = WAVES.vertices.copy()
    vertices[::97] = bad
    mesh = replace(WAVES, vertices=vertices)
    coarse = coarse_mesh(mesh, 1500)
    assert coarse is not None
    check(mesh, coarse, 1500)


def test_vertices_that_no_triangle_uses_do_not_matter() -> None:
    extra = np.array([[1e9, 0, 0], [np.nan, 0, 0]], np.float32)
    same(coarse_mesh(WAVES, 900), coarse_mesh(replace(WAVES, vertices=np.concatenate([WAVES.vertices, extra])), 900))


def same(a: CoarseMesh | None, b: CoarseMesh | None, scale: float = 1.0) -> None:
    assert a is not None and b is not None
    assert np.array_equal(a.triangles, b.triangles)
    assert np.array_equal(a.source, b.source)
    assert (a.deviation_rms * scale, a.deviation_max * scale) == (b.deviation_rms, b.deviation_max)


def test_the_same_again() -> None:
    same(coarse_mesh(BALL, 1500), coarse_mesh(BALL, 1500))


@pytest.mark.parametrize(("scale", "shift"), [(2.0**-10, 0.0), (2.0**20, 0.0), (1.0, 2.0**20), (2.0**-10, 2.0**10)])
def test_scale_and_place_do_not_matter(scale: float, shift: float) -> None:
    """Powers of two and coordinates of few bits, so that float32 holds the moved mesh exactly."""
    waves = replace(WAVES, vertices=np.round(WAVES.vertices * 8) / np.float32(8))
    moved = replace(waves, vertices=((waves.vertices + shift) * scale).astype(np.float32))
    same(coarse_mesh(waves, 900), coarse_mesh(moved, 900), scale)


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0.0), (1e4, 1e6), (1e15, 0.0), (1e-15, 0.0)])
def test_far_out_and_small(scale: float, shift: float) -> None:
    mesh = replace(BALL, vertices=(BALL.vertices * np.float32(scale) + np.float32(shift)))
    coarse = coarse_mesh(mesh, 2000)
    assert coarse is not None
    check(mesh, coarse, 2000)
    assert area(mesh, coarse.triangles) == pytest.approx(4 * np.pi * scale**2, rel=0.02)


coordinates = st.floats(width=32, allow_nan=True, allow_infinity=True)
#: Few places, so that triangles share, overlap and degenerate; now and then a number from anywhere.
points = st.one_of(st.tuples(*[st.integers(0, 4)] * 3), st.tuples(*[st.floats(-1, 1, width=32)] * 3))
places = st.one_of(points, points, points, st.tuples(*[coordinates] * 3))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(vertices=st.lists(places, min_size=3, max_size=40), seed=st.integers(0, 999), most=st.integers(1, 60))
def test_any_soup(vertices: list[tuple[float, float, float]], seed: int, most: int) -> None:
    count = 3 * len(vertices)
    triangles = np.random.default_rng(seed).integers(0, len(vertices), (count, 3))
    with np.errstate(over="ignore"):
        mesh = indexed(np.array(vertices, np.float64), triangles)
        coarse = coarse_mesh(mesh, most)
        if coarse is not None:
            check(mesh, coarse, most)
            assert count > most
