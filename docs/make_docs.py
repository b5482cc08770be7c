#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Makes what README.md shows of the program: ``python docs/make_docs.py tables|pictures``.

``tables`` writes the commands and the nodes' parameters between their marks in README.md, as the
program itself declares them; a test says when they have fallen behind. ``pictures`` runs the demo
and keeps its figures in this folder.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
README = HERE.parent / "README.md"
PICTURES = {"bump_time": "bump.png", "characteristics": "characteristics.png", "road_map": "map.png"}


def tables() -> dict[str, str]:
    """Every generated part of the README by the name of its mark."""
    return {"commands": _commands(), "parameters": _parameters()}


def with_tables(text: str) -> str:
    """The README with its generated parts brought up to date."""
    for name, table in tables().items():
        begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
        if text.count(begin) != 1 or text.count(end) != 1:
            raise SystemExit(f"README.md: the marks of {name} are missing")
        text = text[: text.index(begin) + len(begin)] + table + text[text.index(end) :]
    return text


def _commands() -> str:
    from suspension_twin.cli.main import SUBCOMMANDS

    rows = [f"| `suspension-twin {row.name}` | {row.help} |" for row in SUBCOMMANDS]
    return "\n".join(["| command | what it does |", "| --- | --- |", *rows]) + "\n"


def _parameters() -> str:
    from suspension_twin.nodes.base import COMMON
    from suspension_twin.nodes.calibrator import CalibratorNode
    from suspension_twin.nodes.imu_ingest import ImuIngestNode
    from suspension_twin.nodes.pose_injector import PoseInjectorNode
    from suspension_twin.nodes.suspension_model import SuspensionModelNode

    groups = (
        ("every node", COMMON),
        ("imu_ingest", ImuIngestNode.parameters),
        ("pose_injector", PoseInjectorNode.parameters),
        ("suspension_model", SuspensionModelNode.parameters),
        ("calibrator", CalibratorNode.parameters),
    )
    lines = ["| node | parameter | default | from, to | what |", "| --- | --- | --- | --- | --- |"]
    for node, parameters in groups:
        for p in parameters:
            shown = node if p is parameters[0] else ""
            bounds = f"{p.low:g}, {p.high:g}" if p.low is not None else "fixed" if p.read_only else ""
            lines.append(f"| {shown} | `{p.name}` | {_default(p.default)} | {bounds} | {p.text} |")
    return "\n".join(lines) + "\n"


def _default(value: Any) -> str:
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, float):
        return f"`{value!r}`"
    return f"`{value}`" if value != "" else "`''`"


def pictures() -> None:
    """Run the demo as its command does, and keep three of its figures."""
    from suspension_twin.cli.common import bundled
    from suspension_twin.demo.page import figures
    from suspension_twin.demo.steps import run_demo
    from suspension_twin.report import style

    class Quiet:
        def begin(self, text: str) -> None:
            print(text, flush=True)

        def share(self, done: float, note: str = "") -> None:
            pass

        def end(self, text: str) -> None:
            print(f"  {text}", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        drawn = figures(run_demo(bundled("bags"), Path(folder), Quiet()))
    for name, file in PICTURES.items():
        style.save(drawn[name], HERE / file, dpi=130)


def main() -> None:
    wanted = sys.argv[1:]
    if not wanted or not set(wanted) <= {"tables", "pictures"}:
        raise SystemExit(re.sub(r"\s+", " ", __doc__ or "").strip())
    if "tables" in wanted:
        README.write_text(with_tables(README.read_text(encoding="utf-8")), encoding="utf-8")
    if "pictures" in wanted:
        pictures()


if __name__ == "__main__":
    main()
