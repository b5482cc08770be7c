# SPDX-License-Identifier: Apache-2.0
"""Writing recordings: rosbag2 folders and bare files, MCAP, whole or not at all.

A recording is written beside its place under a hidden name and moved there when it is complete,
so that a name never holds half a recording.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, final

import numpy as np
import yaml
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.cdr import encode, ros2_types
from suspension_twin.drive.containers.contents import topic_name, type_name
from suspension_twin.drive.read import TYPES, Topics
from suspension_twin.drive.repair import nanoseconds
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError, WorkError

__all__ = ["BagWriter", "write_drive"]

#: What ROS 2 Jazzy's rosbag2 writes: metadata version and an offered quality of service.
_METADATA_VERSION = 9

#: ns: the seconds of a stamp are 32 bits long.
_LAST_STAMP = (1 << 31) * 1_000_000_000
_QOS: dict[str, Any] = {
    "history": "keep_last",
    "depth": 10,
    "reliability": "reliable",
    "durability": "volatile",
    "deadline": {"sec": 9223372036, "nsec": 854775807},
    "lifespan": {"sec": 9223372036, "nsec": 854775807},
    "liveliness": "automatic",
    "liveliness_lease_duration": {"sec": 9223372036, "nsec": 854775807},
    "avoid_ros_namespace_conventions": False,
}


@final
class BagWriter:
    """Writes one recording; use it as a context manager.

    ``path`` is the rosbag2 folder to make, or a bare file where it ends in ``.mcap``. Messages may
    be given topic by topic: they are merged by time when the writer is flushed or closed. Leaving
    the context by an exception leaves nothing behind.

    Raises InputError where ``path`` is taken (``overwrite`` replaces a recording, and nothing but
    a recording) or would be taken for a ROS 1 bag, WorkError where it cannot be written.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self.bare = self.path.suffix == ".mcap"
        self.overwrite = overwrite
        self._store = ros2_types()
        self._counts: dict[str, int] = {}
        self._channels: dict[str, tuple[int, str]] = {}
        self._schemas: dict[str, int] = {}
        self._pending: list[tuple[int, NDArray[np.int64], list[bytes]]] = []
        self._span: tuple[int, int] | None = None
        self._check()

    def _check(self) -> None:
        if self.path.suffix == ".bag":
            raise InputError(
                self.path, "a folder of this name is taken for a ROS 1 bag: choose one without .bag"
            )
        if not self.path.name:
            raise InputError(self.path, "names no recording")
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
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", dir=self.path.parent))
            self._folder.chmod(0o755)
            name = self.path.name if self.bare else f"{self.path.name}_0.mcap"
            self._file = self._folder / name
            self._stream: BinaryIO = self._file.open("wb")
        except OSError as error:
            raise WorkError(f"{self.path}: {error.strerror or 'cannot be written'}") from None
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start("ros2", library=f"suspension_twin {_version()}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except OSError as failure:
            raise WorkError(f"{self.path}: {failure.strerror or 'cannot be written'}") from None
        finally:
            self._stream.close()
            shutil.rmtree(self._folder, ignore_errors=True)

    def write(
        self,
        topic: str,
        msgtype: str,
        t: Floats | NDArray[np.int64],
        values: Mapping[str, Any],
        *,
        frame: str = "",
    ) -> None:
        """Add messages of one type: ``t`` (n,) s since the epoch, or ns where its type is integer.

        ``values`` maps dotted field names to what they hold, one for all messages or one row for
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
        topic = topic_name(topic)
        channel = self._channel(topic, type_name(msgtype))
        if len(messages):
            # the time of recording never goes back, so that a reader keeps the order
            recorded = np.maximum(np.maximum.accumulate(stamps), 0)
            self._pending.append((channel, recorded, list(messages)))
            self._counts[topic] += len(messages)

    def flush(self) -> None:
        """Write out what was given so far; messages given later are recorded after it."""
        if not self._pending:
            return
        stamps = np.concatenate([block[1] for block in self._pending])
        channels = np.concatenate([np.full(len(data), channel) for channel, _, data in self._pending])
        messages = [message for _, _, data in self._pending for message in data]
        self._pending.clear()
        order = np.argsort(stamps, kind="stable")
        first, last = int(stamps[order[0]]), int(stamps[order[-1]])
        self._span = (
            (first, last) if self._span is None else (min(first, self._span[0]), max(last, self._span[1]))
        )
        add = self._writer.add_message
        rows = zip(order.tolist(), stamps[order].tolist(), channels[order].tolist(), strict=True)
        for i, stamp, channel in rows:
            add(channel, stamp, messages[i], stamp)

    def _channel(self, topic: str, msgtype: str) -> int:
        if topic in self._channels:
            channel, known = self._channels[topic]
            if known != msgtype:
                raise ValueError(f"{topic} is {known}, not {msgtype}")
            return channel
        if msgtype not in self._schemas:
            definition, _ = self._store.generate_msgdef(msgtype, ros_version=2)
            self._schemas[msgtype] = self._writer.register_schema(msgtype, "ros2msg", definition.encode())
        metadata = {
            "offered_qos_profiles": _yaml([_QOS]).strip(),
            "topic_type_hash": self._store.hash_rihs01(msgtype),
        }
        channel = self._writer.register_channel(topic, "cdr", self._schemas[msgtype], metadata)
        self._channels[topic] = (channel, msgtype)
        self._counts[topic] = 0
        return channel

    def _finish(self) -> None:
        self.flush()
        information = self._information()
        self._writer.add_metadata("rosbag2", {"serialized_metadata": _yaml(information)})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        if self.bare:
            if self.overwrite:
                os.replace(self._file, self.path)
            else:
                _move(self._file, self.path)
            return
        text = _yaml({"rosbag2_bagfile_information": information})
        (self._folder / "metadata.yaml").write_text(text, encoding="utf-8")
        if self.overwrite and self.path.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", dir=self.path.parent))
            os.rename(self.path, old / "old")
            os.rename(self._folder, self.path)
            shutil.rmtree(old, ignore_errors=True)
        else:
            _move(self._folder, self.path)

    def _information(self) -> dict[str, Any]:
        start, end = self._span or (0, 0)
        count = sum(self._counts.values())
        span = {
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": count,
        }
        return {
            "version": _METADATA_VERSION,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": msgtype,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [_QOS],
                        "type_description_hash": self._store.hash_rihs01(msgtype),
                    },
                    "message_count": self._counts[topic],
                }
                for topic, (_, msgtype) in self._channels.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file.name],
            "files": [{"path": self._file.name, **span}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }


class _Plain(yaml.SafeDumper):
    """Repeats what occurs twice instead of referring to it, as rosbag2 does."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _yaml(data: Any) -> str:
    return yaml.dump(data, Dumper=_Plain, sort_keys=False)


def _part_of_bag(path: Path) -> bool:
    return path.name == "metadata.yaml" or path.suffix in (".mcap", ".db3", ".zstd", ".db3-wal", ".db3-shm")


def _move(source: Path, target: Path) -> None:
    if target.exists():  # made by someone else while this was written
        raise InputError(target, "exists already: choose another name or remove it")
    os.rename(source, target)


def _version() -> str:
    try:
        return version("suspension-twin")
    except PackageNotFoundError:  # a source tree that was never installed, as under colcon
        return "0"


def write_drive(
    drive: Drive, path: str | Path, *, topics: Topics | None = None, overwrite: bool = False
) -> None:
    """Write a drive as a rosbag2 folder (or a bare ``.mcap`` file): the contract's topics and types.

    Raises InputError where ``path`` is taken, WorkError where it cannot be written.
    """
    topics = topics or Topics()
    with BagWriter(path, overwrite=overwrite) as bag:
        imu, fix, velocity, heading = drive.imu, drive.fix, drive.velocity, drive.heading
        values = {
            **_vector("linear_acceleration", imu.specific_force),
            **_vector("angular_velocity", imu.angular_rate),
        }
        if imu.orientation is None:
            # REP-145: this sensor reports no orientation
            values |= {"orientation.w": 1.0, "orientation_covariance": [-1.0] + [0.0] * 8}
        else:
            values |= _vector("orientation", imu.orientation, "xyzw")
        bag.write(topics.imu, TYPES["imu"][0], imu.t, values, frame=imu.frame)

        covariance = np.zeros((len(fix), 9))
        known = np.asarray(np.isfinite(fix.sigma).all(axis=1))
        covariance[:, [0, 4, 8]] = np.where(known[:, None], fix.sigma, 0.0) ** 2
        values = {
            "latitude": fix.latitude,
            "longitude": fix.longitude,
            "altitude": fix.altitude,
            "status.status": fix.status,
            "status.service": 1,
            "position_covariance": covariance,
            "position_covariance_type": np.where(known, 2, 0),  # diagonal known, or unknown
        }
        bag.write(topics.fix, TYPES["fix"][0], fix.t, values, frame=fix.frame)
        values = _vector("twist.linear", velocity.enu)
        bag.write(topics.vel, TYPES["vel"][0], velocity.t, values, frame="map")
        if heading is not None:
            values = {"quaternion.z": np.sin(heading.yaw / 2), "quaternion.w": np.cos(heading.yaw / 2)}
            bag.write(topics.heading, TYPES["heading"][0], heading.t, values, frame="map")


def _vector(prefix: str, rows: Floats, names: str = "xyz") -> dict[str, Any]:
    return {f"{prefix}.{name}": rows[:, i] for i, name in enumerate(names)}
