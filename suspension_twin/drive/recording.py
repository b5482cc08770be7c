# SPDX-License-Identifier: Apache-2.0
"""Recordings on disk as raw messages: MCAP, sqlite3 and ROS 1, complete or damaged.

The format is recognised by a file's first bytes, never by its name: a rosbag2 folder called ``drive.bag`` is a rosbag2
folder. A complete file is read by ``rosbags``, which refuses one with any damage; that is then salvaged record by
record (:mod:`suspension_twin.drive.salvage`), without index, order and check sums to rely on.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Final
from urllib.parse import quote

from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader, reader as rosbag1
from rosbags.rosbag2 import Reader as Ros2Reader, storage_mcap

from suspension_twin.drive.contents import Contents, RawTopic, topic_name
from suspension_twin.drive.salvage import (
    MCAP_MAGIC,
    ROS1_MAGIC,
    SQLITE_MAGIC,
    salvage_mcap,
    salvage_ros1,
    salvage_sqlite,
)
from suspension_twin.drive.unpack import ZSTD_MAGIC, Budget, TooLarge, inflate
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.files import open_file, read_bytes, read_yaml, reader, reading

__all__ = ["is_recording", "read_recording", "read_whole"]

#: By a file's first bytes: the name of its storage in rosbags, and the function that reads it where it is damaged.
_FORMATS: Final = {
    MCAP_MAGIC: ("mcap", salvage_mcap),
    SQLITE_MAGIC: ("db3", salvage_sqlite),
    ROS1_MAGIC: ("bag", salvage_ros1),
}
_BAG_NAME: Final = re.compile(r"\.(mcap|db3)(\.zstd)?$")
#: Memory in bytes that a message takes beside its own.
_OVERHEAD: Final = 64


def _magic(path: Path) -> bytes:
    with open_file(path) as file:
        return file.read(16)


def _format(head: bytes) -> bytes | None:
    return next((magic for magic in _FORMATS if head.startswith(magic)), None)


def is_recording(path: str | Path) -> bool:
    """Whether ``read_recording`` is the one to read this path (it may still be damaged)."""
    path = Path(path)
    try:
        if path.is_dir():
            return bool(_files(path, []))
        head = _magic(path)
    except (OSError, InputError):
        return False
    if head.startswith(ZSTD_MAGIC):
        return bool(_BAG_NAME.search(path.name))
    return _format(head) is not None or head.startswith(b"#ROSBAG")


@reader("a recording")
def read_recording(path: str | Path, topics: Collection[str] | None = None) -> Contents:
    """Raw messages of the ``topics`` wanted (all if None), in the order they were recorded.

    ``path`` is a rosbag2 folder (MCAP or sqlite3; ``metadata.yaml`` may be missing), a bare
    ``.mcap`` or ``.db3`` file, or a ROS 1 bag. Cut-off or damaged parts are left out, with a line
    in ``warnings``. Raises InputError where there is nothing to read.
    """
    path = Path(path)
    if path.name == "metadata.yaml":
        path = path.parent
    contents = Contents("cdr", None if topics is None else {topic_name(name) for name in topics})
    files = _files(path, contents.warnings) if path.is_dir() else [path]
    if not files:
        raise InputError(path, _no_recording(path))
    contents.budget = Budget(path, sum(file.stat().st_size for file in files))
    unreadable: list[InputError] = []
    for file in files:
        try:
            with reading(file, "a recording"):
                _read_file(file, contents)
        except TooLarge:
            raise
        except InputError as error:
            if len(files) == 1:
                raise
            unreadable.append(error)
            contents.warnings.append(f"left out {error}")
    if len(unreadable) == len(files):
        raise unreadable[0]
    contents.finish()
    return contents


def _no_recording(folder: Path) -> str:
    inner = sorted(child.name for child in folder.iterdir() if (child / "metadata.yaml").is_file())
    if inner:
        return f"a folder of recordings, not one: name one of {', '.join(inner[:5])}"
    return "no recording: the folder holds no .mcap or .db3 file"


def _natural(path: Path) -> list[tuple[int, str]]:
    """A key that sorts part_10 behind part_9."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", path.name)]


def _files(folder: Path, warnings: list[str]) -> list[Path]:
    """Files of a rosbag2 folder, in the order they were written."""
    present = sorted((p for p in folder.iterdir() if _BAG_NAME.search(p.name) and p.is_file()), key=_natural)
    listed = _listed(folder, warnings, bool(present))
    if listed is None:
        return present
    files = [folder / name for name in listed if (folder / name).is_file()]
    for name in listed:
        bare = folder / name.removesuffix(".zstd")
        if (folder / name).is_file():
            continue
        if bare.is_file():
            files.append(bare)
        elif len(present) == len(listed) == 1:
            return present  # the file was renamed with the recording
        else:
            warnings.append(f"{name} is named in metadata.yaml and missing")
    files += [path for path in present if path not in files and path.suffix != ".zstd"]
    return files or present


def _listed(folder: Path, warnings: list[str], expected: bool) -> list[str] | None:
    """Names of the files that ``metadata.yaml`` lists; None without a usable one, which ``expected`` warns of."""
    metadata = folder / "metadata.yaml"
    if not metadata.is_file():
        if expected:
            warnings.append("metadata.yaml is missing (the recorder was not closed): read without it")
        return None
    try:
        names = read_yaml(metadata)["rosbag2_bagfile_information"]["relative_file_paths"]
        # before Foxy the paths held the folder's name
        return [Path(str(name)).name for name in names]
    except (InputError, KeyError, TypeError):
        warnings.append("metadata.yaml is damaged: read without it")
        return None


def _read_file(path: Path, contents: Contents) -> None:
    head = _magic(path)
    if not head:
        raise InputError(path, "empty")
    kind = _format(head)
    if kind is not None:
        _read_as(kind, path, contents)
    elif head.startswith(ZSTD_MAGIC):
        _read_compressed(path, contents)
    else:
        raise InputError(path, _not_a_bag(head))


def _read_as(kind: bytes, path: Path, contents: Contents) -> None:
    storage, salvage = _FORMATS[kind]
    if kind == ROS1_MAGIC:
        contents.encoding = "ros1"
    with _with_pending_writes(path, contents) as readable:
        try:
            read_whole(readable, storage, contents)
        except Incomplete:
            salvage(readable, contents)


def _read_compressed(path: Path, contents: Contents) -> None:
    """A file compressed as a whole (rosbag2's compression mode FILE)."""
    with tempfile.TemporaryDirectory() as folder:
        bare = Path(folder) / path.name.removesuffix(".zstd")
        packed = read_bytes(path, path.stat().st_size)
        unpacked, complete = inflate("zstd", packed, Budget(path, len(packed)))
        bare.write_bytes(unpacked)
        del packed, unpacked
        if not complete:
            contents.warnings.append(f"{path.name} is cut off or damaged")
        kind = _format(_magic(bare))
        if kind is None or kind == ROS1_MAGIC:
            raise InputError(path, "not a compressed rosbag2 file")
        _read_as(kind, bare, contents)


def _not_a_bag(head: bytes) -> str:
    if any(magic.startswith(head) for magic in _FORMATS):
        return "cut off before its first message"
    if head.startswith(b"#ROSBAG V1"):
        return "a ROS bag of format 1, which is not read: convert it with 'rosbag fix' first"
    if not head.strip(b"\0"):
        return "holds nothing but zeros"
    return (
        "not a recording (MCAP, sqlite3 or ROS 1 bag); bring other formats in with 'suspension-twin import'"
    )


# Complete files, read by rosbags


class Incomplete(Exception):
    """The file is damaged, or laid out in a way that ``rosbags`` does not read."""


_BUDGET: ContextVar[Budget | None] = ContextVar("budget", default=None)


def _limited(tables: dict[str, Callable[..., bytes]]) -> None:
    """Have ``rosbags`` decompress a chunk within the budget of the recording that is read; others as before."""

    def within(compression: str, plain: Callable[..., bytes]) -> Callable[..., bytes]:
        def decompress(data: bytes, *size: int) -> bytes:
            budget = _BUDGET.get()
            if budget is None:
                return plain(data, *size)
            found, complete = inflate(compression, data, budget)
            if not complete:
                raise Incomplete("a chunk is cut off or damaged")
            return found

        return decompress

    tables.update({name: within(name, plain) for name, plain in tables.items()})


# rosbags unpacks a chunk to whatever size it has, and offers no limit but these tables.
_limited(storage_mcap.DECOMPRESSORS)
_limited(rosbag1.decompressors)


def read_whole(path: Path, storage: str, contents: Contents) -> None:
    """Add the messages of a file to ``contents``; ``storage`` is ``mcap``, ``db3`` or ``bag``.

    Raises Incomplete, with ``contents`` unchanged, where the file cannot be read to its end, and TooLarge where it
    unpacks to more than it may.
    """
    # the reader puts the path of a database into a URI as it is
    name = Path(quote(str(path.resolve()))) if storage == "db3" else path
    reader = Ros1Reader(path) if storage == "bag" else Ros2Reader.STORAGE_PLUGINS[f".{storage}"](name)
    token = _BUDGET.set(contents.budget)
    try:
        if storage == "db3":
            _check_plain(path)
        reader.open()
        with closing(reader):
            connections = list(reader.connections)
            wanted = [c for c in connections if contents.wants(c.topic)]
            found = {c.id: RawTopic(c.msgtype) for c in wanted}
            for connection, stamp, data in reader.messages(wanted) if wanted else ():
                contents.budget.take(len(data) + _OVERHEAD)
                found[connection.id].add(stamp, data)
    except SuspensionTwinError:
        raise
    except Exception as error:  # damage shows as an exception of any kind, in rosbags or in a decompressor
        raise Incomplete(str(error)) from None
    finally:
        _BUDGET.reset(token)
    if sum(c.msgcount for c in wanted) != sum(len(topic.data) for topic in found.values()):
        raise Incomplete("holds another number of messages than its index")
    for connection in connections:
        encoding = "ros1"
        if isinstance(connection.ext, ConnectionExtRosbag2):
            encoding = connection.ext.serialization_format
            if connection.msgdef.format == MessageDefinitionFormat.MSG:
                contents.definitions[connection.msgtype] = connection.msgdef.data
        sink = contents.open_topic(connection.topic, connection.msgtype, encoding)
        if sink is not None:
            sink.stamps += found[connection.id].stamps
            sink.data += found[connection.id].data


def _check_plain(path: Path) -> None:
    """Raise Incomplete for a database whose tables are computed: a query on it may never end, or never stop giving.

    Views, virtual tables and generated columns are, and so is a topic that is listed a thousand times.
    """
    uri = f"file:{quote(str(path.resolve()))}?immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as database:
        for name in ("topics", "messages", "schema", "message_definitions"):
            row = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (name,)).fetchone()
            if row is not None and (row[0] != "table" or not str(row[1]).upper().startswith("CREATE TABLE")):
                raise Incomplete(f"its {name} are no plain table")
            if any(column[6] for column in database.execute(f"PRAGMA table_xinfo({name})")):
                raise Incomplete(f"its {name} are computed")
        rows, ids = database.execute("SELECT count(*), count(DISTINCT id) FROM topics").fetchone()
        if rows != ids:
            raise Incomplete("topics share a number")


@contextmanager
def _with_pending_writes(path: Path, contents: Contents) -> Iterator[Path]:
    """A database to read: ``path``, or a copy with the contents of its write-ahead log or rollback journal.

    A recorder that was killed leaves such a file beside the database; SQLite applies it on opening.
    """
    beside = [Path(f"{path}{ending}") for ending in ("-wal", "-journal")]
    pending = [file for file in beside if file.is_file() and file.stat().st_size > 0]
    if not pending:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        for source in (path, *pending):
            with open_file(source) as pages, copy.with_name(source.name).open("wb") as there:
                shutil.copyfileobj(pages, there)
        # where it is too damaged for SQLite its pages are salvaged
        with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as database:
            database.execute("PRAGMA journal_mode=DELETE").fetchone()
            database.execute("SELECT count(*) FROM topics").fetchone()
        contents.warnings.append(f"{path.name} was not closed by its recorder: read with {pending[0].name}")
        yield copy
