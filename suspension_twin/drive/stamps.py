# SPDX-License-Identifier: Apache-2.0
"""Stamps that recorders give wrongly: counters that begin again, strays, clocks set back, packets under one stamp."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from suspension_twin.arrays import Floats

__all__ = [
    "JUMP_BACK",
    "began_again",
    "jumps_back",
    "moment",
    "of_one_recording",
    "own_stamps",
    "spread",
    "strays",
    "unwrapped",
]

Bools: TypeAlias = NDArray[np.bool_]

#: A stamp this many seconds behind the newest is a clock set back (a looped bag), not a late message.
JUMP_BACK: Final = 1.0
#: So many samples that stay behind are a clock set back; fewer are strays (tolerance, by hand).
_STAY_BEHIND: Final = 5
#: s: 1973. Before it a clock counts from its start.
_NEVER_SET: Final = 1e8
#: Samples among which a stray is seen.
_NEIGHBOURS: Final = 2 * _STAY_BEHIND - 1
#: Spans in s after which counters begin again: 16, 24 and 32 bits of µs (Arduino's micros()), ms and the ticks of a
#: watch crystal of 32768 Hz.
_WRAPS: Final = sorted(2.0**bits * unit for bits in (16, 24, 32) for unit in (1e-6, 1e-3, 2.0**-15))
#: A pause is at most so many times as long as what was recorded on its shorter side: a day of it beside 90 s. A single
#: sample at 100 Hz is a stray from 10 s on, as it is beside its time of recording.
_LONGEST_PAUSE: Final = 1000.0
#: What a sample covers at least, in s: one at 100 Hz.
_SHORTEST_STEP: Final = 0.01
#: Packets are regular where so large a share of them at most has a size that differs by more than this share, or by one
#: sample (stamps that are rounded).
_UNEVEN: Final = 0.1


def _usual_step(t: Floats) -> float:
    """Median in s of the steps forward of stamps (n,); 0 where there are none."""
    step = np.diff(t)
    return float(np.median(step[step > 0])) if (step > 0).any() else 0.0


def unwrapped(t: Floats) -> tuple[Floats, float]:
    """Stamps (n,) s of a counter that began again, made to go on, and the span in s after which it does; 0 where the
    stamps are of no such counter.

    They cover one of the usual spans, to within a few samples: the counter ran up to its end and began at its other
    one. Stamps of a clock that was set back by something else do not.
    """
    if t.size < 3:
        return t, 0.0
    usual, covered = _usual_step(t), float(np.ptp(t))
    for span in _WRAPS:
        back = np.diff(t) < -0.5 * span
        missing = min(3.0 * usual + 0.1, span / 8.0)  # s around the end that may have no sample
        if back.any() and span - missing <= covered < span + usual:
            return t + span * np.concatenate([[0], np.cumsum(back)]), span
    return t, 0.0


def began_again(span: float) -> str:
    """A line on a counter that was made to go on."""
    return f"the time is a counter that begins again after {span:.6g} s: made to go on"


def moment(t: float) -> str:
    """A time in s since the epoch in words; of a clock that was never set, the s that it shows."""
    if t < _NEVER_SET:
        return f"{t:.3f} s"
    return f"{datetime.fromtimestamp(t, tz=timezone.utc):%Y-%m-%d %H:%M:%S.%f}"[:-3] + " UTC"


def jumps_back(t: Floats) -> NDArray[np.intp]:
    """Indices at which the clock of stamps (n,) s was set back by more than :data:`JUMP_BACK`: time stays behind."""
    newest = np.maximum.accumulate(t)
    starts = np.flatnonzero(np.diff(t[: max(t.size - _STAY_BEHIND + 1, 0)]) < -JUMP_BACK) + 1
    behind = [bool((t[s : s + _STAY_BEHIND] < newest[s - 1]).all()) for s in starts.tolist()]
    return starts[np.array(behind, dtype=np.bool_)]


def strays(t: Floats) -> Bools:
    """Which of the finite stamps (n,) s, in the order of recording, are out of order and far from their neighbours."""
    if t.size < 3:
        return np.zeros(t.size, dtype=np.bool_)
    local = median_filter(t, size=min(_NEIGHBOURS, t.size), mode="reflect")
    out_of_order = (t < np.maximum.accumulate(t)) | (t > np.minimum.accumulate(t[::-1])[::-1])
    return np.asarray(out_of_order & (np.abs(t - local) > max(JUMP_BACK, _STAY_BEHIND * _usual_step(t))))


def of_one_recording(t: Floats) -> Bools:
    """Which of the finite stamps (n,) s, in any order, fill the span of their recording.

    Where the pause between two parts is out of proportion to the shorter one, its stamps are those of a clock that had
    not been set.
    """
    order = np.argsort(t, kind="stable")
    usual = max(_usual_step(t[order]), _SHORTEST_STEP)
    first, last = 0, t.size
    while last - first > 2:
        pause = np.diff(t[order[first:last]])
        before = np.arange(1, last - first)
        excess = pause - _LONGEST_PAUSE * usual * np.minimum(before, last - first - before)
        at = int(np.argmax(excess))
        if excess[at] <= 0:
            break
        if before[at] <= (last - first) // 2:
            first += int(before[at])
        else:
            last = first + int(before[at])
    inside = np.zeros(t.size, dtype=np.bool_)
    inside[order[first:last]] = True
    return inside


def own_stamps(t: Floats, values: Floats, samples: str) -> tuple[Floats, Bools, list[str]]:
    """A stamp (n,) s for every sample (n, k), which of them to keep, and a line for every repair.

    Samples with stamp and values of one not long before are left out; others with one stamp came in a packet.
    """
    first = np.ones(t.size, dtype=np.bool_)
    lines: list[str] = []
    if np.unique(t).size == t.size:
        return t, first, lines
    _, index, which = np.unique(np.column_stack([t, values]), axis=0, return_index=True, return_inverse=True)
    # of a looped recording the stamps are those of the loop before
    late = np.maximum.accumulate(t) - t > JUMP_BACK
    repeated = ~late & (index[which.ravel()] != np.arange(t.size))
    # in packets of a sensor at rest some samples are equal by chance
    if repeated.sum() > 0.5 * (t.size - np.unique(t).size):
        first = ~repeated
        doubled = (
            f"{int((~first).sum())} of {t.size} {samples} are there twice, with one stamp and the same values"
        )
        lines.append(f"{doubled} (two publishers, or a topic that was recorded twice): left out")
    own = t.copy()
    own[first], size = spread(t[first])
    if size:
        packets = f"{samples} come in packets of {size:.3g} with one stamp"
        lines.append(f"{packets}: spread over the interval to the next packet")
    return own, first, lines


def spread(t: Floats) -> tuple[Floats, float]:
    """Stamps (n,) s of samples that came in packets, spread over the interval to the next packet, and the mean number
    of samples in one; the stamps as they are and 0 where fewer than half of the samples share theirs with another, or
    their number varies.

    A packet's stamp is taken as that of its first sample. The last packet, and one before a gap, takes the usual
    interval.
    """
    first = np.flatnonzero(np.diff(t, prepend=-np.inf) != 0)
    size = np.diff(first, append=t.size)
    if first.size < 3 or size[size > 1].sum() < 0.5 * t.size:
        return t, 0.0
    middle = float(np.median(size))
    if (np.abs(size - middle) <= max(1.0, _UNEVEN * middle)).mean() < 1.0 - _UNEVEN:
        return t, 0.0
    interval, usual = np.diff(t[first]), _usual_step(t[first])
    # a packet that was lost doubles the interval
    interval = np.append(np.where((interval > 0) & (interval < 1.75 * usual), interval, usual), usual)
    within, whole = np.arange(t.size) - np.repeat(first, size), size.astype(np.float64)
    whole[-1] = max(whole[-1], middle)  # not all of it may be there
    return t + within * np.repeat(interval / whole, size), float(size.mean())
