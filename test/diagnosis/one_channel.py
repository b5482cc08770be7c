# SPDX-License-Identifier: Apache-2.0
"""Problems for tests that need no vehicle: residuals by a formula, and drives with one channel."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from types import SimpleNamespace
from typing import Any

import numpy as np

from suspension_twin.inference.hypothesis import BASELINE, Hypothesis
from suspension_twin.inference.problem import Linearised

RATE, CHANNEL = 100.0, "vertical_acceleration"


def problem_over(lengths: list[int], values: np.ndarray, active: tuple[bool, ...] | None = None) -> Any:
    """As much of a problem as localisation and shrink look at: drives of ``lengths`` samples end to end, one channel,
    whose residuals are compared as they are."""
    ends = np.cumsum([0, *lengths])
    segments = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    measured = SimpleNamespace(
        channels=(CHANNEL,),
        segments=segments,
        drives=list(range(len(lengths))),
        rate=RATE,
        independent=0.4,
        values=values,
    )
    data = SimpleNamespace(active=active or (True,) * len(lengths), drive_of=list(range(len(lengths))))
    return SimpleNamespace(data=data, measured=measured, channels=measured.channels)


class Formula:
    """A problem whose residuals (R, L) are a formula of its unknowns (p, L): d of the vehicle, q nuisances within
    ``limit``, and those of the effects; the prior has ``precision`` (p, p) about ``centre`` (p,)."""

    def __init__(
        self,
        residual: Callable[[np.ndarray], np.ndarray],
        d: int,
        q: int,
        precision: np.ndarray,
        centre: np.ndarray | None = None,
        limit: float = 3.0,
    ) -> None:
        self.residual, self.d, self.q, self.limit = residual, d, q, limit
        self.precision = precision
        self.centre = np.zeros(len(precision)) if centre is None else centre
        self.hypothesis: Hypothesis = BASELINE
        self.nuisances: Any = SimpleNamespace(names=(), spread=np.ones(q))

    @property
    def shared(self) -> int:
        return self.d + self.q

    def having(self, hypothesis: Hypothesis) -> Any:
        other = copy(self)
        other.hypothesis = hypothesis
        return other

    def joint_prior(self) -> tuple[np.ndarray, np.ndarray]:
        p = self.shared + len(self.hypothesis)
        return self.precision[:p, :p], self.centre[:p]

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.hypothesis.bounds()
        free, box = np.full(self.d, np.inf), np.full(self.q, self.limit)
        return np.concatenate([-free, -box, low]), np.concatenate([free, box, high])

    def clipped(self, x: np.ndarray) -> np.ndarray:
        low, high = self.limits()
        return np.clip(x, low[:, None], high[:, None])

    def room(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.limits()
        return np.minimum(low - x, 0.0), np.maximum(high - x, 0.0)

    def residuals(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.residual(x), np.zeros(x.shape[1], dtype=bool)

    def sums_of_squares(self, x: np.ndarray) -> np.ndarray:
        residual, failed = self.residuals(x)
        return np.where(failed, np.inf, np.sum(residual**2, axis=0))

    def costs(self, x: np.ndarray) -> np.ndarray:
        precision, centre = self.joint_prior()
        away = x - centre[:, None]
        return self.sums_of_squares(x) + np.sum(away * (precision @ away), axis=0)

    def linearise(self, x: np.ndarray) -> Linearised:
        base = self.residual(x[:, None])
        return Linearised(x, base[:, 0], (self.residual(x[:, None] + 1e-6 * np.eye(x.size)) - base) / 1e-6)

    def effect_columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        here = self.linearise(x)
        return here.residual, np.ascontiguousarray(here.jacobian[:, self.shared :])
