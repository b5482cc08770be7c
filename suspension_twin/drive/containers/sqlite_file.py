# SPDX-License-Identifier: Apache-2.0
"""rosbag2 recordings in sqlite3 files, read as far as the file goes.

The file is opened immutable; where it is cut off or damaged its pages are read one by one. A
recording that was not closed has its last messages in a ``-wal`` or ``-journal`` file beside it;
then a copy is opened, so that SQLite can bring it up to date without touching the recording.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from suspension_twin.drive.containers.contents import Contents, RawTopic
from suspension_twin.drive.containers.inflate import ZSTD_MAGIC, inflate
from suspension_twin.drive.containers.sqlite_pages import message_rows
from suspension_twin.errors import InputError

__all__ = ["MAGIC", "read_sqlite"]

MAGIC = b"SQLite format 3\0"


def read_sqlite(path: Path, contents: Contents) -> None:
    """Add the messages of one file to ``contents``; a warning where it is not whole.

    Raises InputError if it is no recording or too little of it is left to find its topics.
    """
    pending = [beside for beside in (Path(f"{path}-wal"), Path(f"{path}-journal")) if _holds(beside)]
    partial = path.stat().st_size % _page_size(path)
    if not pending and not partial:
        _read(path, path, contents, immutable=True)
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        for source in (path, *pending):
            shutil.copyfile(source, copy.with_name(source.name))
        if partial and not pending:
            # SQLite would take the half page at the end for a whole one filled up with zeros
            os.truncate(copy, path.stat().st_size - partial)
        _read(copy, path, contents, immutable=not pending)
    if pending:
        contents.warnings.append(f"{path.name} was not closed by its recorder: read with {pending[0].name}")


def _page_size(path: Path) -> int:
    with path.open("rb") as file:
        file.seek(16)
        size = int.from_bytes(file.read(2), "big")
    return 65536 if size == 1 else max(size, 512)


def _holds(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _read(opened: Path, path: Path, contents: Contents, *, immutable: bool) -> None:
    uri = f"file:{quote(str(opened.resolve()))}?{'immutable=1' if immutable else 'mode=rw'}"
    with closing(sqlite3.connect(uri, uri=True)) as database:
        # a file shorter than its header says is refused as a whole otherwise
        database.execute("PRAGMA writable_schema=ON")
        database.text_factory = lambda raw: raw.decode("utf-8", "replace")
        try:
            topics = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except sqlite3.Error as error:
            if "no such table" in str(error):
                raise InputError(path, "a database, but not a rosbag2 recording (it has no topics)") from None
            raise InputError(path, f"cut off or damaged before its topics ({error})") from None
        sinks: dict[int, RawTopic] = {}
        for number, name, msgtype, encoding in topics:
            if encoding != "cdr":
                contents.open_topic(str(name), f"{encoding} messages")
                continue
            sink = contents.open_topic(str(name), str(msgtype))
            if sink is not None and isinstance(number, int):
                sinks[number] = sink
        _definitions(database, contents)
        lost = _messages(database, sinks)
    if lost:
        _salvage(opened, sinks)
        count = sum(len(sink.data) for sink in sinks.values())
        contents.warnings.append(f"{path.name} is cut off or damaged: {count} whole messages were read")
    for sink in sinks.values():
        if sink.data and sink.data[0].startswith(ZSTD_MAGIC):
            sink.data = [inflate("zstd", data)[0] for data in sink.data]


def _definitions(database: sqlite3.Connection, contents: Contents) -> None:
    try:
        rows = database.execute(
            "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
        )
        contents.definitions.update({str(name): str(text) for name, text in rows})
    except sqlite3.Error:
        pass  # written by a distribution before Iron, or cut off: the standard types need none


def _messages(database: sqlite3.Connection, sinks: dict[int, RawTopic]) -> bool:
    """Fill the sinks; whether something is lost."""
    where = ",".join(map(str, sinks))
    query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({where}) ORDER BY id"
    try:
        for number, stamp, data in database.execute(query):
            if isinstance(stamp, int) and isinstance(data, bytes):
                sinks[number].stamps.append(stamp)
                sinks[number].data.append(data)
    except sqlite3.Error:
        return True
    return False


def _salvage(path: Path, sinks: dict[int, RawTopic]) -> None:
    """Fill the sinks anew with what the pages hold."""
    rows = {row: (topic, stamp, data) for row, topic, stamp, data in message_rows(path) if topic in sinks}
    for sink in sinks.values():
        sink.stamps.clear()
        sink.data.clear()
    for row in sorted(rows):
        topic, stamp, data = rows[row]
        sinks[topic].stamps.append(stamp)
        sinks[topic].data.append(data)
