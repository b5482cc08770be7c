# SPDX-License-Identifier: Apache-2.0
"""The command line as a whole: exit status, one line for every failure, nothing imported without need."""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import pytest
import typer
from rich.console import Console

import suspension_twin
from suspension_twin.calibration.labels import parameter_label, parameter_unit
from suspension_twin.cli import main as program
from suspension_twin.cli.common import Outputs, bundled, output, print_table
from suspension_twin.cli.main import Subcommand, main, subcommands
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.space import curve_keys
from suspension_twin.vehicle.twin import load_twin

COMMAND = [sys.executable, "-m", "suspension_twin"]
CONTRACT = {"demo", "run", "connect", "record", "calibrate", "simulate", "import", "road"}


class Colour(str, Enum):
    """A choice."""

    red = "red"
    green = "green"


def failing(error: BaseException) -> Callable[[], None]:
    def command() -> None:
        raise error

    return command


@pytest.fixture
def with_command(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Puts one made-up subcommand ``work`` into the program."""

    def put(command: Callable[..., None] | typer.Typer, **row: bool) -> None:
        module = ModuleType("suspension_twin.cli.work")
        setattr(module, "app" if isinstance(command, typer.Typer) else "command", command)
        monkeypatch.setitem(sys.modules, module.__name__, module)
        row_of = Subcommand("work", module.__name__, "Works.", **row)
        monkeypatch.setattr(program, "SUBCOMMANDS", (row_of,))

    yield put


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    status = main(arguments)
    out, err = capsys.readouterr()
    return status, out, err


def test_every_command_of_the_contract_is_there() -> None:
    assert {row.name for row in subcommands()} >= CONTRACT


def test_every_file_of_a_command_is_listed(repository: Path) -> None:
    files = {p.stem for p in (repository / "suspension_twin/cli").glob("*.py") if not p.stem.startswith("_")}
    core = {row.module for row in subcommands() if row.module.startswith("suspension_twin.cli.")}
    assert {f"suspension_twin.cli.{name}" for name in files - {"main", "common", "options"}} == core


@pytest.mark.parametrize("row", subcommands(), ids=lambda row: row.name)
def test_every_command_helps(row: Subcommand, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run([row.name, "--help"], capsys)
    assert (status, err) == (0, "")
    assert "Usage:" in out


@pytest.mark.parametrize("row", subcommands(), ids=lambda row: row.name)
def test_every_command_names_an_unknown_option(row: Subcommand, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run([row.name, "--no-such-option"], capsys)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "--no-such-option" in err or row.name == "road"


def test_help_lists_every_command_and_imports_none(capsys: pytest.CaptureFixture[str]) -> None:
    code = (
        "import sys; from suspension_twin.cli.main import main; status = main(['--help']);"
        "heavy = [m for m in sys.modules if m.split('.')[0] in ('numpy', 'scipy', 'numba', 'rclpy', 'matplotlib')];"
        "sys.exit(status or len(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    for row in subcommands():
        assert row.name in done.stdout
        assert row.help.rstrip(".") in " ".join(done.stdout.split())


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"], capsys) == (0, f"suspension-twin {suspension_twin.__version__}\n", "")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["frobnicate"], "frobnicate"),
        (["--bogus"], "--bogus"),
        (["--bogus", "demo"], "--bogus"),
        (["road", "frobnicate"], "frobnicate"),
        (["calibrate", "--out", "x.yaml", "bag"], "--twin"),
        (["simulate", "--twin", "x.yaml", "bag"], "--out"),
        (["calibrate", "--twin", "no-such-twin.yaml", "bag", "--out", "x.yaml"], "no-such-twin.yaml"),
        (["road", "check", "no-such-road.crg"], "no-such-road.crg"),
        (["import", "no-such-file.csv", "--out", "bag"], "no-such-file.csv"),
    ],
    ids=" ".join,
)
def test_unusable_arguments_are_one_line_that_names_them(
    arguments: list[str],
    named: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = run(arguments, capsys)
    assert (status, out) == (2, "")
    assert named in err
    assert err.count("\n") == 1
    assert err.startswith("suspension-twin")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [[], ["road"]], ids=["nothing", "road"])
def test_a_missing_command_is_met_with_help(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(arguments, capsys)
    assert status == 2
    assert "Usage:" in out
    path = " ".join(["suspension-twin", *arguments])
    assert err == f"{path}: Missing command (see {path} --help)\n"


def test_a_bad_choice_and_a_bad_number_are_one_line(
    with_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def command(colour: Colour, size: Annotated[int, typer.Option(min=1)] = 1) -> None:
        print(colour.value, size)

    with_command(command)
    assert run(["work", "red"], capsys) == (0, "red 1\n", "")
    for arguments, named in (
        (["work"], "colour"),
        (["work", "blue"], "blue"),
        (["work", "red", "--size", "0"], "size"),
        (["work", "red", "--size", "big"], "--size"),
        (["work", "red", "green"], "green"),
    ):
        status, out, err = run(arguments, capsys)
        assert (status, out) == (2, "")
        assert named in err.lower()
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InputError("t.yaml", "vehicle.mass", "must be above 0"), 2, "t.yaml: vehicle.mass: must be above 0"),
        (WorkError("the search found nothing"), 1, "the search found nothing"),
        (InputError("a", "several\nlines\n  of it"), 2, r"a: several\nlines\n of it"),
        (FileNotFoundError(2, "No such file", "x.csv"), 2, "x.csv: No such file"),
        (PermissionError(13, "Permission denied", "/out"), 2, "/out: Permission denied"),
        (OSError(5, "Input/output error", "disk"), 1, "disk: Input/output error"),
        (OSError(28, "No space left on device"), 1, "no space left to write the results"),
        (MemoryError(), 1, "out of memory"),
        (
            ZeroDivisionError("by zero"),
            1,
            "unexpected error, ZeroDivisionError: by zero (--debug shows where)",
        ),
        (KeyError(), 1, "unexpected error, KeyError (--debug shows where)"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_an_error_becomes_a_status_and_one_line(
    error: BaseException,
    status: int,
    line: str,
    with_command: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with_command(failing(error))
    assert run(["work"], capsys) == (status, "", f"suspension-twin: {line}\n")


@pytest.mark.parametrize("arguments", [["--debug", "work"], ["work", "--debug"]], ids=" ".join)
def test_debug_shows_the_traceback_from_either_place(
    arguments: list[str], with_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    with_command(failing(ZeroDivisionError("by zero")))
    status, _, err = run(arguments, capsys)
    assert status == 1
    assert "Traceback" in err
    assert err.endswith(
        "suspension-twin: unexpected error, ZeroDivisionError: by zero (--debug shows where)\n"
    )


def test_debug_after_two_dashes_is_an_argument(
    with_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def command(words: list[str]) -> None:
        print(*words)

    with_command(command)
    assert run(["work", "--", "--debug"], capsys) == (0, "--debug\n", "")


def test_exit_and_interrupt(with_command: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    with_command(failing(typer.Exit(1)))
    assert run(["work"], capsys) == (1, "", "")
    with_command(failing(SystemExit(3)))
    assert run(["work"], capsys) == (3, "", "")
    with_command(failing(KeyboardInterrupt()))
    assert run(["work"], capsys) == (130, "", "suspension-twin: interrupted\n")
    with_command(failing(KeyboardInterrupt()), endless=True)
    assert run(["work"], capsys) == (0, "", "")


def test_subcommands_of_a_subcommand(
    with_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    app = typer.Typer()

    @app.command()
    def show(name: str) -> None:
        print("shown", name)

    @app.command()
    def check(name: str) -> None:
        raise InputError(name, "is wrong")

    with_command(app)
    assert run(["work", "show", "x"], capsys) == (0, "shown x\n", "")
    assert run(["work", "check", "x"], capsys) == (2, "", "suspension-twin: x: is wrong\n")
    status, _, err = run(["work", "show"], capsys)
    assert status == 2
    assert err.startswith("suspension-twin work show: Missing argument")


def test_help_flows_as_the_terminal_is_wide(
    with_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def command() -> None:
        """Works.

        One sentence that is broken
        in the source.
        """

    with_command(command)
    _, out, _ = run(["work", "--help"], capsys)
    assert "One sentence that is broken in the source." in out


def test_the_module_runs() -> None:
    whole = subprocess.run([*COMMAND, "--version"], capture_output=True, text=True, timeout=60)
    assert (whole.returncode, whole.stderr) == (0, "")
    assert whole.stdout == f"suspension-twin {suspension_twin.__version__}\n"


def program_with(body: str, path: Path, endless: bool = False) -> list[str]:
    """A command line that runs the program in a process of its own, with ``body`` as its one subcommand."""
    path.write_text(
        "import sys, time, types\n"
        "from suspension_twin.cli import main as program\n"
        f"row = program.Subcommand('work', 'suspension_twin.cli.work', 'Works.', endless={endless})\n"
        "program.SUBCOMMANDS = (row,)\n"
        "def command():\n"
        f"    {body}\n"
        "program.import_module = lambda name: types.SimpleNamespace(command=command)\n"
        "sys.exit(program.main(['work']))\n"
    )
    return [sys.executable, str(path)]


@pytest.mark.parametrize("size", [1, 1_000_000])
def test_a_reader_that_leaves_is_no_trouble(size: int, tmp_path: Path) -> None:
    """``suspension-twin ... | head``: whether the pipe breaks in the middle or at the last flush."""
    body = f"time.sleep(0.5); print('x' * {size})"
    with subprocess.Popen(
        program_with(body, tmp_path / "talk.py"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        child.stdout.close()
        _, err = child.communicate(timeout=60)
        assert (child.returncode, err) == (1, "")


@pytest.mark.parametrize(
    ("end", "endless", "status"),
    [(signal.SIGINT, False, 130), (signal.SIGINT, True, 0), (signal.SIGTERM, True, 0)],
    ids=["Ctrl-C", "Ctrl-C endless", "SIGTERM endless"],
)
def test_a_signal_ends_a_command_in_a_line_or_quietly(
    end: signal.Signals, endless: bool, status: int, tmp_path: Path
) -> None:
    """Also while it still imports, which takes seconds: the program's own handlers are in place before."""
    body = "print('at work', flush=True); time.sleep(30)"
    # a shell that runs the tests in the background has its children ignore Ctrl-C
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        child = subprocess.Popen(
            program_with(body, tmp_path / "work.py", endless),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        signal.signal(signal.SIGINT, before)
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "at work\n"
        start = time.monotonic()
        child.send_signal(end)
        _, err = child.communicate(timeout=20)
        said = "" if endless else "suspension-twin: interrupted\n"
        assert (child.returncode, err) == (status, said)
        assert time.monotonic() - start < 5
    finally:
        child.kill()


def test_bundled_files_are_found_and_a_missing_one_is_named(repository: Path) -> None:
    assert bundled("package.xml") == repository / "package.xml"
    with pytest.raises(InputError, match="config/no-such-file"):
        bundled("config", "no-such-file")


BUMP = "bags/bump_15kmh"
#: A quick way to each command that writes, and the files that it then writes into the folder OUT.
WRITING = (
    (
        ["calibrate", "--twin", f"{BUMP}/twin.yaml", BUMP, "--out", "OUT/c.yaml"],
        ["c.yaml", "c.calibration.yaml"],
    ),
    (
        ["calibrate", "--twin", f"{BUMP}/twin.yaml", BUMP, "--out", "OUT/c.yaml", "--report", "OUT"],
        ["report.html"],
    ),
    (
        ["diagnose", "--twin", f"{BUMP}/twin.yaml", BUMP, "--out", "OUT"],
        ["diagnosis.json", "report.html", "twin.yaml"],
    ),
    (["simulate", "--twin", f"{BUMP}/twin.yaml", BUMP, "--out", "OUT"], ["gap.json", "simulated"]),
    (["import", BUMP, "--out", "OUT/bag"], ["bag"]),
    (["record", "--source", "sensorlogger://127.0.0.1:0", "--seconds", "0.1", "--out", "OUT/bag"], ["bag"]),
    (["import", BUMP, "--out", "OUT/bag.mcap"], ["bag.mcap"]),
    (
        ["damping", "--twin", "config/tracked/pt91.yaml", "--out", "OUT"],
        ["pitch_variance.png", "pitch_variance.json"],
    ),
    (["road", "show", f"{BUMP}/road.crg", "--out", "OUT/a.png"], ["a.png"]),
    (["road", "mesh", f"{BUMP}/road.crg", "--out", "OUT/a.obj"], ["a.obj"]),
    (["road", "check", f"{BUMP}/road.crg", "--out", "OUT/a.json"], ["a.json"]),
    (["demo", "--out", "OUT"], ["index.html", "twin.yaml"]),
)
ONE_BY_ONE = [(arguments, name) for arguments, names in WRITING for name in names]


def put_in(arguments: list[str], out: Path, repository: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(repository)
    return [a.replace("OUT", str(out)) for a in arguments]


@pytest.mark.parametrize(("arguments", "name"), ONE_BY_ONE, ids=lambda v: v if isinstance(v, str) else v[0])
def test_what_exists_is_overwritten_only_by_force(
    arguments: list[str],
    name: str,
    repository: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / name).write_text("mine")
    status, out, err = run(put_in(arguments, tmp_path, repository, monkeypatch), capsys)
    assert (status, out) == (2, "")
    assert err == f"suspension-twin: {tmp_path / name}: exists already: --force overwrites it\n"
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [(name, "mine")]


@pytest.mark.parametrize("arguments", [a for a, _ in WRITING], ids=lambda v: v[0])
def test_an_output_that_cannot_be_written_is_said_before_the_work(
    arguments: list[str],
    repository: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "file").write_text("mine")
    began = time.monotonic()
    status, out, err = run(put_in(arguments, tmp_path / "file" / "x", repository, monkeypatch), capsys)
    assert (status, out) == (2, "")
    assert "cannot be written: Not a directory" in err and err.count("\n") == 1
    assert time.monotonic() - began < 10


@pytest.mark.parametrize("what", ["show", "mesh", "check"])
def test_the_first_line_says_what_is_written(
    what: str, repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / {"show": "a.png", "mesh": "a.stl", "check": "a.json"}[what]
    arguments = ["road", what, str(repository / BUMP / "road.crg"), "--out", str(path)]
    for more in ([], ["--force"]):
        status, out, err = run([*arguments, *more], capsys)
        assert (status, err) == (0, "")
        assert out.splitlines()[0] == f"Writes {path}"


@pytest.mark.parametrize(
    ("made", "kept", "words"),
    [
        (False, False, "start the same command again"),
        (True, False, "start the same command with --force again"),
        (False, True, "the same command goes on from what is kept in "),
    ],
)
def test_an_interrupt_says_how_to_go_on(
    made: bool,
    kept: bool,
    words: str,
    tmp_path: Path,
    with_command: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    def command() -> None:
        with Outputs(tmp_path / "a", force=False, resumed_from=tmp_path / "state"):
            if made:
                (tmp_path / "a").write_text("")
            if kept:
                (tmp_path / "state").mkdir()
                (tmp_path / "state" / "state.npz").write_text("")
            raise KeyboardInterrupt

    with_command(command)
    status, out, err = run(["work"], capsys)
    assert (status, out) == (130, "")
    assert err.startswith(f"suspension-twin: interrupted, {words}") and err.count("\n") == 1


PAGES = [
    [row.name, *more]
    for row in subcommands()
    for more in ([[], ["show"], ["mesh"], ["check"]] if row.name == "road" else [[]])
]


@pytest.mark.parametrize("command", [[], *PAGES], ids=" ".join)
def test_help_fits_80_columns(
    command: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    status, out, _ = run([*command, "--help"], capsys)
    assert status == 0
    assert max(map(len, out.splitlines())) <= 80
    assert "…" not in out and "<bool>" not in out


def on_terminal(width: int) -> Console:
    return Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)


def shown(console: Console) -> str:
    file = console.file
    assert isinstance(file, io.StringIO)
    return file.getvalue()


def test_a_calibration_s_table_is_whole_at_80_columns_and_in_a_pipe(
    repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The longest names, units and numbers of a car."""
    twin = load_twin(repository / "config" / "twins" / "ford_mondeo_mk4.yaml")
    keys = [
        *curve_keys(twin),
        "vehicle.sprung_inertia.pitch",
        "vehicle.tyre.vertical_stiffness",
        "vehicle.front.unsprung_mass",
        "imu.position.0",
    ]
    columns = "parameter", "unit", "start", "found", "90 % interval", "status"
    rows = [
        (parameter_label(twin, k), parameter_unit(k), "11500", "12192", "10975 to 15566", "not identified")
        for k in keys
    ]
    console = on_terminal(80)
    print_table(console, "What was found", columns, rows, words=("parameter", "unit", "status"))
    lines = shown(console).splitlines()
    assert len(lines) == len(rows) + 3 and max(map(len, lines)) <= 80
    print_table(output(), "What was found", columns, rows, words=("parameter", "unit", "status"))
    piped = capsys.readouterr().out
    for text in (shown(console), piped):
        assert "…" not in text
        for row in (columns, *rows):
            assert all(cell in text for cell in row)
    assert {"N", "kg m²", "N/m", "kg", "m"} == {row[1] for row in rows}


def test_a_table_wraps_words_and_never_numbers() -> None:
    console = on_terminal(40)
    print_table(console, "T", ("name", "value"), [("a name that is far too long for this terminal", "12345")])
    assert "12345" in shown(console) and "terminal" in shown(console) and "…" not in shown(console)


def test_reference_takes_all_that_follow_it(repository: Path, tmp_path: Path, capsys: Any) -> None:
    """As a shell's ``before/*`` gives them: none of them becomes a drive with the gap."""
    seen: list[Any] = []

    def diagnose(request: Any, *given: Any) -> Any:
        seen.append(request)
        raise WorkError("enough")

    twin = str(repository / "bags" / "bump_15kmh" / "twin.yaml")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("suspension_twin.diagnosis.run.diagnose", diagnose)
        for line in (
            ["a", "b", "--reference", "c", "d", "--seed", "1"],
            ["--reference", "c", "--reference", "d", "--seed", "1", "a", "b"],
            ["a", "b", "--seed", "1", "--reference=c", "d"],
        ):
            assert main(["diagnose", "--twin", twin, *line, "--out", str(tmp_path / "out")]) == 1
    capsys.readouterr()
    assert [(r.bags, r.reference, r.seed) for r in seen] == [(("a", "b"), ("c", "d"), 1)] * 3
    assert main(["diagnose", "--twin", twin, "--reference", "c", "a", "--out", str(tmp_path / "out")]) == 2
    assert "BAG" in capsys.readouterr().err


STRANGE = "run[/a]\x1b[31m\nverdict: no_gap [bold]x[/] :smile: \udcff"


def test_names_of_files_are_shown_and_not_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    console = output()
    console.print(f"Written to {STRANGE}", style="bold")
    print_table(console, STRANGE, ("name", "value"), [(STRANGE, "1")])
    out, _ = capsys.readouterr()
    assert out.count(r"run[/a]\x1b[31m\nverdict: no_gap [bold]x[/] :smile: \udcff") == 3
    assert "\x1b" not in out


def test_a_failure_is_one_line_whatever_the_file_is_called(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    road = tmp_path / STRANGE
    road.parent.mkdir(parents=True)
    road.write_text("$CT\n")
    status, _, err = run(["road", "check", str(road)], capsys)
    assert status == 2 and err.count("\n") == 1 and "\x1b" not in err and "[bold]x[/]" in err


@pytest.mark.parametrize("command", ["show", "mesh", "check"])
def test_a_folder_with_brackets_is_written_to(
    command: str, repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run[" / "a][/b]" / {"show": "a.png", "mesh": "a.obj", "check": "a.json"}[command]
    road = repository / "bags" / "bump_15kmh" / "road.crg"
    status, said, err = run(["road", command, str(road), "--out", str(out)], capsys)
    assert (status, err) == (0, "") and str(out) in said and out.stat().st_size > 0


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_no_space_is_a_failure_of_the_work(
    number: int, with_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    with_command(failing(OSError(number, os.strerror(number))))
    assert run(["work"], capsys)[0] == 1
    with_command(failing(OSError(number, os.strerror(number), "x.yaml")))
    assert run(["work"], capsys)[0] == 1
