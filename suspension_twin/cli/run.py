# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin run``: the four nodes in one process, live or replaying a recording; or those of a fleet.

Sources, the recorder, the learnt road, the page and Foxglove are companions: add-ons found by the name of their option.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from suspension_twin.cli.common import Force, Outputs, SourceUrls
from suspension_twin.cli.options import grouped
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
from suspension_twin.registry import Registry

if TYPE_CHECKING:
    from suspension_twin.inference.gap import Gap
    from suspension_twin.nodes.composed import Composed, Playback
    from suspension_twin.nodes.process import Stop
    from suspension_twin.vehicle.twin import Twin

__all__ = ["Companion", "FleetSettings", "RosSettings", "RunSettings", "command"]

#: Seconds before a recording begins, in which subscribers find the topics.
_DISCOVERY = 0.5
#: The same where a page is to be opened first, which may well be forgotten.
_VIEWED = 20.0


@dataclass(frozen=True)
class FleetSettings:
    """The twins of a fleet instead of one twin."""

    fleet: Annotated[
        Path | None,
        typer.Option(
            "--fleet",
            help="Instead of one twin those of all vehicles of a manifest (docs/fleet.md), live, a namespace each.",
            metavar="MANIFEST",
            show_default=False,
        ),
    ] = None
    processes: Annotated[
        int,
        typer.Option(
            "--processes",
            help="With --fleet: processes that share the twins.  [default: one a core]",
            metavar="N",
            min=0,
            show_default=False,
        ),
    ] = 0


@dataclass(frozen=True)
class ReplaySettings:
    """A recording that is replayed."""

    bag: Annotated[
        Path | None,
        typer.Option(
            "--bag", help="Replay this recorded drive instead of listening to sensors.", metavar="BAG"
        ),
    ] = None
    rate: Annotated[
        str,
        typer.Option(
            "--rate", help="Times real time; 'max' or 0: as fast as no message gets lost.", metavar="X"
        ),
    ] = "1"
    loop: Annotated[bool, typer.Option("--loop", help="Begin the recording again at its end.")] = False

    @property
    def speed(self) -> float:
        """Times real time, infinite for full speed."""
        if self.rate == "max":
            return math.inf
        try:
            number = float(self.rate)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and number >= 0):
            raise InputError("--rate", f"must be a number above 0, or 'max', is '{self.rate}'")
        return number or math.inf


@dataclass(frozen=True)
class LiveSettings:
    """Live sources, and files that are written while the twin follows."""

    source: SourceUrls = None
    record: Annotated[
        Path | None,
        typer.Option(
            "--record", help="Record what the sources send into this bag.", metavar="BAG", show_default=False
        ),
    ] = None
    learn_road: Annotated[
        Path | None,
        typer.Option(
            "--learn-road",
            help="Learn the road as it is driven over and load it for the next pass; written to this OpenCRG file.",
            metavar="ROAD",
            show_default=False,
        ),
    ] = None
    force: Force = False


@dataclass(frozen=True)
class DisplaySettings:
    """Where the twin is shown."""

    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            help="Show the twin on a page in the browser: a port (8080), or HOST:PORT to let others look on.",
            metavar="[PORT]",
        ),
    ] = None
    foxglove: Annotated[
        str | None,
        typer.Option(
            "--foxglove",
            help="Serve all topics to Foxglove or Lichtblick: a port (8765), or HOST:PORT for others.",
            metavar="[PORT]",
        ),
    ] = None


@dataclass(frozen=True)
class RosSettings:
    """Names and parameters of the nodes."""

    namespace: Annotated[
        str, typer.Option("--namespace", help="Put everything below this name.", metavar="NS")
    ] = ""
    params: Annotated[
        Path | None,
        typer.Option("--params", help="Parameters of the nodes, a ROS 2 YAML file.", metavar="FILE"),
    ] = None
    ros_args: Annotated[
        list[str] | None,
        typer.Argument(
            help="Arguments for ROS, after '--', such as -- --ros-args -r imu/data_raw:=/phone/imu",
            metavar="ROS_ARGS",
        ),
    ] = None

    @property
    def arguments(self) -> list[str]:
        """Arguments for ROS with the parameter file among them."""
        file = [] if self.params is None else ["--ros-args", "--params-file", str(self.params)]
        return [*(self.ros_args or ()), *file]

    def wanted(self) -> dict[str, dict[str, object]]:
        """Values of the parameter file by node. Raises InputError for it and for the arguments."""
        from suspension_twin.nodes.parameters import read_param_file
        from suspension_twin.nodes.process import check_arguments

        wanted = {} if self.params is None else read_param_file(self.params)
        check_arguments(list(self.ros_args or ()))
        return wanted


@dataclass(frozen=True)
class RunSettings:
    """One twin and how it runs, as its companions need to know it; ``loaded`` is what ``twin`` holds."""

    twin: Path
    loaded: Twin
    replay: ReplaySettings
    live: LiveSettings
    ros: RosSettings


class Companion:
    """Something beside the four nodes. To make it checks its option: InputError for what cannot be used."""

    #: Files that it writes, checked and announced before the start.
    files: Sequence[Path] = ()
    #: s that it may take after Ctrl-C; a second one ends it.
    patience = 0.0

    def beside(self, _composed: Composed, _stop: Stop) -> AbstractContextManager[None]:
        """Runs while the nodes do."""
        return nullcontext()


#: By the name of their option.
_COMPANIONS: Final = Registry[Callable[[str, RunSettings], Companion]]("companions")
_FLEETS: Final = Registry[Callable[[FleetSettings, DisplaySettings, RosSettings], None]]("fleets")


def _run_command(
    *,
    twin: Annotated[
        Path | None,
        typer.Option("--twin", help="The twin file.", metavar="TWIN.YAML", show_default=False),
    ] = None,
    fleet: FleetSettings,
    replay: ReplaySettings,
    live: LiveSettings,
    display: DisplaySettings,
    ros: RosSettings,
) -> None:
    """The four nodes in one process, live or replaying a bag; with --fleet those of many vehicles. Ctrl-C ends them."""
    if fleet.fleet is not None:
        given = {"--twin": twin, "--bag": replay.bag, "--loop": replay.loop, "--rate": replay.rate != "1"}
        for option, value in (given | {"--source": live.source, "--record": live.record}).items():
            if value:
                raise InputError(option, "goes without --fleet: the twins of a fleet are live, from topics")
        _FLEETS.named("live", "--fleet")(fleet, display, ros)
        return
    if twin is None:
        raise InputError("--twin", "is needed: a twin file; or --fleet with a manifest")
    if fleet.processes:
        raise InputError("--processes", "needs --fleet: one twin is one process")
    speed, bag = replay.speed, replay.bag
    if bag is not None and live.source:
        raise InputError("--source", "goes without --bag: a drive is replayed or followed live")
    if live.record is not None and not live.source:
        raise InputError("--record", "needs --source: it records what live sources send")
    if bag is None and (replay.loop or replay.rate != "1"):
        option = "--loop" if replay.loop else "--rate"
        raise InputError(option, "needs --bag: only a recording can be replayed")
    # An error in a file is said before ROS is started, which takes a second.
    from suspension_twin.vehicle.twin import load_twin

    settings = RunSettings(twin, load_twin(twin), replay, live, ros)
    options = {
        "source": " ".join(live.source) if live.source else None,
        "record": live.record,
        "learn-road": live.learn_road,
        "view": display.view,
        "foxglove": display.foxglove,
    }
    companions = [
        _COMPANIONS.named(name, f"--{name}")(str(value), settings)
        for name, value in options.items()
        if value is not None
    ]
    Outputs(*(file for c in companions for file in c.files), force=live.force).announce()
    from suspension_twin.cli._status import say
    from suspension_twin.nodes.composed import Composed, check_namespace
    from suspension_twin.nodes.parameters import check_names
    from suspension_twin.nodes.process import ros_context, stopping

    check_namespace(ros.namespace)
    wanted = ros.wanted()
    with stopping(max((c.patience for c in companions), default=0.0) or None) as stop:
        delay = _DISCOVERY if display.view is None else _VIEWED
        playback = None if bag is None else _playback(bag, speed, replay.loop, delay)
        with ros_context(ros.arguments) as context:
            composed = Composed(
                context,
                twin,
                ros.namespace,
                playback,
                live.source or (),
                live.learn_road,
                folders=[] if bag is None else [bag.absolute().parent],
            )
            try:
                if ros.params is not None:
                    check_names(ros.params, wanted, composed.parameter_names())
                composed.settle_memory()
                for note in composed.notes:
                    say(note)
                with ExitStack() as stack:
                    for companion in companions:
                        stack.enter_context(companion.beside(composed, stop))
                    if composed.player is not None:
                        composed.player.reset(delay)
                    if playback is not None and playback.stay:
                        say(f"The replay begins with the first page that is opened, or in {_VIEWED:.0f} s.")
                    _run(composed, lambda: stop.asked or not context.ok(), bag, playback)
            finally:
                composed.close()


command = grouped(_run_command)


def _playback(bag: Path, speed: float, loop: bool, delay: float) -> Playback:
    """The recording, with its warnings said. Where a page is watched it waits at its end to be sent back."""
    from suspension_twin.cli._status import say
    from suspension_twin.drive.read import read_drive
    from suspension_twin.nodes.composed import Playback

    drive = read_drive(bag)
    for warning in drive.warnings:
        say(f"{bag}: {warning}")
    return Playback(drive, speed, loop, delay, stay=delay > _DISCOVERY)


def _run(
    composed: Composed, stop_asked: Callable[[], bool], bag: Path | None, playback: Playback | None
) -> None:
    from suspension_twin.cli._status import UpdatedLines, conclusion, line

    began = time.monotonic()
    with UpdatedLines() as lines:
        while not (stop_asked() or composed.finished):
            composed.step()
            lines.show(lambda: [line(composed.condition())])
        until = time.monotonic() + 0.2
        while composed.finished and not stop_asked() and time.monotonic() < until:
            composed.step()
        end = composed.condition()
        if composed.finished and not end.answers:
            # answers wait for the pose: what it lacks comes before what the samples lack
            why = next((f": {c}" for c in end.complaints if c.startswith("pose_injector")), "")
            why = why or (f": {end.complaints[0]}" if end.complaints else "")
            raise WorkError(f"{bag}: the twin answered none of {end.samples} IMU samples{why}")
        offline = None
        if playback is not None and composed.finished:
            offline = _offline_gap(composed, playback)
        lines.conclude(conclusion(composed, time.monotonic() - began, offline))


def _offline_gap(composed: Composed, playback: Playback) -> tuple[Gap, Gap] | None:
    """The gap of the drive that was replayed, as ``simulate`` measures it, of all driving and of that which the live
    gap counts; None where it cannot be compared."""
    from suspension_twin.inference.observation import ObserveSettings
    from suspension_twin.inference.simulated import simulate_drive

    follower = composed.twin.follower
    if follower is None:
        return None
    try:
        settings = ObserveSettings(filter=follower.settings.filter)
        result = simulate_drive(playback.drive, follower.twin, settings=settings)
        return result.gap, result.gap_from(follower.gap.driving_since)
    except SuspensionTwinError:  # as of a drive beside the road, which the live twin has warned of
        return None
