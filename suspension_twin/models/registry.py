# SPDX-License-Identifier: Apache-2.0
"""The vehicle models, found by the names of their files, behind one interface.

A model is a module ``suspension_twin/models/<name>.py`` with an object ``MODEL``, or one of an add-on or an installed
package that its entry point in the group ``suspension_twin.models`` names; that one also has ``TWIN``, the class of its
twin file (:data:`suspension_twin.vehicle.twin.SCHEMAS`). Whatever handles a twin (calibration, diagnosis, nodes, the
command line) asks the registry for its model and never for the model's name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, Final, Literal, Protocol

from suspension_twin.arrays import Floats
from suspension_twin.models.types import HeightField, LaneResponse, Response
from suspension_twin.registry import Registry
from suspension_twin.vehicle.twin import Twin

__all__ = ["MODELS", "Model", "deferred", "model_of"]


class SimulateLanes(Protocol):
    """Candidates (P, L) of a twin over an excitation of its model."""

    def __call__(
        self, twin: Twin, params: Floats, excitation: Any, threads: int | None = None
    ) -> LaneResponse: ...


@dataclass(frozen=True, kw_only=True)
class Simulators:
    """Functions that simulate a model.

    Parameters
    ----------
    lanes
        Simulates candidates (P, L), see :func:`~suspension_twin.models.simulate.simulate_lanes`.
    respond
        Simulates one twin with everything recorded, or None where there is nothing more than ``lanes`` gives.
    live
        Makes the model that follows its vehicle stamp by stamp on a road, see
        :class:`~suspension_twin.models.live.LiveModel`, or None where it cannot.
    one_lane
        One twin as rows and functions of one lane, see :class:`~suspension_twin.models.one_lane.OneLane`, for steps of
        up to so many s; or None.
    """

    lanes: SimulateLanes
    respond: Callable[[Any, Any], Response] | None = None
    live: Callable[[Any, HeightField], Any] | None = None
    one_lane: Callable[[Twin, float], Any] | None = None


@dataclass(frozen=True, kw_only=True)
class ModelNumbers:
    """Numbers of a twin that a model uses.

    Parameters
    ----------
    numbers
        Dotted keys of all numbers of a twin that its kernel uses, effects apart.
    also
        Keys that are calibrated beside the characteristics.
    fixed
        Keys in which candidates cannot differ, because the excitation was made for them.
    """

    numbers: Callable[[Twin], Sequence[str]]
    also: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Model(Simulators, ModelNumbers):
    """One vehicle model.

    Parameters
    ----------
    name, title
        Its id in the twin file, and a description of a few words.
    recordings
        How such a vehicle is measured: ``drive`` (IMU and GNSS on a road), ``markers`` (heights of markers on a
        run over an obstacle) or ``rig`` (a corner on an actuator).
    channels
        Names of the signals that a :class:`~suspension_twin.models.types.LaneResponse` of it has.
    opaque
        Its equations are not of this package: effects act on it only where they act on road, sensor or clock.
    prepared
        The twin as a measured vehicle is, with what its file may leave out and no real one lacks.
    on_wheel
        The model of a twin that the measured motion of its wheels drives (``excitation: wheel``).
    """

    name: str
    title: str
    recordings: Literal["drive", "markers", "rig"]
    channels: tuple[str, ...]
    opaque: bool = False
    prepared: Callable[[Twin], Twin] = lambda twin: twin
    on_wheel: Model | None = None


def deferred(module: str, name: str) -> Any:
    """A function of a module of this package that is imported when it is first called: kernels import each other."""

    @cache
    def found() -> Callable[..., Any]:
        function: Callable[..., Any] = getattr(import_module(f"{__package__}.{module}"), name)
        return function

    def call(*arguments: object, **options: object) -> Any:
        return found()(*arguments, **options)

    return call


#: Models by the name that a twin file gives.
MODELS: Final = Registry[Model](
    "models",
    {name: f"{__package__}.{name}:MODEL" for name in ("full_car", "msd", "tracked", "quarter_car")},
    attribute="MODEL",
    kind=Model,
    identity="name",
)


def model_of(twin: Twin) -> Model:
    """The model of a twin.

    Parameters
    ----------
    twin : Twin
        The twin.

    Returns
    -------
    Model
        Its entry in :data:`MODELS`: what is measured of such a vehicle, its channels, how it is simulated.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> model_of(load_twin("bags/bump_15kmh/twin.yaml")).recordings
    'drive'
    """
    model = MODELS[twin.model]
    return (model.on_wheel or model) if twin.on_wheel else model
