# SPDX-License-Identifier: Apache-2.0
"""IMU stamps shifted against GPS stamps."""

from __future__ import annotations

from suspension_twin.effects.base import ClockChange, Effect, Hook, Parameter, Prior, Values, more


def _clock(change: ClockChange, p: Values) -> None:
    change.delay[:] += p["offset"]


EFFECT = Effect(
    id="time_offset",
    title="clock offset",
    where="time",
    doc="IMU stamps are later than they should be by the offset: what is stamped t happened, on the clock of "
    "the GPS receiver, at t - offset.",
    parameters=(Parameter("offset", (-2.0, 2.0), Prior(0.0, 0.05), "s", "IMU stamp less GPS time"),),
    order=220,
    severity=("offset",),
    excited_by=("bumps at several speeds", "accelerating and braking"),
    confused_with=("position_offset (at one speed they are the same)", "sensor_bandwidth"),
    hook=Hook(clock=_clock, models=("full_car", "msd", "tracked", "quarter_car")),
    finding=lambda p: f"the sensor's time stamps are {more(p['offset'], 's', 'late', 'early')}",
)
