# SPDX-License-Identifier: Apache-2.0
"""Roads from drives: the road that was driven over comes back, with intervals that hold it, and limits are reported."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.addons.roads.drives.drives import DrivenPart, road_from_drives
from suspension_twin.addons.roads.drives.estimate import STEP, RoadEstimateSettings
from suspension_twin.addons.roads.drives.passes import banded, lags_along
from suspension_twin.addons.roads.drives.transfer import best_linear_approximation
from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.road import Road, add_bump, half_sine, load_road
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import Twin, load_twin

BAGS = Path(__file__).resolve().parents[4] / "bags"


@pytest.fixture(scope="module")
def twin() -> Twin:
    return load_twin(BAGS / "bump_15kmh" / "twin.yaml")


@pytest.fixture(scope="module")
def truth() -> Road:
    road = iso8608_road("B", 130.0, width=5.0, seed=5, step=0.05)
    road = add_bump(road, half_sine(1.2, 0.05), 55.0)
    return add_bump(road, half_sine(0.8, -0.04), 80.0, v_low=0.0)


def driven(twin: Twin, road: Road, speed: float, seed: int, errors: SensorErrors | None = None) -> Drive:
    seconds = 100.0 / speed
    knots = (
        (0.0, 0.0),
        (3.0, 0.0),
        (6.0, speed),
        (6.0 + seconds, speed),
        (8.0 + seconds, 0.0),
        (9.0 + seconds, 0.0),
    )
    return synthetic_drive(
        twin.with_changes({"road": None}), road, knots, u=6.0, errors=errors, seed=seed, name=f"drive_{seed}"
    )


def paths_of(road: Road, found_line: Road, track: float, u: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """True heights (2, n) under the wheel paths of a line."""
    out = []
    for v in (0.5 * track, -0.5 * track):
        x, y = found_line.uv_to_xy(u, np.full(u.size, v))
        out.append(road.heights(x, y, "hold"))
    return np.array(out)


def test_two_drives_give_the_road_and_its_intervals(twin: Twin, truth: Road) -> None:
    drives = [driven(twin, truth, 5.0, 1), driven(twin, truth, 10.0, 2)]
    found = road_from_drives(drives, twin, RoadEstimateSettings(iterations=4, samples=6))
    true = banded(
        paths_of(truth, found.profiles.road(), found.profiles.track, found.profiles.u), STEP, 0.1, 2.0
    )
    own, sigma = banded(found.profiles.middle, STEP, 0.1, 2.0), found.sigma()
    k = (
        found.covered
        & (found.profiles.u > found.profiles.u[0] + 18.0)
        & (found.profiles.u < found.profiles.u[-1] - 18.0)
    )
    assert k.sum() * STEP > 70.0
    for side in (0, 1):
        error = own[side, k] - true[side, k]
        assert np.corrcoef(own[side, k], true[side, k])[0, 1] > 0.985
        assert np.std(error) < 1e-3
        assert np.mean(np.abs(error) < 1.645 * sigma[side, k]) > 0.75
    # Waves that the car cannot show are reported: those beyond 20 m, and not those between 1 and 2 m.
    known = {w["longest"]: w["known"] for w in found.by_wavelength()}
    assert known[40.0] < 0.9 < 0.95 < known[2.5]


def test_an_independent_car_over_a_known_road(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bundled drive is not the twin's: its road comes back all the same, and the twin follows on it."""
    folder = BAGS / "crg_road"
    out, picture = tmp_path / "road.crg", tmp_path / "road.png"
    command = ["road", "drives", "--twin", str(folder / "twin.yaml"), str(folder), "--out", str(out)]
    assert main([*command, "--iterations", "3", "--picture", str(picture)]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"Writes {out}, {tmp_path / 'road.json'}, {picture}\n")
    assert "one drive: nothing checks its uncertainty" in said
    road, true = load_road(out), load_road(folder / "road.crg")
    record = json.loads((tmp_path / "road.json").read_text())
    found = np.array([road.heights_uv(road.u, side * 0.5 * record["track"]) for side in (1, -1)])
    wanted = paths_of(true, road, record["track"], road.u)
    k = (road.u > 10.0) & (road.u < road.u[-1] - 10.0)
    for side in (0, 1):
        a, b = (banded(z[side], road.u_step, 0.1, 2.0)[k] for z in (found, wanted))
        assert np.corrcoef(a, b)[0, 1] > 0.8
    assert picture.stat().st_size > 30_000
    assert len(record["per_metre"]["u"]) == pytest.approx(road.length, abs=2)
    # A comparison on it warns of its limits.
    moved = load_twin(folder / "twin.yaml").with_changes({"road.file": str(out)})
    simulated = simulate_drive(read_drive(folder), moved)
    assert any("only what changed since shows" in text for text in simulated.warnings)
    level = simulate_drive(read_drive(folder), load_twin(folder / "twin.yaml"))
    assert simulated.gap.rms < level.gap.rms


def test_a_phones_receiver_is_corrected_by_the_road_itself(twin: Twin, truth: Road) -> None:
    """Two drives whose fixes are metres apart along and across."""
    first, second = driven(twin, truth, 6.0, 3), driven(twin, truth, 9.0, 4)
    metre = 180.0 / np.pi / 6.37e6
    poor = []
    for drive, east, north in ((first, 0.0, 0.0), (second, 2.5, -2.0)):
        fix = replace(
            drive.fix,
            longitude=drive.fix.longitude + east * metre / np.cos(np.radians(drive.fix.latitude)),
            latitude=drive.fix.latitude + north * metre,
            sigma=np.full_like(drive.fix.sigma, 3.0),
        )
        poor.append(replace(drive, fix=fix))
    found = road_from_drives(poor, twin, RoadEstimateSettings(iterations=3, samples=2))
    middle = found.passes[1].base[found.passes[1].base.size // 2]
    assert middle == pytest.approx(-2.5, abs=0.3)
    # The map is as far off as the first drive's fixes; which place on the road a point of the line is, is not.
    u, _ = truth.xy_to_uv(found.profiles.line.x, found.profiles.line.y)
    true = banded(truth.heights_uv(u, 0.5 * found.profiles.track, "hold")[None], STEP, 0.1, 1.0)
    k = found.covered & (found.profiles.u > 25.0) & (found.profiles.u < found.profiles.u[-1] - 25.0)
    assert np.corrcoef(banded(found.profiles.middle, STEP, 0.1, 1.0)[0, k], true[0, k])[0, 1] > 0.9


def test_lags_are_found_along_the_road() -> None:
    z = banded(iso8608_road("C", 200.0, width=2.0, seed=2, step=0.05).z[:, :2].T, 0.05)
    u = 0.05 * np.arange(z.shape[1])
    wander = 1.5 + 0.8 * np.sin(2 * np.pi * u / 150.0)
    other = np.array([np.interp(u - wander, u, line) for line in z])
    at, lag, correlation = lags_along(z, other, 0.05, 6.0)
    np.testing.assert_allclose(lag, np.interp(at, u, wander), atol=0.35)
    assert correlation.min() > 0.7


def test_the_linear_twin_is_the_twin_where_that_is_known(twin: Twin) -> None:
    """Well below every resonance the body follows the road: heave is the mean of what the wheels meet."""
    f, gain = best_linear_approximation(twin, 100.0, 64e-6, 8.0)
    slow = (f > 0.15) & (f < 0.3)
    followed = gain[slow, 0, :].sum(axis=1) / -((2 * np.pi * f[slow]) ** 2)
    np.testing.assert_allclose(followed, 1.0, atol=0.12)
    # Left and right wheels roll the body in opposite directions.
    np.testing.assert_allclose(gain[slow, 2, 0], -gain[slow, 2, 1], rtol=0.05)
    assert abs(gain[f < 0.05]).max() == 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("beside", "m beside the first drive"),
        ("elsewhere", "nowhere on the road"),
        ("short", "s on the road"),
    ],
)
def test_drives_that_do_not_fit_are_named(change: str, words: str, twin: Twin, truth: Road) -> None:
    first = driven(twin, truth, 9.0, 5)
    metre = 180.0 / np.pi / 6.37e6
    other: Drive | DrivenPart = DrivenPart(first, 6.0, 9.0)
    if change != "short":
        shift = 1.5 if change == "beside" else 500.0
        fix = replace(first.fix, latitude=first.fix.latitude + shift * metre)
        other = replace(first, name="other", fix=fix)
    with pytest.raises(InputError, match=words) as caught:
        road_from_drives([first, other], twin, RoadEstimateSettings(iterations=1))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("laps", [0.95, 1.3])
@pytest.mark.parametrize("crosses", [False, True])
def test_a_drive_that_comes_back_to_its_own_way_is_refused(crosses: bool, laps: float, twin: Twin) -> None:
    """A circle of less than a lap is a road; more of it, or an eight, lies on itself."""
    a = np.linspace(0.4, 0.4 + laps * 2.0 * np.pi, 800)
    x, y = (22.0 * np.sin(a), 11.0 * np.sin(2.0 * a)) if crosses else (20.0 * np.cos(a), 20.0 * np.sin(a))
    line = Centreline(x, y, 0.05)
    road = road_over(line, np.zeros((line.x.size, 2)), np.array([-3.0, 3.0]), "loop")
    end = 4.0 + (line.length - 15.0) / 5.0
    knots = ((0.0, 0.0), (2.0, 0.0), (4.0, 5.0), (end, 5.0), (end + 2.0, 0.0), (end + 3.0, 0.0))
    drive = synthetic_drive(twin.with_changes({"road": None}), road, knots, u=2.0, seed=1, name="loop")
    if not crosses and laps < 1.0:
        assert road_from_drives([drive], twin, RoadEstimateSettings(1, 1)).profiles.heights.size
        return
    with pytest.raises(
        InputError, match=r"loop: comes after (\d+) s \(\d+ m\) to where it was after (\d+) s"
    ) as caught:
        road_from_drives([drive], twin, RoadEstimateSettings(1, 1))
    later, earlier = (int(s) for s in re.findall(r"after (\d+) s", str(caught.value)))
    places = [[np.interp(drive.fix.t[0] + s, drive.fix.t, c) for c in (drive.fix.latitude, drive.fix.longitude)]
              for s in (later, earlier)]  # fmt: skip
    apart = np.subtract(*places) * 6.37e6 * np.radians(1.0) * [1.0, np.cos(np.radians(drive.fix.latitude[0]))]
    assert np.hypot(*apart) < 5.0 * 1.5 + 1.5


def test_bad_arguments_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tracked = BAGS.parent / "config" / "tracked" / "pt91.yaml"
    car = BAGS / "bump_15kmh" / "twin.yaml"
    out = str(tmp_path / "a.crg")
    for twin_file, drive, words in (
        (tracked, str(BAGS / "bump_15kmh"), "a road is estimated with the axles of a car, tracked has none"),
        (car, f"{BAGS / 'bump_15kmh'}@30..20", "ends before it starts"),
        (car, str(tmp_path / "none"), "none"),
    ):
        assert main(["road", "drives", "--twin", str(twin_file), drive, "--out", out]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_part_of_a_drive_is_taken(twin: Twin, truth: Road, tmp_path: Path) -> None:
    write_drive(driven(twin, truth, 8.0, 6), tmp_path / "drive")
    out = tmp_path / "a.crg"
    car = str(BAGS / "bump_15kmh" / "twin.yaml")
    command = [
        "road",
        "drives",
        "--twin",
        car,
        f"{tmp_path / 'drive'}@7..13",
        "--iterations",
        "1",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    # 6 s at 8 m/s and the wheelbase, less what lies within the tapers.
    assert 30.0 < load_road(out).length < 55.0
