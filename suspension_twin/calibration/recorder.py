# SPDX-License-Identifier: Apache-2.0
"""The course of a search: progress, stopping, checkpoints and resuming from them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from suspension_twin import __version__
from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import CalibrationRequest, Progress
from suspension_twin.calibration.setup import Setup
from suspension_twin.files import Json
from suspension_twin.inference.checkpoint import Checkpoint, State
from suspension_twin.inference.noise import Whitener
from suspension_twin.inference.observation import content_digest
from suspension_twin.inference.problem import Interrupted, Problem

__all__ = ["Recorder", "SearchOutcome", "SquaresFit", "fingerprint"]

_SAVE_EVERY = 5  # generations


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
    """Digest of request, twin and data: a checkpoint is resumed only where it is the same."""
    asked = replace(request, state="", bags=(), twin="", keep_sensor=False)
    twin, data = setup.twin.model_copy(update={"road": None}), setup.problem.data
    excitations = [part.excitation for part in data.parts]
    return content_digest(__version__, asked, twin, data.measured.values, excitations)


class Recorder:
    """One calibration under way. ``history`` rows: evaluations, best cost, mean cost, 0 search or 1 refine.

    ``resumed`` is the state found on disk, until its stage takes it.
    """

    def __init__(
        self,
        request: CalibrationRequest,
        setup: Setup,
        on_progress: Callable[[Progress], None],
        should_stop: Callable[[], bool],
        store: Checkpoint | None,
    ) -> None:
        self.request, self.setup = request, setup
        self.on_progress, self.should_stop, self.store = on_progress, should_stop, store
        self.history: list[tuple[float, float, float, float]] = []
        self.evaluations = 0
        self.resumed = None if store is None else store.load()
        if self.resumed is not None:
            rows = self.resumed.arrays["history"]
            self.history = [(float(a), float(b), float(c), float(d)) for a, b, c, d in rows]
            self.evaluations = int(self.resumed.plain["all_evaluations"])
        self._started, self._begun, self._saved = time.monotonic(), self.evaluations, self.generations

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

    def report(self, refine: bool, best: float, mean: float, expected: float) -> None:
        """A generation is over; ``expected`` evaluations in all."""
        self.history.append((float(self.evaluations), best, mean, float(refine)))
        done = max(self.evaluations - self._begun, 1)
        left = (time.monotonic() - self._started) / done * max(expected - self.evaluations, 0.0)
        stage = "refine" if refine else "search"
        self.on_progress(Progress(stage, self.generations, self.evaluations, best, mean, left))

    def save(self, stage: str, arrays: dict[str, Floats], plain: Json, now: bool = False) -> None:
        """Write the state every few generations, or ``now``."""
        if self.store is None or not (now or self.generations - self._saved >= _SAVE_EVERY):
            return
        self._saved = self.generations
        arrays = {**arrays, "history": np.array(self.history).reshape(-1, 4)}
        plain = {**plain, "all_evaluations": self.evaluations, "all_generations": self.generations}
        self.store.save(State(stage, arrays, plain))

    def resume(self, stage: str) -> State | None:
        """The saved state if it is of this stage; handed out once."""
        if self.resumed is not None and self.resumed.stage == stage:
            state, self.resumed = self.resumed, None
            return state
        return None

    def waits_for(self, *stages: str) -> bool:
        """Whether the saved state is of one of these stages, so that earlier ones are over."""
        return self.resumed is not None and self.resumed.stage in stages
