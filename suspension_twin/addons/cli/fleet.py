# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin fleet``: many vehicles and drives, calibrated or diagnosed over Dask."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from suspension_twin.cli.calibrate import Also, Freeze, Generations, Preset
from suspension_twin.cli.common import Outputs, ProgressLine, Seed, output, print_table
from suspension_twin.cli.diagnose import Effects, checked_effects
from suspension_twin.cli.options import grouped
from suspension_twin.errors import InputError, WorkError

if TYPE_CHECKING:
    from suspension_twin.addons.fleet.changes import ChangePoint
    from suspension_twin.addons.fleet.engine import FleetPlan
    from suspension_twin.addons.fleet.work import Options, Record, Task

__all__ = ["app"]

app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})

Manifest = Annotated[
    Path,
    typer.Argument(
        help="CSV or YAML: vehicle, date, twin, drives, references, road.",
        metavar="MANIFEST",
        show_default=False,
    ),
]
Out = Annotated[
    Path,
    typer.Option("--out", help="Folder for the results.", metavar="DIR", file_okay=False, show_default=False),
]


@dataclass(frozen=True)
class ClusterSettings:
    """The workers: of a running scheduler, or of this machine."""

    scheduler: Annotated[
        str,
        typer.Option(
            "--scheduler",
            help="Address of a Dask scheduler, such as tcp://host:8786.  [default: workers on this machine]",
            metavar="ADDRESS",
            show_default=False,
        ),
    ] = ""
    workers: Annotated[
        int,
        typer.Option(
            "--workers",
            help="Workers on this machine.  [default: one a core]",
            metavar="N",
            min=0,
            show_default=False,
        ),
    ] = 0
    memory: Annotated[
        float,
        typer.Option(
            "--memory",
            help="GiB that a worker on this machine may hold.  [default: its share of 80 % of what is free]",
            metavar="GIB",
            min=0.0,
            show_default=False,
        ),
    ] = 0.0


#: Lines of what failed that are printed; all are in results.parquet.
_LINES = 20
_PAGE = "fleet.html"


@app.command()
@grouped
def calibrate(
    *,
    manifest: Manifest,
    out: Out,
    cluster: ClusterSettings,
    preset: Preset = "fast",
    also: Also = None,
    freeze: Freeze = None,
    max_generations: Generations = 0,
    seed: Seed = 0,
) -> None:
    """Calibrate every row of a manifest, and find which vehicles changed.

    Writes DIR/fleet.html (the page of the fleet), results.parquet, health.parquet, changes.parquet, and a folder for
    every row with the calibrated twin. The same command goes on where it was: what is there is not done again.
    """
    from suspension_twin.addons.fleet.work import Options
    from suspension_twin.calibration.presets import preset_named

    preset_named(preset)
    options = Options(
        "calibrate",
        seed,
        preset,
        also=tuple(also or ()),
        freeze=tuple(freeze or ()),
        max_generations=max_generations,
    )
    _run(manifest, out, options, cluster)


@app.command()
@grouped
def diagnose(
    manifest: Manifest,
    out: Out,
    cluster: ClusterSettings,
    effect: Effects = None,
    seed: Seed = 0,
) -> None:
    """Where twin and car disagree and why, for every row of a manifest.

    Writes DIR/fleet.html (the page of the fleet), results.parquet with verdict, causes, shrink and places, and a folder
    for every row with diagnosis.json, evidence.json and the twin with what was found. The same command goes on where it
    was.
    """
    from suspension_twin.addons.fleet.work import Options

    options = Options("diagnose", seed, effects=checked_effects(effect))
    _run(manifest, out, options, cluster)


def _run(manifest: Path, out: Path, options: Options, given: ClusterSettings) -> None:
    from suspension_twin.addons.fleet.changes import find_changes
    from suspension_twin.addons.fleet.engine import FleetOutcome, connected, plan_fleet, run_fleet
    from suspension_twin.addons.fleet.manifest import read_manifest
    from suspension_twin.addons.fleet.page import fleet_page
    from suspension_twin.addons.fleet.results import (
        CHANGES,
        HEALTH,
        MARK,
        RESULTS,
        Ledger,
        health_rows,
        result_rows,
        write_tables,
    )

    if given.scheduler and (given.workers or given.memory):
        raise InputError(
            "--workers" if given.workers else "--memory", "goes without --scheduler: its workers are there"
        )
    items = read_manifest(manifest)
    ledger = Ledger(out)
    console = output()
    console.print(
        f"Writes {', '.join(str(out / name) for name in (_PAGE, RESULTS, HEALTH, CHANGES))} and {out / 'items'}"
    )
    with Outputs(force=False, resumed_from=out / MARK), ProgressLine() as line:
        line.show("looking at what there is")
        plan = plan_fleet(items, options, ledger, lambda n: line.show(f"looking at row {n}", n / len(items)))
        todo = len(plan.open)
        console.print(_planned(plan))
        ledger.begin()
        outcome = FleetOutcome(dict(plan.done))
        if todo:
            with connected(given.scheduler, given.workers, given.memory * (1 << 30)) as cluster:
                console.print(f"On {cluster.text}")

                def show(task: Task, record: Record, left: int) -> None:
                    line.show(f"{task.item.title}; {left} left", (todo - left) / todo)

                outcome = run_fleet(plan, ledger, cluster, show)
        rows = result_rows(plan, outcome)
        changes = find_changes(health_rows(rows))
        write_tables(out, rows, changes)
        fleet_page(rows, changes, options.action, manifest.name).write(out / _PAGE)
    _print_changes(console, changes)
    failed = [row for row in rows if row["status"] != "done"]
    for row in failed[:_LINES]:
        console.print(
            f"{row['vehicle']} {row['date'] or Path(row['drives'][0]).name}: {row['message']}", style="red"
        )
    if len(failed) > _LINES:
        console.print(f"and {len(failed) - _LINES} more, in {out / RESULTS}", style="red")
    now = "none computed now"
    if outcome.computed:
        rate = outcome.computed / outcome.seconds * 60.0
        now = f"{outcome.computed} computed now in {outcome.seconds:.1f} s, {rate:.0f} a minute"
    console.print(f"{len(rows) - len(failed)} of {len(rows)} rows done, {now}")
    console.print(f"Written to {out}; the page of the fleet is {out / _PAGE}")
    if failed:
        raise WorkError(f"{len(failed)} of {len(rows)} rows failed: status and message in {out / RESULTS}")


def _planned(plan: FleetPlan) -> str:
    before = sum(t.key in plan.done for t in plan.planned)
    unusable = len(plan.tasks) - len(plan.planned)
    hours = sum(t.seconds for t in plan.open) / 3600.0
    driven = f" ({hours:.2f} h of driving)" if hours else ""
    bad = f", {unusable} unusable" if unusable else ""
    return f"{len(plan.items)} rows: {before} done before{bad}, {len(plan.open)} different ones to do{driven}"


def _print_changes(console: Console, changes: list[ChangePoint]) -> None:
    named = [c for c in changes if c.named]
    rows = [
        (
            c.series.vehicle,
            c.series.quantity,
            c.date,
            f"{c.earliest} to {c.latest}",
            f"{c.probability:.3f}",
            f"{c.before:.4g}",
            f"{c.after:.4g}",
            c.series.unit,
        )
        for c in named
    ]
    if rows:
        columns = "vehicle", "quantity", "from", "90 % interval", "probability", "before", "after", "unit"
        print_table(
            console, "What changed", columns, rows, words=("vehicle", "quantity", "90 % interval", "unit")
        )
