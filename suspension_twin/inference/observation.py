# SPDX-License-Identifier: Apache-2.0
"""An observation: everything that is compared with a model, be it a drive, a run on a rig or a simulated drive.

It has measured channels on a uniform grid, the excitation of the model, the path that simulated signals take to that
grid, the noise of each channel, and how it takes part in a fit. Nothing downstream asks where an observation comes
from. ``observe`` makes one of a recorded drive: all that does not depend on the candidate is computed there, once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.inference.gap import CHANNELS, Gap, main_channel, measure_gap
from suspension_twin.inference.nuisance import OF_A_DRIVE, OF_PLANAR_MOTION, NuisancePriors
from suspension_twin.inference.off_road import Ground, OffRoad, off_road
from suspension_twin.inference.sensor_correction import (
    SensorCorrection,
    Turn,
    gain_at_rest,
    heading_error,
    mounting_error,
)
from suspension_twin.models.excitation import coarser, excitation
from suspension_twin.models.hooks import clocks_with, gains_with, turns_with, upright_with
from suspension_twin.models.parameters import pack
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.models.tracked import ObstacleRun
from suspension_twin.models.types import Excitation, Response
from suspension_twin.pose.imu_gnss_consistency import clock_offset_beyond, findings, yaw_beyond
from suspension_twin.pose.planar_denoising import denoised_motion
from suspension_twin.pose.satellites import satellite_motion
from suspension_twin.pose.smoothed import MAX_MEAN_SLOPE, locked_trajectory, mean_tilt
from suspension_twin.pose.types import NO_FIX, POOR_FIX, STANDING_SPEED, PoseSettings, Trajectory, fix_sigma
from suspension_twin.road.crg import warning_of
from suspension_twin.road.road import Outside, Road
from suspension_twin.signals.attitude import level_rpy, rpy_matrix
from suspension_twin.signals.checks import Finding, told
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.signals.ingest import ImuSettings
from suspension_twin.signals.noise_floor import floor_rms
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import Datum, Twin

__all__ = [
    "NO_DATUM",
    "PLANAR",
    "VERTICAL",
    "Grid",
    "Observation",
    "ObserveSettings",
    "PlaceShift",
    "Reading",
    "Usage",
    "content_digest",
    "first_fix",
    "observe",
    "origin_of",
    "renamed",
    "road_of",
]

#: Channels that the road brings about, and those of the planar motion.
VERTICAL = ("vertical_acceleration", "roll_rate", "pitch_rate")
PLANAR = ("longitudinal_acceleration", "lateral_acceleration", "yaw_rate")
Stamped = TypeVar("Stamped", ImuSignals, Trajectory)

#: Of a twin whose road has a place on the map, but whose map has none on Earth.
NO_DATUM = Finding(
    "warn",
    "no_datum",
    "no datum: the map starts at the first fix, and the road lies elsewhere unless the drive began at its origin; add "
    "datum to the twin file",
)
#: Iterations of the yaw of a mounting: the path that shows it is made with its signals, and each leaves a fifth.
_TURNS = 3
#: Length of the blocks that are held out together: m of road, and s of a drive without one.
_METRES, _SECONDS = 8.0, 4.0


@dataclass(frozen=True, eq=False)
class PlaceShift:
    """How far a path is moved ``ahead`` along the vehicle's course and to the ``left``, (k,) m at the times ``t`` (k,)
    s: linear between them, constant beyond; ``turned`` rad, counter-clockwise, is the vehicle everywhere."""

    t: Floats
    ahead: Floats
    left: Floats
    turned: float = 0.0

    def of(self, path: Trajectory) -> Trajectory:
        """The path moved."""
        along, across = (np.interp(path.t, self.t, metres) for metres in (self.ahead, self.left))
        cos, sin = np.cos(path.yaw), np.sin(path.yaw)
        x, y = path.x + along * cos - across * sin, path.y + along * sin + across * cos
        return replace(path, x=x, y=y, yaw=path.yaw + self.turned)


@dataclass(frozen=True)
class ObserveSettings:
    """How a drive is observed.

    ``filter`` for both sides, zero-phase offline; ``max_step`` s of the simulation; ``outside`` is the height policy
    beyond the road: hold, zero, error, or that of the road's file; ``satellites`` takes the planar motion from the
    fixes alone, where the IMU itself is in question; ``saturated`` compares samples at the end of the sensor's range as
    well, which alone show a clipped range; ``placed`` moves every path that is read from the recording.
    """

    filter: FilterSpec = FilterSpec()
    max_step: float = 1e-3
    outside: Outside = "road"
    satellites: bool = False
    saturated: bool = False
    imu: ImuSettings = field(default_factory=ImuSettings)
    placed: PlaceShift | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """The uniform grid of m samples that signals are compared on; its numbers are those of :class:`Observation`."""

    t: Floats
    rate: float
    bandwidth: float
    apply: Callable[[ArrayLike], Floats]
    position: Floats
    along: Floats
    mask: NDArray[np.bool_]
    position_sigma: float = 0.0


@dataclass(frozen=True, eq=False)
class Usage:
    """How an observation takes part in a fit.

    ``channels`` are compared, ``driven`` those by which the vehicle is judged, because the excitation brings them
    about; ``priors`` of the nuisance parameters; ``block`` (m,) numbers the blocks that are held out together, which
    all observations share where ``shared``; ``fused`` where the pose was fused with the sensor that is compared.
    ``unit`` rms in which a fit counts the residual of a channel, its noise where there is none.
    """

    channels: tuple[str, ...]
    driven: tuple[str, ...]
    priors: NuisancePriors
    block: NDArray[np.intp]
    shared: bool = True
    fused: bool = False
    gravity: float = STANDARD_GRAVITY
    unit: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Reading:
    """A recorded drive as it was read for a twin: what its observation was made of.

    ``signals`` (n kept stamps, unfiltered, ``base_link`` axes) and ``trajectory`` on the same stamps; ``shown``: the
    errors of the sensor that the recording itself shows, none where None; ``window``: first and last stamp of an
    excerpt.
    """

    drive: Drive
    twin: Twin
    road: Road
    settings: ObserveSettings
    signals: ImuSignals
    trajectory: Trajectory
    shown: SensorCorrection | None = None
    window: tuple[int, int] | None = None

    @cached_property
    def digest(self) -> str:
        """Digest of everything that an excitation follows from."""
        return content_digest(self.drive, self.twin, self.road, self.settings, self.trajectory, self.window)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Reading) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def correction(self, effects: Sequence[str], others: Sequence[str], upright: bool) -> SensorCorrection:
        """How the drive is read by a hypothesis with ``effects`` on it, beside ``others`` of the twin; ``upright``:
        the vehicle has zero static attitude."""
        base, model = SensorCorrection.of_twin(self.twin), self.twin.model
        shown = self.shown
        if self.settings.satellites or shown is None:
            return base
        level = upright or upright_with([*effects, *others], model)
        if turns_with(effects, model):
            return base if base.turn is not None else replace(base, turn=shown.turn, upright=True)
        # a gain in the twin file is already corrected in the motion
        if gains_with([*effects, *others], model) and shown.gain != 1.0:
            return replace(base, gain=shown.gain, upright=level or base.upright)
        if clocks_with(effects, model) and shown.clock:
            return replace(base, clock=base.clock + shown.clock, upright=level or base.upright)
        leans = mean_tilt(self.signals.up) > MAX_MEAN_SLOPE
        return replace(base, upright=base.upright or (level and not leans))

    def excitation(self, correction: SensorCorrection, step: float | None = None) -> Excitation:
        """The excitation with some errors of the sensor taken out, in steps of at most ``step`` s if that is given."""
        return _reread(self, correction, step)


@lru_cache(maxsize=64)
def _reread(reading: Reading, correction: SensorCorrection, step: float | None) -> Excitation:
    if step is not None:
        return coarser(_reread(reading, correction, None), step)
    if reading.window is not None:
        whole = _reread(replace(reading, window=None), correction, None)
        return _stretch(whole, *reading.window)
    path = reading.trajectory
    if correction != SensorCorrection.of_twin(reading.twin):
        timed, twin, settings = correction.timed(reading.drive), reading.twin, reading.settings
        signals = correction.signals(timed, twin.imu, settings.imu)
        path = replace(_locked(timed, twin, signals, settings, correction.upright), t=path.t)
    return _excited(path, reading, correction.clock)


def _excited(path: Trajectory, reading: Reading, clock: float) -> Excitation:
    twin, settings = reading.twin, reading.settings
    ground = Ground(reading.road, settings.outside)
    found = excitation(path, twin.vehicle, ground, settings.max_step, twin.gps.position[2])
    return replace(found, late=0.0 if settings.satellites else clock)


def _stretch(whole: Excitation, first: int, last: int) -> Excitation:
    """The excitation at stamps ``first`` to ``last``, from static equilibrium on."""
    substeps, motion = whole.substeps[first:last].copy(), whole.motion[first:last].copy()
    substeps[0], motion[0, 0] = 0, 0.0
    begin = int(whole.first[first + 1]) - 1  # the heights at the end of the first interval
    rows = whole.first[first : last + 1] - begin
    rows[0] = 0
    road = whole.road[begin : int(whole.first[last])]
    path, t = whole.path, whole.t[first:last]
    path = replace(path, x=path.x[first:last], y=path.y[first:last], yaw=path.yaw[first:last])
    return replace(whole, t=t, substeps=substeps, first=rows, road=road, motion=motion, path=path)


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation(Grid):
    """A drive or run of m samples on a uniform grid, with n simulated stamps.

    Parameters
    ----------
    t : (m,) array
        s, the grid of every conditioned signal.
    rate : float
        Samples per second of the grid.
    bandwidth : float
        Cut-off in Hz of the low-pass that both sides go through.
    apply : callable
        Takes simulated samples (n, ...) to the grid (m, ...).
    position : (m,) array
        m along the road, or along the path without a road.
    along : (m,) array
        m/s, the rate of the position.
    mask : (m,) array
        True where a comparison is meaningful.
    position_sigma : float
        The receiver's own horizontal standard deviation in m, 0 where it gives none.
    name : str
        Of the drive or run.
    excitation : Excitation or ObstacleRun
        Drives the model, on n stamps.
    measured : dict of str to (m,) array
        Filtered measured channels.
    noise_rms : dict of str to float
        Noise floor of each channel.
    usage : Usage
        How it takes part in a fit.
    reading : Reading, optional
        The recording of a drive and how it was read.
    warnings : tuple of str
        Found while it was read.
    lateness_sigma : float, optional
        Standard deviation in s of how late the receiver's stamps are, where the drive shows it.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.models.simulate import simulate_twin
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = load_twin("bags/crg_road/twin.yaml")
    >>> observation = observe(read_drive("bags/crg_road"), twin)
    >>> gap = observation.gap(observation.condition(simulate_twin(twin, observation.road_excitation)))
    >>> bool(gap.rms > gap.noise_rms)
    True
    """

    name: str
    excitation: Excitation | ObstacleRun
    measured: Mapping[str, Floats]
    noise_rms: Mapping[str, float]
    usage: Usage
    reading: Reading | None = None
    warnings: tuple[str, ...] = ()
    lateness_sigma: float | None = None

    @property
    def road_excitation(self) -> Excitation:
        """The excitation by a road under the wheels; InputError where it is another."""
        if isinstance(self.excitation, ObstacleRun):
            raise InputError(self.name, "is no drive on a road")
        return self.excitation

    @property
    def excited(self) -> bool:
        """Whether it is known what excites the vehicle."""
        return self.reading is None or not self.reading.settings.satellites

    @property
    def source(self) -> Reading:
        """The reading of a recorded drive; InputError where it was none."""
        if self.reading is None:
            raise InputError(self.name, "is no recorded drive")
        return self.reading

    @property
    def twin(self) -> Twin:
        """The twin that a drive was read for."""
        return self.source.twin

    @property
    def road(self) -> Road:
        """The road of a drive."""
        return self.source.road

    @property
    def settings(self) -> ObserveSettings:
        """How a drive was observed."""
        return self.source.settings

    @property
    def signals(self) -> ImuSignals:
        """The IMU of a drive on its n kept stamps, unfiltered, in ``base_link`` axes."""
        return self.source.signals

    @property
    def trajectory(self) -> Trajectory:
        """The locked pose of a drive on the same stamps."""
        return self.source.trajectory

    @cached_property
    def speed(self) -> Floats:
        """(m,) m/s of a drive."""
        path = self.trajectory
        return np.interp(self.t, path.t, path.speed)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """(m,) True where all wheels of a drive have a road under them."""
        inside = _on_road(self.source).astype(float)
        return np.asarray(np.interp(self.t, self.signals.t, inside) > 0.5)

    @cached_property
    def off_road(self) -> OffRoad:
        """Where a drive leaves the road, and the policy there."""
        source = self.source
        return off_road(self.name, source.signals.t, _on_road(source), source.road, source.settings.outside)

    def condition(self, response: Response) -> dict[str, Floats]:
        """The simulated counterpart (m,) of every measured channel of a drive, through the same filter.

        The reading of the simulated sensor at standstill is taken off its vertical, as it is off the recorded one's: a
        gain multiplies gravity too, and a tilt loses a part of it.
        """
        stacked = np.stack([_channel(response, name) for name in CHANNELS], axis=1)
        stacked[:, CHANNELS.index("vertical_acceleration")] -= self.standing_vertical(response)
        filtered = self.apply(stacked)
        return {name: filtered[:, i] for i, name in enumerate(CHANNELS)}

    def standing_vertical(self, response: Response) -> float:
        """m/s² of the simulated sensor's vertical while the vehicle stands; 0 where it never does: the mean of a part
        on the move is motion too."""
        standing = self.signals.standing
        return float(response.vertical_acceleration[standing].mean()) if standing.any() else 0.0

    def simulated(self, twin: Twin) -> dict[str, Floats]:
        """The channels (m,) of a twin, conditioned as the measured ones."""
        if self.reading is not None:
            return self.condition(simulate_twin(twin, self.road_excitation))
        response = simulate_lanes(twin, pack(twin)[:, None], self.excitation)
        filtered = self.apply(response.stacked(tuple(self.measured))[:, :, 0])
        return {name: filtered[:, i] for i, name in enumerate(self.measured)}

    @cached_property
    def driving(self) -> NDArray[np.bool_]:
        """(m,) True where a drive is compared and the vehicle moves, within the range of its sensor; all that is
        compared of a controlled run, and of a vehicle that never moves."""
        if self.reading is None:
            return self.mask
        within = np.interp(self.t, self.signals.t, self.signals.saturated.astype(float)) < 0.01
        moving = np.asarray(self.mask & within & (np.abs(self.speed) > STANDING_SPEED))
        return moving if moving.any() else self.mask

    def gap(self, simulated: Mapping[str, Floats]) -> Gap:
        """The gap to conditioned channels, over all driving on the road."""
        floor = self.noise_rms[main_channel(self.measured)]
        return measure_gap(self.measured, simulated, self.driving, self.rate, floor)

    def part(self, start: float, end: float) -> Observation:
        """The samples of a drive with stamps between ``start`` and ``end`` s, with a grid of their own."""
        source = self.source
        first, last = np.searchsorted(source.signals.t, [start, end])
        if last - first < 16:
            raise InputError(
                self.name, f"{last - first} samples between {start:.2f} and {end:.2f} s are too few"
            )
        cut = slice(int(first), int(last))
        own = replace(source, signals=_cut(source.signals, cut), trajectory=_cut(source.trajectory, cut))
        return _observed(own, self)

    def excerpt(self, start: float, end: float) -> Observation:
        """As :meth:`part`, with the excitation of the whole drive cut from static equilibrium on, so that it can be
        read with another correction of the sensor."""
        source = self.source
        first, last = np.searchsorted(source.signals.t, [start, end]).tolist()
        window = replace(source, window=(first, last))
        cut = window.excitation(SensorCorrection.of_twin(source.twin))
        return replace(self.part(start, end), excitation=cut, reading=window)

    def moved(self, seconds: float, metres: float) -> Observation:
        """The same drive with the pose read ``seconds`` later and the map taken ``metres`` back along its own
        direction: a clock offset and a shifted map, simulated instead of interpolated."""
        source = self.source
        path = source.trajectory
        later = np.clip(path.t + seconds, path.t[0], path.t[-1])
        columns = path.x, path.y, path.yaw, path.velocity, path.yaw_rate, path.acceleration
        x, y, yaw, velocity, turn, acceleration = (interpolated(later, path.t, values) for values in columns)
        if metres:
            with np.errstate(invalid="ignore"):
                sense = np.sign(np.gradient(source.road.xy_to_uv(path.x, path.y)[0], path.t))
            x, y = x + metres * sense * np.cos(yaw), y + metres * sense * np.sin(yaw)
        moved = Trajectory(path.t, x, y, yaw, velocity, turn, acceleration, path.valid)
        return _observed(replace(source, trajectory=moved), self)

    def on_path(self, path: Trajectory) -> Observation:
        """The same signals on another path, at their stamps."""
        t = self.signals.t
        columns = path.x, path.y, path.yaw, path.velocity, path.yaw_rate, path.acceleration
        x, y, yaw, velocity, turn, acceleration = (interpolated(t, path.t, values) for values in columns)
        valid = np.interp(t, path.t, path.valid.astype(float)) == 1.0
        moved = Trajectory(t, x, y, yaw, velocity, turn, acceleration, valid)
        return _observed(replace(self.source, trajectory=moved), self)

    def on(self, road: Road) -> Observation:
        """The same drive on another road."""
        return _observed(replace(self.source, road=road), self)

    def displaced(
        self, t: Floats, ahead: Floats, left: Floats | None = None, turned: float = 0.0
    ) -> Observation:
        """The same drive with its path ``ahead`` along the vehicle's course and to the ``left`` by these (k,) m at the
        times ``t`` (k,) s: linear between them, constant beyond; the vehicle ``turned`` by as many rad."""
        shift = PlaceShift(t, ahead, np.zeros_like(ahead) if left is None else left, turned)
        return _observed(replace(self.source, trajectory=shift.of(self.trajectory)), self)


def observe(
    drive: Drive,
    twin: Twin,
    road: Road | None = None,
    settings: ObserveSettings | None = None,
    strict: bool = False,
    refused: Collection[str] = (),
) -> Observation:
    """Observe a drive for comparison with a twin: all that does not depend on the candidate.

    Parameters
    ----------
    drive : Drive
        The recording.
    twin : Twin
        Places of the sensors, datum, geometry, and the errors of the sensor that are known.
    road : Road, optional
        The road; that of the twin file by default.
    settings : ObserveSettings, optional
        Filter, step, policy beyond the road's borders.
    strict : bool
        Refuse signals that must not be used for calibration (an IMU upside down, too slow, dead).
    refused : collection of str
        Codes of other findings that are refused.

    Returns
    -------
    Observation
        Locked pose, excitation, filtered measured channels and their noise floors.

    Raises
    ------
    InputError
        Naming the drive and what it lacks.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> observation = observe(read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml"))
    >>> sorted(observation.measured)[0]
    'lateral_acceleration'
    """
    settings = settings or ObserveSettings()
    road = road_of(twin) if road is None else road
    correction = SensorCorrection() if settings.satellites else SensorCorrection.of_twin(twin)
    plain = SensorCorrection()
    signals = plain.signals(drive, twin.imu, settings.imu)
    timed = correction.timed(drive)
    same = replace(correction, upright=False) == plain
    mounted = signals if same else correction.signals(timed, twin.imu, settings.imu)
    datum = origin_of(twin, drive)
    noticed = [*mounted.findings, *findings(timed, mounted, twin.gps)]
    if twin.datum is None and twin.road is not None and len(drive.fix):
        noticed.append(NO_DATUM)
    unusable = [f for f in told(noticed) if strict and f.level == "error"]
    for finding in (*unusable, *(f for f in noticed if f.code in refused)):
        raise InputError(drive.name, "imu", finding.text)
    if settings.satellites:
        slow = satellite_motion(drive, signals, twin.gps, datum)
        turn = SensorCorrection.of_twin(twin).turn or mounting_error(*slow)
        ahead = rpy_matrix(turn)[0]
        direction = float(ahead[0]), float(ahead[1]), float(ahead[2])
        signals, trajectory = satellite_motion(drive, signals, twin.gps, datum, direction)
    elif not len(drive.fix):
        trajectory = _felt(timed, twin, mounted, road)
    else:
        try:
            trajectory = replace(_locked(timed, twin, mounted, settings, correction.upright), t=signals.t)
        except InputError as error:
            raise error if str(error).startswith(drive.name) else InputError(drive.name, str(error)) from None
    found = _observed(Reading(drive, twin, road, settings, signals, trajectory))
    known = twin.road is not None and road.name == twin.road.file.name
    about = warning_of(twin.road.file) if known and twin.road is not None else None
    sigma = _position_sigma(drive)
    if sigma and not np.nansum(drive.fix.sigma[:, :2]):
        text = f"the receiver does not say how accurate its positions are: they are taken as good to {sigma:.2g} m"
        noticed.append(Finding("warn", "accuracy", text))
    beside = found.off_road.sentence(float(signals.t[0]))
    noticed += [Finding("warn", "off_road", beside)] if beside else []
    said = dict.fromkeys(
        (
            *drive.warnings,
            *(f.text for f in told(noticed) if f.level != "ok"),
            *((about,) if about else ()),
        )
    )
    # a place that was felt is that of one axle or of the other
    if not len(drive.fix):
        sigma = float(np.ptp(twin.vehicle.wheel_positions[:, 0]))
    return replace(found, warnings=tuple(said), position_sigma=sigma)


def with_shown_errors(observation: Observation) -> Observation:
    """The observation of a drive with the errors of the sensor that its own recording shows.

    The turn of the mounting, by gravity and by the path; the gain by the reading at rest; and the clock offset that IMU
    and receiver show beyond the twin file's. An error that the twin file states already is not looked for.
    """
    source = observation.source
    twin, signals = source.twin, source.signals
    base = SensorCorrection.of_twin(twin)
    if source.settings.satellites:
        turn = (0.0, 0.0, 0.0) if base.turn is not None else mounting_error(signals, source.trajectory)
        return replace(observation, reading=replace(source, shown=SensorCorrection(turn)))
    gain = gain_at_rest(signals) if base.gain == 1.0 else 1.0
    clock = 0.0
    timed = base.timed(source.drive)
    if not clocks_with(e.id for e in twin.effects):
        shifted = replace(signals, t=signals.t - base.clock)
        clock = clock_offset_beyond(timed, shifted, twin.gps)
    turn = _shown_turn(source, base) if base.turn is None else (0.0, 0.0, 0.0)
    return replace(observation, reading=replace(source, shown=SensorCorrection(turn, gain, clock)))


def _shown_turn(source: Reading, base: SensorCorrection) -> Turn:
    twin, settings, trajectory = source.twin, source.settings, source.trajectory
    roll, pitch, yaw = level_rpy(source.signals.up.mean(axis=0))
    timed = base.timed(source.drive)

    def read() -> ImuSignals:
        return replace(base, turn=(roll, pitch, yaw)).signals(timed, twin.imu, settings.imu)

    signals = read()
    # a path that is made with a sensor which faces backwards speeds up accordingly: it shows no yaw any more
    far = yaw_beyond(timed, signals, twin.gps)
    for _ in range(_TURNS):
        yaw, far = yaw + (far or heading_error(signals, trajectory)), 0.0
        signals = read()
        trajectory = _locked(timed, twin, signals, settings, True)
    return roll, pitch, yaw


def road_of(twin: Twin) -> Road:
    """The road that the twin file names."""
    from suspension_twin.road import load_road

    if twin.road is None:
        raise InputError("twin", "road", "is missing: name the road that was driven, road: {file: road.crg}")
    if not twin.road.file.exists():
        where = "it is looked for from the folder of the twin file, unless its path is absolute"
        raise InputError("twin", "road.file", f"there is no {twin.road.file}: {where}")
    return load_road(twin.road.file)


def renamed(observations: Sequence[Observation]) -> list[Observation]:
    """Observations of one name get a number, so that each nuisance parameter has a name of its own."""
    names: list[str] = []
    for one in observations:
        name, k = one.name, 2
        while name in names:
            name, k = f"{one.name}_{k}", k + 1
        names.append(name)
    return [o if o.name == n else replace(o, name=n) for o, n in zip(observations, names, strict=True)]


def content_digest(*values: object) -> str:
    """Digest of the contents of records, arrays, models and plain values."""
    digest = hashlib.sha256()
    for piece in _pieces(values):
        digest.update(piece)
    return digest.hexdigest()


def _pieces(value: object) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield repr((value.dtype.str, value.shape)).encode()
        yield value.tobytes()
    elif isinstance(value, BaseModel):
        yield value.model_dump_json().encode()
    elif isinstance(value, list | tuple):
        yield f"{type(value).__name__}{len(value)}".encode()
        for one in value:
            yield from _pieces(one)
    elif is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__.encode()
        for f in fields(value):
            yield from _pieces(getattr(value, f.name))
    else:
        yield repr(value).encode()


def _locked(
    timed: Drive, twin: Twin, signals: ImuSignals, settings: ObserveSettings, upright: bool
) -> Trajectory:
    """The locked and denoised path of a drive."""
    datum = twin.datum or first_fix(timed)
    trajectory = locked_trajectory(timed, signals, twin.gps, datum, signals.t, upright=upright)
    found = denoised_motion(trajectory, signals, twin.cog_height)
    return found if settings.placed is None else settings.placed.of(found)


def _felt(timed: Drive, twin: Twin, signals: ImuSignals, road: Road) -> Trajectory:
    """The path of a drive without positions, as its sensors felt the road."""
    from suspension_twin.inference.felt_passes import (
        felt_trajectory,  # splines, which a live twin does without
    )

    return denoised_motion(felt_trajectory(timed, twin, signals, road), signals, twin.cog_height)


def origin_of(twin: Twin, drive: Drive) -> Datum:
    """The origin of the map: of the twin file, else the first fix; without positions there is none to be placed."""
    anywhere = Datum(latitude=0.0, longitude=0.0, altitude=0.0)
    return twin.datum or (first_fix(drive) if len(drive.fix) else anywhere)


def first_fix(drive: Drive) -> Datum:
    """The place of the first usable fix of a drive; InputError where there is none."""
    good = np.flatnonzero((drive.fix.status >= 0) & np.isfinite(drive.fix.latitude))
    if not good.size:
        raise InputError(drive.name, "fix", "has no usable GNSS fix: without a position the twin has no road")
    i = int(good[0])
    altitude = float(drive.fix.altitude[i]) if np.isfinite(drive.fix.altitude[i]) else 0.0
    return Datum(
        latitude=float(drive.fix.latitude[i]), longitude=float(drive.fix.longitude[i]), altitude=altitude
    )


def _position_sigma(drive: Drive) -> float:
    """Median horizontal standard deviation of the fixes in m; where the receiver gives none, that of its kind, and 0 of
    one with RTK."""
    sigma = drive.fix.sigma[:, :2]
    known = sigma[np.isfinite(sigma).all(axis=1) & (sigma > 0).all(axis=1)]
    if known.size:
        return float(np.median(known))
    kinds = drive.fix.status[drive.fix.status != NO_FIX].tolist()
    assumed = float(np.median([fix_sigma(PoseSettings(), kind, np.nan, np.nan) for kind in kinds] or [0.0]))
    return assumed if assumed > POOR_FIX else 0.0


def _on_road(source: Reading) -> NDArray[np.bool_]:
    """(n,) True at stamps where all wheels have a road under them."""
    path, wheels = source.trajectory, source.twin.vehicle.wheel_positions
    cos, sin = np.cos(path.yaw)[:, None], np.sin(path.yaw)[:, None]
    x = path.x[:, None] + cos * wheels[:, 0] - sin * wheels[:, 1]
    y = path.y[:, None] + sin * wheels[:, 0] + cos * wheels[:, 1]
    return np.asarray(source.road.inside(x, y).all(axis=1))


def _observed(source: Reading, known: Observation | None = None) -> Observation:
    """The observation of a reading; ``known``: what it is a part or a moved copy of, whose name, floors, accuracy and
    warnings stay."""
    settings, signals, path = source.settings, source.signals, source.trajectory
    conditioner = Conditioner.for_stamps(signals.t, settings.filter, zero_phase=True)
    raw = np.column_stack([_channel(signals, channel) for channel in CHANNELS])
    filtered = conditioner.apply(raw)
    t, grid, inside = signals.t, conditioner.grid, _on_road(source)
    if known is None:
        off_road(source.drive.name, t, inside, source.road, settings.outside)  # refuses by the policy
        floors: Mapping[str, float] = {
            channel: floor_rms(raw[:, i], conditioner, signals.standing, filtered[:, i])
            for i, channel in enumerate(CHANNELS)
        }
    else:
        floors = known.noise_rms
    position = np.interp(grid, t, source.road.xy_to_uv(path.x, path.y)[0])
    usable = inside & path.valid & (settings.saturated | ~signals.saturated)
    mask = conditioner.valid & (np.interp(grid, t, usable.astype(float)) > 0.99)
    clock = SensorCorrection.of_twin(source.twin).clock
    if settings.satellites:
        block = np.floor((grid - grid[0]) / _SECONDS).astype(np.intp)
        usage = Usage(PLANAR, PLANAR, OF_PLANAR_MOTION, block, shared=False)
    else:
        block = np.floor(position / _METRES).astype(np.intp)
        usage = Usage(CHANNELS, VERTICAL, OF_A_DRIVE, block, fused=True, gravity=signals.gravity)
    return Observation(
        t=grid,
        rate=conditioner.rate,
        bandwidth=settings.filter.cutoff,
        apply=conditioner.apply,
        position=position,
        along=np.gradient(position, grid),
        mask=np.asarray(mask),
        position_sigma=known.position_sigma if known else 0.0,
        name=known.name if known else source.drive.name,
        excitation=_excited(path, source, clock),
        measured={channel: filtered[:, i] for i, channel in enumerate(CHANNELS)},
        noise_rms=floors,
        usage=usage,
        reading=source,
        warnings=known.warnings if known else (),
        lateness_sigma=known.lateness_sigma if known else None,
    )


def _channel(source: ImuSignals | Response, name: str) -> Floats:
    """One channel of an object with ``force``, ``rate`` and ``vertical_acceleration``."""
    if name == "vertical_acceleration":
        return source.vertical_acceleration
    array = source.force if name in ("longitudinal_acceleration", "lateral_acceleration") else source.rate
    column = {"roll_rate": 0, "pitch_rate": 1, "yaw_rate": 2, "lateral_acceleration": 1}.get(name, 0)
    return np.asarray(array[:, column])


def _cut(source: Stamped, cut: slice) -> Stamped:
    """A copy of a record of arrays with every array by stamp cut."""
    n = len(source)
    own = {f.name: getattr(source, f.name) for f in fields(source) if f.name != "gaps"}
    arrays = {k: v[cut] for k, v in own.items() if isinstance(v, np.ndarray) and v.ndim and len(v) == n}
    return replace(source, **arrays)  # type: ignore[arg-type]
