# SPDX-License-Identifier: Apache-2.0
"""A reality that nobody simulated: recordings of real cars, with faults put into their samples and stamps.

Two recordings of other people (``shared/data/SOURCES.md``): rtklibexplorer's car with a roof IMU and an RTK receiver,
its documented clock errors corrected, and comma2k19's example, a device on a windshield. What is wrong with a sensor, a
clock, a mounting or a receiver acts on recorded samples as it would have acted in the car; what is wrong with a car
does not, so that it is not here. There is no road, so that planar motion alone is compared.

The same faults can be put into what a simulated reality has recorded, whose twin file then names no road either.

The severity of a fault is what it changes of the planar IMU signals less those of the path by the fixes, in multiples
of what the sound recording leaves of the same; on both sides what biases and a leaning body can explain is taken off.
None of this is the package's: its own comparison decides nothing about a case.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from road_real_drives import phone_car, rtk_car
from scipy.interpolate import CubicSpline
from scipy.optimize import lsq_linear
from scipy.signal import butter, lfilter, sosfiltfilt
from scipy.spatial.transform import Rotation

from blind import ROOT
from blind.faults import Null, knob
from blind.newton import Faults
from blind.phone import lost_time
from blind.plan import MEASURED, Spec
from blind.score import PLAIN
from blind.world import Floats, G, make_world
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.types import Drive, cut
from suspension_twin.drive.write import write_drive
from suspension_twin.vehicle.twin import Twin, parse_twin, save_twin

CHANNELS = ("longitudinal", "lateral", "yaw_rate")
_EARTH = 6_371_000.0  # m
#: s of each drive at least and at most, by recording.
_LENGTH = {"rtklibexplorer": (55.0, 100.0), "comma2k19": (26.0, 33.0)}
#: Share of the cases that are from the windshield, if its minute can show the fault.
_QUARTER = 0.25
_GRID = 20.0  # Hz
_SLOW = 3.0  # m/s: slower than this a path has no course
#: Largest biases (m/s², m/s², rad/s) and shares of an acceleration by which a leaning body adds gravity to it.
_BIAS, _LEAN = (0.1, 0.1, 0.01), (0.05, 0.15)
_SMOOTHEST = 0.2  # Hz, of heights


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording as its owner would hand it in, and the twin file that he would write."""

    name: str
    drive: Drive
    twin: Twin


def data_folder() -> Path:
    """Where measured data lies; SystemExit where it does not."""
    given = os.environ.get("SUSPENSION_TWIN_DATA")
    folder = Path(given) if given else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        raise SystemExit(f"{folder} is not there: name the folder of measured data in SUSPENSION_TWIN_DATA")
    return folder


@lru_cache(maxsize=2)
def recording(name: str) -> Recording:
    """One of the recordings, its known clock errors corrected."""
    folder, mappings = data_folder(), ROOT / "config" / "import"
    if name == "rtklibexplorer":
        source, mapping = folder / "rtklibexplorer_GNSS_IMU", mappings / "rtklibexplorer_gnss_imu.yaml"
        drive = import_drive([source], mapping=mapping).drive
        return Recording(name, drive, rtk_car(drive))
    drive = import_drive([folder / "comma2k19_Example_1"], mapping=mappings / "comma2k19.yaml").drive
    twin = phone_car(drive)
    return Recording(name, drive, _mounted(drive, twin))


def _mounted(drive: Drive, twin: Twin) -> Twin:
    """The twin with the sensor's mounting as its owner would find it from the whole drive: the turn that brings what
    was felt nearest to gravity and the path's accelerations (Wahba's problem)."""
    t, path = _path(drive)
    felt = _at(drive, t)[:, :3]
    wanted = np.column_stack([path[:, :2], np.full(t.size, G)])
    good = path[:, 3] > _SLOW
    turn = Rotation.align_vectors(wanted[good], felt[good])[0]
    roll, pitch, yaw = (round(float(a), 4) for a in turn.as_euler("xyz"))
    return twin.model_copy(update={"imu": twin.imu.model_copy(update={"rpy": (roll, pitch, yaw)})})


# --- faults


def spoiled(drive: Drive, rpy: tuple[float, float, float], faults: Faults, seed: int) -> Drive:
    """The drive as it would have been recorded with the faults, in the order of the chain: mounting, converter,
    filter, driver, clock, receiver. ``rpy`` is the mounting of the twin file."""
    imu = drive.imu
    t, force, rate = imu.t.copy(), imu.specific_force.copy(), imu.angular_rate.copy()
    mount = Rotation.from_euler("xyz", rpy)
    if "sensor_tilt" in faults:
        turn = Rotation.from_euler("xyz", [faults["sensor_tilt"][a] for a in ("roll", "pitch", "yaw")])
        force, rate = (mount.apply(turn.inv().apply(mount.apply(v)), inverse=True) for v in (force, rate))
    if "vibration_rectification" in faults:
        calm = np.median(force, axis=0)
        force = force + faults["vibration_rectification"]["square"] * (force - calm) ** 2
    force = force * (1.0 + faults.get("sensor_scale", {}).get("scale", 0.0))
    rate = rate * (1.0 + faults.get("gyro_gain", {}).get("gain", 0.0))
    if "held_samples" in faults:
        every = 1.0 / faults["held_samples"]["rate"]
        held = np.searchsorted(t, t[0] + np.floor((t - t[0]) / every) * every, side="right") - 1
        force, rate = force[np.maximum(held, 0)], rate[np.maximum(held, 0)]
    drift = 1e-6 * faults.get("clock_drift", {}).get("drift_ppm", 0.0)
    stamps = t + drift * (t - t[0]) + faults.get("time_offset", {}).get("offset", 0.0)
    kept = np.ones(t.size, dtype=np.bool_)
    if "compressed_time" in faults:
        early, gone = lost_time(faults["compressed_time"], t - t[0], seed)
        stamps, kept = stamps - early, ~gone
    whole = replace(imu, t=stamps, specific_force=force, angular_rate=rate)
    return _received(replace(drive, imu=whole.select(kept)), faults, seed)


def _received(drive: Drive, faults: Faults, seed: int) -> Drive:
    """What a receiver with a fault makes of the fixes."""
    fix, velocity = drive.fix, drive.velocity
    at = np.column_stack([fix.latitude, fix.longitude])
    scale = np.radians(_EARTH) * np.array([1.0, np.cos(np.radians(at[0, 0]))])
    moved, step = (at - at[0]) * scale, float(np.median(np.diff(fix.t)))
    if "receiver_multipath" in faults:
        # reflections: an error that wanders, of first order
        own = faults["receiver_multipath"]
        memory = np.exp(-step / own["time"])
        noise = np.random.default_rng([seed, 21]).standard_normal(moved.shape)
        wander = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], noise, axis=0)
        moved = moved + own["sigma"] * _even(wander, step)
    if "receiver_smoothing" in faults:
        # a receiver that thinks it is carried by a ship: fixes that lag behind and cut corners
        memory = np.exp(-step / faults["receiver_smoothing"]["time"])
        moved = lfilter([1.0 - memory], [1.0, -memory], moved, axis=0, zi=memory * moved[:1])[0]
    if "held_fixes" in faults:
        # between buildings the last fix is handed out again
        own = faults["held_fixes"]
        since = fix.t - fix.t[0]
        held = np.where(since % own["every"] < own["seconds"], since - since % own["every"], since)
        moved = moved[np.searchsorted(since, held, side="right") - 1]
    change = moved / scale + at[0] - at
    if not np.any(change):
        return drive
    turned = np.gradient(change * scale, fix.t, axis=0)
    east = np.column_stack([np.interp(velocity.t, fix.t, turned[:, i]) for i in (1, 0)])
    enu = velocity.enu + np.column_stack([east, np.zeros(len(velocity))])
    return replace(
        drive,
        fix=replace(fix, latitude=fix.latitude + change[:, 0], longitude=fix.longitude + change[:, 1]),
        velocity=replace(velocity, enu=enu),
    )


def _even(wander: Floats, step: float) -> Floats:
    """(n, 2) through a low-pass at a sixth of the fixes' rate: reflections do not jump from fix to fix."""
    sos = butter(2, 0.16 / step, fs=1.0 / step, output="sos")
    return np.asarray(sosfiltfilt(sos, wander, axis=0))


def turned_by(effect: str, seed: int) -> Callable[[float], dict[str, float]]:
    """Parameters of a fault by amount 0 to 1."""
    rng = np.random.default_rng([seed, sum(effect.encode())])
    a, sign = float(rng.uniform(0, 1)), float(rng.choice([-1.0, 1.0]))
    own: Mapping[str, Callable[[float], dict[str, float]]] = {
        # beyond it the reading of gravity alone is refused
        "sensor_scale": lambda s: {"scale": 0.3 * s * sign},
        "gyro_gain": lambda s: {"gain": 0.5 * s * sign},
        "receiver_multipath": lambda s: {"sigma": 15.0 * s, "time": 3.0 + 6.0 * a},
        "receiver_smoothing": lambda s: {"time": 2.5 * s},
        "held_fixes": lambda s: {"seconds": 6.0 * s, "every": 8.0 + 8.0 * a},
    }
    if effect in own:
        return own[effect]
    turn = knob(effect, None, seed, True)  # type: ignore[arg-type]  # of a sensor: no car is asked
    return lambda s: turn(s, Null(0.0, 0.0, G, 0.0))


# --- severity


def _path(drive: Drive) -> tuple[Floats, Floats]:
    """Times (n,) s, and (n, 4) of the path: acceleration along and across in m/s², yaw rate in rad/s, speed in m/s.
    Along the road the slope of a hill times gravity is in it, as an accelerometer has that, too."""
    fix = drive.fix
    good = (fix.status >= 0) & np.isfinite(fix.latitude + fix.longitude)
    t, height = fix.t[good], fix.altitude[good]
    scale = np.radians(_EARTH) * np.array([np.cos(np.radians(fix.latitude[good][0])), 1.0])
    place = np.column_stack([fix.longitude[good], fix.latitude[good]])
    place = (place - place[0]) * scale
    first, last = max(t[0], drive.imu.t[0]), min(t[-1], drive.imu.t[-1])
    grid = np.arange(first, last, 1.0 / _GRID)
    place = _smooth(np.asarray(CubicSpline(t, place)(grid)), _cutoff(drive))
    velocity = np.gradient(place, grid, axis=0)
    speed = np.hypot(*velocity.T)
    quick = speed > _SLOW
    if not quick.any():
        raise ValueError(f"{drive.name}: never faster than {_SLOW:g} m/s, so that its path has no course")
    yaw = np.unwrap(np.arctan2(velocity[quick, 1], velocity[quick, 0]))
    turn = np.gradient(_smooth(np.interp(grid, grid[quick], yaw), _cutoff(drive)), grid)
    climb = np.gradient(_smooth(np.interp(grid, t, height), _SMOOTHEST), grid)
    slope = np.where(quick, climb / np.maximum(speed, _SLOW), 0.0)
    return grid, np.column_stack([np.gradient(speed, grid) + G * slope, speed * turn, turn, speed])


def _cutoff(drive: Drive) -> float:
    """Hz up to which fixes show an acceleration: eight to a period."""
    return min(0.8, 0.125 / float(np.median(np.diff(drive.fix.t))))


def _smooth(values: Floats, cutoff: float) -> Floats:
    sos = butter(2, cutoff, fs=_GRID, output="sos")
    return np.asarray(sosfiltfilt(sos, values, axis=0))


def _at(drive: Drive, t: Floats) -> Floats:
    """(n, 6) specific force and rate at times, as slow as the path."""
    both = np.hstack([drive.imu.specific_force, drive.imu.angular_rate])
    order = np.argsort(drive.imu.t, kind="stable")
    stamps = drive.imu.t[order]
    total = np.vstack([np.zeros(6), np.cumsum(both[order][1:] * np.diff(stamps)[:, None], axis=0)])
    half = 0.5 / _GRID  # means over a step of the grid: nothing is folded down
    ends = [np.stack([np.interp(t + d, stamps, c) for c in total.T], axis=1) for d in (half, -half)]
    return _smooth((ends[0] - ends[1]) * _GRID, _cutoff(drive))


def planar(drive: Drive, rpy: tuple[float, float, float]) -> tuple[Floats, Floats, Floats]:
    """Times (n,), what the IMU has felt less what the path says (n, 3), and the path (n, 4)."""
    t, path = _path(drive)
    felt = _at(drive, t)
    mount = Rotation.from_euler("xyz", rpy)
    own = np.column_stack([mount.apply(felt[:, :3])[:, :2], mount.apply(felt[:, 3:])[:, 2]])
    return t, own - path[:, :3], path


def remaining(difference: Floats, path: Floats) -> Floats:
    """(n, 3) what biases and a leaning body leave of a difference."""
    out = difference.copy()
    for c in range(3):
        columns, most = [np.ones(len(path))], [_BIAS[c]]
        if c < 2:
            columns.append(path[:, c])
            most.append(_LEAN[c])
        a, b = np.column_stack(columns), np.array(most)
        out[:, c] -= a @ lsq_linear(a, difference[:, c], (-b, b)).x
    return out


@dataclass(frozen=True, eq=False)
class Floor:
    """What a sound drive leaves: ``rms`` (3,) m/s², m/s², rad/s."""

    drive: Drive
    rpy: tuple[float, float, float]
    rms: Floats

    @classmethod
    def of(cls, drive: Drive, rpy: tuple[float, float, float]) -> Floor:
        """Of a drive without a fault."""
        _, difference, path = planar(drive, rpy)
        used = _used(path)
        left = remaining(difference[used], path[used])
        return cls(drive, rpy, np.sqrt(np.mean(left**2, axis=0)))

    def severity(self, faults: Faults, seed: int) -> float:
        """Largest ratio over the channels of what the faults add."""
        t, before, path = planar(self.drive, self.rpy)
        when, after, _ = planar(spoiled(self.drive, self.rpy, faults, seed), self.rpy)
        here = _used(path) & (t >= when[0]) & (t <= when[-1])
        change = np.stack([np.interp(t, when, c) for c in after.T], axis=1) - before
        left = remaining(change[here], path[here])
        return float(np.max(np.sqrt(np.mean(left**2, axis=0)) / self.rms))


def _used(path: Floats) -> Any:
    """(n,) on the move, off the ends."""
    quick = path[:, 3] > _SLOW
    margin = round(1.5 * _GRID)
    quick[:margin] = quick[-margin:] = False
    return quick


def found(effect: str, wanted: float, floor: Floor, seed: int) -> tuple[dict[str, float], float, float]:
    """Parameters of a severity, the amount and the severity that they have."""
    turn = turned_by(effect, seed)
    amounts = np.geomspace(1e-3, 1.0, 10)
    curve = np.maximum.accumulate(
        [max(floor.severity({effect: turn(float(a))}, seed), 1e-6) for a in amounts]
    )
    if wanted >= curve[-1]:
        amount = 1.0
    else:
        rising = curve + 1e-9 * np.arange(curve.size)
        amount = float(np.exp(np.interp(np.log(wanted), np.log(rising), np.log(amounts))))
    values = {k: float(v) for k, v in turn(amount).items()}
    return values, amount, floor.severity({effect: values}, seed)


# --- cases


def parts(name: str, seed: int) -> dict[str, tuple[float, float]]:
    """(start, end) s after the first sample of a recording of each drive of a case, one after the other."""
    rng = np.random.default_rng([seed, 31])
    names = ["reference", "drive_a", "drive_b", "sealed"]
    if name == "comma2k19":  # a minute: what is sealed is the reference with the faults
        names = ["sealed", "drive_a"]
    t = recording(name).drive.imu.t
    lengths, whole = rng.uniform(*_LENGTH[name], len(names)), float(t[-1] - t[0])
    lengths *= min(1.0, whole / lengths.sum())
    gaps = (whole - lengths.sum()) * rng.dirichlet(np.ones(len(names) + 1))
    out, at = {}, 0.0
    for part, length, gap in zip(names, lengths, gaps, strict=False):
        out[part] = (at + gap, at + gap + length)
        at += gap + length
    out.setdefault("reference", out["sealed"])
    return out


def _pieces(name: str, seed: int) -> dict[str, Drive]:
    whole = recording(name).drive
    start = float(whole.imu.t[0])
    return {n: replace(cut(whole, start + a, start + b), name=n) for n, (a, b) in parts(name, seed).items()}


def _simulated(spec: Spec) -> tuple[str, dict[str, Drive], Twin]:
    """Drives of a simulated reality without a fault, and the twin file of its user, who has no road."""
    from blind import phone
    from blind.folder import RUN, twin_file

    world = make_world(spec.world)
    drives = {
        part: phone.record(world, plan, RUN[spec.reality](world, plan, {}), {}, part)
        for part, plan in world.plans.items()
    }
    return spec.reality, drives, parse_twin(twin_file(world, spec))


def _sources(spec: Spec) -> Iterator[tuple[str, dict[str, Drive], Twin]]:
    """Where a case may be from: its name, drives without a fault, and the twin file."""
    if spec.reality != MEASURED:
        yield _simulated(spec)
        return
    rng = np.random.default_rng([spec.world, 32])
    for name in ("comma2k19", "rtklibexplorer") if rng.random() < _QUARTER else ("rtklibexplorer",):
        yield name, _pieces(name, spec.world), recording(name).twin


@dataclass(frozen=True, eq=False)
class _Faulted:
    """What a case is made from: drives without a fault, the faults, and what severity they reach."""

    source: str
    pieces: dict[str, Drive]
    twin: Twin
    floor: Floor
    faults: Faults
    reached: dict[str, dict[str, float]]

    @classmethod
    def of(cls, spec: Spec, source: str, pieces: dict[str, Drive], twin: Twin) -> _Faulted:
        """The faults of a case in drives of one source, as severe as they can be there."""
        floor = Floor.of(pieces["drive_fast" if "drive_fast" in pieces else "drive_a"], twin.imu.rpy)
        faults: Faults = {}
        reached = {}
        for effect in spec.effects:
            faults[effect], amount, has = found(effect, spec.severity, floor, spec.world)
            reached[effect] = {"amount": round(amount, 6), "severity": round(has, 3)}
        return cls(source, pieces, twin, floor, faults, reached)

    @property
    def shown(self) -> bool:
        """Whether every fault has to be found."""
        return min((r["severity"] for r in self.reached.values()), default=PLAIN) >= PLAIN


def make_case(spec: Spec, cases: Path, sealed: Path) -> dict[str, Any]:
    """Write the case's folder under ``cases`` and its further drive under ``sealed``; return the label.

    ValueError where no source can show the fault.
    """
    own = next((c for c in (_Faulted.of(spec, *source) for source in _sources(spec)) if c.shown), None)
    if own is None:
        raise ValueError(f"{' and '.join(spec.effects)} cannot be shown by what is recorded")
    folder = cases / spec.name
    folder.mkdir(parents=True)
    drives: dict[str, Any] = {}
    for part, piece in own.pieces.items():
        if part == "reference" and not spec.reference:
            continue
        drive = piece if part == "reference" else spoiled(piece, own.twin.imu.rpy, own.faults, spec.world)
        write_drive(drive, (sealed / spec.name if part == "sealed" else folder) / part)
        drives[part] = {
            "start": round(float(drive.imu.t[0]), 3),
            "seconds": round(float(drive.imu.t[-1] - drive.imu.t[0]), 3),
        }
    save_twin(own.twin, folder / "twin.yaml")
    if spec.without:
        (folder / "request.json").write_text(json.dumps({"without": list(spec.without)}) + "\n")
    return {
        **asdict(spec),
        "faults": own.faults,
        "reached": own.reached,
        "stretch": None,
        "frequency": [],
        "drives": drives,
        "source": own.source,
        "floor": {c: float(f"{v:.4g}") for c, v in zip(CHANNELS, own.floor.rms, strict=True)},
    }


def planar_gap(sealed: Path, twin: Path, channel: str) -> float:
    """Rms of a planar channel's difference on a sealed drive above the noise, by the package: of the twin, with nothing
    fitted."""
    from suspension_twin.diagnosis.case import build, read_case
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.shrink import uncalibrated_residual

    case = read_case(DiagnosisRequest(str(twin), (str(sealed),)), lambda note: None, lambda: False)
    bench = build(case, lambda: False)
    c = bench.channels.index(channel)
    left = uncalibrated_residual(bench).difference[:, c]
    noise = case.drives[0].noise_rms[channel]
    return math.sqrt(max(float(np.mean(left**2)) - noise**2, 0.0))
