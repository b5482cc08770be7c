# SPDX-License-Identifier: Apache-2.0
"""Nuisances against the reading that their formula gives of signals known at any time."""

from __future__ import annotations

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.nuisance import (
    NUISANCES,
    OF_A_CALIBRATION,
    OF_A_DRIVE,
    OF_A_RIG,
    OF_A_RUN,
    OF_PLANAR_MOTION,
    NuisancePriors,
    Nuisances,
    map_spread,
    slow_position_error,
)
from suspension_twin.inference.observation import Observation, Usage, observe

CHANNELS = (
    "vertical_acceleration",
    "longitudinal_acceleration",
    "lateral_acceleration",
    "roll_rate",
    "pitch_rate",
    "yaw_rate",
)
FORCES = CHANNELS[:3]
RATE = 100.0
NOTHING = NuisancePriors()
#: A deviation for each, all different.
EVERY = NuisancePriors(
    clock=0.1,
    common_clock=0.2,
    map_position=0.3,
    gain=0.4,
    tilt=0.5,
    force_bias=0.6,
    rate_bias=0.7,
    pivot=0.8,
    slip=0.9,
    mount=1.1,
    drive_map=1.2,
    speed=1.3,
    wander_seconds=2.0,
)


def part_of(
    name: str = "one", seconds: float = 5.0, start: float = 20.0, along: Any = 8.0, channels: Any = CHANNELS
) -> Observation:
    """Measured noise; a vehicle that is ``along`` m/s fast at the seconds since its start."""
    t = start + np.arange(round(seconds * RATE) + 1) / RATE
    rng = np.random.default_rng(t.size)
    speed = along(t - start) if callable(along) else np.full(t.size, along)
    nothing: Any = None
    mask = np.ones(t.size, dtype=bool)
    names = tuple(channels)
    usage = Usage(names, names, NuisancePriors(), np.zeros(t.size, dtype=np.intp))
    measured = {c: rng.standard_normal(t.size) for c in channels}
    return Observation(
        t=t, rate=RATE, bandwidth=20.0, apply=nothing, position=np.cumsum(speed) / RATE, along=speed, mask=mask,
        name=name, excitation=nothing, measured=measured, noise_rms={}, usage=usage,
    )  # fmt: skip


class Waves:
    """Signals (C, L) that are known at any time: slow waves, to which the reading between samples is exact to 1e-3."""

    def __init__(self, channels: int, lanes: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.hertz = rng.uniform(1.0, 4.0, (channels, lanes))
        self.phase = rng.uniform(0.0, 6.0, (channels, lanes))

    def at(self, t: np.ndarray) -> np.ndarray:
        """(r, C, L) at times (r, L)."""
        return np.asarray(np.sin(2 * np.pi * self.hertz * (t[:, None] - 20.0) + self.phase))

    def slope(self, t: np.ndarray) -> np.ndarray:
        """By second, over two samples."""
        return (self.at(t + 1 / RATE) - self.at(t - 1 / RATE)) * RATE / 2

    def bend(self, t: np.ndarray) -> np.ndarray:
        return (self.slope(t + 1 / RATE) - self.slope(t - 1 / RATE)) * RATE / 2


def reading(
    part: Any, channels: tuple[str, ...], waves: Waves, value: dict[str, np.ndarray], rows: np.ndarray
) -> np.ndarray:
    """(r, C, L) what a sensor would deliver with these nuisances, (L,) each, by their documentation."""
    lanes = len(next(iter(value.values())))

    def of(name: str) -> np.ndarray:
        return value.get(name, np.zeros(lanes))

    t, along = part.t[rows, None], part.along[rows, None]
    late = of("clock_offset") + of("one.clock_offset") + of("one.speed") * (t - part.t[0])
    later = t + late + (of("map_position") + of("one.map_position")) / along
    out = waves.at(later)
    slope, where = waves.slope(later), {c: i for i, c in enumerate(channels)}

    def add(channel: str, other: str, by: np.ndarray) -> None:
        if channel in where and other in where:
            out[:, where[channel]] += by * slope[:, where[other]]

    # the point that is still when the body turns is ``pivot`` higher: the sensor sits that much lower below it
    add("longitudinal_acceleration", "pitch_rate", -of("pivot_pitch"))
    add("lateral_acceleration", "roll_rate", of("pivot_roll"))
    # the heading is ahead of the course by the slip of the rear tyres
    add("yaw_rate", "lateral_acceleration", of("rear_slip"))
    if "vertical_acceleration" in where:
        own = where["vertical_acceleration"]
        out[:, own] -= of("mount") * waves.bend(later)[:, own] / (2 * np.pi * 70.0) ** 2
    for channel, c in where.items():
        if channel in FORCES:
            out[:, c] *= 1.0 + of("gain")
        out[:, c] += of(f"one.bias.{channel}")
    if "tilt_roll" in value:
        m = part.measured
        force = np.stack(
            [m["longitudinal_acceleration"], m["lateral_acceleration"], m["vertical_acceleration"]], 1
        )
        force[:, 2] += part.usage.gravity
        rate = np.stack([m["roll_rate"], m["pitch_rate"], m["yaw_rate"]], 1)
        for name, axis in (("tilt_roll", [1.0, 0, 0]), ("tilt_pitch", [0, 1.0, 0])):
            turned = np.concatenate([np.cross(axis, force), np.cross(axis, rate)], axis=1)[rows]
            order = (
                "longitudinal_acceleration",
                "lateral_acceleration",
                "vertical_acceleration",
                *CHANNELS[3:],
            )
            for channel, c in where.items():
                out[:, c] += turned[:, order.index(channel), None] * of(name)
    return out


def rows_of(part: Any, margin: int = 60) -> np.ndarray:
    return np.arange(margin, part.t.size - margin)


def compare(
    nuisances: Nuisances, part: Any, values: dict[str, Any], one_given: bool = False, tolerance: float = 3e-3
) -> None:
    lanes = len(next(iter(values.values())))
    array = np.zeros((len(nuisances), lanes))
    for name, value in values.items():
        array[nuisances.names.index(name)] = value
    waves = Waves(len(nuisances.channels), 1 if one_given else lanes)
    simulated = waves.at(np.repeat(part.t[:, None], 1 if one_given else lanes, axis=1))
    rows = rows_of(part)
    got = nuisances.apply(0, simulated, rows, array)
    wanted = reading(part, nuisances.channels, waves, {k: np.asarray(v) for k, v in values.items()}, rows)
    assert got.shape == (rows.size, len(nuisances.channels), lanes)
    np.testing.assert_allclose(got, wanted, atol=tolerance)


@pytest.fixture(scope="module")
def prepared(pass_case: Any) -> Observation:
    drive = observe(read_drive(pass_case.bag("pass")), pass_case.truth)
    return replace(drive, name="one")


# -- which there are -------------------------------------------------------------------------------


def spreads(
    priors: NuisancePriors, channels: tuple[str, ...] = CHANNELS, wander: float = 0.0
) -> dict[str, float]:
    n = Nuisances([part_of()], [0], channels, replace(priors, tilt=0.0), [wander])
    assert len(n) == len(n.names) == len(set(n.names)) == n.spread.size
    return dict(zip(n.names, n.spread.tolist(), strict=True))


def test_each_nuisance_has_the_spread_of_its_prior() -> None:
    assert spreads(EVERY, wander=0.25) == {
        "map_position": 0.3,
        "clock_offset": 0.2,
        "gain": 0.4,
        "pivot_pitch": 0.8,
        "pivot_roll": 0.8,
        "rear_slip": 0.9,
        "mount": 1.1,
        "one.clock_offset": 0.1,
        "one.speed": 1.3,
        "one.map_position": 1.2,
        **{f"one.bias.{c}": 0.6 if c in FORCES else 0.7 for c in CHANNELS},
        **{f"one.wander.0.{k}": 0.25 for k in range(3)},
    }
    assert spreads(NOTHING) == {}


def test_a_tilt_is_one_about_each_axis_in_the_plane(prepared: Observation) -> None:
    n = Nuisances([prepared], [0], CHANNELS, replace(NOTHING, tilt=0.5), [0.0])
    assert dict(zip(n.names, n.spread.tolist(), strict=True)) == {"tilt_roll": 0.5, "tilt_pitch": 0.5}


@pytest.mark.parametrize(
    "channels, missing",
    [
        (
            ("pitch_rate", "roll_rate", "yaw_rate"),
            {"gain", "mount", "pivot_pitch", "pivot_roll", "rear_slip"},
        ),
        (("vertical_acceleration",), {"pivot_pitch", "pivot_roll", "rear_slip"}),
        (("longitudinal_acceleration", "pitch_rate"), {"mount", "pivot_roll", "rear_slip"}),
        (("lateral_acceleration", "roll_rate"), {"mount", "pivot_pitch", "rear_slip"}),
        (("lateral_acceleration", "yaw_rate"), {"mount", "pivot_pitch", "pivot_roll"}),
        (("longitudinal_acceleration", "roll_rate"), {"mount", "pivot_pitch", "pivot_roll", "rear_slip"}),
    ],
)
def test_what_no_compared_channel_shows_is_left_out(channels: tuple[str, ...], missing: set[str]) -> None:
    shared = {"gain", "mount", "pivot_pitch", "pivot_roll", "rear_slip"}
    found = spreads(EVERY, channels)
    assert shared - set(found) == missing
    assert {n.rpartition(".")[2] for n in found if ".bias." in n} == set(channels)


def test_parts_of_a_drive_share_its_nuisances_and_wander_apart() -> None:
    parts = [part_of("one"), part_of("one", start=40.0, seconds=1.0), part_of("two")]
    n = Nuisances(parts, [0, 0, 1], ("pitch_rate",), EVERY.without(["tilt"]), [0.25, 0.5])
    own = [name for name in n.names if name.startswith(("one.", "two."))]
    kinds = ("clock_offset", "speed", "map_position", "bias.pitch_rate")
    wander = ["one.wander.0.0", "one.wander.0.1", "one.wander.0.2", "one.wander.1.0"]
    wander += [f"two.wander.2.{k}" for k in range(3)]
    assert sorted(own) == sorted([f"{d}.{k}" for d in ("one", "two") for k in kinds] + wander)
    assert (
        n.spread[n.names.index("one.wander.1.0")] == 0.25 and n.spread[n.names.index("two.wander.2.0")] == 0.5
    )
    assert n.clocks == [
        (n.names.index("one.clock_offset"), [0, 1]),
        (n.names.index("two.clock_offset"), [2]),
    ]
    unclocked = Nuisances(parts, [0, 0, 1], ("pitch_rate",), replace(EVERY, clock=0.0, tilt=0.0), [0.0, 0.0])
    assert unclocked.clocks == [] and not any(".wander." in name for name in unclocked.names)


def test_the_second_part_of_a_drive_reads_with_the_nuisances_of_the_drive() -> None:
    parts = [part_of("one"), part_of("one", start=20.0, seconds=3.0)]
    n = Nuisances(parts, [0, 0], CHANNELS, replace(EVERY, tilt=0.0), [0.3])
    rng = np.random.default_rng(0)
    values = 0.05 * rng.standard_normal((len(n), 1))
    waves = Waves(len(CHANNELS), 1)
    value = dict(zip(n.names, values, strict=True))
    rows = rows_of(parts[1])
    # a pass of 3 s has two knots, at its ends
    t = parts[1].t[rows]
    share = (t - t[0] + 0.6) / 3.0
    wander = (1 - share) * value["one.wander.1.0"] + share * value["one.wander.1.1"]
    got = n.apply(1, waves.at(parts[1].t[:, None]), rows, values)
    plain = reading(parts[1], CHANNELS, waves, value, rows)
    late = wander / 8.0
    assert np.abs(late).max() > 1e-3
    shifted = Shifted(waves, late, t)
    np.testing.assert_allclose(got, reading(parts[1], CHANNELS, shifted, value, rows), atol=3e-3)
    assert np.abs(got - plain).max() > 0.02


class Shifted(Waves):
    """Waves that come earlier by as much (r,) as is given at times ``t`` (r,)."""

    def __init__(self, waves: Waves, late: np.ndarray, t: np.ndarray) -> None:
        self.hertz, self.phase = waves.hertz, waves.phase
        self._late, self._count = late[:, None], t.size

    def at(self, t: np.ndarray) -> np.ndarray:
        return super().at(t + self._late)


# -- what they do ----------------------------------------------------------------------------------


def values_of(size: float, seed: int, lanes: int) -> dict[str, np.ndarray]:
    """Of every nuisance that reads between samples or adds to them, about as large as each matters."""
    rng = np.random.default_rng(seed)
    large = {
        "map_position": 0.3,
        "clock_offset": 0.03,
        "gain": 0.3,
        "pivot_pitch": 0.05,
        "pivot_roll": 0.05,
        "rear_slip": 0.02,
        "mount": 40.0,
        "one.clock_offset": 0.03,
        "one.speed": 0.01,
        "one.map_position": 0.2,
        **{f"one.bias.{c}": 0.5 for c in CHANNELS},
    }
    return {k: size * v * rng.uniform(0.5, 1.5, lanes) * rng.choice([-1, 1]) for k, v in large.items()}


@pytest.mark.parametrize("name", sorted(values_of(1.0, 0, 1)))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_each_nuisance_alone(name: str, sign: float) -> None:
    n = Nuisances([part_of()], [0], CHANNELS, replace(EVERY, tilt=0.0), [0.0])
    size = abs(values_of(1.0, 0, 1)[name])
    compare(n, part_of(), {name: sign * size})


@pytest.mark.parametrize("lanes, one_given", [(1, True), (3, False), (3, True)])
@pytest.mark.parametrize("along", [8.0, -8.0, lambda s: 5.0 + s], ids=["on", "back", "faster"])
@pytest.mark.parametrize("alike", [True, False], ids=["alike", "apart"])
def test_all_together_in_all_lanes(lanes: int, one_given: bool, along: Any, alike: bool) -> None:
    part = part_of(along=along)
    n = Nuisances([part], [0], CHANNELS, replace(EVERY, tilt=0.0), [0.0])
    values = values_of(0.7, 1, lanes)
    if alike:
        for name in values:
            if name.endswith(("clock_offset", "speed", "map_position")):
                values[name][:] = values[name][0]
    compare(n, part, values, one_given)


@pytest.mark.parametrize("along", [8.0, lambda s: 5.0 + s], ids=["steady", "faster"])
def test_lanes_of_other_clocks_and_maps_without_levers(along: Any) -> None:
    """The population of a search: a shift for each lane, which at a changing speed changes over the drive."""
    part = part_of(along=along)
    n = Nuisances([part], [0], FORCES, replace(OF_A_CALIBRATION, tilt=0.0), [0.0])
    rng = np.random.default_rng(2)
    values = {
        "map_position": np.array([0.0, 0.3, -0.2, 0.25]),
        "one.clock_offset": 0.05 * rng.standard_normal(4),
        "gain": 0.2 * rng.standard_normal(4),
        "one.bias.lateral_acceleration": rng.standard_normal(4),
    }
    compare(n, part, values)


@pytest.mark.parametrize("channels", [CHANNELS, CHANNELS[::-1], ("yaw_rate", "vertical_acceleration")])
@pytest.mark.parametrize("roll, pitch", [(0.1, 0.0), (0.0, 0.1), (-0.03, 0.07)])
def test_a_small_tilt_turns_force_and_rate(
    prepared: Observation, channels: tuple[str, ...], roll: float, pitch: float
) -> None:
    """About x and y, gravity included: a cross product with what was measured."""
    rng = np.random.default_rng(3)
    measured = {k: v + rng.standard_normal(v.size) for k, v in prepared.measured.items()}
    part = replace(prepared, measured=measured)
    n = Nuisances([part], [0], channels, replace(NOTHING, tilt=0.1), [0.0])
    rows = rows_of(part)
    simulated = rng.standard_normal((part.t.size, len(channels), 1))
    waves: Any = SimpleNamespace(at=lambda t: simulated[rows].copy(), slope=lambda t: 0.0 * simulated[rows])
    waves.bend = waves.slope
    got = n.apply(0, simulated, rows, np.array([[roll], [pitch]]))
    value = {"tilt_roll": np.array([roll]), "tilt_pitch": np.array([pitch])}
    np.testing.assert_allclose(got, reading(part, channels, waves, value, rows), atol=1e-12)


@pytest.mark.parametrize("along", [8.0, -8.0])
@pytest.mark.parametrize("seconds", [1.5, 5.0])
def test_a_wandering_position_is_off_the_way_that_the_vehicle_goes(along: float, seconds: float) -> None:
    """Linear between knots over the pass, at most two seconds apart; one value for a shorter pass. A map's shift is
    along the road instead: backwards it is another."""
    part = part_of(along=along, seconds=seconds)
    n = Nuisances([part], [0], FORCES, replace(NOTHING, map_position=1.0, wander_seconds=2.0), [0.5])
    count = 3 if seconds > 2.0 else 1
    metres = np.array([0.3, -0.4, 0.2])[:count]
    values = np.zeros((len(n), 1))
    values[n.names.index("map_position")] = 0.15
    for k, value in enumerate(metres):
        values[n.names.index(f"one.wander.0.{k}")] = value
    assert len(n) == 1 + count
    rows = rows_of(part, 30)
    knots = part.t[0] + np.arange(count) * seconds / max(count - 1, 1)
    t = part.t[rows]
    off = np.interp(t, knots, metres)
    waves = Waves(3, 1)
    later = t + off / abs(along) + 0.15 / along
    got = n.apply(0, waves.at(part.t[:, None]), rows, values)
    np.testing.assert_allclose(got, waves.at(later[:, None]), atol=3e-3)


def test_a_pass_of_just_one_knot_more() -> None:
    """A knot begins with each full period."""
    for seconds, count in ((1.9, 1), (2.0, 2), (3.9, 2), (4.0, 3)):
        n = Nuisances([part_of(seconds=seconds, start=0.0)], [0], FORCES, EVERY.without(["tilt"]), [0.5])
        assert sum(".wander." in name for name in n.names) == count


def test_a_drive_without_a_position_error_does_not_wander() -> None:
    parts = [part_of("one"), part_of("two")]
    n = Nuisances(parts, [0, 1], FORCES, replace(NOTHING, wander_seconds=60.0), [0.0, 0.3])
    assert n.names == ("two.wander.1.0",)
    signal = Waves(3, 1).at(parts[0].t[:, None])
    rows = rows_of(parts[0])
    np.testing.assert_allclose(n.apply(0, signal, rows, np.array([[0.4]])), signal[rows], atol=1e-12)
    assert np.abs(n.apply(1, signal, rows, np.array([[0.4]])) - signal[rows]).max() > 0.1


@pytest.mark.parametrize("crawling, as_if", [(0.0, 0.5), (0.2, 0.5), (-0.2, -0.5), (0.7, 0.7), (-0.7, -0.7)])
def test_a_vehicle_that_hardly_moves_is_nowhere_far_off_in_time(crawling: float, as_if: float) -> None:
    """Below half a metre a second a place says nothing of a time; standing counts as forwards."""
    signal = Waves(3, 1).at(part_of().t[:, None])
    found = []
    for along in (crawling, as_if):
        part = part_of(along=along)
        n = Nuisances([part], [0], FORCES, replace(NOTHING, map_position=1.0, wander_seconds=60.0), [0.5])
        found.append(n.apply(0, signal, rows_of(part), np.array([[0.02], [0.01]])))
    np.testing.assert_array_equal(*found)
    assert np.abs(found[0] - signal[rows_of(part_of())]).max() > 0.05


@pytest.mark.parametrize("one_given", [True, False])
@pytest.mark.parametrize("late", [0.0, 0.03, np.array([0.0, 0.03])])
def test_only_what_the_road_brings_about_is_shifted(late: Any, one_given: bool) -> None:
    """The response to the motion in the plane stays; gain, bias and lever arms are of the rest, gain apart."""
    part = part_of()
    n = Nuisances([part], [0], FORCES, replace(EVERY, tilt=0.0), [0.0])
    lanes = np.size(late) if np.size(late) > 1 else 2
    road, plane = Waves(3, 1 if one_given else lanes, 4), Waves(3, 1, 5)
    n = n.with_planar_response([plane.at(part.t[:, None])[:, :, 0]])
    values = np.zeros((len(n), lanes))
    values[n.names.index("one.clock_offset")] = late
    values[n.names.index("one.bias.lateral_acceleration")] = 0.2
    rows = rows_of(part)
    repeated = np.repeat(part.t[:, None], 1 if one_given else lanes, axis=1)
    simulated = road.at(repeated) + n.planar_response[0][:, :, None]
    got = n.apply(0, simulated, rows, values)
    wanted = road.at(part.t[rows, None] + values[n.names.index("one.clock_offset")])
    wanted = wanted + n.planar_response[0][rows][:, :, None]
    wanted[:, FORCES.index("lateral_acceleration")] += 0.2
    np.testing.assert_allclose(got, wanted, atol=3e-3)


def test_a_long_drive_is_read_as_its_pieces_are() -> None:
    """Enough values for several threads."""
    part = part_of(seconds=100.0)
    n = Nuisances([part], [0], CHANNELS, replace(EVERY, tilt=0.0), [0.0])
    values = 0.01 * np.random.default_rng(0).standard_normal((len(n), 2))
    signal = np.random.default_rng(1).standard_normal((part.t.size, 6, 2))
    rows = np.arange(part.t.size)
    together = n.apply(0, signal, rows, values)
    pieces = [n.apply(0, signal, r, values) for r in np.array_split(rows, 7)]
    np.testing.assert_array_equal(together, np.concatenate(pieces))


# -- what a solver asks ----------------------------------------------------------------------------


def test_plain_ones_add_the_same_whatever_is_simulated(prepared: Observation) -> None:
    n = Nuisances([prepared], [0], CHANNELS, EVERY, [0.3])
    rng = np.random.default_rng(7)
    rows = rows_of(prepared)
    signals = [rng.standard_normal((prepared.t.size, 6, 1)) for _ in range(2)]
    none = np.zeros((len(n), 1))
    for row, plain in enumerate(n.plain):
        values = none.copy()
        values[row] = 0.01
        added = [n.apply(0, s, rows, values) - n.apply(0, s, rows, none) for s in signals]
        assert np.abs(added[0]).max() > 0.0
        assert np.allclose(*added, atol=1e-9) == plain, n.names[row]
    assert n.plain.dtype == n.one_sided.dtype == np.bool_


def test_steps_are_small_against_the_priors() -> None:
    n = Nuisances([part_of()], [0], CHANNELS, replace(EVERY, tilt=0.0), [0.3])
    share = n.steps / n.spread
    np.testing.assert_allclose(share, share[0])
    assert 1e-6 < share[0] < 1e-2


def test_only_a_mount_is_one_sided() -> None:
    n = Nuisances([part_of()], [0], CHANNELS, replace(EVERY, tilt=0.0), [0.3])
    assert [name for name, one in zip(n.names, n.one_sided, strict=True) if one] == ["mount"]


# -- priors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("key, gone", NUISANCES.items())
def test_what_is_frozen_is_left_out_and_nothing_else(key: str, gone: tuple[str, ...]) -> None:
    given = replace(EVERY, wander=0.4)
    for name in (key, f"nuisances.{key}"):
        left = given.without([name])
        for field in fields(NuisancePriors):
            expected = 0.0 if field.name in gone else getattr(given, field.name)
            assert getattr(left, field.name) == expected
    kept = spreads(given.without([key]), wander=0.4 if key != "wander" else 0.0)
    stem = {"bias": ".bias."}.get(key, key)
    assert not any(stem in name for name in kept if name != "one.map_position")


def test_several_may_be_frozen_and_none() -> None:
    assert EVERY.without([]) == EVERY
    assert EVERY.without(["gain", "nuisances.bias"]) == replace(
        EVERY, gain=0.0, force_bias=0.0, rate_bias=0.0
    )
    with pytest.raises(InputError, match=r"colour.*one of .*nuisances\.gain.*is expected"):
        EVERY.without(["gain", "nuisances.colour"])


def kinds(priors: NuisancePriors, wander: float = 0.0) -> set[str]:
    tilt = {"tilt"} if priors.tilt > 0 else set()
    return tilt | {n.removeprefix("one.").partition(".")[0] for n in spreads(priors, wander=wander)}


def test_a_calibration_has_the_nuisances_of_its_documentation() -> None:
    """Clock, map, gain, tilt and bias; of a controlled run clock and speed; on a rig the clock alone."""
    assert kinds(NOTHING) == set()
    assert kinds(OF_A_CALIBRATION) == {"clock_offset", "map_position", "gain", "tilt", "bias"}
    assert OF_A_CALIBRATION.wander is None
    assert kinds(OF_A_RUN) == {"clock_offset", "speed"}
    assert kinds(OF_A_RIG) == {"clock_offset"}
    assert OF_A_RUN.wander == OF_A_RIG.wander == 0.0
    assert OF_A_RIG.clock < OF_A_RUN.clock < OF_A_CALIBRATION.clock
    assert 0 < OF_A_RUN.speed < 0.1


def test_a_known_road_and_a_calibrated_twin_leave_less() -> None:
    """Clock, map and mount of a drive are known better than before a calibration; the gain is fixed. Without a road
    clock, map and mount are the question, and tyres slip."""
    start = OF_A_CALIBRATION
    assert OF_A_DRIVE.gain == 0.0 and OF_A_DRIVE.speed == 0.0 and OF_A_DRIVE.slip == 0.0
    assert 0 < OF_A_DRIVE.clock < OF_A_DRIVE.common_clock < start.clock
    assert 0 < OF_A_DRIVE.drive_map < OF_A_DRIVE.map_position < start.map_position
    assert 0 < OF_A_DRIVE.tilt < start.tilt and 0 < OF_A_DRIVE.rate_bias <= start.rate_bias
    assert OF_A_DRIVE.force_bias == start.force_bias
    # 6 ms are normal of any recording, three deviations
    assert 3 * OF_A_DRIVE.common_clock == pytest.approx(0.006)
    assert kinds(OF_PLANAR_MOTION) == {"rear_slip", "mount", "bias"}
    assert 0 < 8.0 * OF_PLANAR_MOTION.slip < 0.1  # some degrees in as hard a turn as a car can take
    assert replace(
        OF_A_DRIVE, clock=0.0, common_clock=0.0, map_position=0.0, tilt=0.0, pivot=0.0, drive_map=0.0,
        slip=OF_PLANAR_MOTION.slip,
    ) == OF_PLANAR_MOTION  # fmt: skip


def drives(*sigmas: float) -> list[Any]:
    return [replace(part_of(), position_sigma=s) for s in sigmas]


def test_the_map_is_off_by_a_third_of_a_fix() -> None:
    """The mean over drives that say it, and what a map and a pose agree to at best; else as before any drive."""
    assert map_spread(drives(0.6)) == pytest.approx(0.2)
    assert map_spread(drives(0.6, 1.8)) == pytest.approx(0.4)
    assert map_spread(drives(0.6, 0.0)) == pytest.approx(0.2)
    assert map_spread(drives(0.0)) == map_spread([]) == OF_A_CALIBRATION.map_position
    least = map_spread(drives(1e-6))
    assert map_spread(drives(1e-9)) == least and 0 < least < 0.01
    assert map_spread(drives(3.3 * least)) == pytest.approx(1.1 * least)


def test_half_of_the_error_of_a_fix_averages_out() -> None:
    assert slow_position_error(drives(0.3)[0]) == pytest.approx(0.15)
