# SPDX-License-Identifier: Apache-2.0
"""The four nodes and the player in one process."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from geometry_msgs.msg import AccelStamped, TwistStamped
from nodes_bench import PATIENT, stamp_of
from rclpy.clock import Clock as RosClock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.drive.checks import nanoseconds
from suspension_twin.drive.types import Drive, HeadingData
from suspension_twin.nodes.composed import LINKS, Composed, Playback
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.player import BagPlayer
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.process import ros_context
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.nodes.topics import Embedding
from suspension_twin.testing import running_twin

WARMING = 16  # samples before the IMU's rate is known


@pytest.fixture
def composed(twin_path, request):
    """A function that makes the composition for a playback; taken down afterwards."""
    made = []
    with ros_context(PATIENT) as context:

        def make(playback=None, namespace=""):
            made.append(Composed(context, twin_path, namespace, playback))
            return made[-1]

        yield make
        for one in made:
            one.close()


def answers(nodes) -> dict[str, list]:
    """Lists that fill with stamps and values of the twin's and the measured acceleration."""
    out: dict[str, list] = {"twin": [], "measured": []}

    def into(name):
        return lambda m: out[name].append((stamp_of(m), m.accel.linear.z))

    nodes["suspension_model"].outputs["twin/vertical_acceleration"].links.append(into("twin"))
    nodes["imu_ingest"].outputs["imu/vertical_acceleration"].links.append(into("measured"))
    return out


def play(one: Composed, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not one.finished:
        assert time.monotonic() < end
        one.step()


def connect(bench, player: BagPlayer, nodes) -> None:
    """Wait until the player's topics and those of the nodes know each other both ways, then begin."""
    topics = {output.publisher.topic_name for output in player.outputs.values()}
    ends = [s for node in nodes.values() for s in node.subscriptions if s.topic_name in topics]
    bench.until(lambda: all(end.get_publisher_count() for end in ends), "the player")
    senders = [output.publisher for output in player.outputs.values()]
    bench.until(lambda: all(sender.get_subscription_count() for sender in senders), "the nodes")
    player.reset()


def test_every_sample_is_answered_once_with_its_stamp_and_the_twin_follows(twin_path, drive):
    with running_twin(twin_path) as nodes:
        out = nodes.replay(drive)
    measured, twin = (out[f"{side}/vertical_acceleration"] for side in ("imu", "twin"))
    stamps = nanoseconds(drive.imu.t).tolist()[WARMING:]
    assert [stamp_of(m) for m in twin.messages] == [stamp_of(m) for m in measured.messages] == stamps
    measured, twin = (received["accel.linear.z"] for received in (measured, twin))
    moving = drive.imu.t[WARMING:] > drive.imu.t[0] + 5.0
    # The drive was made by this very twin: what is left is noise and what the pose lacks.
    assert np.corrcoef(measured[moving], twin[moving])[0, 1] > 0.97
    assert np.std((measured - twin)[moving]) < 0.25 * np.std(measured[moving])
    standing = drive.imu.t[WARMING:] < drive.imu.t[0] + 1.5
    assert np.abs(twin[standing]).max() < 0.01


def test_the_condition_counts_samples_and_answers(composed, drive):
    one = composed(Playback(drive, math.inf))
    play(one)
    condition = one.condition()
    assert condition.samples == len(drive.imu) and condition.answers == len(drive.imu) - WARMING
    assert condition.played.position == pytest.approx(condition.played.duration) and condition.gap is not None
    assert not condition.failing


@pytest.mark.long
def test_alone_and_over_the_wire_the_nodes_say_the_same(composed, bench, twin_path, drive):
    one = composed(Playback(drive, math.inf), namespace="inner")
    inner = answers(one.nodes)
    play(one)
    given = {"namespace": "outer", "twin": str(twin_path)}
    kinds = {
        "imu_ingest": ImuIngestNode,
        "pose_injector": PoseInjectorNode,
        "suspension_model": SuspensionModelNode,
    }
    nodes = {name: bench.make(kind, **given) for name, kind in kinds.items()}
    outer = answers(nodes)
    for topic in ("imu/data", "imu/vertical_acceleration", "twin/odom"):
        out = next(n.outputs[topic].publisher for n in nodes.values() if topic in n.outputs)
        bench.until(out.get_subscription_count, f"a subscriber of {topic}")
    player = bench.add(BagPlayer(drive, 2.0, False, Embedding(bench.context, "outer")))
    connect(bench, player, nodes)
    end = time.monotonic() + 60.0
    while len(outer["twin"]) < len(inner["twin"]):
        assert time.monotonic() < end, f"{len(outer['twin'])} of {len(inner['twin'])}"
        bench.spin(min(player.play(), 0.01))
    assert outer["measured"] == inner["measured"]
    assert [s for s, _ in outer["twin"]] == [s for s, _ in inner["twin"]]
    # A fix may come before or after the sample it belongs to, which moves the pose by millimetres; an odometry has no
    # acceleration, whose part below 0.4 Hz is differentiated.
    difference = np.array([a - b for (_, a), (_, b) in zip(outer["twin"], inner["twin"], strict=True)])
    assert np.std(difference) < 0.03 * np.std([v for _, v in inner["twin"]])


def test_a_looped_bag_resets_the_nodes_and_says_the_same_again(composed, drive):
    one = composed(Playback(drive, math.inf, loop=True))
    got = answers(one.nodes)
    end = time.monotonic() + 120.0
    while one.player.loops < 3:
        assert time.monotonic() < end
        one.step()
    count = len(drive.imu) - WARMING
    assert got["twin"][:count] == got["twin"][count : 2 * count]
    assert got["measured"][:count] == got["measured"][count : 2 * count]
    assert len(got["twin"]) == 3 * count
    for name in ("imu_ingest", "pose_injector", "suspension_model"):
        assert one.nodes[name].health.count("resets after a jump back in time") == 2
    assert not one.finished and one.condition().played.rounds == 3


def test_linked_topics_are_not_subscribed_and_a_stranger_on_them_is_told(composed, bench, drive):
    one = composed()
    for topic, _, receiver in LINKS:
        subscribed = [s.topic_name for s in one.nodes[receiver].subscriptions]
        assert f"/{topic}" not in subscribed
    assert "/imu/data_raw" in [s.topic_name for s in one.nodes["imu_ingest"].subscriptions]
    bench.side.create_publisher(Imu, "/imu/data", 10)
    end = time.monotonic() + 20.0
    while not any("another publisher on /imu/data" in text for text in one.condition().complaints):
        assert time.monotonic() < end
        one.step()


@pytest.mark.long
def test_live_over_the_wire_and_silence_is_named(composed, bench, drive):
    one = composed(namespace="car")

    heard = []
    ear = bench.side.create_subscription(AccelStamped, "/car/twin/vertical_acceleration", heard.append, 1000)
    bench.until(ear.get_publisher_count, "the twin")
    player = bench.add(BagPlayer(drive, 2.0, False, Embedding(bench.context, "car")))
    connect(bench, player, one.nodes)
    end = time.monotonic() + 60.0
    while len(heard) < len(drive.imu) - WARMING:
        assert time.monotonic() < end, f"{len(heard)} answers"
        player.play()
        one.step(0.001)
        bench.spin(0.01)
    while not any("no message on imu/data_raw" in text for text in one.condition().complaints):
        assert time.monotonic() < end
        one.step()


def test_simulated_time_runs_with_the_recording(composed, bench, drive):
    clocks = []
    bench.side.create_subscription(
        Clock, "/clock", lambda m: clocks.append(m.clock.sec + m.clock.nanosec / 1e9), 1000
    )
    one = composed(Playback(drive, 20.0, delay=0.5))
    began = None
    while not one.finished:
        one.step()
        bench.executor.spin_once(timeout_sec=0.0)
        if began is None and one.player.position > 0:
            began = time.monotonic()
    took = time.monotonic() - began
    assert took >= one.player.duration / 20.0 - 0.1  # and not much more, but a busy machine may hold it up
    bench.until(lambda: clocks and clocks[-1] >= drive.imu.t[-1] - 0.2)
    assert np.diff(clocks).min() >= 0.0
    model = one.nodes["suspension_model"]
    for _ in range(20):
        one.step(0.01)
    assert model.get_clock().now().nanoseconds / 1e9 == pytest.approx(drive.imu.t[-1], abs=0.5)
    assert model.get_parameter("use_sim_time").value is True


def test_a_busy_first_node_does_not_starve_the_others_of_a_replay(composed, drive):
    """As on a machine that other programs keep busy: something is always ready at the node that is looked at first."""
    one = composed(Playback(drive, 2.0))
    first, *others = one.executor.get_nodes()
    busy = first.create_timer(
        1e-5, lambda: time.sleep(0.002), clock=RosClock(clock_type=ClockType.STEADY_TIME)
    )
    while one.player.position < 2.0:
        one.step()
    for node in (n for n in others if n is not one.player):
        now = node.get_clock().now().nanoseconds / 1e9
        # one that starves stays at the start; a loaded machine lets the others lag, but not by half
        assert 0.5 < (now - drive.imu.t[0]) / one.player.position < 1.5, node.get_name()
    first.destroy_timer(busy)


def test_a_rejected_twin_leaves_nothing_behind(twin_path, tmp_path):
    from suspension_twin.errors import InputError

    with ros_context([]) as context:
        with pytest.raises(InputError, match="absent"):
            Composed(context, tmp_path / "absent.yaml")
        Composed(context, twin_path).close()


def test_the_player_sends_what_was_recorded_in_the_order_of_its_stamps(bench, drive):
    stamped = replace(
        drive,
        heading=HeadingData(t=drive.fix.t[:5], yaw=np.array([0.1, 0.2, 3.0, -3.0, 0.0])),
        fix=replace(
            drive.fix, sigma=np.where(np.arange(len(drive.fix))[:, None] < 3, np.nan, drive.fix.sigma)
        ),
    )
    player = bench.add(BagPlayer(stamped, math.inf, False, Embedding(bench.context)))
    rows = []
    for topic, output in player.outputs.items():
        output.links.append(lambda m, topic=topic: rows.append((topic, stamp_of(m), m)))
    kept = []
    player.outputs["fix"].links.append(
        lambda m: kept.append((m.latitude, m.position_covariance_type, float(m.position_covariance[0])))
    )
    forces = []
    player.outputs["imu/data_raw"].links.append(lambda m: forces.append(m.linear_acceleration.z))
    while not player.done:
        player.play()
    stamps = [s for _, s, _ in rows]
    assert stamps == sorted(stamps)
    count = {topic: sum(t == topic for t, _, _ in rows) for topic in player.outputs}
    assert count == {
        "imu/data_raw": len(drive.imu),
        "fix": len(drive.fix),
        "vel": len(drive.velocity),
        "heading": 5,
    }
    assert forces == drive.imu.specific_force[:, 2].tolist()
    assert [k[1] for k in kept[:4]] == [NavSatFix.COVARIANCE_TYPE_UNKNOWN] * 3 + [
        NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
    ]
    assert kept[5][0] == drive.fix.latitude[5] and kept[5][2] == pytest.approx(drive.fix.sigma[5, 0] ** 2)
    assert player.play() == math.inf


def test_at_full_speed_a_slow_subscriber_outside_misses_nothing(bench, drive):
    short = Drive(drive.name, drive.imu, drive.fix, drive.velocity)
    player = bench.add(BagPlayer(short, math.inf, False, Embedding(bench.context), delay=0.0))
    heard = bench.hear(TwistStamped, "/vel")
    imus = bench.hear(Imu, "/imu/data_raw")
    while not player.done:
        player.play()
    bench.until(lambda: len(heard) == len(drive.velocity) and len(imus) == len(drive.imu))


def test_parameters_are_told_by_node(composed):
    names = composed().parameter_names()
    assert set(names) == {"imu_ingest", "pose_injector", "suspension_model", "calibrator"}
    assert "filter.cutoff" in names["imu_ingest"] and "gap.window" in names["suspension_model"]


def test_another_filter_is_the_same_filter_for_both(composed, drive):
    one = composed(Playback(drive, math.inf))
    for name in ("imu_ingest", "suspension_model", "pose_injector"):
        (result,) = one.nodes[name].set_parameters([Parameter("filter.cutoff", value=8.0)])
        assert result.successful, result.reason
    got = answers(one.nodes)
    play(one)
    measured, twin = (np.array([v for _, v in got[k]]) for k in ("measured", "twin"))
    moving = drive.imu.t[WARMING:] > drive.imu.t[0] + 5.0
    assert np.corrcoef(measured[moving], twin[moving])[0, 1] > 0.97


def test_it_starts_without_what_a_live_twin_does_not_use() -> None:
    """A second of imports: statistics and pictures are the workers', splines the offline pose's."""
    unused = (
        "matplotlib",
        "scipy.stats",
        "scipy.signal",
        "scipy.interpolate",
        "suspension_twin.addons.roads.drives",
    )
    code = f"import sys, suspension_twin.nodes.session; print([n for n in {unused} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
