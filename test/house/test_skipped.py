# SPDX-License-Identifier: Apache-2.0
"""A run ends with one line of what it skipped, and the command that installs what was missing."""

from __future__ import annotations

from pathlib import Path

import pytest

SKIPPING = """
import pytest

@pytest.mark.parametrize("reason", {reasons!r})
def test_it(reason):
    if reason == "an import":
        pytest.importorskip("no_such_module")
    if reason:
        pytest.skip(reason)
"""
WITHOUT = [
    "no measured data: one",
    "no measured data: another",
    "no browser here: apt-get install chromium",
    "no C# here: apt-get install mono-mcs mono-runtime",
    "an import",
]


@pytest.mark.parametrize(
    ("reasons", "lines"),
    [
        ([""], []),
        (
            WITHOUT,
            [
                "skipped: 2 no measured data, 1 no browser here, 1 no C# here, 1 could not import 'no_such_module'; "
                "missing: apt-get install chromium mono-mcs mono-runtime && pip install -e.[test]"
            ],
        ),
        (["too old a file"], ["skipped: 1 too old a file"]),
    ],
    ids=["nothing", "what can be installed", "what cannot"],
)
def test_it_is_one_line(
    reasons: list[str],
    lines: list[str],
    tmp_path: Path,
    request: pytest.FixtureRequest,
    capfd: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "test_some.py").write_text(SKIPPING.format(reasons=reasons))
    own = [p for p in request.config.pluginmanager.get_plugins() if hasattr(p, "pytest_terminal_summary")]
    ours = [p for p in own if str(getattr(p, "__file__", "")).endswith("test/conftest.py")]
    given = [
        "--import-mode=importlib",
        "-p",
        "no:cacheprovider",
        "-c",
        "/dev/null",
        "--rootdir",
        str(tmp_path),
        str(tmp_path),
    ]
    assert pytest.main(given, plugins=ours) == pytest.ExitCode.OK
    assert [line for line in capfd.readouterr().out.splitlines() if line.startswith("skipped")] == lines
