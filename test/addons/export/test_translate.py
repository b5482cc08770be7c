# SPDX-License-Identifier: Apache-2.0
"""Kernels written out as C compute what Python computes; what cannot be written out is refused by name and line."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.addons.export.standalone.translate import CSHARP, C, Translation
from suspension_twin.arrays import Floats
from suspension_twin.errors import WorkError

SHIFT, WIDTH = 2, 1
_OFF = 0


def _swapped(a: float, b: float) -> tuple[float, float]:
    a, b = b, a
    return a + 1.0, b * 2.0


def _clipped(x: float, low: float, high: float) -> float:
    return max(min(x, high), low) if not math.sin(x) > 2.0 else 0.0


def _search(w: Floats, limit: float, count: int) -> float:
    """First element above a limit, or -1: a loop with an else."""
    found = -1.0
    for i in range(count):
        if w[i] > limit and w[i] < 1e3:
            found = w[i] / count
            break
    else:
        found -= 1.0
    return found


def _solve(k: Floats, rest: Floats) -> None:
    for a in range(1, -1, -1):
        for b in range(a + 1, 2):
            rest[a] -= k[a, b] * rest[b]
        rest[a] /= k[a, a]


def kernel(w: Floats, n: int, x: float) -> None:
    """Everything that kernels are written with."""
    k, rest = np.zeros((2, 2)), np.empty(2)
    places = (SHIFT, SHIFT + 1)
    rest[:] = 1.5
    for c in range(2):
        k[c, c] = 2.0 + c
        k[0, 1] = x
        w[(SHIFT + c) * WIDTH] += 10.0 * c
    _solve(k, rest)
    rest += (0.5 if n > 2 else 0.25) * rest
    heights = [w[q] * w[q] for q in range(3)]
    w[0], w[1] = w[1], w[0]
    a, b = _swapped(w[places[1]], x**2)
    inside = 0.0 < x <= 3.0 or n == 7
    inside &= (abs(x) < 2.0) & (n > 0)
    if _OFF & 4:
        w[9] = 1e9
    elif inside:
        w[4] = a - (b - x) - -x
    w[5] = _search(w, 2.0, n) + _search(w, 1e6, n)
    w[6] = rest[0] + heights[2] * rest[1] - (1.0 if inside else 2.0)
    w[7] = _clipped(x, -1.0, 1.0) + (n // 2) / n - (x - (x - 1.0))


def kernel_of_five(w: Floats, x: float) -> None:
    kernel(w, 5, x)


def looping(w: Floats) -> None:
    while w[0] > 0.0:
        w[0] -= 1.0


def sliced(w: Floats) -> None:
    w[0] = np.sum(w)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here: apt-get install gcc")
@pytest.mark.parametrize("fixed", [False, True])
def test_it_computes_what_python_computes(fixed: bool, tmp_path: Path) -> None:
    translation = Translation(C)
    name = translation.add(kernel_of_five if fixed else kernel)
    call = f"{name}(w, {'' if fixed else 'n, '}x)"
    text = f"#include <math.h>\n{translation.text}\nvoid run(double *w, int n, double x) {{ (void)n; {call}; }}\n"
    (tmp_path / "kernel.c").write_text(text, encoding="utf-8")
    build = ["cc", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-o", "kernel.so", "kernel.c", "-lm"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(tmp_path / "kernel.so"))
    for n in [5] if fixed else [2, 3, 5, 7]:
        for x in (-0.7, 0.4, 1.9, 2.5):
            wanted = np.array([0.3, 4.0, 2.5, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            found = wanted.copy()
            kernel(wanted, n, x)
            library.run(found.ctypes.data_as(ctypes.c_void_p), n, ctypes.c_double(x))
            np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-15)


def test_branches_that_cannot_be_taken_are_left_out() -> None:
    translation = Translation(CSHARP)
    translation.add(kernel)
    assert "1000000000.0" not in translation.text
    assert "SHIFT" in translation.text


@pytest.mark.parametrize(("function", "what"), [(looping, "While"), (sliced, "call of np.sum")])
def test_what_cannot_be_written_out_is_named(function: Any, what: str) -> None:
    with pytest.raises(WorkError, match=rf"{function.__name__}, line 2: .*{what}"):
        Translation(C).add(function)
