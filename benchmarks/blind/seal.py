# SPDX-License-Identifier: Apache-2.0
"""Labels under a hash: written and recorded before the first diagnosis, read only for the score."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import Any


class Broken(RuntimeError):
    """The labels are not those that were sealed."""


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def seal(out: Path, commit: str) -> str:
    """Gather the labels of all generated cases into one file and record its hash; returns the hash.

    Cases added later are sealed anew beside the earlier seals.
    """
    labels = {p.parent.name: json.loads(p.read_text()) for p in sorted((out / "sealed").glob("*/label.json"))}
    file = out / "sealed" / "labels.json"
    file.write_text(json.dumps(labels, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    ledger = out / "ledger.json"
    seals = json.loads(ledger.read_text()) if ledger.is_file() else []
    digest = _digest(file)
    if not seals or seals[-1]["labels_sha256"] != digest:
        stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        seals.append(
            {"labels_sha256": digest, "cases": len(labels), "sealed": stamp, "generator_commit": commit}
        )
        ledger.write_text(json.dumps(seals, indent=1) + "\n", encoding="utf-8")
    return digest


def sealed(out: Path) -> str:
    """The last recorded hash, after comparing it with the labels; Broken where they differ or none are sealed."""
    ledger, file = out / "ledger.json", out / "sealed" / "labels.json"
    if not ledger.is_file() or not file.is_file():
        raise Broken(f"{out}: no labels are sealed here; generate cases first")
    digest = str(json.loads(ledger.read_text())[-1]["labels_sha256"])
    if _digest(file) != digest:
        raise Broken(f"{file}: is not what was sealed (sha256 {digest[:12]}…)")
    return digest


def labels(out: Path) -> dict[str, Any]:
    """The labels, once they are known to be the sealed ones."""
    sealed(out)
    return dict(json.loads((out / "sealed" / "labels.json").read_text()))
