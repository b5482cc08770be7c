# SPDX-License-Identifier: Apache-2.0
"""Which cases there are: kinds, effects, severities, seeds and realities, in an order to take a sample from.

Development and both sets for reporting use other worlds. A case's name says nothing about it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from typing import Literal

import numpy as np

from blind.faults import ALIASES, LIBRARY, MSD, OUTSIDE, ROAD

Seeds = Literal["dev", "report", "report2", "report3", "links_dev", "links"]
Kind = Literal["single", "null", "outside", "excluded", "pair", "stretch"]
KINDS: tuple[Kind, ...] = ("single", "null", "outside", "excluded", "pair", "stretch")
SEVERITIES = (0.5, 1.5, 5.0)
REALITIES = ("newton", "multibody")
#: Seeds whose cars are the ones with linkages: fewer cases, and none of them faint.
LINKS = ("links_dev", "links")
_LINKAGE = "linkage"
_FIRST = {
    "dev": 1000,
    "report": 500_000,
    "report2": 1_000_000,
    "links_dev": 2_000_000,
    "links": 3_000_000,
    "report3": 4_000_000,
}
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


@dataclass(frozen=True)
class Spec:
    """One case before anything is simulated. ``without`` is taken out of the library for it."""

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


def plan(seeds: Seeds, short: bool = False) -> list[Spec]:
    """All cases of one set of seeds, mixed so that the first n are a fair sample of any n.

    The short plan is nine cases of the development seeds.
    """
    strata = {kind: list(_numbered(seeds, kind)) for kind in KINDS}
    rng = np.random.default_rng(_FIRST[seeds])
    for kind, cases in strata.items():
        # Round by round through the effects, in another order each round.
        groups: dict[tuple[str, ...], list[Spec]] = {}
        for spec in cases:
            groups.setdefault(spec.effects, []).append(spec)
        for group in groups.values():
            rng.shuffle(group)  # type: ignore[arg-type]
        mixed = []
        for row in zip_longest(*groups.values()):
            row = [s for s in row if s is not None]
            rng.shuffle(row)
            mixed += row
        strata[kind] = mixed
    placed = [
        ((i + 0.5) / len(cases), k, i, spec)
        for k, cases in enumerate(strata.values())
        for i, spec in enumerate(cases)
    ]
    everything = [spec for *_, spec in sorted(placed, key=lambda p: p[:3])]
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
            reality=_LINKAGE if links else REALITIES[world % 2] if kind != "null" else REALITIES[coin % 2],
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
