# SPDX-License-Identifier: Apache-2.0
"""Reading and writing bags: every container, round trips, and every kind of bad input."""

from __future__ import annotations

import errno
import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings, strategies as st
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from suspension_twin.cli.main import main
from suspension_twin.drive.cdr import encode, ros2_types
from suspension_twin.drive.contents import decode_topic
from suspension_twin.drive.read import Topics, read_drive
from suspension_twin.drive.recording import is_recording, read_recording
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData, concatenate, cut
from suspension_twin.drive.write import BagWriter, write_drive
from suspension_twin.errors import InputError, WorkError

START = 1_700_000_000.0
IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
Same = Callable[[Drive, Drive], None]
MakeDrive = Callable[..., Drive]


@pytest.mark.parametrize(
    "kind", ["mcap", "mcap_unchunked", "mcap_zstd", "mcap_lz4", "sqlite3", "ros1", "ros1_bz2", "ros1_lz4"]
)
def test_every_container_gives_the_same_drive(
    kind: str, containers: dict[str, Path], drive: Drive, same: Same
) -> None:
    read = read_drive(containers[kind])
    same(read, drive)
    assert read.warnings == ()
    assert is_recording(containers[kind])


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("compression", [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_rosbag2_folders_compressed_or_not(
    storage: StoragePlugin,
    compression: CompressionMode,
    written: Path,
    drive: Drive,
    same: Same,
    rewrite: Callable[..., Path],
    tmp_path: Path,
) -> None:
    folder = rewrite(read_recording(written), tmp_path / "bag", storage, compression)
    read = read_drive(folder)
    same(read, drive)
    assert read.warnings == ()
    (folder / "metadata.yaml").unlink()
    read = read_drive(folder)
    same(read, drive)
    assert len(read.warnings) == 1 and "metadata.yaml" in read.warnings[0]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_what_is_written_is_read_back(
    data: st.DataObject, same: Same, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Any finite numbers, jittered stamps, empty topics, with and without orientation and covariance."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    n, m, k = data.draw(st.tuples(st.integers(1, 40), st.integers(0, 9), st.integers(0, 9)))
    extreme = st.floats(-1e5, 1e5)
    # stamps as any recorder has them: whole nanoseconds, jittered by up to 5 ms either way
    t = START + np.arange(n) / 100 + rng.integers(-5_000_000, 5_000_000, size=n) * 1e-9
    force = rng.normal(size=(n, 3)) * 20
    force[0, 0] = data.draw(extreme)
    orientation = None
    if data.draw(st.booleans()):
        orientation = rng.normal(size=(n, 4))
        orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
    sigma = np.abs(rng.normal(size=(m, 3))) + 1e-3
    sigma[rng.random(m) < 0.3] = np.nan
    drive = Drive(
        "any",
        ImuData(
            t,
            force,
            rng.normal(size=(n, 3)),
            orientation,
            data.draw(st.sampled_from(["", "imu_link", "telefon é"])),
        ),
        FixData(
            START + np.arange(m) / 4,
            rng.uniform(-90, 90, m),
            rng.uniform(-180, 180, m),
            rng.uniform(-400, 9000, m),
            rng.integers(-1, 3, m).astype(np.int8),
            sigma,
        ),
        VelocityData(START + np.arange(k) / 4, rng.normal(size=(k, 3))),
    )
    folder = tmp_path_factory.mktemp("round")
    write_drive(drive, folder / "bag")
    read = read_drive(folder / "bag")
    same(read, drive)
    assert read.imu.frame == (drive.imu.frame or "imu_link")
    write_drive(read, folder / "again.mcap")
    same(read_drive(folder / "again.mcap"), drive)


def test_rosbags_reads_what_is_written(written: Path, drive: Drive) -> None:
    """Types, definitions, counts and values by an independent reader."""
    with AnyReader([written]) as reader:
        assert {name: (info.msgtype, info.msgcount) for name, info in reader.topics.items()} == {
            "/imu/data_raw": (IMU, len(drive.imu)),
            "/fix": (FIX, len(drive.fix)),
            "/vel": ("geometry_msgs/msg/TwistStamped", len(drive.velocity)),
            "/heading": ("geometry_msgs/msg/QuaternionStamped", len(drive.fix)),
        }
        imu = [
            reader.deserialize(raw, c.msgtype)
            for c, _, raw in reader.messages()
            if c.topic == "/imu/data_raw"
        ]
        fixes = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/fix"]
        stamps = [stamp for _, stamp, _ in reader.messages()]
    assert stamps == sorted(stamps)
    assert [m.linear_acceleration.z for m in imu] == drive.imu.specific_force[:, 2].tolist()
    assert {m.header.frame_id for m in imu} == {"imu_link"}
    assert fixes[3].position_covariance_type == 2
    np.testing.assert_allclose(fixes[3].position_covariance[[0, 4, 8]], drive.fix.sigma[3] ** 2)
    metadata = yaml.safe_load((written / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["storage_identifier"] == "mcap"
    assert metadata["message_count"] == len(stamps)
    assert (written / metadata["relative_file_paths"][0]).is_file()


def test_an_imu_without_orientation_says_so(make: MakeDrive, tmp_path: Path) -> None:
    """REP-145: a first covariance of -1."""
    drive = make(20)
    drive = replace(drive, imu=replace(drive.imu, orientation=None))
    write_drive(drive, tmp_path / "bag")
    (group,) = decode_topic(read_recording(tmp_path / "bag"), "/imu/data_raw")
    assert (group["orientation_covariance"][:, 0] == -1).all()
    assert read_drive(tmp_path / "bag").imu.orientation is None


def test_topics_have_other_names(drive: Drive, same: Same, tmp_path: Path) -> None:
    topics = Topics(imu="car/imu", fix="/car/gps/fix", vel="/car/gps/vel", heading="/car/compass")
    write_drive(drive, tmp_path / "bag", topics=topics)
    same(read_drive(tmp_path / "bag", topics=topics), drive)
    with pytest.raises(
        InputError, match=r"/imu/data_raw.*imu topics of this recording are /car/imu.*--imu-topic /car/imu"
    ):
        read_drive(tmp_path / "bag")
    named = {**asdict(topics), "vel": "/nonsense"}
    with pytest.raises(
        InputError, match=r"/nonsense: no such topic; vel topics of this recording are /car/gps/vel"
    ):
        read_drive(tmp_path / "bag", topics=Topics(**named))


def test_positions_on_another_topic_are_not_lost_without_a_word(drive: Drive, tmp_path: Path) -> None:
    write_drive(drive, tmp_path / "bag", topics=Topics(fix="/gps/fix"))
    found = read_drive(tmp_path / "bag")
    (line,) = (w for w in found.warnings if "topic" in w)
    assert not len(found.fix) and line.startswith(
        "/fix: no such topic; fix topics of this recording are /gps/fix"
    )
    assert not any("topic" in w for w in read_drive(tmp_path / "bag", topics=Topics(fix="")).warnings)


def test_a_folder_named_bag_is_read_and_not_written(
    written: Path, drive: Drive, same: Same, tmp_path: Path
) -> None:
    """Other tools take a folder of this name for a ROS 1 bag."""
    shutil.copytree(written, tmp_path / "drive.bag")
    same(read_drive(tmp_path / "drive.bag"), drive)
    with pytest.raises(InputError, match=r"ROS 1 bag"):
        write_drive(drive, tmp_path / "other.bag")


def test_a_recording_split_into_files(make: MakeDrive, same: Same, tmp_path: Path) -> None:
    """Ten files and more: in the order they were written, not that of the alphabet."""
    whole = make(1100)
    folder = tmp_path / "split"
    folder.mkdir()
    for i in range(11):
        part = cut(whole, START + i, START + i + 1 - 1e-4)
        write_drive(part, folder / f"split_{i}.mcap")
    same(read_drive(folder), whole)
    names = [f"split/split_{i}.mcap" for i in range(11)]  # the paths of old distributions
    (folder / "metadata.yaml").write_text(
        yaml.dump({"rosbag2_bagfile_information": {"relative_file_paths": names}})
    )
    read = read_drive(folder)
    same(read, whole)
    assert read.warnings == ()
    (folder / "split_4.mcap").unlink()
    read = read_drive(folder)
    assert len(read.imu) == 1000
    assert any("split_4.mcap" in line for line in read.warnings)
    (folder / "split_5.mcap").write_bytes(b"nonsense here")
    assert any("split_5.mcap" in line for line in read_drive(folder).warnings)
    (folder / "metadata.yaml").write_text("{unfinished")
    assert any("damaged" in line for line in read_drive(folder).warnings)


def test_parts_put_together_are_the_whole(make: MakeDrive, same: Same) -> None:
    whole = make(1000)
    parts = [cut(whole, START + a, START + a + 2.5) for a in (0.0, 2.5, 5.0, 7.5)]
    same(concatenate(parts), whole)
    with pytest.raises(InputError, match="begins before"):
        concatenate(parts[::-1])
    with pytest.raises(InputError):
        concatenate([])


# --- what cannot be read


def test_what_is_no_recording_is_said_in_one_line(tmp_path: Path, written: Path) -> None:
    cases: dict[str, tuple[str, bytes | None]] = {
        "missing.mcap": ("No such file", None),
        "empty.mcap": ("empty", b""),
        "short.mcap": ("cut off before", b"\x89MCAP"),
        "zeros.db3": ("zeros", bytes(100)),
        "text.bag": ("not a recording", b"hello, this is a text\n"),
        "old.bag": ("format 1", b"#ROSBAG V1.2\n" + bytes(50)),
        "header_only.mcap": ("no topics", b"\x89MCAP0\r\n"),
        "header_only.bag": ("no topics", b"#ROSBAG V2.0\n"),
    }
    for name, (words, data) in cases.items():
        path = tmp_path / name
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(InputError, match=words) as caught:
            read_drive(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
        assert not is_recording(path) or name.startswith(("header_only", "old"))
    empty = tmp_path / "folder"
    empty.mkdir()
    with pytest.raises(InputError, match="no .mcap or .db3"):
        read_drive(empty)
    shutil.copytree(written, empty / "inner")
    with pytest.raises(InputError, match="inner"):
        read_drive(empty)


def test_a_database_that_is_no_recording(tmp_path: Path) -> None:
    import sqlite3

    with sqlite3.connect(tmp_path / "other.db3") as database:
        database.execute("CREATE TABLE shopping (item TEXT)")
    with pytest.raises(InputError, match="not a rosbag2 recording"):
        read_drive(tmp_path / "other.db3")


def test_a_topic_of_a_wrong_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/imu/data_raw", IMU, START + np.arange(5) / 100, {})
        bag.write("/fix", "geometry_msgs/msg/PoseStamped", START + np.arange(5), {})
    with pytest.raises(
        InputError,
        match=r"/fix: holds geometry_msgs/msg/PoseStamped, but fix needs sensor_msgs/msg/NavSatFix",
    ):
        read_drive(tmp_path / "bag")
    read = read_drive(tmp_path / "bag", topics=Topics(fix=""))
    assert (len(read.imu), len(read.fix), len(read.velocity), read.heading) == (5, 0, 0, None)


def test_no_imu_at_all_lists_what_there_is(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/fix", FIX, START + np.arange(5), {})
    with pytest.raises(InputError, match=r"/fix \(sensor_msgs/msg/NavSatFix\)"):
        read_drive(tmp_path / "bag")


def test_an_imu_topic_without_messages(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/imu/data_raw", IMU, np.empty(0), {})
    with pytest.raises(InputError, match="no message"):
        read_drive(tmp_path / "bag")


def test_velocities_with_covariance_are_read(tmp_path: Path) -> None:
    t = START + np.arange(4)
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/imu/data_raw", IMU, t, {"orientation.w": 1.0})
        values = {"twist.twist.linear.x": np.arange(4.0)}
        bag.write("/vel", "geometry_msgs/msg/TwistWithCovarianceStamped", t, values)
    assert read_drive(tmp_path / "bag").velocity.enu[:, 0].tolist() == [0, 1, 2, 3]


# --- stamps and samples that are wrong


def _bag(path: Path, header: np.ndarray, recorded: np.ndarray, values: dict[str, Any] | None = None) -> Path:
    """An IMU bag whose header stamps (ns) and times of recording (ns) differ."""
    stamped = {"header.stamp.sec": header // 10**9, "header.stamp.nanosec": header % 10**9, **(values or {})}
    with BagWriter(path) as bag:
        bag.write_raw("/imu/data_raw", IMU, recorded, encode(ros2_types(), IMU, header.size, stamped))
    return path


RECORDED = 1_700_000_000 * 10**9 + np.arange(500, dtype=np.int64) * 10**7


def test_without_header_stamps_the_times_of_recording_are_taken(tmp_path: Path) -> None:
    read = read_drive(_bag(tmp_path / "bag", np.zeros(500, dtype=np.int64), RECORDED))
    np.testing.assert_allclose(read.imu.t, RECORDED * 1e-9, atol=1e-6)
    assert len(read.warnings) == 1 and "no header stamps" in read.warnings[0]


def test_single_missing_stamps_are_filled_in(tmp_path: Path) -> None:
    header = RECORDED - 30_000_000
    header[[5, 77, 499]] = 0
    read = read_drive(_bag(tmp_path / "bag", header, RECORDED))
    np.testing.assert_allclose(read.imu.t, (RECORDED - 30_000_000) * 1e-9, atol=1e-6)
    assert "3 of 500 header stamps are missing" in read.warnings[0]


def test_absurd_stamps_are_left_out(tmp_path: Path) -> None:
    header = RECORDED.copy()
    header[100] += 3600 * 10**9
    header[200] = 5
    read = read_drive(_bag(tmp_path / "bag", header, RECORDED))
    assert len(read.imu) == 498
    assert (np.diff(read.imu.t) > 0).all()
    assert "2 of 500 stamps are absurd" in read.warnings[0]


@pytest.mark.parametrize("clock", ["simulated", "half speed", "looped"])
def test_clocks_of_their_own_are_kept(clock: str, tmp_path: Path) -> None:
    """Simulation time, a replay at another rate and a looped bag are odd, and not wrong."""
    header = np.arange(1, 501, dtype=np.int64) * 10**7
    if clock == "half speed":
        header = RECORDED[0] + (RECORDED - RECORDED[0]) // 2
    elif clock == "looped":
        header = RECORDED[np.arange(500) % 250]
    read = read_drive(_bag(tmp_path / "bag", header, RECORDED))
    assert len(read.imu) == 500
    np.testing.assert_allclose(read.imu.t, header * 1e-9, atol=1e-6)
    assert bool(read.warnings) == (clock == "looped")


def test_samples_that_are_not_finite_are_left_out(make: MakeDrive, tmp_path: Path) -> None:
    drive = make(100)
    drive.imu.specific_force[3, 1] = np.nan
    drive.imu.angular_rate[50, 2] = np.inf
    drive.velocity.enu[2, 0] = np.nan
    drive.fix.latitude[1], drive.fix.longitude[1] = 0.0, 0.0
    drive.fix.latitude[4] = 91.0
    drive.fix.longitude[5] = np.nan
    drive.fix.altitude[7] = np.nan
    write_drive(drive, tmp_path / "bag")
    read = read_drive(tmp_path / "bag")
    assert (len(read.imu), len(read.velocity), len(read.fix)) == (98, 9, 7)
    for array in (read.imu.specific_force, read.imu.angular_rate, read.fix.altitude, read.velocity.enu):
        assert np.isfinite(array).all()
    text = " | ".join(read.warnings)
    for words in ("2 of 100 IMU samples", "1 of 10 velocities", "3 of 10 fixes", "altitude"):
        assert words in text


def test_nothing_usable_is_an_error(make: MakeDrive, tmp_path: Path) -> None:
    drive = make(10)
    drive.imu.specific_force[:] = np.nan
    write_drive(drive, tmp_path / "bag")
    with pytest.raises(InputError, match="no usable sample"):
        read_drive(tmp_path / "bag")


def test_out_of_order_samples_keep_their_order(make: MakeDrive, same: Same, tmp_path: Path) -> None:
    """What came late stays late: putting it right is the filters' business, live and offline alike."""
    drive = make(50)
    t = drive.imu.t.copy()
    t[[20, 21]] = t[[21, 20]]
    drive = replace(drive, imu=replace(drive.imu, t=t))
    write_drive(drive, tmp_path / "bag")
    same(read_drive(tmp_path / "bag"), drive)


# --- writing


def test_nothing_is_overwritten_unless_told(
    make: MakeDrive, drive: Drive, same: Same, tmp_path: Path
) -> None:
    write_drive(drive, tmp_path / "bag")
    other = make(30, seed=1)
    with pytest.raises(InputError, match="exists already"):
        write_drive(other, tmp_path / "bag")
    same(read_drive(tmp_path / "bag"), drive)
    write_drive(other, tmp_path / "bag", overwrite=True)
    same(read_drive(tmp_path / "bag"), other)
    (tmp_path / "bag" / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match=r"thesis\.tex"):
        write_drive(drive, tmp_path / "bag", overwrite=True)
    write_drive(other, tmp_path / "one.mcap")
    write_drive(drive, tmp_path / "one.mcap", overwrite=True)
    same(read_drive(tmp_path / "one.mcap"), drive)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "one.mcap"]


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
def test_a_write_that_fails_leaves_nothing(name: str, make: MakeDrive, tmp_path: Path) -> None:
    write_drive(make(10), tmp_path / "before")
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / name) as bag:
        bag.write("/imu/data_raw", IMU, START + np.arange(1000) / 100, {})
        bag.flush()
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["before"]


def test_stamps_that_a_message_cannot_hold(make: MakeDrive, tmp_path: Path) -> None:
    drive = make(10)
    for t in (drive.imu.t - 2e9, drive.imu.t + 1e9):
        with pytest.raises(InputError, match="1970"):
            write_drive(replace(drive, imu=replace(drive.imu, t=t)), tmp_path / "bag")
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises((WorkError, InputError), match="file"):
        write_drive(drive, tmp_path / "file" / "bag")


def test_topics_given_one_after_the_other_are_merged_by_time(tmp_path: Path) -> None:
    """The way ``simulate`` writes: one topic whole, then the next."""
    t = START + np.arange(3000) / 100
    deflection = np.random.default_rng(0).normal(size=(t.size, 4))
    corners = ["front_left", "front_right", "rear_left", "rear_right"]
    with BagWriter(tmp_path / "bag") as bag:
        for part in (slice(0, 1000), slice(1000, None)):
            bag.write("twin/imu", IMU, t[part], {"linear_acceleration.z": 9.81}, frame="imu_link")
            bag.write(
                "twin/vertical_acceleration",
                "geometry_msgs/AccelStamped",
                t[part],
                {"accel.linear.z": t[part] - START},
            )
            values = {"name": corners, "position": deflection[part]}
            bag.write("joint_states", "sensor_msgs/msg/JointState", t[part], values, frame="base_link")
            bag.flush()
    with AnyReader([tmp_path / "bag"]) as reader:
        order = [(stamp, connection.topic) for connection, stamp, _ in reader.messages()]
        joints = [
            reader.deserialize(raw, c.msgtype)
            for c, _, raw in reader.messages()
            if c.topic == "/joint_states"
        ]
    assert [topic for _, topic in order[:6]] == [
        "/twin/imu",
        "/twin/vertical_acceleration",
        "/joint_states",
    ] * 2
    assert len(order) == 9000 and order == sorted(order, key=lambda row: row[0])
    assert joints[7].name == corners
    np.testing.assert_array_equal([j.position for j in joints], deflection)
    read = read_drive(tmp_path / "bag", topics=Topics(imu="twin/imu"))
    np.testing.assert_array_equal(read.imu.t, t)
    (group,) = decode_topic(read_recording(tmp_path / "bag"), "twin/vertical_acceleration")
    np.testing.assert_array_equal(group["accel.linear.z"], t - START)


def test_an_unfinished_sqlite_recording_is_read_with_its_log(
    written: Path, rewrite: Callable[..., Path], tmp_path: Path
) -> None:
    """A recorder that was killed leaves messages in the write-ahead log; reading leaves all files as they are."""
    import sqlite3

    folder = rewrite(read_recording(written), tmp_path / "bag", StoragePlugin.SQLITE3)
    source = folder / "bag.db3"
    database = sqlite3.connect(source, isolation_level=None)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    row = database.execute(
        "SELECT topic_id, timestamp + 1000000000, data FROM messages ORDER BY id DESC LIMIT 1"
    ).fetchone()
    database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    for name in ("bag.db3", "bag.db3-wal"):
        shutil.copyfile(folder / name, crashed / name)
    database.close()
    before = {p.name: p.read_bytes() for p in crashed.iterdir()}
    contents = read_recording(crashed)
    assert sum(len(t.data) for t in contents.topics.values()) == 1 + sum(
        len(t.data) for t in read_recording(written).topics.values()
    )
    assert any("not closed" in line for line in contents.warnings)
    assert {p.name: p.read_bytes() for p in crashed.iterdir()} == before


def test_topics_of_types_of_their_own_are_decoded_by_the_definition_in_the_file(tmp_path: Path) -> None:
    """``my_msgs/msg/Wheel`` is known to nobody but the recording; a damaged definition costs only its topic."""
    definition = b"std_msgs/Header header\nfloat32[4] speed\nuint8 gear\n"
    with (tmp_path / "own.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for name, text in (("Wheel", definition), ("Broken", b"float32 = = ?")):
            schema = writer.register_schema(f"my_msgs/msg/{name}", "ros2msg", text)
            channel = writer.register_channel(f"/{name.lower()}", "cdr", schema)
            for i in range(3):
                head = struct.pack("<4sIII4s", b"\0\1\0\0", 100 + i, 5, 4, b"car\0")
                data = head + struct.pack("<4fB", *(float(i + k) for k in range(4)), i)
                writer.add_message(channel, i, data, i)
        writer.finish()  # type: ignore[no-untyped-call]
    contents = read_recording(tmp_path / "own.mcap")
    (group,) = decode_topic(contents, "/wheel")
    np.testing.assert_array_equal(group["speed"], np.arange(3)[:, None] + np.arange(4))
    assert group["gear"].tolist() == [0, 1, 2]
    assert group.stamp_ns.tolist() == [(100 + i) * 10**9 + 5 for i in range(3)]
    assert decode_topic(contents, "/broken") == []
    assert "3 of 3 messages are damaged" in contents.warnings[-1]
    assert decode_topic(contents, "/absent") == []


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
@pytest.mark.parametrize(
    "call", ["suspension_twin.drive.write.os.replace", "suspension_twin.drive.write.synchronise"]
)
def test_a_full_disk_leaves_the_recording_that_was_there(
    name: str, call: str, make: MakeDrive, same: Same, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    old, new = make(200), make(300)
    write_drive(old, tmp_path / name)
    with monkeypatch.context() as patch:
        patch.setattr(call, full)
        with pytest.raises(WorkError, match=rf"{name}: cannot be written: No space left") as caught:
            write_drive(new, tmp_path / name, overwrite=True)
    assert caught.value.exit_status == 1
    assert [p.name for p in tmp_path.iterdir()] == [name]
    same(read_drive(tmp_path / name), old)


def test_what_a_killed_recorder_left_is_removed(make: MakeDrive, tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    left = tmp_path / f".bag.{ended.pid}.0.part"
    (left / "bag").mkdir(parents=True)
    (left / "bag" / "bag.mcap").write_bytes(b"half")
    write_drive(make(200), tmp_path / "bag")
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]


def test_a_recording_that_cannot_be_made_is_refused_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / ("x" * 250), tmp_path / "file" / "bag"):
        assert main(["import", "/dev/zero", "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert "cannot be written" in error and error.count("\n") == 1


def test_a_live_folder_is_a_recording_from_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a kill leaves behind has its ``metadata.yaml``, which ``ros2 bag`` asks for."""
    monkeypatch.setattr("suspension_twin.drive.write._KEEP", 0.0)
    path = tmp_path / "drive"

    def described() -> dict[str, Any]:
        return dict(yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"])

    with BagWriter(path, live=True) as bag:
        assert described()["message_count"] == 0 and (path / described()["relative_file_paths"][0]).is_file()
        for k in range(3):
            bag.write("/fix", "sensor_msgs/msg/NavSatFix", np.array([1.7e9 + k]), {"latitude": 47.0})
            bag.flush()
            assert described()["message_count"] == k + 1
            assert described()["starting_time"]["nanoseconds_since_epoch"] == 1_700_000_000_000_000_000
            assert described()["duration"]["nanoseconds"] == k * 1_000_000_000
        (topic,) = described()["topics_with_message_count"]
        assert topic["topic_metadata"]["name"] == "/fix"
        assert len(read_recording(path).topics["/fix"].data) == 3
    assert described()["message_count"] == 3 and len(read_recording(path).topics["/fix"].data) == 3


@pytest.mark.parametrize(
    ("sigma", "kept"),
    [
        ((0.02, 0.03, 0.05), (0.02, 0.03, 0.05)),
        ((3.5, 3.5, np.nan), (3.5, 3.5, np.nan)),  # as phones state it
        ((np.nan, np.nan, np.nan), (np.nan, np.nan, np.nan)),
        ((np.nan, np.nan, 2.0), (np.nan, np.nan, np.nan)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_what_a_receiver_states_of_its_accuracy_is_kept(
    repository: Path, tmp_path: Path, sigma: tuple[float, ...], kept: tuple[float, ...]
) -> None:
    drive = read_drive(repository / "bags" / "bump_phone")
    fix = replace(drive.fix, sigma=np.tile(sigma, (len(drive.fix), 1)))
    write_drive(replace(drive, fix=fix), tmp_path / "drive")
    np.testing.assert_allclose(read_drive(tmp_path / "drive").fix.sigma, np.tile(kept, (len(fix), 1)))
