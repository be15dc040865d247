# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that comes straight: lamps seen from a point, lamps and sky as sources."""
