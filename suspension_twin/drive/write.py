# SPDX-License-Identifier: Apache-2.0
"""Writing recordings: rosbag2 folders and bare files, MCAP, whole or not at all.

A recording is written beside its place under a hidden name and moved there when it is complete,
so that a name never holds half a recording. A live one is not made a second time: it stands in its
place from the beginning, and everything recorded so far stays, whatever happens.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter

from suspension_twin.arrays import Floats
from suspension_twin.drive.cdr import encode, ros2_types, types_with
from suspension_twin.drive.checks import nanoseconds
from suspension_twin.drive.contents import Contents, topic_name, type_name
from suspension_twin.drive.read import TYPES, Topics
from suspension_twin.drive.types import Drive, FixData, ImuData, Samples, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.files import check_writable, remove_leftovers, synchronise, temporary_beside, writing

__all__ = ["BagWriter", "write_contents", "write_drive", "write_samples"]

#: ns: the seconds of a stamp are 32 bits long.
_LAST_STAMP = (1 << 31) * 1_000_000_000
#: s after which a live recording goes to the disk: the loss by a power cut, against one more write a second.
_KEEP = 1.0


@final
class BagWriter:
    """Writes one recording; use it as a context manager.

    ``path`` is the rosbag2 folder to make, or a bare file where it ends in ``.mcap``. Messages may
    be given topic by topic: they are merged by time when the writer is flushed or closed. Leaving
    the context by an exception leaves nothing behind; a ``live`` recording keeps all that was flushed, and
    all of it is on the disk about a second later.

    ``definitions`` (type name to its ``.msg`` text) adds types to those of ROS 2.

    Raises InputError where ``path`` is taken (``overwrite`` replaces a recording, and nothing but
    a recording) or would be taken for a ROS 1 bag, WorkError where it cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        live: bool = False,
        definitions: Mapping[str, str] | None = None,
    ) -> None:
        self.path = Path(path)
        self.bare = self.path.suffix == ".mcap"
        self.overwrite = overwrite
        self.live = live
        self._kept = time.monotonic()
        self._syncing: threading.Thread | None = None
        self._store = types_with(definitions) if definitions else ros2_types()
        self._connections: dict[str, Connection] = {}
        self._pending: list[tuple[Connection, NDArray[np.int64], list[bytes]]] = []
        self._check()

    def _check(self) -> None:
        if self.path.suffix == ".bag":
            raise InputError(
                self.path, "a folder of this name is taken for a ROS 1 bag: choose one without .bag"
            )
        if not self.path.name:
            raise InputError(self.path, "names no recording")
        check_writable(self.path)
        if not self.path.exists():
            return
        if not self.overwrite:
            raise InputError(self.path, "exists already: choose another name or remove it")
        if self.path.is_dir() != (not self.bare):
            raise InputError(self.path, f"is {'a folder' if self.bare else 'a file'}, not overwritten")
        if not self.bare:
            strange = [p.name for p in self.path.iterdir() if not _part_of_bag(p)]
            if strange:
                raise InputError(
                    self.path, f"holds {strange[0]}, which is no part of a recording: not overwritten"
                )

    def __enter__(self) -> BagWriter:
        self._hidden = temporary_beside(self.path)
        with ExitStack() as undo, writing(self.path):
            undo.callback(shutil.rmtree, self._hidden, ignore_errors=True)
            undo.callback(self._put_back)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(self.path)
            self._hidden.mkdir()
            in_place = self.live and not self.bare
            if self.live and self.path.exists():
                os.rename(self.path, self._before)
            self._bag = Writer(
                self.path if in_place else self._hidden / (self.path.stem if self.bare else self.path.name),
                version=9,  # of ROS 2 Jazzy
                storage_plugin=StoragePlugin.MCAP,
            )
            self._bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._bag.open()
            if self.live and self.bare:
                os.rename(self._storage.path, self.path)
            self._describe()
            undo.pop_all()
        return self

    @property
    def _before(self) -> Path:
        """Place of the replaced recording in the meantime."""
        return self._hidden / "replaced"

    @property
    def _storage(self) -> McapWriter:
        assert isinstance(self._bag.storage, McapWriter)
        return self._bag.storage

    def _put_back(self) -> None:
        if self._before.exists():
            with suppress(OSError):
                os.rename(self._before, self.path)

    def discard(self) -> None:
        """Remove it and put a replaced recording back; to be called before leaving the context."""
        with suppress(Exception):
            self._bag.abort()
        if self.live:
            with suppress(OSError):
                (Path.unlink if self.bare else shutil.rmtree)(self.path)
            self._put_back()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            with writing(self.path):
                if self.live and self._bag.storage is not None:
                    self._end()
                elif kind is None:
                    self._finish()
                else:
                    with suppress(Exception):  # the error that ended the block is reported
                        self._bag.abort()
                if isinstance(error, OSError):
                    raise error
        finally:
            shutil.rmtree(self._hidden, ignore_errors=True)

    def write(
        self,
        topic: str,
        msgtype: str,
        t: Floats | NDArray[np.int64],
        values: Mapping[str, ArrayLike],
        *,
        frame: str = "",
    ) -> None:
        """Add messages of one type: ``t`` (n,) s since the epoch, or ns where its type is integer.

        ``values`` maps dotted field names to their contents, one for all messages or one row for
        each (strings and lists of strings: the same in all). ``t`` becomes ``header.stamp`` where
        the type has a header, with ``frame`` as its frame, and the time of recording. Messages
        keep the order given, also where stamps go back.
        """
        msgtype = type_name(msgtype)
        ns = np.asarray(t) if np.issubdtype(np.asarray(t).dtype, np.integer) else nanoseconds(np.asarray(t))
        ns = ns.astype(np.int64)
        if ns.size and (ns.min() < 0 or ns.max() >= _LAST_STAMP):
            raise InputError(self.path, topic, "stamps before 1970 or after 2038 cannot be written")
        values = dict(values)
        fields = dict(self._store.fielddefs[msgtype][1])
        if "header" in fields:
            values.setdefault("header.stamp.sec", ns // 1_000_000_000)
            values.setdefault("header.stamp.nanosec", ns % 1_000_000_000)
            values.setdefault("header.frame_id", frame)
        self.write_raw(topic, msgtype, ns, encode(self._store, msgtype, ns.size, values))

    def write_raw(
        self, topic: str, msgtype: str, stamps: NDArray[np.int64], messages: Sequence[bytes]
    ) -> None:
        """Add messages that are CDR already; ``stamps`` (n,) ns."""
        topic, msgtype = topic_name(topic), type_name(msgtype)
        connection = self._connections.get(topic)
        if connection is None:
            connection = self._bag.add_connection(topic, msgtype, typestore=self._store)
            self._connections[topic] = connection
        if connection.msgtype != msgtype:
            raise ValueError(f"{topic} is {connection.msgtype}, not {msgtype}")
        if len(messages):
            # the time of recording never goes back, so that a reader keeps the order
            recorded = np.maximum(np.maximum.accumulate(stamps), 0)
            self._pending.append((connection, recorded, list(messages)))

    def flush(self) -> None:
        """Write out all messages given so far; later ones are recorded after them."""
        if not self._pending:
            return
        order = np.argsort(np.concatenate([stamps for _, stamps, _ in self._pending]), kind="stable")
        rows = [
            (connection, stamp, message)
            for connection, stamps, messages in self._pending
            for stamp, message in zip(stamps.tolist(), messages, strict=True)
        ]
        self._pending.clear()
        for i in order.tolist():
            self._bag.write(*rows[i])
        if self.live and time.monotonic() > self._kept + _KEEP:
            self._keep()

    def _keep(self) -> None:
        """Hand all that was flushed to the disk, which takes its time in a thread of its own."""
        self._kept = time.monotonic()
        storage = self._storage
        if storage.chunk.msgs:
            storage.close_chunk()
        storage.bio.flush()
        self._describe()
        if self._syncing is None or not self._syncing.is_alive():
            self._syncing = threading.Thread(target=_synchronised, args=(storage.bio.fileno(),), daemon=True)
            self._syncing.start()

    def _describe(self) -> None:
        """Write ``metadata.yaml`` of what is there, so that a live folder is a recording at any moment.

        The writer describes a recording when it closes it: a copy of it does, whose storage stays open.
        """
        if self.live and not self.bare:
            described = copy(self._bag)
            described.storage = _Open(self._storage.path)  # type: ignore[assignment]
            described.close()

    def _end(self) -> None:
        """Finish a live recording in its place; on failure the messages written so far stay."""
        if self._syncing is not None:
            self._syncing.join()
        self.flush()
        self._bag.close()
        for file in [self.path] if self.bare else self.path.iterdir():
            synchronise(file)
        with suppress(OSError):
            synchronise(self.path.parent)

    def _finish(self) -> None:
        self.flush()
        self._bag.close()
        written = self._bag.path
        for file in written.iterdir():
            synchronise(file)
        if self.bare:
            (written,) = written.glob("*.mcap")
        if self.path.exists():
            if not self.overwrite:  # made by someone else while this was written
                raise InputError(self.path, "exists already: choose another name or remove it")
            if not self.bare:  # a folder does not take another's place: for an instant there is none
                os.rename(self.path, self._before)
        try:
            os.replace(written, self.path)
        except OSError:
            self._put_back()
            raise
        with suppress(OSError):
            synchronise(self.path.parent)


@dataclass(frozen=True)
class _Open:
    """The place of a storage that is not closed yet."""

    path: Path

    def close(self, version: int, metadata: str) -> None:
        """Leave it open."""


def _synchronised(file: int) -> None:
    with suppress(OSError):  # the next write reports it
        os.fsync(file)


def _part_of_bag(path: Path) -> bool:
    return path.name == "metadata.yaml" or path.suffix in (".mcap", ".db3", ".zstd", ".db3-wal", ".db3-shm")


def write_drive(
    drive: Drive, path: str | Path, *, topics: Topics | None = None, overwrite: bool = False
) -> None:
    """Write a drive as a rosbag2 recording with the types of the contract.

    Parameters
    ----------
    drive : Drive
        The drive.
    path : str or Path
        A folder to make, or a bare file where it ends in ``.mcap``.
    topics : Topics, optional
        Names of the topics.
    overwrite : bool
        Replace a recording that is there (and nothing but a recording).

    Raises
    ------
    InputError
        ``path`` exists, or would be taken for a ROS 1 bag.
    WorkError
        It cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from suspension_twin.drive.types import cut
    >>> from suspension_twin.drive.read import read_drive
    >>> drive = read_drive("bags/bump_15kmh")
    >>> first = cut(drive, drive.imu.t[0], drive.imu.t[0] + 5.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_drive(first, f"{folder}/first")
    ...     len(read_drive(f"{folder}/first").imu) == len(first.imu)
    True
    """
    topics = topics or Topics()
    with BagWriter(path, overwrite=overwrite) as bag:
        for samples in (drive.imu, drive.fix, drive.velocity, drive.heading):
            if samples is not None:
                write_samples(bag, samples, topics)


def write_contents(contents: Contents, path: str | Path, *, overwrite: bool = False) -> None:
    """Write the raw messages of a recording as another one, in CDR; topics of unknown types are left out.

    ``contents.warnings`` gets a line for each topic and message that cannot be written.
    """
    store = types_with(contents.definitions)
    with BagWriter(path, overwrite=overwrite, definitions=contents.definitions) as bag:
        for name, topic in list(contents.topics.items()):
            stamps, data = topic.stamps, topic.data
            if topic.msgtype not in store.fielddefs:
                contents.warnings.append(
                    f"{name}: {len(data)} messages of the unknown type {topic.msgtype}: left out"
                )
                del contents.topics[name]
                continue
            if contents.encoding == "ros1":
                stamps, data = [], []
                for stamp, message in zip(topic.stamps, topic.data, strict=True):
                    with suppress(Exception):  # damaged: rosbags raises whatever it meets
                        data.append(bytes(store.ros1_to_cdr(message, topic.msgtype)))
                        stamps.append(stamp)
                if lost := len(topic.data) - len(data):
                    contents.warnings.append(
                        f"{name}: {lost} of {len(topic.data)} messages are damaged: left out"
                    )
            bag.write_raw(name, topic.msgtype, np.array(stamps, dtype=np.int64), data)


def write_samples(bag: BagWriter, samples: Samples, topics: Topics) -> None:
    """Add samples of one kind to a recording, as messages of the type of the contract, on the topic of their kind."""
    if isinstance(samples, ImuData):
        _write_imu(bag, samples, topics.imu)
    elif isinstance(samples, FixData):
        _write_fixes(bag, samples, topics.fix)
    elif isinstance(samples, VelocityData):
        bag.write(topics.vel, TYPES["vel"][0], samples.t, _vector("twist.linear", samples.enu), frame="map")
    else:
        values = {"quaternion.z": np.sin(samples.yaw / 2), "quaternion.w": np.cos(samples.yaw / 2)}
        bag.write(topics.heading, TYPES["heading"][0], samples.t, values, frame="map")


def _write_imu(bag: BagWriter, imu: ImuData, topic: str) -> None:
    values: dict[str, ArrayLike] = {
        **_vector("linear_acceleration", imu.specific_force),
        **_vector("angular_velocity", imu.angular_rate),
    }
    if imu.orientation is None:
        # REP-145: this sensor reports no orientation
        values |= {"orientation.w": 1.0, "orientation_covariance": [-1.0] + [0.0] * 8}
    else:
        values |= _vector("orientation", imu.orientation, "xyzw")
    bag.write(topic, TYPES["imu"][0], imu.t, values, frame=imu.frame)


def _write_fixes(bag: BagWriter, fix: FixData, topic: str) -> None:
    covariance = np.zeros((len(fix), 9))
    known = np.asarray(np.isfinite(fix.sigma[:, :2]).all(axis=1))
    covariance[:, [0, 4, 8]] = np.where(known[:, None], np.nan_to_num(fix.sigma), 0.0) ** 2
    values: dict[str, ArrayLike] = {
        "latitude": fix.latitude,
        "longitude": fix.longitude,
        "altitude": fix.altitude,
        "status.status": fix.status,
        "status.service": 1,
        "position_covariance": covariance,
        "position_covariance_type": np.where(known, 2, 0),  # diagonal known, or unknown
    }
    bag.write(topic, TYPES["fix"][0], fix.t, values, frame=fix.frame)


def _vector(prefix: str, rows: Floats, names: str = "xyz") -> dict[str, ArrayLike]:
    return {f"{prefix}.{name}": rows[:, i] for i, name in enumerate(names)}
