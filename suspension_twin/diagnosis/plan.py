# SPDX-License-Identifier: Apache-2.0
"""What a set-up could show before anyone drives: smallest sizes of effects, and pairs that look alike.

A change of the sensor's readings by an effect is projected off everything that a diagnosis fits anyway: the parameters
of the vehicle and the nuisances, within their bounds. What is left counts in units of the residual to be expected of a
sound model, channel by channel and drive by drive (its largest ratio of rms values). Two thresholds, both read off the
blind benchmark, turn ratios into answers: from ``DETECTABLE`` on an effect is named, and a pair is told apart where one
effect leaves ``APART`` of the other whatever its own parameters are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.hypotheses import Hypothesis, library
from suspension_twin.diagnosis.sensitivity import Change, PlannedDrive, Products, planned_drive, products
from suspension_twin.effects.base import Parameter
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.gap.prepare import road_of
from suspension_twin.identification.parallel import side_by_side
from suspension_twin.models.registry import model_of
from suspension_twin.road import Road, add_bump, bump_road, half_sine
from suspension_twin.vehicle.twin import Twin

__all__ = ["APART", "DETECTABLE", "SPEEDS", "Pair", "Plan", "Ray", "Shown", "plan", "rays"]

#: km/h if none are given.
SPEEDS: Final = (20.0, 40.0)
#: Expected residuals from which on an effect is named: at 1.5 it was in 148 of 166 cases of the blind benchmark
#: (benchmarks/results/blind_report*.json), at 5 in 145 of 157.
DETECTABLE: Final = 1.5
#: Expected residuals that a rival has to leave: see benchmarks/plan_confusion.py.
APART: Final = 0.5
#: Sizes of an effect, in the scale of its prior; the last is its largest plausible size.
_SIZES: Final = (0.1, 0.3, 1.0, 3.0)
#: The same of a logarithmic one, in standard deviations from typical, weak to strong.
_LOG_SIZES: Final = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0)
#: km/h that are tried where a pair cannot be told apart.
_OTHER_SPEEDS: Final = (8.0, 15.0, 30.0, 60.0)
#: e-folds of size by which a change of the set-up has to be better than another to be named instead.
_BETTER: Final = 0.1
#: Frequencies of a resonance, in standard deviations from typical.
_TONES: Final = (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5)


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
    threshold; the ``channel`` that shows it first; ``ratio`` of the ``largest`` size; ``usual`` is what sound vehicles
    have."""

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
    >>> found = plan(load_twin("bags/bump_15kmh/twin.yaml"), speeds=(15.0,))  # doctest: +SKIP
    """

    twin: Twin
    road: str
    speeds: tuple[float, ...]
    seconds: tuple[float, ...]
    shown: tuple[Shown, ...]
    effects: tuple[str, ...]
    angles: Floats
    pairs: tuple[Pair, ...]


@dataclass(frozen=True, eq=False)
class _Rival:
    """What a rival can make: ``names`` of its columns and how large a multiple of each is plausible."""

    hypothesis: Hypothesis
    names: tuple[str, ...]
    scale: Floats

    @property
    def effect(self) -> str:
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
    >>> from suspension_twin.diagnosis.hypotheses import library
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> friction = library(load_twin("bags/bump_15kmh/twin.yaml"), True)["strut_friction"][0]
    >>> [ray.sizes.tolist() for ray in rays(friction)]
    [[20.0, 60.0, 200.0, 600.0], [20.0, 60.0, 200.0, 600.0]]
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


def _rivals(hypothesis: Hypothesis, own: Sequence[Ray]) -> tuple[list[_Rival], list[Change]]:
    """What a hypothesis can make, and the columns that this needs beside its ``own`` rays.

    One rival, of the rays and of changes of the other parameters; of a resonance one for each of some frequencies,
    since what it makes at one is nothing like what it makes at another.
    """
    names: list[str] = []
    scale: list[float] = []
    for ray in own:
        for i, name in enumerate(ray.names):
            if ray.parameter.log:
                names, scale = [*names, name], [*scale, 1.0]
            elif _SIZES[i] != _SIZES[1]:
                names, scale = [*names, name], [*scale, 1.0 / _SIZES[i]]
    severe = hypothesis.effect(hypothesis.effects[0]).severity
    shapes = [i for i, (_, p) in enumerate(hypothesis.searched) if p.name not in severe]
    if not shapes:
        return [_Rival(hypothesis, tuple(names), np.array(scale))], []
    low, high = hypothesis.bounds()
    lead = own[0].points[:, own[0].typical]
    tones = [i for i in shapes if hypothesis.searched[i][1].name == "frequency"]
    out, changes = [], []
    for number, tone in enumerate(_TONES if tones else (0.0,)):
        middle = lead.copy()
        middle[tones] = tone
        moved = [middle] if tones else []
        for i in shapes:
            step = 0.5 * (_TONES[1] - _TONES[0]) if i in tones else 1.0
            for sign in (1.0, -1.0):
                other = middle.copy()
                other[i] += sign * step
                moved.append(other)
        points = np.clip(np.stack(moved, axis=1), low[:, None], high[:, None])
        own_names = tuple(f"{_name(hypothesis)} shape {number} {j}" for j in range(points.shape[1]))
        changes.append(Change(hypothesis, points, own_names))
        kept = () if tones else tuple(names)
        size = np.concatenate([() if tones else scale, np.full(len(own_names), _SIZES[-1])])
        out.append(_Rival(hypothesis, (*kept, *own_names), size))
    return out, changes


@dataclass(frozen=True, eq=False)
class _Asked:
    """Everything that is asked of every drive."""

    rays: tuple[Ray, ...]
    rivals: tuple[_Rival, ...]
    changes: tuple[Change, ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids in their order."""
        return tuple(dict.fromkeys(ray.effect for ray in self.rays))

    def of(self, effects: set[str]) -> _Asked:
        """What concerns some effects."""
        return _Asked(
            tuple(r for r in self.rays if r.effect in effects),
            tuple(r for r in self.rivals if r.effect in effects),
            tuple(c for c in self.changes if c.hypothesis.effects[0] in effects),
        )


def _asked(twin: Twin, drive: PlannedDrive, effects: Sequence[str]) -> _Asked:
    """Rays and rivals of the library; which way logarithmic severities vanish is seen on a ``drive``."""
    own: list[Ray] = []
    rivals: list[_Rival] = []
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


def _vanishing(twin: Twin, drive: PlannedDrive, offered: Sequence[Hypothesis]) -> list[float]:
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
    >>> found = plan(load_twin("bags/bump_15kmh/twin.yaml"), speeds=(15.0,))  # doctest: +SKIP
    >>> next(s.size for s in found.shown if s.effect == "strut_friction")  # doctest: +SKIP
    61.2
    """
    if model_of(twin).recordings != "drive":
        raise InputError("twin", "model", f"{twin.model} does not drive on a road: there is nothing to plan")
    if not speeds:
        raise InputError("speed", "none is given")
    road = road_of(twin) if road is None else road
    twin = twin.model_copy(update={"road": None})
    speeds = tuple(dict.fromkeys(float(v) for v in speeds))
    on_progress("simulating", 0.0)
    drives = [planned_drive(twin, road, kmh) for kmh in speeds]
    asked = _asked(twin, drives[-1], effects)
    on_progress("sensitivities", 0.1)
    found = _together(twin, drives, asked)
    on_progress("comparing effects", 0.4)
    shown = _shown(twin, found, asked.rays)
    seen = [_Seen.of(r, s) for r, s in zip(asked.rays, shown, strict=True) if s.size is not None]
    angles, pairs = _pairs(found, asked, seen)
    on_progress("looking for what would separate pairs", 0.6)
    return Plan(
        twin,
        road.name,
        speeds,
        tuple(float(d.t[-1] - d.t[0]) for d in drives),
        _both_ways(shown),
        asked.effects,
        angles,
        tuple(_remedied(twin, road, drives, found, asked, seen, pairs)),
    )


def _together(twin: Twin, drives: Sequence[PlannedDrive], asked: _Asked) -> Products:
    return reduce(add, side_by_side(lambda drive: products(twin, drive, asked.changes), drives))


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


def _apart(found: Products, seen: Sequence[_Seen], rival: _Rival) -> list[tuple[float, float | None]]:
    """For each ray the angle in degrees between it and a rival, and the size from which on the rival leaves enough of
    it: the first that is detected, a larger one, or None."""
    columns = found.columns([name for one in seen for name in one.names])
    _, alone = found.left(columns)
    ratios, squares = found.left(columns, found.columns(rival.names), rival.scale)
    sine = np.sqrt(np.clip(squares / np.maximum(alone, 1e-12), 0.0, 1.0))
    out, first = [], 0
    for one in seen:
        own = ratios[:, first : first + len(one.points)].max(axis=0)
        size = one.ray.size_from(own, APART, one.points)
        if own[0] >= APART:
            size = one.shown.size
        out.append((float(np.degrees(np.arcsin(sine[first]))), size))
        first += len(one.points)
    return out


def _pairs(found: Products, asked: _Asked, seen: Sequence[_Seen]) -> tuple[Floats, list[Pair]]:
    """Angles between effects, and the pairs that look alike at a size that would be detected."""
    effects = asked.effects
    angles = np.full((len(effects), len(effects)), np.nan)
    worst: dict[tuple[str, str], Pair] = {}
    for rival in asked.rivals if seen else ():
        for one, (angle, size) in zip(seen, _apart(found, seen, rival), strict=True):
            ray = one.ray
            if rival.effect == ray.effect:
                continue
            place = effects.index(ray.effect), effects.index(rival.effect)
            angles[place] = np.fmin(angles[place], angle)
            if size == one.shown.size:
                continue
            pair = Pair(ray.name, ray.effect, one.shown, rival.effect, angle, size)
            other = worst.get((ray.effect, rival.effect))
            if other is None or (size is None, -angle) > (other.size is None, -other.angle):
                worst[ray.effect, rival.effect] = pair
    return angles, sorted(worst.values(), key=lambda pair: (pair.size is not None, pair.angle))


def _remedied(
    twin: Twin,
    road: Road,
    drives: Sequence[PlannedDrive],
    found: Products,
    asked: _Asked,
    seen: Sequence[_Seen],
    pairs: Sequence[Pair],
) -> list[Pair]:
    """Pairs with the change of the set-up that separates them at the smallest size."""
    if not pairs:
        return []
    few = asked.of({effect for pair in pairs for effect in (pair.effect, pair.rival)})
    rays = {one.ray.name: one for one in seen}

    def tried(option: tuple[str, Callable[[], Products]]) -> list[float | None]:
        try:
            changed = option[1]()
        except SuspensionTwinError:  # no such drive with this vehicle
            return [None] * len(pairs)
        return [_separated(changed, few, rays[pair.ray], pair.rival) for pair in pairs]

    options = _options(twin, road, drives, found, few)
    best = list(pairs)
    for (name, _), sizes in zip(options, side_by_side(tried, options), strict=True):
        for n, (pair, size) in enumerate(zip(pairs, sizes, strict=True)):
            rank = rays[pair.ray].ray.rank
            known = best[n].remedy_size if best[n].remedy_size is not None else pair.size
            if size is not None and (known is None or rank(size) < rank(known) - _BETTER):
                best[n] = replace(pair, remedy=name, remedy_size=size)
    return best


def _separated(found: Products, few: _Asked, one: _Seen, rival: str) -> float | None:
    """The size from which on all that a rival can make leaves enough of a ray."""
    sizes = [_apart(found, [one], each)[0][1] for each in few.rivals if each.effect == rival]
    known = [size for size in sizes if size is not None]
    return max(known, key=one.ray.rank) if len(known) == len(sizes) else None


def _options(
    twin: Twin, road: Road, drives: Sequence[PlannedDrive], found: Products, few: _Asked
) -> list[tuple[str, Callable[[], Products]]]:
    """Changes of the set-up that are tried: one more speed, another place of the sensor, a bump."""
    options: list[tuple[str, Callable[[], Products]]] = []

    def more(where: Road, kmh: float, name: str) -> Callable[[], Products]:
        return lambda: found + products(twin, planned_drive(twin, where, kmh, name), few.changes)

    def elsewhere(place: tuple[float, float, float]) -> Callable[[], Products]:
        moved = twin.with_changes({f"imu.position.{i}": v for i, v in enumerate(place)})
        return lambda: _together(moved, [_moved(moved, road, d) for d in drives], few)

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


def _moved(twin: Twin, road: Road, drive: PlannedDrive) -> PlannedDrive:
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
