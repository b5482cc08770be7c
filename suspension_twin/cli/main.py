# SPDX-License-Identifier: Apache-2.0
"""The command ``suspension-twin``: finds the subcommand, and turns every failure into one line.

A subcommand is a row, :class:`Subcommand`, and a module that defines either ``command(...)``, a function with typer
annotations, or ``app``, a :class:`typer.Typer` of subcommands of its own. Those of the core are :data:`SUBCOMMANDS`;
add-ons and installed packages add theirs (an entry point in the group ``suspension_twin.commands`` names a module with
the row as ``SUBCOMMAND``). Only the module of the subcommand asked for is imported, so that ``--help`` and a mistyped
option answer at once.

Exit status: 0 done, 1 the work failed, 2 unusable arguments or input; 130 after Ctrl-C, except for
a command that Ctrl-C is the normal end of.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Annotated, Any, Final, NamedTuple

import typer

from suspension_twin import __version__
from suspension_twin.errors import SuspensionTwinError, one_line, printable
from suspension_twin.registry import Registry, missing_addons

__all__ = ["SUBCOMMANDS", "Subcommand", "main", "subcommands"]

PROGRAM = "suspension-twin"
DONE, FAILED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130


class Subcommand(NamedTuple):
    """One subcommand: the name on the command line, its module and its line in ``--help``."""

    name: str
    module: str
    help: str
    endless: bool = False  # runs until it is interrupted, so an interrupt is success
    several: str = ""  # an option that takes all values up to the next option, as a shell's *.csv gives them
    bare: tuple[tuple[str, str], ...] = ()  # options whose value may be left out, and what it is then


_HERE = __package__
#: Subcommands of the core.
SUBCOMMANDS = (
    Subcommand("demo", f"{_HERE}.demo", "The whole way, live to calibrated, on the bundled drive."),
    Subcommand(
        "run",
        f"{_HERE}.run",
        "The four nodes, live or replaying a bag; or those of a fleet.",
        endless=True,
        bare=(("--view", "8080"), ("--foxglove", "8765")),
    ),
    Subcommand("new", f"{_HERE}.new", "A twin file, by a few questions or from a ready one."),
    Subcommand("calibrate", f"{_HERE}.calibrate", "Find a twin's characteristics from recorded drives."),
    Subcommand(
        "diagnose",
        f"{_HERE}.diagnose",
        "Where twin and car disagree, why, and what closes the gap.",
        several="--reference",
    ),
    Subcommand("simulate", f"{_HERE}.simulate", "The twin over a recorded drive, without ROS."),
    Subcommand("import", f"{_HERE}.import_", "A phone's or logger's recording into a bag."),
    Subcommand("salvage", f"{_HERE}.salvage", "A cut-off or index-less recording, made readable."),
    Subcommand("damping", f"{_HERE}.damping", "Which dampers a tracked vehicle should have, by speed."),
    Subcommand("road", f"{_HERE}.road", "Roads: made, scanned, from profiles or drives; checks."),
)
_ADDED: Final = Registry[Subcommand]("commands", attribute="SUBCOMMAND", kind=Subcommand, identity="name")


def subcommands() -> tuple[Subcommand, ...]:
    """All subcommands, those of add-ons and installed packages last."""
    return (*SUBCOMMANDS, *_ADDED.values())


# Importing makes a hundred thousand objects that all stay: at Python's own 700 the collector takes a tenth of a short
# command to find that out.
_COLLECT_EVERY = 50_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (``sys.argv`` by default) and return its exit status.

    Never raises, and writes at most one line of its own to standard error unless ``--debug`` asks
    for the traceback.
    """
    args, debug = _take_debug(sys.argv[1:] if arguments is None else arguments)
    try:
        chosen = _chosen(args)
    except SuspensionTwinError as error:  # a plugin that cannot be used
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return error.exit_status
    if chosen is not None and chosen.several:
        args = _repeated(args, chosen.several)
    for option, value in chosen.bare if chosen is not None else ():
        args = _completed(args, option, value)
    endless = chosen is not None and chosen.endless
    endings = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.getsignal(number) for number in endings}
    thresholds = gc.get_threshold()
    gc.set_threshold(_COLLECT_EVERY, *thresholds[1:])
    try:
        if endless:  # a service manager ends with SIGTERM, and a shell's background job would ignore SIGINT
            for number in endings:
                signal.signal(number, signal.default_int_handler)
        status = _invoke(args, chosen)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader has gone (| head). The interpreter's own flush at exit would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = FAILED
    except KeyboardInterrupt as end:
        status = DONE if endless else INTERRUPTED
        if not endless:
            print(printable(f"{PROGRAM}: interrupted{f', {end}' if str(end) else ''}"), file=sys.stderr)
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else FAILED if error.code else DONE
    except Exception as error:
        if debug:
            traceback.print_exc()
        status, text = _explain(error, _option(args, "--twin"))
        print(one_line(" ".join(text.split())), file=sys.stderr)
    finally:
        gc.set_threshold(*thresholds)
        if endless:
            for number, handler in previous.items():
                signal.signal(number, handler)
    return status


def _take_debug(arguments: Sequence[str]) -> tuple[list[str], bool]:
    """Take ``--debug`` out, wherever it stands before a ``--``: it belongs to no subcommand."""
    args = list(arguments)
    end = args.index("--") if "--" in args else len(args)
    own = [a for a in args[:end] if a != "--debug"]
    return own + args[end:], len(own) < end


def _repeated(args: Sequence[str], option: str) -> list[str]:
    """``--reference a b`` as ``--reference a --reference b``: the command line parser takes one value an option."""
    found: list[str] = []
    taking = False
    for argument in args:
        more = taking and not argument.startswith("-")
        if more and found[-1] != option:
            found.append(option)
        taking = argument == option or argument.startswith(f"{option}=") or more
        found.append(argument)
    return found


def _completed(args: Sequence[str], option: str, value: str) -> list[str]:
    """``--view`` without a value as ``--view 8080``: the command line parser wants one."""
    found: list[str] = []
    for argument, following in zip(args, [*args[1:], "-"], strict=True):
        found.append(argument)
        if argument == "--":
            return [*found, *args[args.index("--") + 1 :]]
        if argument == option and following.startswith("-"):
            found.append(value)
    return found


def _chosen(args: Sequence[str]) -> Subcommand | None:
    """The subcommand that ``args`` begins with, if it is one (the program itself has only flags)."""
    name = next((a for a in args if not a.startswith("-")), "")
    return next((s for s in SUBCOMMANDS if s.name == name), None) or (_ADDED.get(name) if name else None)


def _invoke(args: list[str], chosen: Subcommand | None) -> int:
    command = typer.main.get_command(_application(chosen))
    try:
        with command.make_context(PROGRAM, args) as context:
            command.invoke(context)
    except typer.Exit as end:
        return end.exit_code
    return DONE


def _application(chosen: Subcommand | None) -> typer.Typer:
    """The chosen subcommand, or all of them by name and help."""
    app = typer.Typer(
        add_completion=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="A live digital twin of a vehicle's suspension: follow a real car, calibrate, and find why they differ.",
        epilog="More about a command: suspension-twin COMMAND --help",
    )
    app.callback()(_root)
    for row in subcommands() if chosen is None else (chosen,):
        if chosen is None:
            app.command(row.name, help=row.help)(_not_imported)
            continue
        module = import_module(row.module)
        if hasattr(module, "app"):
            app.add_typer(module.app, name=row.name, help=row.help)
        else:
            app.command(row.name, help=_paragraphs(module.command.__doc__ or row.help))(module.command)
    return app


def _paragraphs(docstring: str) -> str:
    """The text without the line breaks of the source, which would show among those of the terminal."""
    return "\n\n".join(" ".join(part.split()) for part in docstring.split("\n\n"))


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"{PROGRAM} {__version__}")
        raise typer.Exit()


def _root(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True),
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Options before a subcommand; ``--debug`` is taken out of the arguments by :func:`main`."""


def _not_imported() -> None:
    raise AssertionError("a subcommand ran that was not chosen")


def _option(args: Sequence[str], name: str) -> str | None:
    """The value given to the option ``name``; None if there is none."""
    for argument, following in zip(args, [*args, None][1:], strict=True):
        if argument == name:
            return following
        if argument.startswith(f"{name}="):
            return argument.partition("=")[2]
    return None


def _explain(error: Exception, twin: str | None) -> tuple[int, str]:
    """Exit status and one line for an error that ended a subcommand; ``twin`` is the twin file given to it."""
    format_message: Callable[[], str] | None = getattr(error, "format_message", None)
    if format_message is not None:  # typer's own errors, all about the arguments
        where: Any = getattr(error, "ctx", None)
        path = where.command_path if where is not None else PROGRAM
        message = format_message().rstrip(". ")
        if message == "Missing command":
            print(where.get_help())
        if message.startswith("No such command"):
            message += missing_addons()
        return UNUSABLE, f"{path}: {message} (see {path} --help)"
    from suspension_twin.files import explained

    status, text = explained(error)
    if twin and isinstance(error, SuspensionTwinError) and text.startswith("twin: "):
        text = twin + text.removeprefix("twin")  # said of a twin in memory, which knows of no file
    return status, f"{PROGRAM}: {text}"


if __name__ == "__main__":
    sys.exit(main())
