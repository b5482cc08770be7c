# SPDX-License-Identifier: Apache-2.0
"""The page of a diagnosis: the answer first, in words, the rest folded away."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis.request import DiagnosisResult, DriveView
from suspension_twin.report import plots
from suspension_twin.report.diagnosis import diagnosis_page
from suspension_twin.vehicle.twin import RoadFile, load_twin

START = 1_700_000_000.0


def cause(effect: str, probability: float, parameters: dict[str, float], **more: Any) -> dict[str, Any]:
    return {
        "effect": effect,
        "probability": probability,
        "parameters": parameters,
        "gap_before": 0.4,
        "gap_after": 0.1,
        "shrink": 0.75,
        "shrink_interval": [0.7, 0.8],
        "channel": "vertical_acceleration",
        "shrink_beyond_recalibration": 0.6,
        "shrink_beyond_recalibration_interval": [0.58, 0.62],
        "indistinguishable_from": [],
        "judged": True,
        "log_evidence": 12.0,
        **more,
    }


def document(verdict: str = "effect", **changes: Any) -> dict[str, Any]:
    causes = [
        cause("corner_damper", 0.93, {"corner": 0.0, "change": -0.4}),
        cause("payload", 0.02, {"mass": 90.0, "x": 1.0, "y": 0.0}),
        cause("strut_friction", 0.0, {"front_force": 120.0, "rear_force": 0.0}),
        cause("time_offset", 0.0, {"offset": 0.004}),
        cause("road_scale", 0.0, {"scale": 0.1}),
        cause("sensor_tilt", 0.0, {"roll": 0.01, "pitch": 0.0, "yaw": 0.0}, judged=False),
    ]
    channels = {"vertical_acceleration": 0.4, "roll_rate": 0.02}
    return {
        "verdict": verdict,
        "probability": {"no_gap": 0.04, "unknown": 0.01}.get(verdict, 0.93),
        "gap_after": 0.3,
        "candidates": [],
        "gap": {
            "rms": 0.4,
            "mse": 0.16,
            "noise_rms": 0.03,
            "channel": "vertical_acceleration",
            "channels": channels,
        },
        "where": {
            "time": [{"bag": "fast", "start": START + 3.0, "end": START + 4.0, "share": 0.4}],
            "road": [{"start_m": 12.0, "end_m": 15.0, "share": 0.5}],
            "frequency": [{"low_hz": 2.0, "high_hz": 4.0, "share": 0.5}],
            "channel": [{"name": "roll_rate", "share": 0.6}, {"name": "vertical_acceleration", "share": 0.4}],
            "corner": [{"name": "front_left", "share": 0.5}, {"name": "rear_right", "share": 0.2}],
            "operating_point": [],
        },
        "causes": causes,
        "no_gap_probability": 0.04,
        "unknown_probability": 0.01,
        "combination": ["corner_damper"] if verdict in ("effect", "partly") else [],
        "unexplained": 0.25,
        "recalibration": {
            "gap_before": 0.4,
            "gap_after": 0.3,
            "shrink": 0.25,
            "shrink_interval": [0.1, 0.3],
        },
        "background": {
            "share_of_motion_left": 0.1,
            "share_left_on_reference": None,
            "noise_share_of_residual": 0.2,
        },
        "cannot_be_judged": ["sensor_tilt"],
        "warnings": [],
        "next_experiment": "Drive a speed bump.",
        "seed": 0,
        "message": f"{verdict.replace('_', ' ')}: 0.3 m/s² remain",
        **changes,
    }


def drive(name: str = "fast", channel: str = "vertical_acceleration") -> DriveView:
    t = START + np.arange(0.0, 10.0, 0.01)
    road = np.linspace(5.0, 60.0, t.size)
    measured = np.sin(9.0 * (t - START)) * np.exp(-(((t - START - 4.0) / 2.0) ** 2))
    compared = np.ones(t.size, dtype=bool)
    simulated = {"before": 0.6 * measured, "after": 0.95 * measured}
    return DriveView(name, channel, 100.0, t, road, measured, simulated, compared)


def result(
    repository: Any, d: dict[str, Any], drives: tuple[DriveView, ...] | None = None
) -> DiagnosisResult:
    twin = load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")
    twin = twin.model_copy(update={"road": RoadFile(file=repository / "road.crg")})
    return DiagnosisResult(d, twin, (drive(),) if drives is None else drives, 1.0)


def visible(html: str) -> str:
    """The text that shows before anything is unfolded, tags and drawings left out."""
    html = re.sub(r"<details>.*?</details>|<svg.*?</svg>|<style>.*?</style>", " ", html, flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]+>", " ", html).split())


def test_the_answer_stands_first_in_words_of_a_mechanic(repository):
    html = diagnosis_page(result(repository, document())).render()
    sentence = "Very likely (93 %): the front left damper has lost 40 % of its force."
    assert html.index(sentence) < html.index("<section")
    headings = re.findall(r"<h2>(.*?)</h2>", html)
    assert headings[:4] == [
        "Before and after",
        "Where the gap is",
        "The likeliest causes",
        "What to drive next",
    ]
    folded = re.findall(r"<summary><h2>(.*?)</h2>", html)
    assert folded == headings[4:]
    assert {"Every cause that was tried", "Where, in figures", "Method"} <= set(folded)


def test_visible_text_has_names_units_and_times_from_the_start(repository):
    text = visible(diagnosis_page(result(repository, document())).render())
    assert "wheel front left" in text and "corner 0" not in text
    assert "3 s after the start of fast" in text and "17000000" not in text
    assert "force, front 120 N" in text and "offset 4 ms" in text
    assert not re.search(r"[a-z]_[a-z]", text.replace("suspension_twin", ""))
    assert "nats" not in text


def test_five_causes_show_and_the_rest_is_folded(repository):
    html = diagnosis_page(result(repository, document())).render()
    text = visible(html)
    assert "The road is 10 % higher" in text  # the fifth
    assert "turned against" not in text
    assert "Sensor tilted (cannot be judged)" in html and 'title="sensor tilt"' in html
    assert "Something that is not in the library 1 %" in text


def test_the_channel_that_closes_is_named(repository):
    d = document()
    d["causes"][0].update(channel="roll_rate", gap_before=0.02, gap_after=0.005)
    html = diagnosis_page(result(repository, d, (drive(channel="roll_rate"),))).render()
    assert "gap between twin and car in <strong>roll rate</strong>" in html
    assert "0.005 rad/s" in html
    assert "roll rate [rad/s]" in html
    row = re.search(r"<td>The front left damper.*?</tr>", html, re.DOTALL)
    assert row is not None and "roll rate" in row[0]


@pytest.mark.parametrize("verdict", ["partly", "no_gap", "unknown"])
def test_every_verdict_has_a_page_without_stutter(repository, verdict):
    d = document(verdict)
    if verdict != "no_gap":
        band = {"low_hz": 6.0, "high_hz": 8.0, "peak_hz": 7.0}
        d["signature"] = {"channel": "roll_rate", **band, "resembles": []}
    html = diagnosis_page(result(repository, d)).render()
    assert not re.search(r"(no gap|unknown|partly): \1", html, re.IGNORECASE)
    assert ("The unexplained gap" in html) == (verdict != "no_gap")
    assert "twin recalibrated" in html


def test_candidates_and_errors_that_are_not_new_are_remarks(repository):
    d = document(candidates=["corner_damper", "no_gap"], before_and_after=True, probability=0.97)
    text = visible(diagnosis_page(result(repository, d)).render())
    assert "Extremely likely (97 %)" in text
    assert "the truth is among: one odd damper, nothing is wrong" in text
    assert "Not new: before and after alike." in text


def test_a_gap_without_a_place_is_spread_evenly(repository):
    d = document(where={key: [] for key in document()["where"]}, cannot_be_judged=[])
    text = visible(diagnosis_page(result(repository, d, ())).render())
    assert "spread evenly" in text and "Cannot be judged" not in text


def test_effects_that_cannot_be_judged_are_listed_once(repository):
    text = visible(diagnosis_page(result(repository, document())).render())
    assert text.count("Cannot be judged, as these drives do not excite them: sensor tilted.") == 1


def test_the_car_from_above_names_every_wheel_and_rings_the_faulty_one():
    wheels = np.array([[2.7, 0.8], [2.7, -0.8], [0.0, 0.8], [0.0, -0.8]])
    axes = plots.car_from_above(wheels, {"front_left": 0.5}, marked=["rear_right"], sensor=(1.0, 0.2)).axes[0]
    texts = [t.get_text() for t in axes.texts]
    assert {"front left\n50 %", "front right", "rear left", "rear right", "sensor"} <= set(texts)
    rings = [line for line in axes.lines if line.get_marker() == "o"]
    assert [tuple(np.ravel(ring.get_data())) for ring in rings] == [(0.0, -0.8)]


HOSTILE = (
    "<script>document.title='owned'</script>",
    '"><img src=x onerror="document.title=\'owned\'">',
    "'><svg onload=document.title='owned'>",
    "</svg><script>document.title='owned'</script>",
    "javascript:document.title='owned'",
    "`*_[x](javascript:document.title='owned')",
)


class Acting(HTMLParser):
    """Collects what of a page could act: scripts, handlers, addresses that are code, frames."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [tag] if tag in ("script", "iframe", "object", "embed", "base", "form", "link") else []
        for name, value in attrs:
            address = name in ("href", "src", "xlink:href", "action", "data")
            code = address and (value or "").strip().lower().startswith(("javascript:", "data:text"))
            self.found += [f"{tag} {name}"] if name.startswith("on") or code or name == "srcdoc" else []


@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_of_a_vehicle_a_drive_an_effect_or_a_file_becomes_a_part_of_the_page(repository, name):
    d = document(warnings=[name], next_experiment=name, message=name, cannot_be_judged=[name])
    d["where"]["time"][0]["bag"] = name
    d["causes"][0]["effect"] = d["combination"][0] = "corner_damper"
    d["causes"].append(cause("payload", 0.0, {"mass": 1.0, "x": 0.0, "y": 0.0}, channel="roll_rate"))
    made = result(repository, d, (drive(name),))
    vehicle = made.twin.vehicle.model_copy(update={"name": name})
    road = RoadFile(file=repository / f"{name.replace('/', '')}.crg")
    made = replace(made, twin=made.twin.model_copy(update={"vehicle": vehicle, "road": road}))
    html = diagnosis_page(made).render()
    page = Acting()
    page.feed(html)
    assert page.found == []


@pytest.mark.parametrize(
    ("proposed", "wanted"),
    [({"speed_kmh": 20.0}, True), ({"speed_kmh": 20.0, "road": "a bump"}, False), ({}, False)],
)
def test_the_page_says_how_to_go_on_with_a_drive_over_the_same_road(repository, proposed, wanted):
    html = diagnosis_page(result(repository, document(next_drive=proposed))).render()
    assert ("diagnose --add DRIVE" in html) is wanted


def test_intervals_on_these_drives_and_on_one_more_are_told_apart(repository):
    html = diagnosis_page(result(repository, document())).render()
    assert "by (90 % interval, one more drive)" in html and "(70 % to 80 % on one more drive" in html
    assert "60 % (58 % to 62 %)" in html and "with the interval on these drives alone" in html


def test_a_small_picture_alone_is_no_larger_than_beside_another(repository):
    """Drawn twice as wide its letters would be twice as large."""
    html = diagnosis_page(result(repository, document())).render()
    (columns,) = re.findall(r"[.]row [{][^}]*grid-template-columns: repeat[(]([a-z-]+),", html)
    assert columns == "auto-fill"
