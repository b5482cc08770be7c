# SPDX-License-Identifier: Apache-2.0
"""Joint estimation of vehicle and road: a wrong vehicle is corrected over an unknown road, with its limits."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.addons.roads.drives.drives import road_from_drives
from suspension_twin.addons.roads.drives.estimate import STEP, RoadEstimate, RoadEstimateSettings
from suspension_twin.addons.roads.drives.inverse import known_heights
from suspension_twin.addons.roads.drives.passes import banded
from suspension_twin.addons.roads.drives.vehicle import PARAMETERS, scaled_twin
from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.road import Road, add_bump, half_sine
from suspension_twin.road.recipe import parse_feature
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

BAGS = Path(__file__).resolve().parents[4] / "bags"
NAMES = list(PARAMETERS)


@pytest.fixture(scope="module")
def twin() -> Twin:
    return load_twin(BAGS / "bump_15kmh" / "twin.yaml").with_changes({"road": None})


@pytest.fixture(scope="module")
def truth() -> Road:
    return add_bump(iso8608_road("B", 80.0, width=5.0, seed=5, step=0.05), half_sine(1.2, 0.05), 40.0)


@pytest.fixture(scope="module")
def drives(twin: Twin, truth: Road) -> list[Drive]:
    """At 6 and 11 m/s over 60 m."""
    made = []
    for number, speed in enumerate((6.0, 11.0)):
        t = 4.0 + 48.0 / speed
        knots = ((0.0, 0.0), (2.0, 0.0), (4.0, speed), (t, speed), (t + 1.5, 0.0), (t + 2.0, 0.0))
        made.append(synthetic_drive(twin, truth, knots, seed=number, u=6.0, name=f"drive_{number}"))
    return made


def error_of(found: RoadEstimate, truth: Road) -> float:
    """Rms in m, waves between 0.5 and 10 m, both wheel paths, ends left out."""
    k = (
        found.covered
        & (found.profiles.u > found.profiles.u[0] + 15.0)
        & (found.profiles.u < found.profiles.u[-1] - 15.0)
    )
    total = 0.0
    for heights, v in zip(
        found.profiles.middle, (0.5 * found.profiles.track, -0.5 * found.profiles.track), strict=True
    ):
        x, y = found.profiles.road().uv_to_xy(found.profiles.u, np.full(found.profiles.u.size, v))
        error = banded(heights - truth.heights(x, y, "hold"), STEP, 0.1, 2.0)[k]
        total += 0.5 * float(np.mean(error**2))
    return math.sqrt(total)


@pytest.mark.long
def test_a_wrong_vehicle_is_put_right_by_drives_over_an_unknown_road(
    twin: Twin, truth: Road, drives: list[Drive]
) -> None:
    wrong = np.zeros(len(NAMES))
    wrong[NAMES.index("front dampers")], wrong[NAMES.index("rear dampers")] = -0.5, 0.4
    given = scaled_twin(twin, wrong)
    alone = road_from_drives(drives, given, RoadEstimateSettings(iterations=3, samples=2))
    joint = road_from_drives(drives, given, RoadEstimateSettings(iterations=6, samples=3, joint=True))
    assert error_of(joint, truth) < 0.6 * error_of(alone, truth)
    vehicle = joint.vehicle
    assert vehicle is not None
    z = (vehicle.values + wrong) / vehicle.sigma
    assert np.abs(z).max() < 3.0
    spreads = np.array([p.prior.spread for p in PARAMETERS.values()])
    dampers = [NAMES.index(f"{axle} dampers") for axle in ("front", "rear")]
    assert np.abs(vehicle.values[dampers] + wrong[dampers]).max() < 0.2
    assert (vehicle.sigma < 1.001 * spreads).all() and (vehicle.sigma[dampers] < 0.15).all()
    # The uncertainty of the vehicle is in that of the road.
    assert 0.0 < vehicle.amplitude < 0.1
    # The twin that comes out makes the drive on the road that comes out.
    assert vehicle.twin.vehicle.front.damper_pull.force[0] == pytest.approx(
        given.vehicle.front.damper_pull.force[0] * math.exp(vehicle.values[dampers[0]])
    )


def test_a_common_factor_shows_on_no_road(twin: Twin, truth: Road, drives: list[Drive]) -> None:
    """Which is why the mass is taken from the twin file."""
    factor = np.array([math.log(1.2) if p.prior.log else 0.0 for p in PARAMETERS.values()])
    heavier = scaled_twin(twin, factor).with_changes({"vehicle.mass": 1.2 * twin.vehicle.mass})
    motions = [simulate_drive(drives[1], t, truth).response.vertical_acceleration for t in (twin, heavier)]
    assert np.std(motions[0]) > 0.3
    np.testing.assert_allclose(motions[1], motions[0], atol=1e-9)


def test_a_bump_of_known_size_is_found_and_its_heights_hold(truth: Road) -> None:
    """The estimate has nine tenths of the height, and a road under it."""
    z = 0.9 * truth.heights_uv(0.05 * np.arange(1600), 0.7)
    sides = np.array([z, z])
    known = known_heights(parse_feature("bump", "1.2x0.05@29"), sides, 0.05, 10.0)
    assert known.first * 0.05 == pytest.approx(40.0 - 0.3, abs=0.06)
    assert known.shape.max() == pytest.approx(0.05, abs=1e-3)
    right = known_heights(parse_feature("bump", "1.2x0.05@29:right"), sides, 0.05, 10.0)
    assert right.sides == (1,) and right.first == known.first
    # The adjoint is one: <F x, y> = <x, F' y>.
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((2, 1, 1600)), rng.standard_normal(known.target.shape)
    assert np.vdot(known.forward(x), y) == pytest.approx(np.vdot(x, known.adjoint(y, 1600)))
    # Heights that are the bump on any slope leave nothing.
    shape = np.zeros((2, 1, 1600))
    shape[0, 0, known.first : known.first + known.shape.size] = known.shape
    shape[0, 0] += 0.01 * np.arange(1600)
    np.testing.assert_allclose(known.forward(shape), known.target, atol=1e-9)
    for text, words in (("1.2x0.05@20", "within 3 m of 20 m"), ("1.2x0.05@68", "nothing of about that")):
        with pytest.raises(InputError, match=words):
            known_heights(parse_feature("bump", text), sides, 0.05, 10.0)


def test_the_command_writes_the_vehicle_and_names_open_directions(
    twin: Twin, drives: list[Drive], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_drive(drives[1], tmp_path / "drive")
    save_twin(twin, tmp_path / "twin.yaml")
    command = ["road", "drives", "--twin", str(tmp_path / "twin.yaml"), str(tmp_path / "drive")]
    out, vehicle = tmp_path / "a.crg", tmp_path / "vehicle.yaml"
    bump = ["--bump", "1.2x0.05@30", "--iterations", "3"]
    assert main([*command, "--out", str(out), "--joint", str(vehicle), *bump]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"Writes {out}, {tmp_path / 'a.json'}, {vehicle}\n")
    assert "front dampers" in said and "Not separable: a common factor" in said
    record = json.loads((tmp_path / "a.json").read_text())["joint"]
    assert [p["name"] for p in record["parameters"]] == NAMES
    assert all(p["interval"][0] < p["value"] < p["interval"][1] for p in record["parameters"])
    assert load_twin(vehicle).vehicle.mass == twin.vehicle.mass
    assert main([*command, "--out", str(out), "--force", "--joint", str(tmp_path / "twin.yaml")]) == 2
    assert "give another name" in capsys.readouterr().err
    assert main([*command, "--out", str(out), "--force", "--joint", str(vehicle), "--iterations", "2"]) == 2
    assert "--iterations: the vehicle of --joint is estimated from the third" in capsys.readouterr().err
    assert read_drive(tmp_path / "drive").imu.t.size == drives[1].imu.t.size
