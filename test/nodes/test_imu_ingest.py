# SPDX-License-Identifier: Apache-2.0
"""The node that takes the IMU in, and what wrong messages do to it: nothing."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelStamped
from nodes_bench import put_stamp, stamp_of, worst
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

from suspension_twin.nodes.imu_ingest import ImuIngestNode

T0 = 1.7e9


def imu(t: float, force=(0.0, 0.0, 9.81), rate=(0.0, 0.0, 0.0), frame="imu_link") -> Imu:
    message = put_stamp(Imu(), t)
    message.header.frame_id = frame
    for vector, numbers in ((message.linear_acceleration, force), (message.angular_velocity, rate)):
        vector.x, vector.y, vector.z = (float(v) for v in numbers)
    return message


def feed(node, times, scale=1.0, **more):
    """Deliver a driving car's samples directly."""
    rng = np.random.default_rng(0)
    for t in times:
        x = t - T0
        force = scale * (np.array([0.3, -0.2, 9.81 + math.sin(9.0 * x)]) + rng.normal(0, 0.05, 3))
        node.inputs["imu/data_raw"].deliver(imu(t, force, rng.normal(0, 0.01, 3), **more))


def taps(node):
    """Lists that fill with what the node hands on: (stamp, numbers)."""
    data, vertical = [], []

    def on_data(m):
        a, w = m.linear_acceleration, m.angular_velocity
        data.append((stamp_of(m), a.x, a.y, a.z, w.x, w.y, w.z))

    node.outputs["imu/data"].links.append(on_data)
    vertical_link = lambda m: vertical.append((stamp_of(m), m.accel.linear.z))  # noqa: E731
    node.outputs["imu/vertical_acceleration"].links.append(vertical_link)
    return data, vertical


def test_over_the_wire_every_sample_is_answered_with_its_own_stamp(bench, twin_path):
    bench.make(ImuIngestNode, namespace="car", twin=str(twin_path))
    data, vertical = (
        bench.hear(Imu, "/car/imu/data"),
        bench.hear(AccelStamped, "/car/imu/vertical_acceleration"),
    )
    say = bench.speak(Imu, "/car/imu/data_raw")
    times = [T0 + k / 100.0 for k in range(120)]
    for t in times:
        say(imu(t))
    bench.until(lambda: len(vertical) == 104 and len(data) == 104)
    expected = [stamp_of(imu(t)) for t in times[16:]]
    assert [stamp_of(m) for m in vertical] == [stamp_of(m) for m in data] == expected
    assert all(m.linear_acceleration.z == pytest.approx(9.81, abs=0.02) for m in data)
    assert all(abs(m.accel.linear.z) < 0.02 for m in vertical)
    assert data[0].header.frame_id == vertical[0].header.frame_id == "car/base_link"
    assert data[0].orientation_covariance[0] == -1.0


@pytest.mark.parametrize("replayed", [False, True])
def test_a_node_that_was_late_goes_on_with_the_newest_message_but_in_a_replay(bench, twin_path, replayed):
    """Left alone for longer than it may be behind, a live node has skipped what waited, and says how much."""
    node = bench.make(ImuIngestNode, twin=str(twin_path), max_backlog=0.3, use_sim_time=replayed)
    say, taken = bench.speak(Imu, "/imu/data_raw"), node.inputs["imu/data_raw"]
    times = [T0 + k / 100.0 for k in range(120)]
    for t in times:
        say(imu(t))
    time.sleep(0.4)
    bench.until(lambda: taken.newest == stamp_of(imu(times[-1])))
    assert taken.state.received == (120 if replayed else 1)
    text = "this computer is too slow: messages on imu/data_raw waited too long and were skipped (119 times)"
    assert (text in worst(node)[1]) is not replayed


def test_axes_of_a_turned_sensor_come_out_as_those_of_the_vehicle(bench, tmp_path, twin):
    from suspension_twin.signals.attitude import rpy_matrix
    from suspension_twin.vehicle.twin import save_twin

    rpy = (0.1, -0.4, 1.3)
    save_twin(twin.with_changes({"imu.rpy": rpy}), tmp_path / "twin.yaml")
    node = bench.make(ImuIngestNode, twin=str(tmp_path / "twin.yaml"))
    data, vertical = taps(node)
    body_force, body_rate = np.array([0.5, -0.3, 9.9]), np.array([0.02, -0.01, 0.2])
    for k in range(60):
        force, rate = rpy_matrix(rpy).T @ body_force, rpy_matrix(rpy).T @ body_rate
        node.inputs["imu/data_raw"].deliver(imu(T0 + k / 100.0, force, rate))
    assert data[-1][4:] == pytest.approx(body_rate, abs=1e-3)
    assert np.linalg.norm(data[-1][1:4]) == pytest.approx(np.linalg.norm(body_force), abs=0.2)
    assert len(vertical) == 44


def test_a_message_that_is_not_a_number_is_dropped_and_told(bench, twin_path):
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    data, vertical = taps(node)
    feed(node, [T0 + k / 100.0 for k in range(100)])
    for wrong in (math.nan, math.inf, -math.inf):
        node.inputs["imu/data_raw"].deliver(imu(T0 + 1.0, (0.0, wrong, 9.81)))
        node.inputs["imu/data_raw"].deliver(imu(T0 + 1.0, rate=(0.0, 0.0, wrong)))
    feed(node, [T0 + 1.0 + k / 100.0 for k in range(50)])
    assert len(vertical) == 84 + 50
    assert np.isfinite(np.array(data)).all() and np.isfinite(np.array(vertical)).all()
    level, text = worst(node)
    assert level == 1 and "not finite, dropped (6 times)" in text


def test_a_zero_stamp_and_an_unreported_acceleration_are_refused(bench):
    node = bench.make(ImuIngestNode)
    _, vertical = taps(node)
    feed(node, [T0 + k / 100.0 for k in range(50)])
    node.inputs["imu/data_raw"].deliver(imu(0.0))
    absent = imu(T0 + 0.5)
    absent.linear_acceleration_covariance[0] = -1.0
    node.inputs["imu/data_raw"].deliver(absent)
    assert len(vertical) == 34
    assert "no linear_acceleration" in worst(node)[1]
    assert node.health.count("messages dropped on imu/data_raw") == 2


def test_an_unknown_frame_is_told_and_taken(bench, twin_path):
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    _, vertical = taps(node)
    feed(node, [T0 + k / 100.0 for k in range(50)], frame="elsewhere")
    assert len(vertical) == 34
    level, text = worst(node)
    assert level == 1 and "'elsewhere'" in text and "'imu_link'" in text


def test_a_sensor_in_g_and_one_upside_down_are_recognised(bench, twin_path):
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    data, _ = taps(node)
    feed(node, [T0 + k / 100.0 for k in range(300)], scale=1 / 9.80665)
    assert "come in g" in worst(node)[1]
    assert np.mean([row[3] for row in data]) == pytest.approx(9.81, abs=0.2)
    node.reset_to("test", 0)
    feed(node, [T0 + k / 100.0 for k in range(300)], scale=-1.0)
    assert "upside" in worst(node)[1].lower()


def test_a_tilt_that_the_twin_simulates_is_no_news(bench, tmp_path, twin):
    from suspension_twin.vehicle.twin import EffectSpec, save_twin

    tilt = EffectSpec(id="sensor_tilt", parameters={"roll": 0.0, "pitch": 0.15, "yaw": 0.0})
    leaning, rng = 9.81 * np.array([-math.sin(0.15), 0.0, math.cos(0.15)]), np.random.default_rng(0)
    told = []
    for i, effects in enumerate(((), (tilt,))):
        save_twin(twin.model_copy(update={"effects": effects}), tmp_path / f"{i}.yaml")
        node = bench.make(ImuIngestNode, twin=str(tmp_path / f"{i}.yaml"))
        for k in range(300):
            node.inputs["imu/data_raw"].deliver(imu(T0 + k / 100.0, leaning + rng.normal(0, 0.01, 3)))
        told.append("off upright" in worst(node)[1])
    assert told == [True, False]


def test_a_jump_back_starts_afresh_and_a_late_sample_does_not(bench, twin_path):
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    _, vertical = taps(node)
    feed(node, [T0 + k / 100.0 for k in range(300)])
    node.inputs["imu/data_raw"].deliver(imu(T0 + 2.5))
    assert len(vertical) == 284 and node.health.count("resets after a jump back in time") == 0
    feed(node, [T0 + k / 100.0 for k in range(100)])
    assert node.health.count("resets after a jump back in time") == 1
    assert len(vertical) == 284 + 84
    assert vertical[284][0] == stamp_of(imu(T0 + 0.16))
    worst(node)
    assert node.health.values["IMU samples"] == "100"


def test_whatever_goes_wrong_inside_the_node_lives_and_says_so(bench, twin_path, monkeypatch):
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    _, vertical = taps(node)

    def broken(*_arguments):
        raise ZeroDivisionError("inside")

    with monkeypatch.context() as patched:
        patched.setattr(node.twin.ingest, "push", broken)
        feed(node, [T0 + k / 100.0 for k in range(3)])
    level, text = worst(node)
    assert level == 2 and "ZeroDivisionError: inside (3 times)" in text
    feed(node, [T0 + k / 100.0 for k in range(3, 50)])
    assert len(vertical) == 31


@pytest.mark.long
def test_a_silent_topic_is_named_and_welcomed_back(bench):
    node = bench.make(ImuIngestNode, namespace="car", silence_timeout=0.2)
    heard = bench.hear(DiagnosticArray, "/diagnostics")

    def latest(name: str):
        found = [s for array in heard for s in array.status if s.name == name]
        return found[-1] if found else None

    def silent() -> bool:
        status = latest("car/imu_ingest: imu/data_raw")
        return status is not None and status.level == b"\x03" and "no message for" in status.message

    bench.until(silent, "the word that imu/data_raw is silent")
    assert "no message on imu/data_raw for" in latest("car/imu_ingest").message
    node.set_parameters([Parameter("silence_timeout", value=30.0)])
    bench.until(lambda: latest("car/imu_ingest: imu/data_raw").level == b"\x00")


def test_diagnostics_come_once_a_second_with_the_rate(bench, twin_path):
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    heard = bench.hear(DiagnosticArray, "/diagnostics")
    feed(node, [T0 + k / 250.0 for k in range(500)])
    bench.until(lambda: len(heard) >= 2)
    values = {v.key: v.value for v in heard[-1].status[0].values}
    assert float(values["sample rate (Hz)"]) == pytest.approx(250.0, rel=0.01)
    assert heard[-1].status[0].hardware_id == "suspension_twin"


def test_the_message_of_the_vertical_acceleration_holds_all_axes(bench, twin_path):
    """From which a model in a process of its own has its planar acceleration."""
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    rows = []
    node.outputs["imu/vertical_acceleration"].links.append(
        lambda m: rows.append((m.accel.linear.x, m.accel.linear.z, m.accel.angular.y))
    )
    for k in range(400):
        swing = math.sin(2 * math.pi * k / 50.0)
        node.inputs["imu/data_raw"].deliver(imu(T0 + k / 100.0, (swing, 0.0, 9.81), (0.0, 0.01 * swing, 0.0)))
    ahead, up, pitching = np.array(rows)[100:].T
    assert np.std(ahead) == pytest.approx(math.sqrt(0.5), rel=0.15) and np.std(up) < 0.02
    assert np.std(pitching) == pytest.approx(0.01 * 4 * math.pi * math.sqrt(0.5), rel=0.05)


def test_settings_change_at_once(bench, twin_path):
    node = bench.make(ImuIngestNode, twin=str(twin_path))
    _, vertical = taps(node)
    feed(node, [T0 + k / 100.0 for k in range(200)])
    loud = np.std([v for _, v in vertical])
    assert node.set_parameters([Parameter("filter.cutoff", value=0.5)])[0].successful
    vertical.clear()
    feed(node, [T0 + 2.0 + k / 100.0 for k in range(1000)])
    assert np.std([v for _, v in vertical[500:]]) < 0.3 * loud


def test_simulated_time_that_goes_back_starts_afresh_once(bench, twin_path):
    node = bench.make(ImuIngestNode, twin=str(twin_path), use_sim_time=True)
    tell = bench.speak(Clock, "/clock")

    def clock(t: float) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(t), int(t % 1 * 1e9)
        tell(message)

    clock(T0 + 3.0)
    bench.until(lambda: node.get_clock().now().nanoseconds > T0 * 1e9)
    feed(node, [T0 + k / 100.0 for k in range(300)])
    clock(T0)
    bench.until(lambda: node.health.count("resets after a jump back in time") == 1)
    assert node.twin.ingest.rate is None
    feed(node, [T0 + k / 100.0 for k in range(10)])
    clock(T0 + 3.0)
    feed(node, [T0 + 3.0 + k / 100.0 for k in range(10)])
    # The stamps tell of the next jump first; the clock's word for it then counts no more.
    feed(node, [T0 + k / 100.0 for k in range(10)])
    clock(T0)
    bench.until(lambda: node.get_clock().now().nanoseconds < (T0 + 1) * 1e9)
    assert node.health.count("resets after a jump back in time") == 2


def test_a_clock_that_is_awaited_in_vain_is_told(bench):
    node = bench.make(ImuIngestNode, use_sim_time=True, silence_timeout=0.2)
    node._diagnose()
    bench.until(lambda: "/clock" in worst(node)[1], seconds=5.0)
