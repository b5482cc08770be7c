# SPDX-License-Identifier: Apache-2.0
"""The live IMU path: message by message to bias-free, filtered signals in ``base_link`` axes."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.drive.units import ImuWindows, Units, rates_in_degrees, recognise_units
from suspension_twin.errors import InputError
from suspension_twin.signals.attitude import tilt_of, up_step
from suspension_twin.signals.checks import (
    FULL_SCALES,
    Finding,
    check_axes,
    check_rate,
    told,
)
from suspension_twin.signals.clock import LiveClock, Stamp
from suspension_twin.signals.filters import FilterSpec, filter_row, settle, steady_state
from suspension_twin.signals.imu import (
    MAX_TILT_DIFFERENCE,
    ImuReading,
    ImuSettings,
    is_still,
    standstill_filter_step,
)
from suspension_twin.signals.mounting_change import FILLED, QUIET, WINDOW, Windows, mounting_change
from suspension_twin.vehicle.twin import Place

__all__ = [
    "ImuIngest",
    "ImuSettings",
    "IngestOutput",
    "ingest_step",
]


@compiled
def ingest_step(
    turn: Floats,
    bias: Floats,
    up: Floats,
    up_bias: Floats,
    sos: Floats,
    zi: Floats,
    state: Floats,
    last: Floats,
    soft: Floats,
    block: Floats,
    raw: Floats,
    dt: float,
    missing: int,
    gravity: float,
    gain: float,
    removed: bool,
    restore: bool,
    out: Floats,
) -> None:  # pragma: no cover - compiled
    """One sample: ``turn`` (6, 3) scale and rotation, ``bias`` (6,) of force and rate,
    ``up_bias`` (3,) the attitude's own, ``last`` (12,) the row before and the filtered rate, ``soft`` (3, 6) and
    ``block`` (19,) the standstill window, ``out`` (21,). ``missing`` rows are interpolated into the filter; below 0
    it starts anew. Of a sensor that has ``removed`` gravity, gravity is put back if ``restore``."""
    row = np.empty(9)
    for k in range(3):
        f = 0.0
        w = 0.0
        for j in range(3):
            f += turn[k, j] * raw[j]
            w += turn[3 + k, j] * raw[3 + j]
        row[k] = f - bias[k]
        row[3 + k] = w - bias[3 + k]
    standstill_filter_step(soft, row[0:6], dt)
    block[0] += 1.0
    for k in range(6):
        block[1 + k] += row[k]
        off = soft[2, k] - block[13 + k]  # Welford's recurrence for the filtered signal's variance
        block[13 + k] += off / block[0]
        block[7 + k] += off * (soft[2, k] - block[13 + k])
    if removed:
        for k in range(3):
            row[6 + k] = row[k]
            if restore:
                row[k] += gravity * up[k]
    else:
        up_step(up, up_bias, row[0:3], row[3:6], dt, gravity, gain, 0.02)
        for k in range(3):
            row[6 + k] = row[k] - gravity * up[k]
    if missing < 0:
        settle(zi, state, row)
    else:
        between = np.empty(9)
        for m in range(missing):
            part = (m + 1.0) / (missing + 1.0)
            for k in range(9):
                between[k] = last[k] + part * (row[k] - last[k])
            filter_row(sos, state, between, out[0:9])
    filter_row(sos, state, row, out[0:9])
    for k in range(9):
        last[k] = row[k]
    for k in range(6):
        out[9 + k] = row[k]
    for k in range(3):
        out[15 + k] = up[k]
        out[18 + k] = 0.0 if missing < 0 or dt <= 0.0 else (out[3 + k] - last[9 + k]) / dt
        last[9 + k] = out[3 + k]


#: No sensor of a vehicle sends this much, in whatever unit.
ABSURD = 1.0e5
#: s of samples between two looks at their units, axes and mounting, and windows that a turn of the sensor is seen in.
_LOOK, _WINDOWS = 2.0, 120
#: s that a velocity counts, and by which two are apart whose change does.
_FRESH, _APART = 3.0, 0.5
#: Of a row of ``ingest_step``: specific force, acceleration and raw specific force.
_FORCES = [0, 1, 2, 6, 7, 8, 9, 10, 11]
Vector = tuple[float, float, float]


class IngestOutput(NamedTuple):
    """One sample, all vectors in ``base_link`` axes at the sensor's place.

    ``t`` s; ``force`` m/s² specific force, bias removed, filtered, gravity kept; ``rate`` rad/s, the same;
    ``acceleration`` m/s² the filtered force without gravity; ``raw_force`` and ``raw_rate`` unfiltered,
    bias removed; ``up`` the unit vector opposite to gravity; ``angular_acceleration`` rad/s², the change of the
    filtered rate since the sample before, 0 after a pause.
    """

    t: float
    force: Vector
    rate: Vector
    acceleration: Vector
    raw_force: Vector
    raw_rate: Vector
    up: Vector
    angular_acceleration: Vector

    @property
    def vertical_acceleration(self) -> float:
        """m/s², filtered, gravity removed."""
        return self.acceleration[2]


class ImuIngest:
    """Feed it every message with :meth:`push`; it never raises on one.

    Nothing comes out until the sample rate is known (17 samples). A stamp that is set back (a
    looped bag) resets everything; one that is a little late or repeated is dropped; a pause restarts
    the filter. ``findings`` are the present faults, ``counts`` those of samples.
    """

    def __init__(self, settings: ImuSettings, place: Place) -> None:
        self.settings = settings
        self.place = place
        self._clock = LiveClock()
        self.reset()

    @property
    def rate(self) -> float | None:
        """Measured sample rate in Hz, None until it is known."""
        return self._clock.rate

    @property
    def standing(self) -> bool:
        """Whether the vehicle stands by the last full window."""
        return self._still_blocks >= 2

    @property
    def findings(self) -> list[Finding]:
        """Present faults, worst first."""
        order = {"error": 0, "warn": 1, "ok": 2}
        found = list(self._findings.values())
        lost = self.counts["invalid"]
        if lost:
            found.append(
                Finding("warn", "invalid", f"{lost} messages with NaN or without a stamp were dropped")
            )
        if self.counts["saturated"]:
            text = f"{self.counts['saturated']} samples sit at the end of the range: set a larger range"
            found.append(Finding("warn", "saturated", text))
        return sorted(told(found), key=lambda f: order[f.level])

    def reset(self) -> None:
        """Forget everything, as at the start."""
        self._clock.reset()
        self.counts: Counter[str] = Counter()
        self._findings: dict[str, Finding] = {}
        self._pending: list[tuple[float, ...]] = []
        self._window: list[tuple[float, ...]] = []
        self._unit_mismatches = 0
        self._begin = math.nan
        # stamp, mean force and share of quiet samples of windows, and the one under way
        self._gravity: deque[tuple[float, ...]] = deque(maxlen=_WINDOWS)
        self._under_way: list[tuple[float, ...]] = []
        self._seconds: deque[tuple[float, ...]] = deque(
            maxlen=_WINDOWS
        )  # stamp, mean sample and largest rate
        self._velocity = (-math.inf, 0.0, 0.0)
        self._quiet = False
        self._reading = ImuReading(self.settings, self.place, self.settings.latitude)
        self._up_bias = np.zeros(3)
        self._up = np.array([0.0, 0.0, 1.0])
        self._last = np.zeros(12)
        self._last_t = math.nan
        self._block = np.zeros(19)
        self._soft = np.zeros((3, 6))
        self._quiet_blocks = 0
        self._still_blocks = 0
        self._rest_count = 0.0
        self._rest_mean = np.zeros(6)
        self._pending_rest = np.zeros(6)
        self._designed = math.nan
        self._turn = np.empty((6, 3))
        self._update_turn()

    def push(self, t: float, force: Sequence[float], rate: Sequence[float]) -> IngestOutput | None:
        """One message: ``t`` s, ``force`` (3,) and ``rate`` (3,) in the sensor's axes as they were sent.

        None while the rate is not known, and for a message that was dropped.
        """
        try:
            sample = (*map(float, force), *map(float, rate))
            usable = len(sample) == 6 and all(abs(value) < ABSURD for value in sample)
            stamp = self._clock.classify(float(t)) if usable else Stamp.INVALID
        except (TypeError, ValueError):
            usable, stamp = False, Stamp.INVALID
        if stamp is Stamp.JUMP_BACK:
            self.reset()
            self.counts["resets"] += 1
            self._clock.classify(t)
            stamp = Stamp.FIRST
        if not usable or stamp in (Stamp.INVALID, Stamp.LATE, Stamp.DUPLICATE):
            self.counts[stamp.value if usable else "invalid"] += 1
            return None
        self.counts["samples"] += 1
        if self._is_clipped(sample):
            self.counts["saturated"] += 1
        rate_hz = self._clock.rate
        if rate_hz is None:
            if stamp is Stamp.GAP:
                self._pending.clear()
            self._pending.append((t, *sample))
            return None
        if self._pending:
            waiting, self._pending = self._pending, []
            self._start(np.array([*waiting, (t, *sample)]))
            out = None
            for row in waiting:
                self._advance(row[0], row[1:], False)
        if abs(rate_hz / self._designed - 1.0) > 0.03:
            self._design(rate_hz)
        out = self._advance(t, sample, stamp is Stamp.GAP)
        self._window.append(sample)
        self._under_way.append((t, *sample, self._quiet and t - self._velocity[0] < _FRESH))
        if t - self._under_way[0][0] >= WINDOW:
            self._end_gravity()
        if len(self._window) >= _LOOK * rate_hz:
            self._look_at_window()
        return out

    def heed_velocity(self, t: float, east: float, north: float) -> None:
        """One velocity of the receiver at ``t`` s in m/s: it shows whether the sensor feels gravity alone."""
        before, x, y = self._velocity
        if not t - before >= _APART:
            return
        self._quiet = math.hypot(east - x, north - y) < QUIET * (t - before) < QUIET * _FRESH
        self._velocity = t, east, north

    def _is_clipped(self, sample: tuple[float, ...]) -> bool:
        largest = max(abs(sample[0]), abs(sample[1]), abs(sample[2])) * self._reading.scale
        if self.settings.full_scale is not None:
            if largest >= 0.999 * self.settings.full_scale:
                return True
        elif largest > 19.0 and any(abs(largest / full - 1.0) < 5e-4 for full in FULL_SCALES):
            return True
        full = self.settings.full_scale_rate
        return full is not None and max(abs(sample[3]), abs(sample[4]), abs(sample[5])) >= 0.999 * full

    def _advance(self, t: float, sample: tuple[float, ...], gap: bool) -> IngestOutput:
        dt = t - self._last_t
        missing = 0
        if gap or not math.isfinite(dt):
            missing = -1
            if gap:
                self.counts["gaps"] += 1
                self._block[:] = 0.0
                self._still_blocks = 0
            dt = min(dt, 0.5) if math.isfinite(dt) else 0.0
        elif dt > 1.5 / self._designed:
            missing = round(dt * self._designed) - 1
            self.counts["missing"] += missing
        self._last_t = t
        out = np.empty(21)
        gain = (10.0 if self._still_blocks >= 2 else 1.0) / self.settings.attitude_time
        ingest_step(
            self._turn,
            self._reading.bias,
            self._up,
            self._up_bias,
            self._sos,
            self._zi,
            self._state,
            self._last,
            self._soft,
            self._block,
            np.array(sample),
            dt,
            missing,
            self._reading.gravity,
            gain,
            self._reading.removed,
            self.settings.restore_gravity,
            out,
        )
        if self._block[0] >= self._block_size:
            self._end_block()
        if self._reading.unit != 1.0:  # a sensor in g that is to be left so
            out[_FORCES] /= self._reading.unit
        v = out.tolist()
        vectors = zip(v[::3], v[1::3], v[2::3], strict=True)
        return IngestOutput(t, *vectors)

    def _note(self, code: str, finding: Finding | None) -> None:
        for known in [k for k in self._findings if k.split(".")[0] == code]:
            del self._findings[known]
        if finding is not None:
            self._findings[f"{code}.{finding.code}"] = finding

    def _design(self, rate_hz: float) -> None:
        """Filter sections for the measured rate; a cut-off that it cannot carry is lowered, with a finding."""
        spec, note = self.settings.filter, None
        try:
            self._sos = spec.sections(rate_hz)
        except InputError as error:
            cutoff = 0.4 * rate_hz
            self._sos = FilterSpec(spec.order, cutoff).sections(rate_hz)
            note = Finding("error", "cutoff", f"{error}; filtering at {cutoff:.3g} Hz meanwhile")
        self._note("cutoff", note)
        self._note("rate", check_rate(rate_hz))
        self._zi = steady_state(self._sos)
        self._state = np.zeros((self._sos.shape[0], 2, 9))
        if math.isfinite(self._designed):
            settle(self._zi, self._state, self._last[:9])
        self._designed = rate_hz
        self._block_size = max(round(self.settings.still.window * rate_hz), 8)

    def _start(self, rows: Floats) -> None:
        """The rate is known: look at the first samples, then run."""
        assert self._clock.rate is not None
        self._begin = float(rows[0, 0])
        self._design(self._clock.rate)
        self._set_units(recognise_units(rows[:, 1:4]), rows[:, 1:4])
        body = rows[:, 1:4] @ self._turn[:3].T
        rates = rows[:, 4:7] @ self._turn[3:].T
        turn = float(np.abs(rates.mean(axis=0)).max())
        still = is_still(
            float(body.std(axis=0).max()), float(rates.std(axis=0).max()), turn, self.settings.still
        )
        mean = body.mean(axis=0)
        # a bump does not show the mounting, and what a bend shows of it is no small tilt
        if abs(float(np.linalg.norm(mean)) / self._reading.gravity - 1.0) < 0.2 and (
            still or tilt_of(mean) > math.pi / 4
        ):
            self._check_level(mean)
            body = rows[:, 1:4] @ self._turn[:3].T
            rates = rows[:, 4:7] @ self._turn[3:].T
        if still:
            self._learn_rest(np.concatenate([body.mean(axis=0), rates.mean(axis=0)]), 1.0)
        if not self._reading.removed:
            first = body.mean(axis=0) - self._reading.bias[:3]
            length = float(np.linalg.norm(first))
            if length > 1.0:
                self._up = first / length
        self._soft[:] = np.concatenate([body[0], rates[0]]) - self._reading.bias
        self._block[:] = 0.0

    def _set_units(self, units: Units, force: Floats) -> None:
        self._note("units", self._reading.take_units(units, force))
        if self._reading.removed:
            self._up[:] = (0.0, 0.0, 1.0)
        self._update_turn()

    def _update_turn(self) -> None:
        rotation = self._reading.level @ self._reading.mounting
        self._turn[:3] = self._reading.scale * rotation
        self._turn[3:] = self._reading.rate_scale * rotation

    def _check_level(self, mean: Floats) -> bool:
        """``mean`` (3,) is the specific force at rest in today's axes; True if they were turned for it."""
        self._note("mounting", self._reading.check_level(mean))
        turn = self._reading.take_level(mean)
        if turn is None:
            return False
        self._update_turn()
        self._gravity.clear()
        self._up[:] = turn @ self._up
        self._up_bias[:] = 0.0
        self._rest_count = 0.0
        return True

    def _learn_rest(self, mean: Floats, weight: float) -> None:
        """Take ``mean`` (6,) of a standing window into the biases; all standstills count alike."""
        self._rest_count += weight
        self._rest_mean += (mean - self._rest_mean) * (weight / self._rest_count)
        self._reading.take_rest(self._rest_mean[:3], self._rest_mean[3:])
        self._up_bias[:] = 0.0

    def _end_block(self) -> None:
        """A standstill window is full: judge it. Biases learn from the one before it, which surely
        holds no moving off."""
        n = self._block[0]
        rest = self._block[1:7] / n + self._reading.bias
        std = np.sqrt(self._block[7:13] / n)
        limits = self.settings.still
        force_std, rate_std, turn = float(std[:3].max()), float(std[3:].max()), float(np.abs(rest[3:]).max())
        still = is_still(force_std, rate_std, turn, limits)
        # Constant acceleration looks like standstill, but the force is tilted against the vertical that the gyro
        # gives. With an unknown gyro bias that vertical drifts: three very quiet seconds count all the same.
        tilt = float(np.linalg.norm((self._block[1:3] / n) / self._reading.gravity - self._up[:2]))
        very_quiet = still and force_std < 0.5 * limits.force and rate_std < 0.5 * limits.rate
        self._quiet_blocks = self._quiet_blocks + 1 if very_quiet and tilt < 0.1 else 0
        if not self._reading.removed and tilt > MAX_TILT_DIFFERENCE:
            still = self._quiet_blocks * limits.window >= 3.0
        if not still:
            self._still_blocks = 0
        else:
            self._still_blocks += 1
            if self._still_blocks >= 2:
                if self._check_level(self._pending_rest[:3]):
                    self._still_blocks = 0  # what was gathered is in the old axes
                else:
                    self._learn_rest(self._pending_rest, n)
            self._pending_rest = rest
        self._block[:] = 0.0

    def _look_at_window(self) -> None:
        """Every two seconds: are the units still what they seemed, is an axis dead?"""
        rows = np.array(self._window)
        self._window.clear()
        dead = check_axes(rows[:, :3], rows[:, 3:])
        self._note("axes", dead[0] if dead else None)
        units = recognise_units(rows[:, :3])
        self._unit_mismatches = (
            self._unit_mismatches + 1 if units != self._reading.units and units != "unknown" else 0
        )
        if self._unit_mismatches >= 2:
            self._set_units(units, rows[:, :3])
            self._reading.bias[:] = self._up_bias[:] = 0.0
            self._rest_count = 0.0
            self._unit_mismatches = 0
            self._gravity.clear()

    def _end_gravity(self) -> None:
        """A second is full: do the rates come in degrees, has the sensor turned in its holder?"""
        rows = np.array(self._under_way)
        self._under_way.clear()
        quiet = rows[:, 7] > 0
        self._seconds.append(
            (*rows.mean(axis=0)[:7].tolist(), float(np.linalg.norm(rows[:, 4:7], axis=1).max()))
        )
        felt = rows[quiet] if quiet.mean() >= FILLED else rows
        self._gravity.append(tuple(felt.mean(axis=0)[[0, 1, 2, 3, 7]].tolist()))
        if self._reading.rate_scale == 1.0:
            self._look_for_degrees()
        if not self._reading.removed:
            self._look_for_turn(felt[:, 1:4].mean(axis=0))

    def _look_for_degrees(self) -> None:
        seconds = np.array(self._seconds)
        force = self._reading.scale * seconds[:, 1:4]
        evidence = rates_in_degrees(ImuWindows(seconds[:, 0], force, seconds[:, 4:7], seconds[:, 7]))
        self._note("degrees", self._reading.take_rate_units(evidence))
        if self._reading.rate_scale != 1.0:
            self._start_over(seconds[-1, 1:4])

    def _look_for_turn(self, force: Floats) -> None:
        """Turn the axes back where the sensor has turned; ``force`` (3,) is the mean of the last second."""
        windows = np.array(self._gravity)
        change = None
        for blind, chosen in ((False, windows[windows[:, 4] == 1.0]), (True, windows)):
            change = change or mounting_change(Windows(chosen[:, 0], chosen[:, 1:4], blind=blind))
        if change is None:
            return
        self._note("turned", change.finding(0.5 * (change.last + change.first), self._begin))
        self._gravity.clear()
        if not change.slow:
            self._reading.mounting = self._reading.mounting @ change.turn
            self._start_over(force)

    def _start_over(self, force: Floats) -> None:
        """Forget biases and the vertical, which were learnt in other axes or units: it is that of ``force`` (3,)."""
        self._update_turn()
        self._reading.bias[:] = self._up_bias[:] = 0.0
        self._rest_count = 0.0
        up = self._turn[:3] @ force
        if not self._reading.removed:
            self._up[:] = up / max(float(np.linalg.norm(up)), 1e-9)
