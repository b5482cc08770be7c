# SPDX-License-Identifier: Apache-2.0
"""Extended Kalman filter and smoother of the planar pose: eight states, predicted with the gyro.

States: x, y of ``base_link`` in ``map`` m, yaw rad, forward speed m/s, forward acceleration m/s²,
lateral speed m/s, gyro bias rad/s, accelerometer bias m/s². The yaw rate is an input; the forward
acceleration is a state with the accelerometer as its measurement, so that it comes out smooth and
in step with speed and position. The rear axle hardly slips: the lateral speed is a first-order
Markov process whose variance grows with the lateral acceleration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled

__all__ = [
    "FIX",
    "HEADING",
    "RESET",
    "STATES",
    "VELOCITY",
    "advance",
    "forward",
    "measurement_update",
    "planar_acceleration",
    "planar_inputs",
    "planar_row",
    "smooth",
]

Value = TypeVar("Value", float, Floats)

STATES = 8
X, Y, YAW, SPEED, ACCELERATION, LATERAL_SPEED, GYRO_BIAS, ACCELEROMETER_BIAS = range(8)
#: Inputs of a sample: yaw rate rad/s; forward specific force without gravity m/s²; 1 where the vehicle stands;
#: factor on the gyro's noise, above 1 where samples are missing; antenna ahead and to the left of
#: ``base_link`` on level ground m, and its velocity against it m/s.
YAW_RATE, FORWARD_FORCE, STANDING, GYRO_LOOSENESS, ANTENNA_X, ANTENNA_Y, ANTENNA_VX, ANTENNA_VY = range(8)
#: Noise, as :meth:`~suspension_twin.pose.types.PoseSettings.noise` orders it: densities, then the distances
#: in standard deviations from which a measurement weighs less (Huber) and beyond which it is refused.
FORCE_DENSITY, JERK_DENSITY, GYRO_DENSITY, GYRO_SCALE, SLIP, FORCE_BIAS_WALK, GYRO_BIAS_WALK, HUBER, GATE = (
    range(9)
)
#: Kinds of measurement: a fix, a fix that the position jumps to, a velocity, a heading.
FIX, RESET, VELOCITY, HEADING = 0, 1, 2, 3
LATERAL_SPEED_TIME = 0.5  # s, the time constant of the lateral speed


@compiled
def propagate_covariance(
    f: Floats, p: Floats, work: Floats, out: Floats
) -> None:  # pragma: no cover - compiled
    """out = f p f' for (8, 8)."""
    for i in range(8):
        for j in range(8):
            s = 0.0
            for k in range(8):
                if f[i, k] != 0.0:
                    s += f[i, k] * p[k, j]
            work[i, j] = s
    for i in range(8):
        for j in range(i + 1):
            s = 0.0
            for k in range(8):
                if f[j, k] != 0.0:
                    s += work[i, k] * f[j, k]
            out[i, j] = s
            out[j, i] = s


@compiled
def predict_state(x: Floats, u: Floats, dt: float, f: Floats) -> None:  # pragma: no cover - compiled
    """Move ``x`` (8,) on by ``dt`` s under the inputs ``u`` and leave the Jacobian in ``f``."""
    standing = u[STANDING] > 0.5
    turn = 0.0 if standing else u[YAW_RATE] - x[GYRO_BIAS]
    v, side, a = x[SPEED], x[LATERAL_SPEED], x[ACCELERATION]
    keep = math.exp(-dt / LATERAL_SPEED_TIME)
    half = x[YAW] + 0.5 * turn * dt
    c, s = math.cos(half), math.sin(half)
    for i in range(8):
        for j in range(8):
            f[i, j] = 1.0 if i == j else 0.0
    ahead = across = 0.0
    f[SPEED, ACCELERATION] = dt
    f[SPEED, LATERAL_SPEED] = turn * dt
    if not standing:
        ahead = v * dt + 0.5 * a * dt * dt
        across = side * dt
        f[X, YAW] = -ahead * s - across * c
        f[Y, YAW] = ahead * c - across * s
        f[X, SPEED], f[Y, SPEED] = dt * c, dt * s
        f[X, ACCELERATION], f[Y, ACCELERATION] = 0.5 * dt * dt * c, 0.5 * dt * dt * s
        f[X, LATERAL_SPEED], f[Y, LATERAL_SPEED] = -dt * s, dt * c
        f[X, GYRO_BIAS] = -0.5 * dt * f[X, YAW]
        f[Y, GYRO_BIAS] = -0.5 * dt * f[Y, YAW]
        f[YAW, GYRO_BIAS] = -dt
        f[SPEED, GYRO_BIAS] = -side * dt
    f[LATERAL_SPEED, LATERAL_SPEED] = keep
    x[X] += ahead * c - across * s
    x[Y] += ahead * s + across * c
    x[YAW] += turn * dt
    x[SPEED] += a * dt + turn * side * dt
    x[LATERAL_SPEED] = side * keep


@compiled
def add_process_noise(
    p: Floats, noise: Floats, x: Floats, u: Floats, dt: float
) -> None:  # pragma: no cover - compiled
    """Process noise of ``dt`` s."""
    q = noise[JERK_DENSITY]
    v, omega = x[SPEED], u[YAW_RATE] - x[GYRO_BIAS]
    p[ACCELERATION, ACCELERATION] += q * dt
    p[SPEED, SPEED] += q * dt**3 / 3.0
    p[SPEED, ACCELERATION] += q * dt * dt / 2.0
    p[ACCELERATION, SPEED] += q * dt * dt / 2.0
    if u[STANDING] < 0.5:
        p[YAW, YAW] += (
            (noise[GYRO_DENSITY] + (noise[GYRO_SCALE] * omega) ** 2) * max(u[GYRO_LOOSENESS], 1.0) * dt
        )
    slip = 0.01 + noise[SLIP] * abs(v * omega) * abs(v)
    p[LATERAL_SPEED, LATERAL_SPEED] += slip * slip * (1.0 - math.exp(-2.0 * dt / LATERAL_SPEED_TIME))
    p[ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] += noise[FORCE_BIAS_WALK] * dt
    p[GYRO_BIAS, GYRO_BIAS] += noise[GYRO_BIAS_WALK] * dt
    # A car that stands may creep or settle by a few millimetres; one that drives is led by its speed.
    place = 2.5e-5 if u[STANDING] > 0.5 else 1.0e-6
    p[X, X] += place * dt
    p[Y, Y] += place * dt


@compiled
def scalar_update(
    x: Floats, p: Floats, h: Floats, residual: float, variance: float, yaw_held: bool
) -> None:  # pragma: no cover - compiled
    """Kalman update by one number. With ``yaw_held`` the yaw and its variance stay (Schmidt's consider
    state): a car that stands does not turn because its antenna's fix moves."""
    ph = np.zeros(8)
    for i in range(8):
        for k in range(8):
            if h[k] != 0.0:
                ph[i] += p[i, k] * h[k]
    s = variance
    for k in range(8):
        s += h[k] * ph[k]
    for i in range(8):
        if not (yaw_held and i == YAW):
            x[i] += ph[i] / s * residual
    for i in range(8):
        for j in range(i + 1):
            if yaw_held and i == YAW and j == YAW:
                continue
            value = p[i, j] - ph[i] * ph[j] / s
            p[i, j] = value
            p[j, i] = value


@compiled
def measurement_update(
    x: Floats, p: Floats, kind: int, z: Floats, u: Floats, noise: Floats
) -> float:  # pragma: no cover - compiled
    """Update by a measurement ``z`` (3,): two numbers and a standard deviation, under the inputs ``u`` (8,).

    Returns its weight: 1, less beyond the Huber distance, 0 beyond the gate (refused).
    """
    soft, gate = noise[HUBER], noise[GATE]
    h = np.zeros((2, 8))
    r = np.zeros(2)
    c, s = math.cos(x[YAW]), math.sin(x[YAW])
    rows = 2
    if kind == HEADING:
        rows = 1
        h[0, YAW] = 1.0
        r[0] = z[0] - x[YAW]
        r[0] -= 2.0 * math.pi * math.floor(r[0] / (2.0 * math.pi) + 0.5)
    else:
        ahead, left = u[ANTENNA_X], u[ANTENNA_Y]
        if kind == VELOCITY:
            ahead, left = x[SPEED] + u[ANTENNA_VX], x[LATERAL_SPEED] + u[ANTENNA_VY]
            h[0, SPEED], h[1, SPEED] = c, s
            h[0, LATERAL_SPEED], h[1, LATERAL_SPEED] = -s, c
            r[0], r[1] = z[0], z[1]
        else:
            h[0, X] = h[1, Y] = 1.0
            r[0], r[1] = z[0] - x[X], z[1] - x[Y]
        if kind == RESET:
            for k in range(8):
                p[X, k] = p[k, X] = p[Y, k] = p[k, Y] = 0.0
            p[X, X] = p[Y, Y] = 1.0e6
        h[0, YAW] = -ahead * s - left * c
        h[1, YAW] = ahead * c - left * s
        r[0] -= ahead * c - left * s
        r[1] -= ahead * s + left * c
    # Squared distance by the spread of one number or of two.
    s00 = s01 = s11 = 0.0
    for i in range(8):
        for j in range(8):
            s00 += h[0, i] * p[i, j] * h[0, j]
            s01 += h[0, i] * p[i, j] * h[1, j]
            s11 += h[1, i] * p[i, j] * h[1, j]
    variance = z[2] * z[2]
    s00 += variance
    s11 += variance
    d2 = (r[0] * r[0] * s11 - 2.0 * r[0] * r[1] * s01 + r[1] * r[1] * s00) / (s00 * s11 - s01 * s01)
    weight = 1.0
    if kind != RESET:
        if d2 > gate * gate:
            return 0.0
        weight = min(1.0, soft / math.sqrt(d2 + 1e-12))  # Huber's
    variance /= weight * weight
    hold = u[STANDING] > 0.5 and kind != HEADING
    before = np.empty(8)
    for i in range(8):
        before[i] = x[i]
    for row in range(rows):
        for i in range(8):
            r[row] -= h[row, i] * (x[i] - before[i])
        scalar_update(x, p, h[row], r[row], variance, hold)
    return float(weight)


@compiled
def imu_measurement_update(
    x: Floats, p: Floats, noise: Floats, u: Floats, dt: float
) -> None:  # pragma: no cover - compiled
    """Update by the accelerometer, and at standstill by zero speed, acceleration and yaw rate; ``u`` (8,)."""
    standing = u[STANDING] > 0.5
    span = max(dt, 1e-4)
    h = np.zeros(8)
    for k in range(5 if standing else 1):
        for i in range(8):
            h[i] = 0.0
        if k == 0:
            if u[GYRO_LOOSENESS] > 1.0:
                continue
            h[ACCELERATION] = h[ACCELEROMETER_BIAS] = 1.0
            residual, density = (
                u[FORWARD_FORCE] - x[ACCELERATION] - x[ACCELEROMETER_BIAS],
                noise[FORCE_DENSITY],
            )
        elif k == 1:
            h[SPEED] = 1.0
            residual, density = -x[SPEED], 1.0e-7
        elif k == 2:
            h[ACCELERATION] = 1.0
            residual, density = -x[ACCELERATION], 1.0e-4
        elif k == 3:
            h[LATERAL_SPEED] = 1.0
            residual, density = -x[LATERAL_SPEED], 1.0e-6
        else:
            h[GYRO_BIAS] = 1.0
            residual, density = u[YAW_RATE] - x[GYRO_BIAS], 1.0e-6
        scalar_update(x, p, h, residual, density / span, standing)


@compiled
def copy_state(
    x: Floats, p: Floats, state: Floats, covariance: Floats
) -> None:  # pragma: no cover - compiled
    """Copy ``x`` (8,) and ``p`` (8, 8) into ``state`` and ``covariance``."""
    for i in range(8):
        state[i] = x[i]
        for j in range(8):
            covariance[i, j] = p[i, j]


@compiled
def predict(
    x: Floats, p: Floats, noise: Floats, u: Floats, dt: float, f: Floats, work: Floats
) -> None:  # pragma: no cover - compiled
    """State and covariance on by ``dt`` s under the inputs ``u``."""
    predict_state(x, u, dt, f)
    propagate_covariance(f, p, work, p)
    add_process_noise(p, noise, x, u, dt)


@compiled
def advance(
    t: Floats,
    inputs: Floats,
    states: Floats,
    covariances: Floats,
    first: int,
    last: int,
    kinds: Floats,
    times: Floats,
    values: Floats,
    weights: Floats,
    count: int,
    noise: Floats,
) -> None:  # pragma: no cover - compiled
    """Filter a ring of samples from index ``first``, whose state is given, to ``last`` (both counted on without
    wrapping) with the ``count`` measurements between them, sorted by ``times``.

    ``t`` (r,), ``inputs`` (r, 8), ``states`` (r, 8), ``covariances`` (r, 8, 8); ``values`` (m, 3);
    ``weights`` (m,) gets what each measurement was given.
    """
    size = t.size
    f = np.empty((8, 8))
    work = np.empty((8, 8))
    x, p = np.empty(8), np.empty((8, 8))
    copy_state(states[first % size], covariances[first % size], x, p)
    now = t[first % size]
    m = 0
    while m < count and times[m] <= now:
        m += 1
    for step in range(first + 1, last + 1):
        k = step % size
        u = inputs[k]
        start = now
        while m < count and times[m] <= t[k]:
            if times[m] > now:
                predict(x, p, noise, u, times[m] - now, f, work)
                now = times[m]
            weights[m] = measurement_update(x, p, int(kinds[m]), values[m], u, noise)
            m += 1
        if t[k] > now:
            predict(x, p, noise, u, t[k] - now, f, work)
        now = t[k]
        imu_measurement_update(x, p, noise, u, now - start)
        copy_state(x, p, states[k], covariances[k])


@compiled
def forward(
    t: Floats,
    inputs: Floats,
    kinds: Floats,
    values: Floats,
    start: Floats,
    spread: Floats,
    noise: Floats,
    states: Floats,
    covariances: Floats,
    weights: Floats,
) -> None:  # pragma: no cover - compiled
    """Filter over nodes ``t`` (n,): the filtered states (n, 8) and covariances (n, 8, 8) are left in the
    arrays given. Node i has the mean inputs (n, 8) of the interval before it and at most one
    measurement, ``kinds`` (n,) below 0 for none; ``weights`` (n,) what it got."""
    f = np.empty((8, 8))
    work = np.empty((8, 8))
    x, p = np.empty(8), np.empty((8, 8))
    copy_state(start, spread, x, p)
    for i in range(t.size):
        if i > 0 and t[i] > t[i - 1]:
            dt = t[i] - t[i - 1]
            predict(x, p, noise, inputs[i], dt, f, work)
            imu_measurement_update(x, p, noise, inputs[i], dt)
        if kinds[i] >= 0:
            weights[i] = measurement_update(x, p, int(kinds[i]), values[i], inputs[i], noise)
        copy_state(x, p, states[i], covariances[i])


@compiled
def _level(up: Floats, arm: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    """``out`` (2,): how far ``arm`` (3,) in body axes reaches ahead and to the left on level ground."""
    pitch = math.asin(-max(-1.0, min(1.0, up[0])))
    flat = math.hypot(up[1], up[2])
    cr, sr = (up[2] / flat, up[1] / flat) if flat > 1e-9 else (1.0, 0.0)
    out[0] = math.cos(pitch) * arm[0] + math.sin(pitch) * (sr * arm[1] + cr * arm[2])
    out[1] = cr * arm[1] - sr * arm[2]


def planar_acceleration(
    force: Sequence[Value], rate: Sequence[Value], faster: Sequence[Value], lever: tuple[float, float, float]
) -> tuple[Value, Value]:
    """Acceleration in m/s² ahead and to the left of a point of a rigid body, by a sensor at ``lever`` m from it.

    ``force`` is the specific force less gravity, ``rate`` rad/s and ``faster`` its derivative: three numbers each, or
    three arrays (n,).
    """
    x, y, z = lever
    spin = rate[2] * rate[2]
    ahead = force[0] - z * faster[1] + y * faster[2] + x * spin
    return ahead, force[1] + z * faster[0] - x * faster[2] + y * spin


@compiled
def planar_row(
    force: Floats,
    rate: Floats,
    faster: Floats,
    up: Floats,
    slow_up: Floats,
    sway: float,
    gravity: float,
    imu: Floats,
    antenna: Floats,
    out: Floats,
) -> None:  # pragma: no cover - compiled
    """``out`` (8,): yaw rate about the vertical, forward acceleration of ``base_link``, two left alone, then the
    ``antenna`` (3,) ahead and left of ``base_link`` on level ground, and its velocity there.

    The acceleration is the specific force without gravity and without what turning and its change ``faster``
    (3,) rad/s² add at the sensor's place ``imu`` (3,). ``slow_up`` is the vertical that slopes alone tilt; the
    antenna's quick sway beyond it counts by the share ``sway``.
    """
    omega = rate[0] * up[0] + rate[1] * up[1] + rate[2] * up[2]
    out[0] = omega
    out[1] = force[0] - gravity * up[0] + omega * omega * imu[0] + faster[2] * imu[1] - faster[1] * imu[2]
    arm = np.empty(2)
    swung = np.empty(2)
    _level(slow_up, antenna, arm)
    _level(up, antenna, swung)
    out[4] = arm[0] + sway * (swung[0] - arm[0])
    out[5] = arm[1] + sway * (swung[1] - arm[1])
    out[6] = -omega * antenna[1] + sway * rate[1] * antenna[2]
    out[7] = omega * antenna[0] - sway * rate[0] * antenna[2]


@compiled
def planar_inputs(
    force: Floats,
    rate: Floats,
    faster: Floats,
    up: Floats,
    slow_up: Floats,
    sway: float,
    gravity: float,
    imu: Floats,
    antenna: Floats,
) -> Floats:  # pragma: no cover - compiled
    """(n, 8) of :func:`planar_row` for whole arrays; columns 2 and 3 are zero."""
    out = np.zeros((force.shape[0], 8))
    for i in range(force.shape[0]):
        planar_row(force[i], rate[i], faster[i], up[i], slow_up[i], sway, gravity, imu, antenna, out[i])
    return out


@compiled
def _solve(a: Floats, b: Floats) -> None:  # pragma: no cover - compiled
    """Solve a x = b for symmetric positive definite ``a`` (8, 8) by Cholesky; both are overwritten, b by x."""
    for i in range(8):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            a[i, j] = math.sqrt(s) if i == j else s / a[j, j]
    for column in range(8):
        for i in range(8):
            s = b[i, column]
            for k in range(i):
                s -= a[i, k] * b[k, column]
            b[i, column] = s / a[i, i]
        for i in range(7, -1, -1):
            s = b[i, column]
            for k in range(i + 1, 8):
                s -= a[k, i] * b[k, column]
            b[i, column] = s / a[i, i]


@compiled
def smooth(
    t: Floats, inputs: Floats, noise: Floats, states: Floats, covariances: Floats
) -> None:  # pragma: no cover - compiled
    """Rauch-Tung-Striebel: turn the filtered states and covariances into smoothed ones, in place.

    The accelerometer and standstill updates belong to the node they end at, so the transition from
    the filtered state of a node to the prediction for the next is the plain one.
    """
    f = np.empty((8, 8))
    work = np.empty((8, 8))
    ahead = np.empty((8, 8))
    left = np.empty((8, 8))
    gain = np.empty((8, 8))
    x = np.empty(8)
    scale = np.empty(8)
    for i in range(t.size - 2, -1, -1):
        dt = t[i + 1] - t[i]
        p = covariances[i]
        if dt <= 0.0:
            copy_state(states[i + 1], covariances[i + 1], states[i], p)
            continue
        for k in range(8):
            x[k] = states[i, k]
        u = inputs[i + 1]
        predict_state(x, u, dt, f)
        propagate_covariance(f, p, work, ahead)
        add_process_noise(ahead, noise, x, u, dt)
        # gain = ahead^-1 f p, with each state scaled to its spread: metres beside micro-radians.
        for k in range(8):
            scale[k] = 1.0 / math.sqrt(ahead[k, k])
        for r in range(8):
            for c in range(8):
                left[r, c] = ahead[r, c] * scale[r] * scale[c]
                s = 0.0
                for k in range(8):
                    s += f[r, k] * p[k, c]
                gain[r, c] = s * scale[r]
        _solve(left, gain)
        for r in range(8):
            for c in range(8):
                gain[r, c] *= scale[r]
                ahead[r, c] = covariances[i + 1, r, c] - ahead[r, c]
            x[r] = states[i + 1, r] - x[r]
        for r in range(8):
            for k in range(8):
                states[i, r] += gain[k, r] * x[k]
            for c in range(8):
                s = 0.0
                for k in range(8):
                    s += ahead[r, k] * gain[k, c]
                work[r, c] = s
        for r in range(8):
            for c in range(8):
                s = 0.0
                for k in range(8):
                    s += gain[k, r] * work[k, c]
                p[r, c] += s
