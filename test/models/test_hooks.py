# SPDX-License-Identifier: Apache-2.0
"""The seam that effects plug into: nothing when neutral, to the last bit; the named physics when not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.models import parameters
from suspension_twin.models.excitation import excitation
from suspension_twin.models.hooks import CornerChange, Hook, SignalStage
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes, simulate_twin

ROADS: dict[str, Callable[[Any, Any], None]] = {
    "scale": lambda c, v: c.scale.__iadd__(0.3 * v),
    "ahead": lambda c, v: c.ahead.__iadd__(0.5 * v),
    "left": lambda c, v: c.left.__iadd__(0.13 * v),
    "smooth": lambda c, v: c.smoothing.__iadd__(0.15 * v),
    "patch": lambda c, v: c.patch.__iadd__(0.2 * v),
}


def _payload(numbers: Any, values: Any) -> None:
    numbers["vehicle.mass"] = numbers["vehicle.mass"] + 300 * values["amount"]


def _rescale(signals: Any, t: Any, fresh: Any, values: Any, state: Any) -> None:
    signals *= 1 + values[0]


def _odd(change: CornerChange, values: Any) -> None:
    change.spring[0] += -0.3 * values["amount"]
    change.damper[1] += -0.5 * values["amount"]
    change.compliance[2] += 3e-6 * values["amount"]


HOOKS = {
    **{
        f"road_{k}": Hook(neutral={"amount": 0.0}, road=lambda c, v, f=f: f(c, v["amount"]))
        for k, f in ROADS.items()
    },
    "payload": Hook(neutral={"amount": 0.0}, vehicle=_payload),
    "corners": Hook(neutral={"amount": 0.0}, corners=_odd),
    "signal": Hook(neutral={"amount": 0.0}, signal=SignalStage(_rescale)),
}


@pytest.fixture(autouse=True)
def _effects(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameters, "load_hook", lambda name, model: HOOKS[name])


def with_effect(twin: Any, *names: str, amount: float = 0.0) -> Any:
    return twin.with_changes({"effects": [{"id": n, "parameters": {"amount": amount}} for n in names]})


@pytest.mark.parametrize("name", HOOKS)
def test_neutral_is_bit_identical_and_full_is_not(mondeo: Any, drive: Any, rough: Any, name: str) -> None:
    way = excitation(drive(seconds=2, jitter=0.3, yaw_rate=0.2), mondeo.vehicle, rough)
    plain = simulate_lanes(mondeo, lanes(mondeo, [], np.zeros((1, 0))), way)
    twin = with_effect(mondeo, name)
    # the same block: neutral lanes beside full ones
    amounts = np.array([[0.0], [1.0], [0.0], [0.5]])
    both = simulate_lanes(twin, lanes(twin, [f"effects.{name}.amount"], amounts), way)
    assert not both.failed.any()
    for lane in (0, 2):
        assert np.array_equal(both.force[:, :, lane], plain.force[:, :, 0])
        assert np.array_equal(both.rate[:, :, lane], plain.rate[:, :, 0])
    moved = np.abs(both.force[:, :, 1] - plain.force[:, :, 0]).max()
    half = np.abs(both.force[:, :, 3] - plain.force[:, :, 0]).max()
    assert moved > 0.01
    assert half > 0
    # the recorded run has the same numbers as the lane
    one = simulate_twin(with_effect(mondeo, name, amount=1.0), way)
    assert np.array_equal(one.force, both.force[:, :, 1])


def test_all_neutral_at_once(mondeo: Any, drive: Any, rough: Any) -> None:
    way = excitation(drive(seconds=1), mondeo.vehicle, rough)
    plain = simulate_twin(mondeo, way)
    twin = with_effect(mondeo, *HOOKS)
    names = [f"effects.{n}.amount" for n in HOOKS]
    amounts = np.vstack([np.zeros(len(names)), np.eye(len(names))])
    lane = simulate_lanes(twin, lanes(twin, names, amounts), way)
    assert np.array_equal(lane.force[:, :, 0], plain.force)
    # every lane answers its own effect alone, whatever runs beside it
    for k, name in enumerate(HOOKS):
        alone = simulate_twin(with_effect(mondeo, name, amount=1.0), way)
        assert np.array_equal(lane.force[:, :, k + 1], alone.force), name


def test_unknown_effect_and_parameter_are_named(mondeo: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    with pytest.raises(InputError, match="there is no effect no_such"):
        parameters.pack(mondeo.with_changes({"effects": [{"id": "no_such"}]}))
