# SPDX-License-Identifier: Apache-2.0
"""Worn dampers are the dampers of another file."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import given, respond

from suspension_twin.vehicle.twin import Twin


@pytest.mark.parametrize("model", ["full_car", "msd"])
@pytest.mark.parametrize(("front", "rear"), [(0.5, 0.0), (0.0, 0.7), (0.4, 0.2)])
def test_they_are_the_file_with_less_force(twin: Twin, model: str, front: float, rear: float) -> None:
    car = twin.model_copy(update={"model": model})
    changes = {}
    for axle, loss in (("front", front), ("rear", rear)):
        for part in ("damper_push", "damper_pull"):
            force = getattr(getattr(twin.vehicle, axle), part).force
            changes[f"vehicle.{axle}.{part}.force"] = tuple((1.0 - loss) * f for f in force)
    worn, by_hand = (
        respond(given(car, worn_dampers={"front": front, "rear": rear})),
        respond(car.with_changes(changes)),
    )
    np.testing.assert_allclose(worn.force, by_hand.force, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(worn.rate, by_hand.rate, rtol=1e-9, atol=1e-9)
