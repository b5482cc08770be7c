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

    ``filter`` the low-pass. ``convert_units`` takes a sensor in g times 9.80665; ``restore_gravity`` puts
    gravity back where the phone has removed it; both are reported. ``level``: "never" takes the twin
    file's mounting as the truth whatever gravity says (a disagreement is reported); "gross", the
    default, turns the axes upright only where gravity lies more than 45° off z, where the signs would
    be wrong otherwise; "always" turns out any tilt seen at standstill. A small tilt is left in by
    default because it is a fact about the sensor that calibration and diagnosis are to see; the
    vertical acceleration is free of gravity all the same.
    ``max_bias`` m/s² how much of a horizontal reading at rest counts as bias, more is tilt;
    ``latitude`` degrees for normal gravity; ``full_scale`` m/s² and ``full_scale_rate`` rad/s the sensor's
    ranges where known; ``attitude_time`` s the accelerometer's time constant against the gyro.
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
