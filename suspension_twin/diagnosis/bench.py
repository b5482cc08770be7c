# SPDX-License-Identifier: Apache-2.0
"""The joint problem of a diagnosis: residuals, Jacobian and prior of a hypothesis over all drives.

The unknowns x of a hypothesis are, in this order, the characteristics of the vehicle (slope coordinates, d), the
nuisance parameters (q) and the coordinates of the effects (k). Characteristics and nuisance parameters are shared by
all drives. Effects act on the drives with the gap only, or on all drives where they are pre-existing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.diagnosis.hypotheses import Hypothesis
from suspension_twin.diagnosis.partial import PartialResults
from suspension_twin.inference.gauss_newton import Quadratic
from suspension_twin.inference.noise import Whitener
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.problem import Interrupted, Problem
from suspension_twin.models.excitation import coarser
from suspension_twin.models.hooks import clocks_with, gains_with, turns_with, upright_with
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.models.types import Excitation
from suspension_twin.vehicle.twin import Twin

__all__ = ["REACH", "STEP", "Bench", "Excitations", "Linearised"]

#: Bound of a nuisance parameter in standard deviations of its prior: what is beyond is an effect.
REACH = 3.0
#: Finite-difference steps of characteristics and of effects, in their search coordinates.
STEP = 1e-3
_STEP_EFFECT = 1e-2


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals (R,) and Jacobian (R, d + q + k) at ``x`` (d + q + k,)."""

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
class Excitations:
    """Alternative excitations of one drive, for hypotheses that change how the recorded motion has to be read.

    ``upright``: zero static attitude of the vehicle, so that a static tilt is that of the sensor (this moves antenna
    and wheel paths). ``turned``: motion measured by a sensor with the mounting error that the drive shows.
    ``regained`` and ``reclocked``, keyed by whether the vehicle is upright: corrected for the gain error and for the
    clock offset that the drive shows; empty where it shows none.
    """

    upright: Excitation
    turned: Excitation
    regained: dict[bool, Excitation]
    reclocked: dict[bool, Excitation]


@dataclass(eq=False)
class Bench:
    """A problem over all drives or runs; ``active`` (drives,) is True for drives with the gap.

    ``precision`` (d + q, d + q) and ``centre`` (d + q,) are the prior of characteristics and nuisances.
    ``excitations`` (drives,) are the alternative excitations of drives, empty for controlled runs; ``turn`` is the
    mounting error of the sensor (roll, pitch, yaw; rad); ``level`` whether the vehicle has zero static attitude.
    ``counted_drives`` limits the residuals to some drives, ``counted_rows`` (R,) to some of them; ``fused`` whether
    poses are fused from GNSS and IMU; ``frozen_nuisances`` names nuisance parameters held at zero; ``expected`` (m,
    C) is the discrepancy found on a reference run with the same excitation. ``step`` is the longest time step in s of
    a simulation over a drive; None for the steps of the drive. ``partial`` keeps partial results on disk.
    ``spread`` are standard deviations of effect coordinates by key, where they are not 1.
    """

    problem: Problem
    excitations: tuple[Excitations, ...]
    turn: tuple[float, float, float]
    active: tuple[bool, ...]
    whitener: Whitener
    precision: Floats
    centre: Floats
    stop: Callable[[], bool] = lambda: False
    counted_drives: tuple[int, ...] | None = None
    counted_rows: NDArray[np.bool_] | None = None
    fused: bool = True
    frozen_nuisances: tuple[str, ...] = ()
    level: bool = False
    expected: tuple[Floats | None, ...] = ()
    step: float | None = None
    partial: PartialResults = field(default_factory=PartialResults)
    spread: Mapping[str, float] = field(default_factory=dict)
    _known_plain: dict[str, Any] = field(default_factory=dict)
    _stepped_excitations: dict[int, tuple[Excitation, Excitation]] = field(default_factory=dict)

    @property
    def d(self) -> int:
        return len(self.problem.space)

    @property
    def q(self) -> int:
        return len(self.problem.nuisances)

    def prior(self, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
        """Precision (p, p) and centre (p,) of the prior of all unknowns; that of an effect coordinate is N(centre,
        1) but for those in ``spread``."""
        p = self.d + self.q
        own = [self.spread.get(key, 1.0) ** -2 for key in hypothesis.keys]
        precision = np.diag(np.concatenate([np.ones(p), own]))
        precision[:p, :p] = self.precision
        return precision, np.concatenate([self.centre, hypothesis.centre()])

    def limits(self, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
        """(d + q + k,) lowest and highest unknowns.

        Nuisance parameters are bounded, because an unbounded one absorbs the effect of the same kind: a free clock
        offset of 60 ms lowers the cost of any drive by more than its prior adds.
        """
        low, high = hypothesis.bounds()
        free = np.full(self.d, np.inf)
        allowed = [name not in self.frozen_nuisances for name in self.problem.nuisances.names]
        nuisance = REACH * self.problem.nuisances.spread * allowed
        least = np.where(self.problem.nuisances.one_sided, 0.0, -nuisance)
        return np.concatenate([-free, least, low]), np.concatenate([free, nuisance, high])

    def clipped(self, hypothesis: Hypothesis, x: Floats) -> Floats:
        """Unknowns (d + q + k, L) inside their limits."""
        low, high = self.limits(hypothesis)
        return np.asarray(np.clip(x, low[:, None], high[:, None]))

    def levelled(self) -> Bench:
        """The same with zero static attitude of the vehicle: a static tilt is attributed to the sensor."""
        pairs = zip(self.problem.parts, self.excitations, strict=True)
        parts = [replace(part, excitation=known.upright) for part, known in pairs]
        return replace(self, problem=self.problem.on(parts), level=True)

    def excitation(self, number: int, effects: Sequence[str], preexisting: Sequence[str] = ()) -> Excitation:
        """The excitation of a part, given the ``effects`` on drives with the gap and those of them that are
        ``preexisting``.

        If a hypothesis attributes the static tilt to the sensor, the vehicle is upright on all drives, the reference
        included. Otherwise antenna and wheel paths would differ by about a centimetre before and after the change.
        """
        if not self.excitations:
            run: Excitation = self.problem.parts[number].excitation
            return run
        own, model = [e.id for e in self.problem.twin.effects], self.problem.twin.model
        known, level = self.excitations[number], self.level or upright_with([*effects, *own], model)
        found = known.upright if level else self.problem.parts[number].excitation
        here = effects if self.active[self.problem.drive_of[number]] else preexisting
        if turns_with(here, model):
            found = known.turned
        # a gain in the twin file is already corrected in the prepared motion
        elif gains_with([*here, *own], model) and level in known.regained:
            found = known.regained[level]
        elif clocks_with(here, model):
            found = known.reclocked.get(level, found)
        return self._in_steps(found)

    def _in_steps(self, given: Excitation) -> Excitation:
        """The excitation of a drive in the time steps of the bench."""
        if self.step is None or not self.excitations:
            return given
        if id(given) not in self._stepped_excitations:  # kept with its source, so that the id stays its own
            self._stepped_excitations[id(given)] = given, coarser(given, self.step)
        return self._stepped_excitations[id(given)][1]

    # -- simulation ----------------------------------------------------------------------------

    def signals(self, hypothesis: Hypothesis, z: Floats, u: Floats) -> tuple[list[Floats], np.ndarray]:
        """Conditioned signals (m, C, L) of every part for slope coordinates (d, L) and effects (k, L); failed lanes
        (L,).

        A reference drive on which all lanes are equal is simulated once and has one lane.
        """
        problem, space = self.problem, self.problem.space
        values = space.simulated_values(z)
        twin = space.simulated(hypothesis.twin(problem.twin))
        parameters = hypothesis.values(u)

        def with_effects(drive: int) -> Floats:
            keys, rows = hypothesis.on_drive(drive)
            return lanes(twin, (*space.simulated_keys, *keys), np.concatenate([values, parameters[rows]]).T)

        everywhere = None if hypothesis.differs else with_effects(0)
        before = hypothesis.on_reference()
        rows_before = before.on_drive(0)[1]
        earlier = np.concatenate([values, before.values(u[hypothesis.rows(before)])[rows_before]])
        if (earlier == earlier[:, :1]).all():
            earlier = earlier[:, :1]
        reference_twin = space.simulated(before.twin(problem.twin))
        before_keys = before.on_drive(0)[0]
        plain = lanes(reference_twin, (*space.simulated_keys, *before_keys), earlier.T)

        def driven(numbers: list[int]) -> tuple[list[Floats], np.ndarray]:
            if self.stop():
                raise Interrupted
            excitation = self.excitation(numbers[0], hypothesis.effects, hypothesis.preexisting)
            drive = problem.drive_of[numbers[0]]
            if self.active[drive] and hypothesis.effects:
                candidates = with_effects(drive) if everywhere is None else everywhere
                stacked, bad = self._simulated(twin, candidates, excitation)
            else:
                stacked, bad = self._simulated(reference_twin, plain, excitation)
            conditioned = [problem.parts[number].conditioner.apply(stacked) for number in numbers]
            if problem.channels[0] == "vertical_acceleration":
                for one in conditioned:
                    # a sensor gain also scales gravity: at standstill that is a bias
                    one[:, 0] -= one[:, 0].mean(axis=0)
            return conditioned, bad

        # repeats of a run share one simulation
        alike: dict[tuple[int, int], list[int]] = {}
        for number, part in enumerate(problem.parts):
            drive = problem.drive_of[number]
            key = id(part.excitation), drive if hypothesis.differs else -int(self.active[drive])
            alike.setdefault(key, []).append(number)
        groups = list(alike.values())
        found = side_by_side(driven, groups)
        signals: list[Floats] = [np.empty(0)] * len(problem.parts)
        for numbers, (conditioned, _) in zip(groups, found, strict=True):
            for number, one in zip(numbers, conditioned, strict=True):
                signals[number] = one
        failed = [bad for _, bad in found]
        return signals, np.any(np.broadcast_arrays(np.zeros(values.shape[1], dtype=bool), *failed), axis=0)

    def carry(self, x: Floats) -> None:
        """Simulate the vehicle at ``x`` on a flat road and store its response to the planar motion alone.

        Clock and map offsets shift the response to the road, but not that to the planar motion of the pose. The
        response is the sum of both up to nonlinearity, so that the share of one vehicle serves for similar ones.
        """
        problem, space = self.problem, self.problem.space
        twin = space.simulated(problem.twin)
        candidates = lanes(twin, space.simulated_keys, space.simulated_values(x[: self.d, None]).T)
        carried = []
        for part in problem.parts:
            driven = self._in_steps(part.excitation)
            flat = replace(driven, road=np.repeat(driven.road[:1], driven.road.shape[0], axis=0))
            stacked, _ = self._simulated(twin, candidates, flat)
            carried.append(part.conditioner.apply(stacked)[:, :, 0])
        problem.nuisances.carried = carried

    def _simulated(self, twin: Twin, candidates: Floats, excitation: Excitation) -> tuple[Floats, np.ndarray]:
        """Channels (n, C, L) and failed lanes (L,); a batch that raises LinAlgError is halved until the lane is
        isolated."""
        channels = self.problem.channels
        try:
            options = {"fused": True} if self.fused else {}
            response = simulate_lanes(twin, candidates, excitation, **options)
            return response.stacked(channels), response.failed
        except np.linalg.LinAlgError:
            if candidates.shape[1] == 1:
                return np.zeros((len(excitation), len(channels), 1)), np.ones(1, dtype=bool)
            middle = candidates.shape[1] // 2
            halves = [
                self._simulated(twin, c, excitation) for c in (candidates[:, :middle], candidates[:, middle:])
            ]
            return np.concatenate([h[0] for h in halves], axis=2), np.concatenate([h[1] for h in halves])

    def compared(self, signals: Sequence[Floats], nuisance: Floats) -> Floats:
        """(M, C, L) simulated sensor readings plus the expected discrepancy of each run."""
        if self.expected:
            expected = zip(signals, self.expected, strict=True)
            signals = [s if e is None else s + e[:, :, None] for s, e in expected]
        return self.problem.compared(signals, nuisance)

    def white(self, signals: Sequence[Floats], nuisance: Floats) -> Floats:
        """(R, L) whitened residuals; their squares' sum is -2 log likelihood of independent samples."""
        return self._counted(self.whitener.residuals(self.compared(signals, nuisance)))

    def _counted(self, white: Floats) -> Floats:
        """Whitened residuals (R, L) in place: scaled by the effective sample size, zero outside the counted rows."""
        white *= np.sqrt(self.problem.measured.independent)
        if self.counted_drives is not None:
            white[~np.isin(self.whitener.drive, self.counted_drives)] = 0.0
        if self.counted_rows is not None:
            white[~self.counted_rows] = 0.0
        return white

    def _plain(self) -> Floats:
        """(R, n) constant Jacobian columns of the nuisance parameters that do not depend on the simulation."""
        if self._known_plain.get("whitener") is not self.whitener:
            problem = self.problem
            still = [np.zeros((part.t.size, len(problem.channels), 1)) for part in problem.parts]
            rows = np.flatnonzero(problem.nuisances.plain)
            unit = np.zeros((len(problem.nuisances), 1 + rows.size))
            unit[rows, 1 + np.arange(rows.size)] = 1.0
            white = self.whitener.residuals(problem.compared(still, unit))
            self._known_plain.update(
                whitener=self.whitener, columns=np.ascontiguousarray(white[:, 1:] - white[:, :1])
            )
        return np.array(self._known_plain["columns"])

    def residuals(self, hypothesis: Hypothesis, x: Floats) -> tuple[Floats, np.ndarray]:
        """(R, L) whitened residuals of unknowns (d + q + k, L), and which lanes failed."""
        d, q = self.d, self.q
        found, failed = [], []
        for cut in self.problem.batches(x.shape[1]):
            signals, bad = self.signals(hypothesis, x[:d, cut], x[d + q :, cut])
            found.append(self.white(signals, x[d : d + q, cut]))
            failed.append(bad)
        return np.concatenate(found, axis=1), np.concatenate(failed)

    def costs(self, hypothesis: Hypothesis, x: Floats) -> Floats:
        """(L,) -2 log posterior, infinite where a lane failed."""
        residual, failed = self.residuals(hypothesis, x)
        precision, centre = self.prior(hypothesis)
        away = x - centre[:, None]
        penalty = np.einsum("il,ij,jl->l", away, precision, away, optimize=False)
        total = np.einsum("rl,rl->l", residual, residual, optimize=False) + penalty
        return np.asarray(np.where(failed | ~np.isfinite(total), np.inf, total))

    def linearise(self, hypothesis: Hypothesis, x: Floats) -> Linearised:
        """Residuals and Jacobian at ``x`` (d + q + k,)."""
        d, q = self.d, self.q
        white, per_step, signals = self._stepped(hypothesis, x, d)
        nuisances = self.problem.nuisances
        free, plain = np.flatnonzero(~nuisances.plain), np.flatnonzero(nuisances.plain)
        shifted = np.repeat(x[d : d + q, None], free.size, axis=1)
        shifted[free, np.arange(free.size)] += nuisances.steps[free]
        moved = self.white([s[:, :, :1] for s in signals], shifted)
        given = self._counted(self._plain())
        jacobian = np.empty((white.shape[0], x.size))
        _columns(d, white, per_step, moved, 1.0 / nuisances.steps[free], d + free, given, d + plain, jacobian)
        return Linearised(x, white[:, 0].copy(), jacobian)

    def effect_columns(self, hypothesis: Hypothesis, x: Floats) -> tuple[Floats, Floats]:
        """Residuals (R,) at ``x`` (d + q + k,) and the Jacobian columns (R, k) of the effects."""
        white, per_step, _ = self._stepped(hypothesis, x, 0)
        return white[:, 0].copy(), (white[:, 1:] - white[:, :1]) * per_step

    def _stepped(
        self, hypothesis: Hypothesis, x: Floats, physics: int
    ) -> tuple[Floats, Floats, list[Floats]]:
        """Residuals (R, 1 + physics + k) at ``x`` and one step away in the first ``physics`` unknowns and in those of
        the effects, the factor (physics + k,) from difference to derivative (0 where a lane failed), and the
        signals."""
        d, q, k = self.d, self.q, len(hypothesis)
        _, high = hypothesis.bounds()
        u = x[d + q :]
        # backwards near the upper bound
        own = np.where(u + _STEP_EFFECT > high, -_STEP_EFFECT, _STEP_EFFECT)
        steps = np.concatenate([np.full(physics, STEP), own])
        stepped = np.repeat(np.concatenate([x[:d], u])[:, None], 1 + physics + k, axis=1)
        stepped[[*range(physics), *range(d, d + k)], 1 + np.arange(physics + k)] += steps
        signals, failed = self.signals(hypothesis, stepped[:d], stepped[d:])
        white = self.white(signals, np.repeat(x[d : d + q, None], stepped.shape[1], axis=1))
        return white, ~failed[1:] / steps, signals


@compiled
def _columns(
    d: int,
    stepped: Floats,
    per_step: Floats,
    moved: Floats,
    per_move: Floats,
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
            out[r, i] = (stepped[r, 1 + i] - base) * per_step[i]
        for i in range(free.size):
            out[r, free[i]] = (moved[r, i] - base) * per_move[i]
        for i in range(plain.size):
            out[r, plain[i]] = given[r, i]
        for i in range(d, per_step.size):
            out[r, nuisances + i] = (stepped[r, 1 + i] - base) * per_step[i]
