# SPDX-License-Identifier: Apache-2.0
"""All targets that a twin can be exported to, by name.

A target is a module with an object ``TARGET``: ``suspension_twin/addons/export/<name>.py``, or one of an installed
package that its entry point in the group ``suspension_twin.exporters`` names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from suspension_twin.errors import InputError
from suspension_twin.registry import Registry
from suspension_twin.vehicle.twin import Twin

__all__ = ["TARGETS", "ExportSettings", "Target", "export_twin"]


@dataclass(frozen=True)
class ExportSettings:
    """Settings that some targets take.

    Parameters
    ----------
    into : Path, optional
        CarMaker: the vehicle file whose springs and dampers are replaced.
    fmi : str
        FMU: the version of the interface, ``2.0`` or ``3.0``.
    """

    into: Path | None = None
    fmi: str = "2.0"


@dataclass(frozen=True)
class Target:
    """One target.

    Parameters
    ----------
    title
        Short description of the file.
    suffixes
        Endings that its file may have; none: any.
    write
        Writes a twin to a path. Returns lines on parts of the twin that are not in the file, and on its use.
    settings
        Names of the :class:`ExportSettings` that it takes.
    """

    title: str
    suffixes: tuple[str, ...]
    write: Callable[[Twin, Path, ExportSettings], Sequence[str]]
    settings: tuple[str, ...] = ()


#: Targets by name, each imported when it is asked for.
TARGETS: Final = Registry[Target](
    "exporters",
    {name: f"{__package__}.{name}:TARGET" for name in ("fmu", "carmaker", "simulink", "unity", "csv")},
    attribute="TARGET",
    kind=Target,
)


def export_twin(
    twin: Twin, to: str, path: str | Path, settings: ExportSettings | None = None
) -> tuple[str, ...]:
    """Write a twin in the file of another simulator.

    Parameters
    ----------
    twin : Twin
        What to write.
    to : str
        A target: one of :data:`TARGETS`.
    path : str or Path
        The file. Its content is replaced, whole or not at all.
    settings : ExportSettings, optional
        Of the target.

    Returns
    -------
    tuple of str
        A line for each part of the twin that is not in the file, and on its use.

    Raises
    ------
    InputError
        There is no such target, the ending of the file is not one of its, it does not take a setting, or it cannot
        hold this twin.

    Examples
    --------
    >>> import tempfile
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = load_twin("bags/bump_15kmh/twin.yaml")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     notes = export_twin(twin, "csv", f"{folder}/twin.csv")
    ...     print(Path(folder, "twin.csv").read_text().splitlines()[1])
    vehicle.mass,1725.0,kg
    """
    target, settings, path = TARGETS.named(to, "--to"), settings or ExportSettings(), Path(path)
    if target.suffixes and path.suffix.lower() not in target.suffixes:
        raise InputError(path, f"a file for {to} ends with {' or '.join(target.suffixes)}")
    plain = ExportSettings()
    for name, value in vars(settings).items():
        if value != getattr(plain, name) and name not in target.settings:
            raise InputError(f"--{name}", f"is nothing that {to} takes")
    return tuple(target.write(twin, path, settings))
