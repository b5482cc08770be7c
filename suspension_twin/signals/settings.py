# SPDX-License-Identifier: Apache-2.0
"""How an IMU's signal is treated, the same live and offline."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from suspension_twin.errors import InputError
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.signals.standstill import StillLimits

__all__ = ["ImuSettings"]


@dataclass(frozen=True)
class ImuSettings:
    """How an IMU is treated, the same live and offline.

    Parameters
    ----------
    filter : FilterSpec
        The low-pass.
    convert_units : bool
        Multiply a sensor in g by 9.80665.
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
