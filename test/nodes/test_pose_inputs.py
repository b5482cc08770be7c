# SPDX-License-Identifier: Apache-2.0
"""The pose of an INS, an EKF or a simulator in place of a receiver's fixes and velocities."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, QuaternionStamped, TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from nodes_bench import put_stamp, worst
from sensor_msgs.msg import Imu
from test_pose_injector import T0, fix, imu, straight, tap, velocity

from suspension_twin.drive.types import Drive, HeadingData
from suspension_twin.errors import InputError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.live.twin import schedule
from suspension_twin.nodes.composed import Composed
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.messages import SENSORS
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.process import ros_context
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

ORIGIN = (500_000.0, 5_250_000.0, 0.02)  # of a grid, as UTM's
Deliver = Callable[[str, Any], None]


@pytest.fixture(scope="module")
def context() -> Iterator[Any]:
    with ros_context([]) as made:
        yield made


@pytest.fixture(scope="module")
def moving(drive: Drive, twin_path: Any) -> tuple[Drive, Twin, LocalMap]:
    """The bumpy drive with a heading at every fix, its twin with a datum, and the map."""
    twin = load_twin(twin_path)
    path = simulate_drive(drive, twin).observation.trajectory
    yaw = np.interp(drive.fix.t, path.t, path.yaw)
    from dataclasses import replace

    headed = replace(drive, heading=HeadingData(drive.fix.t, yaw))
    assert twin.datum is not None
    return headed, twin, LocalMap(twin.datum)


def odometry(drive: Drive, twin: Twin, local: LocalMap, i: int, child: str) -> Odometry:
    """Fix, velocity and heading ``i`` as one message of the frame ``child``."""
    x, y, z = local.to_map(drive.fix.latitude[i], drive.fix.longitude[i], drive.fix.altitude[i])
    assert drive.heading is not None
    yaw, message = float(drive.heading.yaw[i]), Odometry(child_frame_id=child)
    lever = np.array(twin.gps.position) if child == "base_link" else np.zeros(3)
    c, s = math.cos(yaw), math.sin(yaw)
    p, q, v = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist
    p.x, p.y, p.z = x - c * lever[0] + s * lever[1], y - s * lever[0] - c * lever[1], z - lever[2]
    q.z, q.w = math.sin(yaw / 2), math.cos(yaw / 2)
    east, north, _ = drive.velocity.enu[i].tolist()
    turn = 0.3  # rad/s, which an antenna off the origin moves by
    v.angular.z = turn
    v.linear.x, v.linear.y = c * east + s * north + turn * lever[1], -s * east + c * north - turn * lever[0]
    message.pose.covariance[0], message.pose.covariance[7] = np.square(drive.fix.sigma[i, :2]).tolist()
    message.header.frame_id = "map"
    return message


def answers(
    context: Any, twin_path: Any, drive: Drive, feed: Callable[[Deliver, int, int], None], **values: Any
) -> np.ndarray:
    """(n, 2) stamps and vertical acceleration of the twin; ``feed`` delivers what belongs to a fix."""
    out: list[tuple[int, float]] = []
    composed = Composed(context, twin_path)
    try:
        from rclpy.parameter import Parameter

        injector = composed.nodes["pose_injector"]
        if values:
            injector.set_parameters([Parameter(k, value=v) for k, v in values.items()])
        composed.outlets.append(
            lambda update, ns: (
                out.append((ns, update.followed.vertical_acceleration)) if update.followed else None
            )
        )
        raw, _, fill = SENSORS["imu"]
        for ns, kind, i in zip(*(c.tolist() for c in schedule(drive)), strict=True):
            if kind == 0:
                message = put_stamp(raw(), 0.0)
                fill(drive.imu, message, i)
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns, 10**9)
                composed.nodes["imu_ingest"].inputs["imu/data_raw"].deliver(message)
            elif kind == 1:

                def deliver(topic: str, message: Any, ns: int = ns) -> None:
                    message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns, 10**9)
                    injector.inputs[topic].deliver(message)

                feed(deliver, i, ns)
    finally:
        composed.close()
    return np.array(out)


@pytest.mark.parametrize(
    ("child", "origin"), [("gps_link", None), ("base_link", None), ("base_link", ORIGIN)]
)
def test_a_replay_through_odometry_gives_the_same_twin(context, moving, twin_path, tmp_path, child, origin):
    drive, twin, local = moving
    with_lever = twin.model_copy(update={"gps": twin.gps.model_copy(update={"position": (0.4, 0.3, 1.5)})})
    save_twin(with_lever, tmp_path / "twin.yaml")

    def receiver(deliver: Deliver, i: int, _ns: int) -> None:
        for stream in ("fix", "vel", "heading"):
            kind, topic, fill = SENSORS[stream]
            message = kind()
            fill({"fix": drive.fix, "vel": drive.velocity, "heading": drive.heading}[stream], message, i)
            deliver(topic, message)

    def ins(deliver: Deliver, i: int, _ns: int) -> None:
        message = odometry(drive, with_lever, local, i, child)
        if origin is not None:
            p, q = message.pose.pose.position, message.pose.pose.orientation
            c, s = math.cos(origin[2]), math.sin(origin[2])
            p.x, p.y = origin[0] + c * p.x - s * p.y, origin[1] + s * p.x + c * p.y
            yaw = 2 * math.atan2(q.z, q.w) + origin[2]
            q.z, q.w = math.sin(yaw / 2), math.cos(yaw / 2)
            message.header.frame_id = "utm"
        deliver("odom", message)

    values = {} if origin is None else {"origin": list(origin)}
    usual = answers(context, tmp_path / "twin.yaml", drive, receiver)
    found = answers(context, tmp_path / "twin.yaml", drive, ins, **values)
    assert found.shape == usual.shape and (found[:, 0] == usual[:, 0]).all()
    off = np.sqrt(np.mean((found[:, 1] - usual[:, 1]) ** 2))
    assert off < 0.01 * np.sqrt(np.mean(usual[:, 1] ** 2))


def pose_message(kind: type, t: float, x: float, yaw: float) -> Any:
    message = put_stamp(kind(), t)
    message.header.frame_id = "map"
    if kind is TransformStamped:
        message.child_frame_id = "base_link"
        place, q = message.transform.translation, message.transform.rotation
    else:
        place, q = message.pose.position, message.pose.orientation
    place.x, place.y = x * math.cos(yaw), x * math.sin(yaw)
    q.z, q.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


@pytest.mark.parametrize(("kind", "topic"), [(PoseStamped, "pose"), (TransformStamped, "transform")])
def test_a_game_engine_or_motion_capture_gives_the_pose(bench, kind, topic):
    node = bench.make(PoseInjectorNode)
    rows = tap(node)
    for k in range(600):
        t = T0 + k / 100
        if k % 5 == 0:
            node.inputs[topic].deliver(pose_message(kind, t, 6.0 * k / 100, 0.6))
        node.inputs["imu/data"].deliver(imu(t))
    _, x, y, yaw, speed, spread = rows[-1]
    assert math.hypot(x, y) == pytest.approx(6.0 * 5.99, abs=0.1) and yaw == pytest.approx(0.6, abs=0.01)
    assert speed == pytest.approx(6.0, abs=0.1) and spread < 0.01
    node.report()
    assert node.health.values["position from"] == node.health.values["heading from"] == topic
    assert not node.inputs["fix"].state.expected and not node.inputs["vel"].state.expected


def test_what_is_better_takes_over_and_gives_way_when_it_is_silent(bench, capfd):
    node = bench.make(PoseInjectorNode)
    straight(node, 3.0)
    assert node.inputs["fix"].state.expected
    message = Odometry(child_frame_id="base_link")
    message.header.frame_id, message.pose.pose.orientation.w = "map", 1.0

    def used() -> str:
        node.report()
        return node.health.values["position from"]

    assert used() == "fix"
    node.inputs["odom"].deliver(put_stamp(message, T0 + 3.0))
    node.inputs["fix"].deliver(fix(T0 + 3.1, 0.0, 0.0))
    assert used() == "odom" and node.health.values["velocity from"] == "odom"
    node.inputs["fix"].deliver(fix(T0 + 9.0, 0.0, 0.0))
    assert used() == "fix"
    assert capfd.readouterr().err.count("position from odom") == 1


def test_a_velocity_with_its_covariance_is_used_unless_it_is_unknown(bench):
    node = bench.make(PoseInjectorNode)
    rows = tap(node)
    for k in range(500):
        t = T0 + k / 100
        if k % 10 == 0:
            node.inputs["fix"].deliver(fix(t, 0.08 * k, 0.0))
            message = put_stamp(TwistWithCovarianceStamped(), t)
            message.twist.twist.linear.x, message.twist.covariance[0] = 8.0, 0.0025
            node.inputs["fix_velocity"].deliver(message)
            wrong = put_stamp(TwistWithCovarianceStamped(), t)
            wrong.twist.twist.linear.x, wrong.twist.covariance[0] = -20.0, 1e6
            node.inputs["fix_velocity"].deliver(wrong)
            node.inputs["vel"].deliver(velocity(t, 0.0, 30.0))  # comes as well, and is of less use
        node.inputs["imu/data"].deliver(imu(t))
    assert rows[-1][4] == pytest.approx(8.0, abs=0.05)


@pytest.mark.parametrize(("variance", "used"), [(4e-4, True), (0.0, False), (-1.0, False), (9.0, False)])
def test_an_imu_with_an_orientation_gives_the_heading_while_standing(bench, tmp_path, twin, variance, used):
    """REP-145: zeros for an unknown covariance, -1 for no orientation."""
    askew = twin.model_copy(update={"imu": twin.imu.model_copy(update={"rpy": (0.0, 0.0, 1.2)})})
    save_twin(askew, tmp_path / "twin.yaml")
    ingest = bench.make(ImuIngestNode, twin=str(tmp_path / "twin.yaml"))
    node = bench.make(PoseInjectorNode, twin=str(tmp_path / "twin.yaml"))
    ingest.outputs["imu/data"].links.append(node.inputs["imu/data"].deliver)
    rows = tap(node)
    for k in range(300):
        message = put_stamp(Imu(), T0 + k / 100)
        message.header.frame_id, message.linear_acceleration.z = "imu_link", 9.81
        sensor = 0.7 + 1.2  # yaw of the sensor where that of the car is 0.7
        message.orientation.z, message.orientation.w = math.sin(sensor / 2), math.cos(sensor / 2)
        message.orientation_covariance[0] = message.orientation_covariance[8] = variance
        ingest.inputs["imu/data_raw"].deliver(message)
        if k % 10 == 0:
            node.inputs["fix"].deliver(fix(T0 + k / 100, 5.0, 5.0))
    assert (rows[-1][5] < 0.1) == used
    if used:
        assert rows[-1][3] == pytest.approx(0.7, abs=0.02)
        node.report()
        assert node.health.values["heading from"] == "imu/data"


def test_a_pose_without_an_orientation_is_refused_where_the_antenna_is_elsewhere(bench, tmp_path, twin):
    far = twin.model_copy(update={"gps": twin.gps.model_copy(update={"position": (1.0, 0.0, 1.5)})})
    save_twin(far, tmp_path / "twin.yaml")
    node = bench.make(PoseInjectorNode, twin=str(tmp_path / "twin.yaml"))
    message = put_stamp(PoseStamped(), T0)
    message.pose.orientation.w = 0.0
    node.inputs["pose"].deliver(message)
    assert "without an orientation" in worst(node)[1]
    node.inputs["heading"].deliver(put_stamp(QuaternionStamped(), T0))


def test_an_origin_has_three_numbers(bench):
    with pytest.raises(InputError, match="origin"):
        bench.make(PoseInjectorNode, origin=[1.0, 2.0])
