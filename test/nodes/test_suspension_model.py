# SPDX-License-Identifier: Apache-2.0
"""The node that is the twin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import AccelStamped, PoseStamped
from nav_msgs.msg import Odometry
from nodes_bench import put_stamp, stamp_of, worst
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from suspension_twin.models.excitation import excitation
from suspension_twin.models.live import LiveTwin
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import PoseSample
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.pose.types import Trajectory
from suspension_twin.road import load_road
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.signals.filters import FilterSpec, LiveLowPass
from suspension_twin.vehicle.twin import EffectSpec, load_twin, save_twin
from suspension_twin_interfaces.msg import Gap
from suspension_twin_interfaces.srv import LoadTwin

T0 = 1.7e9
SPEED = 8.0


def odom(t: float, x: float, y: float = 0.0, yaw: float = 0.0, speed: float = SPEED, frame="map", doubt=1e-4):
    message = put_stamp(Odometry(), t)
    message.header.frame_id = frame
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    message.pose.covariance[35] = doubt
    message.twist.twist.linear.x = speed
    return message


def vertical(t: float, z: float = 0.0) -> AccelStamped:
    message = put_stamp(AccelStamped(), t)
    message.accel.linear.z = z
    return message


def drive(node, count: int, start: int = 0, rate: float = 100.0, **more):
    """Deliver a straight drive at constant speed."""
    for k in range(start, start + count):
        t = T0 + k / rate
        node.inputs["twin/odom"].deliver(odom(t, 5.0 + SPEED * k / rate, **more))
        node.inputs["imu/vertical_acceleration"].deliver(vertical(t, math.sin(k / 10.0)))


def tap(node, topic, take):
    """A list that fills with ``take(message)`` of an output."""
    rows = []
    node.outputs[topic].links.append(lambda m: rows.append(take(m)))
    return rows


def test_it_says_what_the_model_says(bench, twin_path, tmp_path):
    rpy = (0.02, -0.05, 0.3)
    twin = load_twin(twin_path).with_changes({"imu.rpy": rpy})
    save_twin(twin, tmp_path / "twin.yaml")
    node = bench.make(SuspensionModelNode, twin=str(tmp_path / "twin.yaml"), visual_rate=2000.0)
    acceleration = tap(node, "twin/vertical_acceleration", lambda m: (stamp_of(m), m.accel.linear.z))
    imu = tap(
        node,
        "twin/imu",
        lambda m: [getattr(v, a) for v in (m.linear_acceleration, m.angular_velocity) for a in "xyz"],
    )
    turned = tap(node, "twin/imu", lambda m: [getattr(m.orientation, a) for a in "xyzw"])
    pose = tap(node, "twin/pose", lambda m: (m.pose.position.x, m.pose.position.y, m.pose.position.z))
    joints = tap(node, "joint_states", lambda m: (list(m.name), list(m.position), list(m.velocity)))
    drive(node, 400)

    live, low_pass = LiveTwin(twin, load_road(twin.road.file)), LiveLowPass(FilterSpec())
    loudest = 0.0
    for k in range(400):
        ns = stamp_of(vertical(T0 + k / 100.0))
        state = live.step(ns / 1e9, PoseSample(5.0 + SPEED * k / 100.0, 0.0, 0.0, SPEED, 0.0, 0.0, 0.0, 0.0))
        expected = low_pass.push(ns / 1e9, state.vertical_acceleration)
        assert acceleration[k] == (ns, pytest.approx(expected, abs=1e-12))
        loudest = max(loudest, abs(expected))
        assert imu[k][:3] == pytest.approx(rpy_matrix(rpy).T @ state.force, abs=1e-12)
        assert imu[k][3:] == pytest.approx(rpy_matrix(rpy).T @ state.rate, abs=1e-12)
        assert pose[k] == pytest.approx((5.0 + SPEED * k / 100.0, 0.0, state.z), abs=1e-12)
        assert joints[k][1] == pytest.approx(state.deflection.tolist(), abs=1e-12)
        assert joints[k][2] == pytest.approx(state.deflection_rate.tolist(), abs=1e-12)
        x, y, z, w = turned[k]
        up = rpy_matrix((state.roll, state.pitch, 0.0)) @ rpy_matrix(rpy) @ np.array([0.0, 0.0, 1.0])
        assert [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)] == pytest.approx(
            up, abs=1e-9
        )
    assert loudest > 0.5
    assert joints[0][0] == [
        f"{c}_suspension" for c in ("front_left", "front_right", "rear_left", "rear_right")
    ]


def test_a_sensor_with_latency_reads_the_road_as_late_live_as_offline(bench, twin_path, tmp_path):
    latency = 0.02
    prompt = load_twin(twin_path)
    late = prompt.with_changes({"imu.latency": latency})
    save_twin(late, tmp_path / "twin.yaml")
    node = bench.make(SuspensionModelNode, twin=str(tmp_path / "twin.yaml"))
    live = tap(node, "twin/imu", lambda m: m.linear_acceleration.z)
    drive(node, 600)

    t = T0 + np.arange(600) / 100.0
    zero = np.zeros(600)
    speed = np.column_stack([zero + SPEED, zero])
    path = Trajectory(t, 5.0 + SPEED * (t - T0), zero, zero, speed, zero, 0 * speed, np.ones(600, dtype=bool))
    road = excitation(path, late.vehicle, load_road(prompt.road.file))
    offline, without = (simulate_twin(twin, road).force[:, 2] for twin in (late, prompt))
    loudest = np.abs(offline - 9.81).max()
    assert loudest > 0.5
    np.testing.assert_allclose(live, offline, atol=1e-3 * loudest)
    np.testing.assert_allclose(offline[2:], without[:-2], atol=1e-3 * loudest)  # two samples later


def test_over_the_wire_everything_of_the_contract_comes(bench, twin_path):
    options = {"gap__rate": 50.0, "visual_rate": 2000.0}
    bench.make(SuspensionModelNode, namespace="car", twin=str(twin_path), **options)
    kinds = {
        "/car/twin/vertical_acceleration": AccelStamped,
        "/car/twin/imu": Imu,
        "/car/twin/pose": PoseStamped,
        "/car/joint_states": JointState,
        "/tf": TFMessage,
        "/car/twin/gap": Gap,
    }
    heard = {topic: bench.hear(kind, topic) for topic, kind in kinds.items()}
    say_odom, say_vertical = (
        bench.speak(Odometry, "/car/twin/odom"),
        bench.speak(AccelStamped, "/car/imu/vertical_acceleration"),
    )
    for k in range(350):
        t = T0 + k / 100.0
        say_odom(odom(t, 5.0 + SPEED * k / 100.0))
        say_vertical(vertical(t))
        bench.executor.spin_once(timeout_sec=0.001)
    for topic in kinds:
        if topic != "/car/twin/gap":
            bench.until(lambda topic=topic: len(heard[topic]) == 350, topic)
    stamps = [stamp_of(vertical(T0 + k / 100.0)) for k in range(350)]
    for topic in ("/car/twin/vertical_acceleration", "/car/twin/imu", "/car/twin/pose", "/car/joint_states"):
        assert [stamp_of(m) for m in heard[topic]] == stamps
    transform, *wheels = heard["/tf"][-1].transforms
    assert [w.child_frame_id for w in wheels[:2]] == ["car/front_left_wheel", "car/front_right_wheel"]
    assert {w.header.frame_id for w in wheels} == {"car/base_link"} and len(wheels) == 4
    pose = heard["/car/twin/pose"][-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "car/base_link")
    assert pose.header.frame_id == "map" and transform.transform.translation.z == pose.pose.position.z
    assert heard["/car/twin/imu"][0].header.frame_id == "car/imu_link"
    bench.until(lambda: heard["/car/twin/gap"])
    gap = heard["/car/twin/gap"][-1]
    assert gap.header.frame_id == "car/base_link" and stamp_of(gap) in stamps
    assert gap.rms > 0 and len(gap.band_rms) == len(gap.band_low_hz) == 3 and gap.samples > 100
    assert gap.measured_rms == 0.0


def test_samples_and_poses_are_paired_by_stamp_whatever_comes_first(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path), visual_rate=2000.0)
    stamps = tap(node, "twin/vertical_acceleration", stamp_of)
    values = tap(node, "twin/pose", lambda m: m.pose.position.x)
    for k in range(100):  # all samples first, and every tenth pose is lost
        node.inputs["imu/vertical_acceleration"].deliver(vertical(T0 + k / 100.0))
    for k in range(100):
        if k % 10 != 5:
            node.inputs["twin/odom"].deliver(odom(T0 + k / 100.0, 5.0 + SPEED * k / 100.0))
    assert stamps == [stamp_of(vertical(T0 + k / 100.0)) for k in range(100)]
    assert values == pytest.approx([5.0 + SPEED * k / 100.0 for k in range(100)])


def test_a_twin_shaken_beyond_belief_starts_afresh_and_hands_nothing_on(bench, twin_path, monkeypatch):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    rows = tap(node, "twin/vertical_acceleration", lambda m: m.accel.linear.z)
    drive(node, 50)
    step = node._follower._live.step
    monkeypatch.setattr(
        node._follower._live, "step", lambda *given: replace(step(*given), vertical_acceleration=1e200)
    )
    drive(node, 5, start=50)
    monkeypatch.undo()
    assert len(rows) == 50 and "diverged: restarted" in worst(node)[1]
    drive(node, 300, start=55)
    assert len(rows) == 350 and np.isfinite(rows).all() and max(np.abs(rows)) < 50
    assert math.isfinite(node.gap_now().rms)


def test_what_is_not_a_number_is_dropped_and_told(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    rows = tap(node, "twin/vertical_acceleration", lambda m: m.accel.linear.z)
    drive(node, 50)
    node.inputs["twin/odom"].deliver(odom(T0 + 0.5, math.nan))
    node.inputs["twin/odom"].deliver(odom(T0 + 0.5, 9.0, speed=math.inf))
    for huge in (1e300, -1e9):
        node.inputs["twin/odom"].deliver(odom(T0 + 0.5, huge))
        node.inputs["twin/odom"].deliver(odom(T0 + 0.5, 9.0, speed=huge))
        node.inputs["imu/vertical_acceleration"].deliver(vertical(T0 + 0.5, huge))
    node.inputs["imu/vertical_acceleration"].deliver(vertical(T0 + 0.5, math.nan))
    node.inputs["twin/odom"].deliver(odom(0.0, 9.0))
    level, text = worst(node)
    assert level == 1 and "not finite" in text
    drive(node, 50, start=51)
    assert len(rows) == 100 and np.isfinite(rows).all()
    assert node.health.count("resets after a jump back in time") == 0


def test_a_pose_that_jumps_starts_afresh_instead_of_sweeping_over_the_road(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    rows = tap(node, "twin/vertical_acceleration", lambda m: m.accel.linear.z)
    drive(node, 200)
    calm = np.abs(rows).max()
    for k in range(200, 300):
        node.inputs["twin/odom"].deliver(odom(T0 + k / 100.0, 60.0 + SPEED * k / 100.0))
        node.inputs["imu/vertical_acceleration"].deliver(vertical(T0 + k / 100.0))
    assert "jumped" in worst(node)[1]
    assert np.abs(rows).max() < 2.0 * calm


def test_until_the_heading_is_known_the_twin_stands(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    rows = tap(node, "twin/vertical_acceleration", lambda m: m.accel.linear.z)
    for k in range(100):
        node.inputs["twin/odom"].deliver(odom(T0 + k / 100.0, 5.0, speed=0.0, doubt=9.9))
        node.inputs["imu/vertical_acceleration"].deliver(vertical(T0 + k / 100.0))
    assert len(rows) == 100 and np.abs(rows).max() < 1e-6
    drive(node, 100, start=100, yaw=0.5)
    assert len(rows) == 200 and worst(node)[0] == 0  # turning to the found heading is no jump


def test_visual_topics_are_thinned_and_the_acceleration_is_not(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path), visual_rate=50.0, gap__rate=2.0)
    acceleration = tap(node, "twin/vertical_acceleration", stamp_of)
    pose, joints = tap(node, "twin/pose", stamp_of), tap(node, "joint_states", stamp_of)
    gap = tap(node, "twin/gap", stamp_of)
    drive(node, 4000, rate=1000.0)
    assert len(acceleration) == 4000
    assert len(pose) == len(joints) == pytest.approx(200, abs=25)
    assert 2 <= len(gap) <= 5
    assert node.set_parameters([Parameter("visual_rate", value=2000.0)])[0].successful
    pose.clear()
    drive(node, 500, start=4000, rate=1000.0)
    assert len(pose) == 500


def test_what_is_looked_at_comes_sixty_times_a_second_unless_told_otherwise(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    pose = tap(node, "twin/pose", stamp_of)
    drive(node, 1000)
    assert len(pose) == pytest.approx(600, abs=40)
    assert set(np.round(np.diff(pose[100:]) / 1e7)) <= {1, 2}, "every sample, or every other one"


def test_no_twin_no_answer_until_one_is_loaded(bench, twin_path):
    node = bench.make(SuspensionModelNode)
    rows = tap(node, "twin/vertical_acceleration", stamp_of)
    drive(node, 20)
    assert rows == [] and "no twin loaded" in worst(node)[1]
    response = bench.call(LoadTwin, "/suspension_model/load_twin", LoadTwin.Request(path=str(twin_path)))
    assert response.success and "Mondeo" in response.message
    assert node.get_parameter("twin").value == str(twin_path)
    drive(node, 20, start=20)
    assert len(rows) == 20 and worst(node)[0] == 0


def test_a_wrong_twin_is_refused_by_name_and_the_old_one_goes_on(bench, twin_path, tmp_path, twin):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    rows = tap(node, "twin/vertical_acceleration", stamp_of)
    (tmp_path / "broken.yaml").write_text("model: full_car\nvehicle: {mass: 3}\n")
    (tmp_path / "text.yaml").write_text(": : :")
    save_twin(load_twin(twin_path), tmp_path / "roadless.yaml")
    roadless = yaml.safe_load((tmp_path / "roadless.yaml").read_text()) | {"road": {"file": "gone.crg"}}
    (tmp_path / "roadless.yaml").write_text(yaml.safe_dump(roadless))
    for path in ("x" * 100_000, "/", "/dev/zero"):  # no path ends the node
        response = bench.call(LoadTwin, "/suspension_model/load_twin", LoadTwin.Request(path=path))
        assert not response.success and response.message.isprintable() and len(response.message) < 2100
    for name in ("broken.yaml", "text.yaml", "absent.yaml", "roadless.yaml", ""):
        path = str(tmp_path / name) if name else ""
        response = bench.call(LoadTwin, "/suspension_model/load_twin", LoadTwin.Request(path=path))
        assert not response.success and "\n" not in response.message
        assert (name or "empty") in response.message or "gone.crg" in response.message
    drive(node, 50)
    assert len(rows) == 50 and node.values["twin"] == str(twin_path)


def test_a_file_out_of_the_folders_is_neither_loaded_nor_quoted(bench, twin_path, tmp_path):
    bench.make(SuspensionModelNode, twin=str(twin_path), folders=str(twin_path.parent))
    (tmp_path / "shadow.yaml").write_text("root:$6$hash:19000:0:99999:7:::\n")
    save_twin(load_twin(twin_path), tmp_path / "twin.yaml")
    for path in ("/etc/shadow", str(tmp_path / "shadow.yaml"), str(tmp_path / "twin.yaml")):
        response = bench.call(LoadTwin, "/suspension_model/load_twin", LoadTwin.Request(path=path))
        assert not response.success and "lies in none of the folders" in response.message
    widen = SetParameters.Request(parameters=[Parameter("folders", value="/").to_parameter_msg()])
    assert not bench.call(SetParameters, "/suspension_model/set_parameters", widen).results[0].successful


def test_a_program_is_not_loaded_by_a_request(bench, twin_path, tmp_path):
    data = yaml.safe_load(twin_path.read_text()) | {"model": "fmu", "fmu": {"file": "car.fmu"}}
    kept = {"wheelbase", "front_track", "rear_track", "cog", "tyre"}
    data["vehicle"] = {key: value for key, value in data["vehicle"].items() if key in kept}
    data["vehicle"]["tyre"] = {"radius": data["vehicle"]["tyre"]["radius"]}
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump(data))
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    request = LoadTwin.Request(path=str(tmp_path / "twin.yaml"))
    response = bench.call(LoadTwin, "/suspension_model/load_twin", request)
    assert not response.success
    assert "fmu runs a program: name it when the node is started" in response.message
    assert node.values["twin"] == str(twin_path)


def test_loading_says_what_the_other_nodes_have_to_be_told(bench, twin_path, tmp_path):
    bench.make(SuspensionModelNode, twin=str(twin_path))
    twin = load_twin(twin_path).with_changes({"imu.position.0": 1.0, "vehicle.mass": 1800.0})
    save_twin(twin, tmp_path / "other.yaml")
    request = LoadTwin.Request(path=str(tmp_path / "other.yaml"))
    assert "imu changed" in bench.call(LoadTwin, "/suspension_model/load_twin", request).message


def test_a_file_that_has_changed_is_read_again(bench, twin_path, tmp_path):
    path = tmp_path / "twin.yaml"
    save_twin(load_twin(twin_path), path)
    node = bench.make(SuspensionModelNode, twin=str(path))
    save_twin(load_twin(twin_path).with_changes({"vehicle.mass": 1999.0}), path)
    assert bench.call(LoadTwin, "/suspension_model/load_twin", LoadTwin.Request(path=str(path))).success
    assert node._follower.twin.vehicle.mass == 1999.0


def test_reset_puts_the_twin_back_into_equilibrium(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    z = tap(node, "twin/pose", lambda m: m.pose.position.z)
    drive(node, 300)
    assert bench.call(Trigger, "/suspension_model/reset", Trigger.Request()).success
    assert node.gap_now() is None
    z.clear()
    drive(node, 300)
    first = list(z)
    assert bench.call(Trigger, "/suspension_model/reset", Trigger.Request()).success
    z.clear()
    drive(node, 300)
    assert z == first


def test_beside_the_road_is_told(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    node.inputs["twin/odom"].deliver(odom(T0, 50.0, y=80.0))
    node.inputs["imu/vertical_acceleration"].deliver(vertical(T0))
    assert "4 of 4 wheels are outside the road file" in worst(node)[1]


def test_a_pose_in_another_frame_is_told(bench, twin_path):
    node = bench.make(SuspensionModelNode, twin=str(twin_path))
    drive(node, 5, frame="odom")
    assert "'odom'" in worst(node)[1] and "'map'" in worst(node)[1]


def test_braking_pitches_the_twin_nose_down(bench, twin, tmp_path):
    save_twin(twin, tmp_path / "flat.yaml")
    node = bench.make(SuspensionModelNode, twin=str(tmp_path / "flat.yaml"), visual_rate=2000.0)
    pitch = tap(node, "twin/pose", lambda m: 2.0 * math.asin(m.pose.orientation.y))
    x, speed = 0.0, 15.0
    for k in range(300):
        t = T0 + k / 100.0
        node.inputs["twin/odom"].deliver(odom(t, x, speed=speed))
        node.inputs["imu/vertical_acceleration"].deliver(vertical(t))
        braking = 4.0 if k > 100 else 0.0
        x, speed = x + speed / 100.0, speed - braking / 100.0
    assert abs(pitch[99]) < 1e-6
    assert pitch[-1] == pytest.approx(0.03, abs=0.02) and pitch[-1] > 0.01


def test_a_gain_of_the_sensor_leaves_nothing_while_the_vehicle_stands(bench, twin_path, tmp_path):
    """The IMU's filter takes a share of gravity for a bias: a twin that knows the gain has to stand at nothing too."""
    twin = load_twin(twin_path)
    effect = EffectSpec(id="sensor_scale", parameters={"scale": 0.2})
    save_twin(twin.model_copy(update={"effects": (effect,)}), tmp_path / "twin.yaml")
    node = bench.make(SuspensionModelNode, twin=str(tmp_path / "twin.yaml"))
    shown = tap(node, "twin/vertical_acceleration", lambda m: m.accel.linear.z)
    force = tap(node, "twin/imu", lambda m: m.linear_acceleration.z)
    for k in range(50):
        t = T0 + k / 100.0
        node.inputs["twin/odom"].deliver(odom(t, 5.0, speed=0.0))
        node.inputs["imu/vertical_acceleration"].deliver(vertical(t))
    assert shown and max(map(abs, shown)) < 0.02
    assert force[-1] == pytest.approx(1.2 * 9.81, abs=0.05)
