# SPDX-License-Identifier: Apache-2.0
"""A bank of places along the road, weighted by what the IMU feels there and by what a model expects to feel.

A place is a distance ahead of one that is carried on. Beside the places stands the null hypothesis: road and drive do
not belong together. It expects nothing and takes the measured signal for noise of the size that it has; a place takes
what it does not explain for noise of ``SHARES`` of that size. A Bayes filter: weights are moved, multiplied by
likelihoods and normalised, so that evidence for a wrong place comes by chance as rarely as its odds say.
"""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.pose.types import RECEIVER_TIME

__all__ = ["SHARES", "PlaceBank", "PlaceEvidence", "correlate"]

#: Residuals of a model as shares of the motion: a calibrated one of a sound car leaves a fifth
#: (benchmarks/discrepancy.py), a coarse one half of it, and at three quarters it explains nearly nothing.
SHARES = np.array([0.2, 0.4, 0.75])
#: s after which a vehicle may have come onto the known road or left it (prior: once in a drive of an hour). A bump that
#: is like one of the map is evidence of 10 to 15 nats: not enough against a road that was another one before it.
_ROAD_TIME = 3600.0
#: s over which the size of the motion is averaged: a car's body comes to rest in about that.
_RINGING = 1.0


class PlaceBank:
    """Weights of places ``offsets`` (p,) m, evenly apart, for each of the shares that the model may leave, and of none.

    ``weights`` (shares, p) and ``null`` sum to 1.
    """

    def __init__(self, offsets: Floats) -> None:
        self.offsets = offsets
        self.step = float(offsets[1] - offsets[0])
        self.weights = np.full((SHARES.size, offsets.size), 0.5 / (SHARES.size * offsets.size))
        self.null = 0.5

    def prior(self, centre: float, sigma: float) -> Floats:
        """(shares, p) the receiver's own: ``sigma`` m about ``centre`` m, no share rather than another."""
        p = np.exp(-0.5 * ((self.offsets - centre) / sigma) ** 2)
        return np.broadcast_to(p / (p.sum() * SHARES.size), self.weights.shape)

    def begin(self, centre: float, sigma: float) -> None:
        """The receiver's prior is all that is known, road and drive belong together or not."""
        self.weights[:] = 0.5 * self.prior(centre, sigma)
        self.null = 0.5

    def move(self, dt: float, shift: float, wander: float, prior: tuple[float, float]) -> None:
        """``dt`` s later: places have moved by ``shift`` m and spread by ``wander`` m, and a share of all weights has
        returned to the ``prior``, its centre and standard deviation in m (a Markov chain with that stationary state).
        """
        reach = math.ceil((4.0 * wander + abs(shift)) / self.step)
        kernel = np.exp(-0.5 * ((np.arange(-reach, reach + 1) * self.step - shift) / wander) ** 2)
        kernel /= kernel.sum()
        held = np.pad(self.weights, ((0, 0), (reach, reach)), mode="edge")
        self.weights[:] = [np.convolve(row, kernel, mode="valid") for row in held]
        back = -math.expm1(-dt / RECEIVER_TIME)
        other = -math.expm1(-dt / _ROAD_TIME)
        known = 1.0 - self.null
        self.weights *= 1.0 - back
        self.weights += back * known * self.prior(*prior)
        self.weights *= 1.0 - other
        self.weights += 0.5 * other * self.prior(*prior)
        self.null += other * (0.5 - self.null)
        self._normalise()

    def weigh(self, gain: Floats) -> None:
        """Multiply by the likelihoods, ``gain`` (shares, p) their logarithms less that of the null hypothesis."""
        top = max(float(gain.max()), 0.0)
        self.weights *= np.exp(gain - top)
        self.null *= math.exp(-top)
        self._normalise()

    def _normalise(self) -> None:
        total = float(self.weights.sum()) + self.null
        self.weights /= total
        self.null /= total

    @property
    def mean(self) -> float:
        """m, of the places, given that road and drive belong together."""
        places = self.weights.sum(axis=0)
        return float(places @ self.offsets / places.sum())

    @property
    def spread(self) -> float:
        """Standard deviation in m, as the mean."""
        places = self.weights.sum(axis=0)
        return math.sqrt(
            max(float(places @ (self.offsets - self.mean) ** 2 / places.sum()), self.step**2 / 12)
        )


class PlaceEvidence:
    """Log-likelihoods of places over that of the null hypothesis, stretch by stretch.

    ``floor`` (c,) are standard deviations of the c measured signals from below which nothing follows.
    """

    def __init__(self, floor: Floats, places: int) -> None:
        self._floor = floor**2
        self._measured = np.zeros(floor.size)
        self._lagged = np.zeros(floor.size)
        self._expected = np.zeros((places, floor.size))
        self._before = np.zeros((1, floor.size))

    def gain(self, dt: float, measured: Floats, products: Floats, squares: Floats) -> Floats:
        """(shares, p) of ``dt`` s of signals ``measured`` (n, c); ``products`` (p, c) are the means of measured times
        expected, ``squares`` (p, c) of expected squared.

        Neighbouring samples are alike: a signal has an independent value in every half wave, of which n samples of
        correlation r hold n acos(r) / pi (Rice 1945).
        """
        share = dt / (_RINGING + dt)
        own = np.mean(measured**2, axis=0)
        lagged = np.mean(measured * np.concatenate([self._before, measured[:-1]]), axis=0)
        self._before = measured[-1:].copy()
        self._measured += share * (own - self._measured)
        self._lagged += share * (lagged - self._lagged)
        self._expected += share * (squares - self._expected)
        alike = self._lagged / np.maximum(self._measured, self._floor)
        count = len(measured) * np.arccos(np.clip(alike, 0.0, 1.0)) / math.pi
        size = np.maximum(own, self._measured)
        null = np.maximum(size, self._floor)
        motion = np.maximum(size, np.maximum(squares, self._expected))
        left = np.maximum(own - 2.0 * products + squares, 0.0)
        noise = np.maximum(SHARES[:, None, None] ** 2 * motion, self._floor)
        gain = (np.log(null) + own / null) - (np.log(noise) + left / noise)
        out: Floats = 0.5 * (gain * count).sum(axis=2)
        return out


@compiled
def correlate(
    history: Floats, rows: Floats, measured: Floats, products: Floats, squares: Floats
) -> None:  # pragma: no cover - compiled
    """Means of measured times expected, and of expected squared, of every place, into (p, c).

    ``history`` (h, c, lanes) is what lanes felt; a place that lies behind lane k + 1, and after lane k, by part j of
    their distance felt what it did at row ``rows`` (n, parts) [:, j], between two rows; ``measured`` (n, c).
    """
    n, parts = rows.shape
    channels, lanes = history.shape[1], history.shape[2]
    products[:] = 0.0
    squares[:] = 0.0
    for i in range(n):
        for j in range(parts):
            at = int(rows[i, j])
            f = rows[i, j] - at
            after = min(at + 1, history.shape[0] - 1)
            for c in range(channels):
                for k in range(1, lanes):
                    s = history[at, c, k] + f * (history[after, c, k] - history[at, c, k])
                    p = k * parts - j
                    products[p, c] += measured[i, c] * s / n
                    squares[p, c] += s * s / n
            if j == 0:
                for c in range(channels):
                    s = history[at, c, 0] + f * (history[after, c, 0] - history[at, c, 0])
                    products[0, c] += measured[i, c] * s / n
                    squares[0, c] += s * s / n
