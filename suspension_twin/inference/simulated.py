# SPDX-License-Identifier: Apache-2.0
"""The twin over a recorded drive, without ROS: what its topics would have carried, and the gap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import BagWriter
from suspension_twin.errors import InputError
from suspension_twin.files import Json
from suspension_twin.inference.gap import Comparison, Gap, write_gap
from suspension_twin.inference.observation import Observation, ObserveSettings, observe, road_of
from suspension_twin.inference.placement import in_reach, where_felt
from suspension_twin.models.sensor import to_sensor_axes
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import Response
from suspension_twin.road import Road
from suspension_twin.signals.filters import CausalLowPass
from suspension_twin.vehicle.twin import Twin

__all__ = ["SimulatedDrive", "simulate_drive"]

_LEAST_ON_ROAD = 0.02  # share of the moving drive


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedDrive(Comparison):
    """A twin over a drive: what :func:`simulate_drive` returns.

    Parameters
    ----------
    drive : Drive
        The recording.
    observation : Observation
        Its observation.
    response : Response
        The twin on the n kept IMU stamps.
    gap : Gap
        The gap over the whole drive.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> result = simulate_drive(read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml"))
    >>> result.as_dict()["drive"]
    'crg_road'
    """

    drive: Drive
    observation: Observation
    response: Response
    gap: Gap

    @cached_property
    def simulated(self) -> Mapping[str, Floats]:
        """(m,) simulated signal of each channel, m/s² and rad/s."""
        return self.observation.condition(self.response)

    def gap_from(self, t: float) -> Gap:
        """The gap over the driving from ``t`` s on; WorkError where there is none."""
        seen = self.observation
        later = replace(seen, mask=seen.mask & (seen.t >= t))
        return later.gap(self.simulated)

    def as_dict(self) -> Json:
        """Contents of ``gap.json``: the gap, and how it was measured."""
        spec = self.observation.settings.filter
        low_pass = {"kind": "Butterworth low-pass", "order": spec.order, "cutoff_hz": spec.cutoff}
        return {
            **self.gap.as_dict(),
            "drive": self.drive.name,
            "filter": {**low_pass, "zero_phase": True},
            "vertical_acceleration_topic_filter": {**low_pass, "zero_phase": False},
            "on_road": float(self.observation.inside.mean()),
            "off_road": self.observation.off_road.as_dict(),
            "warnings": list(self.observation.warnings),
        }

    def write(self, folder: Path) -> None:
        """Write ``folder/simulated`` (a rosbag2 folder, MCAP) and ``folder/gap.json``.

        One message of each topic for every IMU sample of the recording, at its own stamp. ``twin/imu`` is in
        the sensor's axes, gravity included, unfiltered; ``twin/vertical_acceleration`` and the measured
        ``imu/vertical_acceleration`` beside it in base_link axes, both through the live low-pass.
        """
        with BagWriter(folder / "simulated", overwrite=True) as bag:
            _write_topics(bag, self)
        write_gap(self.as_dict(), folder)


def simulate_drive(
    drive: Drive, twin: Twin, road: Road | None = None, settings: ObserveSettings | None = None
) -> SimulatedDrive:
    """Simulate a twin over the whole of a drive and measure the gap.

    Where the receiver leaves the place open, as a phone's does, the drive is placed where the twin's road was felt.

    Parameters
    ----------
    drive : Drive
        The recording.
    twin : Twin
        The twin.
    road : Road, optional
        The road; that of the twin file by default.
    settings : ObserveSettings, optional
        Filter, step, policy beyond the road's borders.

    Returns
    -------
    SimulatedDrive
        The observation of the drive, the response and the gap.

    Raises
    ------
    InputError
        Naming the drive and what it lacks: samples, fixes, or the road under it.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> result = simulate_drive(read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml"))
    >>> bool(result.gap.rms > 0.1)
    True
    """
    road = road_of(twin) if road is None else road
    observation = observe(drive, twin, road, settings)
    moving = np.abs(observation.speed) > 0.8
    if moving.any() and in_reach(observation).inside[moving].mean() < _LEAST_ON_ROAD:
        raise InputError(
            drive.name,
            f"is not on the road {road.name}: is it the road of this drive, and is the twin file's datum the origin "
            "of its x and y?",
        )
    observation = where_felt(observation, twin)
    response = simulate_twin(twin, observation.road_excitation)
    return SimulatedDrive(drive, observation, response, observation.gap(observation.condition(response)))


def _write_topics(bag: BagWriter, result: SimulatedDrive) -> None:
    observation, response = result.observation, result.response
    t, stamps = response.t, result.drive.imu.t
    place = observation.twin.imu
    attitude = Rotation.from_euler(
        "ZYX", np.column_stack([observation.trajectory.yaw, response.pitch, response.roll])
    )
    sensor = attitude * Rotation.from_euler("ZYX", [place.rpy[2], place.rpy[1], place.rpy[0]])

    def at(values: Floats) -> Floats:
        """Values at every recorded stamp; exact where the stamp was kept."""
        return interpolated(stamps, t, values)

    nearest = np.clip(np.searchsorted(t, stamps), 0, t.size - 1)
    nearest = np.where(
        (nearest > 0) & (np.abs(t[nearest - 1] - stamps) < np.abs(t[nearest] - stamps)), nearest - 1, nearest
    )
    force, rate = (at(to_sensor_axes(v, place.rpy)) for v in (response.force, response.rate))
    bag.write(
        "twin/imu",
        "sensor_msgs/msg/Imu",
        stamps,
        {
            **_xyz("linear_acceleration", force),
            **_xyz("angular_velocity", rate),
            **_quaternion("orientation", sensor.as_quat()[nearest]),
        },
        frame=result.drive.imu.frame,
    )
    simulated = response.vertical_acceleration - observation.standing_vertical(response)
    for topic, signal in (
        ("twin/vertical_acceleration", simulated),
        ("imu/vertical_acceleration", observation.signals.vertical_acceleration),
    ):
        low_pass = CausalLowPass(observation.settings.filter, observation.signals.rate_hz, 1)
        bag.write(
            topic,
            "geometry_msgs/msg/AccelStamped",
            stamps,
            {"accel.linear.z": at(low_pass.process(signal))},
            frame="base_link",
        )
    path = observation.trajectory
    position = np.column_stack([path.x, path.y, response.z])
    bag.write(
        "twin/pose",
        "geometry_msgs/msg/PoseStamped",
        stamps,
        {
            **_xyz("pose.position", at(position)),
            **_quaternion("pose.orientation", attitude.as_quat()[nearest]),
        },
        frame="map",
    )
    bag.write(
        "joint_states",
        "sensor_msgs/msg/JointState",
        stamps,
        {
            "name": list(observation.twin.joint_names),
            "position": at(response.deflection),
            "velocity": at(response.deflection_rate),
        },
    )


def _xyz(prefix: str, rows: Floats) -> dict[str, Floats]:
    return {f"{prefix}.{axis}": rows[:, i] for i, axis in enumerate("xyz")}


def _quaternion(prefix: str, rows: Floats) -> dict[str, Floats]:
    return {f"{prefix}.{axis}": rows[:, i] for i, axis in enumerate("xyzw")}
