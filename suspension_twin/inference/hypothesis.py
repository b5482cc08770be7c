# SPDX-License-Identifier: Apache-2.0
"""Hypotheses: effects with the search coordinates of their parameters, and starting points of a search.

The coordinate of a parameter is u = (p - typical) / s, or u = log(p / typical) / s for a logarithmic one, with the
standard deviation s of its prior, which is then N(0, 1) in u. A discrete parameter (``choices``) has no coordinate:
each of its values is a hypothesis of its own, a variant, and the best variant represents the effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.checkpoint import stored
from suspension_twin.models.hooks import upright_with
from suspension_twin.vehicle.twin import EffectSpec, Twin

__all__ = ["BASELINE", "Hypothesis", "combined", "having_effects"]

_DRIVE = "@"
_WIDTH = 1.4  # standard deviation of the starting points, in that of the prior: they reach its tails


@stored
@dataclass(frozen=True)
class Hypothesis:
    """Some effects, possibly none, with the parameters that are searched and those that are fixed.

    ``fixed`` (key, value) holds choices; ``keys`` are the dotted keys of the searched parameters. ``around`` is the
    centre of the prior in search coordinates after a coarse search; empty for zero. ``preexisting`` names the effects
    that act on reference drives as well. A parameter that differs from drive to drive is searched for each of the
    ``drives``: the first has the parameter's key, another one that with its number behind an ``@``. ``held`` (key,
    value) are parameters of effects that the twin has already: no change is that value, and the prior is about it.
    """

    effects: tuple[str, ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()
    around: tuple[float, ...] = ()
    preexisting: tuple[str, ...] = ()
    model: str = ""
    drives: int = 1
    held: tuple[tuple[str, float], ...] = ()

    def effect(self, name: str) -> Effect:
        """One of its effects, as it is on the model."""
        return EFFECTS[name].on(self.model)

    def corner(self, effect: str) -> int:
        """The wheel that a tone of the effect turns with; -1 for none."""
        tone = self.effect(effect).tone
        return (
            -1
            if tone is None or not tone.corner
            else int(dict(self.fixed)[f"effects.{effect}.{tone.corner}"])
        )

    @property
    def name(self) -> str:
        return " + ".join(self.effects) or "none"

    @property
    def searched(self) -> tuple[tuple[str, Parameter], ...]:
        """Dotted key and description of every searched parameter."""
        held = dict(self.fixed)
        return tuple(
            (f"effects.{e}.{p.name}" + (f"{_DRIVE}{drive}" if drive else ""), p)
            for e in self.effects
            for p in self.effect(e).parameters
            if f"effects.{e}.{p.name}" not in held
            for drive in range(self.drives if p.each_drive else 1)
        )

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(key for key, _ in self.searched)

    def __len__(self) -> int:
        return len(self.searched)

    @property
    def differs(self) -> bool:
        """Whether a parameter differs from drive to drive."""
        return any(p.each_drive for _, p in self.searched)

    @property
    def upright(self) -> bool:
        """Whether an effect gives the static attitude of the vehicle: a static tilt is then that of the sensor."""
        return upright_with(self.effects, self.model)

    def on_drive(self, number: int) -> tuple[tuple[str, ...], list[int]]:
        """Keys of the twin's numbers, and the rows of their coordinates, on one drive."""
        chosen = {}
        for row, (key, p) in enumerate(self.searched):
            plain, _, drive = key.partition(_DRIVE)
            if not p.each_drive or int(drive or 0) == number:
                chosen[plain] = row
        return tuple(chosen), list(chosen.values())

    def centre(self) -> Floats:
        """(k,) centre of the prior."""
        return np.array(self.around) if self.around else self.typical()

    def typical(self) -> Floats:
        """(k,) centre of the prior before any coarse search: typical values, or those that the twin has."""
        return self._as_held(np.zeros(len(self)))

    def _as_held(self, u: Floats) -> Floats:
        """Coordinates (k,) with those of effects that the twin has as they are there."""
        known = dict(self.held)
        for row, (key, _) in enumerate(self.searched):
            if (plain := key.partition(_DRIVE)[0]) in known:
                u[row] = self.coordinate(row, known[plain])
        return u

    def without(self, effect: str) -> Hypothesis:
        """The hypothesis without one of its effects."""
        return self._with(tuple(e for e in self.effects if e != effect))

    def on_reference(self) -> Hypothesis:
        """The hypothesis on reference drives: its pre-existing effects."""
        return self._with(self.preexisting)

    def on_all_drives(self) -> Hypothesis:
        """The same with all effects pre-existing."""
        return replace(self, preexisting=self.effects)

    def _with(self, kept: tuple[str, ...]) -> Hypothesis:
        return Hypothesis(
            kept,
            tuple(pair for pair in self.fixed if pair[0].split(".")[1] in kept),
            tuple(u for key, u in zip(self.keys, self.around, strict=False) if key.split(".")[1] in kept),
            tuple(e for e in self.preexisting if e in kept),
            self.model,
            self.drives,
            tuple(pair for pair in self.held if pair[0].split(".")[1] in kept),
        )

    def rows(self, part: Hypothesis) -> list[int]:
        """Rows of the coordinates of ``part``."""
        return [self.keys.index(key) for key in part.keys]

    @property
    def _severe(self) -> list[bool]:
        """(k,) whether each coordinate is a severity of its effect."""
        return [p.name in self.effect(key.split(".")[1]).severity for key, p in self.searched]

    def bounds(self) -> tuple[Floats, Floats]:
        """(k,) lowest and highest coordinates."""
        low, high = (
            np.array([[p.coordinate(v) for v in p.bounds] for _, p in self.searched], dtype=float)
            .reshape(-1, 2)
            .T.copy()
        )
        return low, high

    def values(self, u: Floats) -> Floats:
        """(k, L) parameters for coordinates (k, L), inside their bounds."""
        out = np.empty_like(u, dtype=float)
        for i, (_, p) in enumerate(self.searched):
            out[i] = p.value(u[i])
        return out

    def neutral(self) -> Floats:
        """(k,) coordinates at which nothing has changed: a severity of zero, or as the twin has it; others at their
        typical value."""
        searched = zip(self.searched, self._severe, strict=True)
        at: list[float] = [
            p.coordinate(p.neutral) if severe and not p.prior.log else 0.0 for (_, p), severe in searched
        ]
        low, high = self.bounds()
        return np.asarray(np.clip(self._as_held(np.array(at, dtype=float)), low, high))

    def negligible(self) -> Floats:
        """(k, n) coordinates at which the effect is smallest: severities of zero, logarithmic ones at either bound (a
        low-pass at its highest cutoff, a contact patch at its shortest)."""
        low, high = self.bounds()
        ends = np.repeat(self.neutral()[:, None], 2, axis=1)
        known, searched = dict(self.held), zip(self.searched, self._severe, strict=True)
        free = [severe and p.prior.log and key not in known for (key, p), severe in searched]
        ends[free] = np.stack([low, high], axis=1)[free]
        return np.unique(ends, axis=1)

    def at_usual_sizes(self, mass: float) -> list[tuple[Floats, Floats, bool]]:
        """For each severity that sound vehicles have, on one of ``mass`` kg: coordinates (k,) at its usual size, those
        without it, and whether it has one sign; none of a tone, which has no usual phase."""
        effect, (low, _), out = self.effect(self.effects[-1]), self.bounds(), []
        for i, ((_, p), severe) in enumerate(zip(self.searched, self._severe, strict=True)):
            usual = p.prior.usual or effect.usual_share * mass
            if not severe or not usual or effect.tone is not None or p.each_drive:
                continue
            nothing = self.neutral()
            if p.prior.log:
                nothing[i] = p.coordinate(max(p.neutral, p.bounds[0]))
            at = nothing.copy()
            at[i] = p.coordinate(usual if p.prior.log else float(self.values(nothing[:, None])[i, 0]) + usual)
            out.append((at, nothing, bool(nothing[i] <= low[i] + 1e-9)))
        return out

    @property
    def has_clearance(self) -> bool:
        """Whether an effect acts only beyond a clearance."""
        return any(p.prior.log and p.unit == "m" and "clearance" in p.name for _, p in self.searched)

    def early_contact(self, travel: Mapping[str, float]) -> Floats:
        """(k,) an effect with a clearance that touches at a ``travel`` (m, by axle), and one standard deviation of
        severity."""
        at = self.neutral()
        for i, ((key, p), severe) in enumerate(zip(self.searched, self._severe, strict=True)):
            if severe and not p.prior.log:
                at[i] += 1.0
            elif p.prior.log and p.unit == "m" and travel:
                axle = key.split(".")[2].partition("_")[0]
                at[i] = p.coordinate(travel.get(axle, max(travel.values())))
        return np.clip(at, *self.bounds())

    def scan(self, count: int) -> tuple[int, Floats] | None:
        """For an effect with a resonance, which no tone is: the row of its strength, and ``count`` points (k, count)
        over the bounds of its frequency; None for any other effect."""
        names = [p.name for _, p in self.searched]
        severe = np.flatnonzero(self._severe).tolist()
        if "frequency" not in names or len(severe) != 1 or self.effect(self.effects[-1]).tone is not None:
            return None
        low, high = self.bounds()
        tone, row = names.index("frequency"), severe[0]
        points = np.zeros((len(self), count))
        points[tone] = np.linspace(low[tone], high[tone], count)
        points[row] = points[row] if self.neutral()[row] != 0.0 else 1.0
        return row, np.asarray(np.clip(points, low[:, None], high[:, None]))

    def spec(self, values: Floats) -> tuple[EffectSpec, ...]:
        """The effects as a twin file has them, for values (k,)."""
        known = {**dict(self.fixed), **dict(zip(self.keys, (float(v) for v in values), strict=True))}
        return tuple(
            EffectSpec(
                id=e,
                parameters={p.name: known[f"effects.{e}.{p.name}"] for p in self.effect(e).parameters},
            )
            for e in self.effects
        )

    def twin(self, base: Twin) -> Twin:
        """``base`` with the effects in its file, so that candidates can differ in them."""
        return having_effects(base, self.spec(self.values(self.neutral()[:, None])[:, 0]))

    def at(self, spec: EffectSpec) -> Floats:
        """(k,) coordinates of an effect as a twin file has it."""
        return np.array([p.coordinate(spec.parameters[p.name]) for _, p in self.searched])

    def coordinate(self, row: int, value: float) -> float:
        """The coordinate of a value of the parameter of a row, inside its bounds."""
        p = self.searched[row][1]
        return p.coordinate(float(np.clip(value, *p.bounds)))

    def starts(self, count: int, seed: int) -> Floats:
        """(k, count) Sobol points over the prior, severities on the side of their bound."""
        if not len(self):
            return np.zeros((0, 1))
        low, high = self.bounds()
        cube = qmc.Sobol(len(self), scramble=True, seed=seed).random(count).T
        normal = self.typical()[:, None] + _WIDTH * ndtri(np.clip(cube, 1e-3, 1 - 1e-3))
        at = self.neutral()
        searched = zip(self.searched, self._severe, strict=True)
        one_sided = [
            s and not p.prior.log and low[i] >= at[i] - 1e-12 for i, ((_, p), s) in enumerate(searched)
        ]
        normal[one_sided] = (at[:, None] + np.abs(normal - self.typical()[:, None]))[one_sided]
        return np.clip(normal, low[:, None], high[:, None])


BASELINE = Hypothesis()


def having_effects(base: Twin, specs: Sequence[EffectSpec]) -> Twin:
    """``base`` with effects in its file, in place of its own such."""
    others = [e for e in base.effects if e.id not in {spec.id for spec in specs}]
    return base.model_copy(update={"effects": (*others, *specs)}) if specs else base


def combined(*parts: Hypothesis) -> Hypothesis:
    """The hypothesis of several effects together."""
    around = tuple(float(u) for p in parts for u in p.centre()) if any(p.around for p in parts) else ()
    return Hypothesis(
        tuple(e for p in parts for e in p.effects),
        tuple(pair for p in parts for pair in p.fixed),
        around,
        tuple(e for p in parts for e in p.preexisting),
        parts[0].model,
        max(p.drives for p in parts),
        tuple(pair for p in parts for pair in p.held),
    )
