# SPDX-License-Identifier: Apache-2.0
"""The list of licences and the bill of materials hold what is installed."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path


def said(repository: Path, option: str) -> str:
    command = [sys.executable, str(repository / "test" / "house" / "sbom.py"), option]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_bill_of_materials_names_every_package_with_version_and_licence(repository: Path) -> None:
    bill = json.loads(said(repository, "--sbom"))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    found = {c["name"].lower(): c for c in bill["components"]}
    assert found["numpy"]["version"] == version("numpy")
    assert found["numpy"]["purl"] == f"pkg:pypi/numpy@{version('numpy')}"
    assert all(c["licenses"][0]["license"]["name"] for c in bill["components"])


def test_the_list_of_licences_has_a_line_for_each(repository: Path) -> None:
    lines = said(repository, "--licences").splitlines()
    assert any(line.startswith("scipy ") and "BSD" in line for line in lines)
    assert len(lines) == len({line.split()[0] for line in lines}) > 20
