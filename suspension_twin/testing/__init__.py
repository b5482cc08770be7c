# SPDX-License-Identifier: Apache-2.0
"""For tests of what lives beside the twin: the four nodes in one process, and a drive replayed through them.

``with running_twin("twin.yaml") as nodes: out = nodes.replay("bag")`` gives what the nodes published as arrays.
pytest finds the fixtures ``running_twin`` and ``replayed`` by itself, see :mod:`suspension_twin.testing.plugin`.
ROS is imported at the first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from suspension_twin.testing.running import TOPICS, Received, RunningTwin, running_twin

__all__ = ["TOPICS", "Received", "RunningTwin", "running_twin"]


def __getattr__(name: str) -> object:
    """A public name, from the module that imports ROS."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from suspension_twin.testing import running

    return getattr(running, name)
