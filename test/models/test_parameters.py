# SPDX-License-Identifier: Apache-2.0
"""One number that can be free: its prior, its search coordinate and its place about a twin's value."""

from __future__ import annotations

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.models.parameters import Parameter, Prior

OFFSET = Parameter("offset", (-2.0, 2.0), Prior(0.1, 0.05), "s")
CUTOFF = Parameter("cutoff", (0.5, 500.0), Prior(15.0, 2.0, "factor"), "Hz")
MASS = Parameter("vehicle.mass", (1000.0, 2000.0), Prior(1500.0, 0.1, "log"), "kg")
CORNER = Parameter("corner", (0.0, 1.0), Prior(0.0, 1.0), choices=(0.0, 1.0))


@pytest.mark.parametrize("parameter", [OFFSET, CUTOFF, MASS])
def test_the_coordinate_of_a_value_is_the_inverse_of_the_value_of_a_coordinate(parameter: Parameter) -> None:
    u = np.array([-1.5, 0.0, 1.0])
    values = parameter.value(u)
    assert values[1] == parameter.prior.typical
    np.testing.assert_allclose([parameter.coordinate(v) for v in values], u, atol=1e-12)


def test_one_standard_deviation_is_the_spread_as_its_scale_says() -> None:
    one = np.array([1.0])
    assert OFFSET.value(one) == pytest.approx(0.15) and OFFSET.prior.deviation == 0.05
    assert CUTOFF.value(one) == 30.0 and CUTOFF.prior.deviation == pytest.approx(np.log(2.0))
    assert MASS.value(one) == pytest.approx(1500.0 * np.exp(0.1)) and MASS.prior.deviation == 0.1
    assert [p.prior.log for p in (OFFSET, CUTOFF, MASS)] == [False, True, True]


def test_values_are_inside_the_bounds() -> None:
    far = np.array([-100.0, 100.0])
    for parameter in (OFFSET, CUTOFF, MASS):
        assert tuple(parameter.value(far)) == parameter.bounds == (parameter.lower, parameter.upper)


def test_about_a_twin_the_prior_is_about_its_value_inside_the_bounds() -> None:
    key = "effects.time_offset.offset"
    late = OFFSET.about(key, 0.4)
    assert (late.key, late.name, late.prior.typical, late.bounds) == (key, "offset", 0.4, OFFSET.bounds)
    narrow = OFFSET.about(key, 0.4, (0.0, 0.3))
    assert narrow.bounds == (0.0, 0.3) and narrow.prior.typical == 0.3
    assert late.prior.spread == OFFSET.prior.spread


def test_a_logarithm_starts_above_zero_and_is_none_where_zero_is_within() -> None:
    key = "effects.sensor_bandwidth.cutoff"
    assert CUTOFF.about(key, 0.0).prior.typical == 15.0  # the twin's is neutral
    assert CUTOFF.about(key, 40.0).prior == Prior(40.0, 2.0, "factor")
    assert not CUTOFF.about(key, 0.0, (0.0, 9.0)).prior.log


@pytest.mark.parametrize(("parameter", "value"), [(OFFSET, 2.1), (CORNER, 0.5)])
def test_a_value_out_of_bounds_or_choices_is_refused_by_name(parameter: Parameter, value: float) -> None:
    assert parameter.check("some_effect", parameter.neutral) == parameter.neutral
    with pytest.raises(InputError, match=rf"some_effect\.{parameter.name}"):
        parameter.check("some_effect", value)
