# SPDX-License-Identifier: Apache-2.0
"""Complete recordings (MCAP, sqlite3, ROS 1), read by ``rosbags`` within the budget of the recording.

``rosbags`` refuses a file with any damage; :mod:`suspension_twin.drive.recording` then salvages it record
by record, as fast but without index, order and check sums to rely on.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.rosbag2 import storage_mcap

from suspension_twin.drive.budget import Budget
from suspension_twin.drive.containers.contents import Contents, RawTopic
from suspension_twin.drive.containers.inflate import inflate
from suspension_twin.errors import SuspensionTwinError

__all__ = ["Incomplete", "read_whole", "with_pending_writes"]


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


# rosbags makes of a chunk whatever it unpacks to, and offers no limit but these tables of its.
_limited(storage_mcap.DECOMPRESSORS)
_limited(rosbag1.decompressors)

#: Of memory that a message takes beside its bytes.
_OVERHEAD: Final = 64


def read_whole(path: Path, storage: str, contents: Contents) -> None:
    """Add the messages of a file to ``contents``; ``storage`` is ``mcap``, ``db3`` or ``bag``.

    Raises Incomplete, with ``contents`` unchanged, where the file cannot be read to its end, and TooLarge where it
    unpacks to more than it may.
    """
    reader: Any
    if storage == "bag":
        reader = Ros1Reader(path)
    else:
        # the reader puts the path of a database into a URI as it is
        name = Path(quote(str(path.resolve()))) if storage == "db3" else path
        reader = Ros2Reader.STORAGE_PLUGINS[f".{storage}"](name)
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
                topic = found[connection.id]
                contents.budget.take(len(data) + _OVERHEAD)
                topic.stamps.append(stamp)
                topic.data.append(data)
    except SuspensionTwinError:
        raise
    except Exception as error:  # damage shows as an exception of any kind, in rosbags or in a decompressor
        raise Incomplete(str(error)) from None
    finally:
        _BUDGET.reset(token)
    if sum(c.msgcount for c in wanted) != sum(len(topic.data) for topic in found.values()):
        raise Incomplete("holds another number of messages than its index")
    for connection in connections:
        if connection.msgdef.format == MessageDefinitionFormat.MSG and storage != "bag":
            contents.definitions[connection.msgtype] = connection.msgdef.data
        encoding = "ros1" if storage == "bag" else connection.ext.serialization_format
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
def with_pending_writes(path: Path, contents: Contents) -> Iterator[Path]:
    """A database to read: ``path``, or a copy with what its write-ahead log or rollback journal holds.

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
            shutil.copyfile(source, copy.with_name(source.name))
        try:
            with closing(sqlite3.connect(copy)) as database:
                database.execute("PRAGMA journal_mode=DELETE").fetchone()
                database.execute("SELECT count(*) FROM topics").fetchone()
        except sqlite3.Error:
            pass  # too damaged for SQLite: its pages are salvaged
        contents.warnings.append(f"{path.name} was not closed by its recorder: read with {pending[0].name}")
        yield copy
