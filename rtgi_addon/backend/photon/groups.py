# SPDX-License-Identifier: GPL-3.0-or-later
"""Photons of one light in groups of similar initial direction, and which of each group is probed (Larsen04 §2).

A group is an elementary interval of the Halton sequence: 2^a by 3^b cells over the two numbers that spread a light's
photons over the scene. A photon's cell is given by the lowest digits of its index, so groups are of equal size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Int32

Rows = NDArray[np.int64]

#: Photons of a group, about: Larsen04 has 77 groups of 40.
GROUP_SIZE = 40
#: Cells are at most so many times longer than wide, in the unit square.
_LONGEST = 4.0


@dataclass(frozen=True)
class Groups:
    """g groups of p photons, numbered as ``emission.all_photons`` lists them; 16 bytes a photon.

    Lights shift the sequence each by numbers of their own (modulo 1), so a group's cell may lie across the edge of the
    unit square. In the second number, mostly an angle about the axis, that is no edge; of the first it parts one group
    in 2^a in two.
    """

    of_photon: Int32  # (p,)
    member: Rows  # (p,) photons, group after group, by index within each
    first_member: Rows  # (g + 1,)

    @property
    def count(self) -> int:
        return len(self.first_member) - 1

    def probes(self, turn: int) -> Rows:
        """(g,) one photon of each group: in ``size`` turns, each of a group's photons once."""
        size = np.diff(self.first_member)
        return np.asarray(self.member[self.first_member[:-1] + turn % size])


def make_groups(counts: dict[int, int], *, size: int = GROUP_SIZE) -> Groups:
    """Groups of about ``size`` photons of each light; of ``counts`` photons each, > 0."""
    of_photon, first = [np.zeros(0, np.int64)], 0
    for count in counts.values():
        halves, thirds = cells(count, size)
        of_photon.append(first + np.arange(count) % (halves * thirds))
        first += min(halves * thirds, count)
    of = np.concatenate(of_photon)
    first_member = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=first))]).astype(np.int64)
    return Groups(of.astype(np.int32), np.argsort(of, kind="stable"), first_member)


def cells(count: int, size: int) -> tuple[int, int]:
    """(2^a, 3^b) cells for groups of about ``size`` out of ``count`` photons.

    Photons i with the same i % 2^a lie in one of 2^a cells of base 2, likewise in base 3, whatever the digits are
    scrambled to; both together are i % (2^a 3^b).
    """
    wanted = max(count / size, 1.0)
    best = (1, 1)
    for a in range(int(np.log2(wanted)) + 2):
        for b in range(int(np.log(wanted) / np.log(3)) + 2):
            one = (2**a, 3**b)
            if max(one) > _LONGEST * min(one) or one[0] * one[1] > count:
                continue
            if abs(np.log(one[0] * one[1] / wanted)) < abs(np.log(best[0] * best[1] / wanted)):
                best = one
    return best
