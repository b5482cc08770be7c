# SPDX-License-Identifier: Apache-2.0
"""What ``calibrate`` and ``diagnose`` do with a twin on tracks: its drives are marker runs over the obstacle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from suspension_twin.errors import InputError, WorkError

__all__ = ["calibrate_runs", "diagnose_runs", "is_tracked"]


def is_tracked(path: Path) -> bool:
    """Whether a twin file says ``model: tracked``; False for what cannot be read, which others report."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    return isinstance(data, dict) and data.get("model") == "tracked"


def _bar() -> Progress:
    errors = Console(stderr=True)
    columns = TextColumn("{task.description:<44}"), BarColumn(), TimeElapsedColumn()
    return Progress(*columns, console=errors, disable=not errors.is_terminal, transient=True)


def calibrate_runs(
    twin: Path, runs: list[Path], out: Path, preset: str, report: Path | None, seed: int, objective: str,
    generations: int,
) -> None:  # fmt: skip
    """Preset ``tracked_paper``: fit the slowest runs, validate on the others; see calibration.tracked_paper."""
    from dataclasses import replace

    import numpy as np

    from suspension_twin.calibration import tracked_paper as paper
    from suspension_twin.calibration.tracked_runs import read_run
    from suspension_twin.vehicle.tracked_twin import TrackedTwin
    from suspension_twin.vehicle.twin import load_twin, save_twin

    if preset not in ("fast", "tracked_paper"):  # "fast" is what stands where no preset is asked for
        raise InputError("preset", preset, "is for cars: a twin on tracks takes tracked_paper")
    wanted = objective or "correlation"
    if wanted not in paper.OBJECTIVES:
        raise InputError("--objective", wanted, f"one of {', '.join(paper.OBJECTIVES)} is expected")
    loaded = load_twin(twin)
    assert isinstance(loaded, TrackedTwin)
    read = [read_run(p, loaded.vehicle) for p in runs]
    slowest = min(r.speed for r in read)
    fitted = [r for r in read if r.speed <= 1.02 * slowest]
    settings = replace(paper.SETTINGS, generations=generations or paper.SETTINGS.generations)
    with _bar() as bar:
        task = bar.add_task("calibrating", total=settings.generations)
        result = paper.calibrate_tracked(
            loaded.vehicle, fitted, objective=wanted, seed=seed, settings=settings,  # type: ignore[arg-type]
            on_generation=lambda g, best: bar.update(task, completed=g, description=f"generation {g}, best {best:.4g}"),
        )  # fmt: skip
    save_twin(loaded.model_copy(update={"vehicle": result.vehicle}), out)
    told = paper.simulate_runs([result.vehicle], read)[0]
    if told is None:
        raise WorkError("tracked_paper: what was found diverges on a validation run")
    console = Console(highlight=False, soft_wrap=True)
    table = Table(title="What was found", title_justify="left", title_style="bold")
    for name in ("parameter", "start", "found", "the paper's"):
        table.add_column(name, justify="left" if name == "parameter" else "right")
    for key, value in result.values.items():
        part, name = key.split(".")
        start = getattr(getattr(loaded.vehicle, part), name)
        table.add_row(key, f"{start:.4g}", f"{value:.4g}", f"{paper.PUBLISHED[key]:.4g}")
    console.print(table)
    table = Table(title="Fit and validation", title_justify="left", title_style="bold")
    for name in ("run", "km/h", "", "correlation A", "B", "left over A", "B", "gain A", "B"):
        table.add_column(name, justify="left" if name in ("run", "") else "right")
    for run, own in zip(read, told, strict=True):
        w = paper.compare(run, own)
        used = "fitted" if any(run is f for f in fitted) else "validation"
        numbers = (f"{v:.3f}" for pair in (w.correlation, w.residual, w.gain) for v in pair)
        table.add_row(run.name, f"{3.6 * run.speed:.0f}", used, *numbers)
    console.print(table)
    a, b = paper.PUBLISHED_CORRELATION
    console.print(
        f"The paper's correlations at 13 km/h are {a} and {b}. Correlation says nothing of amplitude: 'left over' (rms "
        "of the difference over the measured rms) and 'gain' do; --objective motion fits those."
    )
    if report is not None:
        from suspension_twin.report.tracked import calibration_page

        fastest = int(np.argmax([r.speed for r in read]))
        calibration_page(result, read, told, fastest).write(report / "report.html")
    console.print(f"Written to {out}" + (f", page {report / 'report.html'}" if report is not None else ""))


def diagnose_runs(twin: Path, runs: list[Path], reference: list[Path], out: Path, seed: int) -> None:
    """As ``diagnose`` does for a car, from marker runs; writes the same three files."""
    import json

    from suspension_twin.diagnosis.tracked import diagnose_tracked_files
    from suspension_twin.report.tracked import diagnosis_page
    from suspension_twin.vehicle.twin import save_twin

    with _bar() as bar:
        task = bar.add_task("reading", total=1.0)
        result = diagnose_tracked_files(
            str(twin), [str(p) for p in runs], [str(p) for p in reference], seed,
            lambda s: bar.update(task, completed=s.done, description=f"{s.stage} {s.note}".strip()),
        )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(result.document, indent=2, ensure_ascii=False, allow_nan=False)
    (out / "diagnosis.json").write_text(text + "\n", encoding="utf-8")
    save_twin(result.twin, out / "twin.yaml")
    diagnosis_page(result).write(out / "report.html")
    _print_diagnosis(result.document, out)


def _print_diagnosis(document: dict[str, Any], out: Path) -> None:
    console = Console(highlight=False, soft_wrap=True)
    for warning in document["warnings"]:
        console.print(f"[yellow]{warning}[/]")
    console.print(f"[bold]{document['verdict']}[/]: {document['message']}")
    table = Table()
    for name in ("cause", "probability", "shrink", "interval", "parameters"):
        table.add_column(name)
    for cause in document["causes"][:5]:
        low, high = cause["shrink_interval"]
        values = ", ".join(f"{k} {v:.4g}" for k, v in cause["parameters"].items())
        table.add_row(
            cause["effect"], f"{cause['probability']:.3f}", f"{cause['shrink']:.2f}", f"{low:.2f} to {high:.2f}", values
        )
    console.print(table)
    console.print(
        f"no gap {document['no_gap_probability']:.3f}, unknown {document['unknown_probability']:.3f}. "
        f"{document['next_experiment']}"
    )
    console.print(f"Written to {out}")
