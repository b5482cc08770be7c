# SPDX-License-Identifier: Apache-2.0
"""Frames, descriptions and rates by which viewers and game engines show a twin, or two."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import AccelStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from nodes_bench import put_stamp, stamp_of, worst
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.process import ros_context
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.nodes.twin_outputs import Thinning
from suspension_twin.signals.filters import FilterSpec, LiveLowPass
from suspension_twin.vehicle.twin import load_twin, save_twin

T0 = 1_700_000_000.0
LATCHED = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def drive_on(model, seconds: float = 1.0, speed: float = 8.0, stamps=None) -> None:
    """Straight ahead from x = 5 m, nothing measured."""
    for t in np.arange(0.0, seconds, 0.01) if stamps is None else stamps:
        odom = put_stamp(Odometry(), T0 + t)
        odom.header.frame_id, odom.pose.pose.orientation.w = "map", 1.0
        odom.pose.pose.position.x, odom.twist.twist.linear.x = 5.0 + speed * t, speed
        model.inputs["twin/odom"].deliver(odom)
        model.inputs["imu/vertical_acceleration"].deliver(put_stamp(AccelStamped(), T0 + t))


def test_two_twins_share_one_tf(bench, twin_path):
    frames = bench.hear(TFMessage, "/tf")
    for name in ("car_1", "car_2"):
        model = bench.make(SuspensionModelNode, namespace=name, twin=str(twin_path), visual_rate=2000.0)
        drive_on(model, 0.05)
    bench.until(lambda: len(frames) == 10, "transforms of both")
    pairs = {(t.header.frame_id, t.child_frame_id) for m in frames for t in m.transforms}
    children = [child for _, child in pairs]
    assert len(children) == len(set(children)) == 10, "no frame has two parents or two owners"
    assert {("map", "car_1/base_link"), ("map", "car_2/base_link")} <= pairs
    assert ("car_2/base_link", "car_2/rear_left_wheel") in pairs


def test_a_viewer_that_comes_late_gets_sensors_frames_and_the_robot(bench, twin_path):
    model = bench.make(SuspensionModelNode, namespace="car", twin=str(twin_path))
    bench.spin(0.2)
    static: list[TFMessage] = []
    robot: list[String] = []
    bench.side.create_subscription(TFMessage, "/tf_static", static.append, LATCHED)
    bench.side.create_subscription(String, "/car/robot_description", robot.append, LATCHED)
    bench.until(lambda: static and robot, "what was published before")
    twin = load_twin(twin_path)
    placed = {t.child_frame_id: t.transform.translation for t in static[0].transforms}
    assert set(placed) == {"car/imu_link", "car/gps_link"}
    assert (placed["car/imu_link"].x, placed["car/imu_link"].z) == (
        twin.imu.position[0],
        twin.imu.position[2],
    )
    tree = ElementTree.fromstring(robot[0].data)
    links = {link.get("name") for link in tree.iter("link")}
    moving = {j.find("child").get("link") for j in tree.iter("joint") if j.get("type") == "prismatic"}
    frames = bench.hear(TFMessage, "/tf")
    drive_on(model, 0.02)
    bench.until(lambda: frames, "transforms")
    assert moving == {t.child_frame_id for t in frames[0].transforms[1:]} <= links
    assert {j.get("name") for j in tree.iter("joint")} >= set(twin.joint_names)


def test_wheels_stay_on_the_road_while_the_body_moves(bench, twin_path, bumpy_road):
    """Put together, the transforms of body and wheel give a wheel that follows the ground by its tyre."""
    model = bench.make(SuspensionModelNode, twin=str(twin_path), visual_rate=2000.0)
    frames = bench.hear(TFMessage, "/tf")
    drive_on(model, 4.0)
    bench.until(lambda: len(frames) == 400, "transforms")
    above = []
    for message in frames[150:]:
        body, wheel = message.transforms[0].transform, message.transforms[1].transform
        q, (x, y, z) = body.rotation, (wheel.translation.x, wheel.translation.y, wheel.translation.z)
        up = [2 * (q.x * q.z - q.w * q.y), 2 * (q.y * q.z + q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
        height = body.translation.z + up[0] * x + up[1] * y + up[2] * z
        above.append(height - float(bumpy_road.heights(body.translation.x + x, y)))
    radius = load_twin(twin_path).vehicle.tyre.radius
    assert np.mean(above) == pytest.approx(radius, abs=0.003)
    assert np.std(above) < 0.012, "the tyre gives by some millimetres"


def test_the_road_near_the_vehicle_is_a_point_cloud(bench, twin_path, bumpy_road):
    model = bench.make(SuspensionModelNode, twin=str(twin_path))
    clouds = bench.hear(PointCloud2, "twin/road")
    drive_on(model, 1.0)
    bench.until(lambda: len(clouds) >= 4, "a cloud every two metres")
    cloud = clouds[-1]
    points = np.frombuffer(bytes(cloud.data), dtype="<f4").reshape(cloud.width, 3)
    assert cloud.header.frame_id == "map" and cloud.width > 5000
    np.testing.assert_allclose(points[:, 2], bumpy_road.heights(points[:, 0], points[:, 1]), atol=2e-4)
    assert np.ptp(points[:, 0]) == pytest.approx(16.0, abs=0.3) and np.abs(points[:, 1]).max() <= 3.01


@pytest.mark.parametrize(("rate", "jitter"), [(100.0, 0.0), (100.0, 3e-3), (100.4, 1e-3), (50.0, 5e-3)])
def test_up_to_the_visual_rate_every_sample_is_a_pose(rate, jitter):
    stamps = np.arange(0.0, 20.0, 1.0 / rate)
    stamps += np.random.default_rng(1).uniform(-jitter, jitter, stamps.size)
    thinning = Thinning(100.0)
    assert all(thinning.takes(round((T0 + t) * 1e9)) for t in stamps)


def test_faster_samples_are_thinned_evenly():
    thinning = Thinning(100.0)
    taken = [k for k in range(16_000) if thinning.takes(round((T0 + k / 1600.0) * 1e9))]
    assert len(taken) == pytest.approx(1000, abs=50)
    late = np.diff([k for k in taken if k > 1600])
    assert set(late) == {16}


def test_a_topic_of_another_type_is_named(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path), silence_timeout=0.3)
    wanted = "geometry_msgs/msg/TwistWithCovarianceStamped comes there from receiver"
    with ros_context([]) as other:
        receiver = rclpy.create_node("receiver", context=other)
        receiver.create_publisher(TwistWithCovarianceStamped, "vel", 10)
        bench.until(lambda: wanted in worst(node)[1], "the warning")
        assert "geometry_msgs/msg/TwistStamped is expected" in worst(node)[1]
        receiver.destroy_node()
    assert ", expected as sensor_msgs/msg/NavSatFix" in worst(node)[1]


def test_a_low_pass_that_one_node_alone_has_is_seen(bench, twin_path, capfd):
    model = bench.make(SuspensionModelNode, namespace="car", twin=str(twin_path))
    ingest = bench.make(ImuIngestNode, namespace="car", filter__cutoff=10.0)
    bench.make(ImuIngestNode, namespace="other", filter__cutoff=5.0)
    wanted = "the low-pass is 20 Hz, order 2 here and 10 Hz, order 2 in imu_ingest"
    bench.until(lambda: wanted in worst(model)[1], "the warning")
    assert "5 Hz" not in worst(model)[1]
    assert capfd.readouterr().err.count(wanted) == 1  # on the console as well
    from rclpy.parameter import Parameter

    ingest.set_parameters([Parameter("filter.cutoff", value=20.0)])
    bench.until(lambda: "low-pass" not in worst(model)[1], "its end")


def test_without_a_road_it_warns(bench, twin, tmp_path, twin_path):
    save_twin(twin.model_copy(update={"road": None}), tmp_path / "plane.yaml")
    model = bench.make(SuspensionModelNode, twin=str(tmp_path / "plane.yaml"))
    level, text = worst(model)
    assert level == 1 and "names no road" in text
    assert (
        "names no road" not in worst(bench.make(SuspensionModelNode, namespace="b", twin=str(twin_path)))[1]
    )


def test_the_whole_gap_is_that_of_all_driving(bench, twin_path):
    """Of the published signals through the same low-pass once more, as offline it runs forwards and backwards."""
    model = bench.make(SuspensionModelNode, twin=str(twin_path), gap__window=1.0)
    assert math.isnan(model.whole_gap())
    pairs: list[tuple[int, float]] = []
    out = model.outputs["twin/vertical_acceleration"]
    out.links.append(lambda m: pairs.append((stamp_of(m), m.accel.linear.z)))
    drive_on(model, 8.0)
    once_more = LiveLowPass(FilterSpec())
    filtered = [(ns, once_more.push(ns / 1e9, v)) for ns, v in pairs]
    settled = np.array([v for ns, v in filtered if ns >= (T0 + 2.0) * 1e9])
    assert model.whole_gap() == pytest.approx(float(np.sqrt(np.mean(settled**2))), rel=2e-3)
    assert model.whole_gap() != pytest.approx(model.gap_now().rms, rel=1e-2)
    before = model.whole_gap()
    drive_on(model, speed=0.0, stamps=np.arange(8.0, 12.0, 0.01))
    assert model.whole_gap() == before, "a car that stands has no gap"
