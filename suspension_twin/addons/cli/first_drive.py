# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin first-drive``: from a live source to a calibrated twin, step by step."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from suspension_twin.addons.cli.live_lines import (
    DEFAULT_SOURCE,
    LiveLines,
    device_lines,
    say_reached,
    show_guide,
    styled,
    until_ended,
)
from suspension_twin.addons.sources import LiveSource, make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.recorder import LiveRecorder
from suspension_twin.addons.sources.common.runner import running
from suspension_twin.addons.view.live import advice
from suspension_twin.cli.calibrate import print_result, show_progress
from suspension_twin.cli.common import Force, Outputs, ProgressLine, Seed, SourceUrls, TwinFile, output
from suspension_twin.drive.write import BagWriter
from suspension_twin.errors import InputError, WorkError

if TYPE_CHECKING:
    from suspension_twin.addons.sources.common.first_drive import FirstDrive

__all__ = ["command"]


def command(
    *,
    twin: TwinFile,
    out: Annotated[
        Path, typer.Option("--out", help="The twin file to write.", metavar="CALIBRATED.YAML", dir_okay=False)
    ] = Path("calibrated.yaml"),
    record: Annotated[
        Path, typer.Option("--record", help="The bag for what the sources send.", metavar="BAG")
    ] = Path("first_drive"),
    source: SourceUrls = None,
    passes: Annotated[
        int, typer.Option("--passes", help="How often the bump is to be passed.", metavar="N", min=1)
    ] = 3,
    preset: Annotated[
        str, typer.Option("--preset", help="Of the search, as for calibrate.", metavar="NAME")
    ] = "fast",
    seed: Seed = 0,
    generations: Annotated[
        int,
        typer.Option(
            "--max-generations",
            help="Stop the search after so many.  [default: as many as the preset says]",
            metavar="N",
            min=0,
            show_default=False,
        ),
    ] = 0,
    force: Force = False,
) -> None:
    """From a live phone, receiver or IMU to a calibrated twin, without ROS. Ctrl-C ends the drive; what there is is
    kept.

    Stand still until bias, tilt and noise are measured; drive off; pass the bump of the twin's road. Each pass is
    recognised and shown with its speed. Then the twin is calibrated on what was recorded, and the gap before and after
    is printed. Without --source it listens to phones with Sensor Logger and shows how to connect one.
    """
    from suspension_twin.addons.sources.common.first_drive import FirstDrive
    from suspension_twin.calibration.output import details_path, write_result
    from suspension_twin.calibration.presets import preset_named
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate
    from suspension_twin.files import together
    from suspension_twin.inference.observation import NO_DATUM
    from suspension_twin.vehicle.twin import load_twin

    urls = source or [DEFAULT_SOURCE]
    outputs = Outputs(record, out, details_path(out), force=force)
    BagWriter(record, overwrite=force)  # replaces nothing but a recording
    request = CalibrationRequest(
        str(twin), (str(record),), preset=preset_named(preset).name, seed=seed, max_generations=generations
    )
    loaded = load_twin(twin)
    guide = FirstDrive(loaded, passes)
    hub = Hub()
    sources = make_sources(urls, hub)
    say_reached(sources)
    outputs.announce()
    if loaded.datum is None:
        output().print(f"{twin}: {NO_DATUM.text}", style="yellow", markup=False)
    later = f"suspension-twin calibrate --twin {twin} {record} --out {out}"
    with LiveRecorder(record, overwrite=force) as recorder:
        try:
            asyncio.run(_drive(sources, hub, recorder, guide, twin, [] if source else urls))
        except InputError:  # the sensor sits otherwise: no drive was begun
            recorder.discard()
            raise
    if not guide.done:
        count = f"{len(guide.passes)} of {passes} passes"
        raise WorkError(f"the drive ended after {count}; on what was recorded: {later}")
    try:
        with ProgressLine() as line:
            result = calibrate(request, lambda step: show_progress(line, step))
            with together():
                write_result(result, out)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"the drive is in {record}: {later}") from None
    except (InputError, WorkError) as error:
        again = f"{passes} passes of the bump again, at 10 to 30 km/h, each at another speed"
        raise WorkError(f"{error}; drive next: {again}, or on what was recorded: {later}") from error
    console = output()
    for warning in result.warnings:
        console.print(warning, style="yellow")
    print_result(console, result)
    console.print(f"Standstill: {guide.standstill}")
    for number, one in enumerate(guide.passes, 1):
        console.print(f"Pass {number}: {one}")
    beyond = sum("damper" in e.key and e.status != "identified" for e in result.estimates)
    if beyond:
        console.print(
            f"Drive next: faster passes, up to 30 km/h; {beyond} points of the dampers are not identified yet"
        )
    before, after = (getattr(result.drives[0], name).rms for name in ("gap_before", "gap_after"))
    console.print(f"Calibrated: gap {before:.3f} m/s² before, {after:.3f} after", style="bold")
    console.print(f"Written to {record}, {out} and {details_path(out)}")


async def _drive(
    sources: Sequence[LiveSource],
    hub: Hub,
    recorder: LiveRecorder,
    guide: FirstDrive,
    twin: Path,
    shown: Sequence[str],
) -> None:
    """Until all is driven, Ctrl-C or SIGTERM; how to connect what is ``shown`` is said first.

    Raises InputError where gravity shows that the sensor sits otherwise than the twin file says.
    """
    said: set[str] = set()
    told = False

    def lines() -> list[Text]:
        steps = guide.steps()
        at = next((i for i, step in enumerate(steps) if step.state == "now"), len(steps) - 1)
        head = f"Step {at + 1} of {len(steps)}. {steps[at].title}: {steps[at].text}"
        return [Text(head), *device_lines(hub)]

    async with running(sources, hub):
        if shown:
            await show_guide(output(), sources, shown)
        with LiveLines(hub) as live:
            live.say(Text(note) for source in sources for note in source.notes if not shown)
            async for _ in until_ended():
                packets = hub.take()
                recorder.write(packets)
                for packet in packets:
                    guide.add(packet.samples)
                fresh = [line for line in _results(guide, twin) if line.plain not in said]
                said.update(line.plain for line in fresh)
                live.say(fresh)
                if not told and math.isfinite(guide.position_sigma):
                    told = True
                    level, words = advice(guide.position_sigma, True)
                    live.say([Text(words, style="yellow" if level else "")])
                if guide.done:
                    break
                live.show(lines)
    recorder.write(hub.take())


def _results(guide: FirstDrive, twin: Path) -> list[Text]:
    """A line for each step that is done and each pass.

    Raises InputError where gravity shows that the sensor sits otherwise than the twin file says.
    """
    lines = [Text(f"{step.title}: {step.text}") for step in guide.steps()[:2] if step.state == "done"]
    lines += [Text(f"Pass {i}: {one}") for i, one in enumerate(guide.passes, 1)]
    mounting = guide.standstill.mounting if guide.standstill is not None else None
    if mounting is None:
        return lines
    if mounting.level == "error":
        raise InputError(twin, "imu.rpy", mounting.text)
    return [styled(mounting, ""), *lines]
