# SPDX-License-Identifier: Apache-2.0
"""The one family of errors that a user may meet.

Everything that a wrong file, argument or message can cause is raised as an
:class:`InputError`: one line that names the thing and the remedy. Everything that
could not be computed although the input was usable is a :class:`WorkError`. The command
line maps them to exit status 2 and 1; a node turns them into a diagnostics entry.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from difflib import get_close_matches
from os import PathLike, fspath
from typing import Final

__all__ = [
    "InputError",
    "SuspensionTwinError",
    "WorkError",
    "nearest",
    "one_line",
    "printable",
    "shorter",
    "shown",
]

#: Characters of a line of error text; whatever a file holds, a message stays readable.
_LONGEST: Final = 2000


def printable(text: str) -> str:
    """``text`` as one line that a terminal shows and does not obey: control characters become escapes, ``\\n``.

    So do bytes of a file name that are no text, and marks that turn the direction of writing.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def one_line(text: str) -> str:
    """``text`` printable, and of a length that can be read."""
    text = printable(text)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 500]} … {text[-500:]}"


def shorter(text: str, most: int) -> str:
    """``text`` printable, in at most ``most`` characters."""
    text = printable(text[: most + 1])
    return text if len(text) <= most else f"{text[: most - 1]}…"


def shown(value: object, most: int = 80) -> str:
    """``repr(value)`` in at most ``most`` characters, of nested values the first few: to quote in an error."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = most
    return shorter(short.repr(value), most)


class SuspensionTwinError(Exception):
    """Base of every error of this package; its text is one printable line fit for a user."""

    exit_status = 1

    def __init__(self, *parts: str | PathLike[str]) -> None:
        super().__init__(one_line(": ".join(fspath(p) for p in parts)))


class InputError(SuspensionTwinError):
    """Unusable input: names the file and, where there is one, the field.

    ``InputError("twin.yaml", "vehicle.mass", "must be above 0 kg, is -3")`` reads
    ``twin.yaml: vehicle.mass: must be above 0 kg, is -3``.
    """

    exit_status = 2
    #: Of an error about the content of a file the place alone, without anything that stands there: all that somebody
    #: elsewhere may know of it. None where the error is about something else.
    place: str | None = None

    def __init__(self, *parts: str | PathLike[str]) -> None:
        super().__init__(*parts)
        #: The first part: the file, in errors that are about one.
        self.source = printable(fspath(parts[0])) if parts else ""


class WorkError(SuspensionTwinError):
    """The input was usable and the work failed all the same."""


def nearest(word: str, known: Iterable[str]) -> str:
    """``", did you mean mass?"`` for a mistyped ``word``, to end an error's text with; empty if nothing is near."""
    found = get_close_matches(word[:60], list(known), n=1)
    return f", did you mean {found[0]}?" if found else ""
