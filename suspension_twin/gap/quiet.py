# SPDX-License-Identifier: Apache-2.0
"""Planar motion without the sensors' noise, before it drives a model.

Yaw rate and forward pull come from a gyro and an accelerometer and go into the load transfer. A
gyro's noise times the speed shakes the simulated body in roll as much as a smooth road does; what
a least squares fit then makes of it is a body too heavy to be shaken. Where the noise is known,
each short piece of such a signal is cleaned by a Wiener filter: what stands out of the noise
stays as it is, what does not goes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from suspension_twin.drive.types import Floats
from suspension_twin.gap.noise import white_noise_sigma
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.offline import ImuSignals

__all__ = ["quiet_motion", "wiener"]

#: Below this the locked pose knows the pull better, above the accelerometer does.
_SLOW = FilterSpec(2, 0.4)
#: Beyond this no vehicle as a whole accelerates, Hz.
_PLANAR = FilterSpec(2, 12.0)
_PIECE = 4.0  # s
_SMOOTH = 5  # bins over which a piece's spectrum is averaged
_OVER = 2.0  # the spectrum of a short piece scatters: what is less than this many times the noise goes


def quiet_motion(trajectory: Trajectory, signals: ImuSignals, centre: float) -> Trajectory:
    """The trajectory with yaw rate and planar accelerations freed of the IMU's white noise.

    ``centre`` m is the height of the centre of gravity.
    """
    rate = signals.rate_hz
    nyquist = 0.5 * rate
    height = signals.place.position[2]
    yaw, pitch = (white_noise_sigma(signals.rate[:, axis], rate) for axis in (2, 1))
    force = white_noise_sigma(signals.force[:, 0], rate)

    def of_yaw(f: Floats) -> Floats:
        return np.full_like(f, yaw**2 / nyquist)

    def of_pull(f: Floats) -> Floats:
        # the lever of pitching from the sensor down to base_link brings the derivative of the gyro's noise
        return np.asarray((force**2 + (height * 2 * np.pi * f) ** 2 * pitch**2) / nyquist)

    yaw_rate = wiener(trajectory.yaw_rate, rate, of_yaw)
    pull, pitching = _pull(signals)
    slow = zero_phase(_SLOW, rate, trajectory.ax - pull)
    ax = wiener(slow + pull, rate, of_pull, against=centre * pitching)
    ay = trajectory.ay + trajectory.speed * (yaw_rate - trajectory.yaw_rate)
    return replace(trajectory, yaw_rate=yaw_rate, ax=ax, ay=ay)


def _pull(signals: ImuSignals) -> tuple[Floats, Floats]:
    """(n,) forward acceleration of base_link's origin by the IMU alone, gravity and the sensor's lever taken
    out, and (n,) the pitch acceleration in rad/s²."""
    spec = FilterSpec(_PLANAR.order, min(_PLANAR.cutoff, 0.4 * signals.rate_hz))
    rate = zero_phase(spec, signals.rate_hz, signals.rate)
    force = zero_phase(spec, signals.rate_hz, signals.force[:, 0] - signals.gravity * signals.up[:, 0])
    x, _, z = signals.place.position
    pitching = np.gradient(rate[:, 1], signals.t)
    return np.asarray(force - z * pitching + x * rate[:, 2] ** 2), np.asarray(pitching)


def wiener(
    x: Floats,
    rate: float,
    noise: Callable[[Floats], Floats],
    against: Floats | None = None,
    seconds: float = _PIECE,
) -> Floats:
    """``x`` (n,) at ``rate`` Hz without noise of the one-sided density ``noise(f)``, in overlapping pieces.

    ``against`` (n,) is a signal whose own spectrum, piece by piece, counts as noise as well. Straight
    lines pass; so does what stands well above the noise. Without any noise nothing changes.
    """
    size = 4 * max(8, round(seconds * rate / 4))
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
    other = None if against is None else extended(against)
    out, weight = np.zeros_like(whole), np.zeros_like(whole)
    for start in range(0, whole.size - size + 1, hop):
        piece = whole[start : start + size]
        base = piece.mean() + np.sum(line * piece) / square * line
        spectrum = np.fft.rfft((piece - base) * window)
        unwanted = floor
        if other is not None:
            unwanted = floor + power(np.fft.rfft(other[start : start + size] * window))
        keep = np.maximum(0.0, 1.0 - _OVER * unwanted / np.maximum(power(spectrum), 1e-300))
        out[start : start + size] += window * (np.fft.irfft(spectrum * keep, size) + window * base)
        weight[start : start + size] += window**2
    inside = slice(size, size + x.size)
    return np.asarray(out[inside] / np.maximum(weight[inside], 1e-12))
