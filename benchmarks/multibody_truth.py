# SPDX-License-Identifier: Apache-2.0
"""The dense truth of a multibody car, and what in it seven degrees of freedom have no place for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError
from suspension_twin.road import Road
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["AXLES", "CORNERS", "Truth", "beyond", "read_truth"]

Floats = NDArray[np.float64]
CORNERS: Final = ("FL", "FR", "RL", "RR")
AXLES: Final = ("front", "rear")
G: Final = 9.80665
#: Second derivatives of heights that are written to 10 µm mean something up to here, Hz.
_HIGHEST = 25.0
_FLANK = 0.02  # m ahead and behind that a slope is taken over


@dataclass(frozen=True, eq=False)
class Truth:
    """``columns`` (n,) of the engine's table by name, ``t`` (n,) s from the drive's ``start`` (epoch s)."""

    columns: dict[str, Floats]
    start: float
    wheelbase: float
    half_track: float

    @property
    def t(self) -> Floats:
        return self.columns["t"]

    @property
    def rate(self) -> float:
        return 1.0 / float(np.median(np.diff(self.t)))

    def at(self, t: Floats) -> dict[str, Floats]:
        """Every column at times ``t`` s."""
        return {name: np.interp(t, self.t, values) for name, values in self.columns.items()}

    @cached_property
    def pull(self) -> Floats:
        """(n,) m/s² how the speed changes."""
        return np.gradient(self.columns["v_fwd"], self.t)

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        return np.asarray(self.columns["v_fwd"] > 1.0)

    @cached_property
    def ratio(self) -> Floats:
        """(4,) strut compression for each metre of wheel travel, by the struts' own compressions, the wheels'
        heights and the body's pitch: front less rear travel is what these say together."""
        c = self.columns
        front, rear = (0.5 * (c[f"sc_{a}"] + c[f"sc_{b}"]) for a, b in (("FL", "FR"), ("RL", "RR")))
        heights = 0.5 * (c["zw_FL"] + c["zw_FR"] - c["zw_RL"] - c["zw_RR"])
        known = heights + self.wheelbase * c["pitch"]
        table = np.column_stack([front, rear, np.ones_like(front)])[self.moving]
        found = np.linalg.lstsq(table, known[self.moving], rcond=None)[0]
        return np.repeat([1 / found[0], -1 / found[1]], 2)

    def slopes(self, road: Road) -> Floats:
        """(n, 4) slope of the road along the way under each wheel."""
        out = np.empty((self.t.size, 4))
        for k in range(4):
            u = self.columns["u"] - (self.wheelbase if k > 1 else 0.0)
            v = np.full_like(u, self.half_track if k % 2 == 0 else -self.half_track)
            out[:, k] = (road.heights_uv(u + _FLANK, v) - road.heights_uv(u - _FLANK, v)) / (2 * _FLANK)
        return out

    def situations(self, road: Road) -> dict[str, NDArray[np.bool_]]:
        """What the car does, in the order in which a moment is given to the first that fits."""
        slow = _low_passed(self.pull, self.rate, 2.0)
        steep = np.abs(self.slopes(road)).max(axis=1) > 0.06
        near = (
            np.convolve(steep, np.ones(round(0.8 * self.rate)), mode="full")[: steep.size] > 0
        )  # and as it rings
        travel = np.stack([self.columns[f"sc_{c}"] for c in CORNERS], axis=1) / self.ratio
        far = np.abs(travel - np.median(travel, axis=0)).max(axis=1) > 0.03
        return {
            "steep flanks, and 0.8 s after": near & ~far,
            "travel beyond 3 cm": far,
            "braking": slow < -0.7,
            "driving": slow > 0.7,
        }


def read_truth(folder: Path, name: str) -> Truth:
    """The truth beside a drive; its time counts from the whole second that the recording starts in."""
    path = folder / f"{name}_truth.csv"
    if not path.is_file():
        raise InputError(path, "is missing: the dense truth of the drive")
    table = np.genfromtxt(path, delimiter=",", names=True)
    twin = load_twin(folder / "twin.yaml")
    start = float(round(float(read_drive(folder / name).imu.t[0])))
    columns = {n: np.ascontiguousarray(table[n], dtype=np.float64) for n in table.dtype.names or ()}
    return Truth(columns, start, twin.vehicle.wheelbase, 0.5 * twin.vehicle.front_track)


def beyond(truth: Truth, twin: Twin, road: Road) -> dict[str, float]:
    """Balances of forces that the truth itself fulfils or not; rms in N of what is left, for an axle."""
    c, moving = truth.columns, truth.moving
    pull = _low_passed(truth.pull, truth.rate, _HIGHEST)
    out: dict[str, float] = {}
    for k, axle in enumerate(AXLES):
        left, right = CORNERS[2 * k : 2 * k + 2]
        mass = getattr(twin.vehicle, axle).unsprung_mass

        def both(name: str, sign: float, pair: tuple[str, str] = (left, right)) -> Floats:
            return _low_passed(c[f"{name}_{pair[0]}"] + sign * c[f"{name}_{pair[1]}"], truth.rate, _HIGHEST)

        one = np.ones_like(truth.t)
        for sign, name in ((1.0, "both wheels"), (-1.0, "left less right")):
            lift = np.gradient(np.gradient(both("zw", sign), truth.t), truth.t)
            carried = both("Fz", sign) - mass * lift
            strut = [both("Fs", sign), both("Fd", sign), one]
            size = float(np.std(carried[moving]))
            out[f"{axle}, {name}: force between tyre and strut"] = size
            out[f"{axle}, {name}: left by spring and damper (links)"] = _left(carried, strut, moving)
            if sign > 0:
                # links that take a share of brake and drive forces, and arms that stand aslant far from rest
                kinds = [np.minimum(pull, 0.0), np.maximum(pull, 0.0)]
                out[f"{axle}, {name}: and by brake and drive forces"] = _left(
                    carried, [*strut, *kinds], moving
                )
                travel = both("sc", 1.0) / (2 * truth.ratio[2 * k])
                arms = [*kinds, travel**2, np.abs(travel) ** 3]
                out[f"{axle}, {name}: and by the square of the travel"] = _left(
                    carried, [*strut, *arms], moving
                )
        for pair, name in (((0, 1), AXLES[0]), ((2, 3), AXLES[1])):
            if name == axle:
                out |= _tyres(truth, road, axle, pair)
    return out


def _tyres(truth: Truth, road: Road, axle: str, pair: tuple[int, int]) -> dict[str, float]:
    """How well a linear spring tells the tyres' loads: upright, along the road's normal, and with damping."""
    slopes = truth.slopes(road)
    kinds = {"upright spring": 0.0, "spring along the normal": 0.0, "and a damper": 0.0}
    size = stiffness = damping = 0.0
    for k in pair:
        load = truth.columns[f"Fz_{CORNERS[k]}"]
        gap = truth.columns[f"zr_{CORNERS[k]}"] - truth.columns[f"zw_{CORNERS[k]}"]
        normal = gap / np.sqrt(1 + slopes[:, k] ** 2)
        on = truth.moving & (load > 100.0)
        one = np.ones_like(gap)
        rate = np.gradient(normal, truth.t)
        kinds["upright spring"] += _left(load, [gap, one], on) ** 2
        kinds["spring along the normal"] += _left(load, [normal, one], on) ** 2
        kinds["and a damper"] += _left(load, [normal, rate, one], on) ** 2
        fit = np.linalg.lstsq(np.column_stack([normal, rate, one])[on], load[on], rcond=None)[0]
        stiffness, damping = stiffness + fit[0] / 2, damping + fit[1] / 2
        size += float(np.var(load[on]))
    out = {f"{axle} tyres: loads on the road": float(np.sqrt(size))}
    out |= {
        f"{axle} tyres: left by a linear {name}".replace("linear and", "spring and"): float(np.sqrt(v))
        for name, v in kinds.items()
    }
    out[f"{axle} tyres: stiffness found, kN/m"] = float(stiffness) / 1e3
    out[f"{axle} tyres: damping found, N s/m"] = float(damping)
    return out


def _left(values: Floats, by: list[Floats], where: NDArray[np.bool_]) -> float:
    """rms of ``values`` that no sum of ``by`` explains."""
    table = np.column_stack(by)[where]
    found = np.linalg.lstsq(table, values[where], rcond=None)[0]
    return float(np.std(values[where] - table @ found))


def _low_passed(values: Floats, rate: float, cutoff: float) -> Floats:
    return np.asarray(sosfiltfilt(butter(2, cutoff, fs=rate, output="sos"), values))
