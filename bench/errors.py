# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a light map is from a reference that has noise of its own."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from rtgi_addon.backend.scene import Float32


@dataclass(frozen=True)
class Errors:
    """Shares of the reference's mean over n texels and three channels."""

    relative_rmse: float  # RMSE / mean, the reference's noise taken out in quadrature
    raw_rmse: float  # the same with it
    bias: float  # mean difference / mean
    percentile_95: float  # of |difference| / mean
    reference_noise: float  # RMS standard error of the reference / mean
    texels: int

    def as_dict(self) -> dict[str, float]:
        return asdict(self)


def compare(values: Float32, reference: Float32, standard_error: Float32) -> Errors:
    """``values`` and ``reference`` with its ``standard_error``, all (n, 3) W/m².

    The reference's error is independent of ours, so that the expected square of the difference is the sum of both.
    """
    if values.shape != reference.shape or values.shape != standard_error.shape:
        raise ValueError(f"shapes differ: {values.shape}, {reference.shape}, {standard_error.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{np.count_nonzero(~np.isfinite(values))} values are not finite")
    difference = values.astype(np.float64) - reference
    mean = float(reference.mean(dtype=np.float64))
    noise2 = float((standard_error.astype(np.float64) ** 2).mean())
    square = float((difference**2).mean())
    return Errors(
        relative_rmse=float(np.sqrt(max(square - noise2, 0.0))) / mean,
        raw_rmse=float(np.sqrt(square)) / mean,
        bias=float(difference.mean()) / mean,
        percentile_95=float(np.percentile(np.abs(difference), 95)) / mean,
        reference_noise=float(np.sqrt(noise2)) / mean,
        texels=len(values),
    )
