# SPDX-License-Identifier: Apache-2.0
"""The gap between a measured and a simulated drive: rms by channel, and its floor."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import WorkError
from suspension_twin.files import write_text
from suspension_twin.models.car import CHANNELS

__all__ = ["CHANNELS", "Gap", "channel_unit", "main_channel", "measure_gap", "write_gap"]


@dataclass(frozen=True)
class Gap:
    """What separates two signals that went through the same filter.

    ``rms`` and ``mse`` of the main channel (m/s² and m²/s⁴ of the vertical acceleration), ``noise_rms`` its floor,
    ``channels`` the rms of each channel (m/s² and rad/s), ``seconds`` how much was compared.
    """

    rms: float
    mse: float
    noise_rms: float
    channels: dict[str, float]
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """The ``gap`` object of diagnosis.json, with ``seconds``."""
        return {
            "rms": self.rms,
            "mse": self.mse,
            "noise_rms": self.noise_rms,
            "channels": dict(self.channels),
            "seconds": self.seconds,
        }


def measure_gap(
    measured: Mapping[str, Floats],
    simulated: Mapping[str, Floats],
    mask: NDArray[np.bool_],
    rate: float,
    noise_rms: float,
) -> Gap:
    """The gap over the samples of ``mask`` (m,) at ``rate`` Hz; signals (m,) by channel name.

    Raises WorkError if there is nothing to compare or a signal is not finite there.
    """
    count = int(np.count_nonzero(mask))
    if count == 0:
        raise WorkError("nothing to compare: no sample has a pose, a road and a whole signal")
    rms: dict[str, float] = {}
    for channel in measured:
        difference = (np.asarray(measured[channel]) - np.asarray(simulated[channel]))[mask]
        value = float(np.sqrt(np.mean(difference**2)))
        if not np.isfinite(value):
            raise WorkError(f"the gap of {channel} is not a number: the simulation has failed")
        rms[channel] = value
    main = rms[main_channel(measured)]
    return Gap(main, main**2, noise_rms, rms, count / rate)


def main_channel(names: Iterable[str]) -> str:
    """The channel that speaks for all: the vertical acceleration, or the first where that is not measured."""
    known = list(names)
    return CHANNELS[0] if CHANNELS[0] in known else known[0]


def channel_unit(name: str) -> str:
    """SI unit of a channel, by the last word of its name."""
    units = {"acceleration": "m/s²", "rate": "rad/s", "velocity": "m/s", "force": "N"}
    return units.get(name.rpartition("_")[2], "m")


def write_gap(document: Mapping[str, Any], folder: Path) -> None:
    """Write ``folder/gap.json``."""
    write_text(
        folder / "gap.json", json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    )
