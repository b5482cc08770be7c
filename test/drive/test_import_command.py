# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin import``: what it prints, what it leaves, how it fails."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive

G = 9.80665


@pytest.fixture
def upside_down_in_g(tmp_path: Path) -> Path:
    """A Sensor Logger folder of an Android phone lying on its face, in g, with a hole of half a second."""
    folder = tmp_path / "phone"
    folder.mkdir()
    t = np.delete(np.arange(1000), slice(400, 450)) / 100
    ns = [1_714_557_600_000_000_000 + round(x * 1e9) for x in t]
    force = np.random.default_rng(0).normal(size=(t.size, 3)) * 0.05 - [0, 0, 1]
    for name, values in (("TotalAcceleration", force), ("Gyroscope", force * 0)):
        rows = ["time,seconds_elapsed,z,y,x"]
        rows += [f"{a},{b},{z},{y},{x}" for a, b, (x, y, z) in zip(ns, t, values, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(rows))
    (folder / "Metadata.csv").write_text("version,platform,standardisation\n3,android,false\n")
    return folder


def test_it_says_what_it_recognised(
    upside_down_in_g: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "drives" / "phone"
    assert main(["import", str(upside_down_in_g), "--out", str(out)]) == 0
    printed, errors = capsys.readouterr()
    assert errors == "" and printed.splitlines()[0] == f"Writes {out}"
    for words in (
        "Sensor Logger, Android",
        "950 samples at 100.00 Hz over 10.0 s, from 2024-05-01 10:00:00 UTC",
        "1 gap, the longest 0.51 s",
        "gravity: on -z",
        "upside down",
        "so in g",
        "no GPS positions",
        f"Written to {out}",
    ):
        assert words in printed
    drive = read_drive(out)
    assert drive.imu.specific_force[:, 2].mean() == pytest.approx(-G, rel=0.01)


@pytest.mark.parametrize("name", ["drive", "drive.mcap"])
def test_a_bag_in_another_format_becomes_one(
    name: str, containers: dict[str, Path], drive: Drive, same: Callable[[Drive, Drive], None], tmp_path: Path
) -> None:
    assert main(["import", str(containers["ros1_bz2"]), "--out", str(tmp_path / name)]) == 0
    same(read_drive(tmp_path / name), drive)
    assert (tmp_path / name).is_dir() == (name == "drive")


def test_topics_by_option(
    make: Callable[..., Drive], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from suspension_twin.drive.read import Topics

    write_drive(make(50), tmp_path / "bag", topics=Topics(imu="/imu/data", fix="/gps/fix"))
    arguments = ["import", str(tmp_path / "bag"), "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "--imu-topic /imu/data" in capsys.readouterr().err
    assert main([*arguments, "--imu-topic", "/imu/data", "--fix-topic", "gps/fix"]) == 0
    read = read_drive(tmp_path / "out")
    assert (len(read.imu), len(read.fix)) == (50, 5)


def test_an_existing_bag_is_kept_unless_forced(
    upside_down_in_g: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["import", str(upside_down_in_g), "--out", str(tmp_path / "bag")]
    assert main(arguments) == 0
    before = sorted((p.name, p.read_bytes()) for p in (tmp_path / "bag").iterdir())
    assert main(arguments) == 2
    assert "bag: exists already: --force overwrites it" in capsys.readouterr().err
    assert sorted((p.name, p.read_bytes()) for p in (tmp_path / "bag").iterdir()) == before
    assert main([*arguments, "--force"]) == 0


def test_every_failure_is_one_line_and_status_2(
    upside_down_in_g: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "letter.txt").write_text("Dear Sir,\nnothing here.\n")
    (tmp_path / "broken.zip").write_bytes(b"PK\x03\x04" + bytes(40))
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"imu": {"specific_force": {}}}))
    phone, out = str(upside_down_in_g), str(tmp_path / "out")
    cases = [
        ["import"],
        ["import", phone],
        ["import", str(tmp_path / "nowhere"), "--out", out],
        ["import", str(tmp_path / "empty.csv"), "--out", out],
        ["import", str(tmp_path / "letter.txt"), "--out", out],
        ["import", str(tmp_path / "broken.zip"), "--out", out],
        ["import", str(tmp_path), "--out", str(tmp_path / "x.bag")],
        ["import", phone, "--mapping", str(tmp_path / "map.yaml"), "--out", out],
        ["import", phone, "--mapping", str(tmp_path / "no.yaml"), "--out", out],
        ["import", phone, "--mapping", str(tmp_path), "--out", out],
        ["import", phone, "--colour", "red", "--out", out],
    ]
    for arguments in cases:
        assert main(arguments) == 2, arguments
        printed, errors = capsys.readouterr()
        assert errors.count("\n") == 1 and errors.strip(), (arguments, errors)
        assert "Traceback" not in errors and printed == ""
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["empty.csv", "empty.bag", "folder"])
def test_nothing_is_called_empty(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / name
    path.write_bytes(b"") if path.suffix else path.mkdir()
    assert main(["import", str(path), "--out", str(tmp_path / "out")]) == 2
    assert f"{name}: is empty: copy the recording again" in capsys.readouterr().err


def test_a_pipe_that_closes_loses_no_bag(upside_down_in_g: Path, tmp_path: Path) -> None:
    program = [sys.executable, "-m", "suspension_twin", "import", str(upside_down_in_g), "--out", "out"]
    with subprocess.Popen(program, cwd=tmp_path, stdout=subprocess.PIPE) as running:
        assert running.stdout is not None
        running.stdout.close()
        running.wait(60)
    assert len(read_drive(tmp_path / "out").imu) == 950


def test_a_phones_recording_cut_off_while_copying(
    upside_down_in_g: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = (upside_down_in_g / "Gyroscope.csv").read_bytes()
    (upside_down_in_g / "Gyroscope.csv").write_bytes(data[: len(data) * 2 // 3])
    assert main(["import", str(upside_down_in_g), "--out", str(tmp_path / "out")]) == 0
    assert "no gyroscope beside them: left out" in capsys.readouterr().out
