# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed against error: ``python -m bench`` bakes scenes by several methods and compares them with stored references."""
