# SPDX-License-Identifier: Apache-2.0
"""Every promise names a test, and the test is there."""

from __future__ import annotations

import re
from pathlib import Path


def test_every_promise_names_a_test_that_is_there(repository: Path) -> None:
    page = (repository / "docs" / "promises.md").read_text(encoding="utf-8")
    promises = page.split("\n- ")[1:]
    assert len(promises) > 20
    for row in promises:
        named = re.findall(r"`(test/[\w/]+\.py)::(test_\w+)`", row)
        assert named, row
        for file, test in named:
            assert f"def {test}(" in (repository / file).read_text(encoding="utf-8"), f"{file}::{test}"
