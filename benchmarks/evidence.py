# SPDX-License-Identifier: Apache-2.0
"""How much the evidence scatters between fits that are equally good, and how fast a fit gets there.

    python benchmarks/evidence.py [--cases N] [--fits N] [--json]

Development cases of both realities (``blind.py``) with nothing wrong and with something: hypotheses are fitted, then
fitted again from places beside, and the evidence of every one of these fits is taken twice: with vehicle and nuisances
held while a stretch is held back, as the diagnosis does it, and with all of them free. In nats as the probabilities
count them. Then from a place further off, how far above the best known cost a fit stands after a few iterations, its
steps damped by the prior as well and by the curvature alone.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import numpy as np  # noqa: E402
from blind.folder import make_case  # noqa: E402
from blind.plan import Spec, plan  # noqa: E402

from suspension_twin.arrays import Floats  # noqa: E402
from suspension_twin.diagnosis import evidence as judge  # noqa: E402
from suspension_twin.diagnosis import fit as fits  # noqa: E402
from suspension_twin.diagnosis import verdict  # noqa: E402
from suspension_twin.diagnosis.bench import Bench  # noqa: E402
from suspension_twin.diagnosis.case import baseline, build, read_case  # noqa: E402
from suspension_twin.diagnosis.fit import LinearisedFit, fitted, refit  # noqa: E402
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis, library  # noqa: E402
from suspension_twin.diagnosis.request import DiagnosisRequest  # noqa: E402
from suspension_twin.diagnosis.shrink import remaining_residual  # noqa: E402

EFFECTS = ("sensor_bandwidth", "strut_friction")
BESIDE, FURTHER = 0.1, 0.6  # of a coordinate, by which fits begin beside the best and further off
ITERATIONS, LONG = 4, 30
TOLD = (
    "{case} {hypothesis:17s} costs differ by {costs:6.2f}; evidence by {held:5.2f} held, {free:5.2f} free; "
    f"behind after {ITERATIONS} iterations "
    "{behind_damped_by_prior:8.1f}, by the curvature alone {behind_damped_by_curvature:8.1f}"
)


def chosen(count: int) -> list[Spec]:
    """Nulls and cases with something wrong in turn, of both realities, with a reference and without."""
    everything = plan("dev")
    nulls = [s for s in everything if s.kind == "null"]
    faulty = [s for s in everything if s.kind == "single" and s.severity == 1.5 and not s.msd]
    return [s for pair in zip(nulls, faulty, strict=False) for s in pair][:count]


def evidences(bench: Bench, blocks: judge.Blocks, found: Sequence[LinearisedFit], temper: float) -> Floats:
    """(n,) nats that speak for each of some fits, as the probabilities count them."""
    out = [judge.evidence(bench, f, blocks) for f in found]
    return temper * np.array([float(e.score.sum()) - 0.5 * e.occam for e in out])


def scatter(
    bench: Bench, hypothesis: Hypothesis, x: Floats, blocks: judge.Blocks, temper: float, count: int
) -> Any:
    """Costs of fits begun beside each other, and the spread of their evidence, held and free."""
    rng = np.random.default_rng(0)
    spread = np.concatenate([np.ones(bench.d), bench.problem.nuisances.spread, np.ones(len(hypothesis))])
    beside = [x + BESIDE * spread * rng.normal(size=x.size) for _ in range(count)]
    found = [fitted(bench, hypothesis, [y], ITERATIONS) for y in beside]
    held = evidences(bench, blocks, found, temper)
    with patch.object(judge, "_HELD", (0.0,)):
        free = evidences(bench, blocks, found, temper)
    far = x + FURTHER * rng.normal(size=x.size) * spread
    far = bench.clipped(hypothesis, far[:, None])[:, 0]
    known = min(f.cost for f in found)
    _, damped = refit(bench, hypothesis, [far], None, ITERATIONS)
    with patch.object(fits, "SETTINGS", replace(fits.SETTINGS, prior_damping=0.0)):
        _, bare = refit(bench, hypothesis, [far], None, ITERATIONS)
    return {
        "hypothesis": hypothesis.name,
        "costs": float(np.ptp([f.cost for f in found])),
        "held": float(np.std(held, ddof=1)),
        "free": float(np.std(free, ddof=1)),
        "behind_damped_by_prior": damped - known,
        "behind_damped_by_curvature": bare - known,
    }


def case_of(folder: Path, count: int) -> list[dict[str, Any]]:
    """Figures of one case: the baseline and a few effects."""
    drives = [str(p) for p in sorted(folder.iterdir()) if p.is_dir()]
    shown = tuple(d for d in drives if not Path(d).name.startswith("reference"))
    request = DiagnosisRequest(str(folder / "twin.yaml"), shown, tuple(d for d in drives if d not in shown))
    case = read_case(request, lambda note: None, lambda: False)
    bench = build(case, lambda: False)
    bench, base, _ = baseline(case, bench)
    blocks = judge.blocks_of(bench, case.kind)
    seen = [d for d, a in zip(case.drives, bench.active, strict=True) if a]
    noise = {c: float(np.sqrt(np.mean([d.noise_rms[c] ** 2 for d in seen]))) for c in bench.problem.channels}
    left = remaining_residual(bench, BASELINE, judge.evidence(bench, base, blocks).unknowns, blocks)
    temper = verdict.temper_of(bench, left, noise)
    known = library(case.twin, case.excited, ())
    tried = [(BASELINE, base.x)]
    tried += [(h, np.concatenate([base.x, h.starts(1, 0)[:, 0]])) for h in (known[e][0] for e in EFFECTS)]
    out = []
    for hypothesis, x in tried:
        best, _ = refit(bench, hypothesis, [x], None, LONG)
        out.append({"case": folder.name, **scatter(bench, hypothesis, best, blocks, temper, count)})
    return out


def main() -> None:
    """Take the figures and print a table, or with ``--json`` the same figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--cases", type=int, default=4, help="development cases to make (a minute and a half each)"
    )
    parser.add_argument("--fits", type=int, default=5, help="fits beside each other")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory(prefix="evidence_") as name:
        for spec in chosen(options.cases):
            make_case(spec, Path(name) / "cases", Path(name) / "sealed")
            for row in case_of(Path(name) / "cases" / spec.name, options.fits):
                rows.append(row)
                if not options.json:
                    print(TOLD.format(**row), flush=True)
    keys = ("costs", "held", "free", "behind_damped_by_prior", "behind_damped_by_curvature")
    middle = {k: round(float(np.median([r[k] for r in rows])), 3) for k in keys}
    if options.json:
        print(json.dumps({"median": middle, "rows": rows}, indent=1))
    else:
        print(f"in the middle: {middle}")


if __name__ == "__main__":
    main()
