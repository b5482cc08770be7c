# SPDX-License-Identifier: Apache-2.0
"""Mass on board that the twin file does not list."""

from __future__ import annotations

import numpy as np

from suspension_twin.effects.base import (
    Effect,
    Floats,
    Given,
    Hook,
    Parameter,
    Prior,
    Values,
    Variant,
    more,
    plain,
)

#: Height of seats and luggage above the ground, m.
HEIGHT = 0.75


def _vehicle(numbers: dict[str, Floats], p: Values) -> None:
    added, mass = p["mass"], numbers["vehicle.mass"]
    place = (p["x"], p["y"], HEIGHT)
    far = [place[i] - numbers[f"vehicle.cog.{i}"] for i in range(3)]
    # parallel axes: both masses about their common centre
    reduced = added * mass / (mass + added)
    roll, pitch = "vehicle.sprung_inertia.roll", "vehicle.sprung_inertia.pitch"
    numbers[roll] = numbers[roll] + reduced * (far[1] ** 2 + far[2] ** 2)
    numbers[pitch] = numbers[pitch] + reduced * (far[0] ** 2 + far[2] ** 2)
    numbers["vehicle.mass"] = mass + added
    for i in range(3):
        key = f"vehicle.cog.{i}"
        numbers[key] = numbers[key] + added / (mass + added) * far[i]


#: A load of tonnes on a tracked vehicle of tens; its plane of symmetry knows no left and right.
_TRACKED = (
    Parameter("mass", (-8000.0, 12000.0), Prior(0.0, 2500.0), "kg", "of the load"),
    Parameter(
        "x",
        (-1.0, 6.0),
        Prior(2.2, 1.0),
        "m",
        "of its centre, ahead of the rearmost road wheels",
        neutral=2.2,
    ),
)


def _hull(numbers: dict[str, Floats], p: Values) -> None:
    """A lump on half a vehicle at the height of the hull's centre of gravity."""
    links, stations = numbers["vehicle.track.links"], 0
    while f"vehicle.stations.{stations}.x" in numbers:
        stations += 1
    wheels = stations * numbers["vehicle.wheel.mass"]
    hull = 0.5 * numbers["vehicle.mass"] - wheels - links * numbers["vehicle.track.link_mass"]
    lump, far = (
        0.5 * p["mass"],
        p["x"] + numbers[f"vehicle.stations.{stations - 1}.x"] - numbers["vehicle.cog.0"],
    )
    inertia = hull * numbers["vehicle.gyration"] ** 2 + hull * lump / (hull + lump) * far**2
    numbers["vehicle.mass"] = numbers["vehicle.mass"] + p["mass"]
    numbers["vehicle.cog.0"] = numbers["vehicle.cog.0"] + lump / (hull + lump) * far
    with np.errstate(invalid="ignore"):  # more taken off than there is: no such vehicle
        numbers["vehicle.gyration"] = np.sqrt(inertia / (hull + lump))


#: A quarter of a car's.
_CORNER = (Parameter("mass", (0.0, 375.0), Prior(0.0, 37.5), "kg", "of the load on the corner"),)


def _corner(numbers: dict[str, Floats], p: Values) -> None:
    numbers["vehicle.sprung_mass"] = numbers["vehicle.sprung_mass"] + p["mass"]


def _finding(p: Given) -> str:
    x, y = p.get("x"), p.get("y", 0.0)
    load = "more" if p["mass"] >= 0 else "less"
    text = f"the vehicle carries {plain(abs(p['mass']), 'kg')} {load} than its file says"
    if x is None:
        return text
    side = f" and {more(y, 'm', 'to the left', 'to the right')}" if abs(y) >= 0.1 else ""
    return f"{text}, {more(x, 'm', 'ahead of', 'behind')} the rear wheels{side}"


EFFECT = Effect(
    id="payload",
    title="unlisted payload",
    where="body",
    doc="A point mass on the body, 0.75 m above the ground: people or luggage that the mass in the file leaves "
    "out. Mass, centre of gravity, inertia and standing compression all change.",
    parameters=(
        Parameter("mass", (0.0, 1500.0), Prior(0.0, 150.0), "kg", "of the load"),
        Parameter(
            "x", (-1.5, 5.0), Prior(0.5, 0.8), "m", "of its centre, ahead of the rear axle", neutral=0.5
        ),
        Parameter("y", (-1.0, 1.0), Prior(0.0, 0.3), "m", "of its centre, to the left"),
    ),
    order=10,
    severity=("mass",),
    excited_by=("body resonance, 1 to 2 Hz", "braking and accelerating"),
    confused_with=("spring points", "sprung_inertia.pitch"),
    usual_share=0.04,
    hook=Hook(vehicle=_vehicle, models=("full_car", "msd"), upright=True),
    variants={
        "tracked": Variant(_TRACKED, Hook(vehicle=_hull)),
        "quarter_car": Variant(_CORNER, Hook(vehicle=_corner)),
    },
    finding=_finding,
)
