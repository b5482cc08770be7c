# SPDX-License-Identifier: Apache-2.0
"""What answers are made of: masses, shares of a spectrum, shrink and where a gap lies in frequency."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, lfilter, sosfilt

from suspension_twin.diagnosis import verdict
from suspension_twin.diagnosis.conclude import _message
from suspension_twin.diagnosis.evidence import Blocks, Evidence, weights
from suspension_twin.diagnosis.gates import Gatekeeper
from suspension_twin.diagnosis.hypotheses import Hypothesis
from suspension_twin.diagnosis.localisation import _expected_density, _frequency
from suspension_twin.diagnosis.operating import _corners, _points
from suspension_twin.diagnosis.shrink import RemainingResidual, Shrink, shrink_of
from suspension_twin.diagnosis.verdict import Gates

RATE, CHANNEL = 100.0, "vertical_acceleration"
FOUND, NOTHING = Gates(1.0, 1.0, 1.0), Gates(0.0, 1.0, 1.0)


def bench(lengths: list[int], values: np.ndarray, active: tuple[bool, ...] | None = None) -> Any:
    """What the functions here ask of a bench: drives of ``lengths`` samples end to end, one channel."""
    ends = np.cumsum([0, *lengths])
    stretches = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    measured = SimpleNamespace(
        channels=(CHANNEL,),
        segments=stretches,
        drives=list(range(len(lengths))),
        rate=RATE,
        independent=0.4,
        values=values,
    )
    problem = SimpleNamespace(measured=measured, channels=measured.channels)
    return SimpleNamespace(active=active or (True,) * len(lengths), problem=problem)


# -- masses ----------------------------------------------------------------------------------------


@given(
    st.lists(st.floats(0.01, 1.0), min_size=3, max_size=6),
    st.lists(st.floats(0.0, 1.0), min_size=15, max_size=15),
    st.floats(0.0, 0.2),
)
def test_masses_are_probabilities(weights: list[float], gates: list[float], odds: float) -> None:
    w = np.array(weights) / sum(weights)
    made = [Gates(1.0, gates[0], 1.0), *(Gates(*gates[3 * i : 3 * i + 3]) for i in range(len(w) - 1))]
    gone, unseen, alone = (np.full(w.size - 1, v) for v in (0.5, odds, 0.7))
    effects, no_gap, unknown = verdict.masses(w, made, gone, unseen, alone)
    assert min(effects.min(), no_gap, unknown) >= -1e-12
    assert effects.sum() + no_gap + unknown == pytest.approx(1.0)


def test_what_would_not_have_shown_is_not_ruled_out() -> None:
    weights, gates, none = np.array([1.0, 0.0, 0.0]), [FOUND, NOTHING, NOTHING], np.zeros(2)
    effects, no_gap, unknown = verdict.masses(weights, gates, none, np.array([0.0, 0.5]), none)
    assert effects[0] == 0.0 and effects[1] == pytest.approx(1 / 3) and no_gap == pytest.approx(2 / 3)
    assert unknown == 0.0
    # where an effect was found there is nothing left for those that hide
    certain = np.array([0.0, 1.0, 0.0])
    effects, no_gap, _ = verdict.masses(certain, [FOUND, FOUND, NOTHING], none, np.array([0.0, 0.5]), none)
    assert effects[0] == pytest.approx(1.0) and no_gap == pytest.approx(0.0)


# -- the shape of what is left ---------------------------------------------------------------------


def road_motion(seed: int, samples: int) -> np.ndarray:
    """(n,) something like a body's vertical acceleration on a rough road, m/s²."""
    white = np.random.default_rng(seed).standard_normal(samples)
    return np.asarray(sosfilt(butter(2, [1.0, 12.0], "band", fs=RATE, output="sos"), white))


def resonance(x: np.ndarray, hertz: float, damping: float) -> np.ndarray:
    """(n,) what a lightly damped oscillator makes of ``x``, its rms that of ``x``."""
    radius, angle = np.exp(-2 * np.pi * hertz * damping / RATE), 2 * np.pi * hertz / RATE
    y = lfilter([1.0 - radius], [1.0, -2 * radius * np.cos(angle), radius**2], x)
    return np.asarray(y * np.std(x) / np.std(y))


@pytest.mark.parametrize("seed", range(4))
def test_a_share_of_the_motion_is_even_and_an_order_is_not(seed: int) -> None:
    n = 4000
    motion, own = road_motion(seed, n), road_motion(seed + 100, n)
    noise = {CHANNEL: 0.005}
    order = 0.3 * np.sin(2 * np.pi * 7.0 * np.arange(n) / RATE)
    there = bench([n], motion[:, None])
    left = (0.1 * own)[:, None]
    assert verdict.smooth_spectrum(there, RemainingResidual(left, left), noise) > 0.9
    loud = left + order[:, None]
    assert (
        verdict.smooth_spectrum(bench([n], (motion + order)[:, None]), RemainingResidual(loud, loud), noise)
        < 0.1
    )


@given(st.floats(3.0, 16.0), st.floats(0.02, 0.06), st.integers(0, 1000))
def test_a_resonance_is_located_within_a_sixth_of_an_octave(hertz: float, damping: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    drives = [
        0.3 * resonance(rng.standard_normal(n), hertz, damping) + 0.05 * rng.standard_normal(n)
        for n in (3000, 4500)
    ]
    regions = _frequency(bench([3000, 4500], np.zeros((7500, 1))), drives, 0.01, np.zeros(129))
    assert regions == sorted(regions, key=lambda r: -r["share"])
    main = regions[0]
    assert main["share"] > 0.4 and main["low_hz"] < main["high_hz"]
    assert abs(np.log2(np.sqrt(main["low_hz"] * main["high_hz"]) / hertz)) < 1 / 6


def test_no_band_stands_out_of_a_gap_that_is_everywhere_alike() -> None:
    """Equal energy in every octave: nothing to tell."""
    rng = np.random.default_rng(5)
    spectrum = np.fft.rfft(rng.standard_normal(12_000))
    f = np.fft.rfftfreq(12_000, 1 / RATE)
    pink = np.fft.irfft(spectrum / np.sqrt(np.maximum(f, 0.2)))
    assert (
        sum(
            r["share"] for r in _frequency(bench([12_000], np.zeros((12_000, 1))), [pink], 0.0, np.zeros(129))
        )
        < 0.5
    )


def test_what_a_reference_shows_as_well_is_no_band_of_the_gap() -> None:
    """The model misses a fifth of the motion about 4 Hz always; what is new is at 11 Hz, and smaller."""
    n = [3000, 4500, 4000]
    rng = np.random.default_rng(7)
    motion = [resonance(rng.standard_normal(k), 4.0, 0.1) for k in n]
    left = [0.2 * resonance(rng.standard_normal(k), 4.0, 0.1) for k in n]
    for k, one in zip(n[:2], left[:2], strict=True):
        one += 0.12 * resonance(rng.standard_normal(k), 11.0, 0.04)
    there = bench(n, np.concatenate(motion)[:, None], (True, True, False))
    there.problem.channels = (CHANNEL,)
    usual = _expected_density(there, np.concatenate(left)[:, None], 0)
    band = _frequency(there, left[:2], 0.01, usual)[0]
    assert band["low_hz"] < 11.0 < band["high_hz"]
    # without the reference the larger band is the answer
    alone = bench(n[:2], np.concatenate(motion[:2])[:, None])
    plain = _expected_density(alone, np.concatenate(left[:2])[:, None], 0)
    assert not plain.any()
    band = _frequency(alone, left[:2], 0.01, plain)[0]
    assert band["low_hz"] < 4.0 < band["high_hz"]


# -- what is normal --------------------------------------------------------------------------------


def fitted(hypothesis: Hypothesis, nuisances: dict[str, float], values: dict[str, float]) -> tuple[Any, Any]:
    """A bench and evidence with these nuisances, in spreads, and these parameters of the effects."""
    names = list(nuisances)
    given = SimpleNamespace(names=names, spread=np.full(len(names), 0.002))
    twin = SimpleNamespace(vehicle=SimpleNamespace(mass=1500.0))
    # a drive of 40 s in two parts, a shorter one, and a longer one from before
    ends = ((0.0, 10.0, 0), (25.0, 40.0, 0), (50.0, 75.0, 1), (90.0, 190.0, 2))
    parts = [SimpleNamespace(t=np.array([a, b]), position=np.array([5.0, 95.0])) for a, b, _ in ends]
    problem = SimpleNamespace(nuisances=given, twin=twin, parts=parts, drive_of=[drive for *_, drive in ends])
    there = SimpleNamespace(d=2, q=len(names), problem=problem, active=(True, True, False))
    u = [(values[p.name] - p.typical) / p.spread for _, p in hypothesis.searched]
    x = np.concatenate([np.zeros(2), [0.002 * v for v in nuisances.values()], u])
    return there, SimpleNamespace(fit=SimpleNamespace(hypothesis=hypothesis, x=x), penalty=None)


@pytest.mark.parametrize(("mass", "low", "high"), [(30.0, 0.0, 0.05), (60.0, 0.45, 0.55), (150.0, 0.99, 1.0)])
def test_a_payload_has_to_be_more_than_a_file_is_off_by(mass: float, low: float, high: float) -> None:
    found = fitted(Hypothesis(("payload",)), {}, {"mass": mass, "x": 0.5, "y": 0.0})
    assert low <= verdict.beyond_usual(*found) <= high
    assert verdict.beyond_usual(*fitted(Hypothesis(("tyre_envelope",)), {}, {"length": 0.02})) == 1.0


@pytest.mark.parametrize(
    ("effect", "values", "usual"),
    [
        ("strut_friction", {"front_force": 3.0, "rear_force": 5.0}, True),
        ("strut_friction", {"front_force": 0.0, "rear_force": 40.0}, False),
        ("tyre_damping", {"damping": 25.0}, True),
        ("tyre_damping", {"damping": 300.0}, False),
        ("road_scale", {"scale": -0.012}, True),
        ("road_scale", {"scale": 0.08}, False),
        ("sensor_offset", {"x": 0.01, "y": 0.0, "z": -0.01}, True),
        ("sensor_offset", {"x": 0.0, "y": 0.0, "z": 0.2}, False),
        ("clock_drift", {"drift_ppm": -25.0}, True),
        ("clock_drift", {"drift_ppm": -250.0}, False),
        (
            "progressive_spring",
            {"front_rise": 2e5, "rear_rise": -5e4, "front_square": 1e6, "rear_square": 0.0},
            True,
        ),
        (
            "progressive_spring",
            {"front_rise": 7e4, "rear_rise": 4e3, "front_square": 3e7, "rear_square": 3e7},
            False,
        ),
        ("bump_stop", {"front_clearance": 0.003, "rear_clearance": 0.04, "stiffness": 3.2e3}, True),
        ("rebound_stop", {"front_clearance": 0.03, "rear_clearance": 0.03, "stiffness": 4.0e4}, False),
    ],
)
def test_what_every_car_has_is_no_finding(effect: str, values: dict[str, float], usual: bool) -> None:
    found = fitted(Hypothesis((effect,)), {}, values)
    assert (verdict.beyond_usual(*found) < 0.01) == usual and (verdict.beyond_usual(*found) > 0.99) == (
        not usual
    )
    # where a reference shows the same car, what it had before is in both; a clock is another on every drive
    with_reference = verdict.beyond_usual(*found, changed=True)
    assert with_reference == (verdict.beyond_usual(*found) if effect == "clock_drift" else 1.0)


def test_a_clock_that_is_late_within_what_is_normal_at_either_end_does_not_drift() -> None:
    hypothesis = Hypothesis(("clock_drift",))

    def uncommon(ppm: float, clocks: dict[str, float]) -> float:
        return verdict.beyond_usual(*fitted(hypothesis, clocks, {"drift_ppm": ppm}), changed=True)

    one = {"drive_fast.clock_offset": 0.0, "clock_offset": 0.0}  # 40 s and 2 ms: four of these are 200 ppm
    assert uncommon(-200.0, one) == pytest.approx(0.5)
    assert uncommon(100.0, one) < 0.01 and uncommon(-400.0, one) > 0.99
    both = {**one, "drive_fast.map_position": 0.0}  # and 2 mm at 4.5 m/s
    assert uncommon(100.0 * np.hypot(2.0, 2.0 / 4.5), both) == pytest.approx(0.5)
    assert uncommon(100.0, {}) > 0.99  # where no clock's error is known only its rate tells


def test_what_is_named_in_part_is_shared_with_unknown_by_how_much_is_gone() -> None:
    half = verdict.Gates(1.0, 0.5, 1.0)
    assert verdict.retained_share(half, 0.0) == 0.5 and verdict.retained_share(half, 1.0) == 1.0
    assert verdict.retained_share(half, -0.3) == 0.5
    assert verdict.retained_share(half, 0.8) == pytest.approx(0.5 + 0.5 * 0.64)
    assert verdict.retained_share(half, 0.2, 0.7) == pytest.approx(0.5 + 0.5 * 0.7)


def test_what_is_gone_is_counted_above_what_a_sound_model_leaves() -> None:
    def left(*levels: float) -> Any:
        return SimpleNamespace(
            level=dict(zip([(0, True), (0, False), (1, True), (1, False)], levels, strict=True))
        )

    base = left(6.5, 2.5, 3.5, 1.2)
    assert verdict.explained_share(base, base, [0, 1]) == 0.0
    assert verdict.explained_share(left(1.5, 1.4, 1.0, 1.5), base, [0, 1]) == 1.0
    # of 5 + 1 + 2 beyond what a sound model has, 1 stays
    assert verdict.explained_share(left(2.5, 1.0, 1.0, 1.0), base, [0, 1]) == pytest.approx(1.0 - 1.0 / 8.0)
    # drives from before that are the worse for it count against it, other channels do not count
    assert verdict.explained_share(left(2.5, 5.5, 1.0, 1.0), base, [0, 1]) == pytest.approx(1.0 - 5.0 / 8.0)
    assert verdict.explained_share(left(6.5, 2.5, 1.0, 1.0), base, [0]) == 0.0
    # worse than nothing is nothing; where nothing is beyond, nothing is gone
    assert verdict.explained_share(left(9.0, 9.0, 9.0, 9.0), base, [0, 1]) == 0.0
    assert verdict.explained_share(left(1.0, 1.0, 1.0, 1.0), left(1.4, 1.1, 1.0, 1.0), [0, 1]) == 0.0


def test_a_reference_that_two_vehicles_pull_at_is_disturbed() -> None:
    def told(there: float) -> Any:
        return SimpleNamespace(level={(0, True): 9.0, (0, False): 1.1, (1, True): 9.0, (1, False): there})

    assert verdict.reference_unaffected(told(1.2), [0, 1]) > 0.99
    assert verdict.reference_unaffected(told(2.0), [0, 1]) == pytest.approx(0.5)
    assert verdict.reference_unaffected(told(3.0), [0, 1]) < 0.02
    assert verdict.reference_unaffected(SimpleNamespace(level={(0, True): 9.0}), [0]) == 1.0  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("effects", "no_gap", "unknown", "adequate", "answer"),
    [
        ((0.6, 0.1), 0.2, 0.1, 1.0, "effect"),
        ((0.6, 0.1), 0.2, 0.1, 0.1, "partly"),
        # more than either answer without one, but not than both
        ((0.4, 0.0), 0.35, 0.25, 1.0, "no_gap"),
        ((0.4, 0.0), 0.25, 0.35, 1.0, "unknown"),
        # a little likelier than none is not enough to send somebody to a part, three to two is
        ((0.55, 0.0), 0.05, 0.4, 1.0, "unknown"),
        ((0.62, 0.0), 0.05, 0.33, 1.0, "effect"),
        # whatever else shares the rest: no gap and unknown are what a cause is weighed against
        ((0.45, 0.25), 0.1, 0.15, 1.0, "effect"),
        # one of two, whichever: likelier than that it is neither
        ((0.4, 0.3), 0.1, 0.2, 1.0, "effect"),
        ((0.32, 0.3), 0.33, 0.05, 1.0, "effect"),
    ],
)
def test_without_a_reference_a_cause_is_named_where_it_is_half_as_likely_again_as_none(
    effects: tuple[float, float], no_gap: float, unknown: float, adequate: float, answer: str
) -> None:
    tied = [[0, 1]] if effects[1] == 0.3 else [[0]]
    given = np.array(effects), no_gap, unknown, adequate, 0.5
    assert verdict.verdict_of(*given, tied, False) == answer
    assert verdict.verdict_of(*given, [[]], False) in ("no_gap", "unknown")


@pytest.mark.parametrize(("named", "answer"), [(0.55, "effect"), (0.45, "unknown")])
def test_with_a_reference_a_cause_is_named_where_it_is_likelier_than_none(named: float, answer: str) -> None:
    assert verdict.verdict_of(np.array([named]), 0.05, 0.95 - named, 1.0, 0.5, [[0]], True) == answer


def test_what_gains_many_times_as_much_as_any_other_stands_alone() -> None:
    gains, none = np.full(12, 10.0), np.zeros(2)
    gains[3] = 300.0
    assert verdict.dominance_of(gains, none) == pytest.approx(np.where(np.arange(12) == 3, 0.9, 0.0))
    # a second one that gains nearly as much, or a shape that many things have: neither is what it is for sure
    gains[4] = 250.0
    assert not verdict.dominance_of(gains, none).any()
    gains[4] = 10.0
    assert not verdict.dominance_of(gains, np.array([0.0, 150.0])).any()
    # with few effects to choose from the best of them says little, and losses are no gains
    assert not verdict.dominance_of(gains[:9], none).any()
    assert not verdict.dominance_of(np.full(12, -5.0), none).any()


def test_what_is_gained_on_unseen_road_alone_is_chance() -> None:
    """An effect of nothing, whose held-out blocks happen to do better than the baseline's, gets no weight by it."""
    rng = np.random.default_rng(3)

    def told(gain: float, fitted: float) -> Evidence:
        score = -np.full(30, 50.0) + gain / 30 + rng.normal(0, 1.0, 30)
        return Evidence(None, score, 0.0, {}, np.zeros(1), np.zeros((1, 5)), fitted)  # type: ignore[arg-type]

    base, lucky, true = told(0.0, 0.0), told(235.0, 0.7), told(235.0, 140.0)
    even = np.array([0.5, 0.5])
    assert weights([base, lucky], even, 1.0, 0)[0][1] < 0.9
    assert weights([base, true], even, 1.0, 0)[0][1] > 0.999
    assert weights([base, base], even, 1.0, 0)[0][1] == pytest.approx(0.5)


def test_clocks_that_are_all_at_their_limit_make_up_for_something() -> None:
    def punctual(*own: float) -> float:
        nuisances = {"map_position": 3.0, "clock_offset": -3.0}
        nuisances |= {f"drive_{i}.clock_offset": v for i, v in enumerate(own)}
        return verdict.clocks_within_limits(*fitted(Hypothesis(), nuisances, {}), 1.0)

    assert punctual(3.0, 3.0, -3.0) < 0.05
    assert punctual(-3.0, 0.5, 1.0) > 0.99 and punctual(0.1, 0.2) > 0.99
    assert punctual() == 1.0


# -- corners and operating points ------------------------------------------------------------------


def stretches(samples: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Block (n,) of every sample and 500 draws of blocks."""
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), 500).astype(float)
    return np.arange(samples) * count // samples, drawn


@pytest.mark.parametrize("corner", range(4))
def test_the_corner_whose_motion_the_gap_follows_comes_first(corner: int) -> None:
    rng = np.random.default_rng(corner)
    velocity = rng.standard_normal((6000, 4)) * [0.1, 0.2, 0.3, 0.1]
    amount = (velocity[:, corner] / np.std(velocity[:, corner])) ** 2
    found = _corners(velocity, amount, *stretches(6000))
    names = ("front_left", "front_right", "rear_left", "rear_right")
    assert found[0]["name"] == names[corner] and found[0]["share"] > 0.9
    assert len(found) < 4  # a part that is not sure is left out


def test_an_operating_point_is_where_the_gap_is_and_nowhere_if_it_is_everywhere() -> None:
    rng = np.random.default_rng(3)
    velocity, travel = 0.2 * rng.standard_normal(6000), 0.02 * rng.standard_normal(6000)
    told = [("front damper velocity", velocity, "m/s"), ("front spring travel", travel, "m")]
    noise = rng.standard_normal(6000) ** 2
    points = _points(told, noise + 8.0 * (velocity < -0.3), *stretches(6000))
    assert {p["quantity"] for p in points} == {"front damper velocity"}
    assert points[0]["low"] < -0.3 and points[0]["high"] < -0.15 and points[0]["share"] > 0.3
    wrong = [
        _points(told, np.random.default_rng(s).standard_normal(6000) ** 2, *stretches(6000))
        for s in range(20)
    ]
    assert sum(map(bool, wrong)) <= 4


# -- shrink ----------------------------------------------------------------------------------------


def test_another_drive_is_less_sure_where_drives_differ() -> None:
    rng = np.random.default_rng(1)
    n = 2000
    before = rng.standard_normal((2 * n, 1))
    after = before * np.repeat([0.2, 0.8], n)[:, None]
    blocks = Blocks(np.tile(np.arange(n) // 100, 2), np.zeros(0, dtype=int), n // 100)
    there, args = bench([n, n], before), (blocks, 0.0, 0, 0)
    one = RemainingResidual(before, before), RemainingResidual(after, after)
    same, another = shrink_of(there, *one, *args), shrink_of(there, *one, *args, new_drive=True)
    expected = 1 - np.sqrt(np.mean(after**2) / np.mean(before**2))
    assert same.shrink == another.shrink == pytest.approx(expected)
    assert another.interval[0] < 0.25 and another.interval[1] > 0.75  # it may be like either
    assert same.interval[1] - same.interval[0] < 0.2


@pytest.mark.parametrize("drives", [1, 2, 4])
def test_the_interval_holds_for_one_more_drive(drives: int) -> None:
    """Drives of one car that differ by 15 % in what a twin leaves: nine in ten of further ones lie inside."""
    rng = np.random.default_rng(drives)
    n, held = 600, 0
    blocks = Blocks(np.tile(np.arange(n) // 20, drives), np.zeros(0, dtype=int), n // 20)
    for seed in range(200):
        *there, further = 0.3 * np.exp(0.15 * rng.standard_normal(drives + 1))
        before = rng.standard_normal((drives * n, 1))
        after = np.repeat(there, n)[:, None] * rng.standard_normal((drives * n, 1))
        some = bench([n] * drives, before)
        found = shrink_of(
            some,
            RemainingResidual(before, before),
            RemainingResidual(after, after),
            blocks,
            0.0,
            0,
            seed,
            True,
        )
        held += found.interval[0] <= 1 - further <= found.interval[1]
    assert 0.84 <= held / 200 <= 0.99


def test_a_drive_whose_gap_is_gone_leaves_the_interval_finite() -> None:
    rng = np.random.default_rng(5)
    before = rng.standard_normal((2000, 1))
    after = before * np.repeat([0.3, 1e-9], 1000)[:, None]
    blocks = Blocks(np.tile(np.arange(1000) // 50, 2), np.zeros(0, dtype=int), 20)
    some = bench([1000, 1000], before)
    found = shrink_of(
        some,
        RemainingResidual(before, before),
        RemainingResidual(after, after),
        blocks,
        1e-3,
        0,
        0,
        new_drive=True,
    )
    assert np.isfinite(found.interval).all() and found.interval[0] <= found.shrink <= found.interval[1] <= 1.0


def test_settled_differences_are_compared_where_asked() -> None:
    x = np.random.default_rng(2).standard_normal((1000, 1))
    blocks = Blocks(np.arange(1000) // 50, np.zeros(0, dtype=int), 20)
    before, after = RemainingResidual(x, x), RemainingResidual(x, 0.5 * x)
    args = (bench([1000], x), before, after, blocks, 0.0, 0, 0)
    assert shrink_of(*args).shrink == pytest.approx(0.0)
    assert shrink_of(*args, with_nuisances=True).shrink == pytest.approx(0.5)


def test_how_much_is_left_is_told_with_nuisances_where_they_were_fitted_where_asked() -> None:
    x = np.random.default_rng(3).standard_normal((1000, 1))
    left = RemainingResidual(0.4 * x, 0.1 * x)
    at = bench([1000], x)
    noise = dict.fromkeys(at.problem.measured.channels, 1e-6)
    assert verdict.relative_residual(at, left, noise, list(noise), with_gap=True) == pytest.approx(
        0.4, rel=1e-3
    )
    assert verdict.relative_residual(
        at, left, noise, list(noise), with_gap=True, with_nuisances=True
    ) == pytest.approx(0.1, rel=1e-3)


def test_what_is_gone_counts_from_what_a_sound_model_leaves() -> None:
    assert verdict.explained_level_share(0.3, 0.3) == 0.0
    assert verdict.explained_level_share(0.14, 0.3) == verdict.explained_level_share(0.05, 0.3) == 1.0
    assert verdict.explained_level_share(0.4, 0.3) == 0.0  # what makes it worse takes nothing
    assert verdict.explained_level_share(0.05, 0.13) == 0.0  # there was nothing to take
    assert verdict.explained_level_share(0.22, 0.3) == pytest.approx((0.3**2 - 0.22**2) / (0.3**2 - 0.14**2))


def test_a_cars_own_effect_may_ask_clocks_for_something() -> None:
    """With clocks at nothing a payload seems to spoil what it closes."""
    rng = np.random.default_rng(4)
    noise = 1e-3 * rng.standard_normal((1000, 1))
    x = rng.standard_normal((1000, 1)) + noise
    at, blocks = bench([1000], x), Blocks(np.arange(1000) // 50, np.zeros(0, dtype=int), 20)
    names = at.problem.measured.channels
    base = RemainingResidual(0.3 * x, 0.3 * x)

    def gates(road: bool, after: RemainingResidual) -> tuple[bool, float]:
        nothing: Any = None
        case: Any = SimpleNamespace(excited=road, road=road, driven=names)
        keeper = Gatekeeper(at, blocks, dict.fromkeys(names, 1e-3), None, 1.0, case, 0, nothing, base)
        seen = [keeper.shrink(base, after, 0, way) for way in keeper._nuisance_options(0)]
        return keeper._not_traded(0, seen, 0.0) > 0.5, keeper.level(after)

    spoilt = RemainingResidual(0.4 * x, 0.1 * x)
    assert gates(True, spoilt) == (True, pytest.approx(0.1, rel=1e-2))
    assert gates(False, spoilt) == (
        False,
        pytest.approx(0.4, rel=1e-2),
    )  # planar channels have biases to make up


def test_a_cause_that_shows_without_closing_the_gap_is_not_said_to_shrink_it() -> None:
    document = {"gap": {"rms": 1.0, "channel": "vertical_acceleration"}, "combination": ["road_smoothing"]}

    def told(shrink: float) -> str:
        found = Shrink(before=1.0, after=1.0 - shrink, shrink=shrink, interval=(shrink - 0.1, shrink + 0.1))
        return _message("partly", document, found)

    assert told(0.3) == "partly road smoothing: the gap shrinks by 30 % (20 to 40 %) on held-out data"
    assert "does not shrink the gap (-11 to 9 %)" in told(-0.01)


def test_what_stands_in_takes_little_where_much_is_left() -> None:
    much, little = 0.17, 0.05  # of the motion
    assert verdict.adequate_without_reference(much, 0.01, 0.1) < 0.75 * verdict.adequate_without_reference(
        much, 0.01
    )
    assert (
        verdict.adequate_without_reference(much, 0.01, 0.8)
        > 0.95
        > verdict.adequate_without_reference(much, 0.01)
    )
    assert (
        verdict.adequate_without_reference(little, 0.01, 0.1) > 0.95
    )  # what is so quiet lacks nothing, however it came about
    shares = [verdict.adequate_without_reference(much, 0.01, s) for s in np.linspace(-0.2, 1.1, 40)]
    assert (np.diff(shares) >= 0).all() and min(shares) > 0.0 and max(shares) < 1.0
    # both densities are ones: averaged over what stand-ins take, the odds are those of the level alone
    s = (np.arange(20000) + 0.5) / 20000
    shape = 1.0 / 0.23 - 1.0
    of_a_stand_in = shape * (1.0 - s) ** (shape - 1.0)
    assert np.mean(of_a_stand_in) == pytest.approx(1.0, abs=1e-3)
    assert np.mean(s * of_a_stand_in) == pytest.approx(0.23, abs=1e-3)
    told = verdict.adequate_without_reference(much, 0.01, 0.4)
    odds = told / (1.0 - told)
    alone = verdict.adequate_without_reference(much, 0.01) / (
        1.0 - verdict.adequate_without_reference(much, 0.01)
    )
    assert odds / alone == pytest.approx(1.0 / (shape * 0.6 ** (shape - 1.0)))
