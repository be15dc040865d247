# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed and error: ``python -m bench`` measures bakes of one frame beside Cycles, animations, and how cost grows.

One module a part: ``run`` (beside Cycles), ``frames`` and ``flicker`` (animations), ``scaling``, ``larsen_tables``.
"""
