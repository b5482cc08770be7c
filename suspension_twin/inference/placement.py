# SPDX-License-Identifier: Apache-2.0
"""Placement of a drive on its road by what its sensor felt, where the receiver leaves the place open.

The error of a receiver's position is slow, and once the positions are smoothed with its velocities, that of a speed:
d(t), along the vehicle's course, is the part along the course of a process that has a derivative (Matérn 3/2) with the
receiver's own variance s² and a time constant T, and the way driven while the receiver is late by c,

    cov(d_i, d_j) = s² cos(course_i - course_j) (1 + a) exp(-a) + var(c) v_i v_j,   a = sqrt(3) |t_i - t_j| / T.

The drive is cut into passes, pieces of a few seconds on which the road is felt. A bank of places is simulated for each
of them: the given twin over the same motion, with the road looked up farther ahead and, where the road's wheel paths
differ, farther to the left. The pattern of vertical acceleration, pitch and roll rate that both axles make a wheelbase
apart gives each place its likelihood. Passes follow one another as the states of a hidden Markov chain: forward and
backward over it gives the most probable places and their marginal probabilities. Between the passes the places are
found by Gauss-Newton at knots of time. What is left, some centimetres at each knot, is found with the vehicle
(``wander`` of :mod:`~suspension_twin.inference.nuisance`).

A receiver's error matters where three standard deviations of it move the wheels by more than half the shortest wave
that the comparison passes, v / (2 f_c) at its cut-off f_c. Below that, nothing is placed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.effects.registry import effect
from suspension_twin.errors import WorkError
from suspension_twin.inference.excited_segments import TrimSettings, fit_rows, trim
from suspension_twin.inference.nuisance import course_covariance
from suspension_twin.inference.observation import VERTICAL, Observation, PlaceShift, observe
from suspension_twin.inference.off_road import OFF_ROAD
from suspension_twin.inference.priors import SINGLE
from suspension_twin.inference.problem import REACH
from suspension_twin.models.excitation import coarser
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.pose.imu_gnss_consistency import consistency
from suspension_twin.pose.types import PoseSettings
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "SAME_ROAD",
    "NoPlaceError",
    "Placement",
    "in_reach",
    "is_open",
    "on_one_clock",
    "place",
    "where_felt",
]

#: m that wheel paths differ by at least for the lateral place to matter: a tape measure's millimetre.
_LEVEL_ACROSS = 1e-3
#: m between places side by side: the width of a tyre.
_ACROSS = 0.2
#: s of a step while places are looked for (numerics: a 40th of the period of wheel hop).
_STEP = 2e-3
#: Correlation of measured and simulated motion below which the road is taken for another: a seven-degree model on the
#: right road reaches 0.9 and more, on a wrong one 0.3.
SAME_ROAD = 0.5
#: Places that are simulated once more, the most probable ones, to see how far they differ (numerics: four blocks).
_PROBABLE = 64
#: s of driving that one place is looked for (prior): the error of the smoothed speed, sqrt(3) / 60 s of a phone's
#: 2.5 m, moves it by 0.14 m to either side of the middle, half the shortest wave at 6 m/s.
_ONE_PLACE = 4.0
#: Steps of the search between the passes, at most; m of a step below which it ends, and of a difference quotient
#: (numerics).
_STEPS, _NEAR = 12, 2e-3
_ALONG, _LEFT = "position_offset", "lateral_offset"


class NoPlaceError(WorkError):
    """No pass of a drive can be placed on its road."""

    @property
    def left_out(self) -> str:
        """One line for people where other drives are placed."""
        return f"{self}; the drive is left out"


@dataclass(frozen=True, eq=False)
class Placement:
    """Places of ``passes`` against their positions: how much farther ``ahead`` along the vehicle's course and to the
    ``left`` the drive was at ``t`` s, each (k,) m, and by how many rad it was ``turned``; ``spans`` of passes that
    could not be placed, in s."""

    t: Floats
    ahead: Floats
    left: Floats
    passes: int
    spans: tuple[tuple[float, float], ...] = ()
    turned: float = 0.0

    def moved(self, observation: Observation) -> Observation:
        """The drive where it was found, linear between the times; passes that could not be placed are not compared."""
        found = on_the_lane(observation).displaced(self.t, self.ahead, self.left, self.turned)
        source, path = found.source, found.trajectory
        valid = path.valid.copy()
        for start, end in self.spans:
            valid &= (path.t < start) | (path.t > end)
        unknown = replace(found, reading=replace(source, trajectory=replace(path, valid=valid)))
        placed = on_the_lane(unknown)
        known = [text for text in observation.warnings if not text.startswith(OFF_ROAD)]
        known += [placed.off_road.sentence(float(path.t[0])), self.words(float(observation.t[0]))]
        return replace(placed, warnings=tuple(filter(None, known)))

    def kept(self, observation: Observation) -> Observation:
        """As :meth:`moved`, also where the recording is read with another correction of its sensor."""
        moved, path = self.moved(observation), observation.trajectory
        x, y = moved.trajectory.x - path.x, moved.trajectory.y - path.y
        cos, sin = np.cos(path.yaw), np.sin(path.yaw)
        shift = PlaceShift(path.t, x * cos + y * sin, y * cos - x * sin, self.turned)
        settings = replace(observation.settings, placed=shift)
        return replace(moved, reading=replace(moved.source, settings=settings))

    def words(self, start: float) -> str:
        """One line for people, times counted from ``start`` s."""
        lost = ", ".join(f"{a - start:.0f} to {b - start:.0f} s" for a, b in self.spans)
        return (
            f"{self.passes} segments are placed on the road by what was felt, {self.ahead.min():+.1f} to "
            f"{self.ahead.max():+.1f} m ahead of their positions"
        ) + (f"; left out, for their place cannot be told: {lost}" if lost else "")


def _shortest_wave(drive: Observation, speed: float) -> float:
    """m of the shortest wave of a road that the comparison passes at a ``speed`` in m/s."""
    return speed / drive.bandwidth


def is_open(drive: Observation) -> bool:
    """Whether a receiver leaves the place open to what the comparison resolves: three of its standard deviations are
    more than half the shortest wave at the drive's median speed."""
    speed = np.abs(drive.speed)
    moving = speed[speed > TrimSettings().slowest]
    wave = _shortest_wave(drive, float(np.median(moving))) if moving.size else np.inf
    return bool(REACH * drive.position_sigma > 0.5 * wave)


def on_the_lane(drive: Observation) -> Observation:
    """The drive with its path moved sideways where its wheels would run beside the road within the receiver's error."""
    source, path, road = drive.source, drive.trajectory, drive.road
    middle, room = 0.5 * float(road.v[0] + road.v[-1]), _room(drive)
    u, v = road.xy_to_uv(path.x, path.y)
    inside = middle + np.clip(v - middle, -room, room)
    beside = np.abs(v - inside)
    off = (beside > 0.0) & (beside < REACH * drive.position_sigma) & (u > road.u_first) & (u < road.u_last)
    x, y = road.uv_to_xy(u, inside)
    moved = replace(path, x=np.where(off, x, path.x), y=np.where(off, y, path.y))
    return replace(drive, reading=replace(source, trajectory=moved)).displaced(path.t[:1], np.zeros(1))


def in_reach(drive: Observation) -> Observation:
    """The drive as near to its road as its receiver allows: what lies farther off is on another road."""
    return on_the_lane(drive) if is_open(drive) else drive


def _room(drive: Observation) -> float:
    """m to either side of the middle of a drive's road within which its wheels stay on the road."""
    half = float(np.abs(drive.twin.vehicle.wheel_positions[:, 1]).max()) + 0.5 * _ACROSS
    return max(0.5 * float(drive.road.v[-1] - drive.road.v[0]) - half, 0.0)


def on_one_clock(drive: Observation) -> Observation:
    """The drive with its receiver's stamps earlier by what they are late, as IMU and receiver show it when the vehicle
    brakes and turns, where the receiver leaves the place open: an accurate one has a clock worth keeping."""
    source = drive.source
    if not is_open(drive):
        return drive
    recorded, twin = source.drive, source.twin
    known = consistency(recorded, source.signals, twin.gps)
    if known is None:
        return drive
    fix = replace(recorded.fix, t=recorded.fix.t + known.clock_offset)
    velocity = replace(recorded.velocity, t=recorded.velocity.t + known.clock_offset)
    timed = observe(replace(recorded, fix=fix, velocity=velocity), twin, source.road, source.settings)
    late = f"positions and velocities are taken as {-known.clock_offset:.2f} s late, by braking and turning"
    warnings = (*timed.warnings, late)
    return replace(timed, name=drive.name, warnings=warnings, lateness_sigma=known.clock_sigma)


def _lateness(drive: Observation) -> float:
    """s that the receiver's stamps are late, one standard deviation."""
    known = drive.lateness_sigma
    return SINGLE["receiver_lateness"] if known is None else known


def place(drive: Observation, twin: Twin) -> Placement | None:
    """Place a drive's passes on its road, where its receiver leaves that open to what the comparison resolves.

    Parameters
    ----------
    drive : Observation
        A drive with its receiver's positions.
    twin : Twin
        The twin as it is known before, of which the felt pattern is expected.

    Returns
    -------
    Placement, optional
        None where the receiver is accurate enough, or the vehicle's model knows no place on a road.

    Raises
    ------
    NoPlaceError
        No pass can be placed.
    """
    if twin.model not in effect(_ALONG).hook.models or not is_open(drive):
        return None
    passes = _passes(on_the_lane(drive))
    # without passes the road does not excite the vehicle, as is said elsewhere
    return _Bank.of(drive, twin, passes).found() if passes else None


def where_felt(drive: Observation, twin: Twin) -> Observation:
    """A drive on one clock and where its road was felt by ``twin``; where that cannot be told it stays at its
    positions, with a warning."""
    drive = on_one_clock(drive)
    try:
        where = place(drive, twin)
    except NoPlaceError as error:
        return replace(drive, warnings=(*drive.warnings, f"{error}: it is left at its positions"))
    return drive if where is None else where.moved(drive)


@dataclass(frozen=True, eq=False)
class _Pass:
    """A piece of driving on which the road is felt: its ``part`` with the lead, the samples ``rows`` of it that are
    compared, and the ``segment`` of some pieces that is simulated at once, in which they are those ``within``."""

    part: Observation
    rows: NDArray[np.intp]
    segment: Observation
    within: NDArray[np.intp]

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp in s."""
        return float(self.part.t[self.rows[0]]), float(self.part.t[self.rows[-1]])

    @property
    def motion(self) -> tuple[float, float, float]:
        """Its middle in s, the course there in rad and the median speed in m/s."""
        path, (start, end) = self.part.trajectory, self.span
        middle = 0.5 * (start + end)
        own = (path.t >= start) & (path.t <= end)
        return middle, float(np.interp(middle, path.t, path.yaw)), float(np.median(path.speed[own]))


def _passes(drive: Observation) -> list[_Pass]:
    """Pieces of a drive on which the road is felt, about as long as one place is looked for."""
    settings = replace(TrimSettings(), bridge=TrimSettings().window)
    # where the road ends is not known yet
    everywhere = replace(drive, mask=np.ones_like(drive.mask))
    found = []
    for segment in trim(everywhere, settings):
        wide = replace(segment, mask=np.ones_like(segment.mask))
        rows = fit_rows(wide, settings)
        if rows.size < 0.5 * drive.rate:
            continue
        pieces = np.array_split(rows, max(round(rows.size / drive.rate / _ONE_PLACE), 1))
        # simulated eight at a time, which bounds the memory of a long drive
        for together in (pieces[k : k + 8] for k in range(0, len(pieces), 8)):
            spans = [(float(wide.t[own[0]]), float(wide.t[own[-1]])) for own in together]
            whole = drive.part(spans[0][0] - settings.lead, spans[-1][1] + 0.5)
            for start, end in spans:
                part = drive.part(start - settings.lead, end + 0.5)
                found.append(_Pass(part, _between(part, start, end), whole, _between(whole, start, end)))
    return found


def _between(part: Observation, start: float, end: float) -> NDArray[np.intp]:
    """Samples with stamps from ``start`` to ``end`` s."""
    return np.flatnonzero((part.t >= start) & (part.t <= end))


@dataclass(frozen=True, eq=False)
class _Expectation:
    """The ``channels`` that a twin makes of a place on the road, in the ``unit`` (C,) of each."""

    twin: Twin
    channels: tuple[str, ...]
    unit: Floats

    @classmethod
    def of(cls, twin: Twin, channels: tuple[str, ...], passes: Sequence[_Pass]) -> _Expectation:
        """In units of what was felt on all passes; the twin with the place as a number that may differ."""
        have = {e.id for e in twin.effects}
        specs = [e.model_dump() for e in twin.effects] + [{"id": n} for n in (_ALONG, _LEFT) if n not in have]
        felt = [np.mean(_felt(p.part, p.rows, channels) ** 2, axis=0) for p in passes]
        return cls(twin.with_changes({"effects": specs}), channels, np.sqrt(np.mean(felt, axis=0)))

    def felt(self, part: Observation, rows: NDArray[np.intp]) -> Floats:
        """(rows, C, 1) measured at some samples of a part of a drive."""
        return np.asarray((_felt(part, rows, self.channels) / self.unit)[:, :, None])

    def at(self, part: Observation, rows: NDArray[np.intp], ahead: Floats, left: Floats) -> Floats:
        """(rows, C, L) expected at these samples at the places ``ahead`` and ``left`` (L,) m."""
        keys = tuple(f"effects.{name}.offset" for name in (_ALONG, _LEFT))
        candidates = lanes(self.twin, keys, np.column_stack([ahead, left]))
        response = simulate_lanes(self.twin, candidates, coarser(part.road_excitation, _STEP))
        return np.asarray(part.apply(response.stacked(self.channels))[rows] / self.unit[:, None])


def _felt(part: Observation, rows: NDArray[np.intp], channels: Sequence[str]) -> Floats:
    """(rows, C) measured channels of a part of a drive."""
    return np.stack([part.measured[c][rows] for c in channels], axis=1)


@dataclass(frozen=True, eq=False)
class _Bank:
    """Every pass at places ``ahead`` (s,) and ``left`` (v,) m of its positions.

    Of k passes (k, s, v): ``misfit``, the squared residual summed over its samples, and ``correlation`` of felt and
    expected.
    """

    drive: Observation
    passes: list[_Pass]
    expectation: _Expectation
    ahead: Floats
    left: Floats
    misfit: Floats
    correlation: Floats

    @classmethod
    def of(cls, drive: Observation, twin: Twin, passes: list[_Pass]) -> _Bank:
        """Simulate the twin at every place."""
        sigma = drive.position_sigma
        speeds = np.array([p.motion[2] for p in passes])
        reach = REACH * np.hypot(sigma, _lateness(drive) * float(speeds.max()))
        step = 0.5 * _shortest_wave(drive, float(np.median(speeds)))
        count = int(np.ceil(reach / step))
        ahead: Floats = step * np.arange(-count, count + 1, dtype=np.float64)
        shaped = float(np.ptp(drive.road.z, axis=1).max()) > _LEVEL_ACROSS
        beside = int(np.ceil(min(REACH * sigma, 2.0 * _room(drive)) / _ACROSS)) if shaped else 0
        left: Floats = _ACROSS * np.arange(-beside, beside + 1, dtype=np.float64)
        channels = VERTICAL if shaped else ("vertical_acceleration", "pitch_rate")
        expectation = _Expectation.of(twin, channels, passes)
        misfit, correlation = np.empty((2, len(passes), ahead.size, left.size))
        for _, pieces in groupby(enumerate(passes), lambda p: id(p[1].segment)):
            numbers, own = zip(*pieces, strict=True)
            segment, rows = own[0].segment, np.concatenate([p.within for p in own])
            felt = expectation.felt(segment, rows)
            cuts = np.cumsum([p.within.size for p in own])[:-1].tolist()
            for k, beside_it in enumerate(left):
                expected = expectation.at(segment, rows, ahead, np.full(ahead.size, beside_it))
                for number, e, f in zip(numbers, np.split(expected, cuts), np.split(felt, cuts), strict=True):
                    power = np.sum(e**2, axis=(0, 1)) * np.sum(f**2)
                    misfit[number, :, k] = np.sum((e - f) ** 2, axis=(0, 1))
                    alike = np.sum(e * f, axis=(0, 1)) / np.sqrt(np.maximum(power, 1e-12))
                    correlation[number, :, k] = alike
        return cls(drive, passes, expectation, ahead, left, misfit, correlation)

    def found(self) -> Placement:
        """The places of all passes; NoPlaceError where there is none.

        A pass is left out where what is expected differs between its probable places by more than the residual, so that
        it could not be compared, or where it differs so much from what was felt.
        """
        rows = np.array([p.rows.size for p in self.passes])
        # the residual's size where every pass fits best, and how many samples of it are independent
        size = sum(float(m.min()) for m in self.misfit) / rows.sum()
        independent = min(1.0, 2.0 * self.drive.bandwidth / self.drive.rate)
        marginals = self._smoothed([-0.5 * independent * m / size for m in self.misfit])
        places, kept, spans = [], list[_Pass](), list[tuple[float, float]]()
        for one, likely, alike in zip(self.passes, marginals, self.correlation, strict=True):
            along, across = np.unravel_index(int(np.argmax(likely)), likely.shape)
            doubt = self._doubt(one, likely, (float(self.ahead[along]), float(self.left[across])))
            if doubt > size * one.rows.size or alike[along, across] < SAME_ROAD:
                spans.append(one.span)
            else:
                places.append((one.motion[0], float(self.ahead[along]), float(self.left[across])))
                kept.append(one)
        if not places:
            raise NoPlaceError(
                f"{self.drive.name}: no place on the road {self.drive.road.name} is found for what was felt on its "
                f"{len(spans)} passes, within {self.ahead[-1]:.0f} m of the positions of the receiver"
            )
        t, ahead, left = np.array(places).T
        return _Fine.of(self, kept).placement(Placement(t, ahead, left, len(kept), tuple(spans)))

    def _doubt(self, one: _Pass, likely: Floats, best: tuple[float, float]) -> float:
        """Mean square over the probable places of what is expected there less what is expected at the best."""
        order = np.argsort(likely, axis=None)[::-1][:_PROBABLE]
        along, across = np.unravel_index(order, likely.shape)
        weight = likely.ravel()[order]
        ahead, left = np.append(best[0], self.ahead[along]), np.append(best[1], self.left[across])
        expected = self.expectation.at(one.part, one.rows, ahead, left)
        apart = np.sum((expected[:, :, 1:] - expected[:, :, :1]) ** 2, axis=(0, 1))
        return float(apart @ weight / weight.sum())

    def _smoothed(self, logs: list[Floats]) -> list[Floats]:
        """Marginal probabilities (s, v) of the places of each pass, by forward and backward recursion."""
        motion = np.array([p.motion for p in self.passes])
        sigma = self.drive.position_sigma
        across = course_covariance(motion.T[:2], sigma)
        along = across + _lateness(self.drive) ** 2 * np.outer(motion[:, 2], motion[:, 2])
        first = (
            _normal(self.ahead, 0.0, along[0, 0])[:, None] * _normal(self.left, 0.0, across[0, 0])[None, :]
        )
        steps = [
            tuple(
                _transition(grid, c[k : k + 2, k : k + 2])
                for grid, c in ((self.ahead, along), (self.left, across))
            )
            for k in range(len(logs) - 1)
        ]
        likely = [np.exp(log - log.max()) for log in logs]
        forward = [_scaled(first * likely[0])]
        for (a, b), own in zip(steps, likely[1:], strict=True):
            forward.append(_scaled((a.T @ forward[-1] @ b) * own))
        backward = [np.ones_like(first)]
        for (a, b), own in zip(reversed(steps), reversed(likely[1:]), strict=True):
            backward.insert(0, _scaled(a @ (backward[0] * own) @ b.T))
        return [_scaled(f * g) for f, g in zip(forward, backward, strict=True)]


@dataclass(frozen=True, eq=False)
class _Fine:
    """The receiver's error at the ``knots`` (k,) s along the road, by Gauss-Newton with its covariance as prior. Where
    the road's wheel paths differ it is found to the left as well, and so is the error of the heading.

    A displacement d(t) that is slow against the vehicle's motion changes the signals by d(t) times their derivative
    to a constant one, which more lanes of a simulation give. ``rows`` are the compared samples of the ``drive``,
    ``hats`` (rows, k) of the linear interpolation between the knots, ``precision`` that of the prior of the unknowns:
    (k,) m ahead, or these, (k,) m to the left, and the heading in rad.
    """

    drive: Observation
    expectation: _Expectation
    knots: Floats
    rows: NDArray[np.intp]
    hats: Floats
    precision: Floats

    @classmethod
    def of(cls, bank: _Bank, passes: Sequence[_Pass]) -> _Fine:
        """Over the compared samples of ``passes``."""
        drive, spans = on_the_lane(bank.drive), [p.span for p in passes]
        rows = np.flatnonzero(np.any([(drive.t >= a) & (drive.t <= b) for a, b in spans], axis=0))
        first, last = spans[0][0], spans[-1][1]
        apart = drive.usage.priors.wander_seconds
        knots = np.linspace(first, last, int(np.ceil((last - first) / apart)) + 1)
        # none where nothing is felt for long
        knots = knots[np.any([(knots > a - apart) & (knots < b + apart) for a, b in spans], axis=0)]
        course = np.interp(knots, drive.trajectory.t, np.unwrap(drive.trajectory.yaw))
        hats = interpolated(drive.t[rows], knots, np.eye(knots.size))
        covariance = course_covariance(np.stack([knots, course]), drive.position_sigma)
        precision = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        if bank.left.size > 1:
            precision = block_diag(precision, precision, PoseSettings().heading_sigma ** -2.0)
        return cls(drive, bank.expectation, knots, rows, hats, precision)

    def placement(self, coarse: Placement) -> Placement:
        """The places at the knots, from those of the passes."""
        k = self.knots.size
        at = [np.interp(self.knots, coarse.t, v) for v in (coarse.ahead, coarse.left)]
        best = np.concatenate([*at, np.zeros(1)])[: len(self.precision)]
        cost, step = self._quadratic(best)
        for _ in range(_STEPS):
            if np.abs(step[: 2 * k]).max() < _NEAR:
                break
            reached, further = self._quadratic(best + step)
            if reached < cost:
                best, cost, step = best + step, reached, further
            else:
                step = 0.5 * step
        ahead, left, turned = self._split(best)
        return replace(coarse, t=self.knots, ahead=ahead, left=left, turned=turned)

    def _split(self, at: Floats) -> tuple[Floats, Floats, float]:
        """(k,) m ahead and to the left, and rad of the heading."""
        k = self.knots.size
        return (at[:k], at[k : 2 * k], float(at[-1])) if at.size > k else (at, np.zeros(k), 0.0)

    def _quadratic(self, at: Floats) -> tuple[float, Floats]:
        """The cost at the unknowns ``at``, and the step to the minimum of its quadratic model, no longer than that
        holds."""
        k, (ahead, left, turned) = self.knots.size, self._split(at)
        drive = self.drive.displaced(self.knots, ahead, left, turned)
        near = np.array([0.0, _NEAR, 0.0])
        expected = self.expectation.at(drive, self.rows, near, near[[0, 2, 1]])
        miss = self.expectation.felt(drive, self.rows)[:, :, 0] - expected[:, :, 0]
        slopes = (expected[:, :, 1:] - expected[:, :, :1]) / _NEAR
        columns = [slopes[:, :, :1] * self.hats[:, None]]
        if at.size > k:
            turn = _NEAR / drive.twin.vehicle.wheelbase
            other = self.drive.displaced(self.knots, ahead, left, turned + turn)
            beside = self.expectation.at(other, self.rows, near[:1], near[:1]) - expected[:, :, :1]
            columns += [slopes[:, :, 1:] * self.hats[:, None], beside / turn]
        jacobian = np.concatenate(columns, axis=2)
        # the residual of each channel is its noise
        independent = min(1.0, 2.0 * drive.bandwidth / drive.rate)
        size = np.mean(miss**2, axis=0)
        pull = -self.precision @ at
        cost = independent * self.rows.size * float(np.log(size).sum()) - float(at @ pull)
        normal = self.precision.copy()
        for c, weight in enumerate(independent / size):
            normal += weight * jacobian[:, c].T @ jacobian[:, c]
            pull += weight * jacobian[:, c].T @ miss[:, c]
        wave = _shortest_wave(drive, float(np.median(np.abs(drive.speed[self.rows]))))
        limit = np.append(np.repeat([0.25 * wave, 0.5 * _ACROSS], k), _ACROSS / drive.twin.vehicle.wheelbase)
        step = np.linalg.solve(normal, pull)
        return cost, np.clip(step, -limit[: at.size], limit[: at.size])


def _normal(x: Floats, mean: Floats | float, variance: float) -> Floats:
    """Probabilities on a grid of a normal distribution, up to a factor."""
    return np.exp(-0.5 * (x - mean) ** 2 / variance)


def _transition(grid: Floats, covariance: Floats) -> Floats:
    """(s, s) probabilities of the next place, each row given one place now, of two with a joint normal prior."""
    gain = covariance[0, 1] / covariance[0, 0]
    variance = covariance[1, 1] - gain * covariance[0, 1]
    # a step is as wide as the grid is fine, at least
    spacing = grid[1] - grid[0] if grid.size > 1 else 1.0
    rows = _normal(grid[None, :], gain * grid[:, None], max(variance, (0.5 * spacing) ** 2))
    return np.asarray(rows / rows.sum(axis=1, keepdims=True))


def _scaled(probability: Floats) -> Floats:
    return np.asarray(probability / max(float(probability.sum()), 1e-300))
