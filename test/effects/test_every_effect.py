# SPDX-License-Identifier: Apache-2.0
"""What holds for every effect: neutral is nothing, full is something, the file keeps it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from effect_cases import given, respond, rough, way

from suspension_twin.effects.base import Effect
from suspension_twin.effects.registry import EFFECTS, effect
from suspension_twin.errors import InputError
from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

#: Parameters other than the prior's that make an effect visible on the tests' road.
VISIBLE = {
    "bump_stop": {"front_clearance": 0.004, "rear_clearance": 0.004},
    "rebound_stop": {"front_clearance": 0.004, "rear_clearance": 0.004},
    "sensor_clipping": {"range": 11.0},
    "clock_drift": {"drift_ppm": 5000.0},
    "damper_fade": {"time_constant": 3.0},
    "spring_sag": {"front": 0.03, "rate": 4.0},
}


def full(e: Effect) -> dict[str, float]:
    """Every parameter at its typical value, severities away from neutral."""
    values = {p.name: p.prior.typical for p in e.parameters}
    for name in e.severity:
        p = e.parameter(name)
        values[name] = p.prior.typical if p.prior.typical != p.neutral else p.neutral + p.prior.spread
    return values | VISIBLE.get(e.id, {})


def model_of(e: Effect, twin: Twin) -> Twin:
    return twin if "full_car" in e.hook.models else twin.model_copy(update={"model": e.hook.models[0]})


#: Effects of cars; those of a tracked vehicle alone have tests of their own.
CAR_EFFECTS = [name for name, e in EFFECTS.items() if set(e.hook.models) & {"full_car", "msd"}]


@pytest.mark.parametrize("name", CAR_EFFECTS)
def test_neutral_is_bit_identical(twin: Twin, name: str) -> None:
    base = model_of(EFFECTS[name], twin)
    neutral = {p.name: p.prior.typical for p in EFFECTS[name].parameters}
    neutral |= {s: EFFECTS[name].parameter(s).neutral for s in EFFECTS[name].severity}
    plain, same = respond(base), respond(given(base, **{name: neutral}))
    for field in (
        "force",
        "rate",
        "heave",
        "roll",
        "pitch",
        "wheel_z",
        "tyre_force",
        "vertical_acceleration",
    ):
        assert np.array_equal(getattr(plain, field), getattr(same, field)), field


@pytest.mark.parametrize("name", CAR_EFFECTS)
def test_full_moves_what_the_sensor_reads(twin: Twin, name: str) -> None:
    base = model_of(EFFECTS[name], twin)
    plain, other = respond(base), respond(given(base, **{name: full(EFFECTS[name])}))
    change = np.hypot(np.std(plain.force - other.force), 9.81 * np.std(plain.rate - other.rate))
    assert change > 1e-3
    for field in ("force", "rate", "vertical_acceleration"):
        assert np.isfinite(getattr(other, field)).all()


@pytest.mark.parametrize("name", CAR_EFFECTS)
def test_lanes_beside_an_effect_stay_as_they_are(twin: Twin, name: str) -> None:
    """One lane with the effect among lanes without it: neither knows of the other."""
    e = EFFECTS[name]
    base = model_of(e, twin)
    road = excitation(way(2.0), base.vehicle, type("Ground", (), {"heights": staticmethod(rough)})())
    keys = [f"effects.{name}.{p.name}" for p in e.parameters]
    neutral = [p.neutral for p in e.parameters]
    values = np.array([neutral, [full(e)[p.name] for p in e.parameters], neutral])
    armed = given(base, **{name: {}})
    mixed = simulate_lanes(armed, lanes(armed, keys, values), road)
    alone = simulate_lanes(armed, lanes(armed, keys, values[1:2]), road)
    plain = simulate_lanes(base, lanes(base, [], np.zeros((1, 0))), road)
    assert not mixed.failed.any()
    for field in ("force", "rate", "vertical_acceleration"):
        a, b, c = (getattr(r, field) for r in (mixed, alone, plain))
        assert np.array_equal(a[..., 0], c[..., 0]) and np.array_equal(a[..., 2], c[..., 0]), field
        assert np.array_equal(a[..., 1], b[..., 0]), field


@pytest.mark.parametrize("name", CAR_EFFECTS)
def test_an_impossible_candidate_fails_alone(twin: Twin, name: str) -> None:
    """Parameters that no car has, in lanes beside a sound one: theirs fail or stay finite, none stops anything."""
    e = EFFECTS[name]
    base = model_of(e, twin)
    road = excitation(way(0.2), base.vehicle, type("Ground", (), {"heights": staticmethod(rough)})())
    keys = [f"effects.{name}.{p.name}" for p in e.parameters]
    sound = [full(e)[p.name] for p in e.parameters]
    odd = [[value] * len(keys) for value in (1e300, 1e150, 1e20, 1e12, -1e12, -1e300, np.inf, np.nan)]
    odd += [
        [value if i == k else s for i, s in enumerate(sound)]
        for value in (1e300, -1e9)
        for k in range(len(keys))
    ]
    armed = given(base, **{name: {}})
    mixed = simulate_lanes(armed, lanes(armed, keys, np.array([sound, *odd, sound])), road)
    alone = simulate_lanes(armed, lanes(armed, keys, np.array([sound])), road)
    assert not mixed.failed[0] and not mixed.failed[-1]
    assert mixed.failed[7:9].all()  # what is no number at all
    for field in ("force", "rate", "vertical_acceleration"):
        a, b = getattr(mixed, field), getattr(alone, field)
        assert np.array_equal(a[..., 0], b[..., 0]) and np.array_equal(a[..., -1], b[..., 0]), field
        assert np.isfinite(a).all(), field


def test_a_candidate_beside_the_road_fails_alone(twin: Twin) -> None:
    """Its neighbours stay as they are; one twin alone is refused: the road has no height there."""

    def edge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(np.abs(y) < 1.2, rough(x, y), np.nan)

    road = excitation(way(0.5), twin.vehicle, type("Ground", (), {"heights": staticmethod(edge)})())
    armed = given(twin, lateral_offset={})
    run = simulate_lanes(
        armed, lanes(armed, ["effects.lateral_offset.offset"], np.array([[0.0], [0.8], [0.1]])), road
    )
    assert run.failed.tolist() == [False, True, False] and np.isfinite(run.force).all()
    alone = simulate_lanes(armed, lanes(armed, ["effects.lateral_offset.offset"], np.array([[0.1]])), road)
    assert np.array_equal(run.force[..., 2], alone.force[..., 0])
    with pytest.raises(InputError, match="road: has no height everywhere"):
        respond(given(twin, lateral_offset={"offset": 0.8}), edge, way(0.5))


@pytest.mark.parametrize(
    ("effect", "name", "values"),
    [
        ("lateral_offset", "offset", (0.0, 0.1, 0.1, 0.3, 0.0)),
        ("time_offset", "offset", (0.0, 0.02, 0.02, -0.01, 0.0)),
        ("tyre_envelope", "length", (0.2, 0.2, 0.2, 0.2, 0.2)),
        ("sensor_bandwidth", "cutoff", (9.0, 9.0, 0.0, 30.0, 30.0)),
    ],
)
def test_candidates_that_see_the_same_are_as_alone(
    twin: Twin, effect: str, name: str, values: tuple[float, ...]
) -> None:
    """What lanes have in common is made once; in blocks that share all of it, and in those that share some."""
    road = excitation(way(0.5), twin.vehicle, type("Ground", (), {"heights": staticmethod(rough)})())
    armed = given(twin, **{effect: {}})
    key = f"effects.{effect}.{name}"
    for repeat in (1, 4):
        many = np.repeat(np.array(values), repeat)[:, None]
        run = simulate_lanes(armed, lanes(armed, [key], many), road)
        for lane, value in enumerate(many[:, 0]):
            alone = simulate_lanes(armed, lanes(armed, [key], np.array([[value]])), road)
            assert np.array_equal(run.force[..., lane], alone.force[..., 0]), (lane, value)
            assert np.array_equal(run.rate[..., lane], alone.rate[..., 0])


@pytest.mark.parametrize("name", CAR_EFFECTS)
def test_a_twin_file_keeps_it(twin: Twin, name: str, tmp_path: Path) -> None:
    saved = given(model_of(EFFECTS[name], twin), **{name: full(EFFECTS[name])})
    save_twin(saved, tmp_path / "twin.yaml")
    assert load_twin(tmp_path / "twin.yaml") == saved


@pytest.mark.parametrize("name", CAR_EFFECTS)
def test_its_description_is_whole(name: str) -> None:
    e = EFFECTS[name]
    assert e.id == name and e.title and len(e.doc) > 40 and e.excited_by and e.confused_with
    assert 1 <= len(e.parameters) <= 5 and e.severity
    assert list(e.hook.neutral) == [p.name for p in e.parameters]
    for p in e.parameters:
        assert p.lower < p.upper and p.doc and p.prior.spread > 0 and (p.prior.typical > 0 or not p.prior.log)
        assert p.lower <= p.prior.typical <= p.upper
        assert e.hook.neutral[p.name] == p.neutral
    assert all(s in e.hook.neutral for s in e.severity)


def test_all_effects_of_the_full_car_at_once_stay_finite(twin: Twin) -> None:
    every = {n: full(e) for n, e in EFFECTS.items() if "full_car" in e.hook.models}
    assert np.isfinite(respond(given(twin, **every)).force).all()


def test_what_is_wrong_is_named() -> None:
    with pytest.raises(InputError, match="ghost is not an effect"):
        effect("ghost")
    with pytest.raises(InputError, match=r"effects\.payload\.weight.*mass, x, y"):
        EFFECTS["payload"].values({"weight": 3.0})
    with pytest.raises(InputError, match=r"effects\.payload\.mass.*between 0 and 1500 kg, is -5"):
        EFFECTS["payload"].values({"mass": -5.0})
    with pytest.raises(InputError, match=r"corner_damper\.corner.*one of 0, 1, 2, 3"):
        EFFECTS["corner_damper"].values({"corner": 1.5})


def test_a_twin_file_with_a_wrong_parameter_is_refused(twin: Twin) -> None:
    with pytest.raises(InputError, match=r"effects\.sensor_scale\.scale.*between -0\.6 and 1, is 7"):
        respond(given(twin, sensor_scale={"scale": 7.0}))
    with pytest.raises(InputError, match="unsprung_mass is not an effect of the model full_car"):
        respond(given(twin, unsprung_mass={"mass": 40.0}))
