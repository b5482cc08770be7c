# SPDX-License-Identifier: Apache-2.0
"""An FMU behind its connectors: opened and checked once, then started and stepped as often as it is asked for.

FMPy unpacks the archive, loads the library and starts an instance; its steps are taken by compiled code, without the
GIL. An FMU is a program: to simulate it is to run its machine code in this process.
"""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import threading
import weakref
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import types
from numpy.typing import NDArray

from suspension_twin.addons.fmu.twin import Fmu
from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError, nearest, printable
from suspension_twin.files import open_file
from suspension_twin.models.connectors import INPUTS, OUTPUTS
from suspension_twin.vehicle.corners import CORNERS

if TYPE_CHECKING:
    from fmpy.model_description import CoSimulation, ModelDescription, ModelVariable

__all__ = ["ACCELERATIONS", "SENSOR", "Connected", "Slave", "connected"]

_INPUTS: Final = tuple(v.name for v in INPUTS)
_OUTPUTS: Final = tuple(v.name for v in OUTPUTS)
#: The sensor's own readings; without them it is computed from the motion of the body, which then needs these.
SENSOR: Final = tuple(f"specific_force_{axis}" for axis in "xyz")
ACCELERATIONS: Final = ("heave_acceleration", "roll_acceleration", "pitch_acceleration")
_NEEDED_INPUTS: Final = tuple(f"road_height_{corner}" for corner in CORNERS)
_NEEDED: Final = (
    *("heave", "roll", "pitch", "angular_rate_x", "angular_rate_y"),
    *(f"{name}_{corner}" for name in ("deflection", "tyre_force") for corner in CORNERS),
)
_FATAL: Final = 4  # a status
#: Bytes of a member of an archive that are unpacked at a time, and that a member takes on a disk at least.
_PIECE, _MEMBER = 1 << 20, 1 << 12

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Archive:
    """An unpacked FMU: what FMPy read of it, its folder, a lock around what it may do only once at a time, and the
    connections made so far."""

    name: str
    description: ModelDescription
    folder: Path
    lock: threading.RLock
    connections: dict[str, Connected]

    @property
    def interface(self) -> CoSimulation:
        return self.description.coSimulation


@dataclass(frozen=True, eq=False)
class Connected:
    """An FMU with its connectors found.

    ``inputs`` and ``outputs`` are the columns of INPUTS and OUTPUTS that it has, ``parameters`` the value references of
    those that the twin file names, in its order. ``sensor``: it gives what the sensor reads.
    """

    archive: _Archive
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    input_references: tuple[int, ...]
    output_references: tuple[int, ...]
    parameters: tuple[int, ...]
    sensor: bool

    @property
    def name(self) -> str:
        """Of its file."""
        return self.archive.name

    @property
    def single(self) -> bool:
        """Whether a process may hold one instance only."""
        return bool(self.archive.interface.canBeInstantiatedOnlyOncePerProcess)

    @property
    def sloped(self) -> bool:
        """Whether it takes the derivatives of its inputs (FMI 2.0)."""
        return bool(self.archive.interface.canInterpolateInputs) and not self.third

    @property
    def third(self) -> bool:
        """Whether it is of FMI 3.0."""
        return str(self.archive.description.fmiVersion).startswith("3.")


def _fmpy() -> Any:
    try:
        import fmpy
    except ImportError:
        raise InputError("twin", "model", 'fmu needs FMPy: pip install "suspension-twin[fmu]"') from None
    return fmpy


_archives: dict[tuple[str, int, int], _Archive] = {}
_opening = threading.RLock()


def connected(fmu: Fmu) -> Connected:
    """The FMU that a twin's section ``fmu`` names, connected as it says.

    Parameters
    ----------
    fmu
        See :class:`~suspension_twin.addons.fmu.twin.Fmu`.

    Returns
    -------
    Connected
        To be handed to :class:`Slave`. An FMU is opened once per process as long as its file does not change.

    Raises
    ------
    InputError
        FMPy or the file is missing, the file is no FMU for co-simulation, it has no binary for this machine, a
        connector or a parameter is not there: naming it.
    """
    with _opening:
        archive = _opened(Path(fmu.file))
        names = fmu.model_dump_json(include={"inputs", "outputs"})
        key = names + repr([(name, p.variable) for name, p in fmu.parameters.items()])
        if key not in archive.connections:
            archive.connections[key] = _connection(archive, fmu)
        return archive.connections[key]


def _connection(archive: _Archive, fmu: Fmu) -> Connected:
    variables = {v.name: v for v in archive.description.modelVariables}
    inputs = _matched(archive, variables, "inputs", fmu.inputs, _INPUTS, ("input",))
    outputs = _matched(archive, variables, "outputs", fmu.outputs, _OUTPUTS, ("output", "local"))
    sensor = all(name in outputs for name in SENSOR)
    needed = (*_NEEDED, *(() if sensor else ACCELERATIONS))
    for kind, names, there in (("inputs", _NEEDED_INPUTS, inputs), ("outputs", needed, outputs)):
        missing = [name for name in names if name not in there]
        if missing:
            alternative = f" (or {', '.join(SENSOR)})" if set(missing) & set(ACCELERATIONS) else ""
            raise InputError(
                archive.name,
                f"has no {', '.join(missing)}{alternative}; name its variables for them under fmu.{kind}",
            )
    parameters = []
    for key, parameter in fmu.parameters.items():
        name = parameter.variable or key
        variable = variables.get(name)
        known = [n for n, v in variables.items() if _settable(v)]
        if variable is None:
            raise InputError(
                "twin", f"fmu.parameters.{key}", f"{archive.name} has no {name}{nearest(name, known)}"
            )
        if not _settable(variable):
            raise InputError(
                "twin", f"fmu.parameters.{key}", f"{name} of {archive.name} is no number that can be set"
            )
        parameters.append(variable.valueReference)
    return Connected(
        archive,
        tuple(_INPUTS.index(name) for name in inputs),
        tuple(_OUTPUTS.index(name) for name in outputs),
        tuple(inputs.values()),
        tuple(outputs.values()),
        tuple(parameters),
        sensor,
    )


def _number(variable: ModelVariable) -> bool:
    return str(variable.type) in ("Real", "Float64") and not variable.dimensions


def _settable(variable: ModelVariable) -> bool:
    """Whether a variable is a number that may be set before a simulation starts."""
    given = variable.causality == "parameter" or (
        variable.causality in ("local", None) and variable.variability in ("fixed", "tunable")
    )
    return _number(variable) and given and variable.initial in (None, "exact", "approx")


def _matched(
    archive: _Archive,
    variables: Mapping[str, ModelVariable],
    kind: str,
    names: Mapping[str, str],
    connectors: Sequence[str],
    causalities: Sequence[str],
) -> dict[str, int]:
    """Value references by connector, of those that are there."""
    for name in names:
        if name not in connectors:
            raise InputError("twin", f"fmu.{kind}.{name}", f"is no connector{nearest(name, connectors)}")
    found, taken = {}, set(names.values())
    for connector in connectors:
        name = names.get(connector, "" if connector in taken else connector)
        variable = variables.get(name)
        usable = variable is not None and _number(variable) and variable.causality in causalities
        if usable:
            assert variable is not None
            found[connector] = variable.valueReference
        elif names.get(connector):
            have = [n for n, v in variables.items() if _number(v) and v.causality in causalities]
            said = "is no number among its" if variable is not None else "is not among its"
            raise InputError(
                "twin",
                f"fmu.{kind}.{connector}",
                f"{name} {said} {kind} of {archive.name}{nearest(name, have)}",
            )
    return found


def _opened(file: Path) -> _Archive:
    fmpy = _fmpy()
    try:
        status = file.stat()
        open_file(file).close()
    except OSError:
        where = "it is looked for from the folder of the twin file, unless its path is absolute"
        raise InputError("twin", "fmu.file", f"there is no {file}: {where}") from None
    key = str(file.resolve()), status.st_mtime_ns, status.st_size
    if key not in _archives:
        _archives[key] = _unpacked(fmpy, file)
    return _archives[key]


def _unpacked(fmpy: Any, file: Path) -> _Archive:
    folder = Path(tempfile.mkdtemp(prefix="suspension_twin_fmu_"))
    weakref.finalize(_archives_end, shutil.rmtree, folder, ignore_errors=True)
    try:
        _extract(file, folder)
        description = fmpy.read_model_description(str(folder), validate=False)
        platforms = fmpy.supported_platforms(str(folder))
    except SuspensionTwinError:
        raise
    except Exception as error:  # whatever a parser of XML or ZIP raises
        raise InputError(file, f"is no FMU that can be read: {printable(str(error))}") from None
    version, interface = str(description.fmiVersion), description.coSimulation
    if not version.startswith(("2.", "3.")):
        raise InputError(file, f"is of FMI {version}: 2.0 or 3.0 is needed")
    if interface is None:
        raise InputError(file, "is not for co-simulation: export it from its tool as a co-simulation FMU")
    if not interface.canHandleVariableCommunicationStepSize:
        raise InputError(
            file,
            "takes steps of one length only, and the stamps of a drive are not even: export it otherwise",
        )
    here = fmpy.platform_tuple if version.startswith("3.") else fmpy.platform
    library = f"{interface.modelIdentifier}{fmpy.sharedLibraryExtension}"
    places = [folder / "binaries" / name / library for name in (here, fmpy.platform_tuple)]
    if not any(place.is_file() for place in places):
        there = [name for name in platforms if name != "c-code"]
        text = (
            f"has no binary for {here}, but for {', '.join(there)}" if there else f"has no binary for {here}"
        )
        compile_it = f": compile it with 'fmpy compile {file.name}'" if "c-code" in platforms else ""
        raise InputError(file, text + compile_it)
    return _Archive(file.name, description, folder, threading.RLock(), {})


def _extract(file: Path, folder: Path) -> None:
    """Unpack an archive within the budget of its size; no member leaves the folder."""
    with open_file(file) as opened, zipfile.ZipFile(opened) as archive:
        budget = Budget(file, file.stat().st_size)
        for member in archive.infolist():
            budget.take(_MEMBER)
            temporary = folder / member.filename
            if not temporary.resolve().is_relative_to(folder.resolve()):
                raise InputError(file, printable(member.filename[:80]), "leads out of the archive")
            if member.is_dir():
                continue
            temporary.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as packed, temporary.open("wb") as there:
                while piece := packed.read(_PIECE):
                    budget.take(len(piece))
                    there.write(piece)


class _End:
    """Dies with the process: what was unpacked is removed then."""


_archives_end = _End()


class _Function(types.WrapperAddressProtocol):  # type: ignore[misc]
    """A function of a library, as compiled code calls it: pointers are integers there."""

    def __init__(self, library: ctypes.CDLL, name: str, signature: types.Type) -> None:
        self._address = ctypes.cast(library[name], ctypes.c_void_p).value
        self._signature = signature

    def __wrapper_address__(self) -> int | None:
        return self._address

    def signature(self) -> types.Type:
        """Numba's type of it."""
        return self._signature


_P, _D, _S = types.intp, types.float64, types.int32
_PUT_2 = _S(_P, _P, _P, _P)  # instance, references, count, values
_PUT_3 = _S(
    _P, _P, _P, _P, _P
)  # the same, and the number of values; or the orders of derivatives before the values
_STEP_2 = _S(_P, _D, _D, _S)  # instance, time, step, no state is set before it
_STEP_3 = _S(_P, _D, _D, _S, _P, _P, _P, _P)  # the same, three flags and the time reached


@compiled
def _walk_2(
    put: Callable[..., int],
    slope: Callable[..., int],
    step: Callable[..., int],
    get: Callable[..., int],
    who: Ints,
    time: float,
    values: Floats,
    rates: Floats,
    dt: Floats,
    first: Ints,
    ends: Floats,
    out: Floats,
) -> tuple[int, int, float]:
    """Steps of an FMU of version 2.0: number of the step that failed or -1, its status, time.

    ``who`` holds the instance and the addresses of the references of inputs, outputs and of the orders of derivatives.
    """
    instance, inputs, outputs, orders = who[0], who[1], who[2], who[3]
    at, width, count = np.intp(values.ctypes.data), values.shape[1] * 8, values.shape[1]
    row, size, last = np.intp(out.ctypes.data), out.shape[1], np.intp(ends.ctypes.data)
    slopes = np.intp(rates.ctypes.data)
    for k in range(first.size - 1):
        for j in range(first[k], first[k + 1]):
            status = put(instance, inputs, count, at + j * width)
            if status <= 1 and rates.shape[0] > 0:
                status = slope(instance, inputs, count, orders, slopes + j * width)
            if status <= 1:
                status = step(instance, time, dt[j], np.int32(1))
            if status > 1:
                return j, status, time
            time += dt[j]
        status = put(instance, inputs, count, last + k * width)
        if status <= 1:
            status = get(instance, outputs, size, row + k * size * 8)
        if status > 1:
            return first[k + 1], status, time
    return -1, 0, time


@compiled
def _walk_3(
    put: Callable[..., int],
    step: Callable[..., int],
    get: Callable[..., int],
    who: Ints,
    time: float,
    values: Floats,
    dt: Floats,
    first: Ints,
    ends: Floats,
    out: Floats,
) -> tuple[int, int, float]:
    """The same for version 3.0."""
    instance, inputs, outputs = who[0], who[1], who[2]
    at, width, count = np.intp(values.ctypes.data), values.shape[1] * 8, values.shape[1]
    row, size, last = np.intp(out.ctypes.data), out.shape[1], np.intp(ends.ctypes.data)
    flags, until = np.zeros(3, dtype=np.uint8), np.zeros(1)
    f = np.intp(flags.ctypes.data)
    for k in range(first.size - 1):
        for j in range(first[k], first[k + 1]):
            status = put(instance, inputs, count, at + j * width, count)
            if status <= 1:
                status = step(instance, time, dt[j], np.int32(1), f, f + 1, f + 2, np.intp(until.ctypes.data))
                if status <= 1 and flags[1] != 0:
                    status = np.int32(3)  # type: ignore[assignment]  # it wants to end
            if status > 1:
                return j, status, time
            time += dt[j]
        status = put(instance, inputs, count, last + k * width, count)
        if status <= 1:
            status = get(instance, outputs, size, row + k * size * 8, size)
        if status > 1:
            return first[k + 1], status, time
    return -1, 0, time


class Slave:
    """One running instance: started with its parameters at given inputs, then walked.

    ``inputs`` are rows of INPUTS (10,), ``parameters`` values in the order of the twin file, ``settle`` s are walked at
    these inputs in steps of ``step`` s. ``close`` it at the end. Raises WorkError that names the FMU, the call and what
    the FMU said.
    """

    def __init__(
        self, fmu: Connected, parameters: Floats, inputs: Floats, settle: float, step: float
    ) -> None:
        self._fmu, self._said = fmu, ""
        self._columns = np.array(fmu.inputs)
        self.time = 0.0
        if fmu.single:
            fmu.archive.lock.acquire()
        self._held = fmu.single
        self._instance: Any = None
        try:
            self._load()
            self._call("be instantiated", self._instantiate)
            if fmu.parameters:
                self._set(fmu.parameters, parameters, "its parameters")
            self._call("start", self._enter)
            self._set(fmu.input_references, inputs[self._columns], "its inputs")
            self._call("start", self._fmpy.exitInitializationMode)
            count = int(np.ceil(settle / step))
            if count:
                still = np.repeat(inputs[None], count, axis=0)
                self.walk(still, None, np.full(count, settle / count), np.array([0, count]), still[:1])
        except BaseException:
            self.close()
            raise

    def _load(self) -> None:
        import fmpy.fmi2
        import fmpy.fmi3

        archive = self._fmu.archive
        with _opening:  # it changes the working directory meanwhile
            try:
                kind = fmpy.fmi3.FMU3Slave if self._fmu.third else fmpy.fmi2.FMU2Slave
                self._fmpy: Any = kind(
                    instanceName="twin",
                    unzipDirectory=str(archive.folder),
                    guid=archive.description.guid,
                    modelIdentifier=archive.interface.modelIdentifier,
                )
            except Exception as error:
                raise InputError(archive.name, f"cannot be loaded: {printable(str(error))}") from None
        library = self._fmpy.dll
        names: tuple[tuple[str, types.Type], ...]
        if self._fmu.third:
            names = ("fmi3SetFloat64", _PUT_3), ("fmi3DoStep", _STEP_3), ("fmi3GetFloat64", _PUT_3)
        else:
            slope = ("fmi2SetRealInputDerivatives", _PUT_3)
            names = ("fmi2SetReal", _PUT_2), slope, ("fmi2DoStep", _STEP_2), ("fmi2GetReal", _PUT_2)
        self._functions = [_Function(library, name, signature) for name, signature in names]
        count = self._columns.size
        self._references = np.array(self._fmu.input_references, dtype=np.uint32)
        self._asked = np.array(self._fmu.output_references, dtype=np.uint32)
        self._order = np.ones(count, dtype=np.int32)

    def _instantiate(self) -> None:
        if self._fmu.third:
            self._fmpy.instantiate(logMessage=lambda env, status, category, text: self._note(text))
        else:
            from fmpy import calloc, fmi2, free

            calls = fmi2.fmi2CallbackFunctions()
            calls.logger = fmi2.fmi2CallbackLoggerTYPE(
                lambda env, name, status, category, text: self._note(text)
            )
            calls.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
            calls.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
            self._fmpy.instantiate(callbacks=calls)
        self._instance = self._fmpy.component

    def _note(self, text: bytes | None) -> None:
        self._said = printable((text or b"").decode("utf-8", "replace"))[:300]

    def _enter(self) -> None:
        if not self._fmu.third:
            self._fmpy.setupExperiment(startTime=0.0)
        self._fmpy.enterInitializationMode()

    def _call(self, what: str, function: Callable[[], object]) -> None:
        try:
            function()
        except Exception as error:
            raise self._failure(f"cannot {what}: {printable(str(error))}") from None

    def _failure(self, text: str) -> WorkError:
        return WorkError(self._fmu.name, text + (f" ({self._said})" if self._said else ""))

    def _set(self, references: Sequence[int], values: Floats, what: str) -> None:
        put = self._fmpy.setFloat64 if self._fmu.third else self._fmpy.setReal
        try:
            put(list(references), [float(v) for v in values])
        except Exception as error:
            raise self._failure(f"refuses {what}: {printable(str(error))}") from None

    def walk(self, held: Floats, slopes: Floats | None, dt: Floats, first: Ints, ends: Floats) -> Floats:
        """Take m steps of ``dt`` (m,) s, and (n, number of outputs) what it gives after each of n intervals.

        The inputs are held at ``held`` (m, 10); with ``slopes`` (m, 10) 1/s, where it takes derivatives, they begin
        there. Interval k has the steps ``first[k]`` to ``first[k + 1] - 1``; its outputs are read with the inputs at
        ``ends`` (n, 10), as those that depend on them at once need.
        """
        out = np.empty((first.size - 1, self._asked.size))
        values, last = (np.ascontiguousarray(v[:, self._columns]) for v in (held, ends))
        who = np.array(
            [self._instance, *(a.ctypes.data for a in (self._references, self._asked, self._order))],
            dtype=np.int64,
        )
        if self._fmu.third:
            place = who, self.time, values, dt, first, last, out
            failed, status, self.time = _walk_3(*self._functions, *place)  # type: ignore[call-arg]
        else:
            given = slopes is not None and self._fmu.sloped
            rates = (
                np.ascontiguousarray(slopes[:, self._columns]) if slopes is not None and given else values[:0]
            )
            where = who, self.time, values, rates, dt, first, last, out
            failed, status, self.time = _walk_2(*self._functions, *where)  # type: ignore[call-arg]
        if failed >= 0:
            if status >= _FATAL:
                self._instance = None  # nothing may be called any more
            how = {2: "discards", _FATAL: "fails for good in"}.get(status, "fails in")
            raise self._failure(f"{how} the step at {self.time:.3f} s after its start")
        return out

    def close(self) -> None:
        """Free the instance. The library stays loaded."""
        instance, self._instance = self._instance, None
        if instance is not None:
            with suppress(Exception):
                free = self._fmpy.fmi3FreeInstance if self._fmu.third else self._fmpy.fmi2FreeInstance
                free(instance)
        if self._held:
            self._held = False
            self._fmu.archive.lock.release()
