# SPDX-License-Identifier: Apache-2.0
"""Request, progress and result of a diagnosis: plain, picklable data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.decision import Costs
from suspension_twin.display import axes_or_new, bulleted, table
from suspension_twin.drive.read import Topics
from suspension_twin.files import Json
from suspension_twin.vehicle.twin import Twin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

__all__ = ["DiagnosisProgress", "DiagnosisRequest", "DiagnosisResult", "DriveView"]


@dataclass(frozen=True)
class DiagnosisRequest:
    """Twin and drives of a diagnosis, and its settings.

    Parameters
    ----------
    twin : str
        Path of the twin file.
    bags : tuple of str
        Paths of the drives that show the gap.
    reference : tuple of str
        Paths of drives of the same vehicle from before the gap.
    seed : int
        Seed of every random choice.
    effects : tuple of str
        Ids to which the library is limited; empty for all of it.
    topics : Topics
        Names of the topics in the bags.
    costs : Costs
        Costs of wrong and missing answers.
    state : str
        Folder for partial results, from which an interrupted diagnosis goes on; empty for none.

    Examples
    --------
    >>> DiagnosisRequest(twin="calibrated.yaml", bags=("drive",), reference=("before",)).seed
    0
    """

    twin: str
    bags: tuple[str, ...]
    reference: tuple[str, ...] = ()
    seed: int = 0
    effects: tuple[str, ...] = ()
    topics: Topics = Topics()
    costs: Costs = Costs()
    state: str = ""


@dataclass(frozen=True)
class DiagnosisProgress:
    """Progress of a diagnosis: ``stage`` "reading", "calibrating", "effects", "refining",
    "combinations", "judging"; ``done`` 0 to 1 of the whole."""

    stage: str
    done: float
    note: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class DriveView:
    """One drive for the report: a ``channel`` (m,) on its grid, ``measured`` and ``simulated``, ``before`` by the twin
    as given and ``after`` by the twin with the named effects; ``compared`` (m,) marks the samples that count."""

    name: str
    channel: str
    rate: float
    t: Floats
    position: Floats
    measured: Floats
    simulated: Mapping[str, Floats]
    compared: NDArray[np.bool_]

    def __repr__(self) -> str:
        return f"DriveView({self.name}, {self.channel or 'main channel'}, {self.t.size} samples)"


@dataclass(frozen=True, eq=False)
class DiagnosisResult:
    """``document`` is the content of diagnosis.json, ``evidence`` that of evidence.json, ``twin`` the twin
    with the named effects, ``given`` the one that was diagnosed."""

    document: Json
    twin: Twin
    drives: tuple[DriveView, ...]
    seconds: float
    warnings: tuple[str, ...] = field(default_factory=tuple)
    evidence: Json = field(default_factory=dict)
    given: Twin | None = None

    @property
    def message(self) -> str:
        """The result in one line."""
        return str(self.document["message"])

    @property
    def verdict(self) -> str:
        """``effect``, ``partly``, ``suspected``, ``recalibration``, ``no_gap`` or ``unknown``."""
        return str(self.document["verdict"])

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each effect of the library, of ``no_gap`` and of ``unknown``, the likeliest first."""
        found = {str(c["effect"]): float(c["probability"]) for c in self.document["causes"]}
        found |= {name: float(self.document[f"{name}_probability"]) for name in ("no_gap", "unknown")}
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def __str__(self) -> str:
        from suspension_twin.diagnosis import wording

        likeliest = list(self.probabilities.items())[:4]
        lines = [
            wording.answer(self.document),
            *wording.remarks(self.document),
            "probabilities: " + ", ".join(f"{name} {probability:.3f}" for name, probability in likeliest),
            *filter(None, [str(self.document.get("next_experiment") or "")]),
        ]
        return bulleted(f"Diagnosis of {self.twin.vehicle.name}: {self.verdict}", lines, self.warnings)

    __repr__ = __str__

    def plot(self, ax: Axes | None = None, most: int = 8) -> Axes:
        """Draw the probabilities of the ``most`` likely answers as bars; returns the axes."""
        ax = axes_or_new(ax, "probability", "", self.verdict)
        likeliest = list(self.probabilities.items())[:most][::-1]
        ax.barh([name.replace("_", " ") for name, _ in likeliest], [p for _, p in likeliest])
        ax.set_xlim(0.0, 1.0)
        return ax

    def to_frame(self) -> DataFrame:
        """A table of pandas, a row for each effect: probability, and the gap's rms before and after, its shrink."""
        names = ("effect", "probability", "gap_before", "gap_after", "shrink")
        return table({name: [c[name] for c in self.document["causes"]] for name in names}, "effect")
