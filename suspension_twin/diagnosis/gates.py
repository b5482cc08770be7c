# SPDX-License-Identifier: Apache-2.0
"""Probabilities that a hypothesis passes the gates: material, adequate, plausible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from suspension_twin.diagnosis import verdict
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.evidence import Blocks, Evidence
from suspension_twin.diagnosis.local_road_error import concentrated_section, no_concentration
from suspension_twin.diagnosis.shrink import RemainingResidual, Shrink, gap_rows, shrink_of

__all__ = ["Gatekeeper"]

_LEAST_EXCESS = 0.4
_TRADED_SHARE = 0.25  # what a channel may lose, over the square of the most that another gains


@dataclass(frozen=True, eq=False)
class Gatekeeper:
    """What hypotheses are compared with: ``base``, the evidence of recalibration alone, and its held-out residual
    ``recalibrated``; ``noise`` rms by channel in its units; ``reference`` the residual on reference drives as a share
    of the motion (None without); ``temper`` the share of the remaining residual that is noise."""

    bench: Bench
    blocks: Blocks
    noise: dict[str, float]
    reference: float | None
    temper: float
    case: Case
    seed: int
    base: Evidence
    recalibrated: RemainingResidual

    @property
    def driven(self) -> list[int]:
        """Columns of the channels that the excitation of the vehicle drives."""
        return [c for c, name in enumerate(self.bench.problem.channels) if name in self.case.driven]

    def gates(
        self,
        found: Evidence,
        remaining: RemainingResidual,
        least: float = verdict.MATERIAL,
        dominance: float = 0.0,
    ) -> verdict.Gates:
        """Probabilities that ``found`` with the held-out residual ``remaining`` passes each gate.

        It is material from the explained share ``least`` on. ``dominance`` (0 to 1) over all other hypotheses overrides
        losses in other channels.
        """
        bench, driven, columns = self.bench, self.driven, range(len(self.bench.problem.channels))
        seen = {
            (c, way): self.shrink(self.recalibrated, remaining, c, way)
            for c in columns
            for way in self._nuisance_options(c)
        }
        # a gain in one channel that is lost in another does not count, except for a dominant hypothesis
        most = max(seen[c, way].shrink for c in driven for way in self._nuisance_options(c))
        level, noise_level = self.level(remaining), self._noise_share()
        if self.reference is None or level < noise_level:
            adequate = verdict.adequate_without_reference(
                level, noise_level, None if found is self.base else most
            )
            if level > verdict.LITTLE:
                adequate *= verdict.smooth_spectrum(bench, remaining, self.noise)
        else:
            adequate = verdict.adequate_with_reference(found, driven)
        if self.case.excited:
            adequate *= verdict.clocks_within_limits(bench, found, self.temper)
        if self.case.road:
            adequate *= verdict.free_of_tones(bench, remaining)[0]
            adequate *= no_concentration(concentrated_section(bench, remaining, self.noise))
        if found is self.base:
            return verdict.Gates(1.0, adequate, 1.0)
        material = max(
            self._material(c, [seen[c, way] for way in self._nuisance_options(c)], least) for c in columns
        )
        material *= max(
            min(
                self._not_traded(c, [seen[c, way] for way in self._nuisance_options(c)], most) for c in driven
            ),
            dominance,
        )
        material *= verdict.beyond_usual(bench, found, self.reference is not None)
        return verdict.Gates(material, adequate, verdict.plausible(bench, found))

    def explained_share(self, found: Evidence, remaining: RemainingResidual) -> float:
        """Share of the recalibrated residual beyond the model discrepancy that ``found`` explains, of the mean square;
        without a road, of the rms of the first channel."""
        if self.reference is not None:
            return verdict.explained_share(found, self.base, self.driven)
        if self.case.excited:
            return verdict.explained_level_share(self.level(remaining), self.level(self.recalibrated))
        return float(np.clip(self.shrink(self.recalibrated, remaining).shrink, 0.0, 1.0))

    def level(self, remaining: RemainingResidual) -> float:
        """Remaining residual as a share of the motion; without a reference with the nuisance parameters as fitted."""
        with_nuisances = self.case.excited and self.reference is None
        return verdict.relative_residual(
            self.bench, remaining, self.noise, self.case.driven, with_gap=True, with_nuisances=with_nuisances
        )

    def shrink(
        self,
        before: RemainingResidual,
        after: RemainingResidual,
        column: int = 0,
        with_nuisances: bool = False,
    ) -> Shrink:
        """The shrink in one channel, ``with_nuisances`` as fitted or at zero."""
        noise = self.noise[self.bench.problem.channels[column]]
        return shrink_of(
            self.bench, before, after, self.blocks, noise, column, self.seed, with_nuisances=with_nuisances
        )

    def _nuisance_options(self, column: int) -> tuple[bool, ...]:
        """With which nuisance parameters (at zero: False, as fitted: True) the gap of a channel is measured.

        Planar channels: as fitted, because biases and tilt make most of the gap there. Channels that the road drives:
        both, because an effect may increase or decrease the clock and map offsets that the fit needs.
        """
        if column not in self.driven:
            return (True,)
        return (False, True) if self.case.excited or self.reference is not None else (False,)

    def _material(self, column: int, seen: list[Shrink], least: float) -> float:
        """Probability that a share ``least`` of the recalibrated gap of a channel is explained.

        With a reference, the gap to explain is the excess over the model discrepancy found there.
        """
        motion = float(np.std(self.bench.problem.measured.values[gap_rows(self.bench), column]))
        floor = max(self.noise[self.bench.problem.channels[column]], verdict.SLIGHT * motion)
        wanted = (1.0 - (1.0 - least) ** 2) * (self._excess() if column in self.driven else 1.0)
        likely = 0.0
        for found in seen:
            if found.before >= floor:
                shrink, low, high = (1.0 - (1.0 - min(v, 1.0)) ** 2 for v in (found.shrink, *found.interval))
                likely = max(likely, float(norm.cdf((shrink - wanted) / max((high - low) / 3.29, 1e-3))))
        return likely

    def _not_traded(self, column: int, seen: list[Shrink], most: float) -> float:
        """Probability that the gap of a channel grows by less than a tenth over recalibration alone, plus a quarter of
        the square of ``most``, the largest shrink of any channel."""
        allowed, likely = verdict.MATERIAL + _TRADED_SHARE * max(most, 0.0) ** 2, 0.0
        for found in seen:
            if max(found.before, found.after) < self.noise[self.bench.problem.channels[column]]:
                return 1.0
            spread = max((found.interval[1] - found.interval[0]) / 3.29, 1e-3)
            likely = max(likely, float(norm.cdf((found.shrink + allowed) / spread)))
        return likely

    def _excess(self) -> float:
        """Share of the mean square of the recalibrated gap that exceeds that on reference drives."""
        if self.reference is None:
            return 1.0
        level = verdict.relative_residual(
            self.bench, self.recalibrated, self.noise, self.case.driven, with_gap=True
        )
        return float(np.clip(1.0 - (self.reference / max(level, 1e-9)) ** 2, _LEAST_EXCESS, 1.0))

    def _noise_share(self) -> float:
        """Residual as a share of the motion at which it is sensor noise only."""
        rows = gap_rows(self.bench)
        motion = float(np.std(self.bench.problem.measured.values[rows, 0]))
        return 0.7 * self.noise[self.bench.problem.channels[0]] / max(motion, 1e-12)
