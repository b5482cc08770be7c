# SPDX-License-Identifier: Apache-2.0
"""Play in the joints of the dampers."""

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

_PARAMETERS = (
    Parameter("front", (0.0, 0.05), Prior(0.0, 0.004), "m", "play at the wheel, front"),
    Parameter("rear", (0.0, 0.05), Prior(0.0, 0.004), "m", "the same at the rear"),
)


_FIELDS = Fields()
_HALF = _FIELDS.add(CORNER)  # half of the play, m
_PLACE = _FIELDS.state(CORNER)  # of the damper in its play, m


@inlined
def _play(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """Inside the play the damper's force of the last step is subtracted, which leaves its change within a step: first
    order in the step, and the dampers stay implicit."""
    half = w[(e + _HALF + c) * WIDTH + i]
    y = fma(h, travel_rate(w, c, i), w[(e + _PLACE + c) * WIDTH + i])
    loose = w[(rows.DAMPER + c) * WIDTH + i] if abs(y) < half else 0.0
    y = y if y < half else half
    w[(e + _PLACE + c) * WIDTH + i] = y if y > -half else -half
    w[(rows.STRUT + c) * WIDTH + i] -= loose


EFFECT = Effect(
    id="damper_play",
    title="play in the dampers",
    where="strut",
    doc="After each reversal a damper holds only once the play is taken up: worn bushes and joints, a loose piston "
    "rod, oil that has torn and leaves a void.",
    parameters=_PARAMETERS,
    order=70,
    severity=("front", "rear"),
    excited_by=("many reversals of small travel", "rough road at medium speed"),
    confused_with=("top_mount", "damper_fade", "the first points of the dampers"),
    hook=Hook(
        kernel=KernelTerms(
            _FIELDS,
            lambda p: {_HALF: by_corner(0.5 * p["front"], 0.5 * p["rear"])},
            {"strut": (_play, CORNER)},
        )
    ),
    variants={"quarter_car": Variant(of_one_corner(_PARAMETERS))},
    finding=lambda p: f"the dampers have play: {axles(p, '', 'm')}",
)
