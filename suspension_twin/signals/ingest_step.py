# SPDX-License-Identifier: Apache-2.0
"""What the live IMU path does with each sample, compiled."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.signals.attitude import up_step
from suspension_twin.signals.filters import filter_row, settle
from suspension_twin.signals.standstill import standstill_filter_step

__all__ = ["ingest_step"]


@compiled
def ingest_step(
    turn: Floats,
    bias: Floats,
    up: Floats,
    sos: Floats,
    zi: Floats,
    state: Floats,
    last: Floats,
    soft: Floats,
    block: Floats,
    raw: Floats,
    dt: float,
    missing: int,
    gravity: float,
    gain: float,
    removed: bool,
    restore: bool,
    out: Floats,
) -> None:  # pragma: no cover - compiled
    """One sample: ``turn`` (6, 3) scale and rotation, ``bias`` (9,) force, rate and attitude's own,
    ``last`` (7,) the row before, ``soft`` (3, 6) and ``block`` (19,) the standstill window, ``out`` (16,).
    ``missing`` rows are interpolated into the filter; below 0 the filter starts anew. Of a sensor that has
    ``removed`` gravity, only what the setting says is put back."""
    row = np.empty(7)
    for k in range(3):
        f = 0.0
        w = 0.0
        for j in range(3):
            f += turn[k, j] * raw[j]
            w += turn[3 + k, j] * raw[3 + j]
        row[k] = f - bias[k]
        row[3 + k] = w - bias[3 + k]
    standstill_filter_step(soft, row[0:6], dt)
    block[0] += 1.0
    for k in range(6):
        block[1 + k] += row[k]
        off = soft[2, k] - block[13 + k]  # Welford's recurrence for the filtered signal's variance
        block[13 + k] += off / block[0]
        block[7 + k] += off * (soft[2, k] - block[13 + k])
    if removed:
        row[6] = row[2]
        if restore:
            for k in range(3):
                row[k] += gravity * up[k]
    else:
        up_step(up, bias[6:9], row[0:3], row[3:6], dt, gravity, gain, 0.02)
        row[6] = row[2] - gravity * up[2]
    if missing < 0:
        settle(zi, state, row)
    else:
        between = np.empty(7)
        for m in range(missing):
            part = (m + 1.0) / (missing + 1.0)
            for k in range(7):
                between[k] = last[k] + part * (row[k] - last[k])
            filter_row(sos, state, between, out[0:7])
    filter_row(sos, state, row, out[0:7])
    for k in range(7):
        last[k] = row[k]
    for k in range(6):
        out[7 + k] = row[k]
    for k in range(3):
        out[13 + k] = up[k]
