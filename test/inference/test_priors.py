# SPDX-License-Identifier: Apache-2.0
"""Priors of parameters: their bounds, and what they have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError
from suspension_twin.inference.priors import PRIORS, TABLES, TwinPrior, prior_of
from suspension_twin.models.parameters import twin_value
from suspension_twin.models.parts import OPTIONAL_PARTS
from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.tracked import BOUNDS
from suspension_twin.vehicle.twin import Linkage, Twin, load_twin

OPTIONAL = tuple(key for part in OPTIONAL_PARTS.values() for key in part.keys.values())
#: Parts that a car may have none of, and links, which may be of either sign.
PARTS = {
    "vehicle.tyre.damping",
    "quarter_car:vehicle.tyre.damping",
    "vehicle.tyre.contact_length",
    "vehicle.tyre.rolling_radius",
    *(f"vehicle.{axle}.friction" for axle in AXLES),
    *(f"vehicle.{axle}.linkage.{name}" for axle in AXLES for name in Linkage.model_fields),
}
#: Coordinates, which may be of either sign or count from anywhere: all others are positive.
PLACES = PARTS | {
    "imu.latency",
    "vehicle.cog.0",
    "vehicle.cog.1",
    "vehicle.idler.setting",
    "vehicle.idler.taut_at",
    *(f"imu.position.{i}" for i in range(3)),
}


def made(
    scale: Literal["linear", "log"], reach: float, bounds: tuple[float, float] | None = None
) -> TwinPrior:
    return TwinPrior(
        keys=("vehicle.x",), unit="", source="a test", scale=scale, reach=reach, spread=0.1, bounds=bounds
    )


@settings(max_examples=30)
@given(st.floats(1e-3, 1e6), st.floats(1.01, 10.0))
def test_bounds_of_a_positive_number_are_a_factor_apart(nominal: float, reach: float) -> None:
    low, high = made("log", reach).around(nominal)
    assert 0 < low < nominal < high
    assert nominal / low == pytest.approx(reach) and high / nominal == pytest.approx(reach)


@settings(max_examples=30)
@given(st.floats(-1e3, 1e3), st.floats(0.01, 10.0))
def test_bounds_of_a_place_are_a_distance_apart(nominal: float, reach: float) -> None:
    low, high = made("linear", reach).around(nominal)
    assert low < nominal < high
    assert nominal - low == pytest.approx(reach) and high - nominal == pytest.approx(reach)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_bounds_that_are_given_are_used_as_they_are(scale: Literal["linear", "log"]) -> None:
    assert made(scale, 2.0, (3.0, 7.0)).around(5.0) == (3.0, 7.0)
    assert made(scale, 2.0, (3.0, 7.0)).around(99.0) == (3.0, 7.0)


@pytest.mark.parametrize("key", BOUNDS)
def test_of_a_track_bounds_are_those_of_the_paper_and_a_deviation_15_percent_of_them(key: str) -> None:
    prior = prior_of(f"vehicle.{key}")
    assert prior is not None
    low, high = prior.around(1.0)
    assert (low, high) == BOUNDS[key]
    if low > 0:
        assert prior.scale == "log" and prior.spread == pytest.approx(0.15 * (np.log(high) - np.log(low)))
    else:
        assert prior.scale == "linear" and prior.spread == pytest.approx(0.15 * (high - low))


@pytest.mark.parametrize("key", PRIORS)
def test_positive_quantities_have_theirs_in_the_logarithm(key: str) -> None:
    assert (PRIORS[key].scale == "log") == (key not in PLACES)


@pytest.mark.parametrize("key", PRIORS)
def test_bounds_leave_three_deviations_to_either_side(key: str) -> None:
    prior = PRIORS[key]
    low, high = prior.around(1.0)
    width = np.log(high / low) if prior.scale == "log" else high - low
    assert 0 < 6 * prior.spread <= width


def test_what_is_alike_has_priors_alike() -> None:
    """Places on three axes are measured with one tape; wheels in front and at the rear are of one kind."""
    assert PRIORS["imu.position.0"] == PRIORS["imu.position.1"] == PRIORS["imu.position.2"]
    assert PRIORS["vehicle.front.unsprung_mass"] == PRIORS["vehicle.rear.unsprung_mass"]
    assert PRIORS["vehicle.unsprung_mass"] == PRIORS["vehicle.front.unsprung_mass"]
    assert PRIORS["vehicle.sprung_inertia.roll"] == PRIORS["vehicle.sprung_inertia.pitch"]


def test_a_weighbridge_tells_more_than_a_guess() -> None:
    """What is weighed has the least deviation and the closest bounds; an inertia is rarely measured."""
    mass, wheel, inertia = (
        PRIORS[f"vehicle.{k}"] for k in ("mass", "front.unsprung_mass", "sprung_inertia.pitch")
    )
    assert mass.spread < wheel.spread < inertia.spread
    # a car stands on the weighbridge, a corner with all that moves with it does not
    assert mass.spread < PRIORS["vehicle.sprung_mass"].spread
    assert mass.reach < wheel.reach
    # a car is as heavy to the left as to the right, more nearly than in front and at the rear
    assert PRIORS["vehicle.cog.1"].spread < PRIORS["vehicle.cog.0"].spread
    assert PRIORS["vehicle.cog.1"].reach < PRIORS["vehicle.cog.0"].reach


def test_a_key_is_found_by_itself_or_by_its_pattern() -> None:
    assert prior_of("vehicle.mass") is PRIORS["vehicle.mass"]
    assert prior_of("imu.position.2") is PRIORS["imu.position.2"]
    for number in (0, 3, 12):
        assert prior_of(f"vehicle.stations.{number}.damping") is PRIORS["vehicle.stations.*.damping"]
    rigs = prior_of("vehicle.tyre.damping", "quarter_car")
    assert (
        rigs is PRIORS["quarter_car:vehicle.tyre.damping"] is not prior_of("vehicle.tyre.damping", "full_car")
    )
    for key in ("vehicle.stations.x.damping", "vehicle.wheelbase", "vehicle.front.spring.force.0", ""):
        assert prior_of(key) is None


def has(twin: Twin, key: str) -> bool:
    try:
        return twin_value(twin, key.rpartition(":")[2].replace("*", "0")) is not None
    except InputError:
        return False


def test_free_by_default_is_what_a_vehicle_without_characteristics_has(repository: Path) -> None:
    tracked = load_twin(repository / "config" / "tracked" / "pt91.yaml")
    car, corner = (
        load_twin(repository / "config" / "twins" / f"{name}.yaml")
        for name in ("ford_mondeo_mk4", "quarter_car")
    )
    parts = {key: 1e5 if key.endswith(("bar", "mount")) else 0.1 for key in OPTIONAL if "linkage" not in key}
    corner = corner.with_changes({"vehicle.tyre.damping": 0.1})
    car = car.with_changes({**parts, **{f"vehicle.{axle}.linkage": {} for axle in AXLES}})
    for key, prior in PRIORS.items():
        if prior.free:
            assert not has(car, key) and not has(corner, key), key
            assert has(tracked, key) or key == "vehicle.driver.gain", key  # nobody drives this one
        else:
            assert has(car, key) or has(corner, key), key


@pytest.mark.parametrize("name", ["twins/ford_mondeo_mk4", "twins/quarter_car", "tracked/pt91"])
def test_values_of_known_vehicles_are_within_bounds(name: str, repository: Path) -> None:
    twin = load_twin(repository / "config" / f"{name}.yaml")
    keys = [key.replace("*", "1") for key in PRIORS if ":" not in key and has(twin, key)]
    assert len(keys) >= 5
    for key in keys:
        prior, value = prior_of(key), float(twin_value(twin, key))
        assert prior is not None
        low, high = prior.around(value)
        assert low < value < high, key


def test_every_prior_and_table_has_its_source_and_what_has_a_unit_has_one() -> None:
    priors = (*PRIORS.values(), TABLES.point, *TABLES.whole.values(), TABLES.unlisted)
    assert all(
        p.source for p in (*priors, *TABLES.nuisances.values(), *TABLES.table_2.values(), TABLES.damping)
    )
    for key in ("vehicle.mass", "vehicle.cog.2", "imu.position.0", *(f"vehicle.{k}" for k in BOUNDS)):
        assert PRIORS[key].unit, key
    assert prior_of("vehicle.mass").about("vehicle.mass", 1500.0).unit == "kg"  # type: ignore[union-attr]


@pytest.mark.parametrize("part", ["spring", "damper_push", "damper_pull"])
def test_the_points_of_table_2_rise_and_their_bounds_do_not_overlap(part: str) -> None:
    points = TABLES.table_2[part]
    assert len(points.x) == len(points.bounds) and list(points.x) == sorted(points.x)
    ends = [end for pair in points.bounds for end in pair]
    assert ends == sorted(ends)
