# SPDX-License-Identifier: Apache-2.0
"""Starts a diagnosis with a copy of one case's folder and nothing else, and keeps what it answers.

Run as a script (``ask.py FOLDER OUT``) it diagnoses with the part of the library that the folder's
``request.json`` leaves; this is how an effect is taken out of the library.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

REQUEST = "request.json"
ROOT = Path(__file__).resolve().parents[2]
_KEPT = ("PATH", "HOME", "LANG", "LC_ALL", "TMPDIR", "NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS", "VIRTUAL_ENV")


def folder_hash(folder: Path) -> str:
    """Of every file's name and content."""
    total = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        total.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


def source_hash() -> str:
    """Of the package that diagnoses, committed or not."""
    total = hashlib.sha256()
    for path in sorted((ROOT / "suspension_twin").rglob("*.py")):
        total.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:16]


def commit() -> str:
    """The commit of the working tree, marked where the package differs from it."""
    run = subprocess.run(["git", "rev-parse", "--short=12", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    changed = subprocess.run(
        ["git", "status", "--porcelain", "--", "suspension_twin"], cwd=ROOT, capture_output=True, text=True
    )
    return (run.stdout.strip() or "unknown") + ("+changes" if changed.stdout.strip() else "")


def command(folder: Path, out: Path) -> list[str]:
    """What is started for a case."""
    if (folder / REQUEST).is_file():
        return [sys.executable, str(Path(__file__).resolve()), str(folder), str(out)]
    shown, before = _drives(folder)
    more = [a for b in before for a in ("--reference", b)]
    twin = str(folder / "twin.yaml")
    return [
        sys.executable,
        "-m",
        "suspension_twin",
        "diagnose",
        "--twin",
        twin,
        *shown,
        *more,
        "--out",
        str(out),
    ]


def _drives(folder: Path) -> tuple[list[str], list[str]]:
    bags = sorted(p for p in folder.iterdir() if p.is_dir())
    shown = [str(b) for b in bags if not b.name.startswith("reference")]
    return shown, [str(b) for b in bags if b.name.startswith("reference")]


def ask(folder: Path, answer: Path, seal: str, starter: Sequence[str] = ()) -> dict[str, Any]:
    """Diagnose a case unless the same case was already diagnosed by the same package; returns the record.

    ``starter`` stands in for the diagnosis in tests; it gets the folder and the output folder as arguments.
    """
    key = {"case": folder_hash(folder), "package": source_hash()}
    kept = answer / "record.json"
    if kept.is_file():
        record = dict(json.loads(kept.read_text()))
        if {k: record.get(k) for k in key} == key:
            return record
    shutil.rmtree(answer, ignore_errors=True)
    environment = {k: os.environ[k] for k in _KEPT if k in os.environ} | {"PYTHONPATH": str(ROOT)}
    with tempfile.TemporaryDirectory(prefix="blind_") as name:
        copy, out = Path(name) / "case", Path(name) / "out"
        shutil.copytree(folder, copy)
        line = [*starter, str(copy), str(out)] if starter else command(copy, out)
        began = time.monotonic()
        process = subprocess.Popen(
            line, cwd=name, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        errors = process.stderr.read() if process.stderr else ""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.monotonic() - began
        answer.mkdir(parents=True)
        if out.is_dir():
            for file in out.iterdir():
                if file.name in ("diagnosis.json", "evidence.json", "twin.yaml"):
                    # the twin names its road by where the copy happened to lie
                    text = file.read_text(encoding="utf-8").replace(f"{copy}/", "")
                    (answer / file.name).write_text(text, encoding="utf-8")
    record = {
        **key,
        "commit": commit(),
        "seal": seal,
        "status": process.returncode,
        "seconds": round(seconds, 2),
        "memory_mb": round(usage.ru_maxrss / 1024, 1),
        "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 2),
        "error": errors.strip().replace(name, "")[-400:] if process.returncode else "",
    }
    kept.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return record


def main(folder: Path, out: Path) -> None:
    """Diagnose with a part of the library."""
    sys.path.insert(0, str(ROOT))
    from suspension_twin.diagnosis.answer import write
    from suspension_twin.diagnosis.library import DECOYS
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.run import diagnose
    from suspension_twin.effects.registry import EFFECTS
    from suspension_twin.errors import SuspensionTwinError
    from suspension_twin.vehicle.twin import load_twin

    model = load_twin(folder / "twin.yaml").model
    without = json.loads((folder / REQUEST).read_text())["without"]
    shown, before = _drives(folder)
    # a decoy that is asked for by name would be a cause
    kept = tuple(e for e in EFFECTS if model in EFFECTS[e].models and e not in without and e not in DECOYS)
    request = DiagnosisRequest(str(folder / "twin.yaml"), tuple(shown), tuple(before), effects=kept)
    try:
        write(diagnose(request), out)
    except SuspensionTwinError as error:  # a line, as the command line says it
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
