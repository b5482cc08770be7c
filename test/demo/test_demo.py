# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin demo``, run once as a user runs it, and its parts."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from suspension_twin.cli.common import bundled
from suspension_twin.demo.steps import DRIVES, LEARNT, UNSEEN, _outcome, run_demo
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError, WorkError
from suspension_twin.nodes.session import Replay
from suspension_twin.report.characteristics import force
from suspension_twin.road import flat_road
from suspension_twin.vehicle.twin import load_twin

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The command as a user runs it, in an empty folder."""
    folder = tmp_path_factory.mktemp("demo")
    command = [sys.executable, "-m", "suspension_twin", "demo"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    return folder, done


def test_the_demo_says_how_long_it_took_and_where_to_look(demo):
    """How long that is, ``benchmarks/demo.py`` shows."""
    folder, done = demo
    lines = done.stdout.strip().splitlines()
    assert lines[0].startswith(f"Writes {Path('suspension_twin_demo') / 'index.html'}, ")
    assert lines[-1] == f"Look at {Path('suspension_twin_demo') / 'index.html'}"
    assert re.search(r"^\d+ s in all", done.stdout, re.MULTILINE)
    assert done.stderr == ""
    assert (folder / "suspension_twin_demo" / "index.html").is_file()


def test_the_gap_closes_on_the_drive_learnt_from_and_on_the_one_not_seen(demo):
    _, done = demo
    rows = {}
    for name, title in DRIVES.items():
        row = next(line for line in done.stdout.splitlines() if line.startswith(title))
        rows[name] = [float(x) for x in re.findall(r"\d+\.\d+", row.split(title)[1])]
    for measured, first, calibrated, truth in rows.values():
        assert first < measured
        assert calibrated < 0.65 * first
        assert calibrated < 1.35 * truth


def test_the_twin_file_is_nearer_to_the_truth_where_the_drive_moved_it(demo):
    """Dampers up to 0.3 m/s, against the true ones."""
    folder, _ = demo
    found = load_twin(folder / "suspension_twin_demo" / "twin.yaml").vehicle
    start = load_twin(folder / "suspension_twin_demo" / "start.yaml").vehicle
    truth = load_twin(BAGS / LEARNT / "truth.yaml").vehicle
    v = np.linspace(0.2, 0.35, 16)
    errors = {"found": [], "start": []}
    for axle in ("front", "rear"):
        for curve in ("damper_push", "damper_pull"):
            real = force(getattr(getattr(truth, axle), curve).points, v)
            for name, vehicle in (("found", found), ("start", start)):
                errors[name].append(force(getattr(getattr(vehicle, axle), curve).points, v) / real - 1)
    found_error, start_error = (np.sqrt(np.mean(np.square(errors[k]))) for k in ("found", "start"))
    assert found_error < 0.6 * start_error


def test_the_folder_holds_all_that_its_files_refer_to(demo):
    folder, _ = demo
    out = folder / "suspension_twin_demo"
    for name in ("start.yaml", "twin.yaml", f"start_{UNSEEN}.yaml", f"twin_{UNSEEN}.yaml"):
        twin = load_twin(out / name)
        assert twin.road.file.parent == out.resolve()
        assert twin.road.file.is_file()
        assert "file: /" not in (out / name).read_text()


class Figures(HTMLParser):
    """Counts the figures and their captions; collects what the page refers to."""

    def __init__(self):
        super().__init__()
        self.figures, self.drawings, self.links = 0, 0, []

    def handle_starttag(self, tag, attributes):
        self.figures += tag == "figure"
        self.drawings += tag in ("svg", "img")
        self.links += [v for k, v in attributes if k in ("href", "src", "xlink:href")]


def test_the_page_shows_everything_and_needs_nothing(demo):
    folder, _ = demo
    html = (folder / "suspension_twin_demo" / "index.html").read_text(encoding="utf-8")
    page = Figures()
    page.feed(html)
    # in time and in frequency and on the map on both drives, by road, characteristics, convergence
    assert page.figures == page.drawings == 9
    assert all(link.startswith(("#", "data:")) for link in page.links)
    for words in (
        "in time",
        "In frequency",
        "Where the car was",
        "Springs and dampers",
        "The gap in numbers",
    ):
        assert words in html
    assert "simulated" in html
    assert "nan" not in re.sub(r"<svg.*?</svg>|data:[^\"]*", "", html, flags=re.DOTALL).lower().split()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--out", "taken"], "taken"),
        (["--out", "taken/below"], "taken"),
        (["--seed", "x"], "seed"),
        (["extra"], "extra"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, named, tmp_path):
    (tmp_path / "taken").write_text("")
    command = [sys.executable, "-m", "suspension_twin", "demo", *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert named in done.stderr


def test_the_bundled_drives_are_found():
    for name in DRIVES:
        assert len(read_drive(bundled("bags", name)).imu) > 2000


def test_drives_that_are_missing_are_named(tmp_path):
    with pytest.raises(InputError, match=LEARNT):
        run_demo(tmp_path / "nowhere", tmp_path / "out", None)


def test_a_replay_without_heading_or_motion_is_not_compared():
    t = np.arange(0.0, 10.0, 0.01)
    rows = [t, t, 0 * t, 0 * t, np.ones_like(t), np.full_like(t, 0.01)]
    replay = Replay(t, np.sin(t), 0 * t, np.column_stack(rows), np.empty((0, 2)), 1.0)
    seen = SimpleNamespace(driving=t > 5.0)
    offline = SimpleNamespace(
        gap=SimpleNamespace(rms=0.4),
        measured={"vertical_acceleration": np.where(t > 5.0, 2.0, 0.0)},
        observation=seen,
    )
    outcome = _outcome("x", replay, flat_road(), offline)
    assert outcome.live == pytest.approx(np.sqrt(np.mean(np.sin(t[100:]) ** 2)))
    assert (outcome.rms, outcome.measured_rms) == (0.4, 2.0)
    assert outcome.compared.sum() == 900
    rows[5] = np.full_like(t, np.inf)
    with pytest.raises(WorkError, match="heading"):
        _outcome("x", replace(replay, path=np.column_stack(rows)), flat_road(), offline)
    rows[4], rows[5] = 0 * t, np.full_like(t, 0.01)
    with pytest.raises(WorkError, match="never moved"):
        _outcome("x", replace(replay, path=np.column_stack(rows)), flat_road(), offline)
