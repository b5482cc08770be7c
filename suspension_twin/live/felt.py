# SPDX-License-Identifier: Apache-2.0
"""Felt map matching: where along its road a vehicle is, by what its IMU feels and its twin expects to feel there.

Lanes of the model drive ahead of the receiver's place and behind it. What a lane felt is the expected signal of all
places up to the lane behind, so that a few of them make a fine grid of places; a
:class:`~suspension_twin.pose.place_bank.PlaceBank` weighs them by the measured signal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import road_of
from suspension_twin.models.candidate_road import RoadStretch, ahead_of, candidate_heights, reach_of
from suspension_twin.models.constants import Conditions, constants
from suspension_twin.models.excitation import MAX_GAP, MOTION, earlier_pose, next_yaw_acceleration, substeps
from suspension_twin.models.hooks import load_hook
from suspension_twin.models.parameters import lanes, layout
from suspension_twin.models.rows import WIDTH
from suspension_twin.models.sensor_chain import Chain
from suspension_twin.models.simulate import CAR_SIGNALS, LaneBlocks, Stretch
from suspension_twin.models.types import PoseSample
from suspension_twin.pose.lock import PlanarState
from suspension_twin.pose.place_bank import PlaceBank, PlaceEvidence, correlate
from suspension_twin.pose.receiver_lateness import LATE, ReceiverLateness
from suspension_twin.pose.types import POOR_FIX, RECEIVER_TIME, VELOCITY_SHARE
from suspension_twin.road.road import Road
from suspension_twin.signals.filters import CausalLowPass, FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["FeltPosition", "FeltSettings", "felt_stage"]

#: s within which the lock's speed comes back to the receiver's (measured: benchmarks/felt.py).
_SPEED_TIME = 3.0
#: m/s: the fastest that is driven where a place is felt, for the reach of the bank; the slowest at which it resolves
#: all of the low-pass; below the last, 4 km/h, the vehicle crawls and feels nothing of its road.
_FASTEST, _SLOWEST, _CRAWL = 30.0, 5.0, 1.1
#: Hz beyond which no car passes on what the road is: behind the resonance of the wheels at 10 to 15 Hz.
_HIGHEST = 20.0
#: Standard deviations that the bank reaches to, and the largest of them in m: beyond it lanes are too far apart.
_REACH, _POOREST = 3.0, 8.0
#: The high-pass of measured and expected signals removes slopes, gravity and biases (Hz, below the body's resonance).
_SLOW = FilterSpec(1, 0.5)
#: Signals that are compared, and what a phone's sensor and its mount add to them: m/s², rad/s.
_CHANNELS = [CAR_SIGNALS.index("vertical_force"), CAR_SIGNALS.index("pitch_rate")]
_FLOOR = np.array([0.05, 0.003])
#: Lanes: two blocks of the kernel. s of one step, a tenth of the period of the fastest wheel at most; s of signal that
#: are taken at once; s before the rate is known; s after a start for the transient to decay; s kept of what lanes felt.
_LANES, _STEP, _BATCH, _FIRST, _SETTLE, _KEPT = 2 * WIDTH, 2e-3, 0.1, 1.0, 2.0, 3.0
#: Samples per period of the highest frequency that are compared.
_PER_PERIOD = 5.0
#: Probability that road and drive belong together from which a place is believed, and below which no longer; the
#: largest spread of a place that is believed, as a share of the receiver's own.
_SURE, _UNSURE, _SHARP = 0.99, 0.5, 0.5
#: The effect by which a lane sees the road ahead of its pose; what cannot carry it has no lanes to drive ahead.
_SHIFT = "position_offset"
#: m by which the receiver's place may jump, as in the follower.
_JUMP = 0.5


@dataclass(frozen=True)
class FeltSettings:
    """``rate`` m/s by which the place moves at most to where it is felt; ``filter`` is the low-pass of ``imu/data``."""

    rate: float = 1.0
    filter: FilterSpec = FilterSpec()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0.0):
            raise InputError("pose", "felt_rate", f"must be above 0 m/s, is {self.rate}")


class _RoadCoordinates:
    """The road as a height field over (u, v), in which its course is straight."""

    def __init__(self, road: Road) -> None:
        self.heights = road.heights_uv


class _Lanes:
    """Cars that drive ``ahead`` (L,) m of a place that is carried on by the speed of the locked pose, and what the IMU
    feels in each. What fixes do to that pose is no movement: the place is pulled after it within ``RECEIVER_TIME``, by
    ``pulled`` m in the last stretch. ``lead`` m is how far the pose is ahead of it along the road."""

    def __init__(self, twin: Twin, road: Road, ahead: Floats) -> None:
        effects = {effect.id: effect.parameters for effect in twin.effects}
        already = effects.setdefault(_SHIFT, {"offset": 0.0}).get("offset", 0.0)
        specs = [{"id": name, "parameters": values} for name, values in effects.items()]
        shifted = twin.with_changes({"effects": specs})
        params = lanes(shifted, [f"effects.{_SHIFT}.offset"], already + ahead[:, None])
        known = constants(params, layout(shifted), Conditions(_STEP))
        known.problems.raise_first()
        assert known.road is not None
        self._reach = float(ahead[-1] - ahead[0])
        self._road, self._ground, self._change = road, _RoadCoordinates(road), known.road
        self._wheels = twin.vehicle.wheel_positions
        self._delay = 0.0 if known.clock is None else float(known.clock.delay[0])
        self._chain = Chain(known)
        self._fresh, self._blocks = LaneBlocks(known), LaneBlocks(known)
        half = float(np.abs(self._wheels[:, 1]).max())
        middle = 0.5 * float(road.v[0] + road.v[-1])
        self._sides = min(float(road.v[0]) + half, middle), max(float(road.v[-1]) - half, middle)
        self.restart()

    def restart(self) -> None:
        """All stand in static equilibrium."""
        self._blocks.restart(self._fresh)
        self._chain.reset()
        self._t = math.nan
        self._place = np.zeros(3)
        self._motion = np.zeros(len(MOTION))
        self.lead = self.pulled = 0.0

    def walk(self, t: Floats, poses: Floats) -> tuple[Floats, Floats]:
        """On to the stamps ``t`` (n,) s, at ``poses`` (n, 8) as in a ``PoseSample``: what is felt (n, 2, L), and the
        way (n,) m since the last stamp. Raises InputError off the road."""
        n = t.size
        on_road, pace = self._on_road(poses)
        place = np.concatenate([self._place[None], on_road])
        motion = np.zeros((n + 1, len(MOTION)))
        motion[0] = self._motion
        count = np.zeros(n + 1, dtype=np.int64)
        before, pulled = self._t, 0.0
        for k, (stamp, pose) in enumerate(zip(t.tolist(), poses.tolist(), strict=True), 1):
            _, _, _, speed, side, turn, ax, ay = pose
            interval = stamp - before
            before = stamp
            if not interval > 0.0:
                motion[k] = 0.0, ax, ay, turn, 0.0, speed, side
                continue
            count[k] = substeps(interval, _STEP)
            faster = next_yaw_acceleration(motion[k - 1, 4], turn - motion[k - 1, 3], interval)
            motion[k] = interval / count[k], ax, ay, turn, faster, speed, side
            pull = interval / RECEIVER_TIME * (place[k, 0] - place[k - 1, 0])
            pulled += pull
            driven = interval * 0.5 * (motion[k - 1, 5] + speed) * pace[k - 1]
            place[k, 0] = place[k - 1, 0] + driven + pull
        forward = math.copysign(1.0, pace[-1])
        self.lead, self.pulled = forward * float(on_road[-1, 0] - place[-1, 0]), forward * pulled
        if abs(self.lead) > self._reach:
            raise InputError("pose", "is another one")
        if not count[1]:
            place[0] = place[1]
        rows = np.maximum(count[1:], 1)
        first = np.repeat(np.concatenate([[0], np.cumsum(rows)[:-1]]), rows)
        share = ((np.arange(rows.sum()) - first + 1) / np.repeat(rows, rows))[:, None]
        way = np.repeat(place[:-1], rows, axis=0) * (1.0 - share) + np.repeat(place[1:], rows, axis=0) * share
        felt = np.empty((n, len(CAR_SIGNALS), self._blocks.width))
        self._blocks.walk(Stretch(count, motion, 1, n + 1, *self._heights(way)), felt)
        if self._blocks.failed.any():
            raise InputError("road", "the twin diverges on it")
        felt = felt[:, :, : self._blocks.lanes]
        if self._chain:
            self._chain.process(felt, t, count[1:] == 0)
        self._t, self._place, self._motion = before, place[-1], motion[-1]
        return np.ascontiguousarray(felt[:, _CHANNELS]), np.abs(np.diff(place[:, 0]))

    def _on_road(self, poses: Floats) -> tuple[Floats, Floats]:
        """(n, 3) u and v in m and the heading in rad against the road's, and (n,) m of u for each m driven; on the
        road, where a receiver says beside it."""
        x, y, yaw = poses[:, :3].T
        if self._delay:
            x, y, yaw, *_ = np.array(
                [earlier_pose(PoseSample(*row), self._delay) for row in poses.tolist()]
            ).T
        u, v = self._road.xy_to_uv(x, y)
        v = np.clip(v, *self._sides)
        x1, y1 = self._road.uv_to_xy(u + 0.5, v)
        x0, y0 = self._road.uv_to_xy(u - 0.5, v)
        off = yaw - np.arctan2(y1 - y0, x1 - x0)
        off = np.arctan2(np.sin(off), np.cos(off))
        return np.column_stack([u, v, off]), np.cos(off) / np.hypot(x1 - x0, y1 - y0)

    def _heights(self, way: Floats) -> tuple[Floats, Callable[[int], tuple[Floats, Floats]]]:
        """Heights (rows, 4) m along a ``way`` (rows, 3) of u, v and heading, and those of the lanes of a block."""
        c, s = np.cos(way[:, 2:]), np.sin(way[:, 2:])
        x, y = self._wheels.T
        ground = self._ground.heights(way[:, :1] + c * x - s * y, way[:, 1:2] + s * x + c * y)
        (u0, v0, _), (u1, v1, heading) = way[0], way[-1]  # on from here at the same side of the road
        around = ahead_of((u0, u1), (v1, v1), heading, reach_of(self._change), self._wheels, self._ground)
        distance = np.hypot(way[:, 0] - u0, way[:, 1] - v0)
        stretch = RoadStretch(around, ground, distance, ground[0])

        def own(block: int) -> tuple[Floats, Floats]:
            count = min(WIDTH, self._blocks.lanes - block * WIDTH)
            return candidate_heights(stretch, self._change, block * WIDTH, count, strict=False)

        return ground, own


class _Matching:
    """Lanes and bank for receivers of a standard deviation of up to ``sigma`` m, for one run without a pause.

    ``ahead`` m is how far the felt place is ahead of the locked pose.
    """

    def __init__(self, twin: Twin, road: Road, spec: FilterSpec, sigma: float) -> None:
        low, high = -_REACH * sigma, _REACH * sigma + LATE * _FASTEST
        ahead = np.linspace(low, high, _LANES)
        self.sigma = sigma
        self._spec = spec
        self._lanes = _Lanes(twin, road, ahead)
        apart = float(ahead[1] - ahead[0])
        self._highest = min(spec.cutoff, _HIGHEST)
        # four places to the shortest wave
        self._parts = math.ceil(apart / (_SLOWEST / (4.0 * self._highest)))
        places = low + apart / self._parts * np.arange((_LANES - 1) * self._parts + 1, dtype=np.float64)
        self._behind = apart / self._parts * np.arange(self._parts)
        self.bank = PlaceBank(places)
        self.restart()
        self._compile(road)

    def _compile(self, road: Road) -> None:
        """Stand at the begin of the road for a moment: compiled now, not at the first samples."""
        (x,), (y,) = road.uv_to_xy([road.u_first], [0.5 * float(road.v[0] + road.v[-1])])
        poses = np.array([[x, y, road.headings[0], 0.0, 0.0, 0.0, 0.0, 0.0]] * 3)
        felt = np.zeros((3, len(_CHANNELS)))
        behind, self._behind = self._behind, np.zeros(self._parts)
        with suppress(InputError):  # where it has no heights beyond its ends
            self.take(np.array([0.0, 0.01, 0.02]), poses, felt, self.sigma, LATE)
            self._weigh(0.03, felt)
        self._behind = behind
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._lanes.restart()
        self._evidence = PlaceEvidence(_FLOOR, self.bank.offsets.size)
        self._rate = math.nan
        self.fresh = True

    def _begin(self, t: Floats, sigma: float) -> None:
        self._rate = (t.size - 1) / float(t[-1] - t[0])
        channels = len(_CHANNELS)
        spec = FilterSpec(self._spec.order, min(self._spec.cutoff, 0.4 * self._rate))
        self._low = CausalLowPass(spec, self._rate, channels * _LANES)
        self._slow = CausalLowPass(_SLOW, self._rate, channels * (_LANES + 1))
        self._history = np.zeros((0, channels, _LANES))
        self._way = np.zeros(0)
        self._since, self._slip = float(t[0]), 0.0
        self.bank.begin(0.0, sigma)
        self.fresh = False

    def take(self, t: Floats, poses: Floats, felt: Floats, sigma: float, late: float) -> None:
        """Signals ``felt`` (n, 2) at ``t`` (n,) s and the locked ``poses`` (n, 8), fixes good to ``sigma`` m and to
        ``late`` s."""
        if self.fresh:
            self._begin(t, sigma)
        expected, way = self._lanes.walk(t, poses)
        n, channels, count = expected.shape
        low = self._low.process(expected.reshape(n, -1))
        both = np.concatenate([felt, low], axis=1)
        both -= self._slow.process(both)
        kept = int(_KEPT * self._rate)
        self._history = np.concatenate([self._history, both[:, channels:].reshape(n, channels, count)])[
            -kept:
        ]
        start = self._way[-1] if self._way.size else 0.0
        self._way = np.concatenate([self._way, start + np.cumsum(way)])[-kept:]
        dt, motion, lead = n / self._rate, poses[-1], self._lanes.lead
        speed = float(motion[3])
        # The place is carried on by a speed as good as its receiver is; one that is late is wrong while it brakes.
        braked = late * abs(float(poses[:, 6].mean()))
        self._slip = max(braked, VELOCITY_SHARE * sigma, self._slip * math.exp(-dt / _SPEED_TIME))
        wander = self._slip * math.sqrt(2.0 * dt)
        self.bank.move(dt, -self._lanes.pulled, wander, (lead, math.hypot(sigma, late * speed)))
        if speed > _CRAWL and t[-1] - self._since > _SETTLE:
            self._weigh(dt, both[:, :channels])
        self.ahead = self.bank.mean - lead

    def _weigh(self, dt: float, felt: Floats) -> None:
        n, every = len(felt), max(1, int(self._rate / (_PER_PERIOD * self._highest)))
        way = np.maximum.accumulate(self._way)
        at = way[-n::every]
        if at[0] - self._behind[-1] < way[0]:
            return
        rows = np.interp(at[:, None] - self._behind, way, np.arange(way.size, dtype=np.float64))
        products, squares = np.empty((2, self.bank.offsets.size, felt.shape[1]))
        felt = np.ascontiguousarray(felt[-n::every])
        correlate(self._history, rows, felt, products, squares)
        self.bank.weigh(self._evidence.gain(dt, felt, products, squares))


class FeltPosition:
    """Moves locked poses along the road to where the vehicle is felt to be.

    :meth:`step` takes every pose with the sample of the IMU and answers at once; :meth:`rest` does the work, which may
    wait until the answer is out. Poses of fixes better than ``POOR_FIX`` come back as they are, and so do those of
    roads on which nothing is felt.
    """

    def __init__(self, twin: Twin, settings: FeltSettings, road: Road | None = None) -> None:
        self.settings = settings
        self._twin = twin
        self._road = road
        self._matching: _Matching | None = None
        self._lateness = ReceiverLateness()
        self.reset()

    def reset(self) -> None:
        """Forget everything; the place is the receiver's."""
        self._waiting: list[tuple[float, ...]] = []
        self._accuracy = math.nan
        self.offset = 0.0
        self._t = math.nan
        self._pose: PlanarState | None = None
        self._newest = np.zeros((0, 11))
        self._lateness.reset()
        self._why = ""
        self._lose()
        if self._matching is not None:
            self._matching.restart()

    def _lose(self) -> None:
        #: Whether the place is felt; m that it is ahead of the receiver's, and its standard deviation.
        self.known, self.ahead, self.spread = False, 0.0, math.nan

    def step(
        self, pose: PlanarState, force: tuple[float, float, float], pitch_rate: float, accuracy: float
    ) -> PlanarState:
        """The ``pose`` moved to the felt place; ``force`` m/s² and ``pitch_rate`` rad/s as in ``imu/data``,
        ``accuracy`` m of the fixes."""
        dt = pose.t - self._t
        before = self._pose
        if self.known and before is not None:  # what fixes did to the pose since then is no movement
            c, s = math.cos(pose.yaw), math.sin(pose.yaw)
            moved = (pose.x - before.x) * c + (pose.y - before.y) * s
            self.ahead -= moved - 0.5 * (before.motion.speed + pose.motion.speed) * dt
        self._t, self._pose, self._accuracy = pose.t, pose, accuracy
        if accuracy > POOR_FIX:
            self._lateness.feel(pose.t, force[0])
        if not pose.aligned or not accuracy > POOR_FIX:
            self._lose()
            if self._waiting:
                self._waiting.clear()
            if self._matching is not None and not self._matching.fresh:
                self._matching.restart()
        elif not self._why:
            self._waiting.append((pose.t, pose.x, pose.y, pose.yaw, *pose.motion, force[2], pitch_rate))
        if self.offset or self.ahead:
            most = self.settings.rate * min(max(dt, 0.0), MAX_GAP)
            self.offset += max(-most, min(most, self.ahead - self.offset))
        return self._moved(pose) if self.offset or self.known else pose

    def heed_velocity(self, t: float, east: float, north: float) -> None:
        """One velocity of the receiver, of which follows how late it is."""
        if self._accuracy > POOR_FIX:
            self._lateness.velocity(t, math.hypot(east, north))

    @property
    def lateness(self) -> float:
        """s by which a poor receiver is late beyond its stamps; 0 while it is not known."""
        return self._lateness.seconds if self._accuracy > POOR_FIX else 0.0

    def _moved(self, pose: PlanarState) -> PlanarState:
        """Along the arc that it drives, its yaw that of the felt place."""
        along, motion = self.offset, pose.motion
        bend = motion.yaw_rate / motion.speed if abs(motion.speed) > _CRAWL else 0.0
        angle = pose.yaw - 0.5 * bend * along
        c, s = math.cos(angle), math.sin(angle)
        covariance = pose.covariance
        if self.known:
            xx, xy, xyaw, yy, yyaw, yawyaw = covariance
            more = self.spread**2 + (self.ahead - along) ** 2 - (xx * c * c + 2.0 * xy * c * s + yy * s * s)
            covariance = xx + more * c * c, xy + more * c * s, xyaw, yy + more * s * s, yyaw, yawyaw
        return pose._replace(x=pose.x + along * c, y=pose.y + along * s, covariance=covariance)

    def rest(self) -> None:
        """Take the samples that wait, once there are enough of them; at the first poor fix, prepare for them."""
        if self._why or not self._accuracy > POOR_FIX:
            return
        matching, sigma = self._matching, min(self._accuracy, _POOREST)
        if matching is None or not 0.25 * matching.sigma < sigma <= matching.sigma:
            # The power of 2 above it: a receiver's word on its accuracy changes from fix to fix.
            matching = self._prepare(2.0 ** math.ceil(math.log2(sigma)))
        if (
            matching is None
            or not self._waiting
            or self._waiting[-1][0] - self._waiting[0][0] < (_FIRST if matching.fresh else _BATCH)
        ):
            return
        rows = np.array(self._waiting)
        self._waiting.clear()
        joined = rows if matching.fresh else np.concatenate([self._newest, rows])
        self._newest = rows[-1:]
        try:
            if _is_broken(joined):
                raise InputError("pose", "jumps")
            matching.take(rows[:, 0], rows[:, 1:9], rows[:, 9:], self._accuracy, self._lateness.spread)
        except InputError:  # no height there
            matching.restart()
            self._lose()
            return
        bank = matching.bank
        if self.known:
            believed = bank.null < 1.0 - _UNSURE and bank.spread < sigma
        else:
            believed = bank.null < 1.0 - _SURE and bank.spread < _SHARP * sigma
        if believed:
            self.known, self.ahead, self.spread = True, matching.ahead, bank.spread
        else:
            self._lose()

    def _prepare(self, sigma: float) -> _Matching | None:
        """Lanes and bank for a receiver of up to ``sigma`` m; None where there cannot be any."""
        self._lose()
        try:
            self._road = self._road or road_of(self._twin)
            self._matching = _Matching(self._twin, self._road, self.settings.filter, sigma)
        except InputError as error:
            self._waiting.clear()
            self._why = str(error)
        return self._matching

    def condition(self) -> str:
        """The state of the matching in a few words."""
        if self._why or not self._accuracy > POOR_FIX:
            return self._why or "not looked for: the receiver knows the place"
        if not self.known:
            return "not known: the receiver's place is kept"
        return f"{self.ahead:+.2f} m ahead of the receiver's, to {self.spread:.2f} m"


def _is_broken(rows: Floats) -> bool:
    """Whether there is a pause or a jump between rows of t, x, y, yaw and speed."""
    dt = np.diff(rows[:, 0])
    far = np.hypot(np.diff(rows[:, 1]), np.diff(rows[:, 2]))
    return bool(((dt <= 0.0) | (dt > MAX_GAP) | (far > _JUMP + 1.5 * np.abs(rows[1:, 4]) * dt)).any())


def felt_stage(twin: Twin | None, settings: FeltSettings, road: Road | None = None) -> FeltPosition | None:
    """The felt place of a twin; None where there is no road to feel, or no lanes of its model. Its ``road`` is read
    where it is needed, unless it is given."""
    if twin is None or twin.road is None or twin.model not in load_hook(_SHIFT).models:
        return None
    return FeltPosition(twin, settings, road)
