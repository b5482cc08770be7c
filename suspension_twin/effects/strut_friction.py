# SPDX-License-Identifier: Apache-2.0
"""Dry friction in the struts: seals, guides and bushings hold until they slip."""

from __future__ import annotations

from suspension_twin.effects.base import (
    CORNER,
    WIDTH,
    Effect,
    Fields,
    Floats,
    Hook,
    KernelTerms,
    Parameter,
    Prior,
    Variant,
    axles,
    by_corner,
    fma,
    inlined,
    of_one_corner,
    rows,
    travel_rate,
)

#: Stiffness before it slips, N/m: the bushings that give way while the strut still sticks.
STICKING = 3.0e5

_force = ((0.0, 1500.0), Prior(0.0, 200.0, usual=10.0), "N")

_PARAMETERS = (
    Parameter("front_force", *_force, "friction of each front strut"),
    Parameter("rear_force", *_force, "friction of each rear strut"),
)


_FIELDS = Fields()
_LIMIT = _FIELDS.add(CORNER)  # dry friction, N
_STIFFNESS = _FIELDS.add(CORNER)  # before it slips, N/m
_FORCE = _FIELDS.state(CORNER)  # of the friction element, N


@inlined
def _friction(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """A spring that slips at its limit (Prandtl), so that a strut at rest can stick.

    Needs no velocity at the end of the step, has no stiffness beyond its own, cannot chatter.
    """
    limit, stiffness = w[(e + _LIMIT + c) * WIDTH + i], w[(e + _STIFFNESS + c) * WIDTH + i]
    f = fma(stiffness * h, travel_rate(w, c, i), w[(e + _FORCE + c) * WIDTH + i])
    f = f if f < limit else limit
    f = f if f > -limit else -limit
    w[(e + _FORCE + c) * WIDTH + i] = f
    w[(rows.STRUT + c) * WIDTH + i] += f


EFFECT = Effect(
    id="strut_friction",
    title="dry friction in the struts",
    where="strut",
    doc="A force of fixed size against the motion of each strut, at the wheel; below it the strut sticks and "
    "only its bushings (300 N/mm) give way. Its loop of force over travel has an area at any speed.",
    parameters=_PARAMETERS,
    order=20,
    severity=("front_force", "rear_force"),
    excited_by=("small and slow suspension travel", "smooth road", "reversals of damper velocity"),
    confused_with=("damper_pull and damper_push at low velocity", "top_mount", "tyre_damping"),
    hook=Hook(
        kernel=KernelTerms(
            _FIELDS,
            lambda p: {_LIMIT: by_corner(p["front_force"], p["rear_force"]), _STIFFNESS: STICKING},
            {"strut": (_friction, CORNER)},
            stiffness=(_STIFFNESS,),
        ),
    ),
    variants={"quarter_car": Variant(of_one_corner(_PARAMETERS))},
    finding=lambda p: f"the struts stick: dry friction of {axles(p, '_force', 'N')}, at each wheel",
)
