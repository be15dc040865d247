# SPDX-License-Identifier: GPL-3.0-or-later
"""How far gathers by views are off: against links with many rays, given the same radiosity, so that nothing else is
compared; and by what simplified stand-ins of large meshes change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtgi_addon.backend.final_gather.gathers import stand_ins_of_meshes
from rtgi_addon.backend.final_gather.radiosity import sent_by_targets
from rtgi_addon.backend.final_gather.views.view_gather import ViewGather
from rtgi_addon.backend.gpu.context import Gpu
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.scene import Atlas, Float32, Instance, Int32, Mesh, Scene
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import BakeSettings, Gather, SampleCounts
from tests.backend.scenes import WHITE, grid_atlas, mesh_of_triangles, point_light, sphere, translation

from .errors import compare
from .gpu_parts import KINDS, link_rays, lit_by_lamps, make_gather, placed_scene, rms, trace_by, watch
from .gpu_results import Accuracy, StandIn, path_of
from .larsen_tables import gather_all
from .rooms import walls
from .table import LEAST_WHOLE, ROOT

#: Scenes of demo_blend/ and the side of their atlas, pixels; sizes of views.
SCENES = {"cornell": 128, "interior": 256}
SIZES = (16, 32, 64)
#: Rays of a texel of the reference, of which two seeds tell its noise.
REFERENCE, SEEDS = SampleCounts(2048, 2048), (11, 12)
#: Texels compared; of more than so many triangles software draws so few.
COMPARED, SOFTWARE_COMPARED, MANY_TRIANGLES = 1500, 500, 1000
#: Triangles allowed to stand-ins; 0: there are none. Views' pixels along a side; texels that see the dense object.
STAND_INS, STAND_IN_SIZE, STAND_IN_TEXELS = (0, BakeSettings().stand_in_triangles), 32, 48
#: That object, a ball: its rings, 100k triangles; radius and height of bumps, m; waves of bumps, rad/m.
RINGS, RADIUS, BUMP, WAVES = 160, 0.5, 0.015, 30.0


def accuracies(gpu: Gpu, workers: Workers, name: str) -> Iterator[Accuracy]:
    """Of a scene of demo_blend/ at some of its valid texels; only here is Blender needed."""
    from .prepare import prepare

    prepared = prepare(ROOT / "demo_blend" / f"{name}.blend", SCENES[name])
    placed = PlacedScene(prepared.scene, prepared.atlas, prepared.first, (), workers)
    sent = _baked(placed, prepared.atlas)
    stand_in = _stand_in(gpu, placed)
    count = placed.texels.count
    # Seen as a bake sees them: covered texels as what stands for them, black where nothing does.
    sent[:count] = np.where(stand_in[:, None] < 0, np.float32(0), sent[np.maximum(stand_in, 0)])
    few = gpu.info.software and placed.geometry.triangle_count > MANY_TRIANGLES
    valid = np.flatnonzero(stand_in == np.arange(count))
    chosen = np.sort(np.random.default_rng(7).permutation(valid)[: SOFTWARE_COMPARED if few else COMPARED])
    truth, noise = reference(placed, sent, chosen.astype(np.int32))
    whole = placed.texels.coverage[chosen] >= LEAST_WHOLE
    for kind in KINDS:
        if kind is Gather.RAYS:
            if not gpu.info.computes:
                return
            trace_by(placed, gpu)
        for size in SIZES:
            gather = make_gather(gpu, placed, kind, size, memory=0)  # drawn for the product, chosen texels alone
            gather.renew(chosen.astype(np.int32))
            values = gather.irradiance().only(chosen).irradiance(sent)
            errors, of_whole = compare(values, truth, noise), compare(values[whole], truth[whole], noise[whole])
            yield Accuracy(name, kind, path_of(kind), size, errors, of_whole)
            gather.release()


def _baked(placed: PlacedScene, atlas: Atlas) -> Float32:
    """(m, 3) W/m² that all targets send in a bake: radiosity with all its bounces."""
    settings = BakeSettings(gather=Gather.LINKS, denoise=False, estimate=False, seams=False)
    with Session(placed.scene, atlas, settings, placed.state) as session:
        aim, t = session.advance(placed.state).maps.aim, session.texels
    return sent_by_targets(aim[t.page, t.row, t.col], placed.albedo, placed.emitted)


def _stand_in(gpu: Gpu, placed: PlacedScene) -> Int32:
    """(n,) the texel that each is seen as, by the gather's own probes; -1: none."""
    gather = make_gather(gpu, placed, Gather.PLANE, SIZES[0], memory=0)
    gather.renew(np.arange(gather.count, dtype=np.int32))
    known = gather.irradiance().stand_in
    gather.release()
    return known


def reference(placed: PlacedScene, sent: Float32, texels: Int32) -> tuple[Float32, Float32]:
    """((k, 3), (k, 3)) W/m² at ``texels`` (k,) by links, the mean of two seeds, and its standard error."""
    tracers = [link_rays(placed, sent, REFERENCE, seed=seed) for seed in SEEDS]
    one, other = (gather_all(tracer, texels, sent, REFERENCE.total, placed.workers) for tracer in tracers)
    return (one + other) / 2, np.abs(one - other) / 2


def stand_in_errors(gpu: Gpu, workers: Workers) -> Iterator[StandIn]:
    """Hemicubes from the walls of a room with a bumpy ball, whose texels see it as it is or as its stand-in."""
    scene, atlas = ball_room()
    placed = placed_scene(scene, atlas, workers)
    sent, ball = lit_by_lamps(placed), len(scene.instances) - 1
    on_walls = np.flatnonzero(placed.texels.instance != ball)
    texels = np.sort(np.random.default_rng(3).permutation(on_walls)[:STAND_IN_TEXELS]).astype(np.int32)
    truth, noise = reference(placed, sent, texels)
    plain = None
    for most in STAND_INS:
        coarse = stand_ins_of_meshes(placed, most)
        gather = make_gather(gpu, placed, Gather.HEMICUBE, STAND_IN_SIZE, coarse=coarse)
        seconds = _drawn_in_thirds(gather, texels, on_walls)
        values = gather.irradiance().irradiance(sent)[texels]
        plain = values if plain is None else plain
        small = coarse.get(scene.instances[ball].mesh)
        yield StandIn(
            len(small.source) if small else scene.meshes[scene.instances[ball].mesh].triangle_count,
            1e6 * seconds, (small.deviation_rms, small.deviation_max) if small else (0.0, 0.0),
            compare(values, truth, noise), rms(values, plain),
        )  # fmt: skip
        gather.release()


def _drawn_in_thirds(gather: ViewGather, texels: Int32, others: NDArray[np.int64]) -> float:
    """Seconds a view, median; a few ``others`` are drawn before and not counted."""
    drawing = watch(gather)
    gather.renew(np.setdiff1d(others, texels)[:4].astype(np.int32))
    each = []
    for part in np.array_split(texels, 3):
        before = drawing.seconds
        gather.renew(part)
        each.append((drawing.seconds - before) / len(part))
    return float(np.median(each))


def ball_room() -> tuple[Scene, Atlas]:
    """A closed room of 2 m with a bumpy ball of 100k triangles, lit from one side."""
    sides = walls("room", (-1, -1, 0), (1, 1, 2))
    meshes = (*sides, _bumpy_ball())
    matrices = [np.eye(4)] * len(sides) + [translation(0, 0, 0.9)]
    instances = tuple(Instance(m.name, i, matrices[i]) for i, m in enumerate(meshes))
    materials = (WHITE, replace(WHITE, name="left"), replace(WHITE, name="right"))
    scene = Scene(meshes, instances, materials, (point_light((0.7, -0.7, 1.7), 60.0),))
    return scene, grid_atlas(scene, [(20, 20)] * len(sides) + [(40, 20)])


def _bumpy_ball() -> Mesh:
    smooth = sphere("ball", RADIUS, rings=RINGS, inward=False)
    corners = smooth.vertices.astype(np.float64).reshape(-1, 3, 3)
    bumps = np.sin(WAVES * corners).prod(axis=-1, keepdims=True)
    return mesh_of_triangles("ball", corners * (1 + BUMP / RADIUS * bumps), smooth.corner_uv, smooth.island_of_triangle)
