# SPDX-License-Identifier: Apache-2.0
"""Work over workers that come and go: nothing is lost, and nothing is done that is there."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from suspension_twin.addons.fleet import engine
from suspension_twin.addons.fleet.engine import FleetPlan, connected, run_fleet
from suspension_twin.addons.fleet.manifest import Item
from suspension_twin.addons.fleet.results import Ledger
from suspension_twin.addons.fleet.work import Options, Task


@pytest.fixture
def tasks(monkeypatch: pytest.MonkeyPatch) -> list[Task]:
    """Forty tasks that take 20 ms each."""

    def work(task: Task) -> dict[str, Any]:
        time.sleep(0.02)
        return {"key": task.key, "status": "done", "message": ""}

    monkeypatch.setattr(engine, "work", work)
    item = Item("car", "", "twin.yaml", ("drive",))
    base = Task("", item, Options("calibrate"), "", 0, 0.0)
    return [replace(base, key=f"{k:02x}key") for k in range(40)]


def test_nothing_is_lost_where_workers_come_and_leave(tasks: list[Task], tmp_path: Path) -> None:
    plan = FleetPlan(tuple(t.item for t in tasks), tuple(tasks), {})
    seen: list[int] = []
    with connected(workers=1, inside=True) as cluster:
        client = cluster.client

        def change(task: Task, record: dict[str, Any], left: int) -> None:
            seen.append(left)
            if len(seen) == 2:
                client.cluster.scale(4)
                client.wait_for_workers(4)
            if len(seen) == 10:
                client.retire_workers(sorted(client.nthreads())[1:])

        outcome = run_fleet(plan, Ledger(tmp_path / "out"), cluster, change)
        assert len(cluster.client.nthreads()) == 1
    assert seen == list(range(39, -1, -1)) and not outcome.lost
    assert set(outcome.records) == {t.key for t in tasks}
    assert len(list((tmp_path / "out" / "items").glob("*/*/record.json"))) == 40
