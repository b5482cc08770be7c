# SPDX-License-Identifier: Apache-2.0
"""The pose of a recorded drive, smoothed from both sides: centimetres where the receiver gives them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.pose import ekf
from suspension_twin.pose.initial_state import first_state
from suspension_twin.pose.nodes import Nodes, gather, make_nodes, planar_rows
from suspension_twin.pose.rts import smooth
from suspension_twin.pose.settings import PoseSettings
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.vehicle.twin import Datum, Place

__all__ = ["locked_trajectory"]

PASSES = 4
#: Prior of the share of the antenna's sway: 1 with this standard deviation.
SWAY_SIGMA = 0.3
FAR = 50.0  # factor on a measurement's standard deviation beyond which it no longer supports a pose


def locked_trajectory(
    drive: Drive,
    signals: ImuSignals,
    gps_place: Place,
    datum: Datum,
    t: Floats,
    settings: PoseSettings | None = None,
    upright: bool = False,
) -> Trajectory:
    """Estimate the path of ``base_link`` over a whole drive, forward and backward (RTS smoother).

    Parameters
    ----------
    drive : Drive
        The recording, with fixes.
    signals : ImuSignals
        Its IMU, cleaned by :func:`~suspension_twin.signals.offline.ingest_drive`.
    gps_place : Place
        Position of the antenna in ``base_link``.
    datum : Datum
        Origin of ``map``.
    t : (n,) array
        Stamps in s, strictly rising, at which the path is wanted.
    settings : PoseSettings, optional
        Noise and gates of the filter.
    upright : bool
        Take a mean tilt for the sensor's mounting and not for the vehicle's.

    Returns
    -------
    Trajectory
        x, y, yaw, speeds, yaw rate and planar accelerations at ``t``.

    Raises
    ------
    InputError
        No fix, or no motion from which the yaw follows.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.signals.offline import ingest_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> drive, twin = read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml")
    >>> signals = ingest_drive(drive, twin.imu)
    >>> path = locked_trajectory(drive, signals, twin.gps, twin.datum, signals.t)
    >>> round(float(path.speed.max()), 1)
    7.0
    """
    settings = settings or PoseSettings()
    measured = gather(drive, datum, settings)
    rows, sway = planar_rows(signals, gps_place, upright)
    nodes = make_nodes(signals, rows, sway, measured)
    start, spread = first_state(measured, signals.t, rows)
    noise = settings.noise(hard=False)
    states = np.empty((nodes.t.size, ekf.STATES))
    covariances = np.empty((nodes.t.size, ekf.STATES, ekf.STATES))
    weights = np.zeros(nodes.t.size)
    factor = np.ones(nodes.t.size)
    share = 1.0
    for _ in range(PASSES):
        now = _with(nodes, share, factor)
        ekf.forward(now.t, now.inputs, now.kind, now.z, start, spread, noise, states, covariances, weights)
        smooth(now.t, now.inputs, noise, states, covariances)
        share = _sway_share(now, states, share)
        factor = _noise_factors(_with(nodes, share, np.ones(nodes.t.size)), states)
    return _evaluate(np.asarray(t, dtype=np.float64), nodes, factor, states, signals, rows, settings)


def _with(nodes: Nodes, share: float, factor: Floats) -> Nodes:
    """The nodes with the antenna swaying by ``share`` and standard deviations times ``factor``."""
    inputs, z = nodes.inputs.copy(), nodes.z.copy()
    inputs[:, 4:] += share * nodes.sway
    z[:, 2] *= factor
    return replace(nodes, inputs=inputs, z=z)


def _residuals(nodes: Nodes, states: Floats, which: int) -> Floats:
    """(j, 2) measured less expected, ahead and to the left, of the measurements of one kind."""
    at = nodes.kind == which
    x, u, z = states[at], nodes.inputs[at], nodes.z[at]
    c, s = np.cos(x[:, ekf.YAW]), np.sin(x[:, ekf.YAW])
    east, north = z[:, 0], z[:, 1]
    if which == ekf.FIX:
        east, north = east - x[:, ekf.X], north - x[:, ekf.Y]
        ahead, left = u[:, 4], u[:, 5]
    else:
        ahead, left = x[:, ekf.SPEED] + u[:, 6], x[:, ekf.LATERAL_SPEED] + u[:, 7]
    return np.column_stack([east * c + north * s - ahead, north * c - east * s - left])


def _sway_share(nodes: Nodes, states: Floats, share: float) -> float:
    """Share of the antenna's sway in the residuals, by least squares with its prior."""
    weight = 1.0 / SWAY_SIGMA**2
    total = weight
    for which, columns in ((ekf.FIX, slice(0, 2)), (ekf.VELOCITY, slice(2, 4))):
        at = nodes.kind == which
        if not at.any():
            continue
        sway, sigma = nodes.sway[at, columns], nodes.z[at, 2:3]
        full = _residuals(nodes, states, which) + share * sway
        total += float(np.sum(sway * full / sigma**2))
        weight += float(np.sum((sway / sigma) ** 2))
    return float(np.clip(total / weight, 0.0, 1.2))


def _noise_factors(nodes: Nodes, states: Floats) -> Floats:
    """(k,) factors on the standard deviations: the noise that the residuals show for each kind of
    measurement, and more for each that lies further off than its kind does."""
    factor = np.ones(nodes.kind.size)
    for which in (ekf.FIX, ekf.VELOCITY):
        at = nodes.kind == which
        if not at.any():
            continue
        off = np.linalg.norm(_residuals(nodes, states, which), axis=1) / nodes.z[at, 2]
        # The median of a Rayleigh distribution lies at 1.1774 standard deviations.
        common = float(np.clip(np.median(off) / 1.1774, 0.3, 10.0)) if off.size >= 20 else 1.0
        far = off / (3.5 * common)
        factor[at] = common * np.where(far > 1.0, np.minimum(far**2, 1.0e4), 1.0)
    return factor


def _evaluate(
    t: Floats,
    nodes: Nodes,
    factor: Floats,
    states: Floats,
    signals: ImuSignals,
    rows: Floats,
    settings: PoseSettings,
) -> Trajectory:
    """Between the nodes: cubics through position and velocity, so both stay in step."""
    from scipy.interpolate import CubicHermiteSpline  # a fifth of a second, which live nodes do not wait for

    last = np.append(np.diff(nodes.t) > 1e-7, True)  # of nodes that share a stamp the last has it all
    at, x = nodes.t[last], states[last]
    turn = np.interp(at, signals.t, rows[:, 0]) - x[:, ekf.GYRO_BIAS]
    turn = np.where(np.interp(at, signals.t, signals.standing) > 0.5, 0.0, turn)
    c, s = np.cos(x[:, ekf.YAW]), np.sin(x[:, ekf.YAW])
    v, side, acceleration = x[:, ekf.SPEED], x[:, ekf.LATERAL_SPEED], x[:, ekf.ACCELERATION]
    inside = np.clip(t, at[0], at[-1])
    speed = CubicHermiteSpline(at, v, acceleration + turn * side)(inside)
    yaw_rate = np.interp(inside, at, turn)
    return Trajectory(
        t=t,
        x=CubicHermiteSpline(at, x[:, ekf.X], v * c - side * s)(inside),
        y=CubicHermiteSpline(at, x[:, ekf.Y], v * s + side * c)(inside),
        yaw=CubicHermiteSpline(at, x[:, ekf.YAW], turn)(inside),
        speed=speed,
        lateral_speed=np.interp(inside, at, side),
        yaw_rate=yaw_rate,
        ax=np.interp(inside, at, acceleration),
        ay=speed * yaw_rate,
        valid=_valid(t, nodes, factor, settings) & (t >= at[0]) & (t <= at[-1]),
    )


def _valid(t: Floats, nodes: Nodes, factor: Floats, settings: PoseSettings) -> NDArray[np.bool_]:
    """(n,) True within ``outage`` s of a fix on either side that was not thrown out, half of that before the
    first and after the last."""
    used = nodes.t[(nodes.kind == ekf.FIX) & (factor < FAR)]
    if not used.size:
        return np.zeros(t.size, dtype=np.bool_)
    after = np.searchsorted(used, t)
    since = np.where(after > 0, t - used[np.maximum(after - 1, 0)], np.inf)
    until = np.where(after < used.size, used[np.minimum(after, used.size - 1)] - t, np.inf)
    between = np.maximum(since, until) <= settings.outage
    ends = np.minimum(since, until) <= 0.5 * settings.outage
    return np.asarray(np.where(np.isfinite(since) & np.isfinite(until), between, ends), dtype=np.bool_)
