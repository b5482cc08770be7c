# SPDX-License-Identifier: Apache-2.0
"""Planar inputs of the pose filter: yaw rate, forward specific force, lever arm of the antenna."""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled

__all__ = ["planar_inputs", "planar_row"]


@compiled
def _level(up: Floats, arm: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    """``out`` (2,): how far ``arm`` (3,) in body axes reaches ahead and to the left on level ground."""
    pitch = math.asin(-max(-1.0, min(1.0, up[0])))
    flat = math.hypot(up[1], up[2])
    cr, sr = (up[2] / flat, up[1] / flat) if flat > 1e-9 else (1.0, 0.0)
    out[0] = math.cos(pitch) * arm[0] + math.sin(pitch) * (sr * arm[1] + cr * arm[2])
    out[1] = cr * arm[1] - sr * arm[2]


@compiled
def planar_row(
    force: Floats,
    rate: Floats,
    faster: Floats,
    up: Floats,
    slow_up: Floats,
    sway: float,
    gravity: float,
    imu: Floats,
    antenna: Floats,
    out: Floats,
) -> None:  # pragma: no cover - compiled
    """``out`` (8,): yaw rate about the vertical, forward acceleration of ``base_link``, two left alone, then the
    ``antenna`` (3,) ahead and left of ``base_link`` on level ground, and its velocity there.

    The acceleration is the specific force without gravity and without what turning and its change ``faster``
    (3,) rad/s² add at the sensor's place ``imu`` (3,). ``slow_up`` is the vertical that slopes alone tilt; the
    antenna's quick sway beyond it counts by the share ``sway``.
    """
    omega = rate[0] * up[0] + rate[1] * up[1] + rate[2] * up[2]
    out[0] = omega
    out[1] = force[0] - gravity * up[0] + omega * omega * imu[0] + faster[2] * imu[1] - faster[1] * imu[2]
    arm = np.empty(2)
    swung = np.empty(2)
    _level(slow_up, antenna, arm)
    _level(up, antenna, swung)
    out[4] = arm[0] + sway * (swung[0] - arm[0])
    out[5] = arm[1] + sway * (swung[1] - arm[1])
    out[6] = -omega * antenna[1] + sway * rate[1] * antenna[2]
    out[7] = omega * antenna[0] - sway * rate[0] * antenna[2]


@compiled
def planar_inputs(
    force: Floats,
    rate: Floats,
    faster: Floats,
    up: Floats,
    slow_up: Floats,
    sway: float,
    gravity: float,
    imu: Floats,
    antenna: Floats,
) -> Floats:  # pragma: no cover - compiled
    """(n, 8) of :func:`planar_row` for whole arrays; columns 2 and 3 are zero."""
    out = np.zeros((force.shape[0], 8))
    for i in range(force.shape[0]):
        planar_row(force[i], rate[i], faster[i], up[i], slow_up[i], sway, gravity, imu, antenna, out[i])
    return out
