# SPDX-License-Identifier: Apache-2.0
"""The live lock message by message: what it says of itself, what it refuses, how it aligns, that no direction of the
compass is another."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.lock import AHEAD, MAX_FORCE, MAX_TURN, PAUSE, PlanarState, PoseLock
from suspension_twin.pose.types import PoseSettings
from suspension_twin.vehicle.twin import Datum, Place

DATUM = Datum(latitude=47.4, longitude=19.28, altitude=120.0)
MAP = LocalMap(DATUM)
G = 9.81
UP = (0.0, 0.0, G)
NONE = (0.0, 0.0, 0.0)
T0 = 1000.0
ARM = (0.8, -0.4)
Where = tuple[float, float, float]  # x, y, yaw


def fix(lock: PoseLock, t: float, x: float, y: float, sigma: float = 0.02, status: int = 2) -> None:
    """A fix at ``x``, ``y`` of the map."""
    latitude, longitude, _ = (float(v) for v in MAP.to_geodetic(np.array([x, y, 0.0])))
    lock.on_fix(t, latitude, longitude, math.nan, status, sigma, sigma)


def codes(lock: PoseLock) -> dict[str, str]:
    """Findings as code: level."""
    return {f.code: f.level for f in lock.findings}


class Car:
    """In a wide bend at a constant speed from ``start`` at T0; its antenna at ARM; samples and fixes without noise."""

    def __init__(self, speed: float = 5.0, turn: float = 0.0, start: Where = (10.0, -20.0, 0.7)) -> None:
        self.speed, self.turn, self.start = speed, turn, start

    def at(self, t: float) -> Where:
        """Where it is."""
        x, y, yaw = self.start
        s, angle = t - T0, self.turn * (t - T0)
        chord = self.speed * s * np.sinc(angle / 2.0 / math.pi)
        c, n = math.cos(yaw + 0.5 * angle), math.sin(yaw + 0.5 * angle)
        return x + chord * c, y + chord * n, yaw + angle

    def imu(self, lock: PoseLock, t: float) -> PlanarState | None:
        rough = 0.5 * math.sin(20.0 * (t - T0))  # a road shakes
        return lock.on_imu(t, (0.0, self.speed * self.turn, G + rough), (0.0, 0.0, self.turn))

    def fix(self, lock: PoseLock, t: float, sigma: float = 0.02) -> None:
        x, y, yaw = self.at(t)
        c, n = math.cos(yaw), math.sin(yaw)
        fix(lock, t, x + ARM[0] * c - ARM[1] * n, y + ARM[0] * n + ARM[1] * c, sigma)

    def velocity(self, lock: PoseLock, t: float) -> None:
        yaw = self.at(t)[2]
        ahead, left = self.speed - self.turn * ARM[1], self.turn * ARM[0]
        c, n = math.cos(yaw), math.sin(yaw)
        lock.on_velocity(t, ahead * c - left * n, ahead * n + left * c)

    def heading(self, lock: PoseLock, t: float) -> None:
        lock.on_heading(t, self.at(t)[2])

    def off(self, state: PlanarState) -> float:
        """Distance from where it truly is in m."""
        x, y, _ = self.at(state.t)
        return math.hypot(state.x - x, state.y - y)


def new(**given_: float) -> PoseLock:
    """A lock that is fed what no low-pass has delayed."""
    place = Place(frame="gps_link", position=(*ARM, 0.0))
    return PoseLock(PoseSettings(imu_delay=0.0, **given_), place, DATUM)


def drive(
    lock: PoseLock,
    car: Car,
    until: float,
    start: float = 0.0,
    say: Iterable[str] = ("fix", "velocity"),
    each: Callable[[float], None] = lambda t: None,
) -> list[PlanarState]:
    """IMU at 100 Hz and what is said at 10 Hz; seconds from T0."""
    out = []
    for k in range(round(start * 100), round(until * 100)):
        t = T0 + 0.01 * k
        if k % 10 == 0:
            for what in say:
                getattr(car, what)(lock, t)
        state = car.imu(lock, t)
        each(t)
        if state is not None:
            out.append(state)
    return out


# -- what it says of itself -----------------------------------------------------------------------


def test_before_anything_comes() -> None:
    lock = new()
    assert codes(lock) == {"no_imu": "warn"}
    assert lock.fix_age == math.inf
    assert math.isnan(lock.latency)
    assert not lock.aligned
    assert not lock.standing
    fix(lock, T0, 0.0, 0.0)
    assert codes(lock) == {"no_imu": "warn"}
    assert lock.fix_age == math.inf
    assert math.isnan(lock.latency)


def test_an_imu_without_fixes_has_no_pose() -> None:
    lock = new()
    for k in range(20):
        assert lock.on_imu(T0 + 0.01 * k, UP, NONE) is None
    assert codes(lock) == {"no_fix": "warn"}
    assert lock.fix_age == math.inf
    assert lock.counts["gaps"] == 1


def test_the_age_of_the_newest_fix() -> None:
    lock = new()
    lock.on_imu(T0, UP, NONE)
    fix(lock, T0 - 0.3, 0.0, 0.0)
    assert lock.fix_age == pytest.approx(0.3)
    lock.on_imu(T0 + 0.01, UP, NONE)
    assert lock.fix_age == pytest.approx(0.31)
    fix(lock, T0 - 0.1, 0.0, 0.0)
    fix(lock, T0 - 0.5, 0.0, 0.0)  # a late one is not the newest
    assert lock.fix_age == pytest.approx(0.11)


def test_the_latency_is_an_average_of_what_fixes_show() -> None:
    lock = new()
    lock.on_imu(T0, UP, NONE)
    fix(lock, T0 - 0.2, 0.0, 0.0)
    assert lock.latency == pytest.approx(0.2)
    fix(lock, T0 - 0.6, 0.0, 0.0)
    assert 0.2 < lock.latency < 0.3
    for _ in range(100):
        fix(lock, T0 - 0.7, 0.0, 0.0)
    assert lock.latency == pytest.approx(0.7, abs=1e-3)
    assert codes(lock)["latency"] == "warn"
    assert "0.70 s" in next(f.text for f in lock.findings if f.code == "latency")
    for _ in range(100):
        fix(lock, T0 - 0.4, 0.0, 0.0)
    assert "latency" not in codes(lock)


def test_a_lost_receiver_is_an_error_after_the_outage_allowed() -> None:
    lock, car = new(outage=1.5), Car()
    states = drive(lock, car, 3.0)
    assert states[-1].valid
    assert codes(lock) == {}
    valid = [s.valid for s in drive(lock, car, 6.0, 3.0, say=("velocity",))]
    assert sum(valid) == pytest.approx(
        143, abs=3
    )  # the last fix came 0.1 s before, and the filter lags by 0.03 s
    assert codes(lock) == {"fix_lost": "error"}
    assert "3.1 s" in lock.findings[0].text
    assert drive(lock, car, 7.0, 6.0)[-1].valid
    assert codes(lock) == {}


def test_outliers_are_counted_and_told() -> None:
    lock, car = new(), Car()
    drive(lock, car, 3.0)
    for k in range(2):
        fix(lock, T0 + 2.9 + 0.01 * k, 500.0, 500.0)
    lock.on_velocity(T0 + 2.95, -20.0, 30.0)
    assert lock.counts["refused"] == 3
    assert codes(lock) == {"outliers": "warn"}
    assert lock.findings[0].text.startswith("3 ")
    assert car.off(drive(lock, car, 3.5, 3.0)[-1]) < 0.01


# -- what it refuses ----------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, None, -1.0])
def test_no_sample_that_no_sensor_sends(axis: int, value: float | None) -> None:
    """On any axis, whatever the others show; the largest that one may send is used."""
    most = MAX_FORCE if axis < 3 else MAX_TURN
    lock = new()
    fix(lock, T0 - 0.5, 0.0, 0.0)
    lock.on_imu(T0, UP, NONE)
    sample = [*UP, *NONE]
    sample[axis] = most if value is None else value * most * 1.01
    assert lock.on_imu(T0 + 0.01, sample[:3], sample[3:]) is None
    assert lock.counts["invalid"] == 1
    sample[axis] = 0.99 * most
    assert lock.on_imu(T0 + 0.01, sample[:3], sample[3:]) is not None
    assert lock.counts["invalid"] == 1


@pytest.mark.parametrize(
    ("t", "latitude", "longitude", "status"),
    [
        (math.nan, 47.4, 19.28, 0),
        (T0, math.nan, 19.28, 0),
        (T0, 47.4, math.inf, 0),
        (T0, 90.5, 19.28, 0),
        (T0, -90.5, 19.28, 0),
        (T0, 47.4, 180.5, 0),
        (T0, 47.4, -180.5, 0),
        (T0, 47.4, 19.28, -1),
    ],
)
def test_no_fix_that_is_none(t: float, latitude: float, longitude: float, status: int) -> None:
    lock = PoseLock()
    lock.on_imu(T0, UP, NONE)
    lock.on_fix(t, latitude, longitude, 0.0, status)
    assert lock.counts["unusable"] == 1
    assert lock.datum is None
    assert lock.fix_age == math.inf
    assert lock.on_imu(T0 + 0.01, UP, NONE) is None


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(89.9, 19.0), (-89.9, 19.0), (10.0, 179.9), (10.0, -179.9)]
)
def test_a_fix_anywhere_on_earth(latitude: float, longitude: float) -> None:
    lock = PoseLock()
    lock.on_fix(T0, latitude, longitude, 50.0)
    assert lock.counts["unusable"] == 0
    assert lock.datum == Datum(latitude=latitude, longitude=longitude, altitude=50.0)


@pytest.mark.parametrize(
    ("altitude", "height"), [(math.nan, 0.0), (50_000.0, 0.0), (-5000.0, 0.0), (8000.0, 8000.0)]
)
def test_the_height_of_the_origin_is_the_fix_s_if_it_can_be(altitude: float, height: float) -> None:
    lock = PoseLock()
    lock.on_fix(T0, 47.0, 19.0, altitude)
    assert lock.datum is not None
    assert lock.datum.altitude == height


def test_no_velocity_or_heading_that_is_none() -> None:
    lock, car = new(), Car()
    drive(lock, car, 1.0)
    for t, east, north in (
        (math.nan, 1.0, 1.0),
        (T0, math.nan, 1.0),
        (T0, 1.0, math.inf),
        (T0, 120.0, 120.0),
    ):
        lock.on_velocity(t, east, north)
    lock.on_heading(math.nan, 0.0)
    lock.on_heading(T0, math.inf)
    assert lock.counts["unusable"] == 6
    assert car.off(drive(lock, car, 1.5, 1.0)[-1]) < 0.01


def test_late_samples_pauses_and_clocks_that_are_set_back() -> None:
    lock, car = new(), Car(start=(0.0, 0.0, 0.0))
    drive(lock, car, 2.0)
    for t in (T0 + 1.99, T0 + 1.5, T0 + 1.0):
        assert car.imu(lock, t) is None
    assert lock.counts["late"] == 3
    assert lock.counts["resets"] == 0
    gaps = lock.counts["gaps"]
    assert car.imu(lock, T0 + 2.0 + 0.9 * PAUSE) is not None  # a pause, after which something is left
    assert lock.counts["gaps"] == gaps + 1
    assert lock.aligned
    assert car.imu(lock, T0 + 2.0 + 2.0 * PAUSE) is None  # nothing is
    assert lock.counts["resets"] == 1
    assert not lock.aligned
    assert lock.counts["late"] == 0  # the counts are as new, but for that
    states = drive(lock, car, 1.0)  # the clock is set back
    assert lock.counts["resets"] == 1
    assert lock.aligned
    assert car.off(states[-1]) < 0.01


def test_too_late_and_from_the_future() -> None:
    lock, car = new(history=1.0), Car()
    drive(lock, car, 3.0)
    now = T0 + 2.99
    car.fix(lock, now - 0.9)
    assert lock.counts["too_late"] == 0
    car.fix(lock, now - 1.2)
    car.velocity(lock, now - 1.2)
    assert lock.counts["too_late"] == 2
    car.fix(lock, now + AHEAD - 0.2)
    assert lock.counts["from_the_future"] == 0
    car.fix(lock, now + AHEAD + 0.2)
    assert lock.counts["from_the_future"] == 1
    assert codes(lock) == {"too_late": "warn", "from_the_future": "warn"}
    assert [f.text[:2] for f in lock.findings] == ["2 ", "1 "]


# -- how it aligns ------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [0.0, 0.06])
@pytest.mark.parametrize(
    "say", [("fix", "velocity"), ("heading", "velocity", "fix"), ("velocity", "fix"), ("fix",)]
)
@pytest.mark.parametrize("yaw", [0.7, -2.8])
def test_without_noise_it_is_there_from_the_first(say: tuple[str, ...], turn: float, yaw: float) -> None:
    """By velocities, headings, or fixes alone that are metres apart; the antenna is beside base_link."""
    car = Car(15.0 if say == ("fix",) else 5.0, turn, (10.0, -20.0, yaw))
    lock = new()
    states = drive(lock, car, 6.0, say=say)
    valid = [s for s in states if s.valid]
    assert valid
    assert not any(s.valid for s in states[: len(states) - len(valid)])
    assert max(car.off(s) for s in valid[5:]) < (0.6 if say == ("fix",) else 0.03)
    last = valid[-1]
    assert car.off(last) < (0.05 if say == ("fix",) else 0.02)
    assert math.remainder(last.yaw - car.at(last.t)[2], 2.0 * math.pi) == pytest.approx(0.0, abs=0.02)
    assert last.motion.speed == pytest.approx(car.speed, abs=0.05)
    assert (last.motion.yaw_rate, last.motion.ay) == pytest.approx((turn, car.speed * turn), abs=0.02)
    assert last.motion.ax == pytest.approx(0.0, abs=0.06)
    assert lock.counts["refused"] == 0


@pytest.mark.parametrize(
    ("speed", "hertz", "sigma"), [(3.0, 10, 0.02), (9.5, 10, 0.02), (5.0, 1, 2.5), (20.0, 1, 2.5)]
)
def test_a_receiver_without_velocities_aligns_a_slow_car_too(speed: float, hertz: int, sigma: float) -> None:
    """However often its fixes come, and within ten seconds."""
    car, lock = Car(speed), new()
    for k in range(1200):
        t = T0 + 0.01 * k
        if k % (100 // hertz) == 0:
            car.fix(lock, t, sigma)
        state = car.imu(lock, t)
    assert lock.aligned and state is not None
    assert car.off(state) < 1.5 * sigma
    assert state.motion.speed == pytest.approx(speed, abs=0.3)


def test_a_heading_does_not_make_a_moving_car_stand() -> None:
    """Fixes say how fast it goes where no velocities come."""
    car, lock = Car(), new()
    states = drive(lock, car, 5.0, say=("heading", "fix"))
    assert max(car.off(s) for s in states if s.valid) < 0.3
    assert lock.counts["refused"] == 0
    assert states[-1].motion.speed == pytest.approx(5.0, abs=0.02)


def test_a_fix_that_is_older_than_the_velocity_is_driven_on_from() -> None:
    """One fix, four tenths later one velocity: the car has moved two metres between them, and two more since."""
    car, lock = Car(), new()
    for k in range(80):
        state = car.imu(lock, T0 + 0.01 * k)
    car.fix(lock, T0 + 0.205)
    car.velocity(lock, T0 + 0.605)
    state = car.imu(lock, T0 + 0.8)
    assert lock.aligned
    assert state is not None
    assert car.off(state) < 0.02
    assert state.motion.speed == pytest.approx(5.0, abs=0.02)


def test_before_the_first_sample_what_was_said_waits() -> None:
    """Fixes and velocities arrive ahead of the IMU's samples, by network: the pose is the same in the end."""
    car = Car(turn=0.2)
    early, prompt = new(), new()
    for k in range(6):
        car.fix(early, T0 + 0.105 + 0.1 * k)
        car.velocity(early, T0 + 0.105 + 0.1 * k)
    for k in range(100):
        t = T0 + 0.01 * k
        one = car.imu(early, t)
        if k >= 11 and k % 10 == 1 and k < 70:
            car.fix(prompt, t - 0.005)
            car.velocity(prompt, t - 0.005)
        other = car.imu(prompt, t)
    assert one is not None
    assert other is not None
    assert one[1:4] == pytest.approx(other[1:4], abs=0.01)
    assert one.motion.speed == pytest.approx(other.motion.speed, abs=0.01)
    assert car.off(one) < 0.02


def test_of_what_waits_the_newest_is_kept() -> None:
    """A receiver that runs for a quarter of a minute before the IMU does."""
    car, lock = Car(), new()
    for k in range(150):
        car.fix(lock, T0 - 15.0 + 0.1 * k)
        car.velocity(lock, T0 - 15.0 + 0.1 * k)
    car.fix(lock, T0 + 0.055)
    car.velocity(lock, T0 + 0.055)
    for k in range(20):
        state = car.imu(lock, T0 + 0.01 * k)
    assert lock.aligned
    assert state is not None
    assert car.off(state) < 0.02


def test_until_it_is_aligned_the_pose_is_the_fix_with_its_noise() -> None:
    lock = new()
    for k in range(50):
        state = lock.on_imu(T0 + 0.01 * k, UP, NONE)
    fix(lock, T0 + 0.4, 3.0, -4.0, 0.3)
    state = lock.on_imu(T0 + 0.5, UP, NONE)
    assert state is not None
    assert state[:3] == pytest.approx((T0 + 0.5, 3.0, -4.0), abs=1e-6)
    assert (state.yaw, *state.motion) == (0.0,) * 6
    assert not state.valid
    assert state.covariance == pytest.approx((0.09, 0.0, 0.0, 0.09, 0.0, math.pi**2))
    assert codes(lock) == {"not_aligned": "warn"}


# -- no direction is another --------------------------------------------------------------------


def turned_by(states: list[PlanarState], angle: float) -> np.ndarray:
    """Poses and covariances in a map that is turned about its origin."""
    c, s = math.cos(angle), math.sin(angle)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rows = []
    for state in states:
        xx, xy, xw, yy, yw, ww = state.covariance
        spread = rotation @ np.array([[xx, xy, xw], [xy, yy, yw], [xw, yw, ww]]) @ rotation.T
        place = rotation @ [state.x, state.y, 0.0]
        yaw = math.remainder(state.yaw + angle, 2.0 * math.pi)
        rows.append([*place[:2], yaw, *state.motion, *spread[np.triu_indices(3)]])
    return np.array(rows)


@given(st.floats(-3.0, 3.0))
@settings(max_examples=4, deadline=None)
def test_a_map_that_is_turned_has_the_same_drive_turned(angle: float) -> None:
    """Fixes that are lost for a second included: the covariance is turned as well."""

    def whole(car: Car) -> list[PlanarState]:
        lock = new()
        states = drive(lock, car, 1.0)
        return [*states, *drive(lock, car, 1.8, 1.0, say=()), *drive(lock, car, 2.2, 1.8)]

    x, y, yaw = 10.0, -20.0, 0.1
    c, s = math.cos(angle), math.sin(angle)
    plain = whole(Car(6.0, 0.2, (x, y, yaw)))
    there = whole(Car(6.0, 0.2, (x * c - y * s, x * s + y * c, yaw + angle)))
    np.testing.assert_allclose(turned_by(there, 0.0)[30:], turned_by(plain, angle)[30:], rtol=0, atol=1e-4)
    # while nothing is heard it knows less and less, across most of all
    lost = [p for p in plain if T0 + 1.2 < p.t < T0 + 1.79]
    assert (np.diff([p.covariance[0] + p.covariance[3] for p in lost]) > 0.0).all()
    assert plain[-1].covariance[3] < lost[-1].covariance[3]


def test_to_the_east_a_wrong_yaw_leads_to_the_north() -> None:
    lock, car = new(), Car(8.0, 0.0, (0.0, 0.0, 0.0))
    drive(lock, car, 1.0)
    xx, xy, xw, yy, yw, ww = drive(lock, car, 3.0, 1.0, say=())[-1].covariance
    assert yw > 0.3 * math.sqrt(yy * ww)
    assert abs(xw) < 0.05 * math.sqrt(xx * ww)
    assert abs(xy) < 0.05 * math.sqrt(xx * yy)
    assert min(xx, yy, ww) > 0.0
    assert ww < 0.1


def test_the_low_pass_s_delay_is_made_up_for() -> None:
    """Fed with samples that show what was a while ago, it says where the car is now."""
    car, delay = Car(9.0, 0.06), 0.05
    lock = PoseLock(PoseSettings(imu_delay=delay), Place(position=(*ARM, 0.0)), DATUM)
    for k in range(400):
        t = T0 + 0.01 * k
        if k % 10 == 0:
            car.fix(lock, t)
            car.velocity(lock, t)
        state = car.imu(lock, t)  # on a circle they are what they were
    assert state is not None
    assert state.t == pytest.approx(t)
    assert car.off(state) < 0.03  # it drives 0.7 m in that time
    assert math.remainder(state.yaw - car.at(t)[2], 2.0 * math.pi) == pytest.approx(0.0, abs=0.01)
    assert lock.fix_age == pytest.approx(0.09, abs=0.011)
