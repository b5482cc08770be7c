# SPDX-License-Identifier: Apache-2.0
"""Drives over roads whose truth is known: a car of the blind benchmark's realities on a road of its own.

The twin is calibrated as a user would: on drives over another road, which was surveyed. Then the same car is
driven over the road that is to be estimated, of which nobody has a file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from blind import folder, phone, world
from blind.newton import Motion, rotate
from blind.plan import Spec
from blind.world import Floats, Plan, World, make_world
from reality.sensors import Receiver, receiver_fixes

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.types import Drive, FixData, VelocityData
from suspension_twin.drive.write import write_drive
from suspension_twin.road import write_road
from suspension_twin.road.road import ReferenceLine, Road
from suspension_twin.vehicle.twin import Twin, load_twin, parse_twin, save_twin

__all__ = ["LENGTH", "Site", "drive_over", "make_site", "phone_fixes", "truth_along"]

LENGTH = 300.0  # m
#: A phone's receiver: standard deviation m of the slow error, its time s, and of the white one, m and m/s.
_PHONE = {"wander": 2.5, "time": 60.0, "white": 0.5, "velocity": 0.1}


@dataclass(frozen=True, eq=False)
class Site:
    """A car on the road to be estimated: ``world`` is the truth, ``twin`` what was calibrated elsewhere."""

    world: World
    reality: str
    twin: Twin

    @property
    def survey(self) -> Road:
        """The road as a scan would have it."""
        return folder.road_file(self.world, self.world.survey)


@contextmanager
def _longer(length: float) -> Iterator[None]:
    """Roads and drives of ``length`` m in place of the blind benchmark's."""
    before = world.LENGTH
    world.LENGTH = length
    try:
        yield
    finally:
        world.LENGTH = before


def make_site(seed: int, reality: str) -> Site:
    """Calibrate on a surveyed road, then move the car to a new one."""
    home = make_world(seed)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for drive in ("drive_fast", "drive_slow"):
            motion = folder.RUN[reality](home, home.plans[drive], {})
            write_drive(phone.record(home, home.plans[drive], motion, {}, drive), place / drive)
        write_road(folder.road_file(home, home.survey), place / "road.crg")
        spec = Spec("site", "null", (), 0.0, seed, reality, False)
        save_twin(parse_twin(folder.twin_file(home, spec)), place / "twin.yaml")
        bags = tuple(str(place / d) for d in ("drive_fast", "drive_slow"))
        found = calibrate(CalibrationRequest(twin=str(place / "twin.yaml"), bags=bags))
        save_twin(found.twin, place / "calibrated.yaml")
        twin = load_twin(place / "calibrated.yaml").with_changes({"road": None})
    with _longer(LENGTH):
        surface = world._surface(np.random.default_rng([seed, 22]), 31 * seed + 77)
    survey = surface.surveyed(world.FILE_DU, world.FILE_DV, 0.0, 3e-4, 31 * seed + 78)
    return Site(replace(home, surface=surface, survey=survey, plans={}), reality, twin)


def drive_over(site: Site, kmh: float, number: int, faults: dict[str, dict[str, float]] | None = None,
               lane: float = 0.0) -> tuple[Drive, Motion]:  # fmt: skip
    """One drive at about ``kmh``, and what the car really did; ``number`` seeds it."""
    speed = kmh / 3.6
    rng = np.random.default_rng([site.world.seed, 40 + number])
    with _longer(LENGTH):
        plan: Plan = world.drive_plan(
            rng, 0.93 * speed, 1.07 * speed, 20 + number, site.world.seed, lane + rng.uniform(-0.1, 0.1)
        )
    motion = folder.RUN[site.reality](site.world, plan, dict(faults or {}))
    drive = phone.record(site.world, plan, motion, dict(faults or {}), f"drive_{number}_{kmh:.0f}kmh")
    return drive, motion


def phone_fixes(site: Site, drive: Drive, motion: Motion, number: int) -> Drive:
    """The same drive with the fixes of a phone: once a second, metres off, slowly wandering."""
    antenna = motion.place + rotate(motion.turn, np.broadcast_to(site.world.antenna, motion.place.shape))
    receiver = Receiver(
        rate=1.0,
        white=_PHONE["white"],
        wander=_PHONE["wander"],
        wander_time=_PHONE["time"],
        velocity=_PHONE["velocity"],
    )
    start = float(drive.fix.t[0]) - 0.1
    rng = np.random.default_rng([site.world.seed, 60 + number])
    constant = _PHONE["wander"] * rng.standard_normal(3)
    t, geodetic, velocity = receiver_fixes(
        motion.t[::2], antenna[::2] + constant, receiver, site.world.datum, start, 900 + number
    )
    spread = float(np.hypot(receiver.white, receiver.wander))
    fix = FixData(
        t, geodetic[:, 0], geodetic[:, 1], geodetic[:, 2], np.zeros(t.size, dtype=np.int8),
        np.tile([spread, spread, 2.0 * spread], (t.size, 1)),
    )  # fmt: skip
    return replace(drive, fix=fix, velocity=VelocityData(t, velocity))


def truth_along(site: Site, x: Floats, y: Floats, v: Floats | None = None) -> Floats:
    """True heights in m at ``map`` positions, or at lateral places ``v`` m of the road beside them."""
    surface = site.world.surface
    ends = float(surface.heading[0]), float(surface.heading[-1])
    line = surface.line
    reference = ReferenceLine.level(line[:, 0], line[:, 1], surface.du, ends)
    fine = Road("truth", surface.z, surface.v, reference)
    if v is None:
        return fine.heights(x, y, "hold")
    return fine.heights_uv(fine.xy_to_uv(x, y)[0], v, "hold")
