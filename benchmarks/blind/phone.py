# SPDX-License-Identifier: Apache-2.0
"""What a phone and a receiver make of a motion, with what is wrong with them.

The phone's order: its holder, its place turned against the mounting, the range of its converter, gain,
low-pass, samples on a clock of its own with jitter, bias, noise, steps, and now and then a lost one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from reality.sensors import ALONE, Receiver, receiver_fixes
from scipy.interpolate import CubicSpline
from scipy.signal import bilinear, lfilter, lfilter_zi
from scipy.spatial.transform import Rotation

from blind.newton import Faults, Motion, rotate
from blind.world import Floats, G, Phone, Plan, World
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData

CHIP = 42.0  # Hz, of the converter's own low-pass, whose delay the stamps have taken off
RATE = 100.0
#: s of jitter of the stamps; None for each phone's own.
JITTER: float | None = None
#: Receivers by name: with RTK, and the phone's own.
RECEIVERS = {"rtk": Receiver(white=0.006, wander=0.006), "phone": ALONE[1]}
RECEIVER = "rtk"
DELAY = 2 * 0.7071 / (2 * np.pi * CHIP)  # s


@dataclass(frozen=True, eq=False)
class Felt:
    """What reaches the converter: specific force and rate (n, 3) in base_link axes as the twin file places it."""

    t: Floats
    force: Floats
    rate: Floats


def _second_order(signal: Floats, dt: float, frequency: float, damping: float, feed: float) -> Floats:
    """(feed s + w^2) / (s^2 + 2 d w s + w^2) on (n, k) from rest, by the trapezoid rule."""
    w = 2 * np.pi * frequency
    b, a = bilinear([feed, w * w], [1.0, 2 * damping * w, w * w], fs=1 / dt)
    start = lfilter_zi(b, a)[:, None] * signal[:1]
    return np.asarray(lfilter(b, a, signal, axis=0, zi=start)[0])


def felt(motion: Motion | Felt, phone: Phone, faults: Faults, ideal: bool = False) -> Felt:
    """The continuous part of the chain; ``ideal`` leaves out all that is not a fault."""
    dt = float(motion.t[1] - motion.t[0])
    force, rate = motion.force.copy(), motion.rate.copy()
    if not ideal:
        w = 2 * np.pi * phone.holder
        force[:, 2:] = _second_order(force[:, 2:], dt, phone.holder, 0.15, 2 * 0.15 * w)
    own = faults.get("mount_resonance")
    if own:
        w = 2 * np.pi * own["frequency"]
        moved = _second_order(
            force[:, 2:], dt, own["frequency"], own["damping_ratio"], 2 * own["damping_ratio"] * w
        )
        force[:, 2:] += own["gain"] * (moved - force[:, 2:])
    if "stick_slip_holder" in faults:
        force[:, 2] = _stuck(force[:, 2], dt, faults["stick_slip_holder"]["grip"])
    if "gyro_g_sensitivity" in faults:
        own = faults["gyro_g_sensitivity"]
        coupling = np.array([[own[f"{a}{b}"] for b in "xyz"] for a in "xyz"])
        rate = rate + (force - [0.0, 0.0, G]) @ coupling.T
    turn = Rotation.identity() if ideal else Rotation.from_euler("xyz", phone.askew)
    if "sensor_tilt" in faults:
        turn = turn * Rotation.from_euler("xyz", [faults["sensor_tilt"][a] for a in ("roll", "pitch", "yaw")])
    mount = Rotation.from_euler("xyz", phone.rpy)
    force, rate = (mount.apply(turn.inv().apply(v), inverse=True) for v in (force, rate))
    if "vibration_rectification" in faults:
        # the sensing mass leans on a spring that is softer the further it is: squares do not average out
        force = force + faults["vibration_rectification"]["square"] * (force - force[:1]) ** 2
    if "sensor_clipping" in faults:
        reach = faults["sensor_clipping"]["range"]
        force = np.clip(force, -reach, reach)
    force = force * (1.0 + faults.get("sensor_scale", {}).get("scale", 0.0))
    if "sensor_bandwidth" in faults:
        cutoff = faults["sensor_bandwidth"]["cutoff"]
        force, rate = (_second_order(v, dt, cutoff, 0.75, 0.0) for v in (force, rate))
    if not ideal:
        force, rate = (_second_order(v, dt, CHIP, 0.7071, 0.0) for v in (force, rate))
    if "held_samples" in faults:
        # a driver that hands the same sample out until it has another one
        every = 1.0 / faults["held_samples"]["rate"]
        held = np.minimum((np.floor(motion.t / every) * every / dt).astype(int), motion.t.size - 1)
        force, rate = force[held], rate[held]
    return Felt(motion.t, mount.apply(force), mount.apply(rate))


@njit(cache=True)
def _stuck(force: Floats, dt: float, grip: float) -> Floats:
    """(n,) vertical specific force of a phone in a clamp that holds up to ``grip`` m/s² beyond gravity and slides with
    0.8 of it until it is carried along again; a rubber foot brings it back."""
    out, moving, pace, place = force.copy(), False, 0.0, 0.0
    for i in range(force.size):
        wanted = force[i] - G
        back = -900.0 * place - 8.0 * pace
        if not moving and abs(wanted) > grip:
            moving = True
        if moving:
            # pace of the clamp against the phone
            side = 1.0 if wanted > 0.0 else -1.0
            if abs(pace) > 1e-4:
                side = 1.0 if pace > 0.0 else -1.0
            given = 0.8 * grip * side - back
            out[i] = G + given
            before = pace
            pace += dt * (wanted - given)
            place += dt * pace
            if before * pace < 0.0 and abs(wanted) < grip:
                moving, pace = False, 0.0
        else:
            place *= 1.0 - 0.5 * dt
    return out


def lost_time(own: Mapping[str, float], t: Floats, seed: int) -> tuple[Floats, NDArray[np.bool_]]:
    """(n,) s by which stamps at ``t`` are early, and which samples are missing: a logger that loses a few in a row now
    and then stamps the next ones as if none were missing, until it asks the clock again."""
    rng = np.random.default_rng([seed, 13])
    early, gone, at = np.zeros(t.size), np.zeros(t.size, dtype=np.bool_), float(rng.uniform(1.0, 2.5))
    asked = 0.0
    while at < t[-1]:
        lasts = float(own["seconds"] * rng.uniform(0.5, 1.5))
        gone |= (t >= at) & (t < at + lasts)
        until = asked + own["every"] * np.ceil((at + lasts - asked) / own["every"])
        early[(t >= at + lasts) & (t < until)] += lasts
        at += lasts + float(rng.uniform(1.0, 3.5))
    return early, gone


def record(world: World, plan: Plan, motion: Motion, faults: Faults, name: str) -> Drive:
    """The drive as it was recorded."""
    phone = world.phone
    chain = felt(motion, phone, faults)
    mount = Rotation.from_euler("xyz", phone.rpy)
    signal = np.hstack([mount.apply(chain.force, inverse=True), mount.apply(chain.rate, inverse=True)])
    rng = np.random.default_rng([plan.seed, 7])
    count = int((motion.t[-1] - DELAY) * RATE) - 1
    draw = rng.standard_normal((count, 8))
    when = np.arange(count) / RATE
    sample = CubicSpline(motion.t, signal)(when + DELAY)
    sample[:, :3] += np.array(phone.force_bias) + phone.force_noise * draw[:, :3]
    sample[:, 3:] += np.array(phone.rate_bias) + phone.rate_noise * draw[:, 3:6]
    steps = np.repeat([16 * G / 65536, np.radians(1000.0) / 65536], 3)
    sample = np.round(sample / steps) * steps
    drift = 1e-6 * faults.get("clock_drift", {}).get("drift_ppm", 0.0)
    shift = phone.lag + faults.get("time_offset", {}).get("offset", 0.0)
    stamps = (
        plan.start
        + when * (1.0 + drift)
        + shift
        + (phone.jitter if JITTER is None else JITTER) * np.clip(draw[:, 6], -3, 3)
    )
    kept = rng.random(count) >= phone.lost
    if "compressed_time" in faults:
        early, gone = lost_time(faults["compressed_time"], when, plan.seed)
        stamps, kept = stamps - early, kept & ~gone
    imu = ImuData(stamps[kept], sample[kept, :3], sample[kept, 3:])
    antenna = motion.place + rotate(motion.turn, np.broadcast_to(world.antenna, motion.place.shape))
    stride = 2
    receiver = RECEIVERS[RECEIVER]
    fix_t, geodetic, velocity = receiver_fixes(
        motion.t[::stride], antenna[::stride], receiver, world.datum, plan.start, plan.seed + 50_000
    )
    spread = float(np.hypot(receiver.white, receiver.wander))
    fix = FixData(
        fix_t,
        geodetic[:, 0],
        geodetic[:, 1],
        geodetic[:, 2],
        np.full(fix_t.size, 2 if RECEIVER == "rtk" else 0, dtype=np.int8),
        np.tile([spread, spread, receiver.vertical * spread], (fix_t.size, 1)),
    )
    return Drive(name=name, imu=imu, fix=fix, velocity=VelocityData(fix_t, velocity))
