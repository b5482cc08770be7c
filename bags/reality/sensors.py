# SPDX-License-Identifier: Apache-2.0
"""What the instruments make of the motion: a phone in a holder, and an RTK receiver.

The phone's chain, in its order: the holder's resonance, the chip's low-pass (its known group
delay taken off the stamps, as a phone's driver does), samples at 100 Hz of a clock of its own
with jitter, bias, noise, steps of a 16-bit converter, and now and then a sample lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pymap3d
from numpy.typing import NDArray
from scipy.signal import bilinear, butter, lfilter, lfilter_zi
from scipy.special import ndtr

Floats = NDArray[Any]
G = 9.80665


@dataclass(frozen=True)
class Phone:
    rate: float = 100.0  # Hz
    mount_frequency: float = 34.0  # Hz, the holder's resonance
    mount_damping: float = 0.2
    bandwidth: float = 40.0  # Hz, -3 dB of the BMI160 at 100 Hz output
    jitter: float = 4e-4  # s, of the stamps
    lag: float = 1e-3  # s, stamps behind GPS time
    force_noise: float = 0.015  # m/s²
    rate_noise: float = 1.2e-3  # rad/s
    force_bias: tuple[float, float, float] = (0.06, -0.04, 0.05)  # m/s², in the phone's axes
    rate_bias: tuple[float, float, float] = (0.004, -0.003, 0.0025)  # rad/s
    force_step: float = 8 * G / 65536  # ±4 g
    rate_step: float = np.radians(1000.0) / 65536  # ±500 deg/s
    lost: float = 0.001  # share of samples that never arrive


@dataclass(frozen=True)
class Receiver:
    rate: float = 10.0  # Hz
    white: float = 0.005  # m, horizontal, from fix to fix
    wander: float = 0.004  # m, slowly varying
    wander_time: float = 20.0  # s
    velocity: float = 0.02  # m/s
    # The vertical of a fix is twice as noisy as the horizontal.
    vertical: float = 2.0
    late: float = 0.0  # s, stamps behind the motion
    settled: bool = False  # the slow error has its full size from the first fix on


#: A phone without a receiver beside it: 67 Hz, half of that as bandwidth, stamps off by a millisecond; positions off by
#: metres that change over a minute, once a second and late, velocities by the Doppler shift.
ALONE = (
    Phone(rate=67.0, bandwidth=27.0, jitter=1e-3),
    Receiver(
        rate=1.0, white=0.1, wander=2.5, wander_time=60.0, velocity=0.1, vertical=2.0, late=0.4, settled=True
    ),
)


def _chain(signal: Floats, dt: float, phone: Phone, with_mount: bool) -> Floats:
    """The holder and the chip's low-pass over (n, 3), started at rest."""
    out = signal
    if with_mount:
        w = 2 * np.pi * phone.mount_frequency
        b, a = bilinear(
            [2 * phone.mount_damping * w, w * w], [1.0, 2 * phone.mount_damping * w, w * w], fs=1 / dt
        )
        out = lfilter(b, a, out, axis=0, zi=lfilter_zi(b, a)[:, None] * out[:1])[0]
    b, a = butter(2, phone.bandwidth, fs=1 / dt)
    return np.asarray(lfilter(b, a, out, axis=0, zi=lfilter_zi(b, a)[:, None] * out[:1])[0])


def phone_samples(
    t: Floats, force: Floats, rate: Floats, phone: Phone, start: float, seed: int
) -> tuple[Floats, Floats, Floats]:
    """Stamps (k,) s, specific force (k, 3) and angular rate (k, 3) in the phone's axes.

    ``t`` (n,) s from 0, ``force`` and ``rate`` (n, 3) the true ones at the phone's place and in
    its axes; ``start`` is the stamp of t = 0.
    """
    dt = float(t[1] - t[0])
    delay = np.sqrt(2.0) / (2 * np.pi * phone.bandwidth)  # group delay of a second-order Butterworth at 0 Hz
    felt = np.hstack([_chain(force, dt, phone, True), _chain(rate, dt, phone, False)])
    # Every random number belongs to one sample: a shorter run has the same beginning.
    count = int((t[-1] - delay) * phone.rate)
    draw = np.random.default_rng(seed).standard_normal((count, 8))
    ideal = np.arange(count) / phone.rate
    at = ideal + delay
    left = np.clip(np.floor(at / dt).astype(int), 0, t.size - 2)
    part = ((at - t[left]) / dt)[:, None]
    sample = (1 - part) * felt[left] + part * felt[left + 1]
    sample[:, :3] += phone.force_bias + phone.force_noise * draw[:, :3]
    sample[:, 3:] += phone.rate_bias + phone.rate_noise * draw[:, 3:6]
    steps = np.repeat([phone.force_step, phone.rate_step], 3)
    sample = np.round(sample / steps) * steps
    stamps = start + ideal + phone.lag + np.round(np.clip(phone.jitter * draw[:, 6], -4e-3, 4e-3), 6)
    kept = ndtr(draw[:, 7]) >= phone.lost
    return stamps[kept], sample[kept, :3], sample[kept, 3:]


def receiver_fixes(
    t: Floats, antenna: Floats, receiver: Receiver, datum: tuple[float, float, float], start: float, seed: int
) -> tuple[Floats, Floats, Floats]:
    """Stamps (m,), latitude, longitude and altitude (m, 3), velocity (m, 3) m/s east, north, up.

    ``antenna`` (n, 3) m in ``map`` at ``t`` (n,) s.
    """
    dt = float(t[1] - t[0])
    stride = round(1 / receiver.rate / dt)
    index = np.arange(stride, t.size - stride, stride)
    velocity = (antenna[index + 4] - antenna[index - 4]) / (8 * dt)
    draw = np.random.default_rng(seed).standard_normal((index.size, 9))
    keep = np.exp(-1 / receiver.rate / receiver.wander_time)
    if receiver.settled:
        draw[0, :3] /= np.sqrt(1 - keep**2)
    wander = lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], draw[:, :3], axis=0) * receiver.wander
    scale = np.array([1.0, 1.0, receiver.vertical])
    place = antenna[index] + (wander + receiver.white * draw[:, 3:6]) * scale
    velocity = velocity + receiver.velocity * draw[:, 6:] * scale
    geodetic = np.column_stack(pymap3d.enu2geodetic(place[:, 0], place[:, 1], place[:, 2], *datum))
    return start + t[index] + receiver.late, geodetic, velocity
