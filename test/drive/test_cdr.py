# SPDX-License-Identifier: Apache-2.0
"""Vectorised decoding and encoding against the generic (de)serialisers of rosbags and of ROS itself."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.drive.cdr import decode, encode, ros1_types, ros2_types, types_with

IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
JOINTS = "sensor_msgs/msg/JointState"
names = st.text(alphabet="abc_/é", max_size=12)


def imu_message(frame: str, stamp: tuple[int, int], numbers: np.ndarray) -> object:
    t = ros2_types().types
    header = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](*stamp), frame)
    v3, q = t["geometry_msgs/msg/Vector3"], t["geometry_msgs/msg/Quaternion"]
    n = [float(x) for x in numbers]
    return t[IMU](
        header, q(*n[:4]), numbers[10:19], v3(*n[4:7]), numbers[19:28], v3(*n[7:10]), numbers[28:37]
    )


@settings(max_examples=40, deadline=None)
@given(st.lists(names, min_size=1, max_size=6), st.integers(0, 2**32 - 1), st.booleans())
def test_imu_messages_of_changing_frames_decode_as_rosbags_does(
    frames: list[str], seed: int, little: bool
) -> None:
    """One topic whose frame changes mid-way has several byte layouts; none may be lost or mixed up."""
    rng = np.random.default_rng(seed)
    store = ros2_types()
    messages, numbers = [], rng.normal(size=(3 * len(frames), 37))
    for i, row in enumerate(numbers):
        message = imu_message(frames[i % len(frames)], (1_700_000_000 + i, i * 1000), row)
        messages.append(bytes(store.serialize_cdr(message, IMU, little_endian=little)))
    groups = list(decode(store, IMU, messages))
    index = np.concatenate([g.index for g in groups])
    assert sorted(index) == list(range(len(messages)))
    order = np.argsort(index)
    rate = np.concatenate([g.columns("angular_velocity") for g in groups])[order]
    force = np.concatenate([g.columns("linear_acceleration") for g in groups])[order]
    covariance = np.concatenate([g["linear_acceleration_covariance"] for g in groups])[order]
    stamps = np.concatenate([g.stamp_ns for g in groups])[order]
    for i, data in enumerate(messages):
        reference = store.deserialize_cdr(data, IMU)
        assert reference.angular_velocity.x == rate[i, 0]  # type: ignore[attr-defined]
        assert reference.linear_acceleration.z == force[i, 2]  # type: ignore[attr-defined]
        np.testing.assert_array_equal(reference.linear_acceleration_covariance, covariance[i])  # type: ignore[attr-defined]
        assert stamps[i] == (1_700_000_000 + i) * 10**9 + i * 1000
    first = groups[0]
    assert first.text("header.frame_id") == frames[first.index[0] % len(frames)]


@settings(max_examples=40, deadline=None)
@given(names, st.lists(names, max_size=5), st.integers(0, 8), st.integers(0, 4), st.integers(1, 5))
def test_any_message_is_encoded_as_rosbags_does(
    frame: str, joints: list[str], positions: int, efforts: int, n: int
) -> None:
    """Strings, sequences of strings, of numbers, empty ones: alignment is where encoders go wrong."""
    store = ros2_types()
    rng = np.random.default_rng(len(frame) + 10 * positions)
    position, effort = rng.normal(size=(n, positions)), rng.normal(size=(n, efforts))
    made = encode(
        store,
        JOINTS,
        n,
        {
            "header.stamp.sec": np.arange(n),
            "header.frame_id": frame,
            "name": joints,
            "position": position,
            "effort": effort,
        },
    )
    t = store.types
    for i, data in enumerate(made):
        header = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](i, 0), frame)
        message = t[JOINTS](header, joints, position[i], np.empty(0), effort[i])
        assert data == bytes(store.serialize_cdr(message, JOINTS))
    (group,) = decode(store, JOINTS, made)
    if positions:
        np.testing.assert_array_equal(group["position"], position)


def test_nested_sequences_of_messages_are_encoded() -> None:
    """A transform tree: a sequence of messages with strings in them."""
    store = types_with({"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"})
    kind = "tf2_msgs/msg/TFMessage"
    (data,) = encode(
        store,
        kind,
        1,
        {
            "transforms.0.child_frame_id": "base_link",
            "transforms.0.transform.translation.x": 1.5,
            "transforms.1.header.frame_id": "map",
            "transforms.1.transform.rotation.w": 1.0,
        },
    )
    message = store.deserialize_cdr(data, kind)
    assert message.transforms[0].child_frame_id == "base_link"  # type: ignore[attr-defined]
    assert message.transforms[0].transform.translation.x == 1.5  # type: ignore[attr-defined]
    assert message.transforms[1].header.frame_id == "map"  # type: ignore[attr-defined]
    assert message.transforms[1].transform.rotation.w == 1.0  # type: ignore[attr-defined]


def test_ros_itself_reads_what_is_encoded() -> None:
    """The bytes are those of the wire: rclpy deserialises them into its own classes."""
    serialization = pytest.importorskip("rclpy.serialization")
    from sensor_msgs.msg import Imu, JointState, NavSatFix

    store = ros2_types()
    (data,) = encode(store, IMU, 1, {"header.frame_id": "imu_link", "linear_acceleration.z": 9.81})
    imu = serialization.deserialize_message(data, Imu)
    assert (imu.header.frame_id, imu.linear_acceleration.z) == ("imu_link", 9.81)
    (data,) = encode(
        store, FIX, 1, {"status.service": 1, "latitude": 47.5, "position_covariance": np.arange(9.0)}
    )
    fix = serialization.deserialize_message(data, NavSatFix)
    assert (fix.status.service, fix.latitude, list(fix.position_covariance)) == (1, 47.5, list(range(9)))
    (data,) = encode(store, JOINTS, 1, {"name": ["a", "bc"], "position": np.array([[1.0, 2.0]])})
    joints = serialization.deserialize_message(data, JointState)
    assert (list(joints.name), list(joints.position)) == (["a", "bc"], [1.0, 2.0])
    # and what ROS writes is read: it leaves stray bytes behind empty sequences
    joints = JointState(name=["a", "bc"], position=[1.0, 2.0], velocity=[], effort=[3.0])
    (group,) = decode(store, JOINTS, [serialization.serialize_message(joints)] * 2)
    assert group["effort"].tolist() == [[3.0]] * 2
    assert group["position"].tolist() == [[1.0, 2.0]] * 2


def test_ros1_messages_decode() -> None:
    """ROS 1 packs without alignment, and its header begins with ``seq``."""
    store = ros1_types()
    t = store.types
    header = t["std_msgs/msg/Header"](7, t["builtin_interfaces/msg/Time"](12, 34), "gps")
    status = t["sensor_msgs/msg/NavSatStatus"](
        -1, 1, *[0] * (len(store.fielddefs["sensor_msgs/msg/NavSatStatus"][1]) - 2)
    )
    message = t[FIX](header, status, 1.0, 2.0, 3.0, np.arange(9.0), 2)
    (group,) = decode(store, FIX, [bytes(store.serialize_ros1(message, FIX))] * 3, "ros1")
    assert group["longitude"].tolist() == [2.0] * 3
    assert group["status.status"].tolist() == [-1] * 3
    assert group.stamp_ns.tolist() == [12 * 10**9 + 34] * 3
    assert group.text("header.frame_id") == "gps"


def test_damaged_messages_are_left_out_and_the_rest_decode() -> None:
    store = ros2_types()
    good = encode(store, IMU, 5, {"linear_acceleration.z": np.arange(5.0), "header.frame_id": "imu"})
    size = len(good[0])
    length_lies = good[0][:12] + struct.pack("<I", 10**6) + good[0][16:]
    messages = [
        b"",
        b"\0\1",
        good[0],
        b"\xff" * size,
        good[1],
        length_lies,
        good[2][:-9],
        good[3],
        good[4],
    ]
    groups = list(decode(store, IMU, messages))
    index = np.concatenate([g.index for g in groups])
    z = np.concatenate([g["linear_acceleration.z"] for g in groups])
    assert dict(zip(index.tolist(), z.tolist(), strict=True)) == {2: 0.0, 4: 1.0, 7: 3.0, 8: 4.0}


def test_a_field_that_is_not_there_is_an_error() -> None:
    with pytest.raises(KeyError, match="linear_accelerations"):
        encode(ros2_types(), IMU, 1, {"linear_accelerations.z": 1.0})


def test_every_type_of_the_contract_can_be_written() -> None:
    """Every message of the contract is made of parts that the layouts know."""
    store = ros2_types()
    kinds = ("Imu", "NavSatFix", "JointState")
    wanted = [f"sensor_msgs/msg/{k}" for k in kinds]
    wanted += [
        f"geometry_msgs/msg/{k}" for k in ("AccelStamped", "PoseStamped", "TwistStamped", "QuaternionStamped")
    ]
    wanted += ["nav_msgs/msg/Odometry", "diagnostic_msgs/msg/DiagnosticArray", "rosgraph_msgs/msg/Clock"]
    for msgtype in wanted:
        (data,) = encode(store, msgtype, 1, {})
        message = store.deserialize_cdr(data, msgtype)
        assert bytes(store.serialize_cdr(message, msgtype)) == data
