# SPDX-License-Identifier: Apache-2.0
"""What pip, colcon, ROS and the README's commands find when they look at the project."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib import import_module, metadata
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from catkin_pkg.changelog import Changelog, populate_changelog_from_rst
from catkin_pkg.package import parse_package

import suspension_twin

NODES = ("imu_ingest", "pose_injector", "suspension_model", "calibrator", "source", "road_learner")
INTERFACES = Path("suspension_twin_interfaces")


Imports = dict[Path, frozenset[str]]


def imported(imports: Imports, folder: str) -> set[str]:
    """Names of the packages that the Python files below a folder import, from outside the project."""
    names = {name.partition(".")[0] for path in imports if path.parts[0] == folder for name in imports[path]}
    return names - set(sys.stdlib_module_names) - {"suspension_twin"}


def ros_only(names: set[str]) -> set[str]:
    return {n for n in names if re.fullmatch(r"rclpy|ament_\w+|launch\w*|\w+_(msgs|srvs|interfaces)", n)}


def canonical(requirement: str) -> str:
    found = re.match(r"[\w.-]+", requirement)
    assert found
    return re.sub(r"[-_.]+", "-", found[0]).lower()


@pytest.mark.parametrize(
    ("folder", "build_type"),
    [(Path("."), "ament_python"), (INTERFACES, "ament_cmake"), (INTERFACES / "tf2_msgs", None)],
    ids=str,
)
def test_package_xml_is_valid(folder: Path, build_type: str | None, repository: Path) -> None:
    warnings: list[str] = []
    package = parse_package(repository / folder, warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.package_format == 3
    if build_type:
        assert package.get_build_type() == build_type


def test_one_version_everywhere(repository: Path, setup_arguments: dict[str, Any]) -> None:
    versions = {parse_package(repository / folder).version for folder in (".", INTERFACES)}
    assert versions == {suspension_twin.__version__, setup_arguments["version"]}
    changes = (repository / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\n## {suspension_twin.__version__}" in changes


@pytest.mark.parametrize("folder", [Path("."), INTERFACES], ids=str)
def test_the_changelog_is_in_catkins_form(folder: Path, repository: Path) -> None:
    """With the heading that ``catkin_prepare_release`` puts in place of *Forthcoming*."""
    package = parse_package(repository / folder)
    text = (repository / folder / "CHANGELOG.rst").read_text(encoding="utf-8")
    heading = f"{package.version} (2030-01-01)"
    assert "\nForthcoming\n-----------\n" in text
    released = text.replace("Forthcoming\n-----------", f"{heading}\n{'-' * len(heading)}")
    changes = populate_changelog_from_rst(Changelog(package.name), released)
    ((version, _, content),) = list(changes.foreach_version())
    assert version == package.version and content
    assert f"Changelog for package {package.name}\n" in text


def test_the_container_does_the_steps_of_the_page(repository: Path) -> None:
    """Its libraries are those of docs/apt.md, taken from the page itself."""
    steps = (repository / ".devcontainer" / "Dockerfile").read_text(encoding="utf-8")
    page = (repository / "docs" / "apt.md").read_text(encoding="utf-8")
    assert "grep -h '^pip install' src/suspension_twin/docs/apt.md" in steps
    assert len(re.findall(r"^pip install", page, re.MULTILINE)) == 1
    opened = json.loads((repository / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    assert (repository / ".devcontainer" / opened["build"]["dockerfile"]).is_file()


def test_package_xml_depends_on_what_is_imported(repository: Path, imports: Imports) -> None:
    package = parse_package(repository)
    named = {d.name for d in package.exec_depends}
    used = ros_only(imported(imports, "suspension_twin") | imported(imports, "launch"))
    assert used - named == set()
    tools = {"ros2launch"}  # ros2 launch itself
    assert ros_only(named) - used == set()
    assert named >= tools


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 knows too few packages' modules")
def test_setup_requires_what_is_imported(imports: Imports, setup_arguments: dict[str, Any]) -> None:
    required = {canonical(r) for r in setup_arguments["install_requires"]}
    providers = metadata.packages_distributions()
    modules = imported(imports, "suspension_twin")
    outside = modules - ros_only(modules)
    missing = {m for m in outside if not required & {canonical(d) for d in providers.get(m, ["nowhere"])}}
    fleet = {"dask", "distributed", "fsspec", "psutil", "pyarrow"}
    scan = {"pyproj"}  # laspy and plyfile are imported by name
    asked_for = {"pandas", "pytest"}  # by who makes a table or writes a test
    assert missing == {"fmpy", "foxglove", *fleet, *scan, *asked_for}, (
        "extras, of which a command says how to install them"
    )
    unused = {r for r in required if not any(r in map(canonical, providers.get(m, [])) for m in modules)}
    assert unused == set()


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 knows too few packages' modules")
def test_the_test_extra_brings_what_tests_import(imports: Imports, setup_arguments: dict[str, Any]) -> None:
    required = {
        canonical(r) for r in setup_arguments["install_requires"] + setup_arguments["extras_require"]["test"]
    }
    folders = ("test", "bags", "benchmarks", "docs")
    files = [path for path in imports if path.parts[0] in folders]
    own = {p.stem for p in files} | {p.parent.name for p in files}  # helpers beside a script or a test
    modules = set().union(*(imported(imports, folder) for folder in folders))
    tools = {"catkin_pkg", "setuptools"}  # of colcon
    outside = modules - ros_only(modules) - own - tools
    providers = metadata.packages_distributions()
    missing = {m for m in outside if not required & {canonical(d) for d in providers.get(m, ["nowhere"])}}
    assert missing == set()


def test_rosdep_knows_no_library_that_setup_does_not(
    repository: Path, setup_arguments: dict[str, Any]
) -> None:
    keys = {
        d.name.removeprefix("python3-")
        for d in parse_package(repository).exec_depends
        if "python3-" in d.name
    }
    required = {canonical(r).removeprefix("py") for r in setup_arguments["install_requires"]}
    assert keys <= required | {"yaml"}


def test_everything_ros_wants_is_installed(repository: Path, setup_arguments: dict[str, Any]) -> None:
    pairs = [(target, source) for target, sources in setup_arguments["data_files"] for source in sources]
    files = {Path(target) / Path(source).name: source for target, source in pairs}
    assert all((repository / source).is_file() for source in files.values())
    share = Path("share/suspension_twin")
    assert Path("share/ament_index/resource_index/packages/suspension_twin") in files
    assert share / "package.xml" in files
    assert share / "launch/suspension_twin.launch.py" in files
    for folder in ("config", "bags"):
        for path in (repository / folder).rglob("*"):
            if path.is_file() and path.suffix not in (".py", ".pyc"):
                assert share / path.relative_to(repository) in files


def test_package_data_is_installed(tracked: list[Path], setup_arguments: dict[str, Any]) -> None:
    patterns = setup_arguments["package_data"][""]
    others = [p for p in tracked if p.parts[0] == "suspension_twin" and p.suffix != ".py"]
    assert others, "py.typed at least"
    assert [p for p in others if not any(p.match(pattern) for pattern in patterns)] == []
    packages = {p.parent.as_posix().replace("/", ".") for p in others}
    assert packages <= set(setup_arguments["packages"])


def test_every_folder_of_code_is_a_package(repository: Path, setup_arguments: dict[str, Any]) -> None:
    folders = {p.parent for p in (repository / "suspension_twin").rglob("*.py")}
    assert {f.relative_to(repository).as_posix().replace("/", ".") for f in folders} == set(
        setup_arguments["packages"]
    )


def test_entry_points_resolve(setup_arguments: dict[str, Any]) -> None:
    scripts = dict(line.split(" = ") for line in setup_arguments["entry_points"]["console_scripts"])
    assert set(scripts) == {"suspension-twin", *NODES, "viewer", "foxglove_bridge"}
    for target in scripts.values():
        module, attribute = target.split(":")
        assert callable(attrgetter(attribute)(import_module(module)))
    for plugin in setup_arguments["entry_points"]["pytest11"]:
        name, module = plugin.split(" = ")  # alike, or pytest would load it twice where -p names it
        assert name == module and import_module(module).__all__


def test_ros_finds_the_programs(repository: Path) -> None:
    from configparser import ConfigParser

    config = ConfigParser()
    config.read(repository / "setup.cfg")
    assert (
        config["develop"]["script_dir"] == config["install"]["install_scripts"] == "$base/lib/suspension_twin"
    )
    assert config["build_scripts"]["executable"] == "/usr/bin/env python3"


def colcon(*arguments: str | Path, cwd: Path, log: Path) -> str:
    program = Path(sys.executable).with_name("colcon")
    command = [program, "--log-base", log, *arguments]
    done = subprocess.run([str(c) for c in command], cwd=cwd, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_colcon_lists_both_packages(repository: Path, tmp_path: Path) -> None:
    out = colcon("list", "--base-paths", ".", INTERFACES, cwd=repository, log=tmp_path)
    assert out.splitlines() == [
        "suspension_twin\t.\t(ros.ament_python)",
        "suspension_twin_interfaces\tsuspension_twin_interfaces\t(ros.ament_cmake)",
    ]


@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copied", "symlinked"])
@pytest.mark.long
def test_colcon_builds_the_package(
    options: list[str], repository: Path, tracked: list[Path], tmp_path: Path
) -> None:
    """As in an apt workspace, but for the interfaces, which take ament_cmake and stand there as if built."""
    source, install = tmp_path / "src", tmp_path / "install"
    for path in tracked:
        (source / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(repository / path, source / path)
    built = install / "suspension_twin_interfaces/share/suspension_twin_interfaces/package.sh"
    built.parent.mkdir(parents=True)
    built.write_text("")
    folders = ["--build-base", tmp_path / "build", "--install-base", install]
    colcon("build", *options, "--base-paths", ".", *folders, cwd=source, log=tmp_path / "log")
    prefix = install / "suspension_twin"
    assert {p.name for p in (prefix / "lib/suspension_twin").iterdir()} == {
        "suspension-twin",
        *NODES,
        "viewer",
        "foxglove_bridge",
    }
    for name in ("package.xml", "launch/suspension_twin.launch.py"):
        assert (prefix / "share/suspension_twin" / name).is_file()
    assert (prefix / "share/ament_index/resource_index/packages/suspension_twin").exists()
    setup = f". '{prefix}/share/suspension_twin/package.sh' && '{prefix}/lib/suspension_twin/suspension-twin' --version"
    python = os.path.dirname(sys.executable)  # as if that environment were active
    env = {"COLCON_CURRENT_PREFIX": str(prefix), "PATH": f"{python}{os.pathsep}{os.defpath}"}
    done = subprocess.run(["sh", "-c", setup], env=env, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, f"suspension-twin {suspension_twin.__version__}\n"), (
        done.stderr
    )


class Recorded:
    """Stands for whatever a launch file makes, and keeps what it was made with."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.arguments, self.named = arguments, named


def test_the_launch_file_makes_the_nodes(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Executed with stand-ins, since there are no wheels of launch: it lives with an apt ROS 2 alone."""
    kinds = {
        "launch": ("LaunchDescription",),
        "launch.actions": ("DeclareLaunchArgument",),
        "launch.conditions": ("IfCondition",),
        "launch.substitutions": ("LaunchConfiguration", "NotEqualsSubstitution"),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
        "launch_ros.parameter_descriptions": ("ParameterValue",),
        "ament_index_python.packages": ("get_package_share_directory",),
    }
    made: dict[str, type[Recorded]] = {}
    for name, members in kinds.items():
        module = ModuleType(name)
        for member in members:
            made[member] = type(member, (Recorded,), {})
            setattr(module, member, made[member])
        monkeypatch.setitem(sys.modules, name, module)
    index = sys.modules["ament_index_python.packages"]
    monkeypatch.setattr(index, "get_package_share_directory", lambda package: str(repository))
    launch = runpy.run_path(str(repository / "launch/suspension_twin.launch.py"))
    entities = launch["generate_launch_description"]().arguments[0]

    arguments = {e.arguments[0]: e.named for e in entities if isinstance(e, made["DeclareLaunchArgument"])}
    assert set(arguments) == {
        "twin",
        "params",
        "use_sim_time",
        "namespace",
        "autostart",
        "sources",
        "learn_road",
    }
    assert all(a["description"] for a in arguments.values())
    assert "default_value" not in arguments["twin"]
    assert Path(arguments["params"]["default_value"]).is_file()

    nodes = [e.named for e in entities if isinstance(e, made["Node"])]
    assert [n["executable"] for n in nodes] == [n["name"] for n in nodes] == list(NODES)
    for node in nodes:
        assert node["package"] == "suspension_twin"
        assert node["namespace"].arguments == ("namespace",)
        file, values = node["parameters"]
        assert file.arguments == ("params",)
        types = {name: value.named["value_type"] for name, value in values.items()}
        more = {"source": {"sources": str}, "road_learner": {"out": str}}.get(node["name"])
        assert types == {"twin": str, "use_sim_time": bool} | (more or {"autostart": bool})
        assert ("condition" in node) == bool(more)


def test_interfaces_name_their_dependencies(repository: Path) -> None:
    """package.xml, CMakeLists.txt and the definitions agree, or one of the two builds breaks."""
    folder = repository / INTERFACES
    named = {d.text for d in ElementTree.parse(folder / "package.xml").getroot().iter("depend")}
    cmake = (folder / "CMakeLists.txt").read_text()
    found = set(re.findall(r"find_package\((\w+) REQUIRED\)", cmake)) - {
        "ament_cmake",
        "rosidl_default_generators",
    }
    listed = re.search(r"DEPENDENCIES ([\w\s]+)\)", cmake)
    assert listed
    assert named == found == set(listed[1].split())
    implied = {"srv": {"service_msgs"}, "action": {"service_msgs", "action_msgs"}, "msg": set()}
    used = {"builtin_interfaces"}  # of every header
    for kind, packages in implied.items():
        for path in folder.glob(f"{kind}/*.{kind}"):
            used |= packages | set(
                re.findall(r"^(\w+)/\w+(?:\[\w*\])?\s+\w+", path.read_text(), re.MULTILINE)
            )
    assert used == named


def test_every_definition_is_built(repository: Path) -> None:
    for kind in ("msg", "srv", "action"):
        module = import_module(f"suspension_twin_interfaces.{kind}")
        for path in (repository / INTERFACES).glob(f"{kind}/*.{kind}"):
            assert hasattr(module, path.stem)
    from tf2_msgs.msg import TFMessage

    assert TFMessage().transforms == []


def test_the_test_command_is_the_readmes(repository: Path) -> None:
    script = repository / ".ci/run"
    assert os.access(script, os.X_OK)
    commands = [line for line in script.read_text().splitlines() if line and not line.startswith("#")]
    assert commands[-1] == "exec python3 bootstrap.py test --long"
    readme = (repository / "README.md").read_text(encoding="utf-8").splitlines()
    assert "python3 bootstrap.py test --long" in readme
    assert "python3 bootstrap.py demo" in readme
