# SPDX-License-Identifier: Apache-2.0
"""The files of a calibration: the twin, and beside it the estimates with their uncertainty."""

from __future__ import annotations

import math
from pathlib import Path

import yaml

from suspension_twin import __version__
from suspension_twin.calibration.request import CalibrationResult
from suspension_twin.errors import WorkError
from suspension_twin.files import Json, comment_lines, together, write_text
from suspension_twin.vehicle.twin import save_twin

__all__ = ["describe", "details_path", "write_result"]


def details_path(path: Path) -> Path:
    """``calibrated.yaml`` has its details in ``calibrated.calibration.yaml``."""
    return path.with_name(f"{path.stem}.calibration.yaml")


def write_result(result: CalibrationResult, path: Path) -> tuple[Path, Path]:
    """Write the calibrated twin, and beside it ``<name>.calibration.yaml`` with intervals, nuisances and
    excited ranges.

    Both files are there, whole, or neither is; neither holds a time or a duration, so the same request gives the same
    files.

    Parameters
    ----------
    result : CalibrationResult
        What :func:`~suspension_twin.calibration.run.calibrate` returned.
    path : Path
        The twin file to write.

    Returns
    -------
    tuple of Path
        Twin file and details.

    Raises
    ------
    InputError
        A file cannot be written.
    WorkError
        The calibrated twin is farther from its own drives than the one it started from, or explains less of what is
        held out.

    Examples
    --------
    >>> write_result(result, Path("calibrated.yaml"))  # doctest: +SKIP
    (PosixPath('calibrated.yaml'), PosixPath('calibrated.calibration.yaml'))
    """
    if result.refusal:
        raise WorkError(f"no twin is written, {result.refusal}; diagnose says which")
    details = details_path(path)
    body = yaml.safe_dump(
        describe(result), sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
    )
    with together():
        save_twin(result.twin, path, _heading(result, details))
        write_text(details, body)
    return path, details


def _heading(result: CalibrationResult, details: Path) -> str:
    drives = ", ".join(d.name for d in result.drives) or "no drive to the end"
    lines = [
        f"suspension-twin {__version__}: calibrated on {drives}",
        f"preset {result.preset}, seed {result.seed}; intervals and what the drives identify: {details.name}",
    ]
    return comment_lines(*lines)


def describe(result: CalibrationResult) -> Json:
    """The result as plain values. A number that could not be had is null."""
    return {
        "preset": result.preset,
        "objective": result.objective,
        "seed": result.seed,
        "stopped": result.stopped,
        "cost": _number(result.cost),
        "initial_cost": _number(result.initial_cost),
        "paper_objective": {
            "name": "Euclidean distance of the vertical acceleration, eq. (1)",
            "unit": "m/s²",
            "initial": _number(result.initial_distance),
            "result": _number(result.distance),
        },
        "explained_variance": _explained(result),
        "evaluations": result.evaluations,
        "generations": result.generations,
        "drives": [
            {
                "name": d.name,
                "gap_before": _plain(d.gap_before.as_dict()),
                "gap_after": _plain(d.gap_after.as_dict()),
                "residual_with_nuisances_corrected": _number(d.nuisance_free),
                "correlation": _number(d.correlation),
            }
            for d in result.drives
        ],
        "parameters": [
            {
                "key": e.key,
                "start": _number(e.start),
                "value": _number(e.value),
                "interval_90": [_number(e.low), _number(e.high)],
                "bounds": [_number(e.lower), _number(e.upper)],
                "on_bound": e.on_bound or None,
                "status": e.status,
            }
            for e in result.estimates
        ],
        "excited_ranges": [
            {"curve": c.key, "from": _number(c.span[0]), "to": _number(c.span[1]), "unit": c.unit}
            for c in result.curves
        ],
        "nuisances": [
            {
                "name": n.name,
                "value": _number(n.value),
                "standard_deviation": _number(n.sigma),
                "prior": _number(n.prior),
                "unit": n.unit,
            }
            for n in result.nuisances
        ],
        "sensor": [
            {
                "key": s.key,
                "start": _number(s.start),
                "value": _number(s.value),
                "interval_90": [_number(s.low), _number(s.high)],
                "unit": s.unit,
                "written": s.written,
                "consistency": _number(s.consistency),
            }
            for s in result.sensor
        ],
        "warnings": list(result.warnings),
    }


def _explained(result: CalibrationResult) -> Json | None:
    measure = result.yardstick
    if measure is None:
        return None
    shares = {name: _number(getattr(measure, name)) for name in ("twin", "given", "linear", "repeat")}
    return {"channel": measure.channel, "held_out": measure.held_out, **shares}


def _number(value: float) -> float | None:
    """Seven digits, as in the twin file: enough, and the same on every machine."""
    return float(f"{value:.7g}") if math.isfinite(value) else None


def _plain(value: Json) -> Json:
    return {k: _plain(v) if isinstance(v, dict) else _number(v) for k, v in value.items()}
