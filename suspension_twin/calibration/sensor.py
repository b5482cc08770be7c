# SPDX-License-Identifier: Apache-2.0
"""What a calibration finds of the sensor, and which of it goes into the twin file.

The sensor's latency and the roll and pitch of its mounting are properties of the set-up: they hold on the next drive
too. A map's offset and the biases of one drive do not, and stay nuisance parameters.

Each drive has a clock offset c_i of its own, with the posterior covariance V. Its common value is the generalised least
squares estimate c = (1' V^-1 c_i) / (1' V^-1 1) with variance 1 / (1' V^-1 1). Where the c_i scatter by more than V
says (chi² above its degrees of freedom), the variance grows by chi² per degree of freedom (Birge's ratio).

A value x replaces the start x0 where that lowers the expected error of the calibrated vehicle on another drive. The
vehicle was fitted together with x and is not fitted again without it, so what counts is the standard deviation s of x
given the vehicle: leaving x out adds (x - x0)² and saves 2 s², in units of the sensitivity of the signals to x
(Mallows' Cp for one regressor that is dropped while the others are kept). The criterion is (x - x0)² > 2 s². The 90 %
interval that is reported is wider: it holds whatever the vehicle is.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from suspension_twin.arrays import Floats
from suspension_twin.calibration.recorder import Outcome
from suspension_twin.calibration.request import SensorEstimate
from suspension_twin.calibration.setup import Setup
from suspension_twin.calibration.uncertainty import HALF_WIDTH, Uncertainty
from suspension_twin.gap.mounting import turned
from suspension_twin.identification.nuisance import map_spread, slow_position_error
from suspension_twin.vehicle.twin import Twin

__all__ = ["common_offset", "sensor_estimates", "with_sensor"]

#: Variances that a regressor has to explain to be kept: Mallows' Cp.
_CP_PENALTY = 2.0
#: Standard deviations beyond which a map's offset contradicts its prior: the usual gate of three.
_GATE = 3.0


def sensor_estimates(
    setup: Setup, outcome: Outcome, uncertainty: Uncertainty, keep: bool = False
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
        found.append(_estimate("imu.latency", "s", start, start - offset, s, sigma, keep, p))
    for axis in ("roll", "pitch"):
        if f"tilt_{axis}" in names:
            row = names.index(f"tilt_{axis}")
            s, sigma = (float(np.sqrt(v[row, row])) for v in (given, marginal))
            # what turns the measured signals by an angle is a sensor that is turned by its opposite
            found.append(
                _estimate(f"mount.{axis}", "rad", 0.0, -float(outcome.nuisance[row]), s, sigma, keep)
            )
    return tuple(found)


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
    keep: bool,
    p: float = float("nan"),
) -> SensorEstimate:
    """``given`` is the standard deviation of ``value`` given the vehicle, ``sigma`` that whatever the vehicle is."""
    low, high = value - HALF_WIDTH * sigma, value + HALF_WIDTH * sigma
    written = not keep and (value - start) ** 2 > _CP_PENALTY * given**2
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
        if mean[0] ** 2 < _GATE**2 * (v[0, 0] + spread):
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
    return common, float(np.sqrt(variance)), float(chi2.sf(scatter, freedom))


def _speeds(setup: Setup) -> Floats:
    """(drives,) median speeds along the road in m/s where samples are compared."""
    problem = setup.problem
    along: dict[int, list[Floats]] = {}
    for part, rows, drive in zip(problem.parts, problem.rows, problem.drive_of, strict=True):
        along.setdefault(drive, []).append(np.abs(part.along[rows]))
    return np.array([float(np.median(np.concatenate(along[d]))) for d in sorted(along)])
