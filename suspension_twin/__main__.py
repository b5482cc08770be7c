# SPDX-License-Identifier: Apache-2.0
"""``python -m suspension_twin``: the same as the command ``suspension-twin``."""

from __future__ import annotations

import sys

from suspension_twin.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
