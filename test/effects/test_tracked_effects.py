# SPDX-License-Identifier: Apache-2.0
"""Effects of a tracked vehicle: neutral ones change no bit, others what they say, by closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.effects.registry import EFFECTS, effect
from suspension_twin.errors import InputError
from suspension_twin.models.parameters import lanes, pack
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.models.tracked import ObstacleRun, changed_vehicle, simulate_tracked
from suspension_twin.vehicle.tracked import TrackedVehicle
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin

OF_TRACKED = [name for name, found in EFFECTS.items() if "tracked" in found.models]
SPEED = 13 / 3.6


@pytest.fixture(scope="module")
def twin(repository: Path) -> Twin:
    return load_twin(repository / "config" / "tracked" / "pt91.yaml")


@pytest.fixture(scope="module")
def run() -> ObstacleRun:
    return ObstacleRun(np.arange(0.0, 1.5, 0.02), SPEED)


def given(twin: Twin, name: str, **parameters: float) -> Twin:
    return twin.model_copy(update={"effects": (EffectSpec(id=name, parameters=parameters),)})


def markers(twin: Twin, run: ObstacleRun) -> np.ndarray:
    """(n, 9) displacement, velocity and acceleration of A, B and C."""
    response = simulate_lanes(twin, pack(twin)[:, None], run)
    assert not response.failed.any()
    return response.signals[:, :, 0]


def test_a_tracked_vehicle_has_effects_of_its_own_and_of_cars() -> None:
    own = {"track_tension", "track_wear", "station_damper", "station_bar"}
    shared = {"payload", "sensor_scale", "sensor_tilt", "time_offset", "clock_drift"}
    assert set(OF_TRACKED) == own | shared


@pytest.mark.parametrize("name", OF_TRACKED)
def test_a_neutral_effect_changes_no_bit(name: str, twin: Twin, run: ObstacleRun) -> None:
    assert changed_vehicle(given(twin, name)) == twin.vehicle
    np.testing.assert_array_equal(markers(given(twin, name), run), markers(twin, run))


@pytest.mark.parametrize("name", OF_TRACKED)
def test_parameters_have_bounds_and_priors_that_hold_each_other(name: str) -> None:
    found = effect(name, "tracked")
    assert found.severity and set(found.severity) <= {p.name for p in found.parameters}
    for p in found.parameters:
        assert (
            p.lower <= p.neutral <= p.upper
            and p.lower <= p.prior.typical <= p.upper
            and p.prior.spread > 0
            and p.doc
        )


def test_the_vehicle_with_an_effect_by_closed_forms(twin: Twin) -> None:
    vehicle: TrackedVehicle = twin.vehicle

    def one(name: str, **values: float) -> TrackedVehicle:
        return changed_vehicle(given(twin, name, **values))

    assert one("track_tension", tighter=10.0).idler.setting == -5573.0
    assert one("track_tension", tighter=40.0).idler.setting == -5590.0  # as far as it goes
    worn = one("track_wear", stiffness=0.5, elongation=0.02)
    assert worn.track.stiffness == pytest.approx(1.338e7) and worn.idler.taut_at == -5560.0
    assert worn.track.bending_stiffness == pytest.approx(0.5 * vehicle.track.bending_stiffness)
    assert one("station_damper", station=2, change=-1.0).stations[1].damping == 0.0
    assert one("station_damper", station=6, change=0.5).stations[5].damping == pytest.approx(67635.0)
    assert one("station_bar", station=6, sag=0.1).stations[5].sag == pytest.approx(0.1)
    x = 3.0  # ahead of the rearmost road wheels
    loaded = one("payload", mass=4260.0, x=x)
    assert loaded.mass == 46860.0
    # half of it on one side, as a lump on the hull: centre and inertia about it, of both parts
    places = np.array([vehicle.cog[0], vehicle.stations[-1].x + x])
    masses = np.array([vehicle.hull_mass, 2130.0])
    centre = float(np.average(places, weights=masses))
    inertia = vehicle.hull_mass * vehicle.gyration**2 + float(masses @ (places - centre) ** 2)
    assert loaded.cog[0] == pytest.approx(centre)
    assert loaded.hull_mass * loaded.gyration**2 == pytest.approx(inertia)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("payload", {"mass": 4000.0, "x": 2.5}),
        ("station_bar", {"station": 1.0, "sag": 0.08}),
        ("track_tension", {"tighter": -8.0}),
    ],
)
def test_a_candidate_with_an_effect_is_the_vehicle_so_changed(
    name: str, values: dict[str, float], twin: Twin, run: ObstacleRun
) -> None:
    changed = given(twin, name, **values)
    alone = simulate_tracked(changed_vehicle(changed), SPEED, float(run.t[-1]), rate=50.0)
    key = f"effects.{name}.{effect(name, 'tracked').severity[0]}"
    params = lanes(changed, [key], np.array([[0.0], [values[key.split(".")[2]]]]))
    both = simulate_lanes(changed, params, run)
    np.testing.assert_array_equal(both.signals[:, :3, 1], alone.markers)
    np.testing.assert_array_equal(both.signals[:, 6:, 1], alone.marker_acceleration)
    np.testing.assert_array_equal(both.signals[:, :, 0], markers(twin, run))
    assert np.abs(both.signals[:, :3, 1] - both.signals[:, :3, 0]).max() > 1e-4


def test_the_scale_and_the_tilt_of_a_camera(twin: Twin, run: ObstacleRun) -> None:
    plain = markers(twin, run)
    np.testing.assert_allclose(markers(given(twin, "sensor_scale", scale=0.1), run), 1.1 * plain)
    turned = markers(given(twin, "sensor_tilt", pitch=0.01), run)
    travelled = np.sin(0.01) * SPEED * run.t
    np.testing.assert_allclose(turned[:, :3] - plain[:, :3], np.outer(travelled, np.ones(3)), atol=1e-12)
    np.testing.assert_allclose(turned[:, 3:6] - plain[:, 3:6], np.sin(0.01) * SPEED, atol=1e-12)
    np.testing.assert_array_equal(turned[:, 6:], plain[:, 6:])


@pytest.mark.parametrize(
    ("name", "values", "offset", "drift"),
    [("time_offset", {"offset": 0.1}, 0.1, 0.0), ("clock_drift", {"drift_ppm": 2e4}, 0.0, 0.02)],
)
def test_what_is_stamped_t_happened_earlier(
    name: str, values: dict[str, float], offset: float, drift: float, twin: Twin, run: ObstacleRun
) -> None:
    plain, late = markers(twin, run), markers(given(twin, name, **values), run)
    k = 60
    at = run.t[k] - offset - drift * run.t[k]
    assert late[k] == pytest.approx([np.interp(at, run.t, c) for c in plain.T], rel=1e-12, abs=1e-12)
    assert np.abs(late[k] - plain[k]).max() > 1e-3


def test_what_cannot_be_is_named(twin: Twin, run: ObstacleRun) -> None:
    cases = {
        ("rust", ""): "effects: there is no effect rust",
        ("strut_friction", ""): "effects: strut_friction is not an effect of the model tracked",
        ("payload", "weight"): r"effects\.payload\.weight: is not a parameter of it: mass, x",
        (
            "track_tension",
            "tighter",
        ): r"effects\.track_tension\.tighter: must be between -40 and 40 mm, is 90",
        ("station_bar", "station"): r"effects\.station_bar\.station: must be one of 1, 2, .*, is 90",
    }
    for (name, parameter), words in cases.items():
        with pytest.raises(InputError, match=words):
            changed_vehicle(given(twin, name, **({parameter: 90.0} if parameter else {})))
    ninth = given(twin, "station_bar", station=9.0, sag=0.1)  # of six
    with pytest.raises(InputError, match="there can be no such vehicle"):
        changed_vehicle(ninth)
    assert simulate_lanes(ninth, pack(ninth)[:, None], run).failed.all()
