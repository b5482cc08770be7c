# SPDX-License-Identifier: Apache-2.0
"""Recordings with a known truth: a body that stands, then rolls, pitches, turns, brakes and heaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData

G = 9.80665
T0 = 1.7e9


@dataclass(frozen=True, eq=False)
class Truth:
    """What the sensor saw: stamps (n,), force and rate (n, 3) in base_link axes, vertical (n,) without
    gravity, up (n, 3), speed (n,), standing (n,)."""

    t: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    vertical: np.ndarray
    up: np.ndarray
    speed: np.ndarray
    standing: np.ndarray


def motion(s: np.ndarray, stand: float, pull: float = 1.0, slope: float = 0.0) -> Truth:
    """At rest for ``stand`` s, then 1.2 Hz roll and 1.5 Hz pitch of 1.5 degrees, turning, pulling away and
    braking in turn with ``pull`` m/s², heaving at 2 and 11 Hz; all on a ``slope`` rad uphill. ``s`` (n,) s."""

    def angles(when: np.ndarray) -> np.ndarray:
        q = np.maximum(when - stand, 0.0)
        on = np.radians(1.5) * (1.0 - np.exp(-((q / 0.5) ** 2)))  # a gentle beginning
        roll = on * np.sin(2 * np.pi * 1.2 * q)
        pitch = on * np.sin(2 * np.pi * 1.5 * q) - slope
        return np.column_stack([roll, pitch, on * 12.0 * np.sin(0.4 * q)])

    fine = 1e-5
    roll, pitch, yaw = angles(s).T
    d_roll, d_pitch, d_yaw = ((angles(s + fine) - angles(s - fine)) / (2 * fine)).T
    rate = np.column_stack(
        [
            d_roll - np.sin(pitch) * d_yaw,
            np.cos(roll) * d_pitch + np.sin(roll) * np.cos(pitch) * d_yaw,
            np.cos(roll) * np.cos(pitch) * d_yaw - np.sin(roll) * d_pitch,
        ]
    )
    q = np.maximum(s - stand, 0.0)
    speed = 2.0 * pull * (1 - np.cos(0.5 * q))  # 0 to 4 times the pull and back
    heave = (q > 0) * (0.8 * np.sin(2 * np.pi * 2.0 * q) + 0.5 * np.sin(2 * np.pi * 11.0 * q))
    body = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), 0 * s])
    left = np.column_stack([-np.sin(yaw), np.cos(yaw), 0 * s])
    world = ahead * (pull * np.sin(0.5 * q))[:, None] + left * (speed * d_yaw)[:, None]
    world[:, 2] += heave
    force = body.inv().apply(world + np.array([0.0, 0.0, G]))
    up = body.inv().apply(np.tile([0.0, 0.0, 1.0], (s.size, 1)))
    return Truth(T0 + s, force, rate, force[:, 2] - G * up[:, 2], up, speed, s < stand)


@pytest.fixture(scope="session")
def make_drive() -> Callable[..., tuple[Drive, Truth]]:
    """A drive and its truth; every way in which a phone spoils it is an argument."""

    def make(
        *,
        seconds: float = 30.0,
        rate: float = 100.0,
        stand: float = 3.0,
        pull: float = 1.0,
        slope: float = 0.0,
        rpy: tuple[float, float, float] = (0.0, 0.0, 0.0),
        force_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
        noise: float = 0.03,
        rate_noise: float = 0.002,
        jitter: float = 0.0,
        velocities: bool = True,
        seed: int = 1,
    ) -> tuple[Drive, Truth]:
        random = np.random.default_rng(seed)
        s = np.arange(int(seconds * rate)) / rate
        s = s + jitter / rate * random.uniform(-1, 1, s.size)
        truth = motion(s, stand, pull, slope)
        t = truth.t
        mounted = Rotation.from_euler("xyz", rpy)  # fixed axes: roll, pitch, yaw
        force = truth.force + force_bias + random.normal(0, noise, truth.force.shape)
        rates = truth.rate + rate_bias + random.normal(0, rate_noise, truth.rate.shape)
        imu = ImuData(t, mounted.inv().apply(force), mounted.inv().apply(rates))
        none = np.empty(0)
        fix = FixData(none, none, none, none, none.astype(np.int8), np.empty((0, 3)))
        ticks = np.arange(0, int(seconds * 10)) / 10 if velocities else none
        speed = np.interp(T0 + ticks, t, truth.speed)
        enu = np.column_stack([speed, 0 * speed, 0 * speed]) if velocities else np.empty((0, 3))
        return Drive("drive", imu, fix, VelocityData(T0 + ticks, enu)), truth

    return make
