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
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Final, NamedTuple

from suspension_twin import __version__
from suspension_twin.addons.export.registry import ExportSettings, Target
from suspension_twin.addons.export.standalone.source import ModelCode, model_code, rendered
from suspension_twin.addons.export.standalone.translate import C
from suspension_twin.errors import InputError, WorkError, printable
from suspension_twin.files import replacing, write_text
from suspension_twin.models.connectors import INPUTS, OUTPUTS
from suspension_twin.vehicle.twin import Twin

__all__ = ["TARGET"]

VERSIONS: Final = ("2.0", "3.0")
#: Value references of the outputs and of time begin here, as in component.h and fmi3.c.
_FIRST_OUTPUT, _TIME = 100, 1000
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


def _sources(code: ModelCode, version: str) -> tuple[dict[str, str], str]:
    """The C files by name, and a GUID that follows from them."""
    folder = resources.files("suspension_twin.addons.export.standalone")
    model = [
        "/* The equations of a vehicle, written out from the kernel of its twin, and its constants. SI units. */",
        f"#define ROWS {code.rows}",
        f"#define MAX_STEP {code.max_step!r}",
        code.text,
        f"static const double INITIAL[ROWS] = {{\n{code.initial}\n}};",
        "",
    ]
    texts = {"model.c": "\n".join(model)}
    for name in ("component.h", f"fmi{version[0]}.c"):
        texts[name] = (folder / name).read_text(encoding="utf-8")
    digest = hashlib.sha256("\0".join(f"{k}\0{v}" for k, v in sorted(texts.items())).encode()).hexdigest()
    guid = f"{{{uuid.uuid5(_GUID_SPACE, digest)}}}"
    failed = "" if "FAILED" in code.text.split("\n\n")[0] else f"#define FAILED {code.failed}\n"
    texts["model.c"] = f'#define GUID "{guid}"\n{failed}{texts["model.c"]}'
    return texts, guid


def _description(template: str, twin: Twin, name: str, guid: str) -> bytes:
    """An XML file of the archive, from its template."""
    text = rendered(
        template,
        name=name,
        guid=guid,
        description=f"Suspension of {printable(twin.vehicle.name)}: a twin of the model {twin.model}",
        tool=f"suspension_twin {__version__}",
        inputs=INPUTS,
        outputs=OUTPUTS,
        first_output=_FIRST_OUTPUT,
        time=_TIME,
    )
    return text.encode()


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
    code = model_code(twin, C, "an FMU")
    sources, guid = _sources(code, settings.fmi)
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    name = name if re.match("[A-Za-z_]", name) else f"_{name}"
    version = VERSIONS.index(settings.fmi)
    main = f"fmi{settings.fmi[0]}"
    files = {"modelDescription.xml": _description(f"{main}.xml.j2", twin, name, guid)}
    files |= {f"sources/{file}": text.encode() for file, text in sources.items()}
    if settings.fmi == "3.0":
        files["sources/buildDescription.xml"] = _description("build.xml.j2", twin, name, guid)
    notes, builds = list(code.notes), list(_builds())
    for build in builds:
        library = f"binaries/{build.folders[version]}/{name}{build.ending}"
        files[library] = _compiled(build, sources, f"{main}.c")
    if not builds:
        notes.append(
            "There is no C compiler here: the FMU holds its source alone, to be compiled by its importer"
        )
    elif not any(build.ending == ".dll" for build in builds):
        notes.append(f"No binary for Windows: {_WINDOWS} is not there")
    _archive(path, files.items())
    return notes


TARGET = Target(
    "an FMU for co-simulation, FMI 2.0 or 3.0, C source and binaries", (".fmu",), _write, ("fmi",)
)
