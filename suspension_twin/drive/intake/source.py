# SPDX-License-Identifier: Apache-2.0
"""Files that an importer reads, whether they lie in a folder, in a zip archive or were named singly."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError
from suspension_twin.files import read_bytes, reading

__all__ = ["Source", "decode_text"]

_LARGEST = 2 << 30  # bytes of one file
_MOST_FILES = 20_000
_PIECE = 1 << 20  # bytes of a member of an archive that are unpacked at a time
_ITEM = 48  # bytes of memory that a line of text, a list or an object takes beside its characters


def decode_text(data: bytes) -> tuple[str, bool]:
    """Text of a file in UTF-8 or, by its mark, UTF-16; whether it had to be read as Latin-1."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", "replace"), False
    try:
        return data.decode("utf-8-sig"), False
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace"), True


class Source:
    """One recording as the user named it: a file, a folder or a zip archive.

    ``names`` are its files relative to it, with ``/``; of a single file, its name. Archives made on
    a Mac carry a shadow of each file, and some wrap everything in a folder: neither shows here.
    """

    def __init__(self, path: str | Path) -> None:
        """Raises InputError if there is nothing at ``path`` or the archive is damaged."""
        self.path = Path(path)
        self._archive: zipfile.ZipFile | None = None
        self._members: Mapping[str, str | Path]
        self._budget = Budget(self.path, 0)
        with reading(self.path, "a recording"):
            if self.path.is_dir():
                self._members = self._folder()
                return
            if not self.path.is_file() and self.path.exists():
                raise InputError(self.path, "is not a regular file")
            try:
                if zipfile.is_zipfile(self.path):
                    self._archive = zipfile.ZipFile(self.path)
                    self._members = self._zip(self._archive)
                    self._budget = Budget(self.path, self.path.stat().st_size)
                    return
            except zipfile.BadZipFile:
                raise InputError(self.path, "the zip archive is damaged") from None
            with self.path.open("rb") as file:
                if file.read(4) == b"PK\x03\x04":
                    raise InputError(self.path, "the zip archive is cut off: copy it again")
            self._members = {self.path.name: self.path}

    def _folder(self) -> dict[str, str | Path]:
        members: dict[str, str | Path] = {}
        for path in sorted(self.path.rglob("*")):
            if path.is_file() and not _shadow(path.relative_to(self.path).as_posix()):
                members[path.relative_to(self.path).as_posix()] = path
                if len(members) > _MOST_FILES:
                    raise InputError(self.path, f"holds more than {_MOST_FILES} files: name one recording")
        return members

    @staticmethod
    def _zip(archive: zipfile.ZipFile) -> dict[str, str | Path]:
        names = [i.filename for i in archive.infolist() if not i.is_dir() and not _shadow(i.filename)]
        if len(names) > _MOST_FILES:
            raise InputError(str(archive.filename), f"holds more than {_MOST_FILES} files")
        tops = {name.split("/", 1)[0] for name in names}
        wrapped = len(tops) == 1 and all("/" in name for name in names)
        return {name.split("/", 1)[1] if wrapped else name: name for name in names}

    @property
    def name(self) -> str:
        """Name of the recording, without the archive's or file's ending."""
        return self.path.name if self.path.is_dir() else self.path.stem

    @property
    def names(self) -> list[str]:
        """Every file, relative to the source."""
        return list(self._members)

    def find(self, *wanted: str) -> str | None:
        """The first of the names that there is, whatever its case, at any depth (the least deep)."""
        for name in wanted:
            low = name.lower()
            hits = [m for m in self._members if m.lower() == low or m.lower().endswith("/" + low)]
            if hits:
                return min(hits, key=lambda m: m.count("/"))
        return None

    def label(self, name: str) -> str:
        """How an error names one of the files."""
        return str(self.path) if str(self.path.name) == name else f"{self.path}/{name}"

    def read(self, name: str) -> bytes:
        """Content of one file; InputError if it cannot be read, TooLarge if it unpacks to more than it may."""
        member = self._members[name]
        if isinstance(member, Path):
            return read_bytes(member, _LARGEST)
        assert self._archive is not None
        pieces = []
        readable = reading(self.label(name), "a file of an archive (or it is encrypted)")
        with readable, self._archive.open(member) as entry:
            while piece := entry.read(_PIECE):
                self._budget.take(len(piece) + _ITEM * sum(map(piece.count, (b"\n", b"[", b"{"))))
                pieces.append(piece)
        return b"".join(pieces)

    def text(self, name: str) -> str:
        """Content of one text file."""
        return decode_text(self.read(name))[0]

    def head(self, name: str, size: int = 4096) -> bytes:
        """The first bytes of one file, empty if it cannot be read (used to recognise a format)."""
        member = self._members[name]
        try:
            with reading(self.label(name), "a file"):
                if isinstance(member, Path):
                    with member.open("rb") as file:
                        return file.read(size)
                assert self._archive is not None
                with self._archive.open(member) as entry:
                    return entry.read(size)
        except InputError:
            return b""


def _shadow(name: str) -> bool:
    parts = PurePosixPath(name).parts
    return "__MACOSX" in parts or parts[-1].startswith("._") or parts[-1] == ".DS_Store"
