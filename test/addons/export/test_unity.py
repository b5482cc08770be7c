# SPDX-License-Identifier: Apache-2.0
"""The C# class is the twin: compiled, run over a bump and compared, without any of Unity."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from fmu_importers import columns, walked

from suspension_twin.addons.export.registry import export_twin
from suspension_twin.inference.synthetic import path_along
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.road import bump_road, half_sine
from suspension_twin.vehicle.twin import Twin, parse_twin

PROGRAM = """
using System;
using System.Globalization;
using System.IO;

static class Program
{
    static string Text(double value) { return value.ToString("R", CultureInfo.InvariantCulture); }

    static void Main(string[] arguments)
    {
        var car = new Car();
        bool begun = false;
        foreach (string line in File.ReadAllLines(arguments[0]))
        {
            var x = Array.ConvertAll(line.Split(' '), s => double.Parse(s, CultureInfo.InvariantCulture));
            for (int c = 0; c < 4; c++) car.RoadHeight[c] = x[1 + c];
            car.LongitudinalAcceleration = x[5];
            car.LateralAcceleration = x[6];
            car.YawRate = x[7];
            car.YawAcceleration = x[8];
            car.Speed = x[9];
            car.LateralSpeed = x[10];
            if (begun) car.Step(x[0]); else car.Restart();
            begun = true;
            if (car.Failed) throw new Exception("failed");
            Console.WriteLine(string.Join(" ", Text(car.Heave), Text(car.Pitch), Text(car.VerticalAcceleration),
                Text(car.AngularRateX), Text(car.Deflection(1)), Text(car.TyreForce(2)), Text(car.WheelZ(3))));
        }
        car.RoadHeight[0] = double.NaN;
        car.Step(0.001);
        if (!car.Failed) throw new Exception("not finite, and not failed");
    }
}
"""
SEEN = [0, 2, 26, 23, 9, 18, 7]  # of the outputs, in the order of the program


_MONO = shutil.which("mcs") and shutil.which("mono")


@pytest.mark.skipif(not _MONO, reason="no C# here: apt-get install mono-mcs mono-runtime")
@pytest.mark.parametrize("model", ["msd", "full_car"])
@pytest.mark.long
def test_the_class_is_the_twin(model: str, mondeo: Twin, tmp_path: Path) -> None:
    specs = {"msd": [], "full_car": [{"id": "strut_friction", "parameters": {"front_force": 90.0}}]}[model]
    twin = parse_twin({**mondeo.model_dump(), "model": model, "effects": specs})
    if model == "full_car":
        links = {
            "vehicle.front.linkage": {"braking": 0.3, "recession": 0.1},
            "vehicle.tyre.rolling_radius": 0.3,
        }
        twin = twin.with_changes(links)
    road = bump_road(half_sine(0.9, 0.05), at=6.0, length=40.0)
    path = path_along(road, np.arange(0.0, 2.0, 0.01), ((0.0, 7.0), (1.0, 6.0), (2.0, 3.0)), 2.0)
    driven = excitation(path, twin.vehicle, road)
    turning = np.sin(3.0 * driven.t)
    driven.motion[:, 2:5] = np.column_stack([2.0 * turning, 0.3 * turning, 0.9 * np.cos(3.0 * driven.t)])
    t, inputs, last = walked(driven)
    np.savetxt(tmp_path / "in.txt", np.column_stack([np.diff(t, prepend=0.0), inputs]), fmt="%.17g")
    assert export_twin(twin, "unity", tmp_path / "Car.cs") == ()
    (tmp_path / "Program.cs").write_text(PROGRAM, encoding="utf-8")
    build = ["mcs", "-warnaserror", "-out:car.exe", "Car.cs", "Program.cs"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    done = subprocess.run(["mono", "car.exe", "in.txt"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = np.array([[float(x) for x in line.split()] for line in done.stdout.splitlines()])[last]
    wanted = columns(simulate_twin(twin, driven))[:, SEEN]
    assert (np.abs(found - wanted).max(axis=0) < 1e-9 * np.ptp(wanted, axis=0)).all()


def test_the_class_has_a_name_that_csharp_takes(mondeo: Twin, tmp_path: Path) -> None:
    export_twin(mondeo, "unity", tmp_path / "3 my-car.cs")
    assert "public sealed class Twin3_my_car\n" in (tmp_path / "3 my-car.cs").read_text(encoding="utf-8")
