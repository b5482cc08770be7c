# SPDX-License-Identifier: Apache-2.0
"""A new effect costs one file: it is found, its fields are laid out and its term acts in the compiled kernel."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import suspension_twin

ROOT = Path(suspension_twin.__file__).parents[1]
#: A spring in series with a damper beside each strut (Maxwell element): two constants and one state a corner.
EFFECT = """
from suspension_twin.compiled import inlined
from suspension_twin.effects.base import Effect, Parameter, Prior
from suspension_twin.models import rows
from suspension_twin.models.corner import travel_rate
from suspension_twin.models.hooks import Hook, KernelTerms
from suspension_twin.models.rows import CORNER, WIDTH, Fields

FIELDS = Fields()
STIFFNESS = FIELDS.add(CORNER)
PACE = FIELDS.add(CORNER)
FORCE = FIELDS.state(CORNER)
PARAMETERS = (
    Parameter("stiffness", (0.0, 1e6), Prior(2e4, 1e4), "N/m", "of the spring"),
    Parameter("damping", (1.0, 1e5), Prior(2e3, 1e3), "N s/m", "of the damper in series with it", neutral=2e3),
)


def constants(p):
    return {STIFFNESS: p["stiffness"], PACE: p["stiffness"] / p["damping"]}


@inlined
def element(w, e, c, i, h):
    f = w[(e + FORCE + c) * WIDTH + i] + h * w[(e + STIFFNESS + c) * WIDTH + i] * travel_rate(w, c, i)
    f = f / (1.0 + h * w[(e + PACE + c) * WIDTH + i])
    w[(e + FORCE + c) * WIDTH + i] = f
    w[(rows.STRUT + c) * WIDTH + i] += f


EFFECT = Effect(
    id="maxwell_strut",
    title="elastic damper beside the strut",
    where="strut",
    doc="A spring in series with a damper, beside the spring and the damper of each strut.",
    parameters=PARAMETERS,
    severity=("stiffness",),
    excited_by=("everything",),
    confused_with=("top_mount",),
    hook=Hook(kernel=KernelTerms(FIELDS, constants, {"strut": (element, CORNER)})),
)
"""
#: A car that only heaves: alike in front and rear, on waves as long as its wheelbase; linear springs and dampers.
START = """
import json, sys
import numpy as np
import suspension_twin.effects as folder
folder.__path__.append(sys.argv[1])
sys.path.insert(0, sys.argv[2])
from effect_cases import Ground, given, way
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.vehicle.twin import load_twin

x, v = [0.1, 0.2, 0.3, 0.5], [0.5, 1.0, 2.0, 3.0]
axle = {"unsprung_mass": 40.0, "spring": {"compression": x, "force": [2.5e4 * a for a in x]}}
for part in ("damper_push", "damper_pull"):
    axle[part] = {"velocity": v, "force": [1500.0 * a for a in v]}
twin = load_twin(sys.argv[3])
length = twin.vehicle.wheelbase
changes = {"vehicle.cog": [length / 2, 0.0, 0.5], "vehicle.mass": 1600.0, "vehicle.rear_track": 1.5}
twin = twin.with_changes(changes | {"vehicle.front_track": 1.5, "vehicle.front": axle, "vehicle.rear": axle})
road = Ground(lambda x, y: 0.01 * (1 - np.cos(2 * np.pi * x / length)) + 0 * y)
drive = excitation(way(1.5, speed=10.0), twin.vehicle, road, max_step=2.5e-4)
armed = given(twin, maxwell_strut={"stiffness": 3e4, "damping": 800.0})
plain, out = simulate_twin(twin, drive), simulate_twin(armed, drive)
keys = ["effects.maxwell_strut.stiffness"]
two = simulate_lanes(armed, lanes(armed, keys, np.array([[0.0], [3e4]])), drive)
print(json.dumps({
    "last": list(EFFECTS)[-1],
    "neutral": bool(np.array_equal(two.force[:, :, 0], plain.force)),
    "lane": bool(np.array_equal(two.force[:, :, 1], out.force)),
    "pitch": float(np.abs(out.pitch).max()),
    "heave": out.heave.tolist(),
    "plain": plain.heave.tolist(),
    "t": (drive.t - drive.t[0]).tolist(),
    "tyre": twin.vehicle.tyre.vertical_stiffness,
    "length": length,
}))
"""


@pytest.mark.long
def test_an_effect_in_one_new_file_is_found_and_acts(tmp_path: Path, copy_kernels: Any) -> None:
    (tmp_path / "maxwell_strut.py").write_text(EFFECT)
    copy_kernels(tmp_path / "cache")
    twin = ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml"
    run = subprocess.run(
        [sys.executable, "-c", START, str(tmp_path), str(Path(__file__).parent), str(twin)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        timeout=500,
    )
    found = json.loads(run.stdout)
    assert found["last"] == "maxwell_strut"
    assert found["neutral"] and found["lane"]  # beside each other in one block
    assert found["pitch"] < 1e-6

    def rates(t: float, y: np.ndarray) -> list[float]:
        z, dz, u, du, f = y
        road = 0.01 * (1 - np.cos(2 * np.pi * 10.0 * t / found["length"]))
        strut = 2.5e4 * (u - z) + 1500.0 * (du - dz) + f
        tyre = found["tyre"] * (road - u)
        return [dz, strut / 360.0, du, (tyre - strut) / 40.0, 3e4 * (du - dz) - f * 3e4 / 800.0]

    t = np.array(found["t"])
    exact = solve_ivp(rates, (0, t[-1]), np.zeros(5), t_eval=t, rtol=1e-9, atol=1e-12, max_step=1e-3).y[0]
    heave, plain = np.array(found["heave"]), np.array(found["plain"])
    assert np.abs(heave - exact).max() < 5e-3 * np.abs(exact).max()
    assert np.abs(plain - exact).max() > 0.1 * np.abs(exact).max()
