# SPDX-License-Identifier: GPL-3.0-or-later
"""Passes "place", "view" and "background": every pixel of a view shows what a ray through its middle sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.rooms import turned
from rtgi_addon.backend.final_gather.views.raster import MOST_RANGES
from rtgi_addon.backend.final_gather.views.target import Target
from rtgi_addon.backend.gpu.triangles import SceneTriangles, corners_of_scene
from rtgi_addon.backend.scene import Atlas, Instance, Mesh, Placement, Scene, World
from rtgi_addon.backend.settings import Gather
from tests.backend import scenes, stories
from tests.gpu.looks import Look, changed, lifted_box, scene_of, tiles

SOME = 37  # every so many texels
SQUARE = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
FLOOR = scenes.quad("floor", SQUARE)


def some(look: Look, step: int = SOME) -> np.ndarray:
    return np.arange(0, look.texels.count, step, dtype=np.int32)


def on(look: Look, instance: int) -> np.ndarray:
    return np.flatnonzero(look.texels.instance == instance)


# --- place ------------------------------------------------------------------------------------------------------------


def assert_placed(triangles: SceneTriangles, look: Look) -> None:
    """Where the geometry has them, to some float32 steps of the largest coordinate of the object."""
    geometry = look.geometry
    with look.gpu.current():
        placed = np.frombuffer(triangles.placed.read(), np.float32).reshape(-1, 3)
    vertex = triangles.indices(np.arange(triangles.count, dtype=np.int32)).astype(np.int64)
    mirrored = geometry.mirrored[geometry.instance_of_triangle]
    vertex[mirrored] = vertex[mirrored][:, ::-1]
    for instance in range(len(geometry.scene.instances)):
        rows = geometry.triangles_of(instance)
        corners = geometry.corners[rows]
        step = np.finfo(np.float32).eps * max(np.abs(corners).max(initial=0), 1e-30)
        np.testing.assert_allclose(placed[vertex[rows]], corners, rtol=0, atol=6 * step)


def triangles_of(look: Look) -> SceneTriangles:
    return SceneTriangles(look.gpu, look.geometry, look.texels, look.state, corners_of_scene(look.geometry))


@pytest.mark.parametrize("matrix", [
    np.diag([-1.0, 1, 1, 1]), np.diag([2.0, -0.5, 3, 1]), np.diag([1.0, 1, 0, 1]), np.diag([1e-3, 1e-3, 1e-3, 1]),
    np.array([[1, 0.7, 0, 0.2], [0, 1, -0.4, 0.1], [0.3, 0, 1, 0.5], [0, 0, 0, 1]]), np.diag([0.0, 0, 0, 1]),
], ids=["mirrored", "mirrored and stretched", "flat", "tiny", "sheared", "a point"])  # fmt: skip
def test_objects_are_placed_where_the_geometry_has_them(gpu, matrix) -> None:
    look = Look(gpu, *lifted_box(moving=True))
    triangles = triangles_of(look)
    assert_placed(triangles, look)
    matrices = look.state.matrix_world.copy()
    matrices[5] = matrices[5] @ matrix
    look.follow(matrix_world=matrices)
    triangles.follow(np.array([5]), look.state)
    assert_placed(triangles, look)
    triangles.release()


def test_deforming_objects_are_placed_where_the_geometry_has_them(gpu) -> None:
    scene, atlas = stories.studio()
    flap = stories.number_of(scene, "flap")
    look = Look(gpu, scene, atlas)
    triangles = triangles_of(look)
    for amount in (0.5, -1.5, 0.0):
        vertices, normals = stories.bent(scene.meshes[flap], amount)
        look.follow(vertices={flap: vertices}, corner_normals={flap: normals})
        triangles.follow(np.array([flap]), look.state)
        assert_placed(triangles, look)
    triangles.release()


def test_a_mesh_far_from_its_objects_origin_keeps_its_digits(gpu) -> None:
    scene, atlas = scene_of(FLOOR, scenes.box("block", (0.5, 0.5, 0.5), texels=2), size=12)
    far = scene.meshes[1].vertices + np.float32([1000, -2000, 500])
    scene = replace(scene, meshes=(FLOOR, replace(scene.meshes[1], vertices=far)))
    back = scenes.translation(-1000, 2000, -499.2)
    look = Look(gpu, changed(scene, [np.eye(4), turned(0.4, 0, 0, 0) @ back]), atlas)
    triangles = triangles_of(look)
    assert_placed(triangles, look)
    triangles.release()


# --- view -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Gather.PLANE, Gather.HEMICUBE])
def test_pixels_show_what_rays_see(gpu, kind) -> None:
    """On each face of the view by itself, too. Measured with llvmpipe: 99.98 % and more."""
    look = Look(gpu, *lifted_box(), kind, 32)
    texel = some(look)
    images = look.assert_as_rays(texel)
    rays = look.traced(look.eyes(texel))
    for face in look.view.faces:
        left, bottom, width, height = face.rectangle
        part = np.s_[:, bottom : bottom + height, left : left + width]
        assert (images[part] == rays[part]).mean() >= 0.995
        assert len(np.unique(images[part])) > 50


def test_surfaces_that_touch_each_other_are_told_apart(gpu) -> None:
    """The blocks stand on the floor: nothing of their bottoms is seen from without."""
    look = Look(gpu, *scenes.cornell(12), Gather.HEMICUBE, 32)
    look.assert_as_rays(some(look, 61))


def test_what_is_drawn_into_a_tile_does_not_hang_on_the_others(gpu) -> None:
    look = Look(gpu, *lifted_box(6))
    eyes, count = look.eyes(some(look, 5)), len(some(look, 5))
    target = Target(gpu, look.view, 10, -(-count // 10))
    tile = np.arange(count, dtype=np.int32)
    look.raster.draw(target, tile, eyes)
    together = tiles(target)[:count].copy()
    order = np.random.default_rng(0).permutation(count)
    for rows in (order[: count // 2], order[:1], order):  # into tiles that hold the same, or something else
        if len(rows) == count:
            look.raster.draw(target, tile, look.eyes(some(look, 5)[::-1]))
        look.raster.draw(target, tile[rows], eyes.take(rows))
        np.testing.assert_array_equal(tiles(target)[:count], together)
    target.release()


def test_two_sided_surfaces_show_the_side_that_is_seen(gpu) -> None:
    """The studio's sheet and flap have maps on both sides; the sky has two patches."""
    scene, atlas = stories.studio(6)
    look = Look(gpu, scene, atlas, Gather.HEMICUBE, 32)
    images = look.assert_as_rays(some(look, 11))
    seen = np.unique(images)
    inside = seen[(seen >= 0) & (seen < look.texels.count)]
    pane = stories.number_of(scene, "pane")
    of_pane = inside[look.texels.instance[inside] == pane]
    assert {0, 1} == set(look.texels.side[of_pane])
    assert (seen >= look.texels.count).sum() == 2


@pytest.mark.parametrize("back", [False, True])
def test_a_mirrored_object_keeps_its_front(gpu, back) -> None:
    """The sheet above faces down to the floor, by its own winding or because it is mirrored."""
    sheet = scenes.quad("sheet", [(x, y, 0.5) for x, y, _ in SQUARE[::-1]])
    scene, atlas = scene_of(FLOOR, sheet, back=(1,) if back else ())
    for matrix in (np.eye(4), np.diag([-1.0, 1, 1, 1])):
        look = Look(gpu, changed(scene, [np.eye(4), matrix]), atlas)
        images = look.assert_as_rays(on(look, 0)[::3])
        assert (look.owner(images) == 1).any()
        shown = np.unique(images[look.owner(images) == 1])
        assert (look.texels.side[shown] == 0).all()
        look.raster.release()


def test_backs_without_a_map_are_seen_as_none(gpu) -> None:
    sheet = scenes.quad("sheet", [(x, y, 0.5) for x, y, _ in SQUARE])
    look = Look(gpu, *scene_of(FLOOR, sheet))
    images = look.assert_as_rays(on(look, 0)[::3])
    assert set(np.unique(images)) == {-1 - look.entries.none, -1 - look.entries.escaped}


def test_several_pages_of_an_atlas(gpu) -> None:
    scene, atlas = lifted_box()
    on_page = [Placement(n % 3, p.scale, p.offset) for n, p in enumerate(atlas.front)]
    look = Look(gpu, scene, Atlas(atlas.resolution, 3, tuple(on_page), atlas.back), Gather.HEMICUBE, 32)
    images = look.assert_as_rays(some(look))
    pages = look.texels.page[np.unique(images[images >= 0])]
    assert set(pages) == {0, 1, 2}


# --- from frame to frame ----------------------------------------------------------------------------------------------


def test_a_mover_is_followed_to_the_last_bit(gpu) -> None:
    """As if the scene had been placed there from the beginning; mirrored on the way."""
    scene, atlas = lifted_box(moving=True)
    look = Look(gpu, scene, atlas)
    eyes = some(look)
    first, crossed = look.drawn(look.eyes(eyes)), []
    for matrix in (turned(1.0, -0.4, -0.6, 1.3), turned(1.0, 0.4, -0.6, 1.3) @ np.diag([1.0, -1, 1, 1])):
        matrices = look.state.matrix_world.copy()
        matrices[5] = matrix
        look.follow(matrix_world=matrices)
        crossed.append(look.assert_as_rays(eyes))
        fresh = Look(gpu, scene, atlas, state=look.state)
        # Local space has another origin there; a pixel in a thousand lies on an edge.
        assert (fresh.drawn(fresh.eyes(eyes)) != crossed[-1]).mean() < 1e-3
        fresh.raster.release()
    assert (crossed[0] != crossed[1]).mean() > 0.02
    look.follow(matrix_world=scene.first_frame().matrix_world)
    np.testing.assert_array_equal(look.drawn(look.eyes(eyes)), first)


def test_hidden_objects_and_those_that_block_no_light_are_not_drawn(gpu) -> None:
    scene, atlas = lifted_box(moving=True)
    instances = [replace(i, blocks_light=i.name != "back") for i in scene.instances]
    look = Look(gpu, replace(scene, instances=tuple(instances)), atlas)
    texel = some(look)
    assert set(np.unique(look.owner(look.assert_as_rays(texel)))) == {-1, 0, 1, 3, 4, 5, 6}
    visible = look.state.visible.copy()
    visible[5] = False
    look.follow(visible=visible)
    assert set(np.unique(look.owner(look.assert_as_rays(texel)))) == {-1, 0, 1, 3, 4, 6}
    look.follow(visible=np.ones(7, np.bool_))
    assert set(np.unique(look.owner(look.assert_as_rays(texel)))) == {-1, 0, 1, 3, 4, 5, 6}


def test_what_is_hidden_among_many_objects_is_not_drawn_with_them(gpu) -> None:
    """More ranges to draw than are drawn apart; joining them must not bring back what lies between."""
    count = 2 * MOST_RANGES + 20
    plate = scenes.quad("plate", [(-0.05, 0.05, 0), (0.05, 0.05, 0), (0.05, -0.05, 0), (-0.05, -0.05, 0)])
    places = [scenes.translation(0.2 * (n % 10) - 0.9, 0.2 * (n // 10) - 0.8, 0.3) for n in range(count)]
    plates = [Instance(f"plate {n}", 1, m, moving=True) for n, m in enumerate(places)]
    scene = Scene((FLOOR, plate), (Instance("floor", 0, np.eye(4)), *plates), (scenes.WHITE,))
    look = Look(gpu, scene, scenes.grid_atlas(scene, [(6, 6)] + [(1, 1)] * count))
    visible = np.ones(count + 1, np.bool_)
    visible[2::2] = False
    look.follow(visible=visible)
    images = look.assert_as_rays(on(look, 0)[::4])
    assert set(np.unique(look.owner(images))) <= {-1, *np.flatnonzero(visible)}


# --- hard cases -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("away", [1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("kind", [Gather.PLANE, Gather.HEMICUBE])
def test_a_wall_that_stands_on_the_texel_hides_what_is_behind_it(gpu, kind, away) -> None:
    """It crosses the plane of the eye, ``away`` m from it; a room about both."""
    room = scenes.box("room", (8, 8, 8), texels=4, inward=True)
    scene, atlas = scene_of(FLOOR, scenes.quad("wall", [(0, -3, -1), (0, 3, -1), (0, 3, 3), (0, -3, 3)]), room, size=18)
    look = Look(gpu, scene, atlas, kind, 32)
    texel = on(look, 0)
    eyes = look.eyes(texel)
    nearest = np.argsort(np.abs(eyes.eye[:, 0]))[:6]
    eyes = eyes.take(nearest)
    eyes.eye[:, 0] = [away, -away] * 3
    differ, strange = look.apart(eyes)
    assert differ < 0.005 and strange < 1e-3
    images = look.drawn(eyes)
    if away == 1e-4:  # half of all that is seen is the wall
        for image in images:
            shown = (look.owner(image) == 1) | (image == -1 - look.entries.none)
            assert look.view.weights[shown].sum() == pytest.approx(look.view.weights.sum() / 2, rel=0.02)


def test_a_sheet_through_the_eye_is_seen_from_one_of_its_sides_or_edge_on(gpu) -> None:
    """Rounding tells which; a micrometre beside it the sheet hides half of all there is."""
    sheet = scenes.quad("sheet", [(0, -99, -1), (0, 99, -1), (0, 99, 99), (0, -99, 99)])
    look = Look(gpu, *scene_of(FLOOR, sheet))
    eyes, images = look.eyes(on(look, 0)[:8]), []
    for beside in (0, 1e-6, -1e-6):
        eyes.eye[:, 0] = beside
        images.append(look.drawn(eyes))
    middle, left, right = images
    escaped = np.full_like(middle, -1 - look.entries.escaped)
    assert ((left == escaped).mean(axis=(1, 2)) + (right == escaped).mean(axis=(1, 2)) < 1.1).all()
    like = (middle == left) | (middle == right) | (middle == escaped)
    assert like.mean() > 1 - 32 / 768  # all but the pixels that the sheet's plane runs through


@pytest.mark.parametrize("scale", [1e-3, 1e3, 1e6])
def test_scenes_of_any_size_are_drawn_alike(gpu, scale) -> None:
    scene, atlas = lifted_box()
    look = Look(gpu, changed(scene, [np.diag([scale, scale, scale, 1.0])] * 7), atlas)
    assert len(np.unique(look.assert_as_rays(some(look)))) > 300


def test_a_million_metres_out_is_drawn_as_here(gpu) -> None:
    scene, atlas = lifted_box()
    here = Look(gpu, scene, atlas)
    there = Look(gpu, changed(scene, [scenes.translation(1e6, -1e6, 2e5)] * 7), atlas)
    images = [look.assert_as_rays(some(look)) for look in (here, there)]
    assert (images[0] == images[1]).mean() > 0.995


def test_small_things_far_away_and_near_are_seen_in_their_order(gpu) -> None:
    """A millimetre apart at a kilometre: depth tells a millionth of any distance."""
    lids = [scenes.quad(f"lid {z}", [(x * 900, y * 900, z) for x, y, _ in SQUARE[::-1]]) for z in (1000, 1000.01, 1e-3)]
    small = np.diag([1e-6, 1e-6, 1, 1])
    scene, atlas = scene_of(FLOOR, *lids)
    look = Look(gpu, changed(scene, [np.eye(4), np.eye(4), np.eye(4), small]), atlas, Gather.PLANE)
    images = look.owner(look.drawn(look.eyes(on(look, 0))))
    assert (images == 1).any() and not (images == 2).any()


def with_rubbish(mesh: Mesh) -> Mesh:
    """``mesh`` and triangles that are a point or a line, or have one of two more vertices as a corner."""
    count = len(mesh.vertices)
    more = np.array([[0, 0, 0], [0, 1, 1], [count, 1, 2], [0, 1, count + 1], [count, count + 1, 0]], np.int32)
    none, flat = np.zeros(len(more), np.int32), np.zeros((len(more), 3, 3), np.float32)
    return replace(
        mesh, vertices=np.concatenate([mesh.vertices, mesh.vertices[[1, 1]]]),
        triangles=np.concatenate([mesh.triangles, more]),
        corner_normals=np.concatenate([mesh.corner_normals, flat]),
        corner_uv=np.concatenate([mesh.corner_uv, flat[:, :, :2]]),
        island_of_triangle=np.concatenate([mesh.island_of_triangle, none]),
        material_of_triangle=np.concatenate([mesh.material_of_triangle, none]),
    )  # fmt: skip


def test_triangles_that_are_none_hide_nothing(gpu) -> None:
    """Without area, or with a corner that is no place."""
    scene, atlas = lifted_box()
    meshes = (*scene.meshes[:5], *(with_rubbish(m) for m in scene.meshes[5:]))
    rough = replace(scene, meshes=meshes, instances=tuple(replace(i, deforming=True) for i in scene.instances))
    look = Look(gpu, rough, atlas)
    images = look.assert_as_rays(some(look))
    torn = meshes[5].vertices.copy()
    torn[-2:] = [[np.nan, 0, 0], [np.inf, 0, 1]]
    with np.errstate(invalid="ignore"):
        look.follow(vertices={5: torn})
    np.testing.assert_array_equal(look.assert_as_rays(some(look)), images)


def test_a_scene_without_triangles_can_be_looked_at(gpu) -> None:
    for sky in (None, scenes.constant_sky(1.0), World(np.ones((3, 4, 3), np.float32))):
        look = Look(gpu, Scene((), (), (), (), sky), Atlas(16, 1, (), ()))
        look.follow(frame=2)
        look.raster.release()


def test_one_triangle_sees_nothing_and_one_texel_is_seen(gpu) -> None:
    one = scenes.mesh_of_triangles("one", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0], [1, 0], [0, 1]], [0])
    lid = scenes.mesh_of_triangles("lid", [[0, 0, 1], [0, 1, 1], [1, 0, 1]], [[0, 0], [0, 1], [1, 0]], [0])
    alone = Look(gpu, *scene_of(one, size=1))
    assert alone.texels.count == 1
    assert (alone.assert_as_rays([0]) == -1 - alone.entries.escaped).all()
    two = Look(gpu, *scene_of(one, lid, size=1))
    images = two.assert_as_rays([0, 1])
    assert set(np.unique(images[0])) == {1, -1 - two.entries.escaped}
    assert set(np.unique(images[1])) == {0, -1 - two.entries.escaped}


# --- background -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows, columns", [(1, 1), (2, 1), (1, 5), (4, 8), (32, 64)])
def test_the_sky_s_patches_are_those_of_their_directions(gpu, rows, columns) -> None:
    """From texels that look to all sides; graphics drivers take arcsines of a few digits."""
    ball = scenes.sphere("ball", 1.0, rings=8, inward=False)
    scene, atlas = scene_of(ball)
    image = np.arange(1, 1 + 3 * rows * columns, dtype=np.float32).reshape(rows, columns, 3)
    look = Look(gpu, replace(scene, world=World(image)), atlas, Gather.HEMICUBE, 32)
    images = look.assert_as_rays(np.arange(0, look.texels.count, 5), least=0.99)
    patches = np.unique(images[images >= look.texels.count])
    assert len(patches) >= 0.98 * rows * columns  # the smallest, straight up and down, lie between the pixels


def test_the_sky_is_drawn_anew_where_something_was(gpu) -> None:
    scene, atlas = lifted_box(6, moving=True)
    look = Look(gpu, replace(scene, world=World(np.ones((2, 2, 3), np.float32))), atlas)
    visible = np.zeros(7, np.bool_)
    before = look.assert_as_rays(some(look))
    look.follow(visible=visible)
    bare = look.assert_as_rays(some(look))
    assert (bare >= look.texels.count).all()
    look.follow(visible=~visible)
    np.testing.assert_array_equal(look.assert_as_rays(some(look)), before)
