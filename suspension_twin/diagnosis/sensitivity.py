# SPDX-License-Identifier: Apache-2.0
"""Sensitivities of a simulated drive: the twin over a road at a constant speed.

The columns of a drive are the changes of the readings of the virtual sensor: by the vehicle's parameters that a
diagnosis recalibrates, by the nuisance parameters of clock, map and mount, and by effects of given sizes. All that
planning asks of them are scalar products: of whitened columns, which say what a fit makes of a change, and of the
columns of each channel in units of the expected residual, which say how large a change is (``Products``).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.case import drive_problem
from suspension_twin.errors import InputError
from suspension_twin.inference.excited_segments import TrimSettings
from suspension_twin.inference.gap import CHANNELS
from suspension_twin.inference.gauss_newton import bounded_step
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.noise import USUAL_SHARE, Whitener
from suspension_twin.inference.nuisance import OF_A_DRIVE, map_spread
from suspension_twin.inference.observation import PLANAR, VERTICAL, Grid, Observation, Usage
from suspension_twin.inference.problem import REACH, STEP, Data, Problem, Simulation, whitener_of
from suspension_twin.inference.synthetic import SensorErrors, path_along
from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import pack
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.road.road import Road
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["Change", "Products", "planned_drive", "products"]

#: Of the virtual sensor: those of a phone and an RTK receiver.
SENSOR = SensorErrors()
#: s of a drive at most; m between a wheel and an end of the road.
LONGEST, _MARGIN = 40.0, 0.5
#: m/s² of a calm driver (Bae, Moon and Seo, Electronics 8, 2019: comfortable up to 2 m/s²).
_ACCELERATION, _BRAKING = 1.5, 2.0


@dataclass(frozen=True, eq=False)
class Change:
    """Points (k, L) of the coordinates of a hypothesis, and the names (L,) of their columns."""

    hypothesis: Hypothesis
    points: Floats
    names: tuple[str, ...]

    def only(self, names: Collection[str]) -> Change:
        """Those of its points whose columns have one of the ``names``."""
        kept = [i for i, name in enumerate(self.names) if name in names]
        return Change(self.hypothesis, self.points[:, kept], tuple(self.names[i] for i in kept))


def planned_drive(twin: Twin, road: Road, kmh: float, name: str = "") -> Observation:
    """A drive along the middle of a road at a constant speed, from its start.

    Where a quarter of the road is enough for it, the vehicle starts from standing, and so it stops; else it enters and
    leaves at speed.

    Parameters
    ----------
    twin : Twin
        The vehicle, its sensor and its effects.
    road : Road
        The road.
    kmh : float
        Speed in km/h.
    name : str
        Of the drive.

    Returns
    -------
    Observation
        At the rate of the sensor, 40 s of it at most.

    Raises
    ------
    InputError
        The road is shorter than the vehicle, or the speed cannot be driven.

    Examples
    --------
    >>> from suspension_twin.road import bump_road, half_sine
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> road = bump_road(half_sine(0.9, 0.05), at=20.0, length=60.0)
    >>> drive = planned_drive(load_twin("bags/bump_15kmh/twin.yaml"), road, 20.0)
    >>> round(float(drive.along.max()), 1)
    5.6
    """
    if not 1.0 <= kmh <= 300.0:
        raise InputError("speed", f"must be between 1 and 300 km/h, is {kmh:g}")
    v, wheels = kmh / 3.6, twin.vehicle.wheel_positions[:, 0]
    start = road.u_first + _MARGIN - float(wheels.min())
    length = road.u_last - _MARGIN - float(wheels.max()) - start
    if length < float(np.ptp(wheels)):
        raise InputError("road", f"{road.length:.1f} m of it are too short to drive on")
    knots = _knots(v, length)
    t = np.arange(0.0, min(knots[-1][0], LONGEST), 1.0 / SENSOR.imu_rate)
    path = path_along(road, t, knots, start)
    driven = excitation(path, twin.vehicle, road)
    spec = FilterSpec()
    conditioner = Conditioner.for_stamps(t, spec, zero_phase=True)
    response = simulate_lanes(twin, pack(twin)[:, None], driven, fused=True)
    if response.failed[0]:
        raise InputError(
            "twin", f"cannot be simulated on this road at {kmh:g} km/h: it diverges or cannot stand"
        )
    signals = conditioner.apply(response.stacked(CHANNELS))[:, :, 0]
    signals[:, 0] -= signals[:, 0].mean()
    grid = conditioner.grid
    speed = np.interp(grid, t, path.speed)
    passed = np.sqrt(min(1.0, 2.0 * spec.cutoff / conditioner.rate))
    noise = {c: passed * (SENSOR.force if c.endswith("acceleration") else SENSOR.rate) for c in CHANNELS}
    grid_path = Grid(
        grid,
        conditioner.rate,
        spec.cutoff,
        conditioner.apply,
        np.interp(grid, t, road.xy_to_uv(path.x, path.y)[0]),
        speed,
        np.asarray(conditioner.valid & (speed > TrimSettings().slowest)),
        SENSOR.position,
    )
    block = np.zeros(grid.size, dtype=np.intp)  # nothing is held out of a plan
    return Observation(
        name or f"{kmh:g} km/h",
        grid_path,
        driven,
        {c: signals[:, i] for i, c in enumerate(CHANNELS)},
        noise,
        Usage(CHANNELS, VERTICAL, OF_A_DRIVE, block, fused=True),
    )


def _knots(v: float, length: float) -> list[tuple[float, float]]:
    """Knots (s, m/s) of a drive at ``v`` m/s over ``length`` m."""
    # knots are joined by cubics, whose largest slope is 1.5 times the mean one
    up, down = 1.5 * v / _ACCELERATION, 1.5 * v / _BRAKING
    up, down = (s if 0.5 * v * s <= 0.25 * length else 0.0 for s in (up, down))
    knots = [(0.0, 0.0), (1.0, 0.0), (1.0 + up, v)] if up else [(0.0, v)]
    knots.append((knots[-1][0] + length / v - 0.5 * (up + down), v))
    if down:
        end = knots[-1][0] + down
        knots += [(end, 0.0), (end + 1.0, 0.0)]
    return knots


def planned_problem(twin: Twin, drive: Observation) -> Problem:
    """The problem of a drive, with the parameters and the priors of a diagnosis on a road."""
    data = Data((drive,), (0,), (np.flatnonzero(drive.mask),), CHANNELS, (True,))
    priors = replace(OF_A_DRIVE, map_position=min(map_spread([drive]), OF_A_DRIVE.map_position))
    simulation = Simulation(fused=True, centred=True)
    problem = drive_problem(twin, None, data, priors, [0.0], simulation)
    problem = problem.with_planar_response(problem.prior.centre)
    share = USUAL_SHARE * _of_the_road(problem)
    return problem.weighed(Whitener.designed(problem.measured, share, [dict(drive.noise_rms)]))


def _of_the_road(problem: Problem) -> Floats:
    """(C,) the share of each channel's rms that the model is answerable for: all of it, in planar channels the response
    to the road."""
    rows, planar = problem.data.rows[0], problem.nuisances.planar_response[0]
    share = np.ones(len(problem.channels))
    for c, name in enumerate(problem.channels):
        if name in PLANAR:
            whole = problem.measured.values[:, c]
            of_road = whole - planar[rows, c]
            share[c] = min(1.0, float(np.std(of_road)) / max(float(np.std(whole)), 1e-12))
    return share


@dataclass(frozen=True, eq=False)
class Products:
    """Scalar products of K columns, of one drive or of several together.

    ``names`` (K,) of the columns, the ``known`` ones first, which a diagnosis fits in any case: parameters of the
    vehicle and nuisances, with the ``precision`` of their prior and the range (``low``, ``high``) of each. ``white``
    (K, K) of whitened columns. ``blocks`` (B, K, K) of single channels of single drives, in units of the expected
    residual of the block, per sample; ``channels`` (B,) is the channel of each.
    """

    names: tuple[str, ...]
    known: int
    precision: Floats
    low: Floats
    high: Floats
    white: Floats
    blocks: Floats
    channels: tuple[str, ...]

    def columns(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Places of columns."""
        place = {name: i for i, name in enumerate(self.names)}
        return np.array([place[name] for name in names], dtype=np.intp)

    def __add__(self, other: Products) -> Products:
        """Both sets of drives together."""
        known = list(dict.fromkeys([*self.names[: self.known], *other.names[: other.known]]))
        effects = [n for n in self.names[self.known :] if n in set(other.names)]
        names = (*known, *effects)
        place = {name: i for i, name in enumerate(names)}
        white = np.zeros((len(names), len(names)))
        blocks = np.zeros((len(self.channels) + len(other.channels), len(names), len(names)))
        precision = np.zeros((len(known), len(known)))
        low, high = np.empty(len(known)), np.empty(len(known))
        first = 0
        for one in (self, other):
            kept = [i for i, n in enumerate(one.names) if n in place]
            to = np.array([place[one.names[i]] for i in kept])
            white[np.ix_(to, to)] += one.white[np.ix_(kept, kept)]
            last = first + len(one.channels)
            blocks[first:last, to[:, None], to] = one.blocks[:, np.array(kept)[:, None], kept]
            first = last
            own = to[: one.known]
            precision[np.ix_(own, own)] = one.precision  # of what both know the same
            low[own], high[own] = one.low, one.high
        return Products(
            names, len(known), precision, low, high, white, blocks, (*self.channels, *other.channels)
        )

    def left(
        self, columns: NDArray[np.intp], beside: NDArray[np.intp] | None = None, scale: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Squares that the known parameters, and multiples of the columns ``beside`` (n,), leave of ``columns`` (S,).

        A multiple is normal about 0 with the standard deviation ``scale`` (n,), and at most three of them. Returns the
        ratios (B, S) of what is left to the expected residual, rms over rms, and the whitened squares (S,).
        """
        used, low, high, precision = np.arange(self.known), self.low, self.high, self.precision
        if beside is not None and scale is not None:
            used = np.concatenate([used, beside])
            precision = block_diag(precision, np.diag(scale**-2.0))
            low, high = (np.concatenate([a, s * scale]) for a, s in ((low, -REACH), (high, REACH)))
        hessian = self.white[np.ix_(used, used)] + precision
        step = bounded_step(hessian, self.white[np.ix_(used, columns)], low, high)
        squares = _energies(self.white[None], used, columns, step)[0]
        return np.sqrt(_energies(self.blocks, used, columns, step)), squares


def _energies(products: Floats, used: NDArray[np.intp], columns: NDArray[np.intp], step: Floats) -> Floats:
    """(B, S) squares of columns (S,) plus ``step`` (u, S) times the columns ``used`` (u,)."""
    own = products[:, columns, columns]
    cross = np.einsum("bus,us->bs", products[:, used[:, None], columns[None, :]], step)
    both = np.einsum("us,bus->bs", step, products[:, used[:, None], used[None, :]] @ step)
    return np.asarray(np.maximum(own + 2.0 * cross + both, 0.0))


def products(twin: Twin, drive: Observation, changes: Sequence[Change]) -> Products:
    """The products of a drive's columns: known parameters, and the changes of effects.

    A column whose simulation fails is zero: such an effect shows nothing here.
    """
    problem = planned_problem(twin, drive)
    d, q, nuisances = problem.d, problem.q, problem.nuisances
    rows, x = problem.data.rows[0], problem.prior.centre
    stepped = np.repeat(x[:, None], d + 1, axis=1)
    stepped[np.arange(d), 1 + np.arange(d)] += STEP
    signals, _ = problem.signals(stepped)
    base = signals[0][:, :, :1]
    columns = [(signals[0][rows][:, :, 1:] - base[rows]) / STEP]
    steps = np.concatenate([np.zeros((q, 1)), np.diag(nuisances.steps)], axis=1)
    read = problem.likelihood.compared([base], steps)
    columns.append((read[:, :, 1:] - read[:, :, :1]) / nuisances.steps)
    names = [*problem.space.names, *nuisances.names]
    for change in changes:
        held = np.repeat(x[:, None], change.points.shape[1], axis=1)
        signals, failed = problem.having(change.hypothesis).signals(np.concatenate([held, change.points]))
        changed = signals[0][rows] - base[rows]
        changed[:, :, failed] = 0.0
        columns.append(changed)
        names += change.names
    everything = np.concatenate(columns, axis=2)
    return Products(
        tuple(names),
        problem.shared,
        problem.prior.precision,
        *_range(problem),
        *_multiplied(problem, drive, everything),
        CHANNELS,
    )


def _range(problem: Problem) -> tuple[Floats, Floats]:
    """(d + q,) how far each known parameter may go down and up."""
    low, high = problem.limits()
    return np.minimum(low, 0.0), np.maximum(high, 0.0)


def _multiplied(problem: Problem, drive: Observation, columns: Floats) -> tuple[Floats, Floats]:
    """Products (K, K) of the whitened columns (M, C, K), and (C, K, K) of those of each channel over its expected
    residual, per sample."""
    measured = problem.measured
    white = whitener_of(problem).residuals(columns + measured.values[:, :, None])
    white *= np.sqrt(measured.independent)
    of_road = _of_the_road(problem)
    blocks = np.empty((len(CHANNELS), columns.shape[2], columns.shape[2]))
    thin = max(
        1, int(0.5 * measured.rate / measured.bandwidth)
    )  # samples of a low-passed signal that say the same
    for c, name in enumerate(CHANNELS):
        missed = USUAL_SHARE * of_road[c] * float(np.std(measured.values[:, c]))
        expected = np.hypot(missed, drive.noise_rms[name])
        own = np.ascontiguousarray(columns[::thin, c]) / expected
        blocks[c] = own.T @ own / len(own)
    return white.T @ white, blocks
