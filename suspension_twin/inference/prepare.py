# SPDX-License-Identifier: Apache-2.0
"""From a recorded drive to what a twin is compared with, ready to simulate.

Everything that does not depend on the candidate is done here once: the IMU in ``base_link``
axes, the locked pose, the road under the wheels, the filtered measured channels and their floors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.inference.gap import CHANNELS, Gap, measure_gap
from suspension_twin.inference.imu_gnss_consistency import clock_offset_beyond, findings, yaw_beyond
from suspension_twin.inference.mounting import (
    ahead_of,
    clock_offset_of,
    gain_at_rest,
    gain_of,
    heading_off,
    mounting_error,
    regained,
    turn_of,
    turned,
    without_clock_offset,
)
from suspension_twin.inference.noise_floor import floor_rms
from suspension_twin.inference.off_road import Ground, OffRoad, off_road
from suspension_twin.inference.planar_denoising import denoised_motion
from suspension_twin.models.excitation import excitation
from suspension_twin.models.hooks import clocks_with, upright_with
from suspension_twin.models.types import Excitation, Response
from suspension_twin.pose.satellites import satellite_motion
from suspension_twin.pose.smoothed import MAX_MEAN_SLOPE, locked_trajectory, mean_tilt
from suspension_twin.pose.types import Trajectory
from suspension_twin.road.origin import warning_of
from suspension_twin.road.road import Outside, Road
from suspension_twin.signals.attitude import level_rpy
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.signals.ingest import ImuSettings
from suspension_twin.signals.offline import ImuSignals, ingest_drive
from suspension_twin.vehicle.twin import Datum, Twin

__all__ = [
    "PrepareSettings",
    "Prepared",
    "prepare",
    "reclocked_excitation",
    "regained_excitation",
    "turned_excitation",
    "upright_excitation",
]

#: The path that shows how a sensor is turned is made with its signals: each pass leaves a fifth of what was wrong.
_TURNS = 3


@dataclass(frozen=True)
class PrepareSettings:
    """``filter`` for both sides, zero-phase offline; ``max_step`` s of the simulation; ``quiet`` takes the
    IMU's noise out of the planar motion that drives it; ``outside`` what a drive gets that leaves the road:
    hold, zero, error, or what the road's file says; ``satellites`` takes the planar motion from the fixes alone,
    for where the IMU itself is what is asked about; ``saturated`` compares what was read at the end of the sensor's
    range as well: what a range has cut off shows nowhere else."""

    filter: FilterSpec = FilterSpec()
    max_step: float = 1e-3
    quiet: bool = True
    outside: Outside = "road"
    satellites: bool = False
    saturated: bool = False
    imu: ImuSettings = field(default_factory=ImuSettings)


@dataclass(frozen=True, eq=False)
class Prepared:
    """One drive, or a part of one, ready for comparison.

    Parameters
    ----------
    name : str
        Of the drive.
    twin : Twin
        The twin it was prepared for.
    road : Road
        The road.
    settings : PrepareSettings
        How it was prepared.
    signals : ImuSignals
        On the n kept IMU stamps, unfiltered, ``base_link`` axes.
    trajectory : Trajectory
        On the same stamps.
    excitation : Excitation
        On the same stamps.
    conditioner : Conditioner
        To the uniform grid of m samples on which everything below is given.
    measured : dict of str to (m,) array
        Filtered measured channels.
    noise_rms : dict of str to float
        Noise floor of each channel.
    speed : (m,) array
        m/s.
    position : (m,) array
        m of ``base_link`` along the road, or along the path without a road.
    along : (m,) array
        Its rate in m/s.
    inside : (m,) array of bool
        All wheels have a road under them.
    mask : (m,) array of bool
        A comparison is meaningful.
    position_sigma : float
        The receiver's own horizontal standard deviation in m, 0 where it gives none.
    warnings : tuple of str
        What was found while preparing.
    off_road : OffRoad
        Where the drive leaves the road, and the policy there.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.models.simulate import simulate_twin
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = load_twin("bags/crg_road/twin.yaml")
    >>> prepared = prepare(read_drive("bags/crg_road"), twin)
    >>> gap = prepared.gap(prepared.condition(simulate_twin(twin, prepared.excitation)))
    >>> bool(gap.rms > gap.noise_rms)
    True
    """

    name: str
    twin: Twin
    road: Road
    settings: PrepareSettings
    signals: ImuSignals
    trajectory: Trajectory
    excitation: Excitation
    conditioner: Conditioner
    measured: dict[str, Floats]
    noise_rms: dict[str, float]
    speed: Floats
    position: Floats
    along: Floats
    inside: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    position_sigma: float = 0.0
    warnings: tuple[str, ...] = ()
    off_road: OffRoad = OffRoad()

    @property
    def t(self) -> Floats:
        """(m,) s, the grid of every conditioned signal."""
        return self.conditioner.grid

    @property
    def rate(self) -> float:
        """Samples per second of the grid."""
        return self.conditioner.rate

    @property
    def bandwidth(self) -> float:
        """Cut-off in Hz of the low-pass that both sides go through."""
        return self.settings.filter.cutoff

    def condition(self, response: Response) -> dict[str, Floats]:
        """The simulated counterpart (m,) of every measured channel, through the same filter.

        What the simulated sensor shows standing still is taken off its vertical, as it is off the recorded one's: a
        gain multiplies gravity too, and a tilt loses a part of it.
        """
        stacked = np.stack([_channel(response, name) for name in CHANNELS], axis=1)
        stacked[:, CHANNELS.index("vertical_acceleration")] -= self.standing_vertical(response)
        filtered = self.conditioner.apply(stacked)
        return {name: filtered[:, i] for i, name in enumerate(CHANNELS)}

    def standing_vertical(self, response: Response) -> float:
        """m/s² that the simulated sensor shows as its vertical while the vehicle stands; 0 where it never does: the
        mean of a part on the move is motion too."""
        standing = self.signals.standing
        return float(response.vertical_acceleration[standing].mean()) if standing.any() else 0.0

    def gap(self, simulated: Mapping[str, Floats]) -> Gap:
        """The gap to conditioned channels, over every sample that can be compared."""
        return measure_gap(
            self.measured, simulated, self.mask, self.rate, self.noise_rms["vertical_acceleration"]
        )

    def part(self, start: float, end: float) -> Prepared:
        """The samples with stamps between ``start`` and ``end`` s, with a grid of their own."""
        first, last = np.searchsorted(self.signals.t, [start, end])
        if last - first < 16:
            raise InputError(
                self.name, f"{last - first} samples between {start:.2f} and {end:.2f} s are too few"
            )
        cut = slice(int(first), int(last))
        return _assemble(
            self.name,
            self.twin,
            self.road,
            self.settings,
            _cut(self.signals, cut),
            _cut(self.trajectory, cut),
            known=self,
        )

    def moved(self, seconds: float, metres: float) -> Prepared:
        """The same drive with the pose read ``seconds`` later and the map taken ``metres`` back along
        its own direction: what a clock offset and a shifted map mean, simulated instead of interpolated."""
        path = self.trajectory
        t = path.t
        later = np.clip(t + seconds, t[0], t[-1])
        columns = {
            f.name: np.interp(later, t, getattr(path, f.name))
            for f in fields(Trajectory)
            if f.name not in ("t", "valid")
        }
        if metres:
            with np.errstate(invalid="ignore"):
                sense = np.sign(np.gradient(self.road.xy_to_uv(path.x, path.y)[0], t))
            columns["x"] = columns["x"] + metres * sense * np.cos(columns["yaw"])
            columns["y"] = columns["y"] + metres * sense * np.sin(columns["yaw"])
        moved = replace(path, **columns)
        return _assemble(
            self.name,
            self.twin,
            self.road,
            self.settings,
            self.signals,
            moved,
            known=self,
        )


def prepare(
    drive: Drive,
    twin: Twin,
    road: Road | None = None,
    settings: PrepareSettings | None = None,
    strict: bool = False,
) -> Prepared:
    """Prepare a drive for comparison with a twin: everything that does not depend on the candidate,
    computed once.

    Parameters
    ----------
    drive : Drive
        The recording.
    twin : Twin
        Places of the sensors, datum, geometry.
    road : Road, optional
        The road; that of the twin file by default.
    settings : PrepareSettings, optional
        Filter, step, policy beyond the road's borders.
    strict : bool
        Refuse signals that must not be used for calibration (an IMU upside down, too slow, dead).

    Returns
    -------
    Prepared
        Locked pose, excitation, filtered measured channels and their noise floors.

    Raises
    ------
    InputError
        Naming the drive and what it lacks.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> prepared = prepare(read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml"))
    >>> sorted(prepared.measured)[0]
    'lateral_acceleration'
    """
    settings = settings or PrepareSettings()
    if road is None:
        road = road_of(twin)
    about = None if twin.road is None or road.name != twin.road.file.name else warning_of(twin.road.file)
    signals = ingest_drive(drive, twin.imu, settings.imu)
    # a known clock offset is taken off the stamps before IMU and receiver are fused
    late = 0.0 if settings.satellites else clock_offset_of(twin)
    timed = without_clock_offset(drive, late)
    same = settings.satellites or (not late and turn_of(twin) is None and gain_of(twin) == 1.0)
    mounted = signals if same else _read(timed, twin, gain_of(twin), settings)
    datum = twin.datum or _first_fix(drive)
    noticed = [*mounted.findings, *findings(timed, mounted, twin.gps, datum)]
    if strict:
        for finding in noticed:
            if finding.level == "error":
                raise InputError(drive.name, "imu", finding.text)
    if settings.satellites:
        slow = satellite_motion(drive, signals, twin.gps, datum)
        turn = turn_of(twin) or mounting_error(*slow)
        signals, trajectory = satellite_motion(drive, signals, twin.gps, datum, ahead_of(turn))
    else:
        try:
            trajectory = _locked(timed, twin, mounted, settings, datum, _upright(twin))
            trajectory = replace(trajectory, t=signals.t) if late else trajectory
        except InputError as error:
            raise error if str(error).startswith(drive.name) else InputError(drive.name, str(error)) from None
    warnings = (*drive.warnings, *(f.text for f in noticed if f.level != "ok"))
    prepared = _assemble(drive.name, twin, road, settings, signals, trajectory, late=late)
    left = prepared.off_road.sentence(float(signals.t[0]))
    warnings = (*warnings, *(text for text in (left, about) if text))
    return replace(prepared, position_sigma=_position_sigma(drive), warnings=warnings)


def _upright(twin: Twin) -> bool:
    return upright_with(e.id for e in twin.effects)


def _locked(
    drive: Drive, twin: Twin, signals: ImuSignals, settings: PrepareSettings, datum: Datum, upright: bool
) -> Trajectory:
    trajectory = locked_trajectory(drive, signals, twin.gps, datum, signals.t, upright=upright)
    return denoised_motion(trajectory, signals, twin.cog_height) if settings.quiet else trajectory


def upright_excitation(prepared: Prepared, drive: Drive) -> Excitation:
    """What a prepared ``drive`` excites a vehicle with that does not lean on average: what leans is its sensor."""
    twin, settings, signals = prepared.twin, prepared.settings, prepared.signals
    if settings.satellites or _upright(twin) or mean_tilt(signals.up) > MAX_MEAN_SLOPE:
        return prepared.excitation
    timed = without_clock_offset(drive, prepared.excitation.late)
    return _excited(
        prepared, timed, _read(timed, twin, gain_of(twin), settings), True, prepared.excitation.late
    )


def turned_excitation(prepared: Prepared, drive: Drive) -> tuple[Excitation, tuple[float, float, float]]:
    """What excites the vehicle where all that the sensor is turned by, as far as ``drive`` shows, is its mount's; and
    roll, pitch and yaw in rad of that turn."""
    twin, settings, signals = prepared.twin, prepared.settings, prepared.signals
    if turn_of(twin) is not None:
        return prepared.excitation, (0.0, 0.0, 0.0)
    if settings.satellites:
        return prepared.excitation, mounting_error(signals, prepared.trajectory)
    trajectory, datum = prepared.trajectory, twin.datum or _first_fix(drive)
    late = prepared.excitation.late
    roll, pitch, yaw = level_rpy(signals.up.mean(axis=0))
    drive = regained(without_clock_offset(drive, late), gain_of(twin))
    signals = ingest_drive(drive, turned(twin.imu, (roll, pitch, yaw)), settings.imu)
    # a path that is made with a sensor which faces backwards speeds up as that says: by then it is too late to ask
    far = yaw_beyond(drive, signals, twin.gps, datum)
    for _ in range(_TURNS):
        yaw, far = yaw + (far or heading_off(signals, trajectory)), 0.0
        signals = ingest_drive(drive, turned(twin.imu, (roll, pitch, yaw)), settings.imu)
        trajectory = _locked(drive, twin, signals, settings, datum, True)
    return _excited(prepared, drive, signals, True, late), (roll, pitch, yaw)


def regained_excitation(prepared: Prepared, drive: Drive, upright: bool = False) -> Excitation | None:
    """What excites the vehicle, ``upright`` one that does not lean on average, where all that the sensor reads beside
    gravity at rest is its gain; None where the drive shows none."""
    twin, settings, late = prepared.twin, prepared.settings, prepared.excitation.late
    gain = gain_at_rest(prepared.signals)
    if settings.satellites or gain_of(twin) != 1.0 or gain == 1.0:
        return None
    timed = without_clock_offset(drive, late)
    return _excited(prepared, timed, _read(timed, twin, gain, settings), upright or _upright(twin), late)


def reclocked_excitation(prepared: Prepared, drive: Drive, upright: bool = False) -> Excitation | None:
    """What excites the vehicle, ``upright`` one that does not lean on average, where all that the IMU's stamps are
    after the receiver's is its clock's; None where that is not much more than the twin file says."""
    twin, settings, late = prepared.twin, prepared.settings, prepared.excitation.late
    if settings.satellites or clocks_with(e.id for e in twin.effects):
        return None
    timed, signals = without_clock_offset(drive, late), replace(prepared.signals, t=prepared.signals.t - late)
    more = clock_offset_beyond(timed, signals, twin.gps, twin.datum or _first_fix(drive))
    if not more:
        return None
    timed = without_clock_offset(drive, late + more)
    signals = _read(timed, twin, gain_of(twin), settings)
    return _excited(prepared, timed, signals, upright or _upright(twin), late + more)


def _excited(prepared: Prepared, timed: Drive, signals: ImuSignals, upright: bool, late: float) -> Excitation:
    """What excites the vehicle by a drive that is ``timed`` as a sensor without ``late`` s of clock offset would have
    stamped it, and by its ``signals``."""
    twin, settings = prepared.twin, prepared.settings
    trajectory = _locked(timed, twin, signals, settings, twin.datum or _first_fix(timed), upright)
    trajectory = replace(trajectory, t=prepared.signals.t)
    found = _excitation(trajectory, twin, Ground(prepared.road, settings.outside), settings)
    return replace(found, late=late)


def _read(drive: Drive, twin: Twin, gain: float, settings: PrepareSettings) -> ImuSignals:
    """The signals for what moves the vehicle: those of a sensor that is turned as the twin's effects say, less what it
    reads too much by ``gain``."""
    turn = turn_of(twin)
    place = twin.imu if turn is None else turned(twin.imu, turn)
    return ingest_drive(regained(drive, gain), place, settings.imu)


def _excitation(trajectory: Trajectory, twin: Twin, ground: Ground, settings: PrepareSettings) -> Excitation:
    return excitation(trajectory, twin.vehicle, ground, settings.max_step, twin.gps.position[2])


def road_of(twin: Twin) -> Road:
    """The road that the twin file names."""
    from suspension_twin.road import load_road

    if twin.road is None:
        raise InputError("twin", "road", "is missing: name the road that was driven, road: {file: road.crg}")
    if not twin.road.file.exists():
        where = "it is looked for from the folder of the twin file, unless its path is absolute"
        raise InputError("twin", "road.file", f"there is no {twin.road.file}: {where}")
    return load_road(twin.road.file)


def _first_fix(drive: Drive) -> Datum:
    good = np.flatnonzero((drive.fix.status >= 0) & np.isfinite(drive.fix.latitude))
    if not good.size:
        raise InputError(drive.name, "fix", "has no usable GNSS fix: without a position the twin has no road")
    i = int(good[0])
    altitude = float(drive.fix.altitude[i]) if np.isfinite(drive.fix.altitude[i]) else 0.0
    return Datum(
        latitude=float(drive.fix.latitude[i]), longitude=float(drive.fix.longitude[i]), altitude=altitude
    )


def _position_sigma(drive: Drive) -> float:
    """Median horizontal standard deviation of the fixes, 0 where the receiver gives none."""
    sigma = drive.fix.sigma[:, :2]
    known = sigma[np.isfinite(sigma).all(axis=1) & (sigma > 0).all(axis=1)]
    return float(np.median(known)) if known.size else 0.0


def _assemble(
    name: str,
    twin: Twin,
    road: Road,
    settings: PrepareSettings,
    signals: ImuSignals,
    trajectory: Trajectory,
    known: Prepared | None = None,
    late: float = 0.0,
) -> Prepared:
    """``known``: what this is a part or a moved copy of; the floors and warnings stay what they were. ``late`` s of the
    IMU's clock are in the trajectory."""
    late = known.excitation.late if known else late
    conditioner = Conditioner.for_stamps(signals.t, settings.filter, zero_phase=True)
    raw = np.column_stack([_channel(signals, channel) for channel in CHANNELS])
    filtered = conditioner.apply(raw)
    floors = (
        known.noise_rms
        if known
        else {
            channel: floor_rms(raw[:, i], conditioner, signals.standing, filtered[:, i])
            for i, channel in enumerate(CHANNELS)
        }
    )
    t, grid = signals.t, conditioner.grid
    position = road.xy_to_uv(trajectory.x, trajectory.y)[0]
    wheels = twin.vehicle.wheel_positions
    cos, sin = np.cos(trajectory.yaw)[:, None], np.sin(trajectory.yaw)[:, None]
    wheel_x = trajectory.x[:, None] + cos * wheels[:, 0] - sin * wheels[:, 1]
    wheel_y = trajectory.y[:, None] + sin * wheels[:, 0] + cos * wheels[:, 1]
    inside = np.asarray(road.inside(wheel_x, wheel_y).all(axis=1))
    left = known.off_road if known else off_road(name, t, inside, road, settings.outside)
    on_grid = {
        name: np.interp(grid, t, values)
        for name, values in (("speed", trajectory.speed), ("position", position))
    }
    usable = inside & trajectory.valid & (settings.saturated | ~signals.saturated)
    inside_grid = np.interp(grid, t, inside.astype(float)) > 0.5
    mask = conditioner.valid & (np.interp(grid, t, usable.astype(float)) > 0.99)
    return Prepared(
        name=name,
        twin=twin,
        road=road,
        settings=settings,
        signals=signals,
        trajectory=trajectory,
        excitation=replace(
            _excitation(trajectory, twin, Ground(road, settings.outside), settings), late=late
        ),
        conditioner=conditioner,
        measured={channel: filtered[:, i] for i, channel in enumerate(CHANNELS)},
        noise_rms=floors,
        speed=on_grid["speed"],
        position=on_grid["position"],
        along=np.gradient(on_grid["position"], grid),
        inside=inside_grid,
        mask=mask,
        position_sigma=known.position_sigma if known else 0.0,
        warnings=known.warnings if known else (),
        off_road=left,
    )


def _channel(source: ImuSignals | Response, name: str) -> Floats:
    """One channel of what has ``force``, ``rate`` and ``vertical_acceleration``."""
    if name == "vertical_acceleration":
        return source.vertical_acceleration
    kind, axis = {
        "roll_rate": ("rate", 0),
        "pitch_rate": ("rate", 1),
        "yaw_rate": ("rate", 2),
        "longitudinal_acceleration": ("force", 0),
        "lateral_acceleration": ("force", 1),
    }[name]
    return np.asarray(getattr(source, kind)[:, axis])


def _cut(source: Any, cut: slice) -> Any:
    """A copy of a dataclass of arrays with every per-sample array cut."""
    n = len(source)
    changes = {}
    for f in fields(source):
        value = getattr(source, f.name)
        if isinstance(value, np.ndarray) and value.ndim and len(value) == n and f.name != "gaps":
            changes[f.name] = value[cut]
    return replace(source, **changes)
