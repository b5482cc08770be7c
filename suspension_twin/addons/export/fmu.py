# SPDX-License-Identifier: Apache-2.0
"""FMU: a twin for co-simulation by FMI 2.0 or 3.0, as C source and compiled.

The archive needs nothing but the C library. It holds the source; a binary for this machine where there is a C compiler,
and one for Windows where there is a cross-compiler.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
import uuid
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Final, NamedTuple

from suspension_twin import __version__
from suspension_twin.addons.export.registry import ExportSettings, Target
from suspension_twin.addons.export.standalone.languages import C
from suspension_twin.addons.export.standalone.source import Source, written_out
from suspension_twin.errors import InputError, WorkError, printable
from suspension_twin.files import replacing, write_text
from suspension_twin.models.connectors import INPUTS, OUTPUTS, Variable
from suspension_twin.vehicle.twin import Twin

__all__ = ["TARGET"]

VERSIONS: Final = ("2.0", "3.0")
#: Value references of the outputs and of time begin here, as in component.h and fmi3.c.
_FIRST_OUTPUT, _TIME = 100, 1000
#: SI base units of the units of the variables, by exponent.
_UNITS: Final = {
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "rad/s2": {"rad": 1, "s": -2},
    "N": {"kg": 1, "m": 1, "s": -2},
    "s": {"s": 1},
}
_GUID_SPACE: Final = uuid.UUID("8d1c9f0e-5c0b-4b57-9a31-6f5ff0b1a2d4")  # of this kind of FMU
_WINDOWS: Final = "x86_64-w64-mingw32-gcc"
#: No contraction of a * b + c: the numbers are the same wherever it is compiled.
_FLAGS: Final = ("-std=c99", "-O2", "-ffp-contract=off", "-shared", "-Wall", "-Wextra")
_LONGEST_BUILD: Final = 300.0  # s


class _Build(NamedTuple):
    """A compiler, its folders below ``binaries`` in both versions, the ending of the library, and further flags."""

    compiler: tuple[str, ...]
    folders: tuple[str, str]
    ending: str
    flags: tuple[str, ...]


def _builds() -> Iterator[_Build]:
    """One for this machine and one for Windows, as far as there are compilers."""
    given = shlex.split(os.environ.get("CC", ""))
    here = given or [found for found in map(shutil.which, ("cc", "gcc", "clang")) if found][:1]
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    system, ending = {"Darwin": ("darwin", ".dylib"), "Windows": ("windows", ".dll")}.get(
        platform.system(), ("linux", ".so")
    )
    old = {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}[system]
    tuple_name = f"{machine}-{system}"
    if here and shutil.which(here[0]):
        folders = (old if machine == "x86_64" else tuple_name, tuple_name)
        yield _Build(tuple(here), folders, ending, ("-fPIC", "-fvisibility=hidden", "-lm"))
    if system != "windows" and shutil.which(_WINDOWS):
        yield _Build(
            (_WINDOWS,), ("win64", "x86_64-windows"), ".dll", ("-static-libgcc", "-Wl,--no-insert-timestamp")
        )


def _sources(twin: Twin, source: Source, version: str) -> dict[str, str]:
    """The C files by name."""
    folder = resources.files("suspension_twin.addons.export.standalone")
    model = [
        "/* The equations of a vehicle, written out from the kernel of its twin, and its constants. SI units. */",
        f"#define ROWS {source.rows}",
        f"#define MAX_STEP {source.max_step!r}",
        source.text,
        f"static const double INITIAL[ROWS] = {{\n{source.initial}\n}};",
        "",
    ]
    texts = {"model.c": "\n".join(model)}
    main = f"fmi{version[0]}.c"
    for name in ("component.h", main):
        texts[name] = (folder / name).read_text(encoding="utf-8")
    digest = hashlib.sha256("\0".join(f"{k}\0{v}" for k, v in sorted(texts.items())).encode()).hexdigest()
    guid = f"{{{uuid.uuid5(_GUID_SPACE, digest)}}}"
    if "FAILED" not in source.text.split("\n\n")[0]:
        texts["model.c"] = f"#define FAILED {source.failed}\n" + texts["model.c"]
    texts["model.c"] = f'#define GUID "{guid}"\n' + texts["model.c"]
    return texts


def _guid(sources: dict[str, str]) -> str:
    return sources["model.c"].split('"')[1]


def _variables() -> Iterator[tuple[Variable, int, str]]:
    """Inputs and outputs with their value references."""
    for k, variable in enumerate(INPUTS):
        yield variable, k, "input"
    for k, variable in enumerate(OUTPUTS):
        yield variable, _FIRST_OUTPUT + k, "output"


def _document(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _root(twin: Twin, version: str, token: dict[str, str], name: str) -> ElementTree.Element:
    attributes = {
        "fmiVersion": version,
        "modelName": name,
        **token,
        "description": f"Suspension of {printable(twin.vehicle.name)}: a twin of the model {twin.model}",
        "generationTool": f"suspension_twin {__version__}",
        "variableNamingConvention": "flat",
    }
    return ElementTree.Element("fmiModelDescription", attributes)


def _units(root: ElementTree.Element) -> None:
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for unit, exponents in _UNITS.items():
        base = {key: str(value) for key, value in exponents.items()}
        ElementTree.SubElement(ElementTree.SubElement(units, "Unit", name=unit), "BaseUnit", base)


def _description_2(twin: Twin, name: str, guid: str) -> str:
    root = _root(twin, "2.0", {"guid": guid}, name)
    interface = ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=name,
        canHandleVariableCommunicationStepSize="true",
        canInterpolateInputs="true",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    ElementTree.SubElement(ElementTree.SubElement(interface, "SourceFiles"), "File", name="fmi2.c")
    _units(root)
    variables = ElementTree.SubElement(root, "ModelVariables")
    outputs, unknowns = ElementTree.Element("Outputs"), ElementTree.Element("InitialUnknowns")
    for index, (variable, reference, causality) in enumerate(_variables(), 1):
        element = ElementTree.SubElement(
            variables,
            "ScalarVariable",
            name=variable.name,
            valueReference=str(reference),
            description=variable.description,
            causality=causality,
            variability="continuous",
        )
        real = ElementTree.SubElement(element, "Real", unit=variable.unit)
        if causality == "input":
            real.set("start", "0.0")
        else:
            element.set("initial", "calculated")
            for parent in (outputs, unknowns):
                ElementTree.SubElement(parent, "Unknown", index=str(index))
    ElementTree.SubElement(root, "ModelStructure").extend([outputs, unknowns])
    return _document(root)


def _description_3(twin: Twin, name: str, guid: str) -> str:
    root = _root(twin, "3.0", {"instantiationToken": guid}, name)
    ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=name,
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
        providesIntermediateUpdate="true",
    )
    _units(root)
    variables = ElementTree.SubElement(root, "ModelVariables")
    ElementTree.SubElement(
        variables,
        "Float64",
        name="time",
        valueReference=str(_TIME),
        causality="independent",
        variability="continuous",
        unit="s",
    )
    structure = ElementTree.Element("ModelStructure")
    for variable, reference, causality in _variables():
        element = ElementTree.SubElement(
            variables,
            "Float64",
            name=variable.name,
            valueReference=str(reference),
            description=variable.description,
            causality=causality,
            variability="continuous",
            unit=variable.unit,
        )
        if causality == "input":
            element.set("start", "0.0")
            element.set("intermediateUpdate", "true")
        else:
            element.set("initial", "calculated")
    for tag in ("Output", "InitialUnknown"):
        for _, reference, causality in _variables():
            if causality == "output":
                ElementTree.SubElement(structure, tag, valueReference=str(reference))
    root.append(structure)
    return _document(root)


def _build_description(name: str) -> str:
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ElementTree.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    files = ElementTree.SubElement(build, "SourceFileSet", language="C99")
    ElementTree.SubElement(files, "SourceFile", name="fmi3.c")
    return _document(root)


def _compiled(build: _Build, sources: dict[str, str], main: str) -> bytes:
    """The library that a compiler makes of the sources."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            write_text(Path(folder, name), text)
        library = f"model{build.ending}"
        command = [*build.compiler, *_FLAGS, "-o", library, main, *build.flags]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, errors="replace", timeout=_LONGEST_BUILD
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise WorkError(f"the compiler {build.compiler[0]} cannot be run: {error}") from error
        if done.returncode:
            first = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr)
            raise WorkError(f"the compiler {build.compiler[0]} failed: {first.strip()}")
        return Path(folder, library).read_bytes()


def _archive(path: Path, files: Iterable[tuple[str, bytes]]) -> None:
    """A ZIP archive that depends on its files alone."""
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files:
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)


def _write(twin: Twin, path: Path, settings: ExportSettings) -> Sequence[str]:
    if settings.fmi not in VERSIONS:
        raise InputError("--fmi", f"must be one of {', '.join(VERSIONS)}, is {settings.fmi}")
    source = written_out(twin, C, "an FMU")
    sources = _sources(twin, source, settings.fmi)
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    name = name if re.match("[A-Za-z_]", name) else f"_{name}"
    new = settings.fmi == "3.0"
    main = "fmi3.c" if new else "fmi2.c"
    description = (_description_3 if new else _description_2)(twin, name, _guid(sources))
    files = {"modelDescription.xml": description.encode()}
    files |= {f"sources/{file}": text.encode() for file, text in sources.items()}
    if new:
        files["sources/buildDescription.xml"] = _build_description(name).encode()
    notes = list(source.notes)
    built = []
    for build in _builds():
        files[f"binaries/{build.folders[new]}/{name}{build.ending}"] = _compiled(build, sources, main)
        built.append(build.folders[new])
    if not built:
        notes.append(
            "There is no C compiler here: the FMU holds its source alone, to be compiled by its importer"
        )
    elif not any("win" in folder and "darwin" not in folder for folder in built):
        notes.append(f"No binary for Windows: {_WINDOWS} is not there")
    _archive(path, files.items())
    return notes


TARGET = Target(
    "an FMU for co-simulation, FMI 2.0 or 3.0, C source and binaries", (".fmu",), _write, ("fmi",)
)
