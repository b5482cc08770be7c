# SPDX-License-Identifier: Apache-2.0
"""Where the gap lies: in time, on the road, in frequency, by channel, corner and operating point; its signature.

An interval is reported if its mean square is significantly above that of the other intervals, with a false discovery
rate of 0.1 over all that are tested (Benjamini and Hochberg 1995). Shares are of the energy of the gap above the noise;
in frequency, also above the model discrepancy found on reference drives. Significance by corner and operating point is
by block bootstrap over segments of a second (Künsch 1989).

Model discrepancy is broadband, follows the motion and is spread over the road. Two patterns differ from it:

- a **tonal component**: imbalance or runout of a wheel is periodic in distance at any speed (an order), an engine or a
  fan in time. The spectra of segments of a drive, over distance and over time, are divided by the level of their
  neighbouring bins and averaged: a tonal component exceeds its neighbourhood;
- a **local road error**: a residual concentrated on one section of road, on every pass, is an error of the road file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.stats import false_discovery_control, norm

from suspension_twin.arrays import Floats, runs
from suspension_twin.diagnosis.coarse_search import GRID, GRID_OF_SEVERAL
from suspension_twin.diagnosis.judge import ADDED
from suspension_twin.diagnosis.shrink import DRAWS, RemainingResidual, drives_of
from suspension_twin.files import Json
from suspension_twin.inference.excited_segments import TrimSettings
from suspension_twin.inference.fit import DEEP, refit
from suspension_twin.inference.gap import main_channel
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.noise import SEGMENT, density, shares
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.problem import Problem, counting, whitener_of
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.corners import CORNERS
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "RoadErrorMatch",
    "RoadSection",
    "Tone",
    "concentrated_section",
    "localise",
    "road_error_matches",
    "signature",
    "strongest_tone",
    "unevenness",
]

#: Rate of false discoveries (Benjamini, Hochberg 1995).
_FALSE_DISCOVERY_RATE = 0.1
#: Ratio of the gap at an operating point to its mean, share of the gap and number of intervals that are reported.
_STANDS_OUT, _LEAST_SHARE, _MOST = 1.25, 0.02, 8


# -- samples of a diagnosis --------------------------------------------------------------------------


def _of_parts(problem: Problem, name: str) -> Floats:
    """(M,) one signal of the observations (``t``, ``position``, ``along``) at every compared sample."""
    pairs = zip(problem.data.parts, problem.data.rows, strict=True)
    return np.concatenate([getattr(part, name)[rows] for part, rows in pairs])


def _with_gap(problem: Problem) -> list[tuple[Any, NDArray[np.intp], slice]]:
    """Observation, its compared samples, and their place among all samples, for every part of a drive with the gap."""
    data = problem.data
    ends = np.cumsum([rows.size for rows in data.rows])
    return [
        (part, rows, slice(end - rows.size, end))
        for part, rows, drive, end in zip(data.parts, data.rows, data.drive_of, ends, strict=True)
        if data.active[drive]
    ]


def _motion(problem: Problem, twin: Twin) -> tuple[Floats, Floats]:
    """(m, W) travel from the start and velocity of every strut at the m compared samples of drives with the gap."""
    travel, velocity = [], []
    for part, rows, _ in _with_gap(problem):
        response = simulate_twin(twin, part.excitation)
        at = np.clip(np.searchsorted(response.t, part.t[rows]), 0, response.t.size - 1)
        travel.append(response.deflection[at] - response.deflection[0])
        velocity.append(response.deflection_rate[at])
    return np.concatenate(travel), np.concatenate(velocity)


# -- where -------------------------------------------------------------------------------------------


def localise(problem: Problem, difference: Floats, noise: dict[str, float], twin: Twin) -> Json:
    """The object ``where`` of diagnosis.json for a residual ``difference`` (M, C) of all drives.

    ``noise`` is its rms by channel; ``twin`` is simulated for the motion of the suspension.
    """
    names = problem.channels
    main = names.index(main_channel(names))
    floor = noise[names[main]]
    series = [difference[place, main] for *_, place in _with_gap(problem)]
    excess = [np.maximum(x**2 - floor**2, 0.0) for x in series]
    total = max(float(sum(e.sum() for e in excess)), 1e-30)
    where = {
        "time": _time(problem, excess, total),
        # without a road positions are metres of a drive's own path
        "road": _road(problem, np.concatenate(excess), total) if problem.data.parts[0].excited else [],
        "frequency": _bands(
            series, problem.measured.rate, floor, _expected_density(problem, difference, main)
        ),
        "channel": _channels(problem, difference, noise),
        "corner": [],
        "operating_point": [],
    }
    if twin.axles and ("vertical_acceleration" in names or problem.data.parts[0].reading is None):
        where |= _by_motion(problem, np.concatenate(excess), twin)
    return where


def _ranked(items: list[Json]) -> list[Json]:
    """The largest shares, largest first."""
    return sorted((i for i in items if i["share"] >= _LEAST_SHARE), key=lambda i: -float(i["share"]))[:_MOST]


def _significant(means: Floats) -> NDArray[np.bool_]:
    """True for mean squares significantly above their median, as log-normal."""
    logs = np.log(np.maximum(means, 1e-12))
    centre = np.median(logs)
    spread = max(1.4826 * float(np.median(np.abs(logs - centre))), 0.1)
    p = norm.sf((logs - centre) / spread)
    return np.asarray(false_discovery_control(np.clip(p, 1e-12, 1.0)) < _FALSE_DISCOVERY_RATE)


def _time(problem: Problem, excess: Sequence[Floats], total: float) -> list[Json]:
    """Runs of half seconds with significantly more of the gap than the others."""
    items = []
    for (part, rows, _), energy in zip(_with_gap(problem), excess, strict=True):
        size = max(4, int(TrimSettings().window * part.rate))
        count = energy.size // size
        if count < 4:
            continue
        means = energy[: count * size].reshape(count, size).mean(axis=1)
        for a, b in runs(_significant(means)):
            items.append(
                {
                    "bag": part.name,
                    "start": round(float(part.t[rows[a * size]]), 3),
                    "end": round(float(part.t[rows[min(b * size, rows.size) - 1]]), 3),
                    "share": round(float(energy[a * size : b * size].sum()) / total, 4),
                }
            )
    return _ranked(items)


def _road(problem: Problem, energy: Floats, total: float) -> list[Json]:
    """Runs of metres of road with significantly more of the gap than the others."""
    position = np.concatenate([part.position[rows] for part, rows, _ in _with_gap(problem)])
    bins = np.floor(position).astype(int)
    first = bins.min()
    sums, counts = np.bincount(bins - first, energy), np.bincount(bins - first)
    used = counts > 0
    flags = np.zeros(sums.size, dtype=bool)
    flags[used] = _significant(sums[used] / counts[used])
    return _ranked(
        [
            {
                "start_m": round(float(first + a), 2),
                "end_m": round(float(first + b), 2),
                "share": round(float(sums[a:b].sum()) / total, 4),
            }
            for a, b in runs(flags)
        ]
    )


def _expected_density(problem: Problem, difference: Floats, column: int) -> Floats:
    """(F,) power density of the model discrepancy to be expected on drives with the gap: the share of the motion
    found on reference drives, band by band; zeros without a reference."""
    measured, others = problem.measured, [d for d, a in enumerate(problem.data.active) if not a]
    if not others:
        return np.zeros(SEGMENT // 2 + 1)
    own = [s for s, d in zip(measured.segments, measured.drives, strict=True) if problem.data.active[d]]
    motion = density(measured.values[:, column], own, measured.rate)
    return np.asarray(shares(measured, difference, others)[column] ** 2 * motion)


def _periodograms(series: Sequence[Floats], rate: float) -> tuple[Floats, Floats]:
    """Frequencies (F,) and periodograms (N, F) of half overlapping segments; a shorter drive is one segment."""
    found = []
    for x in series:
        size = min(SEGMENT, x.size)
        for start in range(0, x.size - size + 1, max(size // 2, 1)):
            part = x[start : start + size]
            f, power = signal.periodogram(part, fs=rate, window="hann", nfft=SEGMENT, detrend="linear")  # type: ignore[call-overload]
            found.append(power)
    return f, np.array(found)


def _bands(series: Sequence[Floats], rate: float, floor: float, expected: Floats) -> list[Json]:
    """Bands with significantly more of the gap per octave than the mean, each from a peak down to half of its density.

    Significance is by bootstrap over pairs of neighbouring segments of ``series``, one residual a drive. ``expected``
    (F,) is the power density of the model discrepancy, ``floor`` the noise rms.
    """
    f, power = _periodograms(series, rate)
    inside = (f >= 0.5) & (f < 30.0)
    f, power = f[inside], gaussian_filter1d(power[:, inside], 1.0, axis=1, mode="nearest")
    half = 0.5 * (f[1] - f[0])
    octaves = np.log2((f + half) / (f - half))
    blocks = np.arange(len(power)) // 2
    count = int(blocks[-1]) + 1
    sums = np.stack([power[blocks == b].sum(axis=0) for b in range(count)])
    drawn = _bootstrap(count)
    means = np.einsum("kb,bf->kf", drawn, sums, optimize=False)
    means /= np.einsum("kb,b->k", drawn, np.bincount(blocks), optimize=False)[:, None]
    explained = np.maximum(expected[inside], floor**2 / 20.0)
    above = np.maximum(np.vstack([power.mean(axis=0), means]) - explained, 0.0)
    even = above.sum(axis=1) / octaves.sum()
    if even[0] <= 0:
        return []
    fewer = (above[1:] / octaves <= even[1:, None]).mean(axis=0)
    p = np.clip(fewer, 0.5 / DRAWS, 1.0)
    items = [
        {
            "low_hz": round(float(f[low] - half), 2),
            "high_hz": round(float(f[high] + half), 2),
            "share": round(float(above[0, low : high + 1].sum()) / float(above[0].sum()), 4),
        }
        for low, high in _peaks(above[0], np.asarray(false_discovery_control(p) < _FALSE_DISCOVERY_RATE))
    ]
    return _ranked(items)


def _peaks(power: Floats, flagged: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last bin of each peak of ``power`` (F,) among the flagged bins, down to half of its density."""
    left, found = flagged.copy(), []
    while left.any():
        peak = int(np.flatnonzero(left)[np.argmax(power[left])])
        ends = []
        for step in (-1, 1):
            at = peak
            while 0 <= at + step < left.size and left[at + step] and power[at + step] >= 0.5 * power[peak]:
                at += step
            ends.append(at)
            # the falling flank belongs to the same peak
            while (
                0 <= at < left.size and left[at] and power[at] <= power[max(min(at - step, left.size - 1), 0)]
            ):
                left[at] = False
                at += step
        left[ends[0] : ends[1] + 1] = False
        found.append((ends[0], ends[1]))
    return found


def _channels(problem: Problem, difference: Floats, noise: dict[str, float]) -> list[Json]:
    """Share of each channel in the gap, each in units of its noise."""
    names, own = problem.channels, np.concatenate([difference[place] for *_, place in _with_gap(problem)])
    energy = [
        max(float(np.mean(own[:, c] ** 2)) / max(noise[name], 1e-9) ** 2 - 1.0, 0.0)
        for c, name in enumerate(names)
    ]
    total = max(sum(energy), 1e-30)
    items = [{"name": name, "share": round(e / total, 4)} for name, e in zip(names, energy, strict=True)]
    return sorted(items, key=lambda i: -float(str(i["share"])))


# -- corners and operating points --------------------------------------------------------------------


def _by_motion(problem: Problem, energy: Floats, twin: Twin) -> Json:
    """``corner`` and ``operating_point`` for the energy (m,) of the gap; ``twin`` is simulated for the motion."""
    travel, velocity = _motion(problem, twin)
    blocks, speed, first = [], [], 0
    for part, rows, _ in _with_gap(problem):
        speed.append(np.abs(part.along[rows]))
        _, block = np.unique(np.floor(part.t[rows] - part.t[0]), return_inverse=True)
        blocks.append(block + first)
        first = int(blocks[-1].max()) + 1
    quantities = [("speed", np.concatenate(speed), "m/s")]
    for axle, own in twin.axles.items():
        quantities += [
            (f"{axle} damper velocity".strip(), _larger(velocity[:, own.columns]), "m/s"),
            (f"{axle} spring travel".strip(), _larger(travel[:, own.columns]), "m"),
        ]
    block, drawn = np.concatenate(blocks), _bootstrap(first)
    return {
        "corner": _corners(velocity, energy, block, drawn) if velocity.shape[1] == len(CORNERS) else [],
        "operating_point": _operating_points(quantities, energy, block, drawn),
    }


def _bootstrap(count: int) -> Floats:
    """(DRAWS, count) how often each draw holds each of so many blocks."""
    even = np.full(count, 1.0 / count)
    return np.random.default_rng(0).multinomial(count, even, DRAWS).astype(float)


def _larger(values: Floats) -> Floats:
    """(n,) signed value of the wheel with the larger magnitude, of (n, wheels)."""
    return np.asarray(values[np.arange(len(values)), np.argmax(np.abs(values), axis=1)])


def _corners(velocity: Floats, energy: Floats, block: NDArray[np.intp], drawn: Floats) -> list[Json]:
    """Share of the gap by corner: regression of its envelope on the damper speeds of the corners. Corners with a
    significant share, and always the largest.

    ``block`` (n,) is that of every sample, ``drawn`` (k, B) how often each draw of the bootstrap holds each block.
    """
    drive = np.abs(velocity) / np.maximum(np.std(velocity, axis=0), 1e-9)
    count = drawn.shape[1]
    products = (*(drive * drive[:, i : i + 1] for i in range(4)), drive * np.sqrt(energy)[:, None])
    sums = np.stack([[np.bincount(block, c, count) for c in p.T] for p in products])  # (5, 4, B)

    def shares_of(at: Floats) -> Floats:
        """(k, 4) for sums (k, 5, 4)."""
        gram = at[:, :4] + 1e-9 * np.trace(at[:, :4], axis1=1, axis2=2)[:, None, None] * np.eye(4)
        weight = np.maximum(np.linalg.solve(gram, at[:, 4, :, None])[:, :, 0], 0.0)
        return np.asarray(weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12))

    found = shares_of(sums.sum(axis=2)[None])[0]
    draws = shares_of(np.einsum("kb,pcb->kpc", drawn, sums, optimize=False))
    sure = (draws > _LEAST_SHARE).mean(axis=0) >= 0.95
    order = np.argsort(-found, kind="stable")
    return [
        {"name": CORNERS[i], "share": round(float(found[i]), 4)}
        for n, i in enumerate(order)
        if n == 0 or sure[i]
    ]


def _operating_points(
    quantities: Sequence[tuple[str, Floats, str]], energy: Floats, block: NDArray[np.intp], drawn: Floats
) -> list[Json]:
    """Ranges of each quantity (name, values (n,), unit), by deciles of its samples, in which the gap is significantly
    above its mean; ``block`` and ``drawn`` as for the corners."""
    tried = []
    for name, values, unit in quantities:
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, 11)))
        bins = edges.size - 1
        if bins < 2:
            continue
        cell = block * bins + np.clip(np.digitize(values, edges[1:-1]), 0, bins - 1)
        sums, counts = (
            np.bincount(cell, w, drawn.shape[1] * bins).reshape(-1, bins)
            for w in (energy, np.ones(energy.size))
        )
        draws = _over_mean(*(np.einsum("kb,bi->ki", drawn, v, optimize=False) for v in (sums, counts)))
        chance = np.clip((draws <= 1.0).mean(axis=0), 0.5 / DRAWS, 1.0)
        whole = _over_mean(sums.sum(axis=0), counts.sum(axis=0))
        tried.append((name, unit, edges, sums.sum(axis=0), whole, chance))
    if not tried:
        return []
    kept = false_discovery_control(np.concatenate([t[-1] for t in tried])) < _FALSE_DISCOVERY_RATE
    points: list[Json] = []
    first, total = 0, max(float(energy.sum()), 1e-30)
    for name, unit, edges, held, whole, chance in tried:
        flags = kept[first : first + chance.size] & (whole > _STANDS_OUT)
        first += chance.size
        for a, b in runs(flags):
            low, high = (round(float(edges[i]), 4) for i in (a, b))
            share = round(float(held[a:b].sum()) / total, 4)
            points.append({"quantity": name, "low": low, "high": high, "unit": unit, "share": share})
    return _ranked(points)


def _over_mean(sums: Floats, counts: Floats) -> Floats:
    """Means of intervals (..., I) over the mean of all, by their sums and counts."""
    mean = sums.sum(axis=-1, keepdims=True) / np.maximum(counts.sum(axis=-1, keepdims=True), 1.0)
    return np.asarray(sums / np.maximum(counts, 1.0) / np.maximum(mean, 1e-30))


# -- signature ---------------------------------------------------------------------------------------


def signature(problem: Problem, difference: Floats, twin: Twin) -> Json:
    """Features of an unexplained gap (M, C): its band, the regressor of travel and velocity with the highest
    correlation, its hysteresis, and the velocity and travel from which on it appears."""
    names = problem.channels
    column = names.index(main_channel(names))
    series = [difference[place, column] for *_, place in _with_gap(problem)]
    f, segments = _periodograms(series, problem.measured.rate)
    power = segments.mean(axis=0)
    cumulative = np.cumsum(power) / power.sum()
    low, high = (float(f[np.searchsorted(cumulative, q)]) for q in (0.1, 0.9))
    out: Json = {
        "channel": names[column],
        "low_hz": round(low, 2),
        "high_hz": round(high, 2),
        "peak_hz": round(float(f[1 + np.argmax(power[1:])]), 2),
        **_repeatability(problem, difference[:, column]),
    }
    if column or "vertical_acceleration" not in names or problem.data.parts[0].reading is None:
        return out
    travel, velocity = (values.mean(axis=1) for values in _motion(problem, twin))
    residual = np.concatenate(series)
    x, v = (values / max(float(np.std(values)), 1e-9) for values in (travel, velocity))
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
    for label, values, unit in (("velocity", velocity, "m/s"), ("travel", travel, "m")):
        edges = np.quantile(np.abs(values), np.linspace(0, 1, 9))
        index = np.clip(np.digitize(np.abs(values), edges[1:-1]), 0, 7)
        means = np.bincount(index, residual**2, 8) / np.maximum(np.bincount(index, minlength=8), 1)
        over = np.flatnonzero(means > 2.0 * np.median(means))
        if over.size:
            out[f"triggers_above_{label}"] = {"value": round(float(edges[over[0]]), 4), "unit": unit}
    return out


def _repeatability(problem: Problem, difference: Floats) -> dict[str, float]:
    """Correlation over road position of the log mean square per metre of two drives: near 1 for road and tyre effects,
    near 0 for clock effects and noise. Empty for a single drive.
    """
    profiles = [
        (np.floor(part.position[rows]).astype(int), difference[place] ** 2)
        for part, rows, place in _with_gap(problem)
    ]
    low, high = max(b.min() for b, _ in profiles), min(b.max() for b, _ in profiles)
    if len(profiles) < 2 or high - low < 20:
        return {}
    logs = []
    for bins, energy in profiles[:2]:
        own = (bins >= low) & (bins <= high)
        sums = np.bincount(bins[own] - low, energy[own], high - low + 1)
        counts = np.bincount(bins[own] - low, minlength=high - low + 1)
        logs.append(np.log(sums / np.maximum(counts, 1) + 1e-9))
    return {"in_space": round(float(np.corrcoef(logs[0], logs[1])[0, 1]), 3)}


def unevenness(problem: Problem, remaining: RemainingResidual, noise: dict[str, float]) -> float:
    """Largest ratio of the residual share of a half octave to that of its neighbours, vertical acceleration.

    The share of model discrepancy is smooth over frequency; a missing resonance or order exceeds its neighbours.
    """
    measured = problem.measured
    if "vertical_acceleration" not in measured.channels:
        return 1.0
    c = measured.channels.index("vertical_acceleration")
    segments = [s for s, d in zip(measured.segments, measured.drives, strict=True) if problem.data.active[d]]
    rest, motion = (
        density(v[:, c], segments, measured.rate) for v in (remaining.difference, measured.values)
    )
    f = np.linspace(0.0, 0.5 * measured.rate, rest.size)
    half_octaves = 2.0 ** (0.5 * np.arange(9))  # Hz
    band = np.digitize(f, half_octaves)
    white = 2.0 * noise["vertical_acceleration"] ** 2 / measured.rate / measured.independent
    own = [band == b for b in range(1, half_octaves.size)]
    # limited from below by the noise
    level = 0.5 * np.log([max(float(rest[o].mean()) - white, white) / float(motion[o].mean()) for o in own])
    others = [np.delete(level[max(b - 2, 0) : b + 3], min(b, 2)) for b in range(level.size)]
    return float(np.exp(max(float(level[b] - np.median(o)) for b, o in enumerate(others))))


# -- tonal components --------------------------------------------------------------------------------

#: By domain (m or s): segment length, grid step, lowest and highest frequency. Wheels of 0.2 to 0.5 m radius, orders 1
#: to 3.
_DOMAINS = {"distance": (120.0, 0.05, 0.3, 1.6), "time": (10.0, 0.01, 2.0, 20.0)}
#: Bins (two per resolution) from a component to the end of its neighbourhood, and of the component itself.
_NEAR, _SELF = 25, 3
#: Prominence in the residual over that in the simulated signal: a component of a periodic road is in both; share of
#: the mean square of a channel from which on a component counts.
_OWN, _TONE_SHARE = 2.0, 0.1


@dataclass(frozen=True)
class Tone:
    """A tonal component ``at`` a frequency in 1/m or Hz: ``strength`` is its ratio to the neighbouring bins,
    ``share`` that of the mean square of the channel."""

    domain: Literal["distance", "time"]
    channel: str
    at: float
    strength: float
    share: float


def strongest_tone(
    problem: Problem, remaining: RemainingResidual, least_share: float = _TONE_SHARE
) -> Tone | None:
    """The most prominent tonal component on drives with the gap that has ``least_share`` of the mean square of a
    channel and that reference drives do not show; None without one."""
    drive, found = drives_of(problem), []
    for domain, (length, step, low, high) in _DOMAINS.items():
        u = _of_parts(problem, "position" if domain == "distance" else "t")
        k = np.arange(round(length / step) + 1) / (2 * length)
        inside = (k >= low) & (k <= high)
        for c, channel in enumerate(problem.channels):
            if not channel.endswith(("vertical_acceleration", "roll_rate", "pitch_rate")):
                continue
            signals = np.stack([u, remaining.with_nuisances[:, c], problem.measured.values[:, c]])
            with_gap, before = (
                _prominence(
                    [signals[:, drive == d] for d, a in enumerate(problem.data.active) if a == side],
                    length,
                    step,
                )
                for side in (True, False)
            )
            if with_gap is None:
                continue
            strength, simulated, share = with_gap
            good = inside & (strength > _OWN * simulated) & (share >= least_share)
            if before is not None:
                good &= strength > _OWN * before[0]
            if good.any():
                i = int(np.argmax(np.where(good, strength, 0.0)))
                found.append(Tone(domain, channel, float(k[i]), float(strength[i]), float(share[i])))  # type: ignore[arg-type]
    return max(found, key=lambda tone: tone.strength, default=None)


def _prominence(drives: Sequence[Floats], length: float, step: float) -> tuple[Floats, Floats, Floats] | None:
    """(F,) prominence of each frequency in the residual and in the simulated signal, and its share of the residual.

    ``drives`` (3, m) are distance or time, residual and measured signal of each. Means over segments of ``length``,
    None without segments.
    """
    ratios, simulated, tones, total = [], [], [], 0.0
    for u, residual, measured in drives:
        way = np.maximum.accumulate(u)
        for begin in np.arange(way[0], way[-1], length):
            own = (way >= begin) & (way < begin + length)
            # a segment has to be covered by samples
            if np.count_nonzero(own) < 32 or np.ptp(u[own]) < 0.7 * length:
                continue
            grid = begin + step * np.arange(round(length / step))
            at = np.maximum.accumulate(u[own])
            window = np.hanning(grid.size) * (grid <= at[-1])
            powers = []
            for values in (residual[own], residual[own] + measured[own]):
                resampled = np.interp(grid, at, values - values.mean())
                powers.append(np.abs(np.fft.rfft(resampled * window, 2 * grid.size)) ** 2)
            around = [_neighbourhood(p) for p in powers]
            ratios.append(powers[0] / around[0])
            simulated.append(powers[1] / around[1])
            tones.append(2.0 * np.maximum(powers[0] - around[0], 0.0) / window.sum() ** 2)
            total += float(np.var(residual[own]))
    if not ratios:
        return None
    return np.mean(ratios, axis=0), np.mean(simulated, axis=0), np.sum(tones, axis=0) / max(total, 1e-300)


def _neighbourhood(power: Floats) -> Floats:
    """(F,) mean level of the neighbouring bins: median / log(2), for exponentially distributed powers."""
    beside = np.ones(2 * _NEAR + 1, dtype=bool)
    beside[_NEAR - _SELF : _NEAR + _SELF + 1] = False
    return np.asarray(median_filter(power, footprint=beside, mode="nearest") / np.log(2.0) + 1e-300)


# -- local road errors -------------------------------------------------------------------------------

#: Length in m of the cells of a section.
_CELL = 4.0
#: Share of the largest excess within which a shorter section is preferred.
_TOLERANCE = 0.1
#: Shrink of the residual on a section from which on an error of the road file explains it.
_TAKEN = 0.25


@dataclass(frozen=True)
class RoadSection:
    """``start`` and ``end`` in m along the road, the ``share`` of the remaining residual on it (mean square), and its
    excess ``beyond`` the share of the motion there, on the drive where that is smallest."""

    start: float
    end: float
    share: float
    beyond: float


@dataclass(frozen=True)
class RoadErrorMatch:
    """An ``effect`` of the road on a section only: its parameter ``values`` by key, and the ``shrink`` of the
    residual of the vertical acceleration there."""

    effect: str
    values: dict[str, float]
    shrink: float


def concentrated_section(
    problem: Problem, remaining: RemainingResidual, noise: dict[str, float]
) -> RoadSection | None:
    """The section, at most half of the road, with the largest excess of residual over motion in vertical acceleration.

    The excess is the smallest of all drives with the gap, less the mean of the reference drives. None without a
    vertical acceleration or where the drives have no section in common.
    """
    measured = problem.measured
    if "vertical_acceleration" not in measured.channels:
        return None
    c, position = measured.channels.index("vertical_acceleration"), _of_parts(problem, "position")
    first = float(np.floor(position.min() / _CELL))
    cell = (np.floor(position / _CELL) - first).astype(int)
    count, drive, floor = int(cell.max()) + 1, drives_of(problem), noise["vertical_acceleration"] ** 2
    with_gap: list[tuple[Floats, Floats, Floats]] = []
    before: list[Floats] = []
    for number, active in enumerate(problem.data.active):
        own = drive == number
        passed = np.bincount(cell[own], minlength=count).astype(float)
        squares, motion = (
            np.bincount(cell[own], v[own, c] ** 2, count).astype(float)
            for v in (remaining.difference, measured.values)
        )
        residual = _cumulated(np.maximum(squares - passed * floor, 0.0))
        excess = residual - _cumulated(motion)
        if active:
            with_gap.append((_cumulated(passed), residual, excess))
        else:
            before.append(excess)
    starts, ends = np.triu_indices(count + 1, 1)
    short = ends - starts <= max(count // 2, 1)
    starts, ends = starts[short], ends[short]
    beyond = np.min(np.stack([b[ends] - b[starts] for _, _, b in with_gap]), axis=0)
    for b in before:
        beyond -= np.maximum(b[ends] - b[starts], 0.0) / len(before)
    seen = np.all([p[ends] > p[starts] for p, _, _ in with_gap], axis=0)
    if not seen.any():
        return None
    most = float(beyond[seen].max())
    # the shortest section within the tolerance of the largest excess
    near = np.flatnonzero(seen & (beyond >= most - _TOLERANCE * abs(most)))
    best = int(near[np.lexsort((-beyond[near], (ends - starts)[near]))[0]])
    low, high = int(starts[best]), int(ends[best])
    share = float(np.mean([residual[high] - residual[low] for _, residual, _ in with_gap]))
    return RoadSection(_CELL * (first + low), _CELL * (first + high), share, most)


def _cumulated(values: Floats) -> Floats:
    """(n + 1,) cumulative share of the sum; zeros where the sum is zero."""
    total = float(values.sum())
    return np.concatenate([[0.0], np.cumsum(values) / total if total > 0.0 else np.zeros(values.size)])


def road_error_matches(
    problem: Problem, x: Floats, there: RoadSection, effects: list[Hypothesis], temper: float
) -> list[RoadErrorMatch]:
    """The ``effects`` of the road, applied on the section only, that explain its residual, the best first.

    Vehicle and nuisance parameters are fitted from ``x`` (d + q,) where no wheel is on the section and the
    vehicle does not oscillate from it. Each effect has one parameter, which is evaluated on a grid over its range and
    on one about the best. ``temper`` is the share of the residual that is noise.
    """
    whitener = whitener_of(problem)
    place, speed = (_of_parts(problem, name)[whitener.row] for name in ("position", "along"))
    reached = place > there.start - problem.twin.vehicle.wheel_positions[:, 0].max()
    near = reached & (place < there.end + TrimSettings().after * np.abs(speed))
    own = (place >= there.start) & (place < there.end) & np.array(problem.data.active)[whitener.drive]
    x, _ = refit(counting(problem, ~near), [x], None, DEEP)
    inside = counting(problem, own)
    vertical = whitener.channel == problem.channels.index("vertical_acceleration")

    def squares(residual: Floats) -> tuple[Floats, Floats]:
        """Sums of squares (n,) of residuals (R, n) on the section, of all channels and of the vertical acceleration."""
        return np.sum(residual[own] ** 2, axis=0), np.sum(residual[own & vertical] ** 2, axis=0)

    _, base = squares(inside.residuals(x[:, None])[0])

    def best_of(hypothesis: Hypothesis) -> tuple[float, RoadErrorMatch]:
        """The cost of an effect at its best on the section, and the match."""
        (low,), (high,) = hypothesis.bounds()
        best, step = 0.5 * (low + high), 0.5 * (high - low)
        for count in (GRID, GRID_OF_SEVERAL):
            points = np.clip(np.linspace(best - step, best + step, count), low, high)
            unknowns = np.vstack([np.repeat(x[:, None], count, axis=1), points])
            residual, failed = inside.having(hypothesis).residuals(unknowns)
            every, upright = squares(residual)
            at = int(np.argmin(np.where(failed, np.inf, every)))
            best, step = points[at], points[1] - points[0]
        values = dict(
            zip(hypothesis.keys, hypothesis.values(points[at : at + 1, None])[:, 0].tolist(), strict=True)
        )
        shrink = 1.0 - float(np.sqrt(upright[at] / max(base[0], 1e-12)))
        return float(every[at]), RoadErrorMatch(hypothesis.effects[0], values, shrink)

    found = sorted(side_by_side(best_of, [h for h in effects if len(h) == 1]), key=lambda f: f[0])
    return [
        match
        for cost, match in found
        if 0.5 * temper * (cost - found[0][0]) < ADDED and match.shrink > _TAKEN
    ]
