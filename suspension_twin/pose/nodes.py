# SPDX-License-Identifier: Apache-2.0
"""A recorded drive as nodes of the pose filter: times, inputs, measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.pose import ekf
from suspension_twin.pose.inputs import planar_inputs
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.settings import VELOCITY_SHARE, PoseSettings, fix_sigma
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.vehicle.twin import Datum, Place

__all__ = [
    "MAX_MEAN_SLOPE",
    "SLOPE_TIME",
    "Measurements",
    "Nodes",
    "gather",
    "make_nodes",
    "mean_tilt",
    "planar_rows",
]

#: Hz to which yaw rate and forward pull are smoothed before they meet the filter's nodes.
PLANAR = FilterSpec(2, 12.0)
STEP = 0.01  # s between nodes at most
MAX_MEAN_SLOPE = 3.0  # degrees on average of a drive; a larger mean tilt is the sensor's mounting
SLOPE_TIME = 5.0  # s; what tilts the vehicle for longer is a slope, not a sway


@dataclass(frozen=True, eq=False)
class Measurements:
    """Fixes, velocities and headings in the order of time: ``t`` (m,), ``kind`` (m,), ``z`` (m, 3) two
    numbers and a standard deviation."""

    t: Floats
    kind: Floats
    z: Floats


@dataclass(frozen=True, eq=False)
class Nodes:
    """What the filter runs over: ``t`` (k,) s, ``kind`` (k,) of the measurement there, below 0 for none, ``z``
    (k, 3), ``inputs`` (k, 8) over the interval before each node, ``sway`` (k, 4) what the antenna's
    quick swinging adds to the last four of them. ``inputs`` and ``z`` are the caller's to change."""

    t: Floats
    kind: Floats
    z: Floats
    inputs: Floats
    sway: Floats


def gather(drive: Drive, datum: Datum, settings: PoseSettings) -> Measurements:
    """Every usable measurement of ``drive``. Raises InputError where there is no fix."""
    fix, velocity = drive.fix, drive.velocity
    sigma = np.array(
        [
            fix_sigma(settings, int(status), float(east), float(north))
            for status, (east, north) in zip(fix.status, fix.sigma[:, :2], strict=True)
        ],
        dtype=np.float64,
    )
    usable = np.isfinite(fix.t) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & np.isfinite(sigma)
    if not usable.any():
        raise InputError(drive.name, "fix", "has no usable GPS fix: the pose cannot be found")
    height = np.where(np.isfinite(fix.altitude), fix.altitude, datum.altitude)
    enu = LocalMap(datum).to_map(fix.latitude[usable], fix.longitude[usable], height[usable])
    parts = [(fix.t[usable], ekf.FIX, np.column_stack([enu[:, :2], sigma[usable]]))]
    good = np.isfinite(velocity.t) & np.isfinite(velocity.enu[:, :2]).all(axis=1)
    spread = max(settings.velocity_sigma, VELOCITY_SHARE * float(np.median(sigma[usable])))
    parts.append((velocity.t[good], ekf.VELOCITY, _with(velocity.enu[good, :2], spread)))
    if drive.heading is not None:
        good = np.isfinite(drive.heading.t) & np.isfinite(drive.heading.yaw)
        yaw = drive.heading.yaw[good]
        pair = np.column_stack([yaw, np.zeros_like(yaw)])
        parts.append((drive.heading.t[good], ekf.HEADING, _with(pair, settings.heading_sigma)))
    t = np.concatenate([part[0] for part in parts])
    kind = np.concatenate([np.full(len(part[0]), float(part[1])) for part in parts])
    z = np.vstack([part[2] for part in parts])
    order = np.lexsort((kind, t))
    t, kind, z = t[order], kind[order], z[order]
    fresh = np.ones(t.size, dtype=np.bool_)
    fresh[1:] = (np.diff(t) > 0) | (np.diff(kind) != 0)
    return Measurements(t[fresh], kind[fresh], z[fresh])


def _with(pair: Floats, sigma: float) -> Floats:
    return np.column_stack([pair, np.full(len(pair), sigma)])


def planar_rows(signals: ImuSignals, gps_place: Place, upright: bool = False) -> tuple[Floats, Floats]:
    """(n, 8) planar inputs at the IMU's stamps without the antenna's sway, and (n, 4) what it adds; ``upright``: on
    average the tilt is that of the sensor's mounting, not of the vehicle with its antenna."""
    spec = FilterSpec(PLANAR.order, min(PLANAR.cutoff, 0.4 * signals.rate_hz))
    force = zero_phase(spec, signals.rate_hz, signals.force)
    rate = zero_phase(spec, signals.rate_hz, signals.rate)
    slow = gaussian_filter1d(signals.up, SLOPE_TIME * signals.rate_hz, axis=0, mode="nearest")
    slow /= np.linalg.norm(slow, axis=1, keepdims=True)
    faster = np.gradient(rate, signals.t, axis=0)
    imu, antenna = np.array(signals.place.position), np.array(gps_place.position)
    still, swaying = (
        planar_inputs(force, rate, faster, signals.up, slow, share, signals.gravity, imu, antenna)
        for share in (0.0, 1.0)
    )
    # the antenna tilts with the vehicle, not with the sensor's mounting
    if upright or mean_tilt(signals.up) > MAX_MEAN_SLOPE:
        up, slow = _upright(signals.up), _upright(slow)
        for share, out in ((0.0, still), (1.0, swaying)):
            right = planar_inputs(force, rate, faster, up, slow, share, signals.gravity, imu, antenna)
            out[:, 4:] = right[:, 4:]
    still[:, 2] = signals.standing
    return still, swaying[:, 4:] - still[:, 4:]


def mean_tilt(up: Floats) -> float:
    """Degrees by which the mean of verticals (n, 3) is off the z axis."""
    mean = up.mean(axis=0)
    return math.degrees(math.atan2(math.hypot(mean[0], mean[1]), mean[2]))


def _upright(up: Floats) -> Floats:
    """Verticals (n, 3) turned so that their mean is the z axis."""
    mean = up.mean(axis=0)
    mean /= np.linalg.norm(mean)
    # the smallest turn that takes the mean to the z axis (Rodrigues)
    axis = np.array([mean[1], -mean[0], 0.0])
    cross = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turn = np.eye(3) + cross + cross @ cross / (1.0 + mean[2])
    return np.asarray(np.einsum("ij,nj->ni", turn, up, optimize=False))


def make_nodes(signals: ImuSignals, rows: Floats, sway: Floats, measured: Measurements) -> Nodes:
    """An even grid of nodes and one more for each measurement, at its very stamp."""
    inside = (measured.t >= signals.t[0]) & (measured.t <= signals.t[-1])
    if np.count_nonzero(inside & (measured.kind == ekf.FIX)) < 2:
        raise InputError("fix", "fewer than two fixes within the time of the IMU: do the clocks agree?")
    step = max(STEP, 1.0 / signals.rate_hz)
    count = max(2, math.ceil((signals.t[-1] - signals.t[0]) / step) + 1)
    even = np.linspace(signals.t[0], signals.t[-1], count)
    t = np.concatenate([even, measured.t[inside]])
    kind = np.concatenate([np.full(count, -1.0), measured.kind[inside]])
    z = np.vstack([np.zeros((count, 3)), measured.z[inside]])
    order = np.lexsort((kind, t))
    t, kind, z = t[order], kind[order], z[order]
    at_nodes = [np.interp(t, signals.t, column) for column in (*rows.T, *sway.T)]
    inputs = np.ascontiguousarray(np.stack(at_nodes[:8], axis=1))
    # The mean over an interval from the running integral loses nothing to jitter or to coarse nodes.
    interval = np.diff(t)
    wide = interval > 1e-6
    for column in (0, 1):
        integral = _integral(t, signals.t, rows[:, column])
        inputs[1:, column][wide] = np.diff(integral)[wide] / interval[wide]
    inputs[:, 2] = inputs[:, 2] > 0.5
    inputs[:, 3] = 1.0
    for begin, end in signals.gaps:
        inputs[(t > begin) & (t <= end), 3] = 1000.0
    return Nodes(t, kind, z, inputs, np.stack(at_nodes[8:], axis=1))


def _integral(t: Floats, stamps: Floats, values: Floats) -> Floats:
    """The integral from the first stamp of the line through ``values`` at ``stamps``, at ``t`` within them."""
    steps = np.diff(stamps)
    whole = np.concatenate([[0.0], np.cumsum(steps * 0.5 * (values[1:] + values[:-1]))])
    k = np.clip(np.searchsorted(stamps, t, side="right") - 1, 0, stamps.size - 2)
    ahead = t - stamps[k]
    slope = (values[k + 1] - values[k]) / steps[k]
    return np.asarray(whole[k] + ahead * (values[k] + 0.5 * slope * ahead), dtype=np.float64)
