# SPDX-License-Identifier: Apache-2.0
"""Excited segments of a drive with bursts at known times."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from suspension_twin.drive.read import read_drive
from suspension_twin.inference.excited_segments import TrimSettings, excited, fit_rows, trim
from suspension_twin.inference.observation import Observation, observe

FLOOR = 0.05
#: Short ones, for a drive of six seconds.
SHORT = TrimSettings(threshold=4.0, window=0.11, before=0.2, after=0.5, bridge=0.8, lead=0.4, slowest=0.8)


@pytest.fixture(scope="module")
def drive(pass_case: Any) -> Observation:
    """Six seconds at 4.2 m/s in which nothing happens, all samples usable."""
    found = observe(read_drive(pass_case.bag("pass")), pass_case.truth)
    still = replace(
        found,
        measured={k: 0.0 * v for k, v in found.measured.items()},
        noise_rms=dict.fromkeys(found.noise_rms, FLOOR),
    )
    return usable(still, np.ones(found.t.size, dtype=np.bool_))


def usable(drive: Observation, mask: np.ndarray) -> Observation:
    """The drive with samples (m,) that can be compared."""
    return replace(drive, mask=mask)


def driven_at(drive: Observation, speed: np.ndarray) -> Observation:
    """The drive at other speeds (m,) in m/s."""
    source = drive.source
    ahead = np.interp(source.trajectory.t, drive.t, speed)
    path = replace(source.trajectory, velocity=np.column_stack([ahead, 0.0 * ahead]))
    return replace(drive, reading=replace(source, trajectory=path))


def seconds(drive: Observation) -> np.ndarray:
    return drive.t - drive.t[0]


def wave(drive: Observation, rms: float = 1.0) -> np.ndarray:
    """Of that rms within any eighteenth of a second."""
    return rms * np.sqrt(2.0) * np.sin(2 * np.pi * 18.0 * seconds(drive))


def shaken(drive: Observation, *bursts: tuple[float, float], rms: float = 1.0) -> Observation:
    """The drive with a wave from and until each of some times."""
    t = seconds(drive)
    on = np.any([(t >= a) & (t <= b) for a, b in bursts], axis=0)
    return replace(drive, measured={**drive.measured, "vertical_acceleration": on * wave(drive, rms)})


# -- excited ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("floor", [FLOOR, 0.2])
def test_the_threshold_is_in_units_of_the_noise(drive: Observation, floor: float) -> None:
    noisy = replace(drive, noise_rms={**drive.noise_rms, "vertical_acceleration": floor})
    for share, every in ((0.9, False), (1.1, True)):
        whole = shaken(noisy, (0.0, 9.0), rms=share * 4.0 * floor)
        found = excited(whole, SHORT)[60:-60]
        assert found.all() if every else not found.any()
        assert excited(whole, replace(SHORT, threshold=2.0))[60:-60].all()


def test_a_sensor_without_noise_has_some_all_the_same(drive: Observation) -> None:
    """Else rounding would be excitation."""
    quiet = replace(drive, noise_rms=dict.fromkeys(drive.noise_rms, 0.0))
    assert not excited(shaken(quiet, (0.0, 9.0), rms=1e-5), SHORT).any()
    assert excited(shaken(quiet, (0.0, 9.0), rms=1.0), SHORT).all()


def test_grade_and_bias_are_no_excitation(drive: Observation) -> None:
    t = seconds(drive)
    slow = 1.0 + 0.5 * t
    graded = replace(drive, measured={**drive.measured, "vertical_acceleration": slow})
    assert not excited(graded, SHORT)[120:-120].any()
    burst = shaken(drive, (2.5, 3.0))
    both = replace(
        burst,
        measured={
            **burst.measured,
            "vertical_acceleration": slow + burst.measured["vertical_acceleration"],
        },
    )
    np.testing.assert_array_equal(excited(both, SHORT)[120:-120], excited(burst, SHORT)[120:-120])


@pytest.mark.parametrize("before, after", [(0.0, 0.0), (0.2, 0.5), (0.7, 0.1)])
def test_some_time_before_and_after_is_kept(drive: Observation, before: float, after: float) -> None:
    settings = replace(SHORT, before=before, after=after)
    active = excited(shaken(drive, (2.5, 3.0)), settings)
    core = np.flatnonzero(excited(shaken(drive, (2.5, 3.0)), replace(SHORT, before=0.0, after=0.0)))
    found = np.flatnonzero(active)
    assert (np.diff(found) == 1).all()
    assert core[0] - found[0] == int(before * drive.rate) and found[-1] - core[-1] == int(after * drive.rate)
    # the window reaches half of itself to either side of the burst
    t = seconds(drive)
    assert t[core[0]] == pytest.approx(2.5 - 0.055, abs=0.02) and t[core[-1]] == pytest.approx(
        3.055, abs=0.02
    )


def test_at_the_ends_of_a_drive_there_is_less_to_keep(drive: Observation) -> None:
    active = np.flatnonzero(excited(shaken(drive, (0.0, 0.1), (5.9, 9.0)), SHORT))
    assert active[0] == 0 and active[-1] == drive.t.size - 1
    assert np.diff(active).max() > 400


def test_a_wider_window_sees_farther(drive: Observation) -> None:
    burst = shaken(drive, (2.5, 3.0))
    count = [excited(burst, replace(SHORT, window=w)).sum() for w in (0.05, 0.11, 0.31)]
    # by half a window on either side
    np.testing.assert_allclose(np.diff(count), np.array([0.06, 0.2]) * drive.rate, atol=3)


@pytest.mark.parametrize("speed, moving", [(0.7, False), (0.9, True), (-0.7, False), (-0.9, True)])
def test_a_vehicle_has_to_move_either_way(drive: Observation, speed: float, moving: bool) -> None:
    slow = driven_at(shaken(drive, (0.0, 9.0)), np.full(drive.t.size, speed))
    assert excited(slow, SHORT).all() if moving else not excited(slow, SHORT).any()


def test_what_cannot_be_compared_is_not_excited(drive: Observation) -> None:
    """Nor does it excite what is beside it."""
    mask = np.ones(drive.t.size, dtype=np.bool_)
    mask[200:300] = False
    whole = usable(shaken(drive, (0.0, 9.0)), mask)
    np.testing.assert_array_equal(excited(whole, SHORT), mask)
    hidden = usable(shaken(drive, (2.2, 2.8)), mask)
    assert not excited(hidden, SHORT).any()


def test_settings_are_those_for_a_car_by_default() -> None:
    usual = TrimSettings()
    # a body oscillates for a second or two after a bump, and a transient has to decay before that
    assert usual.before < usual.after < usual.bridge and usual.window <= usual.before < usual.lead


# -- trim ------------------------------------------------------------------------------------------


def spans(parts: list[Observation], drive: Observation) -> list[tuple[float, float]]:
    return [(float(p.t[0] - drive.t[0]), float(p.t[-1] - drive.t[0])) for p in parts]


PAD = 1.0  # s on either side, for the transients of the filter


def test_a_segment_is_cut_out_with_its_lead(drive: Observation) -> None:
    burst = shaken(drive, (2.6, 2.8))
    active = seconds(drive)[np.flatnonzero(excited(burst, SHORT))]
    (part,) = trim(burst, SHORT)
    assert part is not burst
    ((begin, end),) = spans([part], drive)
    assert begin == pytest.approx(active[0] - SHORT.lead - PAD, abs=0.02)
    assert end == pytest.approx(active[-1] + PAD, abs=0.02)


def test_segments_end_where_the_drive_does(drive: Observation) -> None:
    last = float(seconds(drive)[-1])
    ((begin, end),) = spans(trim(shaken(drive, (0.5, 0.7)), SHORT), drive)
    assert begin == pytest.approx(0.0, abs=0.005) and end < 3.0
    ((begin, end),) = spans(trim(shaken(drive, (5.5, 5.7)), SHORT), drive)
    assert begin > 3.0 and last - end < 1.5 / drive.rate


def test_no_more_than_the_last_stamp_is_cut_off_at_the_end(drive: Observation) -> None:
    for count in range(560, 590, 5):
        whole = drive.part(drive.t[0], drive.t[count])
        late = float(seconds(whole)[-1])
        (part,) = trim(shaken(whole, (late - 0.3, late)), SHORT)
        assert part is not whole and part.signals.t[-1] >= whole.signals.t[-2]


def test_gaps_are_bridged_if_short(drive: Observation) -> None:
    """Between 2.3 - 0.055 - 0.2 s and the sample at 1.3 + 0.055 + 0.5 s nothing is excited: 0.19 s."""
    two = shaken(drive, (1.1, 1.3), (2.3, 2.5))
    active = seconds(drive)[np.flatnonzero(excited(two, SHORT))]
    assert np.diff(active).max() == pytest.approx(0.19, abs=0.03)
    for bridge, count in ((0.3, 1), (0.1, 2)):
        parts = trim(two, replace(SHORT, bridge=bridge))
        assert len(parts) == count
        ends = spans(parts, drive)
        assert ends[-1][1] == pytest.approx(active[-1] + PAD, abs=0.02)
        if count == 2:
            gap = int(np.argmax(np.diff(active)))
            assert ends[0][1] == pytest.approx(active[gap] + PAD, abs=0.02)
            assert ends[1][0] == pytest.approx(max(active[gap + 1] - SHORT.lead - PAD, 0.0), abs=0.02)


def test_a_drive_that_is_excited_all_over_is_left_whole(drive: Observation) -> None:
    """From nine tenths on, by its span with lead; two segments are cut even if they overlap."""
    last = float(seconds(drive)[-1])
    for share, whole in ((0.95, True), (0.85, False)):
        end = share * last - PAD - 0.5 - 0.055
        parts = trim(shaken(drive, (1.2, end)), SHORT)
        assert len(parts) == 1
        one = shaken(drive, (1.2, end))
        assert (trim(one, SHORT)[0] is one) == whole
    two = shaken(drive, (1.2, 2.0), (3.9, 4.6))
    assert sum(b - a for a, b in spans(trim(two, SHORT), drive)) > 0.95 * last
    assert len(trim(two, SHORT)) == 2


def test_a_calm_drive_has_no_segment(drive: Observation) -> None:
    assert trim(drive, SHORT) == [] and fit_rows(drive, SHORT).size == 0


# -- rows ------------------------------------------------------------------------------------------


def test_calm_between_excited_samples_is_compared(drive: Observation) -> None:
    two = shaken(drive, (1.5, 1.6), (4.5, 4.6))
    active = np.flatnonzero(excited(two, SHORT))
    assert np.diff(active).max() > 100
    np.testing.assert_array_equal(fit_rows(two, SHORT), np.arange(active[0], active[-1] + 1))


def test_standing_and_unusable_samples_between_are_not(drive: Observation) -> None:
    mask, speed = np.ones(drive.t.size, dtype=np.bool_), np.full(drive.t.size, -4.2)
    mask[300:310], speed[320:340] = False, 0.1
    two = driven_at(usable(shaken(drive, (1.5, 1.6), (4.5, 4.6)), mask), speed)
    active = np.flatnonzero(excited(two, SHORT))
    wanted = [i for i in range(active[0], active[-1] + 1) if not (300 <= i < 310 or 320 <= i < 340)]
    np.testing.assert_array_equal(fit_rows(two, SHORT), wanted)


@pytest.mark.parametrize("speed", [4.2, -4.2])
def test_the_lead_is_compared_only_after_a_standing_start(drive: Observation, speed: float) -> None:
    """A model begins at rest: what moved before had a transient of its own."""
    whole = driven_at(shaken(drive, (0.0, 9.0)), np.full(drive.t.size, speed))
    rows = fit_rows(whole, SHORT)
    np.testing.assert_array_equal(rows, np.flatnonzero(seconds(drive) > SHORT.lead))
    start = whole.speed.copy()
    start[:10] = 0.1
    stood = driven_at(whole, start)
    np.testing.assert_array_equal(fit_rows(stood, SHORT), np.arange(10, drive.t.size))
