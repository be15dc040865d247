# SPDX-License-Identifier: GPL-3.0-or-later
"""The small least squares of GMRES, for all strands at once: Givens rotations of a Hessenberg matrix, column by column.

Every operation is element by element over the strands, so none sees another.
"""

from __future__ import annotations

import numpy as np

from ..scene import Bool, Float64

#: A diagonal below this is float32's rounding: the direction is a null vector and changes nothing.
NULL = 1e-6


class HessenbergLeastSquares:
    """min |length · e1 - H y| for each strand (c, g); strands stop taking columns at different times."""

    def __init__(self, length: Float64) -> None:
        self.residual = length.copy()  # (c, g) |length · e1 - H y| with the columns taken so far
        self.ended = length == 0.0  # (c, g) no further column can help
        self._taken = np.zeros(length.shape, np.intp)  # columns
        self._triangle: list[Float64] = []  # column j: (j + 1, c, g)
        self._rotations: list[tuple[Float64, Float64]] = []  # (c, g) cosine, sine
        self._rhs = [length]

    def append(self, column: Float64, active: Bool) -> None:
        """The next column (j + 2, c, g) of H, for the strands that are ``active``."""
        h = list(column)
        for i, (cos, sin) in enumerate(self._rotations):
            h[i], h[i + 1] = cos * h[i] + sin * h[i + 1], cos * h[i + 1] - sin * h[i]
        diagonal = np.hypot(h[-2], h[-1])
        taken = active & (diagonal > NULL)
        cos = np.divide(h[-2], diagonal, out=np.ones_like(diagonal), where=taken)
        sin = np.divide(h[-1], diagonal, out=np.zeros_like(diagonal), where=taken)
        self._rotations.append((cos, sin))
        self._triangle.append(np.stack([*h[:-2], np.where(taken, diagonal, 1.0)]))
        last = self._rhs.pop()
        self._rhs += [cos * last, -sin * last]
        self.residual = np.where(taken, np.abs(self._rhs[-1]), self.residual)
        self.ended = self.ended | (active & ~taken)
        self._taken += taken

    def solve(self) -> Float64:
        """(columns, c, g) y; 0 for columns a strand did not take."""
        weights = np.zeros((len(self._triangle), *self.residual.shape))
        if not len(weights):
            return weights
        known = np.stack(self._rhs[:-1])
        for i in reversed(range(len(weights))):
            weights[i] = np.where(i < self._taken, known[i] / self._triangle[i][i], 0.0)
            known[:i] -= self._triangle[i][:i] * weights[i]
        return weights
