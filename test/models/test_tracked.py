# SPDX-License-Identifier: Apache-2.0
"""The model ``tracked`` against hand calculation, energy, and a model without a track."""

from __future__ import annotations

import itertools
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from suspension_twin.errors import InputError, WorkError
from suspension_twin.models.tracked import belt_length, simulate_tracked, simulate_tracked_lanes
from suspension_twin.vehicle.tracked import Driver, TrackedVehicle, load_tracked

G = 9.80665
SLACK = {
    "track.stiffness": 1e5,
    "track.bending_stiffness": 10.0,
    "track.bending_damping": 1.0,
    "idler.setting": -5550.0,
    "idler.taut_at": -5600.0,
}


@pytest.fixture(scope="module")
def vehicle(repository: Path) -> TrackedVehicle:
    return load_tracked(repository / "config" / "tracked" / "pt91.yaml")


def test_the_belt_is_as_long_as_a_string_around_its_wheels(vehicle: TrackedVehicle) -> None:
    """A string around many points of the circles, as the convex hull of the lower side measures it."""
    from scipy.spatial import ConvexHull

    half, angle = vehicle.track.thickness, np.linspace(0, 2 * np.pi, 20001)
    circles = [(5.56, vehicle.idler.height, vehicle.idler.radius), (0.0, 0.0, vehicle.sprocket.radius)]
    circles += [(s.x, vehicle.wheel_height, vehicle.wheel.radius) for s in vehicle.stations]
    points = np.concatenate(
        [np.stack([x + (r + half) * np.cos(angle), z + (r + half) * np.sin(angle)], 1) for x, z, r in circles]
    )
    hull = ConvexHull(points).area  # of a plane figure: its perimeter
    # the run above is counted from centre to centre and from straight above each
    (xi, zi, ri), (xs, zs, rs) = circles[0], circles[1]
    distance, tilt = math.hypot(xi - xs, zi - zs), math.atan2(zi - zs, xi - xs)
    lean = math.asin((ri - rs) / distance)
    above = distance * math.cos(lean) - distance + (tilt + lean) * ((ri + half) - (rs + half))
    assert belt_length(vehicle, -5560.0) + above == pytest.approx(hull, abs=2e-4)


def test_it_stands_as_hand_calculation_says(vehicle: TrackedVehicle) -> None:
    slack = vehicle.with_changes({**SLACK, "cog.0": (vehicle.stations[0].x + vehicle.stations[-1].x) / 2})
    r = simulate_tracked(slack, 0.0, 0.5, level=True)
    assert r.tension[0] == 0.0
    assert r.ground[-1] == pytest.approx(slack.mass * G, rel=2e-4)
    # what hangs on one arm: a sixth of what is neither wheel nor lying track
    lying = r.ground[-1] / 2 - r.wheel_load[-1].sum()
    load = (slack.mass / 2 * G - lying) / 6 - slack.wheel.mass * G
    arm = slack.arm
    angle = brentq(
        lambda a: arm.stiffness * (arm.free_angle - a) - load * arm.length * math.cos(a), -0.3, 0.3
    )
    # the arms lean by the pitch that their pivots, on one side of the wheels, bring about
    assert r.arm[-1].mean() == pytest.approx(angle, abs=1e-4)
    moment = float(np.sum(r.wheel_load[-1] * ([s.x - slack.cog[0] for s in slack.stations])))
    assert abs(moment) < 0.01 * slack.mass * G


def test_a_heavier_tail_stands_nose_up(vehicle: TrackedVehicle) -> None:
    tail = simulate_tracked(vehicle.with_changes({"cog.0": 2.4}), 0.0, 0.1, level=True)
    assert tail.pitch[-1] < -0.005 and tail.wheel_load[-1, -1] > 1.2 * tail.wheel_load[-1, 0]


def test_no_energy_comes_from_nowhere(vehicle: TrackedVehicle) -> None:
    for kick in ((0.6, 0.0), (0.0, 0.3)):
        r = simulate_tracked(vehicle, 0.0, 3.0, level=True, kick=kick, step=5e-5)
        given = r.energy[0] - r.energy[-1]
        total = r.energy + r.lost
        assert given > 1000.0
        assert np.abs(total - total[0]).max() < 0.02 * given


def _frequency(t: Any, signal: Any) -> float:
    """From the zero crossings of a free oscillation, Hz."""
    s = signal - signal[len(signal) // 2 :].mean()
    k = np.flatnonzero((s[:-1] < 0) & (s[1:] >= 0))
    cross = t[k] - s[k] * (t[1] - t[0]) / (s[k + 1] - s[k])
    return float(1.0 / np.mean(np.diff(cross)))


def test_it_swings_as_the_linear_model_says(vehicle: TrackedVehicle) -> None:
    """Heave and pitch of the hull on six springs: bars, with rubber and ground in series."""
    bare = vehicle.with_dampers(0.0).with_changes({**SLACK, "cog.0": 2.7815, "wheel.mass": 60.0})
    arm = bare.arm
    r = simulate_tracked(bare, 0.0, 3.0, level=True, kick=(0.05, 0.0), rate=500.0)
    load, angle = r.wheel_load.mean() - bare.wheel.mass * G, float(r.arm.mean())
    at_wheel = arm.stiffness / (arm.length * math.cos(angle)) ** 2 - load * math.tan(angle) / (
        arm.length * math.cos(angle)
    )
    # Hertz-like Winkler foundation: F = 4/3 k d sqrt(2 R d), so dF/dd = 1.5 F / d
    force = r.wheel_load.mean()
    depth = (0.75 * force / bare.wheel.rubber / math.sqrt(2 * bare.wheel.radius)) ** (2 / 3)
    below = 1.5 * force / depth
    # the wheel stands on the ground through two or three nodes
    ground = bare.ground.stiffness * bare.track.pitch * 1.5
    stiffness = 1 / (1 / at_wheel + 1 / below + 1 / ground)
    hull = bare.mass / 2 - 6 * bare.wheel.mass - (r.ground[-1] / 2 - r.wheel_load[-1].sum()) / G
    heave = math.sqrt(6 * stiffness / hull) / (2 * math.pi)
    assert _frequency(r.t, r.z) == pytest.approx(heave, rel=0.03)
    p = simulate_tracked(bare, 0.0, 3.0, level=True, kick=(0.0, 0.03), rate=500.0)
    square = sum((s.x - bare.cog[0]) ** 2 for s in bare.stations)
    pitch = math.sqrt(stiffness * square / (hull * bare.gyration**2)) / (2 * math.pi)
    assert _frequency(p.t, p.pitch) == pytest.approx(pitch, rel=0.04)


def trackless(v: TrackedVehicle, hull: float, speed: float, t: Any) -> Any:
    """Heights of A and B of a vehicle without a track: dense equations, BDF. The wheels meet the ground."""
    n, arm, mass = len(v.stations), v.arm, v.wheel.mass
    a0 = arm.standing_angle
    xi = np.array([s.x for s in v.stations]) + arm.length * math.cos(a0) - v.cog[0]
    zeta = v.wheel_height + arm.length * math.sin(a0) - v.cog[1]
    c = np.array([s.damping for s in v.stations])
    s_arc = np.linspace(-0.24, 0.24, 61)
    arc = np.sqrt(v.wheel.radius**2 - s_arc**2) + v.track.thickness
    o = v.obstacle
    corners = np.cumsum([0.0, o.ramp, o.top, o.ramp])
    start = -0.5 - v.idler.radius - (-v.idler.setting / 1000 - v.cog[0])

    def motion(time: float, y: Any, quiet: bool) -> Any:
        q, qd = y[: n + 2], y[n + 2 :]
        x = start + (0.0 if quiet else speed * time)
        theta, alpha = q[1], q[2:]
        dx = xi * math.cos(theta) + zeta * math.sin(theta)
        dz = zeta * math.cos(theta) - xi * math.sin(theta)
        jac = np.zeros((n, 2, n + 2))
        jac[:, 1, 0] = 1.0
        jac[:, 0, 1], jac[:, 1, 1] = dz, -dx
        i = np.arange(n)
        jac[i, 0, i + 2] = arm.length * np.sin(alpha)
        jac[i, 1, i + 2] = -arm.length * np.cos(alpha)
        bias = np.stack([-dx, -dz], 1) * qd[1] ** 2
        bias += arm.length * np.stack([np.cos(alpha), np.sin(alpha)], 1) * qd[2:, None] ** 2
        wx, wz = x + dx - arm.length * np.cos(alpha), q[0] + dz - arm.length * np.sin(alpha)
        ground = np.interp(wx[:, None] + s_arc, corners, [0.0, o.height, o.height, 0.0])
        over = np.maximum(ground - wz[:, None] + arc, 0.0)
        series = 1 / (1 / v.wheel.rubber + 1 / v.ground.stiffness)
        load = series * over.sum(1) * (s_arc[1] - s_arc[0]) - (over.max(1) > 0) * 2e3 * (jac[:, 1] @ qd)
        force = np.stack([np.zeros(n), load - mass * G], 1)
        m = np.diag([hull, hull * v.gyration**2, *np.zeros(n)])
        m += mass * np.einsum("wki,wkj->ij", jac, jac)
        rhs = np.einsum("wki,wk->i", jac, force - mass * bias)
        rhs[0] -= hull * G
        damping = np.full(n, 3e4) if quiet else c
        tau = -arm.stiffness * (alpha + theta - arm.free_angle) - damping * (qd[2:] + qd[1])
        rhs[2:] += tau
        rhs[1] += tau.sum()
        return np.concatenate([qd, np.linalg.solve(m, rhs)])

    y = np.concatenate([[v.cog[1] - v.ground_height, 0.0], np.full(n, a0), np.zeros(n + 2)])
    y = solve_ivp(motion, (0.0, 3.0), y, "BDF", args=(True,), rtol=1e-4, atol=1e-6).y[:, -1]
    run = solve_ivp(motion, (0.0, t[-1]), y, "BDF", t_eval=t, args=(False,), rtol=1e-4, atol=1e-6).y
    x = np.array([-v.markers.A[0], -v.markers.B[0]]) / 1000 - v.cog[0]
    up = np.array([v.markers.A[1], v.markers.B[1]]) / 1000 - v.cog[1]
    height = run[0][:, None] - x * np.sin(run[1])[:, None] + up * np.cos(run[1])[:, None]
    return height - height[0]


def test_a_slack_track_leaves_the_vehicle_without_one(vehicle: TrackedVehicle) -> None:
    slack = vehicle.with_changes(
        {**SLACK, "obstacle.height": 0.1, "obstacle.ramp": 1.5, "obstacle.top": 1.0, "ground.stiffness": 3e8}
    )
    ours = simulate_tracked(slack, 8 / 3.6, 3.6, rate=50.0, fineness=4, step=1e-4)
    hull = slack.mass / 2 - 6 * slack.wheel.mass - (ours.ground[0] / 2 - ours.wheel_load[0].sum()) / G
    theirs = trackless(slack, hull, 8 / 3.6, ours.t)
    assert np.abs(theirs).max() > 0.05
    assert np.abs(ours.markers[:, :2] - theirs).max() < 0.004
    # and the track matters where it is tight
    tight = simulate_tracked(
        slack.with_changes({"track.stiffness": 1e9, "idler.taut_at": -5550.0, "idler.setting": -5570.0}),
        8 / 3.6,
        3.6,
        rate=50.0,
    )
    assert np.abs(tight.markers[:, :2] - theirs).max() > 0.008


def test_markers_converge_with_contact_points_and_steps(vehicle: TrackedVehicle) -> None:
    runs = [
        simulate_tracked(vehicle, 13 / 3.6, 4.0, contacts=c, step=s).markers
        for c, s in ((1, 4e-4), (4, 4e-4), (8, 1e-4))
    ]
    one, usual = (np.abs(r - runs[2]).max() for r in runs[:2])
    assert usual < one < 0.006 * np.ptp(runs[2]) and usual < 0.004 * np.ptp(runs[2])


def test_links_and_a_beam_of_the_same_stiffness_differ_by_little(vehicle: TrackedVehicle) -> None:
    links, beam = (simulate_tracked(vehicle, 13 / 3.6, 4.0, fineness=f, step=2e-4).markers for f in (1, 3))
    assert 0 < np.abs(links - beam).max() < 0.03 * np.ptp(links)


def test_velocity_and_acceleration_belong_to_the_motion(vehicle: TrackedVehicle) -> None:
    r = simulate_tracked(vehicle, 8 / 3.6, 5.0, rate=500.0)
    slope = np.gradient(r.markers, r.t, axis=0)
    assert np.abs(slope - r.marker_velocity)[1:-1].max() < 0.02 * np.abs(slope).max()
    gained = np.cumsum(r.marker_acceleration, axis=0) * (r.t[1] - r.t[0])
    assert np.abs(gained - r.marker_velocity).max() < 0.05 * np.abs(slope).max()


def test_lanes_do_not_know_of_each_other(vehicle: TrackedVehicle) -> None:
    vehicles = [vehicle.with_dampers(c) for c in (0.0, 45090.0)]
    together = simulate_tracked_lanes(vehicles, [2.0, 3.0], 2.0)
    for v, speed, r in zip(vehicles, (2.0, 3.0), together, strict=True):
        alone = simulate_tracked(v, speed, 2.0)
        for f in fields(r):
            assert np.array_equal(getattr(r, f.name), getattr(alone, f.name))


def test_corners_of_the_bounds_run_to_the_end(vehicle: TrackedVehicle) -> None:
    from suspension_twin.vehicle.tracked import BOUNDS

    corners = [dict(zip(BOUNDS, c, strict=True)) for c in itertools.product(*BOUNDS.values())]
    runs = simulate_tracked_lanes([vehicle.with_changes(c) for c in corners], [13 / 3.6] * 32, 4.0)
    assert not any(r.failed for r in runs)
    assert all(np.isfinite(r.markers).all() and np.ptp(r.markers) < 1.0 for r in runs)


def test_a_driven_vehicle_loses_speed_uphill_by_what_its_drive_gives_way(vehicle: TrackedVehicle) -> None:
    """Twice the slope asks for a pull of one track that is more by half the weight down the lesser one."""
    droop, speeds = 1e-5, []
    for height in (0.0, 0.2, 0.4):
        hill = vehicle.with_changes({"obstacle.height": height, "obstacle.ramp": 20.0, "obstacle.top": 1.0})
        driven = hill.model_copy(update={"driver": Driver(gain=0.0, reset=0.0, droop=droop)})
        r = simulate_tracked(driven, 3.0, 6.5, rate=50.0)
        climbing = (r.t > 4.0) & (r.t < 6.4)  # all wheels are on the slope, and it has come to rest on it
        speeds.append(float(np.polyfit(r.t[climbing], r.travel[climbing], 1)[0]))
    level, low, high = speeds
    lying = 0.5 * vehicle.track.links * vehicle.track.link_mass
    assert low - high == pytest.approx(droop * (vehicle.mass / 2 - lying) * G * 0.2 / 20.0, rel=0.08)
    assert 2.8 < level < 2.9  # what rubber and track take on the level, 7 % of the weight


def test_a_driver_who_holds_the_speed_is_nearer_to_his_way(vehicle: TrackedVehicle) -> None:
    away = []
    for gain in (0.0, 1.5, 6.0):
        driver = Driver(gain=gain, reset=8 / 3 * gain)
        r = simulate_tracked(vehicle.model_copy(update={"driver": driver}), 13 / 3.6, 5.0)
        away.append(np.abs(r.travel - r.travel[0] - 13 / 3.6 * r.t).max())
    assert away[0] > 2 * away[1] > 2 * away[2] > 0.02


def test_pitch_is_felt_along_the_way(vehicle: TrackedVehicle) -> None:
    """What a prescribed way leaves out: the hull that pitches above its track has to take its mass along."""
    driven = vehicle.model_copy(update={"driver": Driver()})
    free, held = (simulate_tracked(v, 13 / 3.6, 5.0).markers for v in (driven, vehicle))
    assert np.abs(free - held).max() > 0.03


def test_where_the_links_lie_is_the_same_a_link_on(vehicle: TrackedVehicle) -> None:
    phases = (0.0, vehicle.track.pitch, 0.5 * vehicle.track.pitch)
    here, on, between = (simulate_tracked_lanes([vehicle], [13 / 3.6], 4.0, phase=p)[0] for p in phases)
    assert np.abs(on.markers - here.markers).max() < 1e-4 and on.travel == pytest.approx(here.travel)
    assert 1e-4 < np.abs(between.markers - here.markers).max() < 0.02


def test_a_diverging_run_is_an_error(vehicle: TrackedVehicle) -> None:
    with pytest.raises(WorkError, match="diverged"):
        simulate_tracked(vehicle.with_changes({"track.stiffness": 1e9}), 3.0, 3.0, step=1e-2)


def test_bad_runs_are_refused(vehicle: TrackedVehicle) -> None:
    with pytest.raises(InputError, match="km/h"):
        simulate_tracked(vehicle, 55.0, 1.0)
    with pytest.raises(InputError, match="duration"):
        simulate_tracked(vehicle, 5.0, 0.0)
