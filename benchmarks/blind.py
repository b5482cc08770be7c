# SPDX-License-Identifier: Apache-2.0
"""Diagnosis on cases whose effect is withheld; the program is ``blind/run.py``."""

from blind.run import main

if __name__ == "__main__":
    main()
