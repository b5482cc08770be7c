# SPDX-License-Identifier: Apache-2.0
"""Parts of several subcommands: arguments, the files they write, progress, tables, and the bundled files."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, final

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

import suspension_twin
from suspension_twin.errors import InputError, printable
from suspension_twin.files import check_writable

if TYPE_CHECKING:
    from suspension_twin.diagnosis.wording import Document

__all__ = [
    "Bag",
    "Bags",
    "Force",
    "Outputs",
    "ProgressLine",
    "Seed",
    "SourceUrls",
    "TwinFile",
    "bundled",
    "output",
    "print_diagnosis",
    "print_table",
]

TwinFile = Annotated[
    Path, typer.Option("--twin", help="The twin file.", metavar="TWIN.YAML", show_default=False)
]
Bag = Annotated[
    Path,
    typer.Argument(
        help="A recorded drive: a rosbag2 folder or a bare file.", metavar="BAG", show_default=False
    ),
]
Bags = Annotated[
    list[Path],
    typer.Argument(help="Recorded drives: rosbag2 folders or bare files.", metavar="BAG", show_default=False),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of every random choice.", metavar="N", min=0)]
SourceUrls = Annotated[
    list[str] | None,
    typer.Option(
        "--source",
        help="A live phone, receiver or IMU, such as sensorlogger://0.0.0.0:8000; several: the option again. "
        "All kinds: docs/sources.md.",
        metavar="URL",
        show_default=False,
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite what exists.")]

_UNBROKEN = 10_000  # characters: a line that is not for a terminal is never wrapped


@final
class _Plain(Console):
    """A console on which a text is a text: names of files and topics may hold ``[/a]`` or the codes of a terminal.

    Style is given beside a text (``style=``, or :class:`rich.text.Text`), never within it.
    """

    def render_str(self, text: str, **options: Any) -> Text:
        """A string of anybody, as it stands, control characters as escapes."""
        return super().render_str(printable(text), **{**options, "markup": False, "emoji": False})


def output() -> Console:
    """Standard output: lines are wrapped between words on a terminal, and left whole in a pipe or file."""
    return _Plain(highlight=False, width=None if sys.stdout.isatty() else _UNBROKEN)


def print_table(
    console: Console,
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    words: Sequence[str] | None = None,
) -> None:
    """A table of which nothing is cut off: the columns ``words`` (the first) may wrap, the others hold numbers."""
    wrapping = columns[:1] if words is None else words
    heads = (
        Column(name, overflow="fold")
        if name in wrapping
        else Column(name, justify="right", overflow="fold", no_wrap=True)
        for name in columns
    )
    table = Table(*heads, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for row in rows:
        table.add_row(*row)
    console.print(title, style="bold")
    console.print(table)
    console.print()


@final
class Outputs:
    """Files or folders that a command writes: checked before the work, announced, and kept whole on Ctrl-C.

    Raises InputError for one that exists (unless ``force``) or cannot be written. As a context manager it ends an
    interrupt with how to go on; ``resumed_from`` is a folder from which the same command goes on where it was.
    """

    def __init__(self, *paths: Path, force: bool, resumed_from: Path | None = None) -> None:
        self._paths, self._force, self._resumed_from = paths, force, resumed_from
        self._announced = False
        for path in paths:
            if path.exists() and not force:
                raise InputError(path, "exists already: --force overwrites it")
            check_writable(path)

    def announce(self) -> None:
        """The first line of a command's output, if it writes anything; once, when the input is known to be usable."""
        if self._paths and not self._announced:
            self._announced = True
            output().print(f"Writes {', '.join(map(str, self._paths))}")

    def __enter__(self) -> Outputs:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not KeyboardInterrupt:
            return
        force = " with --force" if not self._force and any(p.exists() for p in self._paths) else ""
        folder = self._resumed_from
        going_on = folder is not None and any(folder.glob("state*.npz"))
        raise KeyboardInterrupt(
            f"the same command{force} goes on from what is kept in {folder}"
            if going_on
            else f"start the same command{force} again"
        ) from None


def bundled(*parts: str) -> Path:
    """The path of a file or folder that comes with the program, such as ``bundled("config", "twins")``.

    From a source tree it lies there; otherwise where the installation put it: ``share/suspension_twin`` under the
    environment (pip) or under the package's own prefix (colcon). Raises :class:`InputError` if it is nowhere.
    """
    package = Path(suspension_twin.__file__).resolve().parent
    # colcon installs the code to <prefix>/lib/pythonX.Y/site-packages and the rest to <prefix>/share.
    shares = (prefix / "share" / "suspension_twin" for prefix in (Path(sys.prefix), *package.parents[3:5]))
    roots = [package.parent, *shares]
    for root in roots:
        if (root / "package.xml").is_file() and (found := root.joinpath(*parts)).exists():
            return found
    raise InputError(
        "/".join(parts), f"is missing from the installation, looked in {', '.join(map(str, roots))}"
    )


@final
class ProgressLine:
    """The stage of the work and a bar on the terminal's standard error, removed at the end; in a log nothing."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        text = TextColumn("{task.description}", markup=False, table_column=Column(ratio=1, no_wrap=True))
        self._bar = Progress(
            text,
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
            expand=True,
        )
        self._task = self._bar.add_task("reading", total=None)

    def __enter__(self) -> ProgressLine:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    @property
    def elapsed(self) -> float:
        """Seconds since the work began."""
        return self._bar.tasks[0].elapsed or 0.0

    def show(self, text: str, share: float | None = None) -> None:
        """Show the stage, and the share of the work that is done, 0 to 1; None: not known."""
        total = None if share is None else 1.0
        self._bar.update(self._task, description=printable(text), total=total, completed=share)


def print_diagnosis(document: Document, out: Path | None) -> None:
    """Print ``diagnosis.json`` in a few lines: warnings, verdict, the likeliest causes, and the folder if any."""
    from suspension_twin.diagnosis import wording

    console = output()
    for warning in document["warnings"]:
        console.print(warning, style="yellow")
    console.print(wording.answer(document), style="bold")
    for remark in wording.remarks(document):
        console.print(remark)
    rows = [
        (
            wording.effect_name(cause["effect"]),
            "; ".join(f"{name} {value}" for name, value in wording.parameters_of(cause)),
            wording.channel_name(wording.channel_of(document, cause)),
            f"{cause['presence']:.3f}",
            wording.percent(cause["shrink"]),
            " to ".join(map(wording.percent, cause["shrink_interval"])),
        )
        for cause in document["causes"][:5]
    ]
    columns = "cause", "parameters", "channel", "probability", "closes", "90 % interval"
    title = "The likeliest causes; what each closes of the gap, with its interval on one more drive"
    print_table(console, title, columns, rows, words=columns[:3])
    known, unknown = (document[f"{name}_probability"] for name in ("no_gap", "unknown"))
    console.print(f"No gap {known:.3f}, unknown {unknown:.3f}.")
    if document.get("next_experiment"):
        console.print(document["next_experiment"])
    drive = document.get("next_drive")
    if drive and "road" not in drive and out is not None:
        console.print(f"Then: suspension-twin diagnose --add DRIVE --out {out}")
    if out is not None:
        console.print(f"Written to {out}")
