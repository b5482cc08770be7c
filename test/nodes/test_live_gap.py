# SPDX-License-Identifier: Apache-2.0
"""The live gap beyond its number: where on the road it lies, and when it leaves what the calibration left."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import AccelStamped
from nav_msgs.msg import Odometry
from nodes_bench import put_stamp, worst
from visualization_msgs.msg import Marker

from suspension_twin.errors import InputError
from suspension_twin.live.follow import BodyAcceleration, Follower, FollowSettings
from suspension_twin.live.gap import CalibrationGap, GapNow, GapTiles, calibration_gap, gap_warning
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.nodes.twin_outputs import colour
from suspension_twin.pose.lock import PlanarMotion, PlanarState
from suspension_twin.vehicle.twin import load_twin, save_twin

T0 = 1.7e9


def drive_over(model, *, bad=(40.0, 45.0), gap=3.0, seconds=10.0, speed=8.0):
    """Along x at ``speed``; the car feels what the twin says, and where x is within ``bad`` an oscillation of 8 Hz and
    ``gap`` rms more."""
    said = []
    model.outputs["twin/vertical_acceleration"].links.append(lambda m: said.append(m.accel.linear.z))
    odom, accel = Odometry(), AccelStamped()
    odom.header.frame_id, odom.pose.pose.orientation.w, odom.twist.twist.linear.x = "map", 1.0, speed
    for k in range(int(seconds * 100)):
        t, x = T0 + k / 100, speed * k / 100
        put_stamp(odom, t)
        odom.pose.pose.position.x = x
        model.inputs["twin/odom"].deliver(odom)
        put_stamp(accel, t)
        shake = math.sqrt(2.0) * gap * math.sin(2 * math.pi * 8.0 * k / 100)
        accel.accel.linear.z = shake if bad[0] <= x < bad[1] else 0.0
        model.inputs["imu/vertical_acceleration"].deliver(accel)
    return said


@pytest.fixture
def flat_twin(tmp_path, twin):
    """A twin file without a road: on flat ground it feels nothing."""
    path = tmp_path / "twin.yaml"
    save_twin(twin.model_copy(update={"road": None}), path)
    return path


def details(path, *drives):
    """Put beside the twin file what a calibration writes."""
    path.with_name(f"{path.stem}.calibration.yaml").write_text(yaml.safe_dump({"drives": list(drives)}))


def test_the_marker_shows_the_metres_where_the_gap_lies(bench, flat_twin):
    model = bench.make(SuspensionModelNode, twin=str(flat_twin), gap__floor=0.5)
    heard = bench.hear(Marker, "/twin/gap_marker")
    drive_over(model)
    bench.until(lambda: len(heard) >= 7, "markers")
    marker = heard[-1]
    assert marker.header.frame_id == "map" and marker.type == Marker.CUBE_LIST and marker.action == Marker.ADD
    assert len(marker.points) == len(marker.colors) > 40
    red = [p.x for p, c in zip(marker.points, marker.colors, strict=True) if c.r == 1.0 and c.g < 0.1]
    ahead = load_twin(flat_twin).imu.position[0]
    assert red and min(red) >= 40.0 + ahead - 1.0 and max(red) <= 45.0 + ahead + 1.0 and len(red) in (5, 6)
    green = [c for c in marker.colors if c.g > 0.8 and c.r == 0.0]
    assert len(marker.points) - len(red) - 2 <= len(green)  # the tiles on either side are half of each


def test_a_new_pass_replaces_the_old_and_the_oldest_is_forgotten():
    tiles = GapTiles()
    for difference in (4.0, -4.0, 4.0):
        tiles.push(0.4, 0.2, 0.1, difference)
    assert tiles.tiles[0, 0] == (0.5, 0.5, 0.1, 4.0)
    tiles.push(-0.2, 0.0, 0.0, 9.0)
    assert list(tiles.tiles) == [(0, 0)]  # one sample says nothing
    for _ in range(3):
        tiles.push(0.4, 0.2, 0.1, 1.0)
    assert tiles.tiles[0, 0].rms == 1.0
    for k in range(3000):
        for _ in range(3):
            tiles.push(10.0 + k, 0.5, 0.0, 1.0)
    assert len(tiles.tiles) == 2000 and (0, 0) not in tiles.tiles and (3009, 0) in tiles.tiles
    tiles.reset()
    assert not tiles.tiles


def test_the_colours_go_from_green_over_yellow_to_red():
    shades = [colour(times) for times in (0.0, 1.0, 2.5, 4.0, 1e9)]
    assert [s.r for s in shades] == [0.0, 0.0, 1.0, 1.0, 1.0]
    assert [s.g for s in shades] == pytest.approx([0.85, 0.85, 0.85, 0.0, 0.0])


def test_diagnostics_warn_while_the_gap_is_beyond_what_the_calibration_left(bench, flat_twin):
    details(
        flat_twin,
        {"gap_after": {"rms": 0.05}, "residual_with_nuisances_corrected": 0.10, "correlation": 0.999},
        {"gap_after": {"rms": 0.07}, "residual_with_nuisances_corrected": None, "correlation": None},
    )
    model = bench.make(SuspensionModelNode, twin=str(flat_twin), gap__window=4.0)
    drive_over(model, bad=(0.0, 0.0), seconds=4.0)
    assert "residual of the calibration" not in worst(model)[1]
    model.reset()
    drive_over(model, seconds=8.0)
    level, text = worst(model)
    rms = model.gap_now().rms
    assert rms == pytest.approx(3.0 * math.sqrt(5.0 / 8.0 / 4.0), rel=0.05)
    warning = (
        f"the gap is {rms:.3g} m/s², {rms / 0.1:.1f} times the residual of the calibration (0.1 m/s²): run"
    )
    assert level == 1 and warning in text
    model.reset()
    drive_over(model, bad=(0.0, 0.0), seconds=4.0)
    assert "residual of the calibration" not in worst(model)[1]


def test_on_a_rougher_road_more_is_left():
    gap = GapNow(1.0, 4.0, 0.01, 10.0, (), 100)
    assert gap_warning(gap, CalibrationGap(0.1, 0.0), 5.0) and not gap_warning(
        gap, CalibrationGap(0.1, 0.0), 10.0
    )
    assert not gap_warning(gap, CalibrationGap(0.1, 0.05), 5.0) and gap_warning(
        gap, CalibrationGap(0.1, 0.05), 4.9
    )
    assert not gap_warning(gap, CalibrationGap(0.0, 0.0), 1.0) and not gap_warning(
        None, CalibrationGap(0.1, 0.0), 1.0
    )


@pytest.mark.parametrize(("sigma", "by_the_place"), [(0.0, False), (0.015, False), (0.8, True)])
def test_a_gap_of_a_place_that_is_not_known_is_no_sign_of_another_vehicle(flat_twin, sigma, by_the_place):
    follower = Follower(load_twin(flat_twin), FollowSettings(floor=CalibrationGap(0.1, 0.0), window=4.0))
    motion, rng = PlanarMotion(5.0, 0.0, 0.0, 0.0, 0.0), np.random.default_rng(1)
    for k in range(1000):
        t, yaw = 0.01 * k, 0.7
        c, s = math.cos(yaw), math.sin(yaw)
        # known across to millimetres, along the course to ``sigma``
        covariance = (sigma**2 * c * c, sigma**2 * c * s, 0.0, sigma**2 * s * s, 0.0, 1e-4)
        pose = PlanarState(t, 5.0 * t * c, 5.0 * t * s, yaw, motion, True, True, covariance)
        follower.step(t, pose, BodyAcceleration((0.0, 0.0, float(rng.normal(0.0, 3.0)))))
    warning = follower.gap_warning()
    assert "residual of the calibration" in warning
    assert ("run a diagnosis" in warning) is not by_the_place
    assert ("known to 0.8 m" in warning) is by_the_place
    assert warning in [finding.text for finding in follower.findings]


def test_without_a_calibration_there_is_nothing_to_warn_of_and_a_parameter_can_say_it(bench, flat_twin):
    model = bench.make(SuspensionModelNode, twin=str(flat_twin))
    drive_over(model, bad=(20.0, 60.0))
    assert "residual of the calibration" not in worst(model)[1]
    said = bench.make(
        SuspensionModelNode, namespace="other", twin=str(flat_twin), gap__floor=0.2, gap__warn=100.0
    )
    drive_over(said, bad=(20.0, 60.0))
    assert "residual of the calibration" not in worst(said)[1]


@pytest.mark.parametrize("text", ["[1, 2", "drives: 7", "drives: [{gap_after: {}}]", "other: 1", "[" * 3000])
def test_details_that_say_nothing_are_named(flat_twin, text):
    flat_twin.with_name("twin.calibration.yaml").write_text(text)
    with pytest.raises(InputError, match=r"twin\.calibration\.yaml: drives: has no residual"):
        calibration_gap(0.0, str(flat_twin))


def test_no_details_no_floor(tmp_path):
    for twin in ("", str(tmp_path / "twin.yaml")):
        assert calibration_gap(0.0, twin) == CalibrationGap(0.0, 0.0)
