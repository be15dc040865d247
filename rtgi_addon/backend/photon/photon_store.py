# SPDX-License-Identifier: GPL-3.0-or-later
"""Selective photons (Larsen04 §2, DESIGN §5): paths are kept from frame to frame, and only disturbed ones re-traced.

"swept": every stored ray is tested against what moved, where it was and where it is; what is touched is exactly what
must be traced again, in the same frame. "probe": one photon of each group is traced a frame, and one that goes another
way than before marks its group. "off": all anew. Once nothing is pending the paths are those of a trace from scratch,
to the last bit, whatever came before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..lamps.emission import MESHES, SKY, PhotonSource, all_photons
from ..parallel import Workers
from ..scene import Bool, Float32, Float64, Int32
from ..selection.sweep import Sweep
from ..settings import Selection
from ..surface.scatter import Surfaces
from ..surface.texels import Texels
from ..surface.tracing import Tracer
from .groups import GROUP_SIZE, Rows, make_groups
from .path_pool import NOBODY, PathPool, equal_bits, moved_rows
from .paths import AFTER_DIFFUSE, END_ESCAPED, PhotonPaths, take_paths
from .photons import emit_photons, flux_factor, trace_starts

#: Photons of a changed light that are looked at first: where none starts as before the others are not compared.
_FEW = 64


@dataclass(frozen=True)
class PhotonUpdate:
    """What one frame changed. Δ of each surface, W: brightest channel of every hit removed, added, or dimmed by.

    A hit that is there before and after counts for nothing, even where the surface slid along under it: surfaces of
    objects that moved want an update whatever their Δ.
    """

    delta_f: Float64  # (surface_count,) of all hits
    delta_i: Float64  # (surface_count,) of hits after at least one diffuse reflection
    delta_aim: Float64  # (surface_count,) of these and all of the sky's and emissive meshes': no shadow ray brings them
    probed: int
    invalidated: int  # photons found disturbed, or whose group was, or new
    traced: int  # photons, probes included
    kept: int  # photons not traced
    rays: int
    pending: int  # photons still to be traced, for want of budget


class PhotonStore:
    """The photons of one bake, their paths and what is known of the frame they were traced in.

    114 bytes a photon and 53 a hit, 220 in all in the Cornell box, whose photons land twice; dead hits and room for new
    ones may come to half of the hits again, each. Measured there, one core, 100,000 photons, ms: 0.2 where nothing
    changed, 52 for a mover that touches 7 % of them (20 the test, 25 the tracing of the longest paths), 35 for a lamp
    that dims, 220 for one that moves; the tracing alone of all takes 175.
    """

    def __init__(
        self, texels: Texels, *, selection: Selection, max_bounces: int, seed: int = 0, diffuse: bool = True,
        group_size: int = GROUP_SIZE,
    ) -> None:  # fmt: skip
        """``diffuse`` False keeps caustic photons; those that met no generator too, since one may come in their way."""
        self.selection = selection
        self._texels, self._group_size = texels, group_size
        self._max_bounces, self._seed, self._diffuse = max_bounces, seed, diffuse
        self._pool = PathPool()
        self._counts: dict[int, int] = {}
        self._identity: dict[int, bytes] = {}  # of each light
        self._scattering: tuple[Float32, ...] = ()
        self._scale: Float32 = np.zeros((0, 3), np.float32)  # (p, 3) Starts.scale
        self._due: Bool = np.zeros(0, np.bool_)  # (p,) to be traced
        self._groups = make_groups({})
        self._turn = 0
        self._cursor = 0  # photon that comes first when not all that are due can be traced
        self._paths: PhotonPaths | None = None

    @property
    def paths(self) -> PhotonPaths:
        """All paths in the order of ``emission.all_photons``, flux in W; the same object until something changes."""
        if self._paths is None:
            self._paths = self._pool.select()
        return self._paths

    def paths_on(self, surfaces: Bool) -> PhotonPaths:
        """All paths, but only their hits on the chosen ``surfaces`` (surface_count,)."""
        texel = self._pool.hit("texel")
        on = np.zeros(len(texel), np.bool_)
        mapped = np.nonzero(texel >= 0)[0]
        on[mapped] = surfaces[self._texels.surface[texel[mapped]]]
        return self._pool.select(on)

    def update(
        self,
        sources: Sequence[PhotonSource],
        counts: dict[int, int],
        *,
        surfaces: Surfaces,
        tracer: Tracer,
        workers: Workers,
        sweep: Sweep,
        instance_of_triangle: Int32,
        rebuilt: bool = False,
        budget: int | None = None,
    ) -> PhotonUpdate:
        """Follow the scene to this frame.

        ``sweep``: what moved since the last call. ``rebuilt``: nothing known about any ray holds (``Movement``).
        ``budget``: the most photons to trace besides probes; those left over keep their old paths, or none, and come
        first in the next frames.
        """
        frame = _Frame(sources, counts, surfaces, tracer, workers, _Deltas(self._texels))
        if self.selection is Selection.OFF:
            self._forget(frame)
        carried = self._follow_counts(frame)
        self._follow_lights(frame)
        scattering = self._follow_scattering(surfaces)
        probed = diverged = rays = 0
        if rebuilt:
            self._due[:] = True
        elif self.selection is Selection.SWEPT:
            self._mark_touched(sweep, instance_of_triangle, scattering, surfaces)
        elif self.selection is Selection.PROBE:
            probed, diverged, rays = self._probe(frame)
        invalidated = int(self._due.sum()) - carried + diverged
        rows = self._within(budget)
        rays += self._trace(frame, rows)[1]
        traced = probed + len(rows)
        return PhotonUpdate(
            *frame.deltas.sums, probed, invalidated, traced, len(self._due) - traced, rays, int(self._due.sum())
        )

    # --- what changed ---------------------------------------------------------------------------------------------

    def _forget(self, frame: _Frame) -> None:
        pool = self._pool
        frame.deltas.add(pool, np.nonzero(pool.path != NOBODY)[0])
        self._pool, self._counts, self._identity, self._paths = PathPool(), {}, {}, None
        self._scale, self._due = np.zeros((0, 3), np.float32), np.zeros(0, np.bool_)

    def _follow_counts(self, frame: _Frame) -> int:
        """Rows for the photons that there are now; how many of them were due before."""
        counts = frame.counts
        if list(counts.items()) == list(self._counts.items()):
            return int(self._due.sum())
        light, index = all_photons(counts)
        first_before = dict(zip(self._counts, np.cumsum([0, *self._counts.values()]).tolist(), strict=False))
        row_before = np.full(len(light), -1, np.int64)
        first = 0
        for number, count in counts.items():
            common = min(count, self._counts.get(number, 0))
            row_before[first : first + common] = first_before.get(number, 0) + np.arange(common)
            first += count
        stays = np.zeros(len(self._due) + 1, np.bool_)  # the last is NOBODY
        stays[row_before[row_before >= 0]] = stays[-1] = True
        frame.deltas.add(self._pool, np.nonzero(~stays[self._pool.path])[0])
        self._pool.resize(light, index, row_before)
        self._scale, self._due = moved_rows(self._scale, row_before), moved_rows(self._due, row_before)
        carried = int(self._due.sum())
        self._due |= row_before < 0
        self._counts, self._groups, self._paths = dict(counts), make_groups(counts, size=self._group_size), None
        frame.recount = True
        return carried

    def _follow_lights(self, frame: _Frame) -> None:
        """Photons that start otherwise than before are due; others get the flux they have now."""
        for source in frame.sources:
            identity = source.identity
            if self._identity.get(source.light) == identity:
                continue
            self._identity[source.light] = identity
            rows = np.nonzero((self._pool.of_path("light") == source.light) & ~self._due)[0]
            if not len(rows):
                continue
            frame.recount = True
            if not self._start_again(frame, source, rows[:_FEW]) and len(rows) > _FEW:
                self._due[rows] = True
            else:
                self._start_again(frame, source, rows[_FEW:])
        self._identity = {s.light: self._identity[s.light] for s in frame.sources}
        if frame.recount:
            self._rescale(frame)

    def _start_again(self, frame: _Frame, source: PhotonSource, rows: Rows) -> bool:
        """Marks those of ``rows`` that start otherwise now; does any start as before?"""
        light, index = self._pool.of_path("light")[rows], self._pool.of_path("index")[rows]
        starts = emit_photons([source], light, index, workers=frame.workers, seed=self._seed)
        same = np.ones(len(rows), np.bool_)
        for before, now in zip(self._pool.starts(rows), (starts.origin, starts.direction, starts.guide), strict=True):
            same &= equal_bits(before, now)
        self._due[rows[~same]] = True
        self._scale[rows[same]] = starts.scale[same]
        return bool(same.any())

    def _rescale(self, frame: _Frame) -> None:
        factor = flux_factor(self._scale, self._pool.of_path("light"), frame.counts)
        changed = ~equal_bits(factor, self._pool.factor)
        if not changed.any():
            return
        path = self._pool.path
        rows = np.nonzero((path != NOBODY) & changed[path])[0]
        frame.deltas.add(self._pool, rows, np.abs(factor - self._pool.factor))
        self._pool.factor = factor
        self._paths = None

    def _follow_scattering(self, surfaces: Surfaces) -> tuple[Bool, Bool]:
        """((n,), (m,)) texels and materials that scatter light otherwise than before."""
        now = (surfaces.albedo, surfaces.specular, surfaces.transmission, surfaces.ior, surfaces.opacity)
        before = self._scattering or now
        differs = [~equal_bits(a, b) for a, b in zip(before, now, strict=True)]
        self._scattering = now  # made anew in every frame (make_surfaces), never written to
        return differs[0], differs[1] | differs[2] | differs[3] | differs[4]

    def _mark_touched(
        self, sweep: Sweep, instance_of_triangle: Int32, scattering: tuple[Bool, Bool], surfaces: Surfaces
    ) -> None:
        """Photons with a ray that meets what moved, or a hit on it, or a hit that scatters otherwise now, are due."""
        pool, (texels, materials) = self._pool, scattering
        path, triangle = pool.path, pool.hit("triangle")
        touched = np.zeros(len(path), np.bool_)
        if texels.any():
            texel = pool.hit("texel")
            touched |= texels.take(texel, mode="clip") & (texel >= 0)
        if materials.any():
            touched |= materials[surfaces.material_of_triangle[triangle]]
        if sweep.any:
            touched |= sweep.moved[instance_of_triangle[triangle]]
            touched |= sweep.enters(pool.hit("start"), pool.hit("direction"), pool.hit("distance"))
        self._due[path[touched & (path != NOBODY)]] = True
        if sweep.any:
            rows = np.nonzero((pool.of_path("end") == END_ESCAPED) & ~self._due)[0]
            endless = np.full(len(rows), np.inf, np.float32)
            origin, direction = pool.of_path("end_origin")[rows], pool.of_path("end_direction")[rows]
            self._due[rows[sweep.enters(origin, direction, endless)]] = True

    def _probe(self, frame: _Frame) -> tuple[int, int, int]:
        """One photon of each group: (traced, gone another way, rays); groups of the latter are due."""
        rows = self._groups.probes(self._turn)
        self._turn += 1
        rows = rows[~self._due[rows]]
        changed, rays = self._trace(frame, rows)
        marked = np.zeros(self._groups.count, np.bool_)
        marked[self._groups.of_photon[changed]] = True
        probed = np.zeros(len(self._due), np.bool_)
        probed[rows] = True
        self._due |= marked[self._groups.of_photon] & ~probed
        return len(rows), len(changed), rays

    # --- tracing --------------------------------------------------------------------------------------------------

    def _within(self, budget: int | None) -> Rows:
        """Photons to trace now; with a budget they take turns, so that none waits for ever."""
        rows = np.nonzero(self._due)[0]
        if budget is None or len(rows) <= budget:
            return rows
        rows = np.roll(rows, -int(np.searchsorted(rows, self._cursor)))[:budget]
        self._cursor = int(rows[-1]) + 1 if len(rows) else self._cursor
        return np.sort(rows)

    def _trace(self, frame: _Frame, rows: Rows) -> tuple[Rows, int]:
        """Photons ``rows`` traced anew: those whose path or flux is another now, and the rays it took."""
        self._due[rows] = False
        if not len(rows):
            return rows, 0
        pool = self._pool
        light, index = pool.of_path("light")[rows], pool.of_path("index")[rows]
        starts = emit_photons(frame.sources, light, index, workers=frame.workers, seed=self._seed)
        fresh, rays = trace_starts(
            starts, light, index, surfaces=frame.surfaces, tracer=frame.tracer, workers=frame.workers,
            max_bounces=self._max_bounces, seed=self._seed, diffuse=self._diffuse,
        )  # fmt: skip
        factor = flux_factor(starts.scale, light, frame.counts)
        same, stays, fresh_stays = pool.compare(rows, fresh, factor)
        self._scale[rows] = starts.scale
        frame.deltas.add(pool, pool.hits_of(rows)[~stays])
        changed = np.nonzero(~same)[0]
        if len(changed):
            pool.factor[rows] = factor
            new = fresh_stays[fresh.hits_of(changed)]
            if len(changed) < len(rows):
                rows, fresh = rows[changed], take_paths(fresh, changed)
            pool.replace(rows, fresh)
            frame.deltas.add(pool, pool.hits_of(rows)[~new])
            self._paths = None
        return (rows if len(changed) else changed), rays


@dataclass
class _Frame:
    """What the steps of one update share."""

    sources: Sequence[PhotonSource]
    counts: dict[int, int]
    surfaces: Surfaces
    tracer: Tracer
    workers: Workers
    deltas: _Deltas
    recount: bool = False  # some photon's flux may differ from before


class _Deltas:
    """Δ_f, Δ_i and the AIM's Δ being summed up (see PhotonUpdate)."""

    def __init__(self, texels: Texels) -> None:
        self._surface = texels.surface
        self._of_kind = np.zeros((texels.surface_count, 3))  # lamps' direct light, other direct light, bounced

    @property
    def sums(self) -> tuple[Float64, Float64, Float64]:
        direct, other, bounced = self._of_kind.T
        return direct + other + bounced, bounced.copy(), other + bounced

    def add(self, pool: PathPool, hits: Rows, factor: Float32 | None = None) -> None:
        """The flux of ``hits`` (k,) of the pool; by ``factor`` (p, 3) instead of the paths' own."""
        texel = pool.hit("texel")[hits]
        hits, texel = hits[texel >= 0], texel[texel >= 0]
        path = pool.path[hits]
        flux = pool.hit("flux").take(hits, axis=0) * (pool.factor if factor is None else factor).take(path, axis=0)
        amount = np.maximum(np.maximum(flux[:, 0], flux[:, 1]), flux[:, 2])
        light = pool.of_path("light")[path]
        kind = ((light == MESHES) | (light == SKY)).astype(np.int64)
        kind[(pool.hit("flags")[hits] & AFTER_DIFFUSE) > 0] = 2
        place = self._surface[texel] * np.int64(3) + kind
        self._of_kind += np.bincount(place, amount, minlength=self._of_kind.size).reshape(-1, 3)
