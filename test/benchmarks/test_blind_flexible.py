# SPDX-License-Identifier: Apache-2.0
"""The reality on bushings with a body that bends: at rest, under a load, twisted and ringing, by closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

NO_WIND = np.zeros((0, 2))


@pytest.fixture(scope="module")
def world() -> Any:
    """A world whose fast drive ends after 12 s, without what is no finding, on its road."""
    from blind.world import Background, make_world

    made = make_world(1003)
    whole = made.plans["drive_fast"]
    short = replace(whole, speed=whole.speed[:1200], push=whole.push[:1200])
    return replace(made, plans={"drive_fast": short}, background=Background())


def _on(world: Any, warp: float = 0.0) -> Any:
    """The world on a plane, or on ground that is ``warp`` m up under the front left and the rear right wheel and as
    much down under the others."""
    from blind.world import START

    u, v = world.surface.u[:, None], world.surface.v[None, :]
    ahead = np.where(u > START + 0.5 * world.car.wheelbase, 1.0, -1.0)
    return replace(world, surface=replace(world.surface, z=warp * ahead * np.sign(v) + 0.0 * u))


def _rates(world: Any) -> tuple[np.ndarray, np.ndarray]:
    """(4,) N/m of springs at the wheel where they stand."""
    from blind.world import SPRING_N, SPRING_REACH, G

    car, fine = world.car, np.linspace(0.0, SPRING_REACH, SPRING_N + 1)
    carried = car.loads() - car.unsprung() * G
    tables = [car.front.spring] * 2 + [car.rear.spring] * 2
    at = np.array([np.interp(f, t, fine) for f, t in zip(carried, tables, strict=True)])
    step = 1e-3
    up, down = (
        np.array([np.interp(x, fine, t) for x, t in zip(at + d, tables, strict=True)]) for d in (step, -step)
    )
    return (up - down) / (2 * step), at


def _stood(world: Any, faults: Any = None) -> Any:
    from blind import flexible

    plan = world.plans["drive_fast"]
    scene = flexible.stand(world, plan, faults or {})
    scene.advance(plan, NO_WIND, -round(flexible.SETTLE / flexible.STEP), 0)
    return scene


@pytest.mark.long
def test_a_standing_car_feels_gravity_alone_and_stays(world: Any) -> None:
    from blind import flexible
    from blind.world import G

    level = _on(world)
    plan, scene = level.plans["drive_fast"], _stood(level)
    before = scene.places.copy()
    felt, path, _ = scene.advance(plan, NO_WIND, 0, 4000)
    assert np.linalg.norm(felt[:, :3].mean(axis=0)) == pytest.approx(G, abs=1e-3)
    assert np.abs(felt[:, 3:]).max() < 1e-3
    assert np.abs(scene.places - before).max() < 1e-3
    assert np.abs(path[:, 8:]).max() < 3e-3  # springs and tyres were chosen for this load
    assert flexible.EVERY * flexible.STEP == 1e-3


def test_a_payload_sinks_the_body_by_its_weight_over_springs_and_tyres(world: Any) -> None:
    from blind.world import G

    level = _on(world)
    load = {"payload": {"mass": 100.0, "x": level.car.cog[0], "y": 0.0}}
    still, sunk = _stood(level), _stood(level, load)
    rates, _ = _rates(level)
    soft = 1.0 / (1.0 / rates + 1.0 / level.car.tyre_stiffness)
    # of all four wheels, weighted by their rates: that is the load
    down = still.places[0, 2] - sunk.places[0, 2] + (sunk.centre[2] - still.centre[2])
    tilt = sunk.places[1:, 2] - still.places[1:, 2]
    tyres = -tilt * level.car.tyre_stiffness
    assert tyres.sum() == pytest.approx(100.0 * G, rel=0.03)
    assert down == pytest.approx(100.0 * G / soft.sum(), rel=0.12)


def test_a_strut_shortens_by_its_lever(world: Any) -> None:
    """The lever is that of the links as rods: a wheel that is carried up on them, solved from their lengths."""
    from blind import flexible
    from blind.flexible import INNER, OUTER, STRUT
    from scipy.optimize import fsolve
    from scipy.spatial.transform import Rotation

    outer, inner = np.array(OUTER), np.array(INNER)
    low, top = (np.array(p) for p in STRUT)
    length = np.linalg.norm(outer - inner, axis=1)
    step = 1e-4

    def off(x: np.ndarray) -> np.ndarray:
        place = Rotation.from_rotvec(x[3:]).apply(outer) + x[:3]
        return np.append(np.linalg.norm(place - inner, axis=1) - length, x[2] - step)

    found = fsolve(off, np.zeros(6), xtol=1e-14)
    end = Rotation.from_rotvec(found[3:]).apply(low) + found[:3]
    shorter = np.linalg.norm(low - top) - np.linalg.norm(end - top)
    assert flexible.lever(outer, inner, low, top) == pytest.approx(shorter / step, rel=2e-3)
    assert 0.5 < shorter / step < 1.0


def test_warped_ground_twists_the_body_as_springs_in_series_do(world: Any) -> None:
    """Four corners of spring and tyre in series with the torsion of the body: K q = 4 k (w - q)."""
    from blind import flexible

    w = 0.01
    scenes = [_stood(_on(world, warp)) for warp in (w, -w)]
    twist = 0.5 * (scenes[0].bent[0] - scenes[1].bent[0])
    mass, rate, _ = flexible.modes_of(world, world.car, scenes[0].numbers[0])[0]
    springs, _ = _rates(world)
    corner = float(np.mean(1.0 / (1.0 / springs + 1.0 / world.car.tyre_stiffness)))
    # a strut's top stands further in than its wheel, and the shape is less there
    tops = [abs(flexible.shape(world.car, *p[:2])[0]) for p in scenes[0].fixed[10]]
    inside = float(np.mean(tops))
    assert twist == pytest.approx(
        4 * corner * w * inside / (mass * rate**2 + 4 * corner * inside**2), rel=0.15
    )


def test_the_body_rings_in_torsion_and_heave_at_the_frequencies_of_their_eigenproblems(world: Any) -> None:
    """Without dampers: heave by the masses on springs and tyres, torsion by the mode and four wheels between."""
    from blind import flexible

    car = world.car
    free = {name: replace(strut, push=1e-3 * strut.push, pull=1e-3 * strut.pull)
            for name, strut in (("front", car.front), ("rear", car.rear))}  # fmt: skip
    level = _on(replace(world, car=replace(car, **free)))
    plan = level.plans["drive_fast"]
    springs, _ = _rates(world)
    ks, kt, m = float(springs.mean()), car.tyre_stiffness, float(car.unsprung().mean())
    # what is damped at rest is put down before the dampers go
    start = _stood(_on(world))

    def ring(mode: int, push: float, count: int) -> np.ndarray:
        scene = flexible.stand(level, plan, {})
        for own, settled in zip(scene.state, start.state, strict=True):
            own[...] = settled
        if mode < 0:
            scene.state[2][:, 2] += push
        else:
            scene.bending[mode] = push
        _, path, bent = scene.advance(plan, NO_WIND, 0, count * flexible.EVERY)
        return path[:, 2] if mode < 0 else bent[:, mode]

    def strongest(x: np.ndarray, low: float, high: float) -> float:
        f = np.linspace(low, high, 600)
        t = np.arange(x.size) * 1e-3
        x = (x - x.mean()) * np.hanning(x.size)
        return float(f[np.argmax(np.abs(np.exp(-2j * np.pi * np.outer(f, t)) @ x))])

    body = float(start.numbers[0])
    heave = np.array([[4 * ks / body, -4 * ks / body], [-ks / m, (ks + kt) / m]])
    low = np.sqrt(np.sort(np.linalg.eigvals(heave).real)) / (2 * np.pi)
    assert strongest(ring(-1, 0.02, 4000), 0.7, 2.5) == pytest.approx(low[0], rel=0.04)
    mass, rate, _ = flexible.modes_of(level, level.car, body)[0]
    torsion = np.array([[rate**2 + 4 * ks / mass, -4 * ks / mass], [-ks / m, (ks + kt) / m]])
    high = np.sqrt(np.sort(np.linalg.eigvals(torsion).real)) / (2 * np.pi)
    assert strongest(ring(0, 0.02, 1500), 15.0, 32.0) == pytest.approx(high[1], rel=0.04)


def test_it_drives_the_same_road_as_the_others_and_feels_something_else(world: Any) -> None:
    from blind.folder import RUN

    rigid, elastic = (RUN[name](world, world.plans["drive_fast"]) for name in ("newton", "flexible"))
    u = np.linspace(rigid.u[4500], rigid.u[11_000], 4000)
    a, b = (np.interp(u, r.u, r.force[:, 2]) for r in (rigid, elastic))
    assert 0.8 < np.corrcoef(a, b)[0, 1] < 0.99
    assert np.abs(rigid.u - elastic.u).max() < 0.3
    assert np.abs(rigid.place[:, :2] - elastic.place[:, :2])[:11_000].max() < 0.3


@pytest.mark.parametrize(
    ("fault", "values", "lower"),
    [
        ("spring_sag", {"front": 0.03, "rear": 0.0, "rate": 0.0}, 0.03),
        ("strut_friction", {"front_force": 0.0, "rear_force": 0.0}, 0.0),
    ],
)
def test_a_sagged_spring_lets_the_front_down(
    world: Any, fault: str, values: dict[str, float], lower: float
) -> None:
    from blind import flexible

    level = _on(world)
    still, sunk = (_stood(level, f) for f in ({}, {fault: values}))
    kept = [s.state[10][flexible.k.TRAVEL] for s in (still, sunk)]
    assert (kept[1] - kept[0])[:2] == pytest.approx([lower, lower], abs=0.003)
