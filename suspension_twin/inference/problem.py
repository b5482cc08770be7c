# SPDX-License-Identifier: Apache-2.0
"""The problem: a vehicle, its observations, the parameters that are searched and the noise.

The unknowns x of a problem are, in this order, the vehicle's (search coordinates of the space, d), the nuisance
parameters (q) and the coordinates of the effects of its hypothesis (k). Vehicle and nuisance parameters are shared by
all observations. Effects act on those with the gap only, or on all of them where they are pre-existing.

A calibration is a problem without effects, a hypothesis a problem with more parameters (:meth:`Problem.having`), a plan
a problem over simulated observations. A problem is immutable; one evaluation is one candidate simulated over all
observations, as the car paper counts its 10 842.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError
from suspension_twin.inference.gauss_newton import Quadratic
from suspension_twin.inference.hypothesis import BASELINE, Hypothesis
from suspension_twin.inference.noise import Whitener
from suspension_twin.inference.nuisance import NuisancePriors, Nuisances
from suspension_twin.inference.objectives import Measured
from suspension_twin.inference.observation import Observation
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.priors import SINGLE
from suspension_twin.inference.space import Space
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.models.tracked import ObstacleRun
from suspension_twin.models.types import Excitation
from suspension_twin.road.recipe import Taped
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "CORRELATION",
    "REACH",
    "STEP",
    "Data",
    "Interrupted",
    "JointPrior",
    "Likelihood",
    "Linearised",
    "Noise",
    "Problem",
    "Simulation",
    "counting",
    "effective_weight",
    "segments_of",
    "whitener_of",
]

#: Bound of a nuisance parameter in standard deviations of its prior: a larger error is an effect.
REACH = 3.0
#: Finite-difference steps of the vehicle and of effects, in their search coordinates.
STEP, STEP_EFFECT = 1e-3, 1e-2
#: Prior correlation of the logarithms of neighbouring slopes of a characteristic.
CORRELATION = SINGLE["slopes"]
# Simulated signals kept at once, in numbers: 25 million are 200 MB.
_LARGEST_BATCH = 25_000_000


class Interrupted(Exception):
    """Raised where a caller asked to stop during a simulation."""


def _never() -> bool:
    return False


def segments_of(rows: NDArray[np.intp], offset: int) -> list[slice]:
    """Runs of consecutive samples in ``rows``, as slices of their own numbering from ``offset`` on."""
    if not rows.size:
        return []
    edges = np.flatnonzero(np.diff(rows) > 1) + 1
    bounds = [0, *edges.tolist(), rows.size]
    return [slice(offset + a, offset + b) for a, b in zip(bounds, bounds[1:], strict=False)]


@dataclass(frozen=True, eq=False)
class Data:
    """The observations of a problem, whole or in parts, and the M samples of them that are compared.

    ``drive_of`` is the drive that each part belongs to, ``rows`` the samples of each that are compared, in C
    ``channels``; ``active`` (drives,) is True for drives with the gap.
    """

    parts: tuple[Observation, ...]
    drive_of: tuple[int, ...]
    rows: tuple[NDArray[np.intp], ...]
    channels: tuple[str, ...]
    active: tuple[bool, ...]

    @cached_property
    def measured(self) -> Measured:
        """The measured side of the compared samples; InputError where there are none."""
        values: list[Floats] = []
        segments: list[slice] = []
        drives: list[int] = []
        offset = 0
        for part, own, drive in zip(self.parts, self.rows, self.drive_of, strict=True):
            values.append(np.stack([part.measured[c][own] for c in self.channels], axis=1))
            runs = segments_of(own, offset)
            segments += runs
            drives += [drive] * len(runs)
            offset += own.size
        if offset == 0:
            raise InputError("drives", "nothing is left to compare after trimming")
        first = self.parts[0]
        return Measured(
            self.channels,
            np.concatenate(values),
            tuple(segments),
            first.rate,
            tuple(drives),
            first.bandwidth,
        )

    @cached_property
    def block(self) -> NDArray[np.intp]:
        """(M,) the block of each compared sample, counted from 0: of road over all drives, of the distance of a run, of
        time without a road."""
        keys = [
            np.stack([np.full(own.size, 0 if part.usage.shared else drive), part.usage.block[own]])
            for part, own, drive in zip(self.parts, self.rows, self.drive_of, strict=True)
        ]
        return np.unique(np.concatenate(keys, axis=1), axis=1, return_inverse=True)[1]

    def nuisances(
        self, priors: NuisancePriors, wander: Sequence[float] | None = None, taped: Taped | None = None
    ) -> Nuisances:
        """The nuisance parameters; ``wander`` (m) is each drive's own position error, 0 for none; ``taped``: features
        of the road that were measured by tape."""
        none = [0.0] * (max(self.drive_of) + 1)
        return Nuisances(self.parts, self.drive_of, self.channels, priors, wander or none, taped)


class Noise(Protocol):
    """A noise model: residuals of unit variance, or in another fixed unit."""

    def residuals(self, simulated: Floats) -> Floats:
        """(R, L) of simulated sensor readings (M, C, L)."""


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Residuals of simulated signals: sensor readings by the nuisance parameters, then the noise model.

    ``weight`` (R,) multiplies the residuals: the root of the effective sample size per sample, 0 for those that do not
    count; none where None. ``expected`` (m, C) is the discrepancy found on a reference run with the same excitation.
    With ``affine`` the residuals are affine in the readings, so that the columns of additive nuisance parameters are
    constant. ``still`` (m, C, 1) are the signals of reference runs that no unknown changes.
    """

    data: Data
    nuisances: Nuisances
    noise: Noise
    weight: Floats | None = None
    expected: tuple[Floats | None, ...] = ()
    affine: bool = False
    still: tuple[Floats, ...] = ()

    def compared(self, signals: Sequence[Floats], nuisance: Floats) -> Floats:
        """(M, C, L) simulated sensor readings for signals (m, C, L) of every part and nuisances (q, L), plus the
        expected discrepancy of each run."""
        if self.expected:
            expected = zip(signals, self.expected, strict=True)
            signals = [s if e is None else s + e[:, :, None] for s, e in expected]
        pairs = enumerate(zip(signals, self.data.rows, strict=True))
        return np.concatenate(
            [self.nuisances.apply(number, part, rows, nuisance) for number, (part, rows) in pairs]
        )

    def residuals(self, signals: Sequence[Floats], nuisance: Floats) -> Floats:
        """(R, L) weighted residuals."""
        return self._weighted(self.noise.residuals(self.compared(signals, nuisance)))

    def _weighted(self, residuals: Floats) -> Floats:
        if self.weight is None:
            return residuals
        weighted = np.multiply(residuals, self.weight[:, None])
        weighted[self.weight == 0.0] = 0.0
        return weighted

    @cached_property
    def additive_columns(self) -> Floats:
        """(R, n) constant Jacobian columns of the nuisance parameters that do not depend on the simulation."""
        signals = [np.zeros((part.t.size, len(self.data.channels), 1)) for part in self.data.parts]
        rows = np.flatnonzero(self.nuisances.plain)
        unit = np.zeros((len(self.nuisances), 1 + rows.size))
        unit[rows, 1 + np.arange(rows.size)] = 1.0
        residuals = self.noise.residuals(self.compared(signals, unit))
        return self._weighted(np.ascontiguousarray(residuals[:, 1:] - residuals[:, :1]))


@dataclass(frozen=True, eq=False)
class JointPrior:
    """The normal prior of vehicle and nuisance parameters: ``precision`` (d + q, d + q) about ``centre`` (d + q,).

    ``frozen`` names nuisance parameters that are held at zero, ``spread`` gives standard deviations of effect
    coordinates by their keys where they are not 1.
    """

    precision: Floats
    centre: Floats
    frozen: tuple[str, ...] = ()
    spread: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, space: Space, nuisances: Nuisances) -> JointPrior:
        """The prior of a space and of nuisance parameters about zero."""
        d, q = len(space), len(nuisances)
        precision = np.zeros((d + q, d + q))
        precision[:d, :d] = space.prior_precision(CORRELATION)
        precision[np.arange(d, d + q), np.arange(d, d + q)] = 1.0 / nuisances.spread**2
        slow = d + np.flatnonzero([".wander." in name for name in nuisances.names])
        if slow.size:
            precision[np.ix_(slow, slow)] = np.linalg.inv(nuisances.covariance[np.ix_(slow - d, slow - d)])
        return cls(precision, np.concatenate([space.z0, np.zeros(q)]))

    def knowing(self, information: Floats) -> JointPrior:
        """With ``information`` (d, d) on the vehicle's coordinates beside it."""
        precision, d = self.precision.copy(), information.shape[0]
        precision[:d, :d] += information
        return replace(self, precision=precision)


@dataclass(frozen=True)
class Simulation:
    """How candidates are simulated: ``step`` s is the longest time step over a drive (None: that of the excitation),
    ``fused`` whether poses are fused from GNSS and IMU, ``upright`` whether the vehicle has zero static attitude,
    ``centred`` takes its mean off the vertical acceleration, and ``stop`` is asked between pieces of work."""

    step: float | None = None
    fused: bool = False
    upright: bool = False
    centred: bool = False
    stop: Callable[[], bool] = _never


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals (R,) and Jacobian (R, p) at ``x`` (p,)."""

    x: Floats
    residual: Floats
    jacobian: Floats

    @cached_property
    def model(self) -> Quadratic:
        """The quadratic model of the residuals' sum of squares about ``x``."""
        return _quadratic(self.residual, self.jacobian)

    def grouped(self, label: NDArray[np.intp]) -> list[Quadratic]:
        """One quadratic model for the rows of each ``label`` (R,), labels 0, 1, ..."""
        order = np.argsort(label, kind="stable")
        jacobian, residual = self.jacobian[order], self.residual[order]
        ends = np.cumsum(np.bincount(label))
        return [_quadratic(residual[a:b], jacobian[a:b]) for a, b in zip([0, *ends[:-1]], ends, strict=True)]

    def first(self, count: int) -> Linearised:
        """The linearisation in the first ``count`` unknowns."""
        return Linearised(self.x[:count], self.residual, np.ascontiguousarray(self.jacobian[:, :count]))

    def with_effects(self, residual: Floats, effects: Floats) -> Quadratic:
        """The quadratic model at another ``residual`` (R,) with the columns ``effects`` (R, k) of further unknowns; the
        Jacobian of the other unknowns is reused."""
        beside = effects.T @ self.jacobian
        squares = np.block([[self.model.squares, beside.T], [beside, effects.T @ effects]])
        slope = np.concatenate([self.jacobian.T @ residual, effects.T @ residual])
        return Quadratic(float(residual @ residual), squares, slope)


def _quadratic(residual: Floats, jacobian: Floats) -> Quadratic:
    return Quadratic(float(residual @ residual), jacobian.T @ jacobian, jacobian.T @ residual)


@dataclass(frozen=True, eq=False)
class Problem:
    """A vehicle over its observations: residuals, Jacobian, prior and cost of p = d + q + k unknowns."""

    twin: Twin
    space: Space
    likelihood: Likelihood
    prior: JointPrior
    hypothesis: Hypothesis = BASELINE
    simulation: Simulation = Simulation()

    @classmethod
    def of(
        cls, twin: Twin, space: Space, likelihood: Likelihood, simulation: Simulation | None = None
    ) -> Problem:
        """The problem without effects, with the prior of its space and nuisance parameters."""
        prior = JointPrior.of(space, likelihood.nuisances)
        return cls(twin, space, likelihood, prior, simulation=simulation or Simulation())

    # -- its parts -----------------------------------------------------------------------------

    @property
    def data(self) -> Data:
        """The observations."""
        return self.likelihood.data

    @property
    def nuisances(self) -> Nuisances:
        """The nuisance parameters."""
        return self.likelihood.nuisances

    @property
    def measured(self) -> Measured:
        """The measured side of the compared samples."""
        return self.data.measured

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the compared channels."""
        return self.data.channels

    @property
    def d(self) -> int:
        """How many unknowns the vehicle has."""
        return len(self.space)

    @property
    def q(self) -> int:
        """How many nuisance parameters there are."""
        return len(self.nuisances)

    @property
    def shared(self) -> int:
        """How many unknowns come before those of the effects."""
        return self.d + self.q

    @property
    def seconds(self) -> float:
        """Simulated seconds of one evaluation."""
        return float(sum(p.t[-1] - p.t[0] for p in self.data.parts))

    def having(self, hypothesis: Hypothesis) -> Problem:
        """The same with the effects of a hypothesis."""
        return self if hypothesis == self.hypothesis else replace(self, hypothesis=hypothesis)

    def weighed(self, noise: Noise, weight: Floats | None = None) -> Problem:
        """The same with another noise model, and its own ``weight`` where that is given."""
        known = self.likelihood if weight is None else replace(self.likelihood, weight=weight)
        return replace(self, likelihood=replace(known, noise=noise))

    # -- prior ---------------------------------------------------------------------------------

    def joint_prior(self) -> tuple[Floats, Floats]:
        """Precision (p, p) and centre (p,) of the prior of all unknowns; an effect coordinate has N(centre, 1) but for
        those in ``prior.spread``."""
        p, keys = self.shared, self.hypothesis.keys
        own = [self.prior.spread.get(key, 1.0) ** -2 for key in keys]
        precision = np.diag(np.concatenate([np.ones(p), own]))
        precision[:p, :p] = self.prior.precision
        return precision, np.concatenate([self.prior.centre, self.hypothesis.centre()])

    def limits(self) -> tuple[Floats, Floats]:
        """(p,) lowest and highest unknowns.

        Nuisance parameters are bounded, because an unbounded one absorbs the effect of the same kind: a free clock
        offset of 60 ms lowers the cost of any drive by more than its prior adds.
        """
        low, high = self.hypothesis.bounds()
        free = np.full(self.d, np.inf)
        allowed = [name not in self.prior.frozen for name in self.nuisances.names]
        nuisance = REACH * self.nuisances.spread * allowed
        least = np.where(self.nuisances.one_sided, 0.0, -nuisance)
        return np.concatenate([-free, least, low]), np.concatenate([free, nuisance, high])

    def clipped(self, x: Floats) -> Floats:
        """Unknowns (p, L) inside their limits."""
        low, high = self.limits()
        return np.asarray(np.clip(x, low[:, None], high[:, None]))

    def room(self, x: Floats) -> tuple[Floats, Floats]:
        """(p,) how far each unknown may go down and up from ``x`` (p,)."""
        low, high = self.limits()
        return np.minimum(low - x, 0.0), np.maximum(high - x, 0.0)

    # -- simulation ----------------------------------------------------------------------------

    def excitation(self, number: int) -> Excitation | ObstacleRun:
        """The excitation of a part as the hypothesis reads its recording.

        If a hypothesis attributes the static tilt to the sensor, the vehicle is upright on all drives, the reference
        included. Otherwise antenna and wheel paths would differ by about a centimetre before and after the change.
        """
        part, hypothesis = self.data.parts[number], self.hypothesis
        if part.reading is None or part.reading.shown is None:
            return part.excitation
        own = [e.id for e in self.twin.effects]
        upright = self.simulation.upright or hypothesis.upright
        active = self.data.active[self.data.drive_of[number]]
        here = hypothesis.effects if active else hypothesis.preexisting
        correction = part.reading.correction(here, own, upright)
        return part.reading.excitation(correction, self.simulation.step)

    def signals(self, x: Floats) -> tuple[list[Floats], NDArray[np.bool_]]:
        """Conditioned signals (m, C, L) of every part for unknowns (p, L), and failed lanes (L,).

        A reference drive on which all lanes are equal is simulated once and has one lane.
        """
        return self.signals_of(self.space.simulated_values(x[: self.d]), x[self.shared :])

    @cached_property
    def _twins(self) -> tuple[Twin, Twin]:
        """The twins that candidates differ from on drives with the gap and on those without."""
        simulated, hypothesis = self.space.simulated, self.hypothesis
        return simulated(hypothesis.twin(self.twin)), simulated(hypothesis.on_reference().twin(self.twin))

    def signals_of(self, values: Floats, effects: Floats) -> tuple[list[Floats], NDArray[np.bool_]]:
        """As :meth:`signals`, for values (n, L) of the space's ``simulated_keys`` and coordinates (k, L) of effects."""
        space, data, hypothesis = self.space, self.data, self.hypothesis
        twin, reference_twin = self._twins
        parameters = hypothesis.values(effects)
        before = hypothesis.on_reference()
        rows_before = before.on_drive(0)[1]
        earlier = np.concatenate([values, before.values(effects[hypothesis.rows(before)])[rows_before]])
        if (earlier == earlier[:, :1]).all():
            earlier = earlier[:, :1]
        reference = lanes(reference_twin, (*space.simulated_keys, *before.on_drive(0)[0]), earlier.T)

        def simulated(numbers: list[int]) -> tuple[list[Floats], NDArray[np.bool_]]:
            if self.simulation.stop():
                raise Interrupted
            excitation, drive = self.excitation(numbers[0]), data.drive_of[numbers[0]]
            if data.active[drive] and hypothesis.effects:
                keys, rows = hypothesis.on_drive(drive)
                own = np.concatenate([values, parameters[rows]])
                stacked, bad = self._simulated(
                    twin, lanes(twin, (*space.simulated_keys, *keys), own.T), excitation
                )
            else:
                if self.likelihood.still and not before.effects:
                    return [self.likelihood.still[number] for number in numbers], np.zeros(1, dtype=bool)
                stacked, bad = self._simulated(reference_twin, reference, excitation)
            return [self._conditioned(data.parts[number], stacked) for number in numbers], bad

        groups = self._repeats()
        found = side_by_side(simulated, groups)
        signals: list[Floats] = [np.empty(0)] * len(data.parts)
        for numbers, (conditioned, _) in zip(groups, found, strict=True):
            for number, one in zip(numbers, conditioned, strict=True):
                signals[number] = one
        failed = [bad for _, bad in found]
        return signals, np.any(np.broadcast_arrays(np.zeros(values.shape[1], dtype=bool), *failed), axis=0)

    def _repeats(self) -> list[list[int]]:
        """Numbers of parts with the same excitation and the same parameters: one simulation serves them."""
        data, groups = self.data, list[list[int]]()
        for number, (part, drive) in enumerate(zip(data.parts, data.drive_of, strict=True)):
            for group in groups:
                other = data.drive_of[group[0]]
                alike = (
                    drive == other if self.hypothesis.differs else data.active[drive] == data.active[other]
                )
                if alike and data.parts[group[0]].excitation is part.excitation:
                    group.append(number)
                    break
            else:
                groups.append([number])
        return groups

    def _conditioned(self, part: Observation, stacked: Floats) -> Floats:
        signals = part.apply(stacked)
        if self.simulation.centred and self.channels[0] == "vertical_acceleration":
            # a sensor gain also scales gravity: at standstill that is a bias
            signals[:, 0] -= signals[:, 0].mean(axis=0)
        return signals

    def _simulated(
        self, twin: Twin, candidates: Floats, excitation: Excitation | ObstacleRun
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Channels (n, C, L) and failed lanes (L,); a batch that raises LinAlgError is halved until the lane is
        isolated."""
        try:
            options = {"fused": True} if self.simulation.fused else {}
            response = simulate_lanes(twin, candidates, excitation, **options)
            return response.stacked(self.channels), response.failed
        except np.linalg.LinAlgError:
            if candidates.shape[1] == 1:
                return np.zeros((len(excitation), len(self.channels), 1)), np.ones(1, dtype=bool)
            middle = candidates.shape[1] // 2
            halves = [
                self._simulated(twin, half, excitation)
                for half in (candidates[:, :middle], candidates[:, middle:])
            ]
            return np.concatenate([h[0] for h in halves], axis=2), np.concatenate([h[1] for h in halves])

    def with_still_references(self) -> Problem:
        """The same for a vehicle without unknowns: without a pre-existing effect its references are simulated once."""
        signals, _ = self.signals(np.zeros((self.shared, 1)))
        return replace(self, likelihood=replace(self.likelihood, still=tuple(signals)))

    def with_twin(self, twin: Twin) -> Problem:
        """The same with another twin."""
        other = replace(self, twin=twin, likelihood=replace(self.likelihood, still=()))
        return other.with_still_references() if self.likelihood.still else other

    def with_planar_response(self, x: Floats) -> Problem:
        """The same with the response of the vehicle at ``x`` (p,) to the planar motion alone, on a flat road.

        Clock and map offsets shift the response to the road, but not that to the planar motion of the pose. The
        response is the sum of both up to nonlinearity, so that the share of one vehicle serves for similar ones.
        """
        plain = self.having(BASELINE)
        twin = self.space.simulated(self.twin)
        values = self.space.simulated_values(x[: self.d, None])
        candidates = lanes(twin, self.space.simulated_keys, values.T)
        responses = []
        for number, part in enumerate(self.data.parts):
            driven = plain.excitation(number)
            assert isinstance(driven, Excitation)
            flat = replace(driven, road=np.repeat(driven.road[:1], driven.road.shape[0], axis=0))
            stacked, _ = self._simulated(twin, candidates, flat)
            responses.append(part.apply(stacked)[:, :, 0])
        nuisances = self.nuisances.with_planar_response(responses)
        return replace(self, likelihood=replace(self.likelihood, nuisances=nuisances))

    def with_tape_response(self, x: Floats) -> Problem:
        """The same with what the errors of the tape add to the signals of the vehicle at ``x`` (p,), by simulation on
        roads with each error's standard deviation."""
        taped = self.nuisances.taped
        if taped is None:
            return self
        twin = self.space.simulated(self.twin)
        keys, values = self.space.simulated_keys, self.space.simulated_values(x[: self.d, None])
        candidates = lanes(twin, keys, values.T)
        sigma = np.array([s for _, s in taped.errors])
        responses = []
        for part in self.data.parts:
            changed = (taped.changed(part.road, row) for row in np.diag(sigma))
            driven = [part.excitation, *(part.on(road).excitation for road in changed)]
            signals = [part.apply(self._simulated(twin, candidates, e)[0])[:, :, 0] for e in driven]
            responses.append(np.stack([s - signals[0] for s in signals[1:]], axis=2) / sigma)
        nuisances = self.nuisances.with_tape_response(responses)
        return replace(self, likelihood=replace(self.likelihood, nuisances=nuisances))

    def batches(self, lane_count: int) -> list[slice]:
        """Slices of the lanes whose signals fit in memory."""
        samples = sum(len(p.excitation) for p in self.data.parts)
        size = max(1, _LARGEST_BATCH // (7 * samples))
        return [slice(i, min(i + size, lane_count)) for i in range(0, lane_count, size)]

    # -- residuals and their derivatives -------------------------------------------------------

    def compared(self, x: Floats) -> Floats:
        """(M, C, L) simulated sensor readings at unknowns (p, L)."""
        signals, _ = self.signals(x)
        return self.likelihood.compared(signals, x[self.d : self.shared])

    def readings(self, x: Floats) -> Floats:
        """(M, C) simulated sensor readings at ``x`` (p,)."""
        return self.compared(x[:, None])[:, :, 0]

    def residuals(self, x: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """(R, L) residuals of unknowns (p, L), and failed lanes."""
        found, failed = [], []
        for cut in self.batches(x.shape[1]):
            signals, bad = self.signals(x[:, cut])
            found.append(self.likelihood.residuals(signals, x[self.d : self.shared, cut]))
            failed.append(bad)
        return np.concatenate(found, axis=1), np.concatenate(failed)

    def sums_of_squares(self, x: Floats) -> Floats:
        """(L,) sums of squared residuals of unknowns (p, L), infinite where a lane failed."""
        sums = np.empty(x.shape[1])
        for cut in self.batches(x.shape[1]):
            residual, failed = self.residuals(x[:, cut])
            found = np.einsum("rl,rl->l", residual, residual)
            sums[cut] = np.where(failed | ~np.isfinite(found), np.inf, found)
        return sums

    def costs(self, x: Floats) -> Floats:
        """(L,) -2 log posterior of unknowns (p, L), infinite where a lane failed."""
        precision, centre = self.joint_prior()
        away = x - centre[:, None]
        penalty = np.einsum("il,ij,jl->l", away, precision, away, optimize=False)
        return np.asarray(self.sums_of_squares(x) + penalty)

    def quadratic(self, x: Floats) -> Quadratic:
        """The quadratic model of the sum of squares about ``x`` (p,)."""
        return self.linearise(x).model

    def linearise(self, x: Floats) -> Linearised:
        """Residuals and Jacobian at ``x`` (p,): differences of simulated lanes for vehicle and effects, none simulated
        for nuisance parameters."""
        d, likelihood, nuisances = self.d, self.likelihood, self.nuisances
        stepped, steps, signals = self._stepped(x, d)
        plain = np.flatnonzero(nuisances.plain) if likelihood.affine else np.empty(0, dtype=np.intp)
        free = np.setdiff1d(np.arange(self.q), plain)
        shifted = np.repeat(x[d : self.shared, None], free.size, axis=1)
        shifted[free, np.arange(free.size)] += nuisances.steps[free]
        moved = likelihood.residuals(signals, shifted) if free.size else np.empty((stepped.shape[0], 0))
        given = likelihood.additive_columns if plain.size else np.empty((stepped.shape[0], 0))
        jacobian = np.empty((stepped.shape[0], x.size))
        _columns(d, stepped, steps, moved, nuisances.steps[free], d + free, given, d + plain, jacobian)
        return Linearised(x, stepped[:, 0].copy(), jacobian)

    def effect_columns(self, x: Floats, known: int = 0) -> tuple[Floats, Floats]:
        """Residuals (R,) at ``x`` (p,) and the Jacobian columns (R, k - known) of the effects, those of the first
        ``known`` coordinates left out."""
        stepped, steps, _ = self._stepped(x, 0, known)
        return stepped[:, 0].copy(), (stepped[:, 1:] - stepped[:, :1]) / steps

    def _stepped(self, x: Floats, vehicle: int, known: int = 0) -> tuple[Floats, Floats, list[Floats]]:
        """Residuals (R, 1 + vehicle + k) at ``x`` and one step away in the first ``vehicle`` unknowns and in those of
        the effects but for the first ``known``, these steps (vehicle + k,), infinite where a lane failed, and the
        signals (m, C, 1) at ``x``."""
        p, k = self.shared + known, len(self.hypothesis) - known
        high = self.hypothesis.bounds()[1][known:]
        # backwards near the upper bound
        own = np.where(x[p:] + STEP_EFFECT > high, -STEP_EFFECT, STEP_EFFECT)
        steps = np.concatenate([np.full(vehicle, STEP), own])
        stepped = np.repeat(x[:, None], 1 + vehicle + k, axis=1)
        stepped[[*range(vehicle), *range(p, p + k)], 1 + np.arange(vehicle + k)] += steps
        found, failed, base = [], [], list[Floats]()
        for cut in self.batches(stepped.shape[1]):
            signals, bad = self.signals(stepped[:, cut])
            found.append(self.likelihood.residuals(signals, stepped[self.d : self.shared, cut]))
            failed.append(bad)
            base = base or [s[:, :, :1] for s in signals]
        residual = found[0] if len(found) == 1 else np.concatenate(found, axis=1)
        return residual, np.where(np.concatenate(failed)[1:], np.inf, steps), base


def whitener_of(problem: Problem) -> Whitener:
    """The whitening noise model of a problem."""
    noise = problem.likelihood.noise
    assert isinstance(noise, Whitener)
    return noise


def effective_weight(noise: Whitener) -> Floats:
    """(R,) weights of whitened residuals: the root of the effective sample size per sample."""
    return np.full(noise.row.size, np.sqrt(noise.measured.independent))


def counting(problem: Problem, rows: NDArray[np.bool_]) -> Problem:
    """The problem with some of its whitened residuals (R,) alone."""
    noise = whitener_of(problem)
    return problem.weighed(noise, weight=np.where(rows, effective_weight(noise), 0.0))


@compiled
def _columns(
    d: int,
    stepped: Floats,
    steps: Floats,
    moved: Floats,
    moves: Floats,
    free: NDArray[np.intp],
    given: Floats,
    plain: NDArray[np.intp],
    out: Floats,
) -> None:  # pragma: no cover - compiled
    """Fill the Jacobian ``out`` (R, d + q + k) in one pass.

    Differences to the first column of ``stepped`` (R, 1 + d + k) and of ``moved`` (R, m), and the constant columns
    ``given`` (R, n). The nuisance parameters have the columns ``free`` and ``plain``.
    """
    nuisances = free.size + plain.size
    for r in range(out.shape[0]):
        base = stepped[r, 0]
        for i in range(d):
            out[r, i] = (stepped[r, 1 + i] - base) / steps[i]
        for i in range(free.size):
            out[r, free[i]] = (moved[r, i] - base) / moves[i]
        for i in range(plain.size):
            out[r, plain[i]] = given[r, i]
        for i in range(d, steps.size):
            out[r, nuisances + i] = (stepped[r, 1 + i] - base) / steps[i]
