# SPDX-License-Identifier: Apache-2.0
"""The node that locks the pose."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from nav_msgs.msg import Odometry
from nodes_bench import put_stamp, stamp_of, worst
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus

from suspension_twin.live.twin import digital_twin, replay, schedule
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.testing import running_twin
from suspension_twin.vehicle.twin import Datum, save_twin
from suspension_twin_interfaces.srv import SetDatum

T0 = 1.7e9
DATUM = Datum(latitude=47.4025, longitude=19.284, altitude=0.0)


def imu(t: float, yaw_rate: float = 0.0) -> Imu:
    message = put_stamp(Imu(), t)
    message.linear_acceleration.z, message.angular_velocity.z = 9.81, yaw_rate
    return message


def fix(
    t: float, east: float, north: float, frame="gps_link", status=NavSatStatus.STATUS_GBAS_FIX
) -> NavSatFix:
    message = put_stamp(NavSatFix(), t)
    message.header.frame_id = frame
    message.latitude, message.longitude, message.altitude = LocalMap(DATUM).to_geodetic([east, north, 1.5])
    message.status.status = status
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
    message.position_covariance[0] = message.position_covariance[4] = 4e-4
    return message


def velocity(t: float, east: float, north: float) -> TwistStamped:
    message = put_stamp(TwistStamped(), t)
    message.twist.linear.x, message.twist.linear.y = east, north
    return message


def straight(node, seconds: float, start: float = T0, speed: float = 8.0, yaw: float = 0.6, gps=True, **more):
    """Deliver a drive along a straight line, GPS at 10 Hz."""
    c, s = math.cos(yaw), math.sin(yaw)
    for k in range(round(seconds * 100)):
        t = start + k / 100.0
        along = speed * (t - T0)
        if gps and k % 10 == 0:
            node.inputs["fix"].deliver(fix(t, along * c, along * s, **more))
            node.inputs["vel"].deliver(velocity(t, speed * c, speed * s))
        node.inputs["imu/data"].deliver(imu(t))


def tap(node):
    """A list that fills with (stamp, x, y, yaw, speed)."""
    rows = []

    def on_odom(m):
        p, q = m.pose.pose.position, m.pose.pose.orientation
        yaw = 2.0 * math.atan2(q.z, q.w)
        rows.append((stamp_of(m), p.x, p.y, yaw, m.twist.twist.linear.x, m.pose.covariance[35]))

    node.outputs["twin/odom"].links.append(on_odom)
    return rows


def test_over_the_wire_the_pose_is_locked_with_every_samples_stamp(bench, twin_path):
    bench.make(PoseInjectorNode, twin=str(twin_path))
    odom = bench.hear(Odometry, "/twin/odom")
    say = {
        kind: bench.speak(kind, topic)
        for kind, topic in ((Imu, "/imu/data"), (NavSatFix, "/fix"), (TwistStamped, "/vel"))
    }
    stamps = []
    for k in range(300):
        t = T0 + k / 100.0
        if k % 10 == 0:
            say[NavSatFix](fix(t, 8.0 * k / 100.0, 0.0))
            say[TwistStamped](velocity(t, 8.0, 0.0))
            bench.spin(0.002)
        say[Imu](imu(t))
        stamps.append(stamp_of(imu(t)))
        bench.executor.spin_once(timeout_sec=0.001)
    bench.until(lambda: odom and stamp_of(odom[-1]) == stamps[-1])
    assert [stamp_of(m) for m in odom] == [s for s in stamps if s >= stamp_of(odom[0])]
    assert len(odom) > 280
    last = odom[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("map", "base_link")
    assert last.pose.pose.position.x == pytest.approx(8.0 * 2.99, abs=0.1)
    assert last.twist.twist.linear.x == pytest.approx(8.0, abs=0.1)
    assert last.pose.covariance[0] < 0.1 and last.pose.covariance[14] == 1e6


def test_the_pose_follows_and_the_antennas_place_counts(bench, tmp_path, twin):
    from suspension_twin.vehicle.twin import save_twin

    save_twin(twin.with_changes({"gps.position": (1.0, 0.5, 1.5)}), tmp_path / "twin.yaml")
    node = bench.make(PoseInjectorNode, twin=str(tmp_path / "twin.yaml"))
    rows = tap(node)
    straight(node, 6.0)
    ns, x, y, yaw, speed, _ = rows[-1]
    along = 8.0 * (ns / 1e9 - T0)
    c, s = math.cos(0.6), math.sin(0.6)
    expected = np.array([along * c, along * s]) - np.array([c * 1.0 - s * 0.5, s * 1.0 + c * 0.5])
    assert [x, y] == pytest.approx(expected, abs=0.1)
    assert yaw == pytest.approx(0.6, abs=0.02) and speed == pytest.approx(8.0, abs=0.1)


def test_wrong_fixes_and_velocities_are_dropped_and_told(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    rows = tap(node)
    straight(node, 3.0)
    for number in (math.nan, math.inf, 95.0):
        wrong = fix(T0 + 3.0, 24.0, 0.0)
        wrong.latitude = number
        node.inputs["fix"].deliver(wrong)
    node.inputs["fix"].deliver(fix(T0 + 3.0, 24.0, 0.0, status=NavSatStatus.STATUS_NO_FIX))
    node.inputs["vel"].deliver(velocity(T0 + 3.0, math.nan, 0.0))
    node.inputs["imu/data"].deliver(imu(T0 + 3.0, math.nan))
    straight(node, 1.0, start=T0 + 3.01)
    assert np.isfinite(np.array(rows)).all()
    assert np.abs(np.diff(np.array(rows)[-120:, 1])).max() < 0.2
    level, text = worst(node)
    assert level == 1 and "too uncertain), dropped (5 times)" in text and "imu/data: message dropped" in text


def test_a_pose_that_was_lost_is_not_handed_on_and_found_again(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    rows = tap(node)
    straight(node, 3.0)
    node._lock._history.state(node._lock._history.head)[:] = math.nan
    straight(node, 3.0, start=T0 + 3.0)
    assert np.isfinite(np.array(rows)).all()
    assert "the estimated pose is not finite" in worst(node)[1]
    assert rows[-1][1] == pytest.approx(8.0 * 5.99 * math.cos(0.6), abs=0.2)


def test_a_status_that_was_never_set_is_not_taken_for_no_fix(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    rows = tap(node)
    straight(node, 2.0, status=NavSatStatus.STATUS_UNKNOWN)
    assert rows[-1][5] < 0.1 and node._lock.counts["unusable"] == 0


def test_an_outlier_is_refused_and_told(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    rows = tap(node)
    straight(node, 3.0)
    node.inputs["fix"].deliver(fix(T0 + 2.99, 500.0, 500.0))
    straight(node, 0.5, start=T0 + 3.0)
    assert np.abs(np.diff(np.array(rows)[:, 1:3], axis=0)).max() < 0.2
    assert "outliers among fixes" in worst(node)[1]


def test_lost_fixes_are_an_error_that_passes(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    straight(node, 3.0)
    assert worst(node)[0] == 0
    straight(node, 4.0, start=T0 + 3.0, gps=False)
    level, text = worst(node)
    assert level == 2 and "no usable GPS fix" in text
    straight(node, 2.0, start=T0 + 7.0)
    assert "no usable GPS fix" not in worst(node)[1]
    assert float(node.health.values["latency of fixes (s)"]) < 0.05


def test_a_heading_gives_the_yaw_at_standstill_and_a_wrong_one_is_refused(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    rows = tap(node)

    def heading(t: float, yaw: float, length: float = 1.0) -> QuaternionStamped:
        message = put_stamp(QuaternionStamped(), t)
        message.quaternion.z, message.quaternion.w = length * math.sin(yaw / 2), length * math.cos(yaw / 2)
        return message

    node.inputs["heading"].deliver(heading(T0, 2.0, length=0.0))
    node.inputs["heading"].deliver(heading(T0, math.nan))
    assert node.health.count("messages dropped on heading") == 2
    for k in range(200):
        t = T0 + k / 100.0
        if k % 10 == 0:
            node.inputs["fix"].deliver(fix(t, 5.0, -3.0))
            node.inputs["vel"].deliver(velocity(t, 0.0, 0.0))
            node.inputs["heading"].deliver(heading(t, 2.0))
        node.inputs["imu/data"].deliver(imu(t))
    assert rows[-1][3] == pytest.approx(2.0, abs=0.02)
    assert rows[-1][1:3] == pytest.approx([5.0, -3.0], abs=0.05)


def test_set_datum_moves_the_map_and_refuses_what_is_no_place(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    rows = tap(node)
    straight(node, 2.0)
    request = SetDatum.Request(latitude=47.4025, longitude=19.285, altitude=0.0)
    response = bench.call(SetDatum, "/pose_injector/set_datum", request)
    assert response.success and "19.285" in response.message
    straight(node, 2.0, start=T0 + 2.0)
    west = LocalMap(DATUM).to_map(47.4025, 19.285, 0.0)[0]
    assert rows[-1][1] == pytest.approx(8.0 * 3.99 * math.cos(0.6) - west, abs=0.2)
    for wrong in (SetDatum.Request(latitude=91.0), SetDatum.Request(longitude=math.nan)):
        response = bench.call(SetDatum, "/pose_injector/set_datum", wrong)
        assert not response.success and "itude" in response.message and "\n" not in response.message
    assert node._lock.datum.longitude == 19.285


def test_the_first_fix_can_be_the_datum(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path), datum__source="first_fix")
    rows = tap(node)
    node.inputs["imu/data"].deliver(imu(T0))
    node.inputs["fix"].deliver(fix(T0, 1000.0, 2000.0))
    for k in range(1, 20):  # the low-passes let a fix's moment out a little later
        node.inputs["imu/data"].deliver(imu(T0 + k / 100.0))
    assert rows[-1][1:3] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert node.set_parameters([Parameter("datum.source", value="twin")])[0].successful
    assert node._lock.datum == DATUM


def test_a_jump_back_starts_afresh(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    rows = tap(node)
    straight(node, 5.0)
    straight(node, 3.0)
    assert node.health.count("resets after a jump back in time") == 1
    assert rows[-1][1] == pytest.approx(8.0 * 2.99 * math.cos(0.6), abs=0.1)


def test_a_fix_in_another_frame_is_told(bench, twin_path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    straight(node, 1.0, frame="roof")
    assert "'roof'" in worst(node)[1]


@pytest.mark.parametrize(("given", "is_there"), [("auto", True), ("off", False), (False, False)])
def test_a_felt_place_can_be_switched_off(bench, twin_path, given, is_there):
    """ROS reads the word off of a command line as false."""
    node = bench.make(PoseInjectorNode, twin=str(twin_path), felt_position=given)
    assert (node.twin.felt is not None) == is_there
    (set_to,) = node.set_parameters([Parameter("felt_position", value="auto")])
    assert set_to.successful and node.twin.felt is not None
    (refused,) = node.set_parameters([Parameter("felt_position", value="on")])
    assert not refused.successful and "auto, off" in refused.reason


def test_the_felt_place_of_the_nodes_is_that_of_the_live_twin(phone_drive):
    """In one process a sample's work is done behind its answer, with the same result."""
    twin = digital_twin(phone_drive.twin)
    twin.follower = None
    wanted = [u.pose for u in replay(phone_drive.drive, twin) if u.pose is not None]
    assert twin.felt is not None and twin.felt.known and abs(twin.felt.offset) > 0.3
    with running_twin(phone_drive.twin) as nodes:
        odom = nodes.replay(phone_drive.drive, ["twin/odom"])["twin/odom"]
    # the ingest of the nodes is not told of velocities
    np.testing.assert_allclose(odom["pose.pose.position.x"], [p.x for p in wanted], atol=2e-3)
    np.testing.assert_allclose(
        odom["pose.covariance"][-500:, 0], [p.covariance[0] for p in wanted[-500:]], rtol=0.05
    )


def test_in_a_process_of_its_own_the_node_feels_the_place_too(bench, phone_drive, tmp_path):
    """By ``imu/data`` alone."""
    twin = digital_twin(phone_drive.twin)
    twin.follower = None
    save_twin(phone_drive.twin, tmp_path / "twin.yaml")
    node = bench.make(PoseInjectorNode, twin=str(tmp_path / "twin.yaml"))
    rows, drive, wanted = tap(node), phone_drive.drive, []
    for ns, kind, i in zip(*(column.tolist() for column in schedule(drive)), strict=True):
        t = ns / 1e9
        if kind == 0:
            update = twin.push_imu(
                t, drive.imu.specific_force[i].tolist(), drive.imu.angular_rate[i].tolist()
            )
            if update is None:
                continue
            message = put_stamp(Imu(), t)
            a, w = message.linear_acceleration, message.angular_velocity
            (a.x, a.y, a.z), (w.x, w.y, w.z) = update.sample.force, update.sample.rate
            node.inputs["imu/data"].deliver(message)
            wanted.append(update.pose.x)
        elif kind == 1:
            twin.push_fix(
                t, drive.fix.latitude[i], drive.fix.longitude[i], drive.fix.altitude[i], 0, 2.5, 2.5
            )
            message = put_stamp(NavSatFix(), t)
            message.latitude, message.longitude = drive.fix.latitude[i], drive.fix.longitude[i]
            message.altitude = drive.fix.altitude[i]
            message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
            message.position_covariance[0] = message.position_covariance[4] = 6.25
            node.inputs["fix"].deliver(message)
        else:
            twin.push_velocity(t, *drive.velocity.enu[i, :2].tolist())
            node.inputs["vel"].deliver(velocity(t, *drive.velocity.enu[i, :2].tolist()))
    assert twin.felt is not None and abs(twin.felt.offset) > 0.3
    np.testing.assert_allclose([x for _, x, *_ in rows], wanted, atol=1e-6)
    node.report()
    assert "ahead of the receiver's" in node.health.values["felt place"]
