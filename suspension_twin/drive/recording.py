# SPDX-License-Identifier: Apache-2.0
"""Recordings on disk: which format a path is in, and its raw messages whatever the format.

The format is recognised by a file's first bytes, never by its name: a rosbag2 folder called
``drive.bag`` is a rosbag2 folder.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

from suspension_twin.drive.budget import Budget, TooLarge
from suspension_twin.drive.cdr import Decoded, decode, ros1_types, types_with
from suspension_twin.drive.containers.contents import Contents, topic_name
from suspension_twin.drive.containers.inflate import ZSTD_MAGIC, Inflated
from suspension_twin.drive.containers.salvage_mcap import MAGIC as MCAP_MAGIC
from suspension_twin.drive.containers.salvage_mcap import salvage_mcap
from suspension_twin.drive.containers.salvage_ros1 import MAGIC as ROS1_MAGIC
from suspension_twin.drive.containers.salvage_ros1 import salvage_ros1
from suspension_twin.drive.containers.salvage_sqlite import MAGIC as SQLITE_MAGIC
from suspension_twin.drive.containers.salvage_sqlite import salvage_sqlite
from suspension_twin.drive.containers.whole import Incomplete, read_whole, with_pending_writes
from suspension_twin.errors import InputError
from suspension_twin.files import read_yaml, reading

__all__ = ["decode_topic", "is_recording", "read_recording"]

#: By a file's first bytes: what rosbags calls its storage, and what reads it where it is damaged.
_FORMATS = {
    MCAP_MAGIC: ("mcap", salvage_mcap),
    SQLITE_MAGIC: ("db3", salvage_sqlite),
    ROS1_MAGIC: ("bag", salvage_ros1),
}
_BAG_NAME = re.compile(r"\.(mcap|db3)(\.zstd)?$")


def _magic(path: Path) -> bytes:
    with path.open("rb") as file:
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


def read_recording(path: str | Path, topics: Collection[str] | None = None) -> Contents:
    """Raw messages of the ``topics`` wanted (all if None), in the order they were recorded.

    ``path`` is a rosbag2 folder (MCAP or sqlite3; ``metadata.yaml`` may be missing), a bare
    ``.mcap`` or ``.db3`` file, or a ROS 1 bag. What is cut off or damaged is left out, with a line
    in ``warnings``. Raises InputError where there is nothing to read.
    """
    path = Path(path)
    if path.name == "metadata.yaml":
        path = path.parent
    wanted = None if topics is None else {topic_name(name) for name in topics}
    with reading(path, "a recording"):
        return _read(path, Contents("cdr", wanted))


def _read(path: Path, contents: Contents) -> Contents:
    if path.is_dir():
        files = _files(path, contents.warnings)
        if not files:
            raise InputError(path, _no_recording(path))
    else:
        files = [path]
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


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def _files(folder: Path, warnings: list[str]) -> list[Path]:
    """Files of a rosbag2 folder, in the order they were written."""
    present = sorted((p for p in folder.iterdir() if _BAG_NAME.search(p.name) and p.is_file()), key=_natural)
    listed = _listed(folder, warnings)
    if listed is None:
        return present
    files = [folder / name for name in listed if (folder / name).is_file()]
    for name in listed:
        if not (folder / name).is_file():
            bare = folder / name.removesuffix(".zstd")
            if bare.is_file():
                files.append(bare)
            elif len(present) == 1 and len(listed) == 1:
                return present  # the file was renamed with the recording
            else:
                warnings.append(f"{name} is named in metadata.yaml and missing")
    files += [path for path in present if path not in files and path.suffix != ".zstd"]
    return files or present


def _listed(folder: Path, warnings: list[str]) -> list[str] | None:
    metadata = folder / "metadata.yaml"
    if not metadata.is_file():
        if any(_BAG_NAME.search(p.name) for p in folder.iterdir()):
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
    if path.exists() and not path.is_file():
        raise InputError(path, "is not a regular file")
    head = _magic(path)
    if not head:
        raise InputError(path, "empty")
    kind = _format(head)
    if kind is None and head.startswith(ZSTD_MAGIC):
        _read_compressed(path, contents)
        return
    if kind is None:
        raise InputError(path, _not_a_bag(path, head))
    if kind == ROS1_MAGIC:
        contents.encoding = "ros1"
    _read_as(kind, path, contents)


def _read_as(kind: bytes, path: Path, contents: Contents) -> None:
    storage, salvage = _FORMATS[kind]
    with with_pending_writes(path, contents) as readable:
        try:
            read_whole(readable, storage, contents)
        except Incomplete:
            salvage(readable, contents)


def _read_compressed(path: Path, contents: Contents) -> None:
    """A file compressed as a whole (rosbag2's compression mode FILE)."""
    with tempfile.TemporaryDirectory() as folder:
        bare = Path(folder) / path.name.removesuffix(".zstd")
        with path.open("rb") as packed, bare.open("wb") as out:
            pieces = Inflated("zstd", packed, Budget(path, path.stat().st_size))
            for piece in pieces:
                out.write(piece)
        if not pieces.complete:
            contents.warnings.append(f"{path.name} is cut off or damaged")
        kind = _format(_magic(bare))
        if kind is None or kind == ROS1_MAGIC:
            raise InputError(path, "not a compressed rosbag2 file")
        _read_as(kind, bare, contents)


def _not_a_bag(path: Path, head: bytes) -> str:
    if any(magic.startswith(head) for magic in _FORMATS):
        return "cut off before its first message"
    if head.startswith(b"#ROSBAG V1"):
        return "a ROS bag of format 1, which is not read: convert it with 'rosbag fix' first"
    if not head.strip(b"\0"):
        return "holds nothing but zeros"
    return (
        "not a recording (MCAP, sqlite3 or ROS 1 bag); bring other formats in with 'suspension-twin import'"
    )


def decode_topic(contents: Contents, name: str) -> list[Decoded]:
    """Messages of one topic as arrays, a group for each byte layout (usually one).

    Empty where the topic has no messages; damaged ones are left out with a warning.
    """
    topic = contents.topics.get(topic_name(name))
    if topic is None or not topic.data:
        return []
    if contents.encoding == "ros1":
        store = ros1_types()
    else:
        own = {k: text for k, text in contents.definitions.items() if k == topic.msgtype}
        store = types_with(own)
    groups = list(decode(store, topic.msgtype, topic.data, contents.encoding))
    lost = len(topic.data) - sum(group.index.size for group in groups)
    if lost:
        contents.warnings.append(
            f"{topic_name(name)}: {lost} of {len(topic.data)} messages are damaged: left out"
        )
    return groups
