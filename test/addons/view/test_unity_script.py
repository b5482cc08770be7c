# SPDX-License-Identifier: Apache-2.0
"""The script for Unity in the documentation: compiled with stand-ins for Unity's classes, and given messages."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.addons.view.axes import to_unity

MCS, MONO = shutil.which("mcs"), shutil.which("mono")
pytestmark = pytest.mark.skipif(not (MCS and MONO), reason="no C# here: apt-get install mono-mcs")

#: What of Unity, of ROS-TCP-Connector and of its generated messages the script uses, and a program that is its scene.
STAND_INS = """
using System;
using System.Collections.Generic;
using System.Globalization;

namespace UnityEngine {
    public struct Vector3 { public float x, y, z; public Vector3(float a, float b, float c) { x = a; y = b; z = c; } }
    public struct Quaternion {
        public float x, y, z, w;
        public Quaternion(float a, float b, float c, float d) { x = a; y = b; z = c; w = d; }
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
    public class PoseStampedMsg { public PoseMsg pose = new PoseMsg(); }
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
        var pose = new RosMessageTypes.Geometry.PoseStampedMsg();
        pose.pose.position = new RosMessageTypes.Geometry.PointMsg { x = n[0], y = n[1], z = n[2] };
        pose.pose.orientation = new RosMessageTypes.Geometry.QuaternionMsg { x = n[3], y = n[4], z = n[5], w = n[6] };
        heard["car_1/twin/pose"].DynamicInvoke(pose);
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
    page = (repository / "docs" / "engines.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"```csharp\n(.*?)```", page, re.DOTALL)
    (tmp_path / "SuspensionTwin.cs").write_text(script, encoding="utf-8")
    (tmp_path / "StandIns.cs").write_text(STAND_INS, encoding="utf-8")
    command = [str(MCS), "-out:scene.exe", "SuspensionTwin.cs", "StandIns.cs"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr + built.stdout
    place, turn = (12.5, -3.0, 0.4), np.array([0.1, -0.2, 0.3, 0.9])
    turn /= np.linalg.norm(turn)
    given = [f"{v:.9f}" for v in (*place, *turn)]
    done = subprocess.run(
        [str(MONO), "scene.exe", *given], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    found = [float(v) for v in done.stdout.split()]
    position, quaternion = to_unity(place, tuple(turn.tolist()))
    np.testing.assert_allclose(found[:7], [*position, *quaternion], atol=1e-6)
    # compressed by 50 mm, at rest, at rest, extended by 30 mm: the wheel goes up in the body, or down
    np.testing.assert_allclose(found[7:], [0.35, 0.3, 0.3, 0.27], atol=1e-6)
