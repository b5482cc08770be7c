# SPDX-License-Identifier: Apache-2.0
"""Stamps that recorders give wrongly: counters that begin again, strays, clocks set back, packets under one stamp."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from suspension_twin.arrays import Floats

__all__ = [
    "JUMP_BACK",
    "began_again",
    "evened",
    "jumps_back",
    "moment",
    "of_one_recording",
    "own_stamps",
    "scatter_of",
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
#: Samples on either side of one that was lost, times the square of a period over the scatter: their means then differ
#: by half a period in five standard deviations. A clock is even over so many times as many samples: known to 1/57 of a
#: period (numerics).
_ASIDE, _EVEN = 2 * 10.0**2, 16
#: An even clock is taken that makes the signals smoother by this share: where it gains less, little was lost
#: (tolerance, by hand).
_SMOOTHER: Final = 0.1
#: Standard deviation of a stamp over the median deviation of an interval: 1.4826 is that of a normal distribution, and
#: an interval has the errors of two stamps (statistics).
_OF_A_STEP: Final = 1.4826 / math.sqrt(2.0)


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


def scatter_of(t: Floats) -> float:
    """Standard deviation of stamps (n,) s about an even clock, in periods, by their intervals; strays aside."""
    usual = _usual_step(t)
    return float(np.median(np.abs(np.diff(t) - usual))) / max(usual, 1e-12) * _OF_A_STEP


def evened(t: Floats, values: Floats) -> tuple[Floats, bool]:
    """Stamps (n,) s of samples (n, k) in the order of recording, or, where those scatter, the times of the even clock
    that the sensor has: where the signals are smoother on it, by each sample's distance from the line through its
    neighbours. A sensor that is polled has its samples at its stamps, however uneven.

    Samples that are missing are seen by stamps that stay behind: the means on either side differ by whole periods.
    False beside the stamps where they scatter about a clock that does not show: nothing says when a sample was taken.
    """
    pauses = np.flatnonzero(np.diff(t) > JUMP_BACK) + 1
    if pauses.size and not jumps_back(t).size:
        times, known = zip(*map(evened, np.split(t, pauses), np.split(values, pauses)), strict=True)
        return np.concatenate(times), all(known)
    n = t.size
    aside = max(1, math.ceil(_ASIDE * scatter_of(t) ** 2)) if n > 1 else 1
    if n < 4 * aside or jumps_back(t).size:
        return t, True
    number, usual = np.arange(n), float(np.median(t[aside:] - t[:-aside])) / aside
    for _ in range(2):  # the second time with the period of all
        late = np.concatenate([[0.0], np.cumsum(t - usual * np.arange(n) - t[0])])
        step = (late[2 * aside :] - 2.0 * late[aside:-aside] + late[: -2 * aside]) / (aside * usual)
        step -= np.median(step)
        lost = np.where((step == maximum_filter1d(step, 2 * aside - 1)) & (step > 0.5), np.rint(step), 0.0)
        number = np.arange(n) + np.cumsum(np.pad(lost, (aside, aside - 1)))
        usual, first = np.polyfit(number, t, 1)
    line = first + usual * number
    even = line + uniform_filter1d(t - line, min(_EVEN * aside, n), mode="mirror")
    gain = _roughness(t, values) / np.maximum(_roughness(even, values), 1e-300)
    if np.mean(gain) < 1.0 + _SMOOTHER:
        return t, True
    holds = np.std(uniform_filter1d(t - even, aside)) < 2.0 * np.std(t - even) / math.sqrt(aside)
    return (even, True) if holds else (t, False)


def _roughness(t: Floats, values: Floats) -> Floats:
    """(k,) mean squares of the distances of samples (n, k) from the line through their neighbours in time, in units of
    those of white noise; beside gaps none."""
    kept = np.unique(t, return_index=True)[1]
    step, values = np.diff(t[kept]), values[kept]
    both = step[1:] + step[:-1]
    after = (step[:-1] / both)[:, None]
    off = values[1:-1] - (1.0 - after) * values[:-2] - after * values[2:]
    near = both < 4.0 * np.median(step)
    return np.asarray(np.mean((off**2 / (1.0 + after**2 + (1.0 - after) ** 2))[near], axis=0))
