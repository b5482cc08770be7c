# SPDX-License-Identifier: Apache-2.0
"""Faults put into recordings: each does to samples and stamps what it says, and its severity is measured on them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.vehicle.twin import load_twin

RPY = (0.02, -0.1, 2.9)


@pytest.fixture(scope="module")
def drive(repository: Path) -> Drive:
    """A bundled drive as a sensor that is turned by ``RPY`` records it."""
    given = read_drive(repository / "bags" / "crg_road")
    own = Rotation.from_euler("xyz", load_twin(repository / "bags" / "crg_road" / "twin.yaml").imu.rpy)
    mount = own.inv() * Rotation.from_euler("xyz", RPY)
    imu = replace(
        given.imu,
        specific_force=mount.apply(given.imu.specific_force, inverse=True),
        angular_rate=mount.apply(given.imu.angular_rate, inverse=True),
    )
    return replace(given, imu=imu)


def test_a_tilt_is_undone_by_a_mounting_that_has_it(drive: Drive) -> None:
    from blind.measured import planar, spoiled

    tilt = {"roll": 0.05, "pitch": -0.08, "yaw": 0.2}
    tilted = spoiled(drive, RPY, {"sensor_tilt": tilt}, 1)
    turn = Rotation.from_euler("xyz", [tilt[a] for a in ("roll", "pitch", "yaw")])
    mounted = tuple((turn * Rotation.from_euler("xyz", RPY)).as_euler("xyz"))
    plain, wrong, right = (planar(*args)[1] for args in ((drive, RPY), (tilted, RPY), (tilted, mounted)))
    np.testing.assert_allclose(right, plain, atol=1e-9)
    # nose up by 0.08 rad: gravity is felt along the road
    assert (wrong - plain)[:, 0].mean() == pytest.approx(9.81 * np.sin(0.08), rel=0.1)


def test_a_late_clock_is_late_by_its_offset_and_one_that_drifts_by_what_it_has_drifted(drive: Drive) -> None:
    from blind.measured import spoiled

    faults = {"time_offset": {"offset": 0.2}, "clock_drift": {"drift_ppm": 1000.0}}
    late = spoiled(drive, RPY, faults, 1).imu.t - drive.imu.t
    assert late[0] == pytest.approx(0.2, abs=1e-6)
    assert late[-1] == pytest.approx(0.2 + 1e-3 * (drive.imu.t[-1] - drive.imu.t[0]), abs=1e-6)


@pytest.mark.parametrize(
    ("fault", "values"),
    [
        ("receiver_smoothing", {"time": 0.5}),
        ("receiver_multipath", {"sigma": 1.0, "time": 4.0}),
        ("held_fixes", {"seconds": 1.0, "every": 6.0}),
    ],
)
def test_a_fault_of_the_receiver_moves_its_fixes_and_not_the_imu(
    drive: Drive, fault: str, values: dict[str, float]
) -> None:
    from blind.measured import spoiled

    odd = spoiled(drive, RPY, {fault: values}, 3)
    assert np.array_equal(odd.imu.specific_force, drive.imu.specific_force)
    north = np.radians(odd.fix.latitude - drive.fix.latitude) * 6_371_000.0
    east = np.radians(odd.fix.longitude - drive.fix.longitude) * 6_371_000.0
    off = np.hypot(north, east * np.cos(np.radians(drive.fix.latitude)))
    speed = np.hypot(*drive.velocity.enu[:, :2].T).max()
    if fault == "receiver_smoothing":  # it lags by its time
        assert off.max() == pytest.approx(0.5 * speed, rel=0.15)
    elif fault == "held_fixes":  # at most by what is driven meanwhile
        assert 0.7 * speed < off.max() < 1.05 * speed
    else:
        assert 0.5 < np.sqrt(np.mean(off**2)) < 2.5


def test_a_severity_is_in_floors_of_the_sound_drive(drive: Drive) -> None:
    from blind.measured import Floor, found

    floor = Floor.of(drive, RPY)
    values, amount, severity = found("time_offset", 3.0, floor, 5)
    assert severity == pytest.approx(3.0, rel=0.15) and 0.0 < amount < 1.0
    less = floor.severity({"time_offset": {"offset": 0.5 * values["offset"]}}, 5)
    assert less == pytest.approx(1.5, rel=0.15)
    # what a bias explains is no severity
    biased = replace(drive.imu, specific_force=drive.imu.specific_force + 0.03)
    assert Floor.of(replace(drive, imu=biased), RPY).rms == pytest.approx(floor.rms, rel=0.05)


def test_the_plan_of_recordings_has_every_fault_with_a_reference_and_without() -> None:
    from blind.faults import RECORDED_LIBRARY, RECORDED_OUTSIDE
    from blind.plan import plan

    from suspension_twin.effects.registry import EFFECTS

    cases = plan("measured_dev")
    assert {c.reality for c in cases} == {"measured"}
    assert len({c.world for c in cases}) == len(cases)
    singles: Counter[Any] = Counter((c.effects[0], c.reference) for c in cases if c.kind == "single")
    assert set(singles) == {(e, r) for e in RECORDED_LIBRARY for r in (True, False)}
    assert not set(RECORDED_OUTSIDE) & set(EFFECTS) and set(RECORDED_LIBRARY) <= set(EFFECTS)
    assert {c.kind for c in cases[:20]} == {"single", "null", "outside", "excluded", "pair"}


def test_a_recorded_case_is_reproduced_by_its_number_and_holds_no_label(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SUSPENSION_TWIN_DATA", str(shared_data))
    from blind import measured
    from blind.plan import plan

    spec = next(c for c in plan("measured_dev") if c.effects == ("sensor_tilt",) and c.reference)
    monkeypatch.setattr(measured, "_QUARTER", 1.0)  # the short recording
    labels = [measured.make_case(spec, tmp_path / n / "cases", tmp_path / n / "sealed") for n in "ab"]
    assert labels[0] == labels[1] and labels[0]["source"] == "comma2k19"
    files = [p for p in (tmp_path / "a" / "cases").rglob("*") if p.is_file()]
    assert {p.relative_to(tmp_path / "a" / "cases" / spec.name).parts[0] for p in files} == {
        "drive_a",
        "reference",
        "twin.yaml",
    }
    assert all(b"sensor_tilt" not in p.read_bytes() for p in files)
    shown = read_drive(tmp_path / "a" / "cases" / spec.name / "drive_a").imu
    again = read_drive(tmp_path / "b" / "cases" / spec.name / "drive_a").imu
    assert np.array_equal(shown.specific_force, again.specific_force)


def test_the_plan_of_set_up_errors_has_gross_ones_before_and_after_alike_and_planar_motion() -> None:
    from blind.faults import RECORDED_LIBRARY, SET_UP_ERRORS, gross
    from blind.plan import plan

    cases = plan("setup_dev")
    assert {c.reality for c in cases} == {"newton", "multibody", "linkage", "flexible"}
    large = [c for c in cases if c.gross]
    assert {(c.effects[0], c.alike) for c in large} == {(e, a) for e in SET_UP_ERRORS for a in (True, False)}
    assert all(c.reference == c.alike and not c.planar for c in large)
    assert {c.effects[0] for c in cases if c.planar and c.kind == "single"} == set(RECORDED_LIBRARY)
    assert any(c.planar and c.reference and c.kind == "null" for c in cases)
    for case in large:
        size = {e: max(map(abs, gross(e, case.world).values())) for e in case.effects}
        least = {
            "position_offset": 0.3,
            "lateral_offset": 0.3,
            "time_offset": 0.08,
            "sensor_tilt": np.radians(10),
        }
        assert all(v >= least[e] - 1e-9 for e, v in size.items())


def test_a_planar_case_of_a_simulated_reality_has_no_road_and_a_reference_without_the_fault(
    tmp_path: Path,
) -> None:
    from blind import measured
    from blind.plan import plan
    from blind.world import make_world

    spec = next(
        c
        for c in plan("setup_dev")
        if c.planar and c.reference and c.kind == "single" and c.reality == "newton"
    )
    spec = replace(spec, effects=("time_offset",), severity=1.5, reality="flexible")
    label = measured.make_case(spec, tmp_path / "cases", tmp_path / "sealed")
    folder = tmp_path / "cases" / spec.name
    assert load_twin(folder / "twin.yaml").road is None
    assert not list(folder.glob("*.crg"))
    sound, late = (read_drive(folder / name) for name in ("reference", "drive_fast"))
    offset = label["faults"]["time_offset"]["offset"]
    assert label["reached"]["time_offset"]["severity"] == pytest.approx(1.5, rel=0.2)
    plans = make_world(spec.world).plans
    begins = [d.imu.t[0] - plans[n].start for d, n in ((sound, "reference"), (late, "drive_fast"))]
    assert abs(offset) > 0.02
    assert begins == pytest.approx([0.0, offset], abs=5e-3)
