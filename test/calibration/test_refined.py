# SPDX-License-Identifier: Apache-2.0
"""Springs refined about the standing car: the same curve, the same stance, and what calibration makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.calibration.labels import parameter_unit
from suspension_twin.calibration.presets import PRESETS, build_space, refined
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.calibration.setup import set_up
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.inference.space import is_fine
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.road import half_sine, write_road
from suspension_twin.road.build import add_bump
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin, save_twin

AXLES = ("front", "rear")
TWINS = Path(__file__).resolve().parents[2] / "config" / "twins"


def force(twin: Twin, axle: str, x: Any) -> Any:
    at, f = (np.r_[0.0, v] for v in getattr(twin.vehicle, axle).spring.points)
    return np.interp(x, at, f)


@pytest.mark.parametrize("name", ["ford_mondeo_mk4", "bmw_320i", "vw_vanagon"])
def test_a_refined_spring_is_the_same_curve(name: str) -> None:
    twin = load_twin(TWINS / f"{name}.yaml")
    fine = refined(twin)
    for axle in AXLES:
        static = twin.axles[axle].static_compression
        assert is_fine(fine.axles[axle])
        assert fine.axles[axle].static_compression == pytest.approx(static, abs=1e-5)
        near = static + np.linspace(-0.07, 0.07, 29)
        assert force(fine, axle, near) == pytest.approx(force(twin, axle, near), rel=0.01)
    assert refined(fine) == fine


def test_points_that_lie_further_out_are_the_same_spring_with_another_free_length(mondeo: Twin) -> None:
    fine, further = refined(mondeo), refined(mondeo, further={"rear": 0.04})
    assert further.vehicle.front == fine.vehicle.front
    x, f = fine.vehicle.rear.spring.points
    assert further.vehicle.rear.spring.points[0] == pytest.approx(x + 0.04)
    assert further.vehicle.rear.spring.points[1] == pytest.approx(f)
    assert further.axles["rear"].static_compression == pytest.approx(
        fine.axles["rear"].static_compression + 0.04, abs=1e-6
    )


@pytest.mark.long
def test_a_spring_far_softer_than_its_file_droops_as_far_as_it_does(mondeo: Twin, tmp_path: Path) -> None:
    """Springs of the file are 2.5 times as stiff: their wheels hang free 7 cm below the standing car, those of the car
    16 and 18 cm. What the drives show below is the spring, and no end of its travel."""
    road = add_bump(iso8608_road("D", 160.0, seed=5, x=4.0, y=2.0, heading=0.3), half_sine(1.0, 0.12), 40.0)
    write_road(road, tmp_path / "road.crg")
    truth = mondeo.model_copy(update={"road": RoadFile(file=tmp_path / "road.crg")})
    stiff = {
        f"vehicle.{a}.spring.force": tuple(2.5 * f for f in truth.axles[a].part.spring.force) for a in AXLES
    }
    save_twin(truth.with_changes(stiff), tmp_path / "twin.yaml")
    for name, seed in (("one", 1), ("two", 2)):
        knots = [(0, 0), (3.2, 0), (6, 4.0), (12, 6.0), (16, 6.0), (18, 0), (19.5, 0)]
        write_drive(synthetic_drive(truth, road, knots, seed=seed, name=name), tmp_path / name)
    request = CalibrationRequest(str(tmp_path / "twin.yaml"), (str(tmp_path / "one"),))
    found = calibrate(request)
    assert sum("free length" in text for text in found.warnings) == 2
    for axle in AXLES:
        here, there = found.twin.axles[axle], truth.axles[axle]
        assert here.static_compression == pytest.approx(there.static_compression, rel=0.25)
        travel = np.linspace(-0.06, 0.03, 10)
        own = force(found.twin, axle, here.static_compression + travel) - here.load
        assert own == pytest.approx(
            force(truth, axle, there.static_compression + travel) - there.load, rel=0.1, abs=40.0
        )
    unseen = read_drive(tmp_path / "two")
    left = simulate_drive(unseen, found.twin, road).gap.rms
    assert left < 1.3 * simulate_drive(unseen, truth, road).gap.rms
    # a stop within the search for the free lengths leaves what was found before it
    stages: list[str] = []
    stopped = calibrate(
        request, lambda p: stages.append(p.stage), lambda: "writing" in stages and stages[-1] != "writing"
    )
    assert stopped.stopped and stopped.estimates and found.cost < stopped.cost < stopped.initial_cost
    assert not any("free length" in text for text in stopped.warnings)


def test_springs_that_are_named_stay_and_other_models_get_no_links(mondeo: Twin) -> None:
    fine = refined(mondeo, ["vehicle.front.spring.force.1"])
    assert fine.vehicle.front.spring == mondeo.vehicle.front.spring
    assert fine.vehicle.rear.spring != mondeo.vehicle.rear.spring
    corner = load_twin(TWINS / "quarter_car.yaml")
    assert "linkage" not in str(refined(corner).vehicle)
    msd = mondeo.model_copy(update={"model": "msd"})
    assert refined(msd).vehicle.front.linkage is None


@given(st.lists(st.floats(-0.7, 0.7), min_size=60, max_size=60))
@settings(max_examples=50, deadline=None)
def test_a_fine_spring_stands_where_it_stood_whatever_its_slopes(changes: list[float]) -> None:
    twin = refined(load_twin(TWINS / "ford_mondeo_mk4.yaml"))
    space = build_space(twin, PRESETS["fast"])
    z = space.z0 + np.array(changes[: len(space)])
    values = space.from_slopes(z)
    found = space.applied(twin, values)
    for axle in AXLES:
        assert found.axles[axle].static_compression == pytest.approx(
            twin.axles[axle].static_compression, abs=1e-6
        )
    again = space.from_slopes(space.to_slopes(values))
    assert again == pytest.approx(values, rel=1e-6, abs=1e-6)


def test_neighbours_of_a_fine_spring_change_together(mondeo: Twin) -> None:
    """The prior of the rate's change over 20 cm is that of two points of the car paper's grid, however fine it is."""
    coarse, fine = (build_space(t, PRESETS["fast"]) for t in (mondeo, refined(mondeo)))

    def correlation(space: Any, first: int, second: int) -> float:
        covariance = space.prior_covariance(0.8)
        a, b = (space.keys.index(f"vehicle.front.spring.force.{i}") for i in (first, second))
        return float(covariance[a, b] / np.sqrt(covariance[a, a] * covariance[b, b]))

    assert correlation(coarse, 1, 2) == pytest.approx(0.8)
    x = fine.curves[0].x
    assert correlation(fine, 0, 5) == pytest.approx(0.8 ** ((x[5] - x[0]) / 0.2))
    assert np.linalg.eigvalsh(fine.prior_covariance(0.8)).min() > 0


def test_parts_have_their_units() -> None:
    units = {
        "vehicle.front.linkage.braking": "",
        "vehicle.tyre.rolling_radius": "m",
        "vehicle.tyre.damping": "N s/m",
    }
    assert {key: parameter_unit(key) for key in units} == units


def test_the_papers_preset_and_named_numbers_stay_as_they_are(rough_case: Any) -> None:
    for preset, free in (("paper", ()), ("fast", ("vehicle.front.spring",))):
        request = CalibrationRequest(rough_case.twin, (rough_case.bag("one"),), preset=preset, free=free)
        setup = set_up(request, lambda _: None, lambda: False)
        assert setup.twin.vehicle.front.linkage is None
        assert len(setup.twin.vehicle.front.spring.force) == 4


@pytest.mark.long
def test_a_car_with_progressive_springs_and_links_is_found_from_straight_ones(
    mondeo: Twin, tmp_path: Path
) -> None:
    """The gap beyond the noise that straight springs without links leave of an unseen drive is more than halved."""
    road = iso8608_road("D", 160.0, seed=5, x=4.0, y=2.0, heading=0.3)
    write_road(road, tmp_path / "road.crg")
    start = mondeo.model_copy(update={"road": RoadFile(file=tmp_path / "road.crg")})
    save_twin(start, tmp_path / "twin.yaml")
    fine = refined(start)
    changes: dict[str, object] = {
        "vehicle.front.linkage": {"braking": 0.4},
        "vehicle.rear.linkage": {"braking": 0.7},
    }
    for axle in AXLES:
        x, f = getattr(fine.vehicle, axle).spring.points
        away = np.clip((x - fine.axles[axle].static_compression) / 0.06, -1, 1)
        slopes = np.diff(f, prepend=0.0) / np.diff(x, prepend=0.0) * (1.0 + 0.35 * away)
        changes[f"vehicle.{axle}.spring.force"] = tuple(np.cumsum(slopes * np.diff(x, prepend=0.0)).tolist())
    truth = fine.with_changes(changes)
    drives = {}
    for name, top, seed in (("one", 7.0, 1), ("two", 5.0, 2), ("three", 8.5, 3)):
        knots = [(0, 0), (3.2, 0), (6, top), (9, 0.5 * top), (12, top), (16, top), (18, 0), (19.5, 0)]
        drives[name] = synthetic_drive(truth, road, knots, seed=seed, name=name)
        write_drive(drives[name], tmp_path / name)
    bags = tuple(str(tmp_path / name) for name in ("one", "two"))
    curves = tuple(f"vehicle.{a}.{part}" for a in AXLES for part in ("spring", "damper_push", "damper_pull"))
    left = {}
    for kind, free in (("straight", curves), ("refined", ())):
        found = calibrate(CalibrationRequest(str(tmp_path / "twin.yaml"), bags, free=free)).twin
        left[kind] = simulate_drive(drives["three"], found, road).gap.rms
    noise = simulate_drive(drives["three"], truth, road).gap.rms
    beyond = {kind: np.sqrt(max(rms**2 - noise**2, 0.0)) for kind, rms in left.items()}
    assert beyond["refined"] < 0.5 * beyond["straight"]
