# SPDX-License-Identifier: Apache-2.0
"""Drives on known paths: the truth by fine integration, the sensors by rigid-body kinematics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.types import Trajectory
from suspension_twin.vehicle.twin import Datum, Place

T0 = 1.7e9
G = 9.80665
DATUM = Datum(latitude=47.4025, longitude=19.284, altitude=120.0)
IMU = Place(position=(1.9, 0.3, 1.2))
GPS = Place(frame="gps_link", position=(0.8, -0.4, 1.5))


@dataclass(frozen=True, eq=False)
class Scene:
    """A drive and where ``base_link`` truly was at its IMU stamps."""

    drive: Drive
    truth: Trajectory
    datum: Datum = field(default=DATUM)
    imu: Place = field(default=IMU)
    gps: Place = field(default=GPS)


Profile = Callable[[np.ndarray], np.ndarray]


def integrate(s: np.ndarray, values: np.ndarray, start: float = 0.0) -> np.ndarray:
    """Running integral by trapezoids."""
    steps = np.diff(s) * 0.5 * (values[1:] + values[:-1])
    return start + np.concatenate([[0.0], np.cumsum(steps)])


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    """A vehicle at ``speed(s)`` m/s, turning with ``turn(s)`` rad/s, pitching by ``pitch(s)`` rad."""

    def make(
        *,
        speed: Profile,
        turn: Profile = np.zeros_like,
        pitch: Profile = np.zeros_like,
        seconds: float = 40.0,
        rate: float = 100.0,
        fix_rate: float = 10.0,
        sigma: float = 0.015,
        velocity_sigma: float | None = 0.03,
        heading: bool = False,
        yaw: float = 2.5,
        place: tuple[float, float] = (0.0, 0.0),
        force_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
        noise: float = 0.03,
        rate_noise: float = 0.002,
        tell_sigma: bool = True,
        seed: int = 1,
    ) -> Scene:
        random = np.random.default_rng(seed)
        fine = np.arange(0.0, seconds + 1e-9, 1e-3)
        v, w = speed(fine), turn(fine)
        psi = integrate(fine, w, yaw)
        x = integrate(fine, v * np.cos(psi), place[0])
        y = integrate(fine, v * np.sin(psi), place[1])
        tilt = pitch(fine)
        q, dq = np.gradient(tilt, fine), np.gradient(np.gradient(tilt, fine), fine)
        pull, dw = np.gradient(v, fine), np.gradient(w, fine)

        def on(s: np.ndarray, values: np.ndarray) -> np.ndarray:
            return np.interp(s, fine, values)

        s = np.arange(0.0, seconds, 1.0 / rate)
        truth = Trajectory(
            t=T0 + s,
            x=on(s, x),
            y=on(s, y),
            yaw=on(s, psi),
            velocity=np.column_stack([on(s, v), 0 * s]),
            yaw_rate=on(s, w),
            acceleration=np.column_stack([on(s, pull), on(s, v * w)]),
            valid=np.ones(s.size, dtype=bool),
        )
        # The sensor's place turns about base_link, with the yaw and with the pitch.
        px, py, pz = IMU.position
        ahead = pull - w**2 * px - dw * py + dq * pz - q**2 * px
        left = v * w + dw * px - w**2 * py
        force = np.column_stack([ahead - G * np.sin(tilt), left, G * np.cos(tilt) - dq * px - q**2 * pz])
        rates = np.column_stack([-w * np.sin(tilt), q, w * np.cos(tilt)])
        imu = ImuData(
            T0 + s,
            np.column_stack([on(s, c) for c in force.T]) + force_bias + random.normal(0, noise, (s.size, 3)),
            np.column_stack([on(s, c) for c in rates.T])
            + rate_bias
            + random.normal(0, rate_noise, (s.size, 3)),
        )
        g = np.arange(0.0, seconds - 1e-9, 1.0 / fix_rate)
        gx, gy, gz = GPS.position
        reach = gx * np.cos(tilt) + gz * np.sin(tilt)
        swing = q * gz
        c, sn = np.cos(psi), np.sin(psi)
        east, north = on(g, x + reach * c - gy * sn), on(g, y + reach * sn + gy * c)
        va, vl = v - w * gy + swing, w * gx
        ve, vn = on(g, va * c - vl * sn), on(g, va * sn + vl * c)
        enu = np.column_stack([east, north, 0 * g]) + random.normal(0, sigma, (g.size, 3)) * [1, 1, 0]
        lla = LocalMap(DATUM).to_geodetic(enu + np.array([0, 0, gz]))
        told = np.full((g.size, 3), sigma if tell_sigma else np.nan)
        status = np.full(g.size, 2 if sigma < 0.1 else 0, dtype=np.int8)
        fix = FixData(T0 + g, lla[:, 0], lla[:, 1], lla[:, 2], status, told)
        if velocity_sigma is None:
            velocity = VelocityData(np.empty(0), np.empty((0, 3)))
        else:
            seen = np.column_stack([ve, vn, 0 * g]) + random.normal(0, velocity_sigma, (g.size, 3)) * [
                1,
                1,
                0,
            ]
            velocity = VelocityData(T0 + g, seen)
        known = HeadingData(T0 + g, on(g, psi) + random.normal(0, 0.01, g.size)) if heading else None
        return Scene(Drive("scene", imu, fix, velocity, known), truth)

    return make


@pytest.fixture(scope="session")
def away() -> Callable[..., Profile]:
    """Speed: at rest for ``stand`` s, up to ``top`` m/s with ``pull`` m/s² rounded at both ends, and gently up
    and down from there."""

    def make(top: float = 10.0, stand: float = 4.0, pull: float = 2.0, wave: float = 0.1) -> Profile:
        def speed(s: np.ndarray) -> np.ndarray:
            rise = top / pull * np.pi / 2
            u = np.clip((s - stand) / rise, 0.0, 1.0)
            later = np.maximum(s - stand - rise, 0.0)
            return top * 0.5 * (1 - np.cos(np.pi * u)) + wave * top * np.sin(0.5 * later)

        return speed

    return make
