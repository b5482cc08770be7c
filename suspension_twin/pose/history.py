# SPDX-License-Identifier: Apache-2.0
"""The last seconds of the live filter, so that a delayed measurement is used at its own stamp."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.pose import ekf

__all__ = ["History", "Measurement"]

#: Two numbers and a standard deviation.
Measurement = tuple[float, float, float]

_SLOTS = 256  # measurements within the history
_MAX_RATE = 1700.0


class History:
    """A ring of samples with the filter's state after each, and the measurements that fell between them.

    A sample is known by its index, counted without end; ``head`` is the newest, -1 before the first.
    """

    def __init__(self, seconds: float, noise: Floats) -> None:
        size = int(seconds * _MAX_RATE) + 2
        self._t = np.zeros(size)
        self._inputs = np.zeros((size, 11))
        self._states = np.zeros((size, ekf.STATES))
        self._covariances = np.zeros((size, ekf.STATES, ekf.STATES))
        self._noise = noise.copy()
        self._kinds = np.zeros(_SLOTS)
        self._times = np.zeros(_SLOTS)
        self._values = np.zeros((_SLOTS, 3))
        self._weights = np.zeros(_SLOTS)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.head = -1
        self._log_t: list[float] = []
        self._log: list[tuple[int, Measurement]] = []

    def stamp(self, index: int) -> float:
        """Stamp in s of a sample."""
        return float(self._t[index % self._t.size])

    def inputs(self, index: int) -> Floats:
        """(11,) inputs of a sample, to read or to fill."""
        row: Floats = self._inputs[index % self._t.size]
        return row

    def state(self, index: int) -> Floats:
        """(8,) state after a sample, to read or to fill."""
        row: Floats = self._states[index % self._t.size]
        return row

    def covariance(self, index: int) -> Floats:
        """(8, 8) covariance after a sample, to read or to fill."""
        block: Floats = self._covariances[index % self._t.size]
        return block

    def append(self, t: float) -> Floats:
        """A new sample at ``t`` s; its inputs (11,) are to be filled."""
        self.head += 1
        self._t[self.head % self._t.size] = t
        return self.inputs(self.head)

    def before(self, t: float) -> int:
        """The newest sample before ``t`` s, or -1 where the history does not reach back so far."""
        size, low, high = self._t.size, self._oldest(), self.head
        if high < 0 or self._t[low % size] >= t:
            return -1
        while low < high:
            middle = (low + high + 1) // 2
            if self._t[middle % size] < t:
                low = middle
            else:
                high = middle - 1
        return low

    def _oldest(self) -> int:
        return max(0, self.head - self._t.size + 2)

    def step(self) -> None:
        """Filter from the sample before the newest to the newest, no measurement between."""
        self._advance(self.head - 1, 0)

    def run(self, first: int) -> None:
        """Filter again from sample ``first``, whose state stands, with all that was measured since."""
        start = bisect_right(self._log_t, self.stamp(first))
        for slot, (t, (kind, z)) in enumerate(zip(self._log_t[start:], self._log[start:], strict=True)):
            self._times[slot] = t
            self._kinds[slot] = kind
            self._values[slot] = z
        self._advance(first, len(self._log_t) - start)

    def let_bias_walk(self, density: float) -> None:
        """How the accelerometer's bias wanders from now on, and in what is filtered again, (m/s²)²/s."""
        self._noise[ekf.FORCE_BIAS_WALK] = density

    def relevel(self, force: float, ahead: float, left: float, sigma: float) -> None:
        """The vertical was wrong: ``force`` m/s² comes on the forward specific force, ``ahead`` and ``left`` m on the
        antenna's place, and what is left over of the accelerometer's bias has the standard deviation ``sigma`` m/s².

        The states move with their inputs, so that what was measured still agrees, and each of them learns that the
        bias is then 0. By how much is taken for the same all over the history: its seconds are fewer than a bend's.
        """
        rows = np.arange(self._oldest(), self.head + 1) % self._t.size
        self._inputs[rows, ekf.FORWARD_FORCE] += force
        self._inputs[rows, ekf.ANTENNA_X] += ahead
        self._inputs[rows, ekf.ANTENNA_Y] += left
        x, p = self._states[rows], self._covariances[rows]
        c, s = np.cos(x[:, ekf.YAW]), np.sin(x[:, ekf.YAW])
        x[:, ekf.X] -= ahead * c - left * s
        x[:, ekf.Y] -= ahead * s + left * c
        x[:, ekf.ACCELEROMETER_BIAS] += force
        column = p[:, :, ekf.ACCELEROMETER_BIAS]
        gain = column / (column[:, ekf.ACCELEROMETER_BIAS, None] + sigma**2)
        self._states[rows] = x - gain * x[:, ekf.ACCELEROMETER_BIAS, None]
        self._covariances[rows] = p - gain[:, :, None] * column[:, None, :]

    def forget_bias(self, sigma: float) -> None:
        """The newest sample's vertical is in doubt: the accelerometer's bias is 0 with the standard deviation ``sigma``
        m/s², whatever was known of it."""
        before = self.head - 1
        self.state(before)[ekf.ACCELEROMETER_BIAS] = 0.0
        block = self.covariance(before)
        block[ekf.ACCELEROMETER_BIAS, :] = block[:, ekf.ACCELEROMETER_BIAS] = 0.0
        block[ekf.ACCELEROMETER_BIAS, ekf.ACCELEROMETER_BIAS] = sigma**2

    def take(self, first: int, t: float, kind: int, z: Measurement) -> float:
        """Put a measurement in at ``t`` s, after sample ``first``, and filter again; the weight it got."""
        at = bisect_right(self._log_t, t)
        self._log_t.insert(at, t)
        self._log.insert(at, (kind, z))
        old = bisect_right(self._log_t, self.stamp(self._oldest()))
        old = max(old, len(self._log_t) - _SLOTS)
        del self._log_t[:old], self._log[:old]
        self.run(first)
        slot = bisect_right(self._log_t, t) - 1 - bisect_right(self._log_t, self.stamp(first))
        return float(self._weights[slot]) if slot >= 0 else 0.0

    def _advance(self, first: int, count: int) -> None:
        ekf.advance(
            self._t,
            self._inputs,
            self._states,
            self._covariances,
            first,
            self.head,
            self._kinds,
            self._times,
            self._values,
            self._weights,
            count,
            self._noise,
        )
