# SPDX-License-Identifier: Apache-2.0
"""The International Roughness Index is that of the standard's tables and of an independent integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.roughness import golden_car, iri, iri_along, iso8608_road


def golden_car_step(step: float) -> tuple[Floats, Floats]:
    """Transition matrix and input vector over ``step`` m of road at 80 km/h."""
    a, b = golden_car()
    matrix = expm(a * step / (80.0 / 3.6))
    return matrix, np.linalg.solve(a, (matrix - np.eye(4)) @ b)


@pytest.mark.parametrize(
    ("step", "matrix", "vector"),
    [  # Sayers, Gillespie and Paterson, World Bank Technical Paper 46 (1986): coefficients of the IRI equations
        (
            0.1,
            [
                [0.9994014, 4.442351e-3, 2.188854e-4, 5.72179e-5],
                [-0.2570548, 0.975036, 7.966216e-3, 2.458427e-2],
                [3.960378e-3, 3.814527e-4, 0.9548048, 4.055587e-3],
                [1.687312, 0.1638951, -19.34264, 0.7948701],
            ],
            [3.793992e-4, 0.2490886, 4.123478e-2, 17.65532],
        ),
        (
            0.25,
            [
                [0.9966071, 1.091514e-2, -2.083274e-3, 3.190145e-4],
                [-0.5563044, 0.9438768, -0.8324718, 5.064701e-2],
                [2.153176e-2, 2.126763e-3, 0.7508714, 8.221888e-3],
                [3.335013, 0.3376467, -39.12762, 0.4347564],
            ],
            [5.476107e-3, 1.388776, 0.2275968, 35.79262],
        ),
    ],
)
def test_coefficients_are_the_published_ones(
    step: float, matrix: list[list[float]], vector: list[float]
) -> None:
    own = golden_car_step(step)
    np.testing.assert_allclose(own[0], matrix, rtol=2e-5, atol=1e-7)
    np.testing.assert_allclose(own[1], vector, rtol=1e-3)  # given in single precision by differences


def test_the_published_recursion_gives_the_same_index() -> None:
    """The computation of the standard, step by step, on a profile at its own interval of 0.25 m."""
    z = iso8608_road("B", 400.0, width=2.0, step=0.25, seed=3).z[:, 0]
    matrix, vector = golden_car_step(0.25)
    start = (z[44] - z[0]) / 11.0
    state, total = np.array([start, 0.0, start, 0.0]), 0.0
    for slope in np.diff(z) / 0.25:
        state = matrix @ state + vector * slope
        total += abs(state[0] - state[2])
    assert iri(z, 0.25) == pytest.approx(total / (z.size - 1), rel=1e-9)


def test_a_bump_moves_the_golden_car_as_its_equations_say() -> None:
    """A triangle of 0.01 m over 4 m, integrated in time with heights instead of slopes."""
    v, step = 80.0 / 3.6, 0.25
    u = np.arange(0.0, 60.0 + step, step)
    z = np.interp(u, [20.0, 22.0, 24.0], [0.0, 0.01, 0.0])

    def rate(t: float, s: np.ndarray) -> list[float]:  # type: ignore[type-arg]
        road = float(np.interp(v * t, u, z))
        force = 63.3 * (s[2] - s[0]) + 6.0 * (s[3] - s[1])
        return [s[1], force, s[3], (653.0 * (road - s[2]) - force) / 0.15]

    t = u / v
    found = solve_ivp(rate, (0.0, t[-1]), np.zeros(4), t_eval=t, max_step=2e-3, rtol=1e-9, atol=1e-12)
    travel = np.abs(found.y[1] - found.y[3])[1:] / v
    np.testing.assert_allclose(iri_along(z, step), travel, atol=2e-6)


def test_a_grade_is_no_roughness_and_heights_scale() -> None:
    z = iso8608_road("C", 200.0, width=2.0, step=0.1).z[:, 0]
    grade = 0.05 * 0.1 * np.arange(z.size)
    assert iri(grade, 0.1) == 0.0
    assert iri(z + grade, 0.1) == pytest.approx(iri(z, 0.1), rel=1e-6)
    assert iri(2.0 * z, 0.1) == pytest.approx(2.0 * iri(z, 0.1), rel=1e-12)


@pytest.mark.parametrize(("n", "step", "words"), [(40, 0.25, "11 m"), (100, 0.5, "0.3 m")])
def test_what_the_standard_does_not_cover_is_refused(n: int, step: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        iri(np.zeros(n), step)
