# SPDX-License-Identifier: Apache-2.0
"""Corrections of the sensor: how far a drive shows a turn or a gain, and the excitation that is read without it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from suspension_twin.drive.types import Drive
from suspension_twin.inference.observation import Observation, observe, with_shown_errors
from suspension_twin.inference.sensor_correction import (
    SensorCorrection,
    gain_at_rest,
    heading_error,
    turned,
)
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.models.excitation import MOTION
from suspension_twin.models.types import Excitation
from suspension_twin.road import Road
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.signals.offline import ingest_drive
from suspension_twin.vehicle.twin import EffectSpec, Place, Twin

KNOTS = [(0.0, 0.0), (3.0, 0.0), (6.0, 5.0), (9.0, 2.0), (14.0, 6.0), (16.0, 0.0), (19.5, 0.0)]
TILT = {"roll": -0.09, "pitch": 0.07, "yaw": 0.3}


@pytest.fixture(scope="module")
def tilted(twin: Twin) -> Twin:
    return twin.model_copy(update={"effects": (EffectSpec(id="sensor_tilt", parameters=TILT),)})


@pytest.fixture(scope="module")
def recorded(tilted: Twin, bumps: Road) -> Drive:
    return synthetic_drive(tilted, bumps, KNOTS, seed=4, errors=SensorErrors(), name="tilted")


@pytest.fixture(scope="module")
def sound(twin: Twin, bumps: Road) -> Excitation:
    """What the same drive excites the vehicle with, measured by a sensor that stands as the file says."""
    drive = synthetic_drive(twin, bumps, KNOTS, seed=4, errors=SensorErrors(), name="sound")
    return observe(drive, twin, bumps).road_excitation


def read_for(effects: tuple[str, ...], observation: Observation, upright: bool = False) -> Excitation:
    """The excitation by a drive as a hypothesis with these effects reads it."""
    source = with_shown_errors(observation).source
    return source.excitation(source.correction(effects, (), upright))


def scaled(drive: Drive, gain: float) -> Drive:
    """The drive with its specific force times a gain."""
    return replace(drive, imu=replace(drive.imu, specific_force=drive.imu.specific_force * gain))


def off(found: Excitation, true: Excitation, what: str) -> float:
    column = MOTION.index(what)
    return float(np.sqrt(np.mean((found.motion[:, column] - true.motion[:, column]) ** 2)))


def test_a_further_turn_comes_after_the_one_in_the_file() -> None:
    place, rpy = Place(rpy=(0.2, -0.4, 1.1)), (0.05, 0.1, -0.6)
    reading = np.array([0.3, -2.0, 9.5])
    once = rpy_matrix(rpy) @ (rpy_matrix(place.rpy) @ reading)
    np.testing.assert_allclose(rpy_matrix(turned(place, rpy).rpy) @ reading, once, atol=1e-12)


def test_a_tilt_in_the_twin_file_gives_no_warning(
    recorded: Drive, tilted: Twin, twin: Twin, bumps: Road
) -> None:
    assert any("off upright" in w for w in observe(recorded, twin, bumps).warnings)
    assert not any("off upright" in w for w in observe(recorded, tilted, bumps).warnings)


@pytest.mark.parametrize("yaw", [-2.6, -0.4, 0.0, 0.05, 1.5])
def test_the_path_shows_which_way_an_upright_sensor_faces(
    drive: Drive, twin: Twin, bumps: Road, yaw: float
) -> None:
    prepared = observe(drive, twin, bumps)
    spun = ingest_drive(drive, turned(twin.imu, (0.0, 0.0, -yaw)))
    # the vertical, told by a path that goes elsewhere, bends after it: turned signals with the right one
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    exact = replace(prepared.signals, force=prepared.signals.force @ turn.T, up=prepared.signals.up @ turn.T)
    assert heading_error(exact, prepared.trajectory) == pytest.approx(yaw, abs=0.01)
    assert math.cos(heading_error(spun, prepared.trajectory) - yaw) > 0.85


def test_without_acceleration_there_is_no_heading_error(drive: Drive, twin: Twin, bumps: Road) -> None:
    prepared = observe(drive, twin, bumps)
    path = prepared.trajectory
    straight = replace(path, acceleration=0 * path.acceleration, yaw_rate=0 * path.yaw_rate)
    assert heading_error(prepared.signals, straight) == 0.0


@pytest.mark.parametrize("known", [False, True], ids=["shown by the drive", "in the twin file"])
def test_a_turned_sensor_does_not_push_the_vehicle(
    recorded: Drive, twin: Twin, tilted: Twin, bumps: Road, sound: Excitation, known: bool
) -> None:
    """By 17° of yaw a third of the braking is taken for a push to the side, which rolls the body."""
    plain = observe(recorded, twin, bumps)
    found = observe(recorded, tilted, bumps).road_excitation if known else read_for(("sensor_tilt",), plain)
    assert off(plain.road_excitation, sound, "ay") > 0.06
    for what in ("ax", "ay"):
        assert off(found, sound, what) < 0.01
        assert off(found, sound, what) < 0.3 * off(plain.road_excitation, sound, what)


@pytest.mark.parametrize("scale", [-0.3, 0.0, 0.25])
def test_gravity_shows_a_gain_and_a_bias_is_none(twin: Twin, bumps: Road, scale: float) -> None:
    errors = SensorErrors(force_bias=(0.05, -0.05, 0.1))
    drive = synthetic_drive(twin, bumps, KNOTS, seed=5, errors=errors, name="biased")
    gain = gain_at_rest(ingest_drive(scaled(drive, 1.0 + scale), twin.imu))
    assert gain == (1.0 if scale == 0.0 else pytest.approx(1.0 + scale, abs=0.02))


def test_a_drive_that_never_stands_shows_no_gain(drive: Drive, twin: Twin) -> None:
    signals = ingest_drive(scaled(drive, 2.0), twin.imu)
    assert gain_at_rest(signals) == pytest.approx(2.0, abs=0.02)
    assert gain_at_rest(replace(signals, standing=np.zeros_like(signals.standing))) == 1.0


@pytest.mark.parametrize("known", [False, True], ids=["shown by the drive", "in the twin file"])
def test_a_gain_of_the_sensor_does_not_push_the_vehicle(
    twin: Twin, bumps: Road, sound: Excitation, known: bool
) -> None:
    loud = twin.model_copy(update={"effects": (EffectSpec(id="sensor_scale", parameters={"scale": 0.4}),)})
    recorded = synthetic_drive(loud, bumps, KNOTS, seed=4, errors=SensorErrors(), name="loud")
    plain = observe(recorded, twin, bumps)
    found = observe(recorded, loud, bumps).road_excitation if known else read_for(("sensor_scale",), plain)
    assert off(found, sound, "ax") < 0.3 * off(plain.road_excitation, sound, "ax")
    assert off(found, sound, "ay") < 0.5 * off(plain.road_excitation, sound, "ay")
    if known:  # whatever else is asked of such a sensor
        known_loud = observe(recorded, loud, bumps)
        for again in (read_for((), known_loud, upright=True), read_for(("sensor_tilt",), known_loud)):
            assert off(again, sound, "ax") < 0.3 * off(plain.road_excitation, sound, "ax")


def test_a_sensor_without_a_gain_is_not_read_again(drive: Drive, twin: Twin, bumps: Road) -> None:
    source = with_shown_errors(observe(drive, twin, bumps)).source
    assert source.shown is not None and source.shown.gain == 1.0
    assert source.correction(("sensor_scale",), (), False) == SensorCorrection.of_twin(twin)


def test_a_correction_is_read_once(drive: Drive, twin: Twin, bumps: Road) -> None:
    """Readings of the same content share an excitation, whoever made them."""
    one, other = (with_shown_errors(observe(drive, twin, bumps)).source for _ in range(2))
    correction = SensorCorrection(upright=True)
    assert one == other and hash(one) == hash(other)
    assert one.excitation(correction) is other.excitation(correction)
    moved = replace(one, twin=twin.with_changes({"vehicle.cog.2": twin.vehicle.cog[2] + 0.1}))
    assert moved != one and moved.excitation(correction) is not one.excitation(correction)
