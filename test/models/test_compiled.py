# SPDX-License-Identifier: Apache-2.0
"""Machine code on disk counts as long as everything that went into it is the same, and no longer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import suspension_twin
from suspension_twin.compiled import sources

ROOT = Path(suspension_twin.__file__).parent
KERNEL = """
from suspension_twin.compiled import compiled, inlined
from house.deep import (
    factor,
)

@inlined
def twice(x):
    return factor(x) + factor(x)

@compiled
def answer(x):
    return twice(x)
"""
START = """
import json
from house.kernel import answer
value = answer(1.0)
print(json.dumps([value, sum(answer.stats.cache_hits.values())]))
"""


@pytest.fixture
def house(tmp_path: Path) -> Path:
    folder = tmp_path / "house"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "kernel.py").write_text(KERNEL)
    (folder / "aside.py").write_text("NOTHING = 0\n")
    factor(folder, 1.0)
    return folder


def factor(folder: Path, value: float) -> None:
    text = "from suspension_twin.compiled import inlined\n@inlined\ndef factor(x):\n    return x * {value}\n"
    (folder / "deep.py").write_text(text.format(value=value))


def start(house: Path) -> tuple[float, int]:
    """What a new process computes, and how often it found its code on disk."""
    environment = os.environ | {
        "PYTHONPATH": f"{house.parent}{os.pathsep}{ROOT.parent}",
        "NUMBA_CACHE_DIR": str(house.parent / "cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    run = subprocess.run(
        [sys.executable, "-c", START],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
        timeout=120,
    )
    value, hits = json.loads(run.stdout)
    return value, hits


def test_a_change_in_another_file_is_noticed_and_a_touch_is_not(house: Path) -> None:
    assert start(house) == (2.0, 0)
    os.utime(house / "kernel.py", (1e9, 1e9))
    (house / "aside.py").write_text("NOTHING = 1\n")  # not imported by the kernel
    assert start(house) == (2.0, 1)
    factor(house, 3.0)
    assert start(house) == (6.0, 0)
    assert start(house) == (6.0, 1)


def test_a_kernel_rests_on_what_it_imports_and_nothing_else() -> None:
    names = {
        path.relative_to(ROOT).as_posix() for path in sources(ROOT / "models" / "full_car_effects.py", ROOT)
    }
    helpers = {
        "corner",
        "curves",
        "damper_tables",
        "equilibrium",
        "full_car",
        "numerics",
        "rows",
        "sensor",
        "settle",
    }
    assert {f"models/{name}.py" for name in helpers} <= names
    assert (
        not {"models/simulate.py", "models/msd.py", "models/tracked_kernel.py", "identification/problem.py"}
        & names
    )


def test_every_kernel_is_compiled_by_the_one_helper() -> None:
    """Numba's own decorators with their stale caches appear nowhere else."""
    others = [path for path in ROOT.rglob("*.py") if path != ROOT / "compiled.py"]
    found = [p.relative_to(ROOT).as_posix() for p in others if "jit(" in p.read_text(encoding="utf-8")]
    assert found == []
