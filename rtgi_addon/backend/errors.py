# SPDX-License-Identifier: GPL-3.0-or-later
"""What can go wrong for a user, in one exception that carries the remedy."""

from __future__ import annotations


class BakeError(Exception):
    """A fault the user can mend: bad input, a full disk, an unreadable file.

    ``problems`` holds one line each, in the form "object or file: what is wrong; what to do".
    Faults of the program itself are assertions or ordinary exceptions, never this.
    """

    def __init__(self, *problems: str) -> None:
        if not problems:
            raise ValueError("a BakeError needs at least one problem line")
        self.problems = problems
        super().__init__("\n".join(problems))


class Cancelled(Exception):
    """The user asked to stop; finished frames stay."""
