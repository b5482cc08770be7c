# SPDX-License-Identifier: Apache-2.0
"""The motion of a drive without positions: passes found by what was felt, the way between by the speed.

A bank of passes over the events of the road is simulated at constant speeds. Where felt and expected pattern of
vertical acceleration and pitch rate correlate, the vehicle passed, forward along the road; the delay between its axles,
a wheelbase over the speed, gives the speed as well. Speeds of passes, of a receiver or a wheel, and standstill are
fused with the longitudinal acceleration over the whole drive, forward and backward: a least squares problem with the
tridiagonal matrix of a random walk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solveh_banded
from scipy.signal import correlate

from suspension_twin.arrays import Floats, runs
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.inference.nuisance import OF_A_CALIBRATION
from suspension_twin.inference.priors import SINGLE
from suspension_twin.inference.sensor_correction import SensorCorrection
from suspension_twin.inference.synthetic import path_along
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.planar_denoising import felt_acceleration
from suspension_twin.pose.smoothed import locked_trajectory
from suspension_twin.pose.types import VELOCITY_SHARE, PoseSettings, Trajectory
from suspension_twin.road.recipe import FIRST_AT, Feature, make_road
from suspension_twin.road.road import Road
from suspension_twin.road.roughness import profile_events
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.ingest import ImuSettings
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.vehicle.twin import Datum, Twin

__all__ = ["FeltPass", "FeltRoad", "felt_passes", "felt_road", "felt_trajectory"]


#: m/s between which passes are looked for (tolerance, by hand: walking pace to 60 km/h), and the ratio of two speeds
#: next to each other (numerics): the axles' delay at 4 m/s differs by a sample of 50 Hz.
_SLOWEST, _FASTEST, _RATIO = 1.5, 16.0, 1.03
#: s before the first axle meets an event, and after the last one: the oscillation of a body at 1.3 Hz decays.
_BEFORE, _AFTER = 0.3, 1.5
#: s before that, in which a simulated vehicle settles (numerics: more than a period of a body at 1.3 Hz).
_SETTLE = 1.0
#: Correlation of felt and expected pattern of a pass: that of a pass of another bump of half the length is 0.6.
_ALIKE = 0.6
#: s of a drive's way that its speed alone carries from a pass on (tolerance, by hand: 0.1 m/s are 0.8 m then).
_CARRIED = 8.0
_HZ = 20.0  # nodes of the speed (numerics, by hand)
#: s of a standstill at least (tolerance, by hand): for a second or two smooth asphalt feels the same to an IMU.
_STILL = 3.0


@dataclass(frozen=True)
class FeltPass:
    """A pass: when ``t`` s the vehicle's origin was at ``u`` m of the road, its ``speed`` m/s, and the ``correlation``
    of felt and expected pattern."""

    t: float
    u: float
    speed: float
    correlation: float


def felt_passes(signals: ImuSignals, twin: Twin, road: Road, known: tuple[Floats, Floats]) -> list[FeltPass]:
    """Passes of the events of a road that a drive felt, in the order of time.

    ``known``: stamps (k,) s and speeds (k,) m/s of a receiver or a wheel, none for none.
    """
    conditioner = Conditioner.for_stamps(signals.t, FilterSpec(), zero_phase=True)
    felt = conditioner.apply(np.column_stack([signals.vertical_acceleration, signals.rate[:, 1]]))
    unit = np.sqrt(np.mean(felt**2, axis=0))
    felt = felt / unit
    at = np.arange(road.u_first, road.u_last, road.u_step)
    events = profile_events(road.heights_uv(at, np.zeros_like(at)), road.u_step, road.u_first)
    if not events:
        return []
    first, last = min(e.start for e in events), max(e.end for e in events)
    rate, vehicle = conditioner.rate, twin.vehicle
    count = int(np.log(_FASTEST / _SLOWEST) / np.log(_RATIO))
    best = np.full(conditioner.grid.size, -1.0)
    which, sigma = np.zeros(best.size), _doppler()
    for speed in _SLOWEST * _RATIO ** np.arange(count):
        length = (last - first + vehicle.wheelbase) / speed + _BEFORE + _AFTER
        t = np.arange(0.0, _SETTLE + length, 1.0 / rate)
        start = first - vehicle.wheelbase - (_SETTLE + _BEFORE) * speed
        path = path_along(road, t, ((0.0, speed), (float(t[-1]) + 1.0, speed)), start)
        response = simulate_twin(twin, excitation(path, vehicle, road))
        stacked = np.column_stack([response.vertical_acceleration, response.rate[:, 1]])
        own = Conditioner.for_stamps(t, FilterSpec(), zero_phase=True)
        pattern = own.apply(stacked)[int(_SETTLE * rate) :] / unit
        if pattern.shape[0] >= felt.shape[0]:
            continue
        found = _correlation(felt, pattern)
        # the time of the origin at the first event
        offset = int((_BEFORE + vehicle.wheelbase / speed) * rate)
        at_origin = np.full(best.size, -1.0)
        at_origin[offset : offset + found.size] = found[: best.size - offset]
        if known[0].size:
            off = (speed - np.interp(conditioner.grid, *known)) / np.hypot(sigma, (_RATIO - 1.0) * speed)
            at_origin = np.where(np.abs(off) < 3.0, at_origin, -1.0)
        better = at_origin > best
        best[better], which[better] = at_origin[better], speed
    passes = []
    left = best.copy()
    while left.size and left.max() > _ALIKE:
        peak = int(np.argmax(left))
        speed = float(which[peak])
        passes.append(FeltPass(float(conditioner.grid[peak]), first, speed, float(left[peak])))
        apart = (last - first + vehicle.wheelbase) / speed + _AFTER
        left[np.abs(conditioner.grid - conditioner.grid[peak]) < apart] = -1.0
    return sorted(passes, key=lambda p: p.t)


def _correlation(felt: Floats, pattern: Floats) -> Floats:
    """(n - m + 1,) correlation of ``pattern`` (m, C) with every stretch of ``felt`` (n, C)."""
    product = sum(correlate(felt[:, c], pattern[:, c], "valid") for c in range(felt.shape[1]))
    total = np.concatenate([[0.0], np.cumsum(np.sum(felt**2, axis=1))])
    m = pattern.shape[0]
    power = (total[m:] - total[:-m]) * float(np.sum(pattern**2))
    return np.asarray(product / np.sqrt(np.maximum(power, 1e-12)), dtype=np.float64)


def _doppler() -> float:
    """m/s, the standard deviation of a phone's speed: that of its fixes tells it."""
    return VELOCITY_SHARE * PoseSettings().fix_sigma


def _known_speeds(drive: Drive) -> tuple[Floats, Floats]:
    """Stamps (k,) s and speeds (k,) m/s of a drive's receiver or wheels."""
    velocity = drive.velocity
    good = np.isfinite(velocity.t) & np.isfinite(velocity.enu[:, :2]).all(axis=1)
    return velocity.t[good], np.hypot(*velocity.enu[good, :2].T)


@dataclass(frozen=True)
class FeltRoad:
    """A straight road with its ``features`` where a drive felt them: its start ``x``, ``y`` m in map and ``heading``
    rad; ``places`` m, the standard deviation of each against the first; the ``passes`` over the first."""

    features: tuple[Feature, ...]
    x: float
    y: float
    heading: float
    places: float
    passes: tuple[FeltPass, ...]


def felt_road(drive: Drive, twin: Twin, features: Sequence[Feature], datum: Datum | None) -> FeltRoad:
    """Lay a straight road where a drive felt its bumps.

    Each pass over all features is one of them after another, forward along the vehicle's course; a pass back along the
    road is turned. The road runs along the mean course, through the mean place of the first feature; of a drive without
    positions it begins at the origin of the map.

    Parameters
    ----------
    drive : Drive
        A recording of passes.
    twin : Twin
        A vehicle of that wheelbase.
    features : sequence of Feature
        In the order in which they are passed first; the first lies on the road where it says, ``FIRST_AT`` m from the
        start where it does not, and others at NaN m where they were felt.
    datum : Datum, optional
        Of the map; None of a drive without positions.

    Returns
    -------
    FeltRoad
        The features with their places, and the start of the road.

    Raises
    ------
    InputError
        Nothing was felt, or not as often as there are features.
    """
    correction = SensorCorrection.of_twin(twin)
    timed = correction.timed(drive)
    signals = correction.signals(timed, twin.imu, ImuSettings())
    known, first = _known_speeds(timed), features[0]
    at = FIRST_AT if math.isnan(first.at) else first.at
    alone = make_road(at + FIRST_AT, features=[replace(first, at=at)])
    felt = felt_passes(signals, twin, alone, known)
    count = len(features)
    if not felt or len(felt) % count:
        raise InputError(
            drive.name,
            f"{first} was felt {len(felt)} times: "
            + (
                f"a multiple of the {count} bumps is expected"
                if felt
                else "check its size and the twin's imu.rpy"
            ),
        )
    speed = _speed(signals, known, felt)
    way = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(signals.t) * (speed[1:] + speed[:-1]))])
    gone = np.interp([p.t for p in felt], signals.t, way).reshape(-1, count)
    apart = np.diff(gone, axis=1)
    spacing, runs_ = np.concatenate([[0.0], np.cumsum(apart.mean(axis=0))]), apart.shape[0]
    doubt = (_RATIO - 1.0) * float(spacing[-1]) / math.sqrt(runs_)
    placed = [
        replace(f, at=at + float(d)) if math.isnan(f.at) else f
        for f, d in zip(features, spacing, strict=True)
    ]
    firsts = tuple(felt[::count])
    if datum is None:
        return FeltRoad(tuple(placed), 0.0, 0.0, 0.0, doubt, firsts)
    path = locked_trajectory(timed, signals, twin.gps, datum, signals.t, upright=correction.upright)
    x, y, yaw = (np.interp([p.t for p in felt], path.t, c) for c in (path.x, path.y, path.yaw))
    half = 0.5 * first.size[0]
    middle = np.stack([x + half * np.cos(yaw), y + half * np.sin(yaw)], axis=1).reshape(-1, count, 2)
    back = np.cos(yaw[::count] - yaw[0]) < 0.0
    # a pass back along the road meets the first feature last
    course = yaw[::count] + np.where(back, math.pi, 0.0)
    heading = math.atan2(float(np.sin(course).mean()), float(np.cos(course).mean()))
    there = np.where(back[:, None], middle[:, -1], middle[:, 0]).mean(axis=0) - (at + half) * np.array(
        [math.cos(heading), math.sin(heading)]
    )
    return FeltRoad(tuple(placed), float(there[0]), float(there[1]), heading, doubt, firsts)


def felt_trajectory(drive: Drive, twin: Twin, signals: ImuSignals, road: Road) -> Trajectory:
    """The motion of a drive without positions, along the middle of its road.

    Parameters
    ----------
    drive : Drive
        A recording whose speeds are used where it has them.
    twin : Twin
        The twin as it is known before.
    signals : ImuSignals
        The IMU of the drive.
    road : Road
        A road with events.

    Returns
    -------
    Trajectory
        At the stamps of the IMU, valid near passes.

    Raises
    ------
    InputError
        The road has no events, or none was felt.
    """
    known = _known_speeds(drive)
    passes = felt_passes(signals, twin, road, known)
    if not passes:
        raise InputError(
            drive.name,
            f"no positions, and no pass over a bump of the road {road.name} is felt: record /fix and /vel too, or "
            "drive over a bump",
        )
    t = signals.t
    speed = _speed(signals, known, passes)
    way = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (speed[1:] + speed[:-1]))])
    times = np.array([p.t for p in passes])
    nearest = np.argmin(np.abs(t[:, None] - times[None, :]), axis=1)
    # a place that jumped would drag the wheels over all the road between in one step: it goes over in a quarter of the
    # time between two passes at least
    reach = np.minimum(0.375 * np.diff(times), _CARRIED)
    after, before = np.append(reach, _CARRIED), np.append(_CARRIED, reach)
    knots = np.stack([times - before, times + after], axis=1).ravel()
    u = way + np.interp(t, knots, np.repeat(np.array([p.u for p in passes]) - np.interp(times, t, way), 2))
    middle = np.full_like(u, 0.5 * (road.v[0] + road.v[-1]))
    x, y = road.uv_to_xy(u, middle)
    ahead, behind = (road.uv_to_xy(u + d, middle) for d in (0.25, -0.25))
    yaw = np.unwrap(np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0]))
    planar = FilterSpec(2, min(12.0, 0.4 * signals.rate_hz))  # as the pose of a drive with positions
    turn = zero_phase(planar, signals.rate_hz, signals.rate[:, 2])
    return Trajectory(
        t=t,
        x=x,
        y=y,
        yaw=yaw,
        velocity=np.column_stack([speed, np.zeros_like(speed)]),
        yaw_rate=turn,
        acceleration=np.column_stack([np.gradient(speed, t), speed * turn]),
        valid=np.asarray((t > (times - before)[nearest]) & (t < (times + after)[nearest])),
    )


def _speed(signals: ImuSignals, known: tuple[Floats, Floats], passes: list[FeltPass]) -> Floats:
    """(n,) m/s at the IMU's stamps, by speeds, standstill and longitudinal acceleration."""
    t = np.arange(signals.t[0], signals.t[-1] + 1.0 / _HZ, 1.0 / _HZ)
    pull = np.interp(t, signals.t, felt_acceleration(signals, 0.0)[0])
    standing = np.zeros(t.size, dtype=np.bool_)
    for first, end in runs(signals.standing):
        if signals.t[end - 1] - signals.t[first] >= _STILL:
            standing |= (t >= signals.t[first]) & (t <= signals.t[end - 1])
    rows = [
        (np.interp(known[0], t, np.arange(t.size)), known[1], np.full(known[0].size, _doppler())),
        (
            np.flatnonzero(standing).astype(float),
            np.zeros(int(standing.sum())),
            np.full(int(standing.sum()), 0.02),
        ),
    ]
    at = np.interp([p.t for p in passes], t, np.arange(t.size))
    own = np.array([p.speed for p in passes])
    rows.append((at, own, (_RATIO - 1.0) * own))
    dt, step = 1.0 / _HZ, _HZ / SINGLE["pull_density"]
    diagonal, beside, right = np.zeros(t.size), np.full(t.size, -step), np.zeros((t.size, 2))
    diagonal[:-1] += step
    diagonal[1:] += step
    # the changes of speed that are felt, and those that a bias of the acceleration of 1 m/s² takes off
    change = np.stack([0.5 * dt * (pull[1:] + pull[:-1]), np.full(t.size - 1, -dt)], axis=1)
    right[1:] += step * change
    right[:-1] -= step * change
    for places, values, sigma in rows:
        i = np.clip(np.rint(places).astype(int), 0, t.size - 1)
        np.add.at(diagonal, i, sigma**-2.0)
        np.add.at(right[:, 0], i, values * sigma**-2.0)
    beside[0] = 0.0
    plain, each = solveh_banded(np.stack([beside, diagonal]), right).T
    off, slope = np.diff(plain) - change[:, 0], np.diff(each) - change[:, 1]
    tilt = OF_A_CALIBRATION.tilt * signals.gravity
    bias = -step * dt * off.sum() / (step * dt * slope.sum() + tilt**-2.0)
    return np.asarray(np.maximum(np.interp(signals.t, t, plain + bias * each), 0.0))
