# SPDX-License-Identifier: Apache-2.0
"""The posterior about a best fit: closed forms where residuals are linear, and what a drive excited."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import fractional_matrix_power
from scipy.stats import norm

from suspension_twin.drive.read import read_drive
from suspension_twin.inference.objectives import Objective, Term
from suspension_twin.inference.observation import Observation, observe
from suspension_twin.inference.posterior import (
    CORRELATION,
    Posterior,
    Travel,
    posterior,
    span_of,
    travel,
)
from suspension_twin.inference.problem import Data, Likelihood, Linearised, Problem
from suspension_twin.inference.runs import observe_runs
from suspension_twin.inference.space import Curve, Space
from suspension_twin.inference.spring_position import slides
from suspension_twin.models.parameters import Parameter, Prior, twin_value
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import Twin, load_twin

SPRING = ("vehicle.spring.force.0", "vehicle.spring.force.1")
DAMPER = ("vehicle.damper_push.force.0", "vehicle.damper_push.force.1")
MASS = ("vehicle.sprung_mass",)
RATE = 20.0
#: The excited piece of the spring is well within its second segment; nothing is seen of the first.
STATIC, SEEN = 0.4, (0.35, 0.45)


@pytest.fixture(scope="module")
def corner(repository: Path) -> Twin:
    """A corner whose spring and damper have two points each."""
    return load_twin(repository / "config" / "twins" / "quarter_car.yaml").with_changes(
        {
            "vehicle.spring.compression": (0.2, 0.6),
            "vehicle.spring.force": (4000.0, 12000.0),
            "vehicle.damper_push.velocity": (0.1, 0.4),
            "vehicle.damper_push.force": (200.0, 700.0),
        }
    )


def space_of(twin: Twin, keys: tuple[str, ...] = (*SPRING, *MASS), spread: float = 0.2) -> Space:
    values: dict[str, float] = {
        **dict(zip(SPRING, (4000.0, 12000.0), strict=True)),
        **dict(zip(DAMPER, (200.0, 700.0), strict=True)),
        MASS[0]: 390.0,
    }
    return Space(twin, [Parameter(k, (1e-2, 1e7), Prior(values[k], spread, "log")) for k in keys])


class Straight:
    """A problem whose signals are the d + q coordinates themselves, so that residuals can be linear in them.
    ``fails`` says of coordinates (d, L) which of them cannot be simulated."""

    def __init__(self, space: Space, q: int, rate: float = RATE, fails: Any = None) -> None:
        self.space, self.q, self.fails = space, q, fails
        self.measured = SimpleNamespace(rate=rate)

    def weighed(self, noise: Any) -> Straight:
        self.noise = noise
        return self

    def linearise(self, x: np.ndarray) -> Linearised:
        d = len(self.space)
        steps = 1e-3 * np.eye(x.size)
        lanes = np.concatenate([x[:, None], x[:, None] + steps], axis=1)
        values = self.space.from_slopes(lanes[:d])
        lanes[:d] = self.space.to_slopes(values)
        residual = self.noise.residuals(lanes[:, None, :])
        return Linearised(x, residual[:, 0], (residual[:, 1:] - residual[:, :1]) / 1e-3)

    def sums_of_squares(self, x: np.ndarray) -> np.ndarray:
        d = len(self.space)
        z = self.space.to_slopes(self.space.from_slopes(x[:d]))
        sums = np.sum(self.noise.residuals(np.concatenate([z, x[d:]])[:, None, :]) ** 2, axis=0)
        return np.where(False if self.fails is None else self.fails(z), np.inf, sums)


class Lines:
    """Residuals a (coordinates - centre) + noise."""

    def __init__(self, a: np.ndarray, centre: np.ndarray, noise: np.ndarray | float = 0.0) -> None:
        self.a, self.centre, self.noise = a, centre, noise * np.ones(len(a))

    def residuals(self, simulated: np.ndarray) -> np.ndarray:
        return self.a @ (simulated[:, 0] - self.centre[:, None]) + self.noise[:, None]


def standing(compressions: np.ndarray | None = None) -> Travel:
    seen = np.linspace(*SEEN, 500) if compressions is None else compressions
    return Travel({"": seen}, {"": np.zeros(10)}, {"": STATIC}, RATE)


def asked(
    space: Space,
    lines: Lines,
    precision: np.ndarray,
    x: np.ndarray | None = None,
    where: Travel | None = None,
    fails: Any = None,
    rate: float = RATE,
    **options: Any,
) -> Posterior:
    problem: Any = Straight(space, precision.shape[0] - len(space), rate, fails)
    problem.data = SimpleNamespace(block=np.arange(len(lines.a)) // int(RATE))
    at = lines.centre if x is None else x
    placed = np.zeros(precision.shape[0] - len(space))
    return posterior(
        problem, lines, at, precision, where or standing(), options.pop("seed", 1), placed=placed, **options
    )


def some_precision(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.standard_normal((size, size))
    return np.asarray(root @ root.T + np.eye(size))


# -- covariance ------------------------------------------------------------------------------------


def test_a_single_block_leaves_the_inverse_of_data_and_prior(corner: Twin) -> None:
    """Nothing tells how a fit to other data would differ."""
    space, rng = space_of(corner, (*DAMPER, *MASS)), np.random.default_rng(0)
    p, rows = len(space) + 2, int(RATE)
    lines = Lines(
        rng.standard_normal((rows, p)), np.concatenate([space.z0, [0.3, -0.2]]), 5.0 * np.ones(rows)
    )
    precision = some_precision(rng, p)
    found = asked(space, lines, precision)
    wanted = np.linalg.inv(lines.a.T @ lines.a + precision)
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-6)
    np.testing.assert_allclose(found.sigma, np.sqrt(np.diag(wanted))[-2:], rtol=1e-6)
    assert found.better is None


@pytest.mark.parametrize("blocks", [3, 10, 23])
def test_where_the_scores_of_blocks_scatter_more_it_is_their_sandwich(corner: Twin, blocks: int) -> None:
    """Standard deviations are at least those by the scores of blocks, each corrected in the space of its residuals by
    (1 - H)^(-1/2), H = A C A' (CR2), with the prior's own part; correlations are those of the inverse information C."""
    space, rng = space_of(corner, (*DAMPER, *MASS)), np.random.default_rng(4)
    p, size = len(space) + 2, int(RATE)
    a = rng.standard_normal((blocks, size, p)) * [1.0, 2.0, 0.5, 1.0, 1.0]
    noise = 0.3 * rng.standard_normal((blocks, size))
    # a block that is off as a whole counts where the slope is of one sign: two of the coordinates
    a[:, :, [0, 3]] = np.abs(a[:, :, [0, 3]])
    noise += 3.0 * rng.standard_normal((blocks, 1))
    precision = some_precision(rng, p)
    lines = Lines(a.reshape(-1, p), np.concatenate([space.z0, [0.0, 0.0]]), noise.ravel())
    found = asked(space, lines, precision)

    plain = np.linalg.inv(lines.a.T @ lines.a + precision)
    left = (lines.noise - lines.a @ plain @ lines.a.T @ lines.noise).reshape(blocks, size)
    scores = [
        own.T @ fractional_matrix_power(np.eye(size) - own @ plain @ own.T, -0.5) @ off
        for own, off in zip(a, left, strict=True)
    ]
    sandwich = plain @ (sum(np.outer(g, g) for g in scores) + precision) @ plain
    deviation = np.sqrt(np.maximum(np.diag(plain), np.diag(sandwich)))
    assert (deviation > np.sqrt(np.diag(plain)) + 1e-6).any()
    correlation = plain / np.sqrt(np.outer(np.diag(plain), np.diag(plain)))
    np.testing.assert_allclose(
        found.covariance, correlation * np.outer(deviation, deviation), rtol=1e-5, atol=1e-12
    )
    np.testing.assert_array_equal(found.covariance, found.covariance.T)


def test_scores_are_those_of_the_optimum_wherever_the_search_stopped(corner: Twin) -> None:
    """Residuals that are linear in the coordinates have one covariance, at the optimum and far from it."""
    space, rng = space_of(corner, (*DAMPER, *MASS)), np.random.default_rng(8)
    blocks, size = 12, int(RATE)
    a = rng.standard_normal((blocks * size, len(space) + 2))
    noise = np.repeat(rng.standard_normal(blocks), size)
    lines = Lines(a, np.concatenate([space.z0, [0.1, -0.1]]), noise)
    precision = some_precision(rng, len(space) + 2)
    near, far = (asked(space, lines, precision, lines.centre + step) for step in (0.0, 0.1))
    np.testing.assert_allclose(far.covariance, near.covariance, rtol=1e-5, atol=1e-9)


def test_residuals_that_repeat_within_a_second_count_once(corner: Twin) -> None:
    """Twenty equal samples a second of a level are one sample a second; independent ones are twenty."""
    space, rng = space_of(corner, MASS), np.random.default_rng(2)
    seconds, size = 400, int(RATE)
    weak = np.diag([1e-6])
    a = np.ones((seconds * size, 1))
    for noise, variance in (
        (np.repeat(rng.standard_normal(seconds), size), 1.0 / seconds),
        (rng.standard_normal(seconds * size), 1.0 / (seconds * size)),
    ):
        found = asked(space, Lines(a, space.z0, noise - noise.mean()), weak)
        assert found.covariance[0, 0] == pytest.approx(variance, rel=0.15)


def test_a_doubt_is_one_more_deviation_of_all_coordinates_together(corner: Twin) -> None:
    space, rng = space_of(corner, (*DAMPER, *MASS)), np.random.default_rng(1)
    lines = Lines(rng.standard_normal((60, 4)), np.append(space.z0, 0.1))
    precision, doubt = some_precision(rng, 4), np.array([0.3, -0.2, 0.0, 0.4])
    sure, unsure = asked(space, lines, precision), asked(space, lines, precision, doubt=doubt)
    np.testing.assert_allclose(unsure.covariance - sure.covariance, np.outer(doubt, doubt), atol=1e-12)
    np.testing.assert_allclose(unsure.sigma**2, sure.sigma**2 + 0.4**2)
    spread = np.std(space.to_slopes(unsure.draws), axis=1)
    np.testing.assert_allclose(spread, np.sqrt(np.diag(unsure.covariance)[:3]), rtol=0.05)


# -- draws -----------------------------------------------------------------------------------------


def test_draws_have_the_mean_and_covariance_that_are_stated(corner: Twin) -> None:
    """In slope coordinates, of the parameters alone; the same seed draws the same."""
    space, rng = space_of(corner, (*DAMPER, *MASS)), np.random.default_rng(3)
    lines = Lines(rng.standard_normal((80, 5)), np.concatenate([space.z0 + 0.2, [0.4, -0.3]]))
    precision = some_precision(rng, 5)
    found = asked(space, lines, precision)
    z = space.to_slopes(found.draws)
    own = found.covariance[:3, :3]
    count = z.shape[1]
    assert z.shape == (3, count) and count > 1000
    np.testing.assert_allclose(z.mean(axis=1), lines.centre[:3], atol=4 * np.sqrt(own.max() / count))
    np.testing.assert_allclose(np.cov(z), own, atol=0.07 * np.diag(own).max())
    np.testing.assert_array_equal(asked(space, lines, precision).draws, found.draws)
    assert not np.array_equal(asked(space, lines, precision, seed=2).draws, found.draws)


def seeing_the_excited(space: Space, lowest: float = 0.0) -> Lines:
    """Residuals that see the slope of the second segment and the mass, of the lowest segment ``lowest`` times as
    much."""
    rng = np.random.default_rng(6)
    a = rng.standard_normal((150, len(space) + 1)) * 3.0
    a[:, 0] *= lowest
    return Lines(a, np.append(space.z0, 0.05))


def prior_of_spring(space: Space, spread: float, across: float = 0.0) -> np.ndarray:
    precision = np.diag([spread**-2.0, *[4.0] * len(space)])
    precision[0, 2] = precision[2, 0] = across
    return precision


@pytest.mark.parametrize("away", [0.0, 0.4, -0.4])
def test_what_no_residual_sees_is_as_the_prior_says_wherever_one_asks(corner: Twin, away: float) -> None:
    """The slope below the excited range: only the prior knows it. The point asked about may be two deviations off."""
    space = space_of(corner)
    lines, spread = seeing_the_excited(space), 0.2
    x = np.add(lines.centre, [away, 0.0, 0.0, 0.0])
    found = asked(space, lines, prior_of_spring(space, spread), x)
    below = space.to_slopes(found.draws)[0] - space.z0[0]
    count = below.size
    # the point asked about has the weight of one step of the grid, a tenth of a deviation
    allowed = 4 * spread / np.sqrt(count) + 0.08 * abs(away)
    assert below.mean() == pytest.approx(0.0, abs=allowed)
    assert below.std() == pytest.approx(spread, rel=0.08 if away else 0.05)
    assert np.unique(below).size == count  # steps of the grid do not show
    others = space.to_slopes(found.draws)[1:] - lines.centre[1:3, None]
    np.testing.assert_allclose(np.cov(others), found.covariance[1:3, 1:3], atol=0.07 * found.covariance[1, 1])


@pytest.mark.parametrize("spread", [0.05, 0.2])
def test_slides_are_mixed_by_their_weights(corner: Twin, spread: float) -> None:
    """exp(-cost / 2) times the density over the shift; the best fit counts as the slide nearest to it would."""
    space = space_of(corner)
    lines = seeing_the_excited(space)
    found = asked(space, lines, prior_of_spring(space, spread))
    below = np.sort(space.to_slopes(found.draws)[0])

    grid = slides(
        np.array([0.2, 0.6]), space.z0[:2], space.z0[:2], CORRELATION, STATIC, np.linspace(*SEEN, 99)
    )
    z = np.array([s.z[0] for s in grid])
    weight = np.exp(-0.5 * ((z - space.z0[0]) / spread) ** 2) * [s.density for s in grid]
    own = min(grid, key=lambda s: abs(s.shift)).density
    # each slide stands for half a step to either side; the step of the grid beside the fit is twice as wide
    half = 0.5 * np.gradient(z)
    share = np.clip((below[:, None] - (z - np.abs(half))) / (2 * np.abs(half)), 0.0, 1.0)
    wanted = (share @ weight + own * norm.cdf(below, space.z0[0], spread)) / (weight.sum() + own)
    observed = (np.arange(below.size) + 0.5) / below.size
    assert np.abs(wanted - observed).max() < 1.6 / np.sqrt(below.size)


def test_others_keep_the_spread_that_they_have_given_a_slide(corner: Twin) -> None:
    """The prior ties the mass to the slope of the unexcited segment; a slide fixes that slope."""
    space = space_of(corner)
    rng = np.random.default_rng(7)
    a = np.zeros((150, 4))
    a[:, [1, 3]] = 3.0 * rng.standard_normal((150, 2))
    lines = Lines(a, np.append(space.z0, 0.0))
    precision = prior_of_spring(space, 0.2, across=7.0)
    found = asked(space, lines, precision)
    z = space.to_slopes(found.draws) - lines.centre[:3, None]
    covariance = found.covariance
    given = covariance[2, 2] - covariance[0, 2] ** 2 / covariance[0, 0]
    assert given < 0.6 * covariance[2, 2]
    assert z[2].var() == pytest.approx(given, rel=0.15)
    assert z[1].var() == pytest.approx(covariance[1, 1], rel=0.08)


def test_slides_that_fit_worse_take_no_share(corner: Twin) -> None:
    space = space_of(corner)
    lines = seeing_the_excited(space, lowest=8.0)
    precision = prior_of_spring(space, 0.2)
    found = asked(space, lines, precision)
    np.testing.assert_array_equal(found.draws, asked(space, lines, precision, where=nowhere()).draws)
    z = space.to_slopes(found.draws)
    np.testing.assert_allclose(z.std(axis=1), np.sqrt(np.diag(found.covariance)[:3]), rtol=0.05)
    assert found.better is None


def nowhere() -> Travel:
    """All of the spring was seen, so that there is nothing to slide."""
    return standing(np.linspace(0.001, 0.59, 500))


def test_slides_that_cannot_be_simulated_take_no_share(corner: Twin) -> None:
    space = space_of(corner)
    lines, precision = seeing_the_excited(space), prior_of_spring(space, 0.2)
    edge = space.z0[0] - 0.1
    found = asked(space, lines, precision, fails=lambda z: z[0] < edge)
    below = space.to_slopes(found.draws)[0]
    assert np.mean(below < edge - 0.02) < 0.06 < 0.2 < norm.cdf(-0.12, 0.0, 0.2)
    assert found.better is None


# -- better ----------------------------------------------------------------------------------------


def test_a_better_point_is_told(corner: Twin) -> None:
    """The slide of least cost, all other coordinates as they are; a point that is best is left alone."""
    space = space_of(corner)
    lines, precision = seeing_the_excited(space), prior_of_spring(space, 0.2)

    def cost(x: np.ndarray) -> float:
        off = x[:3] - space.z0
        return float(np.sum((lines.a @ (x - lines.centre)) ** 2) + off @ precision[:3, :3] @ off)

    x = np.add(lines.centre, [0.5, 0.0, 0.02, 0.0])
    found = asked(space, lines, precision, x)
    assert found.better is not None
    np.testing.assert_array_equal(found.better[2:], x[2:])
    grid = slides(np.array([0.2, 0.6]), x[:2], space.z0[:2], CORRELATION, STATIC, np.linspace(*SEEN, 99))
    costs = [cost(np.concatenate([s.z, x[2:]])) for s in grid]
    np.testing.assert_allclose(found.better[:2], grid[int(np.argmin(costs))].z, rtol=1e-9)
    assert cost(found.better) == pytest.approx(min(costs)) and min(costs) < cost(x) - 5.0
    assert asked(space, lines, precision).better is None
    # no more than the noise of a fit
    near = np.add(lines.centre, [0.1, 0.0, 0.0, 0.0])
    assert cost(near) < 0.5 and asked(space, lines, precision, near).better is None


def test_dampers_and_springs_with_a_frozen_point_do_not_slide(corner: Twin) -> None:
    rng = np.random.default_rng(5)
    for keys, where in (
        (DAMPER, Travel({"": np.linspace(*SEEN, 500)}, {"": np.linspace(*SEEN, 500)}, {"": STATIC}, RATE)),
        ((SPRING[0], *MASS), standing()),
        ((SPRING[1], *MASS), standing()),
    ):
        space = space_of(corner, keys)
        lines = Lines(rng.standard_normal((50, 2)) * [0.0, 3.0], space.z0)
        x = np.add(space.z0, [0.4, 0.0])
        found = asked(space, lines, np.diag([25.0, 4.0]), x, where)
        assert found.better is None
        z = space.to_slopes(found.draws)
        np.testing.assert_allclose(z.mean(axis=1), x, atol=0.015)
        np.testing.assert_allclose(z.std(axis=1), np.sqrt(np.diag(found.covariance)), rtol=0.05)


def test_a_few_stray_samples_do_not_count_as_seen(corner: Twin) -> None:
    """One in a thousand is in the lowest segment: no drive determines a slope by that."""
    space = space_of(corner)
    lines, precision = seeing_the_excited(space), prior_of_spring(space, 0.2)
    seen = np.linspace(*SEEN, 4000)
    seen[:4] = 0.05
    x = np.add(lines.centre, [0.5, 0.0, 0.0, 0.0])
    found = asked(space, lines, precision, x, standing(seen))
    assert found.better is not None and abs(found.better[0] - space.z0[0]) < 0.05


def test_a_spring_is_told_by_its_axle(mondeo: Twin) -> None:
    """The front spring is seen through, the rear one is not."""
    points = {"compression": (0.2, 0.6), "force": (4000.0, 12000.0)}
    twin = mondeo.with_changes(
        {f"vehicle.{a}.spring.{k}": v for a in ("front", "rear") for k, v in points.items()}
    )
    keys = [f"vehicle.{a}.spring.force.{i}" for a in ("front", "rear") for i in (0, 1)]
    space = Space(twin, [Parameter(k, (1.0, 1e6), Prior((4e3, 12e3)[int(k[-1])], 0.2, "log")) for k in keys])
    rng = np.random.default_rng(9)
    lines = Lines(rng.standard_normal((100, 4)) * [0.0, 3.0, 0.0, 3.0], space.z0)
    seen = {"front": nowhere().compression[""], "rear": np.linspace(*SEEN, 400)}
    where = Travel(seen, {}, {"front": STATIC, "rear": STATIC}, RATE)
    off = np.array([0.4, 0.0, 0.4, 0.0])
    found = asked(space, lines, 25.0 * np.eye(4), space.z0 + off, where)
    assert found.better is not None
    np.testing.assert_allclose(found.better - space.z0, [0.4, 0.0, 0.0, 0.0], atol=0.03)
    mean = (space.to_slopes(found.draws) - space.z0[:, None]).mean(axis=1)
    np.testing.assert_allclose(mean, [0.4, 0.0, 0.0, 0.0], atol=0.05)


@pytest.mark.parametrize("axle", [0, 1])
def test_two_springs_slide_by_themselves(mondeo: Twin, axle: int) -> None:
    """Neither is seen below; whichever the point asked about is off in, both are as the prior says."""
    points = {"compression": (0.2, 0.6), "force": (4000.0, 12000.0)}
    twin = mondeo.with_changes(
        {f"vehicle.{a}.spring.{k}": v for a in ("front", "rear") for k, v in points.items()}
    )
    keys = [f"vehicle.{a}.spring.force.{i}" for a in ("front", "rear") for i in (0, 1)]
    space = Space(twin, [Parameter(k, (1.0, 1e6), Prior((4e3, 12e3)[int(k[-1])], 0.2, "log")) for k in keys])
    lines = Lines(np.random.default_rng(9).standard_normal((100, 4)) * [0.0, 3.0, 0.0, 3.0], space.z0)
    seen = np.linspace(*SEEN, 400)
    where = Travel({"front": seen, "rear": seen}, {}, {"front": STATIC, "rear": STATIC}, RATE)
    x = space.z0.copy()
    x[2 * axle] += 0.4
    found = asked(space, lines, 25.0 * np.eye(4), x, where)
    off = space.to_slopes(found.draws) - space.z0[:, None]
    np.testing.assert_allclose(off.mean(axis=1)[[0, 2]], 0.0, atol=0.03)
    np.testing.assert_allclose(off.std(axis=1)[[0, 2]], 0.2, rtol=0.1)


def test_slides_far_apart_lend_each_other_no_width(repository: Path) -> None:
    """Where the lowest segment was seen, few places of the grid are left, with gaps between them."""
    twin = load_twin(repository / "config" / "twins" / "quarter_car.yaml")
    forces = (2300.0, 6900.0, 11500.0, 23000.0)
    space = Space(
        twin,
        [
            Parameter(f"vehicle.spring.force.{i}", (1e-2, 1e7), Prior(f, 0.2, "log"))
            for i, f in enumerate(forces)
        ],
    )
    lines = Lines(np.random.default_rng(1).standard_normal((150, 4)) * 30.0, space.z0)
    seen = np.linspace(0.05, 0.29, 500)
    where = Travel({"": seen}, {"": seen}, {"": twin.axles[""].static_compression}, RATE)
    found = asked(space, lines, 25.0 * np.eye(4), where=where)
    z = space.to_slopes(found.draws)
    assert (z.std(axis=1) < 1.1 * np.sqrt(np.diag(found.covariance))).all()


def test_a_slide_alone_has_no_width(corner: Twin) -> None:
    """There is no other that it could share a step of the grid with."""
    space = space_of(corner)
    lines, precision = seeing_the_excited(space), prior_of_spring(space, 0.2)
    seen = np.linspace(0.03, 0.59, 99)
    (only,) = slides(np.array([0.2, 0.6]), space.z0[:2], space.z0[:2], CORRELATION, STATIC, seen)
    found = asked(space, lines, precision, where=standing(seen))
    below = space.to_slopes(found.draws)[0]
    there = np.abs(below - only.z[0]) < 1e-9
    own = 1.0 / (STATIC + only.shift)
    assert own == pytest.approx(only.density)
    # as likely as the fit, and of its density
    assert np.mean(there) == pytest.approx(0.5, abs=0.03)
    assert below[~there].std() == pytest.approx(0.2, rel=0.06)


def test_of_a_simulated_corner(corner: Twin, run_problem: Problem) -> None:
    """Nothing stands in for anything here: the same formulas hold of the residuals of a simulation."""
    problem = run_problem
    scale = 0.05

    class Scaled:
        def residuals(self, simulated: np.ndarray) -> np.ndarray:
            off = (simulated - problem.measured.values[:, :, None]) / scale
            return np.asarray(off.reshape(-1, off.shape[-1]))

    d = len(problem.space)
    x = np.concatenate([problem.space.z0, np.zeros(len(problem.nuisances))])
    precision = np.diag([*[4.0] * d, *problem.nuisances.spread**-2.0])
    found = posterior(
        problem, Scaled(), x, precision, travel(corner, problem), 1, placed=np.zeros(len(x) - d)
    )
    jacobian = problem.weighed(Scaled()).linearise(x).jacobian
    plain = np.linalg.inv(jacobian.T @ jacobian + precision)
    ratio = np.diag(found.covariance) / np.diag(plain)
    assert (ratio > 1 - 1e-9).all()
    shape = plain / np.sqrt(np.outer(np.diag(plain), np.diag(plain)))
    deviation = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(
        found.covariance, shape * np.outer(deviation, deviation), rtol=1e-6, atol=1e-15
    )


# -- what was driven -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run_problem(corner: Twin, repository: Path) -> Problem:
    (run,) = observe_runs(corner, [str(repository / "config" / "rig" / "random.csv")])
    rows = (np.arange(40, run.t.size - 20, 2),)
    return problem_of(corner, space_of(corner), (run,), rows, "body_acceleration")


def problem_of(
    twin: Twin, space: Space, parts: Sequence[Observation], rows: Sequence[np.ndarray], channel: str
) -> Problem:
    """The problem of one drive in parts, its mean squared difference in one channel."""
    data = Data(tuple(parts), (0,) * len(parts), tuple(rows), (channel,), (True,))
    nuisances = data.nuisances(parts[0].usage.priors)
    objective = Objective((Term("mse", channel),), data.measured)
    return Problem.of(twin, space, Likelihood(data, nuisances, objective))


def test_travel_is_what_the_suspension_did_at_the_compared_samples(
    corner: Twin, run_problem: Problem
) -> None:
    found = travel(corner, run_problem)
    (part,), (rows,) = run_problem.data.parts, run_problem.data.rows
    response = simulate_twin(corner, part.excitation)
    assert found.rate == run_problem.measured.rate == part.rate
    assert list(found.compression) == list(found.velocity) == [""]
    when = part.t[rows]
    beside(found.compression[""], response.t, response.deflection[:, 0], when)
    beside(found.velocity[""], response.t, response.deflection_rate[:, 0], when)
    # jounce is positive
    assert np.corrcoef(np.gradient(found.compression[""]), found.velocity[""])[0, 1] > 0.9
    assert found.static[""] == pytest.approx(corner.axles[""].static_compression, abs=1e-4)


def beside(got: np.ndarray, t: np.ndarray, recorded: np.ndarray, when: np.ndarray) -> None:
    """A sample of a grid is read at one of the two stamps that it lies between."""
    assert got.shape == when.shape
    after = np.array([np.flatnonzero(t >= w - 1e-9)[0] for w in when])
    off = [np.abs(got - recorded[i]) for i in (after, np.maximum(after - 1, 0))]
    assert np.minimum(*off).max() == 0.0


def test_travel_holds_the_last_stamp(corner: Twin, run_problem: Problem) -> None:
    """A grid may end a fraction of a step after what was simulated."""
    (part,) = run_problem.data.parts
    t = part.t + (part.excitation.t[-1] - part.t[-1]) + 0.4 / part.rate
    late = replace(part, t=t)
    rows = np.arange(part.t.size - 50, part.t.size)
    problem = problem_of(corner, run_problem.space, [late], [rows], "body_acceleration")
    found = travel(corner, problem)
    response = simulate_twin(corner, part.excitation)
    assert found.compression[""][-1] == response.deflection[-1, 0]
    assert found.velocity[""][-1] == response.deflection_rate[-1, 0]


def test_travel_of_a_car_is_that_of_both_wheels_of_each_axle_over_all_parts(pass_case: Any) -> None:
    twin = pass_case.truth
    whole = observe(read_drive(pass_case.bag("pass")), twin)
    parts = [whole, whole.part(whole.t[0] + 2.0, whole.t[-1])]
    rows = [np.arange(100, 400), np.arange(50, 150)]
    keys = [f"vehicle.{axle}.spring.force.0" for axle in ("front", "rear")]
    space = Space(twin, [Parameter(k, (1.0, 1e6), Prior(twin_value(twin, k), 0.5, "log")) for k in keys])
    problem = problem_of(twin, space, parts, rows, "vertical_acceleration")
    found = travel(twin, problem)
    assert list(found.compression) == list(found.velocity) == list(found.static) == ["front", "rear"]
    responses = [simulate_twin(twin, part.excitation) for part in parts]
    for axle, columns in (("front", (0, 1)), ("rear", (2, 3))):
        begin = 0
        for part, own, response in zip(parts, rows, responses, strict=True):
            end = begin + 2 * own.size
            for side, column in enumerate(columns):
                for got, recorded in (
                    (found.compression, response.deflection),
                    (found.velocity, response.deflection_rate),
                ):
                    beside(got[axle][begin:end][side::2], response.t, recorded[:, column], part.t[own])
            begin = end
        assert found.velocity[axle].size == found.compression[axle].size == begin
        # before a drive the car stands
        assert found.static[axle] == pytest.approx(twin.axles[axle].static_compression, abs=1e-3)


def test_a_vehicle_without_axles_does_not_travel(corner: Twin, repository: Path) -> None:
    problem: Any = Straight(space_of(corner, MASS), 0, rate=50.0)
    found = travel(load_twin(repository / "config" / "tracked" / "pt91.yaml"), problem)
    assert (found.compression, found.velocity, found.static, found.rate) == ({}, {}, {}, 50.0)


# -- what was excited ------------------------------------------------------------------------------


def curve(part: str, axle: str = "rear") -> Curve:
    x = np.array([0.1, 0.4])
    return Curve(f"vehicle.{axle}.{part}", x, x, (0, 1))


def moved(compression: np.ndarray, velocity: np.ndarray, rate: float = 100.0) -> Travel:
    other = np.full(1000, 7.0)
    return Travel(
        {"front": other, "rear": compression}, {"front": other, "rear": velocity}, {"rear": 0.1}, rate
    )


def test_a_point_is_excited_if_a_twentieth_of_a_second_lies_beyond_it() -> None:
    """Of both wheels: at 100 Hz ten samples, the one at the point counted."""
    rng = np.random.default_rng(0)
    compression, velocity = rng.permutation(np.arange(1.0, 501.0)), rng.permutation(np.arange(-99.5, 100.5))
    where = moved(compression, velocity)
    low, high = span_of(curve("spring"), where)
    assert np.sum(compression <= low) == np.sum(compression >= high) == 10
    low, high = span_of(curve("damper_push"), where)
    assert low == 0.0 and np.sum(velocity >= high) == 10
    low, high = span_of(curve("damper_pull"), where)
    assert low == 0.0 and np.sum(-velocity >= high) == 10
    assert span_of(curve("spring", "front"), where) == (7.0, 7.0)


@pytest.mark.parametrize("part", ["spring", "damper_push", "damper_pull"])
def test_the_same_motion_at_another_rate_excites_the_same(part: str) -> None:
    rng = np.random.default_rng(1)
    compression, velocity = 0.1 + 0.03 * rng.standard_normal(400), 0.2 * rng.standard_normal(400)
    once = span_of(curve(part), moved(compression, velocity, 40.0))
    often = span_of(curve(part), moved(compression.repeat(5), velocity.repeat(5), 200.0))
    assert once == often and once[0] < once[1]


@pytest.mark.parametrize("part", ["spring", "damper_push", "damper_pull"])
def test_so_short_a_motion_excites_nothing(part: str) -> None:
    """Less than three twentieths of a second; a damper counts the time that it moves its way."""
    sign = -1.0 if part == "damper_pull" else 1.0
    enough, short = sign * np.linspace(0.1, 0.3, 30), sign * np.linspace(0.1, 0.3, 29)
    backwards = -sign * np.ones(500) if part != "spring" else np.empty(0)
    assert np.isnan(span_of(curve(part), moved(short, np.append(short, backwards)))).all()
    assert np.isfinite(span_of(curve(part), moved(enough, np.append(enough, backwards)))).all()


def test_a_slow_rate_needs_one_sample_at_least() -> None:
    values = np.array([0.1, 0.2, 0.3])
    assert span_of(curve("spring"), moved(values, values, 2.0)) == (0.1, 0.3)
    assert span_of(curve("damper_push"), moved(values, values, 2.0)) == (0.0, 0.3)
