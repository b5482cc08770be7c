# SPDX-License-Identifier: Apache-2.0
"""The four nodes, each in a process of its own: ``ros2 launch suspension_twin suspension_twin.launch.py twin:=...``.

With ``sources:="sensorlogger://0.0.0.0:8000 ubx:/dev/ttyACM0"`` a fifth one connects phones, receivers and IMUs; with
``learn_road:=/path/to/road.crg`` another learns the road as it is driven over; with ``autostart:=false`` the four wait
for a lifecycle manager.

``suspension-twin run`` starts the same nodes in one process, which costs less.
"""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

FOUR = ("imu_ingest", "pose_injector", "suspension_model", "calibrator")


def generate_launch_description() -> LaunchDescription:
    """The arguments, and a node of each kind that follows them."""
    config = Path(get_package_share_directory("suspension_twin")) / "config"
    arguments = [
        DeclareLaunchArgument("twin", description="Path of the twin file."),
        DeclareLaunchArgument(
            "params",
            default_value=str(config / "nodes.yaml"),
            description="Path of the nodes' parameter file.",
        ),
        DeclareLaunchArgument(
            "use_sim_time", default_value="false", description="Follow /clock, for a replayed recording."
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="A namespace that holds the whole twin."
        ),
        DeclareLaunchArgument(
            "autostart",
            default_value="true",
            description="Whether the four nodes start by themselves; false: a lifecycle manager configures them.",
        ),
        DeclareLaunchArgument(
            "sources", default_value="", description="URLs of live sources, separated by spaces."
        ),
        DeclareLaunchArgument(
            "learn_road",
            default_value="",
            description="Path of the OpenCRG road that is learnt while driving.",
        ),
    ]
    parameters = [
        LaunchConfiguration("params"),
        {
            "twin": ParameterValue(LaunchConfiguration("twin"), value_type=str),
            "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
        },
    ]
    autostart = ParameterValue(LaunchConfiguration("autostart"), value_type=bool)
    nodes = [
        Node(
            package="suspension_twin",
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[parameters[0], {**parameters[1], "autostart": autostart}],
            output="screen",
        )
        for name in FOUR
    ]
    for name, parameter, argument in (
        ("source", "sources", "sources"),
        ("road_learner", "out", "learn_road"),
    ):
        given = LaunchConfiguration(argument)
        nodes.append(
            Node(
                package="suspension_twin",
                executable=name,
                name=name,
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    parameters[0],
                    {**parameters[1], parameter: ParameterValue(given, value_type=str)},
                ],
                output="screen",
                condition=IfCondition(NotEqualsSubstitution(given, "")),
            )
        )
    return LaunchDescription([*arguments, *nodes])
