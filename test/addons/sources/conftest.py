# SPDX-License-Identifier: Apache-2.0
"""What the tests of the sources share: a bundled drive to play."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for the emulators of the apps

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, cut


@pytest.fixture(scope="session")
def bump(repository: Path) -> Drive:
    """Eight seconds of the bundled drive, over the bump."""
    drive = read_drive(repository / "bags" / "bump_15kmh")
    start = float(drive.imu.t[0]) + 8.0
    return cut(drive, start, start + 8.0)
