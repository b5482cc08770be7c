# SPDX-License-Identifier: Apache-2.0
"""Optional parts of a car: tyre damping, contact patch, rolling radius, roll bars, friction, top mounts and links.

A part has optional keys in the twin file and acts through the :class:`~suspension_twin.models.hooks.Hook` of the effect
of its kind, so that car and effect have one equation. Where a twin has both, the effect is the change beyond the part:
forces, dampings and lengths add up, and so do the compliances of mounts.

Links (:data:`LINKAGE`) have equations here. With the moment ``M_y`` of the planar acceleration about the pitch axis
(braking is positive) and the wheelbase L, the links of a front wheel push body and wheel apart with ``s M_y / (2 L)``,
those of a rear wheel with ``-s M_y / (2 L)``; s is ``braking`` or ``driving``. Roll centres at the height h_r take
``M_x w h_r / h`` of the moment about the roll axis, w the axle's share of the weight and h the height of the centre of
gravity. A wheel that moves back by ``r`` times its rise meets the road later: its ground is lower by
``r x slope`` at x m of compression, and the tyre's force N along the slope lifts the wheel with ``r N slope``. The
static equilibrium of a fresh start is without these forces.

A wheel is no point. A circle of radius R that rolls over a slope touches it ahead of or behind its centre, and its
centre is higher by ``R (1 / cos(slope) - 1)``, about ``R slope² / 2``, than above a point; the tyre's force along the
road's normal has the same part. ``rolling_radius`` is this R: 0 of a point, the tyre's radius of a rigid circle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import inlined
from suspension_twin.models import rows
from suspension_twin.models.corner import travel
from suspension_twin.models.hooks import Hook, KernelTerms, Values, load_hook
from suspension_twin.models.rows import AXLE, LANE, WIDTH, Fields, fma
from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.twin import Twin

__all__ = ["LINKAGE", "OPTIONAL_PARTS", "Part", "has_part"]

_FIELDS = Fields()
_BRAKING, _DRIVING, _RECESSION, _ROLL_CENTER = (_FIELDS.add(AXLE) for _ in range(4))
_ROLLING = _FIELDS.add()
#: Below this speed in m/s the slope of the road is that which a wheel would meet at this speed.
_SLOW: Final = 1.0


@inlined
def _links(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """Forces of the links of all four wheels; ``c`` is 0."""
    passed = w[rows.SHARE * WIDTH + i]
    mx = fma(passed, w[(rows.MOMENT + 2) * WIDTH + i], w[rows.MOMENT * WIDTH + i])
    my = fma(passed, w[(rows.MOMENT + 3) * WIDTH + i], w[(rows.MOMENT + 1) * WIDTH + i])
    ahead, behind = w[rows.ARM_X * WIDTH + i], w[(rows.ARM_X + 1) * WIDTH + i]
    per_base = 0.5 * my / (ahead - behind)
    per_height = mx / (w[rows.HEIGHT * WIDTH + i] * (ahead - behind))
    speed = w[rows.SPEED * WIDTH + i]
    per_speed = 1.0 / (speed if speed > _SLOW else _SLOW)
    rise = 0.5 * w[(e + _ROLLING) * WIDTH + i] * w[rows.TYRE * WIDTH + i]
    for a in range(2):
        braking, driving = w[(e + _BRAKING + a) * WIDTH + i], w[(e + _DRIVING + a) * WIDTH + i]
        pitch = (braking if my > 0.0 else driving) * per_base
        pitch = pitch if a == 0 else -pitch
        left, right = w[(rows.ARM_Y + 2 * a) * WIDTH + i], w[(rows.ARM_Y + 2 * a + 1) * WIDTH + i]
        share = -behind if a == 0 else ahead
        roll = w[(e + _ROLL_CENTER + a) * WIDTH + i] * per_height * share / (left - right)
        recession = w[(e + _RECESSION + a) * WIDTH + i]
        for side in range(2):
            corner = 2 * a + side
            slope = per_speed * w[(rows.ROAD_RATE + corner) * WIDTH + i]
            back = recession * slope
            ground = w[(rows.GROUND + corner) * WIDTH + i] + rise * slope * slope
            lower = back * travel(w, corner, i) * w[rows.TYRE * WIDTH + i]
            force = pitch - roll if side == 0 else pitch + roll
            force -= back * (ground if ground > 0.0 else 0.0)
            w[(rows.GROUND + corner) * WIDTH + i] = ground - lower
            w[(rows.STRUT + corner) * WIDTH + i] += force


def _constants(p: Values) -> dict[int, Floats | float]:
    def both(name: str) -> Floats:
        return np.stack([p[f"{axle}_{name}"] for axle in AXLES])

    return {
        _BRAKING: both("braking"),
        _DRIVING: both("driving"),
        _RECESSION: both("recession"),
        _ROLL_CENTER: both("roll_center"),
        _ROLLING: p["rolling_radius"],
    }


_OF_AXLES = {
    f"{axle}_{name}": f"vehicle.{axle}.linkage.{name}"
    for axle in AXLES
    for name in ("braking", "driving", "recession", "roll_center")
}
_NAMES = (*_OF_AXLES, "rolling_radius")

#: The links of both axles, and wheels that roll over an edge.
LINKAGE: Final = Hook(
    kernel=KernelTerms(_FIELDS, _constants, {"strut": (_links, LANE)}),
    neutral=dict.fromkeys(_NAMES, 0.0),
    severity=_NAMES,
)


@dataclass(frozen=True)
class Part:
    """A part of a car that acts as the effect ``name`` does: ``keys`` of the twin file by the effect's parameters."""

    name: str
    keys: Mapping[str, str]

    def hook(self, model: str) -> Hook:
        """How it changes a model."""
        return LINKAGE if self.name == "linkage" else load_hook(self.name, model)

    def values(self, own: Mapping[str, Floats], effect: Values) -> Values:
        """Parameters (L,) of part and effect together, of those that the twin has (``own``, by key)."""
        out = dict(effect)
        for parameter, key in self.keys.items():
            if key in own:
                out[parameter] = self._together(own[key], effect[parameter])
        return out

    def _together(self, part: Floats, effect: Floats) -> Floats:
        """Mounts, for which 0 is rigid, are in series; all else is side by side."""
        if self.name != "top_mount":
            return part + effect
        both = (part > 0.0) & (effect > 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(both, part * effect / (part + effect), part + effect)


def _of_axles(name: str, quantity: str, key: str) -> Part:
    return Part(name, {f"{axle}_{quantity}": f"vehicle.{axle}.{key}" for axle in AXLES})


#: The optional parts, by the id of the effect that each acts as.
OPTIONAL_PARTS: Final[Mapping[str, Part]] = {
    part.name: part
    for part in (
        _of_axles("strut_friction", "force", "friction"),
        _of_axles("top_mount", "stiffness", "top_mount"),
        _of_axles("anti_roll_bar", "stiffness", "anti_roll_bar"),
        Part("linkage", {**_OF_AXLES, "rolling_radius": "vehicle.tyre.rolling_radius"}),
        Part("tyre_damping", {"damping": "vehicle.tyre.damping"}),
        Part("tyre_envelope", {"length": "vehicle.tyre.contact_length"}),
    )
}


def has_part(twin: Twin, key: str) -> bool:
    """Whether the twin file has the number ``key`` of an optional part."""
    node: object = twin
    for name in key.split("."):
        node = getattr(node, name, None)
    return node is not None
