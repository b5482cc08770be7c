# SPDX-License-Identifier: Apache-2.0
"""Importers of recordings, one file each, registered here by the name of the file.

An importer is a module with ``TITLE`` (the user's name of the format), ``recognises(source)`` and
``read(source)``; to add one, put its file here and its name into :data:`IMPORTERS`.
"""

from __future__ import annotations

from importlib import import_module
from typing import Protocol, cast

from suspension_twin.drive.foreign_files import RecordedFiles
from suspension_twin.drive.streams import Streams
from suspension_twin.errors import InputError
from suspension_twin.files import reading

__all__ = ["IMPORTERS", "Importer", "importer_of", "load_importer", "read_source"]

#: Asked in this order; the first that recognises a source reads it.
IMPORTERS = ("sensor_logger", "phyphox", "matlab_mobile", "rtklib", "comma2k19")


class Importer(Protocol):
    """Interface of a module of this folder."""

    TITLE: str

    def recognises(self, source: RecordedFiles) -> bool:
        """Whether the source is in this format (it may still be damaged)."""
        ...

    def read(self, source: RecordedFiles) -> Streams:
        """Every stream the source holds; InputError where it cannot be read."""
        ...


def load_importer(name: str) -> Importer:
    """The importer of a registered name; InputError for another."""
    if name not in IMPORTERS:
        raise InputError("importer", name, f"is not known; there are {', '.join(IMPORTERS)}")
    return cast(Importer, import_module(f"{__name__}.{name}"))


def importer_of(source: RecordedFiles) -> Importer:
    """The importer that recognises the source; InputError if none does."""
    for name in IMPORTERS:
        importer = load_importer(name)
        with reading(source.path, "a recording"):
            if importer.recognises(source):
                return importer
    titles = ", ".join(load_importer(name).TITLE for name in IMPORTERS)
    raise InputError(
        source.path,
        f"format not recognised (known: {titles}; bags); describe its columns in a file and give it as --mapping",
    )


def read_source(source: RecordedFiles, importer: Importer | None = None) -> Streams:
    """Every stream of a source by the importer that recognises it, or the one given; InputError otherwise."""
    chosen = importer or importer_of(source)
    with reading(source.path, f"a recording of {chosen.TITLE}"):
        return chosen.read(source)
