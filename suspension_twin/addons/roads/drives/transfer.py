# SPDX-License-Identifier: Apache-2.0
"""Best linear approximation of a twin: from the heights under its four wheels to what its sensor reads.

The twin is simulated with its own kernel, effects included, over random periodic roads of the level
that the drive has, with all four wheels excited at once and the phases of four runs orthogonal, so
that each frequency gives the matrix of all wheels exactly (Pintelon and Schoukens, System
Identification, 2nd ed., sections 3.5 and 4.3). A damper that differs between push and pull has a kink at
rest, which is a non-linearity at every amplitude; here both have their mean force.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import Excitation, PlanarPath
from suspension_twin.road.build import flat_road
from suspension_twin.vehicle.twin import Damper, Twin

__all__ = ["CHANNELS", "best_linear_approximation"]

#: Channels from which the road is estimated.
CHANNELS = ("vertical_acceleration", "pitch_rate", "roll_rate")

_PERIOD = 1024  # samples of one period
_REALISATIONS = 4
_STEPS = 10  # of the integration in each sample
_LOWEST = 0.1  # Hz; below it the road is flat
_HADAMARD = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]], dtype=np.float64)

Complex = NDArray[np.complex128]


def best_linear_approximation(
    twin: Twin, rate: float, level: float, speed: float, seed: int = 0
) -> tuple[Floats, Complex]:
    """Frequencies (k,) Hz and matrices (k, 3, 4) from wheel heights in m to channels in m/s² and rad/s.

    Parameters
    ----------
    twin : Twin
        The twin.
    rate : float
        Samples per second of the result; it goes up to half of it.
    level : float
        G(n0) of the road in m³ at which the twin is linearised.
    speed : float
        m/s.
    seed : int
        Of the phases.

    Returns
    -------
    f : (k,) array
        Hz, from 0 on.
    h : (k, 3, 4) array
        Complex, zero at 0 Hz.
    """
    rng = np.random.default_rng(seed)
    twin = _symmetric(twin)
    n = _PERIOD
    f: Floats = np.asarray(np.fft.rfftfreq(n, 1.0 / rate), dtype=np.float64)
    used = np.arange(1, f.size - 1)
    # One-sided displacement PSD in time of an ISO 8608 road: G(n0) n0² v / f².
    density = level * 1e-2 * speed / np.maximum(f, _LOWEST) ** 2
    amplitude = np.zeros(f.size)
    amplitude[used] = np.sqrt(0.5 * density[used] * f[1]) * n
    total = np.zeros((f.size, 3, 4), dtype=np.complex128)
    for _ in range(_REALISATIONS):
        phase = np.exp(2j * np.pi * rng.random((f.size, 4)))
        inputs, outputs = [], []
        for signs in _HADAMARD:
            spectrum = amplitude[:, None] * phase * signs
            fine = np.fft.irfft(spectrum * _STEPS, n * _STEPS, axis=0)
            found = simulate_twin(twin, _shaken(fine, rate, speed))
            channels = np.stack([found.vertical_acceleration, found.rate[:, 1], found.rate[:, 0]], axis=1)
            inputs.append(spectrum)
            outputs.append(np.fft.rfft(channels[n : 2 * n], axis=0))
        u, y = np.stack(inputs, axis=2), np.stack(outputs, axis=2)
        total[used] += y[used] @ np.linalg.inv(u[used])
    return f, total / _REALISATIONS


def _symmetric(twin: Twin) -> Twin:
    """The twin with dampers that have the mean of push and pull in both directions."""
    curves: dict[str, dict[str, list[float]]] = {}
    for axle in ("front", "rear"):
        part = getattr(twin.vehicle, axle)
        speeds = sorted({*part.damper_push.velocity, *part.damper_pull.velocity})
        force = 0.5 * (_force(part.damper_push, speeds) + _force(part.damper_pull, speeds))
        curve = {"velocity": speeds, "force": force.tolist()}
        curves |= {f"vehicle.{axle}.damper_{way}": curve for way in ("push", "pull")}
    return twin.with_changes(curves)


def _force(damper: Damper, speeds: list[float]) -> Floats:
    """Force in N at rising speeds, the last slope going on."""
    v, f = np.array([0.0, *damper.velocity]), np.array([0.0, *damper.force])
    beyond = np.maximum(np.array(speeds) - v[-1], 0.0) * (f[-1] - f[-2]) / (v[-1] - v[-2])
    return np.asarray(np.interp(speeds, v, f) + beyond, dtype=np.float64)


def _shaken(period: Floats, rate: float, speed: float) -> Excitation:
    """The twin straight on over a periodic road (m, 4): twice, for the first to settle."""
    stamps = 2 * _PERIOD + 1
    count = np.full(stamps, _STEPS, dtype=np.int64)
    count[0] = 0
    first = np.concatenate([[0], np.cumsum(np.maximum(count, 1))])
    motion = np.zeros((stamps, 7))
    motion[1:, 0] = 1.0 / (rate * _STEPS)
    motion[:, 5] = speed
    # A stamp's row is the end of its last step: sample k of the period lies at stamp k.
    road = np.concatenate([period[:1], np.roll(np.tile(period, (2, 1)), -1, axis=0)])
    t = np.arange(stamps) / rate
    zero = np.zeros(stamps)
    return Excitation(
        t=t,
        substeps=count,
        first=first,
        road=np.ascontiguousarray(road),
        motion=motion,
        max_step=1.0 / (rate * _STEPS),
        path=PlanarPath(speed * t, zero, zero, np.zeros((4, 2)), flat_road()),
    )
