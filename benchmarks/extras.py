# SPDX-License-Identifier: Apache-2.0
"""What a benchmark says when a package that only benchmarks and tests need is not installed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NoReturn

__all__ = ["missing"]


def missing(package: str, extra: str = "test") -> NoReturn:
    """End the program with status 2 and one line that names ``package`` and the ``extra`` that brings it."""
    print(f"{Path(sys.argv[0]).name}: needs {package}: pip install '.[{extra}]'", file=sys.stderr)
    raise SystemExit(2)
