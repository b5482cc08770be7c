# SPDX-License-Identifier: Apache-2.0
"""Importers of recordings, by name.

An importer is a module with ``TITLE`` (the format as a user calls it), ``recognises(source)`` and ``read(source)``: a
file of this folder, or a module of an installed package that its entry point in the group ``suspension_twin.importers``
names.
"""

from __future__ import annotations

from typing import Final, Protocol, runtime_checkable

from suspension_twin.drive.foreign_files import RecordedFiles
from suspension_twin.drive.streams import Streams
from suspension_twin.errors import InputError
from suspension_twin.files import reading
from suspension_twin.registry import Registry

__all__ = ["IMPORTERS", "Importer", "importer_of", "read_source"]


@runtime_checkable
class Importer(Protocol):
    """Interface of an importer's module."""

    TITLE: str

    def recognises(self, source: RecordedFiles) -> bool:
        """Whether the source is in this format (it may still be damaged)."""
        ...

    def read(self, source: RecordedFiles) -> Streams:
        """Every stream the source holds; InputError where it cannot be read."""
        ...


#: Asked in this order, plugins last; the first that recognises a source reads it.
IMPORTERS: Final = Registry[Importer](
    "importers",
    {
        name: f"{__name__}.{name}"
        for name in ("sensor_logger", "logger_csv", "vbo", "phyphox", "matlab_mobile", "rtklib", "comma2k19")
    },
    kind=Importer,
)


def importer_of(source: RecordedFiles) -> Importer:
    """The importer that recognises the source; InputError if none does."""
    for importer in IMPORTERS.values():
        with reading(source.path, "a recording"):
            if importer.recognises(source):
                return importer
    if not any(map(source.head, source.names)):
        raise InputError(source.path, "is empty: copy the recording again")
    titles = ", ".join(importer.TITLE for importer in IMPORTERS.values())
    raise InputError(
        source.path,
        f"format not recognised (known: {titles}; bags); describe its columns in a file and give it as --mapping",
    )


def read_source(source: RecordedFiles, importer: Importer | None = None) -> Streams:
    """Every stream of a source by the importer that recognises it, or the one given; InputError otherwise."""
    chosen = importer or importer_of(source)
    with reading(source.path, f"a recording of {chosen.TITLE}"):
        return chosen.read(source)
