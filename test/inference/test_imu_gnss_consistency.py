# SPDX-License-Identifier: Apache-2.0
"""What IMU and receiver say of each other: clocks that differ, sensors that face elsewhere, rates in degrees."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import observe, with_shown_errors
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.imu_gnss_consistency import consistency, findings
from suspension_twin.road import ReferenceLine, Road, flat_road
from suspension_twin.road.crg import write_road
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.signals.offline import ingest_drive
from suspension_twin.vehicle.twin import EffectSpec, RoadFile, Twin, load_twin

KNOTS = [
    (0.0, 0.0),
    (3.0, 0.0),
    (7.0, 8.0),
    (11.0, 4.0),
    (15.0, 10.0),
    (20.0, 5.0),
    (24.0, 8.0),
    (30.0, 0.0),
    (33.0, 0.0),
]


@pytest.fixture(scope="module")
def drive(twin: Twin, bumps: Road) -> Drive:
    return synthetic_drive(twin, bumps, KNOTS, seed=4, errors=SensorErrors(), name="ride")


def late(drive: Drive, seconds: float) -> Drive:
    return replace(drive, imu=replace(drive.imu, t=drive.imu.t + seconds))


def facing(drive: Drive, yaw: float) -> Drive:
    """As a sensor records it that is turned by ``yaw`` against its mounting."""
    turn = rpy_matrix((0.0, 0.0, yaw))
    imu = drive.imu
    force, rate = imu.specific_force @ turn, imu.angular_rate @ turn
    return replace(drive, imu=replace(imu, specific_force=force, angular_rate=rate))


@pytest.fixture(scope="module")
def winding(twin: Twin) -> Drive:
    """A ride through bends, to the left and to the right: on a straight road no side shows."""
    u = np.arange(0.0, 300.0, 0.1)
    heading = 0.8 * np.sin(2.0 * np.pi * u / 120.0)
    x, y = np.cumsum(np.cos(heading)) * 0.1, np.cumsum(np.sin(heading)) * 0.1
    rough = np.random.default_rng(5).standard_normal((u.size // 5, 7)).repeat(5, axis=0) * 2e-3
    ends = (float(heading[0]), float(heading[-1]))
    road = Road("winding", rough, np.linspace(-3.0, 3.0, 7), ReferenceLine.level(x, y, 0.1, ends))
    return synthetic_drive(twin, road, KNOTS, seed=4, errors=SensorErrors(), name="ride")


def mirrored(drive: Drive, force: tuple[float, ...], rate: tuple[float, ...]) -> Drive:
    """With other signs of the axes of accelerometer and gyro."""
    imu = drive.imu
    felt, turned = imu.specific_force * np.array(force), imu.angular_rate * np.array(rate)
    return replace(drive, imu=replace(imu, specific_force=felt, angular_rate=turned))


@pytest.mark.parametrize("seconds", [-4.0, -0.6, 0.0, 0.35, 1.5, 5.0])
@pytest.mark.parametrize("yaw", [0.0, 1.5708, -2.8])
def test_delay_and_facing_are_told_apart(drive: Drive, twin: Twin, seconds: float, yaw: float) -> None:
    spoilt = late(facing(drive, yaw), seconds)
    told = consistency(spoilt, ingest_drive(spoilt, twin.imu), twin.gps)
    assert told is not None
    assert told.clock_offset == pytest.approx(seconds, abs=0.1)
    assert math.cos(told.yaw - yaw) > 0.99
    assert not told.mirrored and not told.reversed


@pytest.mark.parametrize("seconds", [0.0, -0.7])
@pytest.mark.parametrize(
    ("order", "force", "rate", "handed", "back"),
    [
        ((0, 1, 2), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0), False, False),
        ((0, 1, 2), (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), True, True),
        ((0, 1, 2), (1.0, -1.0, 1.0), (1.0, 1.0, 1.0), True, False),
        ((1, 0, 2), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0), True, False),
        ((0, 1, 2), (1.0, 1.0, 1.0), (-1.0, -1.0, -1.0), False, True),
        ((0, 1, 2), (1.0, 1.0, 1.0), (1.0, 1.0, -1.0), False, True),
    ],
    ids=["sound", "left-handed", "one axis", "two exchanged", "rates", "yaw rate"],
)
def test_wrong_signs_are_told_from_a_turned_sensor(
    winding: Drive,
    twin: Twin,
    seconds: float,
    order: tuple[int, ...],
    force: tuple[float, ...],
    rate: tuple[float, ...],
    handed: bool,
    back: bool,
) -> None:
    imu, axes = winding.imu, list(order)
    swapped = replace(imu, specific_force=imu.specific_force[:, axes], angular_rate=imu.angular_rate[:, axes])
    spoilt = late(mirrored(replace(winding, imu=swapped), force, rate), seconds)
    told = consistency(spoilt, ingest_drive(spoilt, twin.imu), twin.gps)
    assert told is not None and (told.mirrored, told.reversed) == (handed, back)
    assert told.clock_offset == pytest.approx(seconds, abs=0.1)


@pytest.mark.parametrize(
    ("force", "rate", "says"),
    [
        ((1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), "axes are mirrored"),
        ((1.0, 1.0, 1.0), (-1.0, -1.0, -1.0), "other way"),
    ],
)
def test_wrong_signs_are_refused_in_one_line(
    winding: Drive, twin: Twin, force: tuple[float, ...], rate: tuple[float, ...], says: str
) -> None:
    with pytest.raises(InputError, match=says) as told:
        observe(mirrored(winding, force, rate), twin, flat_road(), strict=True)
    assert str(told.value).startswith("ride: imu: ") and "\n" not in str(told.value)
    assert not any("other way" in w or "mirrored" in w for w in observe(winding, twin, flat_road()).warnings)


def test_a_sound_drive_has_nothing_to_say(drive: Drive, twin: Twin, bumps: Road) -> None:
    assert not any("clock" in w or "turned" in w or "gyro" in w for w in observe(drive, twin, bumps).warnings)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda d: late(d, 5.0), "5.0 s after the receiver's"),
        (lambda d: late(d, -5.0), "5.0 s before the receiver's"),
    ],
    ids=["late", "early"],
)
def test_what_no_answer_can_come_from_is_refused_in_one_line(
    drive: Drive, twin: Twin, bumps: Road, spoil: object, says: str
) -> None:
    spoilt = spoil(drive)  # type: ignore[operator]
    with pytest.raises(InputError, match=says) as told:
        observe(spoilt, twin, bumps, strict=True)
    assert str(told.value).startswith("ride") and "\n" not in str(told.value)
    assert any(says in w for w in observe(spoilt, twin, bumps).warnings)  # to look at, not to learn from


def in_degrees(drive: Drive) -> Drive:
    return replace(drive, imu=replace(drive.imu, angular_rate=np.degrees(drive.imu.angular_rate)))


def test_rates_that_braking_hides_are_asked_about(drive: Drive, twin: Twin, bumps: Road) -> None:
    """On a straight road no course says what the unit is, and braking turns what is felt more than the road does."""
    with pytest.raises(InputError, match="are its rates in °/s"):
        observe(in_degrees(drive), twin, bumps, strict=True)


def test_rates_in_degrees_are_named_and_converted(winding: Drive, twin: Twin) -> None:
    sound, found = (observe(d, twin, flat_road(), strict=True) for d in (winding, in_degrees(winding)))
    (text,) = set(found.warnings) - set(sound.warnings)
    assert text.startswith("angular rates come in °/s, taken times π/180") and "imu.rpy" not in text
    np.testing.assert_allclose(found.signals.rate, sound.signals.rate, atol=1e-9)


def test_what_a_diagnosis_may_find_is_a_warning(drive: Drive, twin: Twin, bumps: Road) -> None:
    assert any("0.8 s after" in w for w in observe(late(drive, 0.8), twin, bumps, strict=True).warnings)
    assert any("180°" in w for w in observe(facing(drive, math.pi), twin, bumps, strict=True).warnings)


def test_what_is_proposed_of_a_turned_and_tilted_sensor_needs_no_second_proposal(
    drive: Drive, twin: Twin, bumps: Road
) -> None:
    tilt, imu = rpy_matrix((0.02, -0.12, 3.0)), drive.imu
    turned = replace(imu, specific_force=imu.specific_force @ tilt, angular_rate=imu.angular_rate @ tilt)
    held = replace(drive, imu=turned)
    (line,) = (w for w in observe(held, twin, bumps, strict=True).warnings if "imu.rpy: [" in w)
    roll, pitch, yaw = json.loads(line.partition("imu.rpy: ")[2])
    told = twin.model_copy(update={"imu": twin.imu.model_copy(update={"rpy": (roll, pitch, yaw)})})
    assert not any("imu.rpy" in w for w in observe(held, told, bumps, strict=True).warnings)


@pytest.mark.parametrize("yaw", [1.6, math.pi])
def test_a_path_that_was_bent_by_a_sensor_is_not_asked_how_far_that_is_turned(
    drive: Drive, twin: Twin, bumps: Road, yaw: float
) -> None:
    spoilt = facing(drive, yaw)
    source = with_shown_errors(observe(spoilt, twin, bumps)).source
    assert source.shown is not None and source.shown.turn is not None
    turn = source.shown.turn
    found = source.excitation(source.correction(("sensor_tilt",), (), False))
    assert math.cos(turn[2] - yaw) > 0.999
    sound, right = observe(drive, twin, bumps), np.array(turn[:2])
    assert np.abs(right).max() < 0.02
    assert found.speed.max() == pytest.approx(sound.road_excitation.speed.max(), abs=0.1)


@pytest.mark.parametrize("seconds", [-1.1, 0.06, 0.7])
def test_a_clock_that_is_known_to_be_late_costs_nothing(
    drive: Drive, twin: Twin, bumps: Road, seconds: float
) -> None:
    spoilt = late(drive, seconds)
    knowing = twin.model_copy(
        update={"effects": (EffectSpec(id="time_offset", parameters={"offset": seconds}),)}
    )
    sound, known = observe(drive, twin, bumps), observe(spoilt, knowing, bumps)
    assert not any("after" in w or "before" in w for w in known.warnings)
    assert known.road_excitation.late == pytest.approx(seconds)
    assert np.array_equal(known.excitation.t, known.signals.t)
    gaps = [p.gap(p.condition(simulate_twin(p.twin, p.road_excitation))).rms for p in (sound, known)]
    assert gaps[1] == pytest.approx(gaps[0], rel=5e-3)
    unknown = observe(spoilt, twin, bumps)
    assert unknown.gap(unknown.condition(simulate_twin(twin, unknown.road_excitation))).rms > 1.3 * gaps[0]


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("seconds", [-1.1, 0.7])
def test_how_late_a_clock_is_seen_to_be_is_taken_off_the_motion(
    drive: Drive, twin: Twin, bumps: Road, seconds: float, upright: bool
) -> None:
    spoilt = late(drive, seconds)
    source = with_shown_errors(observe(spoilt, twin, bumps)).source
    seen = source.excitation(source.correction(("time_offset",), (), upright))
    assert seen.late == pytest.approx(seconds, abs=0.05)
    sound, bent = observe(drive, twin, bumps).road_excitation, observe(spoilt, twin, bumps).road_excitation
    off, more = (float(np.std(e.speed - sound.speed)) for e in (seen, bent))
    assert off < 0.3 * more


def test_a_clock_that_is_right_is_not_taken_off_the_motion(drive: Drive, twin: Twin, bumps: Road) -> None:
    shown = with_shown_errors(observe(drive, twin, bumps)).source.shown
    assert shown is not None and shown.clock == 0.0


def test_a_drive_that_hardly_moves_tells_nothing(drive: Drive, twin: Twin) -> None:
    stands = drive.imu.t < drive.imu.t[0] + 3.0
    imu = replace(
        drive.imu,
        t=drive.imu.t[stands],
        specific_force=drive.imu.specific_force[stands],
        angular_rate=drive.imu.angular_rate[stands],
    )
    short = replace(drive, imu=imu)
    assert consistency(short, ingest_drive(short, twin.imu), twin.gps) is None


def in_axes(drive: Drive, roll: float) -> Drive:
    turn = rpy_matrix((roll, 0.0, 0.0))
    imu = drive.imu
    return replace(
        drive,
        imu=replace(imu, specific_force=imu.specific_force @ turn, angular_rate=imu.angular_rate @ turn),
    )


def with_force(drive: Drive, scale: float, offset: float = 0.0) -> Drive:
    force = scale * drive.imu.specific_force + [0.0, 0.0, offset]
    return replace(drive, imu=replace(drive.imu, specific_force=force))


#: A fault, and the words of the one piece of advice that is right about it.
FAULTS = {
    "sound": (lambda d: d, None),
    "g": (lambda d: with_force(d, 1.0 / 9.80665), "come in g"),
    "times ten": (lambda d: with_force(d, 10.0), "check units and scale"),
    "removed": (lambda d: with_force(d, 1.0, -9.81), "gravity is already removed"),
    "degrees": (
        lambda d: replace(d, imu=replace(d.imu, angular_rate=np.degrees(d.imu.angular_rate))),
        "come in °/s",
    ),
    "clock": (lambda d: late(d, 4.0), "give both one clock"),
    "yaw": (lambda d: facing(d, -1.5708), "about the vertical against imu.rpy"),
    "roll": (lambda d: in_axes(d, 1.0), "off z"),
    "mirrored": (lambda d: mirrored(d, (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)), "mirrored"),
    "rates": (lambda d: mirrored(d, (1.0, 1.0, 1.0), (-1.0, -1.0, -1.0)), "other way"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_gets_its_own_advice_and_no_other(winding: Drive, twin: Twin, fault: str) -> None:
    spoil, right = FAULTS[fault]
    said = [w for w in observe(spoil(winding), twin, flat_road()).warnings if "off the road" not in w]
    others = [words for _, words in FAULTS.values() if words and words != right]
    assert right is None or any(right in line for line in said), said
    assert not any(words in line for line in said for words in others), said
    if fault not in ("yaw", "roll"):
        assert not any("imu.rpy" in line for line in said), said


def test_a_map_that_starts_anywhere_is_said_instead_of_the_road(
    drive: Drive, twin: Twin, bumps: Road, tmp_path: Path
) -> None:
    write_road(bumps, tmp_path / "road.crg")
    placed = twin.model_copy(update={"road": RoadFile(file=tmp_path / "road.crg")})
    assert not any("datum" in w for w in observe(drive, placed).warnings)
    nowhere = observe(drive, placed.model_copy(update={"datum": None}))
    assert [w for w in nowhere.warnings if "no datum: the map starts at the first fix" in w]
    assert not any("off the road" in w for w in nowhere.warnings)


def test_a_few_seconds_of_driving_tell_no_long_delay(twin: Twin, bumps: Road) -> None:
    """What was felt 26 s before is by chance more like the motion than what was felt then: nine seconds prove
    nothing."""
    knots = [(0.0, 0.0), (30.0, 0.0), (33.0, 4.0), (36.0, 2.0), (39.0, 0.0), (60.0, 0.0)]
    brief = synthetic_drive(twin, bumps, knots, seed=4, errors=SensorErrors(), name="ride")
    imu, t = brief.imu, brief.imu.t - brief.imu.t[0]
    force = imu.specific_force.copy()
    moving, before = (t > 29.0) & (t < 40.0), (t > 3.0) & (t < 14.0)
    force[before, 0] += np.interp(t[before] + 26.0, t, imu.specific_force[:, 0] - imu.specific_force[0, 0])
    force[moving, 0] += 2.5 * np.sin(2.0 * np.pi * 0.25 * t[moving])
    spoilt = replace(brief, imu=replace(imu, specific_force=force))
    told = consistency(spoilt, ingest_drive(spoilt, twin.imu), twin.gps)
    assert told is None or abs(told.clock_offset) <= 2.0


@pytest.mark.parametrize(
    ("bag", "late", "velocities"),
    [("bump_phone", 0.4, True), ("bump_15kmh", 0.0, True), ("bump_15kmh", 0.0, False)],
)
def test_a_receiver_is_as_late_as_its_stamps(
    repository: Path, bag: str, late: float, velocities: bool
) -> None:
    """Seconds that are taken off the stamps are off the offset."""
    (described,) = (
        p for name in ("car", "twin") if (p := repository / "bags" / bag / f"{name}.yaml").exists()
    )
    twin, drive = load_twin(described), read_drive(repository / "bags" / bag)
    signals = ingest_drive(drive, twin.imu)
    found = []
    for seconds in (0.0, 0.25, 0.4, 0.8):
        fix = replace(drive.fix, t=drive.fix.t - seconds)
        velocity = replace(drive.velocity, t=drive.velocity.t - seconds)
        if not velocities:
            velocity = VelocityData(np.empty(0), np.empty((0, 3)))
        told = consistency(replace(drive, fix=fix, velocity=velocity), signals, twin.gps)
        assert told is not None
        found.append(told.clock_offset - seconds)
        assert abs(found[-1] + late) < 3.0 * told.clock_sigma < 0.2
    np.testing.assert_allclose(found, found[0], atol=0.02)


def test_few_seconds_say_how_little_they_tell(drive: Drive, twin: Twin) -> None:
    signals = ingest_drive(drive, twin.imu)
    whole = consistency(drive, signals, twin.gps)
    early = drive.velocity.t < drive.imu.t[0] + 15.0
    brief = consistency(replace(drive, velocity=drive.velocity.select(early)), signals, twin.gps)
    assert whole is not None and brief is not None
    assert brief.clock_sigma > whole.clock_sigma
    assert abs(brief.clock_offset) < 3.0 * brief.clock_sigma


@pytest.mark.parametrize("stated", [True, False])
def test_altitudes_that_are_metres_off_turn_no_sensor(repository: Path, stated: bool) -> None:
    twin = load_twin(repository / "bags" / "bump_phone" / "car.yaml")
    drive = read_drive(repository / "bags" / "bump_phone")
    if not stated:
        drive = replace(drive, fix=replace(drive.fix, sigma=np.full_like(drive.fix.sigma, np.nan)))
    said = findings(drive, ingest_drive(drive, twin.imu), twin.gps)
    assert {f.code for f in said} == {"clocks"}


@pytest.mark.parametrize("degrees", [30.0, -60.0])
def test_a_sensor_that_turns_once_is_named_with_the_moment(
    winding: Drive, twin: Twin, degrees: float
) -> None:
    middle = 0.5 * (winding.imu.t[0] + winding.imu.t[-1])
    (said,) = swivelled(turned_from(winding, middle, math.radians(degrees)), twin)
    at = float(said.split(" at ")[1].split(" s")[0])
    assert at == pytest.approx(middle - winding.imu.t[0], abs=2.5)


def test_one_hard_stop_turns_no_sensor(twin: Twin, bumps: Road) -> None:
    """However far to the side it is felt: a body that leans and dives, as a soft or laden one does."""
    knots = [
        (0.0, 0.0),
        (3.0, 0.0),
        (9.0, 5.0),
        (15.0, 4.0),
        (21.0, 6.0),
        (26.0, 5.5),
        (28.0, 0.0),
        (32.0, 0.0),
    ]
    gentle = synthetic_drive(twin, bumps, knots, seed=4, errors=SensorErrors(), name="ride")
    assert swivelled(turned_from(gentle, gentle.imu.t[0] + 26.7, math.radians(30.0)), twin) == []


def turned_from(drive: Drive, moment: float, yaw: float) -> Drive:
    """The drive of a sensor that turns in its holder."""
    turned, later = facing(drive, yaw).imu, drive.imu.t[:, None] > moment
    force = np.where(later, turned.specific_force, drive.imu.specific_force)
    rate = np.where(later, turned.angular_rate, drive.imu.angular_rate)
    return replace(drive, imu=replace(drive.imu, specific_force=force, angular_rate=rate))


def swivelled(drive: Drive, twin: Twin) -> list[str]:
    said = findings(drive, ingest_drive(drive, twin.imu), twin.gps)
    return [f.text for f in said if f.code == "swivelled"]
