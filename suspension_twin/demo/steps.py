# SPDX-License-Identifier: Apache-2.0
"""The demo's work, step by step, without a word on the terminal: that is the caller's."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError, WorkError
from suspension_twin.files import replacing
from suspension_twin.road import Road, load_road
from suspension_twin.vehicle.twin import Datum, RoadFile, Twin, load_twin, save_twin

if TYPE_CHECKING:
    from suspension_twin.calibration.request import Progress as CalibrationProgress
    from suspension_twin.nodes.session import CalibrateAnswer, Replay, Session

__all__ = ["DRIVES", "LEARNT", "UNSEEN", "DemoResult", "Outcome", "Progress", "run_demo", "written_files"]

#: Calibrated on the one, validated on the other.
LEARNT, UNSEEN = "bump_15kmh", "crg_road"
DRIVES = {LEARNT: "speed bump at 15 km/h", UNSEEN: "90 m road with potholes"}
#: Samples after the heading was found in which the live signals settle, s.
_SETTLE = 1.0
_MOVING = 0.5  # m/s


class Progress(Protocol):
    """What a caller is told."""

    def begin(self, text: str) -> None:
        """A step begins."""

    def share(self, done: float, note: str = "") -> None:
        """So much of the step is done, 0 to 1."""

    def end(self, text: str) -> None:
        """The step is over; what came out of it."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """One twin over one drive, live: ``replay``, what of it counts, and the gap there.

    ``rms`` and ``measured_rms`` m/s² over the samples ``compared`` (n,), those in which the car
    moved and its heading was known; ``station`` (n,) m along the road of base_link.
    """

    replay: Replay
    compared: Floats
    station: Floats
    rms: float
    measured_rms: float

    @property
    def mse(self) -> float:
        """m²/s⁴, as the car paper counts."""
        return self.rms**2


@dataclass(eq=False)
class DemoResult:
    """Everything that the page shows. ``before``, ``after`` and ``truth`` map drives to outcomes."""

    twins: dict[str, Twin]  # "before", "simulated" (calibrated), "truth"
    datums: dict[str, Datum] = field(default_factory=dict)
    drives: dict[str, Drive] = field(default_factory=dict)
    roads: dict[str, Road] = field(default_factory=dict)
    before: dict[str, Outcome] = field(default_factory=dict)
    after: dict[str, Outcome] = field(default_factory=dict)
    truth: dict[str, Outcome] = field(default_factory=dict)
    excited: dict[str, tuple[tuple[float, float], tuple[float, float]]] = field(default_factory=dict)
    history: list[CalibrationProgress] = field(default_factory=list)
    calibration: CalibrateAnswer | None = None
    seconds: float = 0.0


def run_demo(bags: Path, out: Path, progress: Progress, *, seed: int = 0) -> DemoResult:
    """Replay, calibrate and validate; twin files and roads are left in ``out``.

    ``bags`` is the folder of the bundled drives. Raises WorkError where ``out`` cannot be written.
    """
    from suspension_twin.nodes.session import session

    began = time.monotonic()
    start = {name: _settle_in(bags / name, out, name) for name in DRIVES}
    twins = {"before": load_twin(start[LEARNT]), "truth": load_twin(bags / LEARNT / "truth.yaml")}
    result = DemoResult(twins)
    for name in DRIVES:
        datum = load_twin(start[name]).datum
        assert datum is not None
        result.datums[name] = datum
        result.drives[name] = read_drive(bags / name)
        result.roads[name] = load_road(bags / name / "road.crg")
    with session() as ros:
        for name, title in DRIVES.items():
            text = f"Live: {title}, starting twin"
            result.before[name] = _live(ros, result, name, start[name], progress, text)
        with _step(progress, "Calibrating on the speed bump by the action") as done:
            answer = _calibrate(ros, result, start[LEARNT], bags / LEARNT, out / "twin.yaml", progress, seed)
            done.append(f"{answer.evaluations} simulated candidates in {answer.wall:.0f} s")
        result.calibration = answer
        result.twins["simulated"] = load_twin(answer.output)
        files = {LEARNT: answer.output, UNSEEN: out / f"twin_{UNSEEN}.yaml"}
        _on_road(result.twins["simulated"], load_twin(start[UNSEEN]), files[UNSEEN])
        for name, title in DRIVES.items():
            text = f"{'Held out' if name == UNSEEN else 'Live'}: {title}, calibrated twin"
            result.after[name] = _live(ros, result, name, files[name], progress, text)
        for name, title in DRIVES.items():
            text = f"Live: {title}, true parameters"
            result.truth[name] = _live(ros, result, name, bags / name / "truth.yaml", progress, text)
    result.excited = _excited(result)
    result.seconds = time.monotonic() - began
    return result


@contextmanager
def _step(progress: Progress, text: str) -> Iterator[list[str]]:
    said: list[str] = []
    progress.begin(text)
    yield said
    progress.end(said[-1] if said else "")


def written_files(out: Path) -> list[Path]:
    """What :func:`run_demo` leaves in ``out``."""
    names = ["twin", f"twin_{UNSEEN}", "start", f"start_{UNSEEN}", "twin.calibration"]
    return [*(out / f"{name}.yaml" for name in names), *(out / f"{name}.crg" for name in DRIVES)]


def _settle_in(bag: Path, out: Path, name: str) -> Path:
    """Copy road and starting twin, so that the folder holds all its files refer to."""
    twin = load_twin(bag / "twin.yaml")
    if twin.road is None or twin.datum is None:
        raise InputError(bag / "twin.yaml", "road", "and datum are needed by the demo")
    road = out / f"{name}.crg"
    with replacing(road) as temporary:
        shutil.copyfile(twin.road.file, temporary)
    start = out / ("start.yaml" if name == LEARNT else f"start_{name}.yaml")
    save_twin(twin.model_copy(update={"road": RoadFile(file=road.resolve())}), start)
    return start


def _on_road(vehicle: Twin, place: Twin, path: Path) -> None:
    """The vehicle of one twin, with its sensors, on the road of another."""
    changes = {"datum": place.datum, "road": place.road}
    save_twin(vehicle.model_copy(update=changes), path)


def _live(ros: Session, result: DemoResult, name: str, twin: Path, progress: Progress, text: str) -> Outcome:
    with _step(progress, text) as done:
        replay = ros.replay(result.drives[name], twin, progress.share)
        outcome = _outcome(name, replay, result.roads[name])
        done.append(f"gap {outcome.rms:.2f} of {outcome.measured_rms:.2f} m/s²")
    return outcome


def _outcome(name: str, replay: Replay, road: Road) -> Outcome:
    path = replay.path
    known = np.isfinite(path[:, 5])
    if not known.any():
        raise WorkError(f"{name}: the pose injector never found the heading")
    begin = path[np.argmax(known), 0] + _SETTLE
    speed = np.interp(replay.t, path[:, 0], path[:, 4])
    compared = (replay.t >= begin) & (np.abs(speed) > _MOVING)
    if not compared.any():
        raise WorkError(f"{name}: the car never moved with a known heading")
    u, _ = road.xy_to_uv(path[:, 1], path[:, 2])
    difference = (replay.measured - replay.simulated)[compared]
    return Outcome(
        replay=replay,
        compared=compared,
        station=np.interp(replay.t, path[:, 0], u),
        rms=float(np.sqrt(np.mean(difference**2))),
        measured_rms=float(np.sqrt(np.mean(replay.measured[compared] ** 2))),
    )


def _calibrate(
    ros: Session, result: DemoResult, twin: Path, bag: Path, output: Path, progress: Progress, seed: int
) -> CalibrateAnswer:
    began = time.monotonic()

    def heard(word: CalibrationProgress) -> None:
        result.history.append(word)
        spent = time.monotonic() - began
        share = spent / (spent + word.seconds_left) if np.isfinite(word.seconds_left) else 0.0
        cost = f", cost {word.best_cost:.4g}" if np.isfinite(word.best_cost) else ""
        progress.share(share, f"Calibrating: {word.stage}, generation {word.generation}{cost}")

    return ros.calibrate(twin, [bag], output, seed=seed, on_progress=heard)


def _excited(result: DemoResult) -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
    """Travel from standstill (m) and velocity (m/s) of the calibrated twin's struts on the drive learnt from."""
    from suspension_twin.inference.observation import observe
    from suspension_twin.models.simulate import simulate_twin

    twin = result.twins["simulated"]
    prepared = observe(result.drives[LEARNT], twin, result.roads[LEARNT])
    response = simulate_twin(twin, prepared.road_excitation)
    spans = {}
    for axle, own in twin.axles.items():
        travel = response.deflection[:, own.columns] - own.static_compression
        rate = response.deflection_rate[:, own.columns]
        spans[axle] = ((float(travel.min()), float(travel.max())), (float(rate.min()), float(rate.max())))
    return spans
