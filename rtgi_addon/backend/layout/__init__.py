# SPDX-License-Identifier: GPL-3.0-or-later
"""Before any light: islands, charts, which sides get a map, rectangles on pages."""
