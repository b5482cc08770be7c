# SPDX-License-Identifier: Apache-2.0
"""Effects of a tracked vehicle: neutral ones change nothing, others what they say; all have a line in the docs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.effects.tracked_effects import (
    TRACKED_EFFECTS,
    Camera,
    apply_tracked,
    camera_of,
    tracked_effect,
)
from suspension_twin.errors import InputError
from suspension_twin.models.tracked import pack_tracked
from suspension_twin.vehicle.tracked import TrackedVehicle, load_tracked


@pytest.fixture(scope="module")
def vehicle(repository: Path) -> TrackedVehicle:
    return load_tracked(repository / "config" / "tracked" / "pt91.yaml")


@pytest.mark.parametrize("name", TRACKED_EFFECTS)
def test_neutral_changes_nothing(name: str, vehicle: TrackedVehicle) -> None:
    for after, before in zip(
        pack_tracked(apply_tracked(vehicle, {name: {}})), pack_tracked(vehicle), strict=True
    ):
        np.testing.assert_allclose(after, before, rtol=1e-12, atol=1e-12)
    assert camera_of({name: {}}) == Camera()


@pytest.mark.parametrize("name", TRACKED_EFFECTS)
def test_an_effect_is_whole(name: str, repository: Path) -> None:
    found = tracked_effect(name)
    assert (
        found.id == name
        and found.doc
        and found.excited_by
        and (found.vehicle is None) != (found.camera is None)
    )
    text = (repository / "docs" / "tracked.md").read_text(encoding="utf-8")
    assert f"`{name}`" in text
    for p in found.parameters:
        assert p.low <= p.neutral <= p.high and p.low <= p.typical <= p.high and p.spread > 0
        assert f"`{p.name}`" in text


def test_each_changes_what_it_says(vehicle: TrackedVehicle) -> None:
    def one(name: str, **values: float) -> TrackedVehicle:
        return apply_tracked(vehicle, {name: values})

    assert one("track_tension", tighter=10.0).idler.setting == -5573.0
    assert one("track_tension", tighter=40.0).idler.setting == -5590.0  # as far as it goes
    worn = one("track_wear", stiffness=0.5, elongation=0.02)
    assert worn.track.stiffness == pytest.approx(1.338e7) and worn.idler.taut_at == -5560.0
    assert one("station_damper", station=2, share=0.0).stations[1].damping == 0.0
    assert one("station_bar", station=6, sag=0.1).stations[5].sag == pytest.approx(0.1)
    loaded = one("payload", mass=4260.0, x=1.1)
    assert loaded.mass == 46860.0
    # half of it on one side, as a lump on the hull: centre and inertia about it, of both parts
    parts = np.array([[vehicle.hull_mass, vehicle.cog[0]], [2130.0, vehicle.cog[0] + 1.1]])
    centre = float(np.average(parts[:, 1], weights=parts[:, 0]))
    inertia = vehicle.hull_mass * vehicle.gyration**2 + float(parts[:, 0] @ (parts[:, 1] - centre) ** 2)
    assert loaded.cog[0] == pytest.approx(centre)
    assert loaded.hull_mass * loaded.gyration**2 == pytest.approx(inertia)


def test_the_camera(vehicle: TrackedVehicle) -> None:
    camera = camera_of(
        {"sensor_scale": {"gain": 1.1}, "sensor_tilt": {"roll": 0.01}, "time_offset": {"seconds": 0.1}}
    )
    assert camera == Camera(1.1, 0.1, 0.01)
    t = np.arange(0, 2, 0.01)
    z, v, a = (np.stack([f(t)], axis=1) for f in (np.sin, np.cos, lambda t: -np.sin(t)))
    seen_z, seen_v, seen_a = camera.see(t, z, v, a, 3.0)
    k = 150
    assert seen_z[k, 0] == pytest.approx(1.1 * (np.sin(1.4) - 0.03 * 1.4), abs=1e-4)
    assert seen_v[k, 0] == pytest.approx(1.1 * (np.cos(1.4) - 0.03), abs=1e-4)
    assert seen_a[k, 0] == pytest.approx(-1.1 * np.sin(1.4), abs=1e-4)


def test_what_is_none_is_named(vehicle: TrackedVehicle) -> None:
    with pytest.raises(InputError, match=r"effects: rust is not an effect"):
        apply_tracked(vehicle, {"rust": {}})
    with pytest.raises(InputError, match=r"effects\.payload\.weight: is not a parameter"):
        apply_tracked(vehicle, {"payload": {"weight": 1.0}})
    with pytest.raises(InputError, match=r"effects\.track_tension\.tighter: must be between -40 and 40 mm"):
        apply_tracked(vehicle, {"track_tension": {"tighter": 90.0}})
    with pytest.raises(InputError, match="must be one of 1 to 6, is 9"):
        apply_tracked(vehicle, {"station_bar": {"station": 9, "sag": 0.1}})
