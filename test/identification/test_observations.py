# SPDX-License-Identifier: Apache-2.0
"""Controlled runs as observations: what may be simulated once, and what may not."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.gap.marker_runs import read_run
from suspension_twin.identification.observations import marker_observation, observe
from suspension_twin.vehicle.twin import load_twin


def beginning(path: Path, lines: int, folder: Path) -> Path:
    """A recording that ends early."""
    out = folder / f"first_{lines}_{path.name}"
    out.write_text("\n".join(path.read_text("utf-8").splitlines()[:lines]) + "\n", encoding="utf-8")
    return out


@pytest.mark.parametrize("long_first", [True, False])
def test_repeats_at_one_speed_are_simulated_once_where_one_is_a_part_of_the_other(
    long_first: bool, repository: Path, tmp_path: Path
) -> None:
    vehicle = load_twin(repository / "config" / "tracked" / "pt91.yaml").vehicle
    run = repository / "config" / "tracked" / "runs" / "13kmh_1.csv"
    long, short = (read_run(beginning(run, n, tmp_path), vehicle, 13.0 / 3.6) for n in (101, 71))
    first, second = (long, short) if long_first else (short, long)
    known = marker_observation(first)
    seen = marker_observation(second, [known])
    assert (seen.excitation is known.excitation) == long_first
    assert len(seen.excitation) > seen.t[-1] * seen.rate - 0.5


@pytest.mark.parametrize("long_first", [True, False])
def test_runs_of_a_rig_share_a_program_only_if_it_is_the_same(
    long_first: bool, repository: Path, tmp_path: Path
) -> None:
    twin = load_twin(repository / "config" / "twins" / "quarter_car.yaml")
    whole = repository / "config" / "rig" / "random.csv"
    part = beginning(whole, 1501, tmp_path)
    pair = [whole, part] if long_first else [part, whole]
    one, again, other = observe(twin, [str(path) for path in (pair[0], pair[0], pair[1])])
    assert again.excitation is one.excitation and again.name != one.name
    assert other.excitation is not one.excitation
    assert one.position[-1] < other.position[0] or other.position[-1] < one.position[0]
