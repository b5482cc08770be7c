# SPDX-License-Identifier: Apache-2.0
"""Commands of the add-ons, each a row of ``suspension-twin --help`` and a file of this folder."""

from __future__ import annotations

from typing import Final

from suspension_twin.cli.main import Subcommand

__all__ = ["CONNECT", "EXPORT", "FIRST_DRIVE", "FLEET", "PLAN", "RECORD"]

FIRST_DRIVE: Final = Subcommand(
    "first-drive", f"{__name__}.first_drive", "From a live source to a calibrated twin, step by step."
)
CONNECT: Final = Subcommand(
    "connect",
    f"{__name__}.connect",
    "Connect a phone, a receiver or an IMU, and see what arrives.",
    endless=True,
)
RECORD: Final = Subcommand(
    "record", f"{__name__}.record", "Live phones, receivers and IMUs into a bag.", endless=True
)
FLEET: Final = Subcommand("fleet", f"{__name__}.fleet", "Many vehicles and drives, calibrated over Dask.")
EXPORT: Final = Subcommand("export", f"{__name__}.export", "A twin in the files of other simulators.")
PLAN: Final = Subcommand(
    "plan", f"{__name__}.plan", "Which effects this set-up could show, and never tell apart."
)
