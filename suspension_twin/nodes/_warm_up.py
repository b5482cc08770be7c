# SPDX-License-Identifier: Apache-2.0
"""Compiles, before the first message, what would else be compiled at it and hold everything up."""

from __future__ import annotations

from functools import cache

from suspension_twin.pose.lock import PoseLock
from suspension_twin.signals.ingest import ImuIngest, ImuSettings
from suspension_twin.signals.live import LiveLowPass
from suspension_twin.vehicle.twin import Datum, Place

__all__ = ["warm_up_ingest", "warm_up_low_pass", "warm_up_pose"]

_STEP = 0.01


@cache
def warm_up_ingest() -> None:
    """A second of standing still."""
    ingest = ImuIngest(ImuSettings(), Place())
    for k in range(120):
        ingest.push(1.0 + k * _STEP, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


@cache
def warm_up_pose() -> None:
    """A second of driving east, with everything that a receiver may send."""
    lock = PoseLock(datum=Datum(latitude=0.0, longitude=0.0))
    for k in range(100):
        t = 1.0 + k * _STEP
        if k % 10 == 0:
            lock.on_fix(t - 0.025, 0.0, 10.0 * t / 111_319.5, 0.0, 2)
            lock.on_velocity(t - 0.025, 10.0, 0.0)
            lock.on_heading(t - 0.025, 0.0)
        lock.on_imu(t, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


@cache
def warm_up_low_pass() -> None:
    """A few samples, one of them missing."""
    low_pass = LiveLowPass(ImuSettings().filter)
    for k in (0, 1, 2, 4):
        low_pass.push(1.0 + k * _STEP, 0.0)
