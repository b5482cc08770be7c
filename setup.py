# SPDX-License-Identifier: Apache-2.0
"""How the package is installed, by pip (bootstrap.py) and by colcon alike.

All of it stands here and not in pyproject.toml, which ``colcon build --symlink-install`` does not read. Name, version
and the like come from package.xml.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).resolve().parent
SHARE = Path("share/suspension_twin")
NODES = {
    "nodes": ("imu_ingest", "pose_injector", "suspension_model", "calibrator"),
    "addons.nodes": ("source", "road_learner", "viewer", "foxglove_bridge"),
}

REQUIRED = [
    "suspension-twin-interfaces",  # brings rclpy and the ROS messages, see suspension_twin_interfaces/setup.py
    "numpy>=1.26",
    "scipy>=1.11.1",
    "threadpoolctl>=3.1",
    "llvmlite>=0.50",
    "numba>=0.68",
    "pydantic>=2.7",
    "pyyaml>=6",
    "rosbags>=0.11.6,<0.12",
    "mcap>=1.2.1",
    "h5py>=3.10",
    "mat-io>=1.0.2; python_version >= '3.11'",  # there is none for 3.10, which reads no .mat files
    "lz4>=4",
    "zstandard>=0.20",
    "pycrg>=2.2",
    "pymap3d>=3.1",
    "pymoo>=0.6.1.6",
    "cma>=4.0",
    "matplotlib>=3.10.7",
    "cycler>=0.11",
    "aiohttp>=3.10",
    "paho-mqtt>=2.1",
    "segno>=1.6",
    "pyubx2>=1.3.3",
    "pynmeagps>=1.1.4",
    "jinja2>=3.1",
    "markupsafe>=2.1",
    "typer>=0.24",
    "rich>=14.3",
]
TEST = [
    "pytest>=9",
    "pytest-xdist>=3.7",
    "hypothesis>=6.100",
    "amqtt>=0.12",
    "pyyaml>=6.0.2",  # amqtt's own bound
    "playwright>=1.49",
    "mujoco>=3.3",
    "pythonfmu>=0.7",
    # Later ones refuse Python 3.10, and an old pip that finds out late tries all of numpy's releases for a way out.
    "etils<1.14; python_version < '3.11'",
    "objective-rating-metrics>=1.3",
    "pandas>=2.2",
    "cosmic-ray>=8.4.1",
    "duckdb>=1.0",
    "colcon-ros>=0.4",
    "colcon-package-information>=0.3",
    "wheel>=0.40",
    "ruff>=0.9",
    "mypy>=1.14",
    "scipy-stubs",
    "types-PyYAML",
]
FMU = ["fmpy>=0.3.22"]
FLEET = ["distributed>=2024.5", "dask>=2024.5", "fsspec>=2024.5", "psutil>=7.0", "pyarrow>=15"]
FOXGLOVE = ["foxglove-sdk>=0.14"]
SCAN = ["laspy>=2.5", "lazrs>=0.6", "plyfile>=1.0", "pyproj>=3.6"]
MDF = ["asammdf>=7.3"]
TDMS = ["npTDMS>=1.7"]
DOCS = ["sphinx>=8.1", "docutils>=0.20", "myst-nb>=1.2", "furo>=2024.8.6", "latex2mathml>=3.77"]


def data_files() -> list[tuple[str, list[str]]]:
    """The package's mark and manifest for ament, and launch, config and bags as they lie here."""
    files = {
        Path("share/ament_index/resource_index/packages"): [Path("resource/suspension_twin")],
        SHARE: [Path("package.xml")],
    }
    bundled = [*(HERE / "launch").glob("*.launch.py")]
    for folder in ("config", "bags"):  # without the programs that made the bags
        made_by = (".pyc", ".py") if folder == "bags" else (".pyc",)
        bundled += [p for p in (HERE / folder).rglob("*") if p.is_file() and p.suffix not in made_by]
    for path in sorted(p.relative_to(HERE) for p in bundled):
        files.setdefault(SHARE / path.parent, []).append(path)
    return [(str(target), [str(f) for f in sources]) for target, sources in files.items()]


manifest = ElementTree.parse(HERE / "package.xml").getroot()
maintainer = manifest.find("maintainer")
assert maintainer is not None
setup(
    name=manifest.findtext("name"),
    version=manifest.findtext("version"),
    description=manifest.findtext("description"),
    license=manifest.findtext("license"),
    maintainer=maintainer.text,
    maintainer_email=maintainer.get("email"),
    python_requires=">=3.10,<3.14",
    install_requires=REQUIRED,
    extras_require={
        "test": TEST + DOCS + FOXGLOVE + FLEET + FMU + SCAN + MDF + TDMS,
        "fleet": FLEET,
        "fmu": FMU,
        "s3": ["s3fs>=2024.5"],
        "foxglove": FOXGLOVE,
        "scan": SCAN,
        "mdf": MDF,
        "tdms": TDMS,
        "docs": DOCS,
    },
    packages=find_packages(include=["suspension_twin", "suspension_twin.*"]),
    package_data={
        "": [
            "py.typed",
            "*.html",
            "*.j2",
            "*.css",
            "*.js",
            "*.json",
            "*.yaml",
            "*.c",
            "*.h",
            "*.xml",
            "*.LICENSE",
        ]
    },
    data_files=data_files(),
    entry_points={
        "console_scripts": [
            "suspension-twin = suspension_twin.cli.main:main",
            *(
                f"{node} = suspension_twin.{package}.{node}:{node.title().replace('_', '')}Node.main"
                for package, nodes in NODES.items()
                for node in nodes
            ),
        ],
        "pytest11": ["suspension_twin.testing.plugin = suspension_twin.testing.plugin"],
    },
)
