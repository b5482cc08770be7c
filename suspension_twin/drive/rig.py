# SPDX-License-Identifier: Apache-2.0
"""Recorded runs of a test rig: motion of its actuator and measurements of the corner on it.

A run is a CSV with a column for the time and one for each quantity, units in the header
(``road_displacement_mm``, ``body_acceleration [m/s^2]``), or a recording in which ``/joint_states`` holds the joints
``road`` (position, velocity) and ``suspension`` (position as compression, effort of an actuator in it) and the
accelerometers are ``/imu/data_raw`` on the body and ``/wheel/imu/data_raw`` on the wheel.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline

from suspension_twin.arrays import Floats
from suspension_twin.drive.contents import Contents, decode_topic
from suspension_twin.drive.foreign_files import read_table
from suspension_twin.drive.recording import is_recording, read_recording
from suspension_twin.drive.stamps import of_one_recording
from suspension_twin.errors import InputError
from suspension_twin.files import comment_lines, read_bytes, reader, replacing
from suspension_twin.units import STANDARD_GRAVITY

__all__ = [
    "HUBS",
    "QUANTITIES",
    "RigRecord",
    "checked_rig",
    "driven_by_wheel",
    "read_rig",
    "rig_unit",
    "upright",
    "write_rig",
]

_LENGTH: Final = {"m": 1.0, "mm": 1e-3}
_SPEED: Final = {"m_s": 1.0, "mm_s": 1e-3}
_ACCELERATION: Final = {"m_s2": 1.0, "g": STANDARD_GRAVITY}
_FORCE: Final = {"n": 1.0, "kn": 1e3}
_RATE: Final = {"rad_s": 1.0, "deg_s": math.pi / 180.0}
#: Before the columns of each wheel of a car.
HUBS: Final = ("front_left_", "front_right_", "rear_left_", "rear_right_")
#: Units of each quantity, the SI unit first, and the largest range on any rig: beyond it the unit is another.
QUANTITIES: Final[Mapping[str, tuple[Mapping[str, float], float]]] = {
    "time": ({"s": 1.0, "ms": 1e-3}, np.inf),
    "road_displacement": (_LENGTH, 2.0),
    "road_velocity": (_SPEED, 20.0),
    "body_displacement": (_LENGTH, 5.0),
    "wheel_displacement": (_LENGTH, 5.0),
    "body_acceleration": (_ACCELERATION, 5000.0),
    "wheel_acceleration": (_ACCELERATION, 5000.0),
    "suspension_deflection": (_LENGTH, 2.0),
    "tyre_force": (_FORCE, 1e6),
    "actuator_force": (_FORCE, 1e6),
    "vertical_acceleration": (_ACCELERATION, 5000.0),
    "roll_rate": (_RATE, 100.0),
    "pitch_rate": (_RATE, 100.0),
    **{f"{hub}wheel_displacement": (_LENGTH, 5.0) for hub in HUBS},
    **{f"{hub}wheel_acceleration": (_ACCELERATION, 5000.0) for hub in HUBS},
}
_LARGEST: Final = 1 << 30  # bytes of a table
_ROAD: Final = ("road_displacement", "road_velocity")
_WHEEL: Final = ("wheel_displacement", "wheel_acceleration")
#: Hz above which the motion of a wheel is taken from its accelerometer: well below any bounce of a body, 1 Hz
#: (tolerance, by hand).
_LOWEST: Final = 0.2
#: s over which gravity is the mean of what a wheel feels, and the angle of a gyroscope's own does not drift: 10 s at
#: 0.1 °/s is 1° (tolerance, by hand).
_UPRIGHT: Final = 20.0
_BODY: Final = ("body_acceleration", "body_displacement", "vertical_acceleration")
_ACCELEROMETERS: Final = {"/imu/data_raw": "body_acceleration", "/wheel/imu/data_raw": "wheel_acceleration"}
_JOINTS: Final = "/joint_states"
_FIELDS: Final = {
    ("road", "position"): "road_displacement",
    ("road", "velocity"): "road_velocity",
    ("suspension", "position"): "suspension_deflection",
    ("suspension", "effort"): "actuator_force",
}


@dataclass(frozen=True, eq=False)
class RigRecord:
    """One run of a rig: rising stamps ``t`` (n,) s and ``columns`` (n,) in SI units by quantity.

    Upwards is positive, so is compression, and so is an actuator's force that pushes the body up. Accelerations may
    contain gravity or not, displacements may count from anywhere: only changes are compared.
    """

    name: str
    t: Floats
    columns: Mapping[str, Floats]
    warnings: tuple[str, ...] = ()

    def channel(self, name: str) -> Floats | None:
        """(n,) a response as it was measured, or as it follows from measured displacements: an acceleration as the
        second derivative of a quintic spline, a deflection as a difference; None where it is neither."""
        columns = self.columns
        if name in columns:
            return columns[name]
        if name == "suspension_deflection" and {"body_displacement", "wheel_displacement"} <= set(columns):
            return columns["wheel_displacement"] - columns["body_displacement"]
        moved = columns.get(name.replace("acceleration", "displacement"))
        if moved is None or not name.endswith("acceleration"):
            return None
        t = self.t - self.t[0]
        return np.asarray(make_interp_spline(t, moved, 5).derivative(2)(t))


def driven_by_wheel(record: RigRecord, wheels: Sequence[str] = ("",)) -> RigRecord:
    """The run with the measured motion of its ``wheels``, by the words before their columns, in the place of the road.

    It is their displacements, or the velocities that accelerometers give above 0.2 Hz; InputError where neither was
    measured."""
    kept = {name: values for name, values in record.columns.items() if not name.endswith((*_ROAD, *_WHEEL))}
    deflection = record.channel("suspension_deflection")
    if deflection is not None:
        kept["suspension_deflection"] = deflection
    heights, pulls = (
        {w: record.columns[f"{w}{name}"] for w in wheels if f"{w}{name}" in record.columns} for name in _WHEEL
    )
    if len(heights) == len(wheels):
        moved = {f"{w}road_displacement": height - height[0] for w, height in heights.items()}
        return replace(record, columns={**moved, **kept})
    if len(pulls) < len(wheels):
        of = " of each of the four wheels" if len(wheels) > 1 else ""
        raise InputError(record.name, "wheel_displacement", f"is missing{of}, and so is wheel_acceleration")
    rate = (record.t.size - 1) / float(record.t[-1] - record.t[0])
    from scipy.signal import butter, sosfiltfilt  # a calibration does not wait for it

    sos = butter(2, _LOWEST, "highpass", fs=rate, output="sos")
    beyond = min(record.t.size - 1, round(rate / _LOWEST))

    def speed(pull: Floats) -> Floats:
        drifting = CubicSpline(record.t, pull - pull.mean()).antiderivative()(record.t)
        # mirrored beyond both ends, where the wheel goes on moving
        return np.asarray(sosfiltfilt(sos, drifting, padtype="even", padlen=beyond))

    return replace(record, columns={**{f"{w}road_velocity": speed(p) for w, p in pulls.items()}, **kept})


def upright(label: str, t: Floats, across: NDArray[np.complex128], spin: Floats) -> Floats:
    """(n,) upward specific force at the hub of a wheel that an accelerometer turns with, in its units.

    ``across`` (n,) is what it reads across the axle, x + iy, at ``t`` (n,) s, and ``spin`` (n,) rad/s its rate of turn
    about z. With θ the angle turned and ρ its place beside the axle,

    ``across = f exp(-iθ) + ρ (iθ'' - θ'²) + b``,

    where the mean of f points up. ρ and the bias b are found by least squares, as they stand still on the sensor.
    """
    from scipy.signal import butter, sosfiltfilt  # a calibration does not wait for it

    if t[-1] - t[0] < _UPRIGHT:
        raise InputError(
            label, f"spin: which way is up shows in {_UPRIGHT:g} s or more, not in {t[-1] - t[0]:.3g}"
        )
    rate = (t.size - 1) / float(t[-1] - t[0])
    sos = butter(2, 2.0 / _UPRIGHT, fs=rate, output="sos")
    turned = np.exp(1j * CubicSpline(t, spin).antiderivative()(t))

    def mean(values: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return np.asarray(sosfiltfilt(sos, values.real) + 1j * sosfiltfilt(sos, values.imag))

    still = np.column_stack([1j * CubicSpline(t, spin)(t, 1) - spin**2, np.ones(t.size)])
    # without what is as slow as gravity once it is turned upright
    slow = np.column_stack([x - mean(x * turned) / turned for x in (*still.T, across)])
    found = np.linalg.lstsq(slow[:, :2], slow[:, 2], rcond=None)[0]
    force = (across - still @ found) * turned
    return np.asarray((force * np.exp(-1j * np.angle(mean(force)))).real)


@reader("a run of a rig")
def read_rig(path: str | Path) -> RigRecord:
    """A run from a CSV or a recording; InputError names the file and the quantity that is wrong or missing."""
    path = Path(path)
    columns, warnings = (_of_recording if path.is_dir() or is_recording(path) else _of_table)(path)
    return checked_rig(path, path.stem, columns, tuple(warnings))


def rig_unit(text: str) -> str:
    """A unit as headers have it: ``m_s2`` of ``[m/s²]``."""
    plain = text.casefold().replace("²", "2").replace("^", "").replace("/", "_")
    return re.sub(r"[\s\[\]()]|^_+", "", plain.strip(" _"))


def checked_rig(
    path: str | Path, name: str, columns: dict[str, Floats], warnings: tuple[str, ...]
) -> RigRecord:
    """A run of columns (n,) in SI units, ``time`` among them; InputError names what is missing or wrong."""
    there = ", ".join(columns) or "no known columns"
    if "time" not in columns:
        hint = "; a mapping file names the columns of any other table (import --mapping)"
        raise InputError(path, "time", f"is missing, there are {there}{hint}")
    if not set(_BODY) & set(columns):
        raise InputError(
            path, "body_acceleration", f"is missing, there are {there}; body_displacement would do"
        )
    if not any(name.endswith((*_ROAD, *_WHEEL)) for name in columns):
        raise InputError(
            path,
            "road_displacement",
            "is missing, and so is road_velocity: a quarter_car needs one of them, or the motion of the wheel; a "
            "drive on a road is for another model, such as full_car",
        )
    for quantity, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise InputError(path, quantity, f"is no number in row {bad[0] + 1}: cut or fill the gap")
        if np.ptp(values) > QUANTITIES[quantity][1]:
            unit = next(iter(QUANTITIES[quantity][0]))
            raise InputError(path, quantity, f"ranges over {np.ptp(values):.3g} {unit}: is its unit another?")
    t = columns.pop("time")
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        raise InputError(path, "time", f"does not rise in row {back[0] + 2}")
    return RigRecord(name, t, columns, warnings)


def write_rig(record: RigRecord, path: Path, comment: str = "") -> None:
    """Write a run as a CSV that ``read_rig`` reads back, SI units, ``comment`` in its first line."""
    table = {"time": record.t, **record.columns}
    names = [f"{name}_{next(iter(QUANTITIES[name][0]))}" for name in table]
    head = (comment_lines(comment) if comment else "") + ",".join(names)
    digits = ["%.15g", *["%.6g"] * len(record.columns)]
    with replacing(path) as temporary:
        np.savetxt(temporary, np.stack(list(table.values()), axis=1), digits, ",", header=head, comments="")
        columns, _ = _of_table(temporary)
        checked_rig(path, path.stem, columns, ())  # or it would be refused when it is read


def _of_table(path: Path) -> tuple[dict[str, Floats], list[str]]:
    table = read_table(read_bytes(path, _LARGEST), str(path), header=True)
    columns: dict[str, Floats] = {}
    unused = []
    for index, title in enumerate(table.names):
        text = title.casefold()
        name = next((q for q in QUANTITIES if text.startswith(q)), None)
        units = QUANTITIES[name][0] if name else {}
        unit = rig_unit(text.removeprefix(name)) if name else ""
        # many a column begins with the word time: time_offset, "Time - road"
        if name is None or (name == "time" and unit and unit not in units):
            unused.append(title)
            continue
        if unit not in units:
            raise InputError(path, title[:60], f"needs a unit: {' or '.join(f'{name}_{u}' for u in units)}")
        if name in columns:
            raise InputError(path, name, "has two columns")
        columns[name] = units[unit] * table.numbers(index)
    return columns, [*table.warnings, *([f"columns not used: {', '.join(unused)}"] if unused else [])]


def _of_recording(path: Path) -> tuple[dict[str, Floats], list[str]]:
    """Everything at the stamps of the body's accelerometer, between which the other topics follow cubic splines."""
    contents = read_recording(path, {*_ACCELEROMETERS, _JOINTS})
    found = {
        name: _stamped(contents, topic, "linear_acceleration.z")
        for topic, name in _ACCELEROMETERS.items()
        if topic in contents.topics
    }
    if "body_acceleration" not in found:
        there = ", ".join(sorted(contents.types)[:8]) or "no topics"
        raise InputError(path, "/imu/data_raw", f"is missing, there are {there}")
    joints = decode_topic(contents, _JOINTS)
    strings = joints[0].layout.strings if joints else {}
    names = [joints[0].text(f"name.{i}") for i in range(8) if f"name.{i}" in strings]
    for (joint, quantity), name in _FIELDS.items():
        if joint in names and quantity in (joints[0].records.dtype.names or ()):
            t, rows = _stamped(contents, _JOINTS, quantity)
            values = rows[:, names.index(joint)]
            if np.isfinite(values).all():
                found[name] = t, values
    begin, end = (f([t[i] for t, _ in found.values()]) for f, i in ((max, 0), (min, -1)))
    t = found["body_acceleration"][0]
    t = t[(t >= begin) & (t <= end)]
    columns = {name: CubicSpline(own, values)(t) for name, (own, values) in found.items()}
    return {"time": t, **columns}, contents.warnings


def _stamped(contents: Contents, topic: str, name: str) -> tuple[Floats, Floats]:
    """Rising header stamps in s and a field's values in their order."""
    groups = decode_topic(contents, topic)
    if not groups:
        raise InputError(topic, "no message could be read")
    ns, first = np.unique(np.concatenate([g.stamp_ns for g in groups]), return_index=True)
    values = np.concatenate([g[name] for g in groups]).astype(np.float64)[first]
    own = of_one_recording(ns / 1e9)
    if not own.all():
        contents.warnings.append(f"{topic}: {int((~own).sum())} stamps lie far from the others: left out")
    if own.sum() < 4:
        raise InputError(topic, f"holds {own.sum()} messages with stamps of their own, which are too few")
    return ns[own] / 1e9, values[own]
