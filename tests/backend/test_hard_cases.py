# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes that break renderers, as arrays through the whole session: each ends finite, bounded, and with a word said.

docs/robustness.md lists all such cases, these and those that other files test. No denoising: the estimators alone.
"""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.limits import MOST_ALBEDO
from rtgi_addon.backend.scene import Atlas, Instance, Light, LightKind, Material, Mesh, Placement, Scene, World
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import AimBounced, BakeSettings, Quality
from rtgi_addon.backend.surface.texels import place_texels
from tests.backend import scenes

BARE = BakeSettings(denoise=False, quality=Quality.DRAFT, threads=1, photons=5000)
FINE = replace(BARE, quality=Quality.FINAL)
GREY = Material("grey", (0.5, 0.5, 0.5))
GLASS = Material("glass", (0, 0, 0), transmission=(1, 1, 1), ior=1.5)
MIRROR = Material("mirror", (0, 0, 0), specular=(1, 1, 1))


class Baked:
    """One frame of a scene, all maps finite and not negative; values by texel."""

    def __init__(self, scene: Scene, atlas: Atlas, settings: BakeSettings = BARE) -> None:
        state = scene.first_frame()
        with Session(scene, atlas, replace(settings, resolution=max(16, atlas.resolution)), state) as session:
            result = session.advance(state)
            t = session.texels
            self.area = place_texels(t, session.geometry).area
        self.instance, self.side, at = t.instance, t.side, (t.page, t.row, t.col)
        self.maps, self.warnings = result.maps, result.stats.warnings
        for page in (self.maps.iim, self.maps.aim, *([] if self.maps.caustics is None else [self.maps.caustics])):
            assert np.isfinite(page).all()
            assert (page >= 0).all()
        self.valid, self.iim, self.aim = self.maps.valid[at], self.maps.iim[at], self.maps.aim[at]

    def mean(self, instance: int, side: int = 0) -> float:
        """W/m² of all light on one side of an instance."""
        return float(self.aim[(self.instance == instance) & (self.side == side) & self.valid].mean())


def furnace(material: Material, texels: int = 6) -> tuple[Scene, Atlas]:
    """A closed box of ``material`` all around, nothing in it."""
    mesh = scenes.box("furnace", (2, 3, 4), texels=texels, inward=True)
    scene = Scene((mesh,), (Instance("furnace", 0, np.eye(4)),), (material,))
    return scene, scenes.grid_atlas(scene, [(3 * (texels + 2), 2 * (texels + 2))])


def floor_and(*others: Mesh, lights: tuple[Light, ...] = (), materials: tuple[Material, ...] = (GREY,)) -> Scene:
    """A floor of 4 m at z = 0, instance 0, and ``others`` where they are."""
    meshes = (scenes.quad("floor", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]), *others)
    return Scene(meshes, tuple(Instance(m.name, i, np.eye(4)) for i, m in enumerate(meshes)), materials, lights)


def placed(scene: Scene, size: int = 8, *, both: bool = False) -> Atlas:
    count = len(scene.instances)
    return scenes.grid_atlas(scene, [(size, size)] * count, back=tuple(range(count)) if both else ())


# --- albedo and energy --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("albedo, said", [(1.0, "no limit"), (1.5, "does not lie between 0 and 1"), (np.nan, "albedo")])
def test_a_closed_room_that_absorbs_nothing_is_bounded_and_told(albedo: float, said: str) -> None:
    """E = πL / (1 - ρ) with the albedo that the warning names; light of a NaN albedo is not reflected."""
    baked = Baked(*furnace(Material("wall", (albedo,) * 3, (2.0, 2.0, 2.0))))
    used = MOST_ALBEDO if albedo >= 1 else 0.0
    np.testing.assert_allclose(baked.iim, np.pi * 2 / (1 - used), rtol=0.01)
    (line,) = baked.warnings
    assert "material wall" in line and said in line


def test_a_texture_above_one_is_bounded_and_told() -> None:
    scene, atlas = furnace(Material("wall", (0.5,) * 3, (1.0, 1.0, 1.0)))
    bright = replace(scene.meshes[0], albedo_map=np.full((4, 4, 3), 1.25, np.float32))
    baked = Baked(replace(scene, meshes=(bright,)), atlas)
    np.testing.assert_allclose(baked.iim, np.pi / (1 - MOST_ALBEDO), rtol=0.01)
    assert any("furnace" in line and "clamped" in line for line in baked.warnings)


def test_emission_of_a_million_stays_in_proportion() -> None:
    dim, bright = (Baked(*furnace(Material("wall", (0.9,) * 3, (e, e, e)))) for e in (1.0, 1e6))
    np.testing.assert_allclose(bright.iim, 1e6 * dim.iim, rtol=1e-4)
    assert bright.warnings == []


@pytest.mark.parametrize("bounced", [AimBounced.FEEDBACK, AimBounced.PHOTONS])
def test_light_beyond_all_measure_is_bounded_and_told(bounced: AimBounced) -> None:
    """What would overflow float32 does not, in lamps, materials, textures and skies."""
    scene, atlas = scenes.cornell(4)
    glow = replace(scene.materials[1], emission=(1e30, np.inf, 0.0))
    shining = replace(scene.meshes[0], emission_map=np.full((2, 2, 3), 3e38, np.float32))
    scene = Scene(
        (shining, *scene.meshes[1:]),
        scene.instances,
        (scene.materials[0], glow, scene.materials[2]),
        (replace(scene.lights[0], power=(1e300, 1e200, 0.0)),),
        scenes.constant_sky(1e38),
    )
    baked = Baked(scene, atlas, replace(BARE, aim_bounced=bounced))
    assert 0 < baked.aim.max() < 1e20
    for name in ("lamp", "world", "floor", "material red"):
        assert f"{name}: light above 1e+15 counts as that much" in baked.warnings


@pytest.mark.parametrize("bounced", [AimBounced.FEEDBACK, AimBounced.PHOTONS])
def test_what_reflects_and_lets_through_makes_no_light(bounced: AimBounced) -> None:
    """A pane that reflects half and passes half, or reflects all, in a furnace: E is that of the furnace alone."""
    room, _ = furnace(Material("wall", (0.5,) * 3, (1.0, 1.0, 1.0)))
    pane = scenes.quad("pane", [(-0.6, -0.6, 0), (0.6, -0.6, 0), (0.6, 0.6, 0), (-0.6, 0.6, 0)], material=1)
    for look in (
        Material("half there", (0.999,) * 3, opacity=0.5),
        Material("white mirror", (0.999,) * 3, specular=(1.0, 1.0, 1.0)),
        Material("mirror and glass", (0.0,) * 3, specular=(1.0, 1.0, 1.0), transmission=(1.0, 1.0, 1.0)),
    ):
        meshes = (*room.meshes, pane)
        scene = Scene(meshes, (*room.instances, Instance("pane", 1, np.eye(4))), (*room.materials, look))
        atlas = scenes.grid_atlas(scene, [(24, 16), (8, 8)], back=(1,))
        baked = Baked(scene, atlas, replace(BARE, aim_bounced=bounced, photons=40_000))
        walls = baked.instance == 0
        assert np.average(baked.aim[walls, 0], weights=baked.area[walls]) == pytest.approx(2 * np.pi, rel=0.01)
        assert any("adds up" in line for line in baked.warnings) == (look.name != "half there")


# --- broken geometry ----------------------------------------------------------------------------------------------


def test_vertices_that_are_not_finite_are_left_out_and_told() -> None:
    scene, atlas = scenes.cornell(8)
    lost = scene.meshes[5].vertices.copy()
    lost[0], lost[7] = np.nan, np.inf
    broken = replace(scene, meshes=(*scene.meshes[:5], replace(scene.meshes[5], vertices=lost), scene.meshes[6]))
    baked, whole = Baked(broken, atlas), Baked(scene, atlas)
    assert baked.warnings == ["short: 2 of its vertices are not finite; 2 triangles are left out"]
    assert baked.mean(2) == pytest.approx(whole.mean(2), rel=0.1)  # the back wall hardly sees what is missing


def test_only_broken_vertices_leave_a_black_map() -> None:
    scene = floor_and(lights=(scenes.point_light((0, 0, 1)),))
    gone = replace(scene.meshes[0], vertices=np.full_like(scene.meshes[0].vertices, np.nan))
    assert not Baked(replace(scene, meshes=(gone,)), placed(scene)).aim.any()


def test_degenerate_and_duplicate_triangles_change_nothing() -> None:
    lamp = (scenes.point_light((0.3, 0.2, 1.5), 50.0),)
    wall = scenes.quad("wall", [(-2, 2, 0), (2, 2, 0), (2, 2, 2), (-2, 2, 2)])
    plain = Baked(floor_and(wall, lights=lamp), placed(floor_and(wall)), FINE)
    point, line = [[0, 0, 1]] * 3, [[-1, 0, 1], [0, 0, 1], [1, 0, 1]]
    corners = np.concatenate([wall.vertices.reshape(-1, 3, 3), wall.vertices.reshape(-1, 3, 3), [point, line]])
    uv = np.concatenate([wall.corner_uv, wall.corner_uv, np.zeros((2, 3, 2))])
    twice = scenes.mesh_of_triangles("wall", corners, uv, [0] * 6, np.zeros((6, 3, 3)))
    baked = Baked(floor_and(twice, lights=lamp), placed(floor_and(twice)), FINE)
    for instance in range(2):
        # The wall's texels count the area of both layers, so rays aimed at it weigh a little too much.
        assert baked.mean(instance) == pytest.approx(plain.mean(instance), rel=0.04)


def test_overlapping_layouts_share_pixels_and_stay_bounded() -> None:
    """Two faces over the same pixels: the first has them. What the other sends back is looked up there."""
    wall = scenes.quad("wall", [(-2, 2, 0), (2, 2, 0), (2, 2, 2), (-2, 2, 2)])
    floor = scenes.quad("floor", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)])
    both = scenes.mesh_of_triangles(
        "both",
        np.concatenate([floor.vertices, wall.vertices]),
        np.concatenate([floor.corner_uv, wall.corner_uv]),
        [0, 0, 1, 1],
    )
    scene = Scene((both,), (Instance("both", 0, np.eye(4)),), (GREY,), (scenes.point_light((0, 0, 1), 50.0),))
    baked = Baked(scene, scenes.grid_atlas(scene, [(8, 8)]))
    assert len(baked.aim) == 64
    same = Scene((floor,), (Instance("floor", 0, np.eye(4)),), (GREY,), scene.lights)
    assert baked.aim.max() <= Baked(same, scenes.grid_atlas(same, [(8, 8)])).aim.max() * 2


def test_objects_placed_over_each_other_in_the_atlas() -> None:
    scene = floor_and(scenes.quad("wall", [(-2, 2, 0), (2, 2, 0), (2, 2, 2), (-2, 2, 2)]))
    scene = replace(scene, lights=(scenes.point_light((0, 0, 1)),))
    spot = Placement(0, (0.5, 0.5), (0.25, 0.25))
    baked = Baked(scene, Atlas(16, 1, (spot, spot), (None, None)))
    assert set(baked.instance) == {0}
    assert baked.valid.any()


def test_coplanar_and_interpenetrating_faces() -> None:
    """A second floor in the plane of the first, and a wall through both: light is neither lost nor doubled."""
    lamp = (scenes.point_light((0.0, -1.0, 1.5), 50.0),)
    over = scenes.quad("over", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)])
    through = scenes.quad("through", [(2, 0.5, -1), (-2, 0.5, -1), (-2, 0.5, 2), (2, 0.5, 2)])
    alone, two = floor_and(through, lights=lamp), floor_and(through, over, lights=lamp)
    plain, doubled = (Baked(s, placed(s, both=True), FINE) for s in (alone, two))
    assert doubled.mean(0) == pytest.approx(plain.mean(0), rel=0.03)
    assert doubled.mean(2) == pytest.approx(plain.mean(0), rel=0.03)
    assert doubled.mean(1) == pytest.approx(plain.mean(1), rel=0.05)


def test_no_light_comes_through_a_wall_without_thickness() -> None:
    """Two closed halves of a room with one quad between them, a lamp in one: the other is black, to the last bit."""
    room = scenes.box("room", (4, 2, 2), texels=8, inward=True)
    wall = scenes.quad("wall", [(0, -1, -1), (0, 1, -1), (0, 1, 1), (0, -1, 1)])  # faces +x
    instances = (Instance("room", 0, np.eye(4)), Instance("wall", 1, np.eye(4)))
    scene = Scene((room, wall), instances, (GREY,), (scenes.point_light((1, 0, 0), 50.0),))
    baked = Baked(scene, scenes.grid_atlas(scene, [(30, 20), (8, 8)], back=(1,)))
    assert baked.mean(1, side=0) > 1
    assert baked.mean(1, side=1) == 0


def test_mirrored_sheared_and_stretched_equal_the_same_shape_applied() -> None:
    scene, atlas = scenes.cornell(8)
    linear = np.array([[-1.2, 0.3, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 1.5]])  # a reflection
    matrix = scene.instances[5].matrix_world.copy()
    matrix[:3, :3] = linear
    by_matrix = replace(scene.instances[5], matrix_world=matrix)
    mesh = scene.meshes[5]
    corners = (mesh.vertices @ linear.T).reshape(-1, 3, 3)[:, ::-1]  # turned, so that its front stays outside
    applied = scenes.mesh_of_triangles("short", corners, mesh.corner_uv[:, ::-1], mesh.island_of_triangle)
    at = np.eye(4)
    at[:3, 3] = matrix[:3, 3]
    others = scene.instances
    one = Baked(replace(scene, instances=(*others[:5], by_matrix, others[6])), atlas)
    two = Baked(
        replace(
            scene,
            instances=(*others[:5], replace(others[5], matrix_world=at), others[6]),
            meshes=(*scene.meshes[:5], applied, scene.meshes[6]),
        ),
        atlas,
    )
    for instance in range(7):
        assert one.mean(instance) == pytest.approx(two.mean(instance), rel=0.02)


@pytest.mark.parametrize("linear", [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([1e-6, 1.0, 1e3])])
@pytest.mark.parametrize("moving", [False, True])
def test_flat_and_vanishing_transforms(linear: np.ndarray, moving: bool) -> None:
    scene, atlas = scenes.cornell(6)
    matrix = scene.instances[5].matrix_world.copy()
    matrix[:3, :3] = linear
    squeezed = replace(scene.instances[5], matrix_world=matrix, moving=moving)
    baked = Baked(replace(scene, instances=(*scene.instances[:5], squeezed, scene.instances[6])), atlas)
    assert baked.mean(0) > 1


def test_a_transform_that_is_not_finite_is_refused_by_name() -> None:
    scene, atlas = scenes.cornell(4)
    lost = replace(scene.instances[6], matrix_world=np.full((4, 4), np.nan))
    with pytest.raises(BakeError, match="tall: its transform is not finite; clear it"):
        Baked(replace(scene, instances=(*scene.instances[:6], lost)), atlas)


def test_surfaces_of_one_texel() -> None:
    scene, atlas = scenes.cornell(1)
    coarse, fine = Baked(scene, atlas), Baked(*scenes.cornell(16))
    assert np.count_nonzero(coarse.instance == 0) == 1
    assert coarse.mean(0) == pytest.approx(fine.mean(0), rel=0.5)


def test_instances_of_one_mesh_have_light_of_their_own() -> None:
    tile = scenes.quad("tile", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    places = (scenes.translation(0, 0, 0), scenes.translation(8, 0, 0), scenes.translation(0, 0, 0))
    instances = tuple(Instance(f"tile {i}", 0, place) for i, place in enumerate(places))
    scene = Scene((tile,), instances, (GREY,), (scenes.point_light((0, 0, 1), 50.0),))
    baked = Baked(scene, scenes.grid_atlas(scene, [(6, 6)] * 3))
    assert baked.mean(0) > 20 * baked.mean(1) > 0
    assert baked.mean(2) == pytest.approx(baked.mean(0), rel=0.02)  # at the very same place


def test_200_000_triangles_in_time() -> None:
    """A finely cut floor under a lamp. What stands at a place does not depend on how finely it is cut."""
    n = 316
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    square = np.stack([np.stack([x + a, y + b], axis=-1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], axis=2) / n
    uv = square.reshape(-1, 4, 2)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 2)
    corners = np.concatenate([uv * 4 - 2, np.zeros((*uv.shape[:2], 1))], axis=2)
    fine = scenes.mesh_of_triangles("floor", corners, uv, np.zeros(len(uv)))
    ball = scenes.translation(0, 0, 1)
    block = scenes.box("block", (0.5, 0.5, 0.5), texels=4)
    results = []
    for floor in (floor_and().meshes[0], fine):
        instances = (Instance("floor", 0, np.eye(4)), Instance("block", 1, ball))
        scene = Scene((floor, block), instances, (GREY,), (scenes.point_light((1, 0, 2), 50.0),))
        start = time.perf_counter()
        results.append(Baked(scene, scenes.grid_atlas(scene, [(24, 24), (18, 12)])))
        seconds = time.perf_counter() - start
    assert fine.triangle_count == 2 * n * n
    assert results[1].mean(0) == pytest.approx(results[0].mean(0), rel=0.01)
    assert results[1].mean(1) == pytest.approx(results[0].mean(1), rel=0.05)
    assert seconds < 10  # takes about 2 on one core


@pytest.mark.parametrize("bounced", [AimBounced.FEEDBACK, AimBounced.PHOTONS])
def test_objects_that_fold_fly_off_vanish_and_break_between_frames(bounced: AimBounced) -> None:
    """And in the end all is as at the start, to the bit."""
    scene, atlas = scenes.cornell(6)
    instances = tuple(replace(i, moving=True, deforming=i.name == "tall") for i in scene.instances)
    scene, start, rng = replace(scene, instances=instances), scene.first_frame(0), np.random.default_rng(1)
    settings = replace(BARE, resolution=atlas.resolution, aim_bounced=bounced)
    with Session(scene, atlas, settings, start) as session:
        first = session.advance(start).maps
        for frame in range(1, 7):
            matrices = start.matrix_world.copy()
            matrices[frame % 7, :3, :3] *= rng.choice([0.0, -1.0, 1e-5, 1e4], 3)
            matrices[(frame + 2) % 7, :3, 3] += rng.normal(size=3) * 10.0 ** rng.integers(-2, 6)
            vertices = scene.meshes[6].vertices * rng.normal(size=3).astype(np.float32)
            vertices[frame] = np.nan
            state = replace(start, frame=frame, matrix_world=matrices, visible=rng.random(7) > 0.2)
            result = session.advance(replace(state, vertices={6: vertices}))
            assert np.isfinite(result.maps.aim).all() and (result.maps.aim >= 0).all()
            assert result.stats.warnings == [
                f"tall: frame {frame}: 1 of its vertices are not finite; they are put at its origin"
            ]
        whole = replace(start, vertices={6: scene.meshes[6].vertices})
        last = session.advance(whole).maps
    if bounced is AimBounced.FEEDBACK:  # photon bounds stay as large as they had to be
        np.testing.assert_array_equal(last.aim, first.aim)


# --- lamps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0.0, 0.2])
@pytest.mark.parametrize("kind", [LightKind.POINT, LightKind.SPOT, LightKind.AREA])
def test_a_lamp_on_a_surface(kind: LightKind, radius: float) -> None:
    """Distance 0: no more than the lamp's own light arrives, however near the texels' points lie."""
    lamp = Light("lamp", kind, np.eye(4), (100.0,) * 3, radius=radius, size=(radius, radius))
    scene = floor_and(scenes.quad("roof", [(-2, 2, 1), (2, 2, 1), (2, -2, 1), (-2, -2, 1)]), lights=(lamp,))
    baked = Baked(scene, placed(scene, both=True))
    absorbed = ((1 - 0.5) * baked.aim * baked.area[:, None]).sum(axis=0)
    assert (absorbed <= 100.0 * 1.3).all()  # the lamp's texel has eight points to meet its peak with


def test_a_lamp_inside_a_wall_lights_nothing() -> None:
    """A wall of 20 cm with a lamp in its middle, over a floor."""
    wall = scenes.box("wall", (4, 0.2, 2), texels=4)
    scene = floor_and(lights=(scenes.point_light((0, 0, 1), 1e6),))
    instances = (*scene.instances, Instance("wall", 1, scenes.translation(0, 0, 1.2)))
    scene = replace(scene, meshes=(*scene.meshes, wall), instances=instances)
    assert not Baked(scene, scenes.grid_atlas(scene, [(16, 16), (18, 12)])).aim.any()


def test_a_lamp_in_a_closed_box_that_nobody_sees() -> None:
    scene, _ = scenes.cornell(8)
    vault = scenes.box("vault", (0.3, 0.3, 0.3), texels=2)
    instances = (*scene.instances, Instance("vault", 7, scenes.translation(0.4, -0.4, 1.2)))
    scene = replace(scene, meshes=(*scene.meshes, vault), instances=instances)
    atlas = scenes.grid_atlas(scene, [(8, 8)] * 5 + [(12, 8)] * 3)
    hidden = scenes.point_light((0.4, -0.4, 1.2), 1e6, "hidden")
    plain, with_it = Baked(scene, atlas), Baked(replace(scene, lights=(*scene.lights, hidden)), atlas)
    np.testing.assert_array_equal(with_it.aim, plain.aim)


def test_a_black_lamp_and_a_broken_one() -> None:
    scene, atlas = scenes.cornell(6)
    black = replace(scene.lights[0], name="black", power=(0.0, 0.0, 0.0))
    lost = replace(scene.lights[0], name="lost", matrix_world=np.full((4, 4), np.nan))
    blue = replace(scene.lights[0], name="blue", power=(-5.0, 0.0, np.nan))
    plain = Baked(scene, atlas)
    baked = Baked(replace(scene, lights=(*scene.lights, black, lost, blue)), atlas)
    np.testing.assert_array_equal(baked.aim, plain.aim)
    assert [line.split(":")[0] for line in baked.warnings] == ["lost", "blue"]
    assert not Baked(replace(scene, lights=(black,)), atlas).aim.any()


def test_a_sky_with_broken_pixels() -> None:
    radiance = np.ones((4, 8, 3), np.float32)
    clean = floor_and()
    clean = replace(clean, world=World(radiance.copy()))
    radiance[0, 0] = np.inf  # looks down, where the floor sees nothing
    radiance[0, 1] = -1
    baked = Baked(replace(clean, world=World(radiance)), placed(clean))
    np.testing.assert_allclose(baked.iim, np.pi, rtol=0.02)
    assert baked.warnings == ["world: light that is negative or not finite counts as zero"]


# --- mirrors and glass --------------------------------------------------------------------------------------------


def test_mirror_facing_mirror() -> None:
    """Light between two endless mirrors ends after ``max_specular``; the floor between them stays bounded."""
    left = scenes.quad("left", [(-2, -2, 0), (-2, 2, 0), (-2, 2, 4), (-2, -2, 4)], material=1)
    right = scenes.quad("right", [(2, 2, 0), (2, -2, 0), (2, -2, 4), (2, 2, 4)], material=1)
    scene = floor_and(left, right, lights=(scenes.point_light((0, 0, 1), 100.0),), materials=(GREY, MIRROR))
    baked = Baked(scene, placed(scene))
    floor = baked.instance == 0
    absorbed = (0.5 * baked.aim[floor] * baked.area[floor, None]).sum(axis=0)
    assert baked.maps.caustics is not None and baked.maps.caustics.any()
    assert (absorbed <= 100.0).all()


def test_glass_within_glass_and_total_internal_reflection() -> None:
    """Three shells and a lamp in the innermost: what leaves lands, and it is no more than the lamp gives."""
    shells = [scenes.box(f"shell {i}", (s, s, s), texels=2, material=1) for i, s in enumerate((1.5, 1.0, 0.5))]
    room = scenes.box("room", (4, 4, 4), texels=6, inward=True)
    meshes = (room, *shells)
    instances = tuple(Instance(m.name, i, np.eye(4)) for i, m in enumerate(meshes))
    for ior in (1.5, 2.4, 1.0):
        lamp = scenes.point_light((0.05, 0.02, 0.03), 100.0)
        scene = Scene(meshes, instances, (GREY, replace(GLASS, ior=ior)), (lamp,))
        baked = Baked(scene, scenes.grid_atlas(scene, [(24, 16)] + [(12, 8)] * 3), replace(BARE, photons=60_000))
        walls = baked.instance == 0
        absorbed = (0.5 * baked.aim[walls] * baked.area[walls, None]).sum(axis=0)
        assert (absorbed <= 100.0 * 1.02).all()
        assert (absorbed >= {1.0: 95.0, 1.5: 10.0, 2.4: 0.5}[ior]).all()


def test_an_index_of_refraction_of_nothing_is_told() -> None:
    pane = scenes.quad("pane", [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)], material=1)
    scene = floor_and(pane, lights=(scenes.point_light((0, 0, 2)),), materials=(GREY, replace(GLASS, ior=0.0)))
    assert Baked(scene, placed(scene)).warnings == ["material glass: an index of refraction of 0.0 is taken as 1.45"]


def test_the_table_of_cases_names_tests_that_exist() -> None:
    root = Path(__file__).parents[2]
    named = re.findall(r"`(\w+)/(\w+)::(\w+)`", (root / "docs" / "robustness.md").read_text())
    assert len(named) > 60
    for folder, file, test in named:
        assert f"def test_{test}(" in (root / "tests" / folder / f"test_{file}.py").read_text(), (file, test)
