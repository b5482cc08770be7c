# SPDX-License-Identifier: Apache-2.0
"""A BMI160 by Linux IIO: its sysfs tree as the kernel's driver makes it, and the bytes of its buffer."""

from __future__ import annotations

import asyncio
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from listening import listen

from suspension_twin.addons.sources import iio, make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError

ACCEL, GYRO = 0.002394, 0.000532  # ±8 g, ±1000 degrees a second
TREE = {
    "name": "bmi160",
    "in_accel_scale": str(ACCEL),
    "in_anglvel_scale": str(GYRO),
    "in_accel_sampling_frequency": "100.000000",
    "in_anglvel_sampling_frequency": "100.000000",
    "in_mount_matrix": "0, -1, 0; 1, 0, 0; 0, 0, 1",
    "current_timestamp_clock": "monotonic",
    "buffer/enable": "0",
    "buffer/length": "2",
    "buffer/watermark": "1",
    "trigger/current_trigger": "",
    **{f"in_{kind}_{axis}_raw": "0" for kind in ("accel", "anglvel") for axis in "xyz"},
}
# Of the driver: the gyroscope's channels come first.
for _i, _name in enumerate([f"in_{kind}_{axis}" for kind in ("anglvel", "accel") for axis in "xyz"]):
    TREE[f"scan_elements/{_name}_index"] = str(_i)
    TREE[f"scan_elements/{_name}_type"] = "le:s16/16>>0"
    TREE[f"scan_elements/{_name}_en"] = "0"
TREE |= {
    "scan_elements/in_timestamp_index": "6",
    "scan_elements/in_timestamp_type": "le:s64/64>>0",
    "scan_elements/in_timestamp_en": "0",
}


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with a BMI160 whose interrupt is connected; the folder of the device."""
    monkeypatch.setattr(iio, "SYSFS", tmp_path / "sys")
    monkeypatch.setattr(iio, "DEV", tmp_path / "dev")
    folder = tmp_path / "sys" / "iio:device1"
    for name, value in TREE.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"{value}\n")
    (tmp_path / "sys" / "iio:device0").mkdir()
    (tmp_path / "sys" / "iio:device0" / "name").write_text("cpu_thermal\n")
    (tmp_path / "sys" / "trigger0").mkdir()
    (tmp_path / "sys" / "trigger0" / "name").write_text("bmi160-dev1\n")
    (tmp_path / "dev").mkdir()
    os.mkfifo(tmp_path / "dev" / "iio:device1")
    return folder


def scans(drive: Drive) -> bytes:
    """The bytes of the buffer: six numbers of 16 bits, four bytes of padding, the time in ns."""
    back = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    force, rate = drive.imu.specific_force @ back, drive.imu.angular_rate @ back
    rows = np.rint(np.column_stack([rate / GYRO, force / ACCEL])).astype(int)
    stamps = [round(t * 1e9) for t in drive.imu.t.tolist()]
    return b"".join(struct.pack("<6h4xq", *row, t) for row, t in zip(rows.tolist(), stamps, strict=True))


def test_a_drive_arrives_as_it_was(bump: Drive, board: Path) -> None:
    data = scans(bump)

    async def play(_, taken) -> None:
        pipe = os.open(board.parents[1] / "dev" / "iio:device1", os.O_RDWR)
        for start in range(0, len(data), 1000):  # ends within scans
            os.write(pipe, data[start : start + 1000])
            await asyncio.sleep(0.002)
        while taken.count("imu") < len(bump.imu):
            await asyncio.sleep(0.01)
        assert (board / "buffer" / "enable").read_text().startswith("1")
        os.close(pipe)

    taken = listen("iio:bmi160?rate=1600", play)
    np.testing.assert_allclose(taken.imu.t, bump.imu.t, atol=1e-6)
    np.testing.assert_allclose(taken.imu.specific_force, bump.imu.specific_force, atol=0.51 * ACCEL)
    np.testing.assert_allclose(taken.imu.angular_rate, bump.imu.angular_rate, atol=0.51 * GYRO)
    said = {name: (board / name).read_text().strip() for name in TREE}
    assert said["in_accel_sampling_frequency"].startswith("1600") and said["buffer/enable"].startswith("0")
    assert said["trigger/current_trigger"] == "bmi160-dev1" and said["current_timestamp_clock"].startswith(
        "realtime"
    )
    assert {said[f"scan_elements/{n}_en"][0] for n in ("in_accel_x", "in_anglvel_z", "in_timestamp")} == {"1"}
    assert said["buffer/watermark"][0] == "8"


def test_without_a_trigger_the_values_are_read_one_by_one(board: Path) -> None:
    (board.parent / "trigger0" / "name").unlink()
    (board.parent / "trigger0").rmdir()
    (board / "in_accel_z_raw").write_text("4096\n")
    (board / "in_anglvel_x_raw").write_text("-100\n")

    async def play(sources, taken) -> None:
        while taken.count("imu") < 20:
            await asyncio.sleep(0.01)
        assert "one by one" in sources[0].notes[0]

    taken = listen("iio:bmi160?rate=200", play)
    np.testing.assert_allclose(taken.imu.specific_force[0], [0.0, 0.0, 4096 * ACCEL])
    np.testing.assert_allclose(taken.imu.angular_rate[0], [0.0, -100 * GYRO, 0.0])
    assert abs(taken.imu.t[-1] - taken.hub.now()) < 5.0


def test_the_tree_of_the_kernels_own_driver(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``benchmarks/iio_qemu.py`` kept it: the registers stood for these raw values at ±2 g and ±2000 °/s."""
    lines = (
        (repository / "test" / "addons" / "sources" / "data" / "bmi160_sysfs.txt").read_text().splitlines()
    )
    for name, _, value in (line.partition(" ") for line in lines if not line.startswith("#")):
        (tmp_path / "iio:device0" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "iio:device0" / name).write_text(f"{value}\n")
    monkeypatch.setattr(iio, "SYSFS", tmp_path)

    async def play(_, taken) -> None:
        while taken.count("imu") < 2:
            await asyncio.sleep(0.01)

    taken = listen("iio:bmi160?rate=200", play)
    force, rate = np.array([160, -320, 16384]) * 9.80665 / 16384, np.radians([100, -200, 300]) / 16.4
    np.testing.assert_allclose(taken.imu.specific_force[0], force, rtol=2e-3)
    np.testing.assert_allclose(taken.imu.angular_rate[0], rate, rtol=2e-3)


@pytest.mark.parametrize(
    ("kind", "raw", "wanted"),
    [
        ("le:s12/16>>4", struct.pack("<h", -5 << 4), -5),
        ("be:s16/16>>0", struct.pack(">h", -300), -300),
        ("be:u24/32>>8", struct.pack(">I", 0xFFFFFF << 8), 0xFFFFFF),
        ("le:s64/64>>0", struct.pack("<q", -1), -1),
    ],
)
def test_elements_of_every_type(kind: str, raw: bytes, wanted: int) -> None:
    scan = iio._Scan.of_elements({"a": (0, kind)}, "x")
    assert scan.values(np.frombuffer(raw, dtype=scan.dtype), "a").tolist() == [wanted]


@pytest.mark.parametrize(
    ("change", "url", "words"),
    [
        ({}, "iio:bmi088", "is not there; there are cpu_thermal, bmi160"),
        ({}, "iio:cpu_thermal", "has no in_accel_scale"),
        ({"in_accel_scale": "much"}, "iio:bmi160", "'much' is no number"),
        ({"in_mount_matrix": "1, 0; 0, 1"}, "iio:bmi160", "does not turn three axes"),
        (
            {"scan_elements/in_accel_x_type": "le:f16/16"},
            "iio:bmi160",
            "in_accel_x: the type 'le:f16/16' is not known",
        ),
        ({}, "iio:bmi160?trigger=hrtimer", "has no trigger hrtimer; there are bmi160-dev1"),
        ({}, "iio:bmi160?rate=fast", "rate: must be a number"),
    ],
)
def test_what_is_wrong_is_one_line(board: Path, change: dict, url: str, words: str) -> None:
    for name, value in change.items():
        (board / name).write_text(value)

    async def work() -> None:
        for source in make_sources([url], Hub()):
            await source.start()

    with pytest.raises(InputError, match=words):
        asyncio.run(work())


def test_imus_that_are_there_are_found(board: Path) -> None:
    assert iio.devices() == ["bmi160"]
