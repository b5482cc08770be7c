# SPDX-License-Identifier: Apache-2.0
"""Companions of ``suspension-twin run`` in its process: live sources, their recording, the road that is learnt."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from suspension_twin.addons.cli.live_lines import say_reached
from suspension_twin.addons.roads.drives.learning import twin_path
from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.recorder import LiveRecorder
from suspension_twin.cli._status import UpdatedLines, line, say
from suspension_twin.cli.run import Companion, RunSettings
from suspension_twin.errors import InputError
from suspension_twin.road.crg import record_path

if TYPE_CHECKING:
    from suspension_twin.nodes.composed import Composed
    from suspension_twin.nodes.process import Stop

__all__ = ["LearntRoad", "Recording", "Sources"]

#: s that a recording may take to be completed after Ctrl-C, and the road of the last pass.
_RECORDED, _LEARNT = 30.0, 120.0


class Sources(Companion):
    """``--source``: checks the URLs; the node of live sources is one of those that run."""

    def __init__(self, urls: str, _settings: RunSettings) -> None:
        say_reached(make_sources(urls.split(), Hub()))


class Recording(Companion):
    """``--record``: the samples of the sources in a bag, complete at the end, whatever ends it."""

    patience = _RECORDED

    def __init__(self, path: str, settings: RunSettings) -> None:
        self.files = [Path(path)]
        self._overwrite = settings.live.force

    @contextmanager
    def beside(self, composed: Composed, stop: Stop) -> Iterator[None]:
        """See ``Companion``. Nothing interrupts between a sample's receipt, of which its sender is told, and the
        bag."""
        from suspension_twin.addons.nodes.source import SourceNode

        source, (path,) = composed.nodes["source"], self.files
        assert isinstance(source, SourceNode)
        try:
            with LiveRecorder(path, overwrite=self._overwrite) as recorder, stop.held():
                source.tap = lambda packet: recorder.write([packet])
                try:
                    yield
                finally:
                    source.end()
        finally:
            source.tap = None
            if path.exists():
                say(
                    f"{recorder.counts['imu']} IMU samples, {recorder.counts['fix']} positions written to {path}"
                )


class LearntRoad(Companion):
    """``--learn-road``: at the end the road of the last pass is learnt as well, whatever ends it."""

    patience = _LEARNT

    def __init__(self, road: str, settings: RunSettings) -> None:
        self._road, loaded = Path(road), settings.loaded
        if "front" not in loaded.axles:
            raise InputError(
                "--learn-road", f"needs a car with axles, {settings.twin} is of the model {loaded.model}"
            )
        if self._road.suffix.lower() != ".crg":
            raise InputError(road, "a road is written as .crg; name the file so")
        self.files = [self._road, record_path(self._road), twin_path(self._road)]
        used = [settings.twin, *([] if loaded.road is None else [loaded.road.file])]
        for path in self.files:
            if path.resolve() in [p.resolve() for p in used]:
                raise InputError(
                    "--learn-road", f"would overwrite {path}, which the twin is made of: give another name"
                )

    @contextmanager
    def beside(self, composed: Composed, stop: Stop) -> Iterator[None]:
        """See ``Companion``."""
        try:
            yield
        finally:
            learner = composed.learner
            assert learner is not None
            learner.close_pass()
            if learner.pending:
                say("learning the road of the last pass; Ctrl-C ends this")
                with suppress(KeyboardInterrupt), stop.again(), UpdatedLines() as lines:
                    while learner.pending:
                        composed.serve()
                        lines.show(lambda: [line(composed.condition())])
            no_road = f"no road was learnt, {self._road} is not written: {learner.why}"
            say(learner.summary() if learner.learnt else no_road)
