# SPDX-License-Identifier: GPL-3.0-or-later
"""Which sides of which instances light can reach; only these get a map.

Before the atlas is packed. From points all over both sides of each instance rays go out. Sides that see one another
belong together; a group with no light at all is dark. In the others light must be found for each side: at its own
points, or at the end of a path from them (light travels both ways alike). No density, so no noise: one find is enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..lamps.emission import make_bounds
from ..lamps.lamp_view import may_see, view_lamp
from ..lamps.lights import emit_lamp, is_dark
from ..lamps.sky import make_sky
from ..parallel import Workers
from ..sampling import (
    UInt32,
    dot,
    hash_keys,
    photon_numbers,
    sample_cosine_about,
    stratified_pair,
    unit_float32,
    unit_float64,
)
from ..scene import Bool, Float32, Float64, FrameState, Int32, Light, Scene
from ..surface.geometry import Geometry
from ..surface.tracing import EmbreeTracer, Hits, Tracer

#: Rays of all sides together, and of one side at least and at most (powers of two).
TOTAL_RAYS = 1 << 18
RAYS_OF_SIDE = (128, 1024)
#: Rays over all states together, about, and the states that are looked at whatever it costs.
MOST_RAYS = 1 << 22
LEAST_STATES = 16
#: Segments of a path that looks for light. Each loses about the albedo, so light found later would hardly show.
PATH_SEGMENTS = 8
#: Lamps tested at one point; neighbouring points test the next ones.
LAMPS_OF_POINT = 4
#: Panes that a ray towards a lamp passes.
PANES = 4
#: Photons of all lamps together and of one at least.
PHOTONS, LEAST_PHOTONS = 1 << 14, 1 << 10
#: Times that paths are sent from a side about which there is doubt, if TOTAL_RAYS allows, and of its points the share
#: (one in so many) that send them: a find ends the search, so small steps are quicker.
SEARCHES = 16
SEARCH_STRIDE = 4
#: Points keep this share of their triangle's corners away from its edges, out of cracks between triangles.
INSET = 0.02

FRONT, BACK = 0, 1


def lit_sides(scene: Scene, states: Sequence[FrameState], *, workers: Workers | None = None) -> tuple[Bool, Bool]:
    """(n,), (n,) for each instance: can light reach its front, its back, in any of ``states``?

    An emissive surface counts as lit on both sides: it must be in the maps to send its light. Of very many states in
    large scenes some are left out, evenly; states that differ in nothing that matters are looked at once.
    """
    own_workers = Workers() if workers is None else workers
    lit = np.zeros(2 * len(scene.instances), np.bool_)
    try:
        first = last = states[0]
        geometry = Geometry(scene, first)
        tracer = EmbreeTracer(scene, geometry, first, own_workers)
        for index in _tested_states(states, len(lit)):
            state = states[index] if index else first
            if index and not _differ(last, state):
                continue
            tracer.update(state, geometry.update(state))
            lit |= _lit_in(_Setting(scene, state, geometry, tracer), lit)
            last = state
    finally:
        if workers is None:
            own_workers.close()
    receives = np.array([i.receives_light for i in scene.instances], np.bool_)
    return lit[0::2] & receives, lit[1::2] & receives


def _tested_states(states: Sequence[FrameState], sides: int) -> list[int]:
    """Indices of the states to look at: all that MOST_RAYS allows, the first and the last among them, and one more for
    what none of these shows."""
    most = max(LEAST_STATES, MOST_RAYS // (max(sides, 1) * RAYS_OF_SIDE[0]))
    chosen = {round(i) for i in np.linspace(0, len(states) - 1, min(len(states), most)).tolist()}
    if len(chosen) < len(states):
        shown = np.logical_or.reduce([states[i].visible for i in sorted(chosen)])
        for index, state in enumerate(states):
            if (state.visible & ~shown).any():
                chosen.add(index)
                shown |= state.visible
    return sorted(chosen)


def _differ(a: FrameState, b: FrameState) -> bool:
    """May light reach other places in ``b`` than in ``a``? How strong it is does not matter."""
    still = np.array_equal(a.matrix_world, b.matrix_world) and np.array_equal(a.visible, b.visible)
    if not still or b.vertices or (a.world is None or a.world.is_black) != (b.world is None or b.world.is_black):
        return True
    if a.materials != b.materials or len(a.lights) != len(b.lights):
        return True
    return any(_reach(x) != _reach(y) for x, y in zip(a.lights, b.lights, strict=True))


def _reach(light: Light) -> tuple[object, ...]:
    """All of ``light`` that decides what it can light."""
    shape = (light.kind, light.radius, light.angle, light.cone, light.size, light.shape, light.spread)
    return (*shape, light.casts_shadow, is_dark(light), light.matrix_world.tobytes())


class _Setting:
    """One state of the scene, with what is asked of it over and over. Triangles t are scene-wide."""

    def __init__(self, scene: Scene, state: FrameState, geometry: Geometry, tracer: Tracer) -> None:
        materials = scene.materials if state.materials is None else state.materials
        glows = [m.emission_map is not None and bool(np.any(m.emission_map > 0)) for m in scene.meshes]
        of_instance = np.array([glows[i.mesh] for i in scene.instances], np.bool_)
        visible = state.visible[geometry.instance_of_triangle]
        self.scene = scene
        self.state = state
        self.geometry = geometry
        self.tracer = tracer
        self.lamps = [light for light in state.lights if not is_dark(light)]
        self.sky = make_sky(state.world)
        self.emits: Bool = _by_triangle(geometry, [max(m.emission) > 0 for m in materials])  # (t,)
        self.emits = (self.emits | of_instance[geometry.instance_of_triangle]) & visible
        self.passes: Bool = _by_triangle(geometry, [m.passes_rays for m in materials])  # (t,)
        self.far = 4 * geometry.extent + 1  # m, longer than any ray within the scene


def _by_triangle(geometry: Geometry, of_material: list[bool]) -> Bool:
    return np.array([*of_material, False], np.bool_)[geometry.material_of_triangle]


@dataclass(frozen=True)
class _Rays:
    """r rays on their way. Local space."""

    side: Int32  # (r,) where the path began: 2 * instance + (0 front, 1 back)
    key: UInt32  # (r,) of its random numbers
    origin: Float32  # (r, 3) lifted off the surface
    normal: Float32  # (r, 3) unit, out of the side that the ray leaves
    direction: Float32  # (r, 3) unit

    def __getitem__(self, rows: Any) -> _Rays:
        return _Rays(self.side[rows], self.key[rows], self.origin[rows], self.normal[rows], self.direction[rows])


def _lit_in(setting: _Setting, known: Bool) -> Bool:
    """(2n,) sides ``known`` to be lit, and those that light is found for in this state."""
    lit = known.copy()
    emitting = setting.geometry.instance_of_triangle[setting.emits]
    lit[2 * emitting] = lit[2 * emitting + 1] = True
    lit[_sides_hit_by_lamps(setting)] = True
    start = _first_rays(setting)
    start = start[~lit[start.side]]
    hits = setting.tracer.intersect(start.origin, start.direction)
    lit[start.side[_finds_light(setting, start, hits)]] = True
    doubtful = _grouped_with(setting, start, hits, lit) & ~lit
    count = int(doubtful[start.side].sum()) // SEARCH_STRIDE
    for search in range(min(SEARCHES, -(-TOTAL_RAYS // max(count, 1))) if count else 0):
        turn = np.arange(len(start.side)) % SEARCH_STRIDE == search % SEARCH_STRIDE
        rays = start[(doubtful & ~lit)[start.side] & turn]
        _search_paths(setting, rays, search, lit)
    return lit


def _sides_hit_by_lamps(setting: _Setting) -> NDArray[np.intp]:
    """Sides that photons of the lamps land on first: finds what lies in a beam through a small window."""
    geometry = setting.geometry
    bounds = make_bounds(geometry)
    found = []
    if not bounds.is_empty:
        index = np.arange(max(PHOTONS // max(len(setting.lamps), 1), LEAST_PHOTONS), dtype=np.uint32)
        for number, lamp in enumerate(setting.lamps):
            numbers = [unit_float64(n) for n in photon_numbers(np.full(len(index), number, np.int32), index, 0)]
            photons = emit_lamp(lamp, numbers, origin=geometry.origin, bounds=bounds)
            origin, direction = photons.origin.astype(np.float32), photons.direction.astype(np.float32)
            hits = setting.tracer.intersect(origin, direction)
            rows = np.nonzero(hits.triangle >= 0)[0]
            found.append(2 * geometry.instance_of_triangle[hits.triangle[rows]] + hits.back[rows])
    return np.unique(np.concatenate(found)) if found else np.zeros(0, np.intp)


def _first_rays(setting: _Setting) -> _Rays:
    """Rays from both sides of every instance that may have a map, evenly over its area and the hemisphere."""
    scene, geometry = setting.scene, setting.geometry
    receives = np.array([i.receives_light for i in scene.instances], np.bool_) & setting.state.visible
    area = _areas(geometry, receives[geometry.instance_of_triangle])
    total = np.concatenate([[0.0], np.cumsum(area)])
    low, high = total[geometry.first_triangle[:-1]], total[geometry.first_triangle[1:]]
    tested = np.nonzero(high > low)[0]
    count = _rays_of_side(2 * len(tested))
    pick, weight = _numbers(tested, count, 0)
    # A triangle of the instance by area: the one in whose stretch of the running sum the number falls.
    at = low[tested, None] + (high - low)[tested, None] * pick
    triangle = np.searchsorted(total[1:], at.ravel(), side="right").clip(max=max(len(area) - 1, 0))
    # What is left of that number within the stretch is uniform again: the points stay stratified over the area.
    inside = ((at.ravel() - total[triangle]) / np.where(area[triangle] > 0, area[triangle], 1)).clip(0, 1)
    root = np.sqrt(weight.ravel())
    weights = np.stack([1 - root, root * (1 - inside), root * inside], axis=1) * (1 - 3 * INSET) + INSET
    position = np.einsum("rc,rci->ri", weights, geometry.corners[triangle].astype(np.float64)).astype(np.float32)
    lift = geometry.offset_length(position)[:, None]
    normal, instance = geometry.normals[triangle], np.repeat(tested, count)
    sides = []
    for side in (FRONT, BACK):
        outward = normal if side == FRONT else -normal
        u, v = (n.ravel().astype(np.float32) for n in _numbers(tested, count, 2 + side))
        direction = sample_cosine_about(outward, u, v)
        number = (2 * instance + side).astype(np.int32)
        key = hash_keys(number, np.tile(np.arange(count), len(tested)))
        sides.append(_Rays(number, key, position + lift * outward, outward, direction))
    names = ("side", "key", "origin", "normal", "direction")
    return _Rays(*(np.concatenate([getattr(s, name) for s in sides]) for name in names))


def _areas(geometry: Geometry, wanted: Bool) -> Float64:
    """(t,) m²; 0 for triangles not ``wanted`` (t,) and those without a normal, which no ray can leave or hit."""
    rows = np.nonzero(wanted)[0]
    rows = rows[geometry.normals[rows].any(axis=1)]
    corners = geometry.corners[rows].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    of_rows = np.sqrt(np.einsum("ti,ti->t", cross, cross)) / 2
    area = np.zeros(len(wanted))
    area[rows] = np.where(np.isfinite(of_rows), of_rows, 0.0)
    return area


def _rays_of_side(sides: int) -> int:
    """A power of two, so that the points of a side are stratified fully."""
    low, high = RAYS_OF_SIDE
    wanted = TOTAL_RAYS // max(sides, 1)
    return int(np.clip(1 << max(wanted, 1).bit_length() - 1, low, high))


def _numbers(instances: NDArray[np.intp], count: int, pair: int) -> tuple[Float64, Float64]:
    """Two (instances, count) stratified numbers in [0, 1), by instance index."""
    x, y = stratified_pair(hash_keys(instances, 7), count, pair=pair)
    return unit_float64(x), unit_float64(y)


def _finds_light(setting: _Setting, rays: _Rays, hits: Hits) -> Bool:
    """(r,) does the ray end in the sky or on an emitter, or does its origin see a lamp?"""
    escaped = hits.triangle < 0
    found: Bool = ~escaped & setting.emits.take(hits.triangle, mode="clip")
    if setting.sky is not None:
        patch = setting.sky.of_directions(rays.direction[escaped])
        found[escaped] = (setting.sky.radiance[patch] > 0).any(axis=1)
    lamps = len(setting.lamps)
    for number, lamp in enumerate(setting.lamps):
        turn = (rays.key % np.uint32(lamps) + np.uint32(number)) % np.uint32(lamps)
        rows = np.nonzero(~found & (turn < LAMPS_OF_POINT))[0]
        found[rows] = _sees_lamp(setting, rays[rows], lamp)
    return found


def _sees_lamp(setting: _Setting, rays: _Rays, lamp: Light) -> Bool:
    """(r,) does ``lamp`` light the origins of ``rays``, perhaps through panes?"""
    origin, lift = setting.geometry.origin, setting.geometry.offset_length(rays.origin)
    seen = np.zeros(len(rays.side), np.bool_)
    rows = np.nonzero(may_see(lamp, rays.origin, rays.normal, lift, origin=origin))[0]
    u, v = (unit_float32(hash_keys(rays.key[rows], 11 + n)) for n in range(2))
    view = view_lamp(lamp, rays.origin[rows], u, v, origin=origin, nearest=lift[rows], far=setting.far)
    lights = (view.strength > 0) & (dot(rays.normal[rows], view.direction) > 0)
    rows, direction, distance = rows[lights], view.direction[lights], view.distance[lights]
    if lamp.casts_shadow:
        # Lamps may lie on a wall, or touch one: the ray ends before it.
        clear = _clear(setting, rays.origin[rows], direction, distance - 2 * lift[rows])
        rows = rows[clear]
    seen[rows] = True
    return seen


def _clear(setting: _Setting, origin: Float32, direction: Float32, distance: Float32) -> Bool:
    """(r,) is there nothing on the way but panes?"""
    if not setting.passes.any():
        return ~setting.tracer.occluded(origin, direction, np.maximum(distance, 0))
    clear = np.zeros(len(origin), np.bool_)
    rows = np.arange(len(origin))
    for _ in range(PANES + 1):
        hits = setting.tracer.intersect(origin, direction)
        blocked = (hits.triangle >= 0) & (hits.distance < distance)
        clear[rows[~blocked]] = True
        pane = blocked & setting.passes.take(hits.triangle, mode="clip")
        step = hits.distance[pane] + 2 * setting.geometry.offset_length(origin[pane])
        rows, direction = rows[pane], direction[pane]
        origin, distance = origin[pane] + direction * step[:, None], distance[pane] - step
    return clear


def _grouped_with(setting: _Setting, rays: _Rays, hits: Hits, lit: Bool) -> Bool:
    """(2n,) sides that see a lit one, or see one that does, and so on. The two sides of a pane see one another."""
    rows = np.nonzero(hits.triangle >= 0)[0]
    instance = setting.geometry.instance_of_triangle
    seen = 2 * instance[hits.triangle[rows]] + hits.back[rows]
    panes = np.unique(instance[setting.passes])
    ends = np.concatenate([rays.side[rows], 2 * panes]), np.concatenate([seen, 2 * panes + 1])
    graph = coo_array((np.ones(len(ends[0]), np.int32), ends), shape=(len(lit), len(lit)))
    label = connected_components(graph, directed=False)[1]
    groups: Bool = np.isin(label, label[lit])
    return groups


def _search_paths(setting: _Setting, rays: _Rays, search: int, lit: Bool) -> None:
    """Follow diffuse paths from ``rays``' origins; mark in ``lit`` the sides whose paths find light."""
    rays = replace(rays, key=hash_keys(rays.key, 101 + search))
    rays = replace(rays, direction=_scattered(rays.normal, rays.key))
    for _ in range(PATH_SEGMENTS):
        hits = setting.tracer.intersect(rays.origin, rays.direction)
        lit[rays.side[_finds_light(setting, rays, hits)]] = True
        keep = np.nonzero(~lit[rays.side] & (hits.triangle >= 0))[0]
        if not len(keep):
            return
        rays = _next_rays(setting, rays[keep], hits.triangle[keep], hits.distance[keep], hits.back[keep])


def _next_rays(setting: _Setting, rays: _Rays, triangle: Int32, distance: Float32, back: Bool) -> _Rays:
    """The rays that go on from hits: scattered by a surface, or every other one straight through a pane."""
    key = hash_keys(rays.key, 3)
    through = setting.passes[triangle] & (key & np.uint32(1) > 0)
    normal = setting.geometry.normals[triangle] * np.where(back ^ through, np.float32(-1), np.float32(1))[:, None]
    position = rays.origin + rays.direction * distance[:, None]
    origin = position + normal * setting.geometry.offset_length(position)[:, None]
    direction = np.where(through[:, None], rays.direction, _scattered(normal, key))
    return _Rays(rays.side, key, origin, normal, direction)


def _scattered(normal: Float32, key: UInt32) -> Float32:
    return sample_cosine_about(normal, unit_float32(hash_keys(key, 21)), unit_float32(hash_keys(key, 22)))
