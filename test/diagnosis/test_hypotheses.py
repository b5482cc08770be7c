# SPDX-License-Identifier: Apache-2.0
"""Effects as hypotheses: every one, with its bounds, neutral point and starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from suspension_twin.diagnosis.library import DECOYS, WITHOUT_ROAD, decoys, library, variants
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.hypothesis import Hypothesis, combined
from suspension_twin.vehicle.twin import EffectSpec, Twin, load_twin


@pytest.fixture(params=[(n, m) for n in sorted(EFFECTS) for m in EFFECTS[n].models], ids="-".join)
def offered(request: Any, car: Twin, repository: Path) -> tuple[str, list[Hypothesis]]:
    """An effect and its hypotheses on a model that it applies to."""
    name, model = request.param
    return name, variants(EFFECTS[name].on(model), _of_model(model, car, repository))


def _of_model(model: str, car: Twin, repository: Path) -> Twin:
    tracked = load_twin(repository / "config" / "tracked" / "pt91.yaml")
    return tracked if model == "tracked" else car.model_copy(update={"model": model})


def test_starts_lie_in_the_bounds_and_away_from_nothing(offered: tuple[str, list[Hypothesis]]) -> None:
    name, hypotheses = offered
    for hypothesis in hypotheses:
        starts = hypothesis.starts(16, 0)
        low, high = hypothesis.bounds()
        assert starts.shape == (len(hypothesis), 16)
        assert (starts >= low[:, None]).all() and (starts <= high[:, None]).all()
        values = hypothesis.values(starts)
        for row, (key, parameter) in zip(values, hypothesis.searched, strict=True):
            assert (row >= parameter.lower).all() and (row <= parameter.upper).all(), key
        severe = [i for i, (_, p) in enumerate(hypothesis.searched) if p.name in EFFECTS[name].severity]
        assert (np.ptp(values[severe], axis=1) > 0).all()
        for values_of_one in values.T:
            for spec in hypothesis.spec(values_of_one):
                hypothesis.effect(name).values(spec.parameters)  # raises where the twin file would be refused


def test_every_choice_is_a_hypothesis(car: Twin) -> None:
    corners = [dict(v.fixed)["effects.corner_damper.corner"] for v in variants(EFFECTS["corner_damper"], car)]
    assert corners == [0.0, 1.0, 2.0, 3.0]


def test_the_library_leaves_out_what_needs_a_road(car: Twin) -> None:
    everything = {n for n, e in EFFECTS.items() if "full_car" in e.hook.models}
    assert set(library(car, excited=True)) == everything - set(DECOYS)
    assert set(library(car, excited=False)) == set(WITHOUT_ROAD)


def test_an_effect_that_the_twin_has_is_offered_with_another_size(
    offered: tuple[str, list[Hypothesis]], car: Twin, repository: Path
) -> None:
    """No change is the twin's own size, about which the prior and the starts lie; a part that it is of stays."""
    name, (*_, first) = offered
    (spec,) = first.spec(first.values(first.starts(4, 2))[:, 2])
    twin = _of_model(first.model, car, repository).model_copy(update={"effects": (spec,)})
    (other,) = variants(EFFECTS[name].on(first.model), twin)
    assert other.fixed == first.fixed and other.keys == first.keys
    for still in (other.centre(), other.neutral(), *other.negligible().T):
        assert_allclose(still, first.at(spec), rtol=1e-9, atol=1e-12)
    starts, (low, high) = other.starts(64, 1), other.bounds()
    inside = (other.centre() > low + 2.0) & (other.centre() < high - 2.0)
    assert np.all(np.abs(np.median(starts, axis=1) - other.centre())[inside] < 0.5)
    assert combined(other, other.without(name)).held == other.held and not other.without(name).held
    assert [e.id for e in other.twin(twin).effects] == [name]


def test_the_library_holds_what_the_twin_has(car: Twin) -> None:
    having = car.model_copy(update={"effects": (EffectSpec(id="time_offset", parameters={"offset": 0.1}),)})
    (clock,) = library(having, excited=True)["time_offset"]
    assert clock.values(clock.centre()[:, None])[0, 0] == pytest.approx(0.1)


def test_a_decoy_is_named_only_where_it_is_asked_for(car: Twin) -> None:
    asked = ("progressive_spring", "payload")
    assert set(library(car, True, asked)) == set(asked)
    assert set(decoys(car, True, asked)) == set(DECOYS) - set(asked)
    assert set(decoys(car, True, ("payload",))) == set(decoys(car, True)) == set(DECOYS)
    assert not decoys(car, excited=False)
    having = car.model_copy(update={"effects": (EffectSpec(id="damper_play", parameters={"front": 0.001}),)})
    assert "damper_play" not in decoys(having, True)


def test_a_resonance_is_looked_for_everywhere(car: Twin) -> None:
    known = library(car, True)
    scans = {name: [v.scan(9) for v in of] for name, of in known.items()}
    assert {n for n, s in scans.items() if s[0] is not None} == {
        "body_bending",
        "mount_resonance",
        "powertrain_mount",
    }
    for name in ("body_bending", "mount_resonance", "powertrain_mount"):
        (row, points), (hypothesis,) = scans[name][0], known[name]
        severe, tone = hypothesis.searched[row][1], EFFECTS[name].parameter("frequency")
        assert severe.name in EFFECTS[name].severity
        values = dict(zip(hypothesis.keys, hypothesis.values(points), strict=True))
        heard = values[f"effects.{name}.frequency"]
        assert heard[0] == pytest.approx(tone.lower) and heard[-1] == pytest.approx(tone.upper)
        assert np.ptp(np.diff(np.log(heard))) < 1e-9
        assert (values[f"effects.{name}.{severe.name}"] != severe.neutral).all()


def test_combined_hypotheses_keep_their_order(car: Twin) -> None:
    first, second = variants(EFFECTS["payload"], car)[0], variants(EFFECTS["corner_spring"], car)[2]
    both = combined(first, second)
    assert both.effects == ("payload", "corner_spring")
    assert both.keys == (*first.keys, *second.keys)
    assert [s.id for s in both.twin(car).effects] == ["payload", "corner_spring"]


def test_next_to_nothing_is_zero_or_either_end_of_what_goes_by_factors(car: Twin) -> None:
    effects = {e: variants(EFFECTS[e], car) for e in ("strut_friction", "sensor_bandwidth", "top_mount")}
    friction, band, mount = (effects[e][0] for e in ("strut_friction", "sensor_bandwidth", "top_mount"))
    np.testing.assert_array_equal(friction.negligible()[:, 0], friction.neutral())
    assert friction.negligible().shape[1] == 1
    assert sorted(band.values(band.negligible())[0]) == pytest.approx([0.5, 500.0])
    ends = mount.values(mount.negligible())
    assert ends.shape == (2, 2) and (ends[0] == ends[1]).all() and ends[0, 0] != ends[0, 1]


def test_an_effect_of_a_twin_file_has_its_place(offered: tuple[str, list[Hypothesis]], car: Twin) -> None:
    name, hypotheses = offered
    for hypothesis in hypotheses:
        values = hypothesis.values(hypothesis.starts(4, 1))[:, 3]
        (spec,) = hypothesis.spec(values)
        assert_allclose(hypothesis.values(hypothesis.at(spec)[:, None])[:, 0], values, rtol=1e-9, atol=1e-12)
        having = hypothesis.twin(car.model_copy(update={"effects": (spec,)}))
        assert [e.id for e in having.effects] == [name]  # in place of its own


def test_preexisting_effects_are_there_before_and_what_came_since_is_not(car: Twin) -> None:
    known = library(car, True)
    late, trait, other = (
        known["strut_friction"][0],
        known["corner_damper"][2].on_all_drives(),
        known["payload"][0].on_all_drives(),
    )
    whole = combined(late, trait, other)
    assert whole.effects == ("strut_friction", "corner_damper", "payload")
    assert whole.on_reference() == combined(trait, other)
    assert whole.without("payload").on_reference() == trait
    assert [whole.keys[i] for i in whole.rows(other)] == list(other.keys)
    assert not late.on_reference().effects and not late.on_reference().keys
