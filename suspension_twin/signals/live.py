# SPDX-License-Identifier: Apache-2.0
"""The low-pass of a simulated signal that is to be compared, sample by sample, with a live measured one.

:class:`~suspension_twin.signals.ingest.ImuIngest` filters what was measured. What was simulated
goes the same way: the same sections at the measured rate, missing samples filled in, a fresh
start after a pause.
"""

from __future__ import annotations

import math

from suspension_twin.errors import InputError
from suspension_twin.signals.clock import LiveClock, Stamp
from suspension_twin.signals.filters import FilterSpec, steady_state

__all__ = ["LiveLowPass"]


class _Section:
    """One second-order section in transposed direct form II. In plain numbers: for a single sample a
    compiled call costs more than the arithmetic."""

    def __init__(self, coefficients: list[float], rest: list[float]) -> None:
        self.b0, self.b1, self.b2, _, self.a1, self.a2 = coefficients
        self.rest = rest  # its state after the constant 1 for ever
        self.s0 = self.s1 = 0.0

    def step(self, x: float) -> float:
        y = self.b0 * x + self.s0
        self.s0 = self.b1 * x - self.a1 * y + self.s1
        self.s1 = self.b2 * x - self.a2 * y
        return y


class LiveLowPass:
    """A causal low-pass of one signal over samples as they come, jittered or missing.

    An answer for every sample, from the first: until the rate is known it is estimated from the
    few intervals there are. A cut-off that the rate cannot carry is lowered, as for the measured
    signal.
    """

    def __init__(self, spec: FilterSpec) -> None:
        self.spec = spec
        self._clock = LiveClock()
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next sample counts as having been there for ever."""
        self._clock.reset()
        self._sections: list[_Section] = []
        self._designed = math.nan
        self._known = False  # whether it is designed for a measured rate, not for a first guess
        self._first = math.nan
        self._count = 0
        self._last = 0.0
        self._out = 0.0

    def push(self, t: float, value: float) -> float:
        """``value`` at ``t`` s, filtered. A stamp that does not rise gives the last answer again.

        Raises InputError for what is not finite, and leaves the state as it was.
        """
        if not math.isfinite(t + value):
            raise InputError("filter", f"sample at {t} is not a finite number")
        previous = self._clock.last
        stamp = self._clock.classify(t)
        if stamp in (Stamp.LATE, Stamp.DUPLICATE):
            return self._out
        if stamp is Stamp.JUMP_BACK:
            self.reset()
            stamp = self._clock.classify(t)
        if stamp is Stamp.FIRST:
            self._first = t
            self._out = value
        else:
            self._count += 1
            if self._follow_rate(t):
                self._settle(self._last)
            if stamp is Stamp.GAP:
                self._settle(value)
            else:
                missing = round((t - previous) * self._designed) - 1
                for m in range(missing):
                    self._filter(self._last + (m + 1) / (missing + 1) * (value - self._last))
            self._out = self._filter(value)
        self._last = value
        return self._out

    def _filter(self, value: float) -> float:
        for section in self._sections:
            value = section.step(value)
        return value

    def _settle(self, value: float) -> None:
        for section in self._sections:
            section.s0, section.s1 = (value * r for r in section.rest)

    def _follow_rate(self, t: float) -> bool:
        """Design the sections for the rate as it is known now; whether they hold no past yet."""
        rate = self._clock.rate
        if rate is None:
            # Looked at again when twice as many intervals are known, not at every sample.
            if self._count & (self._count - 1) and not math.isnan(self._designed):
                return False
            rate = self._count / (t - self._first)
        if self._known == (self._clock.rate is not None) and abs(rate / self._designed - 1.0) <= 0.03:
            return False
        self._known = self._clock.rate is not None
        spec = self.spec
        if spec.cutoff >= 0.49 * rate:
            spec = FilterSpec(spec.order, 0.4 * rate)
        sos = spec.sections(rate)
        self._sections = [
            _Section(c, r) for c, r in zip(sos.tolist(), steady_state(sos).tolist(), strict=True)
        ]
        self._designed = rate
        return True
