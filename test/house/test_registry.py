# SPDX-License-Identifier: Apache-2.0
"""Registries: what an installed package adds by its entry points, and that the core does without the add-ons."""

from __future__ import annotations

import ast
import logging
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from suspension_twin import registry
from suspension_twin.errors import InputError
from suspension_twin.registry import ADDONS, PluginError, Registry


def install(folder: Path, name: str, entry_points: dict[str, dict[str, str]], **modules: str) -> None:
    """A distribution as pip leaves it in a folder: modules, and its metadata with entry points by group."""
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(textwrap.dedent(text))
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = []
    for group, points in entry_points.items():
        lines += [f"[suspension_twin.{group}]", *(f"{key} = {value}" for key, value in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """``installed(name, entry_points, module=text)``: as if the distribution had been installed before the start."""
    monkeypatch.syspath_prepend(tmp_path)
    registry.entry_points.cache_clear()
    yield lambda *given, **modules: install(tmp_path, *given, **modules)
    registry.entry_points.cache_clear()
    for file in tmp_path.glob("*.py"):
        sys.modules.pop(file.stem, None)


def colours() -> Registry[str]:
    return Registry("colours", {"sep": "os:sep"}, attribute="COLOUR", kind=str)


def test_a_plugin_is_there_beside_what_is_built_in(installed) -> None:
    installed("paint", {"colours": {"red": "reds"}}, reds="COLOUR = 'crimson'")
    assert dict(colours()) == {"sep": os.sep, "red": "crimson"}
    assert colours().module("red") == "reds" and colours().module("sep") == "os"


def test_nothing_of_a_plugin_is_imported_for_what_is_built_in(installed) -> None:
    installed("paint", {"colours": {"red": "reds"}}, reds="raise SystemExit('imported')")
    assert colours()["sep"] == os.sep


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            "import no_such_library",
            "cannot be loaded: ModuleNotFoundError: No module named 'no_such_library'",
        ),
        ("SHADE = 'crimson'", "cannot be loaded: AttributeError"),
        ("COLOUR = 7", "COLOUR is no str"),
        ("1 / 0", "cannot be loaded: ZeroDivisionError"),
    ],
)
def test_a_broken_plugin_is_one_line_and_breaks_nothing_else(installed, caplog, text: str, why: str) -> None:
    installed("broken-paint", {"colours": {"red": "reds_that_fail"}}, reds_that_fail=text)
    installed("paint", {"colours": {"blue": "blues"}}, blues="COLOUR = 'navy'")
    found = colours()
    with caplog.at_level(logging.ERROR, "suspension_twin"):
        assert list(found) == ["sep", "blue"] == list(found)
    (line,) = caplog.messages
    assert line.startswith("broken-paint: entry point red of suspension_twin.colours: ") and why in line
    with pytest.raises(PluginError, match="broken-paint: entry point red"):
        found["red"]


def test_a_taken_name_is_an_error_line(installed, caplog) -> None:
    installed("paint", {"colours": {"sep": "seps", "red": "reds"}}, seps="COLOUR = 'x'", reds="COLOUR = 'a'")
    installed("other-paint", {"colours": {"red": "other_reds"}}, other_reds="COLOUR = 'b'")
    found = colours()
    with caplog.at_level(logging.ERROR, "suspension_twin"):
        assert dict(found) == {"sep": os.sep}
    assert sorted(caplog.messages) == [
        "paint: entry point red of suspension_twin.colours: its name is taken by other-paint as well",
        "paint: entry point sep of suspension_twin.colours: its name is that of a built-in one",
    ]


def test_an_object_whose_own_name_is_another_is_an_error(installed) -> None:
    installed("paint", {"colours": {"red": "reds"}}, reds="class COLOUR:\n    id = 'blue'\n")
    with pytest.raises(PluginError, match="its id is blue"):
        Registry[object]("colours", attribute="COLOUR", identity="id")["red"]


def test_an_unknown_name_is_an_input_error_that_lists_the_known(installed) -> None:
    with pytest.raises(InputError, match=r"colour: sepp is not known, did you mean sep\?; there are sep"):
        colours().named("sepp", "colour")


def run(*arguments: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """A Python program that finds packages in ``folder`` first."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_a_command_of_a_package_and_a_broken_one(tmp_path: Path, repository: Path) -> None:
    (tmp_path / "suspension_twin").symlink_to(repository / "suspension_twin")
    laps = """
        from suspension_twin.cli.main import Subcommand
        SUBCOMMAND = Subcommand("laps", "laps_command", "Lap times.")
    """
    command = "def command(bag: str) -> None:\n    '''Lap times.'''\n    print('laps of', bag)\n"
    install(tmp_path, "laps", {"commands": {"laps": "laps_row"}}, laps_row=laps, laps_command=command)
    install(tmp_path, "bad", {"commands": {"bad": "bad_row"}}, bad_row="import no_such_library")
    done = run("-m", "suspension_twin", "laps", "drive", folder=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "laps of drive\n", "")
    broken = "bad: entry point bad of suspension_twin.commands: cannot be loaded: ModuleNotFoundError: "
    broken += "No module named 'no_such_library'\n"
    listed = run("-m", "suspension_twin", "--help", folder=tmp_path)
    assert listed.returncode == 0 and "Lap times." in listed.stdout and listed.stderr == broken
    asked = run("-m", "suspension_twin", "bad", folder=tmp_path)
    assert (asked.returncode, asked.stderr) == (2, f"suspension-twin: {broken}")


TERM = """
    from suspension_twin.effects.base import CORNER, WIDTH, Effect, Fields, Floats, Hook, KernelTerms
    from suspension_twin.effects.base import Parameter, Prior, inlined, rows, travel_rate

    _FIELDS = Fields()
    _RATE = _FIELDS.add()


    @inlined
    def _force(w: Floats, e: int, c: int, i: int, h: float) -> None:
        v = travel_rate(w, c, i)
        w[(rows.STRUT + c) * WIDTH + i] += w[(e + _RATE) * WIDTH + i] * v * abs(v)


    EFFECT = Effect(
        id="square_damping",
        title="square damping",
        where="strut",
        doc="A force that grows with the square of the velocity.",
        parameters=(Parameter("rate", (0.0, 1e5), Prior(0.0, 300.0), "N s²/m²", "of the force"),),
        severity=("rate",),
        excited_by=("bumps",),
        confused_with=("worn_dampers",),
        hook=Hook(kernel=KernelTerms(_FIELDS, lambda p: {_RATE: p["rate"]}, {"strut": (_force, CORNER)})),
    )
"""


def with_kernel_term(folder: Path, repository: Path) -> None:
    """A package ``square`` beside ours whose effect has a term in the kernel."""
    for name in ("suspension_twin", "package.xml", "bags"):
        (folder / name).symlink_to(repository / name)
    install(folder, "square", {"effects": {"square_damping": "square"}})
    (folder / "square").mkdir()
    (folder / "square" / "__init__.py").write_text("from square.term import EFFECT\n")
    (folder / "square" / "term.py").write_text(textwrap.dedent(TERM))


@pytest.mark.long
def test_machine_code_is_kept_apart_by_the_source_of_a_plugin(tmp_path: Path, repository: Path) -> None:
    with_kernel_term(tmp_path, repository)
    code = (
        "from suspension_twin.compiled import _cache_folder as folder\n"
        "from suspension_twin.effects.registry import EFFECTS\n"
        "import suspension_twin.models.full_car_effects as kernels\n"
        "EFFECTS['square_damping']\n"
        "print(folder(kernels.__name__, (EFFECTS.module('square_damping'),)))\n"
    )
    before = run("-c", code, folder=tmp_path)
    assert run("-c", code, folder=tmp_path).stdout == before.stdout != "", before.stderr
    (tmp_path / "square" / "term.py").write_text(textwrap.dedent(TERM).replace("* abs(v)", "* v"))
    assert run("-c", code, folder=tmp_path).stdout != before.stdout


@pytest.mark.long
def test_the_term_of_a_plugin_acts_in_the_kernel(tmp_path: Path, repository: Path, monkeypatch) -> None:
    """Interpreted, for compiling takes minutes: the one function that numba gives to compiled code alone is fma."""
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    with_kernel_term(tmp_path, repository)
    code = """
        from numba.core.extending import _Intrinsic
        _Intrinsic.__call__ = lambda _, a, b, c: a * b + c

        import numpy as np
        from suspension_twin.inference.synthetic import path_along
        from suspension_twin.models.excitation import excitation
        from suspension_twin.models.simulate import simulate_twin
        from suspension_twin.road import bump_road, half_sine
        from suspension_twin.vehicle.twin import load_twin

        twin = load_twin("bags/bump_15kmh/twin.yaml")
        road = bump_road(half_sine(0.9, 0.05), at=10.0, length=40.0)
        path = path_along(road, np.arange(0.0, 2.2, 0.02), ((0.0, 6.0), (2.2, 6.0)), 2.0)
        driven = excitation(path, twin.vehicle, road)

        def fastest(rate):
            spec = {"id": "square_damping", "parameters": {"rate": rate}}
            return np.abs(simulate_twin(twin.with_changes({"effects": [spec]}), driven).deflection_rate).max()

        assert fastest(2000.0) < 0.9 * fastest(1.0)
    """
    done = run("-c", textwrap.dedent(code), folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


# The core without the add-ons


def test_no_module_of_the_core_imports_an_add_on(repository: Path) -> None:
    """At any level, also in functions and for types only; the registry alone has the package's name, as a text."""
    found = []
    for path in sorted((repository / "suspension_twin").rglob("*.py")):
        own = path.relative_to(repository)
        if own.parts[1] == "addons":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Constant) and node.value == ADDONS and own.name != "registry.py":
                names = [ADDONS]
            else:
                continue
            found += [f"{own}:{node.lineno}" for name in names if f"{name}.".startswith(f"{ADDONS}.")]
    assert found == []


@pytest.fixture(scope="module")
def core(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package that has no add-ons."""
    folder = tmp_path_factory.mktemp("core")

    def left_out(directory: str, names: list[str]) -> set[str]:
        own = Path(directory).relative_to(repository)
        return {n for n in names if n == "__pycache__" or (own / n).as_posix() == "suspension_twin/addons"}

    shutil.copytree(
        repository / "suspension_twin", folder / "suspension_twin", ignore=left_out, symlinks=True
    )
    shutil.copy(repository / "package.xml", folder)
    for name in ("config", "bags"):
        (folder / name).symlink_to(repository / name)
    # An editable installation would find the add-ons where they lie.
    (folder / "sitecustomize.py").write_text(
        "import sys\n"
        "for finder in list(sys.meta_path):\n"
        "    name = getattr(finder, '__module__', '')\n"
        "    if name.startswith('__editable___suspension_twin_') and 'interfaces' not in name:\n"
        "        sys.meta_path.remove(finder)\n"
    )
    return folder


@pytest.mark.long
def test_the_core_imports_without_the_add_ons(core: Path) -> None:
    names = [
        ".".join(path.relative_to(core).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted((core / "suspension_twin").rglob("*.py"))
        if path.name != "__main__.py" and path.parent != core
    ]
    done = run("-c", f"import importlib\nfor name in {names}: importlib.import_module(name)", folder=core)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_core_lists_its_commands_without_the_add_ons(core: Path) -> None:
    done = run("-m", "suspension_twin", "--help", folder=core)
    assert (done.returncode, done.stderr) == (0, "")
    assert "calibrate" in done.stdout and "connect" not in done.stdout


@pytest.fixture(scope="module")
def hidden(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the package's add-ons cannot be imported: its kernels are compiled already."""
    folder = tmp_path_factory.mktemp("hidden")
    for name in ("suspension_twin", "package.xml", "config", "bags"):
        (folder / name).symlink_to(repository / name)
    (folder / "sitecustomize.py").write_text(
        textwrap.dedent(
            f"""
            import sys

            class Hidden:
                @staticmethod
                def find_spec(name, path=None, target=None):
                    if f"{{name}}.".startswith("{ADDONS}."):
                        raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)

            sys.meta_path.insert(0, Hidden)
            """
        )
    )
    return folder


CAR, TWIN = "bags/bump_15kmh", "bags/bump_15kmh/twin.yaml"


@pytest.mark.parametrize(
    "arguments",
    [
        ["simulate", CAR, "--twin", TWIN, "--out", "OUT"],
        ["calibrate", CAR, "--twin", TWIN, "--out", "OUT.yaml", "--preset", "fast", "--max-generations", "1"],
        ["run", "--twin", TWIN, "--bag", CAR, "--rate", "max"],
        pytest.param(
            ["diagnose", CAR, "--twin", TWIN, "--out", "OUT", "--effect", "strut_friction"],
            marks=pytest.mark.long,
        ),
    ],
    ids=lambda arguments: arguments[0],
)
@pytest.mark.long
def test_the_core_works_without_the_add_ons(hidden: Path, tmp_path: Path, arguments: list[str]) -> None:
    given = [a.replace("OUT", str(tmp_path / "out")) for a in arguments]
    done = run("-m", "suspension_twin", *given, folder=hidden)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["connect"], "No such command 'connect'"),
        (["road", "scan"], "No such command 'scan'"),
        (["run", "--twin", TWIN, "--view"], "--view"),
        (["run", "--twin", TWIN, "--source", "nmea:/dev/ttyUSB0"], "--source"),
        (["run", "--fleet", "fleet.csv"], "--fleet"),
    ],
    ids=lambda given: " ".join(given) if isinstance(given, list) else "",
)
def test_a_command_of_an_add_on_says_what_is_missing(core: Path, arguments: list[str], named: str) -> None:
    done = run("-m", "suspension_twin", *arguments, folder=core)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert named in done.stderr and f"{ADDONS} is not installed" in done.stderr


def test_a_model_of_an_add_on_says_what_is_missing(core: Path, tmp_path: Path) -> None:
    twin = tmp_path / "twin.yaml"
    twin.write_text("model: fmu\nfmu: {file: car.fmu}\n")
    done = run("-m", "suspension_twin", "simulate", CAR, "--twin", str(twin), "--out", "x", folder=core)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    wrong = "model: must be one of full_car, msd, tracked, quarter_car, is 'fmu'"
    assert done.stderr.endswith(f"{wrong}; {ADDONS} is not installed\n")
