# SPDX-License-Identifier: Apache-2.0
"""The tangent plane against an independent formula, there and back, and at coordinates far from nought."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from suspension_twin.pose.local_map import LocalMap
from suspension_twin.vehicle.twin import Datum

A, F = 6378137.0, 1 / 298.257223563  # WGS 84


def ecef(latitude: float, longitude: float, height: float) -> np.ndarray:
    """Earth-centred coordinates by the textbook formula."""
    phi, lam = math.radians(latitude), math.radians(longitude)
    e2 = F * (2 - F)
    n = A / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    return np.array(
        [
            (n + height) * math.cos(phi) * math.cos(lam),
            (n + height) * math.cos(phi) * math.sin(lam),
            (n * (1 - e2) + height) * math.sin(phi),
        ]
    )


def by_hand(datum: Datum, latitude: float, longitude: float, height: float) -> np.ndarray:
    """East, north, up as the projection of the earth-centred difference on the datum's axes."""
    phi, lam = math.radians(datum.latitude), math.radians(datum.longitude)
    d = ecef(latitude, longitude, height) - ecef(datum.latitude, datum.longitude, datum.altitude)
    east = np.array([-math.sin(lam), math.cos(lam), 0.0])
    up = np.array([math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)])
    return np.array([d @ east, d @ np.cross(up, east), d @ up])


LATITUDE, LONGITUDE = st.floats(-85, 85), st.floats(-180, 180)
STEP, HEIGHT = st.floats(-0.1, 0.1), st.floats(-400, 4000)


@given(LATITUDE, LONGITUDE, HEIGHT, STEP, STEP, HEIGHT)
@settings(max_examples=200, deadline=None)
def test_against_the_textbook_and_back(
    lat: float, lon: float, alt: float, dlat: float, dlon: float, height: float
) -> None:
    assume(abs(lat + dlat) < 85 and abs(lon + dlon) <= 180)
    datum = Datum(latitude=lat, longitude=lon, altitude=alt)
    place = LocalMap(datum)
    point = place.to_map(lat + dlat, lon + dlon, height)
    assert point == pytest.approx(by_hand(datum, lat + dlat, lon + dlon, height), abs=2e-6)
    again = place.to_geodetic(point)
    assert again[:2] == pytest.approx([lat + dlat, lon + dlon], abs=1e-10)
    assert again[2] == pytest.approx(height, abs=1e-5)


def test_arrays_keep_their_shape() -> None:
    place = LocalMap(Datum(latitude=47.0, longitude=19.0))
    lat = 47.0 + np.linspace(0, 0.01, 12).reshape(3, 4)
    points = place.to_map(lat, 19.0 + 0 * lat, 0 * lat)
    assert points.shape == (3, 4, 3)
    assert place.to_geodetic(points)[..., 0] == pytest.approx(lat, abs=1e-11)


def test_the_datum_is_the_origin_and_axes_point_east_north_up() -> None:
    place = LocalMap(Datum(latitude=47.0, longitude=19.0, altitude=100.0))
    assert place.to_map(47.0, 19.0, 100.0) == pytest.approx([0, 0, 0], abs=1e-9)
    assert place.to_map(47.0, 19.001, 100.0)[0] > 70
    assert place.to_map(47.001, 19.0, 100.0)[1] > 110
    assert place.to_map(47.0, 19.0, 101.0) == pytest.approx([0, 0, 1], abs=1e-9)
