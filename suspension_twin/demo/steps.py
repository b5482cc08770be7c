# SPDX-License-Identifier: Apache-2.0
"""The steps of the demo. Nothing is printed here: the caller gets the progress."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError, WorkError
from suspension_twin.files import open_file, replacing
from suspension_twin.inference.simulated import SimulatedDrive, simulate_drive
from suspension_twin.road import Road, load_road
from suspension_twin.vehicle.twin import Datum, RoadFile, Twin, load_twin, save_twin

if TYPE_CHECKING:
    from suspension_twin.calibration.request import Progress as CalibrationProgress
    from suspension_twin.nodes.session import CalibrateAnswer, Replay

__all__ = [
    "DRIVES",
    "LEARNT",
    "UNSEEN",
    "BundledDrive",
    "DemoProgress",
    "DemoResult",
    "Outcome",
    "run_demo",
    "written_files",
]

#: Calibrated on the one, validated on the other.
LEARNT, UNSEEN = "bump_15kmh", "crg_road"
DRIVES = {LEARNT: "speed bump at 15 km/h", UNSEEN: "90 m road with potholes"}
#: Samples after the heading was found in which the live signals settle, s.
_SETTLE = 1.0
_MOVING = 0.5  # m/s


class DemoProgress(Protocol):
    """Receiver of the progress of a demo."""

    def begin(self, text: str) -> None:
        """A step begins."""

    def share(self, done: float, note: str = "") -> None:
        """So much of the step is done, 0 to 1."""

    def end(self, text: str) -> None:
        """The step is over, with this result in words."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """One twin over one drive: the live ``replay`` with its ``compared`` samples (n,), those in which the car moved and
    its heading was known, the ``live`` gap there in m/s², and the gap over all driving.

    ``rms`` and ``measured_rms`` m/s², with the whole drive known, as ``simulate`` has them; ``station`` (n,) m along
    the road of base_link.
    """

    replay: Replay
    compared: Floats
    station: Floats
    live: float
    rms: float
    measured_rms: float

    @property
    def mse(self) -> float:
        """m²/s⁴, as the car paper counts."""
        return self.rms**2


@dataclass(frozen=True, eq=False)
class BundledDrive:
    """A bundled drive with its road and the datum of its map."""

    drive: Drive
    road: Road
    datum: Datum


@dataclass(frozen=True, eq=False)
class DemoResult:
    """Result of a demo: ``twins`` "before", "simulated" (calibrated) and "truth"; by drive its ``sites`` and the
    outcomes ``before`` and ``after`` calibration and of the ``truth``; the ``calibration`` with its ``history``."""

    twins: dict[str, Twin]
    sites: dict[str, BundledDrive]
    before: dict[str, Outcome]
    after: dict[str, Outcome]
    truth: dict[str, Outcome]
    calibration: CalibrateAnswer
    history: list[CalibrationProgress]
    seconds: float


def run_demo(bags: Path, out: Path, progress: DemoProgress, *, seed: int = 0) -> DemoResult:
    """Replay, calibrate and validate; twin files and roads are left in ``out``.

    ``bags`` is the folder of the bundled drives. Raises WorkError where ``out`` cannot be written.
    """
    from suspension_twin.nodes.session import session

    began = time.monotonic()
    start = {name: _settle_in(bags / name, out, name) for name in DRIVES}
    started = {name: load_twin(path) for name, path in start.items()}
    sites = {name: _bundled(bags / name, twin) for name, twin in started.items()}
    truths = {name: bags / name / "truth.yaml" for name in DRIVES}
    with session() as ros:

        def live(name: str, twin: Path, which: str) -> Outcome:
            when = "Held out" if name == UNSEEN and which == "calibrated twin" else "Live"
            with _step(progress, f"{when}: {DRIVES[name]}, {which}") as done:
                replay = ros.replay(sites[name].drive, twin, progress.share)
                offline = simulate_drive(sites[name].drive, load_twin(twin))
                outcome = _outcome(name, replay, sites[name].road, offline)
                done.append(f"gap {outcome.rms:.2f} of {outcome.measured_rms:.2f} m/s²")
            return outcome

        before = {name: live(name, path, "starting twin") for name, path in start.items()}
        with _step(progress, "Calibrating on the speed bump by the action") as done:
            history: list[CalibrationProgress] = []
            calibration = ros.calibrate(
                start[LEARNT],
                [bags / LEARNT],
                out / "twin.yaml",
                seed=seed,
                on_progress=_reporting(progress, history),
            )
            done.append(f"{calibration.evaluations} simulated candidates in {calibration.wall:.0f} s")
        calibrated = load_twin(calibration.output)
        files = {LEARNT: calibration.output, UNSEEN: out / f"twin_{UNSEEN}.yaml"}
        elsewhere = {"datum": started[UNSEEN].datum, "road": started[UNSEEN].road}
        save_twin(calibrated.model_copy(update=elsewhere), files[UNSEEN])
        after = {name: live(name, files[name], "calibrated twin") for name in DRIVES}
        truth = {name: live(name, path, "true parameters") for name, path in truths.items()}
    twins = {"before": started[LEARNT], "truth": load_twin(truths[LEARNT]), "simulated": calibrated}
    return DemoResult(twins, sites, before, after, truth, calibration, history, time.monotonic() - began)


def _bundled(bag: Path, twin: Twin) -> BundledDrive:
    assert twin.datum is not None
    return BundledDrive(read_drive(bag), load_road(bag / "road.crg"), twin.datum)


def _reporting(
    progress: DemoProgress, history: list[CalibrationProgress]
) -> Callable[[CalibrationProgress], None]:
    """A callback of a calibration, which reports the progress and keeps it in ``history``."""
    began = time.monotonic()

    def report(found: CalibrationProgress) -> None:
        history.append(found)
        spent = time.monotonic() - began
        share = spent / (spent + found.seconds_left) if np.isfinite(found.seconds_left) else 0.0
        cost = f", cost {found.best_cost:.4g}" if np.isfinite(found.best_cost) else ""
        progress.share(share, f"Calibrating: {found.stage}, generation {found.generation}{cost}")

    return report


@contextmanager
def _step(progress: DemoProgress, text: str) -> Iterator[list[str]]:
    results: list[str] = []
    progress.begin(text)
    yield results
    progress.end(results[-1] if results else "")


def written_files(out: Path) -> list[Path]:
    """Files that :func:`run_demo` leaves in ``out``."""
    names = ["twin", f"twin_{UNSEEN}", "start", f"start_{UNSEEN}", "twin.calibration"]
    return [*(out / f"{name}.yaml" for name in names), *(out / f"{name}.crg" for name in DRIVES)]


def _settle_in(bag: Path, out: Path, name: str) -> Path:
    """Copy road and starting twin, so that the folder holds all its files refer to."""
    twin = load_twin(bag / "twin.yaml")
    if twin.road is None or twin.datum is None:
        raise InputError(bag / "twin.yaml", "road", "and datum are needed by the demo")
    road = out / f"{name}.crg"
    with replacing(road) as temporary, open_file(twin.road.file) as given, temporary.open("wb") as there:
        shutil.copyfileobj(given, there)
    start = out / ("start.yaml" if name == LEARNT else f"start_{name}.yaml")
    save_twin(twin.model_copy(update={"road": RoadFile(file=road.resolve())}), start)
    return start


def _outcome(name: str, replay: Replay, road: Road, offline: SimulatedDrive) -> Outcome:
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
    measured = offline.measured["vertical_acceleration"]
    return Outcome(
        replay=replay,
        compared=compared,
        station=np.interp(replay.t, path[:, 0], u),
        live=float(np.sqrt(np.mean(difference**2))),
        rms=offline.gap.rms,
        measured_rms=float(np.sqrt(np.mean(measured[offline.observation.driving] ** 2))),
    )
