# SPDX-License-Identifier: Apache-2.0
"""Models and effects with parameters from their whole range, on roads that no car should meet.

A trial draws a vehicle (every characteristic scaled), up to three effects with values between their bounds, a step of
integration, a speed and a road: waves, steps of up to 20 cm, places where the ground falls away, missing heights. The
road ends level, so that what moves then has to settle.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torture.commands import ROOT
from torture.ledger import Tally

__all__ = ["BAR", "torture"]

BAR = "fails loudly and alone, or is right: finite, and no motion grows on a level road that a finer step has not"

#: Effects that shake the car themselves.
_SHAKERS = ("engine_order", "wheel_imbalance")
_LEVEL_AFTER, _SECONDS = 3.0, 8.0  # s


class _Ground:
    """Heights of a road that is level after ``until`` m; NaN in the places given."""

    def __init__(self, rng: np.random.Generator, until: float) -> None:
        self.until = until
        self.waves = [(rng.uniform(0, 0.05), rng.uniform(0.2, 10.0), rng.uniform(0, 6.3)) for _ in range(4)]
        self.steps = [(rng.uniform(0, until), rng.uniform(-0.2, 0.2)) for _ in range(int(rng.integers(0, 4)))]
        self.hole = (rng.uniform(0, until), rng.uniform(0.5, 3.0)) if rng.random() < 0.3 else None
        self.missing = rng.uniform(0, until) if rng.random() < 0.15 else None

    def heights(self, x: Any, y: Any) -> Any:
        """Heights (m) at x, y."""
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        z = sum((a * np.sin(2 * np.pi * x / w + p + 0.3 * y) for a, w, p in self.waves), np.zeros(x.shape))
        for at, height in self.steps:
            z = z + np.where(x > at, height, 0.0)
        if self.hole is not None:
            z = np.where((x > self.hole[0]) & (x < sum(self.hole)), z - 2.0, z)
        if self.missing is not None:
            z = np.where((x > self.missing) & (x < self.missing + 0.5), np.nan, z)
        return np.where(x > self.until, 0.0, z)


def _twin(rng: np.random.Generator) -> tuple[Any, list[str]]:
    """A vehicle and the ids of its effects."""
    from suspension_twin.effects.registry import EFFECTS
    from suspension_twin.vehicle.twin import EffectSpec, load_twin

    twin = load_twin(ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml")
    model = ("full_car", "full_car", "msd")[int(rng.integers(3))]
    changes: dict[str, Any] = {"model": model, "vehicle.mass": float(1725.0 * rng.uniform(0.6, 1.6))}
    for axle in ("front", "rear"):
        own = getattr(twin.vehicle, axle)
        for part in ("spring", "damper_push", "damper_pull"):
            scale = float(np.exp(rng.uniform(np.log(0.2), np.log(5.0))))
            changes[f"vehicle.{axle}.{part}.force"] = [float(f * scale) for f in getattr(own, part).force]
    possible = [e for e in EFFECTS.values() if model in e.hook.models]
    chosen = rng.choice(len(possible), size=int(rng.integers(0, 4)), replace=False)
    specs = []
    for e in (possible[i] for i in chosen):
        values = {}
        for p in e.parameters:
            kind = rng.random()
            low, high = p.bounds
            value = low if kind < 0.2 else high if kind < 0.4 else float(rng.uniform(low, high))
            values[p.name] = float(rng.choice(p.choices)) if p.choices else value
        specs.append(EffectSpec(id=e.id, parameters=values))
    changes["effects"] = [spec.model_dump() for spec in specs]
    return twin.with_changes(changes), [spec.id for spec in specs]


def torture(tally: Tally) -> None:
    """A simulation a trial."""
    from suspension_twin.errors import SuspensionTwinError
    from suspension_twin.models.excitation import excitation
    from suspension_twin.models.simulate import simulate_twin
    from suspension_twin.pose.types import Trajectory

    for number in tally.numbers():
        rng = tally.rng(number)
        speed = float(rng.uniform(0.5, 40.0))
        step = float(np.exp(rng.uniform(np.log(1e-4), np.log(5e-3))))
        ground = _Ground(rng, speed * _LEVEL_AFTER)
        s = np.arange(round(_SECONDS * 100) + 1) / 100
        zero = np.zeros_like(s)
        path = Trajectory(
            t=1.7e9 + s, x=speed * s, y=zero, yaw=zero, velocity=np.column_stack([zero + speed, zero]),
            yaw_rate=zero, acceleration=np.zeros((s.size, 2)), valid=np.ones(s.size, bool),
        )  # fmt: skip
        try:
            twin, effects = _twin(rng)
        except SuspensionTwinError as error:
            tally.count("refused as a vehicle")
            if not str(error).isprintable():
                tally.fail("a line that is not printable")
            continue
        what = f"{twin.model}, {', '.join(effects) or 'no effect'}, step {1e3 * step:.2g} ms, {speed:.1f} m/s"
        try:
            response = simulate_twin(twin, excitation(path, twin.vehicle, ground, max_step=step))
        except SuspensionTwinError as error:
            tally.count("diverges, and says so" if "diverges" in str(error) else "refused")
            continue
        except Exception as error:
            tally.fail(f"{what}: {type(error).__name__}: {error}")
            continue
        tally.count("simulated")
        signals = {
            "force": response.force, "rate": response.rate, "heave": response.heave, "wheel_z": response.wheel_z,
            "deflection": response.deflection, "tyre_force": response.tyre_force,
        }  # fmt: skip
        broken = [name for name, values in signals.items() if not np.isfinite(values).all()]
        if broken:
            tally.fail(f"{what}: {broken[0]} is not finite")
            continue
        a = response.vertical_acceleration
        level = s > _LEVEL_AFTER + twin.vehicle.wheelbase / speed + 0.5
        early, late = a[level & (s < 6.5)], a[s > 7.0]
        if not set(effects) & set(_SHAKERS) and early.size > 20:
            first, last = float(np.std(early)), float(np.std(late))
            if (
                last > 1.05 * first + 0.02
            ):  # two modes beat, or the integration makes energy: a finer step tells
                fine = simulate_twin(
                    twin, excitation(path, twin.vehicle, ground, max_step=min(step / 8, 1e-4))
                )
                finer = float(np.std(fine.vertical_acceleration[s > 7.0]))
                tally.count("vibrates on, as at an eighth of the step")
                tally.measure("more motion than at an eighth of the step, %", 100 * (last / finer - 1))
                if last > 1.15 * finer + 0.02:
                    tally.fail(
                        f"{what}: {last:.3g} m/s² on a level road, {finer:.3g} at an eighth of the step"
                    )
