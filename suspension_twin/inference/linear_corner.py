# SPDX-License-Identifier: Apache-2.0
"""A linear model of a corner on a rig, identified by frequency: what a twin of the same runs has to be at least.

Two masses on linear springs and dampers, tyre damping included, behind a common delay T. With the sprung mass as the
unit of mass, its height z, the wheel's u, the road r and an actuator's force f,

``z'' = -c (z' - u') - k (z - u) + g f``,
``m u'' = c (z' - u') + k (z - u) + d (r' - u') + q (r - u) - g f``.

Its transfer functions are fitted by least squares to the spectra of the conditioned signals, each channel in units of
its own motion. Nothing is known of the numbers beforehand, and g may be negative: then the force has the other sign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from suspension_twin.arrays import Floats
from suspension_twin.inference.observation import Observation
from suspension_twin.models.excitation import MOTION

__all__ = ["CORNER_CHANNELS", "LinearCorner", "linear_corner"]

#: Channels that a linear corner has; the force under a tyre needs a mass.
CORNER_CHANNELS = ("body_acceleration", "wheel_acceleration", "suspension_deflection")
#: Where a fit starts (numerics, by hand): Hz of body and wheel (a car, a lorry, a small rig); and s of the delay.
_STARTS = ((1.3, 11.0), (2.5, 9.0), (5.0, 14.0))
_DELAYS = (-0.03, 0.0, 0.03)
_LEAST_DAMPING, _TAPER = 0.2, 0.5  # damping ratio of a start; s at both ends of a run that fade in and out
_FEW, _MANY = 12, 60  # evaluations of every start, and of the best
_REACH = 12.0  # largest logarithm of a ratio of two numbers


@dataclass(frozen=True, eq=False)
class _Spectra:
    """Angular frequencies (F,) 1/s, inputs road and force (F,), and the measured channels (F,) of one run."""

    w: Floats
    road: np.ndarray
    force: np.ndarray
    measured: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class LinearCorner:
    """Numbers per kg of sprung mass, SI units, and the ``delay`` s of all channels behind road and force."""

    wheel: float
    spring: float
    damper: float
    tyre: float
    tyre_damper: float
    delay: float
    force: float

    def responses(self, w: Floats, road: np.ndarray, force: np.ndarray) -> dict[str, np.ndarray]:
        """Spectra (F,) of the channels at ``w`` (F,) 1/s."""
        s = 1j * w
        strut, tyre = self.spring + self.damper * s, self.tyre + self.tyre_damper * s
        body, wheel = s * s + strut, self.wheel * s * s + strut + tyre
        pushed, driven = self.force * force, tyre * road - self.force * force
        late = np.exp(-s * self.delay) / (body * wheel - strut * strut)
        z, u = late * (wheel * pushed + strut * driven), late * (strut * pushed + body * driven)
        return dict(zip(CORNER_CHANNELS, (s * s * z, s * s * u, u - z), strict=True))

    def signals(self, run: Observation) -> dict[str, Floats]:
        """Conditioned channels (m,) over a run that begins at rest."""
        t = run.excitation.t
        even = np.linspace(t[0], t[-1], t.size)
        speed, force = (np.interp(even, t, x) for x in _inputs(run))
        w = 2.0 * np.pi * np.fft.rfftfreq(2 * t.size, even[1] - even[0])
        rate, pushed = (np.fft.rfft(x, 2 * t.size) for x in (speed, force - force[0]))
        found = self.responses(w, _integrated(rate, w), pushed)
        return {
            name: run.apply(np.interp(t, even, np.fft.irfft(x, 2 * t.size)[: t.size]))
            for name, x in found.items()
        }


def linear_corner(
    runs: Sequence[Observation], channels: Sequence[str], rows: Sequence[slice] | None = None
) -> tuple[LinearCorner, float]:
    """The linear corner that fits ``channels`` of the runs best, on some ``rows`` of each if these are given; and the
    gain of the force in standard deviations."""
    from scipy.optimize import least_squares  # half a second to import

    rows = [slice(0, run.t.size) for run in runs] if rows is None else rows
    spectra = [_spectra(run, channels, own) for run, own in zip(runs, rows, strict=True)]
    forced = any(np.any(one.force) for one in spectra)

    def model(x: Floats) -> LinearCorner:
        wheel, spring, damper, tyre, tyre_damper = np.exp(np.clip(x[:5], -_REACH, _REACH)).tolist()
        return LinearCorner(
            wheel, spring, damper, tyre, tyre_damper, 0.01 * float(x[5]), float(x[6]) * forced
        )

    def residuals(x: Floats) -> Floats:
        found = []
        for one in spectra:
            simulated = model(x).responses(one.w, one.road, one.force)
            found += [
                (simulated[name] - measured) / np.linalg.norm(measured)
                for name, measured in one.measured.items()
            ]
        whole = np.concatenate(found)
        return np.concatenate([whole.real, whole.imag])

    starts = []
    for body, wheel in _STARTS:
        for delay in _DELAYS:
            k, mass = (2 * np.pi * body) ** 2, 0.15
            q = mass * (2 * np.pi * wheel) ** 2
            c, d = 2 * _LEAST_DAMPING * 2 * np.pi * body, 0.05 * mass * 2 * np.pi * wheel
            starts.append(np.append(np.log([mass, k, c, q, d]), [100.0 * delay, 0.0]))
    first = [least_squares(residuals, start, max_nfev=_FEW) for start in starts]
    best = least_squares(residuals, min(first, key=lambda fit: fit.cost).x, max_nfev=_MANY)
    effective = sum(one.w.size for one in spectra) * len(channels)
    jacobian = np.asarray(best.jac, dtype=np.float64)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * 2.0 * best.cost / effective
    spread = float(np.sqrt(covariance[-1, -1]))
    return model(best.x), float(best.x[-1]) / spread if forced and spread > 0 else 0.0


def _inputs(run: Observation) -> tuple[Floats, Floats]:
    """Rate of the road's height and force of the actuator (n,) at the stamps of a run: a height drifts where it was a
    velocity that was measured."""
    driven = run.road_excitation
    force = driven.motion[:, len(MOTION)] if driven.motion.shape[1] > len(MOTION) else np.zeros(len(driven))
    return np.asarray(CubicSpline(driven.t, driven.road[driven.first[1:] - 1, 0])(driven.t, 1)), force


def _integrated(rate: np.ndarray, w: Floats) -> np.ndarray:
    """Spectrum (F,) of what has the spectrum ``rate``, without its mean."""
    return np.where(w > 0.0, rate / (1j * np.where(w > 0.0, w, 1.0)), 0.0)


def _spectra(run: Observation, channels: Sequence[str], own: slice) -> _Spectra:
    conditioned = [run.apply(x)[own] for x in _inputs(run)]
    size, edge = own.stop - own.start, max(1, round(_TAPER * run.rate))
    ramp = np.clip(np.minimum(np.arange(size), np.arange(size)[::-1]) / edge, 0.0, 1.0)
    fade = ramp * ramp * (3.0 - 2.0 * ramp)
    # two periods in a run, and what passes the filter
    f = np.fft.rfftfreq(size, 1.0 / run.rate)
    band = (f >= 2.0 * run.rate / size) & (f <= run.bandwidth)

    def of(x: Floats) -> np.ndarray:
        return np.asarray(np.fft.rfft((x - x.mean()) * fade)[band])

    speed, force = (of(x) for x in conditioned)
    road = _integrated(speed, 2 * np.pi * f[band])
    measured = {name: of(run.measured[name][own]) for name in channels}
    return _Spectra(2 * np.pi * f[band], road, force, measured)
