# SPDX-License-Identifier: Apache-2.0
"""Felt map matching: the place along a known road from a phone's receiver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.live.felt import FeltPosition, FeltSettings, felt_stage
from suspension_twin.live.twin import DigitalTwin, digital_twin, replay
from suspension_twin.pose.lock import PlanarState
from suspension_twin.road import flat_road, write_road
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin


def poses_of(twin: DigitalTwin, drive: Drive) -> list[PlanarState]:
    """The poses once the yaw is known."""
    twin.follower = None
    return [u.pose for u in replay(drive, twin) if u.pose is not None and u.pose.aligned]


def without(twin: Twin) -> DigitalTwin:
    """The live twin without a felt place."""
    made = digital_twin(twin)
    made.felt = None
    return made


class Watched:
    """A felt place, and what came into it and out of it."""

    def __init__(self, felt: FeltPosition) -> None:
        self.felt, self.inputs, self.outputs, self.known = felt, [], [], []
        step = felt.step

        def watch(pose, *more):
            out = step(pose, *more)
            self.inputs.append(pose)
            self.outputs.append(out)
            self.known.append((felt.known, felt.ahead, felt.spread, felt.offset))
            return out

        felt.step = watch  # type: ignore[method-assign]


@pytest.fixture(scope="module")
def felt(phone_drive) -> Watched:
    """The drive on its own road."""
    twin = digital_twin(phone_drive.twin)
    watched = Watched(twin.felt)
    poses_of(twin, phone_drive.drive)
    return watched


def test_the_place_is_known_to_a_quarter_of_a_metre(felt, phone_drive):
    t = np.array([p.t for p in felt.inputs])
    true = np.interp(t, phone_drive.t, phone_drive.place)
    receiver = np.array([p.x for p in felt.inputs]) - true
    known, ahead, spread, _ = np.array(felt.known, dtype=float).T
    late = t > t[0] + 14.0
    assert known[late].all()
    error = (receiver + ahead)[late]
    assert np.sqrt(np.mean(receiver[late] ** 2)) > 0.8
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert 0.02 < np.median(spread[late]) < 0.25 and np.abs(error / spread[late]).max() < 4.0
    assert np.abs(np.array([p.x for p in felt.outputs])[t > t[-1] - 3.0] - true[t > t[-1] - 3.0]).max() < 0.25


def test_it_moves_along_the_road_alone_at_its_rate_and_says_how_sure_it_is(felt):
    rows = list(zip(felt.inputs, felt.outputs, felt.known, strict=True))
    offsets = np.array([known[3] for *_, known in rows])
    dt = np.diff([p.t for p in felt.inputs])
    assert np.abs(np.diff(offsets)).max() > 0.0
    assert (np.abs(np.diff(offsets)) <= FeltSettings().rate * dt + 1e-12).all()
    for given, out, (known, ahead, spread, offset) in rows[-300:]:
        moved = out.x - given.x, out.y - given.y
        assert np.hypot(*moved) == pytest.approx(abs(offset), abs=1e-9)
        along = np.array([np.cos(given.yaw), np.sin(given.yaw)])
        assert abs(moved @ along) == pytest.approx(abs(offset), rel=1e-3)
        assert out.yaw == given.yaw and out.motion == given.motion and known
        xx, xy, _, yy, *_ = out.covariance
        variance = along @ np.array([[xx, xy], [xy, yy]]) @ along
        assert variance == pytest.approx(spread**2 + (ahead - offset) ** 2, rel=1e-2)


def test_the_lateness_of_the_receiver_is_found(felt):
    assert felt.felt.lateness == pytest.approx(0.4, abs=0.12)


def test_a_second_round_gives_the_same(felt, phone_drive):
    again = digital_twin(phone_drive.twin)
    poses_of(again, replace(phone_drive.drive, imu=phone_drive.drive.imu.select(np.arange(900))))
    watched = Watched(again.felt)
    poses_of(again, phone_drive.drive)
    assert watched.outputs[-1000:] == felt.outputs[-1000:]


@pytest.mark.parametrize("kind", ["flat", "another"])
def test_where_the_road_is_not_felt_the_receiver_is_kept_exactly(kind, phone_drive, tmp_path):
    other = flat_road(400.0, 12.0, x=0.0) if kind == "flat" else iso8608_road("C", 200.0, width=12.0, seed=77)
    write_road(other, tmp_path / "road.crg")
    twin = digital_twin(phone_drive.twin.model_copy(update={"road": RoadFile(file=tmp_path / "road.crg")}))
    watched = Watched(twin.felt)
    poses_of(twin, phone_drive.drive)
    assert len(watched.outputs) > 1500 and not any(known for known, *_ in watched.known)
    assert all(a is b for a, b in zip(watched.inputs, watched.outputs, strict=True))


@pytest.mark.parametrize("sigma", [0.01, 0.3])
def test_of_a_good_receiver_every_bit_stays(sigma, phone_drive):
    drive = phone_drive.drive
    drive = replace(drive, fix=replace(drive.fix, sigma=np.full_like(drive.fix.sigma, sigma)))
    with_it = digital_twin(phone_drive.twin)
    assert poses_of(with_it, drive) == poses_of(without(phone_drive.twin), drive)
    assert with_it.felt.lateness == 0.0


def test_a_receiver_that_becomes_good_takes_over_without_a_jump(phone_drive):
    """The felt offset goes at its rate, then the pose is the lock's again."""
    drive = phone_drive.drive
    sigma = drive.fix.sigma.copy()
    sigma[17:] = 0.02
    twin = digital_twin(phone_drive.twin, felt=FeltSettings(rate=4.0))
    watched = Watched(twin.felt)
    poses_of(twin, replace(drive, fix=replace(drive.fix, sigma=sigma)))
    offsets = np.array([offset for *_, offset in watched.known])
    assert np.abs(offsets).max() > 0.3 and offsets[-1] == 0.0
    assert np.abs(np.diff(offsets)).max() < 4.0 * 0.02
    assert watched.outputs[-1] is watched.inputs[-1]


def test_without_a_road_or_lanes_there_is_none(repository, mondeo):
    assert felt_stage(None, FeltSettings()) is None
    assert felt_stage(mondeo, FeltSettings()) is None
    assert felt_stage(load_twin(repository / "config" / "twins" / "quarter_car.yaml"), FeltSettings()) is None


def test_a_road_that_cannot_be_read_is_said_and_nothing_else(phone_drive, tmp_path):
    missing = phone_drive.twin.model_copy(update={"road": RoadFile(file=tmp_path / "no.crg")})
    felt = felt_stage(missing, FeltSettings())
    twin = without(phone_drive.twin)
    twin.felt = felt
    assert len(poses_of(twin, phone_drive.drive)) > 1500
    assert "no.crg" in felt.condition() and felt.offset == 0.0


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan])
def test_a_rate_that_is_none_is_refused(rate):
    with pytest.raises(InputError, match="felt_rate"):
        FeltSettings(rate=rate)
