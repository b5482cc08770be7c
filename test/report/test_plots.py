# SPDX-License-Identifier: Apache-2.0
"""The plots show the numbers they were given: read back from the drawn artists."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given, strategies as st

from suspension_twin.calibration.request import Band
from suspension_twin.report import plots, style
from suspension_twin.report.characteristics import (
    AxleEvidence,
    characteristics,
    force,
)
from suspension_twin.vehicle.twin import Vehicle

COLOURS = style.COLOURS


def lines(axes, role):
    return [line for line in axes.get_lines() if line.get_color() == COLOURS[role]]


@pytest.fixture
def vehicle() -> Vehicle:
    axle = {
        "unsprung_mass": 40.0,
        "spring": {"compression": [0.1, 0.3], "force": [2300.0, 7000.0]},
        "damper_push": {"velocity": [0.1, 0.4], "force": [200.0, 720.0]},
        "damper_pull": {"velocity": [0.1, 0.4], "force": [450.0, 1430.0]},
    }
    return Vehicle.model_validate(
        {
            "mass": 1725.0,
            "wheelbase": 2.85,
            "front_track": 1.588,
            "rear_track": 1.605,
            "cog": [1.5, 0.0, 0.55],
            "sprung_inertia": {"roll": 550.0, "pitch": 2600.0},
            "tyre": {"radius": 0.316, "vertical_stiffness": 210000.0},
            "front": axle,
            "rear": axle,
        }
    )


def test_time_plot_shows_both_signals_and_their_difference():
    t = 100.0 + np.arange(50) * 0.01
    measured, simulated, before = np.sin(t), 0.9 * np.sin(t), np.zeros(50)
    fig = plots.in_time(t, measured, simulated, before=before)
    top, strip = fig.axes
    np.testing.assert_allclose(lines(top, "measured")[0].get_xydata(), np.column_stack([t - 100.0, measured]))
    np.testing.assert_array_equal(lines(top, "simulated")[0].get_ydata(), simulated)
    np.testing.assert_array_equal(lines(strip, "ink")[0].get_ydata(), measured - simulated)
    np.testing.assert_array_equal(lines(strip, "before")[0].get_ydata(), measured)
    assert {text.get_text() for text in fig.legends[0].texts} == {
        "measured",
        "simulated",
        "before calibration",
    }


def test_time_plot_cuts_windows_on_one_scale():
    t = np.arange(1000) * 0.01
    y = np.where(t < 5, t, -3 * t)
    fig = plots.in_time(t, y, y, windows=[plots.Window(1, 2, "one"), plots.Window(8, 9, "two")], origin=1.0)
    one, two = fig.axes[0], fig.axes[1]
    assert (one.get_title(loc="left"), two.get_title(loc="left")) == ("one", "two")
    assert one.get_ylim() == two.get_ylim()
    x = lines(two, "measured")[0].get_xdata()
    assert (x.min(), x.max()) == pytest.approx((7.0, 8.0))


def test_spectrum_keeps_to_its_limits_and_survives_zeros():
    f = np.linspace(0, 50, 501)
    density = np.where(f < 10, 1.0, 0.0)
    fig = plots.in_frequency(f, {"residual": density, "measured": density}, limits=(1.0, 20.0), cutoff=15.0)
    x = lines(fig.axes[0], "measured")[0].get_xdata()
    assert (x.min(), x.max()) == pytest.approx((1.0, 20.0))
    low, high = fig.axes[0].get_ylim()
    assert 0 < low < 1 < high
    assert style.svg(fig)


def test_the_paper_s_spectrum_is_drawn_once():
    f = np.linspace(-50, 50, 1001)
    fig = plots.amplitude_spectra(f, {"measured": np.abs(f), "simulated": f**2}, names={"simulated": "msd"})
    drawn = lines(fig.axes[0], "measured")[0].get_xydata()
    np.testing.assert_allclose(drawn[:, 1], np.abs(drawn[:, 0]))
    assert (drawn[0, 0], drawn[-1, 0]) == pytest.approx((0, 10))
    assert [t.get_text() for t in fig.legends[0].texts] == ["measured", "msd"]


def test_map_keeps_distances_true_and_says_where_it_starts():
    x, y = np.linspace(0, 80, 2000), np.linspace(0, 20, 2000)
    border = np.array([[0, -3], [80, 17], [80, 23], [0, 3.0]])
    fig = plots.path_map(x, y, outline=border, fixes=np.column_stack([x, y])[::100], value=x)
    assert fig.axes[0].get_aspect() == 1.0
    pieces = next(c for c in fig.axes[0].collections if hasattr(c, "get_segments")).get_segments()
    assert len(pieces) < 500
    np.testing.assert_allclose([pieces[0][0], pieces[-1][1]], [[0, 0], [80, 20]])
    start = lines(fig.axes[0], "truth")[0]
    np.testing.assert_allclose(start.get_xydata(), [[0, 0]])


def test_a_turned_map_says_where_north_is():
    x, y = np.zeros(50), np.linspace(0, 90, 50)  # due north
    fig = plots.path_map(x, y, turn=-np.pi / 2)
    axes = fig.axes[0]
    end = lines(axes, "bound")[0].get_xydata()
    np.testing.assert_allclose(end, [[90, 0]], atol=1e-9)
    (north,) = axes.texts
    assert north.get_text() == "N"
    np.testing.assert_allclose(north.get_position(), [28, 0], atol=1e-9)


def test_residual_by_road_is_the_rms_of_each_metre():
    distance = np.repeat(np.arange(5) + 0.5, 10)
    residual = np.repeat([1.0, 2.0, np.nan, 4.0, 5.0], 10) * np.tile([1.0, -1.0], 25)
    fig = plots.residual_by_road(distance, residual, profile=(np.arange(5.0), np.zeros(5)))
    values = fig.axes[0].patches[0].get_data().values
    np.testing.assert_allclose(values, [1, 2, np.nan, 4, 5])


def test_convergence_draws_steps_and_goes_logarithmic_only_when_worth_it():
    n = np.array([100.0, 200.0, 300.0])
    assert plots.convergence(n, np.array([10.0, 5.0, 0.1])).axes[0].get_yscale() == "log"
    fig = plots.convergence(
        n, np.array([10.0, 9.0, 8.0]), mean=np.array([20.0, 15.0, 12.0]), stages=[(200.0, "refine")]
    )
    assert fig.axes[0].get_yscale() == "linear"
    np.testing.assert_array_equal(lines(fig.axes[0], "simulated")[0].get_ydata(), [10, 9, 8])


def test_agreement_draws_a_bar_for_every_figure_given():
    fig = plots.agreement({"a": {"before": 2.0, "simulated": 0.5}, "b": {"before": 3.0, "simulated": 1.0}})
    assert sorted(p.get_width() for p in fig.axes[0].patches) == [0.5, 1.0, 2.0, 3.0]


@given(
    st.lists(st.tuples(st.floats(0.01, 1), st.floats(0, 1e4)), min_size=1, max_size=8),
    st.floats(0, 10),
)
def test_force_passes_through_its_points_and_goes_on_with_the_last_slope(steps, beyond):
    x = np.cumsum([s[0] for s in steps])
    f = np.cumsum([s[1] for s in steps])
    np.testing.assert_allclose(force((x, f), np.concatenate([[0.0], x])), np.concatenate([[0.0], f]))
    slope = steps[-1][1] / steps[-1][0]
    np.testing.assert_allclose(
        force((x, f), np.array([x[-1] + beyond])), f[-1] + slope * beyond, rtol=1e-6, atol=1e-6
    )


def test_standing_springs_carry_the_weight(vehicle):
    """Front 1725 kg x 1.5 / 2.85 on two wheels less 40 kg each; the curve is 2300 N at 0.1 m, 23.5 kN/m beyond."""
    load = (1725.0 * 1.5 / 2.85 / 2 - 40.0) * 9.80665
    assert vehicle.axles["front"].static_compression == pytest.approx(0.1 + (load - 2300.0) / 23_500.0)
    total = sum(
        2 * force(vehicle.front.spring.points, np.array([vehicle.axles[a].static_compression]))[0]
        for a in ("front", "rear")
    )
    assert total == pytest.approx((1725.0 - 160.0) * 9.80665)
    heavy = vehicle.model_copy(update={"mass": 4000.0})
    x = heavy.axles["front"].static_compression
    assert x > 0.3
    assert force(heavy.front.spring.points, np.array([x]))[0] == pytest.approx(
        (4000.0 * 1.5 / 2.85 / 2 - 40.0) * 9.80665
    )


def test_springs_from_standstill_meet_where_the_car_stands(vehicle):
    axle = vehicle.front.model_copy(
        update={"spring": vehicle.front.spring.model_copy(update={"force": (900.0, 6000.0)})}
    )
    other = vehicle.model_copy(update={"front": axle})
    evidence = AxleEvidence(compression=(-0.03, 0.02))
    fig = characteristics(
        {"before": vehicle, "simulated": other}, evidence={"front": evidence}, from_rest=True
    )
    load = (1725.0 * 1.5 / 2.85 / 2 - 40.0) * 9.80665 / 1e3
    for role in ("before", "simulated"):
        x, y = lines(fig.axes[0], role)[0].get_xydata().T
        assert np.interp(0.0, x, y) == pytest.approx(load)
        assert (x.min(), x.max()) == pytest.approx((-0.0345, 0.0345))


def test_characteristics_draw_rebound_downwards_and_mark_what_was_not_excited(vehicle):
    evidence = AxleEvidence(
        spring=Band(np.array([0.1, 0.2]), np.array([2000.0, 4000.0]), np.array([2600.0, 5000.0])),
        compression=(0.12, 0.2),
        velocity=(-0.3, 0.3),
        unexcited=[("pull", 0.1)],
    )
    fig = characteristics({"simulated": vehicle, "truth": vehicle}, evidence={"front": evidence})
    spring, _, damper, _ = fig.axes
    assert spring.get_xlim()[1] == pytest.approx(1.15 * 0.2)
    drawn = [line.get_xydata() for line in lines(damper, "simulated")]
    pulled = next(d for d in drawn if d[:, 0].min() < -0.3)
    np.testing.assert_allclose(pulled[-1], [-0.345, -(0.45 + 0.98 * 0.245 / 0.3)], rtol=1e-9)
    hollow = lines(damper, "bound")[0]
    np.testing.assert_allclose(hollow.get_xydata(), [[-0.1, -0.45]])
    assert len(lines(fig.axes[3], "bound")) == 0


def test_style_leaves_the_user_s_settings_alone():
    before = dict(mpl.rcParams)
    t = np.arange(10.0)
    style.png(plots.in_time(t, t, t))
    style.svg(plots.in_time(t, t, t))
    assert dict(mpl.rcParams) == before


def test_figures_are_saved_by_their_suffix(tmp_path):
    t = np.arange(10.0)
    fig = plots.in_time(t, t, t)
    style.save(fig, tmp_path / "new" / "a.png")
    style.save(fig, tmp_path / "a.svg")
    assert (tmp_path / "new" / "a.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert "<svg" in (tmp_path / "a.svg").read_text()


@pytest.mark.parametrize(("last", "end"), [(2.5, 2.5), (60.0, 25.0)])
def test_the_axis_of_frequency_ends_with_the_spectra(last, end):
    frequency = np.linspace(0.0, last, 64)
    axes = plots.in_frequency(frequency, {"measured": np.ones(64), "residual": np.full(64, 0.1)}).axes[0]
    assert axes.get_xlim() == pytest.approx((0.5, end))
    assert max(axes.get_xticks()) <= end
