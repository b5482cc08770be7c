# SPDX-License-Identifier: Apache-2.0
"""Nodes with a lifecycle (``ros2 lifecycle``, nav2's lifecycle manager), which start by themselves by default."""

from __future__ import annotations

from collections.abc import Set as AbstractSet

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from suspension_twin.errors import InputError
from suspension_twin.nodes.base import COMMON, TwinNode
from suspension_twin.nodes.parameters import Param, Values
from suspension_twin.nodes.topics import ERROR, Embedding

__all__ = ["ManagedNode"]

_DONE, _REFUSED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_UNCONFIGURED = "unconfigured"
_AUTOSTART = Param(
    "autostart",
    True,
    "Whether the node configures and activates itself; false: a lifecycle manager does.",
    read_only=True,
)


class ManagedNode(TwinNode, LifecycleNodeMixin):  # type: ignore[misc]
    """A node that checks its parameters and reads the twin when it is configured, works while it is active, and drops
    what comes at other times. A subclass may override ``lacks`` and ``stop``, beside what the base class names."""

    common = (*COMMON, _AUTOSTART)
    _configured = False

    def __init__(self, name: str, embedding: Embedding | None = None) -> None:
        super().__init__(name, embedding)
        LifecycleNodeMixin.__init__(self)
        self.active = self.values["autostart"]
        self._show_state()

    def destroy_node(self) -> None:
        """See the base class; the state machine holds on to the node otherwise."""
        super().destroy_node()  # type: ignore[no-untyped-call]
        self._state_machine.destroy_when_not_in_use()

    # What a subclass may override

    def lacks(self) -> str:
        """Why it cannot be configured with the present parameters; empty if it can."""
        return ""

    def stop(self) -> None:
        """Leave the live twin of this process; ``start`` comes back to it."""

    # What others use

    def bring_up(self) -> None:
        """Configure and activate, where the node starts by itself and nothing is missing."""
        if self.values["autostart"] and self.trigger_configure() == _DONE:  # type: ignore[no-untyped-call]
            self.trigger_activate()  # type: ignore[no-untyped-call]
        self._show_state()

    def checked(self, values: Values) -> None:
        """See the base class. A node that is managed is checked when it is configured."""
        if values["autostart"] or self._configured:
            super().checked(values)

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class; a node that starts by itself tries again."""
        if self.active:
            super().changed(names)
        elif self._label == _UNCONFIGURED and self.values["autostart"]:
            self.bring_up()

    # Transitions

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters and read the twin; refused with the reason in the diagnostics."""
        self.active = False
        try:
            self.check(self.values)
            reason = self.lacks()
        except InputError as error:
            reason = " ".join(str(error).split())
        if reason:
            self.health.findings["configuration"] = ERROR, f"unconfigured: {reason}"
            self.say(ERROR, reason)
            return _REFUSED
        self.health.findings.pop("configuration", None)
        self._configured = True
        return _DONE

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Start, with nothing known."""
        self.active = True
        self.start()
        return _DONE

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Drop what comes from now on."""
        self.active = False
        self.stop()
        return _DONE

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Forget what was configured: parameters are free to change."""
        self._configured = False
        return _DONE

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """As :meth:`on_deactivate`, for good."""
        return self.on_deactivate(_state)

    def report(self) -> None:
        """See the base class."""
        self._show_state()

    @property
    def _label(self) -> str:
        return str(self._state_machine.current_state[1])

    def _show_state(self) -> None:
        self.health.values["lifecycle"] = self._label
