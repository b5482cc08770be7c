# SPDX-License-Identifier: Apache-2.0
"""Every effect as one knob: parameters that grow from nothing with an amount between 0 and 1.

The effects have the ids and the meaning of the contract; ``OUTSIDE`` are those that no twin can be
given. What lies between amount and severity is found by ``severity``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from blind.newton import Faults, Motion
from blind.world import FILE_DU, FILE_DV, Floats, World

OUTSIDE = (
    "cubic_spring",
    "wheel_imbalance",
    "engine_order",
    "damper_cavitation",
    "loose_ball_joint",
    "position_sensitive_damper",
    "gusts",
)
#: What a library may call them, should it come to have them: then that is taken out.
ALIASES = {
    "cubic_spring": ("cubic_spring", "progressive_spring"),
    "damper_cavitation": ("damper_cavitation", "damper_backlash"),
    "loose_ball_joint": ("loose_ball_joint", "joint_play"),
}
ROAD = ("road_scale", "road_smoothing", "position_offset", "lateral_offset")
SENSOR = ("mount_resonance", "sensor_tilt", "sensor_bandwidth", "sensor_clipping", "sensor_scale")
TIME = ("time_offset", "clock_drift")
BODY = (
    "strut_friction",
    "bump_stop",
    "rebound_stop",
    "top_mount",
    "anti_roll_bar",
    "damper_fade",
    "corner_damper",
    "corner_spring",
    "tyre_damping",
    "tyre_envelope",
    "payload",
    "body_bending",
    "powertrain_mount",
    "sensor_offset",
)
MSD = ("unsprung_mass",)
LIBRARY = (*BODY, *MSD, *SENSOR, *TIME, *ROAD)
#: What the library has got since the first plans; and what is outside it in the plans that have these.
ADDED = (
    "worn_dampers",
    "spring_sag",
    "tyre_pressure",
    "semi_active_damper",
    "wheel_imbalance",
    "engine_order",
)
WIDE_OUTSIDE = (
    "cubic_spring",
    "damper_cavitation",
    "loose_ball_joint",
    "position_sensitive_damper",
    "gusts",
    "loose_mass",
    "fuel_slosh",
    "flat_spot",
    "brake_judder",
    "clutch_judder",
    "crosswind",
    "stick_slip_holder",
    "gyro_g_sensitivity",
    "vibration_rectification",
    "held_samples",
    "compressed_time",
    "track_subsidence",
)
#: Of recordings without a road: what a diagnosis can tell by planar motion, and what it cannot.
RECORDED_LIBRARY = ("time_offset", "clock_drift", "sensor_tilt", "sensor_scale")
RECORDED_OUTSIDE = (
    "gyro_gain",
    "vibration_rectification",
    "held_samples",
    "compressed_time",
    "receiver_multipath",
    "receiver_smoothing",
    "held_fixes",
)
#: Set-up errors that are the same before and after: of map, clock and mount.
SET_UP_ERRORS = ("position_offset", "lateral_offset", "time_offset", "sensor_tilt")
#: Faults that the road file has, and those of the stamps alone.
OF_THE_ROAD = (*ROAD, "track_subsidence")
OF_THE_CLOCK = (*TIME, "compressed_time")


@dataclass(frozen=True, eq=False)
class Null:
    """What a drive of the world without any effect reached: bounds for what can be felt at all."""

    jounce: float  # m
    rebound: float
    peak: float  # m/s², highest specific force above gravity
    seconds: float

    @classmethod
    def of(cls, motion: Motion) -> Null:
        peak = float(np.max(np.abs(motion.force[:, 2])))
        return cls(float(motion.travel.max()), float(-motion.travel.min()), peak, float(motion.t[-1]))


Knob = Callable[[float, Null], dict[str, float]]


def knob(effect: str, world: World, seed: int, wide: bool = False) -> Knob:
    """Parameters of an effect by amount; the seed fixes what is not the amount (a corner, a frequency). ``wide`` is for
    the plans that have tones in the library: there engines differ, and a wheel begins each drive as it happens to."""
    rng = np.random.default_rng([seed, sum(effect.encode())])
    a, b, sign = rng.uniform(0, 1), rng.uniform(0, 1), float(rng.choice([-1.0, 1.0]))
    corner = float(rng.integers(0, 4))
    lead = 1.0 if a < 0.5 else 0.4
    # of an axle's faults: in front, at the rear or both
    share = ((1.0, 0.0), (0.0, 1.0), (1.0, 0.8))[min(int(3 * a), 2)]
    place = float(min(int(7 * b), 6))
    angle = rng.normal(size=3)
    angle /= np.linalg.norm(angle)
    coupling = rng.normal(size=9) / 3.0

    knobs: dict[str, Knob] = {
        "strut_friction": lambda s, n: {
            "front_force": 1000 * s * lead,
            "rear_force": 1000 * s * (1.4 - lead),
        },
        "bump_stop": lambda s, n: {
            "front_clearance": n.jounce * (1 - 0.95 * s),
            "rear_clearance": n.jounce * (1 - 0.95 * s) * (0.9 + 0.2 * b),
            "stiffness": 6e4 + 1.2e5 * a,
        },
        "rebound_stop": lambda s, n: {
            "front_clearance": n.rebound * (1 - 0.95 * s),
            "rear_clearance": n.rebound * (1 - 0.95 * s) * (0.9 + 0.2 * b),
            "stiffness": 6e4 + 1.2e5 * a,
        },
        "top_mount": lambda s, n: {
            "front_stiffness": 3e4 / max(s, 0.06),
            "rear_stiffness": 3e4 * (0.8 + 0.8 * b) / max(s, 0.06),
        },
        "anti_roll_bar": lambda s, n: {
            "front_stiffness": 8e4 * s * lead,
            "rear_stiffness": 8e4 * s * (1.4 - lead),
        },
        "damper_fade": lambda s, n: {"loss": 0.93 * s, "time_constant": 6.0 + 12.0 * a},
        "corner_damper": lambda s, n: {"corner": corner, "change": -0.95 * s if sign < 0 else 1.8 * s},
        "corner_spring": lambda s, n: {"corner": corner, "change": -0.6 * s if sign < 0 else 1.0 * s},
        "tyre_damping": lambda s, n: {"damping": 3500 * s},
        "tyre_envelope": lambda s, n: {"length": 0.06 + 1.2 * s},
        "payload": lambda s, n: {"mass": 600 * s, "x": -0.6 + 2.2 * a, "y": sign * 0.4 * b},
        "body_bending": lambda s, n: {
            "gain": 3.0 * s * sign,
            "frequency": 8.5 + 8.5 * a,
            "damping_ratio": 0.02 + 0.03 * b,
        },
        "powertrain_mount": lambda s, n: {
            "mass": 0.28 * world.car.mass * s,
            "frequency": 6.5 + 6 * a,
            "x": 0.7 + 0.8 * b,
        },
        "mount_resonance": lambda s, n: {
            "gain": 1.4 * s,
            "frequency": 8.5 + 8.5 * a,
            "damping_ratio": 0.03 + 0.06 * b,
        },
        "sensor_offset": lambda s, n: {
            "x": 2.5 * s * sign,
            "y": 1.0 * s * (2 * a - 1),
            "z": 0.8 * s * (2 * b - 1),
        },
        "sensor_tilt": lambda s, n: dict(zip(("roll", "pitch", "yaw"), 0.6 * s * angle, strict=True)),
        "sensor_bandwidth": lambda s, n: {"cutoff": 2.5 * 40.0 ** (1 - s)},
        "sensor_clipping": lambda s, n: {"range": 10.0 + (n.peak - 10.0) * (1 - s)},
        "sensor_scale": lambda s, n: {"scale": 0.45 * s * sign},
        "time_offset": lambda s, n: {"offset": 0.4 * s * sign},
        "clock_drift": lambda s, n: {"drift_ppm": 15_000 * s * sign},
        "road_scale": lambda s, n: {"scale": 0.9 * s if sign > 0 else -0.6 * s},
        "road_smoothing": lambda s, n: {"sigma": 0.8 * s},
        "position_offset": lambda s, n: {"offset": 1.5 * s * sign},
        "lateral_offset": lambda s, n: {"offset": 1.2 * s * sign},
        "unsprung_mass": lambda s, n: {"share": 0.12 + 0.88 * s},
        "cubic_spring": lambda s, n: {"rate": 1.2e8 * s},
        "wheel_imbalance": lambda s, n: {"corner": corner, "moment": 2.0 * s, "phase": 6.28 * a},
        "engine_order": lambda s, n: {"force": 2500 * s},
        "damper_cavitation": lambda s, n: {"void": 0.03 * s},
        "loose_ball_joint": lambda s, n: {"play": 0.02 * s},
        "position_sensitive_damper": lambda s, n: {"rise": 12.0 * s},
        "gusts": lambda s, n: {"force": 3000 * s, "phase": 6.28 * a},
        "worn_dampers": lambda s, n: {"front": 0.93 * s * share[0], "rear": 0.93 * s * share[1]},
        "spring_sag": lambda s, n: {
            "front": 0.09 * s * share[0],
            "rear": 0.09 * s * share[1],
            "rate": 4.0 * (b - 0.3),
        },
        "tyre_pressure": lambda s, n: {
            "corner": place,
            "change": -0.85 * s if sign < 0 or a < 0.5 else 0.9 * s,
        },
        "semi_active_damper": lambda s, n: {
            "law": float(b > 0.6),
            "front": (4000 if b <= 0.6 else 1800) * s * max(share[0], 0.3),
            "rear": (4000 if b <= 0.6 else 1800) * s * max(share[1], 0.3),
        },
        "loose_mass": lambda s, n: {
            "mass": 12.0 + 80.0 * s,
            "gap": 0.004 + 0.03 * s,
            "x": world.car.wheelbase * (1.25 if a < 0.5 else -0.15),
            "y": sign * 0.5 * b,
        },
        "fuel_slosh": lambda s, n: {"mass": 160.0 * s, "frequency": 0.55 + 0.6 * a},
        "flat_spot": lambda s, n: {"corner": corner, "depth": 0.02 * s},
        "brake_judder": lambda s, n: {"depth": 1.5 * s, "turns": 1.0 if a < 0.4 else 2.0},
        "clutch_judder": lambda s, n: {"depth": 1.5 * s, "pitch": 2 * np.pi * (6.0 + 6.0 * a)},
        "crosswind": lambda s, n: {"force": 4000.0 * s, "phase": 6.28 * a},
        "stick_slip_holder": lambda s, n: {"grip": 0.4 + (n.peak - 10.0) * (1 - s)},
        "gyro_g_sensitivity": lambda s, n: {
            f"{p}{q}": 0.02 * s * float(g)
            for (p, q), g in zip([(p, q) for p in "xyz" for q in "xyz"], coupling, strict=True)
        },
        "vibration_rectification": lambda s, n: {"square": 0.15 * s * sign},
        "held_samples": lambda s, n: {"rate": 6.0 * 14.0 ** (1 - s)},
        "compressed_time": lambda s, n: {"seconds": 0.25 * s, "every": 6.0 + 8.0 * a},
        "track_subsidence": lambda s, n: {
            "depth": 0.09 * s,
            "first": 35.0 + 50.0 * a,
            "length": 25.0 + 40.0 * b,
            "side": sign,
        },
    }
    if wide:
        # a fan or an idling engine, one gear, one above idle, or two gears with a shift
        engine = (
            {"idle": 5.0 + 10.0 * b, "low": 0.0, "high": 0.0},
            {"idle": 2.0 + 6.0 * b, "low": 0.3 + 0.6 * corner / 3, "high": 0.3 + 0.6 * corner / 3},
            {"idle": 0.0, "low": 0.8 + 0.9 * b, "high": 0.8 + 0.9 * b, "floor": 5.0 + 2.0 * b},
            {},
        )[min(int(4 * a), 3)]
        knobs["engine_order"] = lambda s, n: {"force": 2500 * s, **engine}
        knobs["wheel_imbalance"] = lambda s, n: {
            "corner": corner,
            "moment": 2.0 * s,
            "phase": 6.28 * a,
            "turned": 1.0,
        }
    return knobs[effect]


def gross(effect: str, seed: int) -> dict[str, float]:
    """Parameters of a gross set-up error: a map decimetres off, a clock tenths of a second late, a sensor that is
    turned by more than a holder gives, half of them by right angles about the vertical."""
    rng = np.random.default_rng([seed, 51, sum(effect.encode())])
    sign, part = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.0, 1.0))
    if effect == "sensor_tilt":
        lean = np.radians(rng.uniform(-12.0, 12.0, 2))
        quarters = (
            float(rng.choice([1.0, 2.0, 3.0])) * np.pi / 2
            if part < 0.5
            else np.radians(sign * (10 + 30 * part))
        )
        yaw = (quarters + np.pi) % (2 * np.pi) - np.pi
        return {"roll": float(lean[0]), "pitch": float(lean[1]), "yaw": float(yaw)}
    low, high = {"position_offset": (0.3, 1.5), "lateral_offset": (0.3, 0.9), "time_offset": (0.08, 0.6)}[
        effect
    ]
    return {"offset": sign * (low + (high - low) * part)}


def surveyed(world: World, faults: Faults, stretch: tuple[float, float] | None = None) -> Floats:
    """The road file's heights with what is wrong with it, everywhere or on one stretch (m along the road).

    What is wrong is wrong with the file: the truth is ``scale`` higher, rougher or elsewhere.
    """
    u = np.arange(world.survey.shape[0]) * FILE_DU
    v = np.arange(world.survey.shape[1]) * FILE_DV
    z = misread(world.survey, u, v, faults)
    if stretch is not None:
        part = 0.5 * (np.tanh((u - stretch[0]) / 0.15) - np.tanh((u - stretch[1]) / 0.15))[:, None]
        z = world.survey + part * (z - world.survey)
    return z


def misread(z: Floats, u: Floats, v: Floats, faults: Faults) -> Floats:
    """(N, M) heights at ``u`` along and ``v`` across, in m, with what is wrong with their file."""
    if "position_offset" in faults:
        moved = u + faults["position_offset"]["offset"]
        z = np.stack([np.interp(moved, u, z[:, j]) for j in range(z.shape[1])], axis=1)
    if "lateral_offset" in faults:
        moved = v + faults["lateral_offset"]["offset"]
        z = np.stack([np.interp(moved, v, row) for row in z])
    if "road_smoothing" in faults:
        sigma = faults["road_smoothing"]["sigma"] / float(u[1] - u[0])
        z = gaussian_filter1d(z, sigma, axis=0, mode="nearest") if sigma > 0.05 else z
    if "track_subsidence" in faults:
        own = faults["track_subsidence"]
        sunk = 0.5 * (np.tanh((u - own["first"]) / 0.6) - np.tanh((u - own["first"] - own["length"]) / 0.6))
        sunk = sunk * own["depth"] * (0.7 + 0.3 * np.cos(2 * np.pi * u / 4.3))
        z = z + np.outer(sunk, 0.5 * (1.0 + np.tanh(own["side"] * (v - v.mean()) / 0.15)))
    if "road_scale" in faults:
        z = z / (1.0 + faults["road_scale"]["scale"])
    return z


def on_stretch(motion_u: Floats, wheelbase: float, stretch: tuple[float, float]) -> Floats:
    """True where a wheel stands on the stretch."""
    a, b = stretch
    return ((motion_u > a) & (motion_u < b)) | ((motion_u + wheelbase > a) & (motion_u + wheelbase < b))


def without_road(faults: Faults) -> Faults:
    """The faults that a car has, not its road file."""
    return {k: v for k, v in faults.items() if k not in OF_THE_ROAD}
