# SPDX-License-Identifier: Apache-2.0
"""The page of a calibration: measured and simulated signals, estimates and their uncertainty."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from suspension_twin.arrays import Floats, runs
from suspension_twin.calibration.labels import parameter_label, parameter_unit
from suspension_twin.calibration.request import Band, CalibrationResult, CurveEstimate, DriveFit
from suspension_twin.inference.gap import channel_unit
from suspension_twin.report import plots
from suspension_twin.report.characteristics import AxleEvidence, characteristics
from suspension_twin.report.page import Cell, Mark, Page, Section, Table, short
from suspension_twin.signals.metrics import (
    correlation,
    iso18571,
    mean_squared_error,
    rms_error,
    spectral_distance,
)
from suspension_twin.signals.spectra import power_density, power_spectrum

__all__ = ["calibration_page"]

_WINDOW = 4.0  # s of a panel in time
_PANELS = 3
_WAVE = 3.0  # m: longer waves of the road are left out of its profile
_NEAR = 10.0  # m to either side of a bump that its passes are drawn
_LONGEST_RATED = 20.0  # s of a drive that ISO/TS 18571 rates: its time warping costs with the square
#: Meaning of each status, and its colour in the table.
_MEANINGS = {
    "identified": "the drives carry at least as much information on it as its prior",
    "interpolated": "the drives reached it, yet show less of the slope there than its prior: it follows identified "
    "neighbours on its characteristic; more or stronger motion there would identify it",
    "extrapolated": "beyond what the drives excited it follows identified neighbours on its characteristic by the "
    "prior of smooth slopes; a faster drive or a higher bump would identify it",
    "kept": "at its start: the drives do not show that it differs from it",
    "not identified": "the search had no prior: the value is arbitrary within its interval",
    "on bound": "the search wanted to go further",
}
_COLOURS: dict[str, Mark] = {
    "identified": "good",
    "interpolated": "soft",
    "extrapolated": "soft",
    "kept": "soft",
    "not identified": "warn",
    "on bound": "bad",
}
_NAMES = {
    "simulated": "twin, calibrated",
    "before": "twin as it started",
    "residual": "measured − calibrated",
}


def calibration_page(result: CalibrationResult) -> Page:
    """Make the page of a calibration: characteristics, parameters, gaps, search.

    Parameters
    ----------
    result : CalibrationResult
        Result of :func:`~suspension_twin.calibration.run.calibrate`.

    Returns
    -------
    Page
        ``write(path)`` saves it as one HTML file without scripts and links.

    Examples
    --------
    >>> calibration_page(result).write("report/index.html")  # doctest: +SKIP
    PosixPath('report/index.html')
    """
    drives = ", ".join(d.name for d in result.drives)
    page = Page(
        "Calibration", f"{result.twin.vehicle.name} on {drives}, preset {result.preset}, seed {result.seed}"
    )
    _cards(page, result)
    gaps = {d.name: {"before": d.gap_before.rms, "simulated": d.gap_after.rms} for d in result.drives}
    page.add(Section("Result", _summary(result), _agreement_table(result), plots.agreement(gaps)))
    for drive in result.drives:
        page.add(_drive_section(drive))
    if result.curves:
        page.add(_characteristics_section(result))
    page.add(_parameter_section(result))
    if result.sensor:
        page.add(_sensor_section(result))
    page.add(_nuisance_section(result))
    page.add(_search_section(result))
    return page


def _cards(page: Page, result: CalibrationResult) -> None:
    for d in result.drives:
        closed = 1 - d.gap_after.rms / d.gap_before.rms
        page.card(
            f"Gap on {d.name}",
            f"{d.gap_after.rms:.3g} {channel_unit(d.channel)}",
            f"was {d.gap_before.rms:.3g}, floor {d.gap_after.noise_rms:.3g}",
            "good" if closed > 0.3 else "bad" if closed < 0 else "warn",
        )
    total, counts = len(result.estimates), result.counts
    identified, bound = counts.pop("identified", 0), counts.pop("on bound", 0)
    others = ", ".join(f"{count} {status}" for status, count in counts.items())
    page.card("Identified", f"{identified} of {total}", others or "parameters", "warn" if others else "good")
    page.card("On a bound", f"{bound} of {total}", "parameters", "bad" if bound else "good")
    page.card("Simulated", f"{result.evaluations}", f"candidates in {result.seconds:.1f} s")


def _summary(result: CalibrationResult) -> str:
    lines = [f"**{result.message.partition(';')[0]}.**"] if result.yardstick and result.yardstick.lost else []
    if result.yardstick is not None and not result.yardstick.lost:
        lines.append(f"{result.yardstick}.")
    lines += [
        f"The searched objective, `{result.objective}`, went from {short(result.initial_cost)} to "
        f"{short(result.cost)}; costs of different objectives do not compare. Measured and simulated signals on this "
        "page went through the same zero-phase low-pass."
    ]
    if np.isfinite(result.distance):
        lines.append(
            "The car paper's objective, eq. (1), the same for every preset (Euclidean distance of the vertical "
            "acceleration, each drive aligned in time), went from "
            f"{short(result.initial_distance)} to {short(result.distance)} m/s²."
        )
    for status, count in result.counts.items():
        keys = [parameter_label(result.twin, e.key) for e in result.estimates if e.status == status]
        which = "" if status == "identified" else f": {', '.join(keys)}"
        lines.append(f"{count} of {len(result.estimates)} {status} ({_MEANINGS[status]}){which}.")
    lines += [f"Warning: {w}." for w in result.warnings]
    return "\n\n".join(lines)


# -- comparison ------------------------------------------------------------------------------------


def _agreement_table(result: CalibrationResult) -> Table:
    main = result.drives[0].channel if result.drives else ""
    unit = channel_unit(main)
    rows = [
        _agreement(d, name, simulated[d.channel])
        for d in result.drives
        for name, simulated in (("as it started", d.before), ("calibrated", d.after))
    ]
    columns = [
        "twin",
        f"rms [{unit}]",
        f"MSE [({unit})²]",
        "correlation",
        "ISO/TS 18571",
        "spectra apart [dB]",
    ]
    return Table(columns, rows, f"{main.replace('_', ' ')}, on the compared samples")


def _agreement(drive: DriveFit, name: str, simulated: Floats) -> list[object]:
    a, b = drive.measured[drive.channel][drive.compared], simulated[drive.compared]
    rated = slice(0, int(_LONGEST_RATED * drive.rate))
    return [
        f"{drive.name}, {name}",
        float(rms_error(a, b)),
        float(mean_squared_error(a, b)),
        float(correlation(a, b)),
        float(iso18571(a[rated], b[rated], drive.rate).overall),
        float(spectral_distance(a, b, drive.rate)),
    ]


def _drive_section(drive: DriveFit) -> Section:
    unit = channel_unit(drive.channel)
    text = (
        f"{drive.gap_after.seconds:.1f} s compared. With the nuisances corrected (clock, map, biases) the residual is "
        f"{drive.nuisance_free:.3g} {unit} on the compared samples; the sensor's noise floor is "
        f"{drive.gap_after.noise_rms:.3g} {unit}."
    )
    figures = [(_in_time(drive, drive.channel, plots.ACCELERATION), "The seconds with the strongest motion.")]
    if "pitch_rate" in drive.measured:
        figures.append(
            (_in_time(drive, "pitch_rate", "pitch rate [rad/s]"), "Pitch rate in the same seconds.")
        )
    figures += [
        (_spectra(drive), "Power spectral densities."),
        (_amplitude_spectra(drive), "Amplitude spectra: the car paper's Fig. 11 without its mirror image."),
        (_by_road(drive), "Residual by position along the road."),
    ]
    if drive.received is not None:
        figures.insert(0, (_passes(drive), "Measured passes over the bump, laid over one another."))
    return Section(drive.name, text, *(f for f, _ in figures), captions=tuple(c for _, c in figures))


def _passes(drive: DriveFit) -> Figure:
    """Every pass near the highest point of the road, by the receiver's positions and by those that were found."""
    along, heights = drive.profile
    bump = float(along[int(np.argmax(np.abs(heights - np.median(heights, axis=0)).max(axis=1)))])
    assert drive.received is not None
    lines = list[list[tuple[Floats, Floats]]](([], []))
    for first, last in runs(drive.compared):
        sense = float(np.sign(drive.position[last - 1] - drive.position[first]))
        if (np.abs(drive.position[first:last] - bump) < 0.5).any():
            for found, place in zip(lines, (drive.received, drive.position), strict=True):
                way = sense * (place[first:last] - bump)
                near = np.abs(way) < _NEAR
                found.append((way[near], drive.measured[drive.channel][first:last][near]))
    return plots.passes(*lines)


def _in_time(drive: DriveFit, channel: str, label: str) -> Figure:
    return plots.in_time(
        drive.t,
        drive.measured[channel],
        drive.after[channel],
        before=drive.before[channel],
        windows=_windows(drive),
        origin=float(drive.t[0]),
        label=label,
        names=_NAMES,
    )


def _windows(drive: DriveFit) -> list[plots.Window]:
    """The strongest few seconds, apart from each other, in their order."""
    size = int(_WINDOW * drive.rate)
    power = np.where(drive.compared, drive.measured[drive.channel] ** 2, 0.0)
    energy = uniform_filter1d(power, size, mode="constant")
    found: list[float] = []
    while len(found) < _PANELS and energy.max() > 0:
        i = int(np.argmax(energy))
        found.append(float(drive.t[i]))
        energy[max(0, i - size) : i + size] = 0.0
    half = 0.5 * _WINDOW
    return [plots.Window(t - half, t + half) for t in sorted(found)]


def _longest(drive: DriveFit) -> dict[str, Floats]:
    """Measured, calibrated and started signal and residual over the longest run of compared samples."""
    first, last = max(runs(drive.compared), key=lambda run: run[1] - run[0])
    measured, simulated, before = (
        s[drive.channel][first:last] for s in (drive.measured, drive.after, drive.before)
    )
    return {
        "residual": measured - simulated,
        "before": before,
        "measured": measured,
        "simulated": simulated,
    }


def _spectra(drive: DriveFit) -> Figure:
    signals = _longest(drive)
    frequency, density = power_density(np.column_stack(list(signals.values())), drive.rate, 4.0)
    return plots.in_frequency(
        frequency, dict(zip(signals, density.T, strict=True)), cutoff=20.0, names=_NAMES
    )


def _amplitude_spectra(drive: DriveFit) -> Figure:
    signals = _longest(drive)
    found = {r: power_spectrum(signals[r], drive.rate) for r in ("measured", "simulated", "before")}
    return plots.amplitude_spectra(
        found["measured"][0], {r: amplitude for r, (_, amplitude) in found.items()}, names=_NAMES
    )


def _by_road(drive: DriveFit) -> Figure:
    channel = drive.channel
    rows = drive.compared
    along, heights = drive.profile
    step = max(float(np.median(np.diff(along))), 1e-3) if along.size > 1 else 1.0
    waves = heights - uniform_filter1d(heights, max(3, round(_WAVE / step)), axis=0, mode="nearest")
    return plots.residual_by_road(
        drive.position[rows],
        (drive.measured[channel] - drive.after[channel])[rows],
        before=(drive.measured[channel] - drive.before[channel])[rows],
        profile=(along, waves) if along.size > 1 else None,
        profile_label=f"waves below\n{_WAVE:g} m [cm]",
        names=_NAMES,
    )


# -- characteristics -------------------------------------------------------------------------------


def _characteristics_section(result: CalibrationResult) -> Section:
    vehicles = {"before": result.start.vehicle, "simulated": result.twin.vehicle}
    travel, whole = (
        characteristics(
            vehicles,
            evidence={axle: _evidence(result, axle, from_rest) for axle in result.twin.axles},
            from_rest=from_rest,
        )
        for from_rest in (True, False)
    )
    text = (
        "Bands hold the force with a probability of 90 %. The drives excited the shaded range; beyond it a "
        "characteristic is extrapolated from its neighbouring points by a prior of smooth slopes. A spring is drawn "
        "over the travel from standstill first: its free length is hardly identifiable, since at rest every spring "
        "carries the same load; the second picture includes that uncertainty."
    )
    return Section(
        "Characteristics",
        text,
        travel,
        whole,
        captions=(
            "Springs over the travel from standstill, dampers over the velocity.",
            "Springs over the compression.",
        ),
    )


def _of_axle(result: CalibrationResult, axle: str) -> dict[str, CurveEstimate]:
    own = ".".join(word for word in ("vehicle", axle) if word)
    return {c.key.removeprefix(f"{own}."): c for c in result.curves if c.key.rpartition(".")[0] == own}


def _evidence(result: CalibrationResult, axle: str, from_rest: bool) -> AxleEvidence:
    """Bands, excited ranges and unidentified points of an axle; of its spring over the travel from standstill, or over
    the compression."""
    curves = _of_axle(result, axle)
    spring, unidentified = curves.get("spring"), _unidentified(result, axle)
    band, excited = _band(spring, 1.3), None
    if spring is not None and math.isfinite(spring.span[0]):
        excited = spring.span
    if from_rest:
        band = excited = None
        if spring is not None and spring.from_rest is not None:
            band = spring.from_rest
            excited = (spring.span[0] - spring.static, spring.span[1] - spring.static)
        unidentified = [(kind, x) for kind, x in unidentified if kind != "spring"]
    return AxleEvidence(
        spring=band,
        push=_band(curves.get("damper_push")),
        pull=_band(curves.get("damper_pull")),
        compression=excited,
        velocity=_velocity(curves),
        unexcited=unidentified,
    )


def _band(curve: CurveEstimate | None, reach: float = math.inf) -> Band | None:
    """The band up to ``reach`` times the farthest that was excited."""
    if curve is None:
        return None
    band = curve.band
    near = band.x <= (reach * curve.span[1] if math.isfinite(curve.span[1]) else math.inf)
    return Band(band.x[near], band.low[near], band.high[near])


def _velocity(curves: dict[str, CurveEstimate]) -> tuple[float, float] | None:
    reach = [curves[k].span[1] if k in curves else 0.0 for k in ("damper_pull", "damper_push")]
    return (-reach[0], reach[1]) if all(map(math.isfinite, reach)) else None


def _unidentified(result: CalibrationResult, axle: str) -> list[tuple[str, float]]:
    """Kind and abscissa of the points of an axle that the drives do not identify."""
    found = []
    for e in result.estimates:
        curve_key, _, index = e.key.rpartition(".force.")
        if curve_key and e.status not in ("identified", "on bound"):
            where, _, part = curve_key.removeprefix("vehicle.").rpartition(".")
            if where == axle:
                x = getattr(result.twin.axles[axle].part, part).points[0][int(index)]
                found.append((part.removeprefix("damper_"), float(x)))
    return found


# -- tables ----------------------------------------------------------------------------------------


def _interval(low: float, high: float) -> str:
    return f"{short(low)} to {short(high)}" if math.isfinite(low) else "–"


def _parameter_section(result: CalibrationResult) -> Section:
    rows = [
        [
            parameter_label(result.twin, e.key),
            parameter_unit(e.key),
            e.start,
            Cell(e.value, "bad", f"on its {e.on_bound} bound") if e.on_bound else Cell(e.value),
            _interval(e.low, e.high),
            _interval(e.lower, e.upper),
            Cell(e.status, _COLOURS[e.status], _MEANINGS[e.status]),
        ]
        for e in result.estimates
    ]
    columns = ["parameter", "unit", "start", "found", "90 % interval", "bounds", "status"]
    text = (
        "Values on a bound are coloured. An interval that does not hold its value shows that the bounds or the search "
        "held it back. It counts the error of the model too: that of a kept value may be wider than its prior's."
    )
    return Section("Parameters", text, Table(columns, rows, "Forces are at the wheel, for one wheel."))


def _sensor_section(result: CalibrationResult) -> Section:
    written = {True: Cell("in the twin file", "good"), False: Cell("left as it was", "soft")}
    rows = [
        [s.key, s.start, s.value, _interval(s.low, s.high), s.unit, written[s.written]] for s in result.sensor
    ]
    text = (
        "The latency of the IMU, its low-pass included, and how its mounting is turned against the starting file. A "
        "value goes into the twin file where that lowers the expected error of the calibrated vehicle on another "
        "drive: where it is off the start by more than 1.4 standard deviations given that vehicle. The interval holds "
        "for any vehicle."
    )
    return Section("Sensor", text, Table(["property", "start", "found", "90 % interval", "unit", ""], rows))


def _nuisance_section(result: CalibrationResult) -> Section:
    identified = {n.name for n in result.nuisances if n.sigma**2 <= 0.5 * n.prior**2}
    rows = [
        [
            n.name.replace("_", " "),
            n.value,
            n.sigma,
            n.unit,
            Cell("") if n.name in identified else Cell("not identified", "soft"),
        ]
        for n in result.nuisances
    ]
    text = (
        "Errors of clock, map, mount and sensor, estimated together with the vehicle's parameters. Only the values of "
        "the section above are in the twin file."
    )
    columns = ["nuisance parameter", "found", "± (one sigma)", "unit", ""]
    return Section("Nuisances", text, Table(columns, rows))


def _search_section(result: CalibrationResult) -> Section:
    history = result.history
    if len(history) < 2:
        return Section("The search", "It ended before its first generation.")
    stages = []
    refined = np.flatnonzero(history[:, 3] == 1)
    if refined.size:
        stages.append((float(history[refined[0], 0]), "refine"))
    mean = history[:, 2] if np.isfinite(history[:, 2]).all() and result.preset == "paper" else None
    figure = plots.convergence(history[:, 0], history[:, 1], mean=mean, stages=stages)
    text = f"{result.evaluations} candidates were simulated over every drive, in {result.generations} generations."
    if result.preset == "paper":
        text += " The car paper needed 10 842."
    return Section("The search", text, figure)
