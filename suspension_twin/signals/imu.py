# SPDX-License-Identifier: Apache-2.0
"""An IMU: how its signal is treated, its units, axes and biases, its standstill. The same live and offline."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening, uniform_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.drive.units import DEGREES, Units
from suspension_twin.errors import InputError
from suspension_twin.signals.attitude import level_rpy, normal_gravity, rpy_matrix, tilt_of
from suspension_twin.signals.checks import Finding, check_mounting, check_rate_units, check_units
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import Place

__all__ = [
    "MAX_TILT_DIFFERENCE",
    "STANDSTILL_FILTER",
    "STANDSTILL_FILTER_DELAY",
    "ImuReading",
    "ImuSettings",
    "StillLimits",
    "is_still",
    "rest_bias",
    "standstill_filter_step",
    "standstill_mask",
    "white_noise",
]

#: Low-pass before standstill is judged: an idling engine shakes above 20 Hz, a moving car below 10 Hz.
STANDSTILL_FILTER = FilterSpec(2, 10.0)
STANDSTILL_FILTER_DELAY = 2.0 / (2.0 * math.pi * 10.0)  # s
#: rad between the specific force and the gyro's vertical beyond which the vehicle accelerates.
MAX_TILT_DIFFERENCE = 0.03


@dataclass(frozen=True)
class StillLimits:
    """Limits that a standing car with its engine idling does not exceed within a window.

    ``window`` s; ``force`` m/s² and ``rate`` rad/s standard deviations of the noisiest axis below 10 Hz;
    ``turn`` rad/s the largest mean rate, all of it gyro bias. The limits lie between what a car with
    its engine running shows at rest (0.02 m/s², 0.0015 rad/s) and the least it shows on a smooth
    road (0.13 m/s², 0.007 rad/s).
    """

    window: float = 0.5
    force: float = 0.08
    rate: float = 0.005
    turn: float = 0.05


@compiled
def standstill_filter_step(stages: Floats, sample: Floats, dt: float) -> None:  # pragma: no cover - compiled
    """``STANDSTILL_FILTER`` for live samples of any rate: two poles at 10 Hz, delay ``STANDSTILL_FILTER_DELAY``.

    ``stages`` (3, k): the sample before, the first pole, the second pole, which is the result.
    """
    keep = math.exp(-2.0 * dt / STANDSTILL_FILTER_DELAY)
    share = 0.5 * (1.0 - keep)
    for k in range(sample.size):
        first = keep * stages[1, k] + share * (sample[k] + stages[0, k])
        stages[2, k] = keep * stages[2, k] + share * (first + stages[1, k])
        stages[1, k] = first
        stages[0, k] = sample[k]


def is_still(force_std: float, rate_std: float, turn: float, limits: StillLimits) -> bool:
    """Judge one window by its largest standard deviations and largest mean rate."""
    return force_std < limits.force and rate_std < limits.rate and turn < limits.turn


def standstill_mask(
    rate_hz: float, force: Floats, rate: Floats, limits: StillLimits, speed: Floats | None = None
) -> NDArray[np.bool_]:
    """(n,) True where the vehicle stands for at least two windows; ``speed`` (n,) m/s, NaN where not
    known, overrules the IMU above 0.3 m/s. The first and the last half window of a stop are left out."""
    size = max(round(limits.window * rate_hz), 5)
    if len(force) < size:
        return np.zeros(len(force), dtype=np.bool_)
    soft = FilterSpec(STANDSTILL_FILTER.order, min(STANDSTILL_FILTER.cutoff, 0.4 * rate_hz))
    force, rate = zero_phase(soft, rate_hz, force), zero_phase(soft, rate_hz, rate)

    def spread(values: Floats) -> tuple[Floats, Floats]:
        centred = values - np.median(values, axis=0)
        mean = uniform_filter1d(centred, size, axis=0, mode="nearest")
        square = uniform_filter1d(centred**2, size, axis=0, mode="nearest")
        deviation = np.sqrt(np.maximum(square - mean**2, 0.0))
        return deviation.max(axis=1), np.abs(mean + np.median(values, axis=0)).max(axis=1)

    force_std, _ = spread(force)
    rate_std, turn = spread(rate)
    still = (force_std < limits.force) & (rate_std < limits.rate) & (turn < limits.turn)
    if speed is not None:
        # A fast stretch beside the window rules it out too.
        moving = binary_dilation(np.nan_to_num(speed, nan=0.0) > 0.3, iterations=size // 2)
        still &= ~moving
    return np.asarray(binary_opening(still, structure=np.ones(size, dtype=np.bool_)), dtype=np.bool_)


def rest_bias(mean_force: Floats, gravity: float, limit: float) -> Floats:
    """(3,) accelerometer bias from the mean specific force at rest, in nominally upright axes.

    A slope and a horizontal bias read the same. What lies within ``limit`` m/s² is taken for bias,
    a deviation from (0, 0, g) altogether; beyond it for a tilt, and only the error in length,
    along the measured vertical, is removed.
    """
    if math.hypot(float(mean_force[0]), float(mean_force[1])) <= limit and mean_force[2] > 0:
        return np.asarray(mean_force - np.array([0.0, 0.0, gravity]))
    length = float(np.linalg.norm(mean_force))
    return np.asarray(mean_force * (1.0 - gravity / length)) if length > 0 else np.zeros(3)


@dataclass(frozen=True)
class ImuSettings:
    """How an IMU is treated, the same live and offline.

    Parameters
    ----------
    filter : FilterSpec
        The low-pass.
    convert_units : bool
        Multiply a sensor in g by 9.80665, and one in °/s by π/180.
    restore_gravity : bool
        Add gravity where the phone has removed it.
    level : {"gross", "never", "always"}
        Whether axes are turned upright by gravity: only where they are more than 45° off, never (the twin
        file's mounting is the truth), or at any tilt seen at standstill. A small tilt is kept by default:
        it is a fact about the sensor that calibration and diagnosis need. The vertical acceleration is free
        of gravity in any case.
    max_bias : float
        Horizontal reading at rest in m/s² up to which it counts as bias; more is a tilt.
    latitude : float, optional
        Degrees, for normal gravity.
    full_scale, full_scale_rate : float, optional
        Ranges of the sensor in m/s² and rad/s where known.
    attitude_time : float
        Time constant in s with which the accelerometer corrects the gyroscope's attitude.
    still : StillLimits
        When a vehicle counts as standing.

    Examples
    --------
    >>> ImuSettings(full_scale=4 * 9.81).level
    'gross'
    """

    filter: FilterSpec = field(default_factory=FilterSpec)
    convert_units: bool = True
    restore_gravity: bool = True
    level: Literal["never", "gross", "always"] = "gross"
    max_bias: float = 0.3
    latitude: float | None = None
    full_scale: float | None = None
    full_scale_rate: float | None = None
    attitude_time: float = 8.0
    still: StillLimits = field(default_factory=StillLimits)

    def __post_init__(self) -> None:
        if self.level not in ("never", "gross", "always"):
            raise InputError("imu", "level", f"must be never, gross or always, is {self.level!r}")
        for name in ("max_bias", "attitude_time"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError("imu", name, f"must be above 0, is {value}")
        for name in ("full_scale", "full_scale_rate"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError("imu", name, f"must be above 0, is {value}")
        if self.latitude is not None and not -90 <= self.latitude <= 90:
            raise InputError("imu", "latitude", f"must lie between -90 and 90 degrees, is {self.latitude}")


class ImuReading:
    """Units, axes and biases of an IMU: how its readings become specific force and angular rate in ``base_link``.

    The decisions are those of the settings and the same live, over the windows seen so far, and offline, over a whole
    drive. ``gravity`` m/s²; ``scale`` from the unit sent to m/s², ``rate_scale`` to rad/s, ``unit`` that of what is
    handed on; ``level`` (3, 3) turns the mounting of the twin file upright; ``bias`` (6,) of force m/s² and rate rad/s
    in ``base_link`` axes.

    Parameters
    ----------
    settings : ImuSettings
        What may be converted, turned and removed.
    place : Place
        Mounting of the sensor by the twin file.
    latitude : float, optional
        Degrees, for normal gravity.
    """

    def __init__(self, settings: ImuSettings, place: Place, latitude: float | None) -> None:
        self.settings, self.place = settings, place
        self.gravity = normal_gravity(latitude)
        self.units: Units = "m/s2"
        self.scale = self.unit = self.rate_scale = 1.0
        self.mounting = rpy_matrix(place.rpy)
        self.level: Floats = np.eye(3)
        self.bias = np.zeros(6)

    @property
    def removed(self) -> bool:
        """Whether the sensor has removed gravity itself."""
        return self.units == "gravity removed"

    def take_units(self, units: Units, force: Floats) -> Finding | None:
        """Take ``units`` for those of ``force`` (n, 3) as it was sent; a finding where they are not m/s²."""
        self.units = units
        self.scale = STANDARD_GRAVITY if units == "g" else 1.0
        self.unit = 1.0 if self.settings.convert_units else self.scale
        return check_units(units, float(np.linalg.norm(force.mean(axis=0))))

    def take_rate_units(self, evidence: str) -> Finding | None:
        """Take angular rates for °/s where there is ``evidence`` of it; a finding then."""
        self.rate_scale = DEGREES if evidence and self.settings.convert_units else 1.0
        return check_rate_units(evidence, self.settings.convert_units)

    def check_level(self, mean: Floats) -> Finding | None:
        """A finding where ``mean`` (3,), the specific force at rest in today's axes, is not upright in the file's."""
        small = self.settings.max_bias / self.gravity
        return None if self.removed else check_mounting(self.level.T @ mean, self.place.rpy, small)

    def take_level(self, mean: Floats) -> Floats | None:
        """Turn the axes upright by ``mean`` (3,), as far as the settings allow; the turn (3, 3), None for none."""
        allowed, tilt = self.settings.level, tilt_of(mean)
        limit = {"gross": math.pi / 4, "always": self.settings.max_bias / self.gravity}.get(allowed, math.inf)
        if self.removed or not tilt > limit:
            return None
        turn = rpy_matrix(level_rpy(mean))
        self.level = turn @ self.level
        self.bias[:] = 0.0
        return turn

    def take_rest(self, force: Floats, rate: Floats) -> None:
        """Biases by the mean ``force`` (3,) and ``rate`` (3,) at rest."""
        limit = self.settings.max_bias
        self.bias[:3] = force if self.removed else rest_bias(force, self.gravity, limit)
        self.bias[3:] = rate


def white_noise(samples: Floats) -> float:
    """Standard deviation of the white noise on an axis of ``samples`` (n, 3) at rest: of their differences, so that a
    car that rocks on its springs does not count as noise."""
    return (
        float(np.sqrt(np.mean(np.var(np.diff(samples, axis=0), axis=0)) / 2.0)) if len(samples) > 1 else 0.0
    )
