# SPDX-License-Identifier: GPL-3.0-or-later
"""One engine in a process of its own, so that its memory is its own and each engine has its Blender.

The parent sends (method, seed); the worker answers with a Run per curve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from rtgi_addon.backend.finish.denoise import MapDenoiser
from rtgi_addon.backend.finish.oidn import Denoiser, find_oidn
from rtgi_addon.backend.scene import Bool, Float32, Int32
from rtgi_addon.backend.session import FrameResult, Session
from rtgi_addon.backend.settings import SampleCounts
from rtgi_addon.backend.surface.texels import Texels, stand_ins
from rtgi_addon.environment import device, library_folders, versions

from .baking import settings_of
from .cycles_bake import CyclesBake
from .errors import Errors, compare
from .measure import Cost, Meter
from .prepare import Prepared, prepare, texel_table
from .reference import Reference, load_reference, match
from .results import Run
from .table import LEAST_WHOLE, OURS, BenchScene, Curve, Method


@dataclass(frozen=True)
class Subject:
    """A prepared scene and the texels that are compared."""

    prepared: Prepared
    texels: Texels
    reference: Reference
    compared: Bool  # (r,) of the reference's texels
    texel: Int32  # (r,) of the bake

    def errors(self, values: Float32) -> Errors:
        """Of ``values`` (n, 3) on all texels."""
        rows, r = self.compared, self.reference
        return compare(values[self.texel[rows]], r.mean[rows], r.standard_error[rows])


def make_subject(scene: BenchScene) -> Subject:
    reference = load_reference(scene.reference)
    prepared = prepare(scene.blend, reference.made["resolution"])
    texels, table = texel_table(prepared)
    # Of a texel that is partly under another object, or mostly beside its surface, methods mean different parts.
    texel = match(reference, table)
    compared = (reference.open >= 1.0) & (reference.whole >= LEAST_WHOLE) & (texel >= 0)
    return Subject(prepared, texels, reference, compared, texel)


def _hello(subject: Subject) -> dict[str, Any]:
    """What the parent needs to know, which does not import bpy itself."""
    return {"compared": subject.compared, "device": device(0), "versions": versions()}


def serve_ours(connection: Connection, scene: BenchScene) -> None:
    subject, meter = make_subject(scene), Meter()
    _bake(subject, meter, OURS[0].samples, seed=99, denoise=True)  # libraries are loaded and warm, as Cycles' are
    connection.send(_hello(subject))
    _serve(connection, lambda method, seed: _run_ours(subject, meter, method, seed))


def _run_ours(subject: Subject, meter: Meter, method: Method, seed: int) -> list[Run]:
    runs = []
    for curve, denoise in ((Curve.OURS, False), (Curve.OURS_DENOISED, True)):
        result, cost = _bake(subject, meter, method.samples, seed=seed, denoise=denoise)
        if result.stats.warnings:
            raise RuntimeError("; ".join(result.stats.warnings))
        maps = result.maps
        page = maps.iim if maps.caustics is None else maps.iim + maps.caustics
        t = subject.texels
        errors = subject.errors(page[t.page, t.row, t.col])
        runs.append(Run(curve, method.label, seed, cost, errors, result.stats.estimated_error))
    return runs


def _bake(
    subject: Subject, meter: Meter, samples: SampleCounts, *, seed: int, denoise: bool
) -> tuple[FrameResult, Cost]:
    """All that a bake does after extraction, from a new session to its maps."""
    p = subject.prepared
    settings = settings_of(samples, seed=seed, denoise=denoise, resolution=p.atlas.resolution)

    def work() -> FrameResult:
        with Session(p.scene, p.atlas, settings, p.first, oidn_paths=library_folders()) as session:
            return session.advance(p.first)

    return meter.measured(work)


def serve_cycles(connection: Connection, scene: BenchScene) -> None:
    subject = make_subject(scene)
    library = find_oidn(library_folders())
    if library is None:
        raise RuntimeError(f"no Open Image Denoise in {library_folders()}")
    meter = Meter()
    baker = CyclesBake(subject.prepared, subject.texels, meter)
    with Denoiser(library) as oidn:
        texels = subject.texels
        denoiser = MapDenoiser(oidn, texels.index, texels.surface, 2 * texels.instance + texels.side)
        denoiser.denoise(baker.run(4, 99)[0])
        connection.send(_hello(subject))
        _serve(connection, lambda method, seed: _run_cycles(subject, meter, baker, denoiser, method, seed))


def _run_cycles(
    subject: Subject, meter: Meter, baker: CyclesBake, denoiser: MapDenoiser, method: Method, seed: int
) -> list[Run]:
    values, cost = baker.run(method.samples, seed)
    # What Cycles left black lies under geometry, or on a border; the filter is not shown it, as it is not RTGI's.
    shown = stand_ins(subject.texels, values.any(axis=1))
    filtered, extra = meter.measured(lambda: denoiser.denoise(values, stand_in=shown))
    peaks = [c.peak_bytes for c in (cost, extra) if c.peak_bytes is not None]
    both = Cost(cost.seconds + extra.seconds, max(peaks, default=None))
    return [
        Run(Curve.CYCLES, method.label, seed, cost, subject.errors(values)),
        Run(Curve.CYCLES_DENOISED, method.label, seed, both, subject.errors(filtered)),
    ]


def _serve(connection: Connection, run: Callable[..., list[Run]]) -> None:
    """Answer until the parent sends None."""
    while (asked := connection.recv()) is not None:
        connection.send(run(*asked))
