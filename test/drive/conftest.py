# SPDX-License-Identifier: Apache-2.0
"""Drives and bags for the tests of recorded data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer as Ros2Writer

from suspension_twin.drive.cdr import ros1_types, ros2_types
from suspension_twin.drive.contents import Contents
from suspension_twin.drive.recording import read_recording
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.drive.write import write_drive

START = 1_700_000_000.0


def make_drive(samples: int = 1500, *, seed: int = 0, heading: bool = True) -> Drive:
    """A drive of random but plausible numbers at 100 Hz, with fixes and velocities at 10 Hz."""
    rng = np.random.default_rng(seed)
    t = START + np.arange(samples) / 100
    tf = START + np.arange(max(samples // 10, 1)) / 10
    m = tf.size
    orientation = rng.normal(size=(samples, 4))
    orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
    return Drive(
        name="made",
        imu=ImuData(
            t,
            rng.normal(size=(samples, 3)) + np.array([0.0, 0.0, 9.81]),
            rng.normal(size=(samples, 3)),
            orientation,
        ),
        fix=FixData(
            tf,
            47.4 + rng.normal(size=m) * 1e-3,
            19.2 + rng.normal(size=m) * 1e-3,
            100 + rng.normal(size=m),
            rng.integers(0, 3, size=m).astype(np.int8),
            np.abs(rng.normal(size=(m, 3))) + 0.01,
        ),
        velocity=VelocityData(tf, rng.normal(size=(m, 3)) * 5),
        heading=HeadingData(tf, rng.uniform(-3.1, 3.1, size=m)) if heading else None,
    )


def assert_same(a: Drive, b: Drive) -> None:
    """Every array equal, but for the heading's trip through a quaternion."""
    for field in ("t", "specific_force", "angular_rate"):
        np.testing.assert_array_equal(getattr(a.imu, field), getattr(b.imu, field), err_msg=field)
    for field in ("t", "latitude", "longitude", "altitude", "status"):
        np.testing.assert_array_equal(getattr(a.fix, field), getattr(b.fix, field), err_msg=field)
    np.testing.assert_allclose(a.fix.sigma, b.fix.sigma, rtol=1e-15)
    np.testing.assert_array_equal(a.velocity.t, b.velocity.t)
    np.testing.assert_array_equal(a.velocity.enu, b.velocity.enu)
    assert (a.heading is None) == (b.heading is None)
    if a.heading is not None and b.heading is not None:
        np.testing.assert_array_equal(a.heading.t, b.heading.t)
        np.testing.assert_allclose(a.heading.yaw, b.heading.yaw, atol=1e-14)
    if a.imu.orientation is None:
        assert b.imu.orientation is None
    else:
        assert b.imu.orientation is not None
        np.testing.assert_array_equal(a.imu.orientation, b.imu.orientation)


def _rows(contents: Contents) -> list[tuple[int, str, str, bytes]]:
    rows = [
        (stamp, name, topic.msgtype, data)
        for name, topic in contents.topics.items()
        for stamp, data in zip(topic.stamps, topic.data, strict=True)
    ]
    return sorted(rows, key=lambda row: row[0])


def rewrite_mcap(contents: Contents, path: Path, compression: CompressionType, chunked: bool = True) -> Path:
    """The same messages by the ``mcap`` library."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=64 * 1024, use_chunking=chunked)
        writer.start("ros2", "test")
        channels = {}
        for name, topic in contents.topics.items():
            text, _ = ros2_types().generate_msgdef(topic.msgtype, ros_version=2)
            schema = writer.register_schema(topic.msgtype, "ros2msg", text.encode())
            channels[name] = writer.register_channel(name, "cdr", schema)
        for stamp, name, _, data in _rows(contents):
            writer.add_message(channels[name], stamp, data, stamp)
        writer.finish()
    return path


def rewrite_rosbag2(
    contents: Contents,
    path: Path,
    storage: StoragePlugin,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """The same messages by ``rosbags``, as a rosbag2 folder."""
    writer = Ros2Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {
            name: writer.add_connection(name, topic.msgtype, typestore=ros2_types())
            for name, topic in contents.topics.items()
        }
        for stamp, name, _, data in _rows(contents):
            writer.write(connections[name], stamp, data)
    return path


def _as_ros1(message: object, msgtype: str) -> object:
    """A ROS 2 message as the ROS 1 message of the same name (whose header has ``seq``)."""
    store = ros1_types()
    values: dict[str, object] = {}
    for name, (_, detail) in store.fielddefs[msgtype][1]:
        if name == "seq":
            values[name] = 0
            continue
        value = getattr(message, name)
        values[name] = _as_ros1(value, detail) if hasattr(value, "__msgtype__") else value  # type: ignore[arg-type]
    return store.types[msgtype](**values)  # type: ignore[arg-type]


def rewrite_ros1(contents: Contents, path: Path, compression: str | None) -> Path:
    """The same messages by ``rosbags``, as a ROS 1 bag."""
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    writer.chunk_threshold = 100_000
    with writer:
        connections = {
            name: writer.add_connection(name, topic.msgtype, typestore=ros1_types())
            for name, topic in contents.topics.items()
        }
        for stamp, name, msgtype, data in _rows(contents):
            message = _as_ros1(ros2_types().deserialize_cdr(data, msgtype), msgtype)
            writer.write(connections[name], stamp, ros1_types().serialize_ros1(message, msgtype))
    return path


@pytest.fixture(scope="session")
def drive() -> Drive:
    """A drive of 15 s."""
    return make_drive()


@pytest.fixture(scope="session")
def written(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That drive as a rosbag2 folder."""
    path = tmp_path_factory.mktemp("written") / "drive"
    write_drive(drive, path)
    return path


#: Every container a drive may come in.
FORMATS: dict[str, Callable[[Contents, Path], Path]] = {
    "mcap": lambda c, p: rewrite_mcap(c, p / "a.mcap", CompressionType.NONE),
    "mcap_unchunked": lambda c, p: rewrite_mcap(c, p / "a.mcap", CompressionType.NONE, chunked=False),
    "mcap_zstd": lambda c, p: rewrite_mcap(c, p / "a.mcap", CompressionType.ZSTD),
    "mcap_lz4": lambda c, p: rewrite_mcap(c, p / "a.mcap", CompressionType.LZ4),
    "sqlite3": lambda c, p: rewrite_rosbag2(c, p / "bag", StoragePlugin.SQLITE3) / "bag.db3",
    "ros1": lambda c, p: rewrite_ros1(c, p / "a.bag", None),
    "ros1_bz2": lambda c, p: rewrite_ros1(c, p / "a.bag", "BZ2"),
    "ros1_lz4": lambda c, p: rewrite_ros1(c, p / "a.bag", "LZ4"),
}


@pytest.fixture(scope="session")
def containers(written: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same drive as one file of every format, none of them written by this project."""
    contents = read_recording(written)
    return {name: make(contents, tmp_path_factory.mktemp(name)) for name, make in FORMATS.items()}


@pytest.fixture(scope="session")
def make() -> Callable[..., Drive]:
    """:func:`make_drive`."""
    return make_drive


@pytest.fixture(scope="session")
def same() -> Callable[[Drive, Drive], None]:
    """:func:`assert_same`."""
    return assert_same


@pytest.fixture(scope="session")
def rewrite() -> Callable[..., Path]:
    """:func:`rewrite_rosbag2`."""
    return rewrite_rosbag2
