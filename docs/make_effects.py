#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Writes docs/effects.md from what the effects say of themselves: ``python docs/make_effects.py``."""

from __future__ import annotations

from pathlib import Path

from suspension_twin.diagnosis.hypotheses import WITNESSES
from suspension_twin.effects.base import Effect, Parameter
from suspension_twin.effects.registry import EFFECTS

PAGE = Path(__file__).resolve().parent / "effects.md"
HEAD = """# Effects

What a twin's model can be given that it did not have. In a twin file:

```yaml
effects:
  - {id: strut_friction, parameters: {front_force: 120.0, rear_force: 90.0}}
  - {id: sensor_bandwidth, parameters: {cutoff: 18.0}}
```

A parameter that is not given is neutral, and an effect whose severity (in bold) is neutral changes
no bit of any result. Effects combine freely. This page is written by `docs/make_effects.py`.
"""
WHERE = {
    "strut": "In the struts",
    "tyre": "In the tyres",
    "body": "In the body",
    "sensor": "In the sensor",
    "time": "In the clocks",
    "road": "In the road file",
}


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for where, title in WHERE.items():
        parts.append(f"\n## {title}\n")
        parts += [_entry(e) for e in EFFECTS.values() if e.where == where]
    return "".join(parts)


def _entry(e: Effect) -> str:
    models = ", ".join(f"`{m}`" for m in e.hook.models)
    rows = "".join(_row(p, p.name in e.severity) for p in e.parameters)
    witness = (
        " The diagnosis takes it for a shape, not for a cause, unless asked: see [there](diagnosis.md#which)."
    )
    return (
        f"\n### `{e.id}`: {e.title}\n\n{e.doc}\n\n"
        f"| parameter | unit | from, to | neutral | prior | what |\n| --- | --- | --- | --- | --- | --- |\n{rows}\n"
        f"Excited by {'; '.join(e.excited_by)}. Easily confused with {'; '.join(e.confused_with)}. For {models}."
        f"{_anyway(e)}{witness if e.id in WITNESSES else ''}\n"
    )


def _anyway(e: Effect) -> str:
    """What of an effect is there anyway and no finding."""
    if e.usual_share:
        return f" Up to {100 * e.usual_share:g} % of the mass is normal."
    usual = next((p for p in e.parameters if p.usual), None)
    return "" if usual is None else f" Up to {usual.usual:g} {usual.unit or 'of change'} is normal."


def _row(p: Parameter, severe: bool) -> str:
    name = f"**`{p.name}`**" if severe else f"`{p.name}`"
    prior = f"{p.typical:g} × or ÷ {p.spread:g}" if p.log else f"{p.typical:g} ± {p.spread:g}"
    if p.choices:
        prior = "each"
    return f"| {name} | {p.unit or '–'} | {p.low:g}, {p.high:g} | {p.neutral:g} | {prior} | {p.doc} |\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
