# SPDX-License-Identifier: Apache-2.0
"""Machine code on disk counts as long as everything that went into it is the same, and no longer."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
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


def start(house: Path, **places: str) -> tuple[float, int]:
    """What a new process computes, and how often it found its code on disk; ``places`` for the code."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {
        "PYTHONPATH": f"{house.parent}{os.pathsep}{ROOT.parent}",
        "PYTHONDONTWRITEBYTECODE": "1",
        **(places or {"NUMBA_CACHE_DIR": str(house.parent / "cache")}),
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


@pytest.mark.long
def test_a_change_in_another_file_is_noticed_and_a_touch_or_a_copy_is_not(house: Path) -> None:
    assert start(house) == (2.0, 0)
    os.utime(house / "kernel.py", (1e9, 1e9))
    (house / "aside.py").write_text("NOTHING = 1\n")  # not imported by the kernel
    assert start(house) == (2.0, 1)
    factor(house, 3.0)
    assert start(house) == (6.0, 0)
    copied = shutil.copytree(house, house.parent / "elsewhere" / "house")
    assert start(copied, NUMBA_CACHE_DIR=str(house.parent / "cache")) == (6.0, 1)


def test_code_of_older_sources_is_deleted_when_nothing_has_used_it_for_a_month(house: Path) -> None:
    kernels = house.parent / "cache" / "kernels"
    ages = {"house.kernel.old": 40, "house.kernel.recent": 20, "house.other.old": 40}
    for name, days in ages.items():
        (kernels / name).mkdir(parents=True)
        os.utime(kernels / name, (time.time() - days * 86_400,) * 2)
    start(house)
    left = {folder.name for folder in kernels.iterdir()}
    assert "house.kernel.old" not in left
    assert {"house.kernel.recent", "house.other.old"} < left


@pytest.mark.long
def test_without_a_writable_package_the_users_folder_is_taken_and_without_that_none(house: Path) -> None:
    places = {"XDG_CACHE_HOME": str(house.parent / "user")}
    assert start(house, **places) == (2.0, 0)
    assert (house / "__pycache__" / "kernels").is_dir()
    shutil.rmtree(house / "__pycache__")
    (house / "__pycache__").write_text("a file, so that no folder can be made here")
    assert start(house, **places) == (2.0, 0)
    assert start(house, **places) == (2.0, 1)
    shutil.rmtree(house.parent / "user")
    (house.parent / "user").write_text("nor here")
    assert start(house, **places) == (2.0, 0)


def test_a_kernel_rests_on_what_it_imports_and_nothing_else() -> None:
    names = {
        path.relative_to(ROOT).as_posix() for path in sources(ROOT / "models" / "full_car_effects.py", ROOT)
    }
    helpers = {
        "corner",
        "curves",
        "equilibrium",
        "full_car",
        "rows",
        "sensor",
    }
    assert {f"models/{name}.py" for name in helpers} <= names
    assert (
        not {"models/simulate.py", "models/msd.py", "models/tracked_kernel.py", "inference/problem.py"}
        & names
    )


def test_every_kernel_is_compiled_by_the_one_helper() -> None:
    """Numba's own decorators with their stale caches appear nowhere else."""
    others = [path for path in ROOT.rglob("*.py") if path != ROOT / "compiled.py"]
    found = [p.relative_to(ROOT).as_posix() for p in others if "jit(" in p.read_text(encoding="utf-8")]
    assert found == []
