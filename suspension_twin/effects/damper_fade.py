# SPDX-License-Identifier: Apache-2.0
"""Damping that is lost as the drive goes on and the oil warms."""

from __future__ import annotations

from suspension_twin.effects.base import (
    CORNER,
    LANE,
    WIDTH,
    Effect,
    Fields,
    Floats,
    Hook,
    KernelTerms,
    Parameter,
    Prior,
    inlined,
    plain,
    rows,
)

_FIELDS = Fields()
_LOSS = _FIELDS.add()  # share of the damping lost at last
_PACE = _FIELDS.add()  # growth of the heat, 1/s
_HEAT = _FIELDS.add()  # in units of the heat at which half of the loss is reached; a pause does not cool


@inlined
def _fade(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """Share 1 - loss q / (1 + q) of the damping at heat q."""
    q = w[(e + _HEAT) * WIDTH + i]
    w[(rows.DAMPER_SHARE + c) * WIDTH + i] *= 1.0 - w[(e + _LOSS) * WIDTH + i] * (q / (1.0 + q))


@inlined
def _heat(w: Floats, e: int, c: int, i: int, h: float) -> None:
    w[(e + _HEAT) * WIDTH + i] += h * w[(e + _PACE) * WIDTH + i]


EFFECT = Effect(
    id="damper_fade",
    title="damper fade",
    where="strut",
    doc="All damper forces fall from their cold value towards (1 - loss) of it, with a time constant, from the "
    "start of each drive.",
    parameters=(
        Parameter("loss", (0.0, 0.95), Prior(0.0, 0.3), "", "share of the damping that is lost at last"),
        Parameter(
            "time_constant", (2.0, 5000.0), Prior(60.0, 3.0, "factor"), "s", "of the way there", neutral=60.0
        ),
    ),
    order=90,
    severity=("loss",),
    excited_by=("long drives", "the same road early and late"),
    confused_with=("the whole damper curve", "clock_drift"),
    hook=Hook(
        kernel=KernelTerms(
            _FIELDS,
            lambda p: {_LOSS: p["loss"], _PACE: 1 / p["time_constant"]},
            {"dampers": (_fade, CORNER), "after": (_heat, LANE)},
        ),
        models=("full_car", "quarter_car"),
    ),
    finding=lambda p: (
        f"the dampers lose {plain(p['loss'], '')} of their force as the drive goes on, "
        f"within about {plain(p['time_constant'], 's')}"
    ),
)
