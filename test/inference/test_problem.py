# SPDX-License-Identifier: Apache-2.0
"""Trimming, nuisances, alignment and the problem that the searches see."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from suspension_twin.calibration.presets import refined
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.searches import costs_of, synchronised
from suspension_twin.calibration.setup import Setup, problem_of, set_up
from suspension_twin.calibration.squares import moved
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.excited_segments import TrimSettings, excited, fit_rows, trim
from suspension_twin.inference.noise import Whitener, autoregression
from suspension_twin.inference.nuisance import OF_A_CALIBRATION, NuisancePriors, Nuisances
from suspension_twin.inference.objectives import Measured, Objective, Term
from suspension_twin.inference.observation import Observation, observe
from suspension_twin.inference.problem import Data, Interrupted, Problem, segments_of
from suspension_twin.inference.spring_position import slides, standing_at
from suspension_twin.models.parameters import twin_value
from suspension_twin.signals.coarse_alignment import coarse_lag


@pytest.fixture(scope="module")
def prepared(pass_case: Any) -> Observation:
    return observe(read_drive(pass_case.bag("pass")), pass_case.truth)


@pytest.fixture(scope="module")
def setup(rough_case: Any) -> Setup:
    bags = (rough_case.bag("one"), rough_case.bag("two"))
    return set_up(CalibrationRequest(rough_case.twin, bags), lambda note: None, lambda: False)


@pytest.fixture(scope="module")
def problem(setup: Setup) -> Problem:
    return setup.problem


@pytest.fixture(scope="module")
def objective(setup: Setup) -> Objective:
    return setup.objective


# -- trimming --------------------------------------------------------------------------------------


def test_what_the_bump_excites_is_kept_and_the_rest_is_not(prepared: Observation) -> None:
    active = excited(prepared, TrimSettings())
    when = prepared.t[active] - prepared.t[0]
    # the front wheels reach the bump after (14 - 5 - 2.85) m at 4.2 m/s; half a second before that is kept, and
    # half the window that the motion is judged by
    assert when.min() == pytest.approx(1.46 - 0.75, abs=0.1)
    assert 4.0 < when.max() < 6.0
    still = replace(prepared, measured={k: 0 * v for k, v in prepared.measured.items()})
    assert not excited(still, TrimSettings()).any() and trim(still, TrimSettings()) == []


def test_a_long_drive_is_cut_to_its_passes(prepared: Observation) -> None:
    """One bump within a minute of calm: two passes, and calm that nobody needs to simulate."""
    rate = prepared.rate
    calm = {k: np.zeros(int(40 * rate)) for k in prepared.measured}
    m = prepared.t.size
    long = {k: np.concatenate([v, calm[k], v]) for k, v in prepared.measured.items()}
    count = 2 * m + int(40 * rate)
    grid = prepared.t[0] + np.arange(count) / rate

    class Stub:
        """As much of an observation as trimming looks at."""

        measured, t, noise_rms = long, grid, prepared.noise_rms
        speed, mask = np.full(count, 4.2), np.ones(count, dtype=bool)
        cuts: list[tuple[float, float]] = []  # noqa: RUF012

        def part(self, start: float, end: float) -> Any:
            self.cuts.append((start - grid[0], end - grid[0]))
            return self

    stub = Stub()
    stub.rate = rate  # type: ignore[attr-defined]
    trim(stub, TrimSettings())  # type: ignore[arg-type]
    assert len(stub.cuts) == 2
    assert sum(b - a for a, b in stub.cuts) < 18.0


def test_nothing_is_compared_while_a_start_from_rest_is_forgotten(prepared: Observation) -> None:
    part = prepared.part(prepared.t[0] + 1.0, prepared.t[-1])
    assert part.t[fit_rows(part, TrimSettings())].min() > part.t[0] + 2.4


# -- nuisances -------------------------------------------------------------------------------------


def nuisances_of(prepared: Observation) -> Nuisances:
    return Nuisances([prepared], [0], ("vertical_acceleration", "pitch_rate"), OF_A_CALIBRATION, [0.0])


def applied(n: Nuisances, prepared: Observation, signal: np.ndarray, **values: float) -> np.ndarray:
    vector = np.zeros((len(n), 1))
    for name, value in values.items():
        vector[n.names.index(name.replace("__", "."))] = value
    rows = np.arange(50, prepared.t.size - 50)
    return n.apply(0, signal, rows, vector)[:, :, 0]


def test_each_nuisance_does_what_its_name_says(prepared: Observation) -> None:
    n = nuisances_of(prepared)
    t = prepared.t - prepared.t[0]
    wave = np.sin(2 * np.pi * 4.0 * t)
    signal = np.stack([wave, 0.1 * wave], axis=1)[:, :, None]
    inside = t[50:-50]
    plain = applied(n, prepared, signal)
    np.testing.assert_allclose(plain, signal[50:-50, :, 0], atol=1e-12)
    later = applied(n, prepared, signal, pass__clock_offset=0.0137)
    np.testing.assert_allclose(later[:, 0], np.sin(2 * np.pi * 4.0 * (inside + 0.0137)), atol=1e-3)
    moved = applied(n, prepared, signal, map_position=0.1)
    shifted = inside + 0.1 / prepared.along[50:-50]
    np.testing.assert_allclose(moved[:, 0], np.sin(2 * np.pi * 4.0 * shifted), atol=2e-3)
    biased = applied(n, prepared, signal, pass__bias__pitch_rate=0.02, gain=0.01)
    np.testing.assert_allclose(biased[:, 1], plain[:, 1] + 0.02, atol=1e-12)
    np.testing.assert_allclose(biased[:, 0], 1.01 * plain[:, 0], atol=1e-12)
    tilted = applied(n, prepared, signal, tilt_roll=0.01)
    np.testing.assert_allclose(
        tilted[:, 0] - plain[:, 0], 0.01 * prepared.measured["lateral_acceleration"][50:-50]
    )


def test_what_a_drive_is_off_the_map_adds_to_what_all_are(prepared: Observation) -> None:
    channels = ("vertical_acceleration", "pitch_rate")
    n = Nuisances([prepared], [0], channels, replace(OF_A_CALIBRATION, drive_map=0.006), [0.0])
    wave = np.sin(2 * np.pi * 4.0 * (prepared.t - prepared.t[0]))
    signal = np.stack([wave, wave], axis=1)[:, :, None]
    assert n.spread[n.names.index("pass.map_position")] == 0.006
    both = applied(n, prepared, signal, map_position=0.03, pass__map_position=0.02)
    np.testing.assert_array_equal(both, applied(n, prepared, signal, map_position=0.05))
    assert np.abs(both - applied(n, prepared, signal)).max() > 0.1


@pytest.mark.parametrize("late", [0.0, 0.0137])
def test_an_elastic_mount_amplifies_fast_motion(prepared: Observation, late: float) -> None:
    channels = ("vertical_acceleration", "pitch_rate")
    n = Nuisances([prepared], [0], channels, replace(OF_A_CALIBRATION, mount=1.0), [0.0])
    t = prepared.t - prepared.t[0]
    for hertz in (1.0, 8.0, 15.0):
        signal = np.repeat(np.sin(2 * np.pi * hertz * t)[:, None, None], 2, axis=1)
        plain = applied(n, prepared, signal, pass__clock_offset=late)
        held = applied(n, prepared, signal, pass__clock_offset=late, mount=2.0)
        assert np.array_equal(held[:, 1], plain[:, 1])
        # slopes of slopes over two samples fall short of a second derivative where a wave has few samples
        fine = np.sinc(2 * hertz / prepared.rate) ** 2
        share = np.std(held[:, 0]) / np.std(plain[:, 0]) - 1.0
        assert share == pytest.approx(2.0 * (hertz / 70.0) ** 2 * fine, rel=0.05)
        assert np.corrcoef(held[:, 0], plain[:, 0])[0, 1] > 0.9999  # neither late nor early
    assert n.one_sided.tolist() == [name == "mount" for name in n.names]


def test_clock_and_map_do_not_shift_the_response_to_the_planar_motion(prepared: Observation) -> None:
    n = Nuisances([prepared], [0], ("vertical_acceleration", "pitch_rate"), OF_A_CALIBRATION, [0.0])
    t = prepared.t - prepared.t[0]
    road, braking = np.sin(2 * np.pi * 4.0 * t), np.cos(2 * np.pi * 1.0 * t)
    n = n.with_planar_response([np.stack([braking, 0.5 * braking], axis=1)])
    signal = np.stack([road + braking, 0.5 * braking], axis=1)[:, :, None]
    inside = t[50:-50]
    out = applied(n, prepared, signal, pass__clock_offset=0.03)
    np.testing.assert_allclose(
        out[:, 0] - braking[50:-50], np.sin(2 * np.pi * 4.0 * (inside + 0.03)), atol=1e-3
    )
    np.testing.assert_allclose(out[:, 1], 0.5 * braking[50:-50], atol=1e-12)


@pytest.mark.parametrize("carried", [False, True], ids=["", "carried"])
@pytest.mark.parametrize("alike", [3, 5], ids=["some alike", "all alike"])
def test_lanes_together_are_lanes_alone(prepared: Observation, alike: int, carried: bool) -> None:
    """Lanes that share a shift go through other loops than one with its own; pivots, tilts, mounts included."""
    channels = ("vertical_acceleration", "longitudinal_acceleration", "pitch_rate")
    n = Nuisances([prepared], [0], channels, replace(OF_A_CALIBRATION, pivot=0.3, mount=1.0), [0.0])
    rng = np.random.default_rng(3)
    signal = rng.standard_normal((prepared.t.size, 3, 5))
    if carried:
        n = n.with_planar_response([rng.standard_normal((prepared.t.size, 3))])
    values = rng.standard_normal((len(n), 5)) * n.spread[:, None]
    shifts = [n.names.index("map_position"), n.names.index("pass.clock_offset")]
    values[shifts, 5 - alike :] = values[shifts, -1:]
    rows = np.arange(prepared.t.size)
    inside = slice(50, -50)  # at the very ends a slope of a slope is another
    together = n.apply(0, signal, rows, values)
    one = n.apply(0, signal[:, :, :1], rows, values)
    for lane in range(5):
        alone = n.apply(0, signal[:, :, lane : lane + 1], rows, values[:, lane : lane + 1])
        np.testing.assert_allclose(together[inside, :, lane], alone[inside, :, 0], atol=1e-12)
        same = n.apply(0, signal[:, :, :1], rows, values[:, lane : lane + 1])
        np.testing.assert_allclose(one[:, :, lane], same[:, :, 0], atol=1e-12)


def test_a_wandering_receiver_gets_an_offset_of_its_own(prepared: Observation) -> None:
    n = Nuisances(
        [prepared], [0], ("vertical_acceleration",), replace(OF_A_CALIBRATION, wander_seconds=2.0), [0.4]
    )
    knots = [name for name in n.names if ".wander." in name]
    assert len(knots) == 3 and n.spread[n.names.index(knots[0])] == 0.4
    t = prepared.t - prepared.t[0]
    signal = np.sin(2 * np.pi * 2.0 * t)[:, None, None]
    values = np.zeros((len(n), 1))
    values[n.names.index(knots[-1])] = 0.2
    out = n.apply(0, signal, np.arange(t.size), values)[:, 0, 0]
    assert np.abs(out[:150] - signal[:150, 0, 0]).max() < 0.02  # far from the last knot
    assert np.abs(out[-100:-10] - signal[-100:-10, 0, 0]).max() > 0.2


def test_a_clock_of_all_drives_adds_to_that_of_each(prepared: Observation) -> None:
    n = Nuisances(
        [prepared], [0], ("vertical_acceleration",), replace(OF_A_CALIBRATION, common_clock=0.002), [0.0]
    )
    rows = np.arange(100, prepared.t.size - 100)
    signal = np.sin(2 * np.pi * 3.0 * prepared.t)[:, None, None]
    values = np.zeros((len(n), 3))
    values[n.names.index("clock_offset")] = [0.03, 0.0, 0.01]
    values[n.names.index(f"{prepared.name}.clock_offset")] = [0.0, 0.03, 0.02]
    out = n.apply(0, np.repeat(signal, 3, axis=2), rows, values)
    np.testing.assert_allclose(out, out[:, :, :1].repeat(3, axis=2), atol=1e-12)
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(out[:, :, 0], signal[rows, :, 0], atol=1e-3)
    assert "clock_offset" not in Nuisances([prepared], [0], n.channels, OF_A_CALIBRATION, [0.0]).names


@pytest.mark.parametrize("lanes", [2, 5])
def test_clocks_of_candidates_taken_together_are_those_taken_alone(prepared: Observation, lanes: int) -> None:
    """Lanes that differ by their clocks alone go through a kernel of their own."""
    rng = np.random.default_rng(lanes)
    channels = ("vertical_acceleration", "pitch_rate")
    n = Nuisances([prepared], [0], channels, OF_A_CALIBRATION, [0.0])
    signals = rng.standard_normal((prepared.t.size, 2, lanes))
    values = n.spread[:, None] * rng.standard_normal((len(n), lanes))
    values[n.names.index("map_position")] = 0.0
    rows = np.arange(prepared.t.size)
    together = n.apply(0, signals, rows, values)
    for k in range(lanes):
        alone = n.apply(0, signals[:, :, k : k + 1], rows, values[:, k : k + 1])
        np.testing.assert_allclose(together[:, :, k : k + 1], alone, rtol=1e-12, atol=1e-12)


def test_coarse_lag_finds_seconds() -> None:
    rng = np.random.default_rng(0)
    signal = np.convolve(rng.standard_normal(3000), np.ones(9) / 9, mode="same")
    lag, there, here = coarse_lag([(signal[:-37], signal[37:])], 100.0, 1.0)
    assert lag == pytest.approx(-0.37, abs=0.003) and there > 0.98 and here < 0.5
    assert coarse_lag([(np.zeros(500), signal[:500])], 100.0, 1.0) == (0.0, 0.0, 0.0)
    # no lag allowed, and a lag the other way
    assert coarse_lag([(signal[:500], signal[:500])], 100.0, 0.0) == (
        0.0,
        pytest.approx(1.0),
        pytest.approx(1.0),
    )
    assert coarse_lag([(signal[37:], signal[:-37])], 100.0, 1.0)[0] == pytest.approx(-lag, abs=1e-6)


# -- the problem -----------------------------------------------------------------------------------


def test_a_lane_costs_the_same_whatever_stands_beside_it(problem: Problem, objective: Objective) -> None:
    rng = np.random.default_rng(0)
    z = problem.space.z0[:, None] + 0.2 * rng.standard_normal((len(problem.space), 9))
    values, quiet = problem.space.from_slopes(z), np.zeros(len(problem.nuisances))
    together = costs_of(problem, objective, values, quiet)
    alone = [costs_of(problem, objective, values[:, k : k + 1], quiet)[0] for k in range(9)]
    np.testing.assert_allclose(together, alone, rtol=1e-13)


def test_the_jacobian_is_the_slope_of_the_residuals(problem: Problem) -> None:
    x = np.concatenate([problem.space.z0, np.zeros(len(problem.nuisances))])
    at = problem.linearise(x)
    residual, jacobian = at.residual, at.jacobian
    for k in (1, 9, len(problem.space) + 4):
        step = np.zeros_like(x)
        step[k] = 0.002 if k < len(problem.space) else 0.01 * problem.nuisances.spread[k - len(problem.space)]
        there = problem.linearise(x + step).residual
        expected = jacobian @ step
        assert np.linalg.norm(there - residual - expected) < 0.15 * np.linalg.norm(expected) + 1e-9


def test_a_candidate_that_cannot_stand_costs_infinitely_much(problem: Problem, objective: Objective) -> None:
    values = np.repeat(problem.space.nominal[:, None], 2, axis=1)
    springs = [i for i, k in enumerate(problem.space.keys) if ".spring." in k]
    values[springs, 1] = 1e-6
    costs = costs_of(problem, objective, values, np.zeros(len(problem.nuisances)))
    assert np.isfinite(costs[0]) and np.isinf(costs[1])


def test_synchronising_undoes_a_shift(problem: Problem, objective: Objective, rough_case: Any) -> None:
    right = refined(rough_case.truth)
    truth = np.array([float(twin_value(right, key)) for key in problem.space.keys])
    signals, _ = problem.signals_of(truth[:, None], np.zeros((0, 1)))
    shifted = [np.roll(s, -2, axis=0) for s in signals]  # 20 ms too early
    quiet = np.zeros((len(problem.nuisances), 1))
    found, here = (synchronised(problem, objective, each, quiet) for each in (shifted, signals))
    assert len(problem.nuisances.clocks) == 2
    for row, _ in problem.nuisances.clocks:
        assert here[row, 0] == pytest.approx(0.0, abs=0.002)
        assert found[row, 0] == pytest.approx(-0.02, abs=0.002)


def test_simulating_stops_when_asked_to(problem: Problem) -> None:
    stopping = replace(problem, simulation=replace(problem.simulation, stop=lambda: True))
    with pytest.raises(Interrupted):
        stopping.sums_of_squares(problem.prior.centre[:, None])


def at_spread(problem: Problem, seed: int) -> np.ndarray:
    """(q,) nuisances, each of the size of its prior."""
    return problem.nuisances.spread * np.random.default_rng(seed).standard_normal(len(problem.nuisances))


@pytest.mark.parametrize(
    ("rows", "runs"),
    [
        ([], []),
        ([4], [(0, 1)]),
        ([0, 1, 2], [(0, 3)]),
        ([3, 4, 7, 8, 9, 11], [(0, 2), (2, 5), (5, 6)]),
        ([2, 4, 6], [(0, 1), (1, 2), (2, 3)]),
    ],
)
def test_runs_of_consecutive_samples_are_segments(rows: list[int], runs: list[tuple[int, int]]) -> None:
    for offset in (0, 30):
        found = segments_of(np.array(rows, dtype=np.intp), offset)
        assert found == [slice(offset + a, offset + b) for a, b in runs]


def small(problem: Problem, priors: NuisancePriors | None = None, **changes: Any) -> Problem:
    """The same drives and vehicle in a problem of its own, every third second compared and two channels."""
    rows = tuple(rows[(rows // 100) % 3 == 0] for rows in problem.data.rows)
    data: Data = replace(problem.data, **{"rows": rows, **changes})
    terms = (
        Term("mse", "pitch_rate", 0.5),
        Term("mse", "vertical_acceleration", 2.0),
        Term("spectral", "pitch_rate", 3.0),
    )
    return problem_of(problem.twin, problem.space, data, terms, priors or problem.nuisances.priors)[0]


def test_rows_channels_and_drives_say_what_is_compared(problem: Problem) -> None:
    own = small(problem)
    data = own.data
    assert own.channels == ("pitch_rate", "vertical_acceleration")
    assert sum(rows.size for rows in data.rows) == len(own.measured.values)
    wanted = [
        np.stack([p.measured[c][r] for c in own.channels], axis=1)
        for p, r in zip(data.parts, data.rows, strict=True)
    ]
    np.testing.assert_array_equal(own.measured.values, np.concatenate(wanted))
    assert own.seconds == pytest.approx(sum(len(p.t) - 1 for p in data.parts) / own.measured.rate, rel=1e-4)
    where = [s for k, rows in enumerate(data.rows) for s in segments_of(rows, k * data.rows[0].size)]
    assert list(own.measured.segments) == where and len(where) == len(own.measured.drives)
    assert own.measured.drives == tuple(int(s.start >= data.rows[0].size) for s in where)
    assert (own.measured.rate, own.measured.bandwidth) == (data.parts[0].rate, data.parts[0].bandwidth)
    with pytest.raises(InputError, match="nothing is left to compare"):
        small(problem, rows=tuple(rows[:0] for rows in data.rows))


class Scaled:
    """The residuals of an objective times a number."""

    def __init__(self, objective: Objective, factor: float) -> None:
        self.objective, self.factor = objective, factor

    def residuals(self, simulated: np.ndarray) -> np.ndarray:
        return self.factor * self.objective.residuals(simulated)


def test_costs_and_sums_of_squares_are_those_of_the_compared_signals(
    problem: Problem, objective: Objective
) -> None:
    d = problem.d
    nuisance = at_spread(problem, 1)
    x = np.repeat(np.concatenate([problem.space.z0, nuisance])[:, None], 3, axis=1)
    x[:d, 1] += 0.1
    x[d:, 2] = 0.0
    sums = problem.sums_of_squares(x)
    for k in range(3):
        signals, failed = problem.signals(x[:, k : k + 1])
        assert not failed.any()
        r = objective.residuals(problem.likelihood.compared(signals, x[d:, k : k + 1]))
        assert sums[k] == pytest.approx(float((r**2).sum()), rel=1e-12)
    costs = costs_of(problem, objective, problem.space.from_slopes(x[:d, :2]), nuisance)
    np.testing.assert_allclose(costs, [objective.cost_of_squares(s) for s in sums[:2]], rtol=1e-12)
    doubled = problem.weighed(Scaled(objective, 2.0))
    np.testing.assert_allclose(doubled.sums_of_squares(x[:, :1]), 4.0 * sums[:1])
    infinite = problem.weighed(Scaled(objective, np.nan))
    assert np.isinf(infinite.sums_of_squares(x[:, :2])).all()


def test_the_cost_is_that_of_residuals_and_prior(problem: Problem) -> None:
    x = problem.prior.centre.copy()
    x[: problem.d] += 0.1
    away = x - problem.prior.centre
    penalty = float(away @ problem.prior.precision @ away)
    assert penalty > 0
    assert problem.costs(x[:, None])[0] == pytest.approx(problem.sums_of_squares(x[:, None])[0] + penalty)


def test_a_candidate_that_cannot_stand_has_no_sum_of_squares(
    problem: Problem, objective: Objective, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor a slope where a step makes it fall; whatever stands beside it."""
    from suspension_twin.inference import problem as module

    x = np.concatenate([problem.space.z0, np.zeros(len(problem.nuisances))])
    alone = problem.sums_of_squares(x[:, None])
    slopes = problem.linearise(x).jacobian
    run = module.simulate_lanes

    def falling(*given: Any, **options: Any) -> Any:
        found = run(*given, **options)
        failed = found.failed.copy()
        failed[2:3] = True
        return replace(found, failed=failed)

    monkeypatch.setattr(module, "simulate_lanes", falling)
    three = np.repeat(x[:, None], 3, axis=1)
    three[1] += [0.0, 0.005, 0.01]
    each = problem.sums_of_squares(three)
    assert each[0] == pytest.approx(alone[0]) and np.isinf(each).tolist() == [False, False, True]
    costs = costs_of(problem, objective, problem.space.from_slopes(three[: problem.d]), x[problem.d :])
    assert np.isinf(costs).tolist() == [False, False, True]
    found = problem.linearise(x).jacobian
    assert not found[:, 1].any() and slopes[:, 1].any()
    np.testing.assert_array_equal(np.delete(found, 1, axis=1), np.delete(slopes, 1, axis=1))


def test_the_quadratic_model_is_that_of_residuals_and_their_slopes(problem: Problem) -> None:
    x = np.concatenate([problem.space.z0, at_spread(problem, 2)])
    at, model = problem.linearise(x), problem.quadratic(x)
    assert model.value == pytest.approx(float(problem.sums_of_squares(x[:, None])[0]))
    np.testing.assert_allclose(model.squares, at.jacobian.T @ at.jacobian, rtol=1e-9)
    np.testing.assert_allclose(model.slope, at.jacobian.T @ at.residual, rtol=1e-9)
    # a bias shifts its channel alone, by itself
    bias = problem.d + problem.nuisances.names.index("two.bias.vertical_acceleration")
    shifted = x.copy()
    shifted[bias] += 0.3
    change = problem.linearise(shifted).residual - at.residual
    np.testing.assert_allclose(change, 0.3 * at.jacobian[:, bias], atol=1e-9)


def test_pieces_that_fit_in_memory_give_what_all_together_do(
    problem: Problem, objective: Objective, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples = sum(len(p.excitation) for p in problem.data.parts)
    assert problem.batches(9) == [slice(0, 9)] and problem.batches(0) == []
    x = np.concatenate([problem.space.z0, np.zeros(len(problem.nuisances))])
    lanes = x[:, None] + np.array([0.0, 0.01, 0.02, 0.03, 0.04])
    values, nuisance = problem.space.from_slopes(lanes[: problem.d]), x[problem.d :]

    def results() -> list[np.ndarray]:
        costs = costs_of(problem, objective, values, nuisance)
        return [costs, problem.sums_of_squares(lanes), problem.linearise(x).jacobian]

    together = results()
    largest = "suspension_twin.inference.problem._LARGEST_BATCH"
    monkeypatch.setattr(largest, 7 * 15 * samples)
    assert problem.batches(31) == [slice(0, 15), slice(15, 30), slice(30, 31)]
    for one, other in zip(together, results(), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-6)
    monkeypatch.setattr(largest, 14 * samples)
    assert problem.batches(5) == [slice(0, 2), slice(2, 4), slice(4, 5)]
    np.testing.assert_allclose(problem.sums_of_squares(lanes), together[1], rtol=1e-9)
    monkeypatch.setattr(largest, 1)
    assert problem.batches(2) == [slice(0, 1), slice(1, 2)]


def test_offsets_of_clock_and_map_move_the_excitation(problem: Problem) -> None:
    """Of each drive its own clock and that of all; other nuisances do not."""
    priors = replace(problem.nuisances.priors, common_clock=0.002, map_position=0.5)
    own = small(problem, priors=priors)
    found = np.zeros(len(own.nuisances))
    for name, value in (
        ("map_position", 0.3),
        ("clock_offset", 0.02),
        ("one.clock_offset", -0.05),
        ("gain", 0.7),
    ):
        found[own.nuisances.names.index(name)] = value
    there = moved(own, found)
    for part, given, late in zip(there.data.parts, own.data.parts, (-0.03, 0.02), strict=True):
        wanted = given.moved(late, 0.3)
        np.testing.assert_array_equal(part.road_excitation.road, wanted.road_excitation.road)
        assert (part.road_excitation.road != given.road_excitation.road).any()
    assert own.data.parts == problem.data.parts and there.data.rows is own.data.rows
    np.testing.assert_array_equal(there.measured.values, own.measured.values)
    blind = small(problem, priors=replace(OF_A_CALIBRATION, clock=0.0, map_position=0.0))
    still = moved(blind, np.zeros(len(blind.nuisances)))
    for part, given in zip(still.data.parts, blind.data.parts, strict=True):
        np.testing.assert_array_equal(part.road_excitation.road, given.moved(0.0, 0.0).road_excitation.road)


def test_runs_that_share_an_excitation_are_simulated_once(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    from suspension_twin.inference import problem as module

    one, two = problem.data.parts
    rows = problem.data.rows
    same = small(
        problem,
        parts=(one, two, replace(one, name="again")),
        drive_of=(0, 1, 2),
        rows=(*rows, rows[0]),
        active=(True,) * 3,
    )
    run, calls = module.simulate_lanes, []

    def counted(twin: Any, candidates: Any, excitation: Any) -> Any:
        calls.append(excitation)
        return run(twin, candidates, excitation)

    monkeypatch.setattr(module, "simulate_lanes", counted)
    signals, failed = same.signals(same.prior.centre[:, None])
    assert len(calls) == 2 and {id(c) for c in calls} == {id(one.excitation), id(two.excitation)}
    np.testing.assert_array_equal(signals[0], signals[2])
    assert signals[0].shape == (one.t.size, 2, 1) and failed.tolist() == [False]


def test_costs_of_candidates_at_their_own_clocks(
    problem: Problem, objective: Objective, rough_case: Any
) -> None:
    """With clocks off by 20 ms the right vehicle costs little only once they are fitted, for each candidate."""
    right = refined(rough_case.truth)
    truth = np.array([float(twin_value(right, key)) for key in problem.space.keys])
    values, quiet = np.stack([truth, problem.space.nominal], axis=1), np.zeros(len(problem.nuisances))
    off = quiet.copy()
    off[[row for row, _ in problem.nuisances.clocks]] = 0.02
    there, late = (costs_of(problem, objective, values, each) for each in (quiet, off))
    found = costs_of(problem, objective, values, off, synchronise=True)
    assert found[0] < 1.02 * there[0] < 0.5 * late[0]
    assert (found <= late + 1e-9).all() and off[problem.nuisances.clocks[0][0]] == 0.02


# -- the noise ----------------------------------------------------------------------------------


def test_autoregression_finds_the_process_and_whitens_it() -> None:
    rng = np.random.default_rng(3)
    innovation = 0.3 * rng.standard_normal(20_000)
    process = np.zeros_like(innovation)
    for i in range(2, process.size):
        process[i] = 1.6 * process[i - 1] - 0.8 * process[i - 2] + innovation[i]
    taps, sigma = autoregression([process[:9000], process[9000:]], 4)
    np.testing.assert_allclose(taps, [1, -1.6, 0.8, 0, 0], atol=0.03)
    assert sigma == pytest.approx(0.3, rel=0.03)
    drives = (0, 1)
    measured = Measured(("x",), np.zeros((20_000, 1)), (slice(0, 9000), slice(9000, 20_000)), 100.0, drives)
    white = Whitener.of_residual(measured, process[:, None]).residuals(process[:, None, None])[:, 0]
    assert np.std(white) == pytest.approx(1.0, abs=0.02)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03


def test_a_segment_that_a_filter_hardly_fits_in_is_left_out() -> None:
    measured = Measured(
        ("x",), np.zeros((100, 1)), (slice(0, 8), slice(8, 60), slice(60, 69), slice(69, 77)), 100.0
    )
    taps = np.array([1.0, -0.5, 0.0, 0.0, 0.0])
    white = Whitener.with_filters(measured, (0,) * 4, taps[None, None], np.ones((1, 1)))
    assert white.residuals(np.ones((100, 1, 1))).shape[0] == (52 - 4) + (9 - 4)  # two orders are too short
    nothing = Measured(("x",), np.zeros((100, 1)), (slice(0, 8), slice(20, 28)), 100.0)
    with pytest.raises(WorkError, match="too short"):
        Whitener.with_filters(nothing, (0, 0), taps[None, None], np.ones((1, 1)))


# -- springs ---------------------------------------------------------------------------------------

X = np.array([0.1, 0.3, 0.5, 1.0])
Z = np.log(np.array([20e3, 24e3, 24e3, 24e3]))


def force(z: np.ndarray, at: np.ndarray) -> np.ndarray:
    edges = np.concatenate([[0.0], X])
    return np.interp(at, edges, np.concatenate([[0.0], np.cumsum(np.exp(z) * np.diff(edges))]))


def test_a_slide_acts_alike_around_the_standing_place() -> None:
    static = 0.18
    seen = np.linspace(0.14, 0.22, 50)
    found = slides(X, Z, Z, 0.8, static, seen)
    assert {s.shift > 0 for s in found} == {True, False}
    load = force(Z, np.array([static]))[0]
    for slide in found:
        if not 0.1 < static - 0.04 + slide.shift < static + 0.04 + slide.shift < 0.3:
            continue
        here = force(Z, seen) - load
        there = force(slide.z, seen + slide.shift) - load
        np.testing.assert_allclose(there, here, atol=1e-6 * load)


def test_where_the_first_segment_is_seen_the_curve_has_to_end_in_the_origin() -> None:
    static, seen = 0.05, np.linspace(0.02, 0.08, 50)
    load = force(Z, np.array([static]))[0]
    for slide in slides(X, Z, Z, 0.8, static, seen):
        assert force(slide.z, np.array([static + slide.shift]))[0] == pytest.approx(load, rel=0.1)
        if slide.shift > 0.08:  # slid wholly into the second segment: it still acts alike
            np.testing.assert_allclose(
                force(slide.z, seen + slide.shift) - load, force(Z, seen) - load, atol=1e-6 * load
            )
        else:
            assert abs(slide.shift) < 0.01


def test_standing_at_a_corner_bears_the_same_load() -> None:
    z = standing_at(X, Z, 0.18, 0)
    assert force(z, np.array([0.1]))[0] == pytest.approx(force(Z, np.array([0.18]))[0])
    assert z[1] == pytest.approx(Z[1])
