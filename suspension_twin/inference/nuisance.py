# SPDX-License-Identifier: Apache-2.0
"""Nuisance parameters: errors of clock, map and mounting that are no physics of the vehicle.

The offset between the clocks of IMU and GPS, the position of the map along the road, the IMU's gain, tilt and biases
are fitted with the vehicle and reported apart from it. A shift in time is applied to the simulated, band-limited signal
by interpolation: no simulation is spent on it. A shift of the map by d metres is one in time by d over the speed along
the road. Neither shifts the response to the planar motion, where that is known apart: a pose comes from no map.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.errors import InputError
from suspension_twin.inference.priors import SINGLE, TABLES
from suspension_twin.inference.sensor_reading import read_alike, read_any, read_steady
from suspension_twin.models.parameters import Parameter, Prior
from suspension_twin.models.sensor_chain import TABLE
from suspension_twin.models.simulate import cores, share_out
from suspension_twin.pose.types import RECEIVER_TIME

if TYPE_CHECKING:
    from suspension_twin.inference.observation import Observation
    from suspension_twin.road.recipe import Taped

__all__ = [
    "NUISANCES",
    "OF_A_CALIBRATION",
    "OF_A_DRIVE",
    "OF_A_RIG",
    "OF_A_RUN",
    "OF_PLANAR_MOTION",
    "NuisancePriors",
    "Nuisances",
    "course_covariance",
    "map_spread",
    "slow_position_error",
]

#: Priors that each nuisance parameter which can be frozen leaves out.
NUISANCES: Mapping[str, tuple[str, ...]] = {
    "clock_offset": ("clock", "common_clock"),
    "map_position": ("map_position",),
    "wander": ("wander",),
    "tape": ("tape",),
    "gain": ("gain",),
    "tilt": ("tilt",),
    "bias": ("force_bias", "rate_bias"),
}
#: Values from which on several threads are quicker than one.
_WORTH_SHARING = 50_000
_SLOWEST = 0.5  # m/s: below this a place on the road says nothing of a time


@dataclass(frozen=True)
class ClockPriors:
    """Standard deviations of the offset between the clocks of IMU and receiver: ``clock`` s of each drive,
    ``common_clock`` s of all of them; ``speed`` share by which a run was driven faster than stated, its time
    stretched."""

    clock: float = 0.0
    common_clock: float = 0.0
    speed: float = 0.0


@dataclass(frozen=True)
class MapPriors:
    """Standard deviations of the place on the map along the road: ``map_position`` m of all drives, ``drive_map`` m of
    each, ``wander`` m (the GNSS position's own error, one value for every pass and ``wander_seconds``, in which its
    speed hardly changes; None takes it from the fixes' covariance), ``tape`` m of the sizes of what was measured by
    tape (None: as the road's file says)."""

    map_position: float = 0.0
    drive_map: float = 0.0
    wander: float | None = 0.0
    wander_seconds: float = 2.0
    tape: float | None = 0.0


@dataclass(frozen=True)
class MountingPriors:
    """Standard deviations of the IMU and its mounting: ``gain`` of the accelerometer, ``tilt`` rad, ``force_bias``
    m/s², ``rate_bias`` rad/s, ``mount`` of the share (f / 70 Hz)² by which an elastic mount of the sensor amplifies
    vertical motion at f."""

    gain: float = 0.0
    tilt: float = 0.0
    force_bias: float = 0.0
    rate_bias: float = 0.0
    mount: float = 0.0


@dataclass(frozen=True)
class KinematicPriors:
    """Standard deviations of the vehicle's kinematics that no model has: ``pivot`` m (how far a real suspension's
    kinematics shift the axes about which the body rolls and pitches), ``slip`` rad per m/s² (slip angle of the rear
    tyres: a heading that is taken from the course differs by it)."""

    pivot: float = 0.0
    slip: float = 0.0


@dataclass(frozen=True)
class NuisancePriors(ClockPriors, MapPriors, MountingPriors, KinematicPriors):
    """Prior standard deviations of nuisance parameters; 0 leaves one out. Those by kind of recording are in
    ``priors.yaml``."""

    def without(self, keys: Iterable[str]) -> NuisancePriors:
        """Those of ``keys`` (``nuisances.gain``) left out; raises InputError for one that is not known."""
        gone: dict[str, float] = {}
        for key in keys:
            name = key.removeprefix("nuisances.")
            if name not in NUISANCES:
                raise InputError(
                    "freeze", key, f"one of {', '.join(f'nuisances.{n}' for n in NUISANCES)} is expected"
                )
            gone |= dict.fromkeys(NUISANCES[name], 0.0)
        return replace(self, **gone)


def _of(recording: str) -> NuisancePriors:
    """The priors of a kind of recording."""
    return NuisancePriors(**{name: getattr(prior, recording) for name, prior in TABLES.nuisances.items()})


OF_A_CALIBRATION, OF_A_DRIVE, OF_PLANAR_MOTION = _of("calibration"), _of("drive"), _of("planar_motion")
OF_A_RUN, OF_A_RIG = _of("run"), _of("rig")


class Nuisances:
    """The nuisances of a set of parts of drives; ``drive_of`` says which drive a part belongs to.

    Values are in SI units, (q,) or (q, L), in the order of ``parameters`` and their ``names``; ``spread`` (q,) are
    their priors' standard deviations around zero.
    """

    def __init__(
        self,
        parts: Sequence[Observation],
        drive_of: Sequence[int],
        channels: Sequence[str],
        priors: NuisancePriors,
        wander: Sequence[float],
        taped: Taped | None = None,
    ) -> None:
        self.priors, self.channels, self.taped = priors, tuple(channels), taped
        self._force = np.array([c.endswith("acceleration") for c in channels])
        parameters: list[Parameter] = []
        channels = tuple(channels)

        def add(name: str, kind: str, sigma: float | None = None, least: float = -np.inf) -> None:
            sigma = getattr(priors, kind) if sigma is None else sigma
            if sigma > 0:
                prior, unit = Prior(0.0, sigma), TABLES.nuisances[kind].unit
                parameters.append(Parameter(name, (least, np.inf), prior, unit))

        for name, sigma in taped.errors if taped is not None else ():
            add(name, "tape", sigma)
        #: (m, C, k) of every part: what the errors of the tape, the first k values, add to the signals for each metre.
        self.tape_response: tuple[Floats, ...] = ()
        add("map_position", "map_position")
        add("clock_offset", "common_clock")
        if self._force.any():
            add("gain", "gain")
        add("tilt_roll", "tilt")
        add("tilt_pitch", "tilt")
        #: Channel -> nuisance, the channel whose slope it adds, and its sign.
        self._levers = {}
        for c, name, other, sign, kind in (
            ("longitudinal_acceleration", "pivot_pitch", "pitch_rate", -1.0, "pivot"),
            ("lateral_acceleration", "pivot_roll", "roll_rate", 1.0, "pivot"),
            ("yaw_rate", "rear_slip", "lateral_acceleration", 1.0, "slip"),
        ):
            if getattr(priors, kind) > 0 and c in self.channels and other in self.channels:
                self._levers[c] = (name, channels.index(other), sign)
                add(name, kind)
        self._mounted = (
            self.channels.index("vertical_acceleration") if "vertical_acceleration" in self.channels else -1
        )
        if self._mounted >= 0:
            # below its resonance an elastic mount amplifies motion
            add("mount", "mount", least=0.0)
        drives: dict[int, str] = {}
        for part, drive in zip(parts, drive_of, strict=True):
            if drive not in drives:
                drives[drive] = part.name
                add(f"{part.name}.clock_offset", "clock")
                add(f"{part.name}.speed", "speed")
                add(f"{part.name}.map_position", "drive_map")
                for channel, force in zip(self.channels, self._force, strict=True):
                    add(f"{part.name}.bias.{channel}", "force_bias" if force else "rate_bias")
        #: (m, C) of every part: the response to the planar motion alone; neither clock nor map shifts it.
        self.planar_response: tuple[Floats, ...] = ()
        self._knots: list[Floats] = []
        motions: dict[int, list[Floats]] = {}
        for number, (part, drive) in enumerate(zip(parts, drive_of, strict=True)):
            knots = _knots(part, priors.wander_seconds) if wander[drive] > 0 else np.empty(0)
            self._knots.append(knots)
            if knots.size:
                course = np.where(np.interp(knots, part.t, part.along) < 0.0, np.pi, 0.0)
                motions.setdefault(drive, []).append(np.stack([knots, course]))
            for k in range(knots.size):
                add(f"{part.name}.wander.{number}.{k}", "wander", wander[drive])
        self.parameters = tuple(parameters)
        self.names = tuple(p.key for p in parameters)
        self.spread = np.array([p.prior.spread for p in parameters])
        #: (q, q) of the prior: the slow error of a receiver's positions is correlated over its knots.
        self.covariance = np.diag(self.spread**2)
        for drive, motion in motions.items():
            own = [i for i, n in enumerate(self.names) if n.startswith(f"{drives[drive]}.wander.")]
            self.covariance[np.ix_(own, own)] = course_covariance(np.hstack(motion), wander[drive])
        #: (q,) True where a value cannot be negative
        self.one_sided = np.array([p.lower == 0.0 for p in parameters], dtype=np.bool_)
        self._row = {name: i for i, name in enumerate(self.names)}
        self._parts = tuple(parts)
        self._drive_names = tuple(drives[d] for d in drive_of)
        self._regressors = [
            self._tilt(part) if "tilt_roll" in self._row else np.zeros((2, part.t.size, len(self.channels)))
            for part in parts
        ]

    def __len__(self) -> int:
        return len(self.names)

    def with_planar_response(self, responses: Sequence[Floats]) -> Nuisances:
        """The same, with the response (m, C) of every part to its planar motion alone."""
        known = copy(self)
        known.planar_response = tuple(responses)
        return known

    def with_tape_response(self, responses: Sequence[Floats]) -> Nuisances:
        """The same, with what each error of the tape adds to the signals of every part (m, C, k)."""
        known = copy(self)
        known.tape_response = tuple(responses)
        return known

    def tape_of(self, values: Floats) -> Floats:
        """(k,) m errors of the tape of ``values`` (q,)."""
        return values[: 0 if self.taped is None else len(self.taped.errors)]

    def wander_of(self, number: int, values: Floats) -> tuple[Floats, Floats]:
        """Times (k,) s and metres (k,) or (k, L) by which part ``number`` lies farther ahead by ``values`` (q,) or
        (q, L); none where k is 0."""
        knots, drive = self._knots[number], self._drive_names[number]
        rows = [self._row[f"{drive}.wander.{number}.{k}"] for k in range(knots.size)]
        return knots, values[rows]

    @property
    def clocks(self) -> list[tuple[int, list[int]]]:
        """For each drive the row of its clock offset and the numbers of its parts."""
        found: dict[int, list[int]] = {}
        for number, drive in enumerate(self._drive_names):
            row = self._row.get(f"{drive}.clock_offset")
            if row is not None:
                found.setdefault(row, []).append(number)
        return list(found.items())

    @property
    def steps(self) -> Floats:
        """(q,) finite-difference steps: small against the priors, large against rounding."""
        return 1e-3 * self.spread

    @property
    def plain(self) -> NDArray[np.bool_]:
        """(q,) those that add what does not depend on the simulation: biases and small tilts."""
        return np.array([".bias." in name or name.startswith("tilt_") for name in self.names], dtype=np.bool_)

    def _tilt(self, part: Observation) -> Floats:
        """(2, m, C) what a small tilt about x and about y adds, from the measured signals."""
        m = part.measured
        g = part.usage.gravity
        zero = np.zeros_like(m["yaw_rate"])
        fz = m["vertical_acceleration"] + g
        about_x = {
            "vertical_acceleration": m["lateral_acceleration"],
            "lateral_acceleration": -fz,
            "pitch_rate": -m["yaw_rate"],
            "yaw_rate": m["pitch_rate"],
        }
        about_y = {
            "vertical_acceleration": -m["longitudinal_acceleration"],
            "longitudinal_acceleration": fz,
            "roll_rate": m["yaw_rate"],
            "yaw_rate": -m["roll_rate"],
        }
        return np.stack(
            [np.stack([about.get(c, zero) for c in self.channels], axis=1) for about in (about_x, about_y)]
        )

    def stamped_early(self, number: int, values: Floats) -> Floats:
        """(m, L), or (1, L) where it is the same at all of them: s by which the grid samples of a part happened after
        their stamps, by the clock and the speed among the nuisances ``values`` (q, L)."""
        drive, t = self._drive_names[number], self._parts[number].t
        clocks = [self._row[name] for name in (f"{drive}.clock_offset", "clock_offset") if name in self._row]
        early: Floats = values[clocks].sum(axis=0)[None, :]
        faster = self._row.get(f"{drive}.speed")
        return early if faster is None else np.asarray(early + values[faster] * (t - t[0])[:, None])

    def apply(self, number: int, simulated: Floats, rows: NDArray[np.intp], values: Floats) -> Floats:
        """Readings of the sensor for part ``number`` at grid samples ``rows`` (r,).

        ``simulated`` (m, C, L) conditioned, or one lane for all; ``values`` (q, L). Returns (r, C, L).
        """
        part = self._parts[number]
        lanes = values.shape[1]
        if self.tape_response and (taped := values[: self.tape_response[number].shape[2]]).any():
            added = np.einsum("mck,kl->mcl", self.tape_response[number], taped, optimize=False)
            simulated = simulated + added

        def value(name: str) -> Floats:
            row = self._row.get(name)
            return np.zeros(lanes) if row is None else values[row]

        drive = self._drive_names[number]
        along = part.along[rows]
        along = np.where(np.abs(along) < _SLOWEST, np.where(along < 0, -_SLOWEST, _SLOWEST), along)
        metres = np.broadcast_to(value("map_position") + value(f"{drive}.map_position"), (rows.size, lanes))
        # the map's shift follows the road's direction, the wander the vehicle's
        sense = np.sign(along)[:, None]
        knots, wander = self.wander_of(number, values)
        if knots.size:
            hats = interpolated(part.t[rows], knots, np.eye(knots.size))
            metres = metres + sense * np.einsum("rk,kl->rl", hats, wander, optimize=False)
        early = self.stamped_early(number, values)
        shift = ((early[rows] if early.shape[0] > 1 else early) + metres / along[:, None]) * part.rate
        gain = np.ones((len(self.channels), lanes))
        gain[self._force] += value("gain")
        bias = np.stack([value(f"{drive}.bias.{c}") for c in self.channels])
        about = self._regressors[number][:, rows]
        tilt = np.stack([value("tilt_roll"), value("tilt_pitch")])
        lever, turned = np.zeros_like(gain), np.full(len(self.channels), -1)
        for channel, (name, rate, sign) in self._levers.items():
            turned[self.channels.index(channel)] = rate
            lever[self.channels.index(channel)] = sign * part.rate * value(name)
        if "mount" in self._row:  # less a share of the second derivative, which is the slope of the slope
            turned[self._mounted] = len(self.channels)
            lever[self._mounted] = -((part.rate / (2.0 * np.pi * SINGLE["mount_resonance"])) ** 2) * value(
                "mount"
            )
        out = np.empty((rows.size, len(self.channels), lanes))
        carried = self.planar_response[number] if self.planar_response and shift.any() else None
        simulated, shift = np.ascontiguousarray(simulated), np.ascontiguousarray(shift)
        apart = simulated.shape[2] > 1 and bool((shift[0] != shift[0, 0]).any())
        steady = apart and (turned < 0).all() and bool((shift == shift[0]).all()) and carried is None
        alike = not apart and simulated.shape[2] > 1 and bool((shift == shift[:, :1]).all())
        still = np.empty((0, len(self.channels))) if carried is None else carried
        given, later = simulated, None if alike else carried
        if later is not None:
            given = given - later[:, :, None]
        if not (steady or alike):
            given = self._with_slope(given)

        def work(low: int, high: int) -> None:
            if steady:
                read_steady(given, rows, shift[0], gain, bias, about, tilt, TABLE, out, low, high)
            elif alike:
                one = np.ascontiguousarray(shift[:, 0])
                read_alike(
                    given, still, rows, one, gain, bias, about, tilt, lever, turned, TABLE, out, low, high
                )
            else:
                read_any(given, rows, shift, gain, bias, about, tilt, lever, turned, TABLE, out, low, high)

        pieces = cores() if out.size > _WORTH_SHARING else 1
        cuts = np.linspace(0, rows.size, pieces + 1).astype(int).tolist()
        share_out(work, list(zip(cuts[:-1], cuts[1:], strict=True)), pieces)
        if later is not None:
            out += later[rows][:, :, None]
        return out

    def _with_slope(self, simulated: Floats) -> Floats:
        """Signals (m, C + 1, L) with the slope of the held channel as one more, where the mount is elastic."""
        if "mount" not in self._row:
            return simulated
        slope = np.gradient(simulated[:, self._mounted], axis=0)
        return np.concatenate([simulated, slope[:, None]], axis=1)


def slow_position_error(drive: Observation) -> float:
    """Standard deviation in m of the slow error of a drive's smoothed positions, by what its receiver says of a fix:
    half of it averages out."""
    return 0.5 * float(drive.position_sigma)


def course_covariance(motion: Floats, sigma: float) -> Floats:
    """(k, k) prior covariance in m² of the error of smoothed positions along the vehicle's course.

    Parameters
    ----------
    motion : (2, k) array
        Times in s and courses in rad.
    sigma : float
        The receiver's horizontal standard deviation in m; its error is correlated over T, ``RECEIVER_TIME`` s, and
        has a derivative, as the smoothed path has a speed: Matérn 3/2.

    Returns
    -------
    (k, k) array
        ``sigma² cos(c_i - c_j) (1 + a) exp(-a)`` with ``a = sqrt(3) |t_i - t_j| / T``.
    """
    t, course = motion
    apart, turn = np.subtract.outer(t, t), np.subtract.outer(course, course)
    memories = np.sqrt(3.0) * np.abs(apart) / RECEIVER_TIME
    return np.asarray(sigma**2 * np.cos(turn) * (1.0 + memories) * np.exp(-memories))


def map_spread(drives: Sequence[Observation]) -> float:
    """Standard deviation in m by which all drives' poses may be off the map along the road.

    The mean of drives goes no further than the receiver says of single fixes: that is the limit, three spreads.
    """
    given = [d.position_sigma for d in drives if d.position_sigma > 0]
    return (
        max(float(np.mean(given)) / 3.0, SINGLE["map_accuracy"]) if given else OF_A_CALIBRATION.map_position
    )


def _knots(part: Observation, seconds: float) -> Floats:
    """Times between which the position's error is taken as linear: one knot for a short pass."""
    t = part.t
    count = int((t[-1] - t[0]) // seconds) + 1
    return np.linspace(t[0], t[-1], count) if count > 1 else np.array([0.5 * (t[0] + t[-1])])
