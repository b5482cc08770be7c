# SPDX-License-Identifier: Apache-2.0
"""What ``calibrate`` and ``diagnose`` do with a twin on tracks: its drives are marker runs over the obstacle."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from suspension_twin.cli.common import ProgressLine, output, print_diagnosis, print_table
from suspension_twin.errors import InputError

if TYPE_CHECKING:
    from suspension_twin.calibration.tracked_files import TrackedCalibration

__all__ = ["calibrate_runs", "diagnose_runs", "is_tracked"]


def is_tracked(path: Path) -> bool:
    """Whether a twin file says ``model: tracked``; False for what cannot be read, which others report."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    return isinstance(data, dict) and data.get("model") == "tracked"


def calibrate_runs(
    twin: Path,
    runs: list[Path],
    out: Path,
    preset: str,
    report: Path | None,
    seed: int,
    objective: str,
    generations: int,
) -> None:
    """Preset ``tracked_paper``: fit the slowest runs, validate on the others; see calibration.tracked_files."""
    from suspension_twin.calibration.request import Progress
    from suspension_twin.calibration.tracked_files import PRESET, calibrate_tracked_files
    from suspension_twin.calibration.tracked_paper import OBJECTIVES, SETTINGS

    if preset not in ("fast", PRESET):  # "fast" is what stands where no preset is asked for
        raise InputError("preset", preset, f"is for cars: a twin on tracks takes {PRESET}")
    wanted = objective or "correlation"
    if wanted not in OBJECTIVES:
        raise InputError("--objective", wanted, f"one of {', '.join(OBJECTIVES)} is expected")
    with ProgressLine() as line:

        def show(step: Progress) -> None:
            text = f"generation {step.generation}, cost {step.best_cost:.4g}"
            share = step.generation / (generations or SETTINGS.generations)
            line.show(text if step.stage == "search" else step.stage, share)

        done = calibrate_tracked_files(
            twin,
            runs,
            out,
            objective=wanted,  # type: ignore[arg-type]
            seed=seed,
            generations=generations,
            tell=show,
        )
    _print_calibration(done)
    page = ""
    if report is not None:
        import numpy as np

        from suspension_twin.report.tracked import calibration_page

        fastest = int(np.argmax([r.speed for r in done.runs]))
        calibration_page(done.result, done.runs, done.told, fastest).write(report / "report.html")
        page = f", page {report / 'report.html'}"
    output().print(f"Written to {out}{page}")


def _print_calibration(done: TrackedCalibration) -> None:
    from suspension_twin.calibration import tracked_paper as paper

    console = output()
    rows: list[tuple[str, ...]] = []
    for key, value in done.result.values.items():
        part, name = key.split(".")
        start = getattr(getattr(done.start, part), name)
        rows.append((key, f"{start:.4g}", f"{value:.4g}", f"{paper.PUBLISHED[key]:.4g}"))
    print_table(console, "What was found", ("parameter", "start", "found", "the paper's"), rows)
    rows = []
    for run, own, used in zip(done.runs, done.told, done.fitted, strict=True):
        w = paper.compare(run, own)
        numbers = (f"{v:.3f}" for pair in (w.correlation, w.residual, w.gain) for v in pair)
        rows.append((run.name, "fitted" if used else "validation", f"{3.6 * run.speed:.0f}", *numbers))
    title = "Correlation, residual (rms over the measured rms) and gain of markers A and B"
    columns = "run", "", "km/h", "corr. A", "B", "resid. A", "B", "gain A", "B"
    print_table(console, title, columns, rows, words=("run", ""))
    a, b = paper.PUBLISHED_CORRELATION
    console.print(
        f"The paper's correlations at 13 km/h are {a} and {b}. Correlation says nothing of amplitude: residual "
        "and gain do; --objective motion fits those."
    )


def diagnose_runs(twin: Path, runs: list[Path], reference: list[Path], out: Path, seed: int) -> None:
    """As ``diagnose`` does for a car, from marker runs; writes the same three files."""
    from suspension_twin.diagnosis.output import write
    from suspension_twin.diagnosis.tracked import diagnose_tracked_files
    from suspension_twin.report.tracked import diagnosis_page

    with ProgressLine() as line:
        result = diagnose_tracked_files(
            str(twin),
            [str(p) for p in runs],
            [str(p) for p in reference],
            seed,
            lambda s: line.show(f"{s.stage} {s.note}".strip(), s.done),
        )
    write(result, out)
    diagnosis_page(result).write(out / "report.html")
    print_diagnosis(result.document, out)
