# SPDX-License-Identifier: Apache-2.0
"""Where the samples of all sources meet: one device for each stream, one time base, one bounded queue.

Sources fill it on the thread of their event loop; a node, a recorder or a terminal takes from it on its own.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from suspension_twin.addons.sources.common.clock import ArrivalClock, host_time
from suspension_twin.addons.sources.common.device import STREAMS, Device, Stream
from suspension_twin.addons.sources.common.motion import MotionLag, MotionShift
from suspension_twin.drive.types import ImuData, Samples, VelocityData
from suspension_twin.signals.checks import Finding

__all__ = ["Hub", "Packet"]

#: Samples that wait at most: 50 s of a phone at 400 Hz, 12 s of an IMU at 1600 Hz.
_LIMIT = 20_000
_DEVICES = 16
_SAID = 200
#: s in which the same warning is given once.
_REPEAT = 10.0
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
    """What is added to the stamps of one clock; follows its target slowly."""

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
        self._said: deque[Finding] = deque(maxlen=_SAID)
        self._told: dict[str, float] = {}
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
                self.say(
                    "warn", "too many devices", f"{name}: not taken, there are {_DEVICES} devices already"
                )
                return None
            found = Device(self, name, rank=rank, epoch=epoch)
            self.devices[name] = found
        return found

    def say(self, level: Literal["ok", "warn", "error"], code: str, text: str) -> None:
        """An event for the user; ``code`` names its kind. A warning that was just given is not repeated."""
        if level != "ok":
            now = host_time()
            if now - self._told.get(text, -math.inf) < _REPEAT:
                return
            if len(self._told) >= _SAID:
                self._told.clear()
            self._told[text] = now
        self._said.append(Finding(level, code, text))
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

    def heard(self) -> list[Finding]:
        """What is to be told to the user, since the last call."""
        found = []
        while self._said:
            found.append(self._said.popleft())
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
                self.say(
                    "warn", "second device", f"{device.name}: its {stream} is not used, {other.name} gives it"
                )
            return False
        if other is not None:
            why = f" after {silent:.0f} s of silence" if silent >= _SUCCESSION else ""
            self.say(
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
        """What to add to stamps of ``clock``: it brings them into the time base."""
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
            self.say("warn", "clock corrected", f"{device.name}: its stamps are moved by {jump:+.3f} s")
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
