# SPDX-License-Identifier: Apache-2.0
"""The parameters of the pose injector and what they make: the lock's settings and the map's origin."""

from __future__ import annotations

from suspension_twin.nodes._files import filter_of, twin_of
from suspension_twin.nodes._parameters import Param, Values
from suspension_twin.pose.settings import PoseSettings
from suspension_twin.vehicle.twin import Datum

__all__ = ["POSE", "datum_of", "settings_of"]

_DEFAULT = PoseSettings()
_SETTINGS = (
    ("fix_sigma", "Standard deviation in m of a fix whose receiver gives no covariance.", 0.001, 1000.0),
    ("fix_floor", "Least standard deviation in m of a fix that is believed.", 1e-4, 100.0),
    ("fix_ceiling", "Largest standard deviation in m of a fix that is of use.", 0.01, 1000.0),
    ("velocity_sigma", "Standard deviation in m/s of a GPS velocity.", 1e-3, 10.0),
    ("heading_sigma", "Standard deviation in rad of a heading.", 1e-4, 3.0),
    ("gate", "Standard deviations beyond which a measurement is an outlier.", 1.0, 100.0),
    ("align_speed", "Speed in m/s from which the course gives the first yaw.", 0.1, 20.0),
    ("outage", "Seconds without a fix after which the pose is no longer valid.", 0.1, 600.0),
    ("blend", "Seconds over which a correction is bled into the pose.", 0.01, 10.0),
    ("blend_speed", "Speed in m/s at which a correction may move the pose at most.", 0.01, 50.0),
    ("snap", "Distance in m from which a correction is jumped at once.", 0.1, 1000.0),
    ("history", "Seconds that a fix may come late and still be used.", 0.1, 10.0),
)
_FAST = 20_000.0  # Hz
POSE = (
    Param(
        "imu_delay",
        -1.0,
        "Seconds by which imu/data lags what it measures; below 0: the delay of the low-pass above.",
        -1.0,
        0.2,
    ),
    Param(
        "datum.source",
        "twin",
        "Origin of the map: the twin file's (the first fix where it has none), the first fix, or the parameters "
        "datum.latitude, datum.longitude and datum.altitude.",
        choices=("twin", "first_fix", "parameters"),
    ),
    Param("datum.latitude", 0.0, "Degrees on WGS 84.", -90.0, 90.0),
    Param("datum.longitude", 0.0, "Degrees on WGS 84.", -180.0, 180.0),
    Param("datum.altitude", 0.0, "Metres above the ellipsoid.", -1000.0, 20000.0),
    *(Param(name, getattr(_DEFAULT, name), text, low, high) for name, text, low, high in _SETTINGS),
)


def settings_of(values: Values) -> PoseSettings:
    """How the pose is locked; raises InputError where the values do not fit together."""
    given = values["imu_delay"]
    # The delay of a low-pass hardly depends on the rate it is sampled at; this is that of a fast one.
    delay = filter_of(values).delay(_FAST) if given < 0 else given
    return PoseSettings(imu_delay=delay, **{name: values[name] for name, *_ in _SETTINGS})


def datum_of(values: Values) -> Datum | None:
    """The origin of the map, None for the first fix."""
    if values["datum.source"] == "parameters":
        return Datum(**{k: values[f"datum.{k}"] for k in ("latitude", "longitude", "altitude")})
    twin = twin_of(values)
    return None if twin is None or values["datum.source"] == "first_fix" else twin.datum
