# SPDX-License-Identifier: Apache-2.0
"""Localisation of the gap: in time, on the road, in frequency, by channel, corner and operating point.

An interval is reported if its mean square is significantly above that of the other intervals, with a false discovery
rate of 0.1 over all that are tested (Benjamini and Hochberg 1995). Shares are of the energy of the gap above the noise;
in frequency, also above the model discrepancy found on reference drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import signal
from scipy.ndimage import gaussian_filter1d
from scipy.stats import false_discovery_control, norm

from suspension_twin.arrays import Floats, runs
from suspension_twin.diagnosis.operating import DRAWS, FALSE_DISCOVERY_RATE, by_motion, ranked
from suspension_twin.inference.noise import density, shares
from suspension_twin.inference.problem import Problem
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import Twin

__all__ = ["localise", "repeatable", "signature"]

#: Intervals of time (s) and road (m) in ``where``; samples of a segment of its spectrum, and its lowest Hz.
_WINDOW, _METRES = 0.5, 1.0
_SEGMENT, _LOWEST = 256, 0.5


def localise(problem: Problem, difference: Floats, noise: dict[str, float], twin: Twin) -> dict[str, Any]:
    """The object ``where`` of diagnosis.json for differences (M, C) of the drives with the gap.

    ``twin`` is simulated for the motion of the suspension, for corners and operating points.
    """
    names = problem.channels
    main = names.index("vertical_acceleration") if "vertical_acceleration" in names else 0
    floor = noise[names[main]]
    excess = [np.maximum(d[:, main] ** 2 - floor**2, 0.0) for d in _parts(problem, difference)]
    total = max(float(sum(e.sum() for e in excess)), 1e-30)
    where: dict[str, Any] = {
        "time": _time(problem, excess, total),
        "road": _road(problem, excess, total),
        "frequency": _frequency(
            problem,
            [d[:, main] for d in _parts(problem, difference)],
            floor,
            _expected_density(problem, difference, main),
        ),
        "channel": _channels(problem, difference, noise),
    }
    where.update(
        by_motion(_gap_drives(problem), excess, twin)
        if twin.axles and ("vertical_acceleration" in names or problem.data.parts[0].reading is None)
        else {"corner": [], "operating_point": []}
    )
    return where


def _parts(problem: Problem, values: Floats) -> list[Floats]:
    """Samples (r, C) of every drive with the gap."""
    ends = np.cumsum([0, *(rows.size for rows in problem.data.rows)])
    of = zip(ends[:-1], ends[1:], problem.data.drive_of, strict=True)
    return [values[a:b] for a, b, drive in of if problem.data.active[drive]]


def _gap_drives(problem: Problem) -> list[Any]:
    """Observation drive and its compared samples, for every drive with the gap."""
    return [
        (part, rows)
        for part, rows, drive in zip(
            problem.data.parts, problem.data.rows, problem.data.drive_of, strict=True
        )
        if problem.data.active[drive]
    ]


def _significant(means: Floats, all_means: Floats) -> np.ndarray:
    """True for mean squares significantly above the median of ``all_means``, as log-normal."""
    logs = np.log(np.maximum(means, 1e-12))
    usual = np.log(np.maximum(all_means, 1e-12))
    centre = np.median(usual)
    spread = max(1.4826 * float(np.median(np.abs(usual - centre))), 0.1)
    p = norm.sf((logs - centre) / spread)
    return (
        np.asarray(false_discovery_control(np.clip(p, 1e-12, 1.0)) < FALSE_DISCOVERY_RATE)
        if p.size
        else np.zeros(0, dtype=bool)
    )


def _time(problem: Problem, excess: Sequence[Floats], total: float) -> list[dict[str, Any]]:
    items = []
    for (part, rows), energy in zip(_gap_drives(problem), excess, strict=True):
        size = max(4, int(_WINDOW * part.rate))
        count = energy.size // size
        if count < 4:
            continue
        means = energy[: count * size].reshape(count, size).mean(axis=1)
        for a, b in runs(_significant(means, means)):
            cut = slice(a * size, b * size)
            items.append(
                {
                    "bag": part.name,
                    "start": round(float(part.t[rows[cut.start]]), 3),
                    "end": round(float(part.t[rows[min(cut.stop, rows.size) - 1]]), 3),
                    "share": round(float(energy[cut].sum()) / total, 4),
                }
            )
    return ranked(items)


def _road(problem: Problem, excess: Sequence[Floats], total: float) -> list[dict[str, Any]]:
    place = np.concatenate([part.position[rows] for part, rows in _gap_drives(problem)])
    energy = np.concatenate(list(excess))
    bins = np.floor(place / _METRES).astype(int)
    first = bins.min()
    sums = np.bincount(bins - first, energy)
    counts = np.bincount(bins - first)
    used = counts > 0
    means = np.where(used, sums / np.maximum(counts, 1), 0.0)
    flags = np.zeros(means.size, dtype=bool)
    flags[used] = _significant(means[used], means[used])
    return ranked(
        [
            {
                "start_m": round(float((first + a) * _METRES), 2),
                "end_m": round(float((first + b) * _METRES), 2),
                "share": round(float(sums[a:b].sum()) / total, 4),
            }
            for a, b in runs(flags)
        ]
    )


def _spectrum(problem: Problem, series: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Frequencies and the pooled power density of the drives' differences."""
    rate = problem.measured.rate
    size = min(512, min(s.size for s in series))
    total: Floats = np.zeros(1)
    weight, f = 0.0, np.zeros(1)
    for s in series:
        f, power = signal.welch(s, fs=rate, nperseg=size, detrend="linear")  # type: ignore[call-overload]
        total, weight = total + power * s.size, weight + s.size
    return f, np.asarray(total / weight)


def _segments(problem: Problem, series: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Frequencies (F,) and periodograms (N, F) of half overlapping segments of ``_SEGMENT`` samples; a shorter drive is
    one segment."""
    rate = problem.measured.rate
    found = []
    for x in series:
        size = min(_SEGMENT, x.size)
        for start in range(0, x.size - size + 1, max(size // 2, 1)):
            part = x[start : start + size]
            f, power = signal.periodogram(part, fs=rate, window="hann", nfft=_SEGMENT, detrend="linear")  # type: ignore[call-overload]
            found.append(power)
    return f, np.array(found)


def _expected_density(problem: Problem, difference: Floats, column: int) -> Floats:
    """(F,) power density of the model discrepancy to be expected on drives with the gap: the share of the motion
    found on reference drives, band by band; zeros without a reference."""
    measured, others = problem.measured, [d for d, a in enumerate(problem.data.active) if not a]
    if not others:
        return np.zeros(_SEGMENT // 2 + 1)
    own = [s for s, d in zip(measured.segments, measured.drives, strict=True) if problem.data.active[d]]
    motion = density(measured.values[:, column], own, measured.rate)
    return np.asarray(shares(measured, difference, others)[column] ** 2 * motion)


def _frequency(
    problem: Problem, series: Sequence[Floats], floor: float, usual: Floats
) -> list[dict[str, Any]]:
    """Bands with significantly more of the gap per octave than the mean, each from a peak down to half of its density.

    Significance is by bootstrap over pairs of neighbouring segments. ``usual`` (F,) is the power density of the
    expected model discrepancy, ``floor`` the noise rms.
    """
    f, power = _segments(problem, series)
    inside = (f >= _LOWEST) & (f < 30.0)
    f, power = f[inside], gaussian_filter1d(power[:, inside], 1.0, axis=1, mode="nearest")
    usual = usual[inside]
    there, octaves = (
        np.maximum(usual, floor**2 / 20.0),
        np.log2((f + 0.5 * (f[1] - f[0])) / (f - 0.5 * (f[1] - f[0]))),
    )
    blocks = np.arange(len(power)) // 2
    count = int(blocks[-1]) + 1
    sums = np.stack([power[blocks == b].sum(axis=0) for b in range(count)])
    sizes = np.bincount(blocks)
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), DRAWS).astype(float)
    means = np.einsum("kb,bf->kf", drawn, sums, optimize=False)
    means /= np.einsum("kb,b->k", drawn, sizes, optimize=False)[:, None]
    above = np.maximum(np.vstack([power.mean(axis=0), means]) - there, 0.0)
    even = above.sum(axis=1) / octaves.sum()
    if even[0] <= 0:
        return []
    fewer = (above[1:] / octaves <= even[1:, None]).mean(axis=0)
    remaining = np.asarray(false_discovery_control(np.clip(fewer, 0.5 / DRAWS, 1.0)) < FALSE_DISCOVERY_RATE)
    density, total, half = above[0], float(above[0].sum()), 0.5 * (f[1] - f[0])
    items = []
    while remaining.any():
        peak = int(np.flatnonzero(remaining)[np.argmax(density[remaining])])
        ends = []
        for step in (-1, 1):
            at = peak
            while (
                0 <= at + step < f.size and remaining[at + step] and density[at + step] >= 0.5 * density[peak]
            ):
                at += step
            ends.append(at)
            # the falling flank belongs to the same peak
            while (
                0 <= at < f.size
                and remaining[at]
                and density[at] <= density[max(min(at - step, f.size - 1), 0)]
            ):
                remaining[at] = False
                at += step
        low, high = ends
        remaining[low : high + 1] = False
        items.append(
            {
                "low_hz": round(float(f[low] - half), 2),
                "high_hz": round(float(f[high] + half), 2),
                "share": round(float(density[low : high + 1].sum()) / total, 4),
            }
        )
    return ranked(items)


def _channels(problem: Problem, difference: Floats, noise: dict[str, float]) -> list[dict[str, Any]]:
    """Share of each channel in the gap, each in units of its noise."""
    parts = np.concatenate(_parts(problem, difference))
    energy = [
        max(float(np.mean(parts[:, c] ** 2)) / max(noise[name], 1e-9) ** 2 - 1.0, 0.0)
        for c, name in enumerate(problem.channels)
    ]
    total = max(sum(energy), 1e-30)
    items = [
        {"name": name, "share": round(e / total, 4)} for name, e in zip(problem.channels, energy, strict=True)
    ]
    return sorted(items, key=lambda i: -float(str(i["share"])))


def repeatable(problem: Problem, difference: Floats, column: int) -> dict[str, float]:
    """Correlation over road position of the log mean square per metre of two drives: near 1 for road and tyre effects,
    near 0 for clock effects and noise. Empty for a single drive.
    """
    profiles = []
    for (part, rows), d in zip(_gap_drives(problem), _parts(problem, difference), strict=True):
        bins = np.floor(part.position[rows] / _METRES).astype(int)
        profiles.append((bins, d[:, column] ** 2))
    if len(profiles) < 2:
        return {}
    low = max(b.min() for b, _ in profiles)
    high = min(b.max() for b, _ in profiles)
    if high - low < 20:
        return {}
    rows = []
    for bins, energy in profiles:
        own = (bins >= low) & (bins <= high)
        sums = np.bincount(bins[own] - low, energy[own], high - low + 1)
        counts = np.bincount(bins[own] - low, minlength=high - low + 1)
        rows.append(np.log(sums / np.maximum(counts, 1) + 1e-9))
    return {"in_space": round(float(np.corrcoef(rows[0], rows[1])[0, 1]), 3)}


def signature(problem: Problem, difference: Floats, twin: Twin) -> dict[str, Any]:
    """Features of an unexplained gap: its band, the regressor of travel and velocity with the highest correlation, its
    hysteresis, and the velocity and travel from which on it appears."""
    names = problem.channels
    column = names.index("vertical_acceleration") if "vertical_acceleration" in names else 0
    series = [d[:, column] for d in _parts(problem, difference)]
    f, power = _spectrum(problem, series)
    cumulative = np.cumsum(power) / power.sum()
    low, high = (float(f[np.searchsorted(cumulative, q)]) for q in (0.1, 0.9))
    out: dict[str, Any] = {
        "channel": names[column],
        "low_hz": round(low, 2),
        "high_hz": round(high, 2),
        "peak_hz": round(float(f[1 + np.argmax(power[1:])]), 2),
        **repeatable(problem, difference, column),
    }
    if column or "vertical_acceleration" not in names or problem.data.parts[0].reading is None:
        return out
    linear: list[Floats] = []
    for part, rows in _gap_drives(problem):
        response = simulate_twin(twin, part.excitation)
        at = np.clip(np.searchsorted(response.t, part.t[rows]), 0, response.t.size - 1)
        x = response.deflection[at] - response.deflection[0]
        v = response.deflection_rate[at]
        linear.append(np.column_stack([x.mean(axis=1), v.mean(axis=1)]))
    motion = np.concatenate(linear)
    residual = np.concatenate(series)
    x, v = (motion[:, i] / max(float(np.std(motion[:, i])), 1e-9) for i in range(2))
    basis = {
        "travel": x,
        "velocity": v,
        "travel squared": x * x,
        "velocity squared": v * np.abs(v),
        "travel cubed": x**3,
        "sign of velocity": np.sign(v),
    }
    correlation = {k: abs(float(np.corrcoef(b, residual)[0, 1])) for k, b in basis.items()}
    best = max(correlation, key=lambda k: correlation[k])
    out["goes_with"] = {"what": best, "correlation": round(correlation[best], 3)}
    out["hysteresis"] = round(correlation["sign of velocity"], 3)
    for label, values, unit in (("velocity", motion[:, 1], "m/s"), ("travel", motion[:, 0], "m")):
        edges = np.quantile(np.abs(values), np.linspace(0, 1, 9))
        index = np.clip(np.digitize(np.abs(values), edges[1:-1]), 0, 7)
        means = np.bincount(index, residual**2, 8) / np.maximum(np.bincount(index, minlength=8), 1)
        over = np.flatnonzero(means > 2.0 * np.median(means))
        if over.size:
            out[f"triggers_above_{label}"] = {"value": round(float(edges[over[0]]), 4), "unit": unit}
    return out
