# SPDX-License-Identifier: Apache-2.0
"""OpenCRG's options, modifiers and odd grids, on files written by the OpenCRG tools' own writer."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycrg
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError
from suspension_twin.road import curved_road, grid_road, load_road, write_road

EVEN, UNEVEN = np.linspace(-1.5, 1.5, 7), np.array([-1.5, -1.2, -0.3, 0.1, 0.9, 1.5])


def _write(path: Path, v: Any = UNEVEN, **more: Any) -> Path:
    rng = np.random.default_rng(3)
    pycrg.write(path, rng.normal(0, 0.05, (41, v.size)), 0.5, v, u0=5.0, **more)
    return path


def _compare(path: Path, crg: Any, spread: float = 1.7) -> None:
    """Everywhere where the library has a height ours is the same, and nowhere else do we make one up."""
    road = load_road(path)
    rng = np.random.default_rng(5)
    u = rng.uniform(5.0 - 20.0 * spread, 25.0 + 20.0 * spread, 3000)
    v = rng.uniform(-1.5 - 3.0 * spread, 1.5 + 3.0 * spread, 3000)
    expected = crg.z_uv(u, v)
    given_ = np.isfinite(expected)
    np.testing.assert_allclose(road.heights_uv(u[given_], v[given_]), expected[given_], rtol=0, atol=1e-12)
    if not given_.all():
        with pytest.raises(InputError, match="off the road"):
            road.heights_uv(u[~given_], v[~given_])


@pytest.mark.parametrize("v", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("mode_v", range(5))
@pytest.mark.parametrize("mode_u", range(5))
def test_border_modes(
    tmp_path: Path, reference: Callable[[Path], Any], mode_u: int, mode_v: int, v: Any
) -> None:
    options = {
        "border_mode_u": mode_u,
        "border_mode_v": mode_v,
        "border_offset_u": 0.3,
        "border_offset_v": -0.2,
    }
    path = _write(tmp_path / "a.crg", v, opts=options, banking=0.05, slope=0.02)
    _compare(path, reference(path))


@pytest.mark.parametrize("mode_u", range(1, 5))
def test_smoothing_zones(tmp_path: Path, reference: Callable[[Path], Any], mode_u: int) -> None:
    options = {"border_mode_u": mode_u, "border_smooth_ubeg": 3.0, "border_smooth_uend": 2.0}
    path = _write(tmp_path / "a.crg", opts=options, slope=0.03, z0=4.0, mods={})
    _compare(path, reference(path))


def test_smoothing_zones_under_the_default_modifiers(
    tmp_path: Path, reference: Callable[[Path], Any]
) -> None:
    path = _write(tmp_path / "a.crg", opts={"border_smooth_ubeg": 3.0, "border_smooth_uend": 2.0}, z0=4.0)
    _compare(path, reference(path))


_MODS = [
    {},
    {"scale_z_grid": 2.0, "scale_slope": 0.5, "scale_banking": 3.0},
    {"scale_length": 2.0, "scale_width": 0.5},
    {"scale_curvature": 0.3},
    {"grid_nan_mode": 0},
    {"grid_nan_mode": 1, "grid_nan_offset": 0.1},
    {"grid_nan_mode": 2, "grid_nan_offset": -0.1},
    {"refline_offset_x": 10.0, "refline_offset_y": -4.0, "refline_offset_z": 1.0, "refline_offset_phi": 0.7},
    {
        "refpoint_u_fraction": 0.5,
        "refpoint_v": 0.5,
        "refpoint_x": 3.0,
        "refpoint_y": 4.0,
        "refpoint_phi": 2.0,
    },
    {"refpoint_u": 15.0, "refpoint_z": 7.0},
]


@pytest.mark.parametrize("mods", [None, *_MODS], ids=str)
def test_modifiers(
    tmp_path: Path, reference: Callable[[Path], Any], mods: dict[str | int, float] | None
) -> None:
    path = tmp_path / "a.crg"
    z = np.random.default_rng(3).normal(0, 0.05, (41, 6))
    z[4:9, 0], z[28:33, -2:] = np.nan, np.nan
    phi = 0.4 + 0.02 * np.arange(40)
    pycrg.write(
        path, z, 0.5, UNEVEN, phi, u0=5.0, x0=50.0, y0=20.0, z0=2.0, slope=0.03, banking=0.02, mods=mods
    )
    crg = reference(path)
    road = load_road(path)
    u0, u1, v0, v1 = crg.span
    assert (road.u_first, road.u_last, road.v[0], road.v[-1]) == pytest.approx(crg.span, abs=1e-12)
    rng = np.random.default_rng(5)
    u, v = rng.uniform(u0 - 2, u1 + 2, 2000), rng.uniform(v0 - 0.5, v1 + 0.5, 2000)
    x, y = crg.to_xy(u, v)
    expected = crg.z_xy(x, y)
    given_ = np.isfinite(expected)
    np.testing.assert_allclose(road.heights(x, y)[given_], expected[given_], rtol=0, atol=1e-9)
    np.testing.assert_allclose(road.uv_to_xy(u, v), (x, y), rtol=0, atol=1e-9)


def test_a_reference_point_without_a_height_is_refused(tmp_path: Path) -> None:
    z = np.zeros((41, 6))
    z[18:23, -2:] = np.nan
    mods: dict[str | int, float] = {"refpoint_u_fraction": 0.5, "refpoint_v": 1.2, "refpoint_z": 3.0}
    pycrg.write(tmp_path / "a.crg", z, 0.5, UNEVEN, slope=0.1, mods=mods)
    with pytest.raises(InputError, match=r"a.crg: \$ROAD_CRG_MODS: the reference point"):
        load_road(tmp_path / "a.crg")


@pytest.mark.parametrize("close", [0, 1])
@pytest.mark.parametrize("gap", [0.05, 0.3])
def test_closed_tracks(tmp_path: Path, reference: Callable[[Path], Any], close: int, gap: float) -> None:
    n = 200
    phi = np.linspace(0, 2 * np.pi - gap, n)
    z = 0.1 * np.sin(np.arange(n + 1)[:, None] / 7 + UNEVEN)
    path = tmp_path / "ring.crg"
    pycrg.write(
        path, z, 0.5, UNEVEN, np.mod(phi + np.pi, 2 * np.pi) - np.pi, opts={"refline_continuation": close}
    )
    crg = reference(path)
    road = load_road(path)
    assert road.borders.close_span is not None
    assert road.borders.close == bool(close)
    u = np.linspace(-150, 320, 4001)
    v = 1.4 * np.sin(u)
    np.testing.assert_allclose(road.heights_uv(u, v), crg.z_uv(u, v), rtol=0, atol=1e-12)
    np.testing.assert_allclose(road.uv_to_xy(u, v), crg.to_xy(u, v), rtol=0, atol=1e-9)
    x, y = road.uv_to_xy(np.linspace(0, 100, 3001), 1.4 * np.sin(np.arange(3001)))
    np.testing.assert_allclose(road.heights(x, y), crg.z_xy(x, y), rtol=0, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    sharpness=st.floats(0.0, 0.3),
    step=st.floats(0.02, 2.0),
    count=st.integers(2, 300),
    uneven=st.booleans(),
)
def test_winding_roads_are_read_as_the_library_reads_them(
    seed: int, sharpness: float, step: float, count: int, uneven: bool
) -> None:
    rng = np.random.default_rng(seed)
    v = np.cumsum(rng.uniform(0.1, 0.8, 6)) - 1.5 if uneven else np.linspace(-1.2, 1.2, 6)
    # Bends that keep their centre off the road, or it would overlap itself.
    turn = np.cumsum(rng.uniform(-1, 1, count)) * sharpness
    turn = np.clip(turn, -0.5 * step, 0.5 * step) / max(-v[0], v[-1], 1.0)
    phi = np.cumsum(turn)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "winding.crg"
        z = rng.normal(0, 0.1, (count + 1, 6))
        pycrg.write(
            path, z, step, v, phi, mods={}, fmt="KDBI", banking=0.03, slope=0.01 * np.sin(phi), check=False
        )
        road = load_road(path)
        with pycrg.DataSet.open(path) as data, data.create_contact_point() as point:
            point.set_history(0)
            u = np.sort(rng.uniform(0.0, step * count, 300))
            w = rng.uniform(v[0], v[-1], 300)
            x, y = point.uv_to_xy_many(u, w)
            np.testing.assert_allclose(road.uv_to_xy(u, w), (x, y), rtol=0, atol=1e-9)
            u_crg, v_crg = point.xy_to_uv_many(x, y)
            ours = road.xy_to_uv(x, y)
            z_crg = point.xy_to_z_many(x, y)
    # A road that crosses itself has two answers; ours is right if it leads back to the place.
    same = np.hypot(ours[0] - u_crg, ours[1] - v_crg) < 1e-8
    back = np.hypot(*(a - b for a, b in zip(road.uv_to_xy(*ours), (x, y), strict=True)))
    assert (same | (back < 1e-8)).all()
    np.testing.assert_allclose(road.heights(x, y)[same], z_crg[same], rtol=0, atol=1e-7)
    if abs(phi).max() < 1.5:
        assert same.all()


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    bend=st.floats(-0.1, 0.1),
    heading=st.floats(-10, 10),
    uneven=st.booleans(),
    holes=st.booleans(),
)
def test_a_road_written_is_read_back_equal(
    seed: int, bend: float, heading: float, uneven: bool, holes: bool
) -> None:
    rng = np.random.default_rng(seed)
    v = UNEVEN if uneven else EVEN
    z = rng.normal(0, 0.3, (60, v.size))
    if holes:
        z[10:20, :2], z[30:33, -1] = np.nan, np.nan
    road = grid_road(z, float(rng.uniform(0.01, 1)), v, x=rng.uniform(-1e4, 1e4), y=3.0, heading=heading)
    road = curved_road(road, bend * rng.uniform(0, 1, 59)) if bend else road
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.crg"
        write_road(
            road, path, comment="two lines\n$ of comment that goes on for more than OpenCRG lets a line be"
        )
        back = load_road(path)
        assert [p.name for p in Path(folder).iterdir()] == ["r.crg"]
    np.testing.assert_array_equal(back.z, road.z)
    np.testing.assert_allclose(back.v, road.v, rtol=0, atol=1e-12)
    np.testing.assert_allclose((back.x, back.y), (road.x, road.y), rtol=0, atol=1e-8)
    assert back.u_step == pytest.approx(road.u_step, rel=1e-14)
    assert back.straight == road.straight
    np.testing.assert_allclose(
        np.exp(1j * np.array(back.headings)), np.exp(1j * np.array(road.headings)), atol=1e-9
    )


def test_slope_banking_and_options_survive_writing(tmp_path: Path, reference: Callable[[Path], Any]) -> None:
    options = {"border_mode_u": 4, "border_offset_u": 0.1, "border_smooth_uend": 2.0}
    phi = np.linspace(0, 0.5, 40)
    first = load_road(
        _write(tmp_path / "a.crg", phi=phi, slope=0.1 * phi, banking=np.linspace(0, 0.1, 41), opts=options)
    )
    write_road(first, tmp_path / "b.crg")
    again = load_road(tmp_path / "b.crg")
    u, v = np.linspace(-20, 50, 900), 2 * np.sin(np.arange(900))
    # The default modifiers of the first file left heights off the single-precision grid.
    np.testing.assert_allclose(again.heights_uv(u, v), first.heights_uv(u, v), rtol=0, atol=2e-8)
    np.testing.assert_allclose(again.uv_to_xy(u, v), first.uv_to_xy(u, v), rtol=0, atol=1e-8)


def test_what_the_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    z = np.zeros((10, 5))
    z[3, 2] = np.nan
    with pytest.raises(InputError, match="NaN between valid values"):
        write_road(grid_road(z, 0.1, np.arange(5.0)), tmp_path / "a.crg")
    assert list(tmp_path.iterdir()) == []
