# SPDX-License-Identifier: Apache-2.0
"""Tortures of the package; the program is ``torture/run.py``."""

import sys

from torture.run import main

if __name__ == "__main__":
    sys.exit(main())
