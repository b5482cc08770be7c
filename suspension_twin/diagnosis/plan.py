# SPDX-License-Identifier: Apache-2.0
"""What a set-up could show before anyone drives: smallest sizes of effects, and pairs that look alike.

A change of the sensor's readings by an effect is projected off everything that a diagnosis fits anyway: the parameters
of the vehicle and the nuisances, within their bounds. What is left counts in units of the residual to be expected of a
sound model, channel by channel and drive by drive (its largest ratio of rms values). Two thresholds, both read off the
blind benchmark, turn ratios into answers: from ``DETECTABLE`` on an effect is named, and a pair is distinguished where
one effect leaves ``APART`` of the other whatever its own parameters are.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.library import library
from suspension_twin.diagnosis.sensitivity import Change, Products, planned_drive, products
from suspension_twin.effects.base import Parameter
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.files import write_text
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.observation import Observation, road_of
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.models.registry import model_of
from suspension_twin.road import Road, add_bump, bump_road, half_sine
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "APART",
    "DETECTABLE",
    "SPEEDS",
    "Pair",
    "Plan",
    "Ray",
    "Rival",
    "Shown",
    "alternatives",
    "plan",
    "rays",
]

#: km/h if none are given.
SPEEDS: Final = (20.0, 40.0)
#: Expected residuals from which on an effect is named, and that a rival has to leave: learnt by
#: benchmarks/plan_confusion.py on diagnoses of the blind benchmark, whose floors are about twice these units.
DETECTABLE: Final = 0.5
APART: Final = 0.25
#: Sizes of an effect, in the scale of its prior; the last is its largest plausible size.
_SIZES: Final = (0.1, 0.2, 0.45, 1.0, 3.0)
#: The same of a logarithmic one, in standard deviations from typical, weak to strong.
_LOG_SIZES: Final = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0)
#: km/h that are tried where a pair cannot be told apart.
_OTHER_SPEEDS: Final = (10.0, 30.0, 60.0)
#: e-folds of size by which a change of the set-up has to be better than another to be named instead.
_BETTER: Final = 0.1
#: Frequencies of a resonance, in standard deviations from typical; that many neighbours make one rival.
_TONES: Final = tuple(np.linspace(-1.5, 1.5, 25).tolist())
_TOGETHER: Final = 3


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
        wanted = _LOG_SIZES.index(0.0) if self.parameter.log else _SIZES.index(1.0)
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
            return float(sizes[0] if self.parameter.log else sizes[0] * threshold / ratios[0])
        low, high = np.log(np.maximum(ratios[at - 1 : at + 1], 1e-12))
        share = (np.log(threshold) - low) / max(high - low, 1e-12)
        return float(sizes[at - 1] * (sizes[at] / sizes[at - 1]) ** share)


@dataclass(frozen=True)
class Shown:
    """How well a parameter of an effect shows: the smallest detectable ``size``, in the parameter's unit (a change
    from neutral, or the value of a logarithmic one), None where even the largest plausible size is below the
    threshold; the ``channel`` that shows it first; ``ratio`` of the ``largest`` size; no ``size`` is below the
    ``usual`` one, which sound vehicles have."""

    effect: str
    place: str
    parameter: str
    unit: str
    size: float | None
    typical: float
    largest: float
    usual: float
    ratio: float
    channel: str


@dataclass(frozen=True)
class Pair:
    """An effect, by the ray that is taken most easily for a rival, beside this ``rival``: the ``angle`` in degrees
    between what is left of the two, ``size`` from which on the rival leaves enough of the effect (None: never), and the
    best of the tried changes of the set-up, ``remedy``, with the size that it needs."""

    ray: str
    effect: str
    shown: Shown
    rival: str
    angle: float
    size: float | None
    remedy: str = ""
    remedy_size: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """What a set-up could show: what :func:`plan` returns.

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
    shown : tuple of Shown
        A row for every parameter of every effect.
    effects : tuple of str
        Ids of the effects, in the order of ``angles``.
    angles : (E, E) array
        Degrees between what is left of an effect (row) and a rival (column), the smallest over the parameters that
        show; NaN where none does.
    pairs : tuple of Pair
        Pairs that this set-up could not tell apart at any plausible size, or only from a size on beyond the detectable.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> found = plan(load_twin("bags/bump_15kmh/twin.yaml"), speeds=(15.0,), effects=("sensor_scale",))
    >>> [row.channel for row in found.shown]
    ['vertical_acceleration']
    """

    twin: Twin
    road: str
    speeds: tuple[float, ...]
    seconds: tuple[float, ...]
    shown: tuple[Shown, ...]
    effects: tuple[str, ...]
    angles: Floats
    pairs: tuple[Pair, ...]

    def as_dict(self) -> dict[str, Any]:
        """What ``plan.json`` holds."""
        return {
            "vehicle": getattr(self.twin.vehicle, "name", ""),
            "road": self.road,
            "drives": [
                {"speed_kmh": kmh, "seconds": round(s, 2)}
                for kmh, s in zip(self.speeds, self.seconds, strict=True)
            ],
            "thresholds": {"detectable": DETECTABLE, "apart": APART, "unit": "expected residual, rms"},
            "effects": [asdict(row) for row in self.shown],
            "pairs": [{k: v for k, v in asdict(pair).items() if k != "ray"} for pair in self.pairs],
            "angles_deg": {
                effect: {
                    rival: round(float(angle), 2)
                    for rival, angle in zip(self.effects, row, strict=True)
                    if np.isfinite(angle)
                }
                for effect, row in zip(self.effects, self.angles, strict=True)
            },
        }

    def write(self, folder: Path) -> None:
        """Write ``folder/plan.json``."""
        text = json.dumps(self.as_dict(), indent=2, ensure_ascii=False, allow_nan=False)
        write_text(folder / "plan.json", text + "\n")


@dataclass(frozen=True, eq=False)
class Rival:
    """What an effect can make: ``names`` of its columns and how large a multiple of each is plausible."""

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
    logarithmic = np.array([p.log and p.name in severe for _, p in hypothesis.searched])
    nothing[logarithmic] = (high if weak > 0 else low)[logarithmic]
    found = []
    for i, (_, p) in enumerate(hypothesis.searched):
        if p.name not in severe:
            continue
        for sign in (-1,) if p.log and weak > 0 else (1,) if p.log else (1, -1):
            if p.log:
                at = sign * np.array(_LOG_SIZES)
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
            found.append(Ray(name, hypothesis, p, points, sizes if p.log else np.abs(sizes - p.neutral)))
    return found


def _rivals(hypothesis: Hypothesis, own: Sequence[Ray]) -> tuple[list[Rival], list[Change]]:
    """What a hypothesis can make, and the columns that this needs beside its ``own`` rays: of these rays, and of a
    typical size with each other parameter moved."""
    severe = hypothesis.effect(hypothesis.effects[0]).severity
    shapes = [i for i, (_, p) in enumerate(hypothesis.searched) if p.name not in severe]
    tone = next((i for i in shapes if hypothesis.searched[i][1].name == "frequency"), None)
    if tone is not None:
        return _resonances(hypothesis, own[0], tone, [i for i in shapes if i != tone])
    names, scale = list[str](), list[float]()
    for ray in own:
        names += ray.names
        scale += [1.0 if ray.parameter.log else 1.0 / _SIZES[i] for i in range(ray.sizes.size)]
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
    """A rival for each few neighbouring frequencies of a resonance: what it makes at one is nothing like what it makes
    at another, and both at once it cannot make."""
    changes = []
    for number, frequency in enumerate(_TONES):
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
class _Asked:
    """Everything that is asked of every drive."""

    rays: tuple[Ray, ...]
    rivals: tuple[Rival, ...]
    changes: tuple[Change, ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids in their order."""
        return tuple(dict.fromkeys(ray.effect for ray in self.rays))


def _asked(twin: Twin, drive: Observation, effects: Sequence[str]) -> _Asked:
    """Rays and rivals of the library; which way logarithmic severities vanish is seen on a ``drive``."""
    own: list[Ray] = []
    rivals: list[Rival] = []
    changes: list[Change] = []
    offered = [h for variants in library(twin, True, effects).values() for h in variants]
    weak = _vanishing(twin, drive, offered)
    for hypothesis, sign in zip(offered, weak, strict=True):
        mine = rays(hypothesis, sign)
        more, needed = _rivals(hypothesis, mine)
        own += mine
        rivals += more
        points = np.concatenate([ray.points for ray in mine], axis=1)
        changes += [Change(hypothesis, points, tuple(n for ray in mine for n in ray.names)), *needed]
    return _Asked(tuple(own), tuple(rivals), tuple(changes))


def alternatives(twin: Twin, drive: Observation) -> tuple[list[Rival], list[Change]]:
    """All rivals of the library on a twin, and the changes whose columns they need; ``drive`` shows which way
    logarithmic severities vanish."""
    asked = _asked(twin, drive, ())
    return list(asked.rivals), list(asked.changes)


def _vanishing(twin: Twin, drive: Observation, offered: Sequence[Hypothesis]) -> list[float]:
    """For each hypothesis the sign of the coordinate towards which its logarithmic severities vanish, 1 for those
    without."""
    ends = []
    for hypothesis in offered:
        severe = hypothesis.effect(hypothesis.effects[0]).severity
        log = [p.log and p.name in severe for _, p in hypothesis.searched]
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
    """What drives over a road could show of each effect, and which pairs they could not tell apart.

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
        Sizes, angles, pairs and what would separate them.

    Raises
    ------
    InputError
        A twin that does not drive on roads, a road that is too short, a speed that cannot be driven.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = load_twin("bags/bump_15kmh/twin.yaml")
    >>> found = plan(twin, speeds=(15.0,), effects=("sensor_offset",))
    >>> [row.parameter for row in found.shown if row.size is None]  # over a bump as wide as the road
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
    asked = _asked(twin, drives[-1], effects)
    on_progress("sensitivities", 0.1)
    found = _together(twin, drives, asked.changes)
    on_progress("comparing effects", 0.4)
    shown = _shown(twin, found, asked.rays)
    seen = [_Seen.of(r, s) for r, s in zip(asked.rays, shown, strict=True) if s.size is not None]
    angles, near = _pairs(found, asked, seen)
    on_progress("looking for what would separate pairs", 0.6)
    return Plan(
        twin,
        road.name,
        speeds,
        tuple(float(d.t[-1] - d.t[0]) for d in drives),
        _both_ways(shown),
        asked.effects,
        angles,
        tuple(_remedied(twin, road, drives, found, asked, near)),
    )


def _together(twin: Twin, drives: Sequence[Observation], changes: Sequence[Change]) -> Products:
    return reduce(add, side_by_side(lambda drive: products(twin, drive, changes), drives))


def _shown(twin: Twin, found: Products, rays: Sequence[Ray]) -> list[Shown]:
    """How well each ray shows."""
    columns = found.columns([name for ray in rays for name in ray.names])
    ratios, _ = found.left(columns)
    out, first = [], 0
    for ray in rays:
        own = ratios[:, first : first + ray.sizes.size]
        first += ray.sizes.size
        size = ray.size_from(own.max(axis=0), DETECTABLE)
        effect, p = ray.hypothesis.effect(ray.effect), ray.parameter
        usual = max(
            p.usual, effect.usual_share * getattr(twin.vehicle, "mass", 0.0) if p.unit == "kg" else 0.0
        )
        if size is not None and not p.log:  # what sound vehicles have is no finding
            size = max(size, usual) if usual < ray.sizes[-1] else None
        out.append(
            Shown(
                ray.effect,
                _place(ray.hypothesis),
                p.name,
                p.unit,
                size,
                float(ray.sizes[ray.typical]),
                float(ray.sizes[-1]),
                usual,
                float(own[:, -1].max()),
                found.channels[int(np.argmax(own[:, -1]))],
            )
        )
    return out


def _both_ways(shown: Sequence[Shown]) -> tuple[Shown, ...]:
    """One row for each parameter: of the two ways that it can grow the one that shows less."""
    worst: dict[tuple[str, str, str], Shown] = {}
    for row in shown:
        key = row.effect, row.place, row.parameter
        other = worst.get(key)
        if other is None or row.ratio < other.ratio:
            worst[key] = row
    return tuple(worst.values())


@dataclass(frozen=True, eq=False)
class _Seen:
    """A ray that is detected: its ``points`` are the first of its points that is, and its largest."""

    ray: Ray
    shown: Shown
    points: tuple[int, ...]

    @classmethod
    def of(cls, ray: Ray, shown: Shown) -> _Seen:
        assert shown.size is not None
        enough = [i for i, size in enumerate(ray.sizes) if ray.rank(size) >= ray.rank(shown.size)]
        last = ray.sizes.size - 1
        return cls(ray, shown, tuple(dict.fromkeys([enough[0] if enough else last, last])))

    @property
    def names(self) -> list[str]:
        """Names of its two columns."""
        return [self.ray.names[i] for i in self.points]


def _apart(found: Products, seen: Sequence[_Seen], rival: Rival) -> tuple[list[float | None], Floats]:
    """For each ray the size from which on a rival leaves enough of it (the first that is detected, a larger one, or
    None), and the whitened squares that it leaves of the first."""
    columns = _columns(found, seen)
    ratios, squares = found.left(columns, found.columns(rival.names), rival.scale)
    sizes: list[float | None] = []
    starts = np.cumsum([0, *(len(one.points) for one in seen)])
    for one, first in zip(seen, starts, strict=False):
        own = ratios[:, first : first + len(one.points)].max(axis=0)
        enough = own[0] >= APART
        sizes.append(one.shown.size if enough else one.ray.size_from(own, APART, one.points))
    return sizes, squares[starts[:-1]]


def _columns(found: Products, seen: Sequence[_Seen]) -> NDArray[np.intp]:
    return found.columns([name for one in seen for name in one.names])


@dataclass(frozen=True, eq=False)
class _Alike:
    """A pair, its ray, and the rivals that leave too little of it."""

    pair: Pair
    seen: _Seen
    rivals: tuple[Rival, ...]

    @property
    def names(self) -> list[str]:
        """Names of the columns that concern it."""
        return [*self.seen.names, *(name for rival in self.rivals for name in rival.names)]

    def size_with(self, found: Products) -> float | None:
        """The size from which on all of its rivals leave enough of the ray, with other products."""
        sizes = [_apart(found, [self.seen], rival)[0][0] for rival in self.rivals]
        known = [size for size in sizes if size is not None]
        return max(known, key=self.seen.ray.rank) if len(known) == len(sizes) else None


def _pairs(found: Products, asked: _Asked, seen: Sequence[_Seen]) -> tuple[Floats, list[_Alike]]:
    """Angles between effects, and the pairs that look alike at a size that would be detected: of each the ray and the
    rivals that are nearest."""
    effects = asked.effects
    angles = np.full((len(effects), len(effects)), np.nan)
    near: dict[tuple[str, str], list[tuple[_Seen, Rival, float, float | None]]] = {}
    if not seen:
        return angles, []
    _, squares = found.left(_columns(found, seen))
    alone = squares[np.cumsum([0, *(len(one.points) for one in seen)])[:-1]]
    for rival in asked.rivals:
        sizes, left = _apart(found, seen, rival)
        sine = np.sqrt(np.clip(left / np.maximum(alone, 1e-12), 0.0, 1.0))
        for one, size, angle in zip(seen, sizes, np.degrees(np.arcsin(sine)).tolist(), strict=True):
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
        needed = [each[3] for each in own]
        known = [size for size in needed if size is not None]
        largest = max(known, key=one.ray.rank) if len(known) == len(needed) else None
        pair = Pair(one.ray.name, effect, one.shown, other, angle, largest)
        out.append(_Alike(pair, one, tuple(each[1] for each in own)))
    return angles, sorted(out, key=lambda alike: (alike.pair.size is not None, alike.pair.angle))


def _remedied(
    twin: Twin,
    road: Road,
    drives: Sequence[Observation],
    found: Products,
    asked: _Asked,
    near: Sequence[_Alike],
) -> list[Pair]:
    """Pairs with the change of the set-up that separates them at the smallest size."""
    if not near:
        return []
    needed = {name for alike in near for name in alike.names}
    changes = [few for change in asked.changes if (few := change.only(needed)).names]

    def tried(option: tuple[str, Callable[[], Products]]) -> list[float | None]:
        try:
            changed = option[1]()
        except SuspensionTwinError:  # no such drive with this vehicle
            return [None] * len(near)
        return [alike.size_with(changed) for alike in near]

    options = _options(twin, road, drives, found, changes)
    best = [alike.pair for alike in near]
    for (name, _), sizes in zip(options, side_by_side(tried, options), strict=True):
        for n, (alike, size) in enumerate(zip(near, sizes, strict=True)):
            pair, rank = best[n], alike.seen.ray.rank
            known = pair.size if pair.remedy_size is None else pair.remedy_size
            if size is not None and (known is None or rank(size) < rank(known) - _BETTER):
                best[n] = replace(pair, remedy=name, remedy_size=size)
    return best


def _options(
    twin: Twin, road: Road, drives: Sequence[Observation], found: Products, changes: Sequence[Change]
) -> list[tuple[str, Callable[[], Products]]]:
    """Changes of the set-up that are tried: one more speed, another place of the sensor, a bump."""
    options: list[tuple[str, Callable[[], Products]]] = []

    def more(where: Road, kmh: float, name: str) -> Callable[[], Products]:
        return lambda: found + products(twin, planned_drive(twin, where, kmh, name), changes)

    def elsewhere(place: tuple[float, float, float]) -> Callable[[], Products]:
        moved = twin.with_changes({f"imu.position.{i}": v for i, v in enumerate(place)})
        return lambda: _together(moved, [_again(moved, road, d) for d in drives], changes)

    given = [float(d.along.max()) * 3.6 for d in drives]
    for kmh in _OTHER_SPEEDS:
        if all(not 0.75 < kmh / v < 1.33 for v in given):
            options.append((f"one more drive at {kmh:g} km/h", more(road, kmh, f"{kmh:g} km/h more")))
    for name, bump, kmh in _bumps():
        options.append((f"{name} at {kmh:g} km/h", more(bump, kmh, name)))
    x, _, z = twin.imu.position
    front, rear = (float(f(twin.vehicle.wheel_positions[:, 0])) for f in (np.max, np.min))
    side = 0.4 * float(np.ptp(twin.vehicle.wheel_positions[:, 1]))
    for name, place in (
        ("the sensor over the front axle", (front, 0.0, z)),
        ("the sensor over the rear axle", (rear, 0.0, z)),
        ("the sensor at the left side", (x, side, z)),
    ):
        options.append((name, elsewhere(place)))
    return options


def _again(twin: Twin, road: Road, drive: Observation) -> Observation:
    """The same drive with another twin."""
    return planned_drive(twin, road, float(drive.name.split()[0]), drive.name)


def _bumps() -> list[tuple[str, Road, float]]:
    """Obstacles to try, with the speed over each in km/h."""

    def bumped(length: float, height: float) -> Road:
        return bump_road(half_sine(length, height), at=30.0, length=70.0)

    left = add_bump(bumped(0.9, 1e-6), half_sine(0.9, 0.06), 40.0, v_low=0.1)
    return [
        ("a speed bump (7 cm high, 0.9 m long)", bumped(0.9, 0.07), 20.0),
        ("a sharp edge (3 cm high, 0.25 m long)", bumped(0.25, 0.03), 30.0),
        ("a bump under the left wheels only", left, 20.0),
    ]
