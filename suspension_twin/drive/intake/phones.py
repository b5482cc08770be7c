# SPDX-License-Identifier: Apache-2.0
"""What phones mean by their numbers, for recordings and live samples alike.

Sources: UNITS.md, COORDINATES.md and CROSSPLATFORM.md of tszheichoi/awesome-sensor-logger; Android's
``Location.getAccuracy``, Apple's ``CLLocation``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import FixData

__all__ = ["FORCE_CHOICES", "IOS_FORCE_SIGN", "ExperimentTime", "force_sensors", "phone_fix"]

#: Sensor Logger's sensors whose sum is the specific force, the best first.
FORCE_CHOICES: Final = (
    ("totalacceleration",),
    ("accelerometer", "gravity"),
    ("accelerometeruncalibrated",),
)

#: On iOS Sensor Logger negates the three axes of accelerometer and gravity, unless it standardises them.
IOS_FORCE_SIGN: Final = -1.0


def force_sensors(present: Collection[str]) -> tuple[str, ...]:
    """Of Sensor Logger's sensors (lower case) those whose sum is the specific force; empty if there are none."""
    return next((names for names in FORCE_CHOICES if set(names) <= set(present)), ())


def phone_fix(
    t: Floats, latitude: Floats, longitude: Floats, altitude: Floats, horizontal: Floats, vertical: Floats
) -> FixData:
    """Fixes (n,) of a phone from its accuracies in m.

    The horizontal accuracy is the radius of a 1 sigma circle, so √2 sigma of each axis. A negative one marks
    an invalid fix, zero or NaN one that is not known.
    """
    with np.errstate(invalid="ignore"):
        sigma = np.stack([horizontal / np.sqrt(2), horizontal / np.sqrt(2), vertical], axis=1)
        sigma = np.where(sigma > 0, sigma, np.nan)
        status = np.where(horizontal < 0, -1, 0).astype(np.int8)
    return FixData(t, latitude, longitude, altitude, status, sigma)


@dataclass(frozen=True, eq=False)
class ExperimentTime:
    """phyphox's time of an experiment, which stands still during pauses, beside UTC: at ``begin`` (k,) s, when it was
    started or went on, UTC was ``offset`` (k,) s more."""

    begin: Floats
    offset: Floats

    @classmethod
    def of_events(cls, events: Sequence[str], experiment: Floats, system: Floats) -> ExperimentTime:
        """From the events START and PAUSE, and what both clocks showed at each in s; others are left out."""
        known = np.isfinite(experiment) & np.isfinite(system)
        starts = [i for i, event in enumerate(events) if event == "START" and known[i]]
        return cls(experiment[starts], system[starts] - experiment[starts])

    def utc(self, t: Floats) -> Floats:
        """UTC in s of experiment times ``t`` (n,) s."""
        # a sample at the very moment of a pause belongs to what was before it
        segment = np.clip(np.searchsorted(self.begin, t, side="left") - 1, 0, self.begin.size - 1)
        return np.asarray(t + self.offset[segment])
