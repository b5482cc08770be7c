# SPDX-License-Identifier: Apache-2.0
"""Shows the twin's car in CARLA: ``python carla_mirror.py TWIN.yaml``, see ``docs/engines.md``."""

import sys

import carla
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException

from suspension_twin.addons.view.axes import to_unreal, unreal_rotator
from suspension_twin.addons.view.frames import FramePoses
from suspension_twin.vehicle.twin import load_twin

twin = load_twin(sys.argv[1])
poses = FramePoses(origin=(twin.vehicle.wheelbase / 2, 0.0, 0.0))  # of CARLA's vehicles: between the axles


def take(message):
    stamp, p, q = message.header.stamp, message.pose.position, message.pose.orientation
    poses.push(stamp.sec + 1e-9 * stamp.nanosec, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def draw(snapshot):
    now = node.get_clock().now().nanoseconds / 1e9
    pose = poses.at(now + snapshot.timestamp.delta_seconds)  # seen in the next frame
    if pose is not None:
        location, _ = to_unreal(pose.place, pose.turn)
        roll, pitch, yaw = unreal_rotator(pose.turn)
        vehicle.set_transform(carla.Transform(carla.Location(*location), carla.Rotation(pitch, yaw, roll)))


rclpy.init(args=sys.argv)
node = rclpy.create_node("carla_mirror")
node.create_subscription(PoseStamped, "twin/pose", take, 10)
client = carla.Client("127.0.0.1", 2000)
client.set_timeout(10.0)
world = client.get_world()
model = world.get_blueprint_library().filter("vehicle.*")[0]
vehicle = world.spawn_actor(model, world.get_map().get_spawn_points()[0])
vehicle.set_simulate_physics(False)
ticks = world.on_tick(draw)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
finally:
    world.remove_on_tick(ticks)
    vehicle.destroy()
