# SPDX-License-Identifier: GPL-3.0-or-later
"""OpenGL as a device: a context of our own, shaders, the scene's triangles and tables on it, rays by compute."""
