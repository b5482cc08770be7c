# SPDX-License-Identifier: Apache-2.0
"""The linear inverse: a Gaussian road seen through the twin by several passes at once.

Unknown are the mean and the half difference of the heights of both wheel paths on a grid of lines
beside each other, and a shift along the road of each pass at its knots. A priori the road is a
filtered white noise, ``x = S w`` with ``|S|²`` the spectrum, coherent across as an isotropic surface
is, and the noise of each channel of a pass is stationary with a spectrum of its own. What is solved is
(I + Aᵀ A) w = Aᵀ r with A the whitened chain from w to the channels, by conjugate gradients; every
factor is a Fourier transform or a sparse matrix, so the cost grows with the length of the road and not
with its square. The posterior is sampled by solving the same equations for a road drawn from the prior
and channels that it would have given with noise (Papandreou and Yuille, NIPS 23 (2010) 1858; the error
of that estimate has the posterior's covariance).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.sparse import csr_matrix
from scipy.special import k1

from suspension_twin.addons.roads.drives.passes import FINE, Pass
from suspension_twin.arrays import Floats

__all__ = ["Inverse", "KnownHeights", "RoadPrior", "Seen", "Unknown", "coherence", "period_of"]

Complex = NDArray[np.complex128]

#: Relative residual of the equations, of the mean and of draws, whose errors are known to a tenth anyway.
_TOLERANCE, _ROUGH = 1e-3, 5e-3
_MOST = 400  # iterations
#: Share of the power of neighbouring lines that is isotropic roughness. Learnt: of 0.03, 0.05, 0.1, 0.3 and 1, the
#: one with which the five drives of benchmarks/road_from_drives.py, newton 7001, leave least of another drive.
_ISOTROPIC = 0.1
_NUGGET = 1e-6  # on the diagonal of coherences, all 1 for the longest waves


@dataclass(frozen=True, eq=False)
class Unknown:
    """``road`` (2, lines, period): white noise of mean and half difference; ``shifts``: each pass's (j,) in prior
    sigmas."""

    road: Floats
    shifts: tuple[Floats, ...]

    def plus(self, factor: float, other: Unknown) -> Unknown:
        """This plus ``factor`` times another."""
        shifts = tuple(a + factor * b for a, b in zip(self.shifts, other.shifts, strict=True))
        return Unknown(self.road + factor * other.road, shifts)

    def dot(self, other: Unknown) -> float:
        """Inner product."""
        shifts = sum(float(a @ b) for a, b in zip(self.shifts, other.shifts, strict=True))
        return float(np.vdot(self.road, other.road)) + shifts


@dataclass(frozen=True, eq=False)
class RoadPrior:
    """The road a priori: ``spectrum`` (2, k) m³, one-sided, of mean and half difference at ``n`` (k,) cycles/m;
    ``scale`` (2, period) by which the white noise is larger in places; ``count`` heights every ``step`` m on lines
    that lie ``across`` (k,) m to the left of their wheel path."""

    count: int
    period: int
    step: float
    spectrum: Floats
    scale: Floats
    across: Floats

    @cached_property
    def mixing(self) -> Floats:
        """(k, lines, lines) at ``n``: a factor of the coherence of the lines."""
        return np.asarray(np.linalg.cholesky(coherence(self.n, self.across)), dtype=np.float64)

    @property
    def n(self) -> Floats:
        """(k,) cycles/m."""
        return np.asarray(np.fft.rfftfreq(self.period, self.step), dtype=np.float64)

    @property
    def factor(self) -> Complex:
        """(2, k): the gain from white noise to heights. Its phase is that of an integrator, so that a change of
        scale at one place changes the slopes there."""
        gain: Complex = np.sqrt(self.spectrum / (2.0 * self.step)) * -1j
        gain[:, 0] = 0.0
        return gain

    def heights(self, white: Floats) -> Floats:
        """Heights (2, lines, count) m of mean and half difference."""
        spectrum = self.factor[:, None] * rfft(self.scale[:, None] * white, axis=2)
        out: Floats = irfft(self._mixed(spectrum, self.mixing), self.period, axis=2)[..., : self.count]
        return out

    def _mixed(self, spectrum: Complex, mixing: Floats) -> Complex:
        """Each frequency of (2, lines, k) times its matrix."""
        if self.across.size == 1:
            return spectrum
        return np.ascontiguousarray(
            (mixing @ spectrum.transpose(0, 2, 1)[..., None])[..., 0].transpose(0, 2, 1)
        )

    def back(self, heights: Floats) -> Floats:
        """The adjoint: (2, lines, period)."""
        padded = np.zeros((2, self.across.size, self.period))
        padded[..., : self.count] = heights
        spectrum = np.conj(self.factor)[:, None] * rfft(padded, axis=2)
        mixed = self._mixed(spectrum, self.mixing.transpose(0, 2, 1))
        out: Floats = self.scale[:, None] * irfft(mixed, self.period, axis=2)
        return out


def coherence(n: Floats, across: Floats) -> Floats:
    """(k, lines, lines) at ``n`` (k,) cycles/m of the heights on lines ``across`` m.

    A share of the heights is an isotropic surface, the others (humps, edges) are alike on all lines. An isotropic
    surface whose profiles have a spectrum n^-2 has x K1(x) between lines d apart, x = 2 pi n d.
    """
    x = 2.0 * np.pi * n[:, None, None] * np.abs(across[:, None] - across)
    near = x < 1e-6
    safe = np.where(near, 1.0, x)
    alike = np.where(near, 1.0, safe * k1(safe))
    return np.asarray(1.0 - _ISOTROPIC + _ISOTROPIC * alike + _NUGGET * np.eye(across.size), dtype=np.float64)


def period_of(count: int, step: float) -> int:
    """Samples of a period that holds ``count`` heights and 60 m for them to forget each other."""
    return int(next_fast_len(count + round(60.0 / step), real=True))


class Seen:
    """One pass's chain from heights to whitened channels, about a road and a shift."""

    def __init__(
        self, one: Pass, gain: Complex, noise: Floats, wheels: Sequence[csr_matrix], slope: Floats
    ) -> None:
        """``gain`` (k, 3, 4) at the pass's frequencies, filter included; ``noise`` (3, k) one-sided PSD, infinite
        where nothing is compared; ``slope`` (4, FINE n) of the road under each wheel."""
        self.one, self.wheels, self.slope = one, wheels, slope
        self.gain = np.ascontiguousarray(gain.transpose(1, 2, 0))  # (3, 4, k)
        self.n = one.t.size
        self.whitening = 1.0 / np.sqrt(noise * 0.5 * one.rate)
        self.back = [w.T.tocsr() for w in wheels]
        edge = np.zeros(FINE * self.n)
        edge[:] = 1.0
        rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(round(FINE * one.rate)) / (FINE * one.rate))
        edge[: rise.size] = rise[: edge.size]
        edge[-rise.size :] = np.minimum(edge[-rise.size :], rise[::-1])
        self.edge = edge  # the start of a period must not see its end as a step

    def channels(self, heights: Floats, shift: Floats) -> Floats:
        """Channels (3, n), not whitened, of changes of heights (2, lines, count) and shift (j,) m."""
        moved = shift @ self.one.knots
        sides = ((heights[0] + heights[1]).ravel(), (heights[0] - heights[1]).ravel())
        z = np.array([w @ sides[i % 2] for i, w in enumerate(self.wheels)]) + self.slope * moved
        spectrum = rfft(z * self.edge, axis=1)[:, : self.n // 2 + 1] / FINE
        out: Floats = irfft((self.gain * spectrum).sum(axis=1), self.n, axis=1)
        return out

    def forward(self, heights: Floats, shift: Floats) -> Floats:
        """Whitened channels (3, n)."""
        return self.whiten(self.channels(heights, shift))

    def whiten(self, channels: Floats) -> Floats:
        """Channels (3, n) with their weights, at unit variance a sample where there is noise alone."""
        out: Floats = irfft(self.whitening * rfft(channels * self.one.weight, axis=1), self.n, axis=1)
        return out

    def coloured(self, rng: np.random.Generator) -> Floats:
        """Noise (3, n) with the spectrum that is assumed; none where nothing is compared."""
        white = rfft(rng.standard_normal((3, self.n)), axis=1)
        used = self.whitening > 0.0
        colour = np.divide(1.0, self.whitening, out=np.zeros_like(self.whitening), where=used)
        out: Floats = irfft(colour * white, self.n, axis=1)
        return out

    def adjoint(self, white: Floats) -> tuple[Floats, Floats]:
        """Of ``forward``: heights (2, lines count) and shift (j,)."""
        channels = self.one.weight * irfft(self.whitening * rfft(white, axis=1), self.n, axis=1)
        spectrum = np.zeros((4, FINE * self.n // 2 + 1), dtype=np.complex128)
        half = self.n // 2 + 1
        spectrum[:, :half] = (np.conj(self.gain) * rfft(channels, axis=1)[:, None]).sum(axis=0)
        if self.n % 2 == 0 and spectrum.shape[1] > half:
            spectrum[:, half - 1] *= 0.5  # the last of the coarse is one of a pair in the fine
        z = self.edge * irfft(spectrum, FINE * self.n, axis=1)
        parts = [b @ z[i] for i, b in enumerate(self.back)]
        left, right = parts[0] + parts[2], parts[1] + parts[3]
        return np.array([left + right, left - right]), self.one.knots @ (self.slope * z).sum(axis=0)


@dataclass(frozen=True, eq=False)
class KnownHeights:
    """A stretch whose shape was measured: the heights of ``sides`` (of left and right) from the sample ``first`` on are
    ``shape`` (m,) m above the straight line between its ends, with an error of ``sigma`` m each, on all ``lines``."""

    first: int
    shape: Floats
    sides: tuple[int, ...]
    sigma: float
    lines: int = 1

    @property
    def target(self) -> Floats:
        """(sides, lines, m), whitened."""
        return np.tile(self.shape / self.sigma, (len(self.sides), self.lines, 1))

    def forward(self, heights: Floats) -> Floats:
        """Whitened (sides, lines, m) of heights (2, lines, count) of mean and half difference."""
        part = heights[..., self.first : self.first + self.shape.size]
        sides = np.array([part[0] + part[1], part[0] - part[1]])[list(self.sides)]
        share = np.linspace(0.0, 1.0, self.shape.size)
        level = sides[..., :1] * (1.0 - share) + sides[..., -1:] * share
        return np.asarray((sides - level) / self.sigma, dtype=np.float64)

    def adjoint(self, white: Floats, count: int) -> Floats:
        """Of ``forward``: (2, lines, count)."""
        share = np.linspace(0.0, 1.0, self.shape.size)
        each = white.copy()
        each[..., 0] -= white @ (1.0 - share)
        each[..., -1] -= white @ share
        out = np.zeros((2, self.lines, count))
        stretch = slice(self.first, self.first + self.shape.size)
        for side, rows in zip(self.sides, each / self.sigma, strict=True):
            out[0, :, stretch] += rows
            out[1, :, stretch] += rows if side == 0 else -rows
        return out


class Inverse:
    """The posterior of road and shifts given what several passes saw, and heights that are known.

    Lists of whitened values hold those of the passes first, then those of the known heights.
    """

    def __init__(self, prior: RoadPrior, seen: Sequence[Seen], known: Sequence[KnownHeights] = ()) -> None:
        self.prior, self.seen, self.known = prior, list(seen), list(known)

    def zero(self) -> Unknown:
        """Nothing."""
        shifts = tuple(np.zeros(s.one.knots.shape[0]) for s in self.seen)
        return Unknown(np.zeros((2, self.prior.across.size, self.prior.period)), shifts)

    def shift(self, i: int, white: Floats) -> Floats:
        """Shift (j,) m of pass i at its knots."""
        return white * self.seen[i].one.shift_sigma

    def forward(self, unknown: Unknown) -> list[Floats]:
        """Whitened channels of every pass."""
        heights = self.prior.heights(unknown.road)
        channels = [s.forward(heights, self.shift(i, unknown.shifts[i])) for i, s in enumerate(self.seen)]
        return channels + [k.forward(heights) for k in self.known]

    def adjoint(self, white: Sequence[Floats]) -> Unknown:
        """Of ``forward``."""
        heights = np.zeros((2, self.prior.across.size, self.prior.count))
        shifts = []
        for s, w in zip(self.seen, white, strict=False):
            own, moved = s.adjoint(w)
            heights += own.reshape(heights.shape)
            shifts.append(moved * s.one.shift_sigma)
        for k, w in zip(self.known, white[len(self.seen) :], strict=True):
            heights += k.adjoint(w, self.prior.count)
        return Unknown(self.prior.back(heights), tuple(shifts))

    def solve(self, residuals: Sequence[Floats], tolerance: float = _TOLERANCE) -> Unknown:
        """The posterior mean for whitened residuals (3, n) of every pass, by conjugate gradients."""
        x, r = self.zero(), self.adjoint(residuals)
        p, rr = r, r.dot(r)
        goal = tolerance**2 * rr
        for _ in range(_MOST):
            if rr <= goal:
                break
            ap = self._normal(p)
            alpha = rr / p.dot(ap)
            x, r = x.plus(alpha, p), r.plus(-alpha, ap)
            new = r.dot(r)
            p, rr = r.plus(new / rr, p), new
        return x

    def _normal(self, x: Unknown) -> Unknown:
        return x.plus(1.0, self.adjoint(self.forward(x)))

    def error_sample(self, rng: np.random.Generator) -> Unknown:
        """A draw of the posterior about its mean."""
        truth, white = self.imagined(rng)
        return truth.plus(-1.0, self.solve(white, _ROUGH))

    def imagined(self, rng: np.random.Generator) -> tuple[Unknown, list[Floats]]:
        """A road and shifts drawn from the prior, and the whitened channels that they would give, with noise."""
        zero = self.zero()
        truth = Unknown(
            rng.standard_normal(zero.road.shape), tuple(rng.standard_normal(s.shape) for s in zero.shifts)
        )
        clean = self.forward(truth)
        white = [y + s.whiten(s.coloured(rng)) for s, y in zip(self.seen, clean, strict=False)]
        white += [y + rng.standard_normal(y.shape) for y in clean[len(self.seen) :]]
        return truth, white
