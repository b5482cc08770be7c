# SPDX-License-Identifier: Apache-2.0
"""Importers of FMUs that walk an excitation: every step of the twin's integration is given the road at its end."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
from extras import missing

from suspension_twin.arrays import Floats
from suspension_twin.models.connectors import INPUTS, OUTPUTS, inputs_of
from suspension_twin.models.types import Excitation, Ints, Response

try:
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave
except ImportError:
    missing("fmpy")

__all__ = ["columns", "walk_2", "walk_3", "walked"]

_FIRST_OUTPUT = 100
Numbers = ctypes.c_double * len(INPUTS)
References = ctypes.c_uint32 * len(INPUTS)
Answers = ctypes.c_double * len(OUTPUTS)
Asked = ctypes.c_uint32 * len(OUTPUTS)


def walked(driven: Excitation) -> tuple[Floats, Floats, Ints]:
    """Times (m,) s from the start, inputs (m, 10) there, and which of the rows (n,) are stamps of the drive."""
    at = np.arange(len(driven)).repeat(np.maximum(driven.substeps, 1))
    # stamps of seconds since 1970 resolve a fraction of a microsecond: steps are summed up instead
    return np.cumsum(driven.step[at]), inputs_of(driven), driven.first[1:] - 1


def columns(response: Response) -> Floats:
    """(n, outputs) what a twin does, in the order of the variables of an FMU."""
    names = (
        "heave roll pitch z wheel_z deflection deflection_rate tyre_force force rate vertical_acceleration"
    )
    return np.column_stack([getattr(response, name) for name in (*names.split(), "acceleration")])


def walk_2(path: Path, driven: Excitation) -> Floats:
    """(n, outputs) of an FMU of version 2.0, whose inputs get their derivatives for every step."""
    description = read_model_description(path)
    fmu = FMU2Slave(
        guid=description.guid,
        unzipDirectory=extract(path),
        modelIdentifier=description.coSimulation.modelIdentifier,
    )
    fmu.instantiate()
    t, inputs, last = walked(driven)
    which, one = References(*range(len(INPUTS))), (ctypes.c_int * len(INPUTS))(*([1] * len(INPUTS)))
    asked, answers = Asked(*range(_FIRST_OUTPUT, _FIRST_OUTPUT + len(OUTPUTS))), Answers()
    out = np.empty((len(driven), len(OUTPUTS)))
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.fmi2SetReal(fmu.component, which, len(INPUTS), Numbers(*inputs[0]))
    fmu.exitInitializationMode()
    stamps = {int(row): k for k, row in enumerate(last)}
    for row in range(t.size):
        if row:
            size = t[row] - t[row - 1]
            slope = (inputs[row] - inputs[row - 1]) / size
            fmu.fmi2SetReal(fmu.component, which, len(INPUTS), Numbers(*inputs[row - 1]))
            fmu.fmi2SetRealInputDerivatives(fmu.component, which, len(INPUTS), one, Numbers(*slope))
            fmu.fmi2DoStep(fmu.component, t[row - 1], size, 1)
        if row in stamps:
            fmu.fmi2GetReal(fmu.component, asked, len(OUTPUTS), answers)
            out[stamps[row]] = answers
    fmu.terminate()
    fmu.freeInstance()
    return out


def walk_3(path: Path, driven: Excitation) -> Floats:
    """(n, outputs) of an FMU of version 3.0, which asks for its inputs within the intervals between the stamps."""
    description = read_model_description(path)
    fmu = FMU3Slave(
        guid=description.guid,
        unzipDirectory=extract(path),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="twin",
    )
    t, inputs, last = walked(driven)
    which = References(*range(len(INPUTS)))
    asked, answers = Asked(*range(_FIRST_OUTPUT, _FIRST_OUTPUT + len(OUTPUTS))), Answers()

    def update(environment, time, set_requested, get_allowed, finished, early, wanted, until):  # type: ignore[no-untyped-def]
        row = asked_for[0] = asked_for[0] + 1
        strange.extend([time] if not set_requested or abs(t[row] - time) > 1e-9 else [])
        fmu.fmi3SetFloat64(fmu.component, which, len(INPUTS), Numbers(*inputs[row]), len(INPUTS))

    asked_for = [0]  # rows so far
    strange: list[float] = []  # times that are no ends of steps
    fmu.instantiate(intermediateUpdate=update)
    out = np.empty((len(driven), len(OUTPUTS)))
    fmu.enterInitializationMode(startTime=0.0)
    fmu.fmi3SetFloat64(fmu.component, which, len(INPUTS), Numbers(*inputs[0]), len(INPUTS))
    fmu.exitInitializationMode()
    for k, row in enumerate(last):
        if k:
            fmu.doStep(t[last[k - 1]], t[row] - t[last[k - 1]])
        fmu.fmi3GetFloat64(fmu.component, asked, len(OUTPUTS), answers, len(OUTPUTS))
        out[k] = answers
    fmu.terminate()
    fmu.freeInstance()
    assert asked_for == [t.size - 1]
    assert strange == []
    return out
