# SPDX-License-Identifier: Apache-2.0
"""A writer never writes what its reader refuses: it writes something that reads back, or says what is wrong."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from suspension_twin.diagnosis.answer import _read, write_document
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.rig import RigRecord, read_rig, write_rig
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.inference.checkpoint import Checkpoint, State
from suspension_twin.road import load_road, write_road
from suspension_twin.road.build import grid_road
from suspension_twin.road.profile import Profile, profile_road
from suspension_twin.vehicle.twin import load_twin, save_twin

MANY = settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
NUMBERS = st.floats(width=64) | st.sampled_from([0.0, 1e8, -1e8, 1e300, 1e-300, math.nan, math.inf])
HEIGHTS = st.floats(-20_000.0, 20_000.0) | st.sampled_from([1e8, math.nan, 1e30, 9_999.0])


@MANY
@given(
    arrays(np.float64, (5, 3), elements=HEIGHTS),
    st.floats(1e-8, 2e4),
    st.lists(st.floats(-6000.0, 6000.0), min_size=3, max_size=3),
    st.tuples(NUMBERS, NUMBERS, st.floats(-7.0, 7.0)),
)
def test_a_road(z, step, v, place):
    with TemporaryDirectory() as folder:
        path = Path(folder, "road.crg")
        try:
            x, y, heading = place
            write_road(grid_road(z, step, sorted(v), x=x, y=y, heading=heading), path)
        except SuspensionTwinError:
            assert not path.exists()
            return
        assert load_road(path).z.shape == (5, 3)


@MANY
@given(arrays(np.float64, (2, 6), elements=HEIGHTS), st.floats(1e-9, 1e5), st.floats(0.1, 1e5))
def test_a_road_of_a_profile(z, step, width):
    with TemporaryDirectory() as folder:
        path = Path(folder, "road.crg")
        try:
            write_road(profile_road(Profile("p", step, z, ("left", "right")), width=width), path)
        except SuspensionTwinError:
            assert not path.exists()
            return
        load_road(path)


@MANY
@given(
    st.sampled_from(
        ["vehicle.mass", "imu.position.0", "imu.rpy.1", "vehicle.tyre.radius", "vehicle.front.spring.force.0"]
    ),
    NUMBERS | st.floats(0.0, 5000.0),
    st.text(max_size=40),
)
def test_a_twin(repository, key, value, heading):
    twin = load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")
    try:
        twin = twin.with_changes({key: value})
    except InputError:
        return
    with TemporaryDirectory() as folder:
        save_twin(twin, Path(folder, "twin.yaml"))
        assert load_twin(Path(folder, "twin.yaml")) == twin


@MANY
@given(
    arrays(np.float64, 30, elements=st.floats(-1.0, 1.0)),
    arrays(np.float64, (30, 6), elements=NUMBERS),
    arrays(np.float64, (30, 3), elements=NUMBERS),
)
def test_a_drive(jitter, imu, fix):
    t = np.sort(1.7e9 + 0.01 * np.arange(30) + 0.02 * jitter)
    drive = Drive(
        "drive",
        ImuData(t, imu[:, :3], imu[:, 3:]),
        FixData(t, fix[:, 0], fix[:, 1], fix[:, 2], np.zeros(30, np.int8), np.full((30, 3), np.nan)),
        VelocityData.empty(),
    )
    with TemporaryDirectory() as folder:
        path = Path(folder, "drive.mcap")
        try:
            write_drive(drive, path)
        except SuspensionTwinError:
            assert not path.exists()
            return
        try:
            read_drive(path)
        except InputError as error:  # a drive of which nothing can be used was none before, either
            assert "damaged" not in str(error) and "unexpected" not in str(error)


@MANY
@given(arrays(np.float64, (30, 2), elements=st.floats(-1e6, 1e6)), st.text(max_size=30))
def test_a_run_of_a_rig(values, comment):
    columns = {"road_displacement": values[:, 0], "body_acceleration": values[:, 1]}
    with TemporaryDirectory() as folder:
        path = Path(folder, "run.csv")
        try:
            write_rig(RigRecord("run", 0.01 * np.arange(30), columns, ()), path, comment)
        except SuspensionTwinError:
            assert not path.exists()
            return
        read_rig(path)


@MANY
@given(arrays(np.float64, 4, elements=NUMBERS), NUMBERS, st.text(max_size=20))
def test_a_state_of_a_search(values, number, text):
    with TemporaryDirectory() as folder:
        store = Checkpoint(Path(folder, "states"), "problem")
        store.save(State("search", {"x": values}, {"cost": number, "text": text}))
        found = store.load()
        assert found is not None and np.array_equal(found.arrays["x"], values, equal_nan=True)


@MANY
@given(
    st.recursive(
        NUMBERS | st.text(max_size=9), lambda inner: st.dictionaries(st.text(max_size=5), inner, max_size=3)
    )
)
def test_a_document(value):
    with TemporaryDirectory() as folder:
        try:
            write_document({"value": value}, Path(folder))
        except ValueError:  # a number that is none is refused where it is written
            assert not Path(folder, "diagnosis.json").exists()
            return
        assert _read(Path(folder, "diagnosis.json")) == {"value": value}
