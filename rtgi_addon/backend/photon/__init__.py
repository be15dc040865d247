# SPDX-License-Identifier: GPL-3.0-or-later
"""Light in packets: photon paths, what happens where they land, density, caustics."""
