# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings for the bench's own ray counts, which have no name."""

from __future__ import annotations

from typing import Any

from rtgi_addon.backend.settings import SAMPLES_OF_QUALITY, BakeSettings, SampleCounts


def settings_of(counts: SampleCounts, **options: Any) -> BakeSettings:
    """Settings of the quality that has these sample counts; counts without a name are put in its place."""
    for quality, named in SAMPLES_OF_QUALITY.items():
        if named == counts:
            return BakeSettings(quality=quality, **options)

    class Counted(BakeSettings):
        samples = property(lambda self: counts)

    return Counted(**options)
