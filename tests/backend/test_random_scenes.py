# SPDX-License-Identifier: GPL-3.0-or-later
"""Random scenes through the whole session: whatever stands in them, a bake ends with finite, bounded, lawful maps.

Shapes, transforms, materials and lamps are drawn on purpose from what goes wrong: flat, mirrored and sheared matrices,
lamps in and on surfaces, albedo up to 1.5, emission up to 1e6. RTGI_EXAMPLES sets how many scenes are tried.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.limits import MOST_ALBEDO
from rtgi_addon.backend.scene import AreaShape, Atlas, Instance, Light, LightKind, Material, Mesh, Scene, World
from rtgi_addon.backend.session import FrameResult, Session
from rtgi_addon.backend.settings import AimBounced, BakeSettings, Quality
from tests.backend import scenes

EXAMPLES = int(os.environ.get("RTGI_EXAMPLES", "25"))
TRY = settings(max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
FEW = settings(TRY, max_examples=max(EXAMPLES // 4, 5))
BARE = BakeSettings(denoise=False, quality=Quality.DRAFT, threads=1, photons=2000, seams=True)
STEADY = replace(BARE, quality=Quality.PREVIEW, direct_samples=64)
FACE = 3  # texels along the side of a square

SQUARE = scenes.quad("square", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
TRIANGLE = scenes.mesh_of_triangles("triangle", [[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 0], [1, 0], [0, 1]], [0])
BOX = scenes.box("box", (1, 1, 1), texels=FACE)
ROOM = scenes.box("room", (4, 4, 4), texels=FACE, inward=True)
SIZES = {"square": (FACE, FACE), "triangle": (FACE, FACE), "box": (3 * (FACE + 2), 2 * (FACE + 2))}
SIZES["room"] = SIZES["box"]

rgb = st.tuples(*[st.floats(0, 1.5)] * 3)
share = st.sampled_from([0.0, 0.5, 1.0]).map(lambda x: (x, x, x))
albedos = st.one_of(rgb, st.sampled_from([0.0, 0.5, 1.0, 1.5]).map(lambda x: (x, x, x)))
emissions = st.one_of(st.just((0.0, 0.0, 0.0)), st.sampled_from([1e-6, 1.0, 1e6]).map(lambda x: (x, 0.0, x / 2)))
materials = st.builds(
    Material,
    name=st.just("paint"),
    albedo=albedos,
    emission=emissions,
    specular=st.one_of(st.just((0.0, 0.0, 0.0)), share),
    transmission=st.one_of(st.just((0.0, 0.0, 0.0)), share),
    ior=st.sampled_from([1.0, 1.45, 2.4, 0.7]),
    opacity=st.sampled_from([1.0, 1.0, 0.5, 0.0]),
)
#: Columns of the linear part: turned, mirrored, sheared, stretched, flat, gone.
coordinate = st.floats(-2, 2, width=32)
linear = st.one_of(
    st.just(np.eye(3)),
    st.lists(coordinate, min_size=9, max_size=9).map(lambda c: np.array(c).reshape(3, 3)),
    st.sampled_from([np.diag([-1, 1, 1]), np.diag([1, 1, 0]), np.diag([1e-4, 1, 1e3]), np.zeros((3, 3))]),
)
places = st.tuples(coordinate, coordinate, coordinate)


def matrix_of(columns: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = columns, place
    return matrix


matrices = st.builds(matrix_of, linear, places)
lamps = st.builds(
    Light,
    name=st.just("lamp"),
    kind=st.sampled_from(list(LightKind)),
    matrix_world=matrices,
    power=st.sampled_from([(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1e6, 0.0, 1.0), (50.0, 20.0, 10.0)]),
    radius=st.sampled_from([0.0, 0.1, 3.0]),
    soft_falloff=st.booleans(),
    angle=st.sampled_from([0.0, 0.05, 1.5]),
    cone=st.sampled_from([0.0, 0.3, 1.5]),
    blend=st.sampled_from([0.0, 0.15, 1.0]),
    size=st.sampled_from([(1.0, 1.0), (0.0, 1.0), (5.0, 0.1)]),
    shape=st.sampled_from(list(AreaShape)),
    spread=st.sampled_from([np.pi, 1.0, 0.0]),
    casts_shadow=st.booleans(),
)
skies = st.sampled_from(
    [
        None,
        scenes.constant_sky(0.0),
        scenes.constant_sky(1.0),
        World(np.eye(4, 8, dtype=np.float32)[..., None] * [9, 5, 1]),
    ]
)


@st.composite
def random_scenes(draw: st.DrawFn, *, closed: bool = False) -> tuple[Scene, Atlas]:
    """A few shapes anywhere, in a closed room or not, each mapped on both of its sides."""
    shapes: list[Mesh] = draw(
        st.lists(st.sampled_from([SQUARE, TRIANGLE, BOX]), min_size=0 if closed else 1, max_size=3)
    )
    looks = [draw(materials) for _ in range(len(shapes) + closed)]
    if closed:
        shapes.append(ROOM)
        looks[-1] = replace(looks[-1], opacity=1.0, transmission=(0.0, 0.0, 0.0), specular=(0.0, 0.0, 0.0))
    meshes = tuple(
        replace(mesh, material_of_triangle=np.full(mesh.triangle_count, number, np.int32))
        for number, mesh in enumerate(shapes)
    )
    moving = draw(st.booleans())
    instances = tuple(
        Instance(f"{m.name} {i}", i, np.eye(4) if m.name == "room" else draw(matrices), moving=moving)
        for i, m in enumerate(meshes)
    )
    lights = tuple(draw(st.lists(lamps, max_size=2)))
    scene = Scene(meshes, instances, tuple(looks), lights, None if closed else draw(skies))
    return scene, scenes.grid_atlas(scene, [SIZES[m.name] for m in meshes], back=tuple(range(len(meshes))))


def bake(scene: Scene, atlas: Atlas, choice: BakeSettings = BARE) -> tuple[Session, FrameResult]:
    state = scene.first_frame()
    with Session(scene, atlas, replace(choice, resolution=max(16, atlas.resolution)), state) as session:
        return session, session.advance(state)


def assert_lawful(result: FrameResult) -> None:
    maps = result.maps
    for page in (maps.iim, maps.aim, *(() if maps.caustics is None else (maps.caustics,))):
        assert np.isfinite(page).all()
        assert (page >= 0).all()


@given(random_scenes(), st.sampled_from(list(AimBounced)))
@TRY
def test_any_scene_ends_finite_and_not_negative(made: tuple[Scene, Atlas], bounced: AimBounced) -> None:
    assert_lawful(bake(*made, replace(BARE, aim_bounced=bounced))[1])


@given(random_scenes(closed=True))
@TRY
def test_no_texel_gets_more_than_albedo_allows(made: tuple[Scene, Atlas]) -> None:
    """max E <= max of what arrives unbounced / (1 - max albedo), as every row of links sums to at most one."""
    scene, atlas = made
    scene = replace(scene, materials=tuple(opaque(m) for m in scene.materials))
    _, result = bake(scene, atlas)
    assert_lawful(result)
    black = tuple(replace(m, albedo=(0.0, 0.0, 0.0)) for m in scene.materials)
    _, unbounced = bake(replace(scene, materials=black), atlas)
    albedo = min(max(max(m.albedo) for m in scene.materials), MOST_ALBEDO)
    # The solver ends at a residual of 1e-4; unbounced light has noise of its own, since other rays are aimed.
    assert result.maps.aim.max() <= unbounced.maps.aim.max() / (1 - albedo) * 1.2


@given(random_scenes(closed=True), st.sampled_from([1e-3, 7.0, 1e3]))
@FEW
def test_light_is_linear_in_all_that_shines(made: tuple[Scene, Atlas], factor: float) -> None:
    scene, atlas = made
    lights = tuple(replace(light, power=scaled(light.power, factor)) for light in scene.lights)
    looks = tuple(replace(m, emission=scaled(m.emission, factor)) for m in scene.materials)
    one, other = bake(scene, atlas)[1].maps, bake(replace(scene, lights=lights, materials=looks), atlas)[1].maps
    top = float(one.aim.max())
    np.testing.assert_allclose(other.aim, one.aim * np.float32(factor), rtol=5e-3, atol=1e-3 * factor * top)


@given(random_scenes(closed=True), st.integers(0, 2**16), st.sampled_from([0.0, 1e3]))
@FEW
def test_where_the_scene_stands_changes_no_mean(made: tuple[Scene, Atlas], seed: int, far: float) -> None:
    """A rigid motion of everything: the mean over all texels stays, but for noise."""
    scene, atlas = plain(made)
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    motion = matrix_of(turn * np.sign(np.linalg.det(turn)), (far, -far, far / 2))
    moved = replace(
        scene,
        instances=tuple(replace(i, matrix_world=motion @ i.matrix_world) for i in scene.instances),
        lights=tuple(replace(light, matrix_world=motion @ light.matrix_world) for light in scene.lights),
    )
    assert_same_mean(bake(scene, atlas, STEADY)[1], bake(moved, atlas, STEADY)[1])


@given(random_scenes(closed=True))
@FEW
def test_the_order_of_objects_changes_no_mean(made: tuple[Scene, Atlas]) -> None:
    scene, atlas = plain(made)
    turned = replace(scene, instances=scene.instances[::-1], lights=scene.lights[::-1])
    order = Atlas(atlas.resolution, atlas.page_count, atlas.front[::-1], atlas.back[::-1])
    assert_same_mean(bake(scene, atlas, STEADY)[1], bake(turned, order, STEADY)[1])


def opaque(material: Material) -> Material:
    return replace(material, opacity=1.0, specular=(0.0,) * 3, transmission=(0.0,) * 3)


def scaled(values: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    red, green, blue = (value * factor for value in values)
    return red, green, blue


def plain(made: tuple[Scene, Atlas]) -> tuple[Scene, Atlas]:
    """The scene without what makes a mean noisy: all absorbs half, a lamp hangs free in the room."""
    scene, atlas = made
    looks = tuple(replace(opaque(m), albedo=(0.5,) * 3, emission=(0.0,) * 3) for m in scene.materials)
    lamp = scenes.point_light((1.7, 1.7, 1.7), 100.0)
    return replace(scene, materials=looks, lights=(lamp,)), atlas


def assert_same_mean(a: FrameResult, b: FrameResult) -> None:
    assert_lawful(a)
    assert_lawful(b)
    np.testing.assert_allclose(a.maps.aim.mean(), b.maps.aim.mean(), rtol=0.05)
