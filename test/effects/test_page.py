# SPDX-License-Identifier: Apache-2.0
"""The page on effects says what the effects say of themselves."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

MAKER = Path(__file__).resolve().parents[2] / "docs" / "make_effects.py"


def test_the_page_is_up_to_date() -> None:
    spec = spec_from_file_location("make_effects", MAKER)
    assert spec and spec.loader
    maker = module_from_spec(spec)
    spec.loader.exec_module(maker)
    assert maker.PAGE.read_text(encoding="utf-8") == maker.page(), "run docs/make_effects.py"
