# SPDX-License-Identifier: Apache-2.0
"""What a session with the nodes gives back, as arrays and numbers. No ROS in here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from suspension_twin.arrays import Floats

__all__ = ["CalibrateAnswer", "Feedback", "Replay"]


@dataclass(frozen=True, eq=False)
class Replay:
    """What the nodes published while a drive was played.

    ``t`` (n,) s stamps that both signals have; ``measured`` and ``simulated`` (n,) m/s² from
    ``imu/vertical_acceleration`` and ``twin/vertical_acceleration``. ``path`` (m, 6) from ``twin/odom``:
    stamp, x and y (m), yaw (rad), speed (m/s), and the standard deviation of the yaw (rad), infinite
    while it is not known. ``gap`` (k, 2) from ``twin/gap``: stamp, rms (m/s²). ``wall`` s it all took.
    """

    t: Floats
    measured: Floats
    simulated: Floats
    path: Floats
    gap: Floats
    wall: float


@dataclass(frozen=True)
class Feedback:
    """A word of the action on its way, see Calibrate.action."""

    stage: str
    generation: int
    evaluations: int
    best_cost: float
    mean_cost: float
    seconds_left: float


@dataclass(frozen=True)
class CalibrateAnswer:
    """The result of the action, see Calibrate.action; ``values`` by dotted key."""

    message: str
    output: Path
    cost: float
    initial_cost: float
    evaluations: int
    generations: int
    values: dict[str, float]
    excited: dict[str, bool]
    wall: float
