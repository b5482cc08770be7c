# SPDX-License-Identifier: Apache-2.0
"""Parameters of the live gap."""

from __future__ import annotations

from suspension_twin.gap.running import RunningGap
from suspension_twin.nodes._files import left_by_calibration
from suspension_twin.nodes._parameters import Param, Values

__all__ = ["GAP", "gap_of"]

GAP = (
    Param("gap.window", 10.0, "Sliding window in s of the live gap.", 0.5, 600.0),
    Param("gap.rate", 5.0, "Messages a second on twin/gap.", 0.1, 100.0),
    Param(
        "gap.floor",
        0.0,
        "Gap in m/s² that the calibration left; 0: as the details beside a calibrated twin file say, "
        "else the noise at standstill.",
        0.0,
        100.0,
    ),
    Param("gap.warn", 2.0, "Times what the calibration left from which the gap is warned of.", 1.0, 1000.0),
    Param("gap.bands", [0.5, 3.0, 8.0, 20.0], "Edges in Hz of the adjoining bands of the live gap.", 0.0, 800.0),
)


def gap_of(values: Values) -> RunningGap:
    """The live gap that the parameters describe; its floor is 0 where no calibration left one. Raises InputError."""
    floor = values["gap.floor"] or left_by_calibration(values["twin"])
    return RunningGap(values["gap.window"], values["gap.bands"], floor)
