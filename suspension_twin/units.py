# SPDX-License-Identifier: Apache-2.0
"""Constants of units and standards, each in one place, and values as people write them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

__all__ = ["STANDARD_GRAVITY", "plain"]

STANDARD_GRAVITY: Final = 9.80665  #: m/s², ISO 80000-3

#: Notation of a value in an SI unit: from which size on, the divisor, and the unit.
_WRITTEN: Final[Mapping[str, tuple[tuple[float, float, str], ...]]] = {
    "": ((0.0, 0.01, "%"),),
    "m": ((0.0, 1e-3, "mm"), (0.03, 0.01, "cm"), (1.0, 1.0, "m"), (1e3, 1e3, "km")),
    "s": ((0.0, 1e-3, "ms"), (0.5, 1.0, "s")),
    "rad": ((0.0, math.pi / 180.0, "°"),),
    "rad/s": ((0.0, math.pi / 180.0, "°/s"),),
    "N": ((0.0, 1.0, "N"), (1e4, 1e3, "kN")),
    "N/m": ((0.0, 1.0, "N/m"), (1e3, 1e3, "N/mm")),
}


def plain(value: float, unit: str, digits: int = 2) -> str:
    """A value in an SI unit as people write it: a length in cm, an angle in degrees, a share in per cent.

    Parameters
    ----------
    value : float
        In ``unit``.
    unit : str
        SI unit; empty for a share.
    digits : int
        Digits that matter.

    Returns
    -------
    str
        Number and unit, with a true minus sign.

    Examples
    --------
    >>> plain(0.006, "s"), plain(-0.4, ""), plain(0.12, "m"), plain(180e3, "N/m")
    ('6 ms', '\u221240 %', '12 cm', '180 N/mm')
    """
    sizes = _WRITTEN.get(unit, ((0.0, 1.0, unit),))
    _, factor, name = [row for row in sizes if abs(value) >= row[0]][-1]
    text = _number(value / factor, digits)
    return f"{text}{'' if name.startswith('°') else ' '}{name}".strip()


def _number(value: float, digits: int) -> str:
    """``digits`` of a number, more of one above 100, without powers of ten."""
    if not value:
        return "0"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    text = f"{value:.{places}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return (text if text not in ("-0", "") else "0").replace("-", "\N{MINUS SIGN}")
