# SPDX-License-Identifier: Apache-2.0
"""State of the page: the last seconds of its signals, its path, its gap, the health of the nodes.

A thread of the node adds, the thread of the server takes. Everything that leaves is ready for JSON: times in s since
the first sample, SI units, no NaN.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from suspension_twin.signals.spectra import power_density
from suspension_twin.vehicle.twin import Twin

__all__ = ["LiveView", "NodeStatus", "advice", "scene"]

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: Seconds of the signals that are kept, and of those the spectrum is taken over; s between two spectra.
_KEPT, _SPECTRUM, _SPECTRUM_EVERY = 12.0, 10.0, 1.0
#: Segments of the spectrum in s and its highest frequency in Hz.
_SEGMENT, _HIGHEST = 4.0, 50.0
#: A point of the path every so many m, and the number of points kept.
_STEP, _POINTS = 0.5, 6000
#: Samples that wait for their counterpart: 2.5 s at 1.6 kHz.
_UNPAIRED = 4000
#: Stamps of one signal that go back by more than this begin anew, in s: as the nodes reset. Another signal may come
#: later by any time: a slow machine answers long after the pose.
_BACK = 1.0
_DAY = 86_400 * 10**9  # ns
#: Standard deviation of the position in m up to which single bumps lie under the right wheel, and up to which
#: a stretch of road is still the right one.
_GOOD, _FAIR = 0.1, 0.5


@dataclass(frozen=True)
class NodeStatus:
    """Health of a node or of one of its inputs: ``level`` 0 ok, 1 warning, 2 error, 3 stale."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]


def _locked(method: Callable[Concatenate[LiveView, _P], _R]) -> Callable[Concatenate[LiveView, _P], _R]:
    @wraps(method)
    def call(self: LiveView, /, *args: _P.args, **keywords: _P.kwargs) -> _R:
        with self._lock:
            return method(self, *args, **keywords)

    return call


class LiveView:
    """The state of the page. Stamps are ns of the messages."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._scene: dict[str, object] = {}
        self._health: dict[str, NodeStatus] = {}
        self._about: dict[str, object] = {}
        self._origin = 0
        self.clear()

    @_locked
    def clear(self) -> None:
        """Begin anew: the recording was wound to another place, or another one begins."""
        self._t0: int | None = None
        self._newest = 0
        self._last: dict[str, int] = {}  # newest stamp of each signal
        self._rows: dict[str, deque[list[float]]] = {
            "pose": deque(),
            "joints": deque(),
            "measured": deque(),
            "simulated": deque(),
        }
        self._path: deque[list[float]] = deque(maxlen=_POINTS)
        self._events: list[dict[str, object]] = []
        #: By stamp, the signal that came first and its value.
        self._unpaired: dict[int, tuple[str, float]] = {}
        self._squares, self._count, self._last_gap = 0.0, 0, -1.0
        self._spectrum_at = -math.inf
        self._spectrum: dict[str, list[float]] = {}
        self._restart()

    def _restart(self) -> None:
        """The next frame holds everything."""
        self._fresh: dict[str, list[list[float]]] = {name: [] for name in (*self._rows, "path")}
        self._changed: dict[str, object] = {}
        self._restarted = True

    # What a node adds

    @_locked
    def show(self, twin: Twin) -> None:
        """A twin was loaded."""
        self._scene = scene(twin)
        self._restart()

    @_locked
    def count_from(self, ns: int) -> None:
        """Stamp of the first sample of a recording, from which the seconds shown are counted."""
        if ns != self._origin:
            self._origin = ns
            self.clear()

    @_locked
    def pose(self, ns: int, place: Sequence[float], turn: Sequence[float]) -> None:
        """``place`` x, y, z in m and ``turn`` the quaternion x, y, z, w of ``base_link`` in ``map``."""
        if self._keep("pose", ns, [*place, *turn]):
            self._extend_path(place)

    @_locked
    def joints(self, ns: int, positions: Sequence[float]) -> None:
        """Positions of the joints, in the order of the twin's."""
        self._keep("joints", ns, list(positions))

    @_locked
    def measured(self, ns: int, value: float) -> None:
        """Measured vertical acceleration in m/s²."""
        if self._keep("measured", ns, [value]):
            self._pair("measured", ns, value)

    @_locked
    def simulated(self, ns: int, value: float) -> None:
        """Simulated vertical acceleration in m/s²."""
        if self._keep("simulated", ns, [value]):
            self._pair("simulated", ns, value)

    @_locked
    def update(self, name: str, value: object) -> None:
        """Any other value of the page, shown until it changes: ``gap``, ``motion``, ``player``, ``job``, ``record``."""
        value = _finite(value)
        if self._about.get(name) != value:
            self._about[name] = self._changed[name] = value

    @_locked
    def health(self, status: NodeStatus) -> None:
        """The health of a node or of an input, by its name."""
        if self._health.get(status.name) != status:
            self._health[status.name] = status
            self._changed["health"] = self._statuses()

    @_locked
    def mark(self, text: str) -> None:
        """An event at the newest stamp and place."""
        pose = self._rows["pose"]
        event: dict[str, object] = {"t": self._seconds(self._newest), "text": text, "x": None, "y": None}
        if pose:
            event |= {"x": pose[-1][1], "y": pose[-1][2]}
        self._events.append(event)
        self._changed["events"] = self._events

    # What the server takes

    @_locked
    def frame(self) -> dict[str, object]:
        """Changes since the last call, or everything after a restart; empty if there are none."""
        whole = self._restarted
        out: dict[str, object] = {name: rows for name, rows in self._fresh.items() if rows}
        out |= self._changed
        self._restart()
        self._restarted = False
        if whole:
            return self.snapshot()
        now = self._seconds(self._newest)
        if now - self._spectrum_at >= _SPECTRUM_EVERY:
            self._spectrum_at = now
            if spectrum := self._density():
                out["spectrum"] = self._spectrum = spectrum
        return out

    @_locked
    def snapshot(self) -> dict[str, object]:
        """Everything, for a page that was just opened."""
        return {
            "reset": True,
            "scene": self._scene,
            **{name: list(rows) for name, rows in self._rows.items()},
            "path": list(self._path),
            "events": self._events,
            "health": self._statuses(),
            **self._about,
            **({"spectrum": self._spectrum} if self._spectrum else {}),
        }

    # Inner workings

    def _seconds(self, ns: int) -> float:
        return 0.0 if self._t0 is None else (ns - self._t0) / 1e9

    def _keep(self, name: str, ns: int, row: list[float]) -> bool:
        if not all(map(math.isfinite, row)):
            return False
        if ns < self._last.get(name, ns) - _BACK * 1e9:
            self.clear()
        self._last[name] = max(self._last.get(name, ns), ns)
        if self._t0 is None:
            self._t0 = self._origin if self._origin <= ns < self._origin + _DAY else ns
        self._newest = max(self._newest, ns)
        t = self._seconds(ns)
        kept = [round(t, 4), *(round(v, 5) for v in row)]
        rows = self._rows[name]
        rows.append(kept)
        while rows and rows[0][0] < t - _KEPT:
            rows.popleft()
        self._fresh[name].append(kept)
        if len(self._fresh[name]) > 20_000:  # nobody takes it
            del self._fresh[name][:10_000]
        return True

    def _pair(self, name: str, ns: int, value: float) -> None:
        """Compare the two signals of one stamp, whichever comes first."""
        other, first = self._unpaired.pop(ns, (name, value))
        if other != name:
            self._squares += (first - value) ** 2
            self._count += 1
            return
        self._unpaired[ns] = name, value
        if len(self._unpaired) > _UNPAIRED:
            del self._unpaired[next(iter(self._unpaired))]

    def _extend_path(self, place: Sequence[float]) -> None:
        x, y = place[:2]
        if self._path and math.hypot(x - self._path[-1][0], y - self._path[-1][1]) < _STEP:
            return
        if self._count:
            self._last_gap = math.sqrt(self._squares / self._count)
        self._squares, self._count = 0.0, 0
        point = [round(x, 2), round(y, 2), round(self._last_gap, 4)]
        self._path.append(point)
        self._fresh["path"].append(point)
        del self._fresh["path"][:-_POINTS]

    def _statuses(self) -> list[dict[str, object]]:
        return [
            {"name": s.name, "level": s.level, "message": s.message, "values": dict(s.values)}
            for _, s in sorted(self._health.items())
        ]

    def _density(self) -> dict[str, list[float]]:
        """Density of both signals over the last seconds, on a common grid."""
        tables = [np.array(self._rows[name]) for name in ("measured", "simulated")]
        if any(len(table) < 100 for table in tables):
            return {}
        first, last = max(t[0, 0] for t in tables), min(t[-1, 0] for t in tables)
        first = max(first, last - _SPECTRUM)
        rate = 1.0 / float(np.median(np.diff(tables[0][:, 0]))) if len(tables[0]) > 1 else 0.0
        if last - first < _SEGMENT or not math.isfinite(rate) or rate <= 0:
            return {}
        grid = np.arange(first, last, 1.0 / rate)
        signals = np.column_stack([np.interp(grid, t[:, 0], t[:, 1]) for t in tables])
        f, density = power_density(signals, rate, _SEGMENT)
        shown = (f >= 0.5) & (f <= min(_HIGHEST, 0.45 * rate))
        columns = f[shown], density[shown, 0], density[shown, 1]
        names = "f", "measured", "simulated"
        return {n: [float(f"{v:.4g}") for v in c] for n, c in zip(names, columns, strict=True)}


def _finite(value: object) -> object:
    """The value with None for every number that JSON cannot say."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return value


def scene(twin: Twin) -> dict[str, object]:
    """Geometry of the vehicle for the picture in 3D: wheels with their joints, sensors, and names."""
    joints = twin.joints
    return {
        "name": twin.vehicle.name,
        "model": twin.model,
        "effects": [e.id for e in twin.effects],
        "road": twin.road is not None,
        "imu": list(twin.imu.position),
        "gps": list(twin.gps.position),
        "wheels": [
            {
                "name": joint.name.removesuffix("_suspension").replace("_", " "),
                "kind": joint.kind,
                "origin": list(joint.origin),
                "axis": list(joint.axis),
                "wheel": list(joint.wheel),
                "standing": joint.standing,
                "radius": joint.radius,
                "width": joint.width,
            }
            for joint in joints
        ],
    }


def advice(sigma: float, on_road: bool) -> tuple[int, str]:
    """Level and words on what can be concluded with a position known to ``sigma`` m (standard deviation).

    The limits are those of the wheel on the road: a bump is some decimetres long, and position errors of some
    centimetres alone make the gap two or three times the residual of a calibration.
    """
    if not on_road:
        return 1, (
            "The twin file names no road: the twin drives on a plane. Its motion from braking and cornering is right, "
            "bumps are missing, and the gap is that of the whole road. Do not calibrate on this."
        )
    if not math.isfinite(sigma):
        return 1, "The position is not known yet: drive a few metres with a view of the sky."
    if sigma <= _GOOD:
        return 0, f"Position known to {sigma:.2f} m: bumps lie under the right wheel. Good for a calibration."
    if sigma <= _FAIR:
        return 1, (
            f"Position known to {sigma:.2f} m only: long waves and the spectrum hold, single bumps come early or late. "
            "A calibration finds the place of each pass over a bump by what is felt."
        )
    return 1, (
        f"Position known to {sigma:.1f} m only, as from a phone without RTK: a calibration finds the place of each "
        "pass over a bump by what is felt. Two passes or more cost nothing against RTK, a single one a quarter of the "
        "gap; on a road without bumps it cannot. Live, a bump comes early or late."
    )
