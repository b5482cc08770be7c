# SPDX-License-Identifier: Apache-2.0
"""The drives: the car, the ground, the way driven and where the instruments sit.

From the car paper: the coordinates of both places (Figs. 1 and 8), Table 1's vehicle with its
driver and passenger, the phone at the windshield at 100 Hz, 15 km/h over the bump, a road of
about 90 m with potholes and a ramp. What the paper does not print (the bump's size, the road's
heights, masses of the wheels, inertias and, above all, the characteristics) is our choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from reality.car import Car, Strut
from reality.driver import Driver, Path, speed_over_path
from reality.sensors import ALONE, Phone, Receiver
from reality.surface import Surface, roughness

Floats = NDArray[Any]

#: Every force lies within the bounds of the car paper's Table 2, and as the paper found: the
#: front has the stiffer springs, the rear the firmer dampers.
MONDEO = Car(
    mass=1575.0 + 80.0 + 70.0,
    wheelbase=2.85,
    front_track=1.588,
    rear_track=1.605,
    cog=(1.5, 0.0, 0.55),
    sprung_inertia=(560.0, 2680.0, 2950.0),
    wheel_radius=0.295,
    tyre_stiffness=205_000.0,
    tyre_damping=120.0,
    cornering=60_000.0,
    front=Strut(
        unsprung=41.0,
        spring=((0.1, 2450.0), (0.3, 7350.0), (0.5, 12_800.0), (1.0, 28_000.0)),
        push=((0.125, 420.0), (0.25, 1200.0), (0.35, 3050.0), (0.4, 5050.0)),
        pull=((0.125, 880.0), (0.25, 2050.0), (0.35, 3200.0), (0.4, 5050.0)),
        friction=20.0,
    ),
    rear=Strut(
        unsprung=39.0,
        spring=((0.1, 2050.0), (0.3, 6300.0), (0.5, 11_300.0), (1.0, 26_000.0)),
        push=((0.125, 480.0), (0.25, 1380.0), (0.35, 3250.0), (0.4, 5200.0)),
        pull=((0.125, 960.0), (0.25, 2250.0), (0.35, 3450.0), (0.4, 5250.0)),
        friction=25.0,
    ),
)

#: The phone in its holder faces the driver, upright but for 15 degrees: its x to the right, its y up.
PHONE_PLACE = (1.9, 0.0, 1.2)
PHONE_RPY = (1.309, 0.0, -1.5708)
#: By so much it really sits askew, rad about base_link's axes.
PHONE_ASKEW = (0.012, -0.009, 0.008)
ANTENNA_PLACE = (0.35, 0.2, 1.52)


@dataclass(frozen=True, eq=False)
class Scene:
    """One drive, up to the instruments. ``road`` is what the road file holds: ``road_z`` (nu, nv)
    every ``road_du`` m at ``road_v`` (nv,) along the surface's reference line."""

    name: str
    title: str
    datum: tuple[float, float, float]
    start_time: float
    surface: Surface
    road_du: float
    road_v: Floats
    road_z: Floats
    start: tuple[float, float, float, float]  # x, y, yaw of base_link, u on the road
    driver: Callable[[], Driver]
    seed: int
    phone: Phone = Phone()
    receiver: Receiver = Receiver()
    antenna: tuple[float, float, float] = ANTENNA_PLACE


def bump_15kmh() -> Scene:
    """Three passes over a speed bump at 15 km/h, turning round at both ends of a straight road."""
    length, du, heading = 80.0, 0.025, math.radians(30.0)
    u = np.arange(round(length / du) + 1) * du
    bump = rounded_bump(u, middle=length / 2, length=0.9, height=0.05)
    v = np.arange(-10.0, 10.01, 0.25)
    # New asphalt: a tenth of the middle of ISO 8608's class A. The road file knows the bump alone.
    ground = bump[:, None] + roughness((u.size, v.size), du, 0.25, 1.6e-6, seed=11)
    origin = (-length / 2 * math.cos(heading), -length / 2 * math.sin(heading))
    surface = Surface(du, 0.25, -10.0, origin, np.full(u.size, heading), ground)
    road_v = np.arange(-10.0, 10.01, 5.0)

    # Out over the bump, round by a loop that leads back to the other lane, twice.
    lane, radius, straight = 2.0, 6.2, 32.0
    a = math.acos(0.5 * (1.0 + lane / radius))
    loop = [(radius * a, -1 / radius), (radius * (math.pi + 2 * a), 1 / radius), (radius * a, -1 / radius)]
    pieces = [(straight, 0.0), *loop, (straight, 0.0), *loop, (straight + 5.0, 0.0)]
    u0 = length / 2 - straight / 2
    x, y = surface.to_map(np.array([u0]), np.array([-lane]))[0]
    path = Path.from_pieces((x, y, heading), pieces, ease=4.0)
    turn = sum(p[0] for p in loop)
    fast, slow, limits, s = 15 / 3.6, 2.3, [], 0.0
    for index in range(3):
        limits += [(s, fast), (s + straight - 1.0, slow)] if index < 2 else [(s, fast)]
        s += straight + turn
    speed = speed_over_path(path.length - 3.0, limits, accelerate=1.1, brake=1.6)
    return Scene(
        name="bump_15kmh",
        title="The speed bump, three passes at 15 km/h",
        datum=(dms(47, 24, 9.0), dms(19, 17, 2.5), 120.0),
        start_time=1_700_000_000.0,
        surface=surface,
        road_du=du,
        road_v=road_v,
        road_z=np.repeat(bump[:, None], road_v.size, axis=1),
        start=(x, y, heading, u0),
        driver=lambda: Driver(path, speed, MONDEO.mass, MONDEO.wheelbase, stand=4.0),
        seed=1,
    )


def bump_phone() -> Scene:
    """The same passes, recorded by a phone alone, whose own receiver is in it."""
    phone, receiver = ALONE
    return replace(
        bump_15kmh(),
        name="bump_phone",
        title="The speed bump, recorded by a phone alone",
        start_time=1_700_007_200.0,
        seed=3,
        phone=phone,
        receiver=receiver,
        antenna=PHONE_PLACE,
    )


def crg_road() -> Scene:
    """A worn road of 90 m with potholes that ends in a ramp up to a parking lot."""
    length, du, dv = 90.0, 0.025, 0.05
    u = np.arange(round(length / du) + 1) * du
    v = np.arange(-2.5, 2.501, dv)
    heading = (
        math.radians(105.0)
        + np.cumsum(gaussian_filter1d(np.where((u > 30) & (u < 62), 1 / 130.0, 0.0), 120)) * du
    )
    # Between ISO 8608's classes B and C (their border is 128e-6 m³).
    ground = roughness((u.size, v.size), du, dv, 110e-6, seed=21)
    for at, across, long, wide, deep in POTHOLES:
        r = np.hypot((u[:, None] - at) / (long / 2), (v[None, :] - across) / (wide / 2))
        ground -= deep * 0.5 * (1 + np.cos(np.pi * np.clip((r - 0.35) / 0.65, 0.0, 1.0)))
    ramp = np.clip((u - 66.0) / 4.0, 0.0, 1.0)
    ground += gaussian_filter1d(0.32 * ramp, 0.15 / du, mode="nearest")[:, None]
    surface = Surface(du, dv, -2.5, (0.0, 0.0), heading, ground)
    road_du, road_dv = 0.05, 0.1
    road_z = surface.surveyed(road_du, road_dv, smoothing=0.04, noise=0.002, seed=22)

    u0, lane = 5.0, -0.25
    way = np.arange(u0, 88.0, 0.05)
    path = Path.from_points(surface.to_map(way, np.full(way.size, lane)))
    speed = speed_over_path(
        path.length - 3.0,
        [(0.0, 25 / 3.6), (56.0 - u0, 14 / 3.6), (74.0 - u0, 18 / 3.6)],
        accelerate=1.5,
        brake=1.8,
    )
    x, y = path.x[0], path.y[0]
    return Scene(
        name="crg_road",
        title="The OpenCRG road, 90 m with potholes and a ramp",
        datum=(dms(47, 28, 43.2), dms(19, 3, 24.4), 105.0),
        start_time=1_700_003_600.0,
        surface=surface,
        road_du=road_du,
        road_v=v[::2].copy(),
        road_z=road_z,
        start=(x, y, float(path.heading[0]), u0),
        driver=lambda: Driver(path, speed, MONDEO.mass, MONDEO.wheelbase, stand=4.0),
        seed=2,
    )


#: Middle along and across, length, width and depth in m.
POTHOLES = (
    (24.0, -1.05, 0.70, 0.60, 0.030),
    (29.5, 0.55, 0.80, 0.70, 0.040),
    (35.2, -1.00, 0.55, 0.50, 0.025),
    (41.0, 0.60, 0.90, 0.80, 0.045),
    (41.9, -1.10, 0.80, 0.70, 0.035),
    (48.6, -0.25, 0.60, 3.40, 0.020),
    (53.8, 0.50, 0.70, 0.60, 0.035),
)


def rounded_bump(u: Floats, middle: float, length: float, height: float) -> Floats:
    """A segment of a circle across the whole road, its feet worn round (Gaussian, 3 cm)."""
    radius = (length**2 / 4 + height**2) / (2 * height)
    inside = np.sqrt(np.maximum(radius**2 - (u - middle) ** 2, 0.0)) - (radius - height)
    return np.asarray(gaussian_filter(np.maximum(inside, 0.0), 0.03 / (u[1] - u[0])))


def dms(degrees: int, minutes: int, seconds: float) -> float:
    """Degrees from degrees, minutes and seconds."""
    return degrees + minutes / 60 + seconds / 3600


SCENES = {"bump_15kmh": bump_15kmh, "bump_phone": bump_phone, "crg_road": crg_road}
