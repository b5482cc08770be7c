# SPDX-License-Identifier: Apache-2.0
"""Parameters of the live gap."""

from __future__ import annotations

from suspension_twin.gap.sliding_window import GapNow, RunningGap
from suspension_twin.nodes._files import Left, left_by_calibration
from suspension_twin.nodes._parameters import Param, Values

__all__ = ["GAP", "beyond", "gap_of", "left_of"]

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
    Param(
        "gap.warn",
        5.0,
        "Times what the calibration left from which the gap is warned of. Live, the centimetres of the GPS alone make "
        "it two or three.",
        1.0,
        1000.0,
    ),
    Param(
        "gap.bands", [0.5, 3.0, 8.0, 20.0], "Edges in Hz of the adjoining bands of the live gap.", 0.0, 800.0
    ),
)


def left_of(values: Values) -> Left:
    """What the calibration left: as the parameter says, else as the details beside the twin file do."""
    given = values["gap.floor"]
    return Left(given, 0.0) if given else left_by_calibration(values["twin"])


def gap_of(values: Values) -> RunningGap:
    """The live gap that the parameters describe; its floor is 0 where no calibration left one. Raises InputError."""
    return RunningGap(values["gap.window"], values["gap.bands"], left_of(values).rms)


def beyond(gap: GapNow | None, left: Left, times: float) -> str:
    """What is to be said of a gap of more than ``times`` what the calibration left; empty otherwise. Where the road is
    rougher than the calibration's, more is left."""
    if gap is None or not left.rms:
        return ""
    found = gap.rms / max(left.rms, left.share * gap.measured_rms)
    if found <= times:
        return ""
    return f"the gap of {gap.rms:.3g} m/s² is {found:.1f} times what the calibration left: diagnose it"
