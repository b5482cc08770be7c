# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a tracked vehicle: it names what was done to marker runs, says no gap and unknown when so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from suspension_twin.calibration.tracked_paper import simulate_runs
from suspension_twin.diagnosis.tracked import diagnose_tracked, diagnose_tracked_files
from suspension_twin.diagnosis.tracked_fit import NOTHING, evidence, fit, hypotheses_for, make_bench
from suspension_twin.diagnosis.tracked_own import OWN_SPREAD, driven, own_places, own_vehicle
from suspension_twin.diagnosis.tracked_visible import SHOWS, changes_of, visible_from
from suspension_twin.effects.tracked_effects import TRACKED_EFFECTS, apply_tracked, camera_of

from suspension_twin.diagnosis import tracked
from suspension_twin.errors import InputError
from suspension_twin.gap.marker_runs import MarkerRun
from suspension_twin.report.markers import diagnosis_page
from suspension_twin.vehicle.tracked import TrackedTwin
from suspension_twin.vehicle.twin import load_twin

SPEED = 13 / 3.6
KEYS = {
    "verdict",
    "gap",
    "where",
    "causes",
    "combination",
    "unexplained",
    "next_experiment",
    "seed",
    "message",
    "cannot_be_judged",
    "visible_from",
}


@pytest.fixture(scope="module")
def twin(repository: Path) -> TrackedTwin:
    loaded = load_twin(repository / "config" / "tracked" / "pt91.yaml")
    assert isinstance(loaded, TrackedTwin)
    return loaded


def film(
    twin: TrackedTwin, effects: dict[str, dict[str, float]], seed: int, speed: float = SPEED
) -> MarkerRun:
    """A run of the model itself with effects, and a camera's noise."""
    t = np.arange(0, 4.6, 0.02)
    empty = MarkerRun(t, *(np.zeros((t.size, 3)) for _ in range(3)), speed)  # type: ignore[arg-type]
    told = simulate_runs([apply_tracked(driven(twin.vehicle), effects)], [empty])[0]
    assert told is not None
    rng = np.random.default_rng(seed)
    seen = camera_of(effects).see(t, told[0].markers, told[0].velocity, told[0].acceleration, speed)
    z, v, a = (m + rng.normal(0, s, m.shape) for m, s in zip(seen, (5e-4, 5e-3, 0.08), strict=True))
    return MarkerRun(t, z, v, a, speed, f"13kmh_{seed}")


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few effects, and a twin that is as well calibrated as it can be."""
    few = {k: TRACKED_EFFECTS[k] for k in ("sensor_scale", "station_damper")}
    monkeypatch.setattr(tracked, "TRACKED_EFFECTS", few)
    monkeypatch.setattr(tracked, "calibrate_to", lambda vehicle, runs: vehicle)


def test_a_dead_damper_is_named_with_its_station(twin: TrackedTwin, short: None, tmp_path: Path) -> None:
    fault = {"station_damper": {"station": 6.0, "share": 0.1}}
    runs, reference = [film(twin, fault, 1)], [film(twin, {}, k) for k in (3, 4)]
    result = diagnose_tracked(twin, runs, reference)
    d = result.document
    assert set(d) >= KEYS and d["verdict"] == "effect" and d["combination"] == ["station_damper"]
    top = d["causes"][0]
    assert top["effect"] == "station_damper" and top["probability"] > 0.9 and top["shrink"] > 0.8
    assert top["indistinguishable_from"] == []
    assert top["parameters"]["station"] == 6.0 and top["parameters"]["share"] == pytest.approx(0.1, abs=0.1)
    low, high = top["shrink_interval"]
    assert low <= top["shrink"] <= high + 1e-9
    assert sum(c["probability"] for c in d["causes"]) + d["no_gap_probability"] + d[
        "unknown_probability"
    ] == (pytest.approx(1.0, abs=1e-4))
    json.dumps(d, allow_nan=False)
    assert result.twin.effects[0].id == "station_damper"
    page = diagnosis_page(result).write(tmp_path / "report.html")
    assert "station damper" in Path(page).read_text(encoding="utf-8")


def test_a_sound_vehicle_has_no_gap(twin: TrackedTwin, short: None) -> None:
    result = diagnose_tracked(twin, [film(twin, {}, 1)], [film(twin, {}, 3), film(twin, {}, 4)])
    assert result.document["verdict"] == "no_gap" and result.document["combination"] == []
    assert result.document["no_gap_probability"] > 0.5 and result.twin.effects == ()
    start = result.document["visible_from"]["station_damper"]["share"]
    assert 0.2 < start < 0.98 and f"share above {start:g}" in result.document["message"]


def test_what_no_effect_is_remains_unknown(twin: TrackedTwin, short: None) -> None:
    runs = [film(twin, {}, 1)]
    shake = 0.06 * np.sin(9.0 * runs[0].t)[:, None] * np.array([1.0, -1.0, 1.0])
    odd = [
        replace(r, markers=r.markers + shake, velocity=r.velocity + np.gradient(shake, r.t, axis=0))
        for r in runs
    ]
    document = diagnose_tracked(twin, odd, [film(twin, {}, 3), film(twin, {}, 4)]).document
    assert document["verdict"] == "unknown" and document["unknown_probability"] > 0.5
    assert document["signature"]["peak_hz"] == pytest.approx(9.0 / (2 * np.pi), abs=0.5)


def test_each_kind_of_effect_is_found_by_its_own_hypothesis(twin: TrackedTwin) -> None:
    reference = [film(twin, {}, 3), film(twin, {}, 4)]
    cases = {
        "station_bar": {"station": 2.0, "sag": 0.1},
        "sensor_tilt": {"roll": 0.01},
    }
    for name, values in cases.items():
        bench = make_bench(twin.vehicle, [film(twin, {name: values}, 1)], reference)
        base = fit(bench, NOTHING)
        place = int(values.get("station", 1)) - 1
        found = fit(bench, hypotheses_for(name, twin.vehicle)[place])
        assert base is not None and found is not None
        assert found.score < 0.6 * base.score, name
        told = found.hypothesis.given(found.x)[name]
        for key, value in values.items():
            assert told[key] == pytest.approx(value, rel=0.35), (name, key)


@pytest.mark.parametrize(("seconds", "quiet"), [(0.02, True), (-0.1, False), (0.15, False)])
def test_a_clock_is_wrong_beyond_what_starts_differ_by(
    twin: TrackedTwin, seconds: float, quiet: bool
) -> None:
    late = {"time_offset": {"seconds": seconds}}
    bench = make_bench(
        twin.vehicle, [film(twin, late, k) for k in (1, 2)], [film(twin, {}, k) for k in (3, 4)]
    )
    base = fit(bench, NOTHING)
    assert base is not None and (base.left < 1.5) == quiet
    if not quiet:
        found = fit(bench, hypotheses_for("time_offset", twin.vehicle)[0])
        assert found is not None and found.left < 1.2
        assert found.x[0] == pytest.approx(seconds, abs=0.02)  # when a run starts is known to 15 ms
        assert evidence(bench, found) > evidence(bench, base) + 10.0


def test_where_the_model_misses_the_sound_vehicle_it_is_doubted(twin: TrackedTwin) -> None:
    runs, sound = [film(twin, {}, 1)], [film(twin, {}, k) for k in (3, 4)]
    bump = (
        0.05 * np.exp(-(((sound[0].t - 2.0) / 0.1) ** 2))[:, None]
    )  # of the real vehicle, with and without a fault
    shaken = [replace(r, markers=r.markers + bump) for r in (*runs, *sound)]
    plain, doubted = make_bench(twin.vehicle, runs, sound), make_bench(twin.vehicle, shaken[:1], shaken[1:])
    there, elsewhere = int(2.0 * runs[0].rate), int(4.0 * runs[0].rate)
    assert doubted.scale[0][there, 0] > 5 * plain.scale[0][there, 0]
    assert doubted.scale[0][elsewhere, 0] == pytest.approx(plain.scale[0][elsewhere, 0], rel=0.3)
    one, other = (fit(b, NOTHING) for b in (plain, doubted))
    assert one is not None and other is not None and other.left == pytest.approx(one.left, abs=0.3)


def test_what_is_a_vehicles_own_goes_there_and_back(twin: TrackedTwin) -> None:
    places = own_places(twin.vehicle)
    same, other = own_vehicle(twin.vehicle, places), own_vehicle(twin.vehicle, places + OWN_SPREAD)
    assert own_places(same) == pytest.approx(places)
    assert (same.mass, same.arm, same.cog) == (twin.vehicle.mass, twin.vehicle.arm, twin.vehicle.cog)
    assert (
        other.mass == pytest.approx(twin.vehicle.mass * np.exp(0.03))
        and other.arm.stiffness > same.arm.stiffness
    )
    far = own_vehicle(twin.vehicle, places + 100.0)  # kept within what it can be
    assert far.gyration == pytest.approx(twin.vehicle.gyration * np.exp(0.15))


def test_what_cannot_be_diagnosed(twin: TrackedTwin, repository: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none is given"):
        diagnose_tracked(twin, [])
    car = min((repository / "config" / "twins").glob("*.yaml"))
    with pytest.raises(InputError, match="marker runs are of a tracked vehicle"):
        diagnose_tracked_files(str(car), ["13kmh.csv"])


def test_what_the_runs_do_not_tell_of_cannot_be_judged(
    twin: TrackedTwin, short: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of a track's tension the model tells too little: no gap does not speak against one that is off."""
    few = {k: TRACKED_EFFECTS[k] for k in ("sensor_scale", "track_tension")}
    monkeypatch.setattr(tracked, "TRACKED_EFFECTS", few)
    result = diagnose_tracked(twin, [film(twin, {}, 1)], [film(twin, {}, 3), film(twin, {}, 4)])
    d = result.document
    assert d["verdict"] == "no_gap" and d["cannot_be_judged"] == ["track_tension"]
    assert "track tension cannot be judged" in d["message"] and "track tension" in d["next_experiment"]
    assert {c["effect"]: c["judged"] for c in d["causes"]} == {"sensor_scale": True, "track_tension": False}
    page = diagnosis_page(result).write(tmp_path / "report.html")
    assert "track tension (cannot be judged)" in Path(page).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("effect", "values"),
    [("track_tension", {"tighter": 18.0}), ("track_wear", {"stiffness": 0.4, "elongation": 0.0})],
)
def test_where_the_track_does_show_it_is_named(
    twin: TrackedTwin, short: None, monkeypatch: pytest.MonkeyPatch, effect: str, values: dict[str, float]
) -> None:
    """In motion of the model itself nothing hides it, and what is named is not among what cannot be judged."""
    few = {k: TRACKED_EFFECTS[k] for k in ("sensor_scale", "station_bar", "track_tension", "track_wear")}
    monkeypatch.setattr(tracked, "TRACKED_EFFECTS", few)
    runs = [film(twin, {effect: values}, k, v) for v in (8 / 3.6, SPEED) for k in (1, 2)]
    d = diagnose_tracked(
        twin, runs, [film(twin, {}, k, v) for v in (8 / 3.6, SPEED) for k in (3, 4)]
    ).document
    assert d["combination"] == [effect], d["message"]
    assert effect not in d["cannot_be_judged"] and d["causes"][0]["judged"]
    main = next(iter(values))
    assert d["causes"][0]["parameters"][main] == pytest.approx(values[main], rel=0.25)


def test_an_effect_shows_from_where_it_changes_more_than_noise(twin: TrackedTwin) -> None:
    reference = [film(twin, {}, 3), film(twin, {}, 4)]
    bench = make_bench(twin.vehicle, [film(twin, {}, 1)], reference)
    levels = changes_of(bench, [{"sensor_scale": {"gain": g}} for g in (1.0, 1.02, 1.04, 1.08)])
    assert levels[0] == pytest.approx(0.0, abs=1e-6)
    assert levels[2] == pytest.approx(2 * levels[1], rel=0.05) and levels[3] == pytest.approx(
        4 * levels[1], rel=0.05
    )
    found = visible_from(bench, "sensor_scale", hypotheses_for("sensor_scale", twin.vehicle))
    assert found.judged and np.interp(found.start, (1.0, 1.02), (0.0, levels[1])) == pytest.approx(
        SHOWS, rel=0.2
    )
    late = changes_of(bench, [{"time_offset": {"seconds": s}} for s in (0.01, 0.2)])
    assert late[0] < 0.2 and late[1] > 1.0  # the start of a clock takes the first


def test_a_cause_that_explains_a_part_is_sure_and_not_complete(twin: TrackedTwin, short: None) -> None:
    """A dead damper, and a shake that nothing explains: partly, and the damper is no less there for that."""
    runs = [film(twin, {"station_damper": {"station": 6.0, "share": 0.0}}, k) for k in (1, 2)]
    shake = 0.016 * np.sin(9.0 * runs[0].t)[:, None] * np.array([1.0, -1.0, 1.0])
    odd = [
        replace(r, markers=r.markers + shake, velocity=r.velocity + np.gradient(shake, r.t, axis=0))
        for r in runs
    ]
    d = diagnose_tracked(twin, odd, [film(twin, {}, 3), film(twin, {}, 4)]).document
    assert d["verdict"] == "partly" and d["combination"] == ["station_damper"]
    assert d["causes"][0]["probability"] > 0.6 > 0.4 > d["unknown_probability"]
    assert sum(c["probability"] for c in d["causes"]) + d["no_gap_probability"] + d[
        "unknown_probability"
    ] == (pytest.approx(1.0, abs=1e-4))


def test_a_set_is_of_those_that_explain_something(
    twin: TrackedTwin, short: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However near in evidence: what closes nothing is not one of those that cannot be told apart."""
    monkeypatch.setattr(tracked, "_TIED", 1e9)
    runs = [film(twin, {"station_damper": {"station": 6.0, "share": 0.1}}, 1)]
    d = diagnose_tracked(twin, runs, [film(twin, {}, 3), film(twin, {}, 4)]).document
    shrink = {c["effect"]: c["shrink"] for c in d["causes"]}
    assert d["combination"] == ["station_damper"] and shrink["sensor_scale"] < 0.1
    assert d["causes"][0]["indistinguishable_from"] == []


def test_what_cannot_be_judged_may_be_behind_a_faint_cause(
    twin: TrackedTwin, short: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cause has to gain more than chance gains where the model does not tell of what it is."""
    few = {k: TRACKED_EFFECTS[k] for k in ("sensor_scale", "station_damper", "track_tension")}
    monkeypatch.setattr(tracked, "TRACKED_EFFECTS", few)
    runs = [film(twin, {"station_damper": {"station": 6.0, "share": 0.1}}, 1)]
    reference = [film(twin, {}, 3), film(twin, {}, 4)]
    sure = diagnose_tracked(twin, runs, reference).document
    assert sure["combination"] == ["station_damper"] and sure["cannot_be_judged"] == ["track_tension"]
    gain = sure["causes"][0]["log_evidence"]
    monkeypatch.setattr(tracked, "_UNTOLD", gain + 3.0)
    faint = diagnose_tracked(twin, runs, reference).document
    assert faint["verdict"] == "unknown" and faint["combination"] == []
    assert faint["unknown_probability"] == pytest.approx(1 / (1 + np.exp(-3.0)), abs=0.02)
    assert sum(c["probability"] for c in faint["causes"]) + faint["unknown_probability"] == pytest.approx(
        1, abs=1e-3
    )
    assert "track tension" in faint["message"]
    monkeypatch.setattr(tracked, "TRACKED_EFFECTS", {k: few[k] for k in ("sensor_scale", "station_damper")})
    assert diagnose_tracked(twin, runs, reference).document["combination"] == ["station_damper"]


@pytest.mark.parametrize(("roll", "named"), [(0.0, []), (0.0001, []), (0.00033, ["sensor_tilt"])])
def test_what_shows_is_named_in_a_gap_that_is_hardly_more_than_what_repeats_differ_by(
    twin: TrackedTwin, monkeypatch: pytest.MonkeyPatch, roll: float, named: list[str]
) -> None:
    """A third of a milliradian in 4.6 s: little in any sample, and nothing but a turned camera drifts like it."""
    few = {k: TRACKED_EFFECTS[k] for k in ("sensor_tilt", "station_damper", "track_tension")}
    monkeypatch.setattr(tracked, "TRACKED_EFFECTS", few)
    monkeypatch.setattr(tracked, "calibrate_to", lambda vehicle, runs: vehicle)
    runs, reference = [film(twin, {"sensor_tilt": {"roll": roll}}, 1)], [film(twin, {}, k) for k in (3, 4)]
    base = fit(make_bench(twin.vehicle, runs, reference), NOTHING)
    assert base is not None and np.sqrt(base.left) < tracked._QUIET
    d = diagnose_tracked(twin, runs, reference).document
    assert d["combination"] == named and d["verdict"] == ("effect" if named else "no_gap")
    assert d["cannot_be_judged"] == ["track_tension"]
    if named:
        assert d["causes"][0]["parameters"]["roll"] == pytest.approx(roll, rel=0.2)


def test_a_track_that_cannot_be_judged_looks_like_something_of_the_vehicle() -> None:
    gain = {"payload": 6.0, "station_bar": 1.5, "track_tension": 0.2, "sensor_tilt": 2.0, "time_offset": -0.3}
    assert (
        tracked._untold("track_tension", gain) == tracked._UNTOLD
    )  # for a payload a slack track may be behind it
    assert (
        tracked._untold("time_offset", gain) == 2.0
    )  # a clock looks like a payload no more than a tilt does
    turned = gain | {"sensor_tilt": 9.0}
    assert (
        tracked._untold("track_tension", turned) == 6.0
        and tracked._untold("time_offset", turned) == tracked._UNTOLD
    )
    nothing = {"track_tension": -0.2, "sensor_tilt": 4.0}
    assert tracked._untold("track_tension", nothing) == 0.0
