# SPDX-License-Identifier: Apache-2.0
"""The next experiment: the manoeuvre whose simulated response differs most between the candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.judge import Candidate, Judged, detectable
from suspension_twin.diagnosis.wording import effect_name
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.inference.fit import twin_of
from suspension_twin.inference.synthetic import path_along
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.road import Road, add_bump, bump_road, half_sine
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["Manoeuvre", "menu", "next_experiment", "separation"]

_RATE = 100.0
#: Nats of odds of a thousand to one, beyond which a figure says no more.
_SETTLED = np.log(1000.0)
_CHANNELS = ("vertical_acceleration", "roll_rate", "pitch_rate", "longitudinal_acceleration")


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """A road and knots (s, m/s) of the speed on it."""

    name: str
    road: Road
    knots: tuple[tuple[float, float], ...]


def menu() -> list[Manoeuvre]:
    """The manoeuvres to choose from; each is short and needs no test track."""

    def bumped(length: float, height: float) -> Road:
        return bump_road(half_sine(length, height), at=30.0, length=140.0)

    bump = bumped(0.9, 0.07)
    ripple = bump_road(half_sine(2.0, 0.004), at=[20.0 + 6.0 * i for i in range(10)], length=140.0)
    left = add_bump(bumped(0.9, 1e-6), half_sine(0.9, 0.06), 40.0, v_low=0.1)
    passes = [
        *((f"a speed bump (7 cm high, 0.9 m long) at {v} km/h", bump, v, np.inf) for v in (10, 20, 40)),
        ("a low sharp edge (3 cm high, 0.25 m long) at 30 km/h", bumped(0.25, 0.03), 30, 12.0),
        ("a long wave (8 cm high, 6 m long) at 40 km/h", bumped(6.0, 0.08), 40, 12.0),
        ("a pothole (6 cm deep, 0.7 m long) at 30 km/h", bumped(0.7, -0.06), 30, 12.0),
        ("a bump under the left wheels only at 20 km/h", left, 20, 12.0),
        ("a smooth road (ripples of 4 mm) at 40 km/h", ripple, 40, 12.0),
    ]
    braking = ((0.0, 11.1), (2.0, 11.1), (4.5, 3.0), (8.0, 1.0))
    return [
        Manoeuvre("standing still for ten seconds", bump, ((0.0, 0.0), (10.0, 0.0))),
        *(
            Manoeuvre(name, road, ((0.0, kmh / 3.6), (min(60.0 / (kmh / 3.6), longest), kmh / 3.6)))
            for name, road, kmh, longest in passes
        ),
        Manoeuvre("braking from 40 km/h over a speed bump", bump, braking),
    ]


def separation(first: Twin, second: Twin, what: Manoeuvre, noise: dict[str, float], share: float) -> float:
    """Expected log likelihood ratio in nats between two twins on a manoeuvre.

    0.5 n_eff / n sum((y_1 - y_2)^2 / (sigma^2 + (``share`` s)^2)) over the channels, with the noise sigma and the model
    discrepancy, a ``share`` of the standard deviation s of the motion.
    """
    t = np.arange(what.knots[0][0], what.knots[-1][0], 1.0 / _RATE)
    trajectory = path_along(what.road, t, what.knots, 5.0)
    conditioner = Conditioner.for_stamps(t, FilterSpec(), zero_phase=True)
    seen = []
    for twin in (first, second):
        r = simulate_twin(twin, excitation(trajectory, twin.vehicle, what.road))
        stacked = np.column_stack([r.vertical_acceleration, r.rate[:, 0], r.rate[:, 1], r.force[:, 0]])
        seen.append(conditioner.apply(stacked))
    total = 0.0
    for c, name in enumerate(_CHANNELS):
        motion = float(np.std(seen[0][:, c]))
        sigma2 = noise.get(name, 0.03 if name.endswith("acceleration") else 2e-3) ** 2 + (share * motion) ** 2
        total += (
            0.5
            * (2.0 * FilterSpec().cutoff / _RATE)
            * float(np.sum((seen[0][:, c] - seen[1][:, c]) ** 2))
            / sigma2
        )
    return total


def next_experiment(case: Case, tied: Sequence[Candidate], answer: str, judged: Judged) -> str:
    """One sentence: the manoeuvre, the candidates that it separates, and the expected gain."""
    weak = [
        effect_name(c.effects[0])
        for c in judged.singles
        if not c.decoy and c.powers is not None and not detectable(c.powers)
    ]
    tail = f" Not excited so far: {', '.join(weak)}." if weak else ""
    if len(tied) < 2:
        return f"None is needed to separate candidates.{tail}"
    names = [effect_name(c.effects[0]) for c in tied[:2]]
    if case.kind == "run":
        return f"Repeat the run with another excitation to separate {names[0]} from {names[1]}.{tail}"
    twins = [replace_road(twin_of(judged.problem, c.found.fit)) for c in tied[:2]]
    share = max(judged.reference or 0.15, 0.05)
    gains = []
    for manoeuvre in menu():
        try:
            gains.append((separation(twins[0], twins[1], manoeuvre, judged.noise, share), manoeuvre.name))
        except SuspensionTwinError:
            continue
    if {"mount_resonance"} & {c.effects[0] for c in tied[:2]}:
        tail = f" A tap on the phone holder at standstill excites the mount resonance alone.{tail}"
    if not gains:
        return f"None of the menu can be simulated with {names[0]} and {names[1]}.{tail}"
    gain, name = max(gains)
    pair = f"{names[0]} from {names[1]}"
    if gain < 1.0:
        return f"No manoeuvre of those that were simulated would separate {pair}.{tail}"
    why = " if there is a gap at all" if answer == "no_gap" else ""
    return f"Drive {name}: it separates {pair} best{why}; {_worth(gain)}.{tail}"


def replace_road(twin: Twin) -> Twin:
    """The twin for a road of the menu."""
    return twin.model_copy(update={"road": None})


def _worth(nats: float) -> str:
    """What an expected log likelihood ratio means."""
    if nats >= _SETTLED:
        return "one pass should settle it"
    return f"one pass should make the right one {np.exp(nats):.0f} times as likely as the other"
