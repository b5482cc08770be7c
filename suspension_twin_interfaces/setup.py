# SPDX-License-Identifier: Apache-2.0
"""Build these ROS 2 interfaces with the ros-jazzy wheels alone: no ament, no colcon, only g++.

Each ROS package becomes one extension module that holds its C structs, type supports and Python
converters. Under an apt or source ROS 2 this file is unused: colcon reads package.xml and
CMakeLists.txt. What either build makes talks to the other.
"""

from __future__ import annotations

import json
import os
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

HERE = Path(__file__).resolve().parent
FAST, INTRO = "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"
KINDS = ("msg", "srv", "action")


class Interfaces(Extension):
    """One ROS package: its name, version and dependencies come from its package.xml."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        manifest = ElementTree.parse(folder / "package.xml").getroot()
        self.package, self.version = manifest.findtext("name"), manifest.findtext("version")
        # Every service and action refers to these two, whatever its definition says.
        implied = {"service_msgs", "unique_identifier_msgs"}
        self.deps = sorted({str(d.text) for d in manifest.iter("depend")} | implied)
        super().__init__(
            f"{self.package}.{self.package}_s__rosidl_typesupport_c",
            ["typesupport_dispatch.cpp"],
            language="c++",
        )

    def generate(self, share: Path, out: Path) -> list[str]:
        """Run the rosidl generators in this process, as their CMake macros would; the sources that came out."""
        import rosidl_generator_c
        import rosidl_generator_py
        import rosidl_generator_type_description
        import rosidl_typesupport_c
        import rosidl_typesupport_fastrtps_c
        import rosidl_typesupport_introspection_c
        from rosidl_adapter import convert_to_idl

        shutil.rmtree(out, ignore_errors=True)
        idl_dir = out / "idl" / self.package
        files = sorted(
            p.relative_to(self.folder) for kind in KINDS for p in self.folder.glob(f"{kind}/*.{kind}")
        )
        for path in files:
            (idl_dir / path.parent).mkdir(parents=True, exist_ok=True)
            convert_to_idl(self.folder, self.package, path, idl_dir)
        idls = [path.with_suffix(".idl") for path in files]

        def run(function: Callable[..., object], generator: str, *extra: object, **arguments: object) -> Path:
            resource, target = share / generator / "resource", out / generator / self.package
            (target / "msg").mkdir(parents=True)
            settings = {
                "package_name": self.package,
                "output_dir": str(target),
                "template_dir": str(resource),
                "idl_tuples": [f"{idl_dir}:{i.as_posix()}" for i in idls],
                "target_dependencies": [],
                "ros_interface_dependencies": [
                    f"{d}:{i}" for d in self.deps for i in (share / d).rglob("*.idl")
                ],
                **arguments,
            }
            (out / "arguments.json").write_text(json.dumps(settings))
            function(str(out / "arguments.json"), *extra)
            for template in resource.glob("*__visibility_control.h.in"):
                text = template.read_text().replace("@PROJECT_NAME@", self.package)
                text = text.replace("@PROJECT_NAME_UPPER@", self.package.upper())
                (target / "msg" / template.stem).write_text(text)
            return target

        hashes = run(
            rosidl_generator_type_description.generate_type_hash,
            "rosidl_generator_type_description",
            include_paths=[f"{d.name}:{d}" for d in share.iterdir()],
        )
        run(
            rosidl_generator_c.generate_c,
            "rosidl_generator_c",
            ros_interface_files=[str(self.folder / f) for f in files],
            type_description_tuples=[f"{i}:{hashes / i.with_suffix('.json')}" for i in idls],
        )
        run(rosidl_typesupport_fastrtps_c.generate_typesupport_fastrtps_c, FAST)
        run(rosidl_typesupport_introspection_c.generate_c, INTRO)
        run(rosidl_typesupport_c.generate_c, "rosidl_typesupport_c", [FAST, INTRO])
        converters = run(rosidl_generator_py.generate_py, "rosidl_generator_py", ["rosidl_typesupport_c"])
        (converters / "__init__.py").touch()
        return sorted(str(p) for p in out.rglob("*") if p.suffix in (".c", ".cpp"))


class BuildInterfaces(build_ext):
    """Generates the sources of each package, compiles them, and puts the generated Python beside."""

    def build_extension(self, ext: Interfaces) -> None:
        import numpy
        import rosidl_generator_c

        compiler = (os.environ.get("CXX") or "g++").split()[0]
        if shutil.which(compiler) is None:
            raise SystemExit(f"{ext.package}: {compiler} is missing: apt-get install g++")
        # Where the wheels lie: the environment, or the one that pip builds in.
        prefix = Path(rosidl_generator_c.__file__).resolve().parents[4]
        include = prefix / "include"
        out = Path(self.build_temp).resolve() / ext.package
        ext.sources = ext.sources + ext.generate(prefix / "share", out)
        ext.include_dirs = [str(p) for p in [*out.iterdir(), include, *include.iterdir()] if p.is_dir()]
        ext.include_dirs.append(numpy.get_include())
        ext.library_dirs = [str(prefix / "lib")]
        parts = ("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c", FAST, INTRO)
        ext.libraries = [f"{d}__{part}" for d in ext.deps for part in parts]
        ext.libraries += ["rosidl_typesupport_c", FAST, INTRO, "rosidl_runtime_c", "rcutils", "fastcdr"]
        ext.define_macros = [
            (f"rosidl_typesupport_c__get_{kind}_typesupport_handle_function", f"package_{kind}_dispatch")
            for kind in ("message", "service")
        ]
        ext.extra_compile_args = ["-O1", "-g0", "-w"]
        ext.extra_link_args = ["-Wl,-rpath,$ORIGIN/../../..", "-Wl,--as-needed"]
        super().build_extension(ext)
        converters = out / "rosidl_generator_py" / ext.package
        for source in converters.rglob("*.py"):
            target = Path(self.build_lib) / ext.package / source.relative_to(converters)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)


def sourced(package: str) -> bool:
    """Whether an ament environment that is sourced has this package already."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return any((Path(prefix) / "share" / package / "package.xml").is_file() for prefix in prefixes if prefix)


own = Interfaces(HERE)
setup(
    name=own.package,
    version=own.version,
    description="Messages, services and actions of suspension_twin, built from the ROS 2 Jazzy wheels",
    license="Apache-2.0",
    python_requires=">=3.10,<3.14",
    packages=[],
    ext_modules=[own] if sourced("tf2_msgs") else [own, Interfaces(HERE / "tf2_msgs")],
    cmdclass={"build_ext": BuildInterfaces},
    # rclpy does not bring its middleware; names without "jazzy" in them belong to other releases as well.
    install_requires=[
        "ros-jazzy-rclpy==7.1.6",
        "ros-jazzy-rmw-fastrtps-cpp==8.4.3",
        "ros-jazzy-common-interfaces==5.3.6",
    ],
)
