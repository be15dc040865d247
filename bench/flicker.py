# SPDX-License-Identifier: GPL-3.0-or-later
"""Flicker: how much texels far from a slow mover change from frame to frame, beyond what their light truly does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtgi_addon.backend.scene import Bool, Float64, FrameState
from rtgi_addon.backend.session import Session
from rtgi_addon.backend.settings import BakeSettings, SampleCounts
from rtgi_addon.backend.surface.texels import Texels, place_texels

from .frames import Converged, converge, open_session, values
from .sequences import FrameSequence

#: Frames (from 0) between which changes are measured.
FRAMES = tuple(range(8, 14))
#: Texels farther than this from every mover's centre count, m.
FAR = 0.9
#: The true change is that of bakes with so many rays, the same in all frames: what no mover touches has the same noise.
COUNTS, SEEDS = SampleCounts(512, 512), (2001, 2002)


@dataclass(frozen=True)
class Flicker:
    """Shares of each texel's own irradiance, over all texels far away and all pairs of neighbouring frames."""

    label: str
    texels: int
    percentile_95: float
    largest: float
    true_change: float  # 95th percentile of the change that was removed


def true_changes(sequence: FrameSequence, frames: Sequence[int] = FRAMES) -> Converged:
    return converge(sequence, frames, counts=COUNTS, seeds=SEEDS)


def flicker(
    sequence: FrameSequence, settings: BakeSettings, oidn: Sequence[Path], converged: Converged, *, label: str = ""
) -> Flicker:
    """Of the bake with ``settings``, played from the sequence's first frame."""
    frames = sorted(converged.mean)
    with open_session(sequence, settings, oidn) as session:
        maps = {}
        for n, state in enumerate(sequence.states[: frames[-1] + 1]):
            result = session.advance(state)
            if n in converged.mean:
                maps[n] = values(result.maps, session.texels).astype(np.float64).mean(axis=1)
        far = _far(sequence, session, sequence.states[frames[0]])
    rows = far & np.logical_and.reduce([converged.valid[n] for n in frames])
    ours = np.array([maps[n][rows] for n in frames])
    truth = np.array([converged.mean[n].astype(np.float64).mean(axis=1)[rows] for n in frames])
    beyond, true = excess_change(ours, truth)
    return Flicker(
        label=label, texels=int(rows.sum()), percentile_95=float(np.percentile(beyond, 95)),
        largest=float(beyond.max()), true_change=float(np.percentile(true, 95)),
    )  # fmt: skip


def excess_change(ours: Float64, truth: Float64) -> tuple[Float64, Float64]:
    """(frames - 1, n) each: |change of ours - change of the truth| and |change of the truth|, as shares of the truth.

    Of texels darker than 1 % of the mean, as shares of that.
    """
    change, true = np.diff(ours, axis=0), np.diff(truth, axis=0)
    whole = np.maximum(truth[1:], 0.01 * truth.mean())
    return np.abs(change - true) / whole, np.abs(true) / whole


def _far(sequence: FrameSequence, session: Session, state: FrameState) -> Bool:
    """(n,) texels far from all that moves, and not on it. The session stands at its last frame; movers are slow."""
    texels: Texels = session.texels
    movers = [i for i, instance in enumerate(sequence.scene.instances) if instance.moving]
    position = session.geometry.origin + place_texels(texels, session.geometry).position.astype(np.float64)
    far = ~np.isin(texels.instance, movers)
    for i in movers:
        far &= np.linalg.norm(position - state.matrix_world[i][:3, 3], axis=1) > FAR
    return far
