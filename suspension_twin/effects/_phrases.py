# SPDX-License-Identifier: Apache-2.0
"""Pieces of the sentences that say what an effect with its parameters is: see ``Effect.finding``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from suspension_twin.units import plain
from suspension_twin.vehicle.corners import AXLES, WHEELS

__all__ = ["Given", "axles", "changed", "listed", "more", "of_wheel"]

#: Parameters of one effect by name.
Given = Mapping[str, float]


def listed(words: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def axles(p: Given, suffix: str, unit: str) -> str:
    """``180 N at the front and 90 N at the rear``, of parameters ``front<suffix>`` and ``rear<suffix>``."""
    known = [(axle, p[f"{axle}{suffix}"]) for axle in AXLES if f"{axle}{suffix}" in p]
    there = [(axle, plain(value, unit)) for axle, value in known if value]
    written = {text for _, text in there}
    if len(known) == 1 or not there:  # a single corner, or neither
        return plain(known[0][1], unit)
    if len(there) == 2 and len(written) == 1:
        return f"{written.pop()} at front and rear"
    return listed([f"{text} at the {axle}" for axle, text in there])


def of_wheel(p: Given, part: str) -> str:
    """``the front left damper``."""
    return f"the {WHEELS[round(p['corner'])]} {part}" if "corner" in p else f"the {part}"


def changed(share: float, quantity: str) -> str:
    """``has lost 40 % of its force``."""
    verb = "has lost" if share < 0 else "has gained"
    return f"{verb} {plain(abs(share), '')} of its {quantity}"


def more(value: float, unit: str, above: str, below: str) -> str:
    """The size of a value and the word for its sign: ``60 cm ahead of``."""
    return f"{plain(abs(value), unit)} {above if value >= 0 else below}"
