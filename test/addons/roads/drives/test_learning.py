# SPDX-License-Identifier: Apache-2.0
"""A road from what was just driven: passes end where they come back, and strays do not spoil the road."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.addons.roads.drives.learning import (
    Laps,
    Lesson,
    Span,
    learn_road,
    read_lesson,
    write_lesson,
)
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.road import flat_road
from suspension_twin.vehicle.twin import load_twin

BAGS = Path(__file__).resolve().parents[4] / "bags"


def passes_of(xy: list[tuple[float, float]], speed: float = 5.0, sigma: float = 0.02) -> list[Span]:
    """Spans found along straight pieces between points, driven at one speed."""
    laps, found, t = Laps(), [], 0.0
    for (x0, y0), (x1, y1) in zip(xy[:-1], xy[1:], strict=True):
        length, yaw = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
        for s in np.arange(0.0, length, 0.1 * speed):
            t += 0.1
            part = s / length
            span = laps.push(t, x0 + part * (x1 - x0), y0 + part * (y1 - y0), yaw, speed, sigma)
            found += [span] if span else []
    last = laps.close()
    return [*found, *([last] if last else [])]


def test_a_round_trip_ends_where_it_began() -> None:
    block = [(0.0, 0.0), (60.0, 0.0), (60.0, 40.0), (0.0, 40.0)]
    found = passes_of([*block, *block, (0.0, 0.0), (50.0, 0.0)])
    assert [round(p.length, -1) for p in found] == [200, 200, 50]
    assert all(b.start >= a.end for a, b in zip(found[:-1], found[1:], strict=True))


def test_the_way_back_belongs_to_the_pass() -> None:
    """There and back on one track is no second pass; there once more is."""
    found = passes_of([(0.0, 0.0), (100.0, 0.0), (100.0, 3.0), (0.0, 3.0), (0.0, 0.0), (100.0, 0.0)])
    assert [round(p.length, -1) for p in found] == [210, 100]


def test_a_poor_receiver_comes_back_too_and_short_ways_are_nothing() -> None:
    away = [(0.0, 0.0), (60.0, 0.0), (60.0, 40.0), (-10.0, 40.0), (-10.0, 7.0), (60.0, 7.0)]
    assert len(passes_of(away, sigma=0.02)) == 1
    assert len(passes_of(away, sigma=4.0)) == 2
    assert passes_of([(0.0, 0.0), (15.0, 0.0)]) == []
    assert passes_of([(0.0, 0.0), (100.0, 0.0)], speed=0.5) == []


def test_the_twin_stands_on_what_was_learnt(tmp_path: Path) -> None:
    """From the bundled bump; a pass of elsewhere is left out with a warning."""
    drive = read_drive(BAGS / "bump_15kmh")
    twin = load_twin(BAGS / "bump_15kmh" / "twin.yaml").with_changes({"road": None})
    twin_file = tmp_path / "twin.yaml"
    twin_file.write_text((BAGS / "bump_15kmh" / "twin.yaml").read_text().replace("road:", "# road:"))
    fix = drive.fix
    elsewhere = replace(drive, fix=replace(fix, latitude=fix.latitude + 0.01))
    t = float(drive.imu.t[0])
    out = tmp_path / "road.crg"
    passes = ((0, t + 6.0, t + 22.0), (1, t + 8.0, t + 18.0))
    lesson = Lesson(str(twin_file), str(out), (drive, elsewhere), passes)
    write_lesson(lesson, tmp_path / "lesson.npz")
    outcome = learn_road(read_lesson(tmp_path / "lesson.npz"))
    assert outcome["passes"] == 1
    assert any("left out: pass 2" in text for text in outcome["warnings"])
    assert 20.0 < outcome["length"] < 80.0
    learnt = load_twin(outcome["twin"])
    assert learnt.road is not None and learnt.road.file == out
    on_it = simulate_drive(drive, learnt)
    level = simulate_drive(drive, twin, flat_road())
    assert on_it.gap.rms < 0.6 * level.gap.rms


def test_a_lesson_comes_back_from_its_file(tmp_path: Path) -> None:
    drive = read_drive(BAGS / "bump_15kmh")
    passes = ((0, 1.0, 2.0), (1, 2.0, 3.0), (0, 4.0, 5.0))
    lesson = Lesson("a.yaml", "a.crg", (drive, replace(drive, heading=None)), passes, (47.4, 19.3, 100.0))
    write_lesson(lesson, tmp_path / "lesson.npz")
    found = read_lesson(tmp_path / "lesson.npz")
    assert (found.twin, found.out, found.datum) == (lesson.twin, lesson.out, lesson.datum)
    assert found.passes == passes
    again, other = found.drives
    assert other.heading is None
    assert (again.name, again.warnings) == (drive.name, drive.warnings)
    for kind in ("imu", "fix", "velocity"):
        for name, value in vars(getattr(drive, kind)).items():
            np.testing.assert_array_equal(getattr(getattr(again, kind), name), value)


def test_a_lesson_without_a_pass_is_an_error_and_writes_nothing(tmp_path: Path) -> None:
    drive = read_drive(BAGS / "bump_15kmh")
    t = float(drive.imu.t[0])
    lesson = Lesson(
        str(BAGS / "bump_15kmh" / "twin.yaml"), str(tmp_path / "road.crg"), (drive,), ((0, t, t + 2.5),)
    )
    with pytest.raises(InputError, match=r"drives|pass 1"):
        learn_road(lesson)
    assert list(tmp_path.iterdir()) == []
