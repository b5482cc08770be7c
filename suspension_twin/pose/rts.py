# SPDX-License-Identifier: Apache-2.0
"""Fixed-interval smoother of the pose filter: Rauch, Tung and Striebel's ("Maximum likelihood estimates of
linear dynamic systems", AIAA J. 3, 1965)."""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.pose.ekf import add_process_noise, copy_state, predict_state, propagate_covariance

__all__ = ["smooth"]


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
