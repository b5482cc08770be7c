# SPDX-License-Identifier: Apache-2.0
"""Which cases there are: kinds, effects, severities, seeds and realities, in an order to take a sample from.

Development and the sets for reporting use other worlds. A case's name says nothing about it. The plans ``train`` (for
development), ``report4`` and ``report5`` (to report on) have the whole library, more that is outside it, four scenes
and twins that were calibrated beforehand; every case of theirs has a world of its own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from typing import Literal

import numpy as np

from blind.faults import (
    ADDED,
    ALIASES,
    LIBRARY,
    MSD,
    OF_THE_ROAD,
    OUTSIDE,
    RECORDED_LIBRARY,
    RECORDED_OUTSIDE,
    ROAD,
    SET_UP_ERRORS,
    WIDE_OUTSIDE,
)
from blind.world import Scene

Seeds = Literal[
    "dev",
    "report",
    "report2",
    "report3",
    "links_dev",
    "links",
    "train",
    "report4",
    "report5",
    "measured_dev",
    "measured",
    "flexible_dev",
    "flexible",
    "setup_dev",
    "setup",
]
Kind = Literal["single", "null", "outside", "excluded", "pair", "stretch"]
KINDS: tuple[Kind, ...] = ("single", "null", "outside", "excluded", "pair", "stretch")
SEVERITIES = (0.5, 1.5, 5.0)
REALITIES = ("newton", "multibody")
#: Seeds whose cars are the ones with linkages: fewer cases, and none of them faint.
LINKS = ("links_dev", "links")
LINKAGE = "linkage"
#: Plans of the whole library, and how many rounds through all kinds of cases they have; of those to report on the first
#: cases of a round alone.
WIDE = {"train": 3, "report4": 1, "report5": 1, "flexible_dev": 1, "flexible": 1}
#: Those of one reality alone.
_ONE_REALITY = {"flexible_dev": "flexible", "flexible": "flexible"}
_REPORTED = {"report4": 280, "report5": 300}
_FIRST = {
    "dev": 1000,
    "report": 500_000,
    "report2": 1_000_000,
    "links_dev": 2_000_000,
    "links": 3_000_000,
    "report3": 4_000_000,
    "train": 5_000_000,
    "report4": 6_000_000,
    "measured_dev": 7_000_000,
    "measured": 8_000_000,
    "flexible_dev": 9_000_000,
    "flexible": 10_000_000,
    "setup_dev": 11_000_000,
    "setup": 12_000_000,
    "report5": 13_000_000,
}
#: Seeds of set-up errors, gross ones among them, with a road and without one.
SET_UP = ("setup_dev", "setup")
#: Seeds whose cases are recordings of real cars with faults put into them.
RECORDED = ("measured_dev", "measured")
MEASURED = "measured"
WORLDS = 16  # that cases with an effect share
_PAIR = 3.0  # severity of each member
#: Pairs of parts that are broken at the same time often enough.
PAIRS = (
    ("strut_friction", "mount_resonance"),
    ("bump_stop", "tyre_envelope"),
    ("corner_damper", "sensor_tilt"),
    ("payload", "time_offset"),
    ("top_mount", "sensor_bandwidth"),
    ("road_scale", "mount_resonance"),
    ("anti_roll_bar", "damper_fade"),
    ("position_offset", "body_bending"),
    ("corner_spring", "tyre_damping"),
    ("powertrain_mount", "lateral_offset"),
    ("strut_friction", "clock_drift"),
    ("rebound_stop", "sensor_offset"),
)


#: Further pairs, of the wide plans.
_WIDE_PAIRS = (
    ("worn_dampers", "tyre_pressure"),
    ("spring_sag", "strut_friction"),
    ("wheel_imbalance", "mount_resonance"),
    ("engine_order", "worn_dampers"),
    ("tyre_pressure", "payload"),
    ("semi_active_damper", "sensor_bandwidth"),
    ("wheel_imbalance", "corner_damper"),
    ("spring_sag", "time_offset"),
)
#: Scenes of the wide plans, as often as they come.
_SCENES: tuple[Scene, ...] = ("usual", "smooth", "usual", "bump", "usual", "short")
_WIDE_SEVERITIES = (1.5, 3.0, 5.0)


#: Pairs of what recordings can be given.
_RECORDED_PAIRS = (
    ("time_offset", "sensor_tilt"),
    ("clock_drift", "sensor_tilt"),
    ("sensor_scale", "time_offset"),
    ("sensor_tilt", "sensor_scale"),
)


@dataclass(frozen=True)
class Spec:
    """One case before anything is simulated. ``without`` is taken out of the library for it. ``calibrated``: the twin
    file was calibrated on a drive from before the fault. ``wide``: of a plan of the whole library. ``gross``: a set-up
    error of a size that no tolerance has, drawn by seed. ``alike``: the reference has it as well. ``planar``: the twin
    file names no road."""

    name: str
    kind: Kind
    effects: tuple[str, ...]
    severity: float
    world: int
    reality: str
    reference: bool
    right: bool = False
    msd: bool = False
    without: tuple[str, ...] = ()
    scene: Scene = "usual"
    calibrated: bool = False
    wide: bool = False
    gross: bool = False
    alike: bool = False
    planar: bool = False


def plan(seeds: Seeds, short: bool = False) -> list[Spec]:
    """All cases of one set of seeds, mixed so that the first n are a fair sample of any n.

    The short plan is nine cases of the development seeds.
    """
    numbered = _wide if seeds in WIDE else _numbered
    if seeds in RECORDED:
        numbered = _recorded
    elif seeds in SET_UP:
        numbered = _set_up
    strata = {kind: list(numbered(seeds, kind)) for kind in KINDS}
    rng = np.random.default_rng(_FIRST[seeds])
    for kind, cases in strata.items():
        # Round by round through the effects, in another order each round.
        groups: dict[tuple[str, ...], list[Spec]] = {}
        for spec in cases:
            groups.setdefault(spec.effects, []).append(spec)
        for group in groups.values():
            rng.shuffle(group)
        mixed: list[Spec] = []
        for row in zip_longest(*groups.values()):
            there = [s for s in row if s is not None]
            rng.shuffle(there)
            mixed += there
        strata[kind] = mixed
    placed = [
        ((i + 0.5) / len(cases), k, i, spec)
        for k, cases in enumerate(s for s in strata.values() if s)
        for i, spec in enumerate(cases)
    ]
    everything = [spec for *_, spec in sorted(placed, key=lambda p: p[:3])]
    everything = everything[: _REPORTED.get(seeds)]
    return _short(everything) if short else everything


def _short(cases: list[Spec]) -> list[Spec]:
    """Two null cases, four effects that are plain to see, one outside, one excluded and one pair."""
    wanted = {"null": 2, "single": 4, "outside": 1, "excluded": 1, "pair": 1}
    out = []
    for spec in cases:
        if (
            wanted.get(spec.kind, 0)
            and spec.reality == "newton"
            and spec.severity >= 3.0 - 3.0 * (spec.kind == "null")
        ):
            wanted[spec.kind] -= 1
            out.append(spec)
    return out


def _numbered(seeds: Seeds, kind: Kind) -> Iterator[Spec]:
    links = seeds in LINKS
    for n, (effects, severity, world, more) in enumerate(_fewer(kind) if links else _cases(kind)):
        digest = hashlib.sha256(f"{seeds} {kind} {n} {effects} {severity}".encode()).hexdigest()
        coin = int(digest[-6:], 16)
        hidden = set(effects) & set(ROAD) or "stretch" in more or "unsprung_mass" in effects
        yield Spec(
            name=f"case_{digest[:10]}",
            kind=kind,
            effects=effects,
            severity=severity,
            world=_FIRST[seeds] + world,
            reality=LINKAGE if links else REALITIES[world % 2] if kind != "null" else REALITIES[coin % 2],
            # A reference shares the case's road file, whose faults would be in it as well.
            reference=not hidden and coin // 2 % 2 == 0,
            right=bool(more.get("right")),
            msd=any(e in MSD for e in effects),
            without=tuple(more.get("without", ())),  # type: ignore[arg-type]
        )


def _fewer(kind: Kind) -> Iterator[tuple[tuple[str, ...], float, int, dict[str, object]]]:
    """Of every effect and severity two cases, none below the floor; a third of the nulls."""
    taken: dict[tuple[tuple[str, ...], float], int] = {}
    for case in _cases(kind):
        key = case[:2]
        taken[key] = taken.get(key, 0) + 1
        if taken[key] <= (16 if kind == "null" else 2) and (kind == "null" or case[1] >= 1.0):
            yield case


def _cases(kind: Kind) -> Iterator[tuple[tuple[str, ...], float, int, dict[str, object]]]:
    if kind == "null":
        for i in range(48):
            yield (), 0.0, 100 + i, {"right": i % 2 == 1}
        return
    if kind == "single":
        for e, effect in enumerate(LIBRARY):
            for s, severity in enumerate(SEVERITIES):
                for k in range(4):
                    yield (effect,), severity, (5 * e + 3 * k + 4 * s) % WORLDS, {}
    elif kind == "outside":
        for e, effect in enumerate(OUTSIDE):
            for s, severity in enumerate((1.5, 5.0)):
                for k in range(4):
                    away = ALIASES.get(effect, (effect,))
                    yield (effect,), severity, (7 * e + 3 * k + 8 * s) % WORLDS, {"without": away}
    elif kind == "excluded":
        for e, effect in enumerate(LIBRARY):
            for k in range(2):
                yield (effect,), 5.0, (3 * e + 5 * k) % WORLDS, {"without": (effect,)}
    elif kind == "pair":
        for e, pair in enumerate(PAIRS):
            for k in range(2):
                yield pair, _PAIR, (3 * e + 5 * k) % WORLDS, {}
    else:
        for e, effect in enumerate(ROAD):
            for k in range(4):
                yield (effect,), 5.0, (3 * e + 5 * k) % WORLDS, {"stretch": True}


def _wide(seeds: Seeds, kind: Kind) -> Iterator[Spec]:
    """Cases of a plan of the whole library: whatever the kind, with a reference, without, and without but with a twin
    that was calibrated beforehand, in all scenes."""
    number = 0
    for turn in range(WIDE[seeds]):
        for effects, severity, without in _wide_cases(kind, turn):
            road = bool(set(effects) & set(OF_THE_ROAD))
            msd = any(e in MSD for e in effects)
            ways = ["before", "nothing", "calibrated"] if not (road or msd) else ["nothing"]
            if road and not msd:
                ways.append("calibrated")
            if kind == "null":
                ways.append("right")
            if kind in ("outside", "excluded", "pair"):  # each with and without a reference
                ways = [w for w in ways if w != "calibrated" or (turn + number) % 2]
            for way in ways:
                digest = hashlib.sha256(f"{seeds} {kind} {number} {effects} {severity}".encode()).hexdigest()
                coin = int(digest[-6:], 16)
                scene = _SCENES[number % 4 if kind == "null" else coin // 8 % len(_SCENES)]
                if kind == "null":
                    scene = ("usual", "smooth", "bump", "short")[number // 4 % 4]
                yield Spec(
                    name=f"case_{digest[:10]}",
                    kind=kind,
                    effects=effects,
                    severity=severity,
                    world=_FIRST[seeds] + 20_000 * KINDS.index(kind) + number,
                    reality=_ONE_REALITY.get(seeds) or _drawn(coin, msd, flexible=seeds == "report5"),
                    reference=way == "before",
                    right=way == "right",
                    msd=msd,
                    without=without,
                    scene=scene,
                    calibrated=way == "calibrated",
                    wide=True,
                )
                number += 1


def _drawn(coin: int, msd: bool, flexible: bool) -> str:
    """A reality; wheels on linkages have a mass."""
    cars = (*REALITIES, LINKAGE, *(["flexible"] if flexible else []))
    return REALITIES[coin % 2] if msd else cars[coin % len(cars)]


def _wide_cases(kind: Kind, turn: int) -> Iterator[tuple[tuple[str, ...], float, tuple[str, ...]]]:
    """Effects, severity and what is taken out of the library, in one of several rounds."""
    if kind == "null":
        for _ in range(16):
            yield (), 0.0, ()
    elif kind == "single":
        for effect in (*LIBRARY, *ADDED):
            for severity in _WIDE_SEVERITIES:
                yield (effect,), severity, ()
    elif kind == "outside":
        for e, effect in enumerate(WIDE_OUTSIDE):
            for severity in (1.5, 5.0) if (e + turn) % 2 else (3.0, 5.0):
                yield (effect,), severity, ALIASES.get(effect, ())
    elif kind == "excluded":
        for e, effect in enumerate((*LIBRARY, *ADDED)):
            yield (effect,), (5.0, 3.0)[(e + turn) % 2], (effect,)
    elif kind == "pair":
        for pair in (*PAIRS, *_WIDE_PAIRS):
            yield pair, (_PAIR, 5.0)[turn % 2], ()


def _recorded(seeds: Seeds, kind: Kind) -> Iterator[Spec]:
    """Cases of recordings, each with a stretch of its own, with a reference and without."""
    for number, (effects, severity, without, reference) in enumerate(_recorded_cases(kind)):
        digest = hashlib.sha256(f"{seeds} {kind} {number} {effects} {severity}".encode()).hexdigest()
        yield Spec(
            name=f"case_{digest[:10]}",
            kind=kind,
            effects=effects,
            severity=severity,
            world=_FIRST[seeds] + 20_000 * KINDS.index(kind) + number,
            reality=MEASURED,
            reference=reference,
            without=without,
            wide=True,
        )


def _recorded_cases(kind: Kind) -> Iterator[tuple[tuple[str, ...], float, tuple[str, ...], bool]]:
    """Effects, severity, what is taken out of the library, and whether there is a reference."""
    for reference in (True, False):
        if kind == "null":
            yield from [((), 0.0, (), reference)] * 12
        elif kind == "single":
            for effect in RECORDED_LIBRARY:
                for severity in (*_WIDE_SEVERITIES, *_WIDE_SEVERITIES):
                    yield (effect,), severity, (), reference
        elif kind == "outside":
            for effect in RECORDED_OUTSIDE:
                for severity in (3.0, 5.0):
                    yield (effect,), severity, (), reference
        elif kind == "excluded":
            for effect in RECORDED_LIBRARY:
                for severity in (3.0, 5.0):
                    yield (effect,), severity, (effect,), reference
        elif kind == "pair":
            for pair in _RECORDED_PAIRS:
                for severity in (_PAIR, 5.0):
                    yield pair, severity, (), reference


def _set_up(seeds: Seeds, kind: Kind) -> Iterator[Spec]:
    """Gross set-up errors on a road, in the reference as well or without a reference; and planar motion in simulated
    realities, where the faults of recordings are put into sensor, clock and receiver."""
    gross = (
        [(e, alike) for e in SET_UP_ERRORS for alike in (True, False) for _ in range(4)]
        if kind == "single"
        else []
    )
    planar = list(_recorded_cases(kind))
    everywhere = (*REALITIES, LINKAGE, "flexible")
    for number in range(len(gross) + len(planar)):
        effects: tuple[str, ...]
        without: tuple[str, ...]
        if number < len(gross):
            effect, reference = gross[number]
            effects, severity, without = (effect,), 5.0, ()
        else:
            effects, severity, without, reference = planar[number - len(gross)]
        digest = hashlib.sha256(f"{seeds} {kind} {number} {effects} {severity}".encode()).hexdigest()
        yield Spec(
            name=f"case_{digest[:10]}",
            kind=kind,
            effects=effects,
            severity=severity,
            world=_FIRST[seeds] + 20_000 * KINDS.index(kind) + number,
            reality=everywhere[int(digest[-6:], 16) % 4],
            reference=reference,
            without=without,
            wide=True,
            gross=number < len(gross),
            alike=number < len(gross) and reference,
            planar=number >= len(gross),
        )
