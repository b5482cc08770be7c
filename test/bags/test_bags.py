# SPDX-License-Identifier: Apache-2.0
"""The bundled drives: made by the program beside them, physical, small, and what their pages say."""

from __future__ import annotations

import ast
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt, welch

from suspension_twin.drive.read import read_drive
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.types import Trajectory
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import load_twin

G = 9.80665
BAGS = Path(__file__).resolve().parents[2] / "bags"
NAMES = ("bump_15kmh", "crg_road")
PLACES = {
    "bump_15kmh": (47 + 24 / 60 + 9.0 / 3600, 19 + 17 / 60 + 2.5 / 3600),
    "crg_road": (47 + 28 / 60 + 43.2 / 3600, 19 + 3 / 60 + 24.4 / 3600),
}
#: The car paper's Table 2: bounds in N at the abscissae of a twin's points.
SPRING = {0.1: (500, 5000), 0.3: (5000, 9000), 0.5: (9000, 15000), 1.0: (15000, 50000)}
PUSH = {0.125: (40, 1000), 0.25: (1000, 3000), 0.35: (3000, 5000), 0.4: (5000, 8000)}
PULL = {0.125: (500, 2000), 0.25: (2000, 3000), 0.35: (3000, 5000), 0.4: (5000, 6000)}


@pytest.fixture(scope="module", params=NAMES)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def truth(name):
    with np.load(BAGS / name / "truth.npz") as file:
        columns = {k: file[k].astype(np.float64) for k in file.files}
    columns["t"] = (
        columns["start"] + np.arange(columns["t"].size) * 0.01
    )  # single precision keeps 0.01 s well enough
    return columns


@pytest.fixture(scope="module")
def drive(name):
    return read_drive(BAGS / name)


@pytest.fixture(scope="module")
def maker():
    pytest.importorskip("mujoco")
    sys.path.insert(0, str(BAGS))
    try:
        import make_bags
    finally:
        sys.path.remove(str(BAGS))
    return make_bags


def low_pass(x, cutoff=20.0):
    return sosfiltfilt(butter(2, cutoff, fs=100.0, output="sos"), x, axis=0)


# -- made by the program ---------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("scene", "seconds"), [("bump_15kmh", 10.6), ("bump_phone", 10.6), ("crg_road", 6.0)]
)
def test_the_program_makes_the_beginning_of_the_committed_drive(maker, scene, seconds):
    """Another MuJoCo or libm may round otherwise: then a sample may fall to the converter's next step."""
    made = maker.scenes.SCENES[scene]()
    again = maker.simulate(made, seconds).drive
    kept = read_drive(BAGS / scene)
    n = len(again.imu) - 2
    assert n > 0.97 * made.phone.rate * seconds
    np.testing.assert_allclose(kept.imu.t[:n], again.imu.t[:n], rtol=0, atol=1e-6)
    phone = made.phone
    for ours, theirs, step in (
        (again.imu.specific_force, kept.imu.specific_force, phone.force_step),
        (again.imu.angular_rate, kept.imu.angular_rate, phone.rate_step),
    ):
        difference = np.abs(ours[:n] - theirs[:n])
        assert difference.max() < 1.01 * step
        assert np.mean(difference > 0.01 * step) < 0.01
    m = len(again.fix) - 2
    np.testing.assert_allclose(kept.fix.latitude[:m], again.fix.latitude[:m], rtol=0, atol=1e-9)
    np.testing.assert_allclose(kept.velocity.enu[:m], again.velocity.enu[:m], rtol=0, atol=1e-5)


@pytest.mark.parametrize("scene", NAMES)
def test_the_road_and_twin_files_are_the_program_s(maker, scene, tmp_path):
    made = maker.scenes.SCENES[scene]()
    road, kept = maker.road_file(made), load_road(BAGS / scene / "road.crg")
    np.testing.assert_allclose(kept.z, road.z, rtol=0, atol=1e-7)
    np.testing.assert_allclose(
        np.column_stack([kept.x, kept.y]), np.column_stack([road.x, road.y]), rtol=0, atol=1e-6
    )  # in a bend the chord between two sections is shorter than the file's even step
    for file, twin in (("twin.yaml", maker.preset_twin(made)), ("truth.yaml", maker.true_twin(made))):
        (tmp_path / "road.crg").touch()
        maker.save_twin(twin, tmp_path / file)
        assert (tmp_path / file).read_text() == (BAGS / scene / file).read_text()


def test_the_phone_s_drive(tmp_path, maker):
    """As a phone records it by itself, small, with a car that has no road and no place yet."""
    from suspension_twin.signals.offline import ingest_drive

    folder, drive = BAGS / "bump_phone", read_drive(BAGS / "bump_phone")
    assert sum(f.stat().st_size for f in folder.iterdir()) < 1_000_000
    assert np.median(np.diff(drive.imu.t)) == pytest.approx(1 / 67, abs=1e-3)
    assert np.median(np.diff(drive.fix.t)) == pytest.approx(1.0, abs=1e-6)
    twin = load_twin(folder / "car.yaml")
    assert twin.road is None and twin.datum is None and twin.gps.position == twin.imu.position
    maker.save_twin(maker.preset_twin(maker.scenes.bump_phone()), tmp_path / "car.yaml")
    assert (tmp_path / "car.yaml").read_text() == (folder / "car.yaml").read_text()
    exact = read_drive(BAGS / "bump_15kmh")
    began = drive.imu.t[0] - exact.imu.t[0]
    east, north = (
        (getattr(drive.fix, k) - np.interp(drive.fix.t - began - 0.4, exact.fix.t, getattr(exact.fix, k))) * m
        for k, m in (("longitude", 111_200.0 * math.cos(math.radians(47.4))), ("latitude", 111_200.0))
    )
    assert 1.0 < np.sqrt(np.mean(east**2 + north**2)) < 6.0
    assert [f for f in ingest_drive(drive, twin.imu).findings if f.level != "ok"] == []


def test_the_reality_imports_nothing_of_the_package():
    files = list((BAGS / "reality").glob("*.py"))
    assert len(files) >= 5
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(n.startswith("suspension_twin") for n in names), file


# -- physics ---------------------------------------------------------------------------------------


def test_the_car_at_rest_carries_its_weight_and_stays(maker):
    """Springs and tyres hold 1725 kg; the phone feels gravity and nothing else."""
    scene = maker.scenes.crg_road()
    flat = type(scene.surface)(1.0, 1.0, -5.0, (0.0, 0.0), np.zeros(41), np.zeros((41, 11)))
    car = maker.MONDEO
    rig = maker.Rig(car, flat, (1.9, 0.0, 1.2), np.array([1.0, 0.0, 0.0, 0.0]))
    rig.place(10.0, 0.0, 0.3, 10.0)
    before = rig.state()
    for _ in range(2000):
        rig.step(0.0, 0.0, 4000.0)
    np.testing.assert_allclose(rig.state(), before, rtol=0, atol=1e-6)
    np.testing.assert_allclose(rig.data.sensordata, [0, 0, G, 0, 0, 0], rtol=0, atol=1e-5)
    lifted = sum(rig.data.xfrc_applied[2 + i, 2] for i in range(4))
    assert lifted == pytest.approx(1725.0 * G, rel=1e-9)
    front = sum(rig.data.xfrc_applied[2 + i, 2] for i in range(2))
    assert front == pytest.approx(1725.0 * G * 1.5 / 2.85, rel=1e-6)
    assert float(np.sum(rig.model.body_mass)) == pytest.approx(1725.0, rel=1e-9)


def test_a_lifted_car_heaves_at_the_frequency_of_its_springs(maker):
    """Without dampers and friction the body swings at sqrt(k/m) of springs and tyres in series."""
    from dataclasses import replace

    loose = ((0.125, 1e-3), (0.25, 2e-3), (0.35, 3e-3), (0.4, 4e-3))
    stiff = ((0.1, 2500.0), (0.3, 7500.0), (0.5, 12_500.0), (1.0, 25_000.0))  # linear, 25 kN/m
    strut = replace(maker.MONDEO.front, push=loose, pull=loose, friction=0.0, unsprung=40.0, spring=stiff)
    car = replace(
        maker.MONDEO, front=strut, rear=strut, tyre_damping=0.0, cog=(1.425, 0.0, 0.55), tyre_stiffness=2e5
    )
    scene = maker.scenes.crg_road()
    flat = type(scene.surface)(1.0, 1.0, -5.0, (0.0, 0.0), np.zeros(41), np.zeros((41, 11)))
    rig = maker.Rig(car, flat, (0.0, 0.0, 0.0), np.array([1.0, 0.0, 0.0, 0.0]))
    rig.place(10.0, 0.0, 0.0, 10.0)
    rig.data.qpos[2] += 0.01
    rig.data.qpos[7:11] -= 0.01
    height = []
    for _ in range(16_000):
        rig.step(0.0, 0.0, 4000.0)
        height.append(rig.data.qpos[2])
    swing = np.array(height) - np.mean(height)
    crossings = np.flatnonzero((swing[:-1] < 0) & (swing[1:] >= 0))
    frequency = (crossings.size - 1) / ((crossings[-1] - crossings[0]) * maker.STEP)
    k = 4 / (1 / 25e3 + 1 / 2e5)
    assert frequency == pytest.approx(math.sqrt(k / (1725.0 - 160.0)) / (2 * math.pi), rel=0.015)


def test_the_phone_hears_gravity_and_little_else_while_it_stands(drive):
    still = drive.imu.t < drive.imu.t[0] + 3.5
    force = drive.imu.specific_force[still]
    assert np.linalg.norm(force.mean(0)) == pytest.approx(G, abs=0.15)
    assert np.all(force.std(0) < 0.03)
    assert np.all(drive.imu.angular_rate[still].std(0) < 0.003)
    up = force.mean(0) / np.linalg.norm(force.mean(0))
    np.testing.assert_allclose(up, [0.0, math.cos(math.radians(15)), math.sin(math.radians(15))], atol=0.03)


def test_the_stamps_are_a_phone_s(drive):
    steps = np.diff(drive.imu.t)
    assert np.median(steps) == pytest.approx(0.01, abs=1e-4)
    assert 2e-4 < np.std(steps[steps < 0.015]) < 1e-3
    assert 0 < np.mean(steps > 0.015) < 0.01
    assert np.median(np.diff(drive.fix.t)) == pytest.approx(0.1, abs=1e-6)


def test_peaks_are_those_of_a_car_and_the_phone_measured_them(name, truth, drive):
    felt = low_pass(truth["vertical_acceleration"])
    assert 3.0 < np.abs(felt).max() < 10.0
    # The phone's own up axis, its gravity removed, against the undisturbed sensor.
    still = drive.imu.t < drive.imu.t[0] + 3.5
    mean = drive.imu.specific_force[still].mean(0)
    up = drive.imu.specific_force @ (mean / np.linalg.norm(mean)) - np.linalg.norm(mean)
    uniform = np.interp(truth["t"], drive.imu.t, up)
    inside = slice(200, -100)
    assert np.corrcoef(low_pass(uniform)[inside], felt[inside])[0, 1] > 0.97


def test_the_receiver_is_as_good_as_its_page_says(name, truth, drive):
    from scipy.spatial.transform import Rotation

    twin = load_twin(BAGS / name / "twin.yaml")
    columns = [
        np.interp(drive.fix.t, truth["t"], np.unwrap(truth[k]) if k == "yaw" else truth[k])
        for k in ("x", "y", "z", "roll", "pitch", "yaw")
    ]
    turn = Rotation.from_euler("xyz", np.column_stack(columns[3:]))
    antenna = np.column_stack(columns[:3]) + turn.apply(twin.gps.position)
    # A small patch of the Earth: metres per degree at the datum, good to a millimetre over 100 m.
    a, e2 = 6378137.0, 6.69437999014e-3
    latitude = math.radians(twin.datum.latitude)
    w = math.sqrt(1 - e2 * math.sin(latitude) ** 2)
    north = math.radians(1) * a * (1 - e2) / w**3
    east = math.radians(1) * a * math.cos(latitude) / w
    error = np.column_stack(
        [
            (drive.fix.longitude - twin.datum.longitude) * east,
            (drive.fix.latitude - twin.datum.latitude) * north,
        ]
    )
    error -= antenna[:, :2]
    assert 0.004 < np.sqrt(np.mean(error**2)) < 0.009
    assert np.abs(error).max() < 0.05


@pytest.mark.long
def test_the_true_twin_moves_like_the_reality(name, truth):
    """Two independent implementations of one car agree to a few percent over the road of the file.

    The twin is pulled along by the planar acceleration of its centre of gravity, which is 0.55 m
    above the base_link whose place the truth holds: pitching and rolling move the one against the other.
    """
    twin = load_twin(BAGS / name / "truth.yaml")
    yaw = np.unwrap(truth["yaw"])
    height = twin.vehicle.cog[2]
    x = truth["x"] + height * (truth["pitch"] * np.cos(yaw) + truth["roll"] * np.sin(yaw))
    y = truth["y"] + height * (truth["pitch"] * np.sin(yaw) - truth["roll"] * np.cos(yaw))
    vx, vy = (np.gradient(low_pass(c), 0.01) for c in (x, y))
    ax, ay = (np.gradient(low_pass(c), 0.01) for c in (vx, vy))
    cos, sin = np.cos(yaw), np.sin(yaw)
    path = Trajectory(
        t=truth["t"],
        x=truth["x"],
        y=truth["y"],
        yaw=yaw,
        velocity=np.column_stack([truth["speed"], vy * cos - vx * sin]),
        yaw_rate=np.gradient(low_pass(yaw), 0.01),
        acceleration=np.column_stack([ax * cos + ay * sin, ay * cos - ax * sin]),
        valid=np.ones(yaw.size, dtype=bool),
    )
    response = simulate_twin(twin, excitation(path, twin.vehicle, load_road(twin.road.file)))
    inside = slice(200, -100)
    felt = low_pass(truth["vertical_acceleration"])[inside]
    simulated = low_pass(response.vertical_acceleration)[inside]
    # What is left is what the page lists: friction, tyre damping, contact patch, smoothed or unknown road.
    limit = {"bump_15kmh": 0.08, "crg_road": 0.20}[name]
    assert np.std(felt - simulated) < limit * np.std(felt)
    pitch = (truth["pitch"] - response.pitch)[inside]
    # Dry friction of 2 (20 x 1.35 + 25 x 1.5) N m holds against 183 kN m/rad: up to 0.7 mrad either way.
    assert np.std(pitch) < 7e-4


# -- what the pages say ----------------------------------------------------------------------------


def test_drives_are_small_and_labelled(name):
    folder = BAGS / name
    assert sum(f.stat().st_size for f in folder.iterdir()) < 2_000_000
    page = (folder / "README.md").read_text(encoding="utf-8")
    assert "simulated" in page
    assert "simulated" in (BAGS / "README.md").read_text(encoding="utf-8").lower()


def test_places_are_the_paper_s(name, drive):
    latitude, longitude = PLACES[name]
    twin = load_twin(BAGS / name / "twin.yaml")
    assert (twin.datum.latitude, twin.datum.longitude) == pytest.approx((latitude, longitude), abs=1e-8)
    north = (drive.fix.latitude - latitude) * 111_200
    east = (drive.fix.longitude - longitude) * 111_200 * math.cos(math.radians(latitude))
    assert np.hypot(north, east).min() < 10
    assert np.hypot(north, east).max() < 100


def test_vehicle_is_table_1(name):
    for file in ("twin.yaml", "truth.yaml"):
        vehicle = load_twin(BAGS / name / file).vehicle
        assert vehicle.mass == 1575 + 80 + 70
        assert (vehicle.wheelbase, vehicle.front_track, vehicle.rear_track) == (2.85, 1.588, 1.605)


def test_truth_lies_within_table_2_and_away_from_the_preset(maker):
    for axle in (maker.MONDEO.front, maker.MONDEO.rear):
        for knots, bounds in ((axle.spring, SPRING), (axle.push, PUSH), (axle.pull, PULL)):
            assert [x for x, _ in knots] == list(bounds)
            for x, force in knots:
                assert bounds[x][0] <= force <= bounds[x][1]
    twin = load_twin(BAGS / "bump_15kmh" / "twin.yaml").vehicle.front.damper_push
    np.testing.assert_allclose(twin.velocity, list(PUSH))
    assert max(abs(f / t - 1) for f, (_, t) in zip(twin.force, maker.MONDEO.front.push, strict=True)) > 0.3


def test_bump_is_crossed_three_times_at_15_kmh():
    with np.load(BAGS / "bump_15kmh" / "truth.npz") as truth:
        road = load_road(BAGS / "bump_15kmh" / "road.crg")
        u, v = road.xy_to_uv(truth["x"].astype(float), truth["y"].astype(float))
        speed = truth["speed"] * 3.6
    over = np.flatnonzero(np.diff(np.sign(u - 40.0)) != 0)
    assert over.size == 3
    np.testing.assert_allclose(speed[over], 15.0, atol=0.7)
    assert np.all(np.abs(v) < 10)
    grid = road.heights_grid
    assert grid.max() == pytest.approx(0.05, abs=0.002)
    long = np.ptp(road.u[grid[:, 0] > 0.002])
    assert long == pytest.approx(0.9, abs=0.06)


def test_the_road_has_potholes_a_ramp_and_its_roughness():
    road = load_road(BAGS / "crg_road" / "road.crg")
    assert road.length == pytest.approx(90.0)
    grid = road.heights_grid
    assert np.isfinite(grid).all()
    rise = grid[-200:].mean() - grid[round(55 / road.u_step) : round(64 / road.u_step)].mean()
    assert rise == pytest.approx(0.32, abs=0.03)
    middle = grid[round(41.0 / road.u_step), np.argmin(np.abs(road.v - 0.6))]
    beside = grid[round(39.9 / road.u_step), np.argmin(np.abs(road.v - 0.6))]
    assert 0.025 < beside - middle < 0.06
    # Before the potholes and the ramp the profile lies between ISO 8608's classes B and C.
    flat = grid[: round(20 / road.u_step)]
    n, density = welch(flat, 1 / road.u_step, nperseg=200, axis=0)
    band = (n > 0.2) & (n < 2.0)
    level = np.exp(np.mean(np.log(density[band].mean(1) * (n[band] / 0.1) ** 2)))
    assert 32e-6 < level < 512e-6
