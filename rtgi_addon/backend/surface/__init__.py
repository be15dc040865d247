# SPDX-License-Identifier: GPL-3.0-or-later
"""Where things are: triangles of a frame, rays against them, texels on them."""
