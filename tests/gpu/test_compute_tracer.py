# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays by compute shaders hit what Embree's hit, slip through no edge, and hang neither on batches nor on threads."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from rtgi_addon.backend.gpu import compute_tracer, programs
from rtgi_addon.backend.gpu.compute_tracer import DEFINES, FEWEST_RAYS, ComputeTracer
from rtgi_addon.backend.gpu.context import Gpu, GpuFailed
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import FrameState, Instance, Mesh, Scene
from rtgi_addon.backend.surface.geometry import Geometry
from rtgi_addon.backend.surface.tracing import FREE, MOVER, WALL, EmbreeTracer, Hits
from tests.backend import scenes

RAYS = 20_000
COLUMNS = ("triangle", "u", "v", "distance", "cosine")
UNIT_QUAD = scenes.quad("quad", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])


def cornell(*, moving: bool = False, away: float = 0.0) -> Scene:
    """The box with its blocks a hand's breadth above the floor, so that no two surfaces coincide."""
    scene, _ = scenes.cornell(4, moving=moving)
    shift = scenes.translation(away, -2 * away, away / 2)
    lift = [shift @ scenes.translation(0, 0, 0.1 if i >= 5 else 0.0) for i in range(7)]
    placed = tuple(replace(i, matrix_world=m @ i.matrix_world) for i, m in zip(scene.instances, lift, strict=True))
    return replace(scene, instances=placed)


def random_rays(count: int = RAYS, *, seed: int = 0, reach: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-reach, reach, (count, 3)).astype(np.float32), rng.normal(size=(count, 3)).astype(np.float32)


class Pair:
    """Both tracers over one scene, followed together."""

    def __init__(self, gpu: Gpu, scene: Scene, state: FrameState | None = None) -> None:
        self.state = scene.first_frame() if state is None else state
        self.geometry = Geometry(scene, self.state)
        self.embree = EmbreeTracer(scene, self.geometry, self.state, Workers(1))
        self.compute = ComputeTracer(scene, self.geometry, self.state, gpu)

    def follow(self, **changes) -> None:
        self.state = replace(self.state, **changes)
        changed = self.geometry.update(self.state)
        a, b = (tracer.update(self.state, changed) for tracer in (self.embree, self.compute))
        assert a.rebuilt == b.rebuilt
        for name in ("left", "taken"):
            assert [p.instance for p in getattr(a, name)] == [p.instance for p in getattr(b, name)]

    def agree(self, *, seed: int = 0, hits: int = RAYS // 20, coincident: bool = False) -> Hits:
        """The same triangle on 999 of 1000 rays, the same distance where they differ, the same kind of blocker.

        ``coincident``: flat boxes, whose triangles lie in one another, so that either may be told; of a flat mover's
        space little is left of some directions, and with it of the distance's digits.
        """
        origins, directions = random_rays(seed=seed)
        a, b = self.embree.intersect(origins, directions), self.compute.intersect(origins, directions)
        assert all(getattr(a, name).dtype == getattr(b, name).dtype for name in COLUMNS)
        same = a.triangle == b.triangle
        assert same.mean() >= (0.9 if coincident else 0.999)
        assert ((a.triangle >= 0) == (b.triangle >= 0)).mean() >= 0.999
        met = b.triangle >= 0
        assert met.sum() >= hits
        assert np.isinf(b.distance[~met]).all()
        both = met & (a.triangle >= 0)
        length = np.linalg.norm(directions[both], axis=1)  # distances below in metres
        atol = 1e-5 if coincident else 2e-6
        np.testing.assert_allclose(b.distance[both] * length, a.distance[both] * length, rtol=1e-4, atol=atol)
        hit = same & met
        np.testing.assert_array_equal(b.cosine[hit], a.cosine[hit])
        # A ray nearly in the triangle's plane lands wherever rounding puts it.
        steep = hit & (np.abs(b.cosine) > 1e-2 * np.linalg.norm(directions, axis=1))
        np.testing.assert_allclose(b.u[steep], a.u[steep], atol=1e-3)
        np.testing.assert_allclose(b.v[steep], a.v[steep], atol=1e-3)
        limits = np.random.default_rng(seed).uniform(0, 1, RAYS).astype(np.float32)
        limits[::7] = np.inf
        x, y = self.embree.blocked(origins, directions, limits), self.compute.blocked(origins, directions, limits)
        assert y.dtype == np.uint8 and (x == y).mean() >= 0.999
        np.testing.assert_array_equal(self.compute.occluded(origins, directions, limits), y != FREE)
        return b


def woop(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """(n,) triangle, u, v, distance of the nearest of ``corners`` (t, 3, 3): the shader's test, all pairs of them."""
    axis = np.abs(directions).argmax(axis=1)
    order = np.array([[1, 2, 0], [2, 0, 1], [0, 1, 2]])[axis]  # (n, 3) the largest component last
    way = np.take_along_axis(directions, order, axis=1)
    shear, scale = way[:, :2] / way[:, 2:], np.float32(1) / way[:, 2]
    at = corners[None] - origins[:, None, None]  # (n, t, 3, 3)
    at = np.take_along_axis(at, order[:, None, None], axis=3)
    x, y, z = (
        at[..., 0] - shear[:, 0, None, None] * at[..., 2],
        at[..., 1] - shear[:, 1, None, None] * at[..., 2],
        at[..., 2],
    )

    def edge(p: int, q: int) -> np.ndarray:
        area = x[..., p] * y[..., q] - y[..., p] * x[..., q]
        wide = x[..., p].astype(np.float64) * y[..., q] - y[..., p].astype(np.float64) * x[..., q]
        return np.where(area == 0, wide.astype(np.float32), area)

    u, v, w = edge(2, 1), edge(0, 2), edge(1, 0)
    total = u + v + w
    with np.errstate(all="ignore"):
        distance = (u * z[..., 0] + v * z[..., 1] + w * z[..., 2]) * scale[:, None] / total
        outside = (np.minimum(np.minimum(u, v), w) < 0) & (np.maximum(np.maximum(u, v), w) > 0)
        distance = np.where(outside | (total == 0) | ~(distance > 0), np.float32(np.inf), distance)
        nearest, rows = distance.argmin(axis=1), np.arange(len(origins))
        met = np.isfinite(distance[rows, nearest])
        pick = (rows, nearest)
        return np.where(met, nearest, -1), (v / total)[pick], (w / total)[pick], distance[pick]


def ball(rings: int = 24) -> Mesh:
    """A sphere whose triangles share their corners to the bit: no gap where its map's ends meet."""
    mesh = scenes.sphere("ball", 1.0, rings=rings)
    return replace(mesh, vertices=np.round(mesh.vertices, 5) + np.float32(0))


def rays_at_edges(corners: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """From within the unit ball: a third anywhere, a third at points of edges, a third at corners of ``corners``."""
    rng = np.random.default_rng(3)
    origins = (rng.normal(size=(count, 3)) * 0.25).clip(-0.5, 0.5).astype(np.float32)
    picked = corners[rng.integers(0, len(corners), count)]
    weights = np.zeros((count, 3), np.float32)
    weights[:, 0] = np.where(np.arange(count) % 3 == 1, rng.random(count), 1)
    weights[:, 1] = 1 - weights[:, 0]
    targets = np.einsum("nk,nkj->nj", weights, picked)
    directions = np.where(np.arange(count)[:, None] % 3 == 0, rng.normal(size=(count, 3)), targets - origins)
    return origins, directions.astype(np.float32)


def test_cornell_box_as_embree(compute_gpu):
    Pair(compute_gpu, cornell()).agree()


def test_a_million_metres_out_as_embree(compute_gpu):
    here, there = Pair(compute_gpu, cornell()), Pair(compute_gpu, cornell(away=1e6))
    there.agree()
    a, b = (pair.compute.intersect(*random_rays(2000)) for pair in (here, there))
    assert (a.triangle == b.triangle).mean() > 0.999


def test_the_shader_does_what_its_twin_does(compute_gpu):
    pair = Pair(compute_gpu, cornell())
    origins, directions = random_rays(4000)
    found = pair.compute.intersect(origins, directions)
    triangle, u, v, distance = woop(pair.geometry.corners, origins, directions)
    same = found.triangle == triangle
    assert same.mean() >= 0.999
    hit = same & (triangle >= 0)
    np.testing.assert_allclose(found.distance[hit], distance[hit], rtol=1e-5)
    np.testing.assert_allclose(found.u[hit], u[hit], atol=1e-5)
    np.testing.assert_allclose(found.v[hit], v[hit], atol=1e-5)


def test_what_moves_vanishes_and_comes_back_as_embree(compute_gpu):
    pair = Pair(compute_gpu, cornell(moving=True))
    nodes = pair.compute._buffers._nodes
    assert len(pair.compute._hierarchies) == 2
    hit = [pair.agree().triangle]
    matrices = pair.state.matrix_world.copy()
    matrices[5] = scenes.translation(-0.4, -0.5, 1.3)
    pair.follow(matrix_world=matrices)
    hit.append(pair.agree(seed=1).triangle)
    assert pair.compute._buffers._nodes is nodes
    visible = pair.state.visible.copy()
    visible[5] = False
    pair.follow(visible=visible)
    hit.append(pair.agree(seed=2).triangle)
    pair.follow(visible=np.ones(7, np.bool_))
    hit.append(pair.agree(seed=3).triangle)
    of_mover = [np.isin(t, np.arange(*pair.geometry.first_triangle[5:7])).any() for t in hit]
    assert of_mover == [True, True, False, True]


def test_a_move_writes_no_hierarchy(compute_gpu, monkeypatch):
    pair = Pair(compute_gpu, cornell(moving=True))
    monkeypatch.setattr(compute_tracer, "build_bvh", lambda corners: pytest.fail("a hierarchy was built"))
    monkeypatch.setattr(pair.compute._buffers, "_write", lambda *_: pytest.fail("a hierarchy was uploaded"))
    matrices = pair.state.matrix_world.copy()
    matrices[5, :3, 3] += 0.1
    pair.follow(matrix_world=matrices)
    pair.agree()


def test_what_was_to_stay_put_is_built_anew(compute_gpu):
    pair = Pair(compute_gpu, cornell())
    visible = np.ones(7, np.bool_)
    visible[[0, 6]] = False
    pair.follow(visible=visible)
    pair.agree(seed=1)
    pair.follow(visible=np.ones(7, np.bool_))
    pair.agree(seed=2)


def test_deforming_meshes_as_embree(compute_gpu):
    scene = cornell()
    instances = [replace(i, deforming=k == 6) for k, i in enumerate(scene.instances)]
    pair = Pair(compute_gpu, replace(scene, instances=tuple(instances)))
    vertices = scene.meshes[6].vertices
    for seed, shape in enumerate([vertices * np.float32(0.7), vertices, vertices * np.float32([1, 1, 0.2])]):
        pair.follow(vertices={6: shape})
        pair.agree(seed=seed)
    torn = vertices.copy()
    torn[:12] = np.nan
    pair.follow(vertices={6: torn})
    pair.agree(seed=4)


@pytest.mark.parametrize("scale", [(-1, 1, 1), (1, 1, 0), (0.5, -2, 3), (1e-3, 1e-3, 1e-3), (0, 0, 0)])
@pytest.mark.parametrize("moving", [True, False])
def test_mirrored_flat_and_tiny_as_embree(compute_gpu, scale, moving):
    matrix = scenes.translation(0.2, -0.1, 0.3) @ np.diag([*scale, 1.0])
    meshes = (UNIT_QUAD, scenes.box("box", (1, 1, 1), texels=2))
    turn = np.eye(4)
    turn[:3, :3] = [[0.6, 0, -0.8], [0, 1, 0], [0.8, 0, 0.6]]
    instances = (Instance("box", 1, matrix @ turn, moving=moving), Instance("quad", 0, scenes.translation(0, 0, -1)))
    Pair(compute_gpu, Scene(meshes, instances, (scenes.WHITE,))).agree(hits=100, coincident=0 in scale)


def test_walls_are_told_from_movers_walls_first(compute_gpu):
    instances = (
        Instance("mover", 0, scenes.translation(0, 0, 1), moving=True),
        Instance("wall", 0, np.eye(4)),
        Instance("air", 0, scenes.translation(0, 0, 1.5), blocks_light=False),
    )
    pair = Pair(compute_gpu, Scene((UNIT_QUAD,), instances, (scenes.WHITE,)))
    top = np.array([[0.1, 0.2, 2]], np.float32) - pair.geometry.origin.astype(np.float32)
    origins, down = np.repeat(top, 3, axis=0), np.repeat(np.array([[0, 0, -2]], np.float32), 3, axis=0)
    limits = np.array([0.49, 0.51, 1.01], np.float32)
    assert pair.compute.blocked(origins, down, limits).tolist() == [FREE, MOVER, WALL]
    found = pair.compute.intersect(origins[:1], down[:1])
    assert found.triangle[0] in (0, 1) and found.distance[0] == pytest.approx(0.5)


@pytest.mark.parametrize("moving", [False, True])
def test_no_ray_slips_out_of_a_closed_mesh(compute_gpu, moving):
    """Also not at its edges and corners; nor is one seen through, which a shadow ray would tell."""
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    pair = Pair(compute_gpu, Scene((ball(),), (Instance("ball", 0, turn, moving=moving),), (scenes.WHITE,)))
    origins, directions = rays_at_edges(pair.geometry.corners, 100_000)
    found = pair.compute.intersect(origins, directions)
    assert (found.triangle >= 0).all()
    reached = np.linalg.norm(origins + directions * found.distance[:, None], axis=1)
    assert reached.min() > 0.97 and reached.max() < 1.001
    assert pair.compute.occluded(origins, directions, found.distance * np.float32(1.001)).all()


def test_triangles_finer_than_float32_tells_are_not_slipped_between(compute_gpu):
    """A ball of millimetres at a hundred metres: seen from there its triangles are a few steps of float32."""
    instances = (
        Instance("ball", 0, np.diag([1e-3, 1e-3, 1e-3, 1.0])),
        Instance("far", 1, scenes.translation(0, 0, 400)),
    )
    pair = Pair(compute_gpu, Scene((ball(48), UNIT_QUAD), instances, (scenes.WHITE,)))
    corners = pair.geometry.corners[:-2]
    middle = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
    rng = np.random.default_rng(2)
    way = rng.normal(size=(20_000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    picked = rng.integers(0, len(corners), len(way))
    targets = np.where(np.arange(len(way))[:, None] % 2, corners[picked, 0], corners[picked, :2].mean(axis=1))
    facing = ((targets - middle) * way).sum(axis=1) > 0.5e-3
    origins = (middle + way[facing] * 100).astype(np.float32)
    found = pair.compute.intersect(origins, (targets[facing] - origins).astype(np.float32))
    assert facing.sum() > 4000 and (found.triangle >= 0).all()


def test_rays_along_axes_and_in_planes_of_boxes(compute_gpu):
    """Directions with zeros, from origins on the planes of nodes' boxes."""
    pair = Pair(compute_gpu, Scene((ball(),), (Instance("ball", 0, np.eye(4)),), (scenes.WHITE,)))
    corners = pair.geometry.corners.reshape(-1, 3)
    axis = np.random.default_rng(0).integers(0, 3, len(corners))
    directions = np.zeros_like(corners)
    directions[np.arange(len(corners)), axis] = np.where(np.arange(len(corners)) % 2, 1, -1)
    origins = corners * np.float32(0.999)
    origins[np.arange(len(corners)), axis] = 0
    inside = np.linalg.norm(origins, axis=1) < 0.9
    assert (pair.compute.intersect(origins[inside], directions[inside]).triangle >= 0).all()


def test_same_bits_for_any_batch_order_and_run(compute_gpu):
    scene = cornell(moving=True)
    pair = Pair(compute_gpu, scene)
    origins, directions = random_rays(3 * FEWEST_RAYS + 77)
    whole = pair.compute.intersect(origins, directions)
    pair.compute._rays.pace.items = FEWEST_RAYS
    again = Pair(compute_gpu, scene).compute
    picked = np.random.default_rng(0).permutation(len(origins))[:5001]
    for name in COLUMNS:
        expected = getattr(whole, name)
        np.testing.assert_array_equal(getattr(pair.compute.intersect(origins, directions), name), expected)
        np.testing.assert_array_equal(getattr(again.intersect(origins, directions), name), expected)
        some = again.intersect(origins[picked], directions[picked])
        np.testing.assert_array_equal(getattr(some, name), expected[picked])


def test_batches_adapt_to_the_time_they_take(compute_gpu):
    rays = Pair(compute_gpu, cornell()).compute._rays
    rays.pace.items = 1 << 14
    rays.pace.took(1 << 14, 0.3)
    assert rays.pace.items == 1 << 13
    rays.pace.took(1 << 13, 0.001)
    rays.pace.took(1 << 13, 0.001)  # a batch that was not full says nothing
    assert rays.pace.items == 1 << 14
    for _ in range(30):
        rays.pace.took(rays.pace.items, 0.3)
    assert rays.pace.items == FEWEST_RAYS
    for _ in range(30):
        rays.pace.took(rays.pace.items, 0.001)
    assert rays.pace.items * compute_tracer.RAY.itemsize <= compute_gpu.info.max_storage


def test_threads_may_call_at_once(compute_gpu):
    pair = Pair(compute_gpu, cornell(moving=True))
    parts = [random_rays(3000, seed=seed) for seed in range(6)]
    with ThreadPoolExecutor(2) as pool:
        for rays, hits in zip(parts, pool.map(lambda rays: pair.compute.intersect(*rays), parts), strict=True):
            np.testing.assert_array_equal(pair.compute.intersect(*rays).triangle, hits.triangle)


def test_empty_scenes_and_no_rays(compute_gpu):
    scene = Scene((), (), ())
    state = scene.first_frame()
    tracer = ComputeTracer(scene, Geometry(scene, state), state, compute_gpu)
    origins, directions = random_rays(4)
    assert tracer.intersect(origins, directions).triangle.tolist() == [-1] * 4
    assert not tracer.occluded(origins, directions, np.ones(4, np.float32)).any()
    assert len(tracer.intersect(origins[:0], directions[:0]).triangle) == 0
    box = Pair(compute_gpu, cornell()).compute
    assert len(box.blocked(origins[:0], directions[:0], np.zeros(0, np.float32))) == 0
    with pytest.raises(ValueError, match="limits"):
        box.blocked(origins, directions, np.ones(3, np.float32))


def test_rays_that_are_not_finite_escape(compute_gpu):
    tracer = Pair(compute_gpu, cornell(moving=True)).compute
    origins, directions = np.zeros((5, 3), np.float32), np.ones((5, 3), np.float32)
    origins[0, 1], origins[1] = np.nan, np.inf
    directions[2, 2], directions[3, 0], directions[4] = np.nan, np.inf, 0
    with np.errstate(invalid="ignore"):  # cosines of them
        assert tracer.intersect(origins, directions).triangle.tolist() == [-1] * 5


def test_a_scene_that_does_not_fit_is_refused_in_one_line(compute_gpu):
    small = replace(compute_gpu, info=replace(compute_gpu.info, max_storage=1000))
    scene = cornell()
    with pytest.raises(GpuFailed, match="one storage buffer") as fault:
        ComputeTracer(scene, Geometry(scene, scene.first_frame()), scene.first_frame(), small)
    assert "\n" not in str(fault.value)


def test_without_compute_shaders_it_is_refused(compute_gpu):
    old = replace(compute_gpu, info=replace(compute_gpu.info, version_code=330))
    scene = cornell()
    with pytest.raises(GpuFailed, match="no compute"):
        ComputeTracer(scene, Geometry(scene, scene.first_frame()), scene.first_frame(), old)


def test_closed_it_says_so(compute_gpu):
    tracer = Pair(compute_gpu, cornell()).compute
    tracer.close()
    tracer.close()
    with pytest.raises(GpuFailed, match="closed"):
        tracer.intersect(*random_rays(4))


def test_a_pass_of_another_may_trace(compute_gpu, tmp_path, monkeypatch):
    """``bound`` and ``DEFINES`` are all that a shader needs beside ``inc/bvh.glsl``."""
    (tmp_path / "look_down.glsl").write_text(
        "#version 430 core\n"
        '#include "inc/bvh.glsl"\n'
        "layout(local_size_x = 1) in;\n"
        "layout(std430, binding = 5) writeonly buffer Out { Hit seen; };\n"
        "void main() { seen = nearest_hit(vec3(0.1, 0.2, 0.0), vec3(0, 0, -1), 1e9); }\n"
    )
    shutil.copytree(programs.SHADERS / "inc", tmp_path / "inc")
    monkeypatch.setattr(programs, "SHADERS", tmp_path)
    pair = Pair(compute_gpu, cornell())
    program = programs.compute_program(compute_gpu, "look_down", **DEFINES)
    with pair.compute.bound() as ctx:
        out = ctx.buffer(reserve=16)
        out.bind_to_storage_buffer(5)
        program.run()
        ctx.memory_barrier()
        seen = np.frombuffer(out.read(), compute_tracer.HIT)[0]
        out.release()
    expected = pair.compute.intersect(np.array([[0.1, 0.2, 0]], np.float32), np.array([[0, 0, -1]], np.float32))
    assert seen["triangle"] == expected.triangle[0] >= 0
    assert seen["distance"] == expected.distance[0]
