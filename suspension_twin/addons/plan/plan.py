# SPDX-License-Identifier: Apache-2.0
"""Detectability before anyone drives: smallest sizes of effects, pairs that look alike, and the next drive.

A change of the sensor's readings by an effect is projected off everything that a diagnosis fits anyway: the parameters
of the vehicle and the nuisances, within their bounds. The residual counts in units of that to be expected of a sound
model, channel by channel and drive by drive (its largest ratio of rms values). Two thresholds, both learnt on the
blind benchmark, turn ratios into answers: from ``DETECTABLE`` on an effect is named, and a pair is distinguished where
one effect leaves ``APART`` of the other whatever its own parameters are.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from suspension_twin.addons.plan.sensitivity import Change, Products, products
from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.next_experiment import manoeuvres, planned_drive
from suspension_twin.effects.base import Parameter
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.files import Json, write_text
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.observation import Observation, road_of
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.problem import REACH
from suspension_twin.models.registry import model_of
from suspension_twin.road import Road
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "APART",
    "DETECTABLE",
    "SPEEDS",
    "Detectability",
    "Pair",
    "Plan",
    "Ray",
    "Rival",
    "alternatives",
    "plan",
    "rays",
]

_MENU: Final = json.loads(Path(__file__).with_name("plan.json").read_text(encoding="utf-8"))
#: km/h if none are given.
SPEEDS: Final[tuple[float, ...]] = tuple(_MENU["speeds_kmh"])
#: Expected residuals from which on an effect is named, and that a rival has to leave.
DETECTABLE: Final[float] = _MENU["thresholds"]["detectable"]
APART: Final[float] = _MENU["thresholds"]["apart"]
#: Sizes of an effect, in the scale of its prior; the last is its largest plausible size.
_SIZES: Final = (0.1, 0.2, 0.45, 1.0, REACH)
#: The same of a logarithmic one, in standard deviations from typical, weak to strong.
_LOG_SIZES: Final = np.arange(-REACH, REACH)
#: e-folds of size by which a change of the set-up has to be better than another to be named instead.
_BETTER: Final = 0.1
#: Frequencies of a resonance, in standard deviations from typical.
_TONES: Final = np.linspace(-1.5, 1.5, 25)
_TOGETHER: Final = 3  # neighbours that make one rival (numerics)


@dataclass(frozen=True, eq=False)
class Ray:
    """One parameter of one effect growing one way from nothing: coordinates (k, n) of ``points`` and the ``sizes`` (n,)
    of the parameter there, a change from neutral or, of a logarithmic one, the value. The last is the largest plausible
    size."""

    name: str
    hypothesis: Hypothesis
    parameter: Parameter
    points: Floats
    sizes: Floats

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.hypothesis.effects[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its columns."""
        return tuple(f"{self.name} {i}" for i in range(self.sizes.size))

    @property
    def typical(self) -> int:
        """Which point is of typical size."""
        wanted = int(np.argmax(_LOG_SIZES == 0.0)) if self.parameter.prior.log else _SIZES.index(1.0)
        return min(wanted, self.sizes.size - 1)

    def rank(self, size: float) -> float:
        """A number that grows with the severity of a size, in e-folds: a low-pass is the more the lower it is."""
        return float(np.log(size)) * (1.0 if self.sizes[-1] >= self.sizes[0] else -1.0)

    def size_from(
        self, ratios: Floats, threshold: float, points: Sequence[int] | None = None
    ) -> float | None:
        """The smallest size whose ratio reaches a threshold, by the ratios at its points; None if none does."""
        sizes = self.sizes if points is None else self.sizes[list(points)]
        reached = np.flatnonzero(ratios >= threshold)
        if not reached.size:
            return None
        at = int(reached[0])
        if at == 0:  # a change is in proportion while it is small
            return float(sizes[0] if self.parameter.prior.log else sizes[0] * threshold / ratios[0])
        low, high = np.log(np.maximum(ratios[at - 1 : at + 1], 1e-12))
        share = (np.log(threshold) - low) / max(high - low, 1e-12)
        return float(sizes[at - 1] * (sizes[at] / sizes[at - 1]) ** share)


@dataclass(frozen=True)
class Detectability:
    """Detectability of a parameter of an effect: the smallest ``size`` that shows, in the parameter's unit (a change
    from neutral, or the value of a logarithmic one), None where even the ``largest`` plausible one is below the
    threshold; the ``channel`` that shows it first, and its ``ratio`` at the largest size. No size is below the usual
    one, which sound vehicles have."""

    effect: str
    place: str
    parameter: str
    size: float | None
    typical: float
    largest: float
    ratio: float
    channel: str


@dataclass(frozen=True)
class Pair:
    """An effect, by the ray that is taken most easily for a rival, beside this ``rival``: the ``angle`` in degrees
    between the residuals of the two, ``size`` from which on the rival leaves enough of the effect (None: never), and
    the best of the tried changes of the set-up, ``remedy``, with the size that it needs."""

    ray: str
    effect: str
    shown: Detectability
    rival: str
    angle: float
    size: float | None
    remedy: str = ""
    remedy_size: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """Detectability of all effects by a set-up.

    Parameters
    ----------
    twin : Twin
        The vehicle with its sensor.
    road : str
        Name of the road.
    speeds : tuple of float
        km/h of the drives.
    seconds : tuple of float
        Their lengths.
    detectability : tuple of Detectability
        A row for every parameter of every effect.
    effects : tuple of str
        Ids of the effects, in the order of ``angles``.
    angles : (E, E) array
        Degrees between the residuals of an effect (row) and a rival (column), the smallest over the parameters that
        show; NaN where none does.
    pairs : tuple of Pair
        Pairs that this set-up could not tell apart at any plausible size, or only from a size on beyond the detectable.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> found = plan(load_twin("bags/bump_15kmh/twin.yaml"), speeds=(15.0,), effects=("sensor_scale",))
    >>> [row.channel for row in found.detectability]
    ['vertical_acceleration']
    """

    twin: Twin
    road: str
    speeds: tuple[float, ...]
    seconds: tuple[float, ...]
    detectability: tuple[Detectability, ...]
    effects: tuple[str, ...]
    angles: Floats
    pairs: tuple[Pair, ...]

    def as_dict(self) -> Json:
        """The content of ``plan.json``."""
        drives = zip(self.speeds, self.seconds, strict=True)
        return {
            "vehicle": getattr(self.twin.vehicle, "name", ""),
            "road": self.road,
            "drives": [{"speed_kmh": kmh, "seconds": round(s, 2)} for kmh, s in drives],
            "thresholds": {"detectable": DETECTABLE, "apart": APART, "unit": "expected residual, rms"},
            "effects": [self._row(row) for row in self.detectability],
            "pairs": [
                {k: v for k, v in (asdict(pair) | {"shown": self._row(pair.shown)}).items() if k != "ray"}
                for pair in self.pairs
            ],
            "angles_deg": {
                effect: {
                    rival: round(float(angle), 2)
                    for rival, angle in zip(self.effects, row, strict=True)
                    if np.isfinite(angle)
                }
                for effect, row in zip(self.effects, self.angles, strict=True)
            },
        }

    def _row(self, row: Detectability) -> Json:
        """A row with the unit and the usual size of the parameter."""
        parameter = EFFECTS[row.effect].on(self.twin.model).parameter(row.parameter)
        more = {"unit": parameter.unit, "usual": _usual_size(self.twin, row.effect, parameter)}
        return asdict(row) | more

    def write(self, folder: Path) -> None:
        """Write ``folder/plan.json``."""
        text = json.dumps(self.as_dict(), indent=2, ensure_ascii=False, allow_nan=False)
        write_text(folder / "plan.json", text + "\n")


def _usual_size(twin: Twin, effect: str, parameter: Parameter) -> float:
    """Size of a parameter that sound vehicles have."""
    share = EFFECTS[effect].usual_share if parameter.unit == "kg" else 0.0
    return max(parameter.prior.usual, share * getattr(twin.vehicle, "mass", 0.0))


@dataclass(frozen=True, eq=False)
class Rival:
    """The columns by ``names`` that an effect can make, and how large a multiple of each is plausible."""

    hypothesis: Hypothesis
    names: tuple[str, ...]
    scale: Floats

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.hypothesis.effects[0]


def _place(hypothesis: Hypothesis) -> str:
    """Which of the hypotheses of an effect it is, such as ``corner 2``; empty for the only one."""
    return " ".join(f"{key.rpartition('.')[2]} {value:g}" for key, value in hypothesis.fixed)


def _name(hypothesis: Hypothesis) -> str:
    return " ".join([hypothesis.effects[0], _place(hypothesis)]).strip()


def rays(hypothesis: Hypothesis, weak: float = 1.0) -> list[Ray]:
    """Every severity of a hypothesis growing from nothing, the others at nothing.

    Parameters
    ----------
    hypothesis : Hypothesis
        One effect.
    weak : float
        Sign of the coordinate towards which logarithmic severities vanish.

    Returns
    -------
    list of Ray
        One for each severity and way that its bounds allow.

    Examples
    --------
    >>> from suspension_twin.diagnosis.library import library
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> friction = library(load_twin("bags/bump_15kmh/twin.yaml"), True)["strut_friction"][0]
    >>> [ray.sizes.tolist() for ray in rays(friction)]
    [[20.0, 40.0, 90.0, 200.0, 600.0], [20.0, 40.0, 90.0, 200.0, 600.0]]
    """
    low, high = hypothesis.bounds()
    severe = hypothesis.effect(hypothesis.effects[0]).severity
    nothing = hypothesis.neutral()
    logarithmic = np.array([p.prior.log and p.name in severe for _, p in hypothesis.searched])
    nothing[logarithmic] = (high if weak > 0 else low)[logarithmic]
    found = []
    for i, (_, p) in enumerate(hypothesis.searched):
        if p.name not in severe:
            continue
        for sign in (-1,) if p.prior.log and weak > 0 else (1,) if p.prior.log else (1, -1):
            if p.prior.log:
                at = sign * _LOG_SIZES
            else:
                at = nothing[i] + sign * max(1.0, abs(nothing[i])) * np.array(_SIZES)
            at = np.unique(np.clip(at, low[i], high[i]))[:: int(sign)]
            at = at[at != nothing[i]]
            if not at.size:
                continue
            points = np.repeat(nothing[:, None], at.size, axis=1)
            points[i] = at
            name = f"{_name(hypothesis)} {p.name} {'+' if sign > 0 else '-'}"
            sizes = hypothesis.values(points)[i]
            found.append(
                Ray(name, hypothesis, p, points, sizes if p.prior.log else np.abs(sizes - p.neutral))
            )
    return found


def _rivals(hypothesis: Hypothesis, own: Sequence[Ray]) -> tuple[list[Rival], list[Change]]:
    """Rivals that a hypothesis makes, of its ``own`` rays and of a typical size with each other parameter moved; and
    the changes whose columns these need beside the rays."""
    severe = hypothesis.effect(hypothesis.effects[0]).severity
    shapes = [i for i, (_, p) in enumerate(hypothesis.searched) if p.name not in severe]
    tone = next((i for i in shapes if hypothesis.searched[i][1].name == "frequency"), None)
    if tone is not None:
        return _resonances(hypothesis, own[0], tone, [i for i in shapes if i != tone])
    names, scale = list[str](), list[float]()
    for ray in own:
        names += ray.names
        scale += [1.0 if ray.parameter.prior.log else 1.0 / _SIZES[i] for i in range(ray.sizes.size)]
    changes = []
    if shapes:
        points = _moved(hypothesis, own[0].points[:, own[0].typical], shapes)[:, 1:]
        shape_names = tuple(f"{_name(hypothesis)} shape {i}" for i in range(points.shape[1]))
        changes.append(Change(hypothesis, points, shape_names))
        names += shape_names
        scale += [_SIZES[-1]] * len(shape_names)
    return [Rival(hypothesis, tuple(names), np.array(scale))], changes


def _resonances(
    hypothesis: Hypothesis, ray: Ray, tone: int, shapes: Sequence[int]
) -> tuple[list[Rival], list[Change]]:
    """A rival for each few neighbouring frequencies of a resonance: responses at distant frequencies are unlike, and
    both at once are impossible."""
    changes = []
    for number, frequency in enumerate(_TONES.tolist()):
        middle = ray.points[:, ray.typical].copy()
        middle[tone] = frequency
        points = _moved(hypothesis, middle, shapes)
        names = tuple(f"{_name(hypothesis)} tone {number} {i}" for i in range(points.shape[1]))
        changes.append(Change(hypothesis, points, names))
    rivals = []
    for first in range(0, len(changes) - _TOGETHER + 1, _TOGETHER - 1):
        names = tuple(n for change in changes[first : first + _TOGETHER] for n in change.names)
        rivals.append(Rival(hypothesis, names, np.full(len(names), _SIZES[-1])))
    return rivals, changes


def _moved(hypothesis: Hypothesis, point: Floats, shapes: Sequence[int]) -> Floats:
    """(k, 1 + 2 s) a point, and half a standard deviation either way in each of some coordinates (of a phase a quarter
    of a turn)."""
    points = np.repeat(point[:, None], 1 + 2 * len(shapes), axis=1)
    for n, i in enumerate(shapes):
        points[i, 1 + 2 * n : 3 + 2 * n] += (0.5, -0.5)
    low, high = hypothesis.bounds()
    return np.asarray(np.clip(points, low[:, None], high[:, None]))


@dataclass(frozen=True, eq=False)
class _Library:
    """Rays and rivals of all effects, and the changes whose columns they need."""

    rays: tuple[Ray, ...]
    rivals: tuple[Rival, ...]
    changes: tuple[Change, ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids in their order."""
        return tuple(dict.fromkeys(ray.effect for ray in self.rays))


def _library(twin: Twin, drive: Observation, effects: Sequence[str]) -> _Library:
    """Rays and rivals of the library; which way logarithmic severities vanish is seen on a ``drive``."""
    own, rivals, changes = list[Ray](), list[Rival](), list[Change]()
    offered = [h for variants in library(twin, True, effects).values() for h in variants]
    for hypothesis, sign in zip(offered, _vanishing(twin, drive, offered), strict=True):
        mine = rays(hypothesis, sign)
        more, needed = _rivals(hypothesis, mine)
        points = np.concatenate([ray.points for ray in mine], axis=1)
        own += mine
        rivals += more
        changes += [Change(hypothesis, points, tuple(n for ray in mine for n in ray.names)), *needed]
    return _Library(tuple(own), tuple(rivals), tuple(changes))


def alternatives(twin: Twin, drive: Observation) -> tuple[list[Rival], list[Change]]:
    """All rivals of the library on a twin, and the changes whose columns they need; ``drive`` shows which way
    logarithmic severities vanish."""
    known = _library(twin, drive, ())
    return list(known.rivals), list(known.changes)


def _vanishing(twin: Twin, drive: Observation, offered: Sequence[Hypothesis]) -> list[float]:
    """For each hypothesis the sign of the coordinate towards which its logarithmic severities vanish, 1 for those
    without."""
    ends = []
    for hypothesis in offered:
        severe = hypothesis.effect(hypothesis.effects[0]).severity
        log = [p.prior.log and p.name in severe for _, p in hypothesis.searched]
        points = np.repeat(hypothesis.neutral()[:, None], 2, axis=1)
        points[log] = np.array([2.0, -2.0])
        ends.append(Change(hypothesis, points, (f"{_name(hypothesis)} high", f"{_name(hypothesis)} low")))
    found = products(twin, drive, ends)
    size = np.sqrt(np.diag(found.white))[found.known :].reshape(-1, 2)
    return [1.0 if above <= below else -1.0 for above, below in size.tolist()]


def plan(
    twin: Twin,
    road: Road | None = None,
    speeds: Sequence[float] = SPEEDS,
    effects: Sequence[str] = (),
    on_progress: Callable[[str, float], None] = lambda text, share: None,
) -> Plan:
    """Smallest sizes of effects that drives over a road could show, and pairs that they could not tell apart.

    Parameters
    ----------
    twin : Twin
        The vehicle with its sensor.
    road : Road, optional
        The road; that of the twin file by default.
    speeds : sequence of float
        km/h, a drive for each.
    effects : sequence of str
        Ids to which the library is limited; empty for all of it.
    on_progress : callable
        Gets a text and the share of the work that is done.

    Returns
    -------
    Plan
        Sizes, angles, pairs and the changes that would separate them.

    Raises
    ------
    InputError
        A twin that does not drive on roads, a road that is too short, a speed that cannot be driven.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = load_twin("bags/bump_15kmh/twin.yaml")
    >>> found = plan(twin, speeds=(15.0,), effects=("sensor_offset",))
    >>> [row.parameter for row in found.detectability if row.size is None]  # over a bump as wide as the road
    ['y', 'z']
    """
    if model_of(twin).recordings != "drive":
        raise InputError("twin", "model", f"{twin.model} does not drive on a road: there is nothing to plan")
    if model_of(twin).opaque:
        raise InputError(
            "twin", "model", f"{twin.model} has equations of its own, in which no effect can be tried"
        )
    if not speeds:
        raise InputError("speed", "none is given")
    road = road_of(twin) if road is None else road
    twin = twin.model_copy(update={"road": None})
    speeds = tuple(dict.fromkeys(float(v) for v in speeds))
    on_progress("simulating", 0.0)
    drives = [planned_drive(twin, road, kmh) for kmh in speeds]
    known = _library(twin, drives[-1], effects)
    on_progress("sensitivities", 0.1)
    found = _together(twin, drives, known.changes)
    on_progress("comparing effects", 0.4)
    shown = _detectability(twin, found, known.rays)
    detected = [_Detected.of(r, s) for r, s in zip(known.rays, shown, strict=True) if s.size is not None]
    angles, near = _pairs(found, known, detected)
    on_progress("looking for what would separate pairs", 0.6)
    pairs = _remedied(found, known, near, _options(twin, road, drives, speeds)) if near else []
    seconds = tuple(float(d.t[-1] - d.t[0]) for d in drives)
    return Plan(twin, road.name, speeds, seconds, _weaker_ways(shown), known.effects, angles, tuple(pairs))


def _together(twin: Twin, drives: Iterable[Observation], changes: Sequence[Change]) -> Products:
    return reduce(add, side_by_side(lambda drive: products(twin, drive, changes), list(drives)))


def _detectability(twin: Twin, found: Products, rays: Sequence[Ray]) -> list[Detectability]:
    """Detectability of each ray."""
    ratios, _ = found.left(found.columns([name for ray in rays for name in ray.names]))
    out, first = [], 0
    for ray in rays:
        own = ratios[:, first : first + ray.sizes.size]
        first += ray.sizes.size
        size, largest = ray.size_from(own.max(axis=0), DETECTABLE), float(ray.sizes[-1])
        usual = _usual_size(twin, ray.effect, ray.parameter)
        if size is not None and not ray.parameter.prior.log:  # sizes of sound vehicles are no finding
            size = max(size, usual) if usual < largest else None
        best = int(np.argmax(own[:, -1]))
        out.append(
            Detectability(
                ray.effect,
                _place(ray.hypothesis),
                ray.parameter.name,
                size,
                float(ray.sizes[ray.typical]),
                largest,
                float(own[best, -1]),
                found.channels[best],
            )
        )
    return out


def _weaker_ways(shown: Sequence[Detectability]) -> tuple[Detectability, ...]:
    """One row for each parameter: of the two ways that it can grow the one that shows less."""
    weaker: dict[tuple[str, str, str], Detectability] = {}
    for row in shown:
        key = row.effect, row.place, row.parameter
        if key not in weaker or row.ratio < weaker[key].ratio:
            weaker[key] = row
    return tuple(weaker.values())


@dataclass(frozen=True, eq=False)
class _Detected:
    """A ray that is detected: its ``points`` are the first of its points that is, and its largest."""

    ray: Ray
    shown: Detectability
    points: tuple[int, ...]

    @classmethod
    def of(cls, ray: Ray, shown: Detectability) -> _Detected:
        assert shown.size is not None
        enough = [i for i, size in enumerate(ray.sizes) if ray.rank(size) >= ray.rank(shown.size)]
        last = ray.sizes.size - 1
        return cls(ray, shown, tuple(dict.fromkeys([enough[0] if enough else last, last])))

    @property
    def names(self) -> list[str]:
        """Names of its two columns."""
        return [self.ray.names[i] for i in self.points]


def _columns(found: Products, detected: Sequence[_Detected]) -> tuple[NDArray[np.intp], list[int]]:
    """Columns of rays, and where those of each begin."""
    starts = np.cumsum([0, *(len(one.points) for one in detected)])[:-1].tolist()
    return found.columns([name for one in detected for name in one.names]), starts


def _apart(found: Products, detected: Sequence[_Detected], rival: Rival) -> tuple[list[float | None], Floats]:
    """For each ray the size from which on a rival leaves enough of it (the first that is detected, a larger one, or
    None), and the whitened squares that it leaves of the first."""
    columns, starts = _columns(found, detected)
    ratios, squares = found.left(columns, found.columns(rival.names), rival.scale)
    sizes: list[float | None] = []
    for one, first in zip(detected, starts, strict=True):
        own = ratios[:, first : first + len(one.points)].max(axis=0)
        enough = own[0] >= APART
        sizes.append(one.shown.size if enough else one.ray.size_from(own, APART, one.points))
    return sizes, squares[starts]


def _largest(ray: Ray, sizes: Sequence[float | None]) -> float | None:
    """The most severe of these sizes; None where one of them is never reached."""
    known = [size for size in sizes if size is not None]
    return max(known, key=ray.rank) if len(known) == len(sizes) else None


@dataclass(frozen=True, eq=False)
class _Confusable:
    """A pair, its ray, and the rivals that leave too little of it."""

    pair: Pair
    detected: _Detected
    rivals: tuple[Rival, ...]

    @property
    def names(self) -> list[str]:
        """Names of the columns that concern it."""
        return [*self.detected.names, *(name for rival in self.rivals for name in rival.names)]

    def size_with(self, found: Products) -> float | None:
        """The size from which on all of its rivals leave enough of the ray, with other products."""
        sizes = [_apart(found, [self.detected], rival)[0][0] for rival in self.rivals]
        return _largest(self.detected.ray, sizes)


def _pairs(
    found: Products, known: _Library, detected: Sequence[_Detected]
) -> tuple[Floats, list[_Confusable]]:
    """Angles between effects, and the pairs that look alike at a size that would be detected: of each the ray and the
    rivals that are nearest."""
    effects = known.effects
    angles = np.full((len(effects), len(effects)), np.nan)
    near: dict[tuple[str, str], list[tuple[_Detected, Rival, float, float | None]]] = {}
    if not detected:
        return angles, []
    columns, starts = _columns(found, detected)
    alone = found.left(columns)[1][starts]
    for rival in known.rivals:
        sizes, left = _apart(found, detected, rival)
        sine = np.sqrt(np.clip(left / np.maximum(alone, 1e-12), 0.0, 1.0))
        for one, size, angle in zip(detected, sizes, np.degrees(np.arcsin(sine)).tolist(), strict=True):
            if rival.effect == one.ray.effect:
                continue
            place = effects.index(one.ray.effect), effects.index(rival.effect)
            angles[place] = np.fmin(angles[place], angle)
            if size != one.shown.size:
                near.setdefault((one.ray.effect, rival.effect), []).append((one, rival, angle, size))
    out = []
    for (effect, other), those in near.items():
        one, _, angle, _ = min(those, key=lambda each: (each[3] is not None, each[2]))
        own = [each for each in those if each[0] is one]
        size = _largest(one.ray, [each[3] for each in own])
        pair = Pair(one.ray.name, effect, one.shown, other, angle, size)
        out.append(_Confusable(pair, one, tuple(each[1] for each in own)))
    return angles, sorted(out, key=lambda each: (each.pair.size is not None, each.pair.angle))


# -- changes of the set-up ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Option:
    """A change of the set-up: ``drives`` (road, km/h, name) by a twin, ``added`` to the planned ones or in their
    place."""

    name: str
    twin: Twin
    drives: tuple[tuple[Road, float, str], ...]
    added: bool


def _options(twin: Twin, road: Road, drives: Sequence[Observation], speeds: Sequence[float]) -> list[_Option]:
    """Changes of the set-up that are tried: one more speed, an obstacle, another place of the sensor."""
    given = [float(d.along.max()) * 3.6 for d in drives]
    options = [
        _Option(f"one more drive at {kmh:g} km/h", twin, ((road, kmh, f"{kmh:g} km/h more"),), True)
        for kmh in _MENU["other_speeds_kmh"]
        if all(not 0.75 < kmh / v < 1.33 for v in given)
    ]
    options += [
        _Option(f"{name} at {kmh:g} km/h", twin, ((obstacle, kmh, name),), True)
        for name, obstacle, kmh in manoeuvres(planned=True)
    ]
    x, _, z = twin.imu.position
    front, rear = (float(f(twin.vehicle.wheel_positions[:, 0])) for f in (np.max, np.min))
    side = 0.4 * float(np.ptp(twin.vehicle.wheel_positions[:, 1]))
    again = tuple((road, kmh, f"{kmh:g} km/h") for kmh in speeds)
    for name, place in (
        ("the sensor over the front axle", (front, 0.0, z)),
        ("the sensor over the rear axle", (rear, 0.0, z)),
        ("the sensor at the left side", (x, side, z)),
    ):
        moved = twin.with_changes({f"imu.position.{i}": v for i, v in enumerate(place)})
        options.append(_Option(name, moved, again, False))
    return options


def _remedied(
    found: Products, known: _Library, near: Sequence[_Confusable], options: Sequence[_Option]
) -> list[Pair]:
    """Pairs with the change of the set-up that separates them at the smallest size."""
    needed = {name for each in near for name in each.names}
    changes = [few for change in known.changes if (few := change.only(needed)).names]

    def tried(option: _Option) -> list[float | None]:
        try:
            drives = [planned_drive(option.twin, *drive) for drive in option.drives]
            changed = _together(option.twin, drives, changes)
        except SuspensionTwinError:  # no such drive with this vehicle
            return [None] * len(near)
        changed = found + changed if option.added else changed
        return [each.size_with(changed) for each in near]

    best = [each.pair for each in near]
    for option, sizes in zip(options, side_by_side(tried, options), strict=True):
        for n, (each, size) in enumerate(zip(near, sizes, strict=True)):
            pair, rank = best[n], each.detected.ray.rank
            least = pair.size if pair.remedy_size is None else pair.remedy_size
            if size is not None and (least is None or rank(size) < rank(least) - _BETTER):
                best[n] = replace(pair, remedy=option.name, remedy_size=size)
    return best
