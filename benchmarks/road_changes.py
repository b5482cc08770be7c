# SPDX-License-Identifier: Apache-2.0
"""Faults of a vehicle that came since its reference drives, diagnosed where nobody scanned the road.

    python benchmarks/road_changes.py [--cases N] [--first N] [--jobs N] [--out DIR] [--json]

A car of the blind benchmark is calibrated on a surveyed road and driven twice, at 20 and 40 km/h, over another road of
300 m. Then it gets a fault of five floors of severity and drives there twice more, at 30 and 45 km/h. Its drives are
diagnosed with the two before as the reference, once on the road as a scan would have it, once on the road that
``road drives`` makes of the reference drives alone. Bar: of the faults named on the scanned road, 80 % are named on the
other. Cases take turns between the realities ``newton`` and ``multibody`` and through the effects; each has a world of
its own. An answer that is kept under ``--out`` is not asked for again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "bags")]

from blind import severity  # noqa: E402
from blind.faults import knob  # noqa: E402
from blind.world import make_world  # noqa: E402
from options import parse_options  # noqa: E402
from road_drives_world import drive_over, make_site  # noqa: E402

from suspension_twin.addons.roads.drives.drives import road_from_drives, surface_of  # noqa: E402
from suspension_twin.addons.roads.drives.estimate import RoadEstimateSettings  # noqa: E402
from suspension_twin.drive.write import write_drive  # noqa: E402
from suspension_twin.road import write_road  # noqa: E402
from suspension_twin.vehicle.twin import RoadFile, save_twin  # noqa: E402

BAR = 0.8
EFFECTS = (
    "corner_damper",
    "strut_friction",
    "payload",
    "bump_stop",
    "worn_dampers",
    "tyre_pressure",
    "corner_spring",
    "top_mount",
    "damper_fade",
    "spring_sag",
    "anti_roll_bar",
    "tyre_damping",
)
REALITIES = ("newton", "multibody")
ROADS = ("scanned", "driven")
_SEED, _SEVERITY = 8100, 5.0
#: km/h and number of the drives.
_BEFORE, _AFTER = ((20.0, 0), (40.0, 1)), ((30.0, 2), (45.0, 3))


@dataclass(frozen=True)
class Case:
    """One fault in one world."""

    number: int

    @property
    def effect(self) -> str:
        return EFFECTS[self.number % len(EFFECTS)]

    @property
    def reality(self) -> str:
        # the other way round in the second round of effects
        return REALITIES[(self.number + self.number // len(EFFECTS)) % 2]

    @property
    def seed(self) -> int:
        return _SEED + self.number

    def make(self, folder: Path) -> None:
        """Write drives, roads and twins."""
        home = make_world(self.seed)
        scale = severity.yardstick(home, False)
        curve = severity.curve(home, scale, self.effect, self.seed, True)
        amount = severity.amount_for(curve, _SEVERITY)
        fault = knob(self.effect, home, self.seed, True)(amount, scale.null)
        site = make_site(self.seed, self.reality)
        before = [drive_over(site, kmh, number)[0] for kmh, number in _BEFORE]
        after = [drive_over(site, kmh, number, {self.effect: fault})[0] for kmh, number in _AFTER]
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for name, drives in (("before", before), ("after", after)):
            for i, drive in enumerate(drives):
                write_drive(drive, folder / f"{name}_{i}")
        roads = {
            "scanned": site.survey,
            "driven": surface_of(road_from_drives(before, site.twin, RoadEstimateSettings())),
        }
        for name, road in roads.items():
            file = folder / f"{name}.crg"
            write_road(road, file)
            save_twin(
                site.twin.model_copy(update={"road": RoadFile(file=file)}), folder / f"twin_{name}.yaml"
            )
        (folder / "label.json").write_text(json.dumps({"effect": self.effect, "fault": fault}) + "\n")

    def answer(self, folder: Path, road: str, alone: bool) -> dict[str, Any]:
        """What a diagnosis on one of the roads says; ``alone``: with this effect in place of the library."""
        out = folder / road
        if not (out / "diagnosis.json").is_file():
            before, after = ([str(folder / f"{name}_{i}") for i in (0, 1)] for name in ("before", "after"))
            twin = str(folder / f"twin_{road}.yaml")
            line = [sys.executable, "-m", "suspension_twin", "diagnose", "--twin", twin, *after]
            line += ["--effect", self.effect] if alone else []
            environment = os.environ | {"PYTHONPATH": str(HERE.parent)}
            run = subprocess.run(
                [*line, "--reference", *before, "--out", str(out)],
                env=environment,
                capture_output=True,
                text=True,
            )
            if run.returncode:
                return {"verdict": "error", "named": [], "first": None, "error": run.stderr.strip()[-300:]}
        found = json.loads((out / "diagnosis.json").read_text())
        named = found["combination"] if found["verdict"] in ("effect", "partly") else []
        first = found["causes"][0] if found["causes"] else {"effect": None, "probability": 0.0}
        return {
            "verdict": found["verdict"],
            "named": named,
            "first": first["effect"],
            "probability": first["probability"],
        }


def asked(case: Case, out: Path, alone: bool) -> dict[str, Any]:
    """One case, made and answered on both roads."""
    folder = out / f"case_{case.number:03d}"
    if not (folder / "label.json").is_file():
        case.make(folder)
    return {"effect": case.effect, "reality": case.reality} | {
        r: case.answer(folder, r, alone) for r in ROADS
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over the cases."""

    def right(row: dict[str, Any], road: str) -> bool:
        return bool(row["effect"] in row[road]["named"])

    both = [r for r in rows if right(r, "scanned")]
    return {
        "cases": len(rows),
        **{f"named_{road}": sum(right(r, road) for r in rows) for road in ROADS},
        **{f"first_{road}": sum(r[road]["first"] == r["effect"] for r in rows) for road in ROADS},
        **{f"wrong_{road}": sum(bool(set(r[road]["named"]) - {r["effect"]}) for r in rows) for road in ROADS},
        "named_on_both": sum(right(r, "driven") for r in both),
        "bar": BAR,
    }


def main() -> None:
    """All cases asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=len(EFFECTS))
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--jobs", type=int, default=1, help="cases at once")
    parser.add_argument(
        "--out", type=Path, default=Path("road_changes"), help="where cases and answers are kept"
    )
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser, cases=1)
    cases = [Case(options.first + n) for n in range(options.cases)]
    out = options.out.resolve()
    rows = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for row in pool.map(partial(asked, out=out, alone=options.smoke), cases):
            rows.append(row)
            if not options.json:
                said = "; ".join(
                    f"{road}: {row[road]['verdict']} {'+'.join(row[road]['named']) or '-'} "
                    f"(first {row[road]['first']}, {row[road].get('probability', 0.0):.2f})"
                    for road in ROADS
                )
                print(f"{row['reality']:10}{row['effect']:16}{said}", flush=True)
    found = summary(rows)
    if options.json:
        print(json.dumps({"summary": found, "cases": rows}, indent=1))
        return
    kept, of = found["named_on_both"], found["named_scanned"]
    print(
        f"named on the scanned road {of} of {len(rows)}, of these on the driven one {kept} "
        f"({kept / max(of, 1):.0%}, bar {BAR:.0%}); in all on the driven one {found['named_driven']}; "
        f"wrong names {found['wrong_scanned']} and {found['wrong_driven']}"
    )


if __name__ == "__main__":
    main()
