# SPDX-License-Identifier: Apache-2.0
"""Packages beside this file's Python: ``python3 bootstrap.py check --licences`` lists names, versions and licences,
``python3 bootstrap.py check --sbom`` prints a bill of materials (CycloneDX 1.6, JSON)."""

from __future__ import annotations

import json
import sys
from importlib.metadata import Distribution, distributions
from typing import Any


def licence(package: Distribution) -> str:
    """Licence of a package: its SPDX expression, else its classifiers, else the first line of its licence field."""
    said = package.metadata
    if expression := said.get("License-Expression"):
        return str(expression)
    classified = [
        c.rpartition(" :: ")[2] for c in said.get_all("Classifier") or () if c.startswith("License ::")
    ]
    return ", ".join(classified) or (said.get("License") or "not stated").strip().partition("\n")[0][:60]


def packages() -> list[tuple[str, str, str]]:
    """Name, version and licence of every package, by name."""
    found = {p.metadata["Name"]: p for p in distributions() if p.metadata["Name"]}
    return sorted(
        ((name, p.version, licence(p)) for name, p in found.items()), key=lambda row: row[0].lower()
    )


def bill() -> dict[str, Any]:
    """The bill of materials of CycloneDX, as the document that JSON holds."""
    components = [
        {
            "type": "library",
            "name": name,
            "version": version,
            "purl": f"pkg:pypi/{name.lower().replace('_', '-')}@{version}",
            "licenses": [{"license": {"name": stated}}],
        }
        for name, version, stated in packages()
    ]
    return {"bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1, "components": components}


if __name__ == "__main__":
    if "--sbom" in sys.argv:
        print(json.dumps(bill(), indent=1))
    else:
        width = max(len(name) + len(version) for name, version, _ in packages()) + 1
        for name, version, stated in packages():
            print(f"{f'{name} {version}':{width}}  {stated}")
