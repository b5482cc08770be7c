# SPDX-License-Identifier: Apache-2.0
"""Recordings that end early or are damaged: what is whole is read, and nothing else is raised."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.cli.main import main
from suspension_twin.drive.cdr import Encoding
from suspension_twin.drive.contents import Contents
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.recording import read_recording, read_whole
from suspension_twin.drive.salvage import SQLITE_MAGIC, salvage_mcap, salvage_ros1, salvage_sqlite
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError

KINDS = ["mcap", "mcap_unchunked", "mcap_zstd", "mcap_lz4", "sqlite3", "ros1", "ros1_bz2", "ros1_lz4"]

#: The most of the samples before the cut that may be lost: a page, a compressed block, a chunk.
LOST = {"mcap": 0.01, "mcap_unchunked": 0.01, "ros1": 0.02, "sqlite3": 0.05}


@pytest.mark.parametrize("kind", KINDS)
def test_salvage_of_a_complete_recording_finds_what_rosbags_reads(
    kind: str, containers: dict[str, Path]
) -> None:
    storage, salvage = {
        "m": ("mcap", salvage_mcap),
        "s": ("db3", salvage_sqlite),
        "r": ("bag", salvage_ros1),
    }[kind[0]]
    encoding: Encoding = "ros1" if storage == "bag" else "cdr"
    whole, salvaged = Contents(encoding, None), Contents(encoding, None)
    read_whole(containers[kind], storage, whole)
    salvage(containers[kind], salvaged)
    assert whole.types == salvaged.types and len(whole.types) == 4
    assert whole.definitions == salvaged.definitions
    for name, topic in whole.topics.items():
        assert topic.data and (topic.stamps, topic.data) == (
            salvaged.topics[name].stamps,
            salvaged.topics[name].data,
        )
    assert whole.warnings == []


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_cut_anywhere_gives_its_beginning(
    kind: str, containers: dict[str, Path], drive: Drive, tmp_path: Path
) -> None:
    data = containers[kind].read_bytes()
    path = tmp_path / "cut"
    rng = np.random.default_rng(KINDS.index(kind))
    most = 0
    ends = np.sort(np.concatenate([np.arange(0, 300, 7), rng.integers(0, len(data), 60), [len(data) - 1]]))
    for end in ends:
        path.write_bytes(data[:end])
        try:
            read = read_drive(path)
        except InputError as error:
            assert "\n" not in str(error)
            assert most == 0, "less was read of more"
            continue
        n, m = len(read.imu), len(read.fix)
        assert n >= most
        most = n
        np.testing.assert_array_equal(read.imu.specific_force, drive.imu.specific_force[:n])
        np.testing.assert_array_equal(read.imu.t, drive.imu.t[:n])
        np.testing.assert_array_equal(read.fix.latitude, drive.fix.latitude[:m])
        assert read.warnings or (n, m) == (len(drive.imu), len(drive.fix))
        if kind in LOST:
            assert n / len(drive.imu) >= (end - 20_000) / len(data) - LOST[kind]
    assert most >= 0.8 * len(drive.imu)


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_with_wrong_bytes_never_breaks_the_reader(
    kind: str, containers: dict[str, Path], tmp_path: Path
) -> None:
    data = containers[kind].read_bytes()
    path = tmp_path / "damaged"
    rng = np.random.default_rng(100 + KINDS.index(kind))
    read_some = 0
    for _ in range(40):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 20)):
            damaged[at] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            read = read_drive(path)
        except InputError as error:
            assert "\n" not in str(error)
            continue
        read_some += len(read.imu) > 0
        for array in (read.imu.t, read.imu.specific_force, read.imu.angular_rate, read.velocity.enu):
            assert np.isfinite(array).all()
    assert read_some > 0


@pytest.mark.parametrize("kind", ["mcap", "mcap_zstd", "ros1"])
def test_zeros_behind_a_power_cut(
    kind: str, containers: dict[str, Path], drive: Drive, tmp_path: Path
) -> None:
    """File systems lengthen a file before its content is on the disk."""
    data = containers[kind].read_bytes()
    path = tmp_path / "zeros"
    path.write_bytes(data[: len(data) * 2 // 3] + bytes(200_000))
    read = read_drive(path)
    n = len(read.imu)
    assert 0.3 * len(drive.imu) < n < len(drive.imu)
    np.testing.assert_array_equal(read.imu.specific_force, drive.imu.specific_force[:n])
    assert any("cut off" in line for line in read.warnings)


def test_a_ros1_bag_that_was_never_closed(containers: dict[str, Path], drive: Drive, tmp_path: Path) -> None:
    """Its header still says that there is no index (``*.bag.active``)."""
    data = containers["ros1"].read_bytes()
    at = data.index(b"index_pos=") + len(b"index_pos=")
    path = tmp_path / "a.bag.active"
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    read = read_drive(path)
    np.testing.assert_array_equal(read.imu.specific_force, drive.imu.specific_force)
    assert any("not closed" in line for line in read.warnings)


def test_pages_of_a_database_hold_large_messages_too(tmp_path: Path) -> None:
    """Messages that overflow onto pages of their own, found without the tree."""
    import sqlite3

    rng = np.random.default_rng(0)
    blobs = [rng.bytes(int(size)) for size in rng.integers(1, 20_000, 200)]
    path = tmp_path / "big.db3"
    with sqlite3.connect(path) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.execute("INSERT INTO topics VALUES (1, '/camera', 'sensor_msgs/msg/Image', 'cdr')")
        rows = [(1, 10**9 * (i - 3), blob) for i, blob in enumerate(blobs)]
        database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    data = path.read_bytes()
    assert data.startswith(SQLITE_MAGIC)
    for share in (0.3, 0.6, 0.95):
        path.write_bytes(data[: int(share * len(data))])
        contents = Contents("cdr", None)
        salvage_sqlite(path, contents)
        topic = contents.topics["/camera"]
        assert len(topic.data) > 0.8 * share * len(blobs)
        assert topic.data == blobs[: len(topic.data)]
        assert topic.stamps == [10**9 * (i - 3) for i in range(len(topic.data))]


def test_cells_of_a_page_do_not_overlap(containers: dict[str, Path], tmp_path: Path) -> None:
    """Pages that claim 65 535 cells, all at one place, take no longer than their bytes are worth."""
    data = bytearray(containers["sqlite3"].read_bytes())
    size = int.from_bytes(data[16:18], "big")
    for page in range(size, len(data) - size + 1, size):
        if data[page] == 13:  # a leaf of a table
            data[page + 3 : page + 5] = b"\xff\xff"
            first = data[page + 8 : page + 10]
            data[page + 8 : page + 8 + size // 4] = first * (size // 8)
    path = tmp_path / "claims.db3"
    path.write_bytes(data)
    contents = Contents("cdr", None)
    taken = 0

    def take(count: int) -> None:
        nonlocal taken
        taken += count

    contents.budget.take = take  # type: ignore[method-assign]
    with suppress(InputError):
        salvage_sqlite(path, contents)
    assert taken < 3 * len(data)


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_makes_a_cut_off_recording_readable(
    kind: str, containers: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of its topics, as far as they are whole; the new one is read by rosbags without a word."""
    data = containers[kind].read_bytes()
    cut, out = tmp_path / "cut", tmp_path / "out"
    cut.write_bytes(data[: int(0.9 * len(data))])
    damaged = read_recording(cut)
    assert main(["salvage", str(cut), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"Writes {out}") and "warning: cut" in said
    whole = read_recording(out)
    assert whole.warnings == [] and set(whole.topics) == set(damaged.topics)
    for name, topic in damaged.topics.items():
        assert f"{name}: {len(topic.data)} messages" in said
        assert whole.topics[name].stamps == topic.stamps
        if kind[0] != "r":
            assert whole.topics[name].data == topic.data
    first, again = read_drive(cut), read_drive(out)
    np.testing.assert_array_equal(again.imu.specific_force, first.imu.specific_force)
    np.testing.assert_array_equal(again.fix.latitude, first.fix.latitude)
    assert main(["salvage", str(cut), "--out", str(out)]) == 2


def test_nothing_to_salvage_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bag.mcap").write_bytes(b"nothing of a bag")
    assert main(["salvage", str(tmp_path / "bag.mcap"), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()
