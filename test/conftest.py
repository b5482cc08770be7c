# SPDX-License-Identifier: Apache-2.0
"""The surroundings that every test runs in, set before anything imports ROS, numba or matplotlib."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


def _isolate() -> None:
    """Give each xdist worker a ROS domain of its own, away from any network and from killed processes."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    # Two runs at the same time on one machine shall not meet either: start from the run's id.
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid()))
    start = sum(run.encode()) * 8
    os.environ["ROS_DOMAIN_ID"] = str((start + int(worker)) % 102)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"  # shared memory leaks from killed processes
    os.environ["MPLBACKEND"] = "Agg"
    os.environ.setdefault("NUMBA_NUM_THREADS", str(min(2, os.cpu_count() or 1)))


_isolate()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured data: ``SUSPENSION_TWIN_DATA``, or ``../shared/data`` beside the repository."""
    folder = Path(os.environ.get("SUSPENSION_TWIN_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no measured data: set SUSPENSION_TWIN_DATA to its folder")
    return folder
