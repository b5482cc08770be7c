# SPDX-License-Identifier: Apache-2.0
"""The script for Unity in the documentation: compiled with stand-ins for Unity's classes, and given messages."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.addons.view.axes import to_unity
from suspension_twin.addons.view.frames import FramePoses

MCS, MONO = shutil.which("mcs"), shutil.which("mono")
pytestmark = pytest.mark.skipif(
    not (MCS and MONO), reason="no C# here: apt-get install mono-mcs mono-runtime"
)

#: What of Unity, of ROS-TCP-Connector and of its generated messages the script uses, and a program that is its scene.
STAND_INS = """
using System;
using System.Collections.Generic;
using System.Globalization;

namespace UnityEngine {
    public struct Vector3 {
        public float x, y, z;
        public Vector3(float a, float b, float c) { x = a; y = b; z = c; }
        public static Vector3 LerpUnclamped(Vector3 a, Vector3 b, float k) {
            return new Vector3(a.x + k * (b.x - a.x), a.y + k * (b.y - a.y), a.z + k * (b.z - a.z));
        }
    }
    public static class Time { public static double timeAsDouble; }
    public struct Quaternion {
        public float x, y, z, w;
        public Quaternion(float a, float b, float c, float d) { x = a; y = b; z = c; w = d; }
        public static Quaternion SlerpUnclamped(Quaternion a, Quaternion b, float k) {
            double angle = Math.Acos(Math.Min(a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w, 1.0));
            double p = angle < 1e-6 ? 1 - k : Math.Sin((1 - k) * angle) / Math.Sin(angle);
            double q = angle < 1e-6 ? k : Math.Sin(k * angle) / Math.Sin(angle);
            return new Quaternion((float)(p * a.x + q * b.x), (float)(p * a.y + q * b.y), (float)(p * a.z + q * b.z),
                (float)(p * a.w + q * b.w));
        }
    }
    public class Transform {
        public Vector3 localPosition { get; set; }
        public Vector3 position;
        public Quaternion rotation;
        public void SetPositionAndRotation(Vector3 p, Quaternion q) { position = p; rotation = q; }
    }
    public class MonoBehaviour { public Transform transform = new Transform(); }
}
namespace Unity.Robotics.ROSTCPConnector {
    public class ROSConnection {
        static readonly ROSConnection only = new ROSConnection();
        public static readonly Dictionary<string, Delegate> Subscribed = new Dictionary<string, Delegate>();
        public static ROSConnection GetOrCreateInstance() { return only; }
        public void Subscribe<T>(string topic, Action<T> callback) { Subscribed[topic] = callback; }
    }
}
namespace RosMessageTypes.Geometry {
    public class PointMsg { public double x, y, z; }
    public class QuaternionMsg { public double x, y, z, w; }
    public class PoseMsg {
        public PointMsg position = new PointMsg();
        public QuaternionMsg orientation = new QuaternionMsg();
    }
    public class PoseStampedMsg {
        public RosMessageTypes.Std.HeaderMsg header = new RosMessageTypes.Std.HeaderMsg();
        public PoseMsg pose = new PoseMsg();
    }
}
namespace RosMessageTypes.Std {
    public class TimeMsg { public int sec; public uint nanosec; }
    public class HeaderMsg { public TimeMsg stamp = new TimeMsg(); }
}
namespace RosMessageTypes.Sensor { public class JointStateMsg { public double[] position; } }

static class Scene {
    static void Main(string[] given) {
        var n = Array.ConvertAll(given, v => double.Parse(v, CultureInfo.InvariantCulture));
        var car = new SuspensionTwin { prefix = "car_1/" };
        for (int i = 0; i < 4; i++)
            car.wheels[i] = new UnityEngine.Transform { localPosition = new UnityEngine.Vector3(i, 0.3f, 0) };
        typeof(SuspensionTwin).GetMethod("Start", (System.Reflection.BindingFlags)36).Invoke(car, null);
        var heard = Unity.Robotics.ROSTCPConnector.ROSConnection.Subscribed;
        for (int i = 0; i + 8 < n.Length; i += 8) {
            var pose = new RosMessageTypes.Geometry.PoseStampedMsg();
            pose.header.stamp.sec = (int)Math.Floor(n[i]);
            pose.header.stamp.nanosec = (uint)Math.Round(1e9 * (n[i] - Math.Floor(n[i])));
            pose.pose.position = new RosMessageTypes.Geometry.PointMsg { x = n[i + 1], y = n[i + 2], z = n[i + 3] };
            pose.pose.orientation = new RosMessageTypes.Geometry.QuaternionMsg {
                x = n[i + 4], y = n[i + 5], z = n[i + 6], w = n[i + 7]
            };
            heard["car_1/twin/pose"].DynamicInvoke(pose);
        }
        UnityEngine.Time.timeAsDouble = n[n.Length - 1];
        typeof(SuspensionTwin).GetMethod("Update", (System.Reflection.BindingFlags)36).Invoke(car, null);
        var joints = new RosMessageTypes.Sensor.JointStateMsg { position = new[] { 0.1, 0.1, 0.12, 0.12 } };
        heard["car_1/joint_states"].DynamicInvoke(joints);
        joints.position = new[] { 0.15, 0.1, 0.12, 0.09 };
        heard["car_1/joint_states"].DynamicInvoke(joints);
        var p = car.transform.position;
        var q = car.transform.rotation;
        var found = new List<float> { p.x, p.y, p.z, q.x, q.y, q.z, q.w };
        foreach (var wheel in car.wheels) found.Add(wheel.localPosition.y);
        Console.WriteLine(string.Join(" ", found.ConvertAll(v => v.ToString("R", CultureInfo.InvariantCulture))));
    }
}
"""


def test_it_moves_body_and_wheels(repository: Path, tmp_path: Path) -> None:
    shutil.copy(repository / "config" / "engines" / "SuspensionTwin.cs", tmp_path)
    (tmp_path / "StandIns.cs").write_text(STAND_INS, encoding="utf-8")
    command = [str(MCS), "-out:scene.exe", "SuspensionTwin.cs", "StandIns.cs"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr + built.stdout
    stamps, places = (100.0, 100.02), ((12.5, -3.0, 0.4), (12.8, -3.01, 0.41))
    turns = [
        Rotation.from_euler("ZYX", angles).as_quat() for angles in ((2.0, 0.1, -0.05), (2.01, 0.11, -0.05))
    ]
    poses, given = FramePoses(), []
    for pose in zip(stamps, places, turns, strict=True):
        poses.push(*pose)
        given += np.hstack(pose).tolist()
    for ahead in (0.0, 0.013, 5.0):  # both arrive at 0 on Unity's clock
        words = [f"{v:.9f}" for v in (*given, ahead)]
        command = [str(MONO), "scene.exe", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        found = [float(v) for v in done.stdout.split()]
        wanted = poses.at(stamps[-1] + ahead)
        position, quaternion = to_unity(wanted.place, wanted.turn)
        sign = np.sign(np.dot(quaternion, found[3:7]))  # the same turn either way
        np.testing.assert_allclose(
            found[:7], [*position, *(sign * np.array(quaternion))], atol=5e-6
        )  # in single precision
    # compressed by 50 mm, at rest, at rest, extended by 30 mm: the wheel goes up in the body, or down
    np.testing.assert_allclose(found[7:], [0.35, 0.3, 0.3, 0.27], atol=1e-6)
