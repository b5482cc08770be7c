# SPDX-License-Identifier: Apache-2.0
"""Roads of known heights under simulated scanners, which know nothing of the package's way from points to a road."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

import numpy as np
import pytest

from suspension_twin.addons.roads.scan.scan import MEASURED, ScanSettings, road_from_scan
from suspension_twin.road.build import Centreline
from suspension_twin.road.recipe import make_road, parse_feature

LENGTH = 14.0


@pytest.fixture(scope="module")
def bench(benchmarks_on_the_path: None) -> ModuleType:
    return import_module("road_scan")


@pytest.mark.long
@pytest.mark.parametrize("name", ["terrestrial", "mobile"])
def test_the_wheel_paths_come_back_without_cars_and_people(name: str, bench: ModuleType) -> None:
    features = [parse_feature("bump", "0.9x0.05@3"), parse_feature("pothole", "0.6x0.06@10:0.4..1.2")]
    made = make_road(LENGTH, 8.0, features=features, iso="B", seed=2, step=0.01, v_step=0.05)
    site = bench.make_site(name, made, LENGTH, 2)
    if name == "terrestrial":
        scan = bench.terrestrial(site.ground, 2, step=4e-3, every=14.0)
    else:
        scan = bench.mobile(site.ground, 2, step=5e-3)
    assert (scan.kind == 2).sum() > 1000, "cars and a person are in the cloud"
    line = Centreline([0.0, LENGTH], [0.0, 0.0], 0.025)
    found = road_from_scan(bench.as_cloud(scan), line, "line", ScanSettings(width=3.0))
    paths = np.abs(np.abs(found.road.v) - 0.8) < 0.1
    measured = found.status == MEASURED
    kept, smoothed = (bench.compare(site, r, measured, paths) for r in (found.road, found.gaussian))
    assert kept["error_mm"] < 1.2 and kept["spikes"] == 0
    assert kept["error_mm"] < 0.6 * smoothed["error_mm"]
