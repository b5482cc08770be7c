# SPDX-License-Identifier: Apache-2.0
"""The page of a live fleet: its list, and who may open the page of a twin."""

from __future__ import annotations

import asyncio
import io
import shutil
from collections.abc import Iterator

import numpy as np
import pytest
from aiohttp import ClientSession
from matplotlib.image import imread

from suspension_twin.addons.view.fleet import FleetServer
from suspension_twin.errors import WorkError

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def _open(name: str) -> int:
    if name == "b":
        raise WorkError("the page of this twin did not start")
    return 4711


@pytest.fixture
def server() -> Iterator[FleetServer]:
    made = FleetServer(["a", "b"], _open, port=0, token="secret")
    yield made
    made.close()


def asked(server: FleetServer, path: str, name: str | None = None, token: str = "secret", **headers: str):
    """Status and text of an answer."""

    async def ask() -> tuple[int, str]:
        url = f"http://127.0.0.1:{server.port}{path}?token={token}"
        async with ClientSession() as session:
            call = (
                session.get(url, headers=headers)
                if name is None
                else session.post(url, data=name, headers=headers)
            )
            async with call as answer:
                return answer.status, await answer.text()

    return asyncio.run(ask())


def test_the_list_says_how_every_twin_is(server):
    server.update({"b": {"rate": 100.0, "gap": "0.20 m/s²", "text": "", "failing": False}})
    status, text = asked(server, "/twins")
    assert status == 200
    assert text.startswith('[{"name": "a"}, {"name": "b", "rate": 100.0')
    page = asked(server, "/")[1]
    assert "static/fleet.js" in page
    assert asked(server, "/static/fleet.js")[0] == 200


def test_a_twin_is_opened_by_its_name(server):
    assert asked(server, "/open", "a") == (200, '{"port": 4711, "token": "secret"}')
    assert asked(server, "/open", "b") == (400, "the page of this twin did not start\n")
    assert asked(server, "/open", "c") == (400, "request: asks for a twin that there is not\n")


def test_others_open_nothing(server):
    assert asked(server, "/open", "a", token="guess")[0] == 403
    assert asked(server, "/twins", token="")[0] == 403
    assert asked(server, "/open", "a", Origin="http://elsewhere.example")[0] == 403


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
def test_in_a_browser_what_is_wrong_is_red_and_what_is_well_is_not(server):
    from playwright.sync_api import sync_playwright

    well = {"rate": 100.0, "gap": "0.20 m/s² (3.1 × noise)", "text": "", "failing": False}
    server.update(
        {"a": well, "b": {"rate": 0.0, "gap": "", "text": "imu_ingest: no message", "failing": True}}
    )
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 900, "height": 400})
        page.goto(server.url)
        page.wait_for_function("document.querySelectorAll('#twins tr.bad').length == 1")
        assert "0.20 m/s² (3.1 × noise)" in page.inner_text("#twins")
        bad = page.evaluate("getComputedStyle(document.documentElement).getPropertyValue('--bad')").strip()
        pictures = [page.locator(f"#twins tr:nth-child({n})").screenshot() for n in (1, 2)]
        browser.close()
    red = np.array([int(bad[i : i + 2], 16) for i in (1, 3, 5)])
    rows = [255.0 * imread(io.BytesIO(png), format="png")[:, :, :3].reshape(-1, 3) for png in pictures]
    well_red, bad_red = (int((np.abs(row - red).max(axis=1) < 30.0).sum()) for row in rows)
    assert well_red == 0 and bad_red > 20
