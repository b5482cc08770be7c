# SPDX-License-Identifier: Apache-2.0
"""The twin's pose at the moments of an engine's frames, which are not those of its messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from suspension_twin.addons.view.axes import Quaternion, Vector

__all__ = ["FramePose", "FramePoses"]

#: s by which a pose is carried on at most: a twin that has stopped sending stands, and does not drive off
#: (tolerance, by hand: a dozen poses at 60 Hz).
FARTHEST = 0.2


class FramePose(NamedTuple):
    """A pose in ``map`` for the moment ``t`` s: ``place`` m, ``turn`` a quaternion x, y, z, w; made of a message with
    the ``stamp`` s."""

    t: float
    place: Vector
    turn: Quaternion
    stamp: float

    @property
    def ahead(self) -> float:
        """Time in s by which the message was carried on; below 0 where it was not yet reached."""
        return self.t - self.stamp


class FramePoses:
    """Carries the newest pose of a twin on to any moment, with the speeds between the two newest.

    One thread may push while another asks.

    Parameters
    ----------
    origin : sequence of 3 floats
        Place in ``base_link`` of the point that the engine moves, m.

    Examples
    --------
    >>> poses = FramePoses()
    >>> for t in (10.00, 10.02):
    ...     poses.push(t, (15.0 * t, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
    >>> pose = poses.at(10.05)
    >>> [round(v, 6) for v in pose.place], pose.stamp, round(pose.ahead, 6)
    ([150.75, 0.0, 0.3], 10.02, 0.03)
    """

    def __init__(self, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        self._origin = np.asarray(origin, dtype=float)
        self._poses: tuple[tuple[float, np.ndarray, Rotation], ...] = ()

    def push(self, t: float, place: Sequence[float], turn: Sequence[float]) -> None:
        """Take a pose with the stamp ``t`` s: ``place`` m, ``turn`` a quaternion x, y, z, w. A stamp that goes back
        begins anew."""
        before = self._poses[-1:]
        if before and before[0][0] >= t:
            before = ()
        self._poses = (*before, (t, np.asarray(place, dtype=float), Rotation.from_quat(turn)))

    def at(self, t: float) -> FramePose | None:
        """The pose at ``t`` s; None before the first. Beyond 0.2 s from the newest, that at 0.2 s."""
        poses = self._poses
        if not poses:
            return None
        (first, start, before), (stamp, place, turn) = poses[0], poses[-1]
        apart = stamp - first
        if 0.0 < apart < FARTHEST:
            t = min(max(t, first), stamp + FARTHEST)
            share = (t - stamp) / apart
            place = place + share * (place - start)
            turn = Rotation.from_rotvec(share * (turn * before.inv()).as_rotvec()) * turn
        else:
            t = stamp
        x, y, z = (place + turn.apply(self._origin)).tolist()
        a, b, c, w = turn.as_quat().tolist()
        return FramePose(t, (x, y, z), (a, b, c, w), stamp)
