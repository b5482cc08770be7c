# SPDX-License-Identifier: Apache-2.0
"""Diagnosis on cases whose effect is withheld: makes them, diagnoses them, and scores the answers.

    python benchmarks/blind.py [--short | --full] [--seeds dev|train|report...] [--limit N] [--json] [--out DIR]
    python benchmarks/blind.py --seeds train --case N                 # one case of the plan, by its number
    python benchmarks/blind.py --stage generate|diagnose|score ...    # one stage alone
    python benchmarks/blind.py --stage more ...    # open cases once more, with the drive that was proposed for each
    python benchmarks/blind.py --stage reference ... # calibrated twins once more, with the drive of their calibration
    python benchmarks/blind.py --stage ceiling ... # single causes with the package's own model as the reality
    python benchmarks/blind.py ... --keep [--add]                     # answers kept, with --add beside those before
    python benchmarks/blind.py --reality measured [--limit N]         # recordings of real cars with faults put in

Cases come from realities that share nothing with the package's models (``blind/newton.py``, ``multibody.py``,
``linkage.py``, ``flexible.py``), and from recordings of real cars (``blind/measured.py``). Their labels are sealed
under a hash before the first diagnosis, and a diagnosis is started with a copy of the case's folder alone.
``--limit N`` takes N cases of every kind in fair shares; ``--only`` keeps cases of some effects or kinds. What was
diagnosed stays: run again to go on. A case that was reported on teaches: ``report2`` are as many that none was, and so
are ``report3``.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, get_args

from options import parse_options

from blind import ROOT, ask, seal
from blind.plan import MEASURED, Seeds, Spec, plan

#: Seeds of the realities that are in no other plan.
OF_REALITY = {MEASURED: "measured_dev", "flexible": "flexible_dev"}


def chosen(options: argparse.Namespace) -> list[Spec]:
    """The cases asked for, in the order of the plan."""
    cases = plan(options.seeds, options.short)
    if options.case is not None:
        if not 0 <= options.case < len(cases):
            raise SystemExit(f"--case: the plan {options.seeds} has cases 0 to {len(cases) - 1}")
        cases = [cases[options.case]]
    if options.reality:
        cases = [c for c in cases if c.reality == options.reality]
    if options.only:
        wanted = set(options.only)
        cases = [c for c in cases if wanted & {*c.effects, c.kind, c.name}]
    if options.severity:
        cases = [c for c in cases if c.severity in options.severity]
    if options.limit:
        cases = cases[: options.limit]
    if not cases:
        raise SystemExit("no case of the plan is left: look at --only, --severity, --reality and --limit")
    return cases


def _generate(job: tuple[list[Spec], Path, float, float | None, str]) -> list[str]:
    from blind import folder, measured, phone

    specs, out, phone.RATE, phone.JITTER, phone.RECEIVER = job
    lines = []
    for spec in specs:
        make_case = measured.make_case if spec.reality == MEASURED or spec.planar else folder.make_case
        began = time.monotonic()
        for stale in (out / "cases" / spec.name, out / "sealed" / spec.name):
            shutil.rmtree(stale, ignore_errors=True)
        try:
            label = make_case(spec, out / "cases", out / "sealed")
        except (ArithmeticError, ValueError) as error:  # the others are worth having all the same
            lines.append(f"{spec.name} cannot be made: {error}")
            continue
        (out / "sealed" / spec.name / "label.json").write_text(
            json.dumps(label, indent=1, sort_keys=True) + "\n"
        )
        lines.append(f"{spec.name} {time.monotonic() - began:.1f} s")
    return lines


def generate(
    cases: list[Spec],
    out: Path,
    jobs: int,
    tell: Any,
    rate: float = 100.0,
    jitter: float | None = None,
    receiver: str = "rtk",
) -> None:
    """Write every case that is not there yet, then seal the labels."""
    missing = [c for c in cases if not (out / "sealed" / c.name / "label.json").is_file()]
    by_world: dict[int, list[Spec]] = {}
    for spec in missing:
        by_world.setdefault(spec.world, []).append(spec)
    work = [(specs, out, rate, jitter, receiver) for specs in by_world.values()]
    done = 0
    if jobs == 1:
        for job in work:
            done += _told(_generate(job), tell)
            tell(f"generated {done} of {len(missing)}")
    else:
        with ProcessPoolExecutor(jobs) as pool:
            for lines in pool.map(_generate, work):
                done += _told(lines, tell)
                tell(f"generated {done} of {len(missing)}")
    seal.seal(out, ask.commit())


def _told(lines: list[str], tell: Any) -> int:
    """How many were made; the others are named."""
    bad = [line for line in lines if "cannot be made" in line]
    for line in bad:
        tell(line)
    return len(lines) - len(bad)


def diagnose(cases: list[Spec], out: Path, tell: Any) -> None:
    """Ask for every case; a case that the same package has answered is not asked again."""
    digest = seal.sealed(out)
    known = seal.labels(out)
    cases = [c for c in cases if c.name in known]
    for i, spec in enumerate(cases):
        record = ask.ask(out / "cases" / spec.name, out / "answers" / spec.name, digest)
        tell(f"{i + 1}/{len(cases)} {spec.name} {record['seconds']:.0f} s {record['error']}")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--short", action="store_true", help="nine cases, minutes (the default)")
    size.add_argument("--full", action="store_true", help="all cases, hours")
    parser.add_argument(
        "--seeds", choices=get_args(Seeds), help="dev, or measured_dev for --reality measured"
    )
    parser.add_argument(
        "--stage",
        choices=("generate", "diagnose", "score", "more", "reference", "ceiling", "all"),
        default="all",
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="EFFECT", help="effects, kinds or names of cases"
    )
    parser.add_argument(
        "--severity", nargs="+", type=float, default=[], help="keep cases of these severities"
    )
    parser.add_argument("--reality", choices=("newton", "multibody", "linkage", "flexible", MEASURED))
    parser.add_argument("--case", type=int, metavar="N", help="the case with this number in the plan alone")
    parser.add_argument("--limit", type=int, default=0, metavar="N", help="the first N cases: a fair sample")
    parser.add_argument("--rate", type=float, default=100.0, help="of the phone in Hz")
    parser.add_argument("--jitter", type=float, help="s of its stamps; each phone's own by default")
    parser.add_argument(
        "--receiver", choices=("rtk", "phone"), default="rtk", help="phone: metres off, once a second, late"
    )
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="to generate with")
    parser.add_argument(
        "--baselines",
        type=int,
        default=0,
        metavar="N",
        help="score simple methods beside on N cases (a minute each)",
    )
    parser.add_argument("--keep", action="store_true", help="write the table to benchmarks/results")
    parser.add_argument(
        "--add", action="store_true", help="with --keep: beside the answers to other cases kept there"
    )
    parser.add_argument("--out", type=Path, default=None, metavar="DIR")
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser, limit=1, jobs=1)
    options.seeds = options.seeds or OF_REALITY.get(options.reality, "dev")
    options.short = options.short or not (
        options.full or options.only or options.limit or options.case is not None
    )
    name = f"blind_{options.seeds}" + ("" if options.receiver == "rtk" else "_phone")
    options.out = (options.out or ROOT / "out" / name).resolve()
    return options


def main() -> None:
    """Run the stages asked for."""
    options = parsed()

    def tell(text: str) -> None:
        print(text, file=sys.stderr if options.json else sys.stdout, flush=True)

    cases = chosen(options)
    if options.stage in ("generate", "all"):
        generate(cases, options.out, options.jobs, tell, options.rate, options.jitter, options.receiver)
    if options.stage in ("diagnose", "all"):
        diagnose(cases, options.out, tell)
    if options.stage == "more":
        from blind import more

        more.settle(cases, options.out, tell)
        result = more.figures(cases, options.out)
        print(json.dumps(result) if options.json else more.text_of(result))
    if options.stage == "reference":
        from blind import more

        more.refer(cases, options.out, tell)
        result = more.compared(cases, options.out)
        print(json.dumps(result) if options.json else more.compared_text(result))
    if options.stage == "ceiling":
        from blind import ceiling

        result = ceiling.compare(cases, options.out, tell)
        print(json.dumps(result) if options.json else ceiling.text_of(result))
    if options.stage in ("score", "all"):
        from blind.table import report

        report(cases, options, tell)
