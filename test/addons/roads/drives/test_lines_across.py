# SPDX-License-Identifier: Apache-2.0
"""Drives beside each other: heights on lines across, as far as an estimate can tell them apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.addons.roads.drives.drives import road_from_drives, surface_of
from suspension_twin.addons.roads.drives.estimate import RoadEstimate, RoadEstimateSettings, WheelProfiles
from suspension_twin.addons.roads.drives.inverse import RoadPrior, coherence
from suspension_twin.drive.types import Drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.road import Road, add_bump, half_sine
from suspension_twin.road.build import Centreline
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import Twin, load_twin

BAGS = Path(__file__).resolve().parents[4] / "bags"


@pytest.fixture(scope="module")
def twin() -> Twin:
    return load_twin(BAGS / "bump_15kmh" / "twin.yaml").with_changes({"road": None})


def driven(twin: Twin, road: Road, speed: float, v: float, number: int) -> Drive:
    t = 4.0 + 32.0 / speed
    knots = ((0.0, 0.0), (2.0, 0.0), (4.0, speed), (t, speed), (t + 1.5, 0.0), (t + 2.0, 0.0))
    return synthetic_drive(twin, road, knots, seed=number, u=6.0, v=v, name=f"drive_{number}")


def test_each_lane_is_nearer_to_the_truth_than_one_line_for_both(twin: Twin) -> None:
    """A low ridge lies under the left wheels of one drive, and beside those of the other, 0.2 m to the right."""
    road = iso8608_road("A", 60.0, width=5.0, seed=5, step=0.05)
    road = add_bump(road, half_sine(1.0, 0.015), 28.0, v_low=0.5 * twin.vehicle.front_track)
    drives = [driven(twin, road, 6.0, 0.1, 1), driven(twin, road, 8.0, -0.1, 2)]
    found = road_from_drives(drives, twin, RoadEstimateSettings(iterations=2, samples=1))
    one = road_from_drives(drives, twin, RoadEstimateSettings(iterations=2, samples=1, lines=False))
    assert found.profiles.heights.shape[1] == 2 and one.profiles.heights.shape[1] == 1
    assert found.profiles.across.size == 2 and np.ptp(found.profiles.across) == pytest.approx(0.2, abs=0.03)
    u, v = road.xy_to_uv(found.profiles.line.x, found.profiles.line.y)
    k = (u > 26.0) & (u < 32.0)

    def error(estimate: RoadEstimate) -> float:
        written, total = surface_of(estimate), 0.0
        for across in found.profiles.across:
            x, y = found.profiles.road().uv_to_xy(
                found.profiles.u, np.full(found.profiles.u.size, 0.5 * found.profiles.track + across)
            )
            own, true = written.heights(x, y), road.heights_uv(u, v + 0.5 * found.profiles.track + across)
            total += float(np.std((own - true)[k]) ** 2)
        return total

    assert error(found) < 0.8 * error(one)
    # The written road has each lane where it was driven.
    at = int(np.argmin(np.abs(u - 28.5)))
    x, y = found.profiles.road().uv_to_xy(
        found.profiles.u[at], 0.5 * found.profiles.track + found.profiles.across
    )
    np.testing.assert_allclose(surface_of(found).heights(x, y), found.profiles.heights[0, :, at], atol=1e-3)


def test_lines_are_held_at_both_sides() -> None:
    line = Centreline([0.0, 20.0], [0.0, 0.0], 0.05)
    heights = np.array([[[0.01] * 401, [0.03] * 401], [[-0.01] * 401, [-0.02] * 401]])
    road = WheelProfiles(line, 1.6, heights, np.array([-0.1, 0.1])).road()
    for v, z in (
        (0.7, 0.01),
        (0.8, 0.02),
        (0.9, 0.03),
        (1.2, 0.03),
        (-0.9, -0.01),
        (-0.7, -0.02),
        (-1.2, -0.01),
    ):
        assert float(road.heights(10.0, v)) == pytest.approx(z, abs=1e-6)


def test_the_coherence_is_one_along_and_falls_across_with_the_adjoint_of_the_prior() -> None:
    n = np.array([0.0, 0.05, 1.0, 4.0])
    matrix = coherence(n, np.array([-0.1, 0.0, 0.1]))
    np.testing.assert_allclose(matrix[0], 1.0, atol=1e-5)
    assert (np.linalg.eigvalsh(matrix) > 0.0).all()
    assert matrix[1, 0, 2] > matrix[2, 0, 2] > matrix[3, 0, 2] and matrix[3, 0, 1] > matrix[3, 0, 2]
    k = np.fft.rfftfreq(300, 0.05)
    rng = np.random.default_rng(1)
    prior = RoadPrior(
        200, 300, 0.05, np.ones((2, k.size)), 1.0 + rng.random((2, 300)), np.array([-0.1, 0.0, 0.1])
    )
    white, heights = rng.standard_normal((2, 3, 300)), rng.standard_normal((2, 3, 200))
    assert np.vdot(prior.heights(white), heights) == pytest.approx(np.vdot(white, prior.back(heights)))
