# SPDX-License-Identifier: Apache-2.0
"""The page of a fleet: what changed stands first, names are texts, and what is missing leaves no hole."""

from __future__ import annotations

import re
from typing import Any

from suspension_twin.addons.fleet.changes import find_changes
from suspension_twin.addons.fleet.page import fleet_page, quantity_label
from suspension_twin.addons.fleet.tables import health_rows

QUANTITY = "vehicle.front.damper_push@0.25"
NAME = "<b>car</b> $\\frac{"


def row(vehicle: str, date: str, force: float, **given: Any) -> dict[str, Any]:
    health = {"quantity": QUANTITY, "unit": "N", "identified": True}
    health |= {"value": force, "low": 0.97 * force, "high": 1.03 * force}
    place = {"along": 2.5, "latitude": 47.4, "longitude": 19.3, "rms": 0.4, "seconds": 1.0}
    found = {
        "vehicle": vehicle,
        "date": date,
        "status": "done",
        "message": "",
        "folder": "items/ab/ab12",
        "key": "ab12",
    }
    found |= {"channel": "vertical_acceleration", "gap_before": 0.8, "gap_after": 0.3, "verdict": None}
    found |= {"probability": None, "combination": [], "health": [health], "places": [place]}
    return found | given


def fleet() -> list[dict[str, Any]]:
    """Eight dates: the dampers of one vehicle weaken at the fifth, one row of the other failed."""
    dates = [f"2026-0{month}-01" for month in range(1, 9)]
    rows = [row("steady", d, 400.0 + 5.0 * (k % 2)) for k, d in enumerate(dates)]
    rows += [row(NAME, d, (420.0 if k < 4 else 270.0) + 5.0 * (k % 2)) for k, d in enumerate(dates)]
    lost = {
        "status": "failed",
        "message": "no.mcap: <i>missing",
        "folder": None,
        "gap_after": None,
        "channel": None,
    }
    return [*rows, row("steady", "2026-09-01", 0.0, health=[], places=[], **lost)]


def text_of(html: str) -> str:
    return re.sub(r"<[^>]*>", "", html)


def test_what_changed_stands_first_and_names_are_texts() -> None:
    rows = fleet()
    html = fleet_page(rows, find_changes(health_rows(rows)), "calibrate", "fleet.csv").render()
    assert "<b>car" not in html and "<i>missing" not in html
    assert "1 of 2 vehicles changed: &lt;b&gt;car&lt;/b&gt; $\\frac{." in html
    first = html[html.index('id="vehicles-to-look-at-first"') : html.index('id="changes"')]
    assert "2026-05-01" in first and 'href="items/ab/ab12/"' in first and "steady" not in first
    assert re.search(r"Front damper push at 0\.25 m/s 3\d % lower", text_of(first))
    health = html[html.index('id="health-over-time"') : html.index('id="where-the-gaps-lie"')]
    assert health.count("<polyline") == 2 and "275 N" in health and "405 N" in health
    assert "no.mcap: &lt;i&gt;missing" in html and "http" not in html.replace("http://www.w3.org", "")


def test_nothing_done_is_a_page_as_well() -> None:
    rows = [
        row(
            "a",
            "",
            0.0,
            status="lost",
            message="out of reach",
            folder=None,
            health=[],
            places=[],
            channel=None,
        )
    ]
    text = text_of(fleet_page(rows, [], "calibrate").render())
    assert "No row could be done." in text and "out of reach" in text


def test_a_diagnosed_fleet_shows_verdicts_and_answers() -> None:
    dates = ("2026-01-01", "2026-02-01")
    rows = [row("well", d, 0.0, verdict="no_gap", probability=0.9, health=[]) for d in dates]
    answer = "Very likely (92 %): the dampers are worn"
    fault = {"verdict": "effect", "probability": 0.92, "combination": ["worn_dampers"], "message": answer}
    rows += [row("ill", dates[0], 0.0, verdict="no_gap", probability=0.9, health=[])]
    rows += [row("ill", dates[1], 0.0, health=[], **fault)]
    html = fleet_page(rows, [], "diagnose").render()
    text = text_of(html)
    assert "1 of 2 vehicles differ from their twins: ill." in text and answer in text and "1 of 2" in text
    assert html.count("<rect x") >= 4 and "2026-02-01: worn dampers" in html


def test_quantities_have_names_for_people() -> None:
    assert quantity_label("vehicle.tyre.vertical_stiffness") == "tyre vertical stiffness"
    assert quantity_label("effects.strut_friction.front_force") == "dry friction in the struts, force, front"
    assert quantity_label("vehicle.damper_pull@0.25") == "damper pull at 0.25 m/s"
