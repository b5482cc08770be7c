# SPDX-License-Identifier: Apache-2.0
"""Each effect is the physics that it is named after, shown by what that physics must do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from effect_cases import Ground, given, respond, rough, way
from scipy.signal import butter, freqs

from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import pack
from suspension_twin.models.sensor import to_sensor_axes
from suspension_twin.models.sensor_chain import TABLE, _even, _restamp
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.models.types import Response
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.twin import Twin


def flat(x: Any, y: Any) -> Any:
    return 0.0 * x


def wave(height: float, length: float) -> Any:
    """Long waves after a level start, both sides alike."""
    return lambda x, y: height * np.sin(2 * np.pi * np.maximum(x - 4.0, 0) / length) + 0 * y


def curve(x: np.ndarray, points: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """A characteristic for arguments above 0: linear between its points, on with its last slope."""
    at, force = (np.concatenate([[0.0], p]) for p in points)
    last = (force[-1] - force[-2]) / (at[-1] - at[-2])
    return np.interp(x, at, force) + last * np.maximum(x - at[-1], 0)


def beyond_spring_and_damper(twin: Twin, r: Response, corner: int) -> np.ndarray:
    """Force of one strut (n,) that its characteristics do not explain, from the wheel's own motion."""
    axle = twin.vehicle.front if corner < 2 else twin.vehicle.rear
    total = r.tyre_force[:, corner] - axle.unsprung_mass * (r.acceleration[:, 3 + corner] + G)
    push, pull = (
        curve(np.maximum(v, 0), c.points)
        for v, c in (
            (r.deflection_rate[:, corner], axle.damper_push),
            (-r.deflection_rate[:, corner], axle.damper_pull),
        )
    )
    return total - curve(r.deflection[:, corner], axle.spring.points) - (push - pull)


def test_strut_friction_has_a_loop_at_any_speed(twin: Twin) -> None:
    """What spring and damper leave of the strut's force has the size of the friction, against the motion, and
    its loop over the travel has the same height at two speeds."""
    rubbing = given(twin, strut_friction={"front_force": 150.0, "rear_force": 0.0})
    heights = []
    for length in (5.0, 8.0):
        r = respond(rubbing, wave(0.04, length), way(10.0, rate=500.0))
        last = slice(-round(length / 8.0 * 500) - 1, None)
        rest, rate, travel = (
            beyond_spring_and_damper(twin, r, 0)[last],
            r.deflection_rate[last, 0],
            r.deflection[last, 0],
        )
        slipping = np.abs(rate) > 0.03
        assert slipping.mean() > 0.3
        assert np.quantile(np.abs(rest[slipping] - 150.0 * np.sign(rate[slipping])), 0.7) < 5.0
        heights.append(abs(np.sum(rest[1:] * np.diff(travel))) / np.ptp(travel))
        assert np.abs(beyond_spring_and_damper(twin, r, 2)[last]).max() < 5.0
    assert heights == pytest.approx([300.0, 300.0], rel=0.1)


def test_strut_friction_sticks(twin: Twin) -> None:
    """Behind a bump a sound strut comes back to where it stood, a rubbing one stops short of it and stays."""
    bump = lambda x, y: 0.03 * np.exp(-(((x - 12.0) / 0.5) ** 2)) + 0 * y  # noqa: E731
    plain, stuck = (
        respond(each, bump, way(12.0))
        for each in (twin, given(twin, strut_friction={"front_force": 300.0, "rear_force": 300.0}))
    )
    assert np.abs(plain.deflection[-1] - plain.deflection[0]).max() < 1e-4
    assert np.abs(stuck.deflection[-1] - stuck.deflection[0]).max() > 1e-3
    assert np.abs(stuck.deflection_rate[-1]).max() < 1e-4


@pytest.mark.parametrize(("name", "sign"), [("bump_stop", 1), ("rebound_stop", -1)])
def test_a_stop_acts_only_past_its_clearance(twin: Twin, name: str, sign: int) -> None:
    road = wave(0.06, 12.0)
    plain = respond(twin, road)
    reach = float((sign * (plain.deflection - plain.deflection[0])).max())
    parameters = {"front_clearance": 1.02 * reach, "rear_clearance": 1.02 * reach, "stiffness": 1e5}
    assert np.array_equal(respond(given(twin, **{name: parameters}), road).force, plain.force)
    parameters |= {"front_clearance": 0.5 * reach, "rear_clearance": 0.5 * reach}
    stopped = respond(given(twin, **{name: parameters}), road)
    first = int(np.argmax((sign * (plain.deflection - plain.deflection[0])).max(axis=1) > 0.5 * reach))
    assert np.array_equal(stopped.force[:first], plain.force[:first])
    assert (sign * (stopped.deflection - stopped.deflection[0])).max() < 0.95 * reach


def test_a_progressive_spring_is_its_rate_integrated(twin: Twin) -> None:
    """What spring and damper leave of the strut's force is rise x²/2 + square x³/3 of the travel from standing."""
    rise, square = 1.5e5, 6e6
    rising = given(twin, progressive_spring={"front_rise": rise, "front_square": square})
    r = respond(rising, wave(0.06, 8.0))
    for corner, wanted in ((0, 1.0), (2, 0.0)):
        x = r.deflection[:, corner] - r.deflection[0, corner]
        assert np.ptp(x) > 0.02
        expected = wanted * (rise * x**2 / 2 + square * x**3 / 3)
        assert np.abs(beyond_spring_and_damper(twin, r, corner) - expected).max() < 5.0


def test_a_progressive_spring_stands_where_it_balances(twin: Twin) -> None:
    """In a steady turn the outer wheel's jounce is that at which spring and progression carry the load together."""
    rising = given(twin, progressive_spring={"front_square": 2e7, "rear_square": 2e7})
    turn = way(6.0, speed=10.0, yaw_rate=0.5)
    plain, stiff = (respond(each, flat, turn) for each in (twin, rising))
    # it stood in equilibrium from the first stamp on
    assert np.abs(stiff.deflection[-1] - stiff.deflection[0]).max() < 1e-4
    assert 0.1 < stiff.roll[-1] / plain.roll[-1] < 0.95


@pytest.mark.parametrize("play", [0.002, 0.008])
def test_play_takes_the_dampers_hold_after_a_reversal_alone(twin: Twin, play: float) -> None:
    """Spring apart, the strut carries nothing until the play is taken up, and then what its damper does."""
    loose = given(twin, damper_play={"front": play})
    r = respond(loose, wave(0.06, 8.0), way(10.0, rate=1000.0))
    corner = 0
    travel, rate = r.deflection[:, corner], r.deflection_rate[:, corner]
    missing = beyond_spring_and_damper(twin, r, corner)
    axle = twin.vehicle.front
    damper = curve(np.maximum(rate, 0), axle.damper_push.points) - curve(
        np.maximum(-rate, 0), axle.damper_pull.points
    )
    turns = 1 + np.flatnonzero(rate[1:] * rate[:-1] < 0)
    turns = turns[turns > 2000]
    assert turns.size > 3
    seen = 0
    for begin, end in zip(turns[:-1], turns[1:], strict=True):
        gone = np.abs(travel[begin:end] - travel[begin])
        if gone.max() < 1.5 * play:
            continue
        seen += 1
        within, past = gone < 0.8 * play, gone > 1.2 * play
        least = 20.0 + 0.05 * np.abs(damper[begin:end])
        assert np.all(np.abs(missing[begin:end] + damper[begin:end])[within] < least[within])
        assert np.all(np.abs(missing[begin:end])[past] < least[past])
    assert seen > 3


def test_top_mount_gives_way_to_quick_motion_only(twin: Twin) -> None:
    """At wheel hop the soft mount takes the damper out; over long waves it does nothing."""
    soft = given(twin, top_mount={"front_stiffness": 3e4, "rear_stiffness": 3e4})
    for road, most, least in ((wave(0.03, 16.0), 0.15, 0.0), (wave(0.002, 0.7), 1e9, 0.15)):
        plain, mounted = respond(twin, road), respond(soft, road)
        change = np.std((mounted.force - plain.force)[150:, 2]) / np.std(plain.force[150:, 2])
        assert least <= change <= most


def test_anti_roll_bar_acts_in_roll_alone(twin: Twin) -> None:
    barred = given(twin, anti_roll_bar={"front_stiffness": 2e4, "rear_stiffness": 2e4})
    both_sides = wave(0.04, 9.0)
    straight = [respond(each, both_sides) for each in (twin, barred)]
    assert np.allclose(straight[0].force, straight[1].force, atol=1e-9)
    turning = [respond(each, flat, way(6.0, speed=10.0, yaw_rate=0.3)) for each in (twin, barred)]
    assert 0.2 < turning[1].roll[-1] / turning[0].roll[-1] < 0.85


def test_damper_fade_grows_with_time(twin: Twin) -> None:
    faded = given(twin, damper_fade={"loss": 0.8, "time_constant": 4.0})
    plain, hot = (respond(each, rough, way(24.0)) for each in (twin, faded))
    change = np.abs(hot.vertical_acceleration - plain.vertical_acceleration)
    early, late = np.sqrt(np.mean(change[:100] ** 2)), np.sqrt(np.mean(change[-800:] ** 2))
    assert late > 3 * early
    # all faded: as if the curves were lower by the loss that is reached
    left = 1 - 0.8 * (1e6 / (1 + 1e6))
    changes = {}
    for axle in ("front", "rear"):
        for part in ("damper_push", "damper_pull"):
            force = getattr(getattr(twin.vehicle, axle), part).force
            changes[f"vehicle.{axle}.{part}.force"] = tuple(left * f for f in force)
    lower = respond(twin.with_changes(changes), rough, way(8.0))
    quick = respond(
        given(twin, damper_fade={"loss": 0.8, "time_constant": 2.0}), rough, way(200.0, rate=50.0)
    )
    ratio = np.std(quick.vertical_acceleration[-1000:]) / np.std(lower.vertical_acceleration[100:])
    assert ratio == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("corner", range(4))
@pytest.mark.parametrize("part", ["corner_damper", "corner_spring"])
def test_an_odd_corner_turns_heave_into_roll(twin: Twin, part: str, corner: int) -> None:
    """On a road alike on both sides a sound car does not roll; the odd one does, to the side of its corner."""
    level = twin.with_changes({"vehicle.cog.1": 0.0})
    road = wave(0.03, 8.0)
    assert np.abs(respond(level, road).rate[:, 0]).max() < 1e-12
    r = respond(given(level, **{part: {"corner": float(corner), "change": -0.5}}), road)
    assert np.abs(r.rate[:, 0]).max() > 1e-4
    side = -1 if corner % 2 else 1
    other = corner + side
    mirrored = respond(given(level, **{part: {"corner": float(other), "change": -0.5}}), road)
    assert np.allclose(mirrored.rate[:, 0], -r.rate[:, 0], atol=1e-9)
    assert np.allclose(mirrored.force[:, 2] - r.force[:, 2], 0, atol=2.0)


def test_tyre_damping_is_a_force_by_closing_speed(twin: Twin) -> None:
    """The tyre's force less its spring is the damping times how fast road and wheel close."""
    viscous = given(twin, tyre_damping={"damping": 800.0})
    trajectory, length, height = way(4.0, rate=1000.0), 3.0, 0.01
    r = respond(viscous, wave(height, length), trajectory)
    x = trajectory.x + twin.vehicle.wheelbase
    ground = wave(height, length)(x, 0 * x)
    closing = np.gradient(ground - r.wheel_z[:, 0], trajectory.t)
    spring = twin.vehicle.tyre.vertical_stiffness * (ground - r.wheel_z[:, 0])
    rest = r.tyre_force[:, 0] - spring
    rest, closing = rest[1500:-10] - rest[10], closing[1500:-10]
    assert np.polyfit(closing, rest, 1)[0] == pytest.approx(800.0, rel=0.05)


def test_payload_is_mass_at_a_place(twin: Twin) -> None:
    """Heavier by hand in the file is the same vehicle."""
    loaded = given(twin, payload={"mass": 200.0, "x": twin.vehicle.cog[0], "y": 0.0})
    mass, cog = twin.vehicle.mass, twin.vehicle.cog
    reduced = 200.0 * mass / (mass + 200.0)
    by_hand = twin.with_changes(
        {
            "vehicle.mass": mass + 200.0,
            "vehicle.cog.1": cog[1] * mass / (mass + 200.0),
            "vehicle.cog.2": (cog[2] * mass + 0.75 * 200.0) / (mass + 200.0),
            "vehicle.sprung_inertia.roll": twin.vehicle.sprung_inertia.roll
            + reduced * (0.75 - cog[2]) ** 2
            + reduced * cog[1] ** 2,
            "vehicle.sprung_inertia.pitch": twin.vehicle.sprung_inertia.pitch
            + reduced * (0.75 - cog[2]) ** 2,
        }
    )
    a, b = respond(loaded), respond(by_hand)
    # the load makes the car lean, which the other file takes for level: a constant in what the sensor reads
    assert (np.std(a.force - b.force, axis=0) < 0.01 * np.std(b.force, axis=0)).all()
    assert np.std(a.rate[:, 1] - b.rate[:, 1]) < 0.01 * np.std(b.rate[:, 1])
    sideways = respond(given(twin, payload={"mass": 300.0, "x": 1.0, "y": 0.5}), flat)
    assert sideways.tyre_force[0, 0] > sideways.tyre_force[0, 1]
    assert sideways.tyre_force[0].sum() == pytest.approx((mass + 300.0) * G, rel=1e-6)


def spectrum(x: np.ndarray) -> np.ndarray:
    return np.abs(np.fft.rfft((x - x.mean()) * np.hanning(x.size)))


def test_body_bending_rings_at_its_frequency(twin: Twin) -> None:
    bent = given(twin, body_bending={"gain": 1.0, "frequency": 23.0, "damping_ratio": 0.01})
    trajectory = way(6.0, rate=200.0)
    bump = lambda x, y: 0.03 * np.exp(-(((x - 14.0) / 0.2) ** 2)) + 0 * y  # noqa: E731
    plain, ringing = (respond(each, bump, trajectory).force[:, 2] for each in (twin, bent))
    frequency = np.fft.rfftfreq(plain.size, 1 / 200)
    assert frequency[np.argmax(spectrum(ringing - plain))] == pytest.approx(23.0, abs=0.5)
    assert np.array_equal(respond(bent, bump, trajectory).heave, respond(twin, bump, trajectory).heave)


def test_powertrain_mount_keeps_the_mass_and_absorbs(twin: Twin) -> None:
    """Standing and slow it is the rigid car; at its own frequency the body hardly moves."""
    mounted = given(twin, powertrain_mount={"mass": 180.0, "frequency": 9.0, "x": 0.0})
    slow = [respond(each, wave(0.05, 40.0), way(8.0)) for each in (twin, mounted)]
    assert np.std(slow[1].heave - slow[0].heave) < 0.03 * np.std(slow[0].heave)
    assert slow[1].tyre_force[0] == pytest.approx(slow[0].tyre_force[0])
    tuned = [respond(each, wave(0.003, 8.0 / 9.0), way(8.0)) for each in (twin, mounted)]
    # well above its own frequencies the body is a free mass; at resonance the engine adds m (1 + 1 / 2j zeta)
    sprung = twin.vehicle.mass - 2 * (twin.vehicle.front.unsprung_mass + twin.vehicle.rear.unsprung_mass)
    expected = sprung / abs(sprung - 180.0 + 180.0 * (1 + 1 / (2j * 0.08)))
    ratio = np.std(tuned[1].acceleration[400:, 0]) / np.std(tuned[0].acceleration[400:, 0])
    assert ratio == pytest.approx(expected, rel=0.08)


def transfer(read: np.ndarray, true: np.ndarray, rate: float, frequency: float) -> complex:
    """Complex gain at a frequency that both hold steadily, over the second half."""
    half = slice(read.size // 2, None)
    t = np.arange(read.size)[half] / rate
    turn = np.exp(-2j * np.pi * frequency * t) * np.hanning(t.size)
    return complex((read[half] * turn).sum() / (true[half] * turn).sum())


@pytest.mark.parametrize("frequency", [4.0, 11.0, 16.0])
def test_mount_resonance_is_a_mass_shaken_at_its_foot(twin: Twin, frequency: float) -> None:
    rate, f0, zeta = 400.0, 12.0, 0.06
    held = given(twin, mount_resonance={"gain": 1.0, "frequency": f0, "damping_ratio": zeta})
    road = wave(0.001, 8.0 / frequency)
    trajectory = way(12.0, rate=rate)
    plain, read = respond(twin, road, trajectory).force[:, 2], respond(held, road, trajectory).force[:, 2]
    s = 1j * frequency / f0
    expected = (2 * zeta * s + 1) / (s**2 + 2 * zeta * s + 1)
    assert transfer(read - G, plain - G, rate, frequency) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("frequency", [2.0, 8.0, 20.0])
def test_sensor_bandwidth_is_a_butterworth(twin: Twin, frequency: float) -> None:
    rate = 400.0
    slow = given(twin, sensor_bandwidth={"cutoff": 8.0})
    road, trajectory = wave(0.001, 8.0 / frequency), way(12.0, rate=rate)
    plain, read = respond(twin, road, trajectory), respond(slow, road, trajectory)
    expected = freqs(*butter(2, 2 * np.pi * 8.0, analog=True), [2 * np.pi * frequency])[1][0]
    assert transfer(read.force[:, 2] - G, plain.force[:, 2] - G, rate, frequency) == pytest.approx(
        expected, rel=0.02
    )
    assert transfer(read.rate[:, 1], plain.rate[:, 1], rate, frequency) == pytest.approx(expected, rel=0.02)


def test_sensor_offset_is_another_arm(twin: Twin) -> None:
    x, y, z = twin.imu.position
    moved = twin.model_copy(
        update={"imu": twin.imu.model_copy(update={"position": (x + 0.4, y - 0.2, z + 0.1)})}
    )
    trajectory = way(4.0, yaw_rate=0.2)
    a = respond(given(twin, sensor_offset={"x": 0.4, "y": -0.2, "z": 0.1}), rough, trajectory)
    b = respond(moved, rough, trajectory)
    assert np.allclose(a.force, b.force, atol=1e-9) and np.array_equal(a.rate, b.rate)


def test_sensor_tilt_leaks_gravity(twin: Twin) -> None:
    r = respond(given(twin, sensor_tilt={"roll": 0.05, "pitch": -0.1, "yaw": 0.3}), flat, way(2.0, speed=0.0))
    # nose up: the forward axis looks up and reads a part of gravity; left side up: the left axis does
    assert r.force[-1, 0] == pytest.approx(G * np.sin(0.1), rel=1e-3)
    assert r.force[-1, 1] == pytest.approx(G * np.cos(0.1) * np.sin(0.05), rel=1e-3)
    assert np.linalg.norm(r.force[-1]) == pytest.approx(G, rel=1e-9)


def test_sensor_clipping_and_scale(twin: Twin) -> None:
    plain = respond(twin)
    clipped = respond(given(twin, sensor_clipping={"range": 10.5}))
    assert plain.force.max() > 10.6
    assert np.allclose(clipped.force, np.clip(plain.force, -10.5, 10.5), rtol=0, atol=1e-12)
    assert np.allclose(
        clipped.vertical_acceleration - plain.vertical_acceleration, (clipped.force - plain.force)[:, 2]
    )
    scaled = respond(given(twin, sensor_scale={"scale": 0.04}))
    assert np.allclose(scaled.force, 1.04 * plain.force) and np.array_equal(scaled.rate, plain.rate)


def test_a_sensor_clips_on_its_own_axes(twin: Twin) -> None:
    rpy = (1.31, 0.2, -1.57)
    turned = twin.model_copy(update={"imu": twin.imu.model_copy(update={"rpy": rpy})})
    plain, clipped = respond(turned), respond(given(turned, sensor_clipping={"range": 9.9}))
    own = to_sensor_axes(plain.force, rpy)
    assert np.abs(own).max() > 10.5
    assert np.allclose(to_sensor_axes(clipped.force, rpy), np.clip(own, -9.9, 9.9), rtol=0, atol=1e-12)
    assert np.allclose(
        clipped.vertical_acceleration - plain.vertical_acceleration, (clipped.force - plain.force)[:, 2]
    )


def test_with_a_fused_pose_the_road_alone_is_late(twin: Twin) -> None:
    """At a steady speed that is the same as a late sensor; while braking, the pose brakes when the sensor says so."""
    late = given(twin, time_offset={"offset": 0.05}, clock_drift={"drift_ppm": 2000.0})
    steady, braking = way(8.0, rate=200.0), way(2.0, rate=200.0, speed=12.0, ax=-4.0)
    ways = [
        excitation(w, twin.vehicle, Ground(r))
        for w, r in ((steady, rough), (braking, rough), (braking, flat))
    ]
    params = pack(late)[:, None]
    sensor, road = (
        simulate_lanes(late, params, ways[0], fused=fused).force[400:, 2, 0] for fused in (False, True)
    )
    scatter = np.std(sensor)
    assert np.std(sensor - road) < 0.03 * scatter
    assert np.std(road - respond(twin, rough, steady).force[400:, 2]) > 0.3 * scatter
    # on a flat road there is nothing to be late: to the last bit what a punctual sensor reads
    plain = simulate_lanes(twin, pack(twin)[:, None], ways[2])
    fused = simulate_lanes(late, params, ways[2], fused=True)
    assert np.allclose(fused.force, plain.force, rtol=0, atol=1e-9)
    assert not np.allclose(
        simulate_lanes(late, params, ways[1]).force,
        simulate_lanes(late, params, ways[1], fused=True).force,
        atol=1e-2,
    )


def test_with_a_fused_pose_a_slow_sensor_is_late_on_the_road_alone(twin: Twin) -> None:
    slow, cutoff = given(twin, sensor_bandwidth={"cutoff": 12.0}), 12.0
    params, lag = pack(slow)[:, None], math.sqrt(2.0) / (2 * math.pi * cutoff)
    braking, steady = way(4.0, rate=200.0, speed=12.0, ax=-2.0), way(8.0, rate=200.0)
    # its pitch while it brakes comes when the pose brakes, not a filter's delay later
    ways = [excitation(w, twin.vehicle, Ground(r)) for w, r in ((braking, flat), (steady, rough))]
    plain, late, fused = (
        simulate_lanes(t, pack(t)[:, None], ways[0], fused=f).rate[20:-20, 1, 0]
        for t, f in ((twin, False), (slow, False), (slow, True))
    )
    assert np.std(fused - plain) < 0.3 * np.std(late - plain)
    # and what comes from the road is the sensor's own, low-pass and delay
    late, fused = (simulate_lanes(slow, params, ways[1], fused=f).force[400:-50, 2, 0] for f in (False, True))
    assert np.std(fused - late) < 0.03 * np.std(late)
    assert lag > 0.018 and np.std(fused[4:] - late[:-4]) > 0.3 * np.std(late)


@pytest.mark.parametrize("hz", [2.0, 12.0, 20.0])
def test_a_late_clock_keeps_what_a_phone_still_samples(hz: float) -> None:
    """Half a sample late, which is where reading between stamps of 100 Hz costs most."""
    t = 0.01 * np.arange(400)
    t[200:] += 0.004  # a stamp that is late: where stamps are uneven a cubic does, and nothing is lost
    plain = np.repeat(np.sin(2 * np.pi * hz * t)[:, None, None], 2, axis=1)
    out, substeps = plain.copy(), np.full(t.size, 4)
    substeps[0] = 0
    _restamp(t, substeps, _even(t, substeps), plain, np.array([0.005]), np.zeros(1), TABLE, out)
    wanted = np.sin(2 * np.pi * hz * (t - 0.005))
    inside = np.r_[10:190, 215:390]
    assert np.abs(out[inside, 0, 0] - wanted[inside]).max() < 0.002
    seam = np.abs(out[190:215, 0, 0] - wanted[190:215]).max()
    assert seam < 0.25 * (hz / 20.0) ** 2 + 0.002
    # nothing of what was before a fresh start gets past it
    apart = np.where(t < 2.0, 0.0, plain[:, 0, 0])[:, None, None]
    substeps[200] = 0
    out = apart.copy()
    _restamp(t, substeps, _even(t, substeps), apart, np.array([0.005]), np.zeros(1), TABLE, out)
    assert not out[:200].any()


def test_time_offset_is_late_and_clock_drift_grows(twin: Twin) -> None:
    trajectory = way(20.0, rate=200.0)
    plain = respond(twin, rough, trajectory)
    late = respond(given(twin, time_offset={"offset": 0.03}), rough, trajectory)
    assert np.allclose(late.force[600:, 2], plain.force[594:-6, 2], atol=0.02)
    drifting = respond(given(twin, clock_drift={"drift_ppm": 2000.0}), rough, trajectory)
    lags = []
    for part in (slice(400, 800), slice(3400, 3800)):
        found = [
            np.sum(
                (
                    drifting.force[part, 2]
                    - np.interp(trajectory.t[part] - lag, trajectory.t, plain.force[:, 2])
                )
                ** 2
            )
            for lag in np.arange(0, 0.06, 0.0005)
        ]
        lags.append(np.arange(0, 0.06, 0.0005)[int(np.argmin(found))])
    assert lags == pytest.approx([0.006, 0.036], abs=0.0015)


def test_road_scale_raises_every_height(twin: Twin) -> None:
    a = respond(given(twin, road_scale={"scale": 0.2}), rough)
    b = respond(twin, lambda x, y: 1.2 * rough(x, y))
    # heights count from where the drive begins
    assert np.std(a.force[100:, 2] - b.force[100:, 2]) < 0.01 * np.std(b.force[100:, 2])


def test_position_and_lateral_offset_look_elsewhere(twin: Twin) -> None:
    for name, road in (
        ("position_offset", lambda x, y: rough(x + 0.3, y)),
        ("lateral_offset", lambda x, y: rough(x, y + 0.3)),
    ):
        a, b = respond(given(twin, **{name: {"offset": 0.3}})), respond(twin, road)
        part = slice(100, -20)  # at its end the look ahead leaves the road that was driven
        assert np.std(a.force[part, 2] - b.force[part, 2]) < 0.03 * np.std(b.force[part, 2]), name


def test_tyre_envelope_averages_the_contact_patch(twin: Twin) -> None:
    """A wave as long as the patch vanishes; one of four patches keeps sinc(1/4)."""
    for length, kept in ((0.4, 0.0), (1.6, np.sinc(0.25))):
        road = wave(0.002, length)
        plain = respond(twin, road).wheel_z[100:, 0]
        patched = respond(given(twin, tyre_envelope={"length": 0.4}), road).wheel_z[100:, 0]
        assert np.std(patched) / np.std(plain) == pytest.approx(kept, abs=0.03)


def test_road_smoothing_is_undone(twin: Twin) -> None:
    """A road that a Gaussian went over, sharpened, is the road before."""
    sigma, lengths = 0.15, (1.0, 2.5, 6.0)

    def road(x: Any, y: Any, smooth: bool) -> Any:
        out = 0 * x + 0 * y
        for i, length in enumerate(lengths):
            kept = np.exp(-2 * (np.pi * sigma / length) ** 2) if smooth else 1.0
            out = out + 0.004 * kept * np.sin(2 * np.pi * x / length + i)
        return out

    true = respond(twin, lambda x, y: road(x, y, False))
    file = respond(twin, lambda x, y: road(x, y, True))
    sharp = respond(given(twin, road_smoothing={"sigma": sigma}), lambda x, y: road(x, y, True))
    part = slice(100, -100)
    before, after = (np.std((r.force - true.force)[part, 2]) for r in (file, sharp))
    assert after < 0.05 * before


def test_unsprung_mass_hops_at_its_own_frequency(twin: Twin) -> None:
    """A wheel between tyre and spring: behind an edge the body feels it near sqrt((k_t + k) / m) / 2 pi."""
    changes: dict[str, Any] = {}
    for axle in ("front", "rear"):
        for part in ("damper_push", "damper_pull"):
            changes[f"vehicle.{axle}.{part}"] = {"velocity": (1.0,), "force": (250.0,)}
        changes[f"vehicle.{axle}.spring"] = {"compression": (1.0,), "force": (25000.0,)}
    bare = twin.with_changes(changes).model_copy(update={"model": "msd"})
    edge = lambda x, y: 0.02 * np.clip((x - 9.0) / 0.2, 0, 1) + 0 * y  # noqa: E731
    trajectory = way(5.0, rate=400.0)
    hopping = respond(given(bare, unsprung_mass={"mass": 40.0}), edge, trajectory).force[600:, 2]
    frequency = np.fft.rfftfreq(hopping.size, 1 / 400)
    expected = np.sqrt((twin.vehicle.tyre.vertical_stiffness + 25000.0) / 40.0) / 2 / np.pi
    band = frequency > 5
    assert frequency[band][np.argmax(spectrum(hopping)[band])] == pytest.approx(expected, rel=0.06)
