# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin new``: a twin file by questions or from a ready one."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.vehicle.new import Sizes, resized
from suspension_twin.vehicle.twin import load_twin

SMALL = Sizes("small car", 1000.0, 2.4, 1.4, 1.38, (1.5, 0.2, 1.1), (0.3, 0.0, 1.5))


@pytest.fixture
def mondeo_file(repository):
    return repository / "config" / "twins" / "ford_mondeo_mk4.yaml"


def test_a_resized_car_has_the_natural_frequencies_of_the_first(mondeo_file):
    """Bounce of each axle: sqrt(k / m) of the load that it carries."""
    base = load_twin(mondeo_file)
    small = resized(base, SMALL)
    assert small.vehicle.mass == 1000.0 and small.vehicle.cog[0] == pytest.approx(1.5 * 2.4 / 2.85, abs=1e-3)

    def frequencies(twin):
        found = []
        for axle in twin.vehicle.axles.values():
            x, force = axle.part.spring.points
            found.append(np.sqrt(force[0] / x[0] / axle.load))
        return found

    np.testing.assert_allclose(frequencies(small), frequencies(base), rtol=0.002)


def test_questions_are_asked_and_wrong_answers_asked_again(repository, tmp_path):
    answers = ["Opel Corsa", "light", "1180", "2.49", "", "1.45", "1.4", "0.3", "1.15", "", "", "1.48"]
    answers += ["no.crg", str(repository / "bags" / "bump_15kmh" / "road.crg"), "here", "-33.9, 70.6"]
    command = [sys.executable, "-m", "suspension_twin", "new", "--out", str(tmp_path / "twin.yaml")]
    done = subprocess.run(
        command, input="\n".join(answers) + "\n", capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Writes ") and "a number from 300 to 10000" in done.stderr
    assert "no.crg: no such file" in done.stderr
    twin = load_twin(tmp_path / "twin.yaml")
    assert twin.vehicle.name == "Opel Corsa" and twin.vehicle.mass == 1180.0
    assert twin.vehicle.front_track == 1.588 and twin.vehicle.rear_track == 1.45
    assert twin.imu.position == (1.4, 0.3, 1.15) and twin.gps.position == (0.0, 0.0, 1.48)
    assert twin.road.file.resolve() == repository / "bags" / "bump_15kmh" / "road.crg"
    assert "two numbers are needed" in done.stderr
    assert (twin.datum.latitude, twin.datum.longitude) == (-33.9, 70.6)


@pytest.mark.parametrize("ready", [True, False])
@pytest.mark.long
def test_the_datum_is_that_of_a_drive_or_said_to_be_missing(repository, tmp_path, ready):
    """Never that of the car whose numbers were taken."""
    road, drive = (repository / "bags" / "bump_15kmh" / name for name in ("road.crg", "."))
    fix = read_drive(drive).fix
    answers = [] if ready else [""] * 12
    for more in ([], ["--drive", str(drive)]):
        command = [
            sys.executable,
            "-m",
            "suspension_twin",
            "new",
            "--out",
            str(tmp_path / "twin.yaml"),
            "--force",
        ]
        command += ["--road", str(road), *(["--from", "bmw_320i"] if ready else []), *more]
        done = subprocess.run(command, input="\n".join(answers), capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        datum = load_twin(tmp_path / "twin.yaml").datum
        assert ("no datum: the map starts at the first fix" in done.stdout) == (not more)
        assert (None if datum is None else datum.latitude) == (fix.latitude[0] if more else None)


def test_from_a_ready_one_with_a_road(repository, tmp_path, capsys):
    road, out = repository / "bags" / "bump_15kmh" / "road.crg", tmp_path / "sub" / "twin.yaml"
    arguments = ["new", "--from", "bmw_320i", "--road", str(road), "--out", str(out)]
    assert main(arguments) == 0
    twin = load_twin(out)
    assert twin.vehicle == load_twin(repository / "config" / "twins" / "bmw_320i.yaml").vehicle
    assert twin.road.file.resolve() == road
    capsys.readouterr()
    assert main(arguments) == 2 and "--force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--from", "bmw320"], "did you mean bmw_320i?"),
        (["--from", "bmw_320i", "--road", "no.crg"], "no.crg: no such file"),
        (["--road", "no.crg"], "no.crg: no such file"),  # before anything is asked
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(more, words, tmp_path, capsys):
    assert main(["new", "--out", str(tmp_path / "twin.yaml"), *more]) == 2
    errors = capsys.readouterr().err
    assert words in errors and errors.count("\n") == 1 and not list(tmp_path.iterdir())


def test_without_anybody_to_ask_it_says_so(tmp_path):
    command = [sys.executable, "-m", "suspension_twin", "new", "--out", str(tmp_path / "twin.yaml")]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "--from takes a ready twin" in done.stderr.splitlines()[-1]
