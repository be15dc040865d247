# SPDX-License-Identifier: GPL-3.0-or-later
"""Packing: rectangles keep apart, stay on the page, sit on whole pixels, and are as large as they can be."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgi_addon.backend.layout.packing import Packing, instance_sizes, pack
from rtgi_addon.backend.scene import Instance, Mesh, Scene
from tests.backend.scenes import WHITE, box, cornell, quad, translation

PADDING = 2


def rectangles(packing: Packing) -> np.ndarray:
    """(r, 5) page, x, y, width, height in pixels; checks that they are whole."""
    atlas = packing.atlas
    rows = []
    for placement in (*atlas.front, *atlas.back):
        if placement is not None:
            rows.append((placement.page, *np.multiply((*placement.offset, *placement.scale), atlas.resolution)))
    array = np.array(rows, float).reshape(-1, 5)
    assert np.abs(array - np.rint(array)).max(initial=0) < 1e-6, "rectangles must lie on whole pixels"
    return np.rint(array).astype(int)


def check_apart(packing: Packing) -> np.ndarray:
    """Every two rectangles of a page are PADDING pixels apart, and all lie on their pages. The rectangles."""
    array = rectangles(packing)
    page, low, size = array[:, 0], array[:, 1:3], array[:, 3:5]
    assert (size >= 1).all()
    assert (low >= 0).all() and (low + size <= packing.atlas.resolution).all()
    assert ((page >= 0) & (page < packing.atlas.page_count)).all()
    assert len(np.unique(page)) == packing.atlas.page_count or len(array) == 0
    gap = np.maximum(low[:, None] - (low + size)[None], low[None] - (low + size)[:, None]).max(axis=-1)
    together = (page[:, None] == page[None]) & ~np.eye(len(array), dtype=bool)
    assert gap[together].min(initial=PADDING) >= PADDING
    return array


def planes(sizes: np.ndarray, **options: object) -> Scene:
    """One unit square mesh, an instance of each of ``sizes`` (r, 2) metres."""
    mesh = quad("plane", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    instances = [
        Instance(f"p{i}", 0, np.diag([w, h, 1.0, 1.0]), **options) for i, (w, h) in enumerate(np.asarray(sizes, float))
    ]
    return Scene((mesh,), tuple(instances), (WHITE,))


def pack_all(scene: Scene, *, back: bool = False, resolution: int = 256, density: float | None = None) -> Packing:
    count = len(scene.instances)
    return pack(
        scene,
        resolution=resolution,
        density=density,
        front=np.ones(count, bool),
        back=np.full(count, back),
        padding_px=PADDING,
    )


SIZES = st.lists(st.tuples(st.floats(0, 50), st.floats(0, 50)), min_size=0, max_size=40)


@settings(max_examples=60, deadline=None)
@given(SIZES, st.sampled_from([16, 61, 256]), st.booleans())
def test_one_page_holds_everything_apart(sizes: list, resolution: int, back: bool) -> None:
    packing = pack_all(planes(np.array(sizes).reshape(-1, 2)), back=back, resolution=resolution)
    array = check_apart(packing)
    assert len(array) == len(sizes) * (1 + back)
    minimal = len(array) * (1 + PADDING) ** 2
    if minimal <= 0.5 * resolution**2:
        assert packing.atlas.page_count == 1
        assert not packing.warnings


@settings(max_examples=60, deadline=None)
@given(SIZES, st.floats(0.01, 40), st.sampled_from([32, 128]))
def test_density_gives_pages_and_true_sizes(sizes: list, density: float, resolution: int) -> None:
    packing = pack_all(planes(np.array(sizes).reshape(-1, 2)), resolution=resolution, density=density)
    array = check_apart(packing)
    assert packing.texels_per_metre == pytest.approx(density)
    wanted = np.array(sizes).reshape(-1, 2) * density
    fits = wanted.max(axis=1, initial=0) <= resolution
    # The transform is exact, the layout float32: a size of half a pixel may round either way.
    assert (np.abs(array[fits, 3:5] - np.maximum(wanted[fits], 1)) <= 0.5 + 1e-3).all()
    # One line for each rectangle that a page cannot hold.
    assert len(packing.warnings) == int((wanted.max(axis=1, initial=0) >= resolution + 0.5).sum())


def test_one_page_is_as_dense_as_it_can_be() -> None:
    """Four equal squares: two and two with the padding between them, exactly."""
    packing = pack_all(planes(np.ones((4, 2))), resolution=128)
    assert np.array_equal(np.unique(check_apart(packing)[:, 3:]), [63])
    assert packing.texels_per_metre == pytest.approx(63, rel=0.01)


def test_single_plane_fills_the_page() -> None:
    packing = pack_all(planes(np.array([[3.0, 3.0]])), resolution=100)
    assert rectangles(packing).tolist() == [[0, 0, 0, 100, 100]]


def test_random_rectangles_fill_a_page() -> None:
    rng = np.random.default_rng(3)
    for count, least in ((30, 0.78), (300, 0.80), (2000, 0.78)):
        array = check_apart(pack_all(planes(rng.lognormal(0, 0.6, (count, 2))), resolution=1024))
        assert array[:, 3:].prod(axis=1).sum() / 1024**2 > least


def test_cornell_box_fills_three_quarters_of_its_page() -> None:
    scene, _ = cornell()
    array = check_apart(pack_all(scene, resolution=128))
    assert array[:, 3:].prod(axis=1).sum() / 128**2 >= 0.75


def test_ten_thousand_rectangles_end() -> None:
    scene = planes(np.random.default_rng(0).lognormal(0, 0.7, (10_000, 2)))
    start = time.process_time()
    packing = pack_all(scene, resolution=2048)
    assert time.process_time() - start < 30  # a hang, not a slow machine: 0.8 s on a quiet core
    assert packing.atlas.page_count == 1


def test_more_surfaces_than_texels_get_more_pages_and_a_warning() -> None:
    packing = pack_all(planes(np.ones((500, 2))), resolution=32)
    array = check_apart(packing)
    assert (array[:, 3:] == 1).all()
    assert packing.atlas.page_count == int(np.ceil(500 / 11**2))
    assert "500 surfaces" in packing.warnings[0]


def test_same_scene_same_atlas() -> None:
    scene = planes(np.random.default_rng(1).lognormal(0, 1, (200, 2)))
    assert pack_all(scene) == pack_all(scene)


def test_instances_of_one_size_share_one_texel_grid() -> None:
    """Rigid transforms of one mesh: same size in pixels, so texels at the same places of the mesh."""
    rng = np.random.default_rng(5)
    turned = []
    for i in range(12):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix = translation(*rng.normal(size=3) * 100)
        matrix[:3, :3] = q  # half of them mirror
        turned.append(Instance(f"b{i}", 0, matrix))
    array = check_apart(pack_all(Scene((box("b", (1, 2, 3), texels=8),), tuple(turned), (WHITE,)), resolution=512))
    assert len(np.unique(array[:, 3:], axis=0)) == 1


def random_mesh(rng: np.random.Generator) -> Mesh:
    """A box without its margins, so that areas in UV and space have one ratio."""
    return quad("q", np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(1e-4, 1e4), st.floats(1e-4, 1e4))
def test_size_follows_any_transform(seed: int, sx: float, sy: float) -> None:
    """The sides of the square's image, under scale, shear, mirror and rotation."""
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng)
    linear = rng.normal(size=(3, 3)) @ np.diag([sx, sy, 1.0]) @ rng.normal(size=(3, 3))
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    sizes = instance_sizes(Scene((mesh,), (Instance("i", 0, matrix),), (WHITE,)))
    corner = mesh.vertices.reshape(2, 3, 3)[0].astype(float) @ linear.T
    expected = [np.linalg.norm(corner[1] - corner[0]), np.linalg.norm(corner[2] - corner[1])]
    assert sizes[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("broken", [np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([np.inf, 1, 1])])
def test_flat_or_broken_transforms_get_a_texel(broken: np.ndarray) -> None:
    scene = planes(np.ones((2, 2)))
    matrix = np.eye(4)
    matrix[:3, :3] = broken
    instances = (scene.instances[0], Instance("flat", 0, matrix))
    array = check_apart(pack_all(Scene(scene.meshes, instances, (WHITE,)), resolution=64))
    assert array[1, 3:].tolist() == [1, 1]
    assert array[0, 3:].min() > 50


def test_only_wanted_sides_get_rectangles() -> None:
    mesh = quad("plane", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    empty = Mesh(
        name="empty",
        vertices=np.zeros((0, 3), np.float32),
        triangles=np.zeros((0, 3), np.int32),
        corner_normals=np.zeros((0, 3, 3), np.float32),
        corner_uv=np.zeros((0, 3, 2), np.float32),
        island_of_triangle=np.zeros(0, np.int32),
        material_of_triangle=np.zeros(0, np.int32),
    )
    instances = (
        Instance("front", 0, np.eye(4)),
        Instance("back", 0, np.eye(4)),
        Instance("holdout", 0, np.eye(4), receives_light=False),
        Instance("empty", 1, np.eye(4)),
    )
    packing = pack(
        Scene((mesh, empty), instances, (WHITE,)),
        resolution=64,
        density=None,
        front=np.array([True, False, True, True]),
        back=np.array([False, True, True, True]),
    )
    assert [p is not None for p in packing.atlas.front] == [True, False, False, False]
    assert [p is not None for p in packing.atlas.back] == [False, True, False, False]


def test_nothing_to_pack() -> None:
    packing = pack_all(Scene((), (), ()), resolution=64)
    assert packing.atlas.page_count == 1 and packing.atlas.front == ()
