# SPDX-License-Identifier: Apache-2.0
"""Messages of the app Sensor Logger, as it pushes them over HTTP and publishes them over MQTT.

Source: PUSHING.md, UNITS.md and CROSSPLATFORM.md of tszheichoi/awesome-sensor-logger. A message is the JSON object
``{messageId, sessionId, deviceId, payload: [{name, time, values}]}``; ``time`` is UTC in ns, names are those of the
recorded sensors in lower case. No field names the platform, and iOS has the axes of accelerometer and gravity negated
unless "Standardise Units & Frames" is on, those of the gyroscope not; :class:`_Axes` finds out.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.connection import Address, number, read_object
from suspension_twin.addons.sources.common.hub import Device, Hub
from suspension_twin.arrays import Floats
from suspension_twin.drive.importers.sensor_logger import IOS_FORCE_SIGN, force_sensors
from suspension_twin.drive.streams import phone_fix
from suspension_twin.errors import InputError
from suspension_twin.units import STANDARD_GRAVITY

__all__ = ["Phones", "axes_of", "parse_message"]

_AXES: Final = ("auto", "android", "ios")

_VECTORS: Final = (
    "totalacceleration",
    "accelerometer",
    "gravity",
    "accelerometeruncalibrated",
    "gyroscope",
    "gyroscopeuncalibrated",
)
_LOCATION: Final = (
    "latitude",
    "longitude",
    "altitude",
    "horizontalAccuracy",
    "verticalAccuracy",
    "speed",
    "bearing",
)

_MOST_READINGS = 50_000
#: No sensor of a phone measures that much, in any unit.
_BEYOND = 1e6
#: Stamps in ns that a phone can have: 2001 to 2096.
_FIRST, _LAST = 1_000_000_000_000_000_000, 4_000_000_000_000_000_000
#: s for which a message is waited for that others have overtaken, and for which samples wait for the axes to be known.
_OVERTAKEN, _UNDECIDED = 0.5, 3.0
_FIRST_OVERTAKEN = 4
_TICK = 0.1  # s between looks for messages that have not come
#: A message this much older than the newest is the first of a new count.
_RECOUNT = 1000
#: A course is compared with the gyroscope over this time in s, longer than a receiver's lag, and from this speed in m/s
#: on, at which a course is good to some degrees; a turn this large in rad decides where the two correlate this well.
_COURSE_TIME, _COURSE_SPEED, _COURSE_TURN, _COURSE_AGREES = 3.0, 3.0, 0.5, 0.7


def axes_of(address: Address) -> str:
    """The option ``axes``; InputError for one that is none."""
    axes = address.options.get("axes", "auto")
    if axes not in _AXES:
        raise InputError(str(address), "axes", f"must be one of {', '.join(_AXES)}, is '{axes}'")
    return axes


@dataclass
class LoggerMessage:
    """One message: rows by sensor, (n, 4) stamp in s and x, y, z, for ``location`` (n, 8); ``refused`` readings.

    ``android``: a sensor gives its accuracy, which only Android's do.
    """

    number: int
    session: str
    device: str
    rows: dict[str, Floats]
    android: bool = False
    refused: int = 0
    arrival: float = field(default=0.0, compare=False)


def parse_message(body: bytes | str) -> LoggerMessage:
    """A message from its JSON. Raises InputError where it is none; readings with a wrong field are left out and
    counted."""
    data = read_object(body)
    payload, count = data.get("payload"), data.get("messageId")
    if not isinstance(payload, list) or len(payload) > _MOST_READINGS:
        raise InputError("message", "payload", f"not a list of at most {_MOST_READINGS} readings")
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count < 1 << 53:
        raise InputError("message", "messageId", "not a whole number")
    message = LoggerMessage(count, _word(data.get("sessionId")), _word(data.get("deviceId")), {})
    rows: dict[str, list[tuple[float, ...]]] = {}
    for reading in payload:
        row: tuple[float, ...]
        try:
            name = reading["name"].lower()
            if name in _VECTORS:
                values = reading["values"]
                row = (number(values["x"]), number(values["y"]), number(values["z"]))
                if max(map(abs, row)) > _BEYOND:
                    raise ValueError
                message.android |= "accuracy" in reading
            elif name == "location":
                row = _place(reading["values"])
            else:
                continue
            rows.setdefault(name, []).append((_stamp(reading["time"]), *row))
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
            message.refused += 1
    message.rows = {name: np.array(found, dtype=np.float64) for name, found in rows.items()}
    return message


def _word(value: object) -> str:
    """An identifier of the sender's, cut down to what is fit for a name on a terminal."""
    if not isinstance(value, str | int) or isinstance(value, bool):
        return "phone"
    kept = "".join(c for c in str(value)[:64] if c.isascii() and (c.isalnum() or c in "-_"))
    return kept or "phone"


def _stamp(value: object) -> float:
    """s of a time in ns."""
    if isinstance(value, str) and len(value) < 25:
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not _FIRST <= value <= _LAST:
        raise ValueError
    return float(value) * 1e-9


def _place(values: Any) -> tuple[float, ...]:
    """Latitude and longitude must be there, the rest may be missing."""
    found = [number(values["latitude"]), number(values["longitude"])]
    for name in _LOCATION[2:]:
        value = values.get(name)
        found.append(math.nan if value is None else number(value))
    return tuple(found)


class _Turns:
    """Turning about the measured vertical beside that of the course, which tells whether that vertical points up.

    Neither gravity beside accelerations nor gravity beside angular rates does: both laws hold for negated forces too.
    """

    def __init__(self) -> None:
        self._turned, self._last = 0.0, math.nan  # rad, s
        self._course: tuple[float, float, float] | None = (
            None  # s, rad counterclockwise, rad turned until then
        )
        self._sums = np.zeros(3)  # rad²: both together, the course's, the gyroscope's

    def add(self, force: Floats, rows: Mapping[str, Floats]) -> float:
        """Sign of the force (3,) by the rates and places of a message; 0 as long as it is open."""
        size = float(np.linalg.norm(force))
        if size == 0.0:
            return 0.0
        rates, places = rows.get("gyroscope", rows.get("gyroscopeuncalibrated")), rows.get("location")
        if rates is not None:
            rates = rates[np.argsort(rates[:, 0])]
            steps = np.diff(rates[:, 0], prepend=self._last if math.isfinite(self._last) else rates[0, 0])
            self._turned += float(np.clip(steps, 0.0, 0.1) @ (rates[:, 1:] @ force)) / size
            self._last = float(rates[-1, 0])
        for t, *_, speed, bearing in () if places is None else places[np.argsort(places[:, 0])]:
            if not (speed > _COURSE_SPEED and 0.0 <= bearing <= 360.0):
                self._course = None
            elif self._course is None:
                self._course = t, -math.radians(bearing), self._turned
            elif t - self._course[0] >= _COURSE_TIME:
                course = math.remainder(-math.radians(bearing) - self._course[1], 2.0 * math.pi)
                turned = self._turned - self._course[2]
                self._sums += course * turned, course**2, turned**2
                self._course = t, -math.radians(bearing), self._turned
        both, course, turned = self._sums
        sure = course > _COURSE_TURN**2 and abs(both) > _COURSE_AGREES * math.sqrt(course * turned)
        return math.copysign(1.0, both) if sure else 0.0


@dataclass
class _Axes:
    """Finds the sign of accelerometer and gravity: ``sign`` is None until it is known."""

    wanted: str
    name: str
    hub: Hub
    sign: float | None = None
    seen: set[str] = field(default_factory=set)
    in_g: bool = False

    def __post_init__(self) -> None:
        self._certain = False
        self._turns = _Turns()
        self._force = np.zeros(3)

    def look(self, message: LoggerMessage) -> None:
        """Learn from a message."""
        rows = message.rows
        self.seen |= rows.keys()
        if self._certain and not self.in_g:
            return
        if self.wanted != "auto":
            self._decide(IOS_FORCE_SIGN if self.wanted == "ios" else 1.0, "", certain=True)
        raw = rows.get("accelerometeruncalibrated")
        if raw is not None:
            self.in_g = bool(np.median(np.linalg.norm(raw[:, 1:], axis=1)) < 0.3 * STANDARD_GRAVITY)
        for sensor in ("gravity", "accelerometeruncalibrated"):
            if sensor in rows:
                self._force = rows[sensor][:, 1:].mean(axis=0)
                break
        if self._certain:
            return
        if message.android or "totalacceleration" in self.seen or (raw is not None and not self.in_g):
            self._decide(1.0, "", certain=True)
        elif self.in_g:
            self._decide(IOS_FORCE_SIGN, "an iPhone, its accelerometer axes are negated", certain=True)
        elif turned := self._turns.add(self._force, rows):
            negated = "not " if turned > 0.0 else ""
            why = f"its accelerometer axes are {negated}negated: it turns with its course"
            self._decide(turned, why, certain=True)

    def give_up(self) -> None:
        """Nothing has told the platform within the time: a phone is not mounted upside down."""
        if self.sign is None and self._force.any():
            upright = self._upright()
            sign, why = 1.0, ""
            if upright is None:
                why = "lies on its side and is taken for no iPhone until it turns (?axes=ios if it is one)"
            elif not upright:
                sign = IOS_FORCE_SIGN
                why = "gravity lies as iOS has it: taken as an iPhone (?axes=android if it is none)"
            self._decide(sign, why, certain=False)

    def _upright(self) -> bool | None:
        """Whether the axis along gravity points up; None for a phone on its side, which may point either way."""
        axis = int(np.argmax(np.abs(self._force)))
        return None if axis == 0 else bool(self._force[axis] > 0)

    def _decide(self, sign: float, why: str, *, certain: bool) -> None:
        if self.sign is not None and sign != self.sign:
            why = why or "an Android phone: its accelerometer axes are taken as they are"
            self.hub.notify("warn", "axes", f"{self.name}: {why}; before, the other sign was taken")
        elif self.sign is None and why:
            self.hub.notify("ok", "axes", f"{self.name}: {why}")
        self.sign, self._certain = sign, certain


class _Phone:
    """One phone: its messages in their order, its sensors combined."""

    def __init__(self, device: Device, axes: _Axes) -> None:
        self.device = device
        self.axes = axes
        self._session = ""
        self._next = -1
        self._early: dict[int, LoggerMessage] = {}
        self._done: deque[int] = deque(maxlen=256)
        self._undecided: list[LoggerMessage] = []
        self._gravity = np.empty((0, 4))

    def take(self, message: LoggerMessage) -> None:
        """Order by number: the sender's requests may overtake one another."""
        count = message.number
        if message.session != self._session or self._next < 0 or count < self._next - _RECOUNT:
            self.release()
            # A recording that has just begun may have its first messages overtaken.
            self._session, self._next = message.session, 0 if count < _FIRST_OVERTAKEN else count
            self._done.clear()
        if count in self._done or count in self._early:
            self.device.counts["repeated messages"] += 1
        elif count < self._next:
            self._use(message)
        elif count == self._next:
            self._use(message)
            self._follow()
        else:
            self._early[count] = message

    def tick(self, now: float) -> None:
        """Stop waiting for what has not come in time."""
        if self._early and now - min(m.arrival for m in self._early.values()) > _OVERTAKEN:
            first = min(self._early)
            self.device.counts["lost messages"] += first - self._next
            self._next = first
            self._follow()
        if self._undecided and now - self._undecided[0].arrival > _UNDECIDED:
            self._give_up()

    def finish(self) -> None:
        """Hand on all that still waits: nothing more comes."""
        self.release()
        self._give_up()

    def _give_up(self) -> None:
        self.axes.give_up()
        self._go_on()

    def release(self) -> None:
        """Use what still waits."""
        for count in sorted(self._early):
            self._use(self._early[count])
        self._early.clear()

    def _follow(self) -> None:
        while self._next in self._early:
            self._use(self._early.pop(self._next))

    def _use(self, message: LoggerMessage) -> None:
        self._done.append(message.number)
        self._next = max(self._next, message.number + 1)
        self.device.counts["messages"] += 1
        self.device.counts["readings with a wrong field"] += message.refused
        self.axes.look(message)
        self._undecided.append(message)
        if self.axes.sign is not None:
            self._go_on()
        elif not message.rows.keys() & set(_VECTORS):
            self._places(self._undecided.pop())
        elif len(self._undecided) > 500:
            del self._undecided[0]

    def _go_on(self) -> None:
        """Hand on what waited for the sign; without accelerometer and gravity together there is nothing to wait for."""
        if self.axes.sign is None and force_sensors(self.axes.seen):
            return
        waiting, self._undecided = self._undecided, []
        for message in waiting:
            self._vectors(message)
            self._places(message)

    def _vectors(self, message: LoggerMessage) -> None:
        rows, device, arrival = message.rows, self.device, message.arrival
        for sensor in ("gyroscope", "gyroscopeuncalibrated"):
            if sensor in rows:
                device.rate(rows[sensor][:, 0], rows[sensor][:, 1:], arrival, checked=True)
                break
        chosen = force_sensors(self.axes.seen)
        if not chosen:
            if "accelerometer" in rows:
                device.counts["accelerations without gravity"] += len(rows["accelerometer"])
        elif chosen[0] in rows:
            force = rows[chosen[0]].copy()
            if "gravity" in chosen:
                force = self._with_gravity(force, rows.get("gravity"))
            if chosen[0] == "accelerometeruncalibrated" and self.axes.in_g:
                force[:, 1:] *= STANDARD_GRAVITY
            force[:, 1:] *= self.axes.sign or 1.0
            device.force(force[:, 0], force[:, 1:], arrival, checked=True)
        device.flush(arrival, complete=True)

    def _with_gravity(self, linear: Floats, gravity: Floats | None) -> Floats:
        """The sum at the stamps of the linear acceleration; the last gravity of the message before joins in."""
        known = self._gravity if gravity is None else np.concatenate([self._gravity, gravity])
        known = known[np.argsort(known[:, 0], kind="stable")]
        if not len(known):
            return linear[:0]
        self._gravity = known[-1:]
        sums = [linear[:, i] + np.interp(linear[:, 0], known[:, 0], known[:, i]) for i in (1, 2, 3)]
        return np.column_stack([linear[:, 0], *sums])

    def _places(self, message: LoggerMessage) -> None:
        rows = message.rows.get("location")
        if rows is None:
            return
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        t, latitude, longitude, altitude, horizontal, vertical, speed, bearing = rows.T
        self.device.fix(phone_fix(t, latitude, longitude, altitude, horizontal, vertical), message.arrival)
        self.device.course(t, speed, bearing, message.arrival)


class Phones:
    """All phones that send messages to one source. ``only`` is the beginning of the one deviceId to be taken."""

    def __init__(self, hub: Hub, rank: int, *, axes: str = "auto", only: str = "") -> None:
        self._hub, self._rank, self._wanted, self._only = hub, rank, axes, only
        self._phones: dict[str, _Phone] = {}

    def feed(self, body: bytes | str, arrival: float) -> LoggerMessage:
        """Take one message; InputError where it is none."""
        message = parse_message(body)
        message.arrival = arrival
        if not message.device.startswith(self._only):
            return message
        phone = self._phones.get(message.device)
        if phone is None:
            name = f"phone {message.device[:8]}"
            if name in self._hub.devices:
                name = f"phone {message.device}"
            device = self._hub.device(name, rank=self._rank)
            if device is None:
                return message
            self._hub.notify("ok", f"device {device.name}", f"{device.name}: connected")
            axes = _Axes(self._wanted, device.name, self._hub)
            phone = self._phones[message.device] = _Phone(device, axes)
        phone.take(message)
        return message

    def is_spare(self, message: object) -> bool:
        """Whether nothing of the phone that has sent ``message`` is used: another device is in charge."""
        phone = self._phones.get(message.device) if isinstance(message, LoggerMessage) else None
        return phone is not None and phone.device not in self._hub.chosen.values()

    def tick(self, now: float) -> None:
        """Go on without messages that have not come until ``now`` s."""
        for phone in list(self._phones.values()):
            phone.tick(now)

    def finish(self) -> None:
        """Hand on what still waits, of all phones."""
        for phone in list(self._phones.values()):
            phone.finish()

    async def run(self) -> None:
        """Look some times a second for messages that have not come."""
        while True:
            await asyncio.sleep(_TICK)
            self.tick(host_time())
