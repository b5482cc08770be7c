# SPDX-License-Identifier: Apache-2.0
"""The rules of the house: who may import whom, what every file begins with."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

from suspension_twin.addons.export.registry import TARGETS
from suspension_twin.addons.sources import SOURCES
from suspension_twin.drive.importers import IMPORTERS
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.models.registry import MODELS
from suspension_twin.vehicle.twin import SCHEMAS

# From the left of the design's picture to its right: a package imports from its own row and the rows before it.
ROWS = (
    {"arrays", "errors", "compiled", "display", "files", "registry", "schema", "units"},
    {"drive"},
    {"vehicle"},
    {"signals"},
    {"pose"},
    {"road"},
    {"models", "effects"},
    {"inference"},
    {"calibration"},
    {"diagnosis"},
    {"live"},
    {"report"},
    {"api"},
    {"nodes"},
    {"demo", "testing"},
    {"cli"},
    {"__main__"},
    {"addons"},
)
RANK = {name: rank for rank, row in enumerate(ROWS) for name in row}
ROS = re.compile(r"rclpy|rosidl\w*|ament\w*|launch\w*|\w+_msgs|\w+_srvs|\w+_interfaces")


Modules = list[tuple[Path, ast.Module]]


@pytest.fixture(scope="module")
def modules(repository: Path) -> Modules:
    """Every module of the package."""
    paths = sorted((repository / "suspension_twin").rglob("*.py"))
    return [(path.relative_to(repository), ast.parse(path.read_text(encoding="utf-8"))) for path in paths]


def test_only_nodes_and_testing_import_ros(modules: Modules, imports: dict[Path, frozenset[str]]) -> None:
    found = [
        f"{path}: {name}"
        for path, _ in modules
        for name in imports[path]
        if ROS.fullmatch(name.split(".")[0]) and not {"nodes", "testing"} & {*path.parts}
    ]
    assert found == []


def test_imports_go_from_right_to_left(modules: Modules, imports: dict[Path, frozenset[str]]) -> None:
    found = []
    for path, _ in modules:
        own = path.parts[1].removesuffix(".py")
        for name in imports[path]:
            parts = name.split(".")
            inside = parts[0] == "suspension_twin" and len(parts) > 1
            if inside and own != "__init__" and RANK.get(parts[1], -1) > RANK[own]:
                found.append(f"{path}: {name}")
    assert found == []


def on_import(body: list[ast.stmt]) -> set[str]:
    """Full names of what is imported when the module is."""
    names = set()
    for node in body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.If | ast.Try) and "TYPE_CHECKING" not in ast.dump(node):
            names |= on_import(node.body)
    return names


def test_no_import_goes_in_a_circle(modules: Modules) -> None:
    graph: dict[str, set[str]] = {}
    for path, tree in modules:
        name = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
        graph[name] = on_import(tree.body)
    for own, names in graph.items():  # a name is a module, or of one
        graph[own] = {n if n in graph else n.rpartition(".")[0] for n in names} & set(graph) - {own}
    while ends := {name for name, names in graph.items() if not names}:
        graph = {name: names - ends for name, names in graph.items() if name not in ends}
    assert graph == {}, f"each of these waits for another: {sorted(graph)}"


def test_models_are_asked_for_by_the_registry(modules: Modules) -> None:
    """Only the folders of models, their effects and their files know one model from another."""
    twins = {twin.__name__ for twin in SCHEMAS.values()} | {"TrackedVehicle", "QuarterCar", "Car"}
    found = []
    places = {MODELS.module(name) for name in MODELS}
    added = {"suspension_twin.addons.__init__", *(p for p in places if ".addons." in p)}
    for path, tree in modules:
        own = ".".join(path.with_suffix("").parts)
        if path.parts[1] in ("models", "effects", "vehicle") or any(own.startswith(a) for a in added):
            continue
        if path.stem.startswith("tracked_"):
            found.append(f"{path}: is a world of its own")
        docstrings = {
            id(node.body[0].value)
            for node in ast.walk(tree)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            and node.body
            and isinstance(node.body[0], ast.Expr)
        }
        for node in ast.walk(tree):
            target = "export" in path.parts or path.name == "export.py"  # fmu is one of export as well
            named = set(MODELS) - (set(TARGETS) if target else set())
            if isinstance(node, ast.Constant) and node.value in named and id(node) not in docstrings:
                found.append(f"{path}:{node.lineno}: names the model {node.value}")
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id == "isinstance"
            ):
                asked = {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)} & twins
                found += [f"{path}:{node.lineno}: asks for the class {name}" for name in asked]
    assert found == []


def test_every_package_has_its_place(repository: Path) -> None:
    packages = {p.parent.name for p in (repository / "suspension_twin").glob("*/__init__.py")}
    assert packages <= set(RANK)


def test_every_file_has_licence_and_docstring(repository: Path, tracked: list[Path]) -> None:
    found = []
    for path in (p for p in tracked if p.suffix == ".py"):
        text = (repository / path).read_text(encoding="utf-8").removeprefix("#!/usr/bin/env python3\n")
        first, _, rest = text.partition("\n")
        if first != "# SPDX-License-Identifier: Apache-2.0":
            found.append(f"{path}: licence")
        if not re.match(r'r?"""\S', rest) and (rest or path.name != "__init__.py"):
            found.append(f"{path}: docstring")
    assert found == []


def test_no_path_of_a_machine_and_no_registry(repository: Path, tracked: list[Path]) -> None:
    # Put together here, so that this file may be looked through as well.
    folders = "|".join(("wor" + "k", "tm" + "p", "roo" + "t", "hom" + "e"))
    registries = "|".join(("py" + "pi", "python" + "hosted"))
    forbidden = re.compile(rf"(?<![\w.$}}~*-])/({folders})/|\b({registries})\.org\b")
    found = []
    for path in tracked:
        try:
            text = (repository / path).read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # a bag or a picture
        found += [f"{path}: {line.strip()[:100]}" for line in text.splitlines() if forbidden.search(line)]
    assert found == []


def documentation(repository: Path) -> str:
    pages = [repository / "README.md", *sorted((repository / "docs").rglob("*.md"))]
    return " ".join(page.read_text(encoding="utf-8") for page in pages)


def named_in_tests(repository: Path, folder: str, name: str) -> bool:
    spelt = re.compile(name.replace("_", "[_ -]?"), re.IGNORECASE)  # also as words or a class
    tests = (repository / "test" / folder).rglob("*.py")
    return any(spelt.search(p.name + p.read_text(encoding="utf-8")) for p in tests)


def files_of(repository: Path, folder: str) -> set[str]:
    paths = (repository / "suspension_twin" / folder).glob("*.py")
    return {path.stem for path in paths if not path.stem.startswith("_")}


@pytest.mark.parametrize("name", IMPORTERS)
def test_an_importer_is_whole(name: str, repository: Path) -> None:
    assert name in files_of(repository, "drive/importers")
    assert named_in_tests(repository, "drive", name), f"no test of the importer {name}"
    title = import_module(f"suspension_twin.drive.importers.{name}").TITLE
    assert title.lower() in documentation(repository).lower(), f"{title} has no line in the documentation"


def test_every_importer_is_registered(repository: Path) -> None:
    assert files_of(repository, "drive/importers") == set(IMPORTERS)


@pytest.mark.parametrize("name", SOURCES)
def test_a_source_is_whole(name: str, repository: Path) -> None:
    assert name in files_of(repository, "addons/sources")
    assert (repository / "test" / "addons" / "sources" / f"test_{name}.py").is_file(), (
        f"no test of the source {name}"
    )
    module = SOURCES[name]
    assert module.EXAMPLE.startswith(f"{name}:")
    page = (repository / "docs" / "sources.md").read_text(encoding="utf-8")
    row = next((line for line in page.splitlines() if line.startswith(f"| `{module.EXAMPLE}`")), "")
    assert module.TITLE in row, (
        f"{name} has no line in docs/sources.md: | `{module.EXAMPLE}` | {module.TITLE}..."
    )


def test_every_source_is_registered(repository: Path) -> None:
    assert files_of(repository, "addons/sources") == set(SOURCES)


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_of_export_is_whole(name: str, repository: Path) -> None:
    assert name in files_of(repository, "addons/export")
    assert (repository / "test" / "addons" / "export" / f"test_{name}.py").is_file(), (
        f"no test of the target {name}"
    )
    page = (repository / "docs" / "export.md").read_text(encoding="utf-8")
    assert f"| `{name}` | {TARGETS[name].title}" in page, f"{name} has no line in docs/export.md"


def test_every_target_of_export_is_registered(repository: Path) -> None:
    assert files_of(repository, "addons/export") - {"registry"} == set(TARGETS)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_whole(name: str, repository: Path) -> None:
    package, _, own = MODELS.module(name).rpartition(".")
    assert own == name
    tests = package.removeprefix("suspension_twin.").replace(".", "/")
    assert named_in_tests(repository, tests, name), f"no test of the model {name}"
    assert f"`{name}`" in documentation(repository), f"{name} has no line in the documentation"


def test_every_model_has_a_twin_file() -> None:
    assert set(MODELS) == set(SCHEMAS)
    assert all(MODELS[name].name == name for name in MODELS)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_is_whole(name: str, repository: Path) -> None:
    assert name in files_of(repository, "effects")
    assert named_in_tests(repository, "effects", name), f"no test of the effect {name}"
    assert f"`{name}`" in documentation(repository), f"{name} has no line in the documentation"


def test_every_effect_is_registered(repository: Path) -> None:
    assert files_of(repository, "effects") - {"base", "registry"} == set(EFFECTS)
    strut = "strut_friction bump_stop rebound_stop top_mount anti_roll_bar damper_fade corner_damper corner_spring"
    strut += " worn_dampers spring_sag semi_active_damper"
    tyre_and_body = "tyre_damping tyre_envelope unsprung_mass payload body_bending powertrain_mount"
    tyre_and_body += " tyre_pressure wheel_imbalance engine_order"
    sensor = "mount_resonance sensor_offset sensor_tilt sensor_bandwidth sensor_clipping sensor_scale"
    time_and_road = "time_offset clock_drift road_scale road_smoothing position_offset lateral_offset"
    assert set(EFFECTS) >= set(f"{strut} {tyre_and_body} {sensor} {time_and_road}".split())
