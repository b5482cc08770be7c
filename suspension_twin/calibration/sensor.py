# SPDX-License-Identifier: Apache-2.0
"""Errors of the sensor that a calibration finds, and which of them go into the twin file.

The sensor's latency and the roll and pitch of its mounting are properties of the set-up: they hold on the next drive
too. A map's offset and the biases of one drive do not, and stay nuisance parameters.

Each drive has a clock offset c_i of its own, with the posterior covariance V. Its common value is the generalised least
squares estimate c = (1' V^-1 c_i) / (1' V^-1 1) with variance 1 / (1' V^-1 1). Where the c_i scatter by more than V
says (chi² above its degrees of freedom), the variance grows by chi² per degree of freedom (Birge's ratio).

Roll and pitch of the mounting have two witnesses: the fit, where a tilt mixes planar into vertical acceleration, and
gravity, which it turns into lateral and longitudinal acceleration, apart from the bias of the accelerometer (0.05 m/s²
is 0.3°). Where they agree within three standard deviations the estimate is their weighted mean, with Birge's ratio;
where they do not, the fitted tilt makes up for something else, and the file keeps its angle.

A value x replaces the start x0 where that lowers the expected error of the calibrated vehicle on another drive. The
vehicle was fitted together with x and is not fitted again without it, so what counts is the standard deviation s of x
given the vehicle: leaving x out adds (x - x0)² and saves 2 s², in units of the sensitivity of the signals to x
(Mallows' Cp for one regressor that is dropped while the others are kept). The criterion is (x - x0)² > 2 s². The 90 %
interval that is reported is wider: it holds whatever the vehicle is. A latency has to bring the twin nearer to its own
drives besides: fitted beside an offset of the map, which no twin file has, it may be that offset's counterpart. A
latency below zero is not written: the receiver's positions come late, which is no property of the sensor.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from suspension_twin.arrays import Floats
from suspension_twin.calibration.recorder import SearchOutcome
from suspension_twin.calibration.request import SensorEstimate
from suspension_twin.calibration.setup import Setup, problem_of
from suspension_twin.calibration.uncertainty import HALF_WIDTH, Uncertainty
from suspension_twin.inference.nuisance import (
    OF_A_CALIBRATION,
    NuisancePriors,
    map_spread,
    slow_position_error,
)
from suspension_twin.inference.objectives import parse_objective
from suspension_twin.inference.problem import REACH
from suspension_twin.inference.runs import TWO_PERIODS
from suspension_twin.inference.sensor_correction import turned
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import Twin

__all__ = ["common_offset", "sensor_estimates", "with_sensor"]

#: Channels in which gravity shows a tilt of the sensor, along x and y: about which axis, and the sign of what it adds.
_GRAVITY = {"longitudinal_acceleration": ("pitch", -1.0), "lateral_acceleration": ("roll", 1.0)}


def sensor_estimates(
    setup: Setup, outcome: SearchOutcome, uncertainty: Uncertainty, keep: bool = False
) -> tuple[SensorEstimate, ...]:
    """Latency of the sensor in s and roll and pitch of its mounting in rad, with their intervals; ``keep`` writes
    none of them."""
    names = outcome.problem.nuisances.names
    d, whole = len(uncertainty.space), uncertainty.posterior.covariance
    marginal = whole[d:, d:]
    given = marginal - whole[d:, :d] @ np.linalg.solve(whole[:d, :d], whole[:d, d:])
    found = []
    clocks = [
        names.index(f"{d.name}.clock_offset") for d in setup.drives if f"{d.name}.clock_offset" in names
    ]
    if clocks:
        start = setup.original.imu.latency
        (offset, s, p), (_, sigma, _) = (
            _common_clock(setup, outcome.nuisance, v, clocks) for v in (given, marginal)
        )
        # a sample cannot come before it is taken: what is late then is the receiver, or its clock
        keeps = keep or start < offset or not _closes(setup, outcome, clocks, offset)
        found.append(_estimate("imu.latency", "s", start, start - offset, s, sigma, keep=keeps, p=p))
    level = _by_gravity(setup, outcome) if "tilt_roll" in names else {}
    for axis in ("roll", "pitch"):
        if f"tilt_{axis}" not in names:
            continue
        row = names.index(f"tilt_{axis}")
        # what turns the measured signals by an angle is a sensor that is turned by its opposite
        witnesses = [(-float(outcome.nuisance[row]), v[row, row]) for v in (given, marginal)]
        others = [level[axis]] if axis in level else []
        (_, s, _), (value, sigma, p) = (common_offset(*_stacked([witness, *others])) for witness in witnesses)
        trusted = not p < chdtrc(1, REACH**2)  # the two witnesses agree
        found.append(_estimate(f"mount.{axis}", "rad", 0.0, value, s, sigma, keep=keep or not trusted, p=p))
    return tuple(found)


def _stacked(witnesses: list[tuple[float, float]]) -> tuple[Floats, Floats]:
    """(k,) values and their covariance (k, k) from pairs of value and variance."""
    values, variances = np.array(witnesses).T
    return values, np.diag(variances)


def _closes(setup: Setup, outcome: SearchOutcome, clocks: list[int], offset: float) -> bool:
    """Whether a common clock offset brings the calibrated twin nearer to its own drives, without the map offset that
    was fitted beside it: a twin file has none."""
    problem = outcome.problem
    # where a receiver's error was found, the drive stays: a twin file has a latency, and no place
    placed = np.array([".wander." in name for name in problem.nuisances.names], dtype=bool)
    kept = np.where(placed, outcome.nuisance - outcome.placed, -outcome.placed)
    nuisance = np.repeat(kept[:, None], 2, axis=1)
    nuisance[clocks] += np.array([0.0, offset]) - np.array(setup.lags)[:, None]
    signals, _ = problem.signals_of(outcome.values[:, None], np.zeros((0, 1)))
    without, with_it = setup.objective.costs(problem.likelihood.compared(signals, nuisance))
    return bool(with_it < without)


def _by_gravity(setup: Setup, outcome: SearchOutcome) -> dict[str, tuple[float, float]]:
    """Roll and pitch in rad by which the sensor is turned against the twin file, by gravity alone, and their variances;
    empty where a phone has taken gravity off itself, which leaves no trace of how it is turned.

    A straight line through the means of blocks, residual over simulated acceleration: its offset is the tilt times
    gravity, its slope what a body that leans more than the twin's adds. What reading the drive took off as a bias at
    rest is put back, because it holds the tilt.
    """
    known = outcome.problem.data
    if not all(np.ptp(part.signals.up, axis=0).any() for part in known.parts):
        return {}
    terms = parse_objective("euclidean", dict.fromkeys(_GRAVITY, 1.0))
    problem, _ = problem_of(setup.twin, outcome.problem.space, known, terms, NuisancePriors())
    signals, _ = problem.signals_of(outcome.values[:, None], np.zeros((0, 1)))
    simulated = problem.likelihood.compared(signals, np.zeros((0, 1)))[:, :, 0]
    taken_off = [
        np.repeat(part.signals.force_bias[None, :2], rows.size, axis=0)
        for part, rows in zip(known.parts, known.rows, strict=True)
    ]
    residual = problem.measured.values + np.concatenate(taken_off) - simulated
    size = max(1, round(TWO_PERIODS * problem.measured.rate))
    starts = np.concatenate([np.arange(s.start, s.stop, size) for s in problem.measured.segments])
    count = np.diff(np.append(starts, len(residual)))
    bias, found = OF_A_CALIBRATION.force_bias, {}
    for channel, (axis, sign) in enumerate(_GRAVITY.values()):
        means = (np.add.reduceat(v[:, channel], starts) / count for v in (residual, simulated))
        offset, variance = _offset(*means)
        found[axis] = sign * offset / STANDARD_GRAVITY, (variance + bias**2) / STANDARD_GRAVITY**2
    return found


def _offset(y: Floats, x: Floats) -> tuple[float, float]:
    """Offset of the straight line through blocks (n,), and its variance; without a slope where there are no more than
    two blocks for each of its coefficients."""
    design = np.stack([np.ones_like(x), x], axis=1) if y.size > 2 * 2 else np.ones((y.size, 1))
    inverse = np.linalg.pinv(design.T @ design)
    line = inverse @ (design.T @ y)
    scatter = float(np.sum((y - design @ line) ** 2)) / max(y.size - design.shape[1], 1)
    return float(line[0]), scatter * float(inverse[0, 0])


def with_sensor(twin: Twin, estimates: tuple[SensorEstimate, ...]) -> Twin:
    """The twin with those of the estimates that are to be written."""
    value = {e.key: e.value for e in estimates if e.written}
    rpy = value.get("mount.roll", 0.0), value.get("mount.pitch", 0.0), 0.0
    imu = twin.imu
    if any(rpy):
        imu = imu.model_copy(update={"rpy": turned(imu, rpy).rpy})
    imu = imu.model_copy(update={"latency": value.get("imu.latency", imu.latency)})
    return twin.model_copy(update={"imu": imu})


def _estimate(
    key: str,
    unit: str,
    start: float,
    value: float,
    given: float,
    sigma: float,
    *,
    keep: bool,
    p: float = float("nan"),
) -> SensorEstimate:
    """``given`` is the standard deviation of ``value`` given the vehicle, ``sigma`` that whatever the vehicle is."""
    low, high = value - HALF_WIDTH * sigma, value + HALF_WIDTH * sigma
    written = not keep and (value - start) ** 2 > 2.0 * given**2  # Mallows' Cp
    return SensorEstimate(key, unit, start, float(f"{value:.6g}"), low, high, written, p)


def _common_clock(
    setup: Setup, nuisance: Floats, covariance: Floats, clocks: list[int]
) -> tuple[float, float, float]:
    """As ``common_offset``, of the clock offsets of all drives in s, with what is known of map and receiver."""
    rows = list(clocks)
    names = setup.problem.nuisances.names
    slow = np.array([slow_position_error(d) for d in setup.drives])
    if "map_position" in names:
        rows.insert(0, names.index("map_position"))
    mean, v = nuisance[rows], covariance[np.ix_(rows, rows)]
    if len(rows) > len(clocks):
        # one drive at one speed shows the sum of clock and map: what receiver and survey say of the map settles it,
        # unless the drives contradict them
        spread = map_spread(setup.drives) ** 2 + float(slow[0] ** 2 if slow.size == 1 else 0.0)
        if mean[0] ** 2 < REACH**2 * (v[0, 0] + spread):
            gain = v[:, 0] / (v[0, 0] + spread)
            mean, v = mean - gain * mean[0], v - np.outer(gain, v[0])
        mean, v = mean[1:], v[1:, 1:]
    mean = mean + np.array(setup.lags)
    if mean.size > 1:
        v = v + np.diag((slow / _speeds(setup)) ** 2)
    return common_offset(mean, v)


def common_offset(offsets: Floats, covariance: Floats) -> tuple[float, float, float]:
    """The generalised least squares mean of ``offsets`` (k,) with ``covariance`` (k, k), its standard deviation with
    Birge's ratio, and the probability that k equal offsets scatter as much (NaN for k = 1)."""
    weight = np.linalg.solve(covariance, np.ones(offsets.size))
    variance = 1.0 / float(weight.sum())
    common = variance * float(weight @ offsets)
    freedom = offsets.size - 1
    if not freedom:
        return common, float(np.sqrt(variance)), float("nan")
    off = offsets - common
    scatter = float(off @ np.linalg.solve(covariance, off))
    variance *= max(scatter / freedom, 1.0)
    return common, float(np.sqrt(variance)), float(chdtrc(freedom, scatter))


def _speeds(setup: Setup) -> Floats:
    """(drives,) median speeds along the road in m/s where samples are compared."""
    data = setup.problem.data
    along: dict[int, list[Floats]] = {}
    for part, rows, drive in zip(data.parts, data.rows, data.drive_of, strict=True):
        along.setdefault(drive, []).append(np.abs(part.along[rows]))
    return np.array([float(np.median(np.concatenate(along[d]))) for d in sorted(along)])
