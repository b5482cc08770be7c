# SPDX-License-Identifier: Apache-2.0
"""``benchmarks/live.py`` measures what it says; how fast this machine is, is not for a test to judge."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest


@pytest.mark.long
def test_it_measures_both_systems_at_both_rates_and_the_memory(repository):
    arguments = ["--json", "--seconds", "0.6", "--rounds", "1", "--warm-up", "0.8", "--replay", "20"]
    script = repository / "benchmarks" / "live.py"
    done = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True, timeout=120.0)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    for rate in ("100", "1000"):
        rows = result["rates"][rate]
        for system in ("relay", "twin"):
            row = rows[system]
            assert row["sent"] == round(0.6 * float(rate))
            assert 0 < row["p50_us"] <= row["p99_us"] and row["cpu_share"] > 0
            assert row["lost"] < row["sent"]
        assert rows["p99_ratio"] > 0 and rows["within_bar"] == (rows["p99_ratio"] <= result["bar"])
    memory = result["memory"]
    assert memory["answers"] + memory["unanswered"] == 2000 and memory["unanswered"] == 16
    assert memory["times_real_time"] > 1 and 50 < memory["last_mib"] < 2000
