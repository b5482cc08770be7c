# SPDX-License-Identifier: Apache-2.0
"""The gap between a measured and a simulated drive: rms by channel, and its floor."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.display import axes_or_new, bulleted, table
from suspension_twin.errors import WorkError
from suspension_twin.files import Json, write_text
from suspension_twin.models.car import CHANNELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

    from suspension_twin.inference.observation import Observation

__all__ = [
    "CHANNELS",
    "Comparison",
    "Gap",
    "channel_unit",
    "main_channel",
    "measure_gap",
    "pooled_gap",
    "write_gap",
]


@dataclass(frozen=True)
class Gap:
    """Differences of two signals after the same filter, over all driving on the road.

    Parameters
    ----------
    rms : float
        m/s², of the vertical acceleration at the sensor.
    mse : float
        m²/s⁴, its square.
    noise_rms : float
        m/s², its noise floor.
    channels : dict of str to float
        Root mean square of each channel, m/s² and rad/s.
    seconds : float
        How much was compared.

    Examples
    --------
    >>> Gap(0.4, 0.16, 0.05, {"vertical_acceleration": 0.4}, 60.0).as_dict()["mse"]
    0.16
    """

    rms: float
    mse: float
    noise_rms: float
    channels: dict[str, float]
    seconds: float

    def as_dict(self) -> Json:
        """The ``gap`` object of diagnosis.json, with ``seconds``."""
        return {
            "rms": self.rms,
            "mse": self.mse,
            "noise_rms": self.noise_rms,
            "channels": dict(self.channels),
            "seconds": self.seconds,
        }


class Comparison(ABC):
    """A twin over a recording: every channel measured and simulated, through the same filter and on one grid.

    Examples
    --------
    >>> import suspension_twin as st
    >>> result = st.simulate("bags/crg_road", "bags/crg_road/twin.yaml")
    >>> list(result.simulated)[:2]
    ['vertical_acceleration', 'roll_rate']
    >>> result.simulated["roll_rate"].shape == result.measured["roll_rate"].shape == result.t.shape
    True
    """

    observation: Observation
    gap: Gap

    @property
    @abstractmethod
    def simulated(self) -> Mapping[str, Floats]:
        """(m,) simulated signal of each channel, m/s² and rad/s."""

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.observation.name

    @property
    def t(self) -> Floats:
        """(m,) s, the stamps of every channel."""
        return self.observation.t

    @property
    def measured(self) -> Mapping[str, Floats]:
        """(m,) measured signal of each channel, m/s² and rad/s."""
        return self.observation.measured

    @property
    def noise_rms(self) -> Mapping[str, float]:
        """Noise floor of each channel of the gap, m/s² and rad/s."""
        return self.observation.noise_rms

    @property
    def correlation(self) -> dict[str, float]:
        """Of measured and simulated, by channel, over what the gap compares; 0 where one of them does not move."""
        rows, found = self.observation.driving, {}
        for name in self.gap.channels:
            a, b = (
                signals[name][rows] - signals[name][rows].mean()
                for signals in (self.measured, self.simulated)
            )
            found[name] = float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
        return found

    @property
    def warnings(self) -> tuple[str, ...]:
        """A line for everything that was found of the recording."""
        return self.observation.warnings

    @abstractmethod
    def write(self, folder: Path) -> None:
        """Write the simulated recording and ``gap.json`` into ``folder``."""

    def __str__(self) -> str:
        lines = [
            f"{name.replace('_', ' '):26}{rms:8.4f} {channel_unit(name):6} noise {self.noise_rms[name]:.4f}"
            for name, rms in self.gap.channels.items()
        ]
        title = f"Gap over {self.gap.seconds:.1f} s of {self.name}, rms of measured minus simulated"
        return bulleted(title, lines, self.warnings)

    __repr__ = __str__

    def plot(self, ax: Axes | None = None, channel: str = "") -> Axes:
        """Draw one channel, measured and simulated, over the time in s; returns the axes.

        The ``channel`` is the vertical acceleration where it is not named.
        """
        channel = channel or main_channel(self.measured)
        label = f"{channel.replace('_', ' ')} [{channel_unit(channel)}]"
        ax = axes_or_new(ax, "time [s]", label, f"{self.name}: gap {self.gap.channels[channel]:.3g} rms")
        for side, signals in (("measured", self.measured), ("simulated", self.simulated)):
            ax.plot(self.t - self.t[0], signals[channel], label=side, linewidth=1.0)
        ax.legend(loc="upper right")
        return ax

    def to_frame(self) -> DataFrame:
        """A table of pandas: ``measured_`` and ``simulated_`` columns of every channel over the stamp ``t`` s."""
        sides = {"measured": self.measured, "simulated": self.simulated}
        columns = {f"{side}_{name}": x for side, signals in sides.items() for name, x in signals.items()}
        return table({"t": self.t, **columns}, "t")


def measure_gap(
    measured: Mapping[str, Floats],
    simulated: Mapping[str, Floats],
    mask: NDArray[np.bool_],
    rate: float,
    noise_rms: float,
) -> Gap:
    """Measure the gap between measured and simulated channels after the same filter.

    Parameters
    ----------
    measured, simulated : mapping of str to (m,) array
        Signals by the name of the channel, m/s² and rad/s.
    mask : (m,) array of bool
        Samples that are compared.
    rate : float
        Samples a second.
    noise_rms : float
        Noise floor of the vertical acceleration in m/s².

    Returns
    -------
    Gap
        Root mean square by channel.

    Raises
    ------
    WorkError
        Nothing to compare, or a signal that is not finite.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.inference.simulated import simulate_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> result = simulate_drive(read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml"))
    >>> seen = result.observation
    >>> simulated = seen.condition(result.response)
    >>> gap = measure_gap(seen.measured, simulated, seen.driving, seen.rate, 0.02)
    >>> gap.rms == result.gap.rms
    True
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


def pooled_gap(gaps: Sequence[Gap], channels: Sequence[str]) -> Gap:
    """The gap in some channels over several drives together, each by its seconds."""
    seconds = np.array([g.seconds for g in gaps])

    def pooled(values: Sequence[float]) -> float:
        return float(np.sqrt(np.sum(seconds * np.square(values)) / seconds.sum()))

    rms = {name: pooled([g.channels[name] for g in gaps]) for name in channels}
    main = rms[main_channel(channels)]
    return Gap(main, main**2, pooled([g.noise_rms for g in gaps]), rms, float(seconds.sum()))


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
