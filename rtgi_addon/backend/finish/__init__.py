# SPDX-License-Identifier: GPL-3.0-or-later
"""From texels to pages: noise, seams, padding."""
