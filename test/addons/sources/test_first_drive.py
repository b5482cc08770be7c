# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin first-drive``: from a phone that sends to a calibrated twin, in one command."""

from __future__ import annotations

import asyncio
import signal
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import aiohttp
import numpy as np
import pytest
from sensor_logger_app import SensorLoggerApp
from test_record import free_port, start, wait_for_port

from suspension_twin.addons.sources.common.first_drive import FirstDrive, excited_part
from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.road import bump_road, flat_road, half_sine
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

Part = TypeVar("Part", ImuData, FixData, VelocityData)


@pytest.fixture(scope="module")
def twin(repository: Path) -> Twin:
    return load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")


@pytest.fixture(scope="module")
def three_passes(repository: Path) -> Drive:
    """Four seconds of standstill and three passes of the bump, the second one from the other side."""
    return read_drive(repository / "bags" / "bump_15kmh")


def play(guide: FirstDrive, drive: Drive, period: float = 0.2) -> list[tuple[float, str]]:
    """Give the samples as they come; when, s after the first, which step begins."""
    began, first = [], float(drive.imu.t[0])
    for at in np.arange(first, float(drive.imu.t[-1]) + period, period):
        for samples in (drive.imu, drive.velocity, drive.fix):
            guide.add(samples.select((samples.t >= at) & (samples.t < at + period)))
        now = next((step.name for step in guide.steps() if step.state == "now"), "end")
        if not began or began[-1][1] != now:
            began.append((at - first, now))
    return began


def run(drive: Drive, twin: Path, folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """The command, while a phone plays the drive at twenty times its pace; then Ctrl-C if it still waits."""
    port = free_port()
    url = f"sensorlogger://127.0.0.1:{port}"
    given = (
        "--twin",
        twin,
        "--source",
        url,
        "--out",
        folder / "calibrated.yaml",
        "--record",
        folder / "drive",
    )
    process = start("first-drive", *given, *more)
    wait_for_port(port, process)
    phone = SensorLoggerApp(drive, sensors=("totalacceleration", "gyroscope", "location"))
    asyncio.run(send(phone, port, process))
    out, errors = process.communicate(timeout=240)
    return subprocess.CompletedProcess(process.args, process.returncode, out, errors)


async def send(phone: SensorLoggerApp, port: int, process: subprocess.Popen[str]) -> None:
    try:
        await phone.push(f"http://127.0.0.1:{port}/", 20.0)
    except aiohttp.ClientError:
        return  # it has what it needs, and has closed its port
    if process.poll() is None:
        process.send_signal(signal.SIGINT)


def driven_on(drive: Drive, seconds: float) -> Drive:
    """The drive, and its last two seconds again and again: a car that goes on over an even road."""
    end, period = float(drive.imu.t[-1]), 2.0

    def longer(samples: Part) -> Part:
        last = np.flatnonzero(samples.t > end - period)
        again = samples.select(last)
        rounds = range(1, round(seconds / period) + 1)
        return type(samples).joined([samples] + [replace(again, t=again.t + period * r) for r in rounds])

    return replace(
        drive, imu=longer(drive.imu), fix=longer(drive.fix), velocity=longer(drive.velocity), heading=None
    )


@pytest.mark.long
def test_from_a_phone_to_a_calibrated_twin(three_passes: Drive, repository: Path, tmp_path: Path) -> None:
    file = repository / "bags" / "bump_15kmh" / "twin.yaml"
    done = run(driven_on(three_passes, 120.0), file, tmp_path, "--max-generations", "1")
    assert done.returncode == 0, done.stderr
    for line in ("Stand still: gyroscope bias 0.3", "Pass 1: 14.9 km/h", "Pass 3: 14.9 km/h"):
        assert line in done.stderr
    said = next(line for line in done.stdout.splitlines() if line.startswith("Calibrated: gap "))
    before, after = (
        float(part.split()[0]) for part in said.removeprefix("Calibrated: gap ").split("m/s² before, ")
    )
    assert 0.2 < before < 0.3 and after < 0.8 * before
    found = load_twin(tmp_path / "calibrated.yaml")
    assert found.vehicle != load_twin(file).vehicle
    recorded = read_drive(tmp_path / "drive").imu.t[-1]
    assert recorded < three_passes.imu.t[-1] + 60.0, "it ends by itself, while the phone goes on"


@pytest.mark.long
def test_from_a_phone_alone_to_a_calibrated_twin(repository: Path, tmp_path: Path) -> None:
    """Its own receiver is metres off: what that costs is said before the bump, and each pass is placed by feel."""
    bags = repository / "bags"
    given = load_twin(bags / "bump_15kmh" / "twin.yaml")
    phone = load_twin(bags / "bump_phone" / "car.yaml")
    save_twin(given.model_copy(update={"imu": phone.imu, "gps": phone.gps}), tmp_path / "car.yaml")
    drive = driven_on(read_drive(bags / "bump_phone"), 120.0)
    done = run(drive, tmp_path / "car.yaml", tmp_path, "--max-generations", "4")
    assert done.returncode == 0, done.stderr
    assert done.stderr.index("as from a phone without RTK") < done.stderr.index("Pass 1: 1")
    assert "Pass 3: 1" in done.stderr
    assert "placed on the road by what was felt" in done.stdout and "Drive next: faster passes" in done.stdout
    assert load_twin(tmp_path / "calibrated.yaml").vehicle != given.vehicle


@pytest.mark.long
def test_a_drive_that_ends_early_is_kept(three_passes: Drive, repository: Path, tmp_path: Path) -> None:
    short = replace(
        three_passes, imu=three_passes.imu.select(three_passes.imu.t < three_passes.imu.t[0] + 14.0)
    )
    done = run(short, repository / "bags" / "bump_15kmh" / "twin.yaml", tmp_path)
    assert done.returncode == 1
    assert (
        "the drive ended after 1 of 3 passes" in done.stderr
        and f"calibrate --twin {repository}" in done.stderr
    )
    assert read_drive(tmp_path / "drive").imu.t.size > 1300
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]


def test_a_phone_that_sits_otherwise_ends_it_at_once(
    three_passes: Drive, twin: Twin, repository: Path, tmp_path: Path
) -> None:
    lying = three_passes.imu.specific_force[:, [0, 2, 1]]
    turned = replace(three_passes, imu=replace(three_passes.imu, specific_force=lying))
    turned = replace(turned, imu=turned.imu.select(np.arange(600)))
    done = run(turned, repository / "bags" / "bump_15kmh" / "twin.yaml", tmp_path)
    assert done.returncode == 2
    assert "imu.rpy" in done.stderr.splitlines()[-1] and "gravity lies" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_steps_follow_the_drive(three_passes: Drive, twin: Twin) -> None:
    guide = FirstDrive(twin)
    began = play(guide, three_passes)
    assert [name for _, name in began] == ["stand", "drive", "bump", "end"]
    times = [at for at, _ in began]
    assert 2.5 < times[1] < 4.0 < times[2] < 7.0 and 62.0 < times[3] < 68.0
    assert guide.standstill is not None and guide.standstill.mounting is None
    assert guide.standstill.force_noise == pytest.approx(0.015, rel=0.3)
    # the car stands on top of the bump at 10.9, 37.0 and 63.1 s
    middle = [0.5 * (p.start + p.end) - three_passes.imu.t[0] for p in guide.passes]
    np.testing.assert_allclose(middle, [10.8, 36.9, 62.9], atol=0.3)
    np.testing.assert_allclose([3.6 * p.speed for p in guide.passes], 15.0, atol=0.3)
    assert all(5.0 < p.shock < 8.0 for p in guide.passes)


def test_a_phones_positions_do(three_passes: Drive, twin: Twin) -> None:
    """3 m off, slowly wandering, without velocities: the passes are recognised all the same."""
    fix = three_passes.fix
    wander = (
        np.cumsum(np.random.default_rng(1).normal(size=(2, len(fix))), axis=1)
        * 3.0
        / np.sqrt(len(fix))
        / 1.1e5
    )
    rough = FixData(
        fix.t,
        fix.latitude + wander[0],
        fix.longitude + wander[1],
        fix.altitude,
        fix.status,
        np.full_like(fix.sigma, 3.0),
    )
    guide = FirstDrive(twin)
    play(guide, replace(three_passes, fix=rough, velocity=three_passes.velocity.select(np.arange(0))))
    assert len(guide.passes) == 3 and guide.position_sigma == 3.0
    np.testing.assert_allclose([3.6 * p.speed for p in guide.passes], 15.0, atol=3.0)


def test_a_way_past_the_bump_is_no_pass(three_passes: Drive, twin: Twin) -> None:
    aside = replace(three_passes.fix, latitude=three_passes.fix.latitude + 40.0 / 1.11e5)
    guide = FirstDrive(twin)
    play(guide, replace(three_passes, fix=aside))
    assert guide.standstill is not None and guide.passes == [] and not guide.done


def test_a_drive_without_standstill_stays_at_its_first_step(three_passes: Drive, twin: Twin) -> None:
    later = three_passes.imu.select(three_passes.imu.t > three_passes.imu.t[0] + 6.0)
    guide = FirstDrive(twin)
    moving = replace(three_passes, imu=later.select(later.t < later.t[0] + 58.0))
    assert play(guide, moving) == [(0.0, "stand")]
    assert guide.passes == []


def test_a_recording_that_is_played_again_begins_anew(three_passes: Drive, twin: Twin) -> None:
    guide = FirstDrive(twin)
    first = float(three_passes.imu.t[0])
    for samples in (three_passes.fix, three_passes.velocity, three_passes.imu):
        guide.add(samples.select(samples.t < first + 20.0))
    assert len(guide.passes) == 1
    thinned = replace(three_passes, imu=three_passes.imu.select(np.arange(len(three_passes.imu)) % 10 < 7))
    assert [name for _, name in play(guide, thinned)] == ["stand", "drive", "bump", "end"]
    assert len(guide.passes) == 3


def test_where_a_road_excites() -> None:
    first, last = excited_part(bump_road(half_sine(0.9, 0.05), at=20.0, length=40.0), (-0.8, 0.8))
    assert (first, last) == (pytest.approx(20.0, abs=0.3), pytest.approx(20.9, abs=0.3))
    with pytest.raises(InputError, match="is level"):
        excited_part(flat_road(40.0))


@pytest.mark.parametrize(
    ("twin", "words"),
    [
        ("config/twins/ford_mondeo_mk4.yaml", "road: is missing"),
        ("config/tracked/pt91.yaml", "is not driven on a road"),
    ],
)
def test_a_twin_that_cannot_be_driven_over_a_bump(
    twin: str, words: str, repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--twin", str(repository / twin), "--source", "sensorlogger://127.0.0.1:0"]
    out = ["--out", str(tmp_path / "a.yaml"), "--record", str(tmp_path / "a")]
    assert main(["first-drive", *given, *out]) == 2
    assert words in capsys.readouterr().err and list(tmp_path.iterdir()) == []
