# SPDX-License-Identifier: Apache-2.0
"""``fmu``: a vehicle that an FMU for co-simulation simulates, whatever program made it.

The FMU gets road heights under four wheels and planar accelerations, and gives the motion of the body, deflections and
tyre loads (:mod:`~suspension_twin.models.connectors`). In each communication step an input is held at its mean over the
step, or given with its derivative where the FMU takes that (FMI 2.0). Heights are handed over less their mean at the
start, so that no FMU has to begin at the height of a map, and added to what it gives back. What an FMU does not give is
computed of what it gives: the sensor's readings by the kinematics of ``models.sensor`` at ``imu.position``, the height
of ``base_link``, wheels from body and deflections, rates of deflections as differences.

A candidate is a set of parameters of the FMU. Each has an instance of its own; effects act on road, sensor and clock.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Final

import numpy as np

from suspension_twin.addons.fmu.slave import Connected, Slave, connected
from suspension_twin.addons.fmu.twin import FmuTwin
from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import WorkError
from suspension_twin.models import rows
from suspension_twin.models.candidate_road import candidate_heights, wheel_paths_of
from suspension_twin.models.car import CHANNELS
from suspension_twin.models.connectors import OUTPUTS, inputs_of, motion_between
from suspension_twin.models.constants import Conditions, Outside, outside
from suspension_twin.models.excitation import MAX_STEP
from suspension_twin.models.live import Following
from suspension_twin.models.parameters import ParameterLayout, layout, pack
from suspension_twin.models.registry import Model
from suspension_twin.models.rows import WIDTH
from suspension_twin.models.sensor import sense
from suspension_twin.models.sensor_chain import pass_chain
from suspension_twin.models.simulate import CAR_SIGNALS, cores, sensed_response, share_out
from suspension_twin.models.types import Excitation, HeightField, Ints, LaneResponse, Response
from suspension_twin.vehicle.twin import Twin

__all__ = ["MODEL", "Body", "LiveFmu"]


_NAMES: Final = tuple(v.name for v in OUTPUTS)
_PLACE: Final = ("imu.position.0", "imu.position.1", "imu.position.2")
_WHEELBASE: Final = ("vehicle.wheelbase", "vehicle.front_track", "vehicle.rear_track")
_HEIGHTS: Final = (0, 3, 4, 5, 6, 7)  # columns of OUTPUTS that count from the height 0 of the map
_SIGNALS: Final = slice(20, 27)


def _numbers(twin: Twin) -> Sequence[str]:
    assert isinstance(twin, FmuTwin)
    keys = [f"fmu.parameters.{name}.value" for name in twin.fmu.parameters]
    return (*(() if connected(twin.fmu).sensor else _PLACE), "imu.latency", *keys)


class Body:
    """The FMU of a twin, and the points of its body: the same for all candidates."""

    def __init__(self, twin: Twin) -> None:
        assert isinstance(twin, FmuTwin)
        self.fmu: Connected = connected(twin.fmu)
        self.step, self.settle = float(twin.fmu.step), float(twin.fmu.settle)
        vehicle = twin.vehicle
        self.height = float(vehicle.cog[2])
        self.sprung = np.array(vehicle.sprung_cog or vehicle.cog)
        self.radius = float(vehicle.tyre.radius)
        self.place = np.array(twin.imu.position)
        self.wheels = vehicle.wheel_positions
        self.rest = np.repeat(vehicle.static_deflection, 2)
        self.has = np.zeros(len(OUTPUTS), dtype=np.bool_)
        self.has[list(self.fmu.outputs)] = True
        #: columns that the FMU counts from the height of its start
        self.heights = [column for column in _HEIGHTS if self.has[column]]

    def start(self, parameters: Floats, inputs: Floats) -> Slave:
        """A running instance with ``parameters`` in the order of the twin file, at ``inputs`` (10,)."""
        return Slave(self.fmu, parameters, inputs, self.settle, self.step)

    def complete(self, out: Floats, inputs: Floats, dt: Floats, before: Floats, place: Floats) -> None:
        """Fill in ``out`` (n, outputs), in place, what the FMU does not give.

        ``inputs`` (n, 10) at the same stamps, which are ``dt`` (n,) s apart, 0 at fresh starts; ``before`` (outputs,)
        is the row before the first. ``place`` (3,) m is where the sensor is.
        """
        has, roll, pitch = self.has, out[:, 1], out[:, 2]
        if not has[3]:
            x, y, z = self.sprung
            above = np.cos(pitch) * (np.sin(roll) * y + np.cos(roll) * z) - np.sin(pitch) * x
            out[:, 3] = out[:, 0] + z - above
        for c in range(4):
            if not has[4 + c]:
                x, y = self.wheels[c] - self.sprung[:2]
                travel = out[:, 8 + c] - self.rest[c]
                out[:, 4 + c] = out[:, 0] + y * roll - x * pitch + travel + self.radius
            if not has[12 + c]:
                change = np.diff(out[:, 8 + c], prepend=before[8 + c])
                out[:, 12 + c] = np.divide(change, dt, out=np.zeros_like(dt), where=dt > 0)
        if not self.fmu.sensor:
            _sense(out, inputs, self.sprung, self.height, place)
        elif not has[25] or not has[26]:
            read = out[:, 20:26].copy()
            _sense(out, inputs, self.sprung, self.height, place)
            out[:, 20:25] = read[:, :5]
            if has[25]:
                out[:, 25] = read[:, 5]
            if not has[26]:
                out[:, 26] += read[:, 2] - out[:, 22]


@compiled
def _sense(out: Floats, inputs: Floats, sprung: Floats, height: float, place: Floats) -> None:
    """Fill in the sensor's readings (columns 20 to 26) of ``out`` from the motion of the body."""
    w = np.zeros(rows.CURVES * WIDTH)
    for i in range(3):
        w[(rows.SENSOR + i) * WIDTH] = place[i]
        w[(rows.SPRUNG + i) * WIDTH] = sprung[i]
    w[rows.HEIGHT * WIDTH] = height
    for k in range(out.shape[0]):
        roll, pitch, yaw = out[k, 1], out[k, 2], inputs[k, 6]
        w[rows.ROLL * WIDTH], w[rows.PITCH * WIDTH] = roll, pitch
        # rates of the angles from those about the body's axes
        w[rows.ROLL_RATE * WIDTH] = out[k, 23] + yaw * np.sin(pitch)
        w[rows.PITCH_RATE * WIDTH] = (out[k, 24] - yaw * np.cos(pitch) * np.sin(roll)) / np.cos(roll)
        for i in range(3):
            w[(rows.ACCELERATION + i) * WIDTH] = out[k, 27 + i]
        sense(w, 0, inputs[k, 4], inputs[k, 5], yaw, inputs[k, 7])
        for q in range(7):
            out[k, 20 + q] = w[(rows.SIGNAL + q) * WIDTH]


def communication_steps(
    inputs: Floats, n: int, h: float, longest: float, sloped: bool
) -> tuple[Floats, Floats | None, Floats]:
    """Steps of one interval of n parts of h s: inputs (m, 10) held in each, slopes (m, 10) 1/s, lengths (m,) s.

    ``inputs`` (n + 1, 10) at the ends of its parts. With slopes the inputs are those at the beginnings.
    """
    parts = max(1, min(n, int(longest / h + 1e-6))) if h > 0 else 1
    cuts = np.append(np.arange(0, n, parts), n)
    first, last = cuts[:-1], cuts[1:]
    count = last - first
    dt = count * h
    if sloped:
        return inputs[first], (inputs[last] - inputs[first]) / dt[:, None], dt
    if parts == 1:
        return 0.5 * (inputs[:-1] + inputs[1:]), None, dt
    total = np.vstack([np.zeros(inputs.shape[1]), np.cumsum(0.5 * (inputs[:-1] + inputs[1:]), axis=0)])
    return (total[last] - total[first]) / count[:, None], None, dt


def _whole(
    driven: Excitation, inputs: Floats, longest: float, sloped: bool
) -> tuple[Floats, Floats | None, Floats, Ints]:
    """Communication steps of a whole drive, and (n + 1,) the first of each interval; none before a fresh start."""
    held, slopes, lengths, first = [], [], [], [0]
    for k, (n, h) in enumerate(zip(driven.substeps.tolist(), driven.step.tolist(), strict=True)):
        if n:
            row = int(driven.first[k])
            a, b, c = communication_steps(inputs[row - 1 : row + n], n, h, longest, sloped)
            held.append(a)
            lengths.append(c)
            if b is not None:
                slopes.append(b)
        first.append(first[-1] + (len(lengths[-1]) if n else 0))
    if not held:
        return np.zeros((0, 10)), None, np.zeros(0), np.array(first)
    return np.vstack(held), np.vstack(slopes) if sloped else None, np.concatenate(lengths), np.array(first)


class _Run:
    """One candidate over a drive: an instance of the FMU from every fresh start on."""

    def __init__(self, body: Body, driven: Excitation, road: Floats) -> None:
        self.body, self.driven = body, driven
        self.inputs = inputs_of(driven, road)
        self.last = self.inputs[driven.first[1:] - 1]
        fresh = np.flatnonzero(driven.substeps == 0)
        starts = np.append(fresh, len(driven))
        self.spans = list(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True))
        #: (n,) m the height that each stamp's inputs are given less
        self.base = np.repeat(self.last[fresh, :4].mean(axis=1), np.diff(starts))
        lowered = self.inputs.copy()
        lowered[:, :4] -= np.repeat(self.base, np.maximum(driven.substeps, 1))[:, None]
        self.lowered = lowered
        self.steps = _whole(driven, lowered, body.step, body.fmu.sloped)

    def outputs(self, parameters: Floats, place: Floats) -> Floats:
        """(n, outputs) at the stamps; raises WorkError where the FMU fails."""
        body, driven = self.body, self.driven
        held, slopes, lengths, first = self.steps
        out = np.zeros((len(driven), len(OUTPUTS)))
        columns = list(body.fmu.outputs)
        for begin, end in self.spans:
            slave = body.start(parameters, self.lowered[int(driven.first[begin])])
            try:
                part = slice(int(first[begin]), int(first[end]))
                steps = held[part], None if slopes is None else slopes[part], lengths[part]
                ends = self.lowered[driven.first[begin + 1 : end + 1] - 1]
                out[begin:end, columns] = slave.walk(*steps, first[begin : end + 1] - first[begin], ends)
            except WorkError as error:
                raise WorkError(f"{error}, {driven.t[begin]:.3f} s on the drive's clock") from None
            finally:
                slave.close()
        if not np.isfinite(out).all():
            k, column = np.argwhere(~np.isfinite(out))[0]
            raise WorkError(f"{body.fmu.name}: {_NAMES[column]} is not finite at t = {driven.t[k]:.3f} s")
        out[:, body.heights] += self.base[:, None]
        dt = np.where(driven.substeps > 0, np.diff(driven.t, prepend=driven.t[0]), 0.0)
        body.complete(out, self.last, dt, out[0], place)
        return out


def _road(known: Outside, driven: Excitation, lane: int, strict: bool) -> Floats:
    """(m, 4) m heights that one candidate sees."""
    if known.road is None:
        return driven.road
    whole = wheel_paths_of(driven).stretch(driven.road, slice(0, driven.road.shape[0]))
    return candidate_heights(whole, known.road, lane, 1, strict)[0]


def numbers_and_place(shape: ParameterLayout, params: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Parameters of the FMU (k, L) and the sensor's place (3, L) of candidates (P, L)."""
    keys = [row for name, row in shape.index.items() if name.startswith("fmu.parameters.")]
    if _PLACE[0] in shape.index:
        return params[keys], params[[shape.index[name] for name in _PLACE]]
    return params[keys], np.repeat(place[:, None], params.shape[1], axis=1)


def _lanes(
    twin: Twin,
    params: Floats,
    excitation: Excitation,
    threads: int | None = None,
    *,
    vertical_only: bool = False,
    fused: bool = False,
) -> LaneResponse:
    body, shape = Body(twin), layout(twin)
    known = outside(params, shape, Conditions.of(excitation, fused))
    numbers, places = numbers_and_place(shape, params, body.place)
    count = params.shape[1]
    signals = np.zeros((len(excitation), 7, count))
    failed = known.problems.lanes
    shared = _Run(body, excitation, excitation.road) if known.road is None else None

    def one(lane: int, _: int) -> None:
        if failed[lane]:
            return
        try:
            run = shared or _Run(body, excitation, _road(known, excitation, lane, strict=False))
            if np.isfinite(run.inputs).all():
                signals[:, :, lane] = run.outputs(numbers[:, lane], places[:, lane])[:, _SIGNALS]
                return
        except WorkError:
            pass
        failed[lane] = True

    workers = 1 if body.fmu.single else min(threads or cores(), count)
    share_out(one, [(lane, lane + 1) for lane in range(count)], workers)
    if known.reads_otherwise:
        pass_chain(known, excitation, signals)
    failed |= ~np.isfinite(signals).all(axis=(0, 1))
    signals[:, :, failed] = 0.0
    if vertical_only:
        return LaneResponse(excitation.t, CAR_SIGNALS[-1:], signals[:, -1:], failed)
    return LaneResponse(excitation.t, CAR_SIGNALS, signals, failed)


def _respond(twin: Twin, excitation: Excitation) -> Response:
    body, shape, params = Body(twin), layout(twin), pack(twin)[:, None]
    known = outside(params, shape, Conditions.of(excitation))
    known.problems.raise_first()
    numbers, places = numbers_and_place(shape, params, body.place)
    run = _Run(body, excitation, _road(known, excitation, 0, strict=True))
    out = run.outputs(numbers[:, 0], places[:, 0])
    absent = [27 + i for i in range(7) if not body.has[27 + i]]
    moved = np.column_stack([out[:, :3], out[:, 4:8]])
    if absent and len(excitation) > 2:  # differences, where it does not say
        second = np.gradient(np.gradient(moved, excitation.t, axis=0), excitation.t, axis=0)
        out[:, absent] = second[:, [i - 27 for i in absent]]
    return sensed_response(known, excitation, out)


class LiveFmu(Following):
    """A twin whose vehicle is an FMU; see :class:`~suspension_twin.models.live.Following`.

    Raises InputError for a twin or an FMU that cannot be used, WorkError where it does not start on level ground.
    """

    def __init__(self, twin: Twin, road: HeightField, max_step: float = MAX_STEP) -> None:
        params, shape = pack(twin)[:, None], layout(twin)
        self._body = Body(twin)
        numbers, place = numbers_and_place(shape, params, self._body.place)
        self._numbers, self._place = numbers[:, 0], place[:, 0]
        self._slave: Slave | None = None
        self._out, self._before = np.zeros((1, len(OUTPUTS))), np.zeros(len(OUTPUTS))
        self._inputs = np.zeros(10)
        self._base = 0.0
        self._body.start(self._numbers, self._inputs).close()  # what is wrong with it is said now
        super().__init__(twin, road, outside(params, shape, Conditions(max_step)), max_step)

    def _restart(self) -> None:
        if self._slave is not None:
            self._end()
        self._slave = None

    def _advance(self, seen: Floats) -> bool:
        body, n = self._body, int(self._count[1])
        inputs = np.empty((len(seen) + 1, 10))
        try:
            if n == 0 or self._slave is None:
                self._restart()
                self._base = float(seen[-1].mean())
                inputs = self._between(seen[-1:], 0)
                slave = self._slave = body.start(self._numbers, inputs[-1])
                self._end = weakref.finalize(self, slave.close)
                steps: tuple[Floats, Floats | None, Floats] = inputs[:0], None, np.zeros(0)
            else:
                slave = self._slave
                inputs = np.vstack([self._inputs, self._between(seen, n)])
                h = float(self._motion[1, 0])
                steps = communication_steps(inputs, n, h, body.step, body.fmu.sloped)
            row = slave.walk(*steps, np.array([0, len(steps[2])]), inputs[-1:])[0]
        except WorkError as error:
            self._failure = f"{error}: "
            self._restart()
            return False
        self._before[:] = self._out[0]
        self._inputs = inputs[-1]
        if not np.isfinite(row).all():
            self._failure = f"{body.fmu.name} gives what is not finite: "
            return False
        self._out[0, list(body.fmu.outputs)] = row
        return True

    def _between(self, seen: Floats, n: int) -> Floats:
        """(rows, 10) inputs at the ends of the parts of the interval."""
        share = np.arange(1, len(seen) + 1)[:, None] / len(seen)
        before, after = self._motion[[0 if n else 1], 1:7], self._motion[1:, 1:7]
        return np.hstack([seen - self._base, motion_between(before, after, share)])

    def _row(self) -> Floats:
        out, body = self._out.copy(), self._body
        inputs = self._inputs.copy()
        inputs[:4] += self._base
        n = int(self._count[1])
        out[:, body.heights] += self._base
        body.complete(out, inputs[None], np.array([n * self._motion[1, 0]]), self._before, self._place)
        row: Floats = out[0]
        return row


MODEL = Model(
    name="fmu",
    title="a vehicle simulated by an FMU of any program",
    recordings="drive",
    channels=CHANNELS,
    numbers=_numbers,
    lanes=_lanes,
    fixed=_WHEELBASE,
    respond=_respond,
    live=LiveFmu,
    opaque=True,
)
