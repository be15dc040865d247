# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that arrives by gather rays: targets, rays, links, the fixed point of radiosity."""
