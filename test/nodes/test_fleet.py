# SPDX-License-Identifier: Apache-2.0
"""Many twins in one process: each answers its own vehicle as a twin by itself does, whoever else is there."""

from __future__ import annotations

import math
import time
from collections import defaultdict

import pytest
from geometry_msgs.msg import TwistStamped
from nodes_bench import PATIENT, stamp_of
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from suspension_twin.addons.cli.live_fleet import rows, summary
from suspension_twin.cli.main import main
from suspension_twin.errors import InputError
from suspension_twin.live.gap import GapNow
from suspension_twin.nodes.composed import Composed, Condition, Helpers, Playback, TwinFleet
from suspension_twin.nodes.topics import STREAM_QOS

SAMPLES = 600  # of the drive, 6 s: standing, then driving off over the waves


@pytest.fixture
def fleet(bench, twin_path):
    made = TwinFleet(bench.context, {"a": str(twin_path), "depot/b": str(twin_path)})
    yield made
    made.close()


def test_every_twin_answers_as_if_it_were_alone(bench, fleet, twin_path, drive):
    first = drive.imu.t[SAMPLES - 1]
    single = Composed(bench.context, twin_path, "single", Playback(drive, math.inf))
    wanted, messages = {}, []
    single.nodes["suspension_model"].outputs["twin/vertical_acceleration"].links.append(
        lambda m: wanted.update({stamp_of(m): m.accel.linear.z})
    )
    kinds = {"imu/data_raw": Imu, "fix": NavSatFix, "vel": TwistStamped}
    for topic in kinds:
        single.player.outputs[topic].links.append(lambda m, topic=topic: messages.append((topic, _copied(m))))
    while not single.finished and single.player.position <= first - drive.imu.t[0] + 0.5:
        single.step()
    single.close()

    got = defaultdict(dict)
    frames = set()
    publishers = {}
    for name, twin in fleet.twins.items():
        model = twin.nodes["suspension_model"].outputs
        model["twin/vertical_acceleration"].links.append(
            lambda m, name=name: got[name].update({stamp_of(m): m.accel.linear.z})
        )
        model["twin/imu"].links.append(lambda m: frames.add(m.header.frame_id))
        for topic, kind in kinds.items():
            publishers[name, topic] = bench.side.create_publisher(kind, f"/{name}/{topic}", STREAM_QOS)
    _until(fleet, lambda: all(p.get_subscription_count() for p in publishers.values()))
    sent = 0
    for topic, message in messages:
        if sent == SAMPLES:
            break
        sent += topic == "imu/data_raw"
        for name in fleet.twins:
            publishers[name, topic].publish(message)
        _until(fleet, lambda topic=topic, n=sent: all(_taken(t, topic) >= n for t in fleet.twins.values()))
    assert frames == {"a/imu_link", "depot/b/imu_link"}
    assert len(got["a"]) > SAMPLES - 50
    for name in fleet.twins:
        assert got[name] == {s: v for s, v in wanted.items() if s in got["a"]}
    assert max(abs(v) for v in got["a"].values()) > 0.5


def _copied(message):
    import copy

    return copy.deepcopy(message)


def _taken(twin, topic):
    return twin.nodes["imu_ingest"].inputs[topic].state.received if topic == "imu/data_raw" else math.inf


def _until(fleet, condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        fleet.step(0.02)


def test_services_and_diagnostics_of_each_are_served(bench, fleet):
    client = bench.side.create_client(Trigger, "/depot/b/suspension_model/reset")
    _until(fleet, client.service_is_ready)
    future = client.call_async(Trigger.Request())
    _until(fleet, lambda: (bench.spin(0.01), future.done())[1])
    assert future.result().success
    heard = bench.hear(_diagnostics(), "/diagnostics")
    names = {"a/imu_ingest", "depot/b/pose_injector", "depot/b/suspension_model"}
    _until(fleet, lambda: (bench.spin(0.01), names <= {s.name for m in heard for s in m.status})[1])
    assert set(fleet.conditions()) == {"a", "depot/b"} and "calibrator" not in fleet.twins["a"].nodes


def _diagnostics():
    from diagnostic_msgs.msg import DiagnosticArray

    return DiagnosticArray


def test_a_process_beside_says_how_its_twins_are_or_what_is_wrong_with_them(twin_path, tmp_path):
    with Helpers([{"c": str(twin_path)}, {"d": str(tmp_path / "no.yaml")}], PATIENT) as helpers:
        with pytest.raises(InputError, match=r"no\.yaml"):
            helpers.wait(lambda: True)
        assert helpers._known["c"].samples == 0
        processes = [p for p, _ in helpers._processes]
    assert not any(p.is_alive() for p in processes)


def condition(**given) -> Condition:
    plain = {
        "rates": {"imu": math.nan},
        "samples": 0,
        "answers": 0,
        "gap": None,
        "complaints": [],
        "failing": False,
    }
    return Condition(**(plain | given))


def gap(rms: float, normalised: float = math.nan) -> GapNow:
    return GapNow(rms, 1.0, 0.1, normalised, (), 100)


def test_a_line_says_how_all_are_and_one_what_is_wrong_with_each():
    text = summary(
        {
            "a": condition(rates={"imu": 99.6}, gap=gap(0.3, 1.2)),
            "b": condition(rates={"imu": 101.2}, gap=gap(0.2, 3.4)),
            "c": condition(complaints=["imu_ingest: no message", "more"], failing=True),
        }
    ).plain
    assert text == (
        "3 twins, 2 with samples at 100 to 101 Hz | largest gap now /b 0.20 m/s² (3.4 × noise)\n"
        "/c: imu_ingest: no message (+1)"
    )


def test_the_page_gets_numbers_that_json_can_say():
    found = rows(
        {
            "a": condition(gap=gap(math.nan)),
            "b": condition(gap=gap(0.2, 3.1), complaints=["late"], rates={"imu": 99.0}),
        }
    )
    assert found["a"] == {"rate": 0.0, "gap": "", "text": "", "failing": False}
    assert (found["b"]["rate"], found["b"]["gap"], found["b"]["text"]) == (
        99.0,
        "0.20 m/s² (3.1 × noise)",
        "late",
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--fleet", "f.csv", "--bag", "x"], "--bag: goes without --fleet"),
        (["--fleet", "f.csv", "--view", "no:port"], "--view: must be a port"),
        (["--fleet", "f.csv", "--twin", "x"], "--twin: goes without --fleet"),
        (["--fleet", "absent.csv"], "absent.csv"),
        (["--twin", "x", "--processes", "2"], "--processes: needs --fleet"),
        ([], "--twin: is needed"),
    ],
)
def test_wrong_arguments_are_one_line(given, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", *given]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
