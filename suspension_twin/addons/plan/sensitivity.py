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
from suspension_twin.inference.gap import CHANNELS
from suspension_twin.inference.gauss_newton import bounded_step
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.noise import USUAL_SHARE, Whitener
from suspension_twin.inference.nuisance import OF_A_DRIVE, map_spread
from suspension_twin.inference.observation import PLANAR, Observation
from suspension_twin.inference.problem import REACH, STEP, Data, Problem, Simulation, whitener_of
from suspension_twin.vehicle.twin import Twin

__all__ = ["Change", "Products", "products"]


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


def planned_problem(twin: Twin, drive: Observation) -> Problem:
    """The problem of a drive, with the parameters and the priors of a diagnosis on a road."""
    data = Data((drive,), (0,), (np.flatnonzero(drive.mask),), CHANNELS, (True,))
    priors = replace(OF_A_DRIVE, map_position=min(map_spread([drive]), OF_A_DRIVE.map_position))
    simulation = Simulation(fused=True, centred=True)
    problem = drive_problem(twin, None, data, priors, [0.0], simulation)
    problem = problem.with_planar_response(problem.prior.centre)
    share = USUAL_SHARE * _of_the_road(problem)
    return problem.weighed(Whitener.designed(problem.measured, share, [drive.noise_rms]))


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
