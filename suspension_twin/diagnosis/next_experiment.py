# SPDX-License-Identifier: Apache-2.0
"""The next experiment: the drive that separates the remaining candidates of a diagnosis best, over the road of the twin
at another speed, or over an obstacle."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.judge import Candidate, Judged
from suspension_twin.diagnosis.wording import capital, effect_name
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.files import Json
from suspension_twin.inference.excited_segments import TrimSettings
from suspension_twin.inference.fit import twin_of
from suspension_twin.inference.gap import CHANNELS, channel_unit
from suspension_twin.inference.noise import USUAL_SHARE
from suspension_twin.inference.nuisance import OF_A_DRIVE
from suspension_twin.inference.observation import VERTICAL, Observation, Usage
from suspension_twin.inference.synthetic import SensorErrors, path_along
from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import pack
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.road import add_bump, bump_road, half_sine
from suspension_twin.road.road import Road
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["ProposedDrive", "manoeuvres", "next_experiment", "planned_drive", "separating_drive"]

#: Of the virtual sensor: those of a phone and an RTK receiver.
_SENSOR = SensorErrors()
#: s of a drive at most; m between a wheel and an end of the road.
_LONGEST, _MARGIN = 40.0, 0.5
#: m/s² of a calm driver (Bae, Moon and Seo, Electronics 8, 2019: comfortable up to 2 m/s²).
_ACCELERATION, _BRAKING = 1.5, 2.0
#: km/h from one speed over the twin's own road to the next (tolerance): a driver holds one to a few km/h.
_PACE = 10.0
#: Obstacles with the speed over each: m, km/h.
_OBSTACLES: Final[list[Json]] = json.loads(
    Path(__file__).with_name("obstacles.json").read_text(encoding="utf-8")
)


def planned_drive(twin: Twin, road: Road, kmh: float, name: str = "") -> Observation:
    """A drive along the middle of a road at a constant speed, from its start.

    Where a quarter of the road is enough for it, the vehicle starts from standing, and so it stops; else it enters and
    leaves at speed.

    Parameters
    ----------
    twin : Twin
        The vehicle, its sensor and its effects.
    road : Road
        The road.
    kmh : float
        Speed in km/h.
    name : str
        Of the drive.

    Returns
    -------
    Observation
        At the rate of the sensor, 40 s of it at most.

    Raises
    ------
    InputError
        The road is shorter than the vehicle, or the speed cannot be driven.

    Examples
    --------
    >>> from suspension_twin.road import bump_road, half_sine
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> road = bump_road(half_sine(0.9, 0.05), at=20.0, length=60.0)
    >>> drive = planned_drive(load_twin("bags/bump_15kmh/twin.yaml"), road, 20.0)
    >>> round(float(drive.along.max()), 1)
    5.6
    """
    if not 1.0 <= kmh <= 300.0:
        raise InputError("speed", f"must be between 1 and 300 km/h, is {kmh:g}")
    v, wheels = kmh / 3.6, twin.vehicle.wheel_positions[:, 0]
    start = road.u_first + _MARGIN - float(wheels.min())
    length = road.u_last - _MARGIN - float(wheels.max()) - start
    if length < float(np.ptp(wheels)):
        raise InputError("road", f"{road.length:.1f} m of it are too short to drive on")
    knots = _knots(v, length)
    t = np.arange(0.0, min(knots[-1][0], _LONGEST), 1.0 / _SENSOR.imu_rate)
    path = path_along(road, t, knots, start)
    driven = excitation(path, twin.vehicle, road)
    spec = FilterSpec()
    conditioner = Conditioner.for_stamps(t, spec, zero_phase=True)
    response = simulate_lanes(twin, pack(twin)[:, None], driven, fused=True)
    if response.failed[0]:
        raise InputError(
            "twin", f"cannot be simulated on this road at {kmh:g} km/h: it diverges or cannot stand"
        )
    signals = conditioner.apply(response.stacked(CHANNELS))[:, :, 0]
    signals[:, 0] -= signals[:, 0].mean()
    grid = conditioner.grid
    speed = np.interp(grid, t, path.speed)
    passed = np.sqrt(min(1.0, 2.0 * spec.cutoff / conditioner.rate))
    noise = {c: passed * (_SENSOR.force if c.endswith("acceleration") else _SENSOR.rate) for c in CHANNELS}
    block = np.zeros(grid.size, dtype=np.intp)  # nothing is held out of a plan
    return Observation(
        t=grid,
        rate=conditioner.rate,
        bandwidth=spec.cutoff,
        apply=conditioner.apply,
        position=np.interp(grid, t, road.xy_to_uv(path.x, path.y)[0]),
        along=speed,
        mask=np.asarray(conditioner.valid & (speed > TrimSettings().slowest)),
        position_sigma=_SENSOR.position,
        name=name or f"{kmh:g} km/h",
        excitation=driven,
        measured={c: signals[:, i] for i, c in enumerate(CHANNELS)},
        noise_rms=noise,
        usage=Usage(CHANNELS, VERTICAL, OF_A_DRIVE, block, fused=True),
    )


def _knots(v: float, length: float) -> list[tuple[float, float]]:
    """Knots (s, m/s) of a drive at ``v`` m/s over ``length`` m."""
    # knots are joined by cubics, whose largest slope is 1.5 times the mean one
    up, down = 1.5 * v / _ACCELERATION, 1.5 * v / _BRAKING
    up, down = (s if 0.5 * v * s <= 0.25 * length else 0.0 for s in (up, down))
    knots = [(0.0, 0.0), (1.0, 0.0), (1.0 + up, v)] if up else [(0.0, v)]
    knots.append((knots[-1][0] + length / v - 0.5 * (up + down), v))
    if down:
        end = knots[-1][0] + down
        knots += [(end, 0.0), (end + 1.0, 0.0)]
    return knots


def manoeuvres(planned: bool = False) -> list[tuple[str, Road, float]]:
    """Obstacles with the speed over each in km/h; short, without a test track. Those of a plan alone if ``planned``."""
    return [
        (one["name"], _road_of(one), one["kmh"]) for one in _OBSTACLES if one.get("planned") or not planned
    ]


def _road_of(obstacle: Json) -> Road:
    """70 m of flat road with an obstacle: under all wheels, or under the left ones alone."""
    shape, left = half_sine(obstacle["length"], obstacle["height"]), obstacle.get("left", False)
    flat = half_sine(obstacle["length"], 1e-6)
    road = bump_road(flat if left else shape, at=obstacle.get("at", 30.0), length=70.0)
    return add_bump(road, shape, 40.0, v_low=0.1) if left else road


@dataclass(frozen=True)
class ProposedDrive:
    """A drive that separates two twins: over a ``road`` that is named, or the twin's own, at ``kmh``; ``nats`` is the
    expected log likelihood ratio, ``rms`` the difference in the ``channel`` that shows it best, m/s² or rad/s."""

    road: str
    kmh: float
    nats: float
    channel: str
    rms: float

    @property
    def settles(self) -> bool:
        """Whether it makes one a thousand times as likely as the other."""
        return self.nats > math.log(1000.0)

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.road or 'the road of the twin once more'} at {self.kmh:g} km/h"

    def as_dict(self) -> Json:
        """Of ``diagnosis.json``."""
        road = {"road": self.road} if self.road else {}
        return {
            **road,
            "speed_kmh": self.kmh,
            "channel": self.channel,
            "difference": float(f"{self.rms:.3g}"),
        }


def separating_drive(
    first: Twin, second: Twin, noise: dict[str, float], share: float, own: Sequence[tuple[Road, float]] = ()
) -> ProposedDrive | None:
    """The drive on which two twins differ most: over their ``own`` road at speeds in km/h, where that settles it, else
    over an obstacle of the menu too; None where none can be simulated.

    0.5 n_eff / n sum((y_1 - y_2)^2 / (sigma^2 + (``share`` s)^2)) over the channels, with the ``noise`` sigma and the
    model discrepancy, a ``share`` of the rms s of the motion.
    """

    def separation(manoeuvre: tuple[str, Road, float]) -> ProposedDrive | None:
        name, road, kmh = manoeuvre
        try:
            one, other = (
                planned_drive(twin.model_copy(update={"road": None}), road, kmh) for twin in (first, second)
            )
        except SuspensionTwinError:
            return None
        parts, difference = {}, {}
        for channel, values in one.measured.items():
            sigma = noise.get(channel, one.noise_rms[channel])
            variance = sigma**2 + (share * float(np.std(values[one.mask]))) ** 2
            squares = (values - other.measured[channel])[one.mask] ** 2
            parts[channel] = float(np.sum(squares)) / variance * one.bandwidth / one.rate
            difference[channel] = float(np.sqrt(np.mean(squares)))
        best = max(parts, key=parts.__getitem__)
        return ProposedDrive(name, kmh, sum(parts.values()), best, difference[best])

    def best(menu: Sequence[tuple[str, Road, float]]) -> ProposedDrive | None:
        found = [drive for drive in map(separation, menu) if drive is not None]
        return max(found, key=lambda drive: drive.nats, default=None)

    at_home = best([("", *drive) for drive in own])
    if at_home is not None and at_home.settles:
        return at_home
    return max(filter(None, (at_home, best(manoeuvres()))), key=lambda drive: drive.nats, default=None)


def next_experiment(case: Case, rivals: Sequence[Candidate], answer: str, judged: Judged) -> tuple[str, Json]:
    """One sentence: the drive that separates the first two ``rivals`` of a diagnosis, and what it is worth; and that
    drive. A rival of no effect is the vehicle without any that is missing."""
    if len(rivals) < 2:
        return "No further drive is needed to separate candidates.", {}
    names = [effect_name(c.effects[0]) if c.effects else "no missing effect" for c in rivals[:2]]
    pair, effects = " from ".join(names), [c.effects[0] for c in rivals[:2] if c.effects]
    if case.kind == "run":
        return f"Repeat the run with another excitation to separate {pair}.", {}
    tap = "mount_resonance" in effects
    tail = " A tap on the phone holder at standstill excites the mount resonance alone." if tap else ""
    first, second = (twin_of(judged.problem, c.found.fit) for c in rivals[:2])
    share = max(judged.scale.reference or USUAL_SHARE, 0.05)
    found = separating_drive(first, second, judged.scale.noise, share, _own_road(case))
    if found is None:
        return f"No manoeuvre of the menu can be simulated to separate {pair}.{tail}", {}
    if found.nats < 1.0:
        shows = " ".join(
            f"{capital(effect_name(e))} shows in: {', '.join(EFFECTS[e].excited_by)}." for e in effects
        )
        text = f"No manoeuvre of those that were simulated would separate {pair}. {shows}{tail}"
        return text, {}
    why = " if there is a gap at all" if answer == "no_gap" else ""
    worth = (
        ""
        if found.settles
        else f"; one pass should make the right one {np.exp(found.nats):.0f} times as likely as the other"
    )
    differ = f"{found.rms:.2g} {channel_unit(found.channel)} in {found.channel.replace('_', ' ')}"
    text = f"Drive {found.name}: there {' and '.join(names)} differ most{why}, by {differ}{worth}."
    return text + tail, found.as_dict()


def _own_road(case: Case) -> list[tuple[Road, float]]:
    """The road of the drives at speeds from walking pace up to a quarter beyond the fastest."""
    if not case.road:
        return []
    fastest = 1.25 * 3.6 * max(float(np.abs(d.along).max()) for d in case.drives)
    return [(case.drives[0].road, kmh) for kmh in np.arange(_PACE, max(fastest, _PACE) + 0.1, _PACE).tolist()]
