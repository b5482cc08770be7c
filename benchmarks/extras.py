# SPDX-License-Identifier: Apache-2.0
"""What a benchmark says when something that not every machine has is missing."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NoReturn

__all__ = ["missing", "unavailable"]


def missing(package: str, extra: str = "test") -> NoReturn:
    """End the program with status 2 and one line that names ``package`` and the ``extra`` that brings it."""
    unavailable(f"needs {package}: pip install '.[{extra}]'")


def unavailable(reason: str) -> NoReturn:
    """End the program with status 2 and one line: its name and ``reason``."""
    print(f"{Path(sys.argv[0]).name}: {reason}", file=sys.stderr)
    raise SystemExit(2)
