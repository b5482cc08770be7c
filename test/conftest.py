# SPDX-License-Identifier: Apache-2.0
"""The surroundings that every test runs in, set before anything imports ROS, numba or matplotlib."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import settings

#: Of the tests that take about a minute each, so many are run by --long.
LONGEST_A_DAY = 3
REPOSITORY = Path(__file__).resolve().parents[1]


def _isolate() -> None:
    """Give each xdist worker a ROS domain of its own, away from any network and from killed processes."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    # Two runs at the same time on one machine shall not meet either: start from the run's id.
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid()))
    start = sum(run.encode()) * 8
    os.environ["ROS_DOMAIN_ID"] = str((start + int(worker)) % 102)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"  # shared memory leaks from killed processes
    os.environ["MPLBACKEND"] = "Agg"
    os.environ.setdefault("NUMBA_NUM_THREADS", str(min(2, os.cpu_count() or 1)))


_isolate()
settings.register_profile(
    "untimed", deadline=None
)  # how long an example takes depends on what runs beside it
settings.load_profile("untimed")

from suspension_twin.calibration.presets import TABLE_2, with_table_2  # noqa: E402
from suspension_twin.drive.types import Drive, FixData, VelocityData  # noqa: E402
from suspension_twin.drive.write import write_drive  # noqa: E402
from suspension_twin.inference.synthetic import SensorErrors, path_along, synthetic_drive  # noqa: E402
from suspension_twin.pose.local_map import LocalMap  # noqa: E402
from suspension_twin.road import bump_road, circular, write_road  # noqa: E402
from suspension_twin.road.roughness import iso8608_road  # noqa: E402
from suspension_twin.vehicle.twin import RoadFile, Twin, parse_twin, save_twin  # noqa: E402


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="the tests marked long as well")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without --long those marked so are left out. Of those marked longest a few have their turn with it, others each
    day. A test or a file that is asked for by its name is run."""
    if any(argument.partition("::")[0].endswith(".py") for argument in config.args):
        return
    longest = [item for item in items if item.get_closest_marker("longest")]
    if config.getoption("--long"):
        first = LONGEST_A_DAY * date.today().toordinal()
        turns = {(first + k) % len(longest) for k in range(LONGEST_A_DAY)} if longest else set()
        left_out = {item for k, item in enumerate(longest) if k not in turns}
    else:
        left_out = {*longest, *(item for item in items if item.get_closest_marker("long"))}
    config.hook.pytest_deselected(items=[item for item in items if item in left_out])
    items[:] = [item for item in items if item not in left_out]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """One line: what was skipped, and the command that installs what was missing. A reason names after its colon what
    would install it; what cannot be imported comes with the extra ``test``."""
    why: Counter[str] = Counter()
    missing: dict[str, set[str]] = {"apt-get": set(), "pip": set()}
    for report in terminalreporter.stats.get("skipped", []):
        text, _, remedy = str(report.longrepr[2]).removeprefix("Skipped: ").partition(": ")
        why[text] += 1
        remedy = "pip install -e.[test]" if remedy.startswith("No module named") else remedy
        for tool, names in re.findall("(apt-get|pip) install (.*)", remedy):
            missing[tool] |= set(names.split())
    steps = [f"{tool} install {' '.join(sorted(names))}" for tool, names in missing.items() if names]
    if why:
        counts = ", ".join(f"{count} {text}" for text, count in why.most_common())
        terminalreporter.write_line(
            "; missing: ".join([f"skipped: {counts}", *filter(None, [" && ".join(steps)])])
        )


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured data: ``SUSPENSION_TWIN_DATA``, or ``../shared/data`` beside the repository."""
    folder = Path(os.environ.get("SUSPENSION_TWIN_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no measured data: set SUSPENSION_TWIN_DATA to its folder")
    return folder


@pytest.fixture(scope="session")
def copy_kernels() -> Callable[..., None]:
    """``copy_kernels(folder, *left_out)``: the package's machine code into a cache of a test's own: only what the test
    is about is compiled there."""

    def copy(folder: Path, *left_out: str) -> None:
        known = REPOSITORY / "suspension_twin" / "__pycache__" / "kernels"
        if known.is_dir():  # what another process is writing comes and goes
            shutil.copytree(known, folder / "kernels", ignore=shutil.ignore_patterns("*.tmp.*", *left_out))

    return copy


_AXLE = {
    "unsprung_mass": 40.0,
    "spring": {"compression": [0.1, 0.3, 0.5, 1.0], "force": [2300.0, 6900.0, 11500.0, 23000.0]},
    "damper_push": {"velocity": [0.125, 0.25, 0.35, 0.4], "force": [200.0, 420.0, 620.0, 720.0]},
    "damper_pull": {"velocity": [0.125, 0.25, 0.35, 0.4], "force": [450.0, 900.0, 1250.0, 1430.0]},
}


@pytest.fixture(scope="session")
def mondeo() -> Twin:
    return parse_twin(
        {
            "vehicle": {
                "name": "Ford Mondeo Mk IV estate",
                "mass": 1725.0,
                "wheelbase": 2.85,
                "front_track": 1.588,
                "rear_track": 1.605,
                "cog": [1.5, 0.0, 0.55],
                "sprung_inertia": {"roll": 550.0, "pitch": 2600.0},
                "tyre": {"radius": 0.316, "vertical_stiffness": 210000.0},
                "front": _AXLE,
                "rear": _AXLE,
            },
            "imu": {"position": [1.9, 0.0, 1.2]},
            "datum": {"latitude": 47.4025, "longitude": 19.284},
        }
    )


@dataclass(frozen=True)
class Case:
    """Files of a calibration whose truth is known."""

    folder: Path
    truth: Twin
    start: Twin

    @property
    def twin(self) -> str:
        return str(self.folder / "twin.yaml")

    def bag(self, name: str) -> str:
        return str(self.folder / name)


def _off(twin: Twin) -> Twin:
    """Curves 30 % too stiff in front and 30 % too weak at the rear."""
    changes = {}
    for axle, factor in (("front", 1.3), ("rear", 0.7)):
        for part in ("spring", "damper_push", "damper_pull"):
            _, force = getattr(getattr(twin.vehicle, axle), part).points
            changes[f"vehicle.{axle}.{part}.force"] = tuple((factor * force).tolist())
    return twin.with_changes(changes)


@pytest.fixture(scope="session")
def rough_case(tmp_path_factory: pytest.TempPathFactory, mondeo: Twin) -> Case:
    """Two drives of some twenty seconds over a rough road, the preset 30 % off."""
    folder = tmp_path_factory.mktemp("rough")
    road = iso8608_road("C", 140.0, seed=2, x=4.0, y=2.0, heading=0.3)
    write_road(road, folder / "road.crg")
    named = RoadFile(file=folder / "road.crg")
    start = _off(mondeo).model_copy(update={"road": named})
    save_twin(start, folder / "twin.yaml")
    for name, top, seed in (("one", 7.0, 1), ("two", 5.0, 2)):
        knots = [(0, 0), (3.2, 0), (6, top), (16, top), (19, 0), (20.5, 0)]
        drive = synthetic_drive(mondeo, road, knots, seed=seed, errors=SensorErrors(lost=0.001), name=name)
        write_drive(drive, folder / name)
    return Case(folder, mondeo.model_copy(update={"road": named}), start)


@pytest.fixture(scope="session")
def pass_case(tmp_path_factory: pytest.TempPathFactory, mondeo: Twin) -> Case:
    """Five seconds over one bump, the truth within Table 2's bounds and the start in their middle."""
    folder = tmp_path_factory.mktemp("pass")
    road = bump_road(circular(0.9, 0.05), at=14.0, length=45.0, step=0.02, x=-20.0, y=3.0, heading=0.4)
    write_road(road, folder / "road.crg")
    named = RoadFile(file=folder / "road.crg")
    base = with_table_2(mondeo).model_copy(update={"road": named})
    truth: dict[str, object] = {}
    middle: dict[str, object] = {}
    for key, (_, bounds) in TABLE_2.items():
        truth[f"{key}.force"] = tuple(0.7 * low + 0.3 * high for low, high in bounds)
        middle[f"{key}.force"] = tuple(0.5 * (low + high) for low, high in bounds)
    save_twin(base.with_changes(middle), folder / "twin.yaml")
    drive = synthetic_drive(base.with_changes(truth), road, [(0.0, 4.2), (6.0, 4.2)], seed=3, name="pass")
    write_drive(drive, folder / "pass")
    return Case(folder, base.with_changes(truth), base.with_changes(middle))


class PhoneDrive(NamedTuple):
    """A drive to the east as a phone recorded it, its twin, and its true place (n,) m at ``t`` s."""

    drive: Drive
    twin: Twin
    t: np.ndarray
    place: np.ndarray


@pytest.fixture(scope="session")
def phone_drive(tmp_path_factory: pytest.TempPathFactory, mondeo: Twin) -> PhoneDrive:
    """22 s on a road of ISO class C; the receiver is 2.5 m off, once a second, 0.4 s late beyond its stamps."""
    folder, seed, late = tmp_path_factory.mktemp("phone"), 5, 0.4
    road = iso8608_road("C", 200.0, width=12.0, v_step=6.0, seed=seed)
    road = road.with_heights(np.repeat(road.z[:, 1:2], 3, axis=1))
    write_road(road, folder / "road.crg")
    knots = [(0.0, 0.0), (2.0, 0.0), (8.0, 8.0), (22.0, 8.0)]
    exact = synthetic_drive(mondeo, road, knots, seed, SensorErrors(position=1e-3), u=10.0, name="phone")
    rng, kept, here = np.random.default_rng(seed), np.arange(0, len(exact.fix), 10), LocalMap(mondeo.datum)
    fix, velocity = exact.fix, exact.velocity
    t = fix.t[kept]
    place = here.to_map(fix.latitude, fix.longitude, fix.altitude)
    place = np.stack([np.interp(t - late, fix.t, column) for column in place.T]).T
    place += np.array([1.8, -1.7, 0.0]) + 0.3 * rng.standard_normal(place.shape)
    latitude, longitude, altitude = here.to_geodetic(place).T
    enu = np.stack([np.interp(t - late, velocity.t, column) for column in velocity.enu.T]).T
    fixes = FixData(t, latitude, longitude, altitude, fix.status[kept], np.full((t.size, 3), 2.5))
    speeds = VelocityData(t, enu + 0.1 * rng.standard_normal(enu.shape))
    way = path_along(road, exact.imu.t - 1.7e9, knots, 10.0).x
    twin = mondeo.model_copy(update={"road": RoadFile(file=folder / "road.crg")})
    return PhoneDrive(replace(exact, fix=fixes, velocity=speeds), twin, exact.imu.t, way)
