# SPDX-License-Identifier: Apache-2.0
"""``tracked``: the tracked paper's vehicle in its plane of symmetry, one half of it.

The paper's model has 118 bodies, 97 of them links of the track [read]. The track acts on the
hull, and so on its markers, by (1) the tension that pulls idler, sprocket and the outer wheels together,
(2) that it bridges the gaps between the wheels, ahead of the first and behind the last one, and
(3) its mass under the wheels. So this model has

- the hull (heave, pitch) on a prescribed travel, and each road wheel on its trailing arm with
  torsion bar, rotary damper, hard stops and a rubber tyre: 2 + S degrees of freedom with their
  exact planar kinematics;
- the run of the track between sprocket and idler as a chain of nodes that keep their place on the
  ground, as a track does that does not slip: vertical motion, bending stiffness k_g_phi and damping
  b_g_phi of the joints, contact with the ground below and with the arcs of the wheels above;
- one tension for the whole loop, (k_gl / N) times its stretch and (b_gl / N) times the stretch's
  rate for N links, never pushing. The loop's length is that of the chain below, the tangents to the
  two guide wheels, the wraps around them and the run above.

One tension suffices because the links between two guides settle much faster than the hull moves:
with the paper's k_gl a wave runs at 167 m/s around the loop (0.08 s), the hull answers below 3 Hz.
Links of the upper run move with the hull. A link is one element, as in the paper, and meets the
ground at ``contacts`` places; ``fineness`` elements a link make a beam of the same stiffness instead.
``benchmarks/tracked.py --convergence`` shows what either and the step change, and why nothing
converges where no damper works. What pushes the vehicle on acts at the ground (its moment lifts the
nose). Left out: sag of the upper run, slip, what turns the wheels.

The travel is prescribed, or, where the vehicle has a ``driver``, it is what its sprocket makes of it:
the ground holds the track between the outer wheels, the sprocket winds in the span behind the last
one and gives to the run above, so that behind there is more tension and in front less; a hull that
pitches high above its track is carried to and fro with it; engine and gearbox give way, and the driver
makes up for what the vehicle is too slow by and behind by. At 13 km/h over the obstacle its speed
varies by a tenth, which lifts and dips the nose by more than most faults do.

Integration: semi-implicit Euler, dampers on the arms and the track's bending implicit (the bounds
(11) and (13) would ask for steps below 1 microsecond otherwise).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.errors import InputError, WorkError
from suspension_twin.models.excitation import MAX_STEP, earlier_pose, next_yaw_acceleration
from suspension_twin.models.hooks import ClockChange, Hook
from suspension_twin.models.live import LiveModel, LiveState
from suspension_twin.models.parameters import layout, pack
from suspension_twin.models.registry import Model
from suspension_twin.models.tracked_kernel import COLUMNS, HULL, PARAMETERS, first_index, walk_lane
from suspension_twin.models.types import Excitation, HeightField, Ints, LaneResponse, PoseSample, Response
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.tracked import Driver, Obstacle, TrackedTwin, TrackedVehicle
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "MODEL",
    "LiveTracked",
    "ObstacleRun",
    "TrackedResponse",
    "belt_length",
    "changed_vehicle",
    "obstacle_height",
    "simulate_tracked",
    "simulate_tracked_lanes",
]


STEP = 4.0e-4  # s
CONTACTS = 4  # places on each link at which it can meet the ground
_STRAY = 2.0  # m that a driven vehicle may be ahead of or behind its way: more is no run
_LEAD = 0.5  # m between the idler and the obstacle at the start
SETTLE = 2.0  # s of standing still, heavily damped, before the travel


@dataclass(frozen=True)
class MarkerMotion:
    """Motion (n, 3) of the markers A, B and C in m, m/s and m/s²; displacements upwards from the standing vehicle."""

    markers: Floats
    marker_velocity: Floats
    marker_acceleration: Floats


@dataclass(frozen=True)
class RunningGear:
    """Track and wheels of a run; ``ground`` (n,) N of both sides together, everything else of one side.

    ``tension`` (n,) N of the track; ``arm`` (n, S) rad below the horizontal of the hull; ``wheel_load`` (n, S) N;
    ``energy`` and ``lost`` (n,) J.
    """

    tension: Floats
    ground: Floats
    arm: Floats
    wheel_load: Floats
    energy: Floats
    lost: Floats


@dataclass(frozen=True)
class TrackedResponse(MarkerMotion, RunningGear):
    """One run over the stamps ``t`` (n,) s.

    ``travel`` m of the CoG along the ground from the obstacle's foot; its height ``z`` m; ``pitch`` rad, nose down
    positive; ``failed``: the run diverged, and everything is zero.
    """

    t: Floats
    travel: Floats
    z: Floats
    pitch: Floats
    failed: bool


def obstacle_height(obstacle: Obstacle | None, s: Floats) -> Floats:
    """Height of the ground in m at ``s`` m from the obstacle's foot; level without an obstacle."""
    if obstacle is None:
        return np.zeros(s.shape)
    corners = np.cumsum([0.0, obstacle.ramp, obstacle.top, obstacle.ramp])
    return np.asarray(np.interp(s, corners, [0.0, obstacle.height, obstacle.height, 0.0]))


def belt_length(vehicle: TrackedVehicle, setting: float) -> float:
    """Length in m of the taut loop around idler, outer wheels and sprocket of the standing vehicle.

    Closed form: straight lines between circles that they touch, and the arcs between them.
    """
    v, half = vehicle, vehicle.track.thickness
    circles = [
        (-setting / 1000, v.idler.height, v.idler.radius + half),
        (v.stations[0].x, v.wheel_height, v.wheel.radius + half),
        (v.stations[-1].x, v.wheel_height, v.wheel.radius + half),
        (*v.sprocket.position, v.sprocket.radius + half),
    ]
    total, angle = 0.0, 0.5 * math.pi
    for (x1, z1, r1), (x2, z2, r2) in zip(circles, circles[1:], strict=False):
        distance = math.hypot(x2 - x1, z2 - z1)
        # the normal at which the belt leaves one circle and meets the next, below both
        normal = math.atan2(z2 - z1, x2 - x1) + math.acos((r1 - r2) / distance)
        normal = (normal + math.pi) % (2 * math.pi) - math.pi
        normal += 2 * math.pi if normal > angle else 0.0
        normal -= 2 * math.pi if normal > angle else 0.0
        total += r1 * (angle - normal) + math.sqrt(distance**2 - (r1 - r2) ** 2)
        angle = normal
    total += circles[-1][2] * (angle + 1.5 * math.pi)
    first, last = circles[0], circles[-1]
    return total + math.hypot(first[0] - last[0], first[1] - last[1])


def pack_tracked(
    vehicle: TrackedVehicle,
    fineness: int = 1,
    kick: tuple[float, float] = (0.0, 0.0),
    driver: Driver | None = None,
) -> tuple[Floats, Floats, int]:
    """Parameters (P,), stations (S, 5) and the number of nodes."""
    v, track, (cog_x, cog_z) = vehicle, vehicle.track, vehicle.cog
    cell = track.pitch / fineness
    idler_x = -v.idler.setting / 1000
    idler_r, sprocket_r = v.idler.radius + track.thickness, v.sprocket.radius + track.thickness
    first = v.sprocket.position[0] + sprocket_r + 0.02 - cog_x
    # The last node is counted from where the idler is when the track is taut: all settings share it.
    last = -v.idler.taut_at / 1000 - idler_r - 0.02 - cog_x
    nodes = math.floor((last - first) / cell)
    node_mass = track.link_mass / fineness
    hull = v.mass / 2 - len(v.stations) * v.wheel.mass - nodes * node_mass
    # links that the ground holds, and those between them and the sprocket
    held = (v.stations[0].x - v.stations[-1].x) / track.pitch
    rear = v.stations[-1].x - v.sprocket.position[0], v.wheel_height - v.sprocket.position[1]
    span = math.hypot(*rear) / track.pitch
    values = {
        "hull_mass": hull,
        "hull_inertia": hull * v.gyration**2,
        "sprocket_x": v.sprocket.position[0] - cog_x,
        "sprocket_z": v.sprocket.position[1] - cog_z,
        "sprocket_radius": sprocket_r,
        "idler_x": idler_x - cog_x,
        "idler_z": v.idler.height - cog_z,
        "idler_radius": idler_r,
        "loop_stiffness": track.stiffness / track.links,
        "loop_damping": track.damping / track.links,
        "free_length": belt_length(v, v.idler.taut_at),
        "bending_stiffness": track.bending_stiffness * fineness,
        "bending_damping": track.bending_damping * fineness,
        "wheel_radius": v.wheel.radius,
        "wheel_mass": v.wheel.mass,
        "rubber": v.wheel.rubber,
        "rubber_damping": v.wheel.rubber_damping,
        "arm": v.arm.length,
        "free": v.arm.free_angle,
        "bar": v.arm.stiffness,
        "jounce": v.arm.jounce_stop,
        "rebound": v.arm.rebound_stop,
        "stop": v.arm.stop_stiffness,
        "ground": v.ground.stiffness,
        "ground_damping": v.ground.damping,
        "thickness": track.thickness,
        "node_mass": node_mass,
        "spacing": cell,
        "first_node": first,
        "height": cog_z - v.ground_height,
        "kick": kick[0],
        "pitch_kick": kick[1],
        "governed": 0.0 if driver is None else 1.0,
        "governor": 0.0 if driver is None else driver.gain,
        "reset": 0.0 if driver is None else driver.reset,
        "droop": 0.0 if driver is None else driver.droop,
        "pulling_links": track.links / span,
        "returning_links": track.links / (track.links - span - held),
    }
    a = v.arm.standing_angle
    along, up = v.arm.length * math.cos(a), v.arm.length * math.sin(a)
    stations = [[s.x + along - cog_x, v.wheel_height + up - cog_z, s.damping, s.sag, a] for s in v.stations]
    return np.array([values[name] for name in PARAMETERS]), np.array(stations), nodes


def start_state(p: Floats, stations: Floats, nodes: int, x: float) -> tuple[Floats, Floats, Floats, Ints]:
    """State before settling, CoG at ``x`` on level ground at 0: see ``tracked_kernel.walk_lane``."""
    hull = np.zeros(HULL)
    hull[0] = p[PARAMETERS.index("height")]
    arms = np.stack([stations[:, 4], np.zeros(len(stations))])
    return hull, arms, np.zeros((2, nodes)), np.array([first_index(p, x)])


def wheel_arc(radius: float) -> Floats:
    """Places along a wheel's lower arc (Q, 3): dense where it stands, wide enough for a step."""
    half = np.concatenate([np.arange(0.0, 0.121, 0.02), [0.15, 0.19, 0.24]]) * radius / 0.375
    s = np.concatenate([-half[:0:-1], half])
    return np.stack([s, radius - np.sqrt(radius**2 - s**2), np.gradient(s)], axis=1)


def simulate_tracked_lanes(
    vehicles: Sequence[TrackedVehicle],
    speeds: Sequence[float],
    duration: float,
    *,
    rate: float = 100.0,
    fineness: int = 1,
    step: float = STEP,
    contacts: int = CONTACTS,
    level: bool = False,
    kick: tuple[float, float] = (0.0, 0.0),
    phase: float = 0.0,
    workers: int | None = None,
) -> list[TrackedResponse]:
    """Runs over each vehicle's obstacle from standing level, one for each pair of vehicle and speed.

    ``speeds`` m/s, constant; ``duration`` s at ``rate`` Hz; ``level``: without the obstacle;
    ``kick``: heave (m/s) and pitch (rad/s) speed given to the standing hull at the start; ``phase`` m by which the
    joints of the links lie behind where they do otherwise, which nobody knows of a real run.
    A vehicle with a ``driver`` is driven by its sprocket and holds the speed as well as that goes.
    Raises InputError for a speed or duration that is no run.
    """
    if len(vehicles) != len(speeds):
        raise InputError("tracked", "speeds", f"{len(speeds)} for {len(vehicles)} vehicles")
    for speed in speeds:
        if not 0.0 <= speed <= 40.0:
            raise InputError(
                "tracked", "speed", f"must lie between 0 and 40 m/s, is {speed:g} (is it in km/h?)"
            )
    if not 0.0 < duration <= 600.0 or not 1.0 <= rate <= 1000.0:
        raise InputError("tracked", "duration", "must be above 0 and at most 600 s, at 1 to 1000 Hz")
    t = np.arange(round(duration * rate) + 1) / rate
    substeps = max(1, math.ceil(1.0 / rate / step - 1e-9))

    def run(lane: tuple[TrackedVehicle, float]) -> TrackedResponse:
        vehicle, speed = lane
        p, stations, nodes = pack_tracked(vehicle, fineness, kick, vehicle.driver)
        foot = -_LEAD - vehicle.idler.radius - (-vehicle.idler.setting / 1000 - vehicle.cog[0])
        travel = foot + speed * t + phase
        out = np.zeros((t.size, COLUMNS + 2 * len(vehicle.stations)))
        hull, arms, track, mark = start_state(p, stations, nodes, float(travel[0]))
        cell, base = p[PARAMETERS.index("spacing")], int(mark[0]) * contacts
        room = 0 if vehicle.driver is None else math.ceil(_STRAY / cell) * contacts
        base -= room
        samples = np.arange(base, (first_index(p, float(travel[-1])) + nodes) * contacts + room)
        obstacle = None if level else vehicle.obstacle
        heights = obstacle_height(obstacle, (samples + 0.5) * cell / contacts - phase)
        sound = walk_lane(
            p,
            stations,
            wheel_arc(vehicle.wheel.radius),
            heights,
            base,
            contacts,
            travel,
            np.zeros(t.size),
            np.diff(t),
            np.full(t.size - 1, substeps),
            round(SETTLE / step),
            step,
            hull,
            arms,
            track,
            mark,
            out,
        )
        sound = sound and bool(np.isfinite(out).all())
        return _response(vehicle, t, travel - phase, out, failed=not sound)

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        return list(pool.map(run, zip(vehicles, speeds, strict=True)))


def _response(
    vehicle: TrackedVehicle, t: Floats, travel: Floats, out: Floats, failed: bool
) -> TrackedResponse:
    if failed:
        out = np.zeros_like(out)
    z, pitch, zv, pv, za, pa = out[:, :6].T
    sin, cos = np.sin(pitch)[:, None], np.cos(pitch)[:, None]
    marks = np.array([vehicle.markers.A, vehicle.markers.B, vehicle.markers.C]) / 1000
    x, up = -marks[:, 0] - vehicle.cog[0], marks[:, 1] - vehicle.cog[1]
    height = z[:, None] - x * sin + up * cos
    along, above = x * cos + up * sin, up * cos - x * sin
    stations = len(vehicle.stations)
    return TrackedResponse(
        t=t,
        travel=travel + out[:, 10],
        z=z,
        pitch=pitch,
        tension=out[:, 6],
        ground=2 * out[:, 7],
        arm=out[:, COLUMNS : COLUMNS + stations],
        wheel_load=out[:, COLUMNS + stations :],
        energy=out[:, 8],
        lost=out[:, 9],
        markers=height - height[0],
        marker_velocity=zv[:, None] - along * pv[:, None],
        marker_acceleration=za[:, None] - along * pa[:, None] - above * pv[:, None] ** 2,
        failed=failed,
    )


def simulate_tracked(
    vehicle: TrackedVehicle,
    speed: float,
    duration: float,
    *,
    rate: float = 100.0,
    fineness: int = 1,
    step: float = STEP,
    contacts: int = CONTACTS,
    level: bool = False,
    kick: tuple[float, float] = (0.0, 0.0),
) -> TrackedResponse:
    """One run over the obstacle; raises WorkError where the motion leaves all bounds."""
    response = simulate_tracked_lanes(
        [vehicle],
        [speed],
        duration,
        rate=rate,
        fineness=fineness,
        step=step,
        contacts=contacts,
        level=level,
        kick=kick,
        workers=1,
    )[0]
    if response.failed:
        raise WorkError("tracked: the run diverged: make the track softer or the obstacle lower")
    return response


@dataclass(frozen=True, eq=False)
class ObstacleRun:
    """A run over the vehicle's obstacle from standing level: ``speed`` m/s, even stamps ``t`` (n,) s from 0 on."""

    t: Floats
    speed: float

    def __len__(self) -> int:
        return int(self.t.size)


def _numbers(twin: Twin) -> tuple[str, ...]:
    """Every number of the vehicle, by its dotted key."""

    def leaves(node: Any, key: str) -> Iterator[str]:
        parts = node.items() if isinstance(node, dict) else enumerate(node)
        for name, part in parts:
            if isinstance(part, dict | list | tuple):
                yield from leaves(part, f"{key}.{name}")
            elif isinstance(part, int | float):
                yield f"{key}.{name}"

    return tuple(leaves(twin.vehicle.model_dump(), "vehicle"))


def _hooked(twin: Twin, params: Floats) -> tuple[dict[str, Floats], list[tuple[Hook, dict[str, Floats]]]]:
    """Numbers (L,) of every candidate as its effects change them, and the effects' hooks and parameters."""
    shape = layout(twin)
    numbers = dict(zip(shape.names, params, strict=True))
    own = [
        (hook, {name: numbers[f"effects.{effect}.{name}"] for name in hook.neutral})
        for effect, hook in shape.hooks.items()
    ]
    for hook, values in own:
        if hook.vehicle is not None:
            hook.vehicle(numbers, values)
    return numbers, own


def _vehicles(twin: Twin, numbers: dict[str, Floats], count: int) -> list[TrackedVehicle | None]:
    """The vehicle of each candidate; None where there cannot be such a one."""
    base = dict(zip(layout(twin).names, pack(twin).tolist(), strict=True))
    own = {key: values for key, values in numbers.items() if key.startswith("vehicle.")}
    found: list[TrackedVehicle | None] = []
    for lane in range(count):
        given = {key: float(values[lane]) for key, values in own.items()}
        # an effect may name a station that the vehicle has not
        changes = {k.removeprefix("vehicle."): v for k, v in given.items() if v != base.get(k, math.nan)}
        try:
            found.append(twin.vehicle.with_changes(changes))
        except InputError:
            found.append(None)
    return found


def changed_vehicle(twin: Twin) -> TrackedVehicle:
    """The vehicle of a twin with its effects; InputError where there cannot be such a one."""
    params = pack(twin)[:, None]
    found = _vehicles(twin, _hooked(twin, params)[0], 1)[0]
    if found is None:
        raise InputError("twin", "effects", "there can be no such vehicle")
    return found


def _lanes(twin: Twin, params: Floats, excitation: ObstacleRun, threads: int | None = None) -> LaneResponse:
    """Readings of the markers of candidates (P, L) on a run, by the camera and its clock."""
    numbers, own = _hooked(twin, params)
    count, t = params.shape[1], excitation.t
    vehicles = _vehicles(twin, numbers, count)
    signals, failed = np.zeros((t.size, len(_CHANNELS), count)), np.ones(count, dtype=np.bool_)
    # effects of clock and camera leave the vehicle as it is: candidates that are alike are simulated once
    same: dict[TrackedVehicle, list[int]] = {}
    for i, vehicle in enumerate(vehicles):
        if vehicle is not None:
            same.setdefault(vehicle, []).append(i)
    rate = (t.size - 1) / float(t[-1])
    responses = simulate_tracked_lanes(
        list(same), [excitation.speed] * len(same), float(t[-1]), rate=rate, workers=threads
    )
    for response, lanes in zip(responses, same.values(), strict=True):
        read = (response.markers, response.marker_velocity, response.marker_acceleration)
        signals[:, :, lanes] = np.concatenate(read, axis=1)[:, :, None]
        failed[lanes] = response.failed
    change = ClockChange(np.zeros(count), np.zeros(count))
    for hook, values in own:
        if hook.reading is not None:
            hook.reading(signals, excitation, values)
        if hook.clock is not None:
            hook.clock(change, values)
    for i in np.flatnonzero((change.delay != 0.0) | (change.drift != 0.0)).tolist():
        at = t - change.delay[i] - change.drift[i] * t
        signals[:, :, i] = interpolated(at, t, signals[:, :, i])
    signals[:, :, failed] = 0.0
    return LaneResponse(t, _CHANNELS, signals, failed)


def _driven(twin: Twin) -> Twin:
    """The twin with a driver: no real tracked vehicle follows a prescribed travel."""
    if twin.vehicle.driver is not None:
        return twin
    return twin.model_copy(update={"vehicle": twin.vehicle.model_copy(update={"driver": Driver()})})


_CHANNELS = tuple(
    f"marker_{name}_{kind}"
    for kind in ("displacement", "velocity", "acceleration")
    for name in ("A", "B", "C")
)


class LiveTracked(LiveModel):
    """As :class:`~suspension_twin.models.live.LiveTwin`, for a twin on tracks.

    The plane of symmetry travels along the locked pose; each link is laid on the mean of the heights under
    the two tracks, where the pose points when it is laid. Left and right road wheels move alike: arrays of a state hold
    the left side's wheels front to rear, then the right side's. ``deflection`` is an arm's turn in rad from its free
    angle, up positive; ``roll`` is 0. ``late`` s of the sensor's clock offset are in the poses already.
    """

    def __init__(
        self, twin: TrackedTwin, road: HeightField, max_step: float = MAX_STEP, late: float = 0.0
    ) -> None:
        self._late = twin.imu.latency - late
        vehicle = changed_vehicle(twin)
        self.twin = twin
        self._road = road
        self._step = min(STEP, max_step)
        self._p, self._stations, self._nodes = pack_tracked(vehicle)
        self._arc = wheel_arc(vehicle.wheel.radius)
        self._free, self._radius = vehicle.arm.free_angle, vehicle.wheel.radius
        self._cell = float(self._p[PARAMETERS.index("spacing")])
        # places counted from the centre of gravity: base_link's origin, the imu; and pivots for the wheels
        self._origin = np.array(
            [vehicle.stations[-1].x - vehicle.cog[0], vehicle.ground_height - vehicle.cog[1]]
        )
        position = np.array(twin.imu.position)
        self._imu = self._origin + position[[0, 2]]
        self._imu_y = float(position[1])
        self._arm = vehicle.arm.length
        self._side = vehicle.tread / 2
        self._out = np.zeros((2, COLUMNS + 2 * len(vehicle.stations)))
        self._height = self._standing()
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next step starts from static equilibrium."""
        super().reset()
        self._s, self._pose = 0.0, (0.0, 0.0, 0.0)
        self._before: PoseSample | None = None
        self._yaw_acceleration = 0.0

    def _go_on(self, t: float, motion: PoseSample, interval: float, event: str) -> LiveState:
        self._pose = earlier_pose(motion, self._late)[:3]
        before, self._before = self._before, motion
        if event or before is None:
            sound = self._start()
            self._yaw_acceleration = 0.0
        else:
            change = motion.yaw_rate - before.yaw_rate
            self._yaw_acceleration = next_yaw_acceleration(self._yaw_acceleration, change, interval)
            sound, event = self._walk_on(interval, before, motion)
        if not sound:
            event = "diverged: started afresh"
            if not self._start():
                raise WorkError("tracked: the vehicle cannot stand: are its stiffnesses right?")
        return self._state(t, event, motion)

    def _heights(self, places: Floats, s: float) -> Floats:
        """Mean height of both tracks at places along the way, seen from the pose with the CoG at ``s``."""
        x, y, yaw = self._pose
        c, n = math.cos(yaw), math.sin(yaw)
        ahead = (places - s - self._origin[0])[:, None]
        side = np.array([[self._side, -self._side]])
        heights: Floats = np.asarray(self._road.heights(x + c * ahead - n * side, y + n * ahead + c * side))
        return np.asarray(heights.mean(axis=1))

    def _places(self, begin: int, end: int) -> Floats:
        """Where between nodes ``begin`` and ``end`` the ground is looked at, m along the way."""
        return (np.arange(begin * CONTACTS, end * CONTACTS) + 0.5) * self._cell / CONTACTS

    def _standing(self) -> float:
        """Height of the centre of gravity standing on level ground at 0, m."""
        if not self._settle(np.zeros(self._nodes * CONTACTS)):
            raise InputError("twin", "vehicle", "cannot stand on level ground: are its stiffnesses right?")
        return float(self._hull[0])

    def _start(self) -> bool:
        """Come to rest where the pose is; False where the vehicle cannot stand there."""
        self._s = 0.0
        lead = first_index(self._p, 0.0)
        heights = self._heights(self._places(lead, lead + self._nodes), 0.0)
        if not np.isfinite(heights).all():
            known = heights[np.isfinite(heights)]
            heights = np.where(np.isfinite(heights), heights, known.mean() if known.size else 0.0)
        self._reference = float(heights.mean())
        self._floor = heights - self._reference
        return self._settle(self._floor)

    def _settle(self, floor: Floats) -> bool:
        self._hull, self._arms, self._track, self._mark = start_state(
            self._p, self._stations, self._nodes, 0.0
        )
        self._hull[0] += floor.max()
        self._track[0] = floor.reshape(self._nodes, CONTACTS).max(axis=1)
        still = np.zeros((1, 2)), np.zeros(0), np.zeros(0, dtype=np.int64)
        return self._walk(still, floor, int(self._mark[0]), self._out[1:], round(SETTLE / self._step))

    def _walk_on(self, interval: float, before: PoseSample, motion: PoseSample) -> tuple[bool, str]:
        """Walk an interval: False where the vehicle diverges, and a message about the road, or none."""
        distance = 0.5 * (before.speed + motion.speed) * interval
        mark, travel = int(self._mark[0]), np.array([self._s, self._s + distance])
        lead = first_index(self._p, float(travel[1]))
        low, high = min(mark, lead), max(mark, lead)
        floor, problem = self._floor, ""
        if lead != mark:
            ahead = lead > mark
            begin, end = (mark + self._nodes, lead + self._nodes) if ahead else (lead, mark)
            new = self._heights(self._places(begin, end), float(travel[1])) - self._reference
            if not np.isfinite(new).all():
                problem = "the road has no height under a track: last one held"
                new = np.where(np.isfinite(new), new, floor[-1] if ahead else floor[0])
            floor = np.concatenate([floor, new] if ahead else [new, floor])
        counts = np.array([max(1, math.ceil(interval / self._step - 1e-9))])
        way = np.array([travel, [before.ax, motion.ax]]).T
        sound = self._walk((way, np.array([interval]), counts), floor, low, self._out)
        self._s = float(travel[1])
        self._floor = floor[(lead - low) * CONTACTS :][: self._nodes * CONTACTS]
        return sound and high - low < 4 * self._nodes, problem

    def _walk(
        self, way: tuple[Floats, Floats, Ints], floor: Floats, base: int, out: Floats, settle: int = 0
    ) -> bool:
        """Walk along ``way``: travel m and acceleration m/s² (n, 2), the intervals (n - 1,) s, and their steps."""
        moved, interval, counts = way
        sound = walk_lane(
            self._p,
            self._stations,
            self._arc,
            floor,
            base * CONTACTS,
            CONTACTS,
            moved[:, 0].copy(),
            moved[:, 1].copy(),
            interval,
            counts,
            settle,
            self._step,
            self._hull,
            self._arms,
            self._track,
            self._mark,
            out,
        )
        return bool(sound) and bool(np.isfinite(out).all())

    def _state(self, t: float, event: str, motion: PoseSample) -> LiveState:
        row = self._out[1]
        z, pitch, _, pv, za, pa = row[:6].tolist()
        c, s = math.cos(pitch), math.sin(pitch)
        stations = len(self._stations)
        phi, load = row[COLUMNS : COLUMNS + stations], row[COLUMNS + stations :]
        alpha = phi - pitch
        wheel = z - s * self._stations[:, 0] + c * self._stations[:, 1] - self._arm * np.sin(alpha)
        turn = self._arms[1] + pv
        ax, ay, yaw_rate, yaw_acceleration = motion.ax, motion.ay, motion.yaw_rate, self._yaw_acceleration
        # the imu's place, turned by the pitch, from the centre of gravity; from base_link's origin for the plane
        along, above = self._imu[0] * c + self._imu[1] * s, self._imu[1] * c - self._imu[0] * s
        out, left = float(self._imu[0] - self._origin[0]), self._imu_y
        forward = ax + above * pa - along * pv**2 - yaw_acceleration * left - yaw_rate**2 * out
        aside = ay + yaw_acceleration * out - yaw_rate**2 * left
        upward = za - along * pa - above * pv**2 + G
        base = z - s * self._origin[0] + c * self._origin[1]
        force = np.array([forward * c - upward * s, aside, forward * s + upward * c])
        return LiveState(
            t=t,
            heave=z - self._height + self._reference,
            roll=0.0,
            pitch=pitch,
            z=float(base + self._reference),
            wheel_z=np.tile(wheel + self._reference, 2),
            deflection=np.tile(self._free - phi, 2),
            deflection_rate=np.tile(-turn, 2),
            tyre_force=np.tile(load, 2),
            force=force,
            rate=np.array([-yaw_rate * s, pv, yaw_rate * c]),
            vertical_acceleration=float(force[2] - G * c),
            event=event,
        )


def simulate_tracked_drive(twin: TrackedTwin, excitation: Excitation) -> Response:
    """One twin over an excitation: the live twin over its stamps. Raises WorkError where it diverges."""
    path = excitation.path
    live = LiveTracked(twin, path.ground, excitation.max_step, excitation.late)
    names = [f.name for f in fields(LiveState) if f.name not in ("t", "event")]
    columns: dict[str, list[object]] = {name: [] for name in names}
    for k, t in enumerate(excitation.t):
        if excitation.substeps[k] == 0:
            live.reset()
        _, ax, ay, yaw_rate, _, speed, lateral_speed = excitation.motion[k, :7].tolist()
        pose = float(path.x[k]), float(path.y[k]), float(path.yaw[k])
        state = live.step(float(t), PoseSample(*pose, speed, lateral_speed, yaw_rate, ax, ay))
        if state.event.startswith("diverged"):
            raise WorkError(f"the simulation diverges by t = {t:.3f} s: are the road's heights in m?")
        for name in names:
            columns[name].append(getattr(state, name))
    arrays = {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
    return Response(t=excitation.t, acceleration=np.zeros((len(excitation), 7)), **arrays)


MODEL = Model(
    name="tracked",
    title="a tracked vehicle in its plane of symmetry",
    recordings="markers",
    channels=_CHANNELS,
    numbers=_numbers,
    lanes=_lanes,
    respond=simulate_tracked_drive,
    live=LiveTracked,
    prepared=_driven,
)
