# SPDX-License-Identifier: Apache-2.0
"""Objectives: distances of simulated from measured signals, which can be combined.

An objective is a sum of terms, each a kind over one channel with a weight, written
``euclidean`` or ``mse+0.5*spectral``. Most kinds are sums of squares and say so, which lets
Gauss-Newton work on them:

- ``euclidean``: the car paper's eq. (1). Over several channels it is one distance in their weighted space;
- ``mse``: the mean squared difference;
- ``correlation``: 1 less Pearson's correlation, the tracked paper's eq. (15) turned to be smallest at best;
  half the mean squared difference of the two signals brought to zero mean and unit variance;
- ``spectral``: the mean squared difference of the levels of the power spectral densities (decimal
  logarithm) in sixth-octave bands;
- ``iso18571``: 1 less the overall rating of ISO/TS 18571, the only one that is not a sum of squares.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.gap import CHANNELS

__all__ = ["KINDS", "Measured", "Objective", "Term", "parse_objective"]

KINDS = ("euclidean", "mse", "correlation", "spectral", "iso18571")
_TINY = 1e-300


@dataclass(frozen=True)
class Term:
    """One part of an objective."""

    kind: str
    channel: str
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class Measured:
    """The measured side: ``values`` (M, C), one column a channel, ``rate`` Hz, the segments (slices of
    the M samples) within which samples follow each other without a gap, and the number of the drive
    that each segment belongs to. ``bandwidth`` Hz: the cut-off of the low-pass that both sides went through."""

    channels: tuple[str, ...]
    values: Floats
    segments: tuple[slice, ...]
    rate: float
    drives: tuple[int, ...] = ()
    bandwidth: float = 20.0

    @property
    def independent(self) -> float:
        """Effective sample size per sample: 2 f_c / rate, the pass band of the low-pass as a share of Nyquist."""
        return min(1.0, 2.0 * self.bandwidth / self.rate)

    def column(self, channel: str) -> int:
        return self.channels.index(channel)


def parse_objective(
    text: str, channels: Mapping[str, float], known: Sequence[str] = CHANNELS
) -> tuple[Term, ...]:
    """Parse an objective such as ``mse+0.5*spectral``.

    Parameters
    ----------
    text : str
        Kinds (``euclidean``, ``mse``, ``correlation``, ``spectral``, ``iso18571``) with weights.
    channels : mapping of str to float
        Weight of each channel.
    known : sequence of str
        Channels that the vehicle's model has.

    Returns
    -------
    tuple of Term
        One for each kind and channel.

    Raises
    ------
    InputError
        Naming a kind or channel that is not known.

    Examples
    --------
    >>> [term.kind for term in parse_objective("mse+0.5*spectral", {"vertical_acceleration": 1.0})]
    ['mse', 'spectral']
    """
    terms: list[Any] = []
    for channel in channels:
        if channel not in known:
            raise InputError("objective", channel, f"no such channel: one of {', '.join(known)}")
    if not channels:
        raise InputError("objective", "compares no channel")
    for part in text.split("+"):
        match = re.fullmatch(r"\s*(?:([0-9.eE-]+)\s*\*\s*)?([a-z0-9]+)\s*", part)
        if match is None or match[2] not in KINDS:
            raise InputError("objective", part.strip() or "(empty)", f"one of {', '.join(KINDS)} is expected")
        try:
            weight = float(match[1]) if match[1] else 1.0
        except ValueError:
            raise InputError("objective", part.strip(), "the weight is not a number") from None
        if not weight > 0:
            raise InputError("objective", part.strip(), "the weight must be above 0")
        terms.extend(
            Term(match[2], channel, weight * share) for channel, share in channels.items() if share > 0
        )
    return tuple(terms)


class Objective:
    """Costs of L candidates against one measured side.

    ``costs`` takes simulated signals (M, C, L) in the measured side's order and returns (L,).
    """

    def __init__(self, terms: Sequence[Term], measured: Measured) -> None:
        self.terms = tuple(terms)
        self.measured = measured
        self._distance = [t for t in self.terms if t.kind == "euclidean"]
        self._rest = [t for t in self.terms if t.kind != "euclidean"]
        self._bands = {
            t.channel: self._levels(self._column(t), t.channel) for t in self.terms if t.kind == "spectral"
        }

    def _column(self, term: Term) -> Floats:
        return self.measured.values[:, self.measured.column(term.channel), None]

    @property
    def is_least_squares(self) -> bool:
        """Whether the cost rises with the sum of squares of ``residuals``."""
        return all(t.kind != "iso18571" for t in self.terms) and not (self._distance and self._rest)

    def residuals(self, simulated: Floats) -> Floats:
        """(R, L) whose sum of squares orders candidates as ``costs`` does."""
        parts = [self._residual(term, simulated) for term in self.terms]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _residual(self, term: Term, simulated: Floats) -> Floats:
        """(r, L) of one term; the term's share of the cost is its sum of squares (euclidean: of its square)."""
        measured = self._column(term)
        candidate = simulated[:, self.measured.column(term.channel), :]
        if term.kind == "euclidean":
            return np.asarray(term.weight * (candidate - measured))
        if term.kind == "mse":
            return np.asarray(np.sqrt(term.weight / len(measured)) * (candidate - measured))
        if term.kind == "correlation":
            return np.asarray(np.sqrt(0.5 * term.weight) * (_unit(candidate) - _unit(measured)))
        if term.kind == "spectral":
            bands = self._bands[term.channel]
            return np.asarray(
                np.sqrt(term.weight / len(bands)) * (self._levels(candidate, term.channel) - bands)
            )
        raise InputError("objective", term.kind, "is not a sum of squares")

    def costs(self, simulated: Floats) -> Floats:
        """(L,) costs; euclidean terms make one distance together, the others add up."""
        total = np.zeros(simulated.shape[2])
        if self._distance:
            squares = np.zeros(simulated.shape[2])
            for term in self._distance:
                squares += _sum_squares(self._residual(term, simulated))
            total += np.sqrt(squares)
        for term in self._rest:
            if term.kind == "iso18571":
                total += term.weight * self._iso(simulated[:, self.measured.column(term.channel), :], term)
            else:
                total += _sum_squares(self._residual(term, simulated))
        return total

    def cost_of_squares(self, squares: float) -> float:
        """The cost that a sum of squared residuals stands for."""
        return float(np.sqrt(squares)) if self._distance else float(squares)

    def _levels(self, x: Floats, channel: str) -> Floats:
        """(B, L) decimal logarithms of the power in sixth-octave bands, averaged over the segments."""
        from scipy import signal  # half a second to import, and no preset needs it

        rate = self.measured.rate
        longest = max(s.stop - s.start for s in self.measured.segments)
        window = min(longest, 4 * int(rate))
        density, weight = 0.0, 0
        for segment in self.measured.segments:
            length = segment.stop - segment.start
            if length < window // 2:
                continue
            frequency, part = signal.welch(
                x[segment], rate, nperseg=min(window, length), nfft=window, axis=0, detrend="constant"
            )
            density, weight = density + length * part, weight + length
        edges = 0.5 * 2.0 ** (np.arange(0, int(6 * np.log2(0.4 * rate / 0.5)) + 1) / 6)
        levels = []
        for low, high in zip(edges, edges[1:], strict=False):
            inside = (frequency >= low) & (frequency < high)
            if inside.any():
                levels.append(np.log10(np.asarray(density)[inside].mean(axis=0) / weight + _TINY))
        if not levels:
            raise InputError("objective", "spectral", f"the drive is too short for a spectrum of {channel}")
        return np.array(levels)

    def _iso(self, candidates: Floats, term: Term) -> Floats:
        from suspension_twin.signals.metrics import iso18571

        measured = self._column(term)[:, 0]
        costs = np.empty(candidates.shape[1])
        for lane in range(candidates.shape[1]):
            rating, samples = 0.0, 0
            for s in self.measured.segments:
                length = s.stop - s.start
                rating += length * float(
                    iso18571(measured[s], candidates[s, lane], self.measured.rate).overall
                )
                samples += length
            costs[lane] = 1.0 - rating / samples
        return costs


def _sum_squares(x: Floats) -> Floats:
    return np.asarray(np.einsum("rl,rl->l", x, x, optimize=False))


def _unit(x: Floats) -> Floats:
    """Zero mean, unit length along the first axis; a constant has no direction and stays zero."""
    centred = x - x.mean(axis=0)
    return np.asarray(centred / np.sqrt(np.maximum(_sum_squares(centred), _TINY)))
