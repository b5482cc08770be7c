# SPDX-License-Identifier: Apache-2.0
"""The linear inverse problem: a Gaussian road measured through the twin by several passes at once.

Unknown are the mean and the half difference of the heights of both wheel paths on a grid of lines
beside each other, and a shift along the road of each pass at its knots. A priori the road is a
filtered white noise, ``x = S w`` with ``|S|²`` the spectrum, coherent across as an isotropic surface
is, and the noise of each channel of a pass is stationary with a spectrum of its own. With A the whitened
chain from w to the channels,

    (I + Aᵀ A) w = Aᵀ r

is solved by conjugate gradients; every factor is a Fourier transform or a sparse matrix, so the cost
grows with the length of the road and not with its square. The posterior is sampled by solving the same
equations for a road drawn from the prior and channels that it would have given with noise (Papandreou and
Yuille, NIPS 23 (2010) 1858; the error of that estimate has the posterior's covariance).

A bump whose size was measured is a further observation of the heights, ``KnownHeights``.
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

from suspension_twin.addons.roads.drives.passes import FINE, RoadPass
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.recipe import Feature, shape_of

__all__ = [
    "Complex",
    "Inverse",
    "KnownHeights",
    "LinearPass",
    "RoadPrior",
    "coherence",
    "known_heights",
    "period_of",
    "sides_of",
]

Complex = NDArray[np.complex128]

#: Relative residual of the equations, of the mean and of draws, whose errors are known to a tenth anyway.
_TOLERANCE, _ROUGH = 1e-3, 5e-3
_MOST = 400  # iterations
#: Share of the power of neighbouring lines that is isotropic roughness. Learnt: of 0.03, 0.05, 0.1, 0.3 and 1, the
#: one with which the five drives of benchmarks/road_from_drives.py, newton 7001, leave least of another drive.
_ISOTROPIC = 0.1
_NUGGET = 1e-6  # on the diagonal of coherences, all 1 for the longest waves
#: m about the stated place within which a bump is looked for, at so many m.
_REACH, _STEP = 3.0, 0.01
#: m before and after a bump that are level with its foot.
_FOOT = 0.3
#: m by which a tape, and the road under a bump, are off.
_SIGMA = 0.002
#: Correlation of the estimate with a bump's shape below which it is another one.
_LEAST = 0.8
#: Factor by which the height may be off in an estimate with a vehicle that is not calibrated.
_ALIKE = 2.0


def sides_of(heights: Floats) -> Floats:
    """Left and right of mean and half difference, (2, ...); and the other way round but for a factor of 2."""
    return np.array([heights[0] + heights[1], heights[0] - heights[1]])


@dataclass(frozen=True, eq=False)
class RoadPrior:
    """The road a priori.

    Parameters
    ----------
    count, period : int
        Heights on each line, and samples of the period of its transform.
    step : float
        m between heights.
    spectrum : (2, k) array
        One-sided PSD in m³ of mean and half difference at ``n``.
    scale : (2, period) array
        Factor by which the white noise is larger in places.
    across : (lines,) array
        m by which the lines lie to the left of their wheel path.
    """

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


class LinearPass:
    """One pass's chain from heights to whitened channels, linear about a road and a shift.

    Parameters
    ----------
    one : RoadPass
        The pass.
    gain : (k, 3, 4) array
        Of the vehicle at the pass's frequencies, filter included.
    noise : (3, k) array
        One-sided PSD of each channel, infinite where nothing is compared.
    wheels : sequence of csr_matrix
        From :meth:`RoadPass.wheel_matrices`.
    slope : (4, FINE n) array
        Of the road under each wheel.
    """

    def __init__(
        self, one: RoadPass, gain: Complex, noise: Floats, wheels: Sequence[csr_matrix], slope: Floats
    ) -> None:
        self.one, self.wheels, self.slope = one, wheels, slope
        self.gain = np.ascontiguousarray(gain.transpose(1, 2, 0))  # (3, 4, k)
        self.n = one.size
        self.whitening = 1.0 / np.sqrt(noise * 0.5 * one.rate)
        self.back = [w.T.tocsr() for w in wheels]
        # The start of a period must not see its end as a step.
        self.edge = np.ones(FINE * self.n)
        rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(round(FINE * one.rate)) / (FINE * one.rate))
        self.edge[: rise.size] = rise[: self.edge.size]
        self.edge[-rise.size :] = np.minimum(self.edge[-rise.size :], rise[::-1])

    def channels(self, heights: Floats, shift: Floats) -> Floats:
        """Channels (3, n), not whitened, of changes of heights (2, lines, count) and shift (j,) m."""
        moved = shift @ self.one.knots
        sides = sides_of(heights).reshape(2, -1)
        z = np.array([w @ sides[i % 2] for i, w in enumerate(self.wheels)]) + self.slope * moved
        spectrum = rfft(z * self.edge, axis=1)[:, : self.n // 2 + 1] / FINE
        out: Floats = irfft((self.gain * spectrum).sum(axis=1), self.n, axis=1)
        return out

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
        """Of whitened :meth:`channels`: heights (2, lines count) and shift (j,)."""
        channels = self.one.weight * irfft(self.whitening * rfft(white, axis=1), self.n, axis=1)
        spectrum = np.zeros((4, FINE * self.n // 2 + 1), dtype=np.complex128)
        half = self.n // 2 + 1
        spectrum[:, :half] = (np.conj(self.gain) * rfft(channels, axis=1)[:, None]).sum(axis=0)
        if self.n % 2 == 0 and spectrum.shape[1] > half:
            spectrum[:, half - 1] *= 0.5  # the last of the coarse is one of a pair in the fine
        z = self.edge * irfft(spectrum, FINE * self.n, axis=1)
        parts = [b @ z[i] for i, b in enumerate(self.back)]
        sides = np.array([parts[0] + parts[2], parts[1] + parts[3]])
        return sides_of(sides), self.one.knots @ (self.slope * z).sum(axis=0)


@dataclass(frozen=True, eq=False)
class KnownHeights:
    """A part of the road whose shape was measured.

    The heights of ``sides`` (of left and right) from the sample ``first`` on are ``shape`` (m,) m above the straight
    line between its ends, with an error of ``sigma`` m each, on all ``lines``.
    """

    first: int
    shape: Floats
    sides: tuple[int, ...]
    sigma: float
    lines: int = 1

    @property
    def target(self) -> Floats:
        """(sides, lines, m), whitened."""
        return np.tile(self.shape / self.sigma, (len(self.sides), self.lines, 1))

    @property
    def share(self) -> Floats:
        """(m,) from 0 at the first to 1 at the last height."""
        return np.linspace(0.0, 1.0, self.shape.size)

    def forward(self, heights: Floats) -> Floats:
        """Whitened (sides, lines, m) of heights (2, lines, count) of mean and half difference."""
        sides = sides_of(heights[..., self.first : self.first + self.shape.size])[list(self.sides)]
        level = sides[..., :1] * (1.0 - self.share) + sides[..., -1:] * self.share
        return np.asarray((sides - level) / self.sigma, dtype=np.float64)

    def adjoint(self, white: Floats, count: int) -> Floats:
        """Of ``forward``: (2, lines, count)."""
        each = white.copy()
        each[..., 0] -= white @ (1.0 - self.share)
        each[..., -1] -= white @ self.share
        sides = np.zeros((2, self.lines, count))
        sides[list(self.sides), :, self.first : self.first + self.shape.size] = each / self.sigma
        return sides_of(sides)


def known_heights(
    feature: Feature, sides: Floats, step: float, first: float = 0.0, lines: int = 1
) -> KnownHeights:
    """Find a bump of known size on an estimated road.

    Parameters
    ----------
    feature : Feature
        Its size, and where about it starts: ``at`` m from ``first``.
    sides : (2, n) array
        Heights in m of the left and the right wheel path every ``step`` m, as far as they are estimated.
    step : float
        m.
    first : float
        m of the estimate's line that ``feature.at`` counts from.
    lines : int
        Lines beside each other that have it.

    Returns
    -------
    KnownHeights
        Its heights at the place where the estimate fits best.

    Raises
    ------
    InputError
        Nothing there looks like it.
    """
    shape = shape_of(feature)
    length = feature.size[0]
    on = [i for i, v in enumerate((0.75, -0.75)) if feature.v_low <= v <= feature.v_high]
    count = int(np.ceil((length + 2.0 * _FOOT) / step)) + 1
    share = np.linspace(0.0, 1.0, count)
    best, found, edge = -np.inf, (0, np.zeros(count)), False
    for off in np.arange(-_REACH, _REACH + _STEP, _STEP):
        at = first + feature.at + off
        start = int(np.floor((at - _FOOT) / step))
        if start < 0 or start + count > sides.shape[1] or not on:
            continue
        wanted = shape(step * (start + np.arange(count)) - at)
        part = sides[on, start : start + count]
        part = part - part[:, :1] * (1.0 - share) - part[:, -1:] * share
        gain = float((part @ wanted).mean() / (wanted @ wanted))
        norm = np.linalg.norm(part) * np.linalg.norm(wanted) * np.sqrt(len(on))
        fit = float((part @ wanted).sum() / max(norm, 1e-12))
        if fit > best and 1.0 / _ALIKE < gain < _ALIKE:
            best, found, edge = fit, (start, wanted), abs(off) > _REACH - 0.1
    if best < _LEAST or edge:
        how = "nothing of about that size" if best == -np.inf else f"the best has a correlation of {best:.2f}"
        raise InputError(
            f"--{feature.kind}",
            f"no {length:g} m by {feature.size[1]:g} m on the drives within {_REACH:g} m of {feature.at:g} m: {how}",
        )
    return KnownHeights(*found, tuple(on), _SIGMA, lines)


class Inverse:
    """The posterior of road and shifts given what several passes measured, and heights that are known.

    An unknown is a vector: the white noise (2, lines, period) of mean and half difference, then each pass's shift at
    its knots in prior standard deviations. Lists of whitened values hold those of the passes first, then those of the
    known heights.
    """

    def __init__(
        self, prior: RoadPrior, linear: Sequence[LinearPass], known: Sequence[KnownHeights] = ()
    ) -> None:
        self.prior, self.linear, self.known = prior, list(linear), list(known)
        sizes = [2 * prior.across.size * prior.period, *(s.one.knots.shape[0] for s in linear)]
        self._size, self._cuts = sum(sizes), np.cumsum(sizes)[:-1]

    def white(self, unknown: Floats) -> Floats:
        """White noise (2, lines, period) of an unknown."""
        return np.split(unknown, self._cuts)[0].reshape(2, -1, self.prior.period)

    def heights(self, unknown: Floats) -> Floats:
        """Heights (2, lines, count) m of mean and half difference."""
        return self.prior.heights(self.white(unknown))

    def shifts(self, unknown: Floats) -> list[Floats]:
        """Shift (j,) m of each pass at its knots."""
        parts = np.split(unknown, self._cuts)[1:]
        return [part * s.one.shift_sigma for part, s in zip(parts, self.linear, strict=True)]

    def forward(self, unknown: Floats) -> list[Floats]:
        """Whitened channels of every pass, and known heights."""
        heights = self.heights(unknown)
        pairs = zip(self.linear, self.shifts(unknown), strict=True)
        return [
            *(s.whiten(s.channels(heights, m)) for s, m in pairs),
            *(k.forward(heights) for k in self.known),
        ]

    def adjoint(self, white: Sequence[Floats]) -> Floats:
        """Of ``forward``."""
        heights = np.zeros((2, self.prior.across.size, self.prior.count))
        shifts = []
        for s, w in zip(self.linear, white, strict=False):
            own, moved = s.adjoint(w)
            heights += own.reshape(heights.shape)
            shifts.append(moved * s.one.shift_sigma)
        for k, w in zip(self.known, white[len(self.linear) :], strict=True):
            heights += k.adjoint(w, self.prior.count)
        return np.concatenate([self.prior.back(heights).ravel(), *shifts])

    def solve(self, residuals: Sequence[Floats], tolerance: float = _TOLERANCE) -> Floats:
        """The posterior mean for whitened residuals (3, n) of every pass, by conjugate gradients."""
        r = self.adjoint(residuals)
        x, p, rr = np.zeros(r.size), r, self._dot(r, r)
        goal = tolerance**2 * rr
        for _ in range(_MOST):
            if rr <= goal:
                break
            ap = p + self.adjoint(self.forward(p))
            alpha = rr / self._dot(p, ap)
            x, r = x + alpha * p, r - alpha * ap
            new = self._dot(r, r)
            p, rr = r + new / rr * p, new
        return x

    def _dot(self, a: Floats, b: Floats) -> float:
        """Inner product, road and shifts each by itself so that the rounding of one does not depend on the others."""
        road, *shifts = (
            float(x @ y) for x, y in zip(np.split(a, self._cuts), np.split(b, self._cuts), strict=True)
        )
        return road + sum(shifts)

    def error_sample(self, rng: np.random.Generator) -> Floats:
        """A draw of the posterior about its mean."""
        truth, white = self.imagined(rng)
        return np.asarray(truth - self.solve(white, _ROUGH))

    def imagined(self, rng: np.random.Generator) -> tuple[Floats, list[Floats]]:
        """A road and shifts drawn from the prior, and the whitened channels that they would give, with noise."""
        truth = rng.standard_normal(self._size)
        clean = self.forward(truth)
        white = [y + s.whiten(s.coloured(rng)) for s, y in zip(self.linear, clean, strict=False)]
        return truth, white + [y + rng.standard_normal(y.shape) for y in clean[len(self.linear) :]]
