# SPDX-License-Identifier: Apache-2.0
"""From the kernel's states to what a user reads: compiled, and the same for batch and live."""

from __future__ import annotations

import math

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models import rows
from suspension_twin.models.rows import ARM_X, ARM_Y, DAMPER, SPRUNG, STATIC

__all__ = ["COLUMNS", "OBSERVED", "observe"]

#: Columns of what ``observe`` fills, by the name they have in Response and LiveState.
COLUMNS: dict[str, slice | int] = {
    "heave": 0,
    "roll": 1,
    "pitch": 2,
    "z": 3,
    "wheel_z": slice(4, 8),
    "deflection": slice(8, 12),
    "deflection_rate": slice(12, 16),
    "tyre_force": slice(16, 20),
    "force": slice(20, 23),
    "rate": slice(23, 26),
    "vertical_acceleration": 26,
    "acceleration": slice(27, 34),
}
OBSERVED = 34


@compiled
def observe(states: Floats, signals: Floats, values: Floats, radius: float, msd: bool, out: Floats) -> None:
    """Fill ``out`` (n, OBSERVED) from one lane, the first of its block.

    ``states`` (n, STATES, lanes) and ``signals`` (n, 7, lanes) as the kernel wrote them, ``values``
    (rows,) the lane's constants, ``radius`` m of the tyre. The states of ``msd`` hold the springs'
    compressions themselves, since its corners need not lie in a plane.
    """
    sx, sy, sz = values[SPRUNG], values[SPRUNG + 1], values[SPRUNG + 2]
    for k in range(states.shape[0]):
        state = states[k, :, 0]
        heave, roll, pitch = state[rows.HEAVE], state[rows.ROLL], state[rows.PITCH]
        out[k, 0], out[k, 1], out[k, 2] = heave, roll, pitch
        # base_link's origin hangs under the sprung centre of gravity of the turned body
        above = math.cos(pitch) * (math.sin(roll) * sy + math.cos(roll) * sz) - math.sin(pitch) * sx
        out[k, 3] = heave + sz - above
        for i in range(4):
            x, y = values[ARM_X + i // 2], values[ARM_Y + i]
            wheel = state[rows.WHEEL + i]
            out[k, 4 + i] = wheel + radius if msd else wheel - values[STATIC + i] + radius
            body = heave + y * roll - x * pitch
            body_rate = state[rows.HEAVE_RATE] + y * state[rows.ROLL_RATE] - x * state[rows.PITCH_RATE]
            out[k, 8 + i] = values[STATIC + i] + state[DAMPER + i] if msd else wheel - body
            out[k, 12 + i] = (
                state[rows.DEFLECTION_RATE + i] if msd else state[rows.WHEEL_RATE + i] - body_rate
            )
            out[k, 16 + i] = state[rows.CONTACT + i]
        for q in range(7):
            out[k, 20 + q] = signals[k, q, 0]
            out[k, 27 + q] = state[rows.ACCELERATION + q]
