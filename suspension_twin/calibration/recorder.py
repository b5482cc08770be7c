# SPDX-License-Identifier: Apache-2.0
"""The course of a search: progress, stopping, and what was computed, from which a search that was stopped goes on.

A search follows from its seed and from what its simulations gave. These are kept; a search that is begun again is told
them again instead of simulating, and is then where it was, to the same bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import CalibrationRequest, Progress
from suspension_twin.calibration.setup import Setup
from suspension_twin.files import Json
from suspension_twin.inference.checkpoint import Checkpoint, State, code_digest, decoded, encoded
from suspension_twin.inference.noise import Whitener
from suspension_twin.inference.observation import content_digest
from suspension_twin.inference.problem import Interrupted, Problem

__all__ = ["Recorder", "SearchOutcome", "SquaresFit", "fingerprint"]

Found = TypeVar("Found")


@dataclass(frozen=True, eq=False)
class SquaresFit:
    """Where least squares ended: the solver's coordinates ``x`` (d + q,), the ``likelihood`` that it was fitted by in
    the end, if any, and the weight of the prior beside the objective."""

    x: Floats
    likelihood: Whitener | None
    prior_weight: float


@dataclass
class SearchOutcome:
    """Where a search ended: the ``values`` (d,), the nuisances (q,) with the share of them that is ``placed``
    (simulated, not interpolated), and the fit of least squares; None of a search that knew no prior."""

    values: Floats
    nuisance: Floats
    cost: float
    problem: Problem
    placed: Floats
    squares: SquaresFit | None = None
    stopped: bool = False


def fingerprint(request: CalibrationRequest, setup: Setup) -> str:
    """Digest of code, request, twin and data: what was computed counts only where it is the same."""
    asked = replace(request, state="", bags=(), twin="", keep_sensor=False)
    twin, data = setup.twin.model_copy(update={"road": None}), setup.problem.data
    excitations = [part.excitation for part in data.parts]
    code = code_digest(Path(__file__).with_name("run.py"))
    spread = setup.problem.nuisances.spread
    return content_digest(code, asked, twin, data.measured.values, excitations, spread)


class Recorder:
    """One calibration under way. ``history`` rows: evaluations, best cost, mean cost, 0 search or 1 refine.

    What was computed is kept in the order of the computations; what an earlier run has left comes first.
    """

    def __init__(
        self,
        request: CalibrationRequest,
        setup: Setup,
        on_progress: Callable[[Progress], None],
        should_stop: Callable[[], bool],
        store: Checkpoint | None,
        name: str = "",
    ) -> None:
        self.request, self.setup = request, setup
        self.on_progress, self.should_stop, self.store, self.name = on_progress, should_stop, store, name
        self.history: list[tuple[float, float, float, float]] = []
        self.evaluations = 0
        self._arrays: dict[str, Floats] = {}
        self._kept: list[object] = []
        self._told = self._begun = self._saved = 0
        self._started = time.monotonic()
        if store is not None and (state := store.load(name)) is not None:
            self._arrays, self._kept = state.arrays, state.plain["kept"]
            self._saved = state.plain["generations"]

    @property
    def generations(self) -> int:
        """How many are over."""
        return len(self.history)

    @property
    def objective(self) -> str:
        return self.request.objective or self.setup.preset.objective

    @property
    def out_of_generations(self) -> bool:
        """Whether the request's limit of generations, if any, is reached."""
        return 0 < self.request.max_generations <= self.generations

    def check(self) -> None:
        """Raise :class:`Interrupted` if the search has to stop."""
        if self.should_stop():
            raise Interrupted

    def known(self, evaluations: int, compute: Callable[[], Found]) -> Found:
        """The result of so many ``evaluations``: as an earlier run has kept it, or computed now."""
        if self._told == len(self._kept):
            self._kept.append(encoded(compute(), self._arrays))
        else:
            self._begun = self.evaluations + evaluations
        self._told += 1
        self.evaluations += evaluations
        found: Found = decoded(self._kept[self._told - 1], self._arrays)
        return found

    def report(self, refine: bool, values: Floats, best: float, mean: float, expected: float) -> None:
        """A generation is over, the ``best`` cost is at ``values`` (d,); ``expected`` evaluations in all."""
        self.history.append((float(self.evaluations), best, mean, float(refine)))
        if self.generations <= self._saved:
            return  # an earlier run has reported it
        done = max(self.evaluations - self._begun, 1)
        left = (time.monotonic() - self._started) / done * max(expected - self.evaluations, 0.0)
        stage = "refine" if refine else "search"
        found = tuple(values.tolist())
        self.on_progress(Progress(stage, self.generations, self.evaluations, best, mean, left, values=found))

    def save(self, every: int = 1) -> None:
        """Write what was computed, after so many generations."""
        if self.store is not None and self.generations - self._saved >= every:
            self._saved = self.generations
            plain: Json = {"kept": self._kept, "generations": self.generations}
            self.store.save(State("search", self._arrays, plain), self.name)
