# SPDX-License-Identifier: GPL-3.0-or-later
"""Light-map layouts of real meshes: inside the square, apart, unfolded, repeatable; and the layer they are kept in."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import bmesh
import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scipy.spatial import cKDTree

from rtgi_addon.source import Layout, SourceMesh
from rtgi_addon.unwrap import UV_LAYER, flat_triangles, layer_fault, loop_uv, unwrap, write_uv_layer

Builder = Callable[[], bpy.types.Mesh]


def source_of(mesh: bpy.types.Mesh, rtgi_uv: np.ndarray | None = None) -> SourceMesh:
    """The arrays of a mesh, read the plain way."""
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    vertices = np.zeros(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", vertices)
    fields = {}
    for name, width in (("vertices", 3), ("loops", 3), ("polygon_index", 1)):
        fields[name] = np.zeros(width * count, np.int32)
        mesh.loop_triangles.foreach_get(name, fields[name])
    return SourceMesh(
        name=mesh.name,
        vertices=vertices.reshape(-1, 3),
        triangles=fields["vertices"].reshape(-1, 3),
        corner_normals=np.zeros((count, 3, 3), np.float32),
        loop_of_corner=fields["loops"].reshape(-1, 3),
        polygon_of_triangle=fields["polygon_index"],
        material_of_triangle=np.zeros(count, np.int32),
        rtgi_uv=rtgi_uv,
    )


def from_bmesh(make: Callable[[bmesh.types.BMesh], object]) -> bpy.types.Mesh:
    work = bmesh.new()
    make(work)
    mesh = bpy.data.meshes.new("mesh")
    work.to_mesh(mesh)
    work.free()
    return mesh


def plane() -> bpy.types.Mesh:
    return from_bmesh(lambda b: bmesh.ops.create_grid(b, x_segments=1, y_segments=1, size=2))


def cube() -> bpy.types.Mesh:
    return from_bmesh(lambda b: bmesh.ops.create_cube(b, size=2))


def monkey() -> bpy.types.Mesh:
    return from_bmesh(bmesh.ops.create_monkey)


def fine_monkey() -> bpy.types.Mesh:
    def make(b: bmesh.types.BMesh) -> None:
        bmesh.ops.create_monkey(b)
        bmesh.ops.subdivide_edges(b, edges=b.edges, cuts=1, use_grid_fill=True, smooth=1.0)

    return from_bmesh(make)


def sphere() -> bpy.types.Mesh:
    return from_bmesh(lambda b: bmesh.ops.create_uvsphere(b, u_segments=32, v_segments=16, radius=1))


def round_sphere() -> bpy.types.Mesh:
    return from_bmesh(lambda b: bmesh.ops.create_icosphere(b, subdivisions=5, radius=1))


def bumpy_floor() -> bpy.types.Mesh:
    def make(b: bmesh.types.BMesh) -> None:
        bmesh.ops.create_grid(b, x_segments=80, y_segments=80, size=1)
        for vertex in b.verts:
            vertex.co.z = 0.15 * np.sin(9 * vertex.co.x) * np.cos(7 * vertex.co.y)

    return from_bmesh(make)


def chair() -> bpy.types.Mesh:
    def make(b: bmesh.types.BMesh) -> None:
        legs = [((x, y, 0.225), (0.04, 0.04, 0.45)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
        for place, size in (*legs, ((0, 0, 0.47), (0.45, 0.45, 0.04)), ((0, 0.2, 0.75), (0.45, 0.03, 0.5))):
            bmesh.ops.create_cube(b, size=1, matrix=Matrix.Translation(place) @ Matrix.Diagonal((*size, 1)))

    return from_bmesh(make)


def text() -> bpy.types.Mesh:
    curve = bpy.data.curves.new("text", "FONT")
    curve.body, curve.extrude, curve.bevel_depth = "Light", 0.1, 0.01
    target = bpy.data.objects.new("text", curve)
    bpy.context.scene.collection.objects.link(target)
    return bpy.data.meshes.new_from_object(target.evaluated_get(bpy.context.evaluated_depsgraph_get()))


def torus() -> bpy.types.Mesh:
    bpy.ops.mesh.primitive_torus_add(major_segments=48, minor_segments=24)
    return bpy.context.object.data


def spiral() -> bpy.types.Mesh:
    """A ramp that winds twice about its axis: seen from above it covers itself."""

    def make(b: bmesh.types.BMesh) -> None:
        angles = np.linspace(0, 4 * np.pi, 161)
        rows = [[b.verts.new((r * np.cos(a), r * np.sin(a), 0.05 * a)) for r in (1, 1.5, 2)] for a in angles]
        for low, high in zip(rows[:-1], rows[1:], strict=True):
            for k in range(2):
                b.faces.new((low[k], low[k + 1], high[k + 1], high[k]))

    return from_bmesh(make)


MESHES = [plane, cube, chair, bumpy_floor, sphere, round_sphere, monkey, fine_monkey, text, torus, spiral]


def test_points(uv: np.ndarray, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` points of a (t, 3, 2) layout evenly by UV area, and the triangle of each."""
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = np.abs(d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0])
    triangle = rng.choice(len(uv), count, p=area / area.sum())
    a, b = rng.random((2, count, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    return uv[triangle, 0] + a * d1[triangle] + b * d2[triangle], triangle


test_points.__test__ = False


def covering(uv: np.ndarray, points: np.ndarray, tolerance: float) -> np.ndarray:
    """(n,) how many triangles hold each point by more than ``tolerance``; brute force, in chunks of points."""
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    det = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    uv, det = np.where((det < 0)[:, None, None], uv[:, ::-1], uv), np.abs(det)
    counts = np.zeros(len(points), int)
    for chunk in np.array_split(np.arange(len(points)), max(1, len(points) * len(uv) // 4_000_000)):
        inside = np.broadcast_to((det > 0)[None], (len(chunk), len(uv))).copy()
        for k in range(3):
            a, edge = uv[:, k], uv[:, (k + 1) % 3] - uv[:, k]
            length = np.maximum(np.hypot(edge[:, 0], edge[:, 1]), 1e-30)
            to = points[chunk][:, None] - a[None]
            inside &= edge[:, 0] * to[..., 1] - edge[:, 1] * to[..., 0] > tolerance * length
        counts[chunk] = inside.sum(axis=1)
    return counts


def metres_per_uv(source: SourceMesh, layout: Layout) -> np.ndarray:
    """(t,) sqrt of the ratio of the areas of each triangle, in the layout's own size; 1 is its mean density."""
    corners, uv = source.vertices[source.triangles].astype(float), layout.corner_uv.astype(float) * layout.size
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return np.sqrt(area / np.maximum(np.abs(d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]), 1e-300))


def surface_area(source: SourceMesh) -> float:
    corners = source.vertices[source.triangles].astype(float)
    return (
        float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()) / 2
    )


@pytest.mark.parametrize("build", MESHES)
@pytest.mark.parametrize("time_limit", [0.0, 0.3])
def test_layout_laws(build: Builder, time_limit: float) -> None:
    """In [0, 1], no point covered twice, islands apart by the margin, densities near one another, few islands."""
    source = source_of(build())
    density = 256 / surface_area(source) ** 0.5
    layout, warnings = unwrap(source, 2.0, density, time_limit)
    assert warnings == []
    uv = layout.corner_uv.astype(float)
    assert layout.corner_uv.dtype == np.float32 and uv.shape == (len(source.triangles), 3, 2)
    assert uv.min() == 0 and uv.max() == 1 and np.isfinite(uv).all()

    pixels = uv * layout.size * density
    rng = np.random.default_rng(0)
    points, _ = test_points(pixels, rng, 3000)
    assert covering(pixels, points, 0.01).max() == 1

    samples, triangle = test_points(pixels, rng, 20_000)
    island = layout.island_of_triangle[triangle]
    assert np.array_equal(np.unique(layout.island_of_triangle), np.arange(layout.island_of_triangle.max() + 1))
    near = cKDTree(samples).query_pairs(1.9, output_type="ndarray")
    assert (island[near[:, 0]] == island[near[:, 1]]).all()

    ratio = metres_per_uv(source, layout)
    assert 0.4 < np.quantile(ratio, 0.02) and np.quantile(ratio, 0.98) < 2.6


def test_plane_fills_its_rectangle() -> None:
    mesh = plane()
    mesh.transform(Matrix.Rotation(0.7, 4, (1, 2, 3)) @ Matrix.Diagonal((3, 1, 1, 1)))
    layout, _ = unwrap(source_of(mesh))
    assert sorted(map(tuple, np.unique(layout.corner_uv.reshape(-1, 2).round(5), axis=0).tolist())) == [
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
    ]
    assert sorted(layout.size) == pytest.approx([4, 12], rel=1e-5)
    assert layout.island_of_triangle.tolist() == [0, 0]


def test_cube_becomes_six_squares() -> None:
    layout, _ = unwrap(source_of(cube()), texels_per_metre=64)
    assert np.array_equal(np.bincount(layout.island_of_triangle), [2] * 6)
    for island in range(6):
        corners = layout.corner_uv[layout.island_of_triangle == island].reshape(-1, 2) * layout.size
        assert np.ptp(corners, axis=0) == pytest.approx([2, 2], rel=0.02)


def test_height_field_is_one_island_and_sphere_a_few() -> None:
    assert unwrap(source_of(bumpy_floor()))[0].island_of_triangle.max() == 0
    for build in (sphere, round_sphere):
        assert unwrap(source_of(build()))[0].island_of_triangle.max() < 8


def test_margin_holds_at_few_texels() -> None:
    """A chair of some 20 texels across: its 36 islands still lie two texels apart."""
    source = source_of(chair())
    density = 24 / surface_area(source) ** 0.5
    layout, _ = unwrap(source, 2.0, density)
    pixels = layout.corner_uv.astype(float) * layout.size * density
    low = np.stack([pixels[layout.island_of_triangle == i].min(axis=(0, 1)) for i in range(36)])
    high = np.stack([pixels[layout.island_of_triangle == i].max(axis=(0, 1)) for i in range(36)])
    gap = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=-1)
    assert gap[~np.eye(36, dtype=bool)].min() > 1.8


@pytest.mark.parametrize("build", [cube, monkey, fine_monkey, text])
def test_same_mesh_same_layout(build: Builder) -> None:
    source = source_of(build())
    first, second = unwrap(source)[0], unwrap(source)[0]
    assert np.array_equal(first.corner_uv, second.corner_uv) and first.size == second.size
    assert np.array_equal(first.island_of_triangle, second.island_of_triangle)


CHILD = """
import hashlib, os, sys
import bpy
import numpy as np
from rtgi_addon.source import SourceMesh
from rtgi_addon.unwrap import unwrap
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
arrays = dict(np.load(sys.argv[1]))
mesh = SourceMesh(name="m", rtgi_uv=None, **arrays)
digest = hashlib.sha256()
for time_limit in (0.0, 0.3):
    digest.update(unwrap(mesh, time_limit=time_limit)[0].corner_uv.tobytes())
sys.stderr.write(digest.hexdigest())
sys.stderr.flush()
os._exit(0)
"""


def test_same_layout_in_another_process_on_one_core(tmp_path: Path) -> None:
    source = source_of(monkey())
    names = ("vertices", "triangles", "corner_normals", "loop_of_corner", "polygon_of_triangle", "material_of_triangle")
    np.savez(tmp_path / "mesh.npz", **{name: getattr(source, name) for name in names})
    digest = hashlib.sha256()
    for time_limit in (0.0, 0.3):
        digest.update(unwrap(source, time_limit=time_limit)[0].corner_uv.tobytes())
    command = [sys.executable, "-c", CHILD, str(tmp_path / "mesh.npz")]
    root = Path(__file__).parents[2]
    child = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120, check=True)
    assert child.stderr.endswith(digest.hexdigest())


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_any_scale_of_the_mesh(scale: float) -> None:
    mesh = monkey()
    plain = unwrap(source_of(mesh), texels_per_metre=100)[0]
    mesh.transform(Matrix.Diagonal((scale, scale, scale, 1)))
    scaled = unwrap(source_of(mesh), texels_per_metre=100 / scale)[0]
    assert scaled.size[0] * scaled.size[1] == pytest.approx(plain.size[0] * plain.size[1] * scale**2, rel=0.15)


def test_broken_triangles_get_a_place() -> None:
    """Collapsed, sliver, duplicate and NaN triangles: finite UVs within the square, the good ones as ever."""
    source = source_of(cube())
    vertices = np.concatenate([source.vertices, [[np.nan] * 3, [9, 9, 9], [9, 9, 10]]]).astype(np.float32)
    extra = [[0, 0, 1], [0, 1, 8], [9, 10, 9], *source.triangles[:2].tolist()]
    triangles = np.concatenate([source.triangles, extra]).astype(np.int32)
    count = len(triangles)
    broken = SourceMesh(
        name="broken",
        vertices=vertices,
        triangles=triangles,
        corner_normals=np.zeros((count, 3, 3), np.float32),
        loop_of_corner=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        polygon_of_triangle=np.arange(count, dtype=np.int32),
        material_of_triangle=np.zeros(count, np.int32),
        rtgi_uv=None,
    )
    for time_limit in (0.0, 0.3):
        layout, warnings = unwrap(broken, time_limit=time_limit)
        assert warnings == []
        assert np.isfinite(layout.corner_uv).all() and np.isfinite(layout.size).all()
        assert layout.corner_uv.min() == 0 and layout.corner_uv.max() == 1
        points, _ = test_points(layout.corner_uv.astype(float), np.random.default_rng(0), 2000)
        assert covering(layout.corner_uv.astype(float), points, 1e-4).max() == 1
        assert layout.size[0] * layout.size[1] > 32  # eight faces of 4 m²: the doubled triangles have their own place


@pytest.mark.parametrize("triangles", [[], [[0, 0, 0]]])
def test_nothing_with_an_area(triangles: list) -> None:
    triangles = np.array(triangles, np.int32).reshape(-1, 3)
    count = len(triangles)
    source = SourceMesh(
        "empty",
        np.zeros((1, 3), np.float32),
        triangles,
        np.zeros((count, 3, 3), np.float32),
        np.zeros((count, 3), np.int32),
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
        None,
    )
    layout, warnings = unwrap(source)
    assert warnings == [] and layout.size == (0.0, 0.0) and len(layout.corner_uv) == count
    assert np.isfinite(layout.corner_uv).all()


def test_triangle_soup_never_overlaps() -> None:
    """Triangles thrown about at random, sharing vertices: the worst there is for every unwrapper."""
    rng = np.random.default_rng(2)
    vertices = rng.random((200, 3)).astype(np.float32)
    triangles = np.stack([rng.choice(200, 3, replace=False) for _ in range(400)]).astype(np.int32)
    own = np.arange(1200, dtype=np.int32).reshape(-1, 3)
    source = SourceMesh("soup", vertices, triangles, vertices[triangles], own, own[:, 0], own[:, 0] * 0, None)
    for time_limit in (0.0, 0.3):
        layout, warnings = unwrap(source, time_limit=time_limit)
        assert warnings == []
        uv = layout.corner_uv.astype(float)
        assert covering(uv, test_points(uv, np.random.default_rng(0), 3000)[0], 1e-4).max() == 1


def test_half_a_million_triangles_in_time() -> None:
    """A sphere with a wavy surface, 250 x 1000 quads."""
    rows, columns = 251, 1000
    turns = np.arange(columns) * (2 * np.pi / columns)
    height, turn = np.meshgrid(np.linspace(0.05, np.pi - 0.05, rows), turns, indexing="ij")
    radius = 1 + 0.02 * np.sin(20 * turn) * np.sin(height)
    directions = [np.sin(height) * np.cos(turn), np.sin(height) * np.sin(turn), np.cos(height)]
    vertices = (radius[..., None] * np.stack(directions, axis=-1)).reshape(-1, 3).astype(np.float32)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    low, high, following = i * columns, (i + 1) * columns, (j + 1) % columns
    quads = np.stack([low + j, high + j, high + following, low + following], axis=-1).reshape(-1, 4)
    corner = np.array([[0, 1, 2], [0, 2, 3]])
    triangles = quads[:, corner].reshape(-1, 3).astype(np.int32)
    loops = (4 * np.arange(len(quads))[:, None, None] + corner).reshape(-1, 3).astype(np.int32)
    count = len(triangles)
    source = SourceMesh(
        name="wavy",
        vertices=vertices,
        triangles=triangles,
        corner_normals=np.zeros((count, 3, 3), np.float32),
        loop_of_corner=loops,
        polygon_of_triangle=np.repeat(np.arange(len(quads), dtype=np.int32), 2),
        material_of_triangle=np.zeros(count, np.int32),
        rtgi_uv=None,
    )
    start = time.process_time()
    layout, warnings = unwrap(source)
    assert time.process_time() - start < 25  # 5 s on a quiet core
    assert warnings == [] and layout.island_of_triangle.max() < 50


def test_users_scene_is_left_alone() -> None:
    """Nothing is added, selected, activated or switched by unwrapping with Blender's operator."""
    bpy.ops.mesh.primitive_cube_add()
    kept = bpy.context.object
    names = ("objects", "meshes", "scenes", "collections")

    def state() -> tuple:
        counts = tuple(sorted(i.name for i in getattr(bpy.data, name)) for name in names)
        return counts, bpy.context.scene.name, bpy.context.object, bpy.context.mode, kept.select_get()

    source = source_of(kept.data)
    before = state()
    unwrap(source, time_limit=0.0)
    assert state() == before


def test_valid_own_layer_is_kept_and_a_broken_one_is_not() -> None:
    mesh = chair()
    source = source_of(mesh)
    made, _ = unwrap(source)
    mirrored = made.corner_uv * np.float32(0.5) + np.float32(0.25)
    kept, warnings = unwrap(source_of(mesh, mirrored))
    assert warnings == [] and np.array_equal(kept.corner_uv, mirrored)
    assert kept.size == pytest.approx(tuple(2 * np.array(made.size)), rel=1e-4)
    assert np.array_equal(kept.island_of_triangle, made.island_of_triangle)

    stacked = made.corner_uv.copy()
    stacked[2:4] = stacked[0:2]
    outside = made.corner_uv + np.float32(0.1)
    flat = made.corner_uv.copy()
    flat[3] = 0.5
    lost = made.corner_uv.copy()
    lost[0, 0, 0] = np.nan
    for layer, word in ((stacked, "overlapping"), (outside, "square"), (flat, "area"), (lost, "finite")):
        layout, warnings = unwrap(source_of(mesh, layer))
        assert len(warnings) == 1 and mesh.name in warnings[0] and word in warnings[0]
        assert np.array_equal(layout.corner_uv, made.corner_uv)
    assert layer_fault(source, made.corner_uv) is None


def test_layer_is_written_beside_the_users() -> None:
    mesh = chair()
    for name, value in (("Paint", 0.25), ("Detail", 0.75)):
        layer = mesh.uv_layers.new(name=name)
        layer.uv.foreach_set("vector", np.full(2 * len(mesh.loops), value, np.float32))
    mesh.uv_layers["Detail"].active_render = True
    mesh.uv_layers.active_index = 0
    source = source_of(mesh)
    layout, _ = unwrap(source)
    for _ in range(2):  # the second time it is there already
        write_uv_layer(mesh, loop_uv(source, layout.corner_uv, len(mesh.loops)))
        assert [layer.name for layer in mesh.uv_layers] == ["Paint", "Detail", UV_LAYER]
        assert mesh.uv_layers.active.name == "Paint"
        assert [layer.name for layer in mesh.uv_layers if layer.active_render] == ["Detail"]
        for name, value in (("Paint", 0.25), ("Detail", 0.75)):
            values = np.zeros(2 * len(mesh.loops), np.float32)
            mesh.uv_layers[name].uv.foreach_get("vector", values)
            assert (values == value).all()
        read = np.zeros(2 * len(mesh.loops), np.float32)
        mesh.uv_layers[UV_LAYER].uv.foreach_get("vector", read)
        assert np.array_equal(read.reshape(-1, 2)[source.loop_of_corner], layout.corner_uv)


def test_ninth_layer_is_refused_and_users_layers_stay() -> None:
    mesh = plane()
    while mesh.uv_layers.new(name="more", do_init=False) is not None and len(mesh.uv_layers) < 8:
        pass
    names = [layer.name for layer in mesh.uv_layers]
    with pytest.raises(ValueError, match=UV_LAYER):
        write_uv_layer(mesh, np.zeros((len(mesh.loops), 2), np.float32))
    assert [layer.name for layer in mesh.uv_layers] == names


def test_flat_triangles_keep_their_shape() -> None:
    corners = np.random.default_rng(4).normal(size=(100, 3, 3)).astype(np.float32)
    uv = flat_triangles(corners).astype(float)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        want = np.linalg.norm((corners[:, a] - corners[:, b]).astype(float), axis=1)
        assert np.linalg.norm(uv[:, a] - uv[:, b], axis=1) == pytest.approx(want, rel=1e-4)
