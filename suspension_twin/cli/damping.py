# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin damping``: the dampers to take for a tracked vehicle, section 6 of the tracked paper."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, ProgressLine, TwinFile, output, print_table
from suspension_twin.errors import InputError
from suspension_twin.files import together, write_text

__all__ = ["command"]


def command(
    twin: TwinFile,
    *,
    speeds: Annotated[
        tuple[float, float], typer.Option("--range", help="Speeds that count, in km/h.", metavar="LOW HIGH")
    ] = (5.0, 55.0),
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the picture and the table.", metavar="DIR", file_okay=False),
    ] = None,
    force: Force = False,
) -> None:
    """Which damping a tracked vehicle should have: variance of the pitch over speed for the tracked paper's Table 1.

    Runs the vehicle over its obstacle with seven dampings at 5 to 55 km/h, 15 s each, and names the damping with
    the least mean variance within --range. With --out writes DIR/pitch_variance.png and DIR/pitch_variance.json.
    """
    from suspension_twin.calibration.damping import PAPER_CURVE, select_damping
    from suspension_twin.models.registry import model_of
    from suspension_twin.vehicle.twin import load_twin

    files = [] if out is None else [out / f"pitch_variance.{suffix}" for suffix in ("png", "json")]
    outputs = Outputs(*files, force=force)
    loaded = load_twin(twin)
    if model_of(loaded).recordings != "markers":
        raise InputError(
            twin, "model", f"is {loaded.model}: the dampers of a tracked vehicle are chosen here"
        )
    outputs.announce()
    with outputs, ProgressLine() as line:
        chosen = select_damping(loaded.vehicle, *speeds, tell=line.show)
    console = output()
    rows = [
        *(
            (f"{speed:.0f}", *(f"{1e4 * value:.2f}" for value in row))
            for speed, row in zip(chosen.speeds, chosen.table.T, strict=True)
        ),
        ("mean in range", *(f"{1e4 * value:.2f}" for value in chosen.mean)),
        ("worst over least", *(f"{value:.2f}" for value in chosen.regret)),
    ]
    title = "Variance of the pitch in 1e-4 rad², by damping in N m s/rad"
    print_table(console, title, ("km/h", *map("{:.0f}".format, chosen.dampings)), rows)
    others = [f"{chosen.dampings[i]:.0f}" for i in chosen.near if i != chosen.best]
    also = f"; within a tenth of it: {', '.join(others)}" if others else ""
    console.print(
        f"From {chosen.low:g} to {chosen.high:g} km/h take {chosen.dampings[chosen.best]:.0f} N m s/rad (curve "
        f"{chosen.best + 1}; the paper, over all speeds: curve {PAPER_CURVE}){also}. It depends on the obstacle."
    )
    if not files:
        return
    from suspension_twin.report import style
    from suspension_twin.report.markers import damping_picture

    document = {
        "speeds_kmh": chosen.speeds,
        "dampings": chosen.dampings,
        "range_kmh": speeds,
        "variance_rad2": [[None if v != v else v for v in row] for row in chosen.table.tolist()],
        "recommended": {"curve": chosen.best + 1, "damping": chosen.dampings[chosen.best]},
    }
    with together():
        style.save(damping_picture(chosen.speeds, chosen.dampings, chosen.table), files[0])
        write_text(files[1], json.dumps(document, indent=1) + "\n")
    console.print(f"Written to {files[0]} and {files[1]}")
