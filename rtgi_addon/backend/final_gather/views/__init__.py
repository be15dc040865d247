# SPDX-License-Identifier: GPL-3.0-or-later
"""The gather by views: what a view is, how it is drawn or traced on the GPU, kept, and summed."""
