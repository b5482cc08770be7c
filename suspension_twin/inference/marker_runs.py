# SPDX-License-Identifier: Apache-2.0
"""Marker runs of a tracked vehicle: motion of markers on the hull, from a CSV or from poses in a bag.

The paper films three markers and takes displacement, velocity and acceleration from a photogrammetry tool. The time
of a run is zero where the front edge of the idler is 0.5 m before the obstacle."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.interpolate import make_smoothing_spline

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.drive.contents import decode_topic, topic_name
from suspension_twin.drive.recording import read_recording
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError
from suspension_twin.files import open_text, reader
from suspension_twin.inference.priors import SINGLE
from suspension_twin.vehicle.tracked import TrackedVehicle

__all__ = [
    "CUTOFF",
    "FLOORS",
    "MARKERS",
    "RATE",
    "MarkerRun",
    "low_pass",
    "read_markers",
    "read_poses",
    "read_run",
    "run_speed",
]

MARKERS: Final = ("A", "B", "C")
RATE: Final = 50.0  # Hz, of the grid that runs are compared on
_MOTION: Final = ("displacement", "velocity", "acceleration")
_KINDS: Final = tuple(f"{motion}_{unit}" for motion, unit in zip(_MOTION, ("mm", "m_s", "m_s2"), strict=True))
_POSE_TYPE: Final = "geometry_msgs/msg/PoseStamped"
#: Hz, cut-off of the low-pass of measured and simulated signals: accelerations by photogrammetry are noise above it.
CUTOFF: Final = 6.0
#: Least noise (standard deviation) of displacement m, velocity m/s and acceleration m/s² of A, B, C by photogrammetry.
FLOORS: Final = np.repeat([SINGLE[f"marker_{kind}"] for kind in _MOTION], len(MARKERS))


@dataclass(frozen=True)
class MarkerRun:
    """One run at uniform stamps ``t`` (n,) s from its start; ``speed`` m/s. Low-passed, see :func:`low_pass`.

    ``markers``, ``velocity``, ``acceleration`` (n, 3) upwards of A, B, C in m, m/s, m/s²; a marker that was
    not measured is a column of zeros and False in ``seen``.
    """

    t: Floats
    markers: Floats
    velocity: Floats
    acceleration: Floats
    speed: float
    name: str = "run"
    seen: tuple[bool, ...] = (True, True, True)

    @property
    def rate(self) -> float:
        """Stamps per second."""
        return float((self.t.size - 1) / (self.t[-1] - self.t[0]))


def run_speed(path: str | Path) -> float:
    """Speed in m/s from a name such as ``13kmh_2.csv``; InputError where the name has none."""
    found = re.search(r"(\d+(?:\.\d+)?)\s*_?km_?h", Path(path).name, re.IGNORECASE)
    if found is None:
        raise InputError(path, "speed", "the name has none: call it such as 13kmh_1.csv")
    return float(found.group(1)) / 3.6


@reader("a run")
def read_run(path: str | Path, vehicle: TrackedVehicle, speed: float | None = None) -> MarkerRun:
    """A run from a CSV of marker tracks, or from the poses in a recording (folder, ``.mcap``, ``.db3``)."""
    return _read(Path(path), vehicle, speed)


def _read(path: Path, vehicle: TrackedVehicle, speed: float | None) -> MarkerRun:
    speed = run_speed(path) if speed is None else speed
    if path.is_dir() or path.suffix in (".mcap", ".db3", ".bag"):
        return read_poses(path, vehicle, speed)
    return read_markers(path, speed)


@reader("a run")
def read_markers(path: str | Path, speed: float, *, rate: float = RATE) -> MarkerRun:
    """Marker tracks from a CSV: ``time_s`` and ``A_displacement_mm``, ``A_velocity_m_s``, ``A_acceleration_m_s2``,
    B and C likewise, in any order.

    A and B need a displacement; velocities and accelerations that are missing are taken from a smoothing
    spline. ``t,A,B`` (s, mm, mm) reads as well. Any stamps that rise, resampled to ``rate`` Hz. Raises
    InputError that names the file and what is wrong.
    """
    path = Path(path)
    try:
        with open_text(path) as file:
            names = [_column(name.strip()) for name in file.readline().split(",")]
            _check_header(path, names)
            table = np.loadtxt(file, delimiter=",", ndmin=2)
    except OSError as error:
        raise InputError(path, error.strerror or "cannot be read") from None
    except UnicodeDecodeError:
        raise InputError(path, "not a text file") from None
    except ValueError as error:
        raise InputError(path, f"not a table of numbers: {str(error).splitlines()[0][:80]}") from None
    if table.shape[0] < 20 or table.shape[1] != len(names):
        raise InputError(
            path,
            f"needs {len(names)} columns and at least 20 rows, has {table.shape[1]} and {table.shape[0]}",
        )
    if not np.isfinite(table).all():
        raise InputError(path, "holds values that are no numbers: cut or fill the gaps")
    columns = dict(zip(names, table.T, strict=True))
    t = columns["time_s"]
    if not (np.diff(t) > 0).all():
        raise InputError(path, "time_s", "must rise from row to row")
    if t[0] < 0:
        raise InputError(path, "time_s", "must not begin before 0, where the run does")
    seen = tuple(f"{m}_displacement_mm" in columns for m in MARKERS)
    for marker, have in zip(MARKERS, seen, strict=True):
        if have and np.ptp(columns[f"{marker}_displacement_mm"]) > 5000.0:
            raise InputError(path, f"{marker}_displacement_mm", "moves by more than 5 m: is the unit mm?")
    motion = []
    for derivative, kind in enumerate(_KINDS):
        values = []
        for marker, have in zip(MARKERS, seen, strict=True):
            key = f"{marker}_{kind}"
            if key in columns:
                values.append(columns[key] * (1e-3 if kind.endswith("_mm") else 1.0))
            elif have:
                values.append(_derivative(t, 1e-3 * columns[f"{marker}_displacement_mm"], derivative))
            else:
                values.append(np.zeros(t.size))
        motion.append(np.stack(values, axis=1))
    return _resampled(t, motion, rate, speed, path.stem, seen)


def _column(name: str) -> str:
    return {"t": "time_s", **{m: f"{m}_displacement_mm" for m in MARKERS}}.get(name, name)


def _check_header(path: Path, names: list[str]) -> None:
    known = ["time_s", *(f"{m}_{k}" for m in MARKERS for k in _KINDS)]
    for name in names:
        if name not in known:
            raise InputError(path, "header", f"{name[:40]!r} is not a column: {', '.join(known)}")
        if names.count(name) > 1:
            raise InputError(path, "header", f"{name} stands there twice")
    for name in ("time_s", "A_displacement_mm", "B_displacement_mm"):
        if name not in names:
            raise InputError(path, "header", f"has no {name}")


def _derivative(t: Floats, values: Floats, order: int) -> Floats:
    """Derivative of a smoothing spline with a cut-off of twice ``CUTOFF``."""
    if order == 0:
        return values
    step = float(np.median(np.diff(t)))
    return np.asarray(make_smoothing_spline(t, values, lam=1.0 / step / (4 * np.pi * CUTOFF) ** 4)(t, order))


def low_pass(motion: Floats, rate: float) -> Floats:
    """Motion (n, k) at ``rate`` Hz through the zero-phase low-pass of ``CUTOFF`` Hz."""
    if rate <= 2.5 * CUTOFF:
        return motion
    from scipy.signal import butter, sosfiltfilt  # half a second, which a car's calibration does not wait for

    sos = butter(2, CUTOFF, fs=rate, output="sos")
    return np.asarray(sosfiltfilt(sos, motion, axis=0, padlen=min(30, motion.shape[0] - 1)))


def _resampled(
    t: Floats, motion: list[Floats], rate: float, speed: float, name: str, seen: tuple[bool, ...]
) -> MarkerRun:
    columns = 2 * len(motion) * len(MARKERS)  # before and after the filter
    Budget(name, t.nbytes).take(int(columns * t.itemsize * min(np.ptp(t) * rate, 1e15)))
    first = np.ceil(t[0] * rate - 1e-9)
    grid = np.arange(first, np.floor(t[-1] * rate + 1e-9) + 1) / rate
    if grid.size < 20:
        raise InputError(name, f"lasts {t[-1] - t[0]:.2f} s, which is too short for a run")
    z, v, a = (low_pass(interpolated(grid, t, m), rate) for m in motion)
    return MarkerRun(grid, z, v, a, speed, name, seen)


@reader("a run")
def read_poses(
    path: str | Path, vehicle: TrackedVehicle, speed: float, *, topic: str = "/pose", rate: float = RATE
) -> MarkerRun:
    """Marker tracks from poses of the hull (geometry_msgs/PoseStamped, base_link in map) in a recording.

    Displacements are those of the markers that move with the pose, from its first one; the clock begins
    with the first message. Raises InputError that names the recording and the topic.
    """
    name = topic_name(topic)
    contents = read_recording(path, {name})
    have = contents.types.get(name)
    if have != _POSE_TYPE:
        there = ", ".join(sorted(contents.types)[:8]) or "no topics"
        raise InputError(path, name, f"holds {have}, not {_POSE_TYPE}" if have else f"is missing: {there}")
    groups = decode_topic(contents, name)
    if not groups:
        raise InputError(path, name, "no message could be read")
    ns = np.concatenate([g.stamp_ns for g in groups])
    position = np.concatenate([g.columns("pose.position", "xyz") for g in groups])
    q = np.concatenate([g.columns("pose.orientation", "xyzw") for g in groups])
    order = np.argsort(ns, kind="stable")
    t = (ns[order] - ns[order[0]]) / 1e9
    keep = (
        np.concatenate([[True], np.diff(t) > 0])
        & np.isfinite(position[order]).all(1)
        & np.isfinite(q[order]).all(1)
    )
    if keep.sum() < 20:
        raise InputError(path, name, f"{int(keep.sum())} usable poses are too few")
    t, position, (x, y, z, w) = t[keep], position[order][keep], q[order][keep].T
    size = x * x + y * y + z * z + w * w
    # heights of points of the hull: the last row of the rotation
    along, above = 2 * (x * z - w * y) / size, 1 - 2 * (x * x + y * y) / size
    places = np.array([vehicle.markers.A, vehicle.markers.B, vehicle.markers.C]) / 1000
    forward, up = -places[:, 0] - vehicle.stations[-1].x, places[:, 1] - vehicle.ground_height
    height = position[:, 2:] + along[:, None] * forward + above[:, None] * up
    height = height - height[0]
    motion = [np.stack([_derivative(t, column, k) for column in height.T], axis=1) for k in (1, 2)]
    return _resampled(t, [height, *motion], rate, speed, Path(path).stem, (True, True, True))
