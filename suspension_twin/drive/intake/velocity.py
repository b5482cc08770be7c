# SPDX-License-Identifier: Apache-2.0
"""Velocities east, north, up from what recorders give: speed and bearing, or positions alone."""

from __future__ import annotations

import numpy as np
import pymap3d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import FixData, VelocityData

__all__ = ["velocities_from_course", "velocities_from_fixes"]

#: Below this speed a receiver's bearing means nothing.
_STANDING = 0.3  # m/s


def velocities_from_course(t: Floats, speed: Floats, bearing: Floats) -> VelocityData:
    """From speed in m/s and bearing in degrees clockwise from north; the vertical part is taken as 0.

    Receivers mark what they do not know by a negative number or leave it out: those samples are
    dropped, but for a bearing missing at standstill.
    """
    with np.errstate(invalid="ignore"):
        standing = (speed >= 0) & (speed < _STANDING)
        known = np.isfinite(t) & (standing | ((speed >= 0) & (bearing >= 0) & (bearing <= 360)))
    speed, angle = speed[known], np.radians(np.where(np.isfinite(bearing[known]), bearing[known], 0.0))
    enu = np.stack([speed * np.sin(angle), speed * np.cos(angle), np.zeros_like(speed)], axis=1)
    return VelocityData(t[known], enu)


def velocities_from_fixes(fix: FixData) -> VelocityData:
    """Slopes of parabolas through five neighbouring positions each (three where there are no more).

    A central difference of the same noise would need the same five fixes and lag at the ends. Fixes
    beyond a gap of five periods belong to another stretch; stretches under three fixes give none.
    """
    good = (fix.status >= 0) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & np.isfinite(fix.t)
    t, fresh = np.unique(fix.t[good], return_index=True)
    if t.size < 3:
        return VelocityData.empty()
    latitude, longitude = fix.latitude[good][fresh], fix.longitude[good][fresh]
    altitude = np.nan_to_num(fix.altitude[good][fresh])
    origin = (latitude[0], longitude[0], altitude[0])
    place = np.stack(pymap3d.geodetic2enu(latitude, longitude, altitude, *origin), axis=1)
    breaks = np.flatnonzero(np.diff(t) > 5 * np.median(np.diff(t))) + 1
    stamps, slopes = [], []
    for first, last in zip([0, *breaks], [*breaks, t.size], strict=True):
        if last - first >= 3:
            stamps.append(t[first:last])
            slopes.append(_slopes(t[first:last], place[first:last]))
    if not stamps:
        return VelocityData.empty()
    return VelocityData(np.concatenate(stamps), np.concatenate(slopes))


def _slopes(t: Floats, place: Floats) -> Floats:
    """(n, 3) derivative at each stamp of the parabola fitted to its window."""
    n, size = t.size, min(5, t.size)
    start = np.clip(np.arange(n) - size // 2, 0, n - size)
    window = start[:, None] + np.arange(size)
    x = t[window] - t[:, None]
    # least squares a + b x + c x², of which b is the derivative at the stamp itself
    design = np.stack([np.ones_like(x), x, x * x], axis=2)
    return np.asarray((np.linalg.pinv(design) @ place[window])[:, 1, :])
