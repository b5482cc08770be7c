# SPDX-License-Identifier: Apache-2.0
"""Where the samples of all sources meet: one device for each stream, one time base, one bounded queue.

Sources fill it on the thread of their event loop; a node, a recorder or a terminal takes from it on its own. A device
is one phone, receiver or IMU: its accelerometer and gyroscope are paired, and its clock is watched.
"""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from suspension_twin.addons.sources.common.clock import ArrivalClock, Few, host_time
from suspension_twin.addons.sources.common.motion import MotionLag, MotionShift
from suspension_twin.arrays import Floats
from suspension_twin.drive.checks import measured
from suspension_twin.drive.clocks import ROLLOVER, rolled_over
from suspension_twin.drive.received import LivePlaces, held_velocities, with_vertical
from suspension_twin.drive.stamps import spread
from suspension_twin.drive.streams import velocities_from_course
from suspension_twin.drive.types import FixData, HeadingData, ImuData, Samples, VelocityData
from suspension_twin.errors import InputError, shorter
from suspension_twin.signals.checks import Finding

__all__ = ["STREAMS", "Device", "Hub", "Packet", "Stream"]

Stream = Literal["imu", "fix", "vel", "heading"]
STREAMS: Final[dict[type, Stream]] = {
    ImuData: "imu",
    FixData: "fix",
    VelocityData: "vel",
    HeadingData: "heading",
}

#: A gyroscope sample further than this from an accelerometer sample, in s or periods, is not beside it (as imported).
_BESIDE, _BESIDE_PERIODS = 0.05, 2.5
#: A gyroscope is extrapolated by so many periods at the end of a batch rather than waited for.
_AHEAD = 1.05
#: Samples of one sensor that wait for the other, and s of past gyroscope samples that are kept.
_WAITING, _PAST = 4000, 2.0
#: Stamps before those of a batch by which it is seen that samples come in packets with one stamp.
_PACKETS = 200
#: Samples after which the period of a sensor is measured anew.
_MEASURED_EVERY = 25
#: s over which rates are counted.
_COUNTED_OVER = 2.0


class Device:
    """A device of a :class:`~suspension_twin.addons.sources.common.hub.Hub`.

    ``counts`` by kind: what was received, lost or refused. Stamps given to it are those of the device's clocks, of
    ``clock`` (IMU) and ``position_clock``; a source sets the latter to ``clock`` where it is the same one.
    """

    def __init__(self, hub: Hub, name: str, *, rank: int = 0, epoch: bool = True) -> None:
        self.hub = hub
        self.name = name
        self.rank = rank
        self.clock = ArrivalClock(epoch)
        self.own_position_clock = ArrivalClock()
        self.position_clock = self.own_position_clock
        self.counts: Counter[str] = Counter()
        #: Standard deviation east in m of the last fix, NaN while not known.
        self.accuracy = math.nan
        #: Latitude, longitude in degrees and height in m of the last fix.
        self.place: tuple[float, float, float] | None = None
        #: What the motion has said of its IMU's stamps.
        self.motion: MotionShift | None = None
        #: The host's time in s when it was first heard of.
        self.since = hub.now()
        self._force = _Buffer()
        self._rate = _Buffer()
        self._places = LivePlaces()
        self._held: Floats = np.empty(0)  # stamps of the last positions that were held
        self._velocity = VelocityData(np.array([-math.inf]), np.zeros((1, 3)))
        self._recent: dict[str, deque[tuple[float, int]]] = {}
        self._steps = 0

    # For sources

    def force(self, t: Floats, values: Floats, arrival: float, *, checked: bool = False) -> None:
        """Specific force (n, 3) in m/s² at stamps (n,) s; :meth:`flush` hands it on with the angular rate.

        ``checked`` where every number is known to be one that can be measured.
        """
        self._force.add(*((t, values) if checked else self._usable(t, values, "accelerometer")), arrival)

    def rate(self, t: Floats, values: Floats, arrival: float, *, checked: bool = False) -> None:
        """Angular rate (n, 3) in rad/s at stamps (n,) s."""
        self._rate.add(*((t, values) if checked else self._usable(t, values, "gyroscope")), arrival)

    def flush(self, arrival: float, *, complete: bool) -> None:
        """Hand on the specific forces that have an angular rate beside them.

        ``complete`` says that a batch has ended: then the last samples are not kept until the next batch for the sake
        of a fraction of a period.
        """
        force, rate = self._force, self._rate
        period = rate.period
        reach = -math.inf if rate.t.size < 2 else float(rate.t[-1]) + (_AHEAD * period if complete else 0.0)
        ready = int(np.searchsorted(force.t, reach, side="right"))
        if not ready:
            self._give_up()
            return
        t, values = force.take(ready)
        if t[-1] == rate.t[-1] and np.array_equal(t, rate.t[-ready:]):  # both of one chip's queue
            rates = rate.values[-ready:]
            rate.forget(float(rate.t[-1]) - _PAST)
            self._emit(t, values, rates, arrival)
            return
        after = np.minimum(np.maximum(np.searchsorted(rate.t, t), 1), rate.t.size - 1)
        t0, t1 = rate.t[after - 1], rate.t[after]
        weight = ((t - t0) / (t1 - t0))[:, None]
        rates = (1.0 - weight) * rate.values[after - 1] + weight * rate.values[after]
        beside = np.minimum(np.abs(t - t0), np.abs(t1 - t)) <= max(_BESIDE, _BESIDE_PERIODS * period)
        if not beside.all():
            self.counts["accelerometer samples without a gyroscope"] += int(beside.size - beside.sum())
            t, values, rates = t[beside], values[beside], rates[beside]
        rate.forget(float(rate.t[-1]) - _PAST)
        self._emit(t, values, rates, arrival)

    def imu(self, t: Floats, force: Floats, rate: Floats, arrival: float) -> None:
        """Both at the same stamps (n,) s."""
        good = np.isfinite(t) & measured(force) & measured(rate)
        self.counts["values that are no measurement"] += int(good.size - good.sum())
        self._emit(t[good], force[good], rate[good], arrival)

    def fix(self, fix: FixData, arrival: float) -> None:
        """Positions, stamped by ``position_clock``."""
        with np.errstate(invalid="ignore"):
            good = np.isfinite(fix.t) & (np.abs(fix.latitude) <= 90) & (np.abs(fix.longitude) <= 180)
            good &= ~((fix.latitude == 0) & (fix.longitude == 0))  # what phones report before their first fix
            good &= ~(np.abs(fix.altitude) >= 1e5)  # one that is not known is NaN
        self.counts["fixes that are no place"] += int(good.size - good.sum())
        fix = fix.select(good)
        held = self._places.held(fix)
        self._held = fix.t[held]
        self.counts["fixes that repeat the one before or are interpolated"] += int(held.sum())
        fix = fix.select(~held)
        if not len(fix):
            return
        self.accuracy = float(fix.sigma[-1, 0])
        height = float(fix.altitude[-1])
        if math.isnan(height):
            height = 0.0 if self.place is None else self.place[2]
        self.place = float(fix.latitude[-1]), float(fix.longitude[-1]), height
        self._send(fix, self.position_clock, arrival)

    def velocity(self, velocity: VelocityData, arrival: float) -> None:
        """Velocities, stamped by ``position_clock``; after the positions of the same stamps."""
        velocity, _ = with_vertical(velocity)
        velocity = velocity.select(np.isfinite(velocity.t) & measured(velocity.enu))
        both = VelocityData.joined([self._velocity, velocity])
        fresh = (np.diff(both.t) != 0) & ~held_velocities(both, self._held)[1:]
        if len(velocity):
            self._velocity = velocity.select(np.array([len(velocity) - 1]))
        self._send(velocity.select(fresh[-len(velocity) :]), self.position_clock, arrival)

    def course(self, t: Floats, speed: Floats, bearing: Floats, arrival: float) -> None:
        """Velocities by speed (n,) in m/s and bearing (n,) in degrees; see
        :func:`~suspension_twin.drive.streams.velocities_from_course`."""
        velocity = velocities_from_course(t, speed, bearing)
        lost = int((np.isfinite(t) & np.isfinite(speed)).sum()) - len(velocity)
        self.counts["velocities without a speed or a course"] += lost
        self.velocity(velocity, arrival)

    def heading(self, heading: HeadingData, arrival: float) -> None:
        """Headings, stamped by ``position_clock``."""
        heading = heading.select(np.isfinite(heading.t) & np.isfinite(heading.yaw))
        self._send(heading, self.position_clock, arrival)

    # For who watches

    def last_arrival(self, stream: str) -> float:
        """The host's time in s when something of this stream came last; minus infinity before."""
        recent = self._recent.get(stream)
        return recent[-1][0] if recent else -math.inf

    def frequency(self, stream: str, now: float) -> float:
        """Samples a second of a stream over the last two seconds, or since it has come (again)."""
        recent = list(self._recent.get(stream, ()))
        seconds = max(self.counted(stream, now), 0.25 * _COUNTED_OVER)
        return sum(n for at, n in recent if at > now - _COUNTED_OVER) / seconds

    def counted(self, stream: str, now: float) -> float:
        """s over which :meth:`frequency` counts: less than two where the stream has just begun, or begun again."""
        recent = self._recent.get(stream)
        return min(now - recent[0][0], _COUNTED_OVER) if recent else 0.0

    def sensor_age(self, now: float) -> tuple[float, float]:
        """s since accelerometer and gyroscope samples came, those that are given apart; infinite before."""
        start = self.since if self._force.arrival + self._rate.arrival > -math.inf else now
        ages = [now - max(buffer.arrival, start) for buffer in (self._force, self._rate)]
        return ages[0], ages[1]

    # Inner workings

    def _usable(self, t: Floats, values: Floats, what: str) -> tuple[Floats, Floats]:
        good = np.isfinite(t) & measured(values)
        if good.all():
            return t, values
        self.counts[f"{what} values that are no measurement"] += int(good.size - good.sum())
        return t[good], values[good]

    def _give_up(self) -> None:
        """Of a sensor whose partner is missing keep the newest."""
        lost = self._force.trim(_WAITING)
        self._rate.trim(_WAITING)
        if lost:
            self.counts["accelerometer samples without a gyroscope"] += lost

    def _emit(self, t: Floats, force: Floats, rate: Floats, arrival: float) -> None:
        if not t.size:
            return
        if t.size > 1 and (t[1:] < t[:-1]).any():
            order = np.argsort(t, kind="stable")
            t, force, rate = t[order], force[order], rate[order]
        self._send(ImuData(t, force, rate), self.clock, arrival)

    def _send(self, samples: Samples, clock: ArrivalClock, arrival: float) -> None:
        if not len(samples):
            return
        stream = STREAMS[type(samples)]
        if stream != "imu" and (back := rolled_over(float(samples.t[-1]), arrival)):
            text = f"its dates are {back / ROLLOVER:.0f} x 1024 weeks back (its week number began again)"
            self.hub.notify("warn", "rollover", f"{self.name}: {text}, which is made up for")
            samples = replace(samples, t=samples.t + back)
        self.counts[stream] += len(samples)
        recent = self._recent.setdefault(stream, deque())
        recent.append((arrival, len(samples)))
        while recent[0][0] < arrival - _COUNTED_OVER:
            recent.popleft()
        if stream == "imu" or (stream == "fix" and clock is not self.clock):
            steps = clock.steps
            steady = clock.push(samples.t, arrival)
            if clock.steps > steps:
                text = f"{self.name}: its clock stepped by {clock.last_step:+.2f} s, which is made up for"
                self.hub.notify("warn", "clock step", text)
        else:
            steady = samples.t + clock.shift
        self.hub.put(self, replace(samples, t=steady), clock, arrival)


class _Buffer:
    """Samples of one sensor in rising order of their stamps."""

    def __init__(self) -> None:
        self.t = np.empty(0)
        self.values = np.empty((0, 3))
        self.period = 0.0
        self.arrival = -math.inf
        self._given = np.empty(0)  # stamps as they came
        self._unmeasured = 0

    def add(self, t: Floats, values: Floats, arrival: float) -> None:
        if not t.size:
            return
        self.arrival = arrival
        self._given = np.concatenate([self._given, t])[-_PACKETS - t.size :]
        if (np.diff(self._given[-t.size - 1 :]) == 0).any():
            t = spread(self._given)[0][-t.size :]
        rising = not self.t.size or t[0] > self.t[-1]
        rising &= t.size == 1 or bool((t[1:] > t[:-1]).all())
        new = int(t.size)
        t, values = np.concatenate([self.t, t]), np.concatenate([self.values, values])
        if not rising:
            order = np.argsort(t, kind="stable")
            fresh = np.diff(t[order], prepend=-math.inf) > 0
            t, values = t[order][fresh], values[order][fresh]
        self.t, self.values = t, values
        self._unmeasured += new
        if t.size > 1 and (self._unmeasured >= _MEASURED_EVERY or not self.period):
            self._unmeasured = 0
            self.period = float(np.median(np.diff(t[-2 * _MEASURED_EVERY :])))

    def take(self, count: int) -> tuple[Floats, Floats]:
        t, values = self.t[:count], self.values[:count]
        self.t, self.values = self.t[count:], self.values[count:]
        return t, values

    def forget(self, before: float) -> None:
        if self.t[0] < before:
            self.take(min(int(np.searchsorted(self.t, before)), self.t.size - 2))

    def trim(self, most: int) -> int:
        lost = max(self.t.size - most, 0)
        if lost:
            self.take(lost)
        return lost


#: Samples that wait at most: 50 s of a phone at 400 Hz, 12 s of an IMU at 1600 Hz.
_LIMIT = 20_000
_DEVICES = 16
_EVENTS = 200
#: Characters of an event (tolerance: a few lines of a terminal).
_LINE = 300
#: s after which another device takes the place of one that has gone silent.
_SUCCESSION = 30.0
#: A correction of stamps follows its target by this share of time; beyond the bound in s it jumps.
_SLEW, _JUMP = 5e-3, 0.05
#: Stamps of one device's IMU and positions are taken as of one clock unless they are this far apart in s: a phone's
#: position is up to a second or two on its way.
_ONE_CLOCK = 2.0
#: s between looks at the motion, and the standard deviation in s from which on what it says is used.
_LOOK_EVERY, _CERTAIN = 10.0, 0.02


@dataclass(frozen=True, eq=False)
class Packet:
    """Samples of one kind from one device, stamped in the common time base; ``arrival`` is the host's time in s."""

    device: str
    samples: Samples
    arrival: float

    @property
    def stream(self) -> Stream:
        """Which stream the samples belong to."""
        return STREAMS[type(self.samples)]


@dataclass
class _Correction:
    """Correction of the stamps of one clock; follows its target slowly."""

    value: float = math.nan
    target: float = math.nan
    at: float = 0.0

    def toward(self, target: float, now: float) -> tuple[float, float]:
        """The value now, and by how much it has jumped."""
        self.target = target
        jump = 0.0
        if math.isnan(self.value):
            self.value = target
        elif abs(target - self.value) > _JUMP:
            jump, self.value = target - self.value, target
        else:
            most = _SLEW * max(now - self.at, 0.0)
            self.value += max(-most, min(most, target - self.value))
        self.at = now
        return self.value, jump


@dataclass
class Hub:
    """Devices and their samples. ``wake`` is called, on the sources' thread, when there is something to take."""

    wake: Callable[[], None] = lambda: None
    devices: dict[str, Device] = field(default_factory=dict)
    #: The device in charge of each stream.
    chosen: dict[Stream, Device] = field(default_factory=dict)
    #: What passes corrections (RTCM) on to the receivers.
    correctors: list[Callable[[bytes], None]] = field(default_factory=list)
    #: Samples dropped because nobody took them in time.
    dropped: int = 0

    def __post_init__(self) -> None:
        self._queue: deque[Packet] = deque()
        self._held = 0
        self._lock = threading.Lock()
        self._events: deque[Finding] = deque(maxlen=_EVENTS)
        self._few = Few()
        self._corrections: dict[ArrivalClock, _Correction] = {}
        self._ignored: set[tuple[str, str]] = set()
        #: What the motion has last said of the IMU's stamps.
        self.motion: MotionShift | None = None
        self._lag = MotionLag()
        self._looked_at = 0.0
        self._by_motion = 0.0

    # For sources

    def device(self, name: str, *, rank: int = 0, epoch: bool = True) -> Device | None:
        """The device of that name, made when it is new; None if there are too many already.

        Of two devices with the same stream that of the higher ``rank`` is in charge, else the first. ``epoch`` tells
        whether its IMU's stamps are UTC.
        """
        found = self.devices.get(name)
        if found is None:
            if len(self.devices) >= _DEVICES:
                self.notify(
                    "warn", "too many devices", f"{name}: not taken, there are {_DEVICES} devices already"
                )
                return None
            found = Device(self, name, rank=rank, epoch=epoch)
            self.devices[name] = found
        return found

    def own_device(self, source: str, name: str, *, rank: int, epoch: bool = True) -> Device:
        """As :meth:`device`; InputError where there are too many already."""
        device = self.device(name, rank=rank, epoch=epoch)
        if device is None:
            raise InputError(source, "is one source too many")
        return device

    def notify(self, level: Literal["ok", "warn", "error"], code: str, text: str) -> None:
        """An event for the user; ``code`` names its kind. A warning that was just given is not repeated, and of one
        kind there are a few at a time."""
        text = shorter(text, _LINE)
        if not self._few.allows(f"{level} {code}", text, again=level == "ok"):
            return
        self._events.append(Finding(level, code, text))
        self.wake()

    def put(self, device: Device, samples: Samples, clock: ArrivalClock, arrival: float) -> None:
        """Hand samples on, whose stamps are those of ``clock`` without its steps."""
        stream = STREAMS[type(samples)]
        if not len(samples) or not self._in_charge(device, stream, arrival):
            return
        correction = self._correct(device, clock, arrival)
        if correction:
            samples = replace(samples, t=samples.t + correction)
        self._watch_motion(device, samples, arrival)
        with self._lock:
            self._queue.append(Packet(device.name, samples, arrival))
            self._held += len(samples)
            while self._held > _LIMIT and len(self._queue) > 1:
                lost = len(self._queue.popleft().samples)
                self._held -= lost
                self.dropped += lost
        self.wake()

    # For who takes

    def take(self) -> list[Packet]:
        """Everything that waits, in the order in which it came."""
        with self._lock:
            packets, self._held = list(self._queue), 0
            self._queue.clear()
        return packets

    def events(self) -> list[Finding]:
        """Events for the user since the last call."""
        found = []
        while self._events:
            found.append(self._events.popleft())
        return found

    # Inner workings

    def _in_charge(self, device: Device, stream: Stream, now: float) -> bool:
        """Whether the samples of this stream are taken from ``device``. A velocity belongs to the positions."""
        if stream == "vel" and "fix" in self.chosen:
            return self.chosen["fix"] is device
        other = self.chosen.get(stream)
        if other is device:
            return True
        silent = 0.0 if other is None else now - other.last_arrival(stream)
        if other is not None and device.rank <= other.rank and silent < _SUCCESSION:
            if (device.name, stream) not in self._ignored:
                self._ignored.add((device.name, stream))
                self.notify(
                    "warn", "second device", f"{device.name}: its {stream} is not used, {other.name} gives it"
                )
            return False
        if other is not None:
            why = f" after {silent:.0f} s of silence" if silent >= _SUCCESSION else ""
            self.notify(
                "warn", "device changed", f"{stream} now comes from {device.name}, not {other.name}{why}"
            )
        self.chosen[stream] = device
        self._ignored.discard((device.name, stream))
        return True

    def reference(self) -> ArrivalClock | None:
        """The clock of the positions in use, whose time is the time base; None while there are none."""
        device = self.chosen.get("fix")
        return None if device is None else device.position_clock

    def _correct(self, device: Device, clock: ArrivalClock, now: float) -> float:
        """Correction that brings stamps of ``clock`` into the time base."""
        correction = self._corrections.setdefault(clock, _Correction())
        reference = self.reference()
        if (clock is reference or reference is None) and not math.isnan(correction.value):
            return (
                correction.value
            )  # nothing to follow: the better offset of the next second would only move it
        target = 0.0 if clock.epoch else clock.offset
        if reference is not None and clock is not reference:
            apart = clock.offset - reference.offset
            base = self._corrections.get(reference, _Correction()).value
            one = reference is device.position_clock and clock.epoch and abs(apart) < _ONE_CLOCK
            # Clocks that are not live are those of a recording that is played, or it is too early to tell.
            if not math.isnan(apart + base) and not one and clock.live and reference.live:
                target = apart + base + (self._by_motion if clock is device.clock else 0.0)
        value, jump = correction.toward(target, now)
        if jump:
            self.notify("warn", "clock corrected", f"{device.name}: its stamps are moved by {jump:+.3f} s")
        return value

    def _watch_motion(self, device: Device, samples: Samples, now: float) -> None:
        """Compare IMU and velocities from time to time; where they have different clocks, correct the IMU's."""
        if isinstance(samples, ImuData):
            self._lag.imu(samples)
        elif isinstance(samples, VelocityData):
            self._lag.velocity(samples)
        if now - self._looked_at < _LOOK_EVERY:
            return
        self._looked_at = now
        self.motion = found = self._lag.estimate()
        imu, reference = self.chosen.get("imu"), self.reference()
        if found is None or imu is None or reference is None:
            return
        imu.motion = found
        correction = self._corrections.get(imu.clock)
        own = reference in (imu.clock, imu.position_clock)
        if own or correction is None or abs(correction.value - correction.target) > 1e-3:
            return  # of one device, or still on its way to what was found before
        if found.sigma < _CERTAIN and abs(found.lag) > 3.0 * found.sigma:
            self._by_motion -= found.lag
            self._lag.reset()

    def now(self) -> float:
        """The host's time in s."""
        return host_time()
