# SPDX-License-Identifier: Apache-2.0
"""A bump of known size on a road that is estimated: where it is, and what its heights are."""

from __future__ import annotations

import numpy as np

from suspension_twin.addons.roads.drives.inverse import KnownHeights
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.recipe import Feature, shape_of

__all__ = ["known_heights"]

#: m about the stated place within which the bump is looked for, at so many m.
_REACH, _FINE = 3.0, 0.01
#: m before and after it that are level with its foot.
_FOOT = 0.3
#: m by which a tape, and the road under the bump, are off.
_SIGMA = 0.002
#: Correlation of the estimate with the shape below which it is another one.
_LEAST = 0.8
#: Factor by which the height may be off in an estimate with a vehicle that is not calibrated.
_ALIKE = 2.0


def known_heights(
    feature: Feature, sides: Floats, step: float, first: float = 0.0, lines: int = 1
) -> KnownHeights:
    """Find a feature on an estimated road.

    Parameters
    ----------
    feature : Feature
        Its size, and where about it starts: ``at`` m from ``first``.
    sides : (2, n) array
        Heights in m of the left and the right wheel path every ``step`` m, as far as they are estimated.
    step : float
        m.
    first : float
        m of the estimate's line that ``feature.at`` counts from.
    lines : int
        Lines beside each other that have it.

    Returns
    -------
    KnownHeights
        Its heights at the place where the estimate fits best.

    Raises
    ------
    InputError
        Nothing there looks like it.
    """
    shape = shape_of(feature)
    length = feature.size[0]
    on = [i for i, v in enumerate((0.75, -0.75)) if feature.v_low <= v <= feature.v_high]
    count = int(np.ceil((length + 2.0 * _FOOT) / step)) + 1
    share = np.linspace(0.0, 1.0, count)
    best, found, edge = -np.inf, (0, np.zeros(count)), False
    for off in np.arange(-_REACH, _REACH + _FINE, _FINE):
        at = first + feature.at + off
        start = int(np.floor((at - _FOOT) / step))
        if start < 0 or start + count > sides.shape[1] or not on:
            continue
        wanted = shape(step * (start + np.arange(count)) - at)
        part = sides[on, start : start + count]
        part = part - part[:, :1] * (1.0 - share) - part[:, -1:] * share
        gain = float((part @ wanted).mean() / (wanted @ wanted))
        norm = np.linalg.norm(part) * np.linalg.norm(wanted) * np.sqrt(len(on))
        fit = float((part @ wanted).sum() / max(norm, 1e-12))
        if fit > best and 1.0 / _ALIKE < gain < _ALIKE:
            best, found, edge = fit, (start, wanted), abs(off) > _REACH - 0.1
    if best < _LEAST or edge:
        how = "nothing of about that size" if best == -np.inf else f"the best has a correlation of {best:.2f}"
        raise InputError(
            f"--{feature.kind}",
            f"no {length:g} m by {feature.size[1]:g} m on the drives within {_REACH:g} m of {feature.at:g} m: {how}",
        )
    return KnownHeights(*found, tuple(on), _SIGMA, lines)
