# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin damping``: the dampers to take for a tracked vehicle, section 6 of the tracked paper."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from suspension_twin.cli.common import TwinFile
from suspension_twin.errors import InputError

__all__ = ["command"]

Range = Annotated[
    tuple[float, float], typer.Option("--range", help="Speeds that count, in km/h.", metavar="LOW HIGH")
]
Out = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for the picture and the table.", metavar="DIR", file_okay=False),
]


def command(twin: TwinFile, speeds: Range = (5.0, 55.0), out: Out = None) -> None:
    """Which damping a tracked vehicle should have: variance of the pitch over speed for the tracked paper's Table 1.

    Runs the vehicle over its obstacle with seven dampings at 5 to 55 km/h, 15 s each, and names the damping with
    the least mean variance within --range. With --out also the picture and the whole table.
    """
    from suspension_twin.calibration.tracked_damping import PAPER_CURVE, select_damping
    from suspension_twin.vehicle.tracked import TrackedTwin
    from suspension_twin.vehicle.twin import load_twin

    loaded = load_twin(twin)
    if not isinstance(loaded, TrackedTwin):
        raise InputError(
            twin, "model", f"is {loaded.model}: the dampers of a tracked vehicle are chosen here"
        )
    chosen = select_damping(loaded.vehicle, *speeds)
    console = Console(highlight=False, soft_wrap=True)
    table = Table(
        title="Variance of the pitch, 1e-4 rad², by damping", title_justify="left", title_style="bold"
    )
    table.add_column("km/h \\ N m s/rad", justify="right")
    for i, damping in enumerate(chosen.dampings):
        table.add_column(f"{damping:.0f}", justify="right", style="bold" if i == chosen.best else "")
    for k, speed in enumerate(chosen.speeds):
        table.add_row(f"{speed:.0f}", *(f"{1e4 * row[k]:.2f}" for row in chosen.table))
    table.add_section()
    table.add_row("mean in range", *(f"{1e4 * v:.2f}" for v in chosen.mean))
    table.add_row("worst over least", *(f"{v:.2f}" for v in chosen.regret))
    console.print(table)
    others = [f"{chosen.dampings[i]:.0f}" for i in chosen.near if i != chosen.best]
    also = f"; within a tenth of it: {', '.join(others)}" if others else ""
    console.print(
        f"From {chosen.low:g} to {chosen.high:g} km/h take {chosen.dampings[chosen.best]:.0f} N m s/rad (curve "
        f"{chosen.best + 1}; the paper, over all speeds: curve {PAPER_CURVE}){also}. It depends on the obstacle."
    )
    if out is not None:
        from suspension_twin.report import style
        from suspension_twin.report.tracked import damping_picture

        out.mkdir(parents=True, exist_ok=True)
        style.save(damping_picture(chosen.speeds, chosen.dampings, chosen.table), out / "pitch_variance.png")
        document = {
            "speeds_kmh": chosen.speeds,
            "dampings": chosen.dampings,
            "range_kmh": speeds,
            "variance_rad2": [[None if v != v else v for v in row] for row in chosen.table.tolist()],
            "recommended": {"curve": chosen.best + 1, "damping": chosen.dampings[chosen.best]},
        }
        (out / "pitch_variance.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        console.print(f"Written to {out}")
