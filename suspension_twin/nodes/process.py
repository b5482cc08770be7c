# SPDX-License-Identifier: Apache-2.0
"""A process around nodes: it ends within a second of Ctrl-C or SIGTERM, with exit status 0."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.logging import set_logger_level
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.nodes.topics import Embedding

if TYPE_CHECKING:
    from suspension_twin.nodes.base import TwinNode

__all__ = ["WAIT", "Stop", "check_arguments", "events_executor", "ros_context", "run_alone", "stopping"]

#: Longest wait in C, during which Python does not see a signal, in s.
WAIT = 0.1
#: Time in s from a signal to the end of the process, at most.
_DEADLINE = 0.7
_ENDINGS = (signal.SIGINT, signal.SIGTERM)
#: Where Fast DDS looks for its profiles: a variable, or a file in the current directory. The process's first context
#: reads them.
_PROFILES, _PROFILES_HERE = "FASTRTPS_DEFAULT_PROFILES_FILE", "DEFAULT_FASTRTPS_PROFILES.xml"


class Stop:
    """Whether the process has been asked to end: a handler for SIGINT and SIGTERM, which raises KeyboardInterrupt where
    it ``interrupts``."""

    def __init__(self, interrupts: bool = True) -> None:
        self.asked, self.interrupts = False, interrupts

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        if not self.asked:
            # Both: the exception interrupts a long computation; the flag remains if the exception
            # is lost in a destructor or a callback from C.
            self.asked = True
            if self.interrupts:
                raise KeyboardInterrupt

    @contextmanager
    def again(self) -> Iterator[None]:
        """Within, another signal raises KeyboardInterrupt once more: for work that is done after the first."""
        before, self.asked = self.asked, False
        try:
            yield
        finally:
            self.asked = before or self.asked

    @contextmanager
    def held(self) -> Iterator[None]:
        """Within, a signal interrupts nothing: it is asked for."""
        before, self.interrupts = self.interrupts, False
        try:
            yield
        finally:
            self.interrupts = before

    def leave(self) -> None:
        """End the process here if it has been asked to: the interpreter's regular exit takes half
        a second with a compiler loaded, and there is nothing to clean up."""
        if self.asked:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(OSError, ValueError):
                    stream.flush()
            os._exit(0)


@contextmanager
def stopping(deadline: float | None = None, interrupts: bool = True) -> Iterator[Stop]:
    """SIGINT and SIGTERM raise KeyboardInterrupt within, once, where it ``interrupts``, and then end the process with
    status 0, at the latest ``deadline`` s (0.7 by default) after the signal. Python's handlers wait for the main
    thread, which may be in compiled code; the byte that a signal writes to the wake-up descriptor does not."""
    stop, lost = Stop(interrupts), sys.unraisablehook
    before = {number: signal.signal(number, stop) for number in _ENDINGS}
    here, there = socket.socketpair()
    there.setblocking(False)
    wakeup = signal.set_wakeup_fd(there.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        while numbers := here.recv(64):
            if set(numbers) & set(_ENDINGS):
                time.sleep(_DEADLINE if deadline is None else deadline)
                os._exit(0)

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        # No traceback of a KeyboardInterrupt lost in a destructor: flag and deadline end the process nevertheless.
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):
            lost(unraisable)

    sys.unraisablehook = hook
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield stop
    except KeyboardInterrupt:
        stop.asked = True
    finally:
        sys.unraisablehook = lost
        signal.set_wakeup_fd(wakeup)
        there.close()
        stop.leave()
    for number, handler in before.items():
        signal.signal(number, handler)


@contextmanager
def ros_context(args: list[str] | None) -> Iterator[Context]:
    """A ROS context, shut down at the end; ``args`` are those after the program's name.

    Fast DDS gets the profile ``fast_dds.xml``, with which lost messages are soon sent again, unless the user has given
    one.

    Raises InputError for arguments that ROS does not accept.
    """
    context = Context()
    if not Path(_PROFILES_HERE).exists():
        os.environ.setdefault(_PROFILES, str(Path(__file__).with_name("fast_dds.xml")))
    set_logger_level("rcl", LoggingSeverity.FATAL)  # it would log what is raised here
    try:
        rclpy.init(args=args, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # The text names places in rcl's sources.
        text = re.sub(r",? at /\S+", "", " ".join(str(error).split()))
        raise InputError("ROS arguments", text.removeprefix("failed to initialize rcl: ")) from None
    finally:
        set_logger_level("rcl", LoggingSeverity.INFO)
    try:
        yield context
    finally:
        context.try_shutdown()


def check_arguments(args: list[str]) -> None:
    """Raise InputError for an argument that is not ROS's: ROS would ignore it without a word."""
    try:
        strange = [a for a in remove_ros_args(["", *args])[1:] if a != "--"]
    except RuntimeError:  # half a ROS argument, which the context refuses
        return
    if strange:
        raise InputError(strange[0], "unknown argument: arguments for ROS follow --ros-args")


def help_text(kind: Any, program: str) -> str:
    """Help of a node's program: its purpose, and its parameters with their defaults."""
    lines = [f"Usage: {program} [--ros-args -p NAME:=VALUE -r FROM:=TO ...]", ""]
    lines += [
        *textwrap.wrap(" ".join((kind.__doc__ or "").replace("``", "").split()), 80),
        "",
        "Parameters (-p):",
    ]
    for param in (*kind.common, *kind.parameters):
        shown = json.dumps(param.default) if isinstance(param.default, (bool, str)) else param.default
        bounds = "" if param.low is None else f" ({param.low:g} to {param.high:g})"
        lines += textwrap.wrap(f"{param.name} = {shown}", 80, initial_indent="  ")
        lines += textwrap.wrap(
            f"{param.text}{bounds}", 80, initial_indent="      ", subsequent_indent="      "
        )
    return "\n".join(lines)


def events_executor(context: Context) -> Executor:
    """rclpy's events executor, where this version of rclpy has it: a message costs it the same however many
    subscriptions there are."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def run_alone(
    make: Callable[[Embedding], TwinNode],
    args: list[str] | None = None,
    events: bool = False,
) -> int:
    """Run one node until it is asked to stop; return the exit status. With ``events`` rclpy's events executor serves
    it, which logs whatever a callback raises: a signal does not interrupt one then."""
    try:
        arguments = sys.argv if args is None else args
        own = arguments[1 : arguments.index("--ros-args")] if "--ros-args" in arguments else arguments[1:]
        if {"-h", "--help"} & set(own):
            print(help_text(make, os.path.basename(arguments[0])), flush=True)
            return 0
        check_arguments(arguments[1:])
        with stopping(interrupts=not events) as stop, ros_context(arguments) as context:
            node = make(Embedding(context=context))
            node.bring_up()
            executor = events_executor(context) if events else SingleThreadedExecutor(context=context)
            executor.add_node(node)
            try:
                while not stop.asked and context.ok():
                    executor.spin_once(timeout_sec=WAIT)
            except ExternalShutdownException:
                pass
            finally:
                executor.shutdown()
                node.destroy_node()  # type: ignore[no-untyped-call]
    except SuspensionTwinError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return error.exit_status
    except (
        BrokenPipeError
    ):  # the reader has gone (| head): nothing more for it, and none of the interpreter's complaints
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0
