# SPDX-License-Identifier: Apache-2.0
"""A clock offset that grows."""

from __future__ import annotations

from suspension_twin.effects.base import ClockChange, Effect, Given, Hook, Parameter, Prior, Values, plain


def _clock(change: ClockChange, p: Values) -> None:
    change.drift[:] += 1e-6 * p["drift_ppm"]


def _finding(p: Given) -> str:
    late = 6e-5 * p["drift_ppm"]  # s after a minute
    return f"the sensor's clock runs {'fast' if late >= 0 else 'slow'}: by {plain(abs(late), 's')} a minute"


EFFECT = Effect(
    id="clock_drift",
    title="clock drift",
    where="time",
    doc="The clock that stamps the IMU runs fast by so many parts in a million: the offset against the GPS "
    "receiver's clock is 0 at the start of each drive and grows.",
    parameters=(
        Parameter(
            "drift_ppm",
            (-50000.0, 50000.0),
            Prior(0.0, 300.0, usual=50.0),
            "ppm",
            "rate of the IMU clock less one",
        ),
    ),
    order=230,
    severity=("drift_ppm",),
    excited_by=("long drives", "bumps early and late"),
    confused_with=("time_offset", "damper_fade"),
    hook=Hook(clock=_clock, models=("full_car", "msd", "tracked", "quarter_car")),
    finding=_finding,
)
