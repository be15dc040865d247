# SPDX-License-Identifier: GPL-3.0-or-later
"""Plays animations with selection and from scratch: what a frame costs by stage, and how far its maps are off.

Both ways take turns, so that a busy moment of the machine falls on both.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from rtgi_addon.backend.scene import Bool, Float32, FrameState, LightMaps
from rtgi_addon.backend.session import FrameResult, Session
from rtgi_addon.backend.settings import BakeSettings, SampleCounts, Selection
from rtgi_addon.backend.stats import FrameStats
from rtgi_addon.backend.surface.texels import Texels

from .baking import settings_of
from .errors import Errors, compare
from .sequences import FrameSequence

#: From scratch every frame costs about the same; so many of them are enough.
SCRATCH_EVERY = 3
#: Frames (counted from 0) at which maps are compared with converged ones.
COMPARED = (11, 23)
#: Converged maps: so many bakes of so many rays, not denoised, with seeds that no other bake here has.
CONVERGED = SampleCounts(256, 256)
SEEDS = (1001, 1002, 1003)


@dataclass(frozen=True)
class Cost:
    """Of the frames after the first, which sets everything up."""

    frames: int
    seconds: float  # median
    slowest: float
    stages: dict[str, float]  # median seconds by stage
    counts: dict[str, float]  # mean of FrameStats' counts

    @property
    def rate(self) -> float:
        """Frames a second."""
        return 1 / self.seconds


@dataclass(frozen=True)
class Played:
    """One sequence with one set of settings."""

    sequence: str  # its name
    title: str
    label: str  # of the settings
    texels: int
    first: float  # seconds of the session and its first frame
    selected: Cost
    scratch: Cost
    ratio: float  # of the medians
    difference: float  # largest |selected - scratch| / scratch over frames and texels; below 1 % of the mean, / that
    errors: tuple[Errors, Errors] | None  # selected, from scratch


@dataclass(frozen=True)
class Converged:
    """Maps of some frames from many rays; n texels."""

    mean: dict[int, Float32]  # frame (from 0) -> (n, 3) W/m²
    standard_error: dict[int, Float32]
    valid: dict[int, Bool]  # (n,)


def play(
    sequence: FrameSequence, settings: BakeSettings, oidn: Sequence[Path], *, label: str = "",
    converged: Converged | None = None, scratch_every: int = SCRATCH_EVERY,
) -> Played:  # fmt: skip
    """All frames with selection, every so many of them from scratch too, and all of those in ``converged``."""
    off = replace(settings, selection=Selection.OFF)
    compared = set() if converged is None else set(converged.mean)
    first = sequence.states[0]
    results, seconds = [], []
    scratch_results, scratch_seconds = {}, []
    with open_session(sequence, off, oidn) as fresh:
        fresh.advance(first)  # libraries and caches are warm for both
        start = time.perf_counter()
        with open_session(sequence, settings, oidn) as selecting:
            selecting.advance(first)
            first_seconds = time.perf_counter() - start
            for number, state in enumerate(sequence.states[1:], start=1):
                result, spent = _timed(selecting, state)
                results.append(result)
                seconds.append(spent)
                if number % scratch_every == 1 or number in compared:
                    scratch_results[number], spent = _timed(fresh, state)
                    scratch_seconds.append(spent)
        texels = fresh.texels
    pairs = [(values(results[n - 1].maps, texels), values(r.maps, texels)) for n, r in scratch_results.items()]
    selected = _cost(seconds, [r.stats for r in results])
    scratch = _cost(scratch_seconds, [r.stats for r in scratch_results.values()])
    errors = None
    if converged is not None:
        errors = (
            _errors({n: results[n - 1].maps for n in compared}, converged, texels),
            _errors({n: scratch_results[n].maps for n in compared}, converged, texels),
        )
    return Played(
        sequence=sequence.name, title=sequence.title, label=label, texels=texels.count, first=first_seconds,
        selected=selected, scratch=scratch, ratio=scratch.seconds / selected.seconds,
        difference=max(difference(a, b) for a, b in pairs), errors=errors,
    )  # fmt: skip


def open_session(sequence: FrameSequence, settings: BakeSettings, oidn: Sequence[Path] = ()) -> Session:
    """A session for the whole ``sequence``."""
    return Session(
        sequence.scene, sequence.atlas, settings, sequence.states[0], guide=sequence.guide, oidn_paths=oidn
    )  # fmt: skip


def converge(
    sequence: FrameSequence, frames: Iterable[int], *, counts: SampleCounts = CONVERGED, seeds: Sequence[int] = SEEDS
) -> Converged:
    """Mean of bakes with independent seeds, every frame from scratch."""
    frames = list(frames)
    runs: dict[int, list[Float32]] = {n: [] for n in frames}
    valid: dict[int, Bool] = {}
    for seed in seeds:
        settings = settings_of(counts, seed=seed, denoise=False, selection=Selection.OFF)
        with open_session(sequence, settings) as session:
            t = session.texels
            for n in frames:
                maps = session.advance(sequence.states[n]).maps
                runs[n].append(values(maps, t))
                valid[n] = valid.get(n, np.True_) & maps.valid[t.page, t.row, t.col]
    mean = {n: np.mean(r, axis=0, dtype=np.float64).astype(np.float32) for n, r in runs.items()}
    spread = {n: np.std(r, axis=0, dtype=np.float64, ddof=1).astype(np.float32) for n, r in runs.items()}
    return Converged(mean, {n: s / np.float32(np.sqrt(len(seeds))) for n, s in spread.items()}, valid)


def values(maps: LightMaps, texels: Texels) -> Float32:
    """(n, 3) W/m² of all texels: what the light maps add to Eevee's own light."""
    page = maps.iim if maps.caustics is None else maps.iim + maps.caustics
    return page[texels.page, texels.row, texels.col]


def difference(ours: Float32, other: Float32) -> float:
    """Largest relative difference; of values below 1 % of the mean, relative to that."""
    least = 0.01 * float(other.mean(dtype=np.float64))
    return float((np.abs(ours - other) / np.maximum(np.abs(other), max(least, np.finfo(np.float32).tiny))).max())


def _timed(session: Session, state: FrameState) -> tuple[FrameResult, float]:
    start = time.perf_counter()
    result = session.advance(state)
    return result, time.perf_counter() - start


def _cost(seconds: list[float], stats: list[FrameStats]) -> Cost:
    names = dict.fromkeys(name for s in stats for name in s.seconds)
    counted = [f.name for f in fields(FrameStats) if f.type == "int"]
    return Cost(
        frames=len(seconds),
        seconds=float(np.median(seconds)),
        slowest=max(seconds),
        stages={name: float(np.median([s.seconds.get(name, 0.0) for s in stats])) for name in names},
        counts={name: float(np.mean([getattr(s, name) for s in stats])) for name in counted},
    )


def _errors(maps: dict[int, LightMaps], converged: Converged, texels: Texels) -> Errors:
    """Over the texels that are valid, all frames together."""
    rows = {n: converged.valid[n] & m.valid[texels.page, texels.row, texels.col] for n, m in maps.items()}
    return compare(
        np.concatenate([values(m, texels)[rows[n]] for n, m in maps.items()]),
        np.concatenate([converged.mean[n][rows[n]] for n in maps]),
        np.concatenate([converged.standard_error[n][rows[n]] for n in maps]),
    )
