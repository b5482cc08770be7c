# SPDX-License-Identifier: Apache-2.0
"""Steps in made-up series: found where there is one, with its date and size, and not where there is none."""

from __future__ import annotations

import numpy as np

from suspension_twin.addons.fleet.changes import ChangePoint, QuantitySeries, step_in


def series(
    seed: int, ratio: float, at: int, n: int = 20, sigma: float = 0.03, scatter: float = 0.03
) -> ChangePoint:
    rng = np.random.default_rng(seed)
    truth = 1200.0 * np.where(np.arange(n) >= at, ratio, 1.0)
    values = truth * np.exp(np.hypot(sigma, scatter) * rng.standard_normal(n))
    dates = tuple(f"{d:02d}" for d in range(n))
    found = step_in(QuantitySeries("car", "force", "N", dates, tuple(values), tuple(sigma * values)))
    assert found is not None
    return found


def test_a_step_is_found_at_its_date_and_with_its_size() -> None:
    found = [series(seed, 0.7, 12) for seed in range(50)]
    assert all(c.named for c in found)
    assert all(abs(int(c.date) - 12) <= 2 for c in found)
    assert sum(c.earliest <= "12" <= c.latest for c in found) >= 45
    assert sum(c.ratio[1] <= 0.7 <= c.ratio[2] for c in found) >= 40


def test_no_step_is_named_where_there_is_none() -> None:
    assert not any(series(seed, 1.0, 0).named for seed in range(200))


def test_one_estimate_that_is_off_is_no_change() -> None:
    values = (1000.0, 1010.0, 995.0, 1005.0, 990.0, 1000.0, 1008.0, 600.0)
    found = step_in(QuantitySeries("car", "force", "N", tuple("abcdefgh"), values, (10.0,) * 8))
    assert found is not None and not found.named


def test_a_series_too_short_has_no_change_point() -> None:
    assert step_in(QuantitySeries("car", "force", "N", tuple("abc"), (1.0, 1.0, 2.0), (0.1,) * 3)) is None
