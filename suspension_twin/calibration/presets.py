# SPDX-License-Identifier: Apache-2.0
"""Ready ways to calibrate, and what each searches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.genetic import GaSettings
from suspension_twin.calibration.pattern import PatternSettings
from suspension_twin.effects.registry import effect
from suspension_twin.errors import InputError, nearest
from suspension_twin.inference.gauss_newton import GaussNewtonSettings
from suspension_twin.inference.priors import TABLES, prior_of
from suspension_twin.inference.space import CURVES, Space, bounds_of, curve_keys, is_fine
from suspension_twin.models.parameters import Parameter, layout, twin_value
from suspension_twin.models.parts import LINKAGE, OPTIONAL_PARTS, has_part
from suspension_twin.models.registry import model_of
from suspension_twin.vehicle.tracked import BOUNDS
from suspension_twin.vehicle.twin import EffectSpec, Twin

__all__ = [
    "PART_KEYS",
    "PRESETS",
    "TABLE_2",
    "Preset",
    "build_space",
    "preset_named",
    "refined",
    "with_effects",
    "with_table_2",
]

#: The car paper's Table 2: for each characteristic its abscissae (m, m/s) and the bounds (N) of each point.
TABLE_2: Mapping[str, tuple[tuple[float, ...], tuple[tuple[float, float], ...]]] = {
    key: (part.x, part.bounds)
    for name, part in TABLES.table_2.items()
    for key in (f"vehicle.front.{name}", f"vehicle.rear.{name}")
}


#: Keys of the optional parts of a car that are free where its file has them.
PART_KEYS = tuple(
    key for part in OPTIONAL_PARTS.values() for key in part.keys.values() if "roll_center" not in key
)


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """How candidates are judged. ``synchronise``: each candidate is aligned in time on its own before it is judged, as
    the car paper does; otherwise offsets are unknowns like others. ``slowest``: of controlled runs the slowest are
    fitted alone, the others validate."""

    objective: str
    channels: Mapping[str, float]
    synchronise: bool
    slowest: bool = False


@dataclass(frozen=True, kw_only=True)
class FreeNumbers:
    """Numbers that are free: the points of the characteristics, on the car paper's ``table_2``, and ``also`` some keys;
    or ``keys`` instead, of a vehicle that has them. ``reach``: by which factor a point may move either way where
    nobody gave bounds. ``refined``: springs get points about the standing car where they have few, and the car gets
    links."""

    table_2: bool
    refined: bool = False
    also: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    reach: float = TABLES.point.reach


@dataclass(frozen=True, kw_only=True)
class Preset(Judgement, FreeNumbers):
    """A ready way to calibrate. ``search`` "genetic" (GA, then pattern search) or "squares" (Gauss-Newton, CMA-ES where
    the objective is no sum of squares)."""

    name: str
    about: str
    search: Literal["genetic", "squares"]
    genetic: GaSettings = field(default_factory=GaSettings)
    pattern: PatternSettings = field(default_factory=PatternSettings)
    squares: GaussNewtonSettings = field(default_factory=lambda: GaussNewtonSettings(tolerance=1e-4))


#: Weight 0 stands for "by the channels' floors": each counts in units of its own noise.
_ALL_MOTION = dict.fromkeys(("vertical_acceleration", "roll_rate", "pitch_rate"), 0.0)

PRESETS: Mapping[str, Preset] = {
    "fast": Preset(
        name="fast",
        about="Gauss-Newton in batches on vertical acceleration, roll and pitch rate; the moments of inertia too",
        search="squares",
        objective="likelihood",
        channels=_ALL_MOTION,
        synchronise=False,
        table_2=False,
        refined=True,
        also=("vehicle.sprung_inertia.roll", "vehicle.sprung_inertia.pitch", *PART_KEYS),
    ),
    "paper": Preset(
        name="paper",
        about="the car paper's section 4.3: 24 points of Table 2, GA of 100 by 100, then a pattern search",
        search="genetic",
        objective="euclidean",
        channels={"vertical_acceleration": 1.0},
        synchronise=True,
        table_2=True,
    ),
    "tracked_paper": Preset(
        name="tracked_paper",
        about="the tracked paper's search: population 40, 30 generations, mean correlation, eq. (15)",
        search="genetic",
        objective="correlation",
        # Its markers' vertical motion, front and rear, is what heave and pitch are together.
        channels=dict.fromkeys(
            ("vertical_acceleration", "pitch_rate", "marker_A_displacement", "marker_B_displacement"), 0.5
        ),
        synchronise=True,
        table_2=False,
        genetic=GaSettings(
            population=TABLES.tracked_search.population,
            generations=TABLES.tracked_search.generations,
            stall_generations=TABLES.tracked_search.generations,
            elite_share=TABLES.tracked_search.elite_share,
        ),
        pattern=PatternSettings(evaluations=0),
        keys=tuple(f"vehicle.{key}" for key in BOUNDS),
        slowest=True,
        reach=TABLES.tracked_search.reach,
    ),
}


def preset_named(name: str) -> Preset:
    """The preset of that name; raises InputError that lists them."""
    if name not in PRESETS:
        raise InputError(
            "preset", name or "(empty)", f"one of {', '.join(PRESETS)} is expected{nearest(name, PRESETS)}"
        )
    return PRESETS[name]


def with_table_2(twin: Twin) -> Twin:
    """The twin with its characteristics on Table 2's abscissae, through the points they had there."""
    changes: dict[str, object] = {}
    for key in CURVES:
        if not curve_keys(twin, [key]):
            continue
        part = key.rpartition(".")[2]
        abscissae = TABLES.table_2[part].x
        x, force = twin_value(twin, key).points
        values = _along(x, force, np.array(abscissae))
        name = "compression" if part == "spring" else "velocity"
        changes[f"{key}.{name}"] = tuple(abscissae)
        changes[f"{key}.force"] = tuple(float(v) for v in values)
    return twin.with_changes(changes)


def refined(twin: Twin, kept: Sequence[str] = (), further: Mapping[str, float] | None = None) -> Twin:
    """The twin with springs of points about the standing car, and with links and friction of no effect yet.

    The springs' curves stay what they are, as lines through new points. A spring with enough points stays as it is, and
    so does one of which ``kept`` names a key; twins of models without springs or links stay whole. The points of an
    axle lie by ``further`` m beyond those of the curve, its free length with them, which shows in no signal.
    """
    changes: dict[str, object] = {}
    points = TABLES.refined_spring
    for name, suspension in twin.axles.items():
        key = f"vehicle.{name}.spring" if name else "vehicle.spring"
        x, force = suspension.part.spring.points
        static = suspension.static_compression
        if is_fine(suspension) or any(word.startswith(key) for word in kept):
            continue
        at = static + np.array(points.travel)
        at = np.append(at[at > 0.3 * static], max(static + points.end, x[-1]))
        changes[f"{key}.compression"] = tuple((at + (further or {}).get(name, 0.0)).round(4).tolist())
        changes[f"{key}.force"] = tuple(_along(x, force, at.round(4)).round(2).tolist())
    damping = OPTIONAL_PARTS["tyre_damping"].keys["damping"]
    if damping in model_of(twin).also and not has_part(twin, damping):
        changes[damping] = 0.0
    if twin.model in LINKAGE.models:
        for name in twin.axles:
            if not has_part(twin, f"vehicle.{name}.friction"):
                changes[f"vehicle.{name}.friction"] = 0.0
            if not has_part(twin, f"vehicle.{name}.linkage"):
                changes[f"vehicle.{name}.linkage"] = {}
        if not has_part(twin, "vehicle.tyre.rolling_radius"):
            changes["vehicle.tyre.rolling_radius"] = 0.0
    return twin.with_changes(changes) if changes else twin


def _along(x: Floats, force: Floats, at: Floats) -> Floats:
    """The force of a characteristic with points ``x`` and ``force`` at the abscissae ``at``."""
    slope = (force[-1] - (force[-2] if x.size > 1 else 0.0)) / (x[-1] - (x[-2] if x.size > 1 else 0.0))
    inside = np.interp(at, np.concatenate([[0.0], x]), np.concatenate([[0.0], force]))
    return np.asarray(np.where(at > x[-1], force[-1] + slope * (at - x[-1]), inside))


def build_space(
    twin: Twin,
    preset: Preset,
    free: Sequence[str] = (),
    *,
    also: Sequence[str] = (),
    freeze: Sequence[str] = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    known: Sequence[Parameter] = (),
) -> Space:
    """The free parameters of a calibration of ``twin``; raises InputError that names a wrong key.

    ``known`` parameters, where nothing else is known of them, stay as they are.
    """
    bounds = bounds or {}
    own = _usual(twin, preset)
    wanted = [*(_expanded(twin, free) if free else own), *_expanded(twin, also)]
    frozen = set(_expanded(twin, freeze))
    for key in frozen:
        _value(twin, key)
    keys = [k for k in dict.fromkeys(wanted) if k not in frozen]
    for key in bounds:
        if key not in keys and not any(k.startswith(f"{key}.") for k in keys):
            raise InputError("bounds", key, f"is not free{nearest(key, keys)}")
    if not keys:
        raise InputError("free parameters", "nothing is free: name at least one key")
    have = {
        p.key: p for p in known if prior_of(p.key) is None and p.key.rpartition(".force.")[0] not in CURVES
    }
    return Space(twin, [have.get(key) or _parameter(twin, key, preset, bounds) for key in keys])


def _usual(twin: Twin, preset: Preset) -> list[str]:
    """Keys that are searched by default: those that the preset names for this vehicle; its characteristics; or those in
    which specimens differ."""
    there = layout(twin).names
    named = [key for key in preset.keys if key in there]
    curves = curve_keys(twin)
    if named or curves:
        return named or [*curves, *(key for key in (*preset.also, *model_of(twin).also) if key in there)]
    if twin.bounds:
        return list(twin.bounds)
    usual = [(key, prior_of(key)) for key in there]
    return [key for key, prior in usual if prior is not None and prior.free and twin_value(twin, key) != 0]


def _expanded(twin: Twin, keys: Sequence[str]) -> list[str]:
    found: list[str] = []
    for key in keys:
        base = key.removesuffix(".force")
        if base in CURVES:
            points = curve_keys(twin, [base])
            if not points:
                raise InputError("free parameters", key, "is no characteristic of this vehicle")
            found += points
        elif key.startswith("effects.") and key.count(".") == 1:
            found += [
                f"{key}.{p.name}" for p in effect(key.split(".")[1], twin.model).parameters if not p.choices
            ]
        else:
            found.append(key)
    return found


def _value(twin: Twin, key: str) -> float:
    value = twin_value(twin, key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError("parameters", key, "is not a number of the twin file")
    return float(value)


def _parameter(twin: Twin, key: str, preset: Preset, bounds: Mapping[str, tuple[float, float]]) -> Parameter:
    nominal, given = _value(twin, key), bounds_of(bounds, key) or twin.bounds.get(key)
    curve, _, index = key.rpartition(".force.")
    if curve in CURVES:
        if given is None and preset.table_2:
            given = TABLES.table_2[curve.rpartition(".")[2]].bounds[int(index)]
        low, high = given or (nominal / preset.reach, max(nominal * preset.reach, 1.0))
        return TABLES.point.about(key, nominal, (low, high))
    if key.startswith("effects."):
        _, name, parameter = key.split(".")
        return effect(name, twin.model).parameter(parameter).about(key, nominal, given)
    prior = prior_of(key, twin.model)
    if prior is None:
        if given is None:
            raise InputError("free parameters", key, "needs bounds: nothing is known of how far it may go")
        known = TABLES.unlisted
        if min(*given, nominal) <= 0:
            known = known.model_copy(update={"scale": "linear"}).within(given)
        return known.about(key, nominal, given)
    return prior.about(key, nominal, given)


def with_effects(twin: Twin, keys: Sequence[str]) -> Twin:
    """The twin with every effect that a free key names and that it has not yet, still neutral."""
    have = {spec.id for spec in twin.effects}
    wanted = dict.fromkeys(k.split(".")[1] for k in keys if k.startswith("effects.") and k.count("."))
    missing = [name for name in wanted if name not in have]
    if not missing:
        return twin
    added = tuple(EffectSpec(id=effect(name).id) for name in missing)
    return twin.model_copy(update={"effects": (*twin.effects, *added)})
