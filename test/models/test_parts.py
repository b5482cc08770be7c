# SPDX-License-Identifier: Apache-2.0
"""Optional parts of a car: as the effects of their kind, neutral where they do nothing, and links in closed form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_closed_forms import G, with_linear
from test_live import FIELDS, play

from suspension_twin.errors import InputError
from suspension_twin.models.excitation import excitation
from suspension_twin.models.live import LiveTwin
from suspension_twin.models.parts import OPTIONAL_PARTS
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin, save_twin

K = 25000.0
#: Values of parts, by key; those of one effect are changed together.
VALUES = {
    "vehicle.front.friction": 40.0,
    "vehicle.rear.friction": 25.0,
    "vehicle.front.top_mount": 3e5,
    "vehicle.rear.top_mount": 2e5,
    "vehicle.front.anti_roll_bar": 9e3,
    "vehicle.rear.anti_roll_bar": 4e3,
    "vehicle.tyre.damping": 60.0,
    "vehicle.tyre.contact_length": 0.12,
}
EFFECTS = [name for name in OPTIONAL_PARTS if name != "linkage"]


def with_links(twin: Twin, **links: dict[str, float]) -> Twin:
    return twin.with_changes({f"vehicle.{axle}.linkage": own for axle, own in links.items()})


def signals(twin: Twin, way: Any, road: Any) -> np.ndarray:
    r = simulate_twin(twin, excitation(way, twin.vehicle, road))
    return np.c_[r.force, r.rate, r.deflection, r.tyre_force]


@pytest.mark.parametrize("name", EFFECTS)
def test_a_part_is_the_effect_of_its_kind(mondeo: Any, drive: Any, rough: Any, name: str) -> None:
    keys = OPTIONAL_PARTS[name].keys
    effect = EffectSpec(id=name, parameters={p: VALUES[key] for p, key in keys.items()})
    part = mondeo.with_changes({key: VALUES[key] for key in keys.values()})
    given = mondeo.model_copy(update={"effects": (effect,)})
    assert np.array_equal(signals(part, drive(), rough), signals(given, drive(), rough))
    assert not np.array_equal(signals(part, drive(), rough), signals(mondeo, drive(), rough))


@pytest.mark.parametrize("name", [n for n in EFFECTS if n != "top_mount"])
def test_an_effect_is_the_change_beyond_the_part(mondeo: Any, drive: Any, rough: Any, name: str) -> None:
    keys = OPTIONAL_PARTS[name].keys
    half = mondeo.with_changes({key: 0.5 * VALUES[key] for key in keys.values()})
    effect = EffectSpec(id=name, parameters={p: 0.5 * VALUES[key] for p, key in keys.items()})
    both = half.model_copy(update={"effects": (effect,)})
    whole = mondeo.with_changes({key: VALUES[key] for key in keys.values()})
    assert np.array_equal(signals(both, drive(), rough), signals(whole, drive(), rough))


def test_two_mounts_are_in_series(mondeo: Any, drive: Any, rough: Any) -> None:
    part = mondeo.with_changes({f"vehicle.{axle}.top_mount": 4e5 for axle in ("front", "rear")})
    effect = EffectSpec(id="top_mount", parameters={"front_stiffness": 4e5, "rear_stiffness": 4e5})
    whole = mondeo.with_changes({f"vehicle.{axle}.top_mount": 2e5 for axle in ("front", "rear")})
    both = part.model_copy(update={"effects": (effect,)})
    assert signals(both, drive(), rough) == pytest.approx(signals(whole, drive(), rough), abs=1e-9)


def test_parts_of_no_size_change_no_bit(mondeo: Any, drive: Any, rough: Any) -> None:
    nothing = {
        key: 0.0 for part in OPTIONAL_PARTS.values() for key in part.keys.values() if "linkage" not in key
    }
    twin = with_links(mondeo.with_changes(nothing), front={}, rear={})
    assert np.array_equal(signals(twin, drive(), rough), signals(mondeo, drive(), rough))


def test_links_carry_their_share_of_the_load_transfer(mondeo: Any, drive: Any, flat: Any) -> None:
    """Braking at 3 m/s²: the springs move by (1 - s) m h a / (2 L k), the tyres carry what they carry without links."""
    twin = with_linear(mondeo, k=K)
    linked = with_links(twin, front={"braking": 0.4, "driving": 2.0}, rear={"braking": -0.3})
    way = drive(seconds=8.0, speed=30.0, ax=-3.0)
    e = excitation(way, twin.vehicle, flat)
    plain, r = simulate_twin(twin, e), simulate_twin(linked, e)
    v = twin.vehicle
    transfer = v.mass * v.cog[2] * 3.0 / (2 * v.wheelbase)
    rest = simulate_twin(twin, excitation(drive(seconds=0.1), v, flat)).deflection[0]
    moved = r.deflection[-1] - rest
    assert moved[:2] == pytest.approx(0.6 * transfer / K, rel=0.01)
    assert moved[2:] == pytest.approx(-1.3 * transfer / K, rel=0.01)
    assert r.tyre_force[-1] == pytest.approx(plain.tyre_force[-1], abs=1.0)


def test_the_links_of_driving_act_while_the_car_speeds_up(mondeo: Any, drive: Any, flat: Any) -> None:
    twin = with_linear(mondeo, k=K)
    linked = with_links(twin, rear={"braking": 2.0, "driving": 1.0})
    way = drive(seconds=8.0, speed=1.0, ax=3.0)
    r = simulate_twin(linked, excitation(way, twin.vehicle, flat))
    rest = simulate_twin(twin, excitation(drive(seconds=0.1), twin.vehicle, flat)).deflection[0]
    assert r.deflection[-1, 2:] == pytest.approx(rest[2:], abs=2e-4)  # anti-squat of 1: the rear stays
    assert (r.deflection[-1, :2] < rest[:2] - 0.01).all()


def test_roll_centres_take_their_part_of_the_roll(mondeo: Any, drive: Any, flat: Any) -> None:
    """At the height of the centre of gravity they leave the springs no roll; halfway up, half of it."""
    twin = with_linear(mondeo, k=K)
    height = twin.vehicle.cog[2]
    way = drive(seconds=8.0, speed=15.0, yaw_rate=0.2)
    e = excitation(way, twin.vehicle, flat)

    def roll(share: float) -> Any:
        own = {"roll_center": share * height}
        r = simulate_twin(with_links(twin, front=own, rear=own), e)
        spring = (r.deflection[-1, 1] - r.deflection[-1, 0]) + (r.deflection[-1, 3] - r.deflection[-1, 2])
        return spring, r.tyre_force[-1]

    (none, loads), (half, _), (all_of_it, most) = (roll(s) for s in (0.0, 0.5, 1.0))
    assert none > 0.01
    assert half == pytest.approx(0.5 * none, rel=0.01)
    assert abs(all_of_it) < 0.01 * none
    outer = lambda f: f[1] + f[3] - f[0] - f[2]  # noqa: E731
    assert outer(most) == pytest.approx(outer(loads), rel=0.02)


def test_a_wheel_that_moves_back_is_lifted_on_a_climb(mondeo: Any, drive: Any, ground: Any) -> None:
    """On a slope of 5 % the tyre's force along it presses each spring by r slope N / k more."""
    twin = with_linear(mondeo, k=K)
    own = {"recession": 0.2}
    linked = with_links(twin, front=own, rear=own)
    way = drive(seconds=8.0, speed=10.0)
    slope = ground(lambda x, y: 0.05 * np.clip(x - 5.0, 0.0, None))
    plain, r = (simulate_twin(t, excitation(way, t.vehicle, slope)) for t in (twin, linked))
    more = 0.2 * 0.05 * plain.tyre_force[-1] / K
    assert r.deflection[-1] - plain.deflection[-1] == pytest.approx(more, rel=0.05)


def test_a_circle_rolls_higher_over_a_slope_than_a_point(mondeo: Any, drive: Any, ground: Any) -> None:
    """On a slope of 10 % by R slope² / 2, wheels and body alike; on the level not at all."""
    twin = with_linear(mondeo, k=K)
    rolling = twin.with_changes({"vehicle.tyre.rolling_radius": 0.3})
    way = drive(seconds=8.0, speed=10.0)
    slope = ground(lambda x, y: 0.1 * np.clip(x - 10.0, 0.0, None))
    plain, r = (simulate_twin(t, excitation(way, t.vehicle, slope)) for t in (twin, rolling))
    assert r.wheel_z[-1] - plain.wheel_z[-1] == pytest.approx(0.3 * 0.1**2 / 2, rel=0.01)
    assert r.heave[-1] - plain.heave[-1] == pytest.approx(0.3 * 0.1**2 / 2, rel=0.01)
    assert r.heave[50] == pytest.approx(plain.heave[50], abs=1e-9)


def test_links_balance_the_weight(mondeo: Any, drive: Any, rough: Any) -> None:
    """Forces of links are internal: over a long drive the tyres carry the weight, whatever they are."""
    links = {"braking": 0.5, "driving": 0.5, "recession": 0.1, "roll_center": 0.1}
    twin = with_links(with_linear(mondeo, k=K), front=links, rear=links)
    r = simulate_twin(twin, excitation(drive(seconds=30.0), twin.vehicle, rough))
    assert r.tyre_force.sum(axis=1).mean() == pytest.approx(twin.vehicle.mass * G, rel=0.005)


def test_a_file_keeps_its_parts_and_has_no_others(mondeo: Any, tmp_path: Path) -> None:
    twin = with_links(mondeo.with_changes({"vehicle.front.friction": 20.0}), rear={"driving": 0.5})
    save_twin(twin, tmp_path / "twin.yaml")
    assert load_twin(tmp_path / "twin.yaml") == twin
    text = (tmp_path / "twin.yaml").read_text()
    assert text.count("friction") == text.count("linkage") == 1
    assert "anti_roll_bar" not in text


def test_a_model_without_the_part_names_its_key(mondeo: Any, drive: Any, flat: Any) -> None:
    twin = with_links(mondeo, front={"braking": 0.3}).model_copy(update={"model": "msd"})
    with pytest.raises(InputError, match=r"vehicle\.front\.linkage\.braking: the model msd has no such part"):
        simulate_twin(twin, excitation(drive(), twin.vehicle, flat))


@pytest.mark.parametrize(
    ("key", "value", "hint"),
    [("vehicle.front.linkage", {"braking": 40.0}, "per cent"), ("vehicle.tyre.contact_length", 120.0, "mm")],
)
def test_a_value_in_another_unit_is_named(mondeo: Any, key: str, value: object, hint: str) -> None:
    with pytest.raises(InputError, match=hint):
        mondeo.with_changes({key: value})


def test_a_live_twin_has_its_parts(mondeo: Any, drive: Any, rough: Any) -> None:
    links = {"braking": 0.5, "recession": 0.1}
    twin = with_links(mondeo.with_changes({"vehicle.tyre.damping": 50.0}), front=links, rear=links)
    way = drive(seconds=3.0, ax=-1.0)
    whole = simulate_twin(twin, excitation(way, twin.vehicle, rough))
    states = play(LiveTwin(twin, rough), way)
    for field in FIELDS:
        assert np.array_equal(np.array([getattr(s, field) for s in states]), getattr(whole, field)), field
