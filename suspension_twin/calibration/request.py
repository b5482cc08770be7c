# SPDX-License-Identifier: Apache-2.0
"""Request, progress and result of a calibration: plain, picklable data."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.display import axes_or_new, bulleted, table
from suspension_twin.drive.read import Topics
from suspension_twin.inference.gap import Gap, channel_unit
from suspension_twin.vehicle.twin import Twin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

__all__ = [
    "STATUSES",
    "Band",
    "CalibrationRequest",
    "CalibrationResult",
    "CurveEstimate",
    "DriveFit",
    "DriveSignals",
    "Estimate",
    "Estimates",
    "NuisanceEstimate",
    "Progress",
    "SearchSummary",
    "SensorEstimate",
    "Yardstick",
]


#: What an :class:`Estimate` can be.
STATUSES = ("identified", "interpolated", "extrapolated", "kept", "not identified", "on bound")


@dataclass(frozen=True)
class CalibrationRequest:
    """Twin, drives and settings of a calibration. Only ``twin`` and ``bags`` are needed.

    Parameters
    ----------
    twin : str
        Path of the twin file.
    bags : tuple of str
        Paths of the recorded drives.
    preset : str
        ``fast`` (Gauss-Newton), ``paper`` (the car paper's genetic algorithm) or ``tracked_paper``.
    seed : int
        Seed of every random choice.
    free : tuple of str
        Dotted keys, or keys of whole characteristics, to search in place of the preset's.
    also : tuple of str
        Keys to search as well.
    freeze : tuple of str
        Keys to leave as they are, nuisance parameters (``nuisances.gain``) included.
    bounds : tuple of (str, float, float)
        Key, lower and upper bound in the units of the twin file.
    objective : str
        As :func:`~suspension_twin.inference.objectives.parse_objective` takes it; empty for the
        preset's.
    channels : tuple of (str, float)
        Channels compared and their weights; empty for the preset's.
    max_generations : int
        0 for the preset's.
    state : str
        Folder for checkpoints, to continue after an interruption; empty for none.
    keep_sensor : bool
        Leave latency and mounting of the IMU as the file has them.
    topics : Topics
        Names of the topics in the bags.
    no_position : bool
        Leave the positions of the drives out: passes are found on the road by what was felt.

    Examples
    --------
    >>> CalibrationRequest(twin="bags/bump_15kmh/twin.yaml", bags=("bags/bump_15kmh",)).preset
    'fast'
    """

    twin: str
    bags: tuple[str, ...]
    preset: str = "fast"
    seed: int = 0
    free: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    freeze: tuple[str, ...] = ()
    bounds: tuple[tuple[str, float, float], ...] = ()
    objective: str = ""
    channels: tuple[tuple[str, float], ...] = ()
    max_generations: int = 0
    state: str = ""
    keep_sensor: bool = False
    topics: Topics = Topics()
    no_position: bool = False


@dataclass(frozen=True)
class Progress:
    """Where a calibration stands: ``stage`` "reading", "search", "refine" or "writing"; costs in the
    objective's unit, NaN while unknown; ``seconds_left`` an estimate, NaN while unknown; ``values`` of the free
    parameters, in the order of the result's estimates, where they are best so far, empty while unknown."""

    stage: str
    generation: int = 0
    evaluations: int = 0
    best_cost: float = float("nan")
    mean_cost: float = float("nan")
    seconds_left: float = float("nan")
    note: str = ""
    values: tuple[float, ...] = ()


@dataclass(frozen=True)
class Estimate:
    """One parameter found, in the units of the twin file.

    ``low`` and ``high`` bound its 90 % interval, NaN where none could be had; ``lower`` and ``upper`` are the bounds of
    the search. ``status`` (one of ``STATUSES``; the criterion is in ``calibration.uncertainty``):

    - ``identified``: the data carry at least as much information on it as its prior;
    - ``interpolated``: within the range that the drives excited it follows identified neighbours on its characteristic
      by the prior of smooth slopes;
    - ``extrapolated``: beyond that range it does;
    - ``kept``: at its start, for the data do not show that it differs from it;
    - ``on bound``: the search wanted to go further;
    - ``not identified``: the search knew no prior, and the value is arbitrary within its interval.
    """

    key: str
    start: float
    value: float
    low: float
    high: float
    lower: float
    upper: float
    status: str = "identified"

    @property
    def on_bound(self) -> str:
        """The bound that it is on: "lower", "upper" or ""."""
        if self.status != "on bound":
            return ""
        return "upper" if self.value > 0.5 * (self.lower + self.upper) else "lower"


@dataclass(frozen=True)
class NuisanceEstimate:
    """One nuisance parameter (clock, map, mount, bias). ``sigma`` is its standard deviation, ``prior`` that of its
    prior: where both are alike the data do not identify it."""

    name: str
    value: float
    sigma: float
    prior: float
    unit: str


@dataclass(frozen=True)
class SensorEstimate:
    """One property of the sensor: ``imu.latency`` s, or ``mount.roll`` or ``mount.pitch`` rad by which its mounting is
    turned about the vehicle's axes against the starting file.

    ``low`` and ``high`` bound its 90 % interval; ``written``: the calibrated twin has it. ``consistency`` is the
    probability that what speaks for one common value scatters as much: the drives' clock offsets (NaN for one drive),
    the fitted tilt and gravity (NaN where a phone has taken gravity off)."""

    key: str
    unit: str
    start: float
    value: float
    low: float
    high: float
    written: bool
    consistency: float = float("nan")


@dataclass(frozen=True)
class Yardstick:
    """Share of the variance of a ``channel`` that is explained on ``held_out`` parts of the data: by the calibrated
    ``twin``, by the ``given`` twin with its own nuisances, by a ``linear`` model that was fitted to the same parts, and
    by a ``repeat`` of the same run; NaN for what there is not."""

    channel: str
    held_out: str
    twin: float
    given: float
    linear: float
    repeat: float

    @property
    def lost(self) -> bool:
        """Whether the linear model explains more, by more than a thousandth of the variance."""
        return self.linear > self.twin + 1e-3

    @property
    def is_worse(self) -> bool:
        """Whether the given twin explains more, by more than a hundredth of the variance (a tolerance, by hand: a twin
        that was calibrated on a drive and is calibrated on it again comes out a thousandth apart)."""
        return self.given > self.twin + 1e-2

    def __str__(self) -> str:
        others = [
            f"{words} {100 * value:.1f} %"
            for words, value in (
                ("the given twin", self.given),
                ("a linear model", self.linear),
                ("one repeat of another", self.repeat),
            )
            if np.isfinite(value)
        ]
        beside = f" ({', '.join(others)})" if others else ""
        name = self.channel.replace("_", " ")
        return f"{100 * self.twin:.1f} % of the variance of the {name} explained on held-out {self.held_out}{beside}"


@dataclass(frozen=True, eq=False)
class Band:
    """An interval around a characteristic: abscissae (g,) m or m/s, lowest and highest force (g,) in N."""

    x: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, eq=False)
class CurveEstimate:
    """A characteristic: its ``band``, ``force`` and ``start`` (g,) N over the band's abscissae; ``span`` the range that
    the drives excited, m or m/s (NaN, NaN where nothing was).

    A spring has ``static``, its compression at rest in m (else NaN), and ``from_rest`` the band over the travel from
    there, which does not depend on where its free length lies.
    """

    key: str
    unit: str
    band: Band
    force: Floats
    start: Floats
    span: tuple[float, float]
    static: float
    from_rest: Band | None


@dataclass(frozen=True, eq=False, kw_only=True)
class DriveSignals:
    """Every channel (m,) of one drive at stamps ``t`` (m,) s of an even ``rate`` Hz and at the ``position`` (m,) m
    along the road: measured, and of the twin ``before`` and ``after``; ``compared`` (m,) are the samples of the
    objective; ``received`` (m,) m, the position by the receiver where passes were placed on the road."""

    rate: float
    t: Floats
    position: Floats
    measured: dict[str, Floats]
    before: dict[str, Floats]
    after: dict[str, Floats]
    compared: NDArray[np.bool_]
    received: Floats | None = None


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class DriveFit(DriveSignals):
    """One drive or run, compared: gaps over the whole of it in its main ``channel``, and its signals.

    ``nuisance_free`` is the residual's rms in m/s² on the compared samples with the nuisances corrected. ``profile``
    are distances (k,) m along the road and the heights (k, 2) m of the left and right track.
    """

    name: str
    channel: str
    gap_before: Gap
    gap_after: Gap
    nuisance_free: float
    correlation: float
    profile: tuple[Floats, Floats]

    def __repr__(self) -> str:
        gaps = f"{self.gap_before.rms:.4g} to {self.gap_after.rms:.4g} {channel_unit(self.channel)}"
        return f"{self.name}: gap in {self.channel.replace('_', ' ')} {gaps} rms"


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchSummary:
    """A search that is over, and its ``seconds``. ``cost`` and ``initial_cost`` (of the start, moved into bounds) are
    of the ``objective`` that was searched and compare with no other objective's. ``history`` (k, 4): evaluations, best
    cost, mean cost and stage number (0 search, 1 refine) after each generation."""

    preset: str
    objective: str
    seed: int
    seconds: float
    cost: float = float("nan")
    initial_cost: float = float("nan")
    evaluations: int = 0
    history: Floats = field(default_factory=lambda: np.empty((0, 4)))

    @property
    def generations(self) -> int:
        """How many generations were searched."""
        return len(self.history)

    @property
    def _change(self) -> str:
        return f"cost ({self.objective}) {self.initial_cost:.4g} to {self.cost:.4g} in {self.evaluations} evaluations"


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimates:
    """Everything that was estimated: parameters of the twin, nuisances, the sensor and whole characteristics."""

    estimates: tuple[Estimate, ...] = ()
    nuisances: tuple[NuisanceEstimate, ...] = ()
    sensor: tuple[SensorEstimate, ...] = ()
    curves: tuple[CurveEstimate, ...] = ()


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class CalibrationResult(SearchSummary, Estimates):
    """``twin`` calibrated from ``start``.

    ``distance`` and ``initial_distance`` are the same for every preset: the car paper's eq. (1), the Euclidean
    distance in m/s² between measured and simulated vertical acceleration over the compared samples, each drive
    aligned in time and no other nuisance corrected. ``stopped``: this is the best until the stop, without
    intervals, drives and distances."""

    twin: Twin
    start: Twin
    stopped: bool
    drives: tuple[DriveFit, ...] = ()
    distance: float = float("nan")
    initial_distance: float = float("nan")
    yardstick: Yardstick | None = None
    warnings: tuple[str, ...] = ()

    @property
    def _verdict(self) -> str:
        """The yardstick in words where the twin is worse than it, else nothing."""
        lost = self.yardstick is not None and self.yardstick.lost
        return f"worse than a linear model of the same data: {self.yardstick}" if lost else ""

    @property
    def is_farther(self) -> bool:
        """Whether the calibrated twin is farther from its own drives than the one it started from, all together, even
        with the nuisances as they were found."""
        after = sum(min(d.gap_after.rms, d.nuisance_free) ** 2 for d in self.drives)
        return after > sum(d.gap_before.rms**2 for d in self.drives)

    @property
    def refusal(self) -> str:
        """Why the calibrated twin is not to be written, empty where it is."""
        if self.is_farther:
            gaps = ", ".join(f"{d.name} {d.gap_before.rms:.3g} to {d.gap_after.rms:.3g}" for d in self.drives)
            return (
                f"the calibrated one is farther from its drives than the given one ({gaps}): something other than the "
                "free parameters is off, such as place, clock, speed or the road"
            )
        if self.yardstick is not None and self.yardstick.is_worse:
            return (
                f"the given one explains more of what is held out ({self.yardstick}): the drives do not agree on one "
                "vehicle, or show nothing that the given twin lacks"
            )
        return ""

    @property
    def counts(self) -> dict[str, int]:
        """How many parameters have which status, those that none has left out."""
        found = {s: sum(e.status == s for e in self.estimates) for s in STATUSES}
        return {s: count for s, count in found.items() if count}

    @property
    def _counted(self) -> str:
        return ", ".join(f"{count} {status}" for status, count in self.counts.items())

    @property
    def message(self) -> str:
        """One line: costs, gaps and how many parameters were identified."""
        state = (
            "stopped, the best so far: " if self.stopped else f"{self._verdict}; " if self._verdict else ""
        )
        if not self.drives:
            return f"{state}{self._change}"
        gaps = ", ".join(
            f"{d.name} {d.gap_before.rms:.3g} to {d.gap_after.rms:.3g} {channel_unit(d.channel)}"
            for d in self.drives
        )
        distance = ""
        if np.isfinite(self.distance):
            distance = f"; distance (eq. 1) {self.initial_distance:.4g} to {self.distance:.4g} m/s²"
        return f"{state}{self._change}{distance}; gap {gaps}; {self._counted} of {len(self.estimates)} parameters"

    def __str__(self) -> str:
        bounds = ", ".join(e.key for e in self.estimates if e.on_bound)
        lines = [
            *map(repr, self.drives),
            f"{self._change}, {self.seconds:.1f} s{', stopped' if self.stopped else ''}",
            f"{len(self.estimates)} parameters: {self._counted or 'no uncertainty was computed'}",
            *([f"on a bound: {bounds}"] if bounds else []),
        ]
        if self.yardstick is not None and not self._verdict:
            lines.insert(len(self.drives), str(self.yardstick))
        heading = f"Calibration of {self.twin.vehicle.name}, preset {self.preset}"
        return bulleted(", ".join(filter(None, (heading, self._verdict))), lines, self.warnings)

    __repr__ = __str__

    def plot(self, ax: Axes | None = None, drive: int = 0) -> Axes:
        """Draw one drive's main channel, measured and by the twin before and after, over s; returns the axes."""
        fit = self.drives[drive]
        label = f"{fit.channel.replace('_', ' ')} [{channel_unit(fit.channel)}]"
        ax = axes_or_new(ax, "time [s]", label, repr(fit))
        t = fit.t - fit.t[0]
        ax.plot(t, fit.before[fit.channel], "--", color="0.6", label="before", linewidth=1.0)
        for side, signals in (("measured", fit.measured), ("after", fit.after)):
            ax.plot(t, signals[fit.channel], label=side, linewidth=1.0)
        ax.legend(loc="upper right")
        return ax

    def to_frame(self) -> DataFrame:
        """A table of pandas, a row for each parameter: start, value, 90 % interval, bounds and status."""
        names = [f.name for f in fields(Estimate)]
        names.insert(-1, "on_bound")
        return table({name: [getattr(e, name) for e in self.estimates] for name in names}, "key")
