# SPDX-License-Identifier: Apache-2.0
"""How much of an effect no recalibration absorbs, in units of the floor; and the amount that gives so much.

In the reality's own terms: the change of the felt signals that an amount makes is projected off what
springs, dampers, inertias, tyres, wheel masses and constant biases could change (finite differences of
the same reality, least squares). The floor of a channel is what stays of the background after the same
projection, together with the sensor's noise. Severity is the largest ratio over the six channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from blind import newton, phone
from blind.faults import OF_THE_CLOCK, OF_THE_ROAD, WIDE_OUTSIDE, Null, knob, surveyed
from blind.newton import Faults
from blind.world import DAMPER_N, DAMPER_REACH, Car, Floats, Strut, World, plain

AMOUNTS = np.geomspace(0.01, 1.0, 6)
DRIVE = "drive_fast"
CHANNELS = ("vertical", "roll_rate", "pitch_rate", "longitudinal", "lateral", "yaw_rate")
_COLUMNS = (2, 3, 4, 0, 1, 5)
_HATS = (0.04, 0.12, 0.28, 0.6)  # m/s, where a damper's characteristic may be changed
_RIDGE = 2.0  # relative changes beyond this are no recalibration


@dataclass(frozen=True, eq=False)
class Scale:
    """A world's yardstick: ``floor`` (6,), the directions of recalibration and the null drive."""

    floor: Floats
    directions: Floats  # (6 m, k), in floors
    null: Null
    felt: phone.Felt
    base: Faults

    def severity(self, change: Floats, channels: int = 6) -> float:
        """Largest channel rms of (m, 6) over its floor after projection, of the first ``channels``."""
        return float(np.max(np.sqrt(np.mean(self.left(change) ** 2, axis=0))[:channels]))

    def left(self, change: Floats) -> Floats:
        """(m, 6) in floors: what recalibration leaves of a change."""
        scaled = (change / self.floor).T.ravel()
        return _project(self.directions, scaled).reshape(6, -1).T


def _project(directions: Floats, d: Floats) -> Floats:
    gram = directions.T @ directions
    gram[np.diag_indices_from(gram)] += d.size / 6 * 1e-3 / _RIDGE**2
    return np.asarray(d - directions @ np.linalg.solve(gram, directions.T @ d))


def signals(felt: phone.Felt, shift: Floats | float = 0.0) -> Floats:
    """(m, 6) at 100 Hz through a zero-phase low-pass of 20 Hz, from a second before the car moves."""
    rate = 1.0 / float(felt.t[1] - felt.t[0])
    sos = butter(4, 20.0, fs=rate, output="sos")
    both = np.hstack([felt.force, felt.rate])[:, _COLUMNS]
    if np.any(shift != 0.0):
        both = CubicSpline(felt.t, both)(np.clip(felt.t - shift, 0.0, felt.t[-1]))
    return np.asarray(sosfiltfilt(sos, both, axis=0)[round(2.5 * rate) :: round(rate / 100.0)])


def delay(faults: Faults, t: Floats) -> Floats:
    """(n,) s by which stamps are late."""
    own = faults.get("time_offset", {}).get("offset", 0.0)
    late = own + 1e-6 * faults.get("clock_drift", {}).get("drift_ppm", 0.0) * t
    if "compressed_time" in faults:
        late = late - phone.lost_time(faults["compressed_time"], t, 1)[0]
    return np.asarray(late)


def _step(faults: Faults) -> float:
    """s: twice the usual where nothing stiff is in the way."""
    quick = {
        "top_mount",
        "loose_ball_joint",
        "unsprung_mass",
        "loose_mass",
        "flat_spot",
        "semi_active_damper",
    }
    return 1e-3 if quick & set(faults) else 2e-3


def change(world: World, scale: Scale, faults: Faults) -> Floats:
    """(m, 6) what faults change in the fast drive, against the plain car."""
    road = {k: v for k, v in faults.items() if k in OF_THE_ROAD}
    moves = {k: v for k, v in faults.items() if k not in OF_THE_ROAD and k not in OF_THE_CLOCK}
    even = plain(world)
    if road:
        even = plain(replace(world, survey=surveyed(world, road)))
    if road or moves:
        motion = newton.run(even, world.plans[DRIVE], {**scale.base, **moves}, _step(moves))
        moved = phone.felt(motion, world.phone, moves, ideal=True)
    else:
        moved = scale.felt
    return signals(moved, delay(faults, moved.t)) - signals(scale.felt)


def yardstick(world: World, msd: bool = False) -> Scale:
    """Measure a world; ``msd`` for a twin without wheels of its own."""
    base: Faults = {"unsprung_mass": {"share": 0.12}} if msd else {}
    even, drive = plain(world), world.plans[DRIVE]
    motion = newton.run(even, drive, base, _step(base))
    felt = phone.felt(motion, world.phone, {}, ideal=True)
    reference = signals(felt)
    columns = []
    for car, step in _neighbours(even.car, msd):
        other = newton.run(replace(even, car=car), drive, base, _step(base))
        columns.append((signals(phone.felt(other, world.phone, {}, ideal=True)) - reference) / step)
    real = signals(phone.felt(newton.run(world, drive, base), world.phone, {}), -phone.DELAY)
    noise = np.sqrt(0.4) * np.array([world.phone.force_noise] + [world.phone.rate_noise] * 5)
    noise[3:5] = np.sqrt(0.4) * world.phone.force_noise
    floor = np.std(real - reference, axis=0) + noise
    m = reference.shape[0]
    for _ in range(2):  # the projection weighs by the floor, which the projection lowers
        directions = np.stack([(c / floor).T.ravel() for c in columns], axis=1)
        biases = np.kron(np.eye(6), np.ones((m, 1)))
        directions = np.hstack([directions, biases])
        rest = _project(directions, ((real - reference) / floor).T.ravel()).reshape(6, -1)
        floor = np.sqrt((floor * np.std(rest, axis=1)) ** 2 + noise**2)
    directions = np.hstack([np.stack([(c / floor).T.ravel() for c in columns], axis=1), biases])
    return Scale(floor, directions, Null.of(motion), felt, base)


def _neighbours(car: Car, msd: bool) -> list[tuple[Car, float]]:
    """Cars with one thing changed, and by which share."""
    out: list[tuple[Car, float]] = []
    quick = np.linspace(0, DAMPER_REACH, DAMPER_N + 1)

    def put(axle: str, strut: Strut, step: float) -> None:
        out.append((replace(car, front=strut) if axle == "front" else replace(car, rear=strut), step))

    for axle, strut in (("front", car.front), ("rear", car.rear)):
        put(axle, replace(strut, spring=1.1 * strut.spring), 0.1)
        if not msd:
            put(axle, replace(strut, unsprung=1.05 * strut.unsprung), 0.05)
        for side in ("push", "pull"):
            table = getattr(strut, side)
            for i, at in enumerate(_HATS):
                before, after = (0.0 if i == 0 else _HATS[i - 1]), (2.0 if i == 3 else _HATS[i + 1])
                hat = np.interp(quick, [before, at, after], [0.0, 1.0, 0.0 if i < 3 else 1.0])
                put(axle, replace(strut, **{side: table * (1.0 + 0.15 * hat)}), 0.15)
    roll, pitch, yaw = car.sprung_inertia
    out.append((replace(car, sprung_inertia=(1.05 * roll, pitch, yaw)), 0.05))
    out.append((replace(car, sprung_inertia=(roll, 1.05 * pitch, yaw)), 0.05))
    if not msd:
        out.append((replace(car, tyre_stiffness=1.05 * car.tyre_stiffness), 0.05))
    return out


def counted(effect: str, wide: bool) -> int:
    """How many channels count: of what is outside the library in the wide plans those that a suspension moves, as the
    planar motion is given to a twin whatever disturbs it."""
    return 3 if wide and effect in WIDE_OUTSIDE else 6


def curve(world: World, scale: Scale, effect: str, seed: int, wide: bool = False) -> Floats:
    """(6,) severity at each of AMOUNTS, never falling; ``wide`` as in ``knob``."""
    turn, channels = knob(effect, world, seed, wide), counted(effect, wide)
    faults = [{effect: turn(float(a), scale.null)} for a in AMOUNTS]
    values = [scale.severity(change(world, scale, f), channels) for f in faults]
    return np.asarray(np.maximum.accumulate(np.maximum(values, 1e-6)))


def amount_for(severities: Floats, target: float) -> float:
    """Amount that gives a severity as far as the curve tells; all of it where all is not enough."""
    if target >= severities[-1]:
        return 1.0
    if target <= severities[0]:
        return float(AMOUNTS[0] * target / severities[0])
    rising = severities + 1e-9 * np.arange(severities.size)
    return float(np.exp(np.interp(np.log(target), np.log(rising), np.log(AMOUNTS))))
