# SPDX-License-Identifier: Apache-2.0
"""The page of a running twin in a real browser: what it shows, and that its buttons do what they say."""

from __future__ import annotations

import io
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from nodes_bench import PATIENT

from suspension_twin.drive.read import read_drive

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def until(condition: Callable[[], Any], what: str, seconds: float = 60.0) -> Any:
    """Wait until ``condition`` holds; what it gave."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, f"waited {seconds:g} s for {what}"
        time.sleep(0.05)
    return found


@pytest.fixture(scope="module")
def running(twin_path, recorded, tmp_path_factory) -> Iterator[tuple[str, Path, int]]:
    """``run --bag --view``: the page's address, the folder it records into, and the program's process."""
    folder, port = tmp_path_factory.mktemp("viewed"), free_port()
    given = ["--twin", twin_path, "--bag", recorded, "--rate", "2", "--view", str(port), "--", *PATIENT]
    command = [sys.executable, "-m", "suspension_twin", "run", *map(str, given)]
    process = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    url = f"http://127.0.0.1:{port}/"
    assert process.stderr is not None
    try:
        wanted = [
            f"Watch on {url}?token=",
            "The replay begins with the first page that is opened, or in 20 s.",
        ]
        found: dict[str, str] = {}
        while len(found) < 2 and (line := process.stderr.readline()):
            found |= {begin: line.strip() for begin in wanted if line.startswith(begin)}
        assert set(found) == set(wanted), "the page was never announced"
        url = found[wanted[0]].split()[-1]
        yield url, folder, process.pid
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10.0)
        assert process.returncode == 0 and "Traceback" not in errors, errors
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    until(lambda: not listens(port), "the page's own process to end", 10.0)


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    software = [
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--ignore-gpu-blocklist",
    ]
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=software)
        yield browser
        browser.close()


@pytest.fixture
def page(browser, running) -> Iterator[Any]:
    """The page on a laptop; it must not have raised or logged an error when the test is over."""
    page = browser.new_page(viewport={"width": 1366, "height": 768})
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
    page.goto(running[0])
    yield page
    page.close()
    assert wrong == []


def number(page: Any, element: str) -> float:
    return float(page.inner_text(element).partition(" ")[0].replace("–", "nan"))


def small(page: Any) -> None:
    """Little to paint: what a test is about needs the processors more than the picture does."""
    page.set_viewport_size({"width": 480, "height": 320})


def during(page: Any, condition: Callable[[], Any], what: str) -> None:
    """Wait as ``until`` does, with the replay sent back to 3 s where it ends before."""

    def met() -> Any:
        if page.inner_text("#pause") == "Again":
            seek(page, 3.0)
        return condition()

    until(met, what)


def seek(page: Any, position: float) -> None:
    """As a hand would that drags the time bar."""
    script = "(at) => { const b = document.getElementById('bar'); b.value = at; b.dispatchEvent(new Event('change')); }"
    page.evaluate(script, position)


def pause(page: Any) -> None:
    """Have the replay rest, wherever it is: its end may come first."""

    def rests() -> bool:
        says = page.inner_text("#pause")
        if says != "Play":
            page.click("#pause")
            time.sleep(1.0)
        return says == "Play"

    until(rests, "the pause")


def lit(page: Any, picture: str) -> int:
    """Number of colours in a 2D picture or chart: an empty one has one."""
    return int(
        page.evaluate(
            """(id) => {
            const e = document.getElementById(id), c = e.querySelector("canvas") || e;
            const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
            const seen = new Set();
            for (let i = 0; i < d.length; i += 4) seen.add(d[i] * 65536 + d[i + 1] * 256 + d[i + 2]);
            return seen.size; }""",
            picture,
        )
    )


def painted(page: Any, element: str, *colours: str) -> int:
    """Number of pixels of a screenshot of ``element`` in one of the page's ``colours``, or in a mixture of two that
    follow each other."""
    png = page.locator(element).screenshot()
    seen = 255.0 * imread(io.BytesIO(png), format="png")[:, :, :3].reshape(-1, 1, 3)
    code = "(name) => getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim()"
    wanted = np.array([[int(page.evaluate(code, c)[i : i + 2], 16) for i in (1, 3, 5)] for c in colours])
    share = np.linspace(0.0, 1.0, 20)[:, None]
    mixtures = [wanted[:1], *(a + share * (b - a) for a, b in zip(wanted, wanted[1:], strict=False))]
    return int((np.abs(seen - np.concatenate(mixtures)).max(axis=2).min(axis=1) < 12.0).sum())


def looks_right(page: Any) -> None:
    """Both curves are to be seen, and the path in the colours of its gap, not in the grey of an unknown one."""
    # the twin is the true one: where its curve lies on that of the car, the two cannot be told apart yet
    curves = (("measured", 40), ("simulated", 150))
    until(lambda: all(painted(page, "#chart", name) > least for name, least in curves), "both curves")
    coloured, grey = painted(page, "#map", "good", "fair", "bad"), painted(page, "#map", "road")
    assert coloured > 400 and coloured > 5 * grey, f"{coloured} coloured and {grey} grey pixels"


def test_the_replay_waits_for_its_page_and_looks_right_at_10_s_and_at_its_end(page):
    """The first page of the program: nothing of the drive was played before it was opened."""
    east, north = until(
        lambda: page.evaluate("twin.state.path.length && twin.state.path[0].slice(0, 2)"), "a pose"
    )
    assert np.hypot(east - 5.0, north) < 1.0, f"{east} m east, {north} m north: the drive had begun before"
    until(lambda: page.evaluate("twin.head.t") > 10.0 or page.inner_text("#pause") == "Again", "10 s")
    looks_right(page)
    until(lambda: page.inner_text("#pause") == "Again", "the end")
    looks_right(page)
    bands = "[...document.querySelectorAll('.band span:last-child')].map((e) => +e.textContent)"
    assert np.hypot.reduce(page.evaluate(bands)) == pytest.approx(number(page, "#gap"), abs=0.012)
    until(lambda: number(page, "#driven") > 0.0, "the gap over all driving")


@pytest.mark.long
def test_it_shows_the_moving_twin(page):
    until(lambda: page.evaluate("twin.head.t") or 0.0 > 0, "samples")
    seek(page, 3.0)
    during(page, lambda: number(page, "#speed") > 20, "the vehicle's speed")
    during(page, lambda: number(page, "#gap") > 0.0, "a gap")
    assert page.inner_text("#name") == "Ford Mondeo Mk IV estate"
    first = page.evaluate("[twin.head.t, twin.frames()]")
    during(page, lambda: page.evaluate("twin.head.t") not in (first[0], None), "time to go on")
    during(page, lambda: page.evaluate("twin.frames()") > first[1], "another picture")
    assert len(page.query_selector_all("#travel > div")) == 4
    travels = "[...document.querySelectorAll('#travel b')].map((e) => e.textContent)"
    during(page, lambda: any(text.strip("–-−+0.") for text in page.evaluate(travels)), "a travel")
    assert len(page.query_selector_all(".band")) == 4  # the rest is the last
    during(page, lambda: page.evaluate("twin.state.path.length") > 20, "a path")
    for canvas in ("chart", "map"):
        during(page, lambda name=canvas: lit(page, name) > 3, f"a drawing in {canvas}")
    during(page, lambda: page.evaluate("twin.state.spectrum !== null"), "a spectrum")
    names = until(lambda: page.inner_text("#health").split("\n"), "health")
    for node in ("imu_ingest", "pose_injector", "suspension_model", "calibrator", "viewer"):
        assert node in names
    assert "Position known to 0.0" in page.inner_text("#advice")


def test_the_3d_picture_has_road_and_car_and_moves(page):
    seek(page, 4.0)
    during(page, lambda: page.evaluate("twin.state.pose.length") > 50, "poses")
    during(page, lambda: len(page.locator("#scene").screenshot()) > 8000, "a picture")
    assert page.is_hidden("#no3d")
    first = page.locator("#scene").screenshot()
    during(page, lambda: page.locator("#scene").screenshot() != first, "another picture")
    assert (
        int(
            page.evaluate(
                "performance.getEntriesByType('resource').filter((e) => e.name.includes('/road/')).length"
            )
        )
        > 4
    )


@pytest.mark.long
def test_the_replay_is_paused_wound_and_slowed(page):
    small(page)
    seek(page, 2.0)
    until(lambda: page.evaluate("twin.head.t") >= 2.0, "the place sought")
    pause(page)

    def stands() -> bool:
        position = page.inner_text("#position")
        time.sleep(1.2)
        return page.inner_text("#position") == position

    until(stands, "the replay to stand still")
    page.select_option("#pace", "0.5")
    seek(page, 2.0)
    until(lambda: page.inner_text("#pause") == "Pause", "it to go on")
    until(lambda: page.evaluate("(twin.state.pose.at(-1) || [99])[0]") < 5.0, "the place sought")
    before, began = page.evaluate("twin.state.pose.at(-1)[0]"), time.monotonic()
    until(lambda: page.evaluate("twin.state.pose.at(-1)[0]") > before + 2.5, "2.5 s of the drive")
    assert time.monotonic() - began > 3.3, "half the pace takes twice the time, on a busy machine longer"
    page.select_option("#pace", "5")
    until(lambda: page.inner_text("#pause") == "Again", "the end")
    page.select_option("#pace", "2")
    page.click("#pause")
    until(
        lambda: page.inner_text("#pause") == "Pause" and page.evaluate("twin.head.t") < 5.0, "a new beginning"
    )


@pytest.mark.long
def test_it_records_and_calibrates(page, running, drive):
    """A drive is recorded with a mark in it, and a calibration on it begins; its end is in test_viewer_actions.py.

    The page's process gets no processor for a second meanwhile, as on a busy machine: nothing is missing all the same.
    """
    small(page)
    _, folder, program = running
    (viewer,) = (int(pid) for pid in Path(f"/proc/{program}/task/{program}/children").read_text().split())
    assert page.is_disabled("#stop") and page.is_disabled("#load")
    page.select_option("#pace", "1")
    pause(page)
    page.click("#record")
    until(lambda: page.is_enabled("#stop"), "the recording")
    page.click("#calibrate")
    until(lambda: "still running" in page.inner_text("#said"), "a refusal")
    seek(page, 0.0)
    until(lambda: page.evaluate("twin.head.t") > 2.0, "two seconds")
    os.kill(viewer, signal.SIGSTOP)
    time.sleep(1.2)
    os.kill(viewer, signal.SIGCONT)
    page.click("#mark")
    until(lambda: page.evaluate("twin.state.events.length") == 1, "the mark")
    until(lambda: page.inner_text("#pause") == "Again", "the end")
    time.sleep(4.0)  # a lost message is asked for again after the writer's next heartbeat, 3 s at most
    page.click("#stop")
    until(lambda: page.inner_text("#said").startswith("Recorded"), "the end of the recording")
    (recording,) = folder.glob("drive_*")
    kept = read_drive(recording)
    assert kept.imu.t.tolist() == drive.imu.t.tolist()
    assert kept.fix.t.tolist() == drive.fix.t.tolist()
    assert (
        b"mark " in next(recording.glob("*.mcap")).read_bytes()
        or "events" in (recording / "metadata.yaml").read_text()
    )
    page.click("#calibrate")
    until(lambda: page.is_visible("#jobbar"), "the calibration's progress")
    until(lambda: "starting" not in page.inner_text("#jobtext"), "its first stage")


@pytest.mark.long
def test_it_fits_a_phone(browser, running):
    page = browser.new_page(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page.goto(running[0])
    until(lambda: page.inner_text("#name") == "Ford Mondeo Mk IV estate", "the twin's name")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for button in ("#record", "#mark", "#calibrate", "#diagnose"):
        box = page.locator(button).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["height"] >= 36
        assert page.locator(button).is_visible()
    loaded = "performance.getEntriesByType('resource').some((e) => e.name.includes('/scene.js'))"
    assert page.is_hidden("#scene") and not page.evaluate(loaded), "3D that nobody has asked for"
    page.click("#show3d")
    until(lambda: page.evaluate(loaded) and page.is_visible("#scene"), "the picture in 3D")
    page.click("#show3d")
    assert page.is_hidden("#scene") and page.inner_text("#show3d") == "Show 3D"
    page.close()


@pytest.mark.long
def test_a_page_that_hears_nothing_says_so_and_finds_its_program_again(browser, running):
    """As where the network goes away: the connection is neither closed nor of use, and a new one does not open."""
    page = browser.new_page()
    page.goto(running[0])
    small(page)
    connected = "document.getElementById('link').classList.contains('ok')"
    until(lambda: page.evaluate(connected), "a connection")
    program = running[2]
    children = [int(pid) for pid in Path(f"/proc/{program}/task/{program}/children").read_text().split()]
    for child in children:  # the viewer's process is one of them
        os.kill(child, signal.SIGSTOP)
    try:
        until(lambda: not page.evaluate(connected), "the loss")
        page.click("#mark")
        assert page.inner_text("#said").startswith("Not connected")
        time.sleep(7.0)  # a connection that is begun meanwhile is given up
        assert not page.evaluate(connected)
    finally:
        for child in children:
            os.kill(child, signal.SIGCONT)
    until(lambda: page.evaluate(connected), "the connection again")
    page.close()


@pytest.mark.long
def test_a_paused_program_is_heard_all_the_same(browser, running):
    page = browser.new_page()
    page.goto(running[0])
    connected = "document.getElementById('link').classList.contains('ok')"
    until(lambda: page.evaluate(connected), "a connection")
    small(page)
    pause(page)
    page.evaluate(
        "window.lost = 0, new MutationObserver(() => { window.lost++; })"
        ".observe(document.getElementById('link'), {attributes: true})"
    )
    time.sleep(8.0)
    assert page.evaluate("window.lost") == 0 and page.evaluate(connected)
    page.close()
