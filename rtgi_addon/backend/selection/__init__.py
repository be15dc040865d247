# SPDX-License-Identifier: GPL-3.0-or-later
"""What changed since the last frame, and what that touches."""
