# SPDX-License-Identifier: Apache-2.0
"""What the page is told of a running twin."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from suspension_twin.addons.view.live import LiveView, NodeStatus, advice, scene
from suspension_twin.addons.view.server import NODES, SIDE, tile
from suspension_twin.vehicle.twin import load_twin

START = 1_700_000_000_000_000_000


def fill(
    view: LiveView, seconds: float, speed: float = 5.0, difference: float = 0.0, begin: float = 0.0
) -> None:
    """Drive east at ``speed``, 3 Hz and 1 m/s² measured, simulated with an error of the same shape."""
    for k in range(int(seconds * 100)):
        t = begin + 0.01 * k
        ns, value = START + round(t * 1e9), math.sin(6 * math.pi * t)
        view.measured(ns, value)
        view.simulated(ns, (1 - difference) * value)
        view.pose(ns, (speed * t, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        view.joints(ns, (0.1, 0.1, 0.2, 0.2))


def test_frames_put_together_are_the_snapshot():
    view = LiveView()
    kept: dict[str, list] = {"measured": [], "simulated": [], "pose": [], "path": []}
    for second in range(4):
        fill(view, 1.0, begin=float(second))
        frame = view.frame()
        for name, rows in kept.items():
            rows += frame.get(name, [])
    whole = view.snapshot()
    for name, rows in kept.items():
        assert rows == whole[name] and len(rows) >= 30
    assert view.frame() == {}
    assert len(whole["path"]) == pytest.approx(2 * 20, abs=2)


def test_only_the_last_seconds_of_the_signals_are_kept_and_all_of_the_path():
    view = LiveView()
    fill(view, 40.0)
    whole = view.snapshot()
    assert len(whole["measured"]) == pytest.approx(1200, abs=2)
    assert whole["path"][0][:2] == [0.0, 1.0] and whole["path"][-1][0] == pytest.approx(200.0, abs=1.0)


def test_the_path_has_the_gap_of_each_piece():
    view = LiveView()
    fill(view, 4.0, difference=0.0)
    fill(view, 4.0, difference=0.5, begin=4.0)
    gaps = np.array(view.snapshot()["path"])
    first, second = gaps[2 : len(gaps) // 2 - 2, 2], gaps[len(gaps) // 2 + 2 :, 2]
    assert np.abs(first).max() < 1e-6
    assert np.sqrt(np.mean(second**2)) == pytest.approx(0.5 / math.sqrt(2), rel=0.1)


@pytest.mark.parametrize("first", ["measured", "simulated"])
def test_the_path_is_coloured_whichever_signal_comes_first(first):
    """The simulated value of a stamp is published before the measured one."""
    view = LiveView()
    other = {"measured": "simulated", "simulated": "measured"}[first]
    for k in range(400):
        ns = START + k * 10**7
        view.pose(ns, (0.05 * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        getattr(view, first)(ns, 1.0)
        getattr(view, first)(ns, 1.0)  # sent twice: no counterpart of itself
        getattr(view, other)(ns, 0.6)
    gaps = np.array(view.snapshot()["path"])[2:, 2]
    assert len(gaps) > 30 and gaps == pytest.approx(0.4, abs=1e-6)


def test_the_spectrum_has_the_power_of_the_signals_at_their_frequency():
    view = LiveView()
    fill(view, 11.0, difference=0.5)
    view.frame()
    fill(view, 1.0, difference=0.5, begin=11.0)
    found = view.frame()["spectrum"]
    f, measured, simulated = (np.array(found[name]) for name in ("f", "measured", "simulated"))
    assert f[np.argmax(measured)] == 3.0 and f[np.argmax(simulated)] == 3.0
    step = f[1] - f[0]
    assert measured.sum() * step == pytest.approx(0.5, rel=0.05)
    assert simulated.sum() * step == pytest.approx(0.125, rel=0.05)


def test_a_jump_back_and_a_new_twin_begin_anew(repository):
    view = LiveView()
    fill(view, 3.0, begin=10.0)
    view.frame()
    fill(view, 1.0)
    frame = view.frame()
    assert frame["reset"] and len(frame["measured"]) == 100 and frame["path"][0][0] == 0.0
    view.show(load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml"))
    assert view.frame()["scene"]["name"] == "Ford Mondeo Mk IV estate"


def test_an_answer_that_comes_long_after_the_pose_is_no_jump_back():
    view = LiveView()
    for k in range(1000):
        t = 0.01 * k
        view.pose(START + round(t * 1e9), (5.0 * t, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        view.measured(START + round(max(t - 2.0, 0.0) * 1e9), 0.1)
        view.simulated(START + round(max(t - 4.0, 0.0) * 1e9), 0.2)
    rows = view.snapshot()
    assert rows["pose"][0][0] == rows["measured"][0][0] == rows["simulated"][0][0] == 0.0
    assert rows["path"][0][0] == 0.0 and rows["path"][-1][2] == pytest.approx(0.1)


def test_seconds_are_those_of_the_recording():
    view = LiveView()
    view.count_from(START - 5 * 10**9)
    fill(view, 1.0)
    assert view.snapshot()["measured"][0][0] == 5.0


def test_nothing_that_is_not_finite_gets_on_the_page():
    view = LiveView()
    fill(view, 1.0)
    view.measured(START + 2 * 10**9, math.nan)
    view.pose(START + 2 * 10**9, (math.inf, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    view.update("gap", {"rms": math.nan, "bands": [(0.5, 3.0, math.inf)]})
    text = json.dumps(view.frame(), allow_nan=False)
    assert '"rms": null' in text and "[0.5, 3.0, null]" in text


def test_health_and_other_values_come_when_they_change():
    view = LiveView()
    view.frame()
    ingest = NodeStatus("imu_ingest", 0, "ok", {"rate (Hz)": "100.0"})
    view.health(ingest)
    view.update("gap", {"rms": 0.2})
    frame = view.frame()
    assert frame["health"][0]["name"] == "imu_ingest" and frame["gap"] == {"rms": 0.2}
    view.health(ingest)
    view.update("gap", {"rms": 0.2})
    assert view.frame() == {}
    view.mark("a pothole")
    assert view.frame()["events"][0]["text"] == "a pothole"


@pytest.mark.parametrize(
    "file", ["bags/bump_15kmh/twin.yaml", "config/tracked/pt91.yaml", "config/twins/quarter_car.yaml"]
)
def test_every_model_has_a_scene(file, repository):
    twin = load_twin(repository / file)
    shown = scene(twin)
    json.dumps(shown, allow_nan=False)
    assert len(shown["wheels"]) in (0, len(twin.joint_names))


def test_words_on_the_position():
    good, fair, poor, none, plane = (
        advice(0.02, True),
        advice(0.3, True),
        advice(3.0, True),
        advice(math.nan, True),
        advice(0.02, False),
    )
    assert [level for level, _ in (good, fair, poor, none, plane)] == [0, 1, 1, 1, 1]
    assert "calibration" in good[1] and "3.0 m" in poor[1] and "RTK" in poor[1] and "road" in plane[1]


def test_a_tile_has_the_heights_of_the_road(repository):
    from suspension_twin.road import bump_road, half_sine

    road = bump_road(half_sine(1.0, 0.05), at=5.0, length=20.0)
    z = np.frombuffer(tile(road, 1, 0), dtype="<f4").reshape(NODES, NODES)
    x = 1 * SIDE + np.linspace(0, SIDE, NODES)
    np.testing.assert_allclose(z[0], road.heights(x, np.zeros(NODES)), atol=1e-6)
    assert z[0].max() == pytest.approx(0.05, abs=1e-3)
    assert np.isnan(np.frombuffer(tile(road, 100, 100), dtype="<f4")).all()
    assert not np.frombuffer(tile(None, 3, -4), dtype="<f4").any()
    with pytest.raises(ValueError, match="too far"):
        tile(road, 10**6, 0)
