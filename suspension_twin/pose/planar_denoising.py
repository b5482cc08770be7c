# SPDX-License-Identifier: Apache-2.0
"""Denoising of the planar motion that excites a model.

Load transfer follows the planar acceleration of the centre of gravity. Its slow part is that of the smoothed path, its
fast part that of the IMU: specific force less gravity, transformed from the sensor to the centre of gravity. Gyro noise
times speed would excite the roll of the simulated body as much as a smooth road does, and a fit would compensate for it
with too large an inertia. Short segments of these signals are therefore Wiener filtered with the known noise density.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.pose.ekf import planar_acceleration
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.noise_floor import white_noise_sigma
from suspension_twin.signals.offline import ImuSignals

__all__ = ["SLOW", "denoised_motion", "felt_acceleration", "wiener"]

#: Crossover from the acceleration of the path to that of the accelerometer.
SLOW = FilterSpec(2, 0.4)
#: Bandwidth of the planar motion of the vehicle as a whole.
_PLANAR = FilterSpec(2, 12.0)
_PIECE = 4.0  # s
_SMOOTH = 5  # bins over which a piece's spectrum is averaged
_OVER = 2.0  # oversubtraction: the spectrum of a short segment scatters


def denoised_motion(trajectory: Trajectory, signals: ImuSignals, centre: float) -> Trajectory:
    """The trajectory with yaw rate and planar accelerations freed of the IMU's white noise.

    ``centre`` m is the height of the centre of gravity.
    """
    rate = signals.rate_hz
    nyquist = 0.5 * rate
    ahead, above = signals.place.position[0], signals.place.position[2] - centre
    roll, pitch, yaw = (white_noise_sigma(signals.rate[:, axis], rate) for axis in range(3))
    force = [white_noise_sigma(signals.force[:, axis], rate) for axis in range(2)]

    yaw_rate = wiener(trajectory.yaw_rate, rate, lambda f: np.full_like(f, yaw**2 / nyquist))
    ax, ay = trajectory.acceleration.T
    turned = ay + trajectory.speed * (yaw_rate - trajectory.yaw_rate)
    pull, push = felt_acceleration(signals, centre)
    # the lever arms from the sensor to the centre of gravity add the derivatives of the gyro noise
    ax = wiener(
        zero_phase(SLOW, rate, ax - pull) + pull,
        rate,
        lambda f: (force[0] ** 2 + (above * 2 * np.pi * f * pitch) ** 2) / nyquist,
    )
    ay = wiener(
        zero_phase(SLOW, rate, turned - push) + push,
        rate,
        lambda f: (
            (force[1] ** 2 + (2 * np.pi * f) ** 2 * ((above * roll) ** 2 + (ahead * yaw) ** 2)) / nyquist
        ),
    )
    return replace(trajectory, yaw_rate=yaw_rate, acceleration=np.column_stack([ax, ay]))


def felt_acceleration(signals: ImuSignals, centre: float) -> tuple[Floats, Floats]:
    """(n,) m/s² forward and left at the height ``centre`` m above the origin of base_link, by the IMU alone."""
    spec = FilterSpec(_PLANAR.order, min(_PLANAR.cutoff, 0.4 * signals.rate_hz))
    rate = zero_phase(spec, signals.rate_hz, signals.rate)
    force = zero_phase(spec, signals.rate_hz, signals.force - signals.gravity * signals.up)
    x, y, z = signals.place.position
    faster = np.gradient(rate, signals.t, axis=0)
    return planar_acceleration(tuple(force.T), tuple(rate.T), tuple(faster.T), (x, y, z - centre))


def wiener(
    x: Floats,
    rate: float,
    noise: Callable[[Floats], Floats],
) -> Floats:
    """``x`` (n,) at ``rate`` Hz, Wiener filtered in overlapping segments for noise of the one-sided density
    ``noise(f)``.

    Straight lines pass unchanged, and so does ``x`` for zero noise.
    """
    size = 4 * max(8, round(_PIECE * rate / 4))
    hop = size // 4
    if x.size < size:
        return x.copy()
    window = np.sin(np.pi * (np.arange(size) + 0.5) / size)
    floor = noise(np.asarray(np.fft.rfftfreq(size, 1.0 / rate), dtype=np.float64))
    scale = 2.0 / (rate * np.sum(window**2))
    line = np.linspace(-1.0, 1.0, size)
    square = np.sum(line**2)

    def extended(values: Floats) -> Floats:
        before, after = 2 * values[0] - values[size:0:-1], 2 * values[-1] - values[-2 : -size - 2 : -1]
        return np.asarray(np.concatenate([before, values, after]), dtype=np.float64)

    def power(spectrum: NDArray[np.complex128]) -> Floats:
        padded = np.pad(scale * np.abs(spectrum) ** 2, _SMOOTH // 2, mode="edge")
        return np.asarray(np.convolve(padded, np.ones(_SMOOTH) / _SMOOTH, mode="valid"))

    whole = extended(x)
    out, weight = np.zeros_like(whole), np.zeros_like(whole)
    for start in range(0, whole.size - size + 1, hop):
        piece = whole[start : start + size]
        base = piece.mean() + np.sum(line * piece) / square * line
        spectrum = np.fft.rfft((piece - base) * window)
        keep = np.maximum(0.0, 1.0 - _OVER * floor / np.maximum(power(spectrum), 1e-300))
        out[start : start + size] += window * (np.fft.irfft(spectrum * keep, size) + window * base)
        weight[start : start + size] += window**2
    inside = slice(size, size + x.size)
    return np.asarray(out[inside] / np.maximum(weight[inside], 1e-12))
