# SPDX-License-Identifier: Apache-2.0
"""The one family of errors that a user may meet.

Everything that a wrong file, argument or message can cause is raised as an
:class:`InputError`: one line that names the thing and says what to do. Everything that
could not be computed although the input was usable is a :class:`WorkError`. The command
line maps them to exit status 2 and 1; a node turns them into a diagnostics entry.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from os import PathLike, fspath

__all__ = ["InputError", "SuspensionTwinError", "WorkError", "nearest"]


class SuspensionTwinError(Exception):
    """Base of every error of this package; its text is one line fit for a user."""

    exit_status = 1


class InputError(SuspensionTwinError):
    """Unusable input: names the file and, where there is one, the field.

    ``InputError("twin.yaml", "vehicle.mass", "must be above 0 kg, is -3")`` reads
    ``twin.yaml: vehicle.mass: must be above 0 kg, is -3``.
    """

    exit_status = 2

    def __init__(self, *parts: str | PathLike[str]) -> None:
        super().__init__(": ".join(fspath(p) for p in parts))


class WorkError(SuspensionTwinError):
    """The input was usable and the work failed all the same."""


def nearest(word: str, known: Iterable[str]) -> str:
    """``", did you mean mass?"`` for a mistyped ``word``, to end an error's text with; empty if nothing is near."""
    found = get_close_matches(word, list(known), n=1)
    return f", did you mean {found[0]}?" if found else ""
