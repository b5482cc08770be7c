# SPDX-License-Identifier: Apache-2.0
"""What a calibrated twin of a sound car leaves of drives that no fit has seen, and which part of the car takes of it.

    python benchmarks/discrepancy.py [CASE] [--held-out NAME ...] [--json] [--smoke]

CASE is a folder with ``twin.yaml``, a road and the drives of a car without a fault; by default that of an established
multibody engine beside the measured data (``../shared/withheld/no_effect_added``, or SUSPENSION_TWIN_WITHHELD). The
twin is calibrated on the drives that are not held out, with more of the car each time: springs as the file has them,
springs with points about the standing car, links, and then one more part at a time. Every figure is the rms of
measured minus simulated on the held-out drives as a share of the measured rms.

Beside them stands what a linear model of the car leaves: FIR filters from the road under the four wheels to each
channel, fitted on the same drives. What the last twin leaves is split by frequency, and by the time since the last
bump. ``--smoke`` fits on one drive and tries no further part.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from extras import unavailable
from numpy.typing import NDArray
from options import parse_options
from rich.console import Console
from rich.table import Table
from scipy.signal import butter, sosfiltfilt

from suspension_twin.api import calibrate, simulate
from suspension_twin.arrays import Floats
from suspension_twin.calibration.presets import refined
from suspension_twin.inference.gap import Comparison
from suspension_twin.inference.space import curve_keys
from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.twin import Twin, load_twin

Mask = NDArray[np.bool_]
CHANNELS = ("vertical_acceleration", "roll_rate", "pitch_rate")
BANDS = ((0.0, 1.0), (1.0, 4.0), (4.0, 10.0), (10.0, 20.0))
INERTIAS = ("vehicle.sprung_inertia.roll", "vehicle.sprung_inertia.pitch")
#: Further parts, tried one at a time, at values that cars have (see inference/priors.yaml for the sources).
FURTHER: Mapping[str, Mapping[str, float]] = {
    "tyre damping": {"vehicle.tyre.damping": 30.0},
    "contact patch": {"vehicle.tyre.contact_length": 0.11},
    "roll bars": {f"vehicle.{axle}.anti_roll_bar": 5e3 for axle in AXLES},
    "friction": {f"vehicle.{axle}.friction": 20.0 for axle in AXLES},
    "top mounts": {f"vehicle.{axle}.top_mount": 4e5 for axle in AXLES},
}
#: A bump: the road under a front wheel rises or falls faster than this, m/s; and s after it that count as near it.
BUMP, AFTER = 0.3, 2.0
LAGS = np.arange(-0.1, 0.6, 0.02)  # s, of the FIR filters


def default_case() -> Path:
    """The sound car beside the measured data."""
    root = Path(__file__).resolve().parents[1]
    data = Path(os.environ.get("SUSPENSION_TWIN_WITHHELD", root.parent / "shared" / "withheld"))
    return data / "no_effect_added"


def share(result: Comparison, channel: str, keep: Mask | None = None) -> float:
    """Rms of measured minus simulated over the measured rms."""
    mask = result.observation.mask if keep is None else result.observation.mask & keep
    measured = result.measured[channel][mask]
    left = measured - result.simulated[channel][mask]
    return float(np.sqrt(np.mean(left**2) / np.mean(measured**2)))


def shares(results: Sequence[Comparison]) -> dict[str, float]:
    """By channel, the mean over drives."""
    return {c: float(np.mean([share(r, c) for r in results])) for c in CHANNELS}


def variants(twin: Twin, smoke: bool) -> list[tuple[str, Twin, tuple[str, ...]]]:
    """Name, twin to start from, and what is free where it is not all that the twin has."""
    fine = refined(twin)
    curves = fine.with_changes({f"vehicle.{axle}.linkage": None for axle in AXLES})

    def own(t: Twin) -> tuple[str, ...]:
        return (*curve_keys(t), *INERTIAS)

    out = [
        ("springs of the file", twin, own(twin)),
        ("fine springs", curves, own(curves)),
        ("links", fine, ()),
    ]
    if not smoke:
        out += [(f"links, {name}", fine.with_changes(keys), ()) for name, keys in FURTHER.items()]
    return out


def filters(results: Sequence[Comparison], held: Sequence[Comparison]) -> dict[str, float]:
    """Share that FIR filters of the road, fitted on ``results``, leave of the ``held`` drives; ridge by their noise."""

    def columns(r: Comparison) -> Floats:
        road = r.observation.road_excitation
        heights = road.road[road.first[1:] - 1]
        moved = [np.interp(r.t - lag, road.t, z) for z in heights.T for lag in LAGS]
        design = np.stack(moved, axis=1)
        return np.asarray(design - design.mean(axis=0))

    design = np.concatenate([columns(r)[r.observation.mask] for r in results])
    scale = float(np.mean(design**2))
    normal = design.T @ design + 1e-4 * scale * len(design) * np.eye(design.shape[1])
    out = {}
    for channel in CHANNELS:
        target = np.concatenate([r.measured[channel][r.observation.mask] for r in results])
        weights = np.linalg.solve(normal, design.T @ target)
        left = []
        for r in held:
            measured = r.measured[channel][r.observation.mask]
            rest = measured - columns(r)[r.observation.mask] @ weights
            left.append(np.sqrt(np.mean(rest**2) / np.mean(measured**2)))
        out[channel] = float(np.mean(left))
    return out


def by_band(results: Sequence[Comparison], channel: str) -> list[tuple[float, float]]:
    """For each band its part of the residual's power, and the residual there over the motion there."""
    power = np.zeros((2, len(BANDS)))
    for r in results:
        mask = r.observation.mask
        for row, signal in enumerate((r.measured[channel] - r.simulated[channel], r.measured[channel])):
            for b, (low, high) in enumerate(BANDS):
                rate = r.observation.rate
                if low == 0.0:
                    sos = butter(4, high, "lowpass", fs=rate, output="sos")
                else:
                    sos = butter(4, [low, min(high, 0.49 * rate)], "bandpass", fs=rate, output="sos")
                power[row, b] += np.mean(sosfiltfilt(sos, signal)[mask] ** 2)
    return [(power[0, b] / power[0].sum(), np.sqrt(power[0, b] / power[1, b])) for b in range(len(BANDS))]


def near_bumps(r: Comparison) -> Mask:
    """Samples at most ``AFTER`` s behind a bump under a front wheel."""
    road = r.observation.road_excitation
    heights = road.road[road.first[1:] - 1][:, :2]
    steep = (np.abs(np.gradient(heights, road.t, axis=0)) > BUMP).any(axis=1)
    times = road.t[steep]
    if not times.size:
        return np.zeros(r.t.size, dtype=bool)
    last = np.searchsorted(times, r.t, side="right") - 1
    return np.asarray((last >= 0) & (r.t - times[np.maximum(last, 0)] <= AFTER))


def run(case: Path, held_out: Sequence[str], smoke: bool, tell: Console) -> dict[str, object]:
    """All figures of one case."""
    twin = load_twin(case / "twin.yaml")
    names = sorted(p.parent.name for p in case.glob("*/metadata.yaml"))
    fitted = [n for n in names if n not in held_out][: 1 if smoke else None]
    if not fitted or not set(held_out) <= set(names):
        raise SystemExit(
            f"{case}: has the drives {', '.join(names)}: hold out some of them and fit on the others"
        )
    table = Table(title=f"{case.name}: share of the motion of {', '.join(held_out)} that is left")
    for title in ("twin calibrated on " + ", ".join(fitted), *(c.replace("_", " ") for c in CHANNELS)):
        table.add_column(title)
    document: dict[str, object] = {}
    last: list[Comparison] = []
    for name, start, free in variants(twin, smoke):
        found = calibrate(start, [str(case / n) for n in fitted], free=free).twin
        results = [simulate(case / n, found) for n in held_out]
        document[name] = row = shares(results)
        table.add_row(name, *(f"{100 * row[c]:.1f} %" for c in CHANNELS))
        if name == "links":
            last, basis = results, [simulate(case / n, found) for n in fitted]
    document["filters"] = row = filters(basis, last)
    table.add_row("linear filters of the road", *(f"{100 * row[c]:.1f} %" for c in CHANNELS))
    tell.print(table)
    bands = Table(
        title="What the twin with links leaves: part of its power, and share of the motion in the band"
    )
    for title in (
        "channel",
        *(f"{low:g} to {high:g} Hz" for low, high in BANDS),
        f"within {AFTER:g} s of bumps",
    ):
        bands.add_column(title)
    for c in CHANNELS:
        cells = [f"{100 * part:.0f} %, {100 * of:.0f} %" for part, of in by_band(last, c)]
        near = [near_bumps(r) & r.observation.mask for r in last]
        squares = [(r.measured[c] - r.simulated[c]) ** 2 for r in last]
        all_of = sum(float(s[r.observation.mask].sum()) for s, r in zip(squares, last, strict=True))
        close = sum(float(s[n].sum()) for s, n in zip(squares, near, strict=True))
        bands.add_row(c.replace("_", " "), *cells, f"{100 * close / all_of:.0f} %")
    tell.print(bands)
    return document


def main() -> None:
    """Parse the command line and print the tables, or JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("case", nargs="?", type=Path, default=default_case())
    parser.add_argument("--held-out", nargs="+", default=["drive_fast", "drive_other"])
    parser.add_argument("--json", action="store_true")
    given = parse_options(parser)
    if not (given.case / "twin.yaml").is_file():
        unavailable(f"{given.case}: has no twin.yaml; name a folder with a twin, a road and drives")
    tell = Console(stderr=given.json)
    document = run(given.case, given.held_out, given.smoke, tell)
    if given.json:
        print(json.dumps(document, indent=2))


if __name__ == "__main__":
    main()
